//! What crosses the wire besides geometry: routes, the catalogue, and the frames of a batch.
//!
//! Routes are written and read here only, so that client and server cannot drift apart. The catalogue is
//! JSON (people read it); a batch is a sequence of frames, each a header and a payload.
//!
//! **A stream** is a batch whose list the server makes: of what a [`StreamAsk`] wants, the largest error
//! first. The roots of the whole layer come before all else, and a diamond after its parents, so any prefix
//! of whole frames is a surface. Between the diamonds come pages of the index, each once, before the first
//! diamond that it describes or whose children it describes: so any prefix also tells its own errors.

use crate::bintree::{Forest, Point};
use crate::points::Coding;
use crate::series::Series;
use crate::texture::{Texture, Tile};
use crate::wire::{self, WireError};
use crate::zone::Zone;
use serde::{Deserialize, Serialize};
use std::fmt::Write as _;

/// Most diamonds in one batch; their names keep the request line below 8 kB.
pub const BATCH_MAX: usize = 384;

/// The longest request target that a client sends and a server must take, in bytes.
pub const TARGET_BYTES_MAX: usize = 8000;

/// The largest payload of a diamond, in bytes: every point of the largest block at 32 bits.
pub const PAYLOAD_BYTES_MAX: u32 = 256 << 10;

/// A list of scenes: the answer to `GET /scenes`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Catalogue {
    /// The scenes that this server offers.
    pub scenes: Vec<Scene>,
}

/// A scene: one frame and its layers. The answer to `GET /scenes/{scene}`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Scene {
    /// The name in the address: letters, digits, `-`, `_` and `.`.
    pub name: String,
    /// A hash of the content: everything under it never changes.
    pub version: String,
    /// The planar coordinate system.
    pub frame: Frame,
    /// The surfaces over the frame.
    pub layers: Vec<Layer>,
    /// The regions with a visibility mask.
    #[serde(default)]
    pub zones: Vec<Zone>,
    /// Imagery draped on the terrain. No name of these is a layer's.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub textures: Vec<Texture>,
    /// Surfaces at several times. Each step is one of the layers.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub series: Vec<Series>,
}

impl Scene {
    /// The name by which users choose a layer: its own or, of a step, that of its series.
    #[must_use]
    pub fn chosen_as<'a>(&'a self, layer: &'a str) -> &'a str {
        let series = self.series.iter().find(|series| series.layers.iter().any(|step| step == layer));
        series.map_or(layer, |series| &series.name)
    }

    /// The names by which users choose layers, each once, in the order of layers.
    #[must_use]
    pub fn choices(&self) -> Vec<&str> {
        let mut names: Vec<&str> = Vec::new();
        for layer in &self.layers {
            let name = self.chosen_as(&layer.name);
            // At most 255 layers: looking through them is quick.
            if !names.contains(&name) {
                names.push(name);
            }
        }
        names
    }
}

/// The planar coordinate system of a scene. Coordinates are metres, x east, y north, heights up.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Frame {
    /// The coordinate reference system, if it is known.
    pub crs: Option<Crs>,
    /// Unit of heights; always "metre" so far.
    pub vertical_unit: String,
}

/// A coordinate reference system, and how a layer's lattice lies in it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Crs {
    /// For example "EPSG:32611".
    pub name: String,
    /// The definition as a PROJ string, if it has one.
    pub proj4: Option<String>,
    /// Coordinates, in the system's own units, of frame coordinates (0, 0).
    pub origin: [f64; 2],
    /// Units of the system (metres, feet or degrees) for a metre of the frame, along x and y.
    pub per_metre: [f64; 2],
}

/// What a layer is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Kind {
    /// Solid ground.
    Terrain,
    /// A water surface.
    Water,
}

