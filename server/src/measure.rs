//! How far the surface drawn at a level lies from the source: every sample, exactly.
//!
//! The surface of a level is made of micro-triangles between lattice points. On the lattice of an even
//! level they are the halves of square cells; on that of an odd level, the quarters, cut by both
//! diagonals. Over each the surface is a plane, and since cells are powers of two wide all arithmetic in
//! `f64` is exact. Samples on a shared edge count for both sides, as both draw them.
//!
//! **Nodata.** A triangle with a corner that has no height is not drawn. Where a level draws what the
//! source has not, or leaves out what it has, the two outlines differ; each such sample lies in a
//! triangle that has both data and nodata, so the outlines are at most a hypotenuse apart, and that
//! length is added to the error of the diamond.

use diamantina_protocol::NODATA;
use diamantina_protocol::bintree::Forest;
use diamantina_protocol::diamond::Diamond;
use std::collections::HashMap;

/// What was found of a diamond.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Found {
    /// The largest vertical distance, in quanta.
    pub vertical: f64,
    /// Whether the outlines differ.
    pub outline: bool,
}

impl Found {
    /// The worse of both.
    pub fn merge(&mut self, other: Self) {
        self.vertical = self.vertical.max(other.vertical);
        self.outline |= other.outline;
    }
}

/// The samples of a rectangle of the lattice, one cell apart.
#[derive(Debug, Clone, Copy)]
pub struct Samples<'a> {
    /// Lattice coordinates of the south-west sample.
    pub origin: [u32; 2],
    /// Cells along x and y; there is one sample more.
    pub cells: [u32; 2],
    /// Heights in quanta, row by row from the south.
    pub heights: &'a [i32],
}

/// Compares the surface of `level` (1 to `forest.levels()` - 1) with the samples, and adds what it finds to
/// `found`. `node(x, y)` is the height that the level draws at a point of its lattice.
///
/// The rectangle must be a square of the quadtree of roots, so that it is made of whole cells or lies
/// within one.
pub fn measure(
    forest: &Forest,
    level: u32,
    samples: Samples<'_>,
    node: impl Fn(u32, u32) -> i32,
    found: &mut HashMap<Diamond, Found>,
) {
    let spacing = 1u32 << (forest.root_log2() - forest.patch_log2() - level / 2);
    let macro_log2 = forest.root_log2() - level / 2;
    let [x0, y0] = samples.origin;
    let [x1, y1] = [x0 + samples.cells[0], y0 + samples.cells[1]];
    let first = |w: u32| w & !(spacing - 1);
    // A macro-square's triangles, one or four, collect before they are put into the map.
    let macro_side = 1u32 << macro_log2;
    let mut square_y = y0 & !(macro_side - 1);
    while square_y < y1 {
        let mut square_x = x0 & !(macro_side - 1);
        while square_x < x1 {
            let mut local = [Found::default(); 4];
            for cell_y in (first(y0.max(square_y))..y1.min(square_y + macro_side)).step_by(spacing as usize) {
                for cell_x in
                    (first(x0.max(square_x))..x1.min(square_x + macro_side)).step_by(spacing as usize)
                {
                    let cell = Square { x: cell_x, y: cell_y, side: spacing };
                    if level.is_multiple_of(2) {
                        halves(cell, samples, &node, &mut local[0]);
                    } else {
                        let macro_square = Square { x: square_x, y: square_y, side: macro_side };
                        quarters(cell, macro_square, samples, &node, &mut local);
                    }
                }
            }
            let half = macro_side / 2;
            let centres = if level.is_multiple_of(2) {
                [Some([square_x + half, square_y + half]), None, None, None]
            } else {
                [
                    Some([square_x + half, square_y]),
                    Some([square_x + macro_side, square_y + half]),
                    Some([square_x + half, square_y + macro_side]),
                    Some([square_x, square_y + half]),
                ]
            };
            for (centre, here) in centres.into_iter().zip(local) {
                if let Some(d) = centre.and_then(|c| forest.diamond(c)).filter(|_| here != Found::default()) {
                    found.entry(d).or_default().merge(here);
                }
            }
            square_x += macro_side;
        }
        square_y += macro_side;
    }
}

#[derive(Clone, Copy)]
struct Square {
    x: u32,
    y: u32,
    side: u32,
}

