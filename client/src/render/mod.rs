//! Diamonds and a camera → a picture. The only module, with the fronts, that knows wgpu.
//!
//! | module | what it holds |
//! |---|---|
//! | `frame` | the uniforms, and how positions stay exact far from the origin |
//! | `resident` | surfaces on the GPU, under a budget |
//! | `offscreen` | pictures without a window |
//!
//! A diamond is one or two draws: its points at their own buffer, its place and axes as an instance, the
//! index lists shared by all. One in motion has a second buffer, of the motions of its points, and a pipeline that
//! reads it; irregular triangles have vertices and index lists of their own, and theirs. Nothing is used that WebGL2 lacks: no storage buffers, no base vertex, no
//! indirect draws. Depth is reversed and infinite, positions are relative to the eye.

mod frame;
#[cfg(not(target_arch = "wasm32"))]
mod offscreen;
mod resident;

#[cfg(test)]
mod tests;

#[cfg(not(target_arch = "wasm32"))]
pub use offscreen::Offscreen;

use crate::camera::{Camera, nearest_drawn};
use crate::drawing::DrawItem;
use crate::morph::Record;
use crate::surface::{Corner, Surface};
use diamantina_protocol::message::{Layer, Scene};
use frame::{FrameUniform, LayerUniform, Reference, single};
use glam::DVec3;
use resident::{Residents, SurfacePoint, Triangles};
use std::ops::Range;

const TERRAIN_WGSL: &str =
    concat!(include_str!("../../../shaders/frame.wgsl"), include_str!("../../../shaders/terrain.wgsl"));
const SKY_WGSL: &str =
    concat!(include_str!("../../../shaders/frame.wgsl"), include_str!("../../../shaders/sky.wgsl"));

const DEPTH: wgpu::TextureFormat = wgpu::TextureFormat::Depth32Float;

/// Bytes from one layer's uniforms to the next: the largest alignment that WebGPU and WebGL2 ask for.
const LAYER_STRIDE: usize = 256;

/// The farthest that the near plane goes, in metres, whatever lies beyond.
const NEAR_MAX: f64 = 1e6;

/// What a renderer is made for, once and for all.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Options {
    /// The format of the views drawn to. If it is not an sRGB format, the shader encodes sRGB.
    pub format: wgpu::TextureFormat,
    /// Samples a pixel: 1, or 4 to smooth edges.
    pub samples: u32,
    /// Bytes of GPU memory for surfaces; those that a frame draws are kept whatever they take.
    pub budget_bytes: u64,
}

impl Default for Options {
    /// Four samples, 512 MiB: about eight thousand diamonds of 64 segments.
    fn default() -> Self {
        Self { format: wgpu::TextureFormat::Rgba8UnormSrgb, samples: 4, budget_bytes: 512 << 20 }
    }
}

/// How a frame looks.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Look {
    /// What is seen where no terrain is.
    pub background: Background,
    /// Where the light comes from.
    pub sun: Sun,
    /// What terrain is coloured by.
    pub colours: Colours,
    /// The thickness of the air: 0 is none, 1 a clear day.
    pub haze: f32,
    /// What heights are multiplied by; above 0. The camera's positions count in stretched heights.
    pub exaggeration: f64,
    /// Whether to tint diamonds by level.
    pub show_levels: bool,
    /// Whether to draw the sides of triangles.
    pub wireframe: bool,
}

impl Default for Look {
    fn default() -> Self {
        Self {
            background: Background::Sky,
            sun: Sun::default(),
            colours: Colours::Auto,
            haze: 1.0,
            exaggeration: 1.0,
            show_levels: false,
            wireframe: false,
        }
    }
}

impl Look {
    /// How a scene looks unless told otherwise: other bodies than the Earth are grey, without air, and the sun
    /// stands low, as plains of dust show little relief else.
    #[must_use]
    pub fn of(scene: &Scene) -> Self {
        let radius = scene.frame.crs.as_ref().and_then(|crs| crs.proj4.as_deref()).and_then(radius);
        if radius.is_none_or(|metres| (metres - EARTH_RADIUS).abs() < 100_000.0) {
            return Self::default();
        }
        let black = Background::Colour([0.003, 0.003, 0.004, 1.0]);
        let sun = Sun { altitude_degrees: 20.0, ..Sun::default() };
        Self { background: black, sun, colours: Colours::Grey, haze: 0.0, ..Self::default() }
    }
}

