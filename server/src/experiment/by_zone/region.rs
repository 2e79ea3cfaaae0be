//! Where the viewer stays: a polygon, or the largest lake of a window; and the eyes along its contour.

use super::super::field::Field;
use super::super::windows::Window;
use super::super::{ExperimentError, Run};
use super::QUANTUM;
use crate::zone::cast::Eye;
use crate::zone::polygon::{self, contour, perimeter};
use crate::zone::relief::Relief;
use crate::zone::tiled::Tiled;
use crate::zone::view::Ground;
use crate::zone::{EYES, EYES_MAX, SPACING_CELLS};
use diamantina_protocol::NODATA;
use diamantina_protocol::bintree::Point;
use std::path::Path;

/// Cells of the smallest lake that is taken for a zone.
const LAKE_CELLS_MIN: usize = 50;

/// Where the viewer stays.
pub(super) struct Region {
    pub(super) name: String,
    /// Samples that belong to it, and the highest place of an eye there, metres.
    pub(super) own: Vec<(Point, f64)>,
    /// The eyes of the mask.
    pub(super) eyes: Vec<Eye>,
}

/// Heights of a window's samples as rays need them.
pub(super) fn ground(window: &Window, heights: &[f64]) -> Ground {
    let field = &window.field;
    let mut tiled = Tiled::filled([field.row(); 2], NODATA);
    for (slot, height) in heights.iter().enumerate().filter(|(_, height)| !height.is_nan()) {
        #[allow(clippy::cast_possible_truncation, reason = "saturates, 2000 km up")]
        let quanta = (height / QUANTUM).round() as i32;
        tiled.set(field.point(slot).map(|w| w as usize), quanta.max(NODATA + 1));
    }
    Ground {
        relief: Relief::new(tiled),
        origin: window.origin,
        cell: field.cell(),
        quantum: QUANTUM,
        height_offset: 0.0,
    }
}

pub(super) fn from_polygon(
    run: &Run<'_>,
    window: &Window,
    ground: &Ground,
    path: &Path,
) -> Result<Region, ExperimentError> {
    let polygons = polygon::read(path, window.crs.as_ref(), run.options.zone.coordinates)?;
    let wrong =
        |expected: String, found: String| ExperimentError::Options { option: "--polygon", expected, found };
    if !ground.holds(&polygons) {
        let [low, high] = ground.extent().map(|p| p.map(f64::round));
        let expected = format!(
            "a region within the window of {}, from ({}, {}) to ({}, {}) in its metres",
            window.source, low[0], low[1], high[0], high[1]
        );
        let corners = || polygons.iter().flatten().flatten();
        let [west, south] = [0, 1].map(|k| corners().map(|p| p[k]).fold(f64::INFINITY, f64::min).round());
        let [east, north] = [0, 1].map(|k| corners().map(|p| p[k]).fold(f64::NEG_INFINITY, f64::max).round());
        let found = format!(
            "{} from ({west}, {south}) to ({east}, {north}); choose the window with --at and --samples",
            path.display()
        );
        return Err(wrong(expected, found));
    }
    let cell = ground.cell[0].min(ground.cell[1]);
    let around: f64 = polygons.iter().map(|rings| perimeter(rings)).sum();
    let spacing = run.options.zone.spacing.unwrap_or((SPACING_CELLS * cell).max(around / EYES));
    if around / spacing > EYES_MAX as f64 {
        return Err(ExperimentError::Options {
            option: "--spacing",
            expected: format!("more metres: at most {EYES_MAX} eyes along {around:.0} m of contour"),
            found: spacing.to_string(),
        });
    }
    let (mut own, mut eyes) = (Vec::new(), Vec::new());
    for rings in &polygons {
        let Some(highest) = ground.highest(rings) else {
            let found = format!("a polygon without any in {}", path.display());
            return Err(wrong("polygons with data".to_owned(), found));
        };
        let ceiling = highest + run.options.eye;
        eyes.extend(contour(rings, spacing).into_iter().map(|p| ground.eye(p, ceiling)));
        ground.own(rings, |at| own.push((at.map(|w| u32::try_from(w).unwrap_or(u32::MAX)), ceiling)));
    }
    own.sort_unstable_by(|(p, a), (q, b)| [p[1], p[0]].cmp(&[q[1], q[0]]).then(b.total_cmp(a)));
    own.dedup_by_key(|(p, _)| *p);
    let name = path.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
    Ok(Region { name, own, eyes })
}

