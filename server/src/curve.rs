//! The progressive curve of a layer: how far the surface is from the truth after each prefix of its stream.
//!
//! What a split draws does not depend on what else is split, so each of its triangles is compared once with
//! the samples under it, level by level; then the stream of the whole layer is replayed, and each diamond
//! trades the two triangles that it splits for the four that it draws. Sums are kept in whole numbers, so that
//! adding and taking away leaves nothing behind.
//!
//! The truth is the finest surface of the store, which passes through the samples where the layer is lossless.
//! Every sample counts once: on a shared side it belongs to whichever triangle it would fall into if it were
//! moved a hair's breadth to the east and far less to the north (on the forest's far borders: the other way).

#![allow(
    clippy::cast_possible_truncation,
    clippy::cast_possible_wrap,
    clippy::cast_sign_loss,
    reason = "lattice coordinates are below 2^28, local ones at most 256, and sums below 2^120"
)]

use crate::inspect::{InspectError, decode_levels, entries};
use crate::store::Store;
use crate::stream::{Stream, Subject};
use diamantina_protocol::NODATA;
use diamantina_protocol::diamond::{Block, Diamond, Local};
use diamantina_protocol::index::Entry;
use diamantina_protocol::message::{Layer, StreamAsk};
use rayon::prelude::*;
use std::collections::{BTreeMap, HashMap};
use std::io::{self, Write};
use std::sync::Arc;

/// Squares of quanta are counted in units of 2^-32.
const UNIT: f64 = (1u64 << 32) as f64;

/// A point of the curve: what holds after a prefix of the stream.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Row {
    /// Bytes of the answer.
    pub bytes: u64,
    /// Diamonds in it.
    pub diamonds: u64,
    /// The largest error, in metres, that the index declares of what is drawn.
    pub declared: f64,
    /// The largest vertical distance from the truth, in metres.
    pub max: f64,
    /// The root of the mean square of the distances, in metres.
    pub rms: f64,
    /// Samples where both the surface and the truth have a height: those compared.
    pub compared: u64,
    /// Samples where the truth alone has one.
    pub missing: u64,
    /// Samples where the surface alone has one.
    pub surplus: u64,
}

/// What a layer's curve is measured against.
#[must_use]
pub fn truth(layer: &Layer) -> String {
    match layer.finest_error {
        0.0 => "samples".to_owned(),
        error => format!("finest surface (within {error} m of the samples)"),
    }
}

/// Writes the curves of all layers as CSV: a row at each drop of the largest declared error.
///
/// # Errors
/// When the store is damaged, or the rows cannot be written.
pub fn write(store: &Arc<Store>, out: &mut impl Write) -> Result<io::Result<()>, InspectError> {
    let mut text = String::from(
        "layer,compared_with,bytes,diamonds,declared_error_m,max_error_m,rms_error_m,samples_compared,samples_missing,samples_surplus\n",
    );
    for (number, layer) in store.scene().layers.iter().enumerate() {
        let truth = truth(layer);
        for r in curve(store, u8::try_from(number).unwrap_or(u8::MAX), layer)? {
            text += &format!(
                "{},{truth},{},{},{},{},{},{},{},{}\n",
                layer.name, r.bytes, r.diamonds, r.declared, r.max, r.rms, r.compared, r.missing, r.surplus
            );
        }
    }
    Ok(out.write_all(text.as_bytes()))
}