/// Metres from the Earth's centre, give or take 20 km.
const EARTH_RADIUS: f64 = 6_371_000.0;

/// The radius that a PROJ string names by number, in metres.
fn radius(proj4: &str) -> Option<f64> {
    proj4.split_whitespace().find_map(|w| w.strip_prefix("+R=").or(w.strip_prefix("+a=")))?.parse().ok()
}

/// What is seen where no terrain is.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Background {
    /// A gradient from the horizon to overhead.
    Sky,
    /// One colour: linear red, green, blue and alpha.
    Colour([f32; 4]),
}

/// The direction to the sun.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sun {
    /// Degrees from north, clockwise.
    pub azimuth_degrees: f64,
    /// Degrees above the horizon.
    pub altitude_degrees: f64,
}

impl Default for Sun {
    /// North-west and half way up: the custom of maps, which makes valleys look like valleys.
    fn default() -> Self {
        Self { azimuth_degrees: 315.0, altitude_degrees: 45.0 }
    }
}

impl Sun {
    /// The unit vector towards the sun: x east, y north, z up.
    #[must_use]
    pub fn direction(self) -> DVec3 {
        let (azimuth, altitude) = (self.azimuth_degrees.to_radians(), self.altitude_degrees.to_radians());
        DVec3::new(azimuth.sin() * altitude.cos(), azimuth.cos() * altitude.cos(), altitude.sin())
    }
}

/// What terrain is coloured by.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Colours {
    /// As `Bathymetry` for layers a good part of whose range is below 0 m, as `Terrain` for others: lowlands
    /// and noise around 0 m are no sea.
    Auto,
    /// Height, over the layer's range.
    Terrain,
    /// Height, and depth below 0 m.
    Bathymetry,
    /// Height, from dark to light grey: for bodies without plants and water.
    Grey,
    /// Nothing: one grey.
    Flat,
}

/// What a frame cost.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct FrameStats {
    /// Triangles sent to the GPU.
    pub triangles: u64,
    /// Draw calls.
    pub draws: u32,
    /// Bytes of surfaces uploaded for this frame.
    pub uploaded_bytes: u64,
    /// Bytes of GPU memory that surfaces take.
    pub gpu_bytes: u64,
}

/// What helps where there is no adapter, and where there is no device.
const ADVICE: [&str; 2] = if cfg!(target_arch = "wasm32") {
    [
        "this browser offers neither WebGPU nor WebGL2: switch hardware acceleration on in its settings, or use another",
        "update the browser and the driver, or use another browser",
    ]
} else {
    [
        "install a Vulkan driver, for example the software one of the Debian package mesa-vulkan-drivers",
        "update its driver, or use a software one, for example mesa-vulkan-drivers of Debian",
    ]
};

/// Why there is no picture.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum RenderError {
    /// The machine has no graphics driver that fits.
    #[error("no graphics adapter ({0}): {advice}", advice = ADVICE[0])]
    NoAdapter(String),
    /// The adapter refused.
    #[error("the graphics adapter gives no device: {0}: {advice}", advice = ADVICE[1])]
    Device(String),
    /// A size that cannot be drawn.
    #[error("picture of {} x {} pixels: expected 1 to {limit} each way", found[0], found[1])]
    Size {
        /// The size asked for.
        found: [u32; 2],
        /// The adapter's limit.
        limit: u32,
    },
    /// The picture was drawn but did not come back.
    #[error("the picture could not be read back from the graphics adapter: {0}: ask for a smaller --size")]
    Read(String),
}

/// What draws: on a machine its own graphics, as far as they are more than WebGL2; in a browser WebGPU, or WebGL2 where it
/// has no other.
pub(crate) const BACKENDS: wgpu::Backends = if cfg!(target_arch = "wasm32") {
    wgpu::Backends::BROWSER_WEBGPU.union(wgpu::Backends::GL)
} else {
    wgpu::Backends::PRIMARY
};