/// A surface over the frame.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Layer {
    /// The name in the address.
    pub name: String,
    /// Terrain or water.
    pub kind: Kind,
    /// The root squares and patches.
    pub forest: Forest,
    /// Frame coordinates of lattice point (0, 0), in metres.
    pub origin: [f64; 2],
    /// Metres of a lattice step along x and y.
    pub cell: [f64; 2],
    /// Samples of the source along x and y; the rest of the forest has no heights.
    pub samples: [u32; 2],
    /// Samples that have a height.
    pub valid_samples: u64,
    /// Metres of one quantum: a height is `quantum * integer + height_offset`.
    pub quantum: f64,
    /// Metres added to every height.
    pub height_offset: f64,
    /// The lowest and highest height, in metres.
    pub heights: [f64; 2],
    /// The error that was asked of the finest level, in metres: 0 is lossless.
    pub max_error: f64,
    /// The largest error, in metres, of what is drawn where every diamond is split.
    pub finest_error: f32,
    /// Encodings offered: "points", "tin".
    pub encodings: Vec<String>,
    /// How `points` payloads are coded.
    pub coding: Coding,
    /// Bytes of all payloads and index pages.
    pub bytes: u64,
    /// Whether heights were interpolated to the frame's grid.
    pub resampled: bool,
    /// How errors were found: "exact" if each sample was compared at each level.
    pub errors: String,
    /// What there is to know of the encoding `tin`, where it is offered.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub tin: Option<TinLayer>,
}

/// The encoding `tin` of a layer. Its diamonds are those of a forest of its own, over the same lattice: patches are
/// smaller, and no level only adds precision. Its index is its own as well, since other things are drawn.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct TinLayer {
    /// The root squares, as the layer's, and patches.
    pub forest: Forest,
    /// The largest error, in metres, of what is drawn where every diamond is split.
    pub finest_error: f32,
    /// Triangles of all payloads.
    pub triangles: u64,
    /// Bytes of all payloads and index pages.
    pub bytes: u64,
    /// Triangles at which the simplification of a patch stops, above the finest level.
    pub patch_triangles: u32,
    /// By level of diamonds: the largest distance, in metres, between borders along nodata as they are drawn where such a
    /// diamond is not split and the source's. The errors of these diamonds hold it already.
    #[serde(default)]
    pub borders: Vec<f32>,
    /// The order of collapses: "normal" or "quadric".
    pub metric: String,
    /// How much the borders along nodata count in that order.
    pub lambda: f64,
    /// The error at which simplification stops instead, in metres, at the finest level; twice as much every two levels.
    pub patch_error: Option<f64>,
    /// How errors were found: "exact" if each sample was compared at each level.
    pub errors: String,
}

impl Layer {
    /// Frame coordinates of a lattice point, in metres.
    #[must_use]
    pub fn position(&self, [x, y]: Point) -> [f64; 2] {
        [self.origin[0] + self.cell[0] * f64::from(x), self.origin[1] + self.cell[1] * f64::from(y)]
    }

    /// A height in metres.
    #[must_use]
    pub fn metres(&self, height: i32) -> f64 {
        f64::from(height) * self.quantum + self.height_offset
    }
}

/// The answer to a request for a height.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct HeightAnswer {
    /// Frame coordinates, in metres.
    pub x: f64,
    /// Frame coordinates, in metres.
    pub y: f64,
    /// Degrees east and north, where the frame's system is known.
    pub lon: Option<f64>,
    /// See `lon`.
    pub lat: Option<f64>,
    /// Metres; none where the source has no data.
    pub height: Option<f64>,
    /// The height differs from the source by at most this many metres.
    pub error: f64,
    /// Whether the source has no data here.
    pub nodata: bool,
}

/// A problem, as RFC 9457 writes it.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Problem {
    /// A short name of the kind of problem.
    pub title: String,
    /// The HTTP status.
    pub status: u16,
    /// What was wrong and what to do.
    pub detail: String,
}

/// Whether a name may stand in an address and in a path: 1 to 64 of `[A-Za-z0-9._-]`, not starting with
/// a dot.
#[must_use]
pub fn is_name(text: &str) -> bool {
    (1..=64).contains(&text.len())
        && !text.starts_with('.')
        && text.bytes().all(|b| b.is_ascii_alphanumeric() || matches!(b, b'.' | b'_' | b'-'))
}

/// The path of a scene's description.
#[must_use]
pub fn scene_route(scene: &str) -> String {
    format!("/scenes/{scene}")
}

/// The path of a page of the index.
#[must_use]
pub fn index_route(scene: &str, version: &str, layer: &str, page: u32) -> String {
    format!("/scenes/{scene}/{version}/{layer}/index/{page}")
}

