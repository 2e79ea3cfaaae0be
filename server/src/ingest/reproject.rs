//! A source resampled to another CRS, bilinearly, window by window.
//!
//! The inverse map (target sample → source coordinates) is computed exactly on a coarse lattice fixed to
//! the target grid and interpolated between: blocks of 64 x 64 samples, 3 x 3 nodes, a parabola each way.
//! The exact map is checked at all 16 midpoints between nodes; where any differs by more than an eighth of
//! the promised 0.01 cell, the block is computed sample by sample. A parabola through equidistant nodes
//! errs most at 0.577 of their distance, where it errs 1.03 times as much as at the midpoint (third
//! differences dominate at this scale), so the factor 8 is ample. Blocks are fixed to the grid, hence a
//! sample's value does not depend on the window it is read in.

use super::error::{Result, options};
use super::mosaic::Mosaic;
use super::raster::{Place, SIDE_MAX, SourceCrs, Window};
use crate::projection::Projection;

/// Samples of a block a side.
const BLOCK: u32 = 64;
/// Largest error of a source coordinate, in source cells, seen at the midpoints.
const MIDPOINT_ERROR_MAX: f64 = 0.01 / 8.0;
/// Source samples read at once, at most (8 bytes each); larger shares are halved.
const REGION_SAMPLES_MAX: u64 = 1 << 20;
/// A contribution smaller than this share of a cell counts as none.
const WEIGHT_MIN: f64 = 1e-6;
/// Points along each edge of the source that decide the target's extent.
const EDGE_POINTS: u32 = 256;

/// The map from target samples to the source, and the target grid.
pub(super) struct Reprojection {
    source: Projection,
    target: Projection,
    /// Source samples in CRS units.
    place: Place,
    source_size: [u32; 2],
    /// Target CRS units.
    pub(super) origin: [f64; 2],
    pub(super) step: f64,
    pub(super) width: u32,
    pub(super) height: u32,
    /// Full turn in source units when the source is geographic.
    turn: Option<f64>,
}

impl Reprojection {
    /// Plans the target grid: it covers the source, its samples are whole multiples of the cell.
    /// `cell_metres` defaults to the geometric mean of the source cell's two sizes at its centre, measured
    /// in the target CRS.
    pub(super) fn new(
        mosaic: &Mosaic,
        place: &Place,
        target: &SourceCrs,
        cell_metres: Option<f64>,
    ) -> Result<Self> {
        let file = &mosaic.first().file;
        let projection = |crs: &SourceCrs| -> Result<Projection> {
            let built = crs.proj4.as_deref().map(Projection::new);
            match built {
                Some(Ok(projection)) => Ok(projection),
                other => Err(options(
                    file,
                    "a CRS whose formulas are built in",
                    match other {
                        Some(Err(e)) => format!("{}: {e}", crs.name),
                        _ => crs.name.clone(),
                    },
                    "use --crs source, or another --crs EPSG:N",
                )),
            }
        };
        let source_crs = place.crs.as_ref().ok_or_else(|| super::no_crs(file, &target.name))?;
        let mut plan = Self {
            source: projection(source_crs)?,
            target: projection(target)?,
            place: place.clone(),
            source_size: [mosaic.width, mosaic.height],
            origin: [0.0; 2],
            step: 1.0,
            width: 0,
            height: 0,
            turn: source_crs.geographic.then_some(360.0),
        };
        let outside = || {
            options(
                file,
                format!("a source inside the domain of {}", target.name),
                "samples that cannot be projected",
                "choose another --crs, or --crs source",
            )
        };
        let cell = match cell_metres {
            Some(metres) => metres / target.metres_per_unit,
            None => plan.natural_cell().ok_or_else(outside)?,
        };
        let (low, high) = plan.extent().ok_or_else(outside)?;
        let first = low.map(|v| (v / cell).floor());
        let side = |axis: usize| {
            let samples = (high[axis] / cell).ceil() - first[axis] + 1.0;
            super::whole(samples).filter(|s| (1..=SIDE_MAX).contains(s)).ok_or_else(|| {
                options(
                    file,
                    format!("at most {SIDE_MAX} samples a side in {}", target.name),
                    format!("{samples} with cells of {} metres", cell * target.metres_per_unit),
                    "choose a larger --cell",
                )
            })
        };
        (plan.width, plan.height) = (side(0)?, side(1)?);
        plan.origin = first.map(|f| f * cell);
        plan.step = cell;
        Ok(plan)
    }