/// The system's graphics, of these kinds.
pub(crate) async fn instance(backends: wgpu::Backends) -> wgpu::Instance {
    let mut description = wgpu::InstanceDescriptor::new_without_display_handle();
    description.backends = backends;
    wgpu::util::new_instance_with_webgpu_detection(description).await
}

/// The best adapter that there is, in software if need be, of those that draw on a surface if there is one; and a device
/// of it.
pub(crate) async fn device(
    instance: &wgpu::Instance,
    surface: Option<&wgpu::Surface<'_>>,
    label: &str,
) -> Result<(wgpu::Adapter, wgpu::Device, wgpu::Queue), RenderError> {
    let request = instance.request_adapter(&wgpu::RequestAdapterOptions {
        power_preference: wgpu::PowerPreference::HighPerformance,
        compatible_surface: surface,
        ..Default::default()
    });
    let adapter = request.await.map_err(|e| RenderError::NoAdapter(e.to_string()))?;
    // No more than a browser has, so that whatever works here works there.
    let limits = wgpu::Limits::downlevel_webgl2_defaults().using_resolution(adapter.limits());
    let request = adapter.request_device(&wgpu::DeviceDescriptor {
        label: Some(label),
        required_limits: limits,
        ..Default::default()
    });
    let (device, queue) = request.await.map_err(|e| RenderError::Device(e.to_string()))?;
    Ok((adapter, device, queue))
}

/// A diamond's place, as the vertex shader takes it.
#[repr(C)]
#[derive(Debug, Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
struct Instance {
    origin: [i32; 2],
    axes: [i32; 4],
    level: i32,
    /// The moment to draw, and ticks that a motion takes; 0 and 1 where nothing moves.
    now: i32,
    duration: i32,
}

/// A draw: an item of the frame that is in view.
struct Draw<'a> {
    item: &'a DrawItem,
    sides: u8,
    shares_triangles: bool,
    kind: Kind,
    distance: f64,
}

/// What a diamond's vertices are.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Kind {
    Points,
    MovingPoints,
    Corners,
}

/// How triangles are drawn.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Mode {
    Filled,
    /// A little farther away than they are, so that lines along their sides are seen.
    Behind,
    Lines,
}

/// A pipeline for each kind.
type Pipelines = [wgpu::RenderPipeline; 3];

/// Draws frames to views that the caller owns.
pub struct Renderer {
    device: wgpu::Device,
    queue: wgpu::Queue,
    options: Options,
    residents: Residents,
    filled: Pipelines,
    /// Behind, and lines: made when they are first needed.
    wires: Option<[Pipelines; 2]>,
    terrain_groups: [wgpu::BindGroupLayout; 2],
    sky: wgpu::RenderPipeline,
    frame_group: wgpu::BindGroup,
    frame_uniform: wgpu::Buffer,
    layers: Option<(wgpu::Buffer, wgpu::BindGroup)>,
    instances: Option<wgpu::Buffer>,
    attachments: Option<Attachments>,
}

/// The textures of a frame besides the target.
struct Attachments {
    size: [u32; 2],
    depth: wgpu::TextureView,
    /// The target of several samples a pixel, if there are.
    colour: Option<wgpu::TextureView>,
}

