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
//!
//! Most of what a ray meets was found out by rays before it. Of ground that is known to be seen all over, only the
//! highest slope is of use, and only where something else comes behind it. Such ground is *plain*: it is put off as long
//! as more follows, and then searched from its far end, by blocks that lie below what was found so far.

#![allow(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    clippy::cast_possible_wrap,
    reason = "places are kept within the relief, whose sides are below 2^28; shares of 255 are below 256"
)]

use super::relief::{BLOCKS_LOG2, Relief};
use super::tiled::Tiled;
use crate::progress::Progress;
use diamantina_protocol::NODATA;
use diamantina_protocol::zone::pack;
use rayon::prelude::*;
use std::f64::consts::{FRAC_1_SQRT_2, SQRT_2, TAU};
use std::sync::atomic::{AtomicBool, AtomicU8, Ordering};

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

/// The largest share that is told of a small block as one: less than as good as seen. Where more is open to doubt,
/// its cells tell better.
const BLOCK_SHARE_MAX: f64 = FRAC_1_SQRT_2;

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
        // So many in a quarter: else a ray would run along an axis, and on the edges of triangles.
        ((TAU / (ratio / 2.0).atan()).ceil() as usize).next_multiple_of(4)
    }

    /// The least share that is told apart from hidden.
    fn least(&self) -> f64 {
        self.hidden.max(1.0 / 255.0)
    }
}

/// The visibility of every sample, in 255ths: the largest of the triangles around it, from any of the eyes. What
/// nobody sees has that of [`Optics::hidden`]. `None` if `progress` was told to stop.
///
/// Takes a byte a sample and 1/5 more. The result does not depend on the number of threads.
#[must_use]
pub fn cast(relief: &Relief, optics: &Optics, eyes: &[Eye], progress: &Progress) -> Option<Tiled<u8>> {
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
            // Half a step off the axes.
            let azimuth = (i as f64 + 0.5) / *azimuths as f64 * TAU;
            let plane = Plane::new(relief, optics, *eye, azimuth);
            Walk::new(&plane, optics, &sheets).run();
        }
        if *first == 0 {
            progress.advance(1);
        }
    });
    (!progress.is_stopping()).then(|| sheets.merged())
}

/// What has been seen so far, in 255ths: of samples, in the order of the relief's tiles, and of whole blocks.
struct Sheets<'a> {
    floor: u8,
    relief: &'a Relief,
    heights: &'a Tiled<i32>,
    samples: Vec<AtomicU8>,
    blocks: Vec<AtomicU8>,
    /// The least of the samples of each small block, or what it was not long ago; for larger ones, the least that is
    /// known of the small ones in them.
    least: [Vec<AtomicU8>; BLOCKS_LOG2.len()],
    /// Whether all samples of a block of each kind are known to have heights and to be seen.
    plain: [Vec<AtomicBool>; BLOCKS_LOG2.len()],
}

impl<'a> Sheets<'a> {
    fn new(relief: &'a Relief, floor: u8) -> Self {
        let sheet = |count: usize| (0..count).map(|_| AtomicU8::new(floor)).collect();
        let counts = std::array::from_fn(|which| relief.blocks_size(which).iter().product());
        let heights = relief.heights();
        Self {
            floor,
            relief,
            heights,
            samples: sheet(heights.items().len()),
            blocks: sheet(counts[0]),
            least: counts.map(sheet),
            plain: counts.map(|count| (0..count).map(|_| AtomicBool::new(false)).collect()),
        }
    }

    /// What is known of the samples of a small block.
    fn of_block(&self, [x, y]: [usize; 2]) -> impl Iterator<Item = u8> {
        let side = 1usize << BLOCKS_LOG2[0];
        let [columns, rows] = [0, 1].map(|axis| {
            let first = [x, y][axis] * side;
            first..=(first + side).min(self.heights.size()[axis] - 1)
        });
        rows.map(|y| self.heights.offset(1, y)).flat_map(move |row| {
            let columns = columns.clone().map(|x| self.heights.offset(0, x));
            columns.map(move |column| self.samples[row + column].load(Ordering::Relaxed))
        })
    }

    /// The place of a block in the sheets of its kind.
    fn index(&self, which: usize, [x, y]: [usize; 2]) -> usize {
        y * self.relief.blocks_size(which)[0] + x
    }

