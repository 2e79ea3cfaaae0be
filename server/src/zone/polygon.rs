//! The polygons of a zone: read from GeoJSON (RFC 7946), checked, in the frame's metres.
//!
//! Where the scene's frame has a projection, coordinates are longitude and latitude in degrees, as the RFC says;
//! where it has none, they are the frame's own metres, since degrees would mean nothing. Either can be asked
//! for. Edges are straight in the frame.

use crate::height::{HeightError, to_frame};
use crate::projection::Projection;
use diamantina_protocol::message::Crs;
use diamantina_protocol::zone::{CORNERS_MAX, Part};
use geojson::{GeoJson, Geometry, GeometryValue, Position};
use std::path::{Path, PathBuf};

/// The largest file, in bytes.
const FILE_BYTES_MAX: u64 = 64 << 20;

/// The outline and the holes of a polygon, in the frame's metres; first corners are not repeated.
pub type Rings = Vec<Vec<[f64; 2]>>;

/// What the numbers of a file mean.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum Coordinates {
    /// Degrees where the scene has a projection, else the frame's metres
    Auto,
    /// Degrees of longitude and latitude
    Lonlat,
    /// The frame's metres
    Frame,
}

/// Why a file is no zone.
#[derive(Debug, thiserror::Error)]
pub enum PolygonError {
    /// It cannot be read.
    #[error("{path}: cannot read: {error}")]
    File {
        /// The file.
        path: PathBuf,
        /// What the system said.
        error: std::io::Error,
    },
    /// It is too long.
    #[error("{path}: more than {FILE_BYTES_MAX} bytes, expected the outline of a zone: simplify it")]
    Long {
        /// The file.
        path: PathBuf,
    },
    /// It is not GeoJSON.
    #[error(
        "{path}: not GeoJSON ({reason}): expected a Polygon or MultiPolygon, alone or in features (RFC 7946)"
    )]
    Syntax {
        /// The file.
        path: PathBuf,
        /// What the parser said.
        reason: String,
    },
    /// Something else than polygons.
    #[error("{path}: found a {found}, expected polygons only: a road needs an outline, too")]
    Kind {
        /// The file.
        path: PathBuf,
        /// What it is.
        found: String,
    },
    /// Nothing in it.
    #[error("{path}: no polygon in it: expected a Polygon or MultiPolygon, alone or in features")]
    Empty {
        /// The file.
        path: PathBuf,
    },
    /// A polygon of nothing.
    #[error("{path}: polygon {polygon} has no ring: give it its outline, or leave it out")]
    NoRing {
        /// The file.
        path: PathBuf,
        /// From 1.
        polygon: usize,
    },
    /// A coordinate system of its own.
    #[error(
        "{path}: has coordinates in {found}: convert it to longitude and latitude (RFC 7946 has no other)"
    )]
    Crs {
        /// The file.
        path: PathBuf,
        /// What it says.
        found: String,
    },
    /// A ring that is none.
    #[error("{path}: ring {ring} {what}")]
    Ring {
        /// The file.
        path: PathBuf,
        /// From 1, over all polygons.
        ring: usize,
        /// What is wrong, and what to do.
        what: String,
    },
    /// Edges cross.
    #[error(
        "{path}: edges cross near ({x:.3}, {y:.3}) in the frame's metres: expected rings that touch neither \
         themselves nor one another; repair it, for instance with a buffer of width 0"
    )]
    Crossing {
        /// The file.
        path: PathBuf,
        /// Where.
        x: f64,
        /// Where.
        y: f64,
    },
    /// Too many corners.
    #[error("{path}: {found} corners, at most {CORNERS_MAX}: simplify it")]
    Corners {
        /// The file.
        path: PathBuf,
        /// How many.
        found: usize,
    },
    /// The numbers cannot be degrees.
    #[error(
        "{path}: ({x}, {y}) is no longitude and latitude in degrees: if these are metres of the scene's frame, say \
         --coordinates frame"
    )]
    Degrees {
        /// The file.
        path: PathBuf,
        /// The first number.
        x: f64,
        /// The second.
        y: f64,
    },
    /// No projection to the frame.
    #[error("{path}: {error}, and say --coordinates frame")]
    Projection {
        /// The file.
        path: PathBuf,
        /// Why not.
        error: HeightError,
    },
}

