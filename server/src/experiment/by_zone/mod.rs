//! What a zone's mask saves: triangles with and without it, and whether the skyline from within the zone stays.
//!
//! The zone is a polygon, or the window's largest lake: samples of one height, as many as there are in one piece. Eyes
//! stand along its contour, and rays tell what of the window is seen from them ([`crate::zone`]). The mask weighs
//! curvatures in the quadtree and distances in the bitree. Skylines are compared from places all over the zone, half
//! of them at the highest place of an eye and half between that and the ground: no such place was an eye of the mask
//! but by chance.

mod map;
mod region;
mod sight;

use super::by_curvature::{full_polygons, with_share};
use super::curvature::quadtree::{Quadtree, Sums};
use super::curvature::templates;
use super::report::{Picture, Report, Table};
use super::select::{Ground as Weighed, by_strategy, scale, select};
use super::windows::Window;
use super::{ExperimentError, Run, scan, view};
use crate::zone::cast::{Optics, cast};
use crate::zone::polygon::Coordinates;
use crate::zone::{ANGLE, EPSILON, HIDDEN};
use diamantina_protocol::bintree::Point;
use region::Region;
use sight::Sight;
use std::path::PathBuf;

/// Percent of the full grid's polygons that the plain quadtree has.
const SHARES: [f64; 5] = [50.0, 20.0, 10.0, 5.0, 2.0];
/// Metres of a quantum of heights while rays are cast.
const QUANTUM: f64 = 1e-3;
/// What the zone is.
#[derive(Debug, Clone, clap::Args)]
#[group(id = "zone_options")]
pub(crate) struct Options {
    /// `zone`: the region where the viewer stays, as GeoJSON [default: the largest lake of each window]
    #[arg(long, value_name = "GEOJSON")]
    pub(crate) polygon: Option<PathBuf>,
    /// `zone`: what the polygon's numbers mean
    #[arg(long, value_enum, default_value_t = Coordinates::Auto)]
    pub(crate) coordinates: Coordinates,
    /// `zone`: what the errors of hidden ground count for: 0 to 0.996
    #[arg(long, default_value_t = HIDDEN, value_name = "SHARE")]
    pub(crate) hidden: f64,
    /// `zone`: the angle of a pixel: what is hidden by less counts fully. 0: all that is hidden counts for --hidden
    #[arg(long, default_value_t = ANGLE, value_name = "RADIANS")]
    pub(crate) angle: f64,
    /// `zone`: the least apparent width of a triangle that a ray must not miss
    #[arg(long, default_value_t = EPSILON, value_name = "RADIANS")]
    pub(crate) epsilon: f64,
    /// `zone`: metres between eyes along the contour [default: 4 cells, or more for 200 eyes at most]
    #[arg(long, value_name = "METRES")]
    pub(crate) spacing: Option<f64>,
}

