//! Colours by value: what the shaders draw and what a legend shows are one definition, [`Scale`].
//!
//! A ramp is a list of sRGB colours with places from 0 to 1. Between two of them light is mixed linearly, as the shader
//! does it: decode both, mix, encode.
//!
//! `batlow` and `lajolla` are Fabio Crameri's (Scientific colour maps, doi 10.5281/zenodo.1243862; MIT licence, copyright
//! 2020 Fabio Crameri), `viridis` and `magma` those of matplotlib (Stéfan van der Walt, Nathaniel Smith and Eric Firing;
//! CC0). Of each table of 256 colours eight are kept, so placed that no channel in between is more than 9 of 255 off the
//! table. They change evenly to the eye, and stay apart for people who confuse red and green.

use super::frame::single;
use super::look::{Colours, Look, Shading};
use diamantina_protocol::message::Layer;
use diamantina_protocol::texture;

/// A colour of a ramp: where it stands, and sRGB as 0xRRGGBB.
pub(super) type Stop = (f32, u32);

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

const BATLOW: [Stop; 8] = [
    (0.0, 0x01_19_59),
    (0.251, 0x22_60_61),
    (0.373, 0x4c_72_4d),
    (0.514, 0x88_84_2f),
    (0.624, 0xbe_90_35),
    (0.729, 0xeb_9a_60),
    (0.851, 0xfd_af_a7),
    (1.0, 0xfa_cc_fa),
];

const VIRIDIS: [Stop; 8] = [
    (0.0, 0x44_01_54),
    (0.137, 0x46_30_7e),
    (0.424, 0x27_7e_8e),
    (0.616, 0x25_ac_82),
    (0.718, 0x4c_c2_6c),
    (0.82, 0x86_d5_49),
    (0.933, 0xd2_e2_1b),
    (1.0, 0xfd_e7_25),
];

const MAGMA: [Stop; 8] = [
    (0.0, 0x00_00_04),
    (0.075, 0x0d_0a_29),
    (0.18, 0x33_10_67),
    (0.337, 0x73_20_81),
    (0.549, 0xca_3e_72),
    (0.686, 0xf4_69_5c),
    (0.835, 0xfe_b0_78),
    (1.0, 0xfc_fd_bf),
];

/// Crameri's `lajolla`, from its light end: level ground is light, as where slopes are hatched.
const SLOPE: [Stop; 8] = [
    (0.0, 0xff_fe_cb),
    (0.118, 0xf7_dc_77),
    (0.188, 0xf1_c1_59),
    (0.435, 0xe1_75_50),
    (0.573, 0xc0_4d_49),
    (0.722, 0x74_38_30),
    (0.843, 0x41_2716),
    (1.0, 0x19_19_00),
];

/// The sea, shallow to deep.
const SEA: [Stop; 4] = [(0.0, 0xa9_d6_dd), (0.12, 0x62_ad_cc), (0.45, 0x2a_6c_a0), (1.0, 0x12_2f_5c)];

/// Water that mirrors nothing.
pub(super) const WATER: u32 = 0x4a_86_ab;

/// The share of a layer's range of heights below 0 m that makes it a sea and not lowland or noise.
const SEA_SHARE_MIN: f64 = 0.1;

/// Summits up to here are hills, with no snow on them; from there on they are mountains, and white. Metres.
const HILLS_TO_MOUNTAINS: [f64; 2] = [600.0, 3000.0];

/// How far up the ramp of land the summits of hills reach.
const HILLS: f64 = 0.62;

/// The steepest slope that has a colour of its own, in degrees: ground hardly stands steeper between samples.
const SLOPE_MAX: f64 = 60.0;

/// What a colour tells.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Quantity {
    /// Metres; below 0 depth, where there is a sea.
    Height,
    /// Degrees from the level, of the surface as it is drawn, its heights not multiplied.
    Slope,
    /// The cosine of the angle between the surface and the sun's light, from 0 to 1.
    Light,
}

/// What the colours of a layer stand for.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Scale {
    quantity: Quantity,
    range: [f64; 2],
    /// Whether values lie beyond the ends of the range.
    beyond: [bool; 2],
    land: &'static [Stop; 8],
    /// The lowest value of land, ...
    pub(super) base: f64,
    /// ... and parts of the ramp for each unit above it.
    pub(super) per_value: f64,
    /// Parts of the ramp of the sea for each metre of depth; 0 where there is none.
    pub(super) per_depth: f64,
}

impl Scale {
    /// What colours mean for a layer of terrain.
    #[must_use]
    pub fn of(look: &Look, layer: &Layer) -> Self {
        Self::over(look, layer.heights)
    }

