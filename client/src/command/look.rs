//! How pictures look, on the command line.

use super::{Failure, numbers};
use clap::{Args, ValueEnum};
use diamantina_client::render::{self, Background, Colours, Imagery, Look, Shading, Sun, Water};
use diamantina_protocol::message::Scene;
use diamantina_protocol::texture;
use std::ops::RangeInclusive;

/// What heights may be multiplied by.
const EXAGGERATION: RangeInclusive<f64> = 0.01..=1000.0;

#[derive(Clone, Args)]
pub(super) struct LookArgs {
    /// Where the sun stands: degrees clockwise from north, degrees above the horizon [default: 315,45; 315,20
    /// on other bodies than the Earth]
    #[arg(long, value_name = "AZIMUTH,ALTITUDE", value_parser = parse_pair)]
    sun: Option<[f64; 2]>,
    /// Show nothing but what was measured: no sky, haze, waves, mirrors, motions or exaggeration, colours of the ramp
    /// alone, and one sample a pixel, so that none mixes two places. Water has one colour. Lit as by --shading hillshade,
    /// or with --shading none not at all: then the legend tells the height of each pixel
    #[arg(long = "true")]
    pub(super) is_true: bool,
    /// What is behind the terrain: sky, or a colour as six hexadecimal digits [default: sky; black on other
    /// bodies than the Earth; white with --true]
    #[arg(long, value_name = "sky|RRGGBB", value_parser = parse_background)]
    background: Option<Background>,
    /// What colours mean [default: auto]
    #[arg(long, value_enum)]
    colours: Option<ColourName>,
    /// What the ends of the colours stand for: metres, or degrees with --colours slope [default: the lowest and the
    /// highest height of each layer; 0 to 60 degrees]
    #[arg(long, value_name = "LOW,HIGH", value_parser = parse_pair)]
    range: Option<[f64; 2]>,
    /// How terrain is lit [default: soft; hillshade with --true or --colours hillshade]
    #[arg(long, value_enum)]
    shading: Option<ShadingName>,
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
    /// How layers of water are drawn [default: mirror; plain with --true]
    #[arg(long, value_enum)]
    water: Option<WaterName>,
    /// How high the waves are: 0 is a mirror, 1 a breeze [default: 1]
    #[arg(long, value_name = "N")]
    waves: Option<f64>,
    /// The depth of water through which a third of green light comes [default: it fits the layer's extent, at most 12]
    #[arg(long, value_name = "METRES")]
    clarity: Option<f64>,
    /// How much of the light on the ground imagery is shown in: 0 as it was taken, 1 as if it were the ground's own colour
    /// [default: 0.5]
    #[arg(long, value_name = "PART")]
    texture_light: Option<f32>,
    /// The size of the mirrored picture as a part of the picture's: less is faster, and blurred [default: 1]
    #[arg(long, value_name = "PART")]
    mirror_scale: Option<f64>,
    /// How many times as large as --error-pixels errors may be in what water mirrors: more is faster [default: 2]
    #[arg(long, value_name = "TIMES")]
    mirror_error: Option<f64>,
}

#[derive(Clone, Copy, PartialEq, Eq, ValueEnum)]
enum ColourName {
    /// Grey on other bodies than the Earth; else bathymetry where a tenth of the range of heights lies below 0 m, or terrain
    Auto,
    /// Height, as landscapes are coloured
    Terrain,
    /// The same, and depth below 0 m
    Bathymetry,
    /// Height, dark to light
    Grey,
    /// Height, blue over green and orange to pink, even to the eye
    Batlow,
    /// Height, violet over green to yellow, even to the eye
    Viridis,
    /// Height, black over red to light yellow, even to the eye
    Magma,
    /// The angle from the level, light to dark
    Slope,
    /// None: the light alone
    Hillshade,
}

#[derive(Clone, Copy, PartialEq, Eq, ValueEnum)]
enum ShadingName {
    /// By sun and sky, as a landscape
    Soft,
    /// By the cosine of the angle to the sun, as gdaldem hillshade
    Hillshade,
    /// Not at all: each pixel has the colour of its height or slope
    None,
}

