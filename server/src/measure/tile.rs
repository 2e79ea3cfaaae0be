//! The samples of a tile against the surface, whole rows at a time: the way for ground without holes.
//!
//! **The trick.** A surface of right triangles does not change when each is halved at the middle of its
//! hypotenuse, at the mean of the two ends. So the lattice of any level becomes one as fine as the samples
//! by a few rounds of means, without a thought of which sample lies in which triangle. The middles of an
//! odd level's cell sides are the first such means; from then on all is as on an even level:
//!
//! ```text
//! +-------+-------+      + old    Middles of sides: the mean of the two ends.
//! |     / | \     |      x new    Centres of squares: the mean of the ends of the diagonal, which
//! x   x   x   x   x               alternates from square to square, as the triangles do. (Squares made
//! | /     |     \ |               by halving lie in one triangle each, where either diagonal gives
//! +---x---+---x---+               the same.)
//! ```
//!
//! **Exact.** Heights count from one of the samples, so they are whole numbers of quanta up to R, the
//! tile's range; over a cell s samples wide, means are multiples of 1/s, and so are distances, at most 2R.
//! `f32` has 24 bits: where 2Rs <= 2^24 nothing is rounded. Elsewhere `f64` does as much: R < 2^26,
//! s <= 2^18.

#![allow(
    clippy::cast_possible_truncation,
    clippy::cast_precision_loss,
    reason = "f32 is used only where the range says that it is exact; indices are below the tile's size"
)]

use super::{Found, Nodes, Samples, Square};
use diamantina_protocol::NODATA;
use std::ops::{Add, Mul, Sub};

/// Lanes of a comparison: enough for any vector unit, so that the loop over them becomes one.
const LANES: usize = 16;

/// More than heights of 24 bits can be apart, and less than nodata is from any of them.
const RANGE_MAX: f64 = (1u64 << 26) as f64;

/// Numbers that the surface is computed in.
trait Real: Copy + Add<Output = Self> + Sub<Output = Self> + Mul<Output = Self> + PartialOrd + Into<f64> {
    const ZERO: Self;
    const HALF: Self;
    fn of(value: i32) -> Self;
    fn of_exact(value: f64) -> Self;
    fn magnitude(self) -> Self;
    fn larger(self, other: Self) -> Self {
        if self > other { self } else { other }
    }
}

impl Real for f32 {
    const ZERO: Self = 0.0;
    const HALF: Self = 0.5;
    fn of(value: i32) -> Self {
        value as f32
    }
    fn of_exact(value: f64) -> Self {
        value as f32
    }
    fn magnitude(self) -> Self {
        self.abs()
    }
}

impl Real for f64 {
    const ZERO: Self = 0.0;
    const HALF: Self = 0.5;
    fn of(value: i32) -> Self {
        value.into()
    }
    fn of_exact(value: f64) -> Self {
        value
    }
    fn magnitude(self) -> Self {
        self.abs()
    }
}

/// Room for the surface of a tile, and for the coarser one that it is made from.
#[derive(Default)]
pub(super) struct Buffers {
    single: [Vec<f32>; 2],
    double: [Vec<f64>; 2],
}

/// Where a tile lies and what it is compared in.
#[derive(Clone, Copy)]
struct Job<'a> {
    even: bool,
    tile: Square,
    around: Square,
    samples: &'a Samples<'a>,
    nodes: Nodes<'a>,
    /// The height from which the others count.
    base: i32,
}

/// As [`super::cells::measure`], unless the tile has holes: then nothing happens, and the result is false.
pub(super) fn measure(
    level: u32,
    tile: Square,
    around: Square,
    samples: &Samples<'_>,
    nodes: Nodes<'_>,
    buffers: &mut Buffers,
    local: &mut [Found; 4],
) -> bool {
    let summary = samples.summary([tile.x, tile.y]);
    if summary.holes {
        // Where there is nothing to draw and nothing to miss, nothing is found.
        return summary.empty && is_bare(tile, nodes);
    }
    let even = level.is_multiple_of(2);
    let base = summary.low.midpoint(summary.high);
    let job = Job { even, tile, around, samples, nodes, base };
    let range = f64::from((summary.high - base).max(base - summary.low));
    let cell = f64::from(1u32 << (nodes.spacing_log2 + u32::from(!even)));
    let range = job.lattice(&mut buffers.single[0]).max(range);
    if range > RANGE_MAX {
        return false;
    }
    if 2.0 * range * cell <= f64::from(1u32 << f32::MANTISSA_DIGITS) {
        job.compare(&mut buffers.single, local);
    } else {
        job.lattice(&mut buffers.double[0]);
        job.compare(&mut buffers.double, local);
    }
    true
}

