//! Diamonds and a camera → a picture. The only module, with the fronts, that knows wgpu.
//!
//! | module | what it holds |
//! |---|---|
//! | `look` | light, colours, water: what a caller may choose |
//! | `ramp` | colours by value, for shaders and legends |
//! | `frame` | the uniforms, and how positions stay exact far from the origin |
//! | `view` | where a pass draws from: the eye, or its mirror image |
//! | `pipelines` | how vertices become pixels |
//! | `resident` | surfaces on the GPU, under a budget |
//! | `drape` | imagery on terrain |
//! | `water` | what is mirrored in water and seen through it |
//! | `lens` | what a pass is told of where it draws from |
//! | `overlay` | what egui draws over a picture: the panel, annotations |
//! | `offscreen` | pictures without a window |
//! | `room` | what all but diamonds and imagery takes of the GPU's memory |
//!
//! A diamond is one or two draws: its points at their own buffer, its place and axes as an instance, the
//! index lists shared by all; irregular triangles have vertices and index lists of their own. One in motion has a second
//! buffer, of the motions of its points, and a pipeline that reads it; irregular triangles that appear have one that leaves out
//! pixels. Nothing is used that WebGL2 lacks: no storage buffers, no base vertex, no
//! indirect draws. Depth is reversed and infinite, positions are relative to the eye.

mod drape;
mod frame;
mod lens;
mod look;
#[cfg(not(target_arch = "wasm32"))]
mod offscreen;
mod overlay;
mod pipelines;
mod ramp;
mod resident;
mod room;
mod view;
mod water;

#[cfg(test)]
mod tests;

pub use look::{Annotations, Background, Colours, Imagery, Look, Shading, Sun, Water};
#[cfg(not(target_arch = "wasm32"))]
pub use offscreen::Offscreen;
pub(crate) use overlay::Overlay;
pub use ramp::{Quantity, Scale, water_colour};

use crate::camera::{Bounds, Camera};
use crate::drawing::{DrawItem, Mirror, left_for_diamonds};
use crate::surface::Surface;
use crate::texture::Drape;
use diamantina_protocol::message::{self, Layer};
use drape::Drapes;
use frame::{FrameUniform, LayerUniform};
use lens::Lens;
use pipelines::{Kind, Mode, Pipelines, Target, sky_pipeline, terrain_pipelines};
use ramp::encoded;
use resident::{Residents, Triangles};
use std::collections::BTreeSet;
use std::ops::Range;
use view::View;
use water::WaterPasses;

const DEPTH: wgpu::TextureFormat = wgpu::TextureFormat::Depth32Float;

/// Bytes from one layer's uniforms to the next: the largest alignment that WebGPU and WebGL2 ask for.
const LAYER_STRIDE: usize = 256;

/// What a renderer is made for, once and for all.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Options {
    /// The format of the views drawn to. If it is not an sRGB format, the shader encodes sRGB.
    pub format: wgpu::TextureFormat,
    /// Samples a pixel: 1, or 4 to smooth edges.
    pub samples: u32,
    /// Bytes of GPU memory for all that frames take. Surfaces that were drawn a while ago are kept as long as there is room for them;
    /// all else is there whatever it takes: that it fits is the business of who says what to draw.
    pub budget_bytes: u64,
    /// Steps that imagery seen at a slant is sampled in, 1 to 16: more is sharper.
    pub anisotropy: u16,
}

impl Default for Options {
    /// Four samples, 512 MiB: about eight thousand diamonds of 64 segments.
    fn default() -> Self {
        Self {
            format: wgpu::TextureFormat::Rgba8UnormSrgb,
            samples: 4,
            budget_bytes: 512 << 20,
            anisotropy: 4,
        }
    }
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
    /// Bytes of GPU memory that surfaces and their motions take.
    pub gpu_bytes: u64,
    /// Bytes of GPU memory that all else takes: the picture, depth, samples, what is mirrored and seen through, tiles of imagery,
    /// the index lists that all diamonds share, and where each of them is.
    pub fixed_bytes: u64,
}

impl FrameStats {
    /// Bytes of GPU memory that are taken: what the budget is about.
    #[must_use]
    pub fn total_bytes(&self) -> u64 {
        self.gpu_bytes + self.fixed_bytes
    }
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
        // Imagery takes less where there are blocks.
        required_features: adapter.features() & wgpu::Features::TEXTURE_COMPRESSION_BC,
        required_limits: limits,
        ..Default::default()
    });
    let (device, queue) = request.await.map_err(|e| RenderError::Device(e.to_string()))?;
    Ok((adapter, device, queue))
}