/// Reads the polygons of a zone. `crs` is that of the scene's frame. The file may be hostile.
///
/// # Errors
/// When it cannot be read or holds no proper polygons.
pub fn read(path: &Path, crs: Option<&Crs>, coordinates: Coordinates) -> Result<Vec<Rings>, PolygonError> {
    let file_error = |error| PolygonError::File { path: path.to_owned(), error };
    if std::fs::metadata(path).map_err(file_error)?.len() > FILE_BYTES_MAX {
        return Err(PolygonError::Long { path: path.to_owned() });
    }
    let text = std::fs::read_to_string(path).map_err(file_error)?;
    parse(&text, path, crs, coordinates)
}

/// The polygons in a text; `path` is for messages.
fn parse(
    text: &str,
    path: &Path,
    crs: Option<&Crs>,
    coordinates: Coordinates,
) -> Result<Vec<Rings>, PolygonError> {
    let syntax =
        |e: &dyn std::fmt::Display| PolygonError::Syntax { path: path.to_owned(), reason: e.to_string() };
    let value: serde_json::Value = serde_json::from_str(text).map_err(|e| syntax(&e))?;
    refuse_crs(&value, path)?;
    let parsed: GeoJson = serde_json::from_value(value).map_err(|e| syntax(&e))?;
    let mut found = Vec::new();
    let mut add = |geometry: &Geometry| collect(geometry, path, &mut found);
    match &parsed {
        GeoJson::Geometry(geometry) => add(geometry)?,
        GeoJson::Feature(feature) => feature.geometry.iter().try_for_each(add)?,
        GeoJson::FeatureCollection(all) => {
            all.features.iter().filter_map(|f| f.geometry.as_ref()).try_for_each(add)?;
        }
    }
    if found.is_empty() {
        return Err(PolygonError::Empty { path: path.to_owned() });
    }
    let corners = found.iter().flatten().map(Vec::len).sum();
    if corners > CORNERS_MAX {
        return Err(PolygonError::Corners { path: path.to_owned(), found: corners });
    }
    let reader = Reader { path, crs, degrees: are_degrees(crs, coordinates) };
    let mut number = 0;
    let mut polygons = Vec::with_capacity(found.len());
    for polygon in found {
        if polygon.is_empty() {
            return Err(PolygonError::NoRing { path: path.to_owned(), polygon: polygons.len() + 1 });
        }
        let (mut rings, first) = (Vec::with_capacity(polygon.len()), number + 1);
        for ring in &polygon {
            number += 1;
            rings.push(reader.ring(ring, number)?);
        }
        refuse_crossings(&rings, path)?;
        refuse_what_is_no_hole(&rings, first, path)?;
        polygons.push(rings);
    }
    Ok(polygons)
}

/// Files of the older specification may name a system of their own.
fn refuse_crs(value: &serde_json::Value, path: &Path) -> Result<(), PolygonError> {
    let Some(crs) = value.get("crs").filter(|crs| !crs.is_null()) else { return Ok(()) };
    let name =
        crs.pointer("/properties/name").and_then(serde_json::Value::as_str).unwrap_or("an unknown system");
    if name.ends_with("CRS84") || name.ends_with(":4326") {
        return Ok(());
    }
    Err(PolygonError::Crs { path: path.to_owned(), found: name.chars().take(80).collect() })
}

type Polygon = Vec<Vec<Position>>;