/// Whether the level draws nothing in a tile nor around it.
fn is_bare(tile: Square, nodes: Nodes<'_>) -> bool {
    // Twice the spacing is the cell of an odd level; that of an even one lies in it.
    let cell = 2u32 << nodes.spacing_log2;
    let low = |w: u32| w & !(cell - 1);
    let high = |w: u32, w0: u32, points: usize| {
        let last = w0 + ((points as u32 - 1) << nodes.spacing_log2);
        w.next_multiple_of(cell).min(last)
    };
    let rows = nodes.heights.len() / nodes.width;
    let (x0, x1) = (low(tile.x), high(tile.x + tile.side, nodes.origin[0], nodes.width));
    let (y0, y1) = (low(tile.y), high(tile.y + tile.side, nodes.origin[1], rows));
    let count = ((x1 - x0) >> nodes.spacing_log2) as usize + 1;
    (y0..=y1)
        .step_by(1 << nodes.spacing_log2)
        .all(|y| nodes.row(x0, y, count).iter().all(|height| *height == NODATA))
}

impl Job<'_> {
    /// The tile's lattice of an even level: its own nodes, with the middles of an odd level's cell sides;
    /// or its four corners, where it lies within a cell. Returns the largest magnitude of what is known
    /// around it.
    fn lattice<T: Real>(self, out: &mut Vec<T>) -> f64 {
        out.clear();
        let spacing = 1u32 << self.nodes.spacing_log2;
        if spacing > self.tile.side {
            return self.within_cell(out);
        }
        let count = (self.tile.side / spacing) as usize + 1;
        let mut range = T::ZERO;
        for j in 0..count {
            let y = self.tile.y + j as u32 * spacing;
            let row = self.nodes.row(self.tile.x, y, count);
            let first = out.len();
            if self.even {
                out.extend(row.iter().map(|height| self.relative::<T>(*height)));
            } else {
                self.odd_row(row, y, out);
            }
            range = range.larger(largest(&out[first..]));
        }
        range.into()
    }

    /// A row of the lattice of an odd level: its nodes, and between them the middles of cell sides.
    fn odd_row<T: Real>(self, row: &[i32], y: u32, out: &mut Vec<T>) {
        let spacing = 1u32 << self.nodes.spacing_log2;
        let count = row.len();
        let odd_row = (y / spacing) % 2;
        if count < 3 {
            // The tile is as wide as half a cell: the ends of its sides lie beyond it.
            out.extend((0..count as u32).map(|i| T::of_exact(self.point(self.tile.x + i * spacing, y))));
            return;
        }
        // The tile begins and ends with a whole cell: pairs of points, and one more.
        let first = out.len();
        out.resize(first + count, T::ZERO);
        let (pairs, last) = out[first..].as_chunks_mut::<2>();
        let (here, end) = row.as_chunks::<2>();
        if odd_row == 0 {
            let next = row[1..].as_chunks::<2>().0;
            for ((pair, [west, _]), [_, east]) in pairs.iter_mut().zip(here).zip(next) {
                let (west, east) = (self.relative::<T>(*west), self.relative::<T>(*east));
                *pair = [west, (west + east) * T::HALF];
            }
            last[0] = self.relative(end[0]);
        } else {
            let (south, south_end) = self.nodes.row(self.tile.x, y - spacing, count).as_chunks::<2>();
            let (north, north_end) = self.nodes.row(self.tile.x, y + spacing, count).as_chunks::<2>();
            let mean = |a: i32, b: i32| (self.relative::<T>(a) + self.relative(b)) * T::HALF;
            for (((pair, [_, middle]), [a, _]), [b, _]) in pairs.iter_mut().zip(here).zip(south).zip(north) {
                *pair = [mean(*a, *b), self.relative(*middle)];
            }
            last[0] = mean(south_end[0], north_end[0]);
        }
    }

    /// A height counted from the base. Nodata comes out beyond [`RANGE_MAX`], whatever the base.
    fn relative<T: Real>(self, height: i32) -> T {
        T::of(height.wrapping_sub(self.base))
    }

    /// The lattice of an even level at one of its points, which for an odd one may be the middle of a side.
    fn point(self, x: u32, y: u32) -> f64 {
        let spacing = 1u32 << self.nodes.spacing_log2;
        let node = |x: u32, y: u32| self.relative::<f64>(self.nodes.at(x, y));
        match ((x / spacing) % 2, (y / spacing) % 2) {
            (1, 0) if !self.even => f64::midpoint(node(x - spacing, y), node(x + spacing, y)),
            (0, 1) if !self.even => f64::midpoint(node(x, y - spacing), node(x, y + spacing)),
            _ => node(x, y),
        }
    }

    /// The surface at the corners of a tile that lies within a cell.
    fn within_cell<T: Real>(self, out: &mut Vec<T>) -> f64 {
        let spacing = 1u32 << self.nodes.spacing_log2;
        let (x, y) = (self.tile.x & !(spacing - 1), self.tile.y & !(spacing - 1));
        let corners = [(x, y), (x + spacing, y), (x + spacing, y + spacing), (x, y + spacing)];
        let [sw, se, ne, nw] = corners.map(|(x, y)| self.point(x, y));
        let rising = (x / spacing + y / spacing).is_multiple_of(2);
        let side = self.tile.side;
        for (dx, dy) in [(0, 0), (side, 0), (0, side), (side, side)] {
            let s = f64::from(self.tile.x + dx - x) / f64::from(spacing);
            let t = f64::from(self.tile.y + dy - y) / f64::from(spacing);
            out.push(T::of_exact(match (rising, s >= t, s + t <= 1.0) {
                (true, true, _) => sw + (se - sw) * s + (ne - se) * t,
                (true, false, _) => sw + (ne - nw) * s + (nw - sw) * t,
                (false, _, true) => sw + (se - sw) * s + (nw - sw) * t,
                (false, _, false) => ne - (ne - nw) * (1.0 - s) - (ne - se) * (1.0 - t),
            }));
        }
        [sw, se, ne, nw].into_iter().fold(0.0, |range: f64, v| range.max(v.abs()))
    }

    /// Refines the lattice in the first buffer to the samples and compares.
    fn compare<T: Real>(self, [from, to]: &mut [Vec<T>; 2], local: &mut [Found; 4]) {
        let side = self.tile.side;
        let mut step = (1u32 << self.nodes.spacing_log2).min(side);
        // Which diagonals rise: by coordinates in cells of this step, then as within one.
        let mut falling = (self.tile.x / step + self.tile.y / step) % 2;
        while step > 1 {
            refine(from, (side / step) as usize, falling, to);
            std::mem::swap(from, to);
            (step, falling) = (step / 2, 0);
        }
        let width = side as usize + 1;
        let rows = from.chunks_exact(width).zip(self.samples.rows([self.tile.x, self.tile.y], side));
        if self.even {
            let worst = rows.fold(T::ZERO, |worst, (drawn, row)| worst.larger(self.worst(drawn, row)));
            local[0].vertical = local[0].vertical.max(worst.into());
            return;
        }
        // The diagonals of the macro-square part each row: west, then south or north, then east.
        let (dx, whole) = (self.tile.x - self.around.x, self.around.side);
        let touched = self.touched();
        for ((drawn, row), dy) in rows.zip(self.tile.y - self.around.y..) {
            let near = dy.min(whole - dy);
            let mut part = |from: u32, to: u32, triangle: usize| {
                let (from, to) = (from.max(dx), to.min(dx + side));
                if touched[triangle] && from <= to {
                    let range = (from - dx) as usize..=(to - dx) as usize;
                    let worst = self.worst(&drawn[range.clone()], &row[range]).into();
                    local[triangle].vertical = local[triangle].vertical.max(worst);
                }
            };
            part(0, near, 3);
            part(whole - near, whole, 1);
            if dy <= whole / 2 {
                part(near, whole - near, 0);
            }
            if dy >= whole / 2 {
                part(near, whole - near, 2);
            }
        }
    }

    /// Which of the macro-square's triangles (south, east, north, west) have a part inside the tile. Others
    /// only meet its border: their own tiles see the samples there.
    fn touched(self) -> [bool; 4] {
        let whole = self.around.side;
        let (x0, y0) = (self.tile.x - self.around.x, self.tile.y - self.around.y);
        let (x1, y1) = (x0 + self.tile.side, y0 + self.tile.side);
        // At a distance from the triangle's side it spans from that distance to as far from the other end.
        let spans = |distance: u32, low: u32, high: u32| {
            2 * distance < whole && distance.max(low) < (whole - distance).min(high)
        };
        [spans(y0, x0, x1), spans(whole - x1, y0, y1), spans(whole - y1, x0, x1), spans(x0, y0, y1)]
    }

    /// The largest distance along a row.
    fn worst<T: Real>(self, drawn: &[T], samples: &[i32]) -> T {
        let distance = |drawn: T, sample: i32| (self.relative::<T>(sample) - drawn).magnitude();
        let mut worst = [T::ZERO; LANES];
        let (drawn, drawn_rest) = drawn.as_chunks::<LANES>();
        let (samples, samples_rest) = samples.as_chunks::<LANES>();
        for (drawn, samples) in drawn.iter().zip(samples) {
            for lane in 0..LANES {
                worst[lane] = worst[lane].larger(distance(drawn[lane], samples[lane]));
            }
        }
        let rest = drawn_rest.iter().zip(samples_rest).map(|(drawn, sample)| distance(*drawn, *sample));
        worst.into_iter().chain(rest).fold(T::ZERO, T::larger)
    }
}

