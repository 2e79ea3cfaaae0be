//! Mountains made by rivers: land that rises while streams cut into it, until both balance.
//!
//! In each step water runs from every node to one lower neighbour, the areas that it drains add up
//! downstream, and the stream power law `dh/dt = uplift - K sqrt(area) dh/ds` is solved implicitly from the
//! sea upwards, each node after the one that it drains to (Braun and Willett 2013). No slope stays steeper
//! than scree. Lattices from coarse to fine share the work: the coarse ones find the great valleys in many
//! cheap steps, the fine ones add their branches in few.

#![allow(
    clippy::cast_possible_truncation,
    clippy::cast_possible_wrap,
    clippy::cast_sign_loss,
    reason = "numbers of nodes of a lattice of a thousand a side"
)]

use super::{hash, noise};
use rayon::prelude::*;
use std::cmp::Reverse;
use std::collections::BinaryHeap;

/// Nodes a side and steps of each lattice: nodes times steps stay within some millions a lattice.
const LATTICES: [(usize, usize); 5] = [(65, 60), (129, 25), (257, 14), (513, 8), (1025, 5)];

/// What a step cuts of a fall of a metre a metre, for each metre of the root of the area drained.
const CUT: f64 = 0.225;

/// What a step raises where the uplift is 1, in metres.
const RAISE: f64 = 100.0;

/// The steepest slope: that of scree.
const SCREE: f64 = 0.75;

/// The eight neighbours of a node.
const AROUND: [[i64; 2]; 8] = [[1, 0], [0, 1], [-1, 0], [0, -1], [1, 1], [-1, 1], [-1, -1], [1, -1]];

/// A square lattice of heights.
pub(super) struct Lattice {
    side: usize,
    heights: Vec<f64>,
}

/// What the land is made from, at a place in parts of the whole.
pub(super) struct Plan {
    /// Metres along each side.
    pub(super) extent: f64,
    /// Where the sea is, at height 0.
    pub(super) is_sea: fn(f64, f64) -> bool,
    /// How fast the land rises: 1 is the scale of high mountains.
    pub(super) uplift: fn(f64, f64) -> f64,
}

/// A lattice on its way, with what stays the same from step to step.
struct Eroding {
    land: Lattice,
    sea: Vec<bool>,
    raise: Vec<f64>,
    /// Where nodes stand, in cells: a little off the lattice, so that valleys do not follow it.
    places: Vec<[f64; 2]>,
    cell: f64,
}

/// Land worn by rivers, of heights above the sea's 0. About a second of one core.
pub(super) fn wear(plan: &Plan) -> Lattice {
    let mut land = Lattice { side: 2, heights: vec![20.0; 4] };
    for (turn, (side, steps)) in (0u32..).zip(LATTICES) {
        let mut eroding = Eroding::refine(plan, &land, side, turn);
        for step in 0..steps {
            // Fine lattices have few hollows left.
            if side < 300 || step == 0 {
                eroding.fill_hollows();
            }
            eroding.step(turn * 1000 + (step / 3) as u32);
        }
        eroding.smooth();
        land = eroding.land;
    }
    land
}

impl Lattice {
    fn at(&self, x: i64, y: i64) -> f64 {
        let last = self.side as i64 - 1;
        self.heights[y.clamp(0, last) as usize * self.side + x.clamp(0, last) as usize]
    }

    /// The height at a place in parts of the whole, on curves through the nodes (Catmull and Rom 1974).
    pub(super) fn height(&self, east: f64, north: f64) -> f64 {
        let cells = (self.side - 1) as f64;
        let (x, y) = (east * cells, north * cells);
        let (i, j) = (x.floor(), y.floor());
        let curve = |[a, b, c, d]: [f64; 4], t: f64| {
            b + 0.5 * t * (c - a + t * (2.0 * a - 5.0 * b + 4.0 * c - d + t * (3.0 * (b - c) + d - a)))
        };
        let four = [-1, 0, 1, 2];
        let row = |dy: i64| curve(four.map(|dx| self.at(i as i64 + dx, j as i64 + dy)), x - i);
        curve(four.map(row), y - j)
    }

    /// The height at a place in cells, interpolated between four nodes.
    fn between(&self, x: f64, y: f64) -> f64 {
        let (i, j) = (x.floor(), y.floor());
        let (u, v) = (x - i, y - j);
        let (i, j) = (i as i64, j as i64);
        let row = |j: i64| self.at(i, j) + (self.at(i + 1, j) - self.at(i, j)) * u;
        row(j) + (row(j + 1) - row(j)) * v
    }
}

impl Eroding {
    /// A finer lattice over the same land. It is bent a little at every scale, so that no valley stays as
    /// straight as the coarser lattice made it.
    fn refine(plan: &Plan, coarse: &Lattice, side: usize, turn: u32) -> Self {
        let last = (side - 1) as f64;
        let (cell, scale) = (plan.extent / last, (coarse.side - 1) as f64 / last);
        let nodes = (0..side * side).into_par_iter().map(|i| {
            let (x, y) = ((i % side) as i32, (i / side) as i32);
            let (fx, fy) = (f64::from(x), f64::from(y));
            let (east, north) = (fx / last, fy / last);
            let (cx, cy) = (fx * scale, fy * scale);
            let bend = |seed: u32| {
                1.1 * noise(cx * 0.31 + 0.5, cy * 0.31 + 0.5, seed + turn)
                    + 0.35 * noise(cx * 0.8, cy * 0.8, seed + 10 + turn)
            };
            let sea = (plan.is_sea)(east, north);
            let rough = 0.1 * cell * hash(x, y, 900 + turn);
            let height = if sea { 0.0 } else { coarse.between(cx + bend(300), cy + bend(400)) + rough };
            let place = [fx + 0.4 * hash(x, y, 0x77 + turn), fy + 0.4 * hash(x, y, 0x99 + turn)];
            (height, sea, RAISE * (plan.uplift)(east, north), place)
        });
        let nodes: Vec<_> = nodes.collect();
        Self {
            land: Lattice { side, heights: nodes.iter().map(|n| n.0).collect() },
            sea: nodes.iter().map(|n| n.1).collect(),
            raise: nodes.iter().map(|n| n.2).collect(),
            places: nodes.iter().map(|n| n.3).collect(),
            cell,
        }
    }

