//! The height at a place: the finest surface's, found by decoding the ancestors of one diamond.

#![allow(
    clippy::cast_possible_truncation,
    clippy::cast_possible_wrap,
    clippy::cast_sign_loss,
    reason = "places are checked to lie on the lattice before they become whole numbers"
)]

use crate::inspect::{InspectError, read_page};
use crate::projection::Projection;
use crate::store::{Key, Kind, Store, StoreError, number};
use bytes::Bytes;
use diamantina_protocol::NODATA;
use diamantina_protocol::diamond::{Block, Diamond};
use diamantina_protocol::message::{Crs, HeightAnswer, Layer};
use diamantina_protocol::points::{self, DecodeError};
use quick_cache::sync::{Cache, DefaultLifecycle};
use quick_cache::{DefaultHashBuilder, OptionsBuilder, Weighter};
use std::collections::HashMap;
use std::sync::Arc;

/// Decoded diamonds of those that were asked about of late, for all who ask: places near one another, a profile's
/// for example, then cost one decoding. Bounded in bytes; keys tell versions of scenes apart.
#[derive(Debug)]
pub struct Decoded(Option<Cache<Name, Arc<Block>, ByBytes>>);

/// A diamond of a layer of a version of a scene; a version is a hash of all its content.
type Name = (u64, u8, Diamond);

#[derive(Debug, Clone)]
struct ByBytes;

impl Weighter<Name, Arc<Block>> for ByBytes {
    fn weight(&self, _: &Name, block: &Arc<Block>) -> u64 {
        // Beside the heights, a key, a place among the others and an allocation.
        size_of_val(block.heights()) as u64 + 128
    }
}

impl Decoded {
    /// Keeps diamonds of at most `budget` bytes; 0 keeps none. One of 64 segments takes 33 kB.
    #[must_use]
    pub fn new(budget: u64) -> Self {
        // One part: diamonds larger than a part's budget are not kept. The number is a hint for the first allocation.
        let options =
            OptionsBuilder::new().weight_capacity(budget).estimated_items_capacity(512).shards(1).clone();
        Self(options.build().ok().filter(|_| budget > 0).map(|options| {
            Cache::with_options(options, ByBytes, DefaultHashBuilder::default(), DefaultLifecycle::default())
        }))
    }
}

/// Why a height cannot be told.
#[derive(Debug, thiserror::Error)]
pub enum HeightError {
    /// The place is not on the layer.
    #[error("({x}, {y}) is outside of the layer, which spans {west} to {east} and {south} to {north}")]
    Outside {
        /// Frame coordinates asked for.
        x: f64,
        /// Frame coordinates asked for.
        y: f64,
        /// The layer's extent.
        west: f64,
        /// The layer's extent.
        east: f64,
        /// The layer's extent.
        south: f64,
        /// The layer's extent.
        north: f64,
    },
    /// Longitude and latitude mean nothing here.
    #[error("this scene's frame has no known projection ({0}): ask with x= and y= in metres")]
    NoProjection(String),
    /// The projection is not defined there.
    #[error("longitude {lon}, latitude {lat} cannot be projected to the frame")]
    Unprojectable {
        /// Degrees east.
        lon: f64,
        /// Degrees north.
        lat: f64,
    },
    /// The store is damaged.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// The index or a payload is damaged.
    #[error("{0}")]
    Damaged(String),
}

impl From<DecodeError> for HeightError {
    fn from(e: DecodeError) -> Self {
        Self::Damaged(e.to_string())
    }
}

fn projection(crs: Option<&Crs>) -> Result<(Projection, &Crs), HeightError> {
    let crs = crs.ok_or_else(|| HeightError::NoProjection("it has no CRS".to_owned()))?;
    let definition = crs.proj4.as_deref().ok_or_else(|| HeightError::NoProjection(crs.name.clone()))?;
    let projection = Projection::new(definition).map_err(|e| HeightError::NoProjection(e.to_string()))?;
    Ok((projection, crs))
}

