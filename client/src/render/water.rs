//! Water, in passes before the picture's own: what is mirrored, and what is seen through it.
//!
//! After the projective texture mapping of the water of BDAM terrain: (a) the scene without water, mirrored in the
//! surface's mean plane and clipped there, and the same scene from the eye itself, each into a texture; (b), (c) both are
//! projected onto the surface by the place on the screen; (d) each pixel mixes them by its Fresnel reflectance, here with
//! Schlick's R(t) = R0 + (1 - R0) (1 - cos t)^5 and R0 = ((n - 1) / (n + 1))^2. See `shaders/water.wgsl`.
//!
//! Each layer of water has one plane, at the mean height of what is in view of it, near parts counting most. Its own
//! slopes and the waves bend the rays at each pixel. The mirrored picture is drawn from a cut of its own, where there is
//! one (see [`Renderer::mirror`]), else from the diamonds of the picture.

use super::frame::single;
use super::lens::Lens;
use super::pipelines::{Mode, Pipelines, Target, sky_pipeline, terrain_pipelines};
use super::room::{pixels, samples_bytes};
use super::view::View;
use super::{DEPTH, Draw, FrameStats, Look, Renderer, What, clear_colour, is_water};
use crate::camera::Camera;
use crate::drawing::DrawItem;
use crate::mirror::mean_height;
use diamantina_protocol::message::{Kind, Layer};
use glam::{DVec2, DVec3};
use std::collections::BTreeMap;

/// What textures between passes hold: colours, linear when read.
const FORMAT: wgpu::TextureFormat = wgpu::TextureFormat::Rgba8UnormSrgb;

/// Waves that are added up; the twin of a number in `shaders/water.wgsl`.
const WAVES: usize = 24;

/// Metres a second each second.
const GRAVITY: f64 = 9.81;

/// What a metre takes of red, green and blue, in parts of what it takes of green: clear lakes are blue-green.
const ABSORPTION: [f64; 3] = [4.0, 1.0, 0.75];

/// What deep water sends back of red, green and blue.
const BODY: [f32; 3] = [0.008, 0.045, 0.065];

/// The twin of `Water` in `shaders/water.wgsl`.
#[repr(C)]
#[derive(Debug, Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
pub(super) struct WaterUniform {
    pub(super) absorption: [f32; 4],
    pub(super) body: [f32; 4],
    pub(super) optics: [f32; 4],
    pub(super) waves: [[f32; 4]; WAVES],
}

impl WaterUniform {
    /// Of a layer of water among `layers`. `near`: the near plane of the picture of what is seen through, in metres.
    fn new(layers: &[Layer], layer: &Layer, look: &Look, eye: DVec3, near: f32) -> Self {
        let water = &look.water;
        let extent = [0, 1].map(|i| layer.cell[i] * f64::from(layer.samples[i]));
        let extent = extent[0].hypot(extent[1]);
        // Deep enough for a lake's bed to be seen at its shore, down to a tank's in a laboratory.
        let clarity = water.clarity.unwrap_or_else(|| (extent / 2000.0).clamp(0.05, 12.0));
        let [r, g, b] = ABSORPTION.map(|part| single(part / clarity / look.exaggeration));
        let index = water.refractive_index;
        let straight_down = ((index - 1.0) / (index + 1.0)).powi(2);
        let longest = (extent / 100.0).clamp(0.02, 60.0);
        // As far as an outline of the coarsest samples jumps.
        let cells = layers.iter().filter(|layer| layer.kind == Kind::Terrain).flat_map(|layer| layer.cell);
        let coast = cells.fold(0.0, f64::max);
        Self {
            absorption: [r, g, b, single(clarity * look.exaggeration / 50.0)],
            body: [BODY[0], BODY[1], BODY[2], single(coast)],
            optics: [
                single(straight_down),
                single(1.0 / index),
                near,
                if water.waves > 0.0 { 1.0 } else { 0.0 },
            ],
            waves: waves(longest, water.waves, water.seconds, eye.truncate()),
        }
    }
}