    /// Target coordinates of a source position in samples from the south-west.
    fn forward(&self, column: f64, row: f64) -> Option<[f64; 2]> {
        let x = self.place.origin[0] + column * self.place.step[0];
        let y = self.place.origin[1] + row * self.place.step[1];
        let (x, y) = self.source.to(&self.target, x, y)?;
        Some([x, y])
    }

    fn natural_cell(&self) -> Option<f64> {
        let [column, row] = self.source_size.map(|s| f64::from(s - 1) / 2.0);
        let length = |a: [f64; 2], b: [f64; 2]| (a[0] - b[0]).hypot(a[1] - b[1]);
        let east = length(self.forward(column + 0.5, row)?, self.forward(column - 0.5, row)?);
        let north = length(self.forward(column, row + 0.5)?, self.forward(column, row - 0.5)?);
        let cell = (east * north).sqrt();
        (cell.is_finite() && cell > 0.0).then_some(cell)
    }

    /// Lowest and highest target coordinates of the source's samples; `None` if any cannot be projected.
    fn extent(&self) -> Option<([f64; 2], [f64; 2])> {
        let (mut low, mut high) = ([f64::INFINITY; 2], [f64::NEG_INFINITY; 2]);
        let [columns, rows] = self.source_size.map(|s| f64::from(s - 1));
        for i in 0..=EDGE_POINTS {
            for j in 0..=EDGE_POINTS {
                // The edges densely, the inside (where a pole may lie) at every 16th point.
                let edge = [i, j].iter().any(|k| *k == 0 || *k == EDGE_POINTS);
                if !edge && (i % 16 != 0 || j % 16 != 0) {
                    continue;
                }
                let share = [i, j].map(|k| f64::from(k) / f64::from(EDGE_POINTS));
                let point = self.forward(share[0] * columns, share[1] * rows)?;
                for axis in 0..2 {
                    low[axis] = low[axis].min(point[axis]);
                    high[axis] = high[axis].max(point[axis]);
                }
            }
        }
        Some((low, high))
    }

    /// Exact source position, in samples from the south-west, of a target sample.
    fn inverse(&self, x: f64, y: f64) -> Option<[f64; 2]> {
        let (x, y) = (self.origin[0] + x * self.step, self.origin[1] + y * self.step);
        let (mut x, y) = self.target.to(&self.source, x, y)?;
        if let Some(turn) = self.turn {
            // Longitudes of a source across the antimeridian may run beyond 180 degrees.
            let centre = self.place.origin[0] + f64::from(self.source_size[0]) / 2.0 * self.place.step[0];
            x -= ((x - centre) / turn).round() * turn;
        }
        Some([
            (x - self.place.origin[0]) / self.place.step[0],
            (y - self.place.origin[1]) / self.place.step[1],
        ])
    }

    /// Fills `out` with the window's values, rows from the south. About 2 MiB beside the source's own, up to
    /// 10 MiB where the target is much coarser than the source.
    pub(super) fn read(&self, mosaic: &Mosaic, window: Window, band: u32, out: &mut [f64]) -> Result<()> {
        let mut positions = Vec::new();
        let mut region = Vec::new();
        let width = window.width as usize;
        let (x1, y1) = (window.x0 + window.width, window.y0 + window.height);
        for block_y in window.y0 / BLOCK..y1.div_ceil(BLOCK) {
            for block_x in window.x0 / BLOCK..x1.div_ceil(BLOCK) {
                let (bx, by) = (block_x * BLOCK, block_y * BLOCK);
                let part = Window {
                    x0: bx.max(window.x0),
                    y0: by.max(window.y0),
                    width: (bx + BLOCK).min(x1) - bx.max(window.x0),
                    height: (by + BLOCK).min(y1) - by.max(window.y0),
                };
                self.positions(bx, by, part, &mut positions);
                let start = (part.y0 - window.y0) as usize * width + (part.x0 - window.x0) as usize;
                let all = Window { x0: 0, y0: 0, ..part };
                self.sample(
                    mosaic,
                    band,
                    &positions,
                    part.width as usize,
                    all,
                    width,
                    &mut out[start..],
                    &mut region,
                )?;
            }
        }
        Ok(())
    }

