//! The samples of a tile against the surface, cell by cell, row by row: the way that knows of nodata.

use super::{Found, Nodes, Samples, Square};
use diamantina_protocol::NODATA;

/// Compares the samples of `tile`, which lies in the macro-square `around`, with the surface of `level`.
/// `local` is what is found of the macro-square's triangles: of an even level the first is both; of an odd
/// one they are those at its south, east, north and west side.
pub(super) fn measure(
    level: u32,
    tile: Square,
    around: Square,
    samples: &Samples<'_>,
    nodes: Nodes<'_>,
    local: &mut [Found; 4],
) {
    let even = level.is_multiple_of(2);
    let side = 1u32 << (nodes.spacing_log2 + u32::from(!even));
    let first = |w: u32| w & !(side - 1);
    let window = Window { samples, tile };
    for y in (first(tile.y)..tile.y + tile.side).step_by(side as usize) {
        for x in (first(tile.x)..tile.x + tile.side).step_by(side as usize) {
            let cell = Square { x, y, side };
            if even {
                halves(cell, window, nodes, &mut local[0]);
            } else {
                quarters(cell, around, window, nodes, local);
            }
        }
    }
}

/// The samples of a tile.
#[derive(Clone, Copy)]
struct Window<'a> {
    samples: &'a Samples<'a>,
    tile: Square,
}

impl Window<'_> {
    /// The part of a cell's 0..=side along x that the tile covers.
    fn across(self, corner: u32, side: u32) -> [u32; 2] {
        clip(self.tile.x, self.tile.side, corner, side)
    }

    /// The same along y.
    fn along(self, corner: u32, side: u32) -> [u32; 2] {
        clip(self.tile.y, self.tile.side, corner, side)
    }
}

fn clip(low: u32, length: u32, corner: u32, side: u32) -> [u32; 2] {
    [low.saturating_sub(corner), (low + length - corner).min(side)]
}

/// The two triangles of a cell of an even level. Diagonals join points whose coordinates, in cells, sum
/// to an even number.
fn halves(cell: Square, window: Window<'_>, nodes: Nodes<'_>, found: &mut Found) {
    let Square { x, y, side } = cell;
    let corners =
        [nodes.at(x, y), nodes.at(x + side, y), nodes.at(x + side, y + side), nodes.at(x, y + side)];
    let [sw, se, ne, nw] = corners;
    let s = f64::from(side);
    let value = |h: i32| (h != NODATA).then_some(f64::from(h));
    let rising = (x / side + y / side).is_multiple_of(2);
    let row_clip = window.along(y, side);
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
        run(window, cell, dy, [0, cut], left, [edges(sw, nw), diagonal], flat(dy), found);
        run(window, cell, dy, [cut, side], right, [diagonal, edges(se, ne)], flat(dy), found);
    }
}

/// The four triangles of a cell of an odd level, each with the middle as its apex; `local` by side of
/// the macro-square: south, east, north, west.
fn quarters(cell: Square, around: Square, window: Window<'_>, nodes: Nodes<'_>, local: &mut [Found; 4]) {
    let Square { x, y, side } = cell;
    let half = side / 2;
    let corners =
        [nodes.at(x, y), nodes.at(x + side, y), nodes.at(x + side, y + side), nodes.at(x, y + side)];
    let middle = nodes.at(x + half, y + half);
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
    let row_clip = window.along(y, side);
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
        run(window, cell, dy, [0, near], west, [edges(sw, nw), d_west], false, &mut local[of_quarter[3]]);
        run(
            window,
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
                window,
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
                window,
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
    window: Window<'_>,
    cell: Square,
    dy: u32,
    dx: [u32; 2],
    drawn: Option<(f64, f64)>,
    ends: [bool; 2],
    flat: bool,
    found: &mut Found,
) {
    let clip = window.across(cell.x, cell.side);
    let (from, to) = (dx[0].max(clip[0]), dx[1].min(clip[1]));
    if from > to {
        return;
    }
    let samples = window.samples;
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