#[derive(Clone, Copy, PartialEq, Eq, ValueEnum)]
enum WaterName {
    /// With what it mirrors and what is seen through it
    Mirror,
    /// In one colour
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
        if let Some(waves) = self.waves.filter(|waves| !(0.0..=10.0).contains(waves)) {
            return refuse(format!("--waves {waves}: expected a number from 0 to 10"));
        }
        if let Some(clarity) = self.clarity.filter(|metres| !(*metres > 0.0 && metres.is_finite())) {
            return refuse(format!("--clarity {clarity}: expected metres, above 0"));
        }
        if let Some(light) = self.texture_light.filter(|light| !(0.0..=1.0).contains(light)) {
            return refuse(format!("--texture-light {light}: expected a number from 0 to 1"));
        }
        if let Some(scale) = self.mirror_scale.filter(|scale| !(*scale > 0.0 && *scale <= 1.0)) {
            return refuse(format!("--mirror-scale {scale}: expected a number above 0, at most 1"));
        }
        if let Some(times) = self.mirror_error.filter(|times| !(1.0..=1000.0).contains(times)) {
            return refuse(format!("--mirror-error {times}: expected a number from 1 to 1000"));
        }
        if let Some([low, high]) = self.range.filter(|[low, high]| low >= high) {
            return refuse(format!("--range {low},{high}: expected the lower end first"));
        }
        if self.colours == Some(ColourName::Hillshade) {
            if self.shading.is_some_and(|shading| shading != ShadingName::Hillshade) {
                let what = "--colours hillshade shows the light alone: leave it out, or --shading";
                return refuse(what.to_owned());
            }
            if self.range.is_some() {
                return refuse("--colours hillshade has no range: leave it out, or --range".to_owned());
            }
        }
        self.check_truth()
    }

    /// Whether nothing else is asked for that would not be true.
    fn check_truth(&self) -> Result<(), Failure> {
        let wrong = [
            (self.exaggeration != 1.0, "--exaggeration", "heights are shown as they are"),
            (
                self.background == Some(Background::Sky),
                "--background sky",
                "there is one colour behind the terrain",
            ),
            (self.shading == Some(ShadingName::Soft), "--shading soft", "expected hillshade or none"),
            (self.show_levels, "--show-levels", "colours are those of the ramp alone"),
            (self.water == Some(WaterName::Mirror), "--water mirror", "water has one colour"),
            (self.texture_light.is_some(), "--texture-light", "imagery is shown as it was taken"),
            (self.waves.is_some(), "--waves", "water has one colour"),
            (self.clarity.is_some(), "--clarity", "water has one colour"),
            (self.mirror_scale.is_some(), "--mirror-scale", "water has one colour"),
            (self.mirror_error.is_some(), "--mirror-error", "water has one colour"),
        ];
        let wrong = wrong.into_iter().filter(|_| self.is_true).find(|(is_asked, ..)| *is_asked);
        wrong.map_or(Ok(()), |(_, option, why)| Err(untrue(option, why)))
    }

    pub(super) fn look(&self, scene: &Scene) -> Look {
        let look = Look::of(scene);
        let colours = match self.colours.unwrap_or(ColourName::Auto) {
            ColourName::Auto => look.colours,
            ColourName::Terrain => Colours::Terrain,
            ColourName::Bathymetry => Colours::Bathymetry,
            ColourName::Grey => Colours::Grey,
            ColourName::Batlow => Colours::Batlow,
            ColourName::Viridis => Colours::Viridis,
            ColourName::Magma => Colours::Magma,
            ColourName::Slope => Colours::Slope,
            ColourName::Hillshade => Colours::Flat,
        };
        let shading = match self.shading {
            Some(ShadingName::Hillshade) => Shading::Hillshade,
            Some(ShadingName::None) => Shading::Unlit,
            None if colours == Colours::Flat => Shading::Hillshade,
            Some(ShadingName::Soft) | None => Shading::Soft,
        };
        let look = Look {
            background: self.background.unwrap_or(look.background),
            sun: self.sun.map_or(look.sun, |[azimuth_degrees, altitude_degrees]| Sun {
                azimuth_degrees,
                altitude_degrees,
            }),
            colours,
            range: self.range,
            shading,
            exaggeration: self.exaggeration,
            show_levels: self.show_levels,
            wireframe: self.wireframe,
            imagery: Imagery { light: self.texture_light.unwrap_or(look.imagery.light), ..look.imagery },
            water: Water {
                reflecting: self.water != Some(WaterName::Plain),
                waves: self.waves.unwrap_or(look.water.waves),
                clarity: self.clarity,
                mirror_scale: self.mirror_scale.unwrap_or(look.water.mirror_scale),
                mirror_error: self.mirror_error.unwrap_or(look.water.mirror_error),
                ..look.water
            },
            ..look
        };
        if !self.is_true {
            return look;
        }
        let look = look.truthful();
        Look { background: self.background.unwrap_or(look.background), ..look }
    }

    pub(super) fn options(&self) -> render::Options {
        render::Options {
            samples: if self.no_antialias || self.is_true { 1 } else { 4 },
            ..render::Options::default()
        }
    }
}

