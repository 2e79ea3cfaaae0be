//! How many triangles the graphics draw a second by themselves: one mesh in one draw, with next to nothing to do for a
//! vertex or a pixel. What a flight's triangles a second are to be seen beside.

use criterion::{Criterion, Throughput};

/// The pictures' size.
const SIZE: [u32; 2] = [1380, 768];

/// Times that the mesh is drawn for one wait.
const DRAWS: u32 = 8;

const FORMAT: wgpu::TextureFormat = wgpu::TextureFormat::Rgba8UnormSrgb;
const DEPTH: wgpu::TextureFormat = wgpu::TextureFormat::Depth32Float;

const SHADER: &str = "
@vertex fn vertex(@location(0) place: vec2<f32>) -> @builtin(position) vec4<f32> {
    return vec4(2.0 * place - 1.0, 0.5, 1.0);
}
@fragment fn fragment() -> @location(0) vec4<f32> {
    return vec4(0.4, 0.5, 0.3, 1.0);
}";

/// What is drawn with.
struct Graphics {
    name: String,
    device: wgpu::Device,
    queue: wgpu::Queue,
    pipeline: wgpu::RenderPipeline,
    colour: wgpu::TextureView,
    depth: wgpu::TextureView,
}

impl Graphics {
    /// On the best adapter that there is.
    fn new() -> Option<Self> {
        let instance = wgpu::Instance::new(wgpu::InstanceDescriptor::new_without_display_handle());
        let wanted = wgpu::RequestAdapterOptions {
            power_preference: wgpu::PowerPreference::HighPerformance,
            ..Default::default()
        };
        let adapter = pollster::block_on(instance.request_adapter(&wanted)).ok()?;
        let wanted = wgpu::DeviceDescriptor { required_limits: adapter.limits(), ..Default::default() };
        let (device, queue) = pollster::block_on(adapter.request_device(&wanted)).ok()?;
        let pipeline = pipeline(&device);
        let [width, height] = SIZE;
        let view = |format| {
            let texture = device.create_texture(&wgpu::TextureDescriptor {
                label: None,
                size: wgpu::Extent3d { width, height, depth_or_array_layers: 1 },
                mip_level_count: 1,
                sample_count: 1,
                dimension: wgpu::TextureDimension::D2,
                format,
                usage: wgpu::TextureUsages::RENDER_ATTACHMENT,
                view_formats: &[],
            });
            texture.create_view(&wgpu::TextureViewDescriptor::default())
        };
        let (colour, depth) = (view(FORMAT), view(DEPTH));
        Some(Self { name: adapter.get_info().name, device, queue, pipeline, colour, depth })
    }

    /// Draws a mesh some times, and waits until that is done.
    fn draw(&self, mesh: &Mesh) {
        let mut encoder = self.device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
        let mut pass = encoder.begin_render_pass(&wgpu::RenderPassDescriptor {
            color_attachments: &[Some(wgpu::RenderPassColorAttachment {
                view: &self.colour,
                depth_slice: None,
                resolve_target: None,
                ops: wgpu::Operations {
                    load: wgpu::LoadOp::Clear(wgpu::Color::BLACK),
                    store: wgpu::StoreOp::Store,
                },
            })],
            depth_stencil_attachment: Some(wgpu::RenderPassDepthStencilAttachment {
                view: &self.depth,
                depth_ops: Some(wgpu::Operations {
                    load: wgpu::LoadOp::Clear(0.0),
                    store: wgpu::StoreOp::Discard,
                }),
                stencil_ops: None,
            }),
            ..Default::default()
        });
        pass.set_pipeline(&self.pipeline);
        pass.set_vertex_buffer(0, mesh.places.slice(..));
        pass.set_index_buffer(mesh.indices.slice(..), wgpu::IndexFormat::Uint32);
        for _ in 0..DRAWS {
            pass.draw_indexed(0..3 * mesh.triangles, 0, 0..1);
        }
        drop(pass);
        self.queue.submit([encoder.finish()]);
        self.device.poll(wgpu::PollType::wait_indefinitely()).expect("the device is lost");
    }
}

