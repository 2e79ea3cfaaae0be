//! The height at a place: the finest surface's, found by decoding the ancestors of one diamond.

#![allow(
    clippy::cast_possible_truncation,
    clippy::cast_possible_wrap,
    clippy::cast_sign_loss,
    reason = "places are checked to lie on the lattice before they become whole numbers"
)]

use crate::inspect::{InspectError, read_page};
use crate::projection::Projection;
use crate::store::{Key, Kind, Store, StoreError};
use diamantina_protocol::NODATA;
use diamantina_protocol::diamond::{Block, Diamond};
use diamantina_protocol::message::{Crs, HeightAnswer, Layer};
use diamantina_protocol::points::{self, DecodeError};
use std::collections::HashMap;

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
/// triangle there. Decodes some tens of diamonds: milliseconds.
///
/// # Errors
/// When the place is outside of the layer or the store is damaged.
pub fn height(
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
        let block = decode(store, number, layer, d, &mut HashMap::new())?;
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

/// Decodes a diamond with its ancestors.
fn decode(
    store: &Store,
    number: u8,
    layer: &Layer,
    d: Diamond,
    done: &mut HashMap<Diamond, Block>,
) -> Result<Block, HeightError> {
    if let Some(block) = done.get(&d) {
        return Ok(block.clone());
    }
    let mut block = Block::empty(&layer.forest, d.level());
    for parent in layer.forest.parents(d) {
        let from = decode(store, number, layer, parent, done)?;
        block.inherit(&layer.forest, d, parent, &from);
    }
    let [a, b] = d.centre();
    let payload = store.get(Key { layer: number, kind: Kind::Points, a, b })?;
    if payload.is_none() {
        // No payload is right only where the index says so.
        let page = diamantina_protocol::index::page_of(&layer.forest, d);
        let entries = read_page(store, number, layer, Kind::Index, page).map_err(|e| match e {
            InspectError::Store(error) => HeightError::Store(error),
            other => HeightError::Damaged(other.to_string()),
        })?;
        if entries.iter().any(|(other, e)| *other == d && e.bytes > 0) {
            return Err(HeightError::Damaged(format!("the points of diamond {:?} are missing", [a, b])));
        }
    }
    points::decode(&layer.forest, &layer.coding, d, &mut block, &payload.unwrap_or_default())?;
    done.insert(d, block.clone());
    Ok(block)
}