fn collect(geometry: &Geometry, path: &Path, found: &mut Vec<Polygon>) -> Result<(), PolygonError> {
    match &geometry.value {
        GeometryValue::Polygon { coordinates } => found.push(coordinates.clone()),
        GeometryValue::MultiPolygon { coordinates } => found.extend(coordinates.iter().cloned()),
        GeometryValue::GeometryCollection { geometries } => {
            geometries.iter().try_for_each(|geometry| collect(geometry, path, found))?;
        }
        other => {
            return Err(PolygonError::Kind { path: path.to_owned(), found: other.type_name().to_owned() });
        }
    }
    Ok(())
}

fn are_degrees(crs: Option<&Crs>, coordinates: Coordinates) -> bool {
    match coordinates {
        Coordinates::Lonlat => true,
        Coordinates::Frame => false,
        Coordinates::Auto => {
            crs.and_then(|crs| crs.proj4.as_deref()).is_some_and(|p| Projection::new(p).is_ok())
        }
    }
}

struct Reader<'a> {
    path: &'a Path,
    crs: Option<&'a Crs>,
    degrees: bool,
}

impl Reader<'_> {
    /// A ring in the frame's metres, to the millimetre, without corners that repeat the one before.
    fn ring(&self, positions: &[Position], number: usize) -> Result<Vec<[f64; 2]>, PolygonError> {
        let wrong = |what: &str| PolygonError::Ring {
            path: self.path.to_owned(),
            ring: number,
            what: what.to_owned(),
        };
        if positions.first() != positions.last() {
            return Err(wrong("does not end where it begins: repeat its first position at its end"));
        }
        let mut ring: Vec<[f64; 2]> = Vec::with_capacity(positions.len());
        for position in positions.iter().skip(1) {
            let [x, y, ..] = position.as_slice() else {
                return Err(wrong("has a position of less than two numbers"));
            };
            let corner = self.place(*x, *y)?.map(|w| (w * 1e3).round() / 1e3);
            if !corner.iter().all(|w| w.is_finite()) {
                return Err(wrong("has a position that is not a number"));
            }
            if ring.last() != Some(&corner) {
                ring.push(corner);
            }
        }
        if ring.len() > 1 && ring.first() == ring.last() {
            ring.pop();
        }
        let area: f64 = edges(&ring).map(|[a, b]| a[0] * b[1] - b[0] * a[1]).sum();
        if ring.len() < 3 || area == 0.0 {
            return Err(wrong(
                "has no area: expected three corners at least, in the order in which they follow",
            ));
        }
        Ok(ring)
    }

    fn place(&self, x: f64, y: f64) -> Result<[f64; 2], PolygonError> {
        if !self.degrees {
            return Ok([x, y]);
        }
        if x.abs() > 360.0 || y.abs() > 90.0 {
            return Err(PolygonError::Degrees { path: self.path.to_owned(), x, y });
        }
        to_frame(self.crs, x, y)
            .map_err(|error| PolygonError::Projection { path: self.path.to_owned(), error })
    }
}

/// The edges of a ring.
pub fn edges(ring: &[[f64; 2]]) -> impl Iterator<Item = [[f64; 2]; 2]> + '_ {
    ring.iter().zip(ring.iter().cycle().skip(1)).map(|(a, b)| [*a, *b])
}

/// Refuses rings whose edges cross or touch, but for neighbours at their corner. Edges are looked at in order of
/// their least x, against those that begin before they end.
fn refuse_crossings(rings: &[Vec<[f64; 2]>], path: &Path) -> Result<(), PolygonError> {
    let mut all: Vec<[[f64; 2]; 2]> = rings.iter().flat_map(|ring| edges(ring)).collect();
    let west = |edge: &[[f64; 2]; 2]| edge[0][0].min(edge[1][0]);
    all.sort_by(|a, b| west(a).total_cmp(&west(b)));
    for (i, one) in all.iter().enumerate() {
        let east = one[0][0].max(one[1][0]);
        for other in all[i + 1..].iter().take_while(|other| west(other) <= east) {
            if do_cross(one, other) {
                let [x, y] = one[0];
                return Err(PolygonError::Crossing { path: path.to_owned(), x, y });
            }
        }
    }
    Ok(())
}