/// Frame coordinates, in metres, of a longitude and latitude in degrees.
///
/// # Errors
/// When the frame has no projection, or not there.
pub fn to_frame(crs: Option<&Crs>, lon: f64, lat: f64) -> Result<[f64; 2], HeightError> {
    let (projection, crs) = projection(crs)?;
    let (x, y) = projection.forward(lon, lat).ok_or(HeightError::Unprojectable { lon, lat })?;
    // Longitudes of the frame may run from 0 to 360, or beyond 180: this is the same place, counted from its
    // south-west sample.
    let x = if projection.is_geographic() && x < crs.origin[0] - 1e-9 { x + 360.0 } else { x };
    Ok([(x - crs.origin[0]) / crs.per_metre[0], (y - crs.origin[1]) / crs.per_metre[1]])
}

/// The height of a layer at frame coordinates `[x, y]`, on the finest surface: the plane of the bintree
/// triangle there. Decodes some tens of diamonds, milliseconds, unless they are among the `decoded`.
///
/// # Errors
/// When the place is outside of the layer or the store is damaged.
pub fn height(
    decoded: &Decoded,
    store: &Store,
    number: u8,
    layer: &Layer,
    crs: Option<&Crs>,
    [x, y]: [f64; 2],
) -> Result<HeightAnswer, HeightError> {
    let cells = layer.samples.map(|s| f64::from(s - 1));
    let found = [0, 1].map(|axis| in_cells([x, y][axis], layer.origin[axis], layer.cell[axis]));
    let (at, rounding) = (found.map(|f| f.0), found[0].1 + found[1].1);
    if !(0.0..=cells[0]).contains(&at[0]) || !(0.0..=cells[1]).contains(&at[1]) {
        let [west, south] = layer.origin;
        let (east, north) = (west + cells[0] * layer.cell[0], south + cells[1] * layer.cell[1]);
        return Err(HeightError::Outside { x, y, west, east, south, north });
    }
    let size = layer.forest.size();
    let cell: [u32; 2] = std::array::from_fn(|axis| (at[axis] as u32).min(size[axis] - 1));
    let within = [at[0] - f64::from(cell[0]), at[1] - f64::from(cell[1])];
    let [i, j] = cell;
    // The triangle of the cell: corners in order, with their weights.
    let ([s, t], rising) = (within, (i + j).is_multiple_of(2));
    let corners = match (rising, if rising { s >= t } else { s + t <= 1.0 }) {
        (true, true) => [([i, j], 1.0 - s), ([i + 1, j], s - t), ([i + 1, j + 1], t)],
        (true, false) => [([i, j], 1.0 - t), ([i, j + 1], t - s), ([i + 1, j + 1], s)],
        (false, true) => [([i, j], 1.0 - s - t), ([i + 1, j], s), ([i, j + 1], t)],
        (false, false) => [([i + 1, j], 1.0 - t), ([i, j + 1], 1.0 - s), ([i + 1, j + 1], s + t - 1.0)],
    };
    // Told by the centroid of the small triangle: a sample may lie on a side of a diamond's triangles, a centroid
    // never does, and all three corners are then in one diamond's block.
    let centroid = [0, 1].map(|axis| corners.iter().map(|(c, _)| f64::from(c[axis])).sum::<f64>() / 3.0);
    let mut height = Some(0.0);
    if let Some(d) = finest(layer, centroid) {
        let block = Decoder { decoded, store, number, layer, done: HashMap::new() }.decode(d)?;
        let local = layer.forest.local(d);
        for (corner, weight) in corners {
            let [p, q] = local.local2(corner.map(i64::from));
            let h = block.heights()[Block::slot(block.segments(), p as usize, q as usize)];
            let part = (h != NODATA).then(|| f64::from(h) * weight);
            // A corner without weight, but for rounding, has no say: on an edge, what lies beyond may be nodata.
            height = match (height, part) {
                (Some(sum), Some(part)) => Some(sum + part),
                (Some(sum), None) if weight <= rounding => Some(sum),
                _ => None,
            };
        }
    } else {
        return Err(HeightError::Damaged(format!("no diamond at {centroid:?}")));
    }
    let lonlat = projection(crs).ok().and_then(|(projection, crs)| projection.lonlat(crs, [x, y]));
    let metres = height.map(|h| h * layer.quantum + layer.height_offset);
    Ok(HeightAnswer {
        x,
        y,
        lon: lonlat.map(|[lon, _]| lon),
        lat: lonlat.map(|[_, lat]| lat),
        height: metres,
        error: f64::from(layer.finest_error),
        nodata: metres.is_none(),
    })
}