    fn over(look: &Look, heights: [f64; 2]) -> Self {
        let ratio = |part: f64, range: f64| if range > 0.0 { part / range } else { 0.0 };
        let land = land(look.colours);
        let quantity = quantity(look.colours);
        if quantity != Quantity::Height {
            let most = if quantity == Quantity::Slope { SLOPE_MAX } else { 1.0 };
            let range = look.range.filter(|_| quantity == Quantity::Slope).unwrap_or([0.0, most]);
            let beyond =
                if quantity == Quantity::Slope { [range[0] > 0.0, range[1] < 90.0] } else { [false; 2] };
            let per_value = ratio(1.0, range[1] - range[0]);
            return Self { quantity, range, beyond, land, base: range[0], per_value, per_depth: 0.0 };
        }
        let range = look.range.unwrap_or(heights);
        let [lowest, highest] = range;
        let sea = has_sea(look.colours, range);
        let base = if sea { lowest.max(0.0).min(highest) } else { lowest };
        Self {
            quantity,
            range,
            beyond: [heights[0] < lowest, heights[1] > highest],
            land,
            base,
            per_value: ratio(top(look.colours, highest), highest - base),
            per_depth: if sea { ratio(1.0, -lowest) } else { 0.0 },
        }
    }

    /// What is coloured.
    #[must_use]
    pub fn quantity(&self) -> Quantity {
        self.quantity
    }

    /// The values at both ends: metres, degrees, or 0 and 1.
    #[must_use]
    pub fn range(&self) -> [f64; 2] {
        self.range
    }

    /// Whether there may be values below the lower and above the upper end; they have that end's colour.
    #[must_use]
    pub fn beyond(&self) -> [bool; 2] {
        self.beyond
    }

    /// Whether heights below 0 are depths, with colours of their own.
    #[must_use]
    pub fn has_sea(&self) -> bool {
        self.per_depth > 0.0
    }

    /// The colour of a value, sRGB: where nothing is shaded, that of each pixel that shows it.
    #[must_use]
    pub fn colour(&self, value: f64) -> [u8; 3] {
        if self.quantity == Quantity::Light {
            return [byte(value.clamp(0.0, 1.0)); 3];
        }
        let light = if self.has_sea() && value < 0.0 {
            mixed(&SEA, -value * self.per_depth)
        } else {
            mixed(self.land, (value - self.base) * self.per_value)
        };
        light.map(|c| byte(encoded(c)))
    }
}

/// The colour of layers of water that mirror nothing, sRGB.
#[must_use]
pub fn water_colour() -> [u8; 3] {
    let [_, r, g, b] = WATER.to_be_bytes();
    [r, g, b]
}

/// The ramp of land.
pub(super) fn land(colours: Colours) -> &'static [Stop; 8] {
    match colours {
        Colours::Auto | Colours::Terrain | Colours::Bathymetry | Colours::Flat => &LAND,
        Colours::Grey => &ROCK,
        Colours::Batlow => &BATLOW,
        Colours::Viridis => &VIRIDIS,
        Colours::Magma => &MAGMA,
        Colours::Slope => &SLOPE,
    }
}

/// The ramp of the sea.
pub(super) fn sea() -> &'static [Stop; 4] {
    &SEA
}

/// Whether rock shows on steep ground: where colours are those of a landscape, and not a scale to be read.
pub(super) fn shows_rock(look: &Look) -> bool {
    let is_landscape =
        matches!(look.colours, Colours::Auto | Colours::Terrain | Colours::Bathymetry | Colours::Grey);
    is_landscape && look.shading == Shading::Soft
}

/// What is coloured.
pub(super) fn quantity(colours: Colours) -> Quantity {
    match colours {
        Colours::Slope => Quantity::Slope,
        Colours::Flat => Quantity::Light,
        _ => Quantity::Height,
    }
}

/// Whether heights below 0 m are depths.
fn has_sea(colours: Colours, [lowest, highest]: [f64; 2]) -> bool {
    match colours {
        Colours::Bathymetry => lowest < 0.0,
        Colours::Auto => lowest < 0.0 && -lowest >= SEA_SHARE_MIN * (highest - lowest),
        _ => false,
    }
}

/// How far up the ramp the highest point stands: a low island has no snow.
fn top(colours: Colours, highest: f64) -> f64 {
    let [low, high] = HILLS_TO_MOUNTAINS;
    match colours {
        Colours::Auto | Colours::Terrain | Colours::Bathymetry | Colours::Flat => {
            HILLS + (1.0 - HILLS) * ((highest - low) / (high - low)).clamp(0.0, 1.0)
        }
        _ => 1.0,
    }
}

