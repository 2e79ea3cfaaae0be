//! How a frame looks: light, colours, water.

use diamantina_protocol::message::{Kind, Scene};
use glam::DVec3;

/// How a frame looks.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Look {
    /// What is seen where no terrain is.
    pub background: Background,
    /// Where the light comes from.
    pub sun: Sun,
    /// What terrain is coloured by.
    pub colours: Colours,
    /// What the ends of the colours stand for, the lower below the upper: metres of height, or degrees of slope. Without
    /// it each layer's own lowest and highest height, and 0 to 60 degrees.
    pub range: Option<[f64; 2]>,
    /// How terrain is lit.
    pub shading: Shading,
    /// The thickness of the air: 0 is none, 1 a clear day.
    pub haze: f32,
    /// What heights are multiplied by; above 0. The camera's positions count in stretched heights.
    pub exaggeration: f64,
    /// Whether to tint diamonds by level.
    pub show_levels: bool,
    /// Whether to draw the sides of triangles.
    pub wireframe: bool,
    /// How water looks.
    pub water: Water,
    /// How imagery looks.
    pub imagery: Imagery,
    /// What is written over the finished picture. [`super::Renderer`] does not: see [`crate::annotate`].
    pub annotations: Annotations,
}

impl Default for Look {
    fn default() -> Self {
        Self {
            background: Background::Sky,
            sun: Sun::default(),
            colours: Colours::Auto,
            range: None,
            shading: Shading::Soft,
            haze: 1.0,
            exaggeration: 1.0,
            show_levels: false,
            wireframe: false,
            water: Water::default(),
            imagery: Imagery::default(),
            annotations: Annotations::default(),
        }
    }
}

/// Behind pictures that show nothing but what was measured: paper.
const PAPER: Background = Background::Colour([1.0; 4]);

impl Look {
    /// Whether layers of water mirror what is around them.
    #[must_use]
    pub fn mirrors(&self) -> bool {
        self.water.reflecting && !self.wireframe
    }

    /// How a scene looks unless told otherwise. Other bodies than the Earth are grey, without air, and the sun stands low, as
    /// plains of dust show little relief else. Under layers of water the ground has no sea of its own: it would tell depths twice,
    /// and end in a hard edge where the water's shore is soft.
    #[must_use]
    pub fn of(scene: &Scene) -> Self {
        let radius = scene.frame.crs.as_ref().and_then(|crs| crs.proj4.as_deref()).and_then(radius);
        if radius.is_none_or(|metres| (metres - EARTH_RADIUS).abs() < 100_000.0) {
            let is_wet = scene.layers.iter().any(|layer| layer.kind == Kind::Water);
            let colours = if is_wet { Colours::Terrain } else { Colours::Auto };
            return Self { colours, ..Self::default() };
        }
        let black = Background::Colour([0.003, 0.003, 0.004, 1.0]);
        let sun = Sun { altitude_degrees: 20.0, ..Sun::default() };
        Self { background: black, sun, colours: Colours::Grey, haze: 0.0, ..Self::default() }
    }

    /// The same without all that is only beautiful: on paper instead of under a sky, without haze, with heights as they
    /// are, with colours of the ramp alone, lit by a formula or not at all, water in one colour, and imagery as it was taken. Sun, colours and
    /// annotations stay.
    #[must_use]
    pub fn truthful(self) -> Self {
        Self {
            background: PAPER,
            haze: 0.0,
            exaggeration: 1.0,
            show_levels: false,
            shading: if self.shading == Shading::Soft { Shading::Hillshade } else { self.shading },
            water: Water { reflecting: false, waves: 0.0, ..self.water },
            imagery: Imagery { light: 0.0, ..self.imagery },
            ..self
        }
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
    /// Height, over the layer's range, from dark blue over green and orange to pink, even to the eye.
    Batlow,
    /// Height, from violet over green to yellow, even to the eye.
    Viridis,
    /// Height, from black over red to light yellow, even to the eye.
    Magma,
    /// The angle from the level, light to dark.
    Slope,
    /// Nothing: one grey; white where terrain is lit as by [`Shading::Hillshade`], whose light alone is seen then.
    Flat,
}

impl Colours {
    /// All of them, as they are listed to choose from.
    pub const ALL: [Self; 9] = [
        Self::Auto,
        Self::Terrain,
        Self::Bathymetry,
        Self::Grey,
        Self::Batlow,
        Self::Viridis,
        Self::Magma,
        Self::Slope,
        Self::Flat,
    ];
}

/// How terrain is lit. Their numbers are those that the shaders know.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Shading {
    /// By the sun and the sky, with rock on steep ground: as a landscape.
    Soft = 0,
    /// By the cosine of the angle between the surface and the light, 0 where it is turned away: as `gdaldem hillshade`. The
    /// encoded colour is multiplied by it, as programs of maps multiply two layers. Water is not lit.
    Hillshade = 1,
    /// Not at all: each pixel has its value's colour.
    Unlit = 2,
}

/// What is written over pictures.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Annotations {
    /// A bar of a round length, as it looks where the middle of the picture is.
    pub scale_bar: bool,
    /// An arrow to the north, as it lies on the level there.
    pub north_arrow: bool,
    /// What colours mean.
    pub legend: bool,
}

impl Annotations {
    /// All of them.
    pub const ALL: Self = Self { scale_bar: true, north_arrow: true, legend: true };

    /// Whether there is anything to write.
    #[must_use]
    pub fn is_any(self) -> bool {
        self != Self::default()
    }
}

/// How layers of water look.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Water {
    /// Whether it mirrors what is around it and shows what is below it; else it is one opaque colour.
    pub reflecting: bool,
    /// How much slower light is in it than in the air: 1.33. Above 1; a very large number makes a mirror.
    pub refractive_index: f64,
    /// How high waves are: 0 is a mirror, 1 a breeze.
    pub waves: f64,
    /// The moment of the waves, in seconds.
    pub seconds: f64,
    /// The depth in metres through which 1/e of green light comes; else one that fits the layer's extent.
    pub clarity: Option<f64>,
    /// Width and height of the mirrored picture as parts of those of the picture; above 0, at most 1.
    pub mirror_scale: f64,
    /// How many times as large as in the picture itself errors may be in what is mirrored; at least 1.
    pub mirror_error: f64,
}

impl Default for Water {
    /// A lake in a breeze.
    fn default() -> Self {
        Self {
            reflecting: true,
            refractive_index: 1.33,
            waves: 1.0,
            seconds: 0.0,
            clarity: None,
            mirror_scale: 1.0,
            mirror_error: 2.0,
        }
    }
}

/// How imagery looks on terrain.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Imagery {
    /// How much of the light on the ground it is shown in: 0 as it was taken, 1 as if it were the ground's own colour.
    pub light: f32,
    /// How much it hides of the terrain's colours, 0 to 1.
    pub opacity: f32,
}

impl Default for Imagery {
    /// Pictures have light and shadow of their own: some relief is added to it.
    fn default() -> Self {
        Self { light: 0.5, opacity: 1.0 }
    }
}