    /// The neighbours of a node, with their number in `AROUND`.
    fn around(&self, i: usize) -> impl Iterator<Item = (usize, usize)> + use<> {
        let side = self.land.side as i64;
        let (x, y) = (i as i64 % side, i as i64 / side);
        AROUND.into_iter().enumerate().filter_map(move |(k, [dx, dy])| {
            let (x, y) = (x + dx, y + dy);
            let inside = (0..side).contains(&x) && (0..side).contains(&y);
            inside.then_some((k, (y * side + x) as usize))
        })
    }

    /// Raises hollows until all land falls towards the sea (Barnes, Lehman and Mulla 2014).
    fn fill_hollows(&mut self) {
        let mut seen = self.sea.clone();
        // Heights are not negative, so their bits are in their order.
        let mut shore: BinaryHeap<Reverse<(u64, usize)>> = (0..seen.len())
            .filter(|i| seen[*i] && self.around(*i).any(|(_, j)| !seen[j]))
            .map(|i| Reverse((0, i)))
            .collect();
        while let Some(Reverse((_, i))) = shore.pop() {
            let height = self.land.heights[i];
            for (_, j) in self.around(i).filter(|(_, j)| !std::mem::replace(&mut seen[*j], true)) {
                let here = &mut self.land.heights[j];
                *here = here.max(height + 0.01);
                shore.push(Reverse((here.to_bits(), j)));
            }
        }
    }

    /// The neighbour that a node drains to and the metres to it; itself if none is lower. Which of several
    /// falls the water takes is a little by chance.
    fn outlet(&self, i: usize, salt: u32) -> (usize, f64) {
        let (mut best, mut outlet) = (0.0, (i, 0.0));
        if self.sea[i] {
            return outlet;
        }
        for (k, j) in self.around(i) {
            let fall = self.land.heights[i] - self.land.heights[j];
            if fall > 0.0 {
                let [dx, dy] = [0, 1].map(|axis| self.places[i][axis] - self.places[j][axis]);
                let cells = (dx * dx + dy * dy).sqrt();
                let pull = fall / cells * (1.0 + 0.2 * hash(i as i32, k as i32, salt));
                if pull > best {
                    (best, outlet) = (pull, (j, cells * self.cell));
                }
            }
        }
        outlet
    }

    fn step(&mut self, salt: u32) {
        let outlets: Vec<_> = (0..self.sea.len()).into_par_iter().map(|i| self.outlet(i, salt)).collect();
        let order = downstream_first(&outlets);
        let mut areas = vec![self.cell * self.cell; outlets.len()];
        for &i in order.iter().rev() {
            let (outlet, _) = outlets[i];
            if outlet != i {
                areas[outlet] += areas[i];
            }
        }
        for &i in &order {
            let (outlet, metres) = outlets[i];
            if self.sea[i] {
                continue;
            }
            let raised = self.land.heights[i] + self.raise[i];
            self.land.heights[i] = if outlet == i {
                raised
            } else {
                let below = self.land.heights[outlet];
                let cut = CUT * areas[i].sqrt() / metres;
                ((raised + cut * below) / (1.0 + cut)).min(below + SCREE * metres)
            };
        }
    }

    /// Rounds crests and hollows of single nodes.
    fn smooth(&mut self) {
        let old = Lattice { side: self.land.side, heights: self.land.heights.clone() };
        for (i, here) in self.land.heights.iter_mut().enumerate().filter(|(i, _)| !self.sea[*i]) {
            let (x, y) = ((i % old.side) as i64, (i / old.side) as i64);
            let around = old.at(x - 1, y) + old.at(x + 1, y) + old.at(x, y - 1) + old.at(x, y + 1);
            *here += 0.15 * (around - 4.0 * *here);
        }
    }
}

/// All nodes, each after the one that it drains to.
fn downstream_first(outlets: &[(usize, f64)]) -> Vec<usize> {
    // The nodes that drain to i are donors[first[i]..first[i + 1]].
    let mut first = vec![0; outlets.len() + 1];
    let drains = |i: usize| outlets[i].0 != i;
    for i in (0..outlets.len()).filter(|i| drains(*i)) {
        first[outlets[i].0 + 1] += 1;
    }
    for i in 1..first.len() {
        first[i] += first[i - 1];
    }
    let (mut free, mut donors) = (first.clone(), vec![0; outlets.len()]);
    for i in (0..outlets.len()).filter(|i| drains(*i)) {
        let slot = &mut free[outlets[i].0];
        donors[*slot] = i;
        *slot += 1;
    }
    let mut order: Vec<usize> = (0..outlets.len()).filter(|i| !drains(*i)).collect();
    let mut next = 0;
    while next < order.len() {
        let i = order[next];
        order.extend_from_slice(&donors[first[i]..first[i + 1]]);
        next += 1;
    }
    order
}