/// Waves from the longest in metres on down, about a wind from the north-west. Phases are told at the eye, so that they are
/// exact however far it is from the origin. Of those that a pixel shows, wherever the water is seen from, several are nearly as long
/// as the longest: two or three of them would be a pattern, as of woven cloth.
fn waves(longest: f64, strength: f64, seconds: f64, eye: DVec2) -> [[f32; 4]; WAVES] {
    std::array::from_fn(|i| {
        let part = i as f64;
        let turn = std::f64::consts::TAU / (longest * 0.86f64.powf(part));
        // Spread as evenly as may be without repeating: by the golden ratio.
        let spread = ((part + 1.0) * 0.618_034).fract() * 2.0 - 1.0;
        let direction = DVec2::from_angle(-0.8 + 1.3 * spread);
        // Deep water: the square of the speed grows with the length. At the origin no two are in step, nor in a row.
        let phase = turn * direction.dot(eye) - (GRAVITY * turn).sqrt() * seconds + 1.7 * part * part;
        let vector = direction * turn;
        let height = 0.0077 * strength / turn;
        [single(vector.x), single(vector.y), single(phase.rem_euclid(std::f64::consts::TAU)), single(height)]
    })
}

/// A picture between two passes.
struct Sheet {
    size: [u32; 2],
    samples: u32,
    colour: wgpu::TextureView,
    /// What is drawn to where there are several samples a pixel: `colour` is their mean.
    sampled: Option<wgpu::TextureView>,
    depth: wgpu::TextureView,
}

impl Sheet {
    fn new(device: &wgpu::Device, label: &str, size: [u32; 2], samples: u32) -> Self {
        let view = |format, samples| {
            let [width, height] = size;
            let read = if samples == 1 {
                wgpu::TextureUsages::TEXTURE_BINDING
            } else {
                wgpu::TextureUsages::empty()
            };
            let texture = device.create_texture(&wgpu::TextureDescriptor {
                label: Some(label),
                size: wgpu::Extent3d { width, height, depth_or_array_layers: 1 },
                mip_level_count: 1,
                sample_count: samples,
                dimension: wgpu::TextureDimension::D2,
                format,
                usage: wgpu::TextureUsages::RENDER_ATTACHMENT | read,
                view_formats: &[],
            });
            texture.create_view(&wgpu::TextureViewDescriptor::default())
        };
        Self {
            size,
            samples,
            colour: view(FORMAT, 1),
            sampled: (samples > 1).then(|| view(FORMAT, samples)),
            depth: view(DEPTH, samples),
        }
    }

    fn bytes(&self) -> u64 {
        sheet_bytes(self.size, self.samples)
    }
}

/// Bytes of GPU memory: four a pixel of colour, and its samples.
fn sheet_bytes(size: [u32; 2], samples: u32) -> u64 {
    pixels(size) * (4 + samples_bytes(samples))
}

/// The size of what is mirrored in pictures of a size.
fn mirrored_size(size: [u32; 2], look: &Look) -> [u32; 2] {
    let scale = look.water.mirror_scale.clamp(1e-3, 1.0);
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "at most as large as it was")]
    size.map(|pixels| ((f64::from(pixels) * scale).round() as u32).max(1))
}

/// What a layer of water mirrors.
struct Mirror {
    sheet: Sheet,
    lens: Lens,
    uniform: wgpu::Buffer,
    group: wgpu::BindGroup,
}