/// The path of a zone's masks.
#[must_use]
pub fn zone_route(scene: &str, version: &str, zone: &str) -> String {
    format!("/scenes/{scene}/{version}/zones/{zone}")
}

/// The path of a tile of a texture.
#[must_use]
pub fn tile_route(scene: &str, version: &str, texture: &str, tile: Tile) -> String {
    let Tile { level, x, y } = tile;
    format!("/scenes/{scene}/{version}/{texture}/texture/{level}/{x}/{y}")
}

/// The path of one diamond.
#[must_use]
pub fn points_route(scene: &str, version: &str, layer: &str, [x, y]: Point) -> String {
    format!("/scenes/{scene}/{version}/{layer}/points/{x}/{y}")
}

/// The path of a page of the index of `tin`.
#[must_use]
pub fn tin_index_route(scene: &str, version: &str, layer: &str, page: u32) -> String {
    format!("/scenes/{scene}/{version}/{layer}/tin/index/{page}")
}

/// The path of the triangles of one diamond.
#[must_use]
pub fn tin_route(scene: &str, version: &str, layer: &str, [x, y]: Point) -> String {
    format!("/scenes/{scene}/{version}/{layer}/tin/{x}/{y}")
}

/// The path and query of a batch of diamonds.
#[must_use]
pub fn batch_route(scene: &str, version: &str, layer: &str, centres: &[Point]) -> String {
    batch_of(format!("/scenes/{scene}/{version}/{layer}/points"), centres)
}

/// The path and query of a batch of the triangles of diamonds.
#[must_use]
pub fn tin_batch_route(scene: &str, version: &str, layer: &str, centres: &[Point]) -> String {
    batch_of(format!("/scenes/{scene}/{version}/{layer}/tin"), centres)
}

/// The route with the list of diamonds.
fn batch_of(mut route: String, centres: &[Point]) -> String {
    route.push_str("?d=");
    for (i, [x, y]) in centres.iter().enumerate() {
        // Writing to a String cannot fail.
        let _ = write!(route, "{}{x},{y}", if i == 0 { "" } else { ";" });
    }
    route
}

/// Why text is not a list of diamonds.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum BatchError {
    /// Not `x,y;x,y;...`.
    #[error("'{0}' is not a centre: expected d=x,y;x,y;... with whole numbers")]
    Syntax(String),
    /// Too many.
    #[error("more than {BATCH_MAX} diamonds in one request: send several")]
    Many,
}

/// The centres in the query `d=x,y;x,y;...`. The text may be hostile.
///
/// # Errors
/// When it is not such a list, or too long.
pub fn parse_batch(text: &str) -> Result<Vec<Point>, BatchError> {
    let mut list = Vec::new();
    for item in text.split(';') {
        if list.len() == BATCH_MAX {
            return Err(BatchError::Many);
        }
        let centre = item.split_once(',').and_then(|(x, y)| Some([whole(x)?, whole(y)?]));
        let shown: String = item.chars().take(24).collect();
        list.push(centre.ok_or(BatchError::Syntax(shown))?);
    }
    Ok(list)
}

/// A number in plain decimal digits.
fn whole(text: &str) -> Option<u32> {
    text.bytes().all(|b| b.is_ascii_digit()).then(|| text.parse().ok())?
}

/// The most diamonds in a stream. A client goes on with ordinary requests, or asks for less.
pub const STREAM_MAX: usize = 32 << 10;

/// The most sides of a view.
pub const SIDES_MAX: usize = 8;

/// What a stream shall hold: the diamonds that touch the box, are in view and have a declared error above
/// both bounds, with all their ancestors; and the layer's roots in any case.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct StreamAsk {
    /// `bbox=x0,y0,x1,y1`: the region in the frame's metres, its borders included. None: the whole layer.
    pub bbox: Option<[f64; 4]>,
    /// `error=M`: the declared error, in metres, that needs no refining. 0: down to the finest level, but for
    /// what is exact before.
    pub error: f64,
    /// Where it is seen from, if it is. Then the largest *apparent* error comes first.
    pub view: Option<StreamView>,
    /// `limit=BYTES`: the stream ends with the frame that reaches so many.
    pub limit: Option<u64>,
}

