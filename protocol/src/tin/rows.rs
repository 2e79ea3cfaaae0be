//! The heights of a whole lattice, row by row from the south: each by how far it is from what those before let it expect.
//!
//! ```text
//!    ww  w   *          * is expected where a plane through the others would have it, if they lie in one; by
//!        sw  s  se      weights that suit surveys, which are smoother than noise and rougher than planes.
//!            ss
//! ```
//!
//! Beyond the ends of a row its slope goes on. How large a difference will be is told by those in the row below, never by
//! those beside it: so the classes of a row are known before its first number, and two lanes run through it side by side.

#![allow(
    clippy::cast_possible_truncation,
    clippy::cast_possible_wrap,
    clippy::cast_sign_loss,
    reason = "a lattice has fewer than 2^16 points, columns are within 2^8, and means of sizes below 2^27"
)]

use super::lattice::Row;
use super::numbers::Class;
use super::walk::Fault;
use crate::HEIGHT_MAX;

/// Weights of what is known, in sixteenths; they add up to one, and have planes go on.
const W: i32 = 17;
const WW: i32 = -4;
const S: i32 = 3;
const SW: i32 = -3;
const SE: i32 = 6;
const SS: i32 = -3;

/// Heights are taken less of the first one. With these weights no sum of such heights exceeds 32 bits.
const FAR: i32 = 2 * HEIGHT_MAX;

/// Places beyond the ends of a row that those above may look at: a row ends one place after the one below at most.
const MARGIN: usize = 4;

/// The mean magnitude, in sixteenths, before the first row.
const MEAN: u32 = 64;

/// One end of the wire.
pub(super) trait End {
    /// Whether it knows the heights.
    const SENDS: bool;
    /// Sends a row's numbers, each under its class, or receives them: of magnitudes below 2^30.
    fn row(&mut self, classes: &[Class], numbers: &mut [i32]) -> Result<(), Fault>;
}

/// A row with a margin, told by columns.
#[derive(Clone)]
struct Line {
    /// The column of the first place.
    west: i32,
    heights: Vec<i32>,
}

impl Line {
    fn at(&self, x: i32) -> usize {
        (x - self.west) as usize
    }

    /// So many heights from a column on.
    fn from(&self, x: i32, count: usize) -> &[i32] {
        let at = self.at(x);
        &self.heights[at..at + count]
    }

    /// Goes on beyond both ends of a row that has been filled in.
    fn extend(&mut self, row: Row) {
        let (first, last) = (self.at(row.first), self.at(row.last));
        let inner = usize::from(last > first);
        for (end, inside, way) in [(first, first + inner, -1isize), (last, last - inner, 1)] {
            let slope = self.heights[end] - self.heights[inside];
            let mut height = self.heights[end];
            for away in 1..=MARGIN {
                height = (height + slope).clamp(-FAR, FAR);
                self.heights[end.wrapping_add_signed(way * away as isize)] = height;
            }
        }
    }
}

/// Takes both ends over all rows: heights less of the first one, row by row.
pub(super) fn pass<E: End>(rows: &[Row], heights: &mut [i32], end: &mut E) -> Result<(), Fault> {
    let west = rows.iter().map(|row| row.first).min().unwrap_or(0) - MARGIN as i32;
    let east = rows.iter().map(|row| row.last).max().unwrap_or(0) + MARGIN as i32;
    let width = (east - west + 1) as usize;
    let line = Line { west, heights: vec![0; width] };
    let mut lines = [line.clone(), line.clone(), line];
    let (mut guesses, mut numbers, mut classes) =
        (vec![0; width], vec![0; width], vec![Class::default(); width]);
    let mut sizes = vec![MEAN; width];
    let mut mean = MEAN;
    for (j, row) in rows.iter().enumerate() {
        let count = row.len();
        let heights = &mut heights[row.before as usize..][..count];
        let [here, below, beneath] = &mut lines;
        let first = here.at(row.first);
        let (guesses, numbers, classes) =
            (&mut guesses[..count], &mut numbers[..count], &mut classes[..count]);
        // Of the first row nothing is known but the row itself.
        let along = if j == 0 { [16, 0] } else { [W, WW] };
        if j > 0 {
            guess(guesses, row.first, below, beneath);
            for back in [1, 2] {
                let x = row.first - back;
                here.heights[first - back as usize] =
                    (2 * below.heights[below.at(x)] - beneath.heights[beneath.at(x)]).clamp(-FAR, FAR);
            }
        }
        for (class, near) in classes.iter_mut().zip(sizes[first - 1..=first + count].windows(3)) {
            *class = Class::of((near[0] + 2 * near[1] + near[2] + 2 * mean) / 6);
        }
        let known = &mut here.heights[first - 2..first + count];
        if E::SENDS {
            known[2..].copy_from_slice(heights);
            for (((number, height), guess), before) in
                numbers.iter_mut().zip(&*heights).zip(&*guesses).zip(known.windows(2))
            {
                *number = height - expected(*guess, along, before[1], before[0]);
            }
        }
        end.row(classes, numbers)?;
        if !E::SENDS {
            let (mut before, mut last) = (known[0], known[1]);
            for ((height, number), (guess, known)) in
                heights.iter_mut().zip(&*numbers).zip(guesses.iter().zip(&mut known[2..]))
            {
                *height = number + expected(*guess, along, last, before);
                if height.unsigned_abs() > FAR.unsigned_abs() {
                    return Err(Fault::Place);
                }
                *known = *height;
                (before, last) = (last, *height);
            }
        }
        here.extend(*row);
        if j == 0 {
            below.heights.clone_from(&here.heights);
        }
        let mut sum = 0u64;
        for (size, number) in sizes[first..].iter_mut().zip(&*numbers) {
            let magnitude = number.unsigned_abs().min(SIZE_MAX) << 4;
            sum += u64::from(magnitude);
            *size = (*size + 3 * magnitude) / 4;
        }
        let (begin, finish) = (sizes[first], sizes[first + count - 1]);
        sizes[first - MARGIN..first].fill(begin);
        sizes[first + count..][..MARGIN].fill(finish);
        mean = (mean + 3 * (sum / count as u64) as u32) / 4;
        lines.rotate_right(1);
    }
    Ok(())
}

/// The largest size of a difference that is told from larger ones.
const SIZE_MAX: u32 = 1 << 22;

/// What the rows below say of a row that begins at a column, in sixteenths.
fn guess(guesses: &mut [i32], first: i32, below: &Line, beneath: &Line) {
    let near = below.from(first - 1, guesses.len() + 2);
    let far = beneath.from(first, guesses.len());
    for ((guess, near), far) in guesses.iter_mut().zip(near.windows(3)).zip(far) {
        *guess = SW * near[0] + S * near[1] + SE * near[2] + SS * far;
    }
}

/// The height that is expected, given the two before.
#[inline(always)]
fn expected(guess: i32, [w, ww]: [i32; 2], last: i32, before: i32) -> i32 {
    (guess + w * last + ww * before + 8) >> 4
}