/// A coordinate in cells from the first sample, and how far off rounding may have put it. What is a sample but
/// for rounding is that sample: else the last one would lie outside.
fn in_cells(coordinate: f64, origin: f64, cell: f64) -> (f64, f64) {
    let at = (coordinate - origin) / cell;
    // Of the place of the sample, of the caller's sum, and of the two operations above: half an ulp each.
    let rounding = 2.0 * f64::EPSILON * (coordinate.abs().max(origin.abs()) / cell + at.abs());
    (if (at - at.round()).abs() <= rounding { at.round() } else { at }, rounding)
}

/// The diamond whose split draws the finest triangle around a place, in cells, that is on no triangle's side.
fn finest(layer: &Layer, place: [f64; 2]) -> Option<Diamond> {
    let forest = &layer.forest;
    let half = 1u32 << (forest.root_log2() - 1);
    let roots = forest.roots();
    let centre = [0, 1].map(|axis| {
        let root = (place[axis] as u32 >> forest.root_log2()).min(roots[axis] - 1);
        (2 * root + 1) * half
    });
    let mut d = forest.diamond(centre)?;
    loop {
        // Of the four triangles of the split, the one that lies on the place's side of both diagonals.
        let local = forest.local(d);
        let along = |e: [i64; 2]| {
            let w = [0, 1].map(|axis| place[axis] - local.origin[axis] as f64);
            (w[0] * e[0] as f64 + w[1] * e[1] as f64) / (e[0] * e[0] + e[1] * e[1]) as f64
        };
        let (u, v) = (along(local.u), along(local.v));
        let side = match (u > v, u + v > forest.segments_at(d.level()) as f64) {
            (true, false) => 0,
            (true, true) => 1,
            (false, true) => 2,
            (false, false) => 3,
        };
        match forest.children(d)[side] {
            Some(child) => d = child,
            None => return Some(d),
        }
    }
}

/// Decodes diamonds for one answer.
struct Decoder<'a> {
    decoded: &'a Decoded,
    store: &'a Store,
    number: u8,
    layer: &'a Layer,
    /// What this answer needed so far, however little is kept for others.
    done: HashMap<Diamond, Arc<Block>>,
}

impl Decoder<'_> {
    /// Decodes a diamond with its ancestors.
    fn decode(&mut self, d: Diamond) -> Result<Arc<Block>, HeightError> {
        if let Some(block) = self.done.get(&d) {
            return Ok(Arc::clone(block));
        }
        let name = (number(&self.store.scene().version), self.number, d);
        if let Some(block) = self.decoded.0.as_ref().and_then(|kept| kept.get(&name)) {
            return Ok(block);
        }
        let forest = &self.layer.forest;
        let mut block = Block::empty(forest, d.level());
        for parent in forest.parents(d) {
            block.inherit(forest, d, parent, &*self.decode(parent)?);
        }
        points::decode(forest, &self.layer.coding, d, &mut block, &self.payload(d)?)?;
        let block = Arc::new(block);
        self.done.insert(d, Arc::clone(&block));
        if let Some(kept) = &self.decoded.0 {
            kept.insert(name, Arc::clone(&block));
        }
        Ok(block)
    }

    /// The payload of a diamond, which is empty where the index says so.
    fn payload(&self, d: Diamond) -> Result<Bytes, HeightError> {
        let [a, b] = d.centre();
        if let Some(payload) = self.store.get(Key { layer: self.number, kind: Kind::Points, a, b })? {
            return Ok(payload);
        }
        let page = diamantina_protocol::index::page_of(&self.layer.forest, d);
        let entries =
            read_page(self.store, self.number, self.layer, Kind::Index, page).map_err(|e| match e {
                InspectError::Store(error) => HeightError::Store(error),
                other => HeightError::Damaged(other.to_string()),
            })?;
        if entries.iter().any(|(other, e)| *other == d && e.bytes > 0) {
            return Err(HeightError::Damaged(format!("the points of diamond {:?} are missing", [a, b])));
        }
        Ok(Bytes::new())
    }
}
