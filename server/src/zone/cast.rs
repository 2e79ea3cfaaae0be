//! Rays from eyes over a relief: what of it is seen, and how well hidden the rest is.
//!
//! All rays of one azimuth lie in a vertical plane, so they are followed together: the plane cuts each small
//! triangle in a segment, and a segment covers the slopes between its ends. Whoever comes to a segment in order
//! of distance sees it if some of its slopes are still open. Over ground without holes the open slopes are those
//! above one number, the horizon; behind a hole there may be windows below it. So no step of elevation has to be
//! chosen: this is the limit of fine steps.
//!
//! The step of azimuth is that of Cifuentes et al., *Ray casting para la definición de zonas de interés en
//! simplificación topográfica* (2007), equation 6: its tangent is half the least ratio of a triangle's width to its
//! distance, over all triangles whose ratio is at least ε. The least width of a triangle with legs of a cell is the
//! cell divided by the root of two. So a ray crosses every triangle that is near enough.
//!
//! Where all slopes of a block of cells are hidden, the block is passed over; how well its best seen place is hidden
//! is bounded by its highest sample and its nearest side. What has no height neither hides nor is seen. Slopes are in quanta a metre: heights stay the integers that they are.

#![allow(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    clippy::cast_possible_wrap,
    reason = "places are kept within the relief, whose sides are below 2^28; shares of 255 are below 256"
)]

use super::relief::{BLOCKS_LOG2, Relief};
use crate::progress::Progress;
use diamantina_protocol::NODATA;
use diamantina_protocol::zone::pack;
use rayon::prelude::*;
use std::f64::consts::{SQRT_2, TAU};
use std::sync::atomic::{AtomicU8, Ordering};

/// The radius of the Earth, in metres: the mean of its axes.
const EARTH_RADIUS: f64 = 6_371_009.0;

/// How much light bends with the Earth's surface: the usual coefficient of refraction.
const REFRACTION: f64 = 0.13;

/// Metres that the ground sinks at a distance of one metre, with the square of the distance.
pub const BEND: f64 = (1.0 - REFRACTION) / (2.0 * EARTH_RADIUS);

/// The most windows below the horizon that are told apart; beyond, the lowest two are taken for one, which
/// shows more than there is.
const WINDOWS_MAX: usize = 16;

/// Slopes closer than this are the same: some thousand times the rounding of the arithmetic.
const SAME: f64 = 1e-11;

/// The largest share that is told of a small block as one. Where more is open to doubt, its cells tell better.
const BLOCK_SHARE_MAX: f64 = 0.2;

/// Azimuths that are worked on at once.
const AZIMUTHS_AT_ONCE: usize = 512;

/// An eye.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Eye {
    /// Cells from the south-west sample, within the relief.
    pub place: [f64; 2],
    /// The height in quanta.
    pub height: f64,
}

/// How rays run and what counts as hidden.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Optics {
    /// Metres of a cell along x and y.
    pub cell: [f64; 2],
    /// Metres of a quantum.
    pub quantum: f64,
    /// Metres by which the ground sinks at a distance of one metre: [`BEND`], or 0 for a flat Earth.
    pub bend: f64,
    /// The least apparent width of a triangle that counts, in radians: ε.
    pub epsilon: f64,
    /// The visibility of what is hidden: 0 to below 1.
    pub hidden: f64,
    /// Radians by which something may seem higher than it is and have visibility 1; with visibility v, 1/v as
    /// much. 0: all that is hidden has the visibility of what is hidden.
    pub angle: f64,
}

impl Optics {
    /// How many azimuths are looked at from a place, in cells.
    #[must_use]
    pub fn azimuths(&self, relief: &Relief, place: [f64; 2]) -> usize {
        let reach: [f64; 2] = std::array::from_fn(|axis| {
            let far = (relief.size()[axis] - 1) as f64;
            place[axis].max(far - place[axis]) * self.cell[axis]
        });
        let width = self.cell[0].min(self.cell[1]) / SQRT_2;
        let ratio = (width / reach[0].hypot(reach[1])).max(self.epsilon);
        (TAU / (ratio / 2.0).atan()).ceil() as usize
    }

    /// The least share that is told apart from hidden.
    fn least(&self) -> f64 {
        self.hidden.max(1.0 / 255.0)
    }
}