/// Where a stream is seen from: no more of a camera than an order of refinement needs.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct StreamView {
    /// `eye=x,y,z`: in the frame's metres.
    pub eye: [f64; 3],
    /// `angle=A`: the apparent error that needs no refining, in radians: the declared error over the distance
    /// of the eye from the box around the diamond (its square of the frame, its lowest and highest height). A
    /// client that draws P pixels a radian and bears E pixels of error asks for E/P.
    pub angle: f64,
    /// `sides=x,y,z;...`: the half spaces that are seen, at most [`SIDES_MAX`], each through the eye and with
    /// this vector pointing inside. What lies wholly beyond one of them is not in view. None: all around.
    pub sides: Vec<[f64; 3]>,
    /// `vertical=1`: errors of heights count as they are seen, see [`crate::sight`]. `vertical=0`, or nothing: all
    /// count as spheres.
    pub vertical: bool,
}

/// Why parameters do not ask for a stream.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum StreamError {
    /// A value that is none.
    #[error("{name}={found}: expected {expected}")]
    Value {
        /// The parameter.
        name: &'static str,
        /// The value found.
        found: String,
        /// What it must be.
        expected: &'static str,
    },
    /// Not a parameter.
    #[error(
        "'{0}' is no parameter of a stream: expected bbox, error, eye, angle, sides, vertical, limit, each at most once"
    )]
    Name(String),
    /// Half a view.
    #[error(
        "eye= and angle= go together, and sides= and vertical= with them: an order by distance needs all it is made of"
    )]
    View,
}

/// The path and query of a stream.
#[must_use]
pub fn stream_route(scene: &str, version: &str, layer: &str, ask: &StreamAsk) -> String {
    let mut route = format!("/scenes/{scene}/{version}/{layer}/stream?error={}", ask.error);
    // Writing to a String cannot fail.
    if let Some([x0, y0, x1, y1]) = ask.bbox {
        let _ = write!(route, "&bbox={x0},{y0},{x1},{y1}");
    }
    if let Some(StreamView { eye: [x, y, z], angle, sides, vertical }) = &ask.view {
        let _ = write!(route, "&eye={x},{y},{z}&angle={angle}");
        if *vertical {
            route.push_str("&vertical=1");
        }
        for (i, [x, y, z]) in sides.iter().enumerate() {
            let _ = write!(route, "{}{x},{y},{z}", if i == 0 { "&sides=" } else { ";" });
        }
    }
    if let Some(bytes) = ask.limit {
        let _ = write!(route, "&limit={bytes}");
    }
    route
}

/// What the names and values of a query ask for. They may be hostile.
///
/// # Errors
/// When they make no sense.
pub fn parse_stream<'a>(
    pairs: impl IntoIterator<Item = (&'a str, &'a str)>,
) -> Result<StreamAsk, StreamError> {
    let mut ask = StreamAsk::default();
    let (mut seen, mut eye, mut angle, mut sides, mut vertical) = (Vec::new(), None, None, None, None);
    for (name, text) in pairs {
        let fail = |name, expected| StreamError::Value { name, found: excerpt(text), expected };
        if seen.contains(&name) {
            return Err(StreamError::Name(excerpt(name)));
        }
        seen.push(name);
        match name {
            "bbox" => {
                let bbox = finite(text).filter(|[x0, y0, x1, y1]| x0 <= x1 && y0 <= y1);
                let expected = "x0,y0,x1,y1 in metres, with x0 <= x1 and y0 <= y1";
                ask.bbox = Some(bbox.ok_or_else(|| fail("bbox", expected))?);
            }
            "error" => {
                let error = finite(text).filter(|[error]| *error >= 0.0);
                [ask.error] = error.ok_or_else(|| fail("error", "metres, 0 or more"))?;
            }
            "limit" => {
                let bytes = text.parse().ok().filter(|bytes| *bytes > 0);
                ask.limit = Some(bytes.ok_or_else(|| fail("limit", "bytes, 1 or more"))?);
            }
            "eye" => eye = Some(finite(text).ok_or_else(|| fail("eye", "x,y,z in metres"))?),
            "angle" => {
                let value = finite(text).filter(|[angle]| *angle > 0.0);
                let [value] = value.ok_or_else(|| fail("angle", "radians, above 0"))?;
                angle = Some(value);
            }
            "sides" => {
                let expected = "at most 8 vectors x,y,z;x,y,z;... that point inside";
                sides = Some(vectors(text).ok_or_else(|| fail("sides", expected))?);
            }
            "vertical" => {
                let expected = "0 or 1";
                vertical = Some(match text {
                    "0" => false,
                    "1" => true,
                    _ => return Err(fail("vertical", expected)),
                });
            }
            _ => return Err(StreamError::Name(excerpt(name))),
        }
    }
    ask.view = match (eye, angle, sides, vertical) {
        (Some(eye), Some(angle), sides, vertical) => Some(StreamView {
            eye,
            angle,
            sides: sides.unwrap_or_default(),
            vertical: vertical.unwrap_or(false),
        }),
        (None, None, None, None) => None,
        _ => return Err(StreamError::View),
    };
    Ok(ask)
}