/// The curve of a layer, from its roots down to its finest surface. For layers that fit in memory: 4 bytes a
/// sample besides what [`decode_levels`] takes.
///
/// # Errors
/// When the store is damaged.
pub fn curve(store: &Arc<Store>, number: u8, layer: &Layer) -> Result<Vec<Row>, InspectError> {
    let entries = entries(store, number, layer)?;
    let grid = Grid::read(store, number, layer, &entries)?;
    let mut drawn: HashMap<Diamond, [Found; 4]> = HashMap::new();
    decode_levels(store, number, layer, &entries, |_, blocks| {
        drawn.par_extend(blocks.par_iter().map(|(d, block, _)| (*d, grid.compare(layer, *d, block))));
    })?;
    let mut stream = Stream::new(Arc::clone(store), number, layer, StreamAsk::default(), usize::MAX);
    let finest = f64::from(layer.finest_error);
    let (mut sum, mut rows) = (Sum::default(), Vec::new());
    let (mut bytes, mut bytes_here, mut diamonds, mut declared) = (0, 0, 0, f64::INFINITY);
    while let Some(frame) = stream.next_frame()? {
        bytes += frame.bytes.len() as u64;
        let Subject::Diamond(d) = frame.subject else { continue };
        let error = f64::from(entries.get(&d).map_or(0.0, |e| e.error_metres)).max(finest);
        // What comes next is the worst of what is drawn; nothing is before the last root. Once all is within the
        // finest error, what is left still makes the surface more precise: the last row tells of that.
        if d.level() > 0 && error < declared && error > finest {
            declared = error;
            rows.push(sum.row(layer, bytes_here, diamonds, declared));
        }
        for parent in layer.forest.parents(d) {
            let side = layer.forest.children(parent).iter().position(|child| *child == Some(d));
            if let (Some(side), Some(found)) = (side, drawn.get(&parent)) {
                sum.take(&found[side]);
            }
        }
        drawn.get(&d).into_iter().flatten().for_each(|found| sum.add(found));
        (bytes_here, diamonds) = (bytes, diamonds + 1);
    }
    rows.push(sum.row(layer, bytes_here, diamonds, finest));
    Ok(rows)
}

/// What was found under a triangle, in quanta.
#[derive(Debug, Clone, Copy, Default)]
struct Found {
    /// Sum of the squares, in [`UNIT`]s.
    squares: i128,
    max: f64,
    compared: u64,
    missing: u64,
    surplus: u64,
}

/// What was found under all triangles that are drawn.
#[derive(Debug, Default)]
struct Sum {
    total: Found,
    /// How often each largest distance occurs, by its bits, which sort as the numbers do.
    largest: BTreeMap<u64, u64>,
}

impl Sum {
    fn add(&mut self, found: &Found) {
        self.total.squares += found.squares;
        self.total.compared += found.compared;
        self.total.missing += found.missing;
        self.total.surplus += found.surplus;
        *self.largest.entry(found.max.to_bits()).or_default() += 1;
    }

    fn take(&mut self, found: &Found) {
        self.total.squares -= found.squares;
        self.total.compared -= found.compared;
        self.total.missing -= found.missing;
        self.total.surplus -= found.surplus;
        if let Some(count) = self.largest.get_mut(&found.max.to_bits()) {
            *count -= 1;
            if *count == 0 {
                self.largest.remove(&found.max.to_bits());
            }
        }
    }

    fn row(&self, layer: &Layer, bytes: u64, diamonds: u64, declared: f64) -> Row {
        let Found { squares, compared, missing, surplus, .. } = self.total;
        let max = self.largest.last_key_value().map_or(0.0, |(bits, _)| f64::from_bits(*bits));
        let rms = (squares as f64 / UNIT / compared.max(1) as f64).sqrt();
        let (max, rms) = (max * layer.quantum, rms * layer.quantum);
        Row { bytes, diamonds, declared, max, rms, compared, missing, surplus }
    }
}

/// A corner of a triangle: doubled local coordinates, lattice coordinates, height.
#[derive(Clone, Copy)]
struct Corner {
    local: [i64; 2],
    lattice: [i64; 2],
    height: i32,
}

/// The split of a diamond, whose triangles are compared.
struct Split<'a> {
    grid: &'a Grid,
    local: Local,
    block: &'a Block,
}

/// The heights of the finest surface at every sample.
struct Grid {
    width: i64,
    height: i64,
    heights: Vec<i32>,
    /// The forest's far corner.
    far: [i64; 2],
}

impl Grid {
    fn read(
        store: &Store,
        number: u8,
        layer: &Layer,
        entries: &HashMap<Diamond, Entry>,
    ) -> Result<Self, InspectError> {
        let [width, height] = layer.samples.map(i64::from);
        let heights = vec![NODATA; (width * height) as usize];
        let mut grid = Self { width, height, heights, far: layer.forest.size().map(i64::from) };
        decode_levels(store, number, layer, entries, |level, blocks| {
            if level + 1 < layer.forest.levels() {
                return;
            }
            for (d, block, _) in blocks {
                let local = layer.forest.local(*d);
                for [p, q] in block.places().filter(|[p, q]| local.upper || q <= p) {
                    let [x, y] = local.lattice2([p as i64, q as i64]);
                    if x < width && y < height {
                        let slot = Block::slot(block.segments(), p, q);
                        grid.heights[(y * width + x) as usize] = block.heights()[slot];
                    }
                }
            }
        })?;
        Ok(grid)
    }

