//! What a pass is told of where it draws from, and of the diamonds that it draws.

use super::drape::Start;
use super::frame::{FrameUniform, LayerUniform, Reference, single};
use super::look::Background;
use super::pipelines::Kind;
use super::view::View;
use super::{Draw, LAYER_STRIDE, Look, Renderer};
use crate::camera::nearest_drawn;
use crate::drawing::DrawItem;
use crate::surface::Surface;
use diamantina_protocol::message::{self, Layer};

/// The farthest that the near plane goes, in metres, whatever lies beyond.
const NEAR_MAX: f64 = 1e6;

/// A diamond's place, as the vertex shader takes it.
#[repr(C)]
#[derive(Debug, Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
pub(super) struct Instance {
    origin: [i32; 2],
    axes: [i32; 4],
    level: i32,
    /// The moment to draw, and ticks that a motion takes; 0 and 1 where nothing moves. Of irregular triangles that are seen in
    /// some pixels: the bits of the two numbers of their share.
    now: i32,
    duration: i32,
    /// The first tile of imagery, and where in it the eye is and what a metre is.
    tile: u32,
    drape: [f32; 4],
    /// How large its triangles are in the mean, in metres: the side of a square of two; 0 where no lines are drawn.
    triangle: f32,
}

/// What a pass is told of where it draws from: uniforms, and the places of its diamonds.
pub(super) struct Lens {
    frame: wgpu::Buffer,
    pub(super) frame_group: wgpu::BindGroup,
    pub(super) layers: Option<(wgpu::Buffer, wgpu::BindGroup)>,
    pub(super) instances: Option<wgpu::Buffer>,
}

impl Lens {
    pub(super) fn new(device: &wgpu::Device, groups: &[wgpu::BindGroupLayout; 2]) -> Self {
        let frame = device.create_buffer(&wgpu::BufferDescriptor {
            label: Some("frame"),
            size: size_of::<FrameUniform>() as u64,
            usage: wgpu::BufferUsages::UNIFORM | wgpu::BufferUsages::COPY_DST,
            mapped_at_creation: false,
        });
        let frame_group = device.create_bind_group(&wgpu::BindGroupDescriptor {
            label: Some("frame"),
            layout: &groups[0],
            entries: &[wgpu::BindGroupEntry { binding: 0, resource: frame.as_entire_binding() }],
        });
        Self { frame, frame_group, layers: None, instances: None }
    }

    /// Bytes of GPU memory that it takes.
    pub(super) fn bytes(&self) -> u64 {
        let layers = self.layers.as_ref().map_or(0, |(buffer, _)| buffer.size());
        self.frame.size() + layers + self.instances.as_ref().map_or(0, wgpu::Buffer::size)
    }