const COLUMNS: [&str; 17] = [
    "DEM",
    "x",
    "y",
    "mesh",
    "tolerance",
    "selected",
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
    let Options { hidden, angle, epsilon, spacing, .. } = run.options.zone;
    for (option, value, least, most) in
        [("--hidden", hidden, 0.0, 0.996), ("--angle", angle, 0.0, 0.1), ("--epsilon", epsilon, 1e-6, 0.1)]
    {
        if !(least..=most).contains(&value) {
            let expected = format!("a number from {least} to {most}");
            return Err(ExperimentError::Options { option, expected, found: value.to_string() });
        }
    }
    if let Some(found) = spacing.filter(|metres| !(*metres > 0.0 && metres.is_finite())) {
        let (option, expected, found) = ("--spacing", "metres, above 0".to_owned(), found.to_string());
        return Err(ExperimentError::Options { option, expected, found });
    }
    let mut table =
        Table::new("zone", "Triangles without and with the mask, and skylines from the zone", &COLUMNS);
    let mut masks = Table::new(
        "masks",
        "What is seen from the zone",
        &["DEM", "x", "y", "zone", "samples", "eyes", "in the zone [%]", "seen [%]", "hidden [%]"],
    );
    let mut pictures = Vec::new();
    let mut notes = Vec::new();
    for (i, window) in run.windows.iter().enumerate() {
        match one(run, i, window, [&mut table, &mut masks], &mut pictures) {
            // Of many windows some have no lake.
            Err(ExperimentError::Options { option: "--polygon", found, .. }) if run.windows.len() > 1 => {
                notes.push(format!("{} is left out: {found}.", window.label()));
            }
            done => done?,
        }
    }
    if table.rows.is_empty() {
        return Err(ExperimentError::Options {
            option: "--polygon",
            expected: "a region given, as no window has a lake".to_owned(),
            found: format!("none for {} windows", run.windows.len()),
        });
    }
    notes.extend([
        format!(
            "Eyes stand {} m above the highest ground of their polygon. Bitrees without and with the mask are selected in the same \
             way, told beside each, the default by the criterion, {}. Hidden ground counts for {hidden}, and for more \
             where it is hidden by less than {angle} radians over that. A pixel is {ANGLE} radians.",
            run.options.eye,
            run.options.criterion,
        ),
        format!(
            "Skylines from {} places in the zone, compared at each half pixel: the largest difference, and the \
             share of the azimuths that differ by more than a pixel. Places that a coarse mesh covers have no \
             skyline; they are counted. Surfaces are drawn through the heights \
             that a mesh has at every sample.",
            sight::PLACES
        ),
        "Pictured is, of each kind of mesh, the one with the fewest triangles whose skyline the mask moves by a pixel at \
         most; if there is none, the one that it moves the least."
            .to_owned(),
    ]);
    Ok(Report { title: "Visibility from a zone".to_owned(), notes, tables: vec![table, masks], pictures })
}

/// A mesh without and with the mask.
struct Pair {
    kind: &'static str,
    tolerance: String,
    /// How the bitrees' points were found.
    selected: String,
    meshes: [Vec<[Point; 3]>; 2],
    /// Heights at every sample.
    surfaces: [Vec<f64>; 2],
}

/// The pair of each kind that is to be pictured, and the pixels by which its skyline moves.
#[derive(Default)]
struct Pictured(Option<(Pair, f64)>);

impl Pictured {
    fn offer(&mut self, pair: Pair, moved: f64) {
        let rank = |pair: &Pair, moved: f64| {
            let stays = moved <= 1.0;
            // Fewest triangles among those that stay, else the least that moves; NaN last.
            (!stays, if stays { pair.meshes[1].len() as f64 } else { moved })
        };
        let is_better = self.0.as_ref().is_none_or(|(best, best_moved)| {
            let [new, old] = [rank(&pair, moved), rank(best, *best_moved)];
            new.0.cmp(&old.0).then(new.1.total_cmp(&old.1)).is_lt()
        });
        if is_better {
            self.0 = Some((pair, moved));
        }
    }
}

