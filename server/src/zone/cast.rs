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

mod plane;
mod sheets;
mod sky;

use super::relief::{BLOCKS_LOG2, Relief};
use super::tiled::Tiled;
use crate::progress::Progress;
use diamantina_protocol::NODATA;
use diamantina_protocol::zone::pack;
use plane::{Plane, Post, highest_slope, lowest_slope};
use rayon::prelude::*;
use sheets::{Sheets, Witness};
use sky::{Sky, beneath, is_above, threshold};
use std::f64::consts::{FRAC_1_SQRT_2, SQRT_2, TAU};

/// The radius of the Earth, in metres: the mean of its axes.
const EARTH_RADIUS: f64 = 6_371_009.0;

/// How much light bends with the Earth's surface: the usual coefficient of refraction.
const REFRACTION: f64 = 0.13;

/// Metres that the ground sinks at a distance of one metre, with the square of the distance.
pub const BEND: f64 = (1.0 - REFRACTION) / (2.0 * EARTH_RADIUS);

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