impl Renderer {
    /// A renderer on a device that the caller made. Needs no features, and no limits beyond WebGL2's.
    #[must_use]
    pub fn new(device: wgpu::Device, queue: wgpu::Queue, options: &Options) -> Self {
        let layout = |label, dynamic, size: usize| {
            device.create_bind_group_layout(&wgpu::BindGroupLayoutDescriptor {
                label: Some(label),
                entries: &[wgpu::BindGroupLayoutEntry {
                    binding: 0,
                    visibility: wgpu::ShaderStages::VERTEX_FRAGMENT,
                    ty: wgpu::BindingType::Buffer {
                        ty: wgpu::BufferBindingType::Uniform,
                        has_dynamic_offset: dynamic,
                        min_binding_size: wgpu::BufferSize::new(size as u64),
                    },
                    count: None,
                }],
            })
        };
        let frame_layout = layout("frame", false, size_of::<FrameUniform>());
        let layer_layout = layout("layer", true, size_of::<LayerUniform>());
        let frame_uniform = device.create_buffer(&wgpu::BufferDescriptor {
            label: Some("frame"),
            size: size_of::<FrameUniform>() as u64,
            usage: wgpu::BufferUsages::UNIFORM | wgpu::BufferUsages::COPY_DST,
            mapped_at_creation: false,
        });
        let frame_group = device.create_bind_group(&wgpu::BindGroupDescriptor {
            label: Some("frame"),
            layout: &frame_layout,
            entries: &[wgpu::BindGroupEntry { binding: 0, resource: frame_uniform.as_entire_binding() }],
        });
        let terrain_groups = [frame_layout.clone(), layer_layout];
        let filled = terrain_pipelines(&device, options, &terrain_groups, Mode::Filled);
        let sky = sky_pipeline(&device, options, &[Some(&frame_layout)]);
        Self {
            residents: Residents::new(options.budget_bytes),
            options: *options,
            filled,
            wires: None,
            terrain_groups,
            sky,
            frame_group,
            frame_uniform,
            layers: None,
            instances: None,
            attachments: None,
            device,
            queue,
        }
    }

    /// The device that frames are drawn on.
    #[must_use]
    pub fn device(&self) -> &wgpu::Device {
        &self.device
    }

    /// The queue that frames are sent to.
    #[must_use]
    pub fn queue(&self) -> &wgpu::Queue {
        &self.queue
    }

    /// Draws a frame to `view`, which is of `camera.size` pixels and of the format of the options, and
    /// sends it to the GPU; does not wait for it. Surfaces not seen before are uploaded.
    ///
    /// Items whose layer is not in `layers`, or whose surface is of another number of segments than the
    /// layer's, are passed over.
    pub fn draw(
        &mut self,
        layers: &[Layer],
        camera: &Camera,
        items: &[DrawItem],
        look: &Look,
        view: &wgpu::TextureView,
    ) -> FrameStats {
        let uploaded_bytes = self.residents.start_frame(&self.device, layers, items, look.wireframe);
        if look.wireframe && self.wires.is_none() {
            let made = |mode| terrain_pipelines(&self.device, &self.options, &self.terrain_groups, mode);
            self.wires = Some([made(Mode::Behind), made(Mode::Lines)]);
        }
        let draws = self.in_view(layers, camera, items, look.exaggeration);
        self.write_uniforms(layers, camera, look, &draws);
        let attachments = match self.attachments.take() {
            Some(old) if old.size == camera.size => old,
            _ => Attachments::new(&self.device, &self.options, camera.size),
        };
        let mut stats =
            FrameStats { uploaded_bytes, gpu_bytes: self.residents.bytes(), ..Default::default() };
        let mut encoder = self.device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
        {
            let mut pass = begin_pass(&mut encoder, &attachments, view, look, self.options.format);
            match self.wires.as_ref().filter(|_| look.wireframe) {
                None => self.draw_terrain(&mut pass, &draws, &self.filled, false, &mut stats),
                Some([behind, lines]) => {
                    self.draw_terrain(&mut pass, &draws, behind, false, &mut stats);
                    self.draw_terrain(&mut pass, &draws, lines, true, &mut FrameStats::default());
                }
            }
            if look.background == Background::Sky {
                pass.set_pipeline(&self.sky);
                pass.set_bind_group(0, &self.frame_group, &[]);
                pass.draw(0..3, 0..1);
            }
        }
        self.attachments = Some(attachments);
        self.queue.submit([encoder.finish()]);
        stats
    }

