//! A quadtree split by sums of curvature, then balanced so that neighbours differ by one level at most.
//!
//! Which quadrants are split is one flag a quadrant, level by level. Sums over quadrants come from a table of
//! sums over everything to the south-west, four look-ups each. A quadrant owns its western and southern
//! borders, so that sums add up.
//!
//! A triangle with a corner that has no data is not drawn. So that no others go with it, a quadrant splits in any case while
//! some of its samples have data and some have none, those on its border included.

use super::curvatures;
use crate::experiment::field::Field;

/// Where an observer stands and how much distance forgives.
#[derive(Debug, Clone, Copy)]
pub struct Observer {
    /// Samples from the south-west corner, along x and y.
    pub at: [f64; 2],
    /// The constant a: at the distance of the field's diagonal the threshold is 1 + a times as high.
    pub forgiveness: f64,
}

/// Sums of curvature over any quadrant.
#[derive(Debug)]
pub struct Sums {
    row: usize,
    sums: Vec<f64>,
    /// How many samples without data there are to the south-west, by the same places; `None` if there are none at all.
    missing: Option<Vec<u32>>,
}

impl Sums {
    /// Of a field; each sample's curvature times its weight, if there are any (as many as samples).
    #[must_use]
    pub fn new(field: &Field, weights: Option<&[f32]>) -> Self {
        let row = field.row() + 1;
        let mut sums = vec![0.0; row * row];
        for (slot, curvature) in curvatures(field).into_iter().enumerate() {
            let (x, y) = (slot % field.row(), slot / field.row());
            let weight = weights.map_or(1.0, |w| f64::from(w[slot]));
            let at = (y + 1) * row + x + 1;
            sums[at] = weight * curvature + sums[at - 1] + sums[at - row] - sums[at - row - 1];
        }
        let mut missing = vec![0u32; row * row];
        for (slot, height) in field.heights().iter().enumerate() {
            let at = (slot / field.row() + 1) * row + slot % field.row() + 1;
            missing[at] =
                u32::from(height.is_nan()) + missing[at - 1] + missing[at - row] - missing[at - row - 1];
        }
        let has_any = missing.last().is_some_and(|n| *n > 0);
        Self { row, sums, missing: has_any.then_some(missing) }
    }

    /// Over `size` by `size` samples from (`x`, `y`).
    fn over(&self, x: usize, y: usize, size: usize) -> f64 {
        let at = |x: usize, y: usize| self.sums[y * self.row + x];
        at(x + size, y + size) - at(x, y + size) - at(x + size, y) + at(x, y)
    }
}

impl Sums {
    /// Whether some of the samples of a quadrant, all its borders included, have data and some have none.
    fn is_mixed(&self, x: usize, y: usize, size: usize) -> bool {
        let Some(missing) = &self.missing else { return false };
        let at = |x: usize, y: usize| missing[y * self.row + x];
        let last = size + 1;
        let here = at(x + last, y + last) + at(x, y) - at(x, y + last) - at(x + last, y);
        here > 0 && (here as usize) < last * last
    }
}

/// Which quadrants are split: by level, 2^level a side, rows from the south.
#[derive(Debug, Clone)]
pub struct Quadtree {
    log2: u8,
    split: Vec<Vec<bool>>,
}

impl Quadtree {
    /// Splits from the root while the sum is more than `threshold`, or by the rule for an observer; then
    /// balances.
    #[must_use]
    pub fn new(field: &Field, sums: &Sums, threshold: f64, observer: Option<Observer>) -> Self {
        let levels = usize::from(field.log2());
        let mut split: Vec<Vec<bool>> = (0..levels).map(|l| vec![false; 1 << (2 * l)]).collect();
        for level in 0..levels {
            let (n, size) = (1usize << level, 1usize << (levels - level));
            for j in 0..n {
                for i in 0..n {
                    let exists = level == 0 || split[level - 1][j / 2 * (n / 2) + i / 2];
                    let sum = sums.over(i * size, j * size, size);
                    let is_curved = match observer {
                        None => sum > threshold,
                        Some(o) => sum > 0.0 && sum >= threshold * factor(field, o, [i, j], size),
                    };
                    let is_mixed = || sums.is_mixed(i * size, j * size, size);
                    split[level][j * n + i] = exists && (is_curved || is_mixed());
                }
            }
        }
        let mut tree = Self { log2: field.log2(), split };
        tree.balance();
        tree
    }

    /// Neighbours of what is split must be there themselves; from the finest level up, once.
    fn balance(&mut self) {
        for level in (1..self.split.len()).rev() {
            let n = 1usize << level;
            for slot in (0..n * n).filter(|slot| self.split[level][*slot]).collect::<Vec<_>>() {
                let (i, j) = (slot % n, slot / n);
                let around = [(i.wrapping_sub(1), j), (i + 1, j), (i, j.wrapping_sub(1)), (i, j + 1), (i, j)];
                for (i, j) in around.into_iter().filter(|(i, j)| *i < n && *j < n) {
                    self.split[level - 1][j / 2 * (n / 2) + i / 2] = true;
                }
            }
        }
    }

    /// Base-2 logarithm of the cells along a side.
    #[must_use]
    pub fn log2(&self) -> u8 {
        self.log2
    }

    /// Whether a quadrant is there and split. False outside of the field.
    #[must_use]
    pub fn is_split(&self, level: usize, i: usize, j: usize) -> bool {
        let n = 1usize << level;
        i < n && j < n && self.split.get(level).is_some_and(|flags| flags[j * n + i])
    }

    /// All quadrants that are there and not split: level, column, row.
    #[must_use]
    pub fn leaves(&self) -> Vec<(usize, usize, usize)> {
        let mut list = Vec::new();
        let mut open = vec![(0, 0, 0)];
        while let Some((level, i, j)) = open.pop() {
            if self.is_split(level, i, j) {
                let children = [(0, 0), (1, 0), (0, 1), (1, 1)];
                open.extend(children.map(|(di, dj)| (level + 1, 2 * i + di, 2 * j + dj)));
            } else {
                list.push((level, i, j));
            }
        }
        list
    }
}

/// By how much the distance of a quadrant raises the threshold: a d / D + 1.
fn factor(field: &Field, observer: Observer, place: [usize; 2], size: usize) -> f64 {
    let metres = |axis: usize| {
        let centre = (place[axis] as f64 + 0.5) * size as f64;
        (centre - observer.at[axis]) * field.cell()[axis]
    };
    let side = f64::from(field.side());
    let diagonal = (side * field.cell()[0]).hypot(side * field.cell()[1]);
    observer.forgiveness * metres(0).hypot(metres(1)) / diagonal + 1.0
}