/// The two triangles of a cell of an even level. Diagonals join points whose coordinates, in cells, sum
/// to an even number.
fn halves(cell: Square, samples: Samples<'_>, node: &impl Fn(u32, u32) -> i32, found: &mut Found) {
    let Square { x, y, side } = cell;
    let corners = [node(x, y), node(x + side, y), node(x + side, y + side), node(x, y + side)];
    let [sw, se, ne, nw] = corners;
    let s = f64::from(side);
    let value = |h: i32| (h != NODATA).then_some(f64::from(h));
    let rising = (x / side + y / side).is_multiple_of(2);
    let row_clip = samples.clip(1, y, side);
    for dy in row_clip[0]..=row_clip[1] {
        let t = f64::from(dy) / s;
        // Along a row the diagonal is met at dx = dy, or at side - dy.
        let cut = if rising { dy } else { side - dy };
        let (left, right) = if rising {
            // Above the diagonal: sw, ne, nw. Below: sw, se, ne.
            (
                plane(value(nw), value(ne), value(sw), |nw, ne, sw| (sw + (nw - sw) * t, (ne - nw) / s)),
                plane(value(sw), value(se), value(ne), |sw, se, ne| (sw + (ne - se) * t, (se - sw) / s)),
            )
        } else {
            (
                plane(value(sw), value(se), value(nw), |sw, se, nw| (sw + (nw - sw) * t, (se - sw) / s)),
                plane(value(nw), value(ne), value(se), |nw, ne, se| {
                    (nw + (se - ne) * (1.0 - t), (ne - nw) / s)
                }),
            )
        };
        let edges = |a: i32, b: i32| a != NODATA && b != NODATA;
        let diagonal = if rising { edges(sw, ne) } else { edges(se, nw) };
        let (bottom, top) = (edges(sw, se), edges(nw, ne));
        let flat = |dy: u32| (dy == 0 && bottom) || (dy == side && top);
        run(samples, cell, dy, [0, cut], left, [edges(sw, nw), diagonal], flat(dy), found);
        run(samples, cell, dy, [cut, side], right, [diagonal, edges(se, ne)], flat(dy), found);
    }
}

/// The four triangles of a cell of an odd level, each with the middle as its apex; `local` by side of
/// the macro-square: south, east, north, west.
fn quarters(
    cell: Square,
    around: Square,
    samples: Samples<'_>,
    node: &impl Fn(u32, u32) -> i32,
    local: &mut [Found; 4],
) {
    let Square { x, y, side } = cell;
    let half = side / 2;
    let corners = [node(x, y), node(x + side, y), node(x + side, y + side), node(x, y + side)];
    let middle = node(x + half, y + half);
    let s = f64::from(side);
    let value = |h: i32| (h != NODATA).then_some(f64::from(h));
    // Which triangle of the macro-square each quarter lies in: by its centroid, in sixths of a cell.
    let centre =
        |w: u32, w0: u32| 6 * i64::from(w - w0) / i64::from(side) - 3 * i64::from(around.side / side);
    let of_quarter: [usize; 4] = [[3, 1], [5, 3], [3, 5], [1, 3]].map(|[cx, cy]| {
        let (dx, dy) = (centre(x, around.x) + cx, centre(y, around.y) + cy);
        match (dx.abs() > dy.abs(), dx > 0, dy > 0) {
            (true, true, _) => 1,
            (true, false, _) => 3,
            (false, _, true) => 2,
            (false, _, false) => 0,
        }
    });
    let [sw, se, ne, nw] = corners.map(value);
    let m = value(middle);
    let edges = |a: Option<f64>, b: Option<f64>| a.is_some() && b.is_some();
    let row_clip = samples.clip(1, y, side);
    for dy in row_clip[0]..=row_clip[1] {
        let t = f64::from(dy) / s;
        // West, then south or north, then east.
        let near = dy.min(side - dy);
        // The plane through the two ends of a side and the middle. For west and east the slope along the
        // side is known, and the rest follows from the middle; likewise south and north.
        let west = plane(sw, nw, m, |sw, nw, m| (sw + (nw - sw) * t, (m - f64::midpoint(sw, nw)) * 2.0 / s));
        let east = plane(se, ne, m, |se, ne, m| {
            let slope = (f64::midpoint(se, ne) - m) * 2.0 / s;
            (se + (ne - se) * t - slope * s, slope)
        });
        let south = plane(sw, se, m, |sw, se, m| (sw + (m - f64::midpoint(sw, se)) * 2.0 * t, (se - sw) / s));
        let north =
            plane(nw, ne, m, |nw, ne, m| (nw + (m - f64::midpoint(nw, ne)) * 2.0 * (1.0 - t), (ne - nw) / s));
        let lower = dy <= half;
        let (d_west, d_east) =
            if lower { (edges(sw, m), edges(se, m)) } else { (edges(nw, m), edges(ne, m)) };
        run(samples, cell, dy, [0, near], west, [edges(sw, nw), d_west], false, &mut local[of_quarter[3]]);
        run(
            samples,
            cell,
            dy,
            [side - near, side],
            east,
            [d_east, edges(se, ne)],
            false,
            &mut local[of_quarter[1]],
        );
        if lower {
            let flat = dy == 0 && edges(sw, se);
            run(
                samples,
                cell,
                dy,
                [near, side - near],
                south,
                [d_west, d_east],
                flat,
                &mut local[of_quarter[0]],
            );
        }
        if dy >= half {
            let flat = dy == side && edges(nw, ne);
            run(
                samples,
                cell,
                dy,
                [near, side - near],
                north,
                [d_west, d_east],
                flat,
                &mut local[of_quarter[2]],
            );
        }
    }
}