pub(super) fn from_lake(run: &Run<'_>, window: &Window, ground: &Ground) -> Result<Region, ExperimentError> {
    let field = &window.field;
    let cells = lake(field);
    if cells.len() < LAKE_CELLS_MIN {
        return Err(ExperimentError::Options {
            option: "--polygon",
            expected: format!("a region given, as the window of {} has no lake", window.label()),
            found: format!("nothing, and {} level cells in one piece", cells.len()),
        });
    }
    let mut around = vec![0u8; field.heights().len()];
    for [x, y] in &cells {
        for corner in [[*x, *y], [x + 1, *y], [*x, y + 1], [x + 1, y + 1]] {
            around[field.slot(corner)] += 1;
        }
    }
    let own: Vec<Point> =
        (0..around.len()).filter(|slot| around[*slot] > 0).map(|slot| field.point(slot)).collect();
    let shore: Vec<Point> = own.iter().copied().filter(|p| around[field.slot(*p)] < 4).collect();
    let height = field.at(own[0]);
    let ceiling = height + run.options.eye;
    let given = run.options.zone.spacing.map(|metres| metres / field.cell()[0].min(field.cell()[1]));
    let mut spacing = given.unwrap_or(SPACING_CELLS);
    let mut posts = apart(&shore, spacing);
    while given.is_none() && posts.len() as f64 > EYES {
        spacing *= 1.25;
        posts = apart(&shore, spacing);
    }
    let eye = |p: &Point| Eye { place: p.map(f64::from), height: ceiling / ground.quantum };
    let name = format!("lake of {} cells at {height:.0} m", cells.len());
    let own = own.into_iter().map(|p| (p, ceiling)).collect();
    Ok(Region { name, own, eyes: posts.iter().map(eye).collect() })
}

/// The largest piece of cells whose four corners have one height and which share sides, by their south-west corners.
fn lake(field: &Field) -> Vec<Point> {
    let side = field.side();
    let is_level = |[x, y]: Point| {
        let height = field.at([x, y]);
        [[x + 1, y], [x, y + 1], [x + 1, y + 1]].iter().all(|p| field.at(*p) == height)
    };
    let mut known = vec![false; field.heights().len()];
    let mut largest = Vec::new();
    for start in (0..side).flat_map(|y| (0..side).map(move |x| [x, y])) {
        if std::mem::replace(&mut known[field.slot(start)], true) || !is_level(start) {
            continue;
        }
        let (mut piece, mut done) = (vec![start], 0);
        while let Some([x, y]) = piece.get(done).copied() {
            done += 1;
            let beside = [[x.wrapping_sub(1), y], [x + 1, y], [x, y.wrapping_sub(1)], [x, y + 1]];
            for next in beside.into_iter().filter(|p| p[0] < side && p[1] < side) {
                if !known[field.slot(next)] && is_level(next) {
                    known[field.slot(next)] = true;
                    piece.push(next);
                }
            }
        }
        if piece.len() > largest.len() {
            largest = piece;
        }
    }
    largest
}

/// Some of the points, so that none is nearer to another than `spacing` and none farther from the next than that.
fn apart(points: &[Point], spacing: f64) -> Vec<Point> {
    let mut kept: Vec<Point> = Vec::new();
    for p in points {
        let far = |q: &Point| f64::from(p[0].abs_diff(q[0])).hypot(f64::from(p[1].abs_diff(q[1]))) >= spacing;
        if kept.iter().all(far) {
            kept.push(*p);
        }
    }
    kept
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_largest_lake_is_found_and_eyes_stand_apart() {
        let side = 32usize;
        let height = |slot: usize| {
            let [x, y] = [slot % (side + 1), slot / (side + 1)];
            let is_lake = (4..=14).contains(&x) && (6..=20).contains(&y);
            let is_pond = (20..=24).contains(&x) && (6..=10).contains(&y);
            if is_lake || is_pond { 100.0 } else { 110.0 + (x * 7 + y * 13) as f64 }
        };
        let field = Field::new(5, (0..(side + 1) * (side + 1)).map(height).collect(), [30.0; 2]).unwrap();
        let mut cells = lake(&field);
        cells.sort_unstable();
        let expected: Vec<Point> = (4..14).flat_map(|x| (6..20).map(move |y| [x, y])).collect();
        assert_eq!(cells, expected);
        let kept = apart(&cells, 4.0);
        let distance =
            |p: &Point, q: &Point| f64::from(p[0].abs_diff(q[0])).hypot(f64::from(p[1].abs_diff(q[1])));
        assert!(kept.iter().all(|p| kept.iter().all(|q| p == q || distance(p, q) >= 4.0)));
        assert!(cells.iter().all(|p| kept.iter().any(|q| distance(p, q) < 4.0)));
    }
}
