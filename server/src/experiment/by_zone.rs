//! What a zone's mask saves: triangles with and without it, and whether the skyline from within the zone stays.
//!
//! The zone is a polygon, or the window's largest lake: samples of one height, as many as there are in one piece. Eyes
//! stand along its contour, and rays tell what of the window is seen from them ([`crate::zone`]). The mask weighs
//! curvatures in the quadtree and distances in the bitree. Skylines are compared from places all over the zone, half
//! of them at the highest place of an eye and half between that and the ground: no such place was an eye of the mask
//! but by chance.

use super::by_curvature::with_share;
use super::curvature::quadtree::{Quadtree, Sums};
use super::curvature::templates;
use super::field::Field;
use super::report::{Picture, Report, Table};
use super::scan;
use super::select::{Criterion, Ground as Weighed, Strategy, by_strategy};
use super::view;
use super::windows::Window;
use super::{ExperimentError, Run, plot};
use crate::zone::cast::{Eye, Optics, cast, walk};
use crate::zone::polygon::{self, Coordinates, contour, perimeter};
use crate::zone::relief::Relief;
use crate::zone::tiled::Tiled;
use crate::zone::view::Ground;
use crate::zone::{ANGLE, EPSILON, EYES, HIDDEN, SPACING_CELLS};
use diamantina_protocol::NODATA;
use diamantina_protocol::bintree::Point;
use rayon::prelude::*;
use std::f64::consts::TAU;
use std::path::{Path, PathBuf};

/// Percent of the full grid's polygons that the plain quadtree has.
const SHARES: [f64; 5] = [50.0, 20.0, 10.0, 5.0, 2.0];
/// The one that is pictured.
const PICTURED: f64 = 10.0;
/// Metres of a quantum of heights while rays are cast.
const QUANTUM: f64 = 1e-3;
/// Cells of the smallest lake that is taken for a zone.
const LAKE_CELLS_MIN: usize = 50;
/// Places from which skylines are compared.
const PLACES: usize = 12;
/// Azimuths of a plotted skyline.
const PLOTTED: usize = 720;

/// What the zone is.
#[derive(Debug, Clone, clap::Args)]
#[group(id = "zone_options")]
pub(crate) struct Options {
    /// `zone`: the region where the viewer stays, as GeoJSON [default: the largest lake of each window]
    #[arg(long, value_name = "GEOJSON")]
    pub(crate) polygon: Option<PathBuf>,
    /// What the polygon's numbers mean
    #[arg(long, value_enum, default_value_t = Coordinates::Auto)]
    pub(crate) coordinates: Coordinates,
    /// What the errors of hidden ground count for: 0 to below 1
    #[arg(long, default_value_t = HIDDEN, value_name = "SHARE", allow_negative_numbers = true)]
    pub(crate) hidden: f64,
    /// The angle of a pixel: what is hidden by less counts fully. 0: all that is hidden counts for --hidden
    #[arg(long, default_value_t = ANGLE, value_name = "RADIANS", allow_negative_numbers = true)]
    pub(crate) angle: f64,
}

const COLUMNS: [&str; 14] = [
    "DEM",
    "mesh",
    "tolerance",
    "triangles",
    "with the mask",
    "left [%]",
    "skyline moved by the mask [px]",
    "azimuths moved by more than 1 px [%]",
    "skyline off without mask [px]",
    "azimuths off by more than 1 px without mask [%]",
    "skyline off with mask [px]",
    "azimuths off by more than 1 px with mask [%]",
    "places under the mesh",
    "places under the masked mesh",
];

pub(super) fn run(run: &Run<'_>) -> Result<Report, ExperimentError> {
    let Options { hidden, angle, .. } = run.options.zone;
    for (option, value, most) in [("--hidden", hidden, 0.996), ("--angle", angle, 0.1)] {
        if !(0.0..=most).contains(&value) {
            let expected = format!("a number from 0 to {most}");
            return Err(ExperimentError::Options { option, expected, found: value.to_string() });
        }
    }
    let mut table =
        Table::new("zone", "Triangles without and with the mask, and skylines from the zone", &COLUMNS);
    let mut masks = Table::new(
        "masks",
        "What is seen from the zone",
        &["DEM", "zone", "samples", "eyes", "in the zone [%]", "seen [%]", "hidden [%]", "seconds"],
    );
    let mut pictures = Vec::new();
    let mut notes = Vec::new();
    for (i, window) in run.windows.iter().enumerate() {
        match one(run, i, window, [&mut table, &mut masks], &mut pictures) {
            // Of many windows some have no lake.
            Err(ExperimentError::Options { option: "--polygon", found, .. }) if run.windows.len() > 1 => {
                notes.push(format!("{} at {:?} is left out: {found}.", window.source, window.at));
            }
            done => done?,
        }
    }
    notes.extend([
        format!(
            "Eyes stand {} m above the highest ground of their polygon. The bitree's selection is compact, by vertical \
             distance. Hidden ground counts for {hidden}, and for more \
             where it is hidden by less than {angle} radians over that. A pixel is {ANGLE} radians.",
            run.options.eye
        ),
        format!(
            "Skylines from {PLACES} places in the zone, compared at each half pixel: the largest difference, and the \
             share of the azimuths that differ by more than a pixel. Places that a coarse mesh covers have no \
             skyline; they are counted. Surfaces are drawn through the heights \
             that a mesh has at every sample."
        ),
    ]);
    Ok(Report { title: "Visibility from a zone".to_owned(), notes, tables: vec![table, masks], pictures })
}