    /// The items that the camera may see, in an order that switches index buffers seldom and draws what
    /// is near first, so that it hides what is behind at the least cost.
    fn in_view<'a>(
        &self,
        layers: &[Layer],
        camera: &Camera,
        items: &'a [DrawItem],
        exaggeration: f64,
    ) -> Vec<Draw<'a>> {
        let planes = camera.planes();
        let mut draws: Vec<_> = items
            .iter()
            .filter_map(|item| {
                let resident = self.residents.get(item)?;
                let layer = layers.get(item.layer)?;
                let bounds = resident.bounds(layer.quantum).map(|b| b.stretched(exaggeration));
                let bounds = bounds.filter(|b| b.touches(&planes))?;
                let upper = layer.forest.local(item.diamond).upper;
                let sides = item.sides & if upper { 0b1111 } else { 0b0011 };
                let distance = bounds.distance(camera.eye);
                let shares_triangles = resident.own.is_none();
                let kind = match &*item.surface {
                    Surface::Tin(_) => Kind::Corners,
                    Surface::Points(_) if resident.motion.is_some() => Kind::MovingPoints,
                    Surface::Points(_) => Kind::Points,
                };
                Some(Draw { item, sides, shares_triangles, kind, distance })
            })
            .collect();
        draws.sort_by(|a, b| {
            let key = |d: &Draw<'_>| (d.item.layer, d.kind, !d.shares_triangles);
            key(a).cmp(&key(b)).then(a.distance.total_cmp(&b.distance))
        });
        draws
    }

    fn write_uniforms(&mut self, layers: &[Layer], camera: &Camera, look: &Look, draws: &[Draw<'_>]) {
        let nearest = draws.iter().map(|d| d.distance).fold(NEAR_MAX, f64::min);
        // A little before the nearest box: rounding must not cut it.
        let near = single((0.9 * nearest).max(nearest_drawn(layers.iter().flat_map(|layer| layer.cell))));
        let frame = FrameUniform::new(camera, look, near, !self.options.format.is_srgb());
        self.queue.write_buffer(&self.frame_uniform, 0, bytemuck::bytes_of(&frame));

        let references: Vec<_> =
            layers.iter().map(|layer| Reference::near(layer, camera.eye, look.exaggeration)).collect();
        let mut uniforms = vec![0u8; LAYER_STRIDE * layers.len().max(1)];
        for ((layer, reference), slot) in
            layers.iter().zip(&references).zip(uniforms.chunks_mut(LAYER_STRIDE))
        {
            let uniform = reference.uniform(layer, camera.eye, look);
            slot[..size_of::<LayerUniform>()].copy_from_slice(bytemuck::bytes_of(&uniform));
        }
        let (buffer, _) = match self.layers.take() {
            Some(old) if old.0.size() >= uniforms.len() as u64 => self.layers.insert(old),
            _ => self.layers.insert(layer_group(&self.device, &self.terrain_groups[1], uniforms.len())),
        };
        self.queue.write_buffer(buffer, 0, &uniforms);

        let instances: Vec<_> = draws
            .iter()
            .map(|draw| {
                let layer = draw.item.layer;
                let mut local = layers[layer].forest.local(draw.item.diamond);
                if draw.kind == Kind::Corners {
                    local.origin = draw.item.diamond.centre().map(i64::from);
                }
                // Steps are at most a root square's side, 2^24.
                let [ux, uy, vx, vy] = [local.u[0], local.u[1], local.v[0], local.v[1]]
                    .map(|step| i32::try_from(step).unwrap_or(0));
                let moving = draw.item.moving.as_ref();
                let (now, duration) = moving.map_or((0, 1), |m| (m.now.ticks(), m.motion.duration()));
                Instance {
                    origin: references[layer].relative(local.origin),
                    axes: [ux, uy, vx, vy],
                    level: i32::try_from(draw.item.diamond.level()).unwrap_or(0),
                    now,
                    duration,
                }
            })
            .collect();
        let bytes: &[u8] = bytemuck::cast_slice(&instances);
        let buffer = match self.instances.take() {
            Some(old) if old.size() >= bytes.len() as u64 => self.instances.insert(old),
            _ => self.instances.insert(self.device.create_buffer(&wgpu::BufferDescriptor {
                label: Some("instances"),
                size: (bytes.len() as u64).next_power_of_two().max(4096),
                usage: wgpu::BufferUsages::VERTEX | wgpu::BufferUsages::COPY_DST,
                mapped_at_creation: false,
            })),
        };
        self.queue.write_buffer(buffer, 0, bytes);
    }

    /// Draws the triangles of the items, or the lines around them.
    fn draw_terrain(
        &self,
        pass: &mut wgpu::RenderPass<'_>,
        draws: &[Draw<'_>],
        pipelines: &Pipelines,
        lines: bool,
        stats: &mut FrameStats,
    ) {
        let (Some((_, layer_group)), Some(instances)) = (&self.layers, &self.instances) else { return };
        pass.set_bind_group(0, &self.frame_group, &[]);
        let (mut layer_now, mut places_now, mut triangles_now) = (None, None, None::<&Triangles>);
        let mut kind_now = None;
        for (draw, instance) in draws.iter().zip(0u32..) {
            let grid = self.residents.grid(draw.item);
            let Some(resident) = self.residents.get(draw.item) else { continue };
            let triangles = resident.own.as_ref().or(grid.map(|grid| &grid.triangles));
            let Some(triangles) = triangles else { continue };
            if kind_now != Some(draw.kind) {
                kind_now = Some(draw.kind);
                pass.set_pipeline(&pipelines[draw.kind as usize]);
                pass.set_vertex_buffer(if draw.kind == Kind::Corners { 1 } else { 2 }, instances.slice(..));
                places_now = None;
            }
            if layer_now != Some(draw.item.layer) {
                layer_now = Some(draw.item.layer);
                let offset = u32::try_from(LAYER_STRIDE * draw.item.layer).unwrap_or(0);
                pass.set_bind_group(1, layer_group, &[offset]);
            }
            if let Some(grid) = grid.filter(|grid| places_now != Some(&grid.places)) {
                places_now = Some(&grid.places);
                pass.set_vertex_buffer(0, grid.places.slice(..));
            }
            if !triangles_now.is_some_and(|now| std::ptr::eq(now, triangles)) {
                triangles_now = Some(triangles);
                let indices = if lines { triangles.lines.as_ref() } else { None };
                pass.set_index_buffer(
                    indices.unwrap_or(&triangles.indices).slice(..),
                    wgpu::IndexFormat::Uint16,
                );
            }
            pass.set_vertex_buffer(u32::from(draw.kind != Kind::Corners), resident.points.slice(..));
            if let Some(motion) = &resident.motion {
                pass.set_vertex_buffer(3, motion.records.slice(..));
            }
            for range in runs(&triangles.sides, draw.sides) {
                stats.draws += 1;
                stats.triangles += u64::from((range.end - range.start) / 3);
                // Each index of a triangle begins a line of two.
                let range = if lines { 2 * range.start..2 * range.end } else { range };
                pass.draw_indexed(range, 0, instance..instance + 1);
            }
        }
    }
}

/// The index ranges of the chosen sides, those that follow each other joined: at most two.
fn runs(sides: &[Range<u32>; 4], chosen: u8) -> impl Iterator<Item = Range<u32>> {
    let on = move |side: usize| side < 4 && chosen >> side & 1 == 1;
    let first = (0..4).filter(move |side| on(*side) && (*side == 0 || !on(side - 1)));
    first
        .map(move |first| {
            let last = (first..4).take_while(|side| on(*side)).last().unwrap_or(first);
            sides[first].start..sides[last].end
        })
        .filter(|run| !run.is_empty())
}

impl Attachments {
    fn new(device: &wgpu::Device, options: &Options, size: [u32; 2]) -> Self {
        let view = |label, format| {
            let [width, height] = size;
            let texture = device.create_texture(&wgpu::TextureDescriptor {
                label: Some(label),
                size: wgpu::Extent3d { width, height, depth_or_array_layers: 1 },
                mip_level_count: 1,
                sample_count: options.samples,
                dimension: wgpu::TextureDimension::D2,
                format,
                usage: wgpu::TextureUsages::RENDER_ATTACHMENT,
                view_formats: &[],
            });
            texture.create_view(&wgpu::TextureViewDescriptor::default())
        };
        let colour = (options.samples > 1).then(|| view("samples", options.format));
        Self { size, depth: view("depth", DEPTH), colour }
    }
}

fn begin_pass<'a>(
    encoder: &'a mut wgpu::CommandEncoder,
    attachments: &Attachments,
    view: &wgpu::TextureView,
    look: &Look,
    format: wgpu::TextureFormat,
) -> wgpu::RenderPass<'a> {
    let clear = match look.background {
        Background::Sky => [0.0, 0.0, 0.0, 1.0],
        Background::Colour(colour) => colour.map(f64::from),
    };
    let [r, g, b] = [0, 1, 2].map(|i| if format.is_srgb() { clear[i] } else { encoded(clear[i]) });
    let (target, resolve_target) = match &attachments.colour {
        Some(samples) => (samples, Some(view)),
        None => (view, None),
    };
    let store = if resolve_target.is_some() { wgpu::StoreOp::Discard } else { wgpu::StoreOp::Store };
    encoder.begin_render_pass(&wgpu::RenderPassDescriptor {
        label: Some("frame"),
        color_attachments: &[Some(wgpu::RenderPassColorAttachment {
            view: target,
            depth_slice: None,
            resolve_target,
            ops: wgpu::Operations { load: wgpu::LoadOp::Clear(wgpu::Color { r, g, b, a: clear[3] }), store },
        })],
        depth_stencil_attachment: Some(wgpu::RenderPassDepthStencilAttachment {
            view: &attachments.depth,
            depth_ops: Some(wgpu::Operations {
                load: wgpu::LoadOp::Clear(0.0),
                store: wgpu::StoreOp::Discard,
            }),
            stencil_ops: None,
        }),
        ..Default::default()
    })
}