/// Refuses rings behind the first one of a polygon, which has the number `first`, that are no holes: those that do not lie
/// in it, or lie in another hole. Of rings that do not cross one corner tells.
fn refuse_what_is_no_hole(rings: &Rings, first: usize, path: &Path) -> Result<(), PolygonError> {
    let alone = |ring: &Vec<[f64; 2]>| Part { ceiling: f64::INFINITY, rings: vec![ring.clone()] };
    let parts: Vec<Part> = rings.iter().map(alone).collect();
    for (i, ring) in rings.iter().enumerate().skip(1) {
        let [x, y] = ring[0];
        let within = |part: &Part| part.covers([x, y]);
        let mut others = parts.iter().enumerate().skip(1).filter(|(j, _)| *j != i);
        let what = if !within(&parts[0]) {
            format!(
                "is no hole: it lies outside of ring {first}, the outline; if it is land of its own, make it a polygon of a MultiPolygon"
            )
        } else if let Some((j, _)) = others.find(|(_, part)| within(part)) {
            format!("lies in ring {}, which is a hole: make it a polygon of a MultiPolygon", first + j)
        } else {
            continue;
        };
        return Err(PolygonError::Ring { path: path.to_owned(), ring: first + i, what });
    }
    Ok(())
}

/// Twice the area of a triangle, positive where it turns left.
fn turn(a: [f64; 2], b: [f64; 2], c: [f64; 2]) -> f64 {
    (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
}

fn do_cross([a, b]: &[[f64; 2]; 2], [c, d]: &[[f64; 2]; 2]) -> bool {
    let neighbours = if a == d {
        Some((c, b, a))
    } else if b == c {
        Some((d, a, b))
    } else {
        None
    };
    if let Some((p, q, corner)) = neighbours {
        // Neighbours share a corner, and no more unless one runs back along the other.
        let back = (p[0] - corner[0]) * (q[0] - corner[0]) + (p[1] - corner[1]) * (q[1] - corner[1]) > 0.0;
        return turn(*p, *corner, *q) == 0.0 && back;
    }
    let sides = [turn(*a, *b, *c), turn(*a, *b, *d), turn(*c, *d, *a), turn(*c, *d, *b)];
    let apart = |s: f64, t: f64| (s > 0.0 && t > 0.0) || (s < 0.0 && t < 0.0);
    if sides == [0.0; 4] {
        // On one line: they cross if they overlap.
        return (0..2).all(|k| a[k].min(b[k]) <= c[k].max(d[k]) && c[k].min(d[k]) <= a[k].max(b[k]));
    }
    !apart(sides[0], sides[1]) && !apart(sides[2], sides[3])
}

/// Points along all rings, at most `spacing` apart along each, three a ring at least.
#[must_use]
pub fn contour(rings: &[Vec<[f64; 2]>], spacing: f64) -> Vec<[f64; 2]> {
    let mut points = Vec::new();
    for ring in rings {
        let lengths: Vec<f64> = edges(ring).map(|[a, b]| (b[0] - a[0]).hypot(b[1] - a[1])).collect();
        let length: f64 = lengths.iter().sum();
        let count = (length / spacing).ceil().max(3.0);
        let (mut walked, mut next) = (0.0, 0.0);
        for ([a, b], edge) in edges(ring).zip(&lengths) {
            while next < walked + edge && next < length * (1.0 - 1e-9) {
                let part = (next - walked) / edge;
                points.push([0, 1].map(|k| a[k] + (b[k] - a[k]) * part));
                next += length / count;
            }
            walked += edge;
        }
    }
    points
}

/// Metres around all rings.
#[must_use]
pub fn perimeter(rings: &[Vec<[f64; 2]>]) -> f64 {
    rings.iter().flat_map(|ring| edges(ring)).map(|[a, b]| (b[0] - a[0]).hypot(b[1] - a[1])).sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::projection::epsg;
    use proptest::prelude::*;

    fn frame(text: &str) -> Result<Vec<Rings>, PolygonError> {
        parse(text, Path::new("zone.geojson"), None, Coordinates::Auto)
    }

    fn square(text: &str) -> String {
        format!(r#"{{"type":"Polygon","coordinates":[{text}]}}"#)
    }

    const SQUARE: &str = "[[0,0],[10,0],[10,10],[0,10],[0,0]]";

    #[test]
    fn polygons_are_found_wherever_they_may_stand() {
        let polygon = square(SQUARE);
        let feature = format!(r#"{{"type":"Feature","properties":{{}},"geometry":{polygon}}}"#);
        let expected = vec![vec![[10.0, 0.0], [10.0, 10.0], [0.0, 10.0], [0.0, 0.0]]];
        for text in [
            polygon.clone(),
            feature.clone(),
            format!(r#"{{"type":"FeatureCollection","features":[{feature}]}}"#),
            format!(r#"{{"type":"GeometryCollection","geometries":[{polygon}]}}"#),
            format!(r#"{{"type":"MultiPolygon","coordinates":[[{SQUARE}]]}}"#),
        ] {
            assert_eq!(frame(&text).unwrap(), vec![expected.clone()], "{text}");
        }
        let holed = square(&format!("{SQUARE},[[2,2],[2,4],[4,4],[2,2]]"));
        assert_eq!(frame(&holed).unwrap()[0].len(), 2);
    }

    #[test]
    fn what_is_no_zone_is_named() {
        for (text, word) in [
            ("{", "not GeoJSON"),
            (r#"{"type":"Polygon"}"#, "not GeoJSON"),
            (r#"{"type":"Point","coordinates":[1,2]}"#, "found a Point"),
            (r#"{"type":"FeatureCollection","features":[]}"#, "no polygon in it"),
            (r#"{"type":"MultiPolygon","coordinates":[]}"#, "no polygon in it"),
            (&square("[[0,0],[10,0],[10,10],[0,10]]"), "ring 1 does not end where it begins"),
            (&square("[[0,0],[10,0],[20,0],[0,0]]"), "no area"),
            (&square("[[0,0],[0,0],[0,0],[0,0]]"), "no area"),
            (&square("[]"), "no area"),
            (&square("[[0],[1],[2],[0]]"), "less than two numbers"),
            (&square(""), "polygon 1 has no ring"),
            (&format!(r#"{{"type":"MultiPolygon","coordinates":[[{SQUARE}],[]]}}"#), "polygon 2 has no ring"),
            (
                &square(&format!("{SQUARE},[[22,2],[22,4],[24,4],[22,2]]")),
                "ring 2 is no hole: it lies outside",
            ),
            (
                &square(&format!("{SQUARE},[[2,2],[2,8],[8,8],[8,2],[2,2]],[[4,4],[4,5],[5,5],[4,4]]")),
                "ring 3 lies in ring 2",
            ),
            (&square("[[0,0],[10,10],[10,0],[0,30],[0,0]]"), "edges cross"),
            (&square(&format!("{SQUARE},[[5,5],[20,5],[5,6],[5,5]]")), "edges cross"),
            (&square("[[0,0],[10,0],[10,10],[10,0],[0,10],[0,0]]"), "edges cross"),
            (
                &format!(
                    r#"{{"type":"Polygon","crs":{{"properties":{{"name":"EPSG:2056"}}}},"coordinates":[{SQUARE}]}}"#
                ),
                "coordinates in EPSG:2056",
            ),
        ] {
            let error = frame(text).unwrap_err().to_string();
            assert!(error.contains(word) && error.contains("zone.geojson"), "{text}: {error}");
        }
        let many = (0..CORNERS_MAX).map(|i| format!("[{i},{}],", i * i)).collect::<String>();
        let error = frame(&square(&format!("[{many}[0,9],[0,0]]"))).unwrap_err().to_string();
        assert!(error.contains("corners, at most"), "{error}");
    }

    #[test]
    fn degrees_and_metres_are_not_mixed_up() {
        let crs = Crs {
            name: "EPSG:32632".into(),
            proj4: epsg(32632).map(str::to_owned),
            origin: [400_000.0, 5_000_000.0],
            per_metre: [1.0, 1.0],
        };
        let path = Path::new("zone.geojson");
        let degrees = square("[[9,46],[9.1,46],[9.1,46.1],[9,46.1],[9,46]]");
        let rings = parse(&degrees, path, Some(&crs), Coordinates::Auto).unwrap();
        // 9 degrees east is the central meridian.
        let [x, y] = *rings[0][0].last().unwrap();
        assert!((x - 100_000.0).abs() < 1.0 && (94_000.0..96_000.0).contains(&y), "{x} {y}");
        assert_eq!(parse(&degrees, path, Some(&crs), Coordinates::Frame).unwrap()[0][0][0], [9.1, 46.0]);
        let metres = square("[[1000,1000],[2000,1000],[2000,2000],[1000,1000]]");
        let error = parse(&metres, path, Some(&crs), Coordinates::Auto).unwrap_err().to_string();
        assert!(error.contains("(2000, 1000)") && error.contains("--coordinates frame"), "{error}");
        let error = parse(&degrees, path, None, Coordinates::Lonlat).unwrap_err().to_string();
        assert!(error.contains("no known projection"), "{error}");
    }

    proptest! {
        #[test]
        fn points_of_a_contour_lie_on_it_no_farther_apart_than_asked(
            corners in prop::collection::vec([-1e4..1e4f64, -1e4..1e4f64], 3..12),
            spacing in 10.0..3e4f64,
        ) {
            let rings = vec![corners];
            let points = contour(&rings, spacing);
            prop_assert!(points.len() >= 3);
            let expected = (perimeter(&rings) / spacing).ceil().max(3.0);
            prop_assert!((points.len() as f64 - expected).abs() < 1.5, "{} for {}", points.len(), expected);
            for p in &points {
                let near = edges(&rings[0]).map(|[a, b]| {
                    let along = [b[0] - a[0], b[1] - a[1]];
                    let squared = along[0].powi(2) + along[1].powi(2);
                    let t = ((p[0] - a[0]) * along[0] + (p[1] - a[1]) * along[1]) / squared.max(1e-9);
                    let t = t.clamp(0.0, 1.0);
                    (p[0] - a[0] - along[0] * t).hypot(p[1] - a[1] - along[1] * t)
                });
                prop_assert!(near.fold(f64::INFINITY, f64::min) < 1e-6);
            }
        }

        #[test]
        fn any_text_is_polygons_or_an_error(text in "[\\[\\]{}\":,0-9a-zA-Z .-]{0,80}") {
            let _ = frame(&text);
        }

        #[test]
        fn stars_do_not_cross_themselves(radii in prop::collection::vec(10.0..100.0f64, 4..20)) {
            let at = |i: usize| {
                let angle = i as f64 / radii.len() as f64 * std::f64::consts::TAU;
                [radii[i] * angle.cos(), radii[i] * angle.sin()]
            };
            let ring: Vec<[f64; 2]> = (0..radii.len()).map(at).collect();
            prop_assert!(refuse_crossings(std::slice::from_ref(&ring), Path::new("")).is_ok());
            let part = Part { ceiling: 0.0, rings: vec![ring] };
            prop_assert!(part.covers([0.0, 0.0]));
        }
    }
}