    /// Compares the triangles that a split draws, side by side.
    fn compare(&self, layer: &Layer, d: Diamond, block: &Block) -> [Found; 4] {
        let split = Split { grid: self, local: layer.forest.local(d), block };
        let m = 2 * block.segments() as i64;
        let corners = [[0, 0], [m, 0], [m, m], [0, m]];
        std::array::from_fn(|side| {
            let mut found = Found::default();
            if side < 2 || split.local.upper {
                let ends = [corners[side], corners[(side + 1) % 4], [m / 2, m / 2]];
                // A side's triangle has n^2 small ones, or half as many where centres are no points.
                let depth = 2 * block.segments().ilog2() - u32::from(!block.has_centres());
                split.bisect(ends.map(|p| split.corner(p)), depth, &mut found);
            }
            found
        })
    }
}

impl Split<'_> {
    fn corner(&self, at: [i64; 2]) -> Corner {
        let slot = Block::slot(self.block.segments(), at[0] as usize, at[1] as usize);
        Corner { local: at, lattice: self.local.lattice2(at), height: self.block.heights()[slot] }
    }

    /// Cuts the triangle with hypotenuse ab and apex c in two, `depth` times: what is left is drawn flat.
    fn bisect(&self, [a, b, c]: [Corner; 3], depth: u32, found: &mut Found) {
        if depth == 0 {
            return self.flat([a, b, c], found);
        }
        let m = self.corner([0, 1].map(|axis| (a.local[axis] + b.local[axis]) / 2));
        self.bisect([c, a, m], depth - 1, found);
        self.bisect([b, c, m], depth - 1, found);
    }

    /// Compares the samples that a flat triangle owns. Where one of its corners has no height, it is there
    /// only along the side between the others.
    fn flat(&self, corners: [Corner; 3], found: &mut Found) {
        let Grid { width, height, heights, far } = self.grid;
        let [a, b, c] = corners.map(|k| k.lattice);
        let area = cross(a, b, c);
        let span = |axis: usize, size: i64| {
            let ends = [a[axis], b[axis], c[axis]];
            let [low, high] = ends.iter().fold([i64::MAX, i64::MIN], |[l, h], v| [l.min(*v), h.max(*v)]);
            low..=high.min(size - 1)
        };
        let mut squares = 0.0;
        for y in span(1, *height) {
            for x in span(0, *width) {
                let hair = [if x == far[0] { -1 } else { 1 }, if y == far[1] { -1 } else { 1 }];
                let edges = [(b, c), (c, a), (a, b)];
                if !edges.iter().all(|(from, to)| is_inside(*from, *to, [x, y], hair, area.signum())) {
                    continue;
                }
                let weights = edges.map(|(from, to)| cross(from, to, [x, y]));
                let parts = weights.iter().zip(&corners).filter(|(weight, _)| **weight != 0);
                let drawn = parts.clone().all(|(_, k)| k.height != NODATA);
                let truth = heights[(y * width + x) as usize];
                match (drawn, truth != NODATA) {
                    (true, true) => {
                        let sum: i64 = parts.map(|(weight, k)| weight * i64::from(k.height)).sum();
                        let distance = (sum as f64 / area as f64 - f64::from(truth)).abs();
                        squares += distance * distance;
                        found.max = found.max.max(distance);
                        found.compared += 1;
                    }
                    (true, false) => found.surplus += 1,
                    (false, true) => found.missing += 1,
                    (false, false) => {}
                }
            }
        }
        found.squares += (squares * UNIT).round() as i128;
    }
}

/// Twice the area of a triangle, positive where it turns left.
fn cross(o: [i64; 2], p: [i64; 2], q: [i64; 2]) -> i64 {
    (p[0] - o[0]) * (q[1] - o[1]) - (p[1] - o[1]) * (q[0] - o[0])
}

/// Whether a sample, moved by a hair along x and far less along y, lies on the inner side of an edge.
fn is_inside(from: [i64; 2], to: [i64; 2], s: [i64; 2], hair: [i64; 2], turn: i64) -> bool {
    let edge = [to[0] - from[0], to[1] - from[1]];
    let side = match cross(from, to, s) {
        0 if edge[1] != 0 => -edge[1] * hair[0],
        0 => edge[0] * hair[1],
        side => side,
    };
    side * turn > 0
}