impl Mirror {
    /// `scene`: what is seen through.
    fn new(
        renderer: &Renderer,
        layout: &wgpu::BindGroupLayout,
        [smooth, exact]: [&wgpu::Sampler; 2],
        sheet: Sheet,
        scene: &Sheet,
    ) -> Self {
        let device = &renderer.device;
        let uniform = device.create_buffer(&wgpu::BufferDescriptor {
            label: Some("water"),
            size: size_of::<WaterUniform>() as u64,
            usage: wgpu::BufferUsages::UNIFORM | wgpu::BufferUsages::COPY_DST,
            mapped_at_creation: false,
        });
        let view = |binding, view| wgpu::BindGroupEntry {
            binding,
            resource: wgpu::BindingResource::TextureView(view),
        };
        let sampler = |binding, sampler| wgpu::BindGroupEntry {
            binding,
            resource: wgpu::BindingResource::Sampler(sampler),
        };
        let group = device.create_bind_group(&wgpu::BindGroupDescriptor {
            label: Some("water"),
            layout,
            entries: &[
                wgpu::BindGroupEntry { binding: 0, resource: uniform.as_entire_binding() },
                sampler(1, smooth),
                view(2, &sheet.colour),
                view(3, &scene.colour),
                view(4, &scene.depth),
                sampler(5, exact),
            ],
        });
        Self { lens: Lens::new(device, &renderer.groups), sheet, uniform, group }
    }
}

/// What draws land, and the sky behind it.
type Scenery = (Pipelines, wgpu::RenderPipeline);

fn scenery(renderer: &Renderer, mode: Mode, samples: u32) -> Scenery {
    let (device, target) = (&renderer.device, Target { format: FORMAT, samples });
    let terrain = terrain_pipelines(device, target, &renderer.terrain_groups(), mode);
    (terrain, sky_pipeline(device, target, &renderer.groups[0]))
}

/// Samples a pixel of what is mirrored. Outlines in still water are seen as those of the picture are; waves make them soft by
/// themselves, and four samples take a software renderer a quarter to a half longer.
fn mirror_samples(samples: u32, look: &Look) -> u32 {
    if look.water.waves > 0.0 { 1 } else { samples }
}

/// All that water takes, made when it is first seen.
pub(super) struct WaterPasses {
    layout: wgpu::BindGroupLayout,
    smooth_sampler: wgpu::Sampler,
    exact_sampler: wgpu::Sampler,
    /// To the picture.
    surfaces: Pipelines,
    /// To the textures: what is mirrored, by samples a pixel, and what is seen through.
    mirrored: BTreeMap<u32, Scenery>,
    through: Scenery,
    scene: Sheet,
    scene_lens: Lens,
    /// By layer.
    mirrors: BTreeMap<usize, Mirror>,
}

impl WaterPasses {
    pub(super) fn new(renderer: &Renderer, size: [u32; 2]) -> Self {
        let device = &renderer.device;
        let texture = |binding, filterable| wgpu::BindGroupLayoutEntry {
            binding,
            visibility: wgpu::ShaderStages::FRAGMENT,
            ty: wgpu::BindingType::Texture {
                sample_type: wgpu::TextureSampleType::Float { filterable },
                view_dimension: wgpu::TextureViewDimension::D2,
                multisampled: false,
            },
            count: None,
        };
        let sampler = |binding, kind| wgpu::BindGroupLayoutEntry {
            binding,
            visibility: wgpu::ShaderStages::FRAGMENT,
            ty: wgpu::BindingType::Sampler(kind),
            count: None,
        };
        let layout = device.create_bind_group_layout(&wgpu::BindGroupLayoutDescriptor {
            label: Some("water"),
            entries: &[
                wgpu::BindGroupLayoutEntry {
                    binding: 0,
                    visibility: wgpu::ShaderStages::FRAGMENT,
                    ty: wgpu::BindingType::Buffer {
                        ty: wgpu::BufferBindingType::Uniform,
                        has_dynamic_offset: false,
                        min_binding_size: wgpu::BufferSize::new(size_of::<WaterUniform>() as u64),
                    },
                    count: None,
                },
                sampler(1, wgpu::SamplerBindingType::Filtering),
                texture(2, true),
                texture(3, true),
                texture(4, false),
                sampler(5, wgpu::SamplerBindingType::NonFiltering),
            ],
        });
        let sampler = |filter| {
            device.create_sampler(&wgpu::SamplerDescriptor {
                label: Some("water"),
                mag_filter: filter,
                min_filter: filter,
                // Waves read a little beyond the edges.
                address_mode_u: wgpu::AddressMode::MirrorRepeat,
                address_mode_v: wgpu::AddressMode::MirrorRepeat,
                ..Default::default()
            })
        };
        let [frame, layer] = &renderer.groups;
        Self {
            surfaces: terrain_pipelines(device, renderer.target(), &[frame, layer, &layout], Mode::Water),
            mirrored: BTreeMap::new(),
            // Its depth is read, which WebGL2 cannot of several samples.
            through: scenery(renderer, Mode::Filled, 1),
            scene: Sheet::new(device, "seen through water", size, 1),
            scene_lens: Lens::new(device, &renderer.groups),
            mirrors: BTreeMap::new(),
            layout,
            smooth_sampler: sampler(wgpu::FilterMode::Linear),
            exact_sampler: sampler(wgpu::FilterMode::Nearest),
        }
    }