/// The visibility of every sample, in 255ths: the largest of the triangles around it, from any of the eyes. What
/// nobody sees has that of [`Optics::hidden`]. `None` if `progress` was told to stop.
///
/// Takes a byte a sample and 1/64 more. The result does not depend on the number of threads.
#[must_use]
pub fn cast(relief: &Relief, optics: &Optics, eyes: &[Eye], progress: &Progress) -> Option<Vec<u8>> {
    let floor = pack(optics.hidden);
    let works: Vec<(Eye, usize, usize)> = eyes
        .iter()
        .flat_map(|eye| {
            let azimuths = optics.azimuths(relief, eye.place);
            (0..azimuths).step_by(AZIMUTHS_AT_ONCE).map(move |first| (*eye, first, azimuths))
        })
        .collect();
    let sheets = Sheets::new(relief, floor);
    works.par_iter().for_each(|(eye, first, azimuths)| {
        if progress.is_stopping() {
            return;
        }
        for i in *first..(first + AZIMUTHS_AT_ONCE).min(*azimuths) {
            // Half a step off the axes, along which rays would run on the edges of triangles.
            let azimuth = (i as f64 + 0.5) / *azimuths as f64 * TAU;
            walk(relief, optics, *eye, azimuth, |seen| sheets.note(&seen));
        }
        if *first == 0 {
            progress.advance(1);
        }
    });
    (!progress.is_stopping()).then(|| sheets.merged())
}

/// What has been seen so far, in 255ths: of samples, and of whole blocks.
struct Sheets {
    floor: u8,
    size: [usize; 2],
    samples: Vec<AtomicU8>,
    blocks_size: [usize; 2],
    blocks: Vec<AtomicU8>,
}

impl Sheets {
    fn new(relief: &Relief, floor: u8) -> Self {
        let sheet = |[w, h]: [usize; 2]| (0..w * h).map(|_| AtomicU8::new(floor)).collect();
        let (size, blocks_size) = (relief.size(), relief.blocks_size());
        Self { floor, size, samples: sheet(size), blocks_size, blocks: sheet(blocks_size) }
    }

    fn note(&self, seen: &Seen) {
        let share = stepped(seen.share, self.floor);
        let raise = |sheet: &[AtomicU8], width: usize, [x, y]: [usize; 2]| {
            let here = &sheet[y * width + x];
            // Most are known already, and looking costs less than changing.
            if here.load(Ordering::Relaxed) < share {
                here.fetch_max(share, Ordering::Relaxed);
            }
        };
        match seen.region {
            Region::Triangle(corners) => corners.iter().for_each(|c| raise(&self.samples, self.size[0], *c)),
            Region::Cell([x, y]) => [[x, y], [x + 1, y], [x, y + 1], [x + 1, y + 1]]
                .iter()
                .for_each(|c| raise(&self.samples, self.size[0], *c)),
            Region::Block(block) => raise(&self.blocks, self.blocks_size[0], block),
        }
    }

    fn merged(self) -> Vec<u8> {
        let mut samples: Vec<u8> = self.samples.into_iter().map(AtomicU8::into_inner).collect();
        let side = 1usize << BLOCKS_LOG2[0];
        for (i, share) in self.blocks.into_iter().map(AtomicU8::into_inner).enumerate() {
            let [x, y] = [i % self.blocks_size[0] * side, i / self.blocks_size[0] * side];
            if share == self.floor {
                continue;
            }
            for y in y..=(y + side).min(self.size[1] - 1) {
                let row = y * self.size[0];
                for sample in &mut samples[row + x..=row + (x + side).min(self.size[0] - 1)] {
                    *sample = (*sample).max(share);
                }
            }
        }
        samples
    }
}

/// A share as it is kept: in 255ths, at one of the steps 1, 1/√2, 1/2, ... above it, so that masks compress.
fn stepped(share: f64, floor: u8) -> u8 {
    let halvings = (-2.0 * share.log2()).floor().clamp(0.0, 16.0) / 2.0;
    pack((-halvings).exp2().max(share)).max(floor)
}

/// A part of the relief, in samples from the south-west.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Region {
    /// A small triangle, by its corners.
    Triangle([[usize; 2]; 3]),
    /// A cell, by its south-west sample.
    Cell([usize; 2]),
    /// A block of the smaller kind, by its place among the blocks.
    Block([usize; 2]),
}