    /// The blocks of the next smaller kind in a larger block.
    fn parts(&self, which: usize, block: [usize; 2]) -> impl Iterator<Item = [usize; 2]> {
        let size = self.relief.blocks_size(which - 1);
        let log2 = BLOCKS_LOG2[which] - BLOCKS_LOG2[which - 1];
        let [columns, rows] =
            [0, 1].map(|axis| block[axis] << log2..((block[axis] + 1) << log2).min(size[axis]));
        rows.flat_map(move |y| columns.clone().map(move |x| [x, y]))
    }

    /// The least that is known of what is in a block, or that was not long ago.
    fn least(&self, which: usize, block: [usize; 2]) -> u8 {
        let i = self.index(which, block);
        let least = self.least[which][i].load(Ordering::Relaxed);
        if which == 0 { least.max(self.blocks[i].load(Ordering::Relaxed)) } else { least }
    }

    /// Whether so much is known of all that is in a block of a larger kind.
    fn knows(&self, which: usize, block: [usize; 2], share: u8) -> bool {
        if self.least(which, block) >= share {
            return true;
        }
        let least = self.parts(which, block).map(|part| self.least(which - 1, part)).min().unwrap_or(u8::MAX);
        self.least[which][self.index(which, block)].store(least, Ordering::Relaxed);
        least >= share
    }

    fn merged(self) -> Tiled<u8> {
        let relief = self.relief;
        let mut samples = self.heights.like(self.samples.into_iter().map(AtomicU8::into_inner).collect());
        let side = 1usize << BLOCKS_LOG2[0];
        let [width, height] = relief.size();
        let columns = relief.blocks_size(0)[0];
        for (i, share) in self.blocks.into_iter().map(AtomicU8::into_inner).enumerate() {
            if share == self.floor {
                continue;
            }
            let [x, y] = [i % columns * side, i / columns * side];
            for y in y..=(y + side).min(height - 1) {
                for x in x..=(x + side).min(width - 1) {
                    samples.set([x, y], share.max(samples.at([x, y])));
                }
            }
        }
        samples
    }
}

/// Who is shown what rays meet.
trait Witness {
    fn note(&mut self, seen: Seen);

    /// Whether of a block of the smallest kind so much is known that a share changes nothing.
    fn knows_block(&self, _block: [usize; 2], _share: f64) -> bool {
        false
    }

    /// The same of blocks of a larger kind, for a share of at most [`BLOCK_SHARE_MAX`].
    fn knows_larger(&self, _which: usize, _blocks: [[usize; 2]; 2], _share: f64) -> bool {
        false
    }

    /// Whether all samples of a block are known to have heights and to be seen.
    fn is_plain(&self, _which: usize, _block: [usize; 2]) -> bool {
        false
    }

    /// Finds out whether a block of the smallest kind is plain, and then whether those are that it is in.
    fn look(&self, _block: [usize; 2]) {}

    /// Whether all four samples of a cell, by their place among the heights, are known to be seen.
    fn knows_seen(&self, _corners: [usize; 4]) -> bool {
        false
    }
}

impl<F: FnMut(Seen)> Witness for F {
    fn note(&mut self, seen: Seen) {
        self(seen);
    }
}

impl Witness for &Sheets<'_> {
    fn note(&mut self, seen: Seen) {
        let share = stepped(seen.share, self.floor);
        let raise = |here: &AtomicU8| {
            // Most are known already, and looking costs less than changing.
            if here.load(Ordering::Relaxed) < share {
                here.fetch_max(share, Ordering::Relaxed);
            }
        };
        match seen.region {
            Region::Triangle(corners) => {
                corners.iter().for_each(|c| raise(&self.samples[self.heights.index(*c)]))
            }
            Region::Cell([x, y]) => {
                let columns = [x, x + 1].map(|x| self.heights.offset(0, x));
                for row in [y, y + 1].map(|y| self.heights.offset(1, y)) {
                    columns.iter().for_each(|column| raise(&self.samples[row + column]));
                }
            }
            Region::Block(block) => raise(&self.blocks[self.index(0, block)]),
        }
    }

    fn knows_block(&self, block: [usize; 2], share: f64) -> bool {
        let share = stepped(share, self.floor);
        let known = &self.least[0][self.index(0, block)];
        if known.load(Ordering::Relaxed) >= share {
            return true;
        }
        let least = self.of_block(block).min().unwrap_or(u8::MAX);
        known.store(least, Ordering::Relaxed);
        least >= share
    }

    fn knows_larger(&self, which: usize, blocks: [[usize; 2]; 2], share: f64) -> bool {
        let share = stepped(share, self.floor);
        blocks.iter().all(|block| self.knows(which, *block, share))
    }

    fn is_plain(&self, which: usize, block: [usize; 2]) -> bool {
        self.plain[which][self.index(which, block)].load(Ordering::Relaxed)
    }

    fn look(&self, mut block: [usize; 2]) {
        let is_seen = |block| self.of_block(block).all(|share| share == u8::MAX);
        if self.is_plain(0, block) || self.relief.has_holes(0, [block; 2]) || !is_seen(block) {
            return;
        }
        self.least[0][self.index(0, block)].store(u8::MAX, Ordering::Relaxed);
        for which in 0..BLOCKS_LOG2.len() {
            if which > 0 {
                block = block.map(|w| w >> (BLOCKS_LOG2[which] - BLOCKS_LOG2[which - 1]));
                if !self.parts(which, block).all(|part| self.is_plain(which - 1, part)) {
                    return;
                }
            }
            self.plain[which][self.index(which, block)].store(true, Ordering::Relaxed);
        }
    }

    fn knows_seen(&self, corners: [usize; 4]) -> bool {
        corners.iter().all(|i| self.samples[*i].load(Ordering::Relaxed) == u8::MAX)
    }
}