/// The beginning of a text, fit for a message.
fn excerpt(text: &str) -> String {
    text.chars().take(40).collect()
}

/// So many finite numbers with commas between.
fn finite<const N: usize>(text: &str) -> Option<[f64; N]> {
    let mut numbers = [0.0; N];
    let mut parts = text.split(',');
    for number in &mut numbers {
        *number = parts.next()?.parse().ok().filter(|n: &f64| n.is_finite())?;
    }
    parts.next().is_none().then_some(numbers)
}

/// Up to [`SIDES_MAX`] vectors, none of them without a direction.
fn vectors(text: &str) -> Option<Vec<[f64; 3]>> {
    let mut list = Vec::new();
    for part in text.split(';') {
        let vector = finite(part).filter(|v: &[f64; 3]| v.iter().any(|x| *x != 0.0))?;
        if list.len() == SIDES_MAX {
            return None;
        }
        list.push(vector);
    }
    Some(list)
}

/// What a frame of a batch or stream holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Status {
    /// The diamond's payload follows. In a stream it may have no bytes: the split adds no height.
    Ok,
    /// There is no such diamond, or it has no payload.
    Missing,
    /// The store's copy is damaged.
    Damaged,
    /// A page of the index follows, as it is stored; only in a stream.
    Page,
}

/// One diamond of a batch, or a diamond or page of a stream.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FrameHeader {
    /// The diamond's centre; of a page its number, and 0.
    pub centre: Point,
    /// What follows.
    pub status: Status,
    /// Bytes that follow.
    pub length: u32,
    /// The low half of the payload's XXH3.
    pub checksum: u32,
}

/// The most bytes that a header takes.
pub const FRAME_HEADER_BYTES_MAX: usize = 21;

/// The checksum of a payload on the wire: the low half of XXH3.
#[must_use]
#[allow(clippy::cast_possible_truncation, reason = "the low half is what is wanted")]
pub fn checksum(payload: &[u8]) -> u32 {
    xxhash_rust::xxh3::xxh3_64(payload) as u32
}

impl FrameHeader {
    /// The header of a payload.
    #[must_use]
    pub fn of(centre: Point, payload: &[u8]) -> Self {
        let length = u32::try_from(payload.len()).unwrap_or(u32::MAX);
        Self { centre, status: Status::Ok, length, checksum: checksum(payload) }
    }

    /// The header of a page of the index.
    #[must_use]
    pub fn of_page(page: u32, blob: &[u8]) -> Self {
        Self { status: Status::Page, ..Self::of([page, 0], blob) }
    }

    /// The header of a diamond that cannot be sent.
    #[must_use]
    pub fn without(centre: Point, status: Status) -> Self {
        Self { centre, status, length: 0, checksum: checksum(&[]) }
    }

    /// Appends the header's bytes.
    pub fn write(&self, out: &mut Vec<u8>) {
        let status = match self.status {
            Status::Ok => 0u8,
            Status::Missing => 1,
            Status::Damaged => 2,
            Status::Page => 3,
        };
        out.extend(wire::to_bytes(&(self.centre, status, self.length, self.checksum)));
    }