/// The sRGB curve, for a clear colour on a target that stores colours as they are.
fn encoded(linear: f64) -> f64 {
    if linear <= 0.003_130_8 { 12.92 * linear } else { 1.055 * linear.powf(1.0 / 2.4) - 0.055 }
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

/// What the vertex shaders take of each buffer: see `shaders/terrain.wgsl`.
const PLACE: &[wgpu::VertexAttribute] = &wgpu::vertex_attr_array![0 => Uint16x2];
const POINT: &[wgpu::VertexAttribute] = &wgpu::vertex_attr_array![1 => Sint32, 2 => Snorm16x2];
const INSTANCE: &[wgpu::VertexAttribute] =
    &wgpu::vertex_attr_array![3 => Sint32x2, 4 => Sint32x4, 5 => Sint32x3];
const RECORD: &[wgpu::VertexAttribute] =
    &wgpu::vertex_attr_array![6 => Float32x2, 7 => Snorm16x2, 8 => Snorm16x2, 9 => Sint32];

const CORNER: &[wgpu::VertexAttribute] =
    &wgpu::vertex_attr_array![0 => Sint32x2, 1 => Sint32, 2 => Snorm16x2];

/// The pipelines of diamonds that stand still, of those that move, and of irregular triangles: in the order of [`Kind`].
fn terrain_pipelines(
    device: &wgpu::Device,
    options: &Options,
    groups: &[wgpu::BindGroupLayout; 2],
    mode: Mode,
) -> Pipelines {
    let layout = |stride: usize, step_mode, attributes| {
        Some(wgpu::VertexBufferLayout { array_stride: stride as u64, step_mode, attributes })
    };
    let (vertex, instance) = (wgpu::VertexStepMode::Vertex, wgpu::VertexStepMode::Instance);
    let points = [
        layout(4, vertex, PLACE),
        layout(size_of::<SurfacePoint>(), vertex, POINT),
        layout(size_of::<Instance>(), instance, INSTANCE),
        layout(size_of::<Record>(), vertex, RECORD),
    ];
    let corners =
        [layout(size_of::<Corner>(), vertex, CORNER), layout(size_of::<Instance>(), instance, INSTANCE)];
    let fragment = if mode == Mode::Lines { "wire_fragment" } else { "terrain_fragment" };
    let groups = groups.each_ref().map(Some);
    // Both faces are drawn: terrain seen from below is terrain still.
    let made = |vertex, buffers: &[_]| {
        let compare = match mode {
            Mode::Lines => wgpu::CompareFunction::GreaterEqual,
            Mode::Filled | Mode::Behind => wgpu::CompareFunction::Greater,
        };
        let depth = Depth { compare, write: true, behind: mode == Mode::Behind };
        let topology = match mode {
            Mode::Lines => wgpu::PrimitiveTopology::LineList,
            Mode::Filled | Mode::Behind => wgpu::PrimitiveTopology::TriangleList,
        };
        pipeline(device, options, &groups, [vertex, fragment], TERRAIN_WGSL, buffers, depth, topology)
    };
    [
        made("terrain_vertex", &points[..3]),
        made("terrain_morph_vertex", &points),
        made("tin_vertex", &corners),
    ]
}

/// What a pipeline does with depth.
#[derive(Debug, Clone, Copy)]
struct Depth {
    compare: wgpu::CompareFunction,
    write: bool,
    /// Whether to move triangles away by a few steps of depth, and more where they are steep.
    behind: bool,
}

fn sky_pipeline(
    device: &wgpu::Device,
    options: &Options,
    groups: &[Option<&wgpu::BindGroupLayout>],
) -> wgpu::RenderPipeline {
    // Infinitely far, so equal to the cleared depth and behind all else.
    let entries = ["sky_vertex", "sky_fragment"];
    let depth = Depth { compare: wgpu::CompareFunction::GreaterEqual, write: false, behind: false };
    let topology = wgpu::PrimitiveTopology::TriangleList;
    pipeline(device, options, groups, entries, SKY_WGSL, &[], depth, topology)
}

/// A pipeline with these entry points of a vertex and a fragment shader.
#[allow(clippy::too_many_arguments, reason = "a pipeline is made of so many things, each of its own type")]
fn pipeline(
    device: &wgpu::Device,
    options: &Options,
    groups: &[Option<&wgpu::BindGroupLayout>],
    [vertex, fragment]: [&str; 2],
    source: &str,
    buffers: &[Option<wgpu::VertexBufferLayout<'_>>],
    depth: Depth,
    topology: wgpu::PrimitiveTopology,
) -> wgpu::RenderPipeline {
    let module = device.create_shader_module(wgpu::ShaderModuleDescriptor {
        label: Some(vertex),
        source: wgpu::ShaderSource::Wgsl(source.into()),
    });
    let layout = device.create_pipeline_layout(&wgpu::PipelineLayoutDescriptor {
        label: Some(vertex),
        bind_group_layouts: groups,
        immediate_size: 0,
    });
    device.create_render_pipeline(&wgpu::RenderPipelineDescriptor {
        label: Some(vertex),
        layout: Some(&layout),
        vertex: wgpu::VertexState {
            module: &module,
            entry_point: Some(vertex),
            compilation_options: wgpu::PipelineCompilationOptions::default(),
            buffers,
        },
        primitive: wgpu::PrimitiveState { topology, ..Default::default() },
        depth_stencil: Some(wgpu::DepthStencilState {
            format: DEPTH,
            depth_write_enabled: Some(depth.write),
            depth_compare: Some(depth.compare),
            stencil: wgpu::StencilState::default(),
            // Depth is reversed: less is farther away.
            bias: if depth.behind {
                wgpu::DepthBiasState { constant: -8, slope_scale: -1.0, clamp: 0.0 }
            } else {
                wgpu::DepthBiasState::default()
            },
        }),
        multisample: wgpu::MultisampleState { count: options.samples, ..Default::default() },
        fragment: Some(wgpu::FragmentState {
            module: &module,
            entry_point: Some(fragment),
            compilation_options: wgpu::PipelineCompilationOptions::default(),
            targets: &[Some(wgpu::ColorTargetState {
                format: options.format,
                blend: None,
                write_mask: wgpu::ColorWrites::ALL,
            })],
        }),
        multiview_mask: None,
        cache: None,
    })
}
