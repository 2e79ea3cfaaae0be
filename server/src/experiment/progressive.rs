//! What a receiver has after each part of a progressive transmission: errors against points and bytes.
//!
//! Heights are whole units, and every scheme ends with exactly those: 1 m where all are whole metres, else the power of
//! ten below a hundred-thousandth of the relief, at most 1 cm, but so large that no height is beyond the 2^23 units that
//! a source may have. Errors are against the heights as they were, so at the end up to half a unit.
//!
//! | scheme | order | bytes |
//! |---|---|---|
//! | `level` | the bitree's points off their means, level by level | batches |
//! | `tolerance` | the bitree refined to half the tolerance again and again; what an earlier batch has stays | batches |
//! | `error` | the bitree's worst triangle first, twice as many points a batch | batches |
//! | `quadtree` | the restricted quadtree refined to the same tolerances; what an earlier batch has stays | batches |
//! | `points midpoint`, `points smooth` | all points, level by level | the payloads of `protocol::points`, lossless, with the model that knows nothing of the layer |
//! | `raster` | all at once | differences from the western neighbour, 2 bytes each where they fit, zstd |
//!
//! A batch is a list of points in raster order: for each the gap to the one before and the difference
//! between its height and the one that the receiver deduces there, both as numbers of 7 bits a byte, in two columns;
//! zstd at level 19 over both. The four corners open the first batch, 4 bytes each.

use super::field::Field;
use super::report::{Picture, Report, Table};
use super::scan::surface;
use super::select::{GREEDY_SHARE, Ground, greedy};
use super::windows::Window;
use super::{Criterion, ExperimentError, Run, plot, quadtree};
use diamantina_protocol::NODATA;
use diamantina_protocol::bintree::Forest;
use diamantina_protocol::bitree::{Bitree, Facet, level};
use diamantina_protocol::diamond::{Block, Diamond};
use diamantina_protocol::points::{self, Coding, Rule};
use std::collections::HashMap;

const ZSTD_LEVEL: i32 = 19;
/// Bytes of a corner's height.
const CORNER_BYTES: usize = 4;

/// What a receiver has at some time.
struct Step {
    points: usize,
    bytes: usize,
    max: f64,
    rms: f64,
}

pub(super) fn run(run: &Run<'_>) -> Result<Report, ExperimentError> {
    let columns =
        ["DEM", "x", "y", "unit [m]", "scheme", "points", "bytes", "largest error [m]", "RMS error [m]"];
    let mut table = Table::new("progressive", "After each part of the transmission", &columns);
    let mut pictures = Vec::new();
    run.progress.stage("transmitting", "windows", run.windows.len() as u64, 0);
    for (i, window) in run.windows.iter().enumerate() {
        if run.progress.is_stopping() {
            return Err(ExperimentError::Stopped);
        }
        let (unit, schemes) = schemes(window)?;
        #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "a handful of decimals")]
        let decimals = (1.0 - unit.log10()).ceil().max(3.0) as usize;
        for (name, steps) in &schemes {
            for s in steps {
                let [x, y] = window.at.map(|w| w.to_string());
                let place = [window.source.clone(), x, y, unit.to_string()];
                let found = [
                    s.points.to_string(),
                    s.bytes.to_string(),
                    format!("{:.decimals$}", s.max),
                    format!("{:.decimals$}", s.rms),
                ];
                table.push(place.into_iter().chain([(*name).to_owned()]).chain(found));
            }
        }
        if i == 0 {
            pictures = plots(&window.label(), &schemes)?;
        }
        run.progress.advance(1);
    }
    let notes = vec![
        "Heights are sent in whole units; errors are against the heights as they were, so at the end up to half a unit."
            .to_owned(),
        "Points of 'points ...' and 'raster' are all samples of the grid that have come, of the other schemes those that are \
         real."
            .to_owned(),
        "Plots are of the first window, with logarithms; a step without error has no place on them.".to_owned(),
    ];
    Ok(Report { title: "Progressive transmission".to_owned(), notes, tables: vec![table], pictures })
}

type Scheme = (&'static str, Vec<Step>);

/// A field as it is sent.
struct Sent<'a> {
    /// Heights in whole units.
    field: Field,
    /// Metres.
    unit: f64,
    /// Heights in metres, as they were.
    source: &'a Field,
}