/// What suits an adapter of what was asked for: one in software takes minutes for what others do in no time.
pub(crate) fn fit(options: &Options, adapter: &wgpu::Adapter) -> Options {
    let is_software = adapter.get_info().device_type == wgpu::DeviceType::Cpu;
    let can =
        adapter.get_downlevel_capabilities().flags.contains(wgpu::DownlevelFlags::ANISOTROPIC_FILTERING);
    Options { anisotropy: if can && !is_software { options.anisotropy } else { 1 }, ..*options }
}

/// What is drawn of items.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum What {
    Triangles,
    /// And the ring around those of water.
    Ringed,
    /// The lines around triangles.
    Lines,
}

/// A draw: an item of the frame that is in view.
struct Draw<'a> {
    item: &'a DrawItem,
    sides: u8,
    shares_triangles: bool,
    kind: Kind,
    /// Stretched, as is the distance of the eye from it.
    bounds: Bounds,
    distance: f64,
}

/// Draws frames to views that the caller owns.
pub struct Renderer {
    device: wgpu::Device,
    queue: wgpu::Queue,
    options: Options,
    residents: Residents,
    filled: Pipelines,
    /// Behind, and lines: made when they are first needed.
    wires: Option<[Pipelines; 2]>,
    /// Of the uniforms of a pass, and of a layer.
    groups: [wgpu::BindGroupLayout; 2],
    sky: wgpu::RenderPipeline,
    drapes: Drapes,
    mirrors: Vec<Mirror>,
    /// Bytes of imagery uploaded since the last frame.
    draped_bytes: u64,
    /// There but while a frame is drawn.
    lens: Option<Lens>,
    water: Option<WaterPasses>,
    attachments: Option<Attachments>,
    /// What the caller takes, a pixel and besides.
    target_bytes: u64,
    beside_bytes: u64,
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
        let groups = [
            layout("frame", false, size_of::<FrameUniform>()),
            layout("layer", true, size_of::<LayerUniform>()),
        ];
        let target = Target { format: options.format, samples: options.samples };
        let drapes = Drapes::new(&device, options.anisotropy);
        Self {
            residents: Residents::new(),
            options: *options,
            filled: terrain_pipelines(
                &device,
                target,
                &[&groups[0], &groups[1], drapes.layout()],
                Mode::Filled,
            ),
            drapes,
            mirrors: Vec::new(),
            draped_bytes: 0,
            wires: None,
            sky: sky_pipeline(&device, target, &groups[0]),
            lens: None,
            groups,
            water: None,
            attachments: None,
            target_bytes: 0,
            beside_bytes: 0,
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

    /// Draws a frame to `target`, which is of `camera.size` pixels and of the format of the options, and
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
        target: &wgpu::TextureView,
    ) -> FrameStats {
        let mirrors = if look.mirrors() { self.mirrors.as_slice() } else { &[] };
        let mirrored = mirrors.iter().flat_map(|mirror| &mirror.items);
        let waters: BTreeSet<usize> =
            items.iter().filter(|item| is_water(layers, item, look)).map(|item| item.layer).collect();
        let taken = self.frame_bytes(layers, camera.size, look, waters.len()) + self.drapes.pictures_bytes();
        let room = left_for_diamonds(self.options.budget_bytes, taken);
        let uploaded_bytes =
            self.residents.start_frame(&self.device, layers, items, mirrored, look.wireframe, room);
        let mut stats =
            FrameStats { uploaded_bytes, gpu_bytes: self.residents.bytes(), ..Default::default() };
        stats.uploaded_bytes += std::mem::take(&mut self.draped_bytes);
        if look.wireframe && self.wires.is_none() {
            let made = |mode| terrain_pipelines(&self.device, self.target(), &self.terrain_groups(), mode);
            self.wires = Some([made(Mode::Behind), made(Mode::Lines)]);
        }
        let attachments = match self.attachments.take() {
            Some(old) if old.size == camera.size => old,
            _ => Attachments::new(&self.device, &self.options, camera.size),
        };
        let view = View::straight(camera);
        let mut draws = self.in_view(layers, &view, items, look, |item| !is_water(layers, item, look));
        let land_count = draws.len();
        draws.extend(self.in_view(layers, &view, items, look, |item| is_water(layers, item, look)));
        let (land, surfaces) = draws.split_at(land_count);
        let mut lens = self.lens.take().unwrap_or_else(|| Lens::new(&self.device, &self.groups));
        lens.write(self, layers, &view, look, &draws, !self.options.format.is_srgb());
        let mut encoder = self.device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
        // Pictures that are drawn no more take no room.
        let mut water = self.water.take().filter(|_| look.mirrors());
        if !surfaces.is_empty() {
            water.get_or_insert_with(|| WaterPasses::new(self, camera.size)).prepare(
                self,
                &mut encoder,
                layers,
                camera,
                items,
                look,
                surfaces,
                &mut stats,
            );
        }
        {
            let mut pass = begin_pass(&mut encoder, &attachments, target, look, self.options.format);
            pass.set_bind_group(2, self.drapes.group(), &[]);
            match self.wires.as_ref().filter(|_| look.wireframe) {
                None => {
                    self.draw_surfaces(&mut pass, &lens, land, 0, &self.filled, What::Triangles, &mut stats)
                }
                Some([behind, lines]) => {
                    self.draw_surfaces(&mut pass, &lens, land, 0, behind, What::Triangles, &mut stats);
                    let mut uncounted = FrameStats::default();
                    self.draw_surfaces(&mut pass, &lens, land, 0, lines, What::Lines, &mut uncounted);
                }
            }
            if let Some(water) = &water {
                let first = u32::try_from(land_count).unwrap_or(0);
                water.draw(self, &mut pass, &lens, surfaces, first, &mut stats);
            }
            lens.draw_sky(&mut pass, &self.sky, look);
        }
        stats.fixed_bytes = self.drapes.bytes()
            + self.residents.shared_bytes()
            + attachments.bytes(&self.options)
            + water.as_ref().map_or(0, |water| water.bytes() + water.lens_bytes())
            + lens.bytes()
            + room::pixels(camera.size) * self.target_bytes
            + self.beside_bytes;
        (self.lens, self.water, self.attachments) = (Some(lens), water, Some(attachments));
        self.queue.submit([encoder.finish()]);
        stats
    }