/// A part of the relief that is seen, or nearly.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Seen {
    /// Which part. Of what is seen, always a triangle.
    pub region: Region,
    /// Slopes between which all of it lies that the plane of the azimuth cuts, in quanta a metre.
    pub slopes: [f64; 2],
    /// 1 where it is seen; else a bound of how much errors in it count for: see [`Optics::angle`].
    pub share: f64,
}

/// Follows the rays of one azimuth (radians from the x axis to the y axis) and shows what is seen or nearly, in order of
/// distance; what has a share of [`Optics::hidden`] or less is left out.
pub fn walk(relief: &Relief, optics: &Optics, eye: Eye, azimuth: f64, visit: impl FnMut(Seen)) {
    let along = [azimuth.cos() / optics.cell[0], azimuth.sin() / optics.cell[1]];
    let major = usize::from(along[1].abs() > along[0].abs());
    let steep = along[major].abs();
    let plane = Plane {
        relief,
        major,
        sizes: [relief.size()[major], relief.size()[1 - major]],
        eye: [eye.place[major], eye.place[1 - major]],
        height: eye.height,
        forward: along[major] > 0.0,
        lean: along[1 - major] / steep,
        step: 1.0 / steep,
        bend: optics.bend / optics.quantum,
    };
    let sky = Sky { horizon: f64::NEG_INFINITY, windows: Vec::new(), optics, least: optics.least() };
    Walk { plane, sky, visit }.run();
}

/// The vertical plane of an azimuth. Columns of cells are crossed one by one along the major axis, the one along
/// which the azimuth crosses more of them; `u` counts cells along it from the eye.
struct Plane<'a> {
    relief: &'a Relief,
    /// 0 for x, 1 for y. Places in the plane's frame are `[major, minor]`.
    major: usize,
    /// Samples.
    sizes: [usize; 2],
    eye: [f64; 2],
    height: f64,
    forward: bool,
    /// Cells along the minor axis for one along the major: -1 to 1.
    lean: f64,
    /// Metres for a cell along the major axis.
    step: f64,
    /// Quanta by which the ground sinks at one metre.
    bend: f64,
}

impl Plane<'_> {
    fn minor(&self, u: f64) -> f64 {
        self.eye[1] + self.lean * u
    }

    /// `u` of a line between columns.
    fn to_line(&self, line: usize) -> f64 {
        let u = line as f64 - self.eye[0];
        if self.forward { u } else { -u }
    }

    fn sample(&self, [k, j]: [usize; 2]) -> [usize; 2] {
        if self.major == 0 { [k, j] } else { [j, k] }
    }

    /// The slope at which a height in quanta is seen.
    fn slope(&self, height: f64, u: f64) -> f64 {
        let distance = u * self.step;
        let above = height - self.height - self.bend * distance * distance;
        if distance > 0.0 { above / distance } else { f64::INFINITY.copysign(above) }
    }

    /// Slopes between which all is seen that lies between two heights, from `near` to `far`.
    fn slopes(&self, [low, high]: [f64; 2], [near, far]: [f64; 2]) -> [f64; 2] {
        let [near, far] = [near * self.step, far * self.step];
        let rise = high - self.height - self.bend * near * near;
        let fall = low - self.height - self.bend * far * far;
        let over = |above: f64, distance: f64| {
            if distance > 0.0 { above / distance } else { f64::INFINITY.copysign(above) }
        };
        [over(fall, if fall < 0.0 { near } else { far }), over(rise, if rise > 0.0 { near } else { far })]
    }
}

/// The slopes that are still open: all above the horizon, and some windows below it, from low to high.
struct Sky<'a> {
    horizon: f64,
    windows: Vec<[f64; 2]>,
    optics: &'a Optics,
    least: f64,
}

/// Whether a slope is above another by more than rounding.
fn is_above(a: f64, b: f64) -> bool {
    a > b && (b.is_infinite() || a - b > SAME * (1.0 + b.abs()))
}

fn overlap([lo, hi]: [f64; 2], [least, most]: [f64; 2]) -> bool {
    is_above(hi, least) && is_above(most, lo)
}

