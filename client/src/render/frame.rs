//! The uniforms of a frame: twins of the structs in `shaders/frame.wgsl`.
//!
//! **Exact where diamonds meet.** The GPU gets lattice coordinates and heights as integers, and the
//! offset of the eye from a *reference point* of the lattice near it. Integer differences are exact, and
//! what follows is the same for all diamonds of a layer: a shared point has the same bits in each.
//! Near the eye the differences are small, so `f32` holds them to a millionth of a cell.

use super::look::{Background, Colours, Look};
use super::view::View;
use diamantina_protocol::message::{Kind, Layer};
use glam::DVec3;

/// Haze of a metre of air at height 0, for a haze of 1: 13 % at 10 km.
const HAZE_PER_METRE: f32 = 1.4e-5;

/// A colour of a ramp: where it stands, and sRGB as 0xRRGGBB.
type Stop = (f32, u32);

/// Land, lowest to highest: forest green, meadow, straw, ochre, brown, grey, white.
const LAND: [Stop; 8] = [
    (0.0, 0x3d_6e_4a),
    (0.12, 0x62_8d_56),
    (0.28, 0x9f_ad_6e),
    (0.44, 0xcd_bd_88),
    (0.60, 0xb8_9c_78),
    (0.74, 0xa6_98_8d),
    (0.87, 0xc8_c6_c5),
    (1.0, 0xfa_fb_fd),
];

/// Bare rock and dust, lowest to highest.
const ROCK: [Stop; 8] = [
    (0.0, 0x4a_45_42),
    (0.14, 0x5f_59_54),
    (0.28, 0x77_6f_69),
    (0.42, 0x8e_86_7f),
    (0.56, 0xa5_9d_95),
    (0.70, 0xbb_b3_aa),
    (0.85, 0xd2_cb_c2),
    (1.0, 0xec_e7_e0),
];

/// The sea, shallow to deep.
const SEA: [Stop; 4] = [(0.0, 0xa9_d6_dd), (0.12, 0x62_ad_cc), (0.45, 0x2a_6c_a0), (1.0, 0x12_2f_5c)];

/// The share of a layer's range of heights below 0 m that makes it a sea and not lowland or noise.
const SEA_SHARE_MIN: f64 = 0.1;

/// Summits up to here are hills, with no snow on them; from there on they are mountains, and white. Metres.
const HILLS_TO_MOUNTAINS: [f64; 2] = [600.0, 3000.0];

/// How far up the ramp of land the summits of hills reach.
const HILLS: f64 = 0.62;

const HORIZON: u32 = 0xd3_e0_ec;
const ZENITH: u32 = 0x4f_80_bd;

/// Water that mirrors nothing.
const WATER: u32 = 0x4a_86_ab;

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
        let [lowest, highest] = layer.heights;
        let ratio = |part: f64, range: f64| if range > 0.0 { single(part / range) } else { 0.0 };
        let sea = has_sea(look.colours, layer.heights);
        let land_base = if sea { lowest.max(0.0).min(highest) } else { lowest };
        LayerUniform {
            cell: layer.cell.map(single),
            offset: offset.map(single),
            quantum: single(layer.quantum * look.exaggeration),
            up_offset: single(height * look.exaggeration - eye.z),
            height: i32::try_from(self.height).unwrap_or(0),
            per_depth: if sea { ratio(1.0, -lowest) } else { 0.0 },
            land_base: single(land_base),
            per_height: ratio(top(look.colours, highest), highest - land_base),
            exaggeration: single(look.exaggeration),
            is_water: f32::from(u8::from(layer.kind == Kind::Water)),
        }
    }
}

/// Whether heights below 0 m are depths.
fn has_sea(colours: Colours, [lowest, highest]: [f64; 2]) -> bool {
    match colours {
        Colours::Bathymetry => lowest < 0.0,
        Colours::Auto => lowest < 0.0 && -lowest >= SEA_SHARE_MIN * (highest - lowest),
        Colours::Terrain | Colours::Grey | Colours::Flat => false,
    }
}

/// How far up the ramp the highest point stands: a low island has no snow.
fn top(colours: Colours, highest: f64) -> f64 {
    let [low, high] = HILLS_TO_MOUNTAINS;
    match colours {
        Colours::Grey => 1.0,
        _ => HILLS + (1.0 - HILLS) * ((highest - low) / (high - low)).clamp(0.0, 1.0),
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
        let [r, g, b] = linear(WATER);
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
            drape: [look.imagery.light, look.imagery.opacity, f32::from(anisotropy), 0.0],
            land: if look.colours == Colours::Grey { ROCK } else { LAND }.map(|(at, srgb)| colour(srgb, at)),
            sea: SEA.map(|(at, srgb)| colour(srgb, at)),
        }
    }
}

/// What the GPU takes of a number, once all that needs more digits is done.
#[allow(clippy::cast_possible_truncation, reason = "rounding to f32 is the purpose")]
pub(super) fn single(value: f64) -> f32 {
    value as f32
}

/// Linear red, green and blue of 0xRRGGBB.
fn linear(srgb: u32) -> [f32; 3] {
    let [_, r, g, b] = srgb.to_be_bytes();
    [r, g, b].map(|byte| {
        let c = f32::from(byte) / 255.0;
        if c <= 0.040_45 { c / 12.92 } else { ((c + 0.055) / 1.055).powf(2.4) }
    })
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
            for entry in &module.entry_points {
                let text = translate(&module, &info, entry);
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
        let frame = twin!(FrameUniform: clip_from_eye right up forward sun horizon zenith options water drape land sea);
        assert_eq!(layout("Frame"), frame);
        let layer = twin!(LayerUniform: cell offset quantum up_offset height per_depth land_base per_height exaggeration is_water);
        assert_eq!(layout("Layer"), layer);
        assert_eq!(layout("Water"), twin!(WaterUniform: absorption body optics waves));
        let sizes = [size_of::<FrameUniform>(), size_of::<LayerUniform>(), size_of::<WaterUniform>()];
        assert!(sizes.iter().all(|s| s.is_multiple_of(16)), "WebGL2 wants it");
    }

    #[test]
    fn colours_are_linear() {
        assert_eq!(linear(0xff_00_ff), [1.0, 0.0, 1.0]);
        assert!((linear(0x80_80_80)[0] - 0.215_86).abs() < 1e-4);
    }

    /// The Moon, the noise of a flat coast and a dry valley were drawn as seas.
    #[test]
    fn only_a_deep_part_is_sea() {
        let sea = |heights| has_sea(Colours::Auto, heights);
        for heights in
            [[-2153.0, 1599.0], [-0.135, 0.125], [-30.0, 108.8], [-2339.0, -19.0], [-1431.0, 100.0]]
        {
            assert!(sea(heights), "{heights:?}");
        }
        for heights in
            [[-3.0, 146.0], [-28.0, 1077.0], [-16.0, 3742.0], [-86.0, 3368.0], [0.0, 0.0], [5.0, 9.0]]
        {
            assert!(!sea(heights), "{heights:?}");
        }
        assert!(has_sea(Colours::Bathymetry, [-3.0, 146.0]) && !has_sea(Colours::Terrain, [-3e3, 1.0]));
        assert_eq!([146.0, 4128.0].map(|h| top(Colours::Auto, h)), [HILLS, 1.0]);
    }

    #[test]
    fn stops_rise() {
        for ramp in [&LAND[..], &ROCK[..], &SEA[..]] {
            assert!(ramp.is_sorted_by(|a, b| a.0 < b.0));
        }
    }
}