/// A share as it is kept: in 255ths, at the least of the steps 1, 1/√2, 1/2, ... 1/256 that is not below it, so that
/// masks compress.
fn stepped(share: f64, floor: u8) -> u8 {
    // Half the binary logarithm of the share's square: its exponent, but for a power of two itself.
    let bits = (share * share).to_bits();
    let exponent = (bits >> 52) as i64 - 1023 + i64::from(bits << 12 != 0);
    STEPS[(-exponent).clamp(0, STEPS.len() as i64 - 1) as usize].max(floor)
}

/// 255 times the powers of 1/√2, rounded up.
const STEPS: [u8; 17] = [255, 181, 128, 91, 64, 46, 32, 23, 16, 12, 8, 6, 4, 3, 2, 2, 1];

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
    let plane = Plane::new(relief, optics, eye, azimuth);
    Walk::new(&plane, optics, visit).run();
}

/// The vertical plane of an azimuth. Columns of cells are crossed one by one along the major axis, the one along
/// which the azimuth crosses more of them; `u` counts cells along it from the eye.
struct Plane<'a> {
    relief: &'a Relief,
    heights: &'a Tiled<i32>,
    /// 0 for x, 1 for y. Places in the plane's frame are `[major, minor]`.
    major: usize,
    /// Samples.
    sizes: [usize; 2],
    eye: [f64; 2],
    height: f64,
    /// 1 where the azimuth goes up the major axis, else -1.
    sign: f64,
    /// Cells along the minor axis for one along the major: -1 to 1.
    lean: f64,
    /// Its inverse. Kept, as is `across`: a division costs more than all else at a crossing.
    unlean: f64,
    /// Cells along the major axis for one across the diagonals that rise, and those that fall.
    across: [f64; 2],
    /// Metres for a cell along the major axis.
    step: f64,
    /// Quanta by which the ground sinks at one metre.
    bend: f64,
}

/// A place along the plane.
#[derive(Clone, Copy)]
struct Post {
    u: f64,
    /// Its place along the minor axis.
    minor: f64,
    /// One over its distance in metres.
    inverse: f64,
    /// Quanta by which the eye stands above what is seen at the slope 0 there: its height, and the ground sinks.
    fall: f64,
}

impl Post {
    /// The slope at which a height in quanta is seen.
    fn slope(&self, height: f64) -> f64 {
        let above = height - self.fall;
        if self.inverse.is_finite() { above * self.inverse } else { f64::INFINITY.copysign(above) }
    }
}

/// The most at which a height is seen between two posts.
fn highest_slope(height: f64, [near, far]: [&Post; 2]) -> f64 {
    let above = height - near.fall;
    above * if above > 0.0 { near.inverse } else { far.inverse }
}

/// The least at which a height is seen between two posts.
fn lowest_slope(height: f64, [near, far]: [&Post; 2]) -> f64 {
    let above = height - far.fall;
    above * if above < 0.0 { near.inverse } else { far.inverse }
}

