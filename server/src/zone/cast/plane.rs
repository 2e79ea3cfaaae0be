//! The vertical plane of an azimuth, and where it crosses lines of the relief.

#![allow(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    clippy::cast_possible_wrap,
    reason = "places are kept within the relief, whose sides are below 2^28; shares of 255 are below 256"
)]

use super::{Eye, Optics};
use crate::zone::relief::{BLOCKS_LOG2, Relief};
use crate::zone::tiled::Tiled;

/// No plane leans closer than this to one cell a column. Along a diagonal, rounding would say anew in each cell on
/// which side of it the plane is, and rays would pass voids of both sides, where each side is whole. This is so little
/// that nothing is seen otherwise, and so much that a cell from the eye rounding is far smaller, in reliefs of a million
/// samples, too.
const OFF_DIAGONAL: f64 = 1e-9;

/// The vertical plane of an azimuth. Columns of cells are crossed one by one along the major axis, the one along
/// which the azimuth crosses more of them; `u` counts cells along it from the eye.
pub(super) struct Plane<'a> {
    pub(super) relief: &'a Relief,
    pub(super) heights: &'a Tiled<i32>,
    /// 0 for x, 1 for y. Places in the plane's frame are `[major, minor]`.
    pub(super) major: usize,
    /// Samples.
    pub(super) sizes: [usize; 2],
    pub(super) eye: [f64; 2],
    pub(super) height: f64,
    /// 1 where the azimuth goes up the major axis, else -1.
    pub(super) sign: f64,
    /// Cells along the minor axis for one along the major: between -1 and 1, by [`OFF_DIAGONAL`] at least.
    pub(super) lean: f64,
    /// Its inverse. Kept, as is `across`: a division costs more than all else at a crossing.
    pub(super) unlean: f64,
    /// Cells along the major axis for one across the diagonals that rise, and those that fall.
    pub(super) across: [f64; 2],
    /// Metres for a cell along the major axis.
    pub(super) step: f64,
    /// Quanta by which the ground sinks at one metre.
    pub(super) bend: f64,
}

/// A place along the plane.
#[derive(Clone, Copy)]
pub(super) struct Post {
    pub(super) u: f64,
    /// Its place along the minor axis.
    pub(super) minor: f64,
    /// One over its distance in metres.
    pub(super) inverse: f64,
    /// Quanta by which the eye stands above what is seen at the slope 0 there: its height, and the ground sinks.
    pub(super) fall: f64,
}

impl Post {
    /// The slope at which a height in quanta is seen.
    pub(super) fn slope(&self, height: f64) -> f64 {
        let above = height - self.fall;
        if self.inverse.is_finite() { above * self.inverse } else { f64::INFINITY.copysign(above) }
    }
}

/// The most at which a height is seen between two posts.
pub(super) fn highest_slope(height: f64, [near, far]: [&Post; 2]) -> f64 {
    let above = height - near.fall;
    above * if above > 0.0 { near.inverse } else { far.inverse }
}

/// The least at which a height is seen between two posts.
pub(super) fn lowest_slope(height: f64, [near, far]: [&Post; 2]) -> f64 {
    let above = height - far.fall;
    above * if above < 0.0 { near.inverse } else { far.inverse }
}

impl<'a> Plane<'a> {
    pub(super) fn new(relief: &'a Relief, optics: &Optics, eye: Eye, azimuth: f64) -> Self {
        let along = [azimuth.cos() / optics.cell[0], azimuth.sin() / optics.cell[1]];
        // Whichever of both rounding makes the longer along a diagonal, it is x.
        let major = usize::from(along[1].abs() * (1.0 - OFF_DIAGONAL) > along[0].abs());
        let steep = along[major].abs();
        let most = 1.0 - OFF_DIAGONAL;
        let (sign, lean) = (1f64.copysign(along[major]), (along[1 - major] / steep).clamp(-most, most));
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

    pub(super) fn post(&self, u: f64) -> Post {
        let distance = u * self.step;
        Post {
            u,
            minor: self.eye[1] + self.lean * u,
            inverse: 1.0 / distance,
            fall: self.height + self.bend * distance * distance,
        }
    }

    /// The post at a line between columns.
    pub(super) fn at_line(&self, line: usize) -> Post {
        self.post((line as f64 - self.eye[0]) * self.sign)
    }

    pub(super) fn sample(&self, [k, j]: [usize; 2]) -> [usize; 2] {
        if self.major == 0 { [k, j] } else { [j, k] }
    }

    /// A post's place in a cell, from its first corner.
    pub(super) fn local(&self, [k, j]: [usize; 2], post: &Post) -> [f64; 2] {
        [self.eye[0] + self.sign * post.u - k as f64, post.minor - j as f64]
    }

    /// On which sides of a cell's diagonal, and how far, two posts are, and the post between them where the plane crosses
    /// it. It rises from the first corner or falls to the second.
    #[inline(always)]
    pub(super) fn diagonal(
        &self,
        cell: [usize; 2],
        rising: bool,
        [from, to]: [&Post; 2],
    ) -> ([f64; 2], Option<Post>) {
        let [a, b] = [from, to].map(|post| {
            let [s, t] = self.local(cell, post);
            if rising { s - t } else { s + t - 1.0 }
        });
        let cross = || self.post((from.u - a * self.across[usize::from(!rising)]).clamp(from.u, to.u));
        ([a, b], (a * b < 0.0).then(cross))
    }

    /// The line before a column, seen from the eye.
    pub(super) fn line_before(&self, column: usize) -> usize {
        if self.sign > 0.0 { column } else { column.wrapping_add(1) }
    }

    /// The line after a column, seen from the eye.
    pub(super) fn line_after(&self, column: usize) -> usize {
        if self.sign > 0.0 { column + 1 } else { column }
    }

    /// The column beyond a line.
    pub(super) fn column_beyond(&self, line: usize) -> usize {
        if self.sign > 0.0 { line } else { line.wrapping_sub(1) }
    }

    /// The line beyond a column of blocks.
    pub(super) fn line_beyond(&self, which: usize, block: usize) -> usize {
        let first = block << BLOCKS_LOG2[which];
        if self.sign > 0.0 { (first + (1 << BLOCKS_LOG2[which])).min(self.sizes[0] - 1) } else { first }
    }

    /// What the plane crosses of a column of blocks between two posts: it leans at most one cell a column, so it is
    /// one block or two.
    pub(super) fn blocks(&self, which: usize, block: usize, posts: [&Post; 2]) -> [[usize; 2]; 2] {
        let row = |post: &Post| (post.minor.max(0.0) as usize).min(self.sizes[1] - 2) >> BLOCKS_LOG2[which];
        posts.map(|post| self.sample([block, row(post)]))
    }
}
