//! Map projections: longitude and latitude ⇄ the coordinates of a CRS.
//!
//! The formulas are proj4rs's. Two things are added: the
//! equirectangular projection (`+proj=eqc`, the usual one for other planets) and a detour around a slip in
//! proj4rs's ellipsoids (see `REWRITTEN`). No shift grids are carried: NAD27 gets its mean shift (good to
//! some 10 m), the grids of other datums are left out.

use crate::message::Crs;
use proj4rs::Proj;
use proj4rs::transform::transform;

/// Words that proj4rs 0.1.5 gets wrong, and what says the same rightly. It takes the flattening of an
/// ellipsoid that is given by its minor half axis as (a - b) / b, which puts UTM on Clarke 1866 off by 85 m
/// at 46 degrees north; so such ellipsoids are given by a and their inverse flattening. NAD27 gets its mean
/// shift over the conterminous United States (NIMA TR8350.2).
const REWRITTEN: [(&str, &str); 7] = [
    ("+ellps=clrk66", "+a=6378206.4 +rf=294.9786982138982"),
    ("+datum=NAD27", "+a=6378206.4 +rf=294.9786982138982 +towgs84=-8,160,176"),
    ("+ellps=mod_airy", "+a=6377340.189 +rf=299.3249646"),
    (
        "+datum=ire65",
        "+a=6377340.189 +rf=299.3249646 +towgs84=482.530,-130.596,564.557,-1.042,-0.214,-0.631,8.15",
    ),
    ("+ellps=new_intl", "+a=6378157.5 +rf=298.2496153900135"),
    ("+ellps=plessis", "+a=6376523 +rf=308.64099709583735"),
    ("+ellps=walbeck", "+a=6376896 +rf=302.78000018165636"),
];

/// Why text is not a projection that this build can compute.
#[derive(Debug, thiserror::Error)]
pub enum ProjectionError {
    /// The PROJ string is malformed or names a projection that is not built in.
    #[error("expected a PROJ string with a known projection, found '{proj4}' ({reason}): choose another CRS")]
    Definition {
        /// The text as given.
        proj4: String,
        /// What the parser said.
        reason: String,
    },
}

/// One CRS, ready to convert to and from longitude and latitude. Immutable, a few hundred bytes.
pub struct Projection {
    kind: Kind,
    lonlat: Proj,
}

enum Kind {
    Proj(Box<Proj>),
    Equirectangular(Equirectangular),
}

impl std::fmt::Debug for Projection {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let name = match &self.kind {
            Kind::Proj(proj) => proj.projname(),
            Kind::Equirectangular(_) => "eqc",
        };
        f.debug_struct("Projection").field("name", &name).finish_non_exhaustive()
    }
}

impl Projection {
    /// Reads a PROJ string such as `+proj=utm +zone=11 +datum=WGS84`. The text may be hostile.
    ///
    /// # Errors
    /// When the string is malformed or its projection is not built in.
    pub fn new(proj4: &str) -> Result<Self, ProjectionError> {
        let failed = |reason: String| ProjectionError::Definition { proj4: proj4.to_owned(), reason };
        let kind = if parameter(proj4, "proj") == Some("eqc") {
            Kind::Equirectangular(Equirectangular::new(proj4).map_err(|e| failed(e.to_owned()))?)
        } else {
            let proj = Proj::from_proj_string(&rewritten(proj4)).map_err(|e| failed(e.to_string()))?;
            Kind::Proj(Box::new(proj))
        };
        let lonlat =
            Proj::from_proj_string("+proj=longlat +datum=WGS84").map_err(|e| failed(e.to_string()))?;
        Ok(Self { kind, lonlat })
    }

    /// True when x and y are degrees of longitude and latitude.
    #[must_use]
    pub fn is_geographic(&self) -> bool {
        matches!(&self.kind, Kind::Proj(proj) if proj.is_latlong())
    }

