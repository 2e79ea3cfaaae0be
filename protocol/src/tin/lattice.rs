//! Whole lattices: patches with every point of their square, each cell cut along the diagonal of the bintree.
//!
//! What the finest patches of a source are where all samples have heights, and so half of the triangles of a store. Their
//! triangles need not be told, nor be looked at one by one: all is arithmetic. Points are numbered row by row.

#![allow(
    clippy::cast_possible_truncation,
    clippy::cast_possible_wrap,
    clippy::cast_sign_loss,
    reason = "a lattice has fewer than 2^16 points, and its coordinates are within 2^8 of its centre"
)]

use super::place::Square;
use super::walk::NONE;
use super::{Neighbours, Patch, TRIANGLES_MAX, Vertex};
use crate::bintree::{Forest, Point};
use crate::diamond::Diamond;

/// Columns of cells that are gone through at once: so many that a row's vertices are still cached in the next one.
const BAND: i32 = 12;

/// The lattice of a diamond's square, in steps from its centre.
pub(super) struct Lattice {
    centre: Point,
    /// Base-2 logarithm of a step.
    shift: u32,
    /// The square, scaled so that three times a triangle's centroid lies in it where the triangle does.
    thrice: Square,
    /// The south-western corner of the box around the square.
    west: i32,
    south: i32,
    /// Columns of the box.
    columns: usize,
    rows: Vec<Row>,
    /// How many child triangles there are.
    children: u32,
    points: usize,
    triangles: usize,
    /// Whether the cell to the north-east of the centre is cut from its south-western corner.
    is_centre_cut_so: bool,
}

/// A row of points.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Row {
    pub(super) first: i32,
    pub(super) last: i32,
    /// Points in the rows before.
    pub(super) before: u32,
}

impl Row {
    pub(super) fn len(self) -> usize {
        (self.last - self.first + 1) as usize
    }

    /// The number of a point.
    fn slot(self, x: i32) -> u32 {
        (self.before as i32 + x - self.first) as u32
    }
}

/// The two triangles of a cell, as corners: south-west, south-east, north-west, north-east.
const HALVES: [[[usize; 3]; 2]; 2] = [[[0, 1, 2], [1, 3, 2]], [[0, 1, 3], [0, 3, 2]]];

/// Across each edge of these triangles, from the first corner to the second on: how far away the cell is, which of its
/// triangles it is, and the corner at which the edge begins there. Cells side by side are cut the other way.
type Across = ([i32; 2], usize, u32);
const BEYOND: [[[Across; 3]; 2]; 2] = [
    [[([0, -1], 1, 1), ([0, 0], 1, 2), ([-1, 0], 0, 1)], [([1, 0], 1, 2), ([0, 1], 0, 0), ([0, 0], 0, 1)]],
    [[([0, -1], 1, 1), ([1, 0], 0, 2), ([0, 0], 1, 0)], [([0, 0], 0, 2), ([0, 1], 0, 0), ([-1, 0], 1, 0)]],
];

impl Lattice {
    /// That of a diamond in steps of 2^shift; `None` if a patch has no room for it, or the square for a step.
    pub(super) fn new(forest: &Forest, d: Diamond, shift: u32) -> Option<Self> {
        let half = half(forest, d) >> shift;
        let triangles = count(forest, d, half);
        if half == 0 || triangles > TRIANGLES_MAX as u64 {
            return None;
        }
        let centre = d.centre();
        let [low, high] = forest.bounds(d);
        let away = |w: u32, i: usize| ((i64::from(w) - i64::from(centre[i])) >> shift) as i32;
        let mut rows = Vec::with_capacity(2 * half as usize + 1);
        let mut points = 0;
        for y in away(low[1], 1)..=away(high[1], 1) {
            let reach = if d.level() % 2 == 1 { half as i32 - y.abs() } else { half as i32 };
            let row = Row {
                first: (-reach).max(away(low[0], 0)),
                last: reach.min(away(high[0], 0)),
                before: points,
            };
            points += row.len() as u32;
            rows.push(row);
        }
        let west = rows.iter().map(|row| row.first).min()?;
        Some(Self {
            centre,
            shift,
            thrice: Square::new(forest, d, shift).thrice(),
            west,
            south: away(low[1], 1),
            columns: rows.iter().map(|row| row.last - west + 1).max()? as usize,
            rows,
            children: if forest.local(d).upper { 4 } else { 2 },
            points: points as usize,
            triangles: triangles as usize,
            is_centre_cut_so: ((centre[0] >> shift) + (centre[1] >> shift)).is_multiple_of(2),
        })
    }

