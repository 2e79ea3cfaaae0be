//! How pictures look, on the command line.

use super::{Failure, numbers};
use clap::{Args, ValueEnum};
use diamantina_client::render::{self, Background, Colours, Imagery, Look, Sun, Water};
use diamantina_protocol::message::Scene;
use std::ops::RangeInclusive;

/// What heights may be multiplied by.
const EXAGGERATION: RangeInclusive<f64> = 0.01..=1000.0;

#[derive(Clone, Args)]
pub(super) struct LookArgs {
    /// Where the sun stands: degrees clockwise from north, degrees above the horizon [default: 315,45; 315,20
    /// on other bodies than the Earth]
    #[arg(long, value_name = "AZIMUTH,ALTITUDE", value_parser = parse_pair)]
    sun: Option<[f64; 2]>,
    /// What is behind the terrain: sky, or a colour as six hexadecimal digits [default: sky; black on other
    /// bodies than the Earth]
    #[arg(long, value_name = "sky|RRGGBB", value_parser = parse_background)]
    background: Option<Background>,
    /// What colours mean: terrain is coloured by height, bathymetry also by depth below 0 m; auto is grey on
    /// other bodies than the Earth, and bathymetry where a tenth of the range of heights lies below 0 m
    #[arg(long, default_value = "auto", value_enum)]
    colours: ColourName,
    /// What heights are multiplied by, to make gentle relief visible; errors and the heights of eye and
    /// target are multiplied, too
    #[arg(long, default_value_t = 1.0, value_name = "N")]
    pub(super) exaggeration: f64,
    /// Tint diamonds by their level
    #[arg(long)]
    show_levels: bool,
    /// Draw the sides of triangles
    #[arg(long)]
    wireframe: bool,
    /// One sample a pixel: faster, with jagged edges
    #[arg(long)]
    no_antialias: bool,
    /// How layers of water are drawn: with what they mirror and what is seen through them, or in one colour
    #[arg(long, default_value = "mirror", value_enum)]
    water: WaterName,
    /// How high the waves are: 0 is a mirror, 1 a breeze
    #[arg(long, default_value_t = 1.0, value_name = "N")]
    waves: f64,
    /// The depth of water through which a third of green light comes [default: it fits the layer's extent, at most 12]
    #[arg(long, value_name = "METRES")]
    clarity: Option<f64>,
    /// How much of the light on the ground imagery is shown in: 0 as it was taken, 1 as if it were the ground's own colour
    #[arg(long, default_value_t = 0.5, value_name = "PART")]
    texture_light: f32,
    /// The size of the mirrored picture as a part of the picture's: less is faster, and blurred
    #[arg(long, default_value_t = 1.0, value_name = "PART")]
    mirror_scale: f64,
}

#[derive(Clone, Copy, ValueEnum)]
enum ColourName {
    Auto,
    Terrain,
    Bathymetry,
    Grey,
}

#[derive(Clone, Copy, PartialEq, Eq, ValueEnum)]
enum WaterName {
    /// What is mirrored and what is seen through
    Mirror,
    /// One colour
    Plain,
}

impl LookArgs {
    /// Whether all of it can be drawn.
    pub(super) fn check(&self) -> Result<(), Failure> {
        if !EXAGGERATION.contains(&self.exaggeration) {
            let [low, high] = [EXAGGERATION.start(), EXAGGERATION.end()];
            return Err(Failure(
                2,
                format!("--exaggeration {}: expected a number from {low} to {high}", self.exaggeration),
            ));
        }
        let refuse = |what: String| Err(Failure(2, what));
        if !(self.waves >= 0.0 && self.waves <= 10.0) {
            return refuse(format!("--waves {}: expected a number from 0 to 10", self.waves));
        }
        if let Some(clarity) = self.clarity.filter(|metres| !(*metres > 0.0 && metres.is_finite())) {
            return refuse(format!("--clarity {clarity}: expected metres, above 0"));
        }
        if !(0.0..=1.0).contains(&self.texture_light) {
            return refuse(format!("--texture-light {}: expected a number from 0 to 1", self.texture_light));
        }
        if !(self.mirror_scale > 0.0 && self.mirror_scale <= 1.0) {
            return refuse(format!(
                "--mirror-scale {}: expected a number above 0, at most 1",
                self.mirror_scale
            ));
        }
        Ok(())
    }

    pub(super) fn look(&self, scene: &Scene) -> Look {
        let look = Look::of(scene);
        Look {
            background: self.background.unwrap_or(look.background),
            sun: self.sun.map_or(look.sun, |[azimuth_degrees, altitude_degrees]| Sun {
                azimuth_degrees,
                altitude_degrees,
            }),
            colours: match self.colours {
                ColourName::Auto => look.colours,
                ColourName::Terrain => Colours::Terrain,
                ColourName::Bathymetry => Colours::Bathymetry,
                ColourName::Grey => Colours::Grey,
            },
            exaggeration: self.exaggeration,
            show_levels: self.show_levels,
            wireframe: self.wireframe,
            imagery: Imagery { light: self.texture_light, ..look.imagery },
            water: Water {
                reflecting: self.water == WaterName::Mirror,
                waves: self.waves,
                clarity: self.clarity,
                mirror_scale: self.mirror_scale,
                ..look.water
            },
            ..look
        }
    }

    pub(super) fn options(&self) -> render::Options {
        render::Options { samples: if self.no_antialias { 1 } else { 4 }, ..render::Options::default() }
    }
}

fn parse_pair(text: &str) -> Result<[f64; 2], String> {
    numbers(text)
}

fn parse_background(text: &str) -> Result<Background, String> {
    if text == "sky" {
        return Ok(Background::Sky);
    }
    let digits = text.strip_prefix('#').unwrap_or(text);
    let colour = (digits.len() == 6).then(|| u32::from_str_radix(digits, 16).ok()).flatten();
    let colour = colour.ok_or("expected sky or six hexadecimal digits, as in ff00ff")?;
    // The picture is sRGB, blending is linear.
    #[allow(clippy::cast_possible_truncation, reason = "a colour needs no more than f32")]
    let linear = |shift: u32| {
        let c = f64::from(colour >> shift & 0xff) / 255.0;
        (if c <= 0.04045 { c / 12.92 } else { ((c + 0.055) / 1.055).powf(2.4) }) as f32
    };
    Ok(Background::Colour([linear(16), linear(8), linear(0), 1.0]))
}