/// The unit, and the schemes by name.
fn schemes(window: &Window) -> Result<(f64, Vec<Scheme>), ExperimentError> {
    let sent = Sent::new(&window.field);
    let field = &sent.field;
    if field.log2() < 3 {
        return Err(ExperimentError::Options {
            option: "--samples",
            expected: "9 or more, for the points encoding".to_owned(),
            found: field.row().to_string(),
        });
    }
    let [tolerances, quadtrees] = by_tolerance(field);
    let all = [
        ("level", by_level(field)),
        ("tolerance", tolerances),
        ("error", by_error(field)),
        ("quadtree", quadtrees),
    ];
    let mut list: Vec<Scheme> = Vec::new();
    for (name, trees) in all {
        list.push((name, batches(&sent, &trees)?));
    }
    list.push(("points midpoint", payloads(&sent, Rule::Midpoint)?));
    list.push(("points smooth", payloads(&sent, Rule::Smooth)?));
    let bytes = compress(&raster(&units(field), field.row()))?.len();
    let [max, rms] = sent.errors(field.heights());
    list.push(("raster", vec![Step { points: field.samples(), bytes, max, rms }]));
    Ok((sent.unit, list))
}

impl<'a> Sent<'a> {
    fn new(source: &'a Field) -> Self {
        let known = || source.heights().iter().filter(|h| !h.is_nan());
        #[allow(clippy::cast_possible_truncation, reason = "exponents of f64")]
        let mut power = if known().all(|h| h.fract() == 0.0) {
            0
        } else {
            // Level ground has no relief, and any unit will do that holds its height.
            (1e-5 * source.relief()).log10().floor().clamp(-9.0, -2.0) as i32
        };
        let largest = known().fold(0.0f64, |most, h| most.max(h.abs()));
        let ten = |power: i32| if power < 0 { 1.0 / 10f64.powi(-power) } else { 10f64.powi(power) };
        while (largest / ten(power)).round() > f64::from(points::SOURCE_MAX) {
            power += 1;
        }
        let unit = ten(power);
        let heights = source.heights().iter().map(|h| (h / unit).round()).collect();
        let field = Field::new(source.log2(), heights, source.cell()).unwrap_or_else(|| source.clone());
        Self { field, unit, source }
    }

    /// The largest and the RMS error, in metres, of a surface in units.
    fn errors(&self, surface: &[f64]) -> [f64; 2] {
        let apart = surface.iter().zip(self.source.heights()).map(|(s, h)| (self.unit * s - h).abs());
        let known = apart.filter(|e| !e.is_nan());
        let (max, squares, n) = known.fold((0.0f64, 0.0, 0u32), |(m, s, n), e| (m.max(e), s + e * e, n + 1));
        [max, (squares / f64::from(n.max(1))).sqrt()]
    }

    fn step(&self, tree: &Bitree, bytes: usize) -> Step {
        let [max, rms] = self.errors(&surface(&self.field, tree));
        Step { points: tree.points().0, bytes, max, rms }
    }
}

/// Heights as integers; the field has whole units.
fn units(field: &Field) -> Vec<i32> {
    #[allow(clippy::cast_possible_truncation, reason = "at most SOURCE_MAX")]
    field.heights().iter().map(|h| if h.is_nan() { NODATA } else { *h as i32 }).collect()
}

/// The points that are off their means, by level; the first is the corners alone.
fn by_level(field: &Field) -> Vec<Bitree> {
    let full = field.full_tree();
    let mut trees = vec![field.tree()];
    for l in 1..=2 * u32::from(field.log2()) {
        let mut tree = trees[trees.len() - 1].clone();
        for slot in 0..field.heights().len() {
            let p = field.point(slot);
            if level(field.log2(), p) == l
                && let Some(facet) = full.around(p).into_iter().flatten().next()
                && let [ha, _, hb] = facet.heights()
                && !field.at(p).is_nan()
                && field.at(p) != (ha + hb) / 2.0
            {
                tree.add(p, field.at(p));
            }
        }
        trees.push(tree);
    }
    trees
}

/// Bitrees and restricted quadtrees refined to half the tolerance again and again, from the relief down to one unit,
/// then to none.
fn by_tolerance(field: &Field) -> [Vec<Bitree>; 2] {
    let Some(ground) = Ground::new(field, None) else { return [Vec::new(), Vec::new()] };
    let mut trees = [vec![field.tree()], vec![field.tree()]];
    let mut tolerance = field.relief() / 2.0;
    while tolerance > 0.0 {
        tolerance = if tolerance < 1.0 { 0.0 } else { tolerance };
        let [bitree, quadtree] = trees.each_ref().map(|list| list[list.len() - 1].clone());
        trees[0].push(greedy(&ground, Criterion::Vertical, tolerance, GREEDY_SHARE, usize::MAX, bitree));
        let error = |facet: &Facet, enough: f64| Criterion::Vertical.error(&ground, facet, enough);
        trees[1].push(quadtree::complete(field, &quadtree, tolerance, false, error));
        tolerance /= 2.0;
    }
    trees
}