    /// Bytes of GPU memory that its pictures take.
    pub(super) fn bytes(&self) -> u64 {
        let sheets = self.mirrors.values().map(|mirror| &mirror.sheet).chain([&self.scene]);
        sheets.map(Sheet::bytes).sum()
    }

    /// Bytes of GPU memory that its pictures take in pictures of a size and of so many samples a pixel, with so many layers of water.
    pub(super) fn bytes_of(size: [u32; 2], look: &Look, samples: u32, waters: usize) -> u64 {
        if waters == 0 {
            return 0;
        }
        let mirror = sheet_bytes(mirrored_size(size, look), mirror_samples(samples, look));
        sheet_bytes(size, 1) + waters as u64 * mirror
    }

    /// Bytes of GPU memory that what is told of its passes takes.
    pub(super) fn lens_bytes(&self) -> u64 {
        let of_mirror = |mirror: &Mirror| mirror.uniform.size() + mirror.lens.bytes();
        self.scene_lens.bytes() + self.mirrors.values().map(of_mirror).sum::<u64>()
    }

    /// Draws what the layers of water in view mirror, and what is seen through them. `water` is sorted by layer.
    #[allow(clippy::too_many_arguments, reason = "a frame is told by so many things, each of its own type")]
    pub(super) fn prepare(
        &mut self,
        renderer: &Renderer,
        encoder: &mut wgpu::CommandEncoder,
        layers: &[Layer],
        camera: &Camera,
        items: &[DrawItem],
        look: &Look,
        water: &[Draw<'_>],
        stats: &mut FrameStats,
    ) {
        let device = &renderer.device;
        if self.scene.size != camera.size {
            self.scene = Sheet::new(device, "seen through water", camera.size, 1);
            self.mirrors.clear();
        }
        let is_land = |item: &DrawItem| !is_water(layers, item, look);
        // Haze lies before the surface, not before the bed: the surface's own pixels add it.
        let clear = Look { haze: 0.0, ..*look };
        let view = View::straight(camera);
        let land = renderer.in_view(layers, &view, items, look, is_land);
        let near = self.scene_lens.write(renderer, layers, &view, &clear, &land, false);
        draw_sheet(renderer, encoder, &self.scene, &self.scene_lens, look, &land, &self.through, stats);

        let size = mirrored_size(camera.size, look);
        let mut of_layer: BTreeMap<usize, Vec<&Draw<'_>>> = BTreeMap::new();
        for draw in water {
            of_layer.entry(draw.item.layer).or_default().push(draw);
        }
        // The step of a series that is drawn now takes over from that which was.
        for number in
            of_layer.keys().filter(|number| !self.mirrors.contains_key(number)).copied().collect::<Vec<_>>()
        {
            let idle = self.mirrors.keys().find(|other| !of_layer.contains_key(other)).copied();
            if let Some(mirror) = idle.and_then(|other| self.mirrors.remove(&other)) {
                self.mirrors.insert(number, mirror);
            }
        }
        // Their pictures would be more than those of the layers that are shown.
        self.mirrors.retain(|number, _| of_layer.contains_key(number));
        let samples = mirror_samples(renderer.options.samples, look);
        let mirrored =
            self.mirrored.entry(samples).or_insert_with(|| scenery(renderer, Mode::Mirrored, samples));
        for (number, draws) in of_layer {
            let layer = &layers[number];
            let fits = |mirror: &Mirror| mirror.sheet.size == size && mirror.sheet.samples == samples;
            if !self.mirrors.get(&number).is_some_and(fits) {
                let sheet = Sheet::new(device, "mirrored", size, samples);
                let samplers = [&self.smooth_sampler, &self.exact_sampler];
                let mirror = Mirror::new(renderer, &self.layout, samplers, sheet, &self.scene);
                self.mirrors.insert(number, mirror);
            }
            let Some(mirror) = self.mirrors.get_mut(&number) else { continue };
            let uniform = WaterUniform::new(layers, layer, look, camera.eye, near);
            renderer.queue.write_buffer(&mirror.uniform, 0, bytemuck::bytes_of(&uniform));
            let told = renderer.mirrors.iter().find(|mirror| mirror.layer == number);
            let drawn = draws.iter().map(|draw| (draw.item.diamond, draw.bounds));
            let height = told.map(|told| told.height).or_else(|| mean_height(drawn, camera.eye));
            let Some(height) = height else { continue };
            if camera.eye.z <= height {
                // Nothing is mirrored on the way up.
                continue;
            }
            let view = View::mirrored(camera, height);
            let items = told.map_or(items, |told| &told.items);
            let land = renderer.in_view(layers, &view, items, look, is_land);
            mirror.lens.write(renderer, layers, &view, look, &land, false);
            draw_sheet(renderer, encoder, &mirror.sheet, &mirror.lens, look, &land, mirrored, stats);
        }
    }

    /// Draws the surfaces themselves, in the picture's pass.
    pub(super) fn draw(
        &self,
        renderer: &Renderer,
        pass: &mut wgpu::RenderPass<'_>,
        lens: &Lens,
        water: &[Draw<'_>],
        first_instance: u32,
        stats: &mut FrameStats,
    ) {
        let mut first = first_instance;
        for draws in water.chunk_by(|a, b| a.item.layer == b.item.layer) {
            if let Some(mirror) = draws.first().and_then(|draw| self.mirrors.get(&draw.item.layer)) {
                pass.set_bind_group(2, &mirror.group, &[]);
                renderer.draw_surfaces(pass, lens, draws, first, &self.surfaces, What::Ringed, stats);
            }
            first += u32::try_from(draws.len()).unwrap_or(0);
        }
    }
}

/// One pass to a texture, with the sky behind.
#[allow(clippy::too_many_arguments, reason = "a pass is told by so many things, each of its own type")]
fn draw_sheet(
    renderer: &Renderer,
    encoder: &mut wgpu::CommandEncoder,
    sheet: &Sheet,
    lens: &Lens,
    look: &Look,
    land: &[Draw<'_>],
    (pipelines, sky): &Scenery,
    stats: &mut FrameStats,
) {
    let mut pass = encoder.begin_render_pass(&wgpu::RenderPassDescriptor {
        label: Some("water"),
        color_attachments: &[Some(wgpu::RenderPassColorAttachment {
            view: sheet.sampled.as_ref().unwrap_or(&sheet.colour),
            depth_slice: None,
            resolve_target: sheet.sampled.is_some().then_some(&sheet.colour),
            ops: wgpu::Operations {
                load: wgpu::LoadOp::Clear(clear_colour(look, FORMAT)),
                store: wgpu::StoreOp::Store,
            },
        })],
        depth_stencil_attachment: Some(wgpu::RenderPassDepthStencilAttachment {
            view: &sheet.depth,
            depth_ops: Some(wgpu::Operations { load: wgpu::LoadOp::Clear(0.0), store: wgpu::StoreOp::Store }),
            stencil_ops: None,
        }),
        ..Default::default()
    });
    pass.set_bind_group(2, renderer.drapes.group(), &[]);
    renderer.draw_surfaces(&mut pass, lens, land, 0, pipelines, What::Triangles, stats);
    lens.draw_sky(&mut pass, sky, look);
}