    pub(super) fn shift(&self) -> u32 {
        self.shift
    }

    pub(super) fn points(&self) -> usize {
        self.points
    }

    pub(super) fn triangles(&self) -> usize {
        self.triangles
    }

    pub(super) fn rows(&self) -> &[Row] {
        &self.rows
    }

    /// The number of a point of the square.
    fn slot(&self, x: i32, y: i32) -> usize {
        self.rows[(y - self.south) as usize].slot(x) as usize
    }

    /// Where the triangles of each child triangle end: all have as many.
    fn ends(&self) -> [u32; 4] {
        [1, 2, 3, 4].map(|child: u32| self.triangles as u32 / self.children * child.min(self.children))
    }

    /// Where they begin.
    fn begins(&self) -> [u32; 4] {
        let [a, b, c, _] = self.ends();
        [0, a, b, c]
    }

    /// Whether a cell is cut from its south-western corner to the north-eastern one, or else between the others.
    fn is_cut_from_south_west(&self, x: i32, y: i32) -> bool {
        ((x + y) & 1 == 0) == self.is_centre_cut_so
    }

    /// Which of its corners a cell's triangles have.
    fn halves(&self, x: i32, y: i32) -> &'static [[usize; 3]; 2] {
        &HALVES[usize::from(self.is_cut_from_south_west(x, y))]
    }

    /// The child triangle that a triangle lies in, given the sum of its corners: its bit, or none.
    fn child(&self, x: i32, y: i32) -> u8 {
        self.thrice.within(x.into(), y.into()).children
    }

    /// The number of a cell of the box, also of the cells around it.
    fn cell(&self, x: i32, y: i32) -> usize {
        (y + 1 - self.south) as usize * (self.columns + 1) + (x + 1 - self.west) as usize
    }

    /// Which triangles of the patch have an edge in common.
    pub(super) fn neighbours(&self) -> Neighbours {
        let mut numbers = vec![[NONE; 2]; (self.rows.len() + 1) * (self.columns + 1)];
        let mut next = self.begins();
        self.each(|child, [x, y], half, _| {
            let number = &mut next[usize::from(child % 4)];
            numbers[self.cell(x, y)][half] = *number;
            *number += 1;
        });
        let mut across = vec![[NONE; 4]; self.triangles];
        self.each(|_, [x, y], half, _| {
            let four = &mut across[numbers[self.cell(x, y)][half] as usize];
            let beyond = &BEYOND[usize::from(self.is_cut_from_south_west(x, y))][half];
            for (twin, (to, half, corner)) in four.iter_mut().zip(beyond) {
                let number = numbers[self.cell(x + to[0], y + to[1])][*half];
                *twin = if number == NONE { NONE } else { 4 * number + corner };
            }
        });
        Neighbours { across: across.into_flattened(), repeated: None }
    }

    /// The patch with these heights, row by row.
    pub(super) fn patch(&self, heights: &[i32]) -> Patch {
        let mut heights = heights.iter().copied();
        let vertices = self.vertices(|_| heights.next().unwrap_or(0));
        Patch { vertices, triangles: self.all(), ends: self.ends() }
    }

    /// The points with their heights, row by row.
    fn vertices(&self, mut height: impl FnMut(Point) -> i32) -> Vec<Vertex> {
        let mut vertices = Vec::with_capacity(self.points);
        for (y, row) in (self.south..).zip(&self.rows) {
            let place = |w: i32, i: usize| self.centre[i].wrapping_add_signed(w << self.shift);
            let y = place(y, 1);
            vertices.extend((row.first..=row.last).map(|x| {
                let x = place(x, 0);
                Vertex { x, y, height: height([x, y]) }
            }));
        }
        vertices
    }

    /// The triangles, by child triangles.
    fn all(&self) -> Vec<[u32; 3]> {
        let mut next = self.begins();
        let mut triangles = vec![[0; 3]; self.triangles];
        self.each(|child, _, _, triangle| {
            let number = &mut next[usize::from(child % 4)];
            triangles[*number as usize] = triangle;
            *number += 1;
        });
        triangles
    }

    /// Whether another one has the same triangles.
    fn is_like(&self, other: &Self) -> bool {
        let shape = |of: &Self| (of.thrice, of.south, of.is_centre_cut_so);
        shape(self) == shape(other) && self.rows == other.rows
    }

    /// Goes through all triangles: the child triangle of each, its cell, which of the cell's it is, and its points.
    fn each(&self, mut take: impl FnMut(u8, [i32; 2], usize, [u32; 3])) {
        let east = self.west + self.columns as i32;
        for band in (self.west..east).step_by(BAND as usize) {
            for (y, pair) in (self.south..).zip(self.rows.windows(2)) {
                let [below, above] = [pair[0], pair[1]];
                let from = band.max(below.first.min(above.first));
                let to = (band + BAND).min(below.last.max(above.last));
                for x in from..to {
                    let corners = [below.slot(x), below.slot(x + 1), above.slot(x), above.slot(x + 1)];
                    for (number, half) in self.halves(x, y).iter().enumerate() {
                        let [i, j] =
                            [0, 1].map(|bit| half.iter().map(|c| (*c >> bit & 1) as i32).sum::<i32>());
                        let child = self.child(3 * x + i, 3 * y + j);
                        if child != 0 {
                            take(
                                child.trailing_zeros() as u8,
                                [x, y],
                                number,
                                half.map(|corner| corners[corner]),
                            );
                        }
                    }
                }
            }
        }
    }

    /// The heights of a patch, row by row, if it is this lattice and nothing else.
    pub(super) fn heights(&self, patch: &Patch) -> Option<Vec<i32>> {
        if patch.ends != self.ends() || patch.triangles.len() != self.triangles {
            return None;
        }
        let mut found = Found {
            names: vec![NONE; self.points],
            met: vec![[false; 2]; (self.rows.len() + 1) * (self.columns + 1)],
        };
        for child in 0..4 {
            for triangle in &patch.triangles[patch.range(child)] {
                let mut corners = [Vertex::default(); 3];
                for (corner, v) in corners.iter_mut().zip(triangle) {
                    *corner = *patch.vertices.get(*v as usize)?;
                }
                self.take(triangle, corners, child, &mut found)?;
            }
        }
        Some(found.names.into_iter().map(|v| patch.vertices[v as usize].height).collect())
    }

    /// Notes a patch's triangle, unless it is none of the lattice's, or the second of its place, or has another vertex
    /// where there is one already.
    #[inline]
    fn take(&self, triangle: &[u32; 3], corners: [Vertex; 3], child: usize, found: &mut Found) -> Option<()> {
        let mut places = [[0; 2]; 3];
        for (place, corner) in places.iter_mut().zip(corners) {
            let [x, y] = [corner.x.wrapping_sub(self.centre[0]), corner.y.wrapping_sub(self.centre[1])];
            if (x | y).trailing_zeros() < self.shift {
                return None;
            }
            *place = [x, y].map(|w| w.cast_signed() >> self.shift);
        }
        let [a, b, c] = places;
        let least = [0, 1].map(|i| a[i].min(b[i]).min(c[i]));
        // Far from the square, so that no sum overflows.
        if least.iter().any(|w| w.unsigned_abs() > 1 << 16) {
            return None;
        }
        let mut shape = 0;
        for [x, y] in places {
            let (x, y) = (x.abs_diff(least[0]), y.abs_diff(least[1]));
            if x > 1 || y > 1 {
                return None;
            }
            shape |= 1 << (2 * y + x);
        }
        let halves = self.halves(least[0], least[1]);
        let half =
            halves.iter().position(|half| half.iter().map(|corner| 1 << corner).sum::<u32>() == shape)?;
        let turns = (b[0] - a[0]) * (c[1] - a[1]) > (b[1] - a[1]) * (c[0] - a[0]);
        let sum = [0, 1].map(|i| a[i] + b[i] + c[i]);
        if !turns || self.child(sum[0], sum[1]) != 1 << child {
            return None;
        }
        // It lies in the square, and so its cell in the box.
        if std::mem::replace(&mut found.met[self.cell(least[0], least[1])][half], true) {
            return None;
        }
        for ([x, y], v) in places.into_iter().zip(triangle) {
            let name = &mut found.names[self.slot(x, y)];
            if *name != NONE && *name != *v {
                return None;
            }
            *name = *v;
        }
        Some(())
    }
}