impl<'a> Plane<'a> {
    fn new(relief: &'a Relief, optics: &Optics, eye: Eye, azimuth: f64) -> Self {
        let along = [azimuth.cos() / optics.cell[0], azimuth.sin() / optics.cell[1]];
        let major = usize::from(along[1].abs() > along[0].abs());
        let steep = along[major].abs();
        let (sign, lean) = (1f64.copysign(along[major]), along[1 - major] / steep);
        Self {
            relief,
            heights: relief.heights(),
            major,
            sizes: [relief.size()[major], relief.size()[1 - major]],
            eye: [eye.place[major], eye.place[1 - major]],
            height: eye.height,
            sign,
            lean,
            unlean: 1.0 / lean,
            across: [1.0 / (sign - lean), 1.0 / (sign + lean)],
            step: 1.0 / steep,
            bend: optics.bend / optics.quantum,
        }
    }

    fn post(&self, u: f64) -> Post {
        let distance = u * self.step;
        Post {
            u,
            minor: self.eye[1] + self.lean * u,
            inverse: 1.0 / distance,
            fall: self.height + self.bend * distance * distance,
        }
    }

    /// The post at a line between columns.
    fn at_line(&self, line: usize) -> Post {
        self.post((line as f64 - self.eye[0]) * self.sign)
    }

    fn sample(&self, [k, j]: [usize; 2]) -> [usize; 2] {
        if self.major == 0 { [k, j] } else { [j, k] }
    }

    /// A post's place in a cell, from its first corner.
    fn local(&self, [k, j]: [usize; 2], post: &Post) -> [f64; 2] {
        [self.eye[0] + self.sign * post.u - k as f64, post.minor - j as f64]
    }

    /// On which sides of a cell's diagonal, and how far, two posts are, and the post between them where the plane crosses
    /// it. It rises from the first corner or falls to the second.
    #[inline(always)]
    fn diagonal(&self, cell: [usize; 2], rising: bool, [from, to]: [&Post; 2]) -> ([f64; 2], Option<Post>) {
        let [a, b] = [from, to].map(|post| {
            let [s, t] = self.local(cell, post);
            if rising { s - t } else { s + t - 1.0 }
        });
        let cross = || self.post((from.u - a * self.across[usize::from(!rising)]).clamp(from.u, to.u));
        ([a, b], (a * b < 0.0).then(cross))
    }

    /// The line before a column, seen from the eye.
    fn line_before(&self, column: usize) -> usize {
        if self.sign > 0.0 { column } else { column.wrapping_add(1) }
    }

    /// The line after a column, seen from the eye.
    fn line_after(&self, column: usize) -> usize {
        if self.sign > 0.0 { column + 1 } else { column }
    }

    /// The column beyond a line.
    fn column_beyond(&self, line: usize) -> usize {
        if self.sign > 0.0 { line } else { line.wrapping_sub(1) }
    }

    /// The line beyond a column of blocks.
    fn line_beyond(&self, which: usize, block: usize) -> usize {
        let first = block << BLOCKS_LOG2[which];
        if self.sign > 0.0 { (first + (1 << BLOCKS_LOG2[which])).min(self.sizes[0] - 1) } else { first }
    }

    /// What the plane crosses of a column of blocks between two posts: it leans at most one cell a column, so it is
    /// one block or two.
    fn blocks(&self, which: usize, block: usize, posts: [&Post; 2]) -> [[usize; 2]; 2] {
        let row = |post: &Post| (post.minor.max(0.0) as usize).min(self.sizes[1] - 2) >> BLOCKS_LOG2[which];
        posts.map(|post| self.sample([block, row(post)]))
    }
}

/// The slopes that are still open: all above the horizon, and some windows below it, from low to high.
struct Sky<'a> {
    horizon: f64,
    /// Above this a slope is above the horizon by more than rounding.
    threshold: f64,
    windows: Vec<[f64; 2]>,
    /// The highest slope of all windows.
    ajar: f64,
    /// Whether something without height was passed since the last segment: only there may a window open. A surface
    /// without holes goes on where it was, whatever rounding says.
    after_hole: bool,
    /// Kept to be filled again.
    spare: Vec<[f64; 2]>,
    optics: &'a Optics,
    least: f64,
}

/// Above this a slope is above another by more than rounding.
fn threshold(slope: f64) -> f64 {
    if slope.is_infinite() { slope } else { slope + SAME * (1.0 + slope.abs()) }
}

/// Below this a slope is below another by more than rounding.
fn beneath(slope: f64) -> f64 {
    if slope.is_infinite() { slope } else { slope - 2.0 * SAME * (1.0 + slope.abs()) }
}

fn is_above(a: f64, b: f64) -> bool {
    a > threshold(b)
}

fn overlap([lo, hi]: [f64; 2], [least, most]: [f64; 2]) -> bool {
    is_above(hi, least) && is_above(most, lo)
}

