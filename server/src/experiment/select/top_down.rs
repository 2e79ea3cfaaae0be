//! Selection from the top, level by level.
//!
//! Going by levels means that the ends of a hypotenuse have their final heights before its middle is judged,
//! so each triangle is judged by the surface that it will be part of. A middle that becomes real for the
//! sake of one triangle moves the other one at the same hypotenuse, too: its halves are judged again, even where the
//! triangle, or a larger one that it is part of, was good enough before.
//!
//! Each triangle scans its samples only until the tolerance is passed; a triangle that is good is scanned
//! once. So the cost is at most one scan of the field a level, and usually two or three in all.

use super::{Criterion, Ground};
use diamantina_protocol::bintree::Point;
use diamantina_protocol::bitree::{Bitree, Draft, Facet};

/// One bit for each triangle of a grid.
struct Queued(Vec<u64>);

impl Queued {
    /// Whether it was not there yet.
    fn insert(&mut self, path: u32) -> bool {
        let (word, bit) = (path as usize / 64, 1u64 << (path % 64));
        let before = self.0[word];
        self.0[word] |= bit;
        before & bit == 0
    }
}

/// The points of a descent; middles that are off by no more than `share` of the tolerance stay fictitious. By criteria
/// that are no distances each middle that is off at all is real, by sums any. Every triangle is within the tolerance
/// afterwards, down to the finest ones, which cannot split.
#[must_use]
pub fn top_down(ground: &Ground<'_>, criterion: Criterion, tolerance: f64, share: f64) -> Bitree {
    descend(ground, criterion, tolerance, share).0
}

/// The same, with those of its points that might go again. A point whose own sample would be off by more than the
/// tolerance without it has to stay, and most are such: what they hang between has its final height by then.
pub(super) fn descend(
    ground: &Ground<'_>,
    criterion: Criterion,
    tolerance: f64,
    share: f64,
) -> (Bitree, Vec<Point>) {
    let field = ground.field();
    let tree = field.tree();
    let finest = 2 * u32::from(field.log2());
    let mut queued = Queued(vec![0; (4usize << finest).div_ceil(64)]);
    let mut now = tree.roots().to_vec();
    let mut draft = Draft::of(tree);
    // How many of a point's triangles are split for their own sake; a point is the middle of those of one level.
    let mut split_at = vec![0u8; field.heights().len()];
    let mut may_go = Vec::new();
    // Kept from level to level, since they are large.
    let (mut split, mut across) = (Vec::new(), Vec::new());
    for level in 0..finest {
        now.retain(|facet| {
            // The middle is one of the samples, and often tells enough.
            let middle = ground.field().slot(facet.middle());
            criterion.is_beyond(ground, middle, off(ground, facet), tolerance)
                || criterion.error(ground, facet, tolerance) > tolerance
        });
        for facet in &now {
            split_at[field.slot(facet.middle())] += 1;
        }
        across.clear();
        for facet in &now {
            let m = facet.middle();
            let off = off(ground, facet);
            if off.is_nan() && criterion.splits_level() {
                // Any real point below makes the middle fictitious.
                if let Some(below) = field.known_below(facet.corners()) {
                    draft.add(below, field.at(below));
                }
                continue;
            }
            // Whatever the middle's own weight: triangles that count hang on it.
            let is_off = if criterion.is_distance() {
                off.abs() > share * tolerance
            } else {
                off != 0.0 || criterion.splits_level()
            };
            if is_off && !off.is_nan() && draft.add(m, field.at(m)).is_none() {
                if !criterion.is_beyond(ground, field.slot(m), off, tolerance) {
                    may_go.push(m);
                }
                let is_outermost = m.iter().any(|w| *w == 0 || *w == 1 << field.log2());
                if split_at[field.slot(m)] < 2 && !is_outermost {
                    across.extend(draft.around(m).into_iter().flatten());
                }
            }
        }
        std::mem::swap(&mut split, &mut now);
        if level + 1 == finest {
            break;
        }
        now.clear();
        now.reserve(2 * (split.len() + across.len()));
        for facet in split.iter().chain(&across).filter(|facet| queued.insert(facet.path())) {
            now.extend(draft.halves(facet));
        }
    }
    (draft.finish(), may_go)
}

/// How far the sample at a triangle's middle is above the hypotenuse; NaN without data.
fn off(ground: &Ground<'_>, facet: &Facet) -> f64 {
    let [ha, _, hb] = facet.heights();
    ground.field().at(facet.middle()) - (ha + hb) / 2.0
}