    /// The header in front of `bytes` and its length; `None` when more bytes are needed. They may be
    /// hostile.
    ///
    /// # Errors
    /// When no header starts so.
    pub fn read(bytes: &[u8]) -> Result<Option<(Self, usize)>, WireError> {
        type Fields = (Point, u8, u32, u32);
        let ((centre, status, length, checksum), used) = match wire::from_prefix::<64, Fields>(bytes) {
            Ok(read) => read,
            Err(_) if bytes.len() < FRAME_HEADER_BYTES_MAX => return Ok(None),
            Err(e) => return Err(e),
        };
        let status = match status {
            0 => Status::Ok,
            1 => Status::Missing,
            2 => Status::Damaged,
            3 => Status::Page,
            other => return Err(WireError::Damaged(format!("status {other}"))),
        };
        if length > PAYLOAD_BYTES_MAX {
            return Err(WireError::Damaged(format!("payload of {length} bytes, limit {PAYLOAD_BYTES_MAX}")));
        }
        Ok(Some((Self { centre, status, length, checksum }, used)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn a_batch_request_comes_back(centres in prop::collection::vec(any::<[u32; 2]>(), 1..BATCH_MAX)) {
            for route in [batch_route("s", "v", "terrain", &centres), tin_batch_route("s", "v", "terrain", &centres)] {
                prop_assert_eq!(parse_batch(route.split_once("d=").unwrap().1), Ok(centres.clone()));
            }
        }

        #[test]
        fn a_frame_comes_back(x in any::<u32>(), y in any::<u32>(), payload in prop::collection::vec(any::<u8>(), 0..50)) {
            let header = FrameHeader::of([x, y], &payload);
            let mut bytes = Vec::new();
            header.write(&mut bytes);
            prop_assert!(bytes.len() <= FRAME_HEADER_BYTES_MAX);
            for cut in 0..bytes.len() {
                prop_assert_eq!(FrameHeader::read(&bytes[..cut]), Ok(None));
            }
            let used = bytes.len();
            bytes.extend(payload);
            prop_assert_eq!(FrameHeader::read(&bytes), Ok(Some((header, used))));
        }

        #[test]
        fn a_page_comes_back(page in any::<u32>(), blob in prop::collection::vec(any::<u8>(), 0..50)) {
            let header = FrameHeader::of_page(page, &blob);
            let mut bytes = Vec::new();
            header.write(&mut bytes);
            let used = bytes.len();
            prop_assert_eq!(FrameHeader::read(&bytes), Ok(Some((header, used))));
        }

        #[test]
        fn a_stream_request_comes_back(ask in any_stream()) {
            let route = stream_route("s", "v", "terrain", &ask);
            prop_assert_eq!(parse_stream(pairs(route.split_once('?').unwrap().1)), Ok(ask));
        }

        #[test]
        fn any_text_is_a_stream_request_or_an_error(text in "(bbox|error|eye|angle|sides|limit|x)=[-0-9.,;einaf&=]{0,40}.{0,20}") {
            if let Ok(ask) = parse_stream(pairs(&text)) {
                let route = stream_route("s", "v", "l", &ask);
                prop_assert_eq!(parse_stream(pairs(route.split_once('?').unwrap().1)), Ok(ask));
            }
        }

        #[test]
        fn any_text_is_a_batch_or_an_error(text in ".{0,60}") { let _ = parse_batch(&text); }

        #[test]
        fn any_bytes_are_a_frame_or_an_error(bytes in prop::collection::vec(any::<u8>(), 0..40)) {
            if let Ok(Some((header, _))) = FrameHeader::read(&bytes) { prop_assert!(header.length <= PAYLOAD_BYTES_MAX); }
        }
    }

    fn pairs(query: &str) -> impl Iterator<Item = (&str, &str)> {
        query.split('&').map(|pair| pair.split_once('=').unwrap_or((pair, "")))
    }

    fn any_number() -> impl Strategy<Value = f64> {
        prop_oneof![any::<f64>().prop_filter("finite", |x| x.is_finite()), -1e7..1e7]
    }

    fn any_stream() -> impl Strategy<Value = StreamAsk> {
        let direction = [any_number(), any_number(), any_number()];
        let direction = direction.prop_filter("a direction", |v| v.iter().any(|x| *x != 0.0));
        let sides = prop::collection::vec(direction, 0..=SIDES_MAX);
        let positive = any_number().prop_map(f64::abs).prop_filter("above 0", |x| *x > 0.0);
        let view = ([any_number(), any_number(), any_number()], positive, sides, any::<bool>());
        let view = view.prop_map(|(eye, angle, sides, vertical)| StreamView { eye, angle, sides, vertical });
        let bbox = [any_number(), any_number(), any_number(), any_number()];
        let bbox = bbox.prop_map(|[a, b, c, d]| [a.min(c), b.min(d), a.max(c), b.max(d)]);
        let parts = (
            prop::option::of(bbox),
            any_number().prop_map(f64::abs),
            prop::option::of(view),
            prop::option::of(1u64..),
        );
        parts.prop_map(|(bbox, error, view, limit)| StreamAsk { bbox, error, view, limit })
    }

    #[test]
    fn wrong_stream_requests_are_named() {
        assert_eq!(parse_stream([]), Ok(StreamAsk::default()), "the whole layer");
        for (text, word) in [
            ("bbox=1,2,3", "bbox=1,2,3: expected x0,y0,x1,y1"),
            ("bbox=1,2,3,4,5", "x0 <= x1"),
            ("bbox=3,2,1,4", "x0 <= x1"),
            ("bbox=1,4,3,2", "y0 <= y1"),
            ("bbox=1,2,3,nan", "bbox=1,2,3,nan"),
            ("bbox=1,2,3,inf", "x0 <= x1"),
            ("error=nan", "error=nan: expected metres, 0 or more"),
            ("error=-1", "metres"),
            ("error=1e999", "metres"),
            ("error=", "metres"),
            ("error=1&error=2", "at most once"),
            ("limit=0", "bytes, 1 or more"),
            ("limit=-1", "bytes"),
            ("limit=1.5", "bytes"),
            ("eye=1,2,3", "eye= and angle= go together"),
            ("angle=1", "eye= and angle= go together"),
            ("eye=1,2,3&angle=0", "radians, above 0"),
            ("eye=1,2&angle=1", "x,y,z in metres"),
            ("eye=1,2,3&angle=1&sides=0,0,0", "point inside"),
            ("sides=1,0,0", "go together"),
            ("vertical=1", "go together"),
            ("eye=1,2,3&angle=1&vertical=yes", "vertical=yes: expected 0 or 1"),
            ("eror=1", "'eror' is no parameter"),
        ] {
            let error = parse_stream(pairs(text)).unwrap_err().to_string();
            assert!(error.contains(word), "{text}: {error}");
        }
        let many = ["1,0,0"; SIDES_MAX + 1].join(";");
        assert!(parse_stream([("eye", "0,0,0"), ("angle", "1"), ("sides", &many)]).is_err());
        // A long value is not repeated whole.
        assert!(parse_stream([("error", "9,".repeat(5000).as_str())]).unwrap_err().to_string().len() < 200);
    }

    #[test]
    fn wrong_batches_are_named() {
        assert_eq!(parse_batch("1,2;3"), Err(BatchError::Syntax("3".into())));
        assert_eq!(parse_batch("+1,2"), Err(BatchError::Syntax("+1,2".into())));
        assert_eq!(parse_batch(&vec!["1,2"; BATCH_MAX + 1].join(";")), Err(BatchError::Many));
    }

    #[test]
    fn names_cannot_be_paths() {
        assert!(is_name("alps-2.v1_x"));
        for bad in ["", ".", "..", "a/b", "a b", "ä", ".hidden", &"x".repeat(65)] {
            assert!(!is_name(bad), "{bad}");
        }
    }

    #[test]
    fn a_full_batch_fits_a_request_line() {
        // The longest centres of a layer of 2^17 cells: six digits each.
        let route = batch_route(
            &"s".repeat(64),
            &"v".repeat(32),
            &"l".repeat(64),
            &vec![[131_072, 131_072]; BATCH_MAX],
        );
        assert!(route.len() <= TARGET_BYTES_MAX, "{}", route.len());
    }
}