impl<'a> Sky<'a> {
    fn new(optics: &'a Optics) -> Self {
        let (horizon, least) = (f64::NEG_INFINITY, optics.least());
        Self {
            horizon,
            threshold: horizon,
            windows: Vec::new(),
            ajar: horizon,
            after_hole: true,
            spare: Vec::new(),
            optics,
            least,
        }
    }

    /// Whether some of the slopes between two are open.
    fn shows(&self, slopes: [f64; 2]) -> bool {
        slopes[1] > self.threshold
            || slopes[0] < self.ajar && self.windows.iter().any(|window| overlap(slopes, *window))
    }

    /// What the errors of something count for that lies between two slopes, none of them open.
    fn share(&self, [lo, hi]: [f64; 2]) -> f64 {
        if self.optics.angle == 0.0 {
            return 0.0;
        }
        let Optics { quantum, .. } = *self.optics;
        let mut share = self.beside(hi, self.horizon);
        // Towards a border above, the count grows as long as slopes are above h - √(h² + 1): see `beside`.
        if lo * quantum < -0.5 || self.horizon * quantum > 0.5 {
            share = share.max(self.beside(lo, self.horizon));
        }
        // Of windows only the next below and the next above count.
        if !self.windows.is_empty() {
            let above = self.windows.iter().position(|[least, _]| !is_above(hi, *least));
            let below = above.unwrap_or(self.windows.len()).checked_sub(1);
            let borders = [above.map(|i| self.windows[i][0]), below.map(|i| self.windows[i][1])];
            for border in borders.into_iter().flatten() {
                share = share.max(self.beside(lo, border)).max(self.beside(hi, border));
            }
        }
        share.min(1.0)
    }

    /// The same for one slope beside one border of what is open. A vertical error E at the distance t
    /// and the slope s is seen as E / (t (1 + s²)) and changes the slope by E / t. Of all slopes between two, one of
    /// both counts for the most: in between, the quotient has a least value, if any.
    fn beside(&self, slope: f64, border: f64) -> f64 {
        let Optics { angle, quantum, .. } = *self.optics;
        let gap = (border - slope).abs() * quantum;
        let slope = slope * quantum;
        // Straight down, no vertical error is seen.
        if slope.is_infinite() { 1.0 } else { angle * (1.0 + slope * slope) / gap }
    }

    /// Closes the slopes below one, where no windows are open.
    fn raise(&mut self, slope: f64) {
        if slope > self.threshold {
            self.horizon = slope;
            self.threshold = threshold(slope);
        }
    }

    /// Closes the slopes between two.
    fn cover(&mut self, [lo, hi]: [f64; 2]) {
        if lo < self.ajar && self.windows.iter().any(|window| overlap([lo, hi], *window)) {
            // What is left of each; at most two parts.
            let mut before = std::mem::take(&mut self.spare);
            std::mem::swap(&mut before, &mut self.windows);
            for [least, most] in before.drain(..) {
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
            self.spare = before;
        }
        if self.after_hole && is_above(lo, self.horizon) {
            self.windows.push([self.horizon, lo]);
        }
        self.after_hole = false;
        if hi > self.horizon {
            self.horizon = hi;
            self.threshold = threshold(hi);
        }
        while self.windows.len() > WINDOWS_MAX {
            self.windows[1][0] = self.windows[0][0];
            self.windows.remove(0);
        }
        self.ajar = self.windows.last().map_or(f64::NEG_INFINITY, |[_, most]| *most);
    }
}

struct Walk<'a, W> {
    plane: &'a Plane<'a>,
    sky: Sky<'a>,
    witness: W,
    /// Whether a cell was crossed in the last small block that nobody has seen yet.
    has_unseen: bool,
}

/// The whole number below, for numbers above -2.
fn floor(w: f64) -> i32 {
    // The processor's own rounding, which x86-64 has for whole numbers only, and towards zero.
    (w + 2.0) as i32 - 2
}

impl<'a, W: Witness> Walk<'a, W> {
    fn new(plane: &'a Plane<'a>, optics: &'a Optics, witness: W) -> Self {
        Self { plane, sky: Sky::new(optics), witness, has_unseen: false }
    }

