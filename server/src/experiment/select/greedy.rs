//! Selection by the worst triangle first.
//!
//! A queue holds triangles by error. The worst one is halved: if its middle, or a corner that is fictitious so
//! far, is off by a share of its error, that point becomes real and everything drawn around it is measured again;
//! if not, the halves go on by themselves, and nothing is transmitted for that. Entries that a later point has
//! overtaken are recognised by their error, which is no longer the one last known.

use super::{Criterion, Ground};
use crate::experiment::field::Field;
use diamantina_protocol::bintree::Point;
use diamantina_protocol::bitree::{Bitree, Facet};
use std::collections::BinaryHeap;
use std::ops::ControlFlow;

/// Triangles by error, and what is known of each. 8 bytes a triangle of the grid.
struct Queue<'a, 'b> {
    ground: &'a Ground<'b>,
    criterion: Criterion,
    tolerance: f64,
    /// Bits of errors, which order as the errors do since none is negative; then the path.
    heap: BinaryHeap<(u64, u32)>,
    /// By path, the bits of the error that is queued; 0 for none.
    known: Vec<u64>,
}

impl Queue<'_, '_> {
    fn push(&mut self, facet: &Facet) {
        let error = self.criterion.error(self.ground, facet, f64::INFINITY);
        let known = &mut self.known[facet.path() as usize];
        if error > self.tolerance && *known != error.to_bits() {
            self.heap.push((error.to_bits(), facet.path()));
        }
        *known = error.to_bits();
    }

    /// All that is drawn at and below a triangle.
    fn push_drawn(&mut self, tree: &Bitree, from: &Facet) {
        let _ = tree.leaves(from, &mut |leaf| {
            self.push(leaf);
            ControlFlow::Continue(())
        });
    }

    /// The worst error and its path, if what is known has not changed since.
    fn pop(&mut self) -> Option<(f64, u32)> {
        loop {
            let (bits, path) = self.heap.pop()?;
            if self.known[path as usize] == bits {
                self.known[path as usize] = 0;
                return Some((f64::from_bits(bits), path));
            }
        }
    }
}

/// Adds points to a selection, splitting the worst triangle until none is worse than `tolerance`, or
/// `points_max` points are real, corners included. `share` of a triangle's error has to be at its middle for
/// that to become real; by criteria that are no distances any.
#[must_use]
pub fn greedy(
    ground: &Ground<'_>,
    criterion: Criterion,
    tolerance: f64,
    share: f64,
    points_max: usize,
    mut tree: Bitree,
) -> Bitree {
    let field = ground.field();
    let known = vec![0; 4 << (2 * field.log2())];
    let mut queue = Queue { ground, criterion, tolerance, heap: BinaryHeap::new(), known };
    let mut points = tree.points().0;
    for root in tree.roots() {
        queue.push_drawn(&tree, &root);
    }
    while points < points_max
        && let Some((error, path)) = queue.pop()
    {
        let Some(facet) = tree.facet(path) else { continue };
        if tree.is_split(&facet) {
            queue.push_drawn(&tree, &facet);
            continue;
        }
        let (mut point, off) = farthest(field, &facet);
        let is_blind = criterion.splits_level() && field.at(point).is_nan();
        if is_blind && let Some(below) = field.known_below(facet.corners()) {
            point = below;
        }
        let is_level = off == 0.0 && criterion.splits_level() && !field.at(point).is_nan();
        if is_level || off > share * error || (off > 0.0 && !criterion.is_distance()) {
            tree.add(point, field.at(point));
            points += 1;
            if is_blind {
                queue.push_drawn(&tree, &facet);
            }
            for half in tree.around(point).into_iter().flatten().flat_map(|t| tree.halves(&t)) {
                queue.push_drawn(&tree, &half);
            }
        } else if facet.level() < 2 * u32::from(field.log2()) {
            for half in tree.halves(&facet) {
                queue.push(&half);
            }
        }
    }
    tree
}

/// Of the middle and the corners of a triangle, the point whose sample is farthest off the surface; the middle if none is.
/// Whatever its weight: others' triangles, which may count, hang on it.
fn farthest(field: &Field, facet: &Facet) -> (Point, f64) {
    let [ha, _, hb] = facet.heights();
    let is_finest = facet.level() >= 2 * u32::from(field.log2());
    let middle = (facet.middle(), (ha + hb) / 2.0);
    let corners = facet.corners().into_iter().zip(facet.heights());
    let mut best = (facet.middle(), 0.0);
    for (point, height) in corners.chain((!is_finest).then_some(middle)) {
        let off = (field.at(point) - height).abs();
        if off > best.1 {
            best = (point, off);
        }
    }
    best
}