    /// CRS coordinates (in the CRS's units) of a WGS 84 longitude and latitude in degrees; `None` outside
    /// the projection's domain. About half a microsecond.
    #[must_use]
    pub fn forward(&self, lon_deg: f64, lat_deg: f64) -> Option<(f64, f64)> {
        match &self.kind {
            Kind::Proj(proj) => {
                if proj.is_latlong() && !(-90.0..=90.0).contains(&lat_deg) {
                    return None;
                }
                convert(&self.lonlat, proj, lon_deg, lat_deg)
            }
            Kind::Equirectangular(eqc) => eqc.forward(lon_deg, lat_deg),
        }
    }

    /// WGS 84 longitude and latitude in degrees of CRS coordinates; `None` outside the projection's domain.
    #[must_use]
    pub fn inverse(&self, x: f64, y: f64) -> Option<(f64, f64)> {
        match &self.kind {
            Kind::Proj(proj) => convert(proj, &self.lonlat, x, y),
            Kind::Equirectangular(eqc) => eqc.inverse(x, y),
        }
    }

    /// Longitude, from -180 to 180, and latitude in degrees of a place in the metres of a frame that lies so in this system;
    /// `None` where there are none.
    #[must_use]
    pub fn lonlat(&self, frame: &Crs, place: [f64; 2]) -> Option<[f64; 2]> {
        let [x, y] = [0, 1].map(|i| frame.origin[i] + place[i] * frame.per_metre[i]);
        let (lon, lat) = self.inverse(x, y)?;
        let lon = if (-180.0..=180.0).contains(&lon) { lon } else { (lon + 180.0).rem_euclid(360.0) - 180.0 };
        Some([lon, lat])
    }

    /// Coordinates in `other` of the point (x, y) of this CRS, the datum shifted once, directly.
    #[must_use]
    pub fn to(&self, other: &Self, x: f64, y: f64) -> Option<(f64, f64)> {
        match (&self.kind, &other.kind) {
            (Kind::Proj(from), Kind::Proj(to)) => convert(from, to, x, y),
            _ => {
                let (lon, lat) = self.inverse(x, y)?;
                other.forward(lon, lat)
            }
        }
    }
}

/// Major and minor half axes of a PROJ string's ellipsoid, metres; WGS 84's when it names none.
#[must_use]
pub fn ellipsoid(proj4: &str) -> (f64, f64) {
    // (name, a, inverse flattening), the ellipsoids that EPSG's geographic CRSs use most.
    const KNOWN: [(&str, f64, f64); 9] = [
        ("wgs84", 6_378_137.0, 298.257_223_563),
        ("grs80", 6_378_137.0, 298.257_222_101),
        ("nad83", 6_378_137.0, 298.257_222_101),
        ("clrk66", 6_378_206.4, 294.978_698_2),
        ("nad27", 6_378_206.4, 294.978_698_2),
        ("bessel", 6_377_397.155, 299.152_812_8),
        ("intl", 6_378_388.0, 297.0),
        ("krass", 6_378_245.0, 298.3),
        ("airy", 6_377_563.396, 299.324_964_6),
    ];
    let number = |key| parameter(proj4, key).and_then(|v| v.parse::<f64>().ok()).filter(|v| *v > 0.0);
    if let Some(r) = number("R") {
        return (r, r);
    }
    if let Some(a) = number("a") {
        return (a, number("b").unwrap_or_else(|| number("rf").map_or(a, |rf| a - a / rf)));
    }
    let name = parameter(proj4, "ellps").or(parameter(proj4, "datum")).unwrap_or("wgs84").to_lowercase();
    let (_, a, rf) = KNOWN.into_iter().find(|k| k.0 == name).unwrap_or(KNOWN[0]);
    (a, a - a / rf)
}

/// The value of `+key=value` in a PROJ string.
fn parameter<'a>(proj4: &'a str, key: &str) -> Option<&'a str> {
    proj4.split_whitespace().find_map(|word| word.strip_prefix('+')?.strip_prefix(key)?.strip_prefix('='))
}

/// The same definition in words that proj4rs gets right, with nothing that needs a shift grid.
fn rewritten(proj4: &str) -> String {
    let (a, b) = ellipsoid(proj4);
    let words = proj4.split_whitespace().filter_map(|word| {
        let known = REWRITTEN.iter().find(|(from, _)| from.eq_ignore_ascii_case(word));
        match known {
            Some((_, to)) => Some((*to).to_owned()),
            None if word.starts_with("+nadgrids=") && word != "+nadgrids=@null" => None,
            None if word.starts_with("+b=") && a > b => Some(format!("+rf={}", a / (a - b))),
            None => Some(word.to_owned()),
        }
    });
    words.collect::<Vec<_>>().join(" ")
}