impl Sky<'_> {
    /// Whether some of the slopes between two are open.
    fn shows(&self, slopes: [f64; 2]) -> bool {
        is_above(slopes[1], self.horizon) || self.windows.iter().any(|window| overlap(slopes, *window))
    }

    /// What the errors of something count for that lies between two slopes, none of them open.
    fn share(&self, [lo, hi]: [f64; 2]) -> f64 {
        if self.optics.angle == 0.0 {
            return 0.0;
        }
        let mut share = self.beside(lo, hi, self.horizon);
        for [least, most] in &self.windows {
            let below = !is_above(hi, *least);
            share = share.max(self.beside(lo, hi, if below { *least } else { *most }));
        }
        share.min(1.0)
    }

    /// The same beside one border of what is open, for all slopes between two. A vertical error E at the distance t
    /// and the slope s is seen as E / (t (1 + s²)) and changes the slope by E / t. Of all slopes between two, one of
    /// both counts for the most: in between, the quotient has a least value, if any.
    fn beside(&self, a: f64, b: f64, border: f64) -> f64 {
        let Optics { angle, quantum, .. } = *self.optics;
        let count = |slope: f64| {
            let gap = (border - slope).abs() * quantum;
            // Straight down, no vertical error is seen.
            if slope.is_infinite() { 1.0 } else { angle * (1.0 + (slope * quantum).powi(2)) / gap }
        };
        count(a).max(count(b))
    }

    /// Closes the slopes between two.
    fn cover(&mut self, [lo, hi]: [f64; 2]) {
        if self.windows.is_empty() && !is_above(lo, self.horizon) {
            self.horizon = self.horizon.max(hi);
            return;
        }
        let mut open = std::mem::take(&mut self.windows);
        open.push([self.horizon, f64::INFINITY]);
        for [least, most] in open {
            if !overlap([lo, hi], [least, most]) {
                self.windows.push([least, most]);
                continue;
            }
            if is_above(lo, least) {
                self.windows.push([least, lo]);
            }
            if is_above(most, hi) {
                self.windows.push([hi, most]);
            }
        }
        // The last is what is open above all.
        self.horizon = self.windows.pop().map_or(self.horizon, |[horizon, _]| horizon);
        if self.windows.len() > WINDOWS_MAX {
            self.windows[1][0] = self.windows[0][0];
            self.windows.remove(0);
        }
    }
}

struct Walk<'a, F> {
    plane: Plane<'a>,
    sky: Sky<'a>,
    visit: F,
}