    /// Whether tiles of imagery may come as blocks: where they do all the same, they are coded anew.
    #[must_use]
    pub fn reads_blocks(&self) -> bool {
        drape::reads_blocks(&self.device)
    }

    /// Says what layers of water mirror in the next frames. Those that nothing is said of mirror what is drawn.
    pub fn mirror(&mut self, mirrors: &[Mirror]) {
        self.mirrors = mirrors.to_vec();
    }

    /// Lays imagery on the terrain in the frames from now on, or none: uploads tiles not seen before.
    pub fn drape(&mut self, drape: Option<&Drape>) {
        self.draped_bytes += self.drapes.show(&self.device, &self.queue, drape);
    }

    /// The groups that terrain's pipelines take.
    fn terrain_groups(&self) -> [&wgpu::BindGroupLayout; 3] {
        [&self.groups[0], &self.groups[1], self.drapes.layout()]
    }

    fn target(&self) -> Target {
        Target { format: self.options.format, samples: self.options.samples }
    }

    /// Those items that a view may see, in an order that switches index buffers seldom and draws what
    /// is near first, so that it hides what is behind at the least cost.
    fn in_view<'a>(
        &self,
        layers: &[Layer],
        view: &View,
        items: &'a [DrawItem],
        look: &Look,
        is_wanted: impl Fn(&DrawItem) -> bool,
    ) -> Vec<Draw<'a>> {
        let planes = view.planes();
        let mut draws: Vec<_> = items
            .iter()
            .filter(|item| is_wanted(item))
            .filter_map(|item| {
                let resident = self.residents.get(item)?;
                let layer = layers.get(item.layer)?;
                let bounds = resident.bounds(layer.quantum).map(|b| b.stretched(look.exaggeration));
                let bounds = bounds.filter(|b| b.touches(&planes))?;
                let upper = layer.forest.local(item.diamond).upper;
                let sides = item.sides & if upper { 0b1111 } else { 0b0011 };
                let distance = bounds.distance(view.eye());
                let shares_triangles = resident.own.is_none();
                let kind = match &*item.surface {
                    // What is mirrored stands still while it moves in the picture.
                    Surface::Points(_) if item.moving.is_some() && resident.motion.is_some() => {
                        Kind::MovingPoints
                    }
                    Surface::Points(_) => Kind::Points,
                    Surface::Tin(_) if !item.share.is_all() => Kind::FadingCorners,
                    Surface::Tin(_) => Kind::Corners,
                };
                Some(Draw { item, sides, shares_triangles, kind, bounds, distance })
            })
            .collect();
        draws.sort_by(|a, b| {
            let key = |d: &Draw<'_>| (d.item.layer, d.kind, !d.shares_triangles);
            let nearest = key(a).cmp(&key(b)).then(a.distance.total_cmp(&b.distance));
            nearest.then(a.item.diamond.cmp(&b.item.diamond))
        });
        draws
    }

    /// Draws the triangles of the items, with the ring around them or without, or the lines around each of them.
    ///
    /// The draws are those that `lens` was told of, from the one with this number on.
    #[allow(clippy::too_many_arguments, reason = "a pass is told by so many things, each of its own type")]
    fn draw_surfaces(
        &self,
        pass: &mut wgpu::RenderPass<'_>,
        lens: &Lens,
        draws: &[Draw<'_>],
        first_instance: u32,
        pipelines: &Pipelines,
        what: What,
        stats: &mut FrameStats,
    ) {
        let (Some((_, layer_group)), Some(instances)) = (&lens.layers, &lens.instances) else { return };
        pass.set_bind_group(0, &lens.frame_group, &[]);
        let (mut layer_now, mut places_now, mut triangles_now) = (None, None, None::<&Triangles>);
        let mut kind_now = None;
        for (draw, instance) in draws.iter().zip(first_instance..) {
            let grid = self.residents.grid(draw.item);
            let Some(resident) = self.residents.get(draw.item) else { continue };
            let triangles = resident.own.as_ref().or(grid.map(|grid| &grid.triangles));
            let Some(triangles) = triangles else { continue };
            let [instance_slot, vertex_slot] = draw.kind.buffers();
            if kind_now != Some(draw.kind) {
                kind_now = Some(draw.kind);
                pass.set_pipeline(&pipelines[draw.kind as usize]);
                pass.set_vertex_buffer(instance_slot, instances.slice(..));
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
                let indices = if what == What::Lines { triangles.lines.as_ref() } else { None };
                pass.set_index_buffer(
                    indices.unwrap_or(&triangles.indices).slice(..),
                    wgpu::IndexFormat::Uint16,
                );
            }
            pass.set_vertex_buffer(vertex_slot, resident.points.slice(..));
            if let Some(motion) = &resident.motion {
                pass.set_vertex_buffer(3, motion.records.slice(..));
            }
            let ring = runs(&triangles.ring, if what == What::Ringed { draw.sides } else { 0 });
            for range in runs(&triangles.sides, draw.sides).chain(ring) {
                stats.draws += 1;
                stats.triangles += u64::from((range.end - range.start) / 3);
                // Each index of a triangle begins a line of two.
                let range = if what == What::Lines { 2 * range.start..2 * range.end } else { range };
                pass.draw_indexed(range, 0, instance..instance + 1);
            }
        }
    }
}