/// Metres in one unit of height, where a PROJ string (of a compound CRS) says it.
#[must_use]
pub fn vertical_metres(proj4: &str) -> Option<f64> {
    match parameter(proj4, "vunits")? {
        "m" => Some(1.0),
        "ft" => Some(0.3048),
        "us-ft" => Some(1200.0 / 3937.0),
        _ => None,
    }
}

/// Metres in one unit of x and y of a PROJ string, whether or not its projection is built in; 1 where it says
/// none.
#[must_use]
pub fn unit_metres(proj4: &str) -> f64 {
    let given = parameter(proj4, "to_meter").and_then(|v| match v.split_once('/') {
        Some((n, d)) => Some(n.parse::<f64>().ok()? / d.parse::<f64>().ok()?),
        None => v.parse().ok(),
    });
    given.filter(|m: &f64| m.is_finite() && *m > 0.0).unwrap_or(match parameter(proj4, "units") {
        Some("ft") => 0.3048,
        Some("us-ft") => 1200.0 / 3937.0,
        Some("km") => 1000.0,
        Some("ind-ft") => 0.304_799_841_53,
        _ => 1.0,
    })
}

/// proj4rs with degrees outside and radians inside.
fn convert(from: &Proj, to: &Proj, x: f64, y: f64) -> Option<(f64, f64)> {
    let (x, y) = if from.is_latlong() { (x.to_radians(), y.to_radians()) } else { (x, y) };
    let mut point = (x, y, 0.0);
    transform(from, to, &mut point).ok()?;
    let (x, y) =
        if to.is_latlong() { (point.0.to_degrees(), point.1.to_degrees()) } else { (point.0, point.1) };
    (x.is_finite() && y.is_finite()).then_some((x, y))
}

/// `+proj=eqc`: x is proportional to longitude and y to latitude, on a sphere.
struct Equirectangular {
    radius: f64,
    lon_0: f64,
    lat_0: f64,
    cos_lat_ts: f64,
    x_0: f64,
    y_0: f64,
    unit: f64,
}