/// The largest magnitude.
fn largest<T: Real>(values: &[T]) -> T {
    let mut largest = [T::ZERO; LANES];
    let (values, rest) = values.as_chunks::<LANES>();
    for values in values {
        for lane in 0..LANES {
            largest[lane] = largest[lane].larger(values[lane].magnitude());
        }
    }
    largest.into_iter().chain(rest.iter().map(|value| value.magnitude())).fold(T::ZERO, T::larger)
}

/// Halves a lattice of `cells` squares a side: `from` has `cells + 1` points in a row, `to` gets twice as many
/// less one. The diagonal of a square rises where its coordinates and `falling` sum to an even number.
fn refine<T: Real>(from: &[T], cells: usize, falling: u32, to: &mut Vec<T>) {
    let width = 2 * cells + 1;
    to.clear();
    to.resize(width * width, T::ZERO);
    let mut rows = to.chunks_exact_mut(width);
    let mean = |a: T, b: T| (a + b) * T::HALF;
    for j in 0..=cells {
        let south = &from[j * (cells + 1)..(j + 1) * (cells + 1)];
        let Some(row) = rows.next() else { return };
        for ((pair, a), b) in row.as_chunks_mut::<2>().0.iter_mut().zip(south).zip(&south[1..]) {
            *pair = [*a, mean(*a, *b)];
        }
        row[width - 1] = south[cells];
        let Some(row) = rows.next() else { return };
        let north = &from[(j + 1) * (cells + 1)..(j + 2) * (cells + 1)];
        let falls_at = (j + 1 + falling as usize) % 2;
        let squares = south.iter().zip(&south[1..]).zip(north).zip(&north[1..]);
        for (i, (pair, (((sw, se), nw), ne))) in
            row.as_chunks_mut::<2>().0.iter_mut().zip(squares).enumerate()
        {
            let (rising, falling) = (mean(*sw, *ne), mean(*se, *nw));
            *pair = [mean(*sw, *nw), if i % 2 == falls_at { falling } else { rising }];
        }
        row[width - 1] = mean(south[cells], north[cells]);
    }
}