/// Whether an item is drawn as water, by passes of its own.
fn is_water(layers: &[Layer], item: &DrawItem, look: &Look) -> bool {
    let is_water = layers.get(item.layer).is_some_and(|layer| layer.kind == message::Kind::Water);
    is_water && look.mirrors()
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

    /// Bytes of GPU memory that they take.
    fn bytes(&self, options: &Options) -> u64 {
        room::pixels(self.size) * room::samples_bytes(options.samples)
    }
}

fn begin_pass<'a>(
    encoder: &'a mut wgpu::CommandEncoder,
    attachments: &Attachments,
    view: &wgpu::TextureView,
    look: &Look,
    format: wgpu::TextureFormat,
) -> wgpu::RenderPass<'a> {
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
            ops: wgpu::Operations { load: wgpu::LoadOp::Clear(clear_colour(look, format)), store },
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

/// What is seen where nothing is drawn, as a target of this format takes it.
fn clear_colour(look: &Look, format: wgpu::TextureFormat) -> wgpu::Color {
    let clear = match look.background {
        Background::Sky => [0.0, 0.0, 0.0, 1.0],
        Background::Colour(colour) => colour.map(f64::from),
    };
    let [r, g, b] = [0, 1, 2].map(|i| if format.is_srgb() { clear[i] } else { encoded(clear[i]) });
    wgpu::Color { r, g, b, a: clear[3] }
}