fn pipeline(device: &wgpu::Device) -> wgpu::RenderPipeline {
    let module = device.create_shader_module(wgpu::ShaderModuleDescriptor {
        label: None,
        source: wgpu::ShaderSource::Wgsl(SHADER.into()),
    });
    device.create_render_pipeline(&wgpu::RenderPipelineDescriptor {
        label: None,
        layout: None,
        vertex: wgpu::VertexState {
            module: &module,
            entry_point: Some("vertex"),
            compilation_options: wgpu::PipelineCompilationOptions::default(),
            buffers: &[Some(wgpu::VertexBufferLayout {
                array_stride: 8,
                step_mode: wgpu::VertexStepMode::Vertex,
                attributes: &wgpu::vertex_attr_array![0 => Float32x2],
            })],
        },
        primitive: wgpu::PrimitiveState::default(),
        depth_stencil: Some(wgpu::DepthStencilState {
            format: DEPTH,
            depth_write_enabled: Some(true),
            // All draws lie at the same depth: only the first one's pixels are written.
            depth_compare: Some(wgpu::CompareFunction::Greater),
            stencil: wgpu::StencilState::default(),
            bias: wgpu::DepthBiasState::default(),
        }),
        multisample: wgpu::MultisampleState::default(),
        fragment: Some(wgpu::FragmentState {
            module: &module,
            entry_point: Some("fragment"),
            compilation_options: wgpu::PipelineCompilationOptions::default(),
            targets: &[Some(FORMAT.into())],
        }),
        multiview_mask: None,
        cache: None,
    })
}

/// A regular grid over the whole picture, in blocks of eight cells, as caches of vertices like it.
struct Mesh {
    places: wgpu::Buffer,
    indices: wgpu::Buffer,
    triangles: u32,
}

impl Mesh {
    /// Of so many cells a side, a multiple of 8.
    fn new(graphics: &Graphics, side: u32) -> Self {
        let row = side + 1;
        let place = |i: u32| [i % row, i / row].map(|w| w as f32 / side as f32);
        let places: Vec<[f32; 2]> = (0..row * row).map(place).collect();
        let blocks = (0..side).step_by(8).flat_map(|y| (0..side).step_by(8).map(move |x| [x, y]));
        let cells = blocks.flat_map(|[x, y]| (0..64).map(move |i| (y + i / 8) * row + x + i % 8));
        let indices: Vec<[u32; 6]> =
            cells.map(|sw| [sw, sw + 1, sw + row + 1, sw, sw + row + 1, sw + row]).collect();
        let buffer = |bytes: &[u8], usage| {
            let size = bytes.len() as u64;
            let buffer = graphics.device.create_buffer(&wgpu::BufferDescriptor {
                label: None,
                size,
                usage: usage | wgpu::BufferUsages::COPY_DST,
                mapped_at_creation: false,
            });
            graphics.queue.write_buffer(&buffer, 0, bytes);
            buffer
        };
        Self {
            places: buffer(bytemuck::cast_slice(&places), wgpu::BufferUsages::VERTEX),
            indices: buffer(bytemuck::cast_slice(&indices), wgpu::BufferUsages::INDEX),
            triangles: 2 * side * side,
        }
    }
}

fn main() {
    let mut bench = Criterion::default().configure_from_args();
    let Some(graphics) = Graphics::new() else {
        println!("graphics: no adapter, so nothing to measure");
        return;
    };
    println!("graphics: {}", graphics.name);
    let mut group = bench.benchmark_group("graphics");
    group.sample_size(10);
    // Triangles of 8 pixels, half a pixel, and an eighth.
    for side in [256, 1024, 2048] {
        let mesh = Mesh::new(&graphics, side);
        group.throughput(Throughput::Elements(u64::from(DRAWS) * u64::from(mesh.triangles)));
        group.bench_function(format!("triangles_of_a_mesh_of_{}", mesh.triangles), |b| {
            b.iter(|| graphics.draw(&mesh));
        });
    }
    group.finish();
    bench.final_summary();
}