impl Patch {
    /// The patch of a diamond with every point of the forest's lattice, each cell cut along the diagonal of the bintree,
    /// and its neighbours; `None` if a patch has no room for them.
    #[must_use]
    pub fn lattice(
        forest: &Forest,
        d: Diamond,
        height: impl FnMut(Point) -> i32,
    ) -> Option<(Self, Neighbours)> {
        Lattices::default().patch(forest, d, height)
    }
}

/// The most shapes that are kept: diamonds of a level have four, twice as many on the forest's border, cut in two ways.
const SHAPES_MAX: usize = 32;

/// Makes the patches of whole lattices: of those that have the same triangles, the first alone triangle by triangle. Takes
/// 28 bytes a triangle of up to 32 of them.
#[derive(Default)]
pub struct Lattices {
    shapes: Vec<(Lattice, Vec<[u32; 3]>, Neighbours)>,
}

impl Lattices {
    /// [`Patch::lattice`].
    #[must_use]
    pub fn patch(
        &mut self,
        forest: &Forest,
        d: Diamond,
        height: impl FnMut(Point) -> i32,
    ) -> Option<(Patch, Neighbours)> {
        let lattice = Lattice::new(forest, d, 0)?;
        let (vertices, ends) = (lattice.vertices(height), lattice.ends());
        let known = self.shapes.iter().position(|(shape, ..)| shape.is_like(&lattice));
        let known = known.unwrap_or_else(|| {
            if self.shapes.len() >= SHAPES_MAX {
                self.shapes.clear();
            }
            let (triangles, neighbours) = (lattice.all(), lattice.neighbours());
            self.shapes.push((lattice, triangles, neighbours));
            self.shapes.len() - 1
        });
        let (_, triangles, neighbours) = &self.shapes[known];
        Some((Patch { vertices, triangles: triangles.clone(), ends }, neighbours.clone()))
    }
}

/// The lattice that a patch is, with its heights row by row; `None` if it is anything else.
pub(super) fn of(forest: &Forest, d: Diamond, patch: &Patch) -> Option<(Lattice, Vec<i32>)> {
    let half = half(forest, d);
    let shift =
        (0..=half.ilog2()).find(|shift| count(forest, d, half >> shift) == patch.triangles.len() as u64)?;
    let lattice = Lattice::new(forest, d, shift)?;
    let heights = lattice.heights(patch)?;
    Some((lattice, heights))
}

/// Half of the width of a diamond's square, along x or y.
fn half(forest: &Forest, d: Diamond) -> u64 {
    1 << (forest.root_log2() - 1 - d.level() / 2)
}

/// Triangles of a diamond's lattice, half of whose square is so many steps wide.
fn count(forest: &Forest, d: Diamond, half: u64) -> u64 {
    let whole = if d.level().is_multiple_of(2) { 8 } else { 4 } * half * half;
    if forest.local(d).upper { whole } else { whole / 2 }
}

/// What has been found of a lattice.
struct Found {
    /// The patch's vertex at each point.
    names: Vec<u32>,
    /// Of each cell of the box around the square the triangles.
    met: Vec<[bool; 2]>,
}