    /// Tells it all of a pass; the distance of the near plane, in metres. `encode`: see [`FrameUniform::new`].
    pub(super) fn write(
        &mut self,
        renderer: &Renderer,
        layers: &[Layer],
        view: &View,
        look: &Look,
        draws: &[Draw<'_>],
        encode: bool,
    ) -> f32 {
        let Renderer { device, queue, groups, .. } = renderer;
        let eye = view.eye();
        let nearest = draws.iter().map(|d| d.distance).fold(NEAR_MAX, f64::min);
        // A little before the nearest box: rounding must not cut it.
        let near = single((0.9 * nearest).max(nearest_drawn(layers.iter().flat_map(|layer| layer.cell))));
        let frame = FrameUniform::new(view, look, near, encode, renderer.options.anisotropy);
        queue.write_buffer(&self.frame, 0, bytemuck::bytes_of(&frame));

        let references: Vec<_> =
            layers.iter().map(|layer| Reference::near(layer, eye, look.exaggeration)).collect();
        let mut uniforms = vec![0u8; LAYER_STRIDE * layers.len().max(1)];
        for ((layer, reference), slot) in
            layers.iter().zip(&references).zip(uniforms.chunks_mut(LAYER_STRIDE))
        {
            let uniform = reference.uniform(layer, eye, look);
            slot[..size_of::<LayerUniform>()].copy_from_slice(bytemuck::bytes_of(&uniform));
        }
        let (buffer, _) = match self.layers.take() {
            Some(old) if old.0.size() >= uniforms.len() as u64 => self.layers.insert(old),
            _ => self.layers.insert(layer_group(device, &groups[1], uniforms.len())),
        };
        queue.write_buffer(buffer, 0, &uniforms);

        let instances: Vec<_> = draws
            .iter()
            .map(|draw| {
                let layer = draw.item.layer;
                let mut local = layers[layer].forest.local(draw.item.diamond);
                if draw.item.surface.tin().is_some() {
                    local.origin = draw.item.diamond.centre().map(i64::from);
                }
                // Steps are at most a root square's side, 2^24.
                let [ux, uy, vx, vy] = [local.u[0], local.u[1], local.v[0], local.v[1]]
                    .map(|step| i32::try_from(step).unwrap_or(0));
                let moving = draw.item.moving.as_ref();
                let (now, duration) = moving.map_or((0, 1), |m| (m.now.ticks(), m.motion.duration()));
                // Neither has both: the bits of floats.
                let [now, duration] = match draw.kind {
                    Kind::FadingCorners => draw.item.share.0.map(|part| part.to_bits().cast_signed()),
                    _ => [now, duration],
                };
                let is_terrain = layers[layer].kind == message::Kind::Terrain;
                let start =
                    if is_terrain { renderer.drapes.start(&draw.bounds, view) } else { Start::default() };
                Instance {
                    origin: references[layer].relative(local.origin),
                    axes: [ux, uy, vx, vy],
                    level: i32::try_from(draw.item.diamond.level()).unwrap_or(0),
                    now,
                    duration,
                    tile: start.node,
                    drape: start.place,
                    // Lines alone are told.
                    triangle: if look.wireframe {
                        single(triangle_metres(&layers[layer], draw.item))
                    } else {
                        0.0
                    },
                }
            })
            .collect();
        let bytes: &[u8] = bytemuck::cast_slice(&instances);
        let buffer = match self.instances.take() {
            Some(old) if old.size() >= bytes.len() as u64 => self.instances.insert(old),
            _ => self.instances.insert(device.create_buffer(&wgpu::BufferDescriptor {
                label: Some("instances"),
                size: (bytes.len() as u64).next_power_of_two().max(4096),
                usage: wgpu::BufferUsages::VERTEX | wgpu::BufferUsages::COPY_DST,
                mapped_at_creation: false,
            })),
        };
        queue.write_buffer(buffer, 0, bytes);
        near
    }

    /// The sky wherever nothing was drawn, if there is one.
    pub(super) fn draw_sky(&self, pass: &mut wgpu::RenderPass<'_>, sky: &wgpu::RenderPipeline, look: &Look) {
        if look.background == Background::Sky {
            pass.set_pipeline(sky);
            pass.set_bind_group(0, &self.frame_group, &[]);
            pass.draw(0..3, 0..1);
        }
    }
}

/// The side of a square of two triangles of an item, as large as they are in the mean, in metres.
fn triangle_metres(layer: &Layer, item: &DrawItem) -> f64 {
    let local = layer.forest.local(item.diamond);
    let metres = |[x, y]: [i64; 2]| [x as f64 * layer.cell[0], y as f64 * layer.cell[1]];
    let ([a, b], [c, d]) = (metres(local.u), metres(local.v));
    let cell = (a * d - b * c).abs();
    let squares = match &*item.surface {
        Surface::Points(points) if points.block().has_centres() => 2.0,
        Surface::Points(_) => 1.0,
        Surface::Tin(tin) => {
            // Half of a diamond lies beyond the forest's rim, if it is not upper.
            let cells = layer.forest.segments_at(item.diamond.level()).pow(2) as f64;
            tin.triangles() as f64 / if local.upper { 2.0 } else { 1.0 } / cells
        }
    };
    (cell / squares.max(1e-9)).sqrt()
}

fn layer_group(
    device: &wgpu::Device,
    layout: &wgpu::BindGroupLayout,
    bytes: usize,
) -> (wgpu::Buffer, wgpu::BindGroup) {
    let buffer = device.create_buffer(&wgpu::BufferDescriptor {
        label: Some("layers"),
        size: bytes as u64,
        usage: wgpu::BufferUsages::UNIFORM | wgpu::BufferUsages::COPY_DST,
        mapped_at_creation: false,
    });
    let group = device.create_bind_group(&wgpu::BindGroupDescriptor {
        label: Some("layers"),
        layout,
        entries: &[wgpu::BindGroupEntry {
            binding: 0,
            resource: wgpu::BindingResource::Buffer(wgpu::BufferBinding {
                buffer: &buffer,
                offset: 0,
                size: wgpu::BufferSize::new(size_of::<LayerUniform>() as u64),
            }),
        }],
    });
    (buffer, group)
}