/// Linear light at a place of a ramp.
fn mixed(ramp: &[Stop], place: f64) -> [f64; 3] {
    let mut colour = linear(ramp[0].1).map(f64::from);
    for pair in ramp.windows(2) {
        let [low, high] = [pair[0].0, pair[1].0].map(f64::from);
        let (part, next) = (((place - low) / (high - low)).clamp(0.0, 1.0), linear(pair[1].1));
        for (channel, next) in colour.iter_mut().zip(next) {
            *channel += (f64::from(next) - *channel) * part;
        }
    }
    colour
}

/// The nearest byte to a number from 0 to 1.
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "from 0 to 255")]
fn byte(channel: f64) -> u8 {
    (channel.clamp(0.0, 1.0) * 255.0).round() as u8
}

/// The sRGB curve.
pub(super) fn encoded(linear: f64) -> f64 {
    texture::srgb(linear)
}

/// Linear red, green and blue of 0xRRGGBB.
pub(super) fn linear(srgb: u32) -> [f32; 3] {
    let [_, r, g, b] = srgb.to_be_bytes();
    [r, g, b].map(|byte| single(texture::light(f64::from(byte) / 255.0)))
}

#[cfg(test)]
mod tests {
    use super::*;

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
        for ramp in Colours::ALL.map(|colours| &land(colours)[..]).into_iter().chain([&SEA[..]]) {
            assert!(ramp.is_sorted_by(|a, b| a.0 < b.0));
            assert_eq!((ramp[0].0, ramp[ramp.len() - 1].0), (0.0, 1.0));
        }
    }

    /// Places of the published tables, some of which are no stops: of 256 colours those numbered 32, 96, 160 and 224.
    #[test]
    fn ramps_are_the_published_ones() {
        for (colours, expected) in [
            (Colours::Batlow, [0x11_43_60, 0x4d_73_4d, 0xc0_90_36, 0xfd_b4_b6]),
            (Colours::Viridis, [0x47_2d_7b, 0x2c_72_8e, 0x28_ae_80, 0xad_dc_30]),
            (Colours::Magma, [0x1d_11_47, 0x83_26_81, 0xe7_52_63, 0xfe_c4_88]),
            (Colours::Slope, [0xf7_d9_71, 0xe5_87_51, 0xa4_45_44, 0x36_24_11]),
        ] {
            let look = Look { colours, range: Some([0.0, 255.0]), ..Look::default() };
            let scale = Scale::over(&look, [0.0, 255.0]);
            for (value, expected) in [32.0, 96.0, 160.0, 224.0].into_iter().zip(expected) {
                let [_, r, g, b] = u32::to_be_bytes(expected);
                let found = scale.colour(value);
                let off = found.iter().zip([r, g, b]).map(|(a, b)| a.abs_diff(b)).max().unwrap();
                assert!(off <= 9, "{colours:?} at {value}: {found:?}, expected {:?}", [r, g, b]);
            }
        }
    }

    /// What a reader of a picture does: the value whose colour is nearest.
    #[test]
    fn a_colour_tells_its_value() {
        for colours in Colours::ALL {
            for heights in [[-2153.0, 1599.0], [0.0, 4128.0], [12.0, 146.0]] {
                let look = Look { colours, ..Look::default() };
                let scale = Scale::over(&look, heights);
                let [low, high] = scale.range();
                let at = |step: usize| low + (high - low) * step as f64 / 1024.0;
                let table: Vec<[u8; 3]> = (0..=1024).map(|step| scale.colour(at(step))).collect();
                for step in (0..=1024).step_by(31) {
                    let found = table[step];
                    let apart = |c: &[u8; 3]| {
                        c.iter().zip(found).map(|(a, b)| i32::from(a.abs_diff(b)).pow(2)).sum::<i32>()
                    };
                    let same = (0..=1024_usize).filter(|i| apart(&table[*i]) == 0);
                    let farthest = same.map(|i| i.abs_diff(step)).max().unwrap();
                    assert!(farthest <= 24, "{colours:?} {heights:?}: {} and {farthest} on", at(step));
                }
            }
        }
    }

    #[test]
    fn a_range_may_be_chosen_and_says_what_lies_beyond() {
        let look = Look { colours: Colours::Batlow, range: Some([100.0, 200.0]), ..Look::default() };
        let scale = Scale::over(&look, [120.0, 900.0]);
        assert_eq!((scale.range(), scale.beyond()), ([100.0, 200.0], [false, true]));
        assert_eq!(scale.colour(900.0), scale.colour(200.0));
        let slope = Scale::over(&Look { colours: Colours::Slope, ..Look::default() }, [0.0, 5.0]);
        assert_eq!((slope.range(), slope.beyond()), ([0.0, SLOPE_MAX], [false, true]));
        let flat = Scale::over(&look, [7.0, 7.0]);
        assert_eq!(flat.colour(7.0), [0x01, 0x19, 0x59]);
    }
}
