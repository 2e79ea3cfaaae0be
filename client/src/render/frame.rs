//! The uniforms of a frame: twins of the structs in `shaders/frame.wgsl`.
//!
//! **Exact where diamonds meet.** The GPU gets lattice coordinates and heights as integers, and the
//! offset of the eye from a *reference point* of the lattice near it. Integer differences are exact, and
//! what follows is the same for all diamonds of a layer: a shared point has the same bits in each.
//! Near the eye the differences are small, so `f32` holds them to a millionth of a cell.

use super::look::{Background, Colours, Look};
use super::ramp::{self, Quantity, Scale, linear};
use super::view::View;
use diamantina_protocol::message::{Kind, Layer};
use glam::DVec3;

/// Haze of a metre of air at height 0, for a haze of 1: 13 % at 10 km.
const HAZE_PER_METRE: f32 = 1.4e-5;

const HORIZON: u32 = 0xd3_e0_ec;
const ZENITH: u32 = 0x4f_80_bd;

/// The twin of `Frame`.
#[repr(C)]
#[derive(Debug, Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
pub(super) struct FrameUniform {
    clip_from_eye: [[f32; 4]; 4],
    right: [f32; 4],
    up: [f32; 4],
    forward: [f32; 4],
    sun: [f32; 4],
    horizon: [f32; 4],
    zenith: [f32; 4],
    options: [f32; 4],
    water: [f32; 4],
    drape: [f32; 4],
    land: [[f32; 4]; 8],
    sea: [[f32; 4]; 4],
    style: [f32; 4],
}

/// The twin of `Layer`.
#[repr(C)]
#[derive(Debug, Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
pub(super) struct LayerUniform {
    cell: [f32; 2],
    offset: [f32; 2],
    quantum: f32,
    up_offset: f32,
    height: i32,
    per_depth: f32,
    land_base: f32,
    per_height: f32,
    exaggeration: f32,
    is_water: f32,
}

/// Where the eye is in a layer: the lattice point that positions are relative to.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Reference {
    lattice: [i64; 2],
    height: i64,
}

impl Reference {
    /// The lattice point and height nearest to the eye, no further than the GPU's integers reach.
    pub(super) fn near(layer: &Layer, eye: DVec3, exaggeration: f64) -> Self {
        #[allow(clippy::cast_possible_truncation, reason = "clamped just before")]
        let nearest = |value: f64| value.round().clamp(-5e8, 5e8) as i64;
        Self {
            lattice: [0, 1].map(|i| nearest((eye[i] - layer.origin[i]) / layer.cell[i])),
            height: nearest((eye.z / exaggeration - layer.height_offset) / layer.quantum),
        }
    }

    /// A lattice point relative to the reference point.
    pub(super) fn relative(&self, [x, y]: [i64; 2]) -> [i32; 2] {
        // Both are below 2^29 in magnitude.
        [x - self.lattice[0], y - self.lattice[1]].map(|d| i32::try_from(d).unwrap_or(i32::MAX))
    }

    /// The layer's uniforms.
    pub(super) fn uniform(&self, layer: &Layer, eye: DVec3, look: &Look) -> LayerUniform {
        let offset = [0, 1].map(|i| layer.origin[i] + layer.cell[i] * self.lattice[i] as f64 - eye[i]);
        let height = self.height as f64 * layer.quantum + layer.height_offset;
        let scale = Scale::of(look, layer);
        LayerUniform {
            cell: layer.cell.map(single),
            offset: offset.map(single),
            quantum: single(layer.quantum * look.exaggeration),
            up_offset: single(height * look.exaggeration - eye.z),
            height: i32::try_from(self.height).unwrap_or(0),
            per_depth: single(scale.per_depth),
            land_base: single(scale.base),
            per_height: single(scale.per_value),
            exaggeration: single(look.exaggeration),
            is_water: f32::from(u8::from(layer.kind == Kind::Water)),
        }
    }
}

impl FrameUniform {
    /// The uniforms of a pass. `encode`: whether the target stores colours as they are, so that the
    /// shader must encode sRGB. `near`: the near plane, in metres.
    pub(super) fn new(view: &View, look: &Look, near: f32, encode: bool, anisotropy: u16) -> Self {
        let with = |v: DVec3, w: f32| v.as_vec3().extend(w).to_array();
        let [right, up, forward] = view.rays().map(|ray| with(ray, 0.0));
        let colour = |srgb: u32, w: f32| {
            let [r, g, b] = linear(srgb);
            [r, g, b, w]
        };
        let flag = |on: bool| f32::from(u8::from(on));
        let (zenith, even) = match look.background {
            Background::Sky => (colour(ZENITH, 0.0), false),
            Background::Colour(even) => (even, true),
        };
        let [r, g, b] = linear(ramp::WATER);
        Self {
            clip_from_eye: view.clip_from_eye(near).to_cols_array_2d(),
            right,
            up,
            forward,
            sun: with(look.sun.direction(), single(view.eye().z)),
            horizon: colour(HORIZON, look.haze * HAZE_PER_METRE),
            zenith,
            options: [flag(encode), flag(look.show_levels), flag(look.colours == Colours::Flat), flag(even)],
            water: [r, g, b, single(view.lowest())],
            drape: [
                look.imagery.light,
                look.imagery.opacity,
                f32::from(anisotropy),
                single(1.0 / view.pixels_per_radian()),
            ],
            land: ramp::land(look.colours).map(|(at, srgb)| colour(srgb, at)),
            sea: ramp::sea().map(|(at, srgb)| colour(srgb, at)),
            style: [
                f32::from(look.shading as u8),
                flag(ramp::quantity(look.colours) == Quantity::Slope),
                flag(ramp::shows_rock(look)),
                look.haze.min(1.0),
            ],
        }
    }
}