/// The worst first, twice as many points each time.
fn by_error(field: &Field) -> Vec<Bitree> {
    let Some(ground) = Ground::new(field, None) else { return Vec::new() };
    let mut trees = vec![field.tree()];
    loop {
        let before = trees[trees.len() - 1].clone();
        let points = before.points().0;
        let next = greedy(&ground, Criterion::Vertical, 0.0, GREEDY_SHARE, 2 * points, before);
        let is_done = next.points().0 < 2 * points;
        trees.push(next);
        if is_done {
            return trees;
        }
    }
}

/// The batches that lead from each selection to the next.
fn batches(sent: &Sent<'_>, trees: &[Bitree]) -> Result<Vec<Step>, ExperimentError> {
    let (mut steps, mut bytes) = (Vec::new(), 4 * CORNER_BYTES);
    let mut before: Option<&Bitree> = None;
    for tree in trees {
        if let Some(before) = before {
            bytes += compress(&batch(&sent.field, before, tree))?.len();
        }
        steps.push(sent.step(tree, bytes));
        before = Some(tree);
    }
    Ok(steps)
}

/// The points of `after` that `before` has not: gaps, then differences from what is deduced.
fn batch(field: &Field, before: &Bitree, after: &Bitree) -> Vec<u8> {
    let (mut gaps, mut differences, mut last) = (Vec::new(), Vec::new(), 0u64);
    for (slot, at) in (0..field.heights().len()).zip(0u64..) {
        let p = field.point(slot);
        let Some(height) = after.real(p).filter(|_| before.real(p).is_none()) else { continue };
        let around = before.around(p).into_iter().flatten().next();
        let deduced =
            around.map_or(0.0, |facet| f64::midpoint(facet.heights()[0], facet.heights()[2]).round());
        #[allow(clippy::cast_possible_truncation, reason = "at most twice SOURCE_MAX")]
        let difference = (height - deduced).round() as i64;
        varint(&mut gaps, at - last);
        varint(&mut differences, ((difference << 1) ^ (difference >> 63)).cast_unsigned());
        last = at;
    }
    gaps.extend(differences);
    gaps
}

/// 7 bits a byte, the lowest first.
fn varint(out: &mut Vec<u8>, mut value: u64) {
    while value >= 128 {
        out.push((value & 127) as u8 | 128);
        value >>= 7;
    }
    out.push((value & 127) as u8);
}

fn compress(bytes: &[u8]) -> Result<Vec<u8>, ExperimentError> {
    zstd::bulk::compress(bytes, ZSTD_LEVEL).map_err(|e| ExperimentError::Coding(format!("zstd: {e}")))
}

/// Differences from the western neighbour, 2 bytes each if all fit, else 4.
fn raster(heights: &[i32], row: usize) -> Vec<u8> {
    let differences: Vec<i32> = heights
        .chunks(row)
        .flat_map(|line| line.iter().scan(0i32, |west, h| Some(h.wrapping_sub(std::mem::replace(west, *h)))))
        .collect();
    match differences.iter().map(|d| i16::try_from(*d)).collect::<Result<Vec<_>, _>>() {
        Ok(short) => short.into_iter().flat_map(i16::to_le_bytes).collect(),
        Err(_) => differences.into_iter().flat_map(i32::to_le_bytes).collect(),
    }
}