impl<F: FnMut(Seen)> Walk<'_, F> {
    fn run(&mut self) {
        let columns = self.plane.sizes[0] - 1;
        let eye = self.plane.eye[0];
        // A column number of -1 wraps, and is beyond all columns like any other.
        let mut column =
            if self.plane.forward { eye.floor() as usize } else { (eye.ceil() as usize).wrapping_sub(1) };
        let mut from = 0.0;
        let mut tried = [usize::MAX; 2];
        'columns: while column < columns {
            for which in [1, 0] {
                let block = column >> BLOCKS_LOG2[which];
                if tried[which] == block {
                    continue;
                }
                tried[which] = block;
                if let Some(line) = self.beyond(which, block, from) {
                    from = self.plane.to_line(line);
                    column = if self.plane.forward { line } else { line.wrapping_sub(1) };
                    continue 'columns;
                }
            }
            let line = if self.plane.forward { column + 1 } else { column };
            let to = self.plane.to_line(line);
            if !self.column(column, [from, to]) {
                return;
            }
            from = to;
            column = if self.plane.forward { column + 1 } else { column.wrapping_sub(1) };
        }
    }

    /// The line at the end of a column of blocks, where all that the plane crosses in it is hidden: it is told as one
    /// then. Large blocks bound little, so they are passed over only if nothing is to be told.
    fn beyond(&mut self, which: usize, block: usize, from: f64) -> Option<usize> {
        let plane = &self.plane;
        let log2 = BLOCKS_LOG2[which];
        let line = if plane.forward { ((block + 1) << log2).min(plane.sizes[0] - 1) } else { block << log2 };
        let to = plane.to_line(line);
        // The plane leans at most one cell a column: it crosses one block or two.
        let row = |u: f64| (plane.minor(u).max(0.0) as usize).min(plane.sizes[1] - 2) >> log2;
        let blocks = [from, to].map(|u| plane.sample([block, row(u)]));
        let [low, high] = plane.relief.bounds(which, blocks);
        if low > high {
            return Some(line);
        }
        let slopes = plane.slopes([f64::from(low), f64::from(high)], [from, to]);
        if self.sky.shows(slopes) {
            return None;
        }
        let share = self.sky.share(slopes);
        if share > self.sky.least {
            if which > 0 || share > BLOCK_SHARE_MAX {
                return None;
            }
            for block in blocks {
                (self.visit)(Seen { region: Region::Block(block), slopes, share });
            }
        }
        Some(line)
    }

    /// Crosses a column; whether the plane is still over the relief at its end.
    fn column(&mut self, column: usize, [from, to]: [f64; 2]) -> bool {
        let [low, high] = {
            let [a, b] = [from, to].map(|u| self.plane.minor(u));
            if a < b { [a, b] } else { [b, a] }
        };
        // It leans at most one cell a column, so it crosses one line between rows at most.
        let line = low.floor() + 1.0;
        let cross = if line < high { (line - self.plane.eye[1]) / self.plane.lean } else { to };
        for [from, to] in [[from, cross.clamp(from, to)], [cross.clamp(from, to), to]] {
            if from >= to {
                continue;
            }
            let middle = self.plane.minor(f64::midpoint(from, to));
            if middle < 0.0 || middle > (self.plane.sizes[1] - 1) as f64 {
                return false;
            }
            let row = (middle as usize).min(self.plane.sizes[1] - 2);
            self.cell([column, row], [from, to]);
        }
        true
    }

    /// Crosses a cell: one small triangle or two.
    fn cell(&mut self, [k, j]: [usize; 2], [from, to]: [f64; 2]) {
        let plane = &self.plane;
        let corners = [[k, j], [k + 1, j], [k + 1, j + 1], [k, j + 1]].map(|c| plane.sample(c));
        let heights = corners.map(|c| plane.relief.at(c));
        let filled = heights.iter().filter(|h| **h != NODATA);
        let [low, high] = filled.fold([i32::MAX, NODATA], |[low, high], h| [low.min(*h), high.max(*h)]);
        if high == NODATA {
            return;
        }
        let bounds = [f64::from(low), f64::from(high)];
        let slopes = plane.slopes(bounds, [from, to]);
        if !self.sky.shows(slopes) {
            let share = self.sky.share(slopes);
            if share > self.sky.least {
                (self.visit)(Seen { region: Region::Cell(plane.sample([k, j])), slopes, share });
            }
            return;
        }
        let local = |u: f64| {
            let along = if plane.forward { u } else { -u };
            [plane.eye[0] + along - k as f64, plane.minor(u) - j as f64]
        };
        let rising = (k + j).is_multiple_of(2);
        // Which side of the diagonal, and how far.
        let side = |u: f64| {
            let [s, t] = local(u);
            if rising { s - t } else { s + t - 1.0 }
        };
        let [a, b] = [side(from), side(to)];
        let cross = if a * b < 0.0 { from + (to - from) * a / (a - b) } else { to };
        for ([from, to], side) in [([from, cross], if a == 0.0 { b } else { a }), ([cross, to], b)] {
            if from >= to {
                continue;
            }
            // The triangle's corners: the one beside the diagonal stands between its ends.
            let [i, c, l] = match (rising, side < 0.0) {
                (true, false) => [0, 1, 2],
                (true, true) => [2, 3, 0],
                (false, true) => [3, 0, 1],
                (false, false) => [1, 2, 3],
            };
            if [i, c, l].iter().any(|corner| heights[*corner] == NODATA) {
                continue;
            }
            // Legs run along the axes, so heights along them tell the plane.
            let apex = f64::from(heights[c]);
            let [leg_i, leg_l] = [i, l].map(|corner| f64::from(heights[corner]) - apex);
            let height = |u: f64| {
                let [s, t] = local(u);
                // How far from the apex along either axis.
                let [s, t] = [if c == 0 || c == 3 { s } else { 1.0 - s }, if c < 2 { t } else { 1.0 - t }];
                // At even corners the leg to the one before runs along the minor axis.
                if c % 2 == 0 { apex + leg_i * t + leg_l * s } else { apex + leg_i * s + leg_l * t }
            };
            let ends = [from, to].map(|u| self.plane.slope(height(u), u));
            let slopes = if ends[0] < ends[1] { ends } else { [ends[1], ends[0]] };
            let share = if self.sky.shows(slopes) {
                self.sky.cover(slopes);
                1.0
            } else {
                self.sky.share(slopes)
            };
            if share > self.sky.least {
                let region = Region::Triangle([corners[i], corners[c], corners[l]]);
                (self.visit)(Seen { region, slopes, share });
            }
        }
    }
}

#[cfg(test)]
mod tests;