fn one(
    run: &Run<'_>,
    number: usize,
    window: &Window,
    [table, masks]: [&mut Table; 2],
    pictures: &mut Vec<Picture>,
) -> Result<(), ExperimentError> {
    let field = &window.field;
    let ground = region::ground(window, field.heights());
    let region = match &run.options.zone.polygon {
        Some(path) => region::from_polygon(run, window, &ground, path)?,
        None => region::from_lake(run, window, &ground)?,
    };
    let optics = Optics {
        cell: field.cell(),
        quantum: QUANTUM,
        bend: 0.0,
        epsilon: run.options.zone.epsilon,
        hidden: run.options.zone.hidden,
        angle: run.options.zone.angle,
    };
    run.progress.stage("casting rays", "eyes", region.eyes.len() as u64, 0);
    let mut mask =
        cast(&ground.relief, &optics, &region.eyes, run.progress).ok_or(ExperimentError::Stopped)?;
    region.own.iter().for_each(|(p, _)| mask.set(p.map(|w| w as usize), u8::MAX));
    let mask: Vec<u8> = mask.rows().collect();
    masks.push(told(window, &region, &mask));
    pictures.push(Picture {
        file: format!("{number}-mask.png"),
        caption: format!(
            "{}: bright is seen, dark is hidden, blue is the zone ({})",
            window.label(),
            region.name
        ),
        bytes: map::draw(field, &mask, &region.own).map_err(|e| ExperimentError::Plot(e.to_string()))?,
    });
    let weights: Vec<f32> = mask.iter().map(|share| f32::from(*share) / 255.0).collect();
    let sight = Sight::new(window, &region, field.heights());
    let [plain, masked] = [None, Some(&weights[..])].map(|weights| Sums::new(field, weights));
    let grounds = [None, Some(&weights[..])]
        .map(|weights| Weighed::new(field, weights).expect("a weight from 0 to 1 for each sample"));
    let whole = scale(&grounds[0], run.options.criterion);
    let steps = SHARES.len() + run.options.tolerances.len();
    run.progress.stage("meshes", "pairs", steps as u64, 0);
    let mut pictured = [Pictured::default(), Pictured::default()];
    let mut push = |kind: usize, pair: Pair| {
        let (row, moved) = sight.row(&pair);
        table.push(row);
        pictured[kind].offer(pair, moved);
        run.progress.advance(1);
        if run.progress.is_stopping() { Err(ExperimentError::Stopped) } else { Ok(()) }
    };
    for share in SHARES {
        let (threshold, mesh) = with_share(field, &plain, None, share / 100.0);
        let meshes = [mesh, templates::triangles(&Quadtree::new(field, &masked, threshold, None))];
        let surfaces = meshes.each_ref().map(|mesh| view::surface(field, mesh));
        let left = 100.0 * meshes[0].len() as f64 / full_polygons(field);
        // Where much is without a height, even the coarsest mesh has more.
        let told = if left > share {
            format!(", of which no fewer than {left:.1} % can be had")
        } else {
            String::new()
        };
        let tolerance = format!("T = {threshold:.3e} ({share} % of the polygons{told})");
        let selected = String::new();
        push(0, Pair { kind: "curvature quadtree", tolerance, selected, meshes, surfaces })?;
    }
    for percent in &run.options.tolerances {
        let tolerance = percent / 100.0 * whole;
        let (plain, way) = select(&grounds[0], run.options.criterion, tolerance);
        // In the same way, or else the two would differ by more than the mask.
        let trees = [plain, by_strategy(&grounds[1], run.options.criterion, tolerance, way)];
        let selected = way.to_string();
        let surfaces = trees.each_ref().map(|tree| scan::surface(field, tree));
        let meshes = trees.map(|tree| {
            tree.triangles().into_iter().map(|corners| corners.map(|(point, _)| point)).collect()
        });
        let tolerance = format!("{tolerance:.1} ({percent} %)");
        push(1, Pair { kind: "bitree", tolerance, selected, meshes, surfaces })?;
    }
    pictures.extend(sight.pictures(number, pictured.iter().filter_map(|pictured| pictured.0.as_ref()))?);
    Ok(())
}

/// A row about a mask.
fn told(window: &Window, region: &Region, mask: &[u8]) -> Vec<String> {
    let percent = |is: &dyn Fn(u8) -> bool| {
        let count = mask.iter().filter(|share| is(**share)).count();
        format!("{:.1}", 100.0 * count as f64 / mask.len() as f64)
    };
    let least = mask.iter().copied().min().unwrap_or(0);
    let [x, y] = window.at.map(|w| w.to_string());
    vec![
        window.source.clone(),
        x,
        y,
        region.name.clone(),
        mask.len().to_string(),
        region.eyes.len().to_string(),
        format!("{:.1}", 100.0 * region.own.len() as f64 / mask.len() as f64),
        percent(&|share| share == u8::MAX),
        percent(&|share| share == least && least < u8::MAX),
    ]
}