/// Start and slope along a row, if all three corners have a height.
fn plane(
    a: Option<f64>,
    b: Option<f64>,
    c: Option<f64>,
    f: impl Fn(f64, f64, f64) -> (f64, f64),
) -> Option<(f64, f64)> {
    Some(f(a?, b?, c?))
}

/// Compares the samples of row `dy` of a cell, from `dx[0]` to `dx[1]`, with `start + slope * dx`.
///
/// Where nothing is drawn, a sample with a height is missing, unless it lies on an edge whose ends both
/// have heights (`ends`: the edges met at either end of the run; `flat`: the row itself is one): that
/// edge is another triangle's too, and what is missing there is missing inside as well.
#[allow(
    clippy::too_many_arguments,
    reason = "the inner loop of the measurement; a struct would be built a million times"
)]
fn run(
    samples: Samples<'_>,
    cell: Square,
    dy: u32,
    dx: [u32; 2],
    drawn: Option<(f64, f64)>,
    ends: [bool; 2],
    flat: bool,
    found: &mut Found,
) {
    let clip = samples.clip(0, cell.x, cell.side);
    let (from, to) = (dx[0].max(clip[0]), dx[1].min(clip[1]));
    if from > to {
        return;
    }
    let row = (cell.y + dy - samples.origin[1]) as usize * (samples.cells[0] + 1) as usize;
    // Counted from the window's first sample, which may lie right of the cell's corner.
    let at = |dx: u32| row + (cell.x + dx - samples.origin[0]) as usize;
    let heights = &samples.heights[at(from)..=at(to)];
    if let Some((start, slope)) = drawn {
        let mut worst = found.vertical;
        let mut missing = false;
        for (i, h) in heights.iter().enumerate() {
            let surface = start + slope * (f64::from(from) + i as f64);
            let distance = (f64::from(*h) - surface).abs();
            let valid = *h != NODATA;
            missing |= !valid;
            worst = worst.max(if valid { distance } else { 0.0 });
        }
        found.vertical = worst;
        found.outline |= missing;
    } else if !flat {
        let on_edge = |dx_here: u32| (dx_here == dx[0] && ends[0]) || (dx_here == dx[1] && ends[1]);
        found.outline |= (from..=to).zip(heights).any(|(dx_here, h)| {
            let corner = (dy == 0 || dy == cell.side) && (dx_here == 0 || dx_here == cell.side);
            *h != NODATA && !on_edge(dx_here) && !corner
        });
    }
}

impl Samples<'_> {
    /// The part of a cell's 0..=side along an axis that the samples cover.
    fn clip(&self, axis: usize, corner: u32, side: u32) -> [u32; 2] {
        let (low, high) = (self.origin[axis], self.origin[axis] + self.cells[axis]);
        [low.saturating_sub(corner), (high - corner).min(side)]
    }
}