/// An option that has no place beside --true.
pub(super) fn untrue(option: &str, why: &str) -> Failure {
    Failure(2, format!("{option} beside --true: {why}; leave one of them out"))
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
    let linear = |shift: u32| texture::light(f64::from(colour >> shift & 0xff) / 255.0) as f32;
    Ok(Background::Colour([linear(16), linear(8), linear(0), 1.0]))
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::Parser;
    use diamantina_protocol::arguments::with_negative_numbers;
    use diamantina_protocol::message::Frame;

    #[derive(Parser)]
    struct Only {
        #[command(flatten)]
        look: LookArgs,
    }

    fn parsed(words: &str) -> LookArgs {
        let words = ["look"].into_iter().chain(words.split_whitespace()).map(Into::into);
        Only::try_parse_from(with_negative_numbers(words)).unwrap().look
    }

    fn look(words: &str) -> Look {
        let frame = Frame { crs: None, vertical_unit: "metre".into() };
        let scene = Scene {
            name: "s".into(),
            version: "v".into(),
            frame,
            layers: vec![],
            zones: vec![],
            textures: vec![],
            series: vec![],
        };
        let args = parsed(words);
        assert!(args.check().is_ok(), "{words}");
        args.look(&scene)
    }

    #[test]
    fn without_options_it_is_the_usual_look() {
        assert_eq!(look(""), Look::default());
        assert_eq!(parsed("").options().samples, 4);
    }

    #[test]
    fn true_pictures_are_truthful_and_may_choose_what_is_true() {
        let found = look("--true");
        assert_eq!(found, Look::default().truthful());
        assert_eq!((found.shading, found.haze, found.water.reflecting), (Shading::Hillshade, 0.0, false));
        assert_eq!(parsed("--true").options().samples, 1);
        let words =
            "--true --shading none --colours batlow --background 000000 --sun 10,20 --range -5,9 --wireframe";
        let found = look(words);
        assert_eq!(
            (found.shading, found.colours, found.range),
            (Shading::Unlit, Colours::Batlow, Some([-5.0, 9.0]))
        );
        assert_eq!(found.background, Background::Colour([0.0, 0.0, 0.0, 1.0]));
        assert!(found.wireframe && found.sun.altitude_degrees == 20.0);
        assert_eq!(look("--colours hillshade").shading, Shading::Hillshade);
    }

    #[test]
    fn what_contradicts_itself_is_refused() {
        for (words, named) in [
            ("--true --exaggeration 2", "--exaggeration"),
            ("--true --background sky", "--background sky"),
            ("--true --shading soft", "--shading soft"),
            ("--true --show-levels", "--show-levels"),
            ("--true --water mirror", "--water mirror"),
            ("--true --waves 0", "--waves"),
            ("--true --texture-light 0.5", "--texture-light"),
            ("--texture-light 2", "--texture-light 2"),
            ("--true --clarity 3", "--clarity"),
            ("--true --mirror-scale 0.5", "--mirror-scale"),
            ("--colours hillshade --shading none", "--shading"),
            ("--colours hillshade --range 0,1", "--range"),
            ("--range 5,5", "--range 5,5"),
            ("--waves 11", "--waves 11"),
        ] {
            let Err(Failure(code, message)) = parsed(words).check() else { panic!("{words} is accepted") };
            assert!(code == 2 && message.contains(named), "{words}: {message}");
            assert_eq!(message.contains("beside --true"), words.starts_with("--true"), "{message}");
        }
    }
}