    /// Source positions of the part of a block; NaN outside the projection's domain.
    fn positions(&self, bx: u32, by: u32, part: Window, positions: &mut Vec<[f64; 2]>) {
        positions.clear();
        let (rows, columns) = (part.y0..part.y0 + part.height, part.x0..part.x0 + part.width);
        let Some(nodes) = self.nodes(bx, by) else {
            for y in rows {
                positions.extend(
                    columns
                        .clone()
                        .map(|x| self.inverse(f64::from(x), f64::from(y)).unwrap_or([f64::NAN; 2])),
                );
            }
            return;
        };
        for y in rows {
            let v = f64::from(y - by) / f64::from(BLOCK / 2) - 1.0;
            let line: [[f64; 2]; 3] =
                std::array::from_fn(|i| parabola([nodes[0][i], nodes[1][i], nodes[2][i]], v));
            // Coefficients along x once a row, then two multiplications a coordinate.
            let coefficient = |a: usize| {
                let [p, q, r] = line.map(|n| n[a]);
                [q, (r - p) / 2.0, (r + p) / 2.0 - q]
            };
            let (cx, cy) = (coefficient(0), coefficient(1));
            positions.extend(columns.clone().map(|x| {
                let u = f64::from(x - bx) / f64::from(BLOCK / 2) - 1.0;
                [cx[0] + u * (cx[1] + u * cx[2]), cy[0] + u * (cy[1] + u * cy[2])]
            }));
        }
    }

    /// The 3 x 3 exact nodes of a block, [row][column]; `None` where they do not suffice.
    fn nodes(&self, bx: u32, by: u32) -> Option<[[[f64; 2]; 3]; 3]> {
        let (bx, by, half) = (f64::from(bx), f64::from(by), f64::from(BLOCK / 2));
        let mut nodes = [[[0.0; 2]; 3]; 3];
        for (j, row) in nodes.iter_mut().enumerate() {
            for (i, node) in row.iter_mut().enumerate() {
                *node = self.inverse(bx + i as f64 * half, by + j as f64 * half)?;
            }
        }
        for j in 0..5 {
            for i in 0..5 {
                if i % 2 == 0 && j % 2 == 0 {
                    continue;
                }
                let (u, v) = (f64::from(i) / 2.0 - 1.0, f64::from(j) / 2.0 - 1.0);
                let exact = self.inverse(bx + (u + 1.0) * half, by + (v + 1.0) * half)?;
                let near = parabola(nodes.map(|row| parabola(row, u)), v);
                if (0..2).any(|a| {
                    (exact[a] - near[a]).abs().partial_cmp(&MIDPOINT_ERROR_MAX)
                        != Some(std::cmp::Ordering::Less)
                }) {
                    return None;
                }
            }
        }
        Some(nodes)
    }

    /// Bilinear values of `rect`, a rectangle inside the part that `positions` describes.
    #[expect(clippy::too_many_arguments, reason = "recursion over shared buffers")]
    fn sample(
        &self,
        mosaic: &Mosaic,
        band: u32,
        positions: &[[f64; 2]],
        stride: usize,
        rect: Window,
        out_stride: usize,
        out: &mut [f64],
        region: &mut Vec<f64>,
    ) -> Result<()> {
        let share = Share { positions, stride, rect, size: self.source_size };
        let Some(area) = share.area() else {
            share.each(|x, y, _| out[y * out_stride + x] = f64::NAN);
            return Ok(());
        };
        if u64::from(area.width) * u64::from(area.height) > REGION_SAMPLES_MAX && rect.samples() > 1 {
            for half in halves(rect) {
                self.sample(mosaic, band, positions, stride, half, out_stride, out, region)?;
            }
            return Ok(());
        }
        region.clear();
        region.resize(area.samples(), f64::NAN);
        mosaic.read(area, band, region)?;
        share.each(|x, y, position| {
            let at = inside(position, self.source_size);
            out[y * out_stride + x] = at.map_or(f64::NAN, |at| bilinear(region, area, at));
        });
        Ok(())
    }
}