/// Where the viewer stays.
struct Region {
    name: String,
    /// Samples that belong to it, and the highest place of an eye there, metres.
    own: Vec<(Point, f64)>,
    /// The eyes of the mask.
    eyes: Vec<Eye>,
}

fn one(
    run: &Run<'_>,
    number: usize,
    window: &Window,
    [table, masks]: [&mut Table; 2],
    pictures: &mut Vec<Picture>,
) -> Result<(), ExperimentError> {
    let field = &window.field;
    let ground = ground(window, field.heights());
    let region = match &run.options.zone.polygon {
        Some(path) => from_polygon(run, window, &ground, path)?,
        None => from_lake(run, window, &ground)?,
    };
    let started = std::time::Instant::now();
    let optics = Optics {
        cell: field.cell(),
        quantum: QUANTUM,
        bend: 0.0,
        epsilon: EPSILON,
        hidden: run.options.zone.hidden,
        angle: run.options.zone.angle,
    };
    run.progress.stage("casting rays", "eyes", region.eyes.len() as u64, 0);
    let mut mask =
        cast(&ground.relief, &optics, &region.eyes, run.progress).ok_or(ExperimentError::Stopped)?;
    region.own.iter().for_each(|(p, _)| mask.set(p.map(|w| w as usize), u8::MAX));
    let seconds = started.elapsed().as_secs_f64();
    let mask: Vec<u8> = mask.rows().collect();
    let percent = |is: &dyn Fn(u8) -> bool| {
        let count = mask.iter().filter(|share| is(**share)).count();
        format!("{:.1}", 100.0 * count as f64 / mask.len() as f64)
    };
    let least = mask.iter().copied().min().unwrap_or(0);
    masks.push([
        window.source.clone(),
        region.name.clone(),
        mask.len().to_string(),
        region.eyes.len().to_string(),
        format!("{:.1}", 100.0 * region.own.len() as f64 / mask.len() as f64),
        percent(&|share| share == u8::MAX),
        percent(&|share| share == least && least < u8::MAX),
        format!("{seconds:.1}"),
    ]);
    pictures.push(Picture {
        file: format!("{number}-mask.png"),
        caption: format!(
            "{}: bright is seen, dark is hidden, blue is the zone ({})",
            window.source, region.name
        ),
        bytes: map(field, &mask, &region.own).map_err(|e| ExperimentError::Plot(e.to_string()))?,
    });
    let weights: Vec<f32> = mask.iter().map(|share| f32::from(*share) / 255.0).collect();
    let sight = Sight::new(window, &region, field.heights());
    let [plain, masked] = [None, Some(&weights[..])].map(|weights| Sums::new(field, weights));
    let steps = SHARES.len() + run.options.tolerances.len();
    run.progress.stage("meshes", "pairs", steps as u64, 0);
    for share in SHARES {
        let (threshold, mesh) = with_share(field, &plain, None, share / 100.0);
        let other = templates::triangles(&Quadtree::new(field, &masked, threshold, None));
        let both = [&mesh, &other].map(|mesh| view::surface(field, mesh));
        let tolerance = format!("T = {threshold:.3e} ({share} % of the polygons)");
        table.push(sight.row(["curvature quadtree", &tolerance], [mesh.len(), other.len()], &both));
        if share == PICTURED {
            sight.pictures(number, field, &both, pictures)?;
            for (name, mesh) in [("plain", &mesh), ("masked", &other)] {
                let caption = format!("{name} mesh by curvature, {} triangles", mesh.len());
                let bytes = plot::mesh(field.side(), mesh);
                pictures.push(Picture { file: format!("{number}-{name}-mesh.svg"), caption, bytes });
            }
        }
        run.progress.advance(1);
        if run.progress.is_stopping() {
            return Err(ExperimentError::Stopped);
        }
    }
    for percent in &run.options.tolerances {
        let metres = percent / 100.0 * field.relief();
        let trees = [None, Some(&weights[..])].map(|weights| {
            let weighed = Weighed::new(field, weights).expect("a weight from 0 to 1 for each sample");
            by_strategy(&weighed, Criterion::Vertical, metres, Strategy::Compact)
        });
        let both = [&trees[0], &trees[1]].map(|tree| scan::surface(field, tree));
        let tolerance = format!("{metres:.1} m ({percent} % of the relief)");
        let counts = [&trees[0], &trees[1]].map(|tree| tree.triangle_count());
        table.push(sight.row(["bitree", &tolerance], counts, &both));
        run.progress.advance(1);
        if run.progress.is_stopping() {
            return Err(ExperimentError::Stopped);
        }
    }
    Ok(())
}