/// What the GPU takes of a number, once all that needs more digits is done.
#[allow(clippy::cast_possible_truncation, reason = "rounding to f32 is the purpose")]
pub(super) fn single(value: f64) -> f32 {
    value as f32
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::mem::offset_of;

    use super::super::pipelines::{SKY_WGSL, TERRAIN_WGSL, WATER_WGSL};
    use super::super::water::WaterUniform;

    const SHADERS: [(&str, &str, usize); 3] = [
        // Vertices at rest, in motion and of irregular triangles; terrain, mirrored terrain, and wires.
        ("terrain.wgsl", TERRAIN_WGSL, 6),
        ("water.wgsl", WATER_WGSL, 4),
        ("sky.wgsl", SKY_WGSL, 2),
    ];

    /// Whatever a browser's WebGL2 takes, the others take too.
    fn translate(module: &naga::Module, info: &naga::valid::ModuleInfo, entry: &naga::EntryPoint) -> String {
        use naga::back::glsl;
        let options = glsl::Options {
            version: glsl::Version::Embedded { version: 300, is_webgl: true },
            ..Default::default()
        };
        let pipeline = glsl::PipelineOptions {
            shader_stage: entry.stage,
            entry_point: entry.name.clone(),
            multiview: None,
        };
        let mut text = String::new();
        let policies = naga::proc::BoundsCheckPolicies::default();
        let mut writer = glsl::Writer::new(&mut text, module, info, &options, &pipeline, policies).unwrap();
        writer.write().unwrap();
        text
    }

    #[test]
    fn every_shader_is_valid_and_fit_for_webgl2() {
        for (name, source, entries) in SHADERS {
            let module = naga::front::wgsl::parse_str(source)
                .unwrap_or_else(|e| panic!("{}", e.emit_to_string_with_path(source, name)));
            // No capabilities: what any device has, browsers included.
            let (flags, capabilities) =
                (naga::valid::ValidationFlags::all(), naga::valid::Capabilities::empty());
            let info = naga::valid::Validator::new(flags, capabilities)
                .validate(&module)
                .unwrap_or_else(|e| panic!("{}", e.emit_to_string_with_path(source, name)));
            assert_eq!(module.entry_points.len(), entries, "{name}");
            let entries = module.entry_points.iter().map(|entry| (entry.stage, entry.name.as_str()));
            for (entry, in_some_pixels) in entries.flat_map(|entry| [(entry, 0.0), (entry, 1.0)]) {
                let constants = [("IN_SOME_PIXELS".to_owned(), in_some_pixels)];
                let constants = constants.into_iter().filter(|_| !module.overrides.is_empty()).collect();
                let (module, info) = naga::back::pipeline_constants::process_overrides(
                    &module,
                    &info,
                    Some(entry),
                    &constants,
                )
                .unwrap();
                let found = module.entry_points.iter().find(|found| found.name == entry.1).unwrap();
                let text = translate(&module, &info, found);
                assert!(text.contains("#version 300 es"));
                // Version 3.10 has these, WebGL2 has not.
                assert!(!["mix(uvec", "mix(ivec"].iter().any(|call| text.contains(call)), "{name}: {text}");
            }
        }
    }

    #[test]
    fn every_file_of_shaders_is_tested() {
        let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../shaders");
        for entry in std::fs::read_dir(folder).unwrap() {
            let name = entry.unwrap().file_name().into_string().unwrap();
            let is_part = ["frame.wgsl", "surface.wgsl", "drape.wgsl"].contains(&&*name);
            assert!(is_part || SHADERS.iter().any(|(n, ..)| *n == name), "{name}");
        }
    }

    /// Name, offset and, last, the size of the whole.
    fn layout(name: &str) -> Vec<(String, usize)> {
        let module = naga::front::wgsl::parse_str(WATER_WGSL).unwrap();
        let (_, found) = module.types.iter().find(|(_, t)| t.name.as_deref() == Some(name)).unwrap();
        let naga::TypeInner::Struct { members, span } = &found.inner else { panic!("{name} is no struct") };
        let mut layout: Vec<_> =
            members.iter().map(|m| (m.name.clone().unwrap(), m.offset as usize)).collect();
        layout.push(("size".into(), *span as usize));
        layout
    }

    macro_rules! twin {
        ($type:ty: $($field:ident)*) => {
            vec![$((stringify!($field).to_owned(), offset_of!($type, $field)),)* ("size".into(), size_of::<$type>())]
        };
    }

    #[test]
    fn uniforms_have_the_layout_of_their_twins() {
        let frame = twin!(FrameUniform: clip_from_eye right up forward sun horizon zenith options water drape land sea style);
        assert_eq!(layout("Frame"), frame);
        let layer = twin!(LayerUniform: cell offset quantum up_offset height per_depth land_base per_height exaggeration is_water);
        assert_eq!(layout("Layer"), layer);
        assert_eq!(layout("Water"), twin!(WaterUniform: absorption body optics waves));
        let sizes = [size_of::<FrameUniform>(), size_of::<LayerUniform>(), size_of::<WaterUniform>()];
        assert!(sizes.iter().all(|s| s.is_multiple_of(16)), "WebGL2 wants it");
    }
}
