//! Triangles few cells wide against their samples, as most are: whole rows of the box around one, side by side and without
//! a choice. Which samples lie in a triangle is as random as the mesh, so each choice would often be guessed wrong.
//!
//! All numbers are whole, and exact in `f32` as long as heights differ by little. Coordinates are from the first corner.

use super::Vertex;
use glam::Vec4;

/// Columns of a box, at most.
pub(super) const WIDE: u32 = 8;

/// Rows of a box, at most: twice an area is below 2^7 then.
const HIGH: u32 = 16;

/// Quanta that corners may differ by. D and D times a height, slopes times a way across the box, and their sums are below
/// 2^7, 2^22 and 2^24 then; and a sample whose height is so far off that it was rounded is found to be farther off than this.
const HEIGHTS_MAX: i32 = 1 << 14;

/// The south-western corner and the size, in samples, of the box around a triangle, if it is so small.
#[derive(Debug, Clone, Copy)]
pub(super) struct Bounds {
    pub(super) low: [u32; 2],
    pub(super) columns: u32,
    pub(super) rows: u32,
}

impl Bounds {
    /// Around a triangle; `None` if that is too large, or too steep.
    #[inline(always)]
    pub(super) fn around([a, b, c]: [Vertex; 3]) -> Option<Self> {
        let low = [a.x.min(b.x).min(c.x), a.y.min(b.y).min(c.y)];
        let high = [a.x.max(b.x).max(c.x), a.y.max(b.y).max(c.y)];
        let (columns, rows) = (high[0] - low[0] + 1, high[1] - low[1] + 1);
        let steep = (b.height - a.height).unsigned_abs() | (c.height - a.height).unsigned_abs();
        let fits = (columns <= WIDE) & (rows <= HIGH) & (steep < HEIGHTS_MAX.unsigned_abs());
        fits.then_some(Self { low, columns, rows })
    }
}

/// A linear function of the plane at the columns of a row, and from one row to the next.
#[derive(Clone, Copy)]
struct Linear<const VECTORS: usize> {
    row: [Vec4; VECTORS],
    north: Vec4,
}

impl<const VECTORS: usize> Linear<VECTORS> {
    /// `east * x + north * y`, for x from `at.x` on.
    #[inline(always)]
    fn new(east: f32, north: f32, at: [f32; 2], more: f32) -> Self {
        let first = Vec4::splat(east * at[0] + north * at[1] + more);
        let step = Vec4::new(0.0, east, 2.0 * east, 3.0 * east);
        let mut row = [first + step; VECTORS];
        if let [_, second] = row.as_mut_slice() {
            *second += Vec4::splat(4.0 * east);
        }
        Self { row, north: Vec4::splat(north) }
    }

    #[inline(always)]
    fn next(&mut self) {
        self.row = self.row.map(|w| w + self.north);
    }
}

/// The largest distance between a triangle, which turns left, and the samples in it, times twice its area `doubled`; `None`
/// if some sample has no height, or heights differ by too much. `heights`: row by row from the box's first column on, or
/// from `before` columns west of it, `width` apart.
#[inline(always)]
#[allow(clippy::cast_precision_loss, reason = "below 2^24")]
pub(super) fn distance<const VECTORS: usize>(
    [a, b, c]: [Vertex; 3],
    doubled: f32,
    of: &Bounds,
    before: u32,
    heights: &[i32],
    width: usize,
) -> Option<f32> {
    let step = |from: u32, to: u32| to.wrapping_sub(from).cast_signed() as f32;
    let (ab, ac) = ([step(a.x, b.x), step(a.y, b.y)], [step(a.x, c.x), step(a.y, c.y)]);
    let (rise_b, rise_c) = ((b.height - a.height) as f32, (c.height - a.height) as f32);
    let at = [step(a.x, of.low[0]) - before as f32, step(a.y, of.low[1])];
    // What is left of each side, a to b, c to a and b to c: together they are the triangle's own.
    let mut left = [
        Linear::<VECTORS>::new(-ab[1], ab[0], at, 0.0),
        Linear::new(ac[1], -ac[0], at, 0.0),
        Linear::new(ab[1] - ac[1], ac[0] - ab[0], at, doubled),
    ];
    let mut plane =
        Linear::<VECTORS>::new(rise_b * ac[1] - rise_c * ab[1], ab[0] * rise_c - ac[0] * rise_b, at, 0.0);
    let mut worst = [Vec4::ZERO; VECTORS];
    let mut rows = heights.chunks(width);
    for _ in 0..of.rows {
        let fours = rows.next()?.as_chunks::<4>().0;
        for (i, four) in fours.first_chunk::<VECTORS>()?.iter().enumerate() {
            let [p, q, r, s] = four.map(|h| h.wrapping_sub(a.height) as f32);
            let off = (Vec4::new(p, q, r, s) * doubled - plane.row[i]).abs();
            let least = left[0].row[i].min(left[1].row[i]).min(left[2].row[i]);
            worst[i] = worst[i].max(Vec4::select(least.cmpge(Vec4::ZERO), off, Vec4::ZERO));
        }
        plane.next();
        left.iter_mut().for_each(Linear::next);
    }
    let worst = worst.into_iter().fold(Vec4::ZERO, Vec4::max).max_element();
    (worst < HEIGHTS_MAX as f32 * doubled).then_some(worst)
}