/// Heights of a window's samples as rays need them.
fn ground(window: &Window, heights: &[f64]) -> Ground {
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

fn from_polygon(
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
    let spacing = (SPACING_CELLS * cell).max(around / EYES);
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

fn from_lake(run: &Run<'_>, window: &Window, ground: &Ground) -> Result<Region, ExperimentError> {
    let field = &window.field;
    let cells = lake(field);
    if cells.len() < LAKE_CELLS_MIN {
        return Err(ExperimentError::Options {
            option: "--polygon",
            expected: format!("a region, as the window of {} at {:?} has no lake", window.source, window.at),
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
    let mut spacing = SPACING_CELLS;
    let mut posts = apart(&shore, spacing);
    while posts.len() as f64 > EYES {
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

/// Skylines from within a zone.
struct Sight<'a> {
    window: &'a Window,
    eyes: Vec<Eye>,
    /// By eye and azimuth: angles in pixels.
    full: Vec<Option<Vec<f64>>>,
}

impl<'a> Sight<'a> {
    fn new(window: &'a Window, region: &Region, heights: &[f64]) -> Self {
        let field = &window.field;
        let step = (region.own.len() / PLACES).max(1);
        let places = region.own.iter().skip(step / 2).step_by(step).take(PLACES);
        let eye = |(i, (p, ceiling)): (usize, &(Point, f64))| {
            let ground = Some(field.at(*p)).filter(|h| !h.is_nan() && h < ceiling);
            let low = ground.map_or(*ceiling, |ground| f64::midpoint(ground, *ceiling));
            let height = if i % 2 == 0 { *ceiling } else { low };
            Eye { place: p.map(f64::from), height: height / QUANTUM }
        };
        let eyes: Vec<Eye> = places.enumerate().map(eye).collect();
        let mut sight = Self { window, eyes, full: Vec::new() };
        sight.full = sight.skylines(heights);
        sight
    }

    /// Of a place that the surface covers there is none.
    fn skylines(&self, heights: &[f64]) -> Vec<Option<Vec<f64>>> {
        let ground = ground(self.window, heights);
        let optics = Optics {
            cell: ground.cell,
            quantum: QUANTUM,
            bend: 0.0,
            epsilon: ANGLE,
            hidden: 0.0,
            angle: 0.0,
        };
        let of = |eye: &Eye| {
            if ground.relief.height(eye.place).is_some_and(|height| height >= eye.height) {
                return None;
            }
            let azimuths = (TAU / ANGLE * 2.0).ceil();
            #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "some thousands")]
            let skyline = (0..azimuths as u32).map(|i| {
                let mut highest = f64::NEG_INFINITY;
                walk(&ground.relief, &optics, *eye, (f64::from(i) + 0.5) / azimuths * TAU, |seen| {
                    highest = highest.max(seen.slopes[1]);
                });
                (highest * QUANTUM).atan() / ANGLE
            });
            Some(skyline.collect())
        };
        self.eyes.par_iter().map(of).collect()
    }

    /// The largest difference in pixels, and the percentage of the azimuths that differ by more than one, over the
    /// places that neither surface covers.
    fn difference(a: &[Option<Vec<f64>>], b: &[Option<Vec<f64>>]) -> [f64; 2] {
        let (mut largest, mut moved, mut all) = (0.0f64, 0u32, 0u32);
        let both = a.iter().zip(b).filter_map(|(a, b)| a.as_ref().zip(b.as_ref()));
        for (a, b) in both.flat_map(|(a, b)| a.iter().zip(b)) {
            let apart = (a - b).abs();
            largest = largest.max(apart);
            moved += u32::from(apart > 1.0);
            all += 1;
        }
        // Without a place to compare from nothing is known, and that is no agreement.
        if all == 0 { [f64::NAN; 2] } else { [largest, 100.0 * f64::from(moved) / f64::from(all)] }
    }

    fn row(&self, [mesh, tolerance]: [&str; 2], counts: [usize; 2], surfaces: &[Vec<f64>; 2]) -> Vec<String> {
        let [plain, masked] = surfaces.each_ref().map(|heights| self.skylines(heights));
        let covered = [&plain, &masked].map(|all| all.iter().filter(|one| one.is_none()).count().to_string());
        let pairs = [(&masked, &plain), (&plain, &self.full), (&masked, &self.full)];
        let left = 100.0 * counts[1] as f64 / counts[0].max(1) as f64;
        let head = [self.window.source.clone(), mesh.to_owned(), tolerance.to_owned()];
        let counts = counts.map(|count| count.to_string()).into_iter().chain([format!("{left:.1}")]);
        let differences =
            pairs.into_iter().flat_map(|(a, b)| Self::difference(a, b).map(|d| format!("{d:.2}")));
        head.into_iter().chain(counts).chain(differences).chain(covered).collect()
    }

    /// What is seen from a place in the zone, towards the highest ground; and its skyline.
    fn pictures(
        &self,
        number: usize,
        field: &Field,
        [plain, masked]: &[Vec<f64>; 2],
        pictures: &mut Vec<Picture>,
    ) -> Result<(), ExperimentError> {
        // One at the highest place of an eye.
        let middle = self.eyes.len() / 4 * 2;
        let Some(eye) = self.eyes.get(middle) else { return Ok(()) };
        let known = (0..field.heights().len()).filter(|slot| !field.heights()[*slot].is_nan());
        let highest = known.max_by(|a, b| field.heights()[*a].total_cmp(&field.heights()[*b])).unwrap_or(0);
        let towards = field.point(highest).map(f64::from);
        let looker = view::Eye { at: eye.place, height: eye.height * QUANTUM, towards };
        let full = view::render(field, field.heights(), looker);
        let mut series = Vec::new();
        for (name, heights) in [("full", field.heights()), ("plain", plain), ("masked", masked)] {
            let seen = view::render(field, heights, looker);
            let [changed, _] = view::difference(&full, &seen);
            let caption =
                format!("{name}: from the zone; {changed:.2} % of the pixels differ from the full grid");
            let bytes = view::png(&seen).map_err(|e| ExperimentError::Plot(e.to_string()))?;
            pictures.push(Picture { file: format!("{number}-view-{name}.png"), caption, bytes });
            let Some(skyline) = &self.skylines(heights)[middle] else { continue };
            let every = (skyline.len() / PLOTTED).max(1);
            let degrees = 360.0 / skyline.len() as f64;
            let points = skyline.iter().enumerate().step_by(every);
            let points =
                points.map(|(i, pixels)| [i as f64 * degrees, (pixels * ANGLE).to_degrees()]).collect();
            series.push(plot::Series { name: name.to_owned(), points });
        }
        let axes = ["azimuth [degrees from east]", "elevation [degrees]"];
        let bytes =
            plot::lines(&format!("{}: skyline from the zone", self.window.source), axes, false, &series)?;
        let caption = "Skylines of the full grid and of both meshes".to_owned();
        pictures.push(Picture { file: format!("{number}-skyline.svg"), caption, bytes });
        Ok(())
    }
}

/// The mask over the shaded ground, north up.
fn map(field: &Field, mask: &[u8], own: &[(Point, f64)]) -> Result<Vec<u8>, png::EncodingError> {
    let row = field.row();
    let mut pixels = vec![[0u8; 3]; row * row];
    for (slot, pixel) in pixels.iter_mut().enumerate() {
        let [x, y] = field.point(slot);
        let [before, after] = [x.saturating_sub(1), (x + 1).min(field.side())];
        let [below, above] = [y.saturating_sub(1), (y + 1).min(field.side())];
        let east =
            (field.at([after, y]) - field.at([before, y])) / (f64::from(after - before) * field.cell()[0]);
        let north =
            (field.at([x, above]) - field.at([x, below])) / (f64::from(above - below) * field.cell()[1]);
        let share = f64::from(mask[slot]) / 255.0;
        if !east.is_nan() && !north.is_nan() {
            let shade = f64::from(view::shade([east, north], 0.0));
            let lit =
                [0.30 + 0.70 * share, 0.30 + 0.66 * share, 0.34 + 0.46 * share].map(|part| part * shade);
            #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "from 0 to 255")]
            let lit = lit.map(|v| v as u8);
            *pixel = lit;
        }
    }
    own.iter().for_each(|(p, _)| pixels[field.slot(*p)] = [40, 90, 170]);
    let mut bytes = Vec::new();
    let size = u32::try_from(row).unwrap_or(u32::MAX);
    let mut encoder = png::Encoder::new(&mut bytes, size, size);
    encoder.set_color(png::ColorType::Rgb);
    encoder.set_depth(png::BitDepth::Eight);
    let northern_first: Vec<u8> = pixels.chunks(row).rev().flatten().flatten().copied().collect();
    encoder.write_header()?.write_image_data(&northern_first)?;
    Ok(bytes)
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