/// Some target samples and where they fall in the source.
struct Share<'a> {
    positions: &'a [[f64; 2]],
    stride: usize,
    rect: Window,
    size: [u32; 2],
}

impl Share<'_> {
    fn each(&self, mut action: impl FnMut(usize, usize, [f64; 2])) {
        let (x0, y0) = (self.rect.x0 as usize, self.rect.y0 as usize);
        for y in y0..y0 + self.rect.height as usize {
            for x in x0..x0 + self.rect.width as usize {
                action(x, y, self.positions[y * self.stride + x]);
            }
        }
    }

    /// The source samples that these need; `None` if none lies inside.
    fn area(&self) -> Option<Window> {
        let (mut low, mut high) = ([f64::INFINITY; 2], [f64::NEG_INFINITY; 2]);
        self.each(|_, _, position| {
            if let Some(at) = inside(position, self.size) {
                for a in 0..2 {
                    low[a] = low[a].min(at[a]);
                    high[a] = high[a].max(at[a]);
                }
            }
        });
        let x0 = super::whole(low[0].floor())?;
        let y0 = super::whole(low[1].floor())?;
        let x1 = (super::whole(high[0].floor())? + 2).min(self.size[0]);
        let y1 = (super::whole(high[1].floor())? + 2).min(self.size[1]);
        Some(Window { x0, y0, width: x1 - x0, height: y1 - y0 })
    }
}

/// The position clamped to the source's samples, if it is not farther out than rounding.
fn inside(position: [f64; 2], size: [u32; 2]) -> Option<[f64; 2]> {
    let last = size.map(|s| f64::from(s - 1));
    let near = (0..2).all(|a| position[a] >= -WEIGHT_MIN && position[a] <= last[a] + WEIGHT_MIN);
    near.then(|| [position[0].clamp(0.0, last[0]), position[1].clamp(0.0, last[1])])
}

/// The value at a position inside `area`; samples without weight do not count, not even their nodata.
fn bilinear(region: &[f64], area: Window, at: [f64; 2]) -> f64 {
    let (column, u) = split(at[0] - f64::from(area.x0));
    let (row, v) = split(at[1] - f64::from(area.y0));
    let width = area.width as usize;
    // In this form flat water stays exactly flat.
    let mix = |a: f64, b: f64, share: f64| a + (b - a) * share;
    let line = |row: usize| {
        let i = row * width + column;
        if u > 0.0 { mix(region[i], region[i + 1], u) } else { region[i] }
    };
    if v > 0.0 { mix(line(row), line(row + 1), v) } else { line(row) }
}

/// Whole part and weight of the next sample.
#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "positions lie inside an area of at most 2^24 samples a side"
)]
fn split(at: f64) -> (usize, f64) {
    let whole = at.floor();
    let part = at - whole;
    if part > 1.0 - WEIGHT_MIN {
        (whole as usize + 1, 0.0)
    } else if part < WEIGHT_MIN {
        (whole as usize, 0.0)
    } else {
        (whole as usize, part)
    }
}

/// The parabola through values at −1, 0 and 1.
fn parabola(nodes: [[f64; 2]; 3], u: f64) -> [f64; 2] {
    std::array::from_fn(|a| {
        let [p, q, r] = nodes.map(|n| n[a]);
        q + u * ((r - p) / 2.0 + u * ((r + p) / 2.0 - q))
    })
}

fn halves(rect: Window) -> [Window; 2] {
    if rect.width >= rect.height {
        let half = rect.width / 2;
        [Window { width: half, ..rect }, Window { x0: rect.x0 + half, width: rect.width - half, ..rect }]
    } else {
        let half = rect.height / 2;
        [Window { height: half, ..rect }, Window { y0: rect.y0 + half, height: rect.height - half, ..rect }]
    }
}