/// Level by level by the points encoding. The last level is checked to be the field itself.
fn payloads(sent: &Sent<'_>, rule: Rule) -> Result<Vec<Step>, ExperimentError> {
    let field = &sent.field;
    let patch_log2 = field.log2().saturating_sub(4).clamp(2, 6);
    let wrong = |e: &dyn std::fmt::Display| ExperimentError::Coding(format!("points encoding: {e}"));
    let forest = Forest::new(field.log2(), patch_log2, [1, 1]).map_err(|e| wrong(&e))?;
    let coding = Coding::new(rule, 1, vec![0; forest.levels() as usize + 1]).map_err(|e| wrong(&e))?;
    let source = units(field);
    let (mut steps, mut bytes) = (Vec::new(), 0);
    let mut before: HashMap<Diamond, Block> = HashMap::new();
    for l in 0..forest.levels() {
        let mut here = HashMap::new();
        for d in forest.diamonds(l) {
            let mut block = Block::empty(&forest, l);
            for parent in forest.parents(d) {
                block.inherit(&forest, d, parent, &before[&parent]);
            }
            let mut whole = Block::empty(&forest, l);
            whole.fill(&forest.local(d), |x, y| source[field.slot([x, y])]);
            let mut received = block.clone();
            let payload = points::encode(&forest, &coding, d, &mut block, &whole);
            points::decode(&forest, &coding, d, &mut received, &payload).map_err(|e| wrong(&e))?;
            if received != whole {
                return Err(wrong(&"a diamond came back changed"));
            }
            bytes += payload.len();
            here.insert(d, received);
        }
        before = here;
        // The root's payload has its own points and the centres between; each level adds the next.
        let known = 2 * u32::from(patch_log2) + l + 1;
        let mut tree = field.tree();
        for (slot, height) in field.heights().iter().enumerate() {
            if level(field.log2(), field.point(slot)) <= known {
                tree.add(field.point(slot), *height);
            }
        }
        steps.push(sent.step(&tree, bytes));
    }
    Ok(steps)
}

fn plots(source: &str, schemes: &[Scheme]) -> Result<Vec<Picture>, ExperimentError> {
    let plot = |file: &str, title: &str, x: &str, y: &str, at: &dyn Fn(&Step) -> [f64; 2]| {
        let series: Vec<plot::Series> = schemes
            .iter()
            .filter(|(name, _)| *name != "raster")
            .map(|(name, steps)| plot::Series {
                name: (*name).to_owned(),
                points: steps.iter().map(at).collect(),
            })
            .collect();
        // Level ground is without error from the first byte on: there is nothing to draw.
        if !series.iter().flat_map(|s| &s.points).any(|p| p.iter().all(|v| *v > 0.0)) {
            return Ok(None);
        }
        let bytes = plot::lines(&format!("{source}: {title}"), [x, y], true, &series)?;
        Ok::<_, ExperimentError>(Some(Picture { file: file.to_owned(), caption: title.to_owned(), bytes }))
    };
    let max = "largest error [m]";
    let rms = "RMS error [m]";
    let all = [
        plot("max-bytes.svg", "largest error against bytes", "bytes", max, &|s| [s.bytes as f64, s.max])?,
        plot("rms-bytes.svg", "RMS error against bytes", "bytes", rms, &|s| [s.bytes as f64, s.rms])?,
        plot("max-points.svg", "largest error against points", "points", max, &|s| [s.points as f64, s.max])?,
        plot("rms-points.svg", "RMS error against points", "points", rms, &|s| [s.points as f64, s.rms])?,
    ];
    Ok(all.into_iter().flatten().collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_scheme_ends_without_error_and_selections_only_grow() {
        let heights: Vec<f64> =
            (0..33 * 33u32).map(|s| f64::from(s % 33 * (s / 33) % 29 + s.wrapping_mul(40_503) % 5)).collect();
        let field = Field::new(5, heights, [30.0, 30.0]).unwrap();
        let window = Window {
            source: "made".to_owned(),
            at: [0, 0],
            origin: [0.0; 2],
            crs: None,
            field,
            weights: None,
        };
        // Heights beyond 2^23 m make the unit ten metres, and a relief of millimetres makes it finer.
        for (times, unit_is, least) in [(1.0, 1.0, 0.0), (1e6, 10.0, 0.0), (1.0 / 3e3, 1e-7, 5e-8)] {
            let heights = window.field.heights().iter().map(|h| h * times).collect();
            let window = Window { field: Field::new(5, heights, [30.0, 30.0]).unwrap(), ..window.clone() };
            let (unit, schemes) = schemes(&window).unwrap();
            assert!(unit.to_bits() == f64::to_bits(unit_is), "{unit}");
            for (name, steps) in schemes {
                assert!(steps.last().unwrap().max <= least * (1.0 + 1e-6), "{times} {name}");
                assert!(steps.first().unwrap().max > least || name == "raster", "{times} {name}");
                let is_growing =
                    steps.windows(2).all(|w| w[0].points <= w[1].points && w[0].bytes <= w[1].bytes);
                assert!(is_growing, "{times} {name}");
            }
        }
    }

    #[test]
    fn numbers_of_seven_bits() {
        let mut out = Vec::new();
        for v in [0, 127, 128, 300] {
            varint(&mut out, v);
        }
        assert_eq!(out, [0, 127, 128, 1, 172, 2]);
    }
}