    fn run(&mut self) {
        let plane = self.plane;
        let columns = plane.sizes[0] - 1;
        let eye = plane.eye[0];
        // A column number of -1 wraps, and is beyond all columns like any other.
        let mut column =
            if plane.sign > 0.0 { eye.floor() as usize } else { (eye.ceil() as usize).wrapping_sub(1) };
        let mut from = plane.post(0.0);
        // Where plain ground begins that the horizon does not know yet.
        let mut plain = None;
        let [mut looked, mut tried] = [[usize::MAX; BLOCKS_LOG2.len()]; 2];
        // A block that is passed over may end beyond the relief's sides, where cells would have ended the walk.
        let rows = 0.0..=(plane.sizes[1] - 1) as f64;
        'blocks: while column < columns && rows.contains(&from.minor) {
            // A block of plain ground, as large as there is.
            let mut beyond = None;
            for which in 0..BLOCKS_LOG2.len() {
                let block = column >> BLOCKS_LOG2[which];
                if looked[which] == block {
                    break;
                }
                looked[which] = block;
                let line = plane.line_beyond(which, block);
                let to = plane.at_line(line);
                if !self.is_plain(which, block, [&from, &to]) {
                    break;
                }
                beyond = Some((line, to));
            }
            if let Some((line, to)) = beyond {
                plain.get_or_insert((plane.line_before(column), from));
                (column, from) = (plane.column_beyond(line), to);
                continue;
            }
            if let Some(near) = plain.take() {
                self.settle(near, (plane.line_before(column), from));
            }
            for which in (0..BLOCKS_LOG2.len()).rev() {
                let block = column >> BLOCKS_LOG2[which];
                if tried[which] == block {
                    continue;
                }
                tried[which] = block;
                let line = plane.line_beyond(which, block);
                let to = plane.at_line(line);
                if self.is_over(which, block, [&from, &to]) {
                    (column, from) = (plane.column_beyond(line), to);
                    continue 'blocks;
                }
            }
            let line = plane.line_beyond(0, column >> BLOCKS_LOG2[0]);
            match self.block(column, from, line) {
                Some(to) => (column, from) = (plane.column_beyond(line), to),
                None => return,
            }
        }
    }

    /// Crosses a column of small blocks from a column and post on; the post at its far line if that is over the relief.
    fn block(&mut self, mut column: usize, near: Post, far: usize) -> Option<Post> {
        let plane = self.plane;
        let block = column >> BLOCKS_LOG2[0];
        self.has_unseen = false;
        let mut from = near;
        loop {
            let line = plane.line_after(column);
            let to = plane.at_line(line);
            if !self.column::<false>(column, [&from, &to]) {
                return None;
            }
            from = to;
            if line == far {
                break;
            }
            column = plane.column_beyond(line);
        }
        // Most looks at blocks that are not plain are saved so.
        if !self.has_unseen {
            plane.blocks(0, block, [&near, &from]).into_iter().for_each(|block| self.witness.look(block));
        }
        Some(from)
    }

    /// Whether all that the plane crosses in a column of blocks is known to be seen, so that it only hides what is
    /// behind it, and whether it does so by the horizon alone: above all windows, and with the relief beyond it.
    fn is_plain(&self, which: usize, block: usize, posts: [&Post; 2]) -> bool {
        let plane = self.plane;
        if self.sky.after_hole || !(0.0..=(plane.sizes[1] - 1) as f64).contains(&posts[1].minor) {
            return false;
        }
        let blocks = plane.blocks(which, block, posts);
        blocks.iter().all(|block| self.witness.is_plain(which, *block))
            && (self.sky.windows.is_empty()
                || lowest_slope(f64::from(plane.relief.bounds(which, blocks)[0]), posts) >= self.sky.ajar)
    }

    /// Raises the horizon over plain ground between two lines, the nearer first: from far to near, since what is
    /// far is mostly seen at higher slopes, and what lies lower need not be looked at.
    fn settle(&mut self, (start, near): (usize, Post), (mut line, mut to): (usize, Post)) {
        let forward = self.plane.sign > 0.0;
        let before = self.sky.threshold;
        let mut tried = [usize::MAX; BLOCKS_LOG2.len()];
        let plane = self.plane;
        let post = |line| if line == start { near } else { plane.at_line(line) };
        'columns: while line != start {
            let column = if forward { line - 1 } else { line };
            for which in (0..BLOCKS_LOG2.len()).rev() {
                let block = column >> BLOCKS_LOG2[which];
                if tried[which] == block {
                    continue;
                }
                tried[which] = block;
                let first = block << BLOCKS_LOG2[which];
                let nearer =
                    if forward { first.max(start) } else { (first + (1 << BLOCKS_LOG2[which])).min(start) };
                let from = post(nearer);
                let [_, high] = plane.relief.bounds(which, plane.blocks(which, block, [&from, &to]));
                if highest_slope(f64::from(high), [&from, &to]) <= self.sky.threshold {
                    (line, to) = (nearer, from);
                    continue 'columns;
                }
            }
            line = if forward { line - 1 } else { line + 1 };
            let from = post(line);
            let highest = self.sky.horizon;
            self.column::<true>(column, [&from, &to]);
            // Of slopes that are the same the nearest counts, as if they had come in their order.
            if is_above(highest, self.sky.horizon) {
                self.sky.horizon = highest;
            }
            self.sky.threshold = before.max(beneath(self.sky.horizon));
            to = from;
        }
        self.sky.threshold = threshold(self.sky.horizon);
    }

    /// Whether a column of blocks may be passed over, because all that the plane crosses in it is hidden: it is told as
    /// one then. Large blocks bound little, so they are passed over only if nothing is to be told, or nothing new.
    fn is_over(&mut self, which: usize, block: usize, posts: [&Post; 2]) -> bool {
        let plane = self.plane;
        let blocks = plane.blocks(which, block, posts);
        let [low, high] = plane.relief.bounds(which, blocks);
        if low > high {
            self.sky.after_hole = true;
            return true;
        }
        let has_holes = plane.relief.has_holes(which, blocks);
        let slopes = [lowest_slope(f64::from(low), posts), highest_slope(f64::from(high), posts)];
        if self.sky.shows(slopes) {
            return false;
        }
        let share = self.sky.share(slopes);
        if share > self.sky.least {
            if which > 0 {
                let is_known = share <= BLOCK_SHARE_MAX && self.witness.knows_larger(which, blocks, share);
                if is_known {
                    self.sky.after_hole = has_holes;
                }
                return is_known;
            }
            if share > BLOCK_SHARE_MAX {
                let is_known = blocks.iter().all(|block| self.witness.knows_block(*block, share));
                if is_known {
                    self.sky.after_hole = has_holes;
                }
                return is_known;
            }
            for block in blocks {
                self.witness.note(Seen { region: Region::Block(block), slopes, share });
            }
        }
        self.sky.after_hole = has_holes;
        true
    }

    /// Crosses a column; whether the plane is still over the relief at its end.
    fn column<const PLAIN: bool>(&mut self, column: usize, [from, to]: [&Post; 2]) -> bool {
        let low = from.minor.min(to.minor);
        // It leans at most one cell a column, so it crosses one line between rows at most.
        let line = f64::from(floor(low) + 1);
        if line < from.minor.max(to.minor) {
            let cross = (line - self.plane.eye[1]) * self.plane.unlean;
            if cross > from.u && cross < to.u {
                let cross = self.plane.post(cross);
                return self.in_row::<PLAIN>(column, [from, &cross])
                    && self.in_row::<PLAIN>(column, [&cross, to]);
            }
        }
        self.in_row::<PLAIN>(column, [from, to])
    }

    /// Crosses a column between lines of rows, too; whether that is over the relief.
    fn in_row<const PLAIN: bool>(&mut self, column: usize, [from, to]: [&Post; 2]) -> bool {
        if from.u >= to.u {
            return true;
        }
        let middle = f64::midpoint(from.minor, to.minor);
        if middle < 0.0 || middle > (self.plane.sizes[1] - 1) as f64 {
            return false;
        }
        let row = (middle as usize).min(self.plane.sizes[1] - 2);
        self.cell::<PLAIN>([column, row], [from, to]);
        true
    }

    /// Crosses a cell: one small triangle or two. Of a plain one, only the horizon above it is of use.
    fn cell<const PLAIN: bool>(&mut self, [k, j]: [usize; 2], [from, to]: [&Post; 2]) {
        let plane = self.plane;
        let (major, minor) = (plane.major, 1 - plane.major);
        let columns = [k, k + 1].map(|k| plane.heights.offset(major, k));
        let rows = [j, j + 1].map(|j| plane.heights.offset(minor, j));
        let items = plane.heights.items();
        let places = [columns[0] + rows[0], columns[1] + rows[0], columns[1] + rows[1], columns[0] + rows[1]];
        let heights = places.map(|i| items[i]);
        let [a, b, c, d] = heights;
        let high = a.max(b).max(c.max(d));
        let posts = [from, to];
        if PLAIN {
            if highest_slope(f64::from(high), posts) > self.sky.threshold {
                self.raise([k, j], heights, posts);
            }
            return;
        }
        let mut low = a.min(b).min(c.min(d));
        let has_hole = low == NODATA;
        if has_hole {
            if high == NODATA {
                self.sky.after_hole = true;
                return;
            }
            low = heights.iter().copied().filter(|h| *h != NODATA).fold(high, i32::min);
        }
        let slopes = [lowest_slope(f64::from(low), posts), highest_slope(f64::from(high), posts)];
        if !self.sky.shows(slopes) {
            // Its triangles are not looked at one by one.
            self.sky.after_hole = has_hole;
            if self.witness.knows_seen(places) {
                return;
            }
            let share = self.sky.share(slopes);
            self.has_unseen |= share <= BLOCK_SHARE_MAX;
            if share > self.sky.least {
                self.witness.note(Seen { region: Region::Cell(plane.sample([k, j])), slopes, share });
            }
            return;
        }
        let is_known = self.witness.knows_seen(places);
        self.triangles([k, j], heights, posts, is_known);
    }

    /// Raises the horizon over the triangles of a plain cell, to the very slopes that [`Self::triangles`] finds.
    fn raise(&mut self, cell: [usize; 2], heights: [i32; 4], [from, to]: [&Post; 2]) {
        let plane = self.plane;
        let rising = (cell[0] + cell[1]).is_multiple_of(2);
        let [h0, h1, h2, h3] = heights.map(f64::from);
        // Chosen without branches: nothing foretells in which triangle a ray is.
        let slope = |post: &Post, is_left: bool| {
            let is_lower = rising != is_left;
            let at = if is_lower || rising { h0 } else { h1 + h3 - h2 };
            let along = if is_lower { h1 - h0 } else { h2 - h3 };
            let across = if is_left { h3 - h0 } else { h2 - h1 };
            let [s, t] = plane.local(cell, post);
            post.slope(at + along * s + across * t)
        };
        let ([a, b], cross) = plane.diagonal(cell, rising, [from, to]);
        let cross = cross.unwrap_or(*to);
        for ([from, to], side) in [([from, &cross], if a == 0.0 { b } else { a }), ([&cross, to], b)] {
            if from.u < to.u {
                let ends = [from, to].map(|post| slope(post, side < 0.0));
                self.sky.raise(if ends[0] < ends[1] { ends[1] } else { ends[0] });
            }
        }
    }

    /// Crosses the triangles of a cell. If it is known that all of them are seen, they only hide what is behind them.
    fn triangles(&mut self, [k, j]: [usize; 2], heights: [i32; 4], [from, to]: [&Post; 2], is_known: bool) {
        let plane = self.plane;
        let rising = (k + j).is_multiple_of(2);
        let corners = [[k, j], [k + 1, j], [k + 1, j + 1], [k, j + 1]].map(|c| plane.sample(c));
        let ([a, b], cross) = plane.diagonal([k, j], rising, [from, to]);
        let cross = cross.unwrap_or(*to);
        let [h0, h1, h2, h3] = heights.map(f64::from);
        for ([from, to], side) in [([from, &cross], if a == 0.0 { b } else { a }), ([&cross, to], b)] {
            if from.u >= to.u {
                continue;
            }
            // A triangle's corners, and its plane: the height at the cell's first corner, and slopes along its axes.
            let ([i, c, l], [at, along, across]) = match (rising, side < 0.0) {
                (true, false) => ([0, 1, 2], [h0, h1 - h0, h2 - h1]),
                (true, true) => ([2, 3, 0], [h0, h2 - h3, h3 - h0]),
                (false, true) => ([3, 0, 1], [h0, h1 - h0, h3 - h0]),
                (false, false) => ([1, 2, 3], [h1 + h3 - h2, h2 - h3, h2 - h1]),
            };
            if [i, c, l].iter().any(|corner| heights[*corner] == NODATA) {
                self.sky.after_hole = true;
                continue;
            }
            let ends = [from, to].map(|post| {
                let [s, t] = plane.local([k, j], post);
                post.slope(at + along * s + across * t)
            });
            let slopes = if ends[0] < ends[1] { ends } else { [ends[1], ends[0]] };
            let share = if self.sky.shows(slopes) {
                self.sky.cover(slopes);
                1.0
            } else {
                self.sky.after_hole = false;
                if is_known { 0.0 } else { self.sky.share(slopes) }
            };
            if share > self.sky.least && !is_known {
                let region = Region::Triangle([corners[i], corners[c], corners[l]]);
                self.witness.note(Seen { region, slopes, share });
            }
        }
    }
}

#[cfg(test)]
mod tests;