impl Equirectangular {
    fn new(proj4: &str) -> Result<Self, &'static str> {
        let number = |key| match parameter(proj4, key).map(str::parse::<f64>) {
            None => Ok(0.0),
            Some(Ok(v)) if v.is_finite() => Ok(v),
            Some(_) => Err("a parameter is not a number"),
        };
        let cos_lat_ts = number("lat_ts")?.to_radians().cos();
        if cos_lat_ts < 1e-9 {
            return Err("lat_ts is at a pole");
        }
        Ok(Self {
            radius: ellipsoid(proj4).0,
            lon_0: number("lon_0")?,
            lat_0: number("lat_0")?,
            cos_lat_ts,
            x_0: number("x_0")?,
            y_0: number("y_0")?,
            unit: unit_metres(proj4),
        })
    }

    fn forward(&self, lon: f64, lat: f64) -> Option<(f64, f64)> {
        if !lon.is_finite() || !(-90.0..=90.0).contains(&lat) {
            return None;
        }
        let lam = (lon - self.lon_0 + 180.0).rem_euclid(360.0) - 180.0;
        let x = self.radius * self.cos_lat_ts * lam.to_radians() + self.x_0;
        let y = self.radius * (lat - self.lat_0).to_radians() + self.y_0;
        Some((x / self.unit, y / self.unit))
    }

    fn inverse(&self, x: f64, y: f64) -> Option<(f64, f64)> {
        let lam = ((x * self.unit - self.x_0) / (self.radius * self.cos_lat_ts)).to_degrees();
        let lat = ((y * self.unit - self.y_0) / self.radius).to_degrees() + self.lat_0;
        // The seam at 180 degrees counts as both sides.
        let inside = lam.abs() <= 180.0 + 1e-9 && lat.abs() <= 90.0 + 1e-9;
        inside.then_some((lam + self.lon_0, lat.clamp(-90.0, 90.0)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn of(code: u16) -> Projection {
        Projection::new(crs_definitions::from_code(code).unwrap().proj4).unwrap()
    }

    /// Reference values: EPSG Guidance Note 7-2 for the polar stereographic, PROJ for the others.
    #[test]
    fn known_points_agree() {
        let close = |a: (f64, f64), b: (f64, f64), eps| {
            assert!((a.0 - b.0).abs() < eps && (a.1 - b.1).abs() < eps, "{a:?} {b:?}");
        };
        // On the central meridian x is 500 km; the meridian arc to 45 degrees is 4984944.378 m.
        close(of(32632).forward(9.0, 45.0).unwrap(), (500_000.0, 4_984_944.378 * 0.9996), 0.01);
        close(of(3857).forward(180.0, 0.0).unwrap(), (20_037_508.342_789, 0.0), 0.001);
        close(of(3857).forward(10.0, 60.0).unwrap(), (1_113_194.908, 8_399_737.890), 0.01);
        // EPSG:3031 is variant B about the pole: the pole itself is the origin.
        close(of(3031).forward(0.0, -90.0).unwrap(), (0.0, 0.0), 0.001);
    }

    #[test]
    fn inverse_undoes_forward() {
        let moon = Projection::new("+proj=eqc +lat_ts=30 +lon_0=10 +R=1737400").unwrap();
        let cases = [
            (of(32611), -119.5, 34.25),
            (of(26710), -122.2, 46.2),
            (of(2227), -119.5, 37.25),
            (of(3857), 12.0, 44.0),
            (of(25832), 12.0, 44.0),
            (of(4326), 12.0, 44.0),
            (of(2193), 172.0, -41.0),
            (of(3031), 110.5, -66.5),
            (of(32661), 40.0, 86.0),
            (moon, -150.0, -41.0),
        ];
        for (projection, lon, lat) in cases {
            let (x, y) = projection.forward(lon, lat).unwrap();
            let (lon2, lat2) = projection.inverse(x, y).unwrap();
            // A thousandth of a second; datum shifts are inverted by iteration.
            assert!((lon - lon2).abs() < 3e-7 && (lat - lat2).abs() < 3e-7, "{projection:?} {lon2} {lat2}");
        }
    }

    /// Without shift grids the mean shift stands in. The northing of a parallel differs by 218.09 m between
    /// the two ellipsoids (meridian arcs integrated numerically), and the datum moves by about 21 m back.
    #[test]
    fn nad27_is_shifted() {
        let bare = Projection::new("+proj=utm +zone=10 +ellps=clrk66").unwrap();
        let (x, y) = bare.to(&of(32610), 500_000.0, 5_115_000.0).unwrap();
        assert!((x - 500_000.0).abs() < 0.01 && (y - 5_115_000.0 - 218.09).abs() < 0.1, "{x} {y}");
        let (x, y) = of(26710).to(&of(32610), 562_000.0, 5_115_000.0).unwrap();
        assert!((x - 561_906.0).abs() < 5.0 && (y - 5_115_196.0).abs() < 5.0, "{x} {y}");
    }

    /// Regression: proj4rs 0.1.5 takes f = (a - b) / b for an ellipsoid given by b.
    #[test]
    fn an_ellipsoid_is_the_same_by_either_axis() {
        let y = |text: &str| Projection::new(text).unwrap().forward(9.0, 46.0).unwrap().1;
        let by_b = y("+proj=utm +zone=32 +a=6378137 +b=6356752.314245179");
        assert!((by_b - y("+proj=utm +zone=32 +ellps=WGS84")).abs() < 1e-3);
    }

    #[test]
    fn hostile_definitions_are_refused_or_harmless() {
        for text in ["", "+proj=nonsense", "+proj=eqc +lat_ts=90", "+proj=eqc +lon_0=x", "+zone=3", "\u{0}"] {
            assert!(Projection::new(text).is_err(), "{text}");
        }
        assert!(of(32611).forward(f64::NAN, 0.0).is_none());
        assert!(of(4326).forward(0.0, 91.0).is_none());
    }
}
