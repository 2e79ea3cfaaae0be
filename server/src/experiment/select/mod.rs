//! Which points of a field a bitree needs: one interface for all criteria.
//!
//! A [`Criterion`] gives each triangle an error, which may weigh each sample with a mask. Two ways lead from
//! an error to points, and a third mends both:
//!
//! - [`top_down`]: level by level, a triangle splits while its error is more than the tolerance. Its middle
//!   becomes real where it is off its hypotenuse by more than some share of the tolerance, else
//!   it stays fictitious and is not transmitted. With share 0 there are the fewest triangles, with share 1 the fewest
//!   points that a single descent finds.
//! - [`greedy`]: the worst triangle first, until all are good or a number of points is reached.
//! - [`prune`]: takes points out again, finest first, as long as every triangle that changes stays within
//!   the tolerance. It goes over them three times.
//!
//! After the bitree paper, its section 3.2. Every selection is measured anew afterwards, over all samples.

mod criterion;
mod greedy;
mod prune;
mod surface;
mod top_down;

pub use criterion::{Criterion, Ground};
pub use greedy::greedy;
pub use prune::prune;
pub use top_down::top_down;

use diamantina_protocol::bitree::Bitree;
use std::fmt;
use std::ops::ControlFlow;
use surface::Surface;

/// How points were found.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Strategy {
    /// From the top, each middle of a split triangle real; then pruned.
    Compact,
    /// From the top, middles within the tolerance fictitious; then pruned.
    Sparse,
    /// The worst triangle first; then pruned.
    Greedy,
    /// All points at once, by a measure of each point alone.
    Direct,
}

impl fmt::Display for Strategy {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Compact => "compact",
            Self::Sparse => "sparse",
            Self::Greedy => "greedy",
            Self::Direct => "direct",
        })
    }
}

/// The share of a triangle's error that its middle has to explain to become real in a greedy selection. Of 0.3,
/// 0.6 and 0.9 it gave the fewest points and triangles in all windows and at all tolerances.
pub const GREEDY_SHARE: f64 = 0.3;

/// The points that keep a criterion's error of every triangle within `tolerance`, found in one way.
#[must_use]
pub fn by_strategy(ground: &Ground<'_>, criterion: Criterion, tolerance: f64, strategy: Strategy) -> Bitree {
    let refine = |tree| greedy(ground, criterion, tolerance, GREEDY_SHARE, usize::MAX, tree);
    let from_top = |share| {
        let surface = top_down::descend(ground, criterion, tolerance, share);
        match criterion {
            // A fictitious corner is near a steep triangle's plane, and too far from a flatter one's that a point
            // beside it made later; and it tilts the finest triangles. Then the corner itself has to become real, which
            // no descent does.
            Criterion::Euclidean | Criterion::Normal => Surface::of(&refine(surface.into_tree())),
            Criterion::Vertical | Criterion::Curvature | Criterion::Coefficient => surface,
        }
    };
    let surface = match strategy {
        Strategy::Compact => from_top(0.0),
        Strategy::Sparse => from_top(1.0),
        Strategy::Greedy => Surface::of(&refine(ground.field().tree())),
        Strategy::Direct => return criterion.direct(ground, tolerance),
    };
    match criterion.is_measured() {
        true => prune::prune_surface(ground, criterion, tolerance, surface).into_tree(),
        false => surface.into_tree(),
    }
}

/// The points that keep a criterion's error of every triangle within `tolerance`, found in the better way for that
/// criterion, [`Criterion::strategy`].
#[must_use]
pub fn select(ground: &Ground<'_>, criterion: Criterion, tolerance: f64) -> (Bitree, Strategy) {
    let strategy = criterion.strategy();
    (by_strategy(ground, criterion, tolerance, strategy), strategy)
}

/// At most `points` points, corners included, the largest errors first.
#[must_use]
pub fn by_number(ground: &Ground<'_>, criterion: Criterion, points: usize) -> Bitree {
    let refined = || greedy(ground, criterion, 0.0, GREEDY_SHARE, points, ground.field().tree());
    criterion.largest(ground, points).unwrap_or_else(refined)
}

/// What 100 % of a tolerance is by a criterion: of distances the relief, else the error of the corners' two triangles.
#[must_use]
pub fn scale(ground: &Ground<'_>, criterion: Criterion) -> f64 {
    match criterion {
        Criterion::Vertical | Criterion::Euclidean | Criterion::Coefficient => ground.field().relief(),
        Criterion::Curvature | Criterion::Normal => largest_error(ground, criterion, &ground.field().tree()),
    }
}

/// The largest error by a criterion over the triangles that are drawn.
#[must_use]
pub fn largest_error(ground: &Ground<'_>, criterion: Criterion, tree: &Bitree) -> f64 {
    let mut worst = 0.0f64;
    for root in tree.roots() {
        let _ = tree.leaves(&root, &mut |facet| {
            worst = worst.max(criterion.error(ground, facet, f64::INFINITY));
            ControlFlow::Continue(())
        });
    }
    worst
}

#[cfg(test)]
mod tests;
