//! What is seen from within a zone: skylines, and pictures of them.

use super::super::report::Picture;
use super::super::windows::Window;
use super::super::{ExperimentError, plot, view};
use super::region::{Region, ground};
use super::{Pair, QUANTUM};
use crate::zone::ANGLE;
use crate::zone::cast::{Eye, Optics, walk};
use diamantina_protocol::bintree::Point;
use rayon::prelude::*;
use std::f64::consts::TAU;

/// Places from which skylines are compared.
pub(super) const PLACES: usize = 12;
/// Azimuths of a plotted skyline.
const PLOTTED: usize = 720;

/// Skylines from within a zone.
pub(super) struct Sight<'a> {
    window: &'a Window,
    eyes: Vec<Eye>,
    /// By eye and azimuth: angles in pixels.
    full: Vec<Option<Vec<f64>>>,
}

impl<'a> Sight<'a> {
    pub(super) fn new(window: &'a Window, region: &Region, heights: &[f64]) -> Self {
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

    /// A row about a pair, and the pixels by which the mask moves its skylines.
    pub(super) fn row(&self, pair: &Pair) -> (Vec<String>, f64) {
        let [plain, masked] = pair.surfaces.each_ref().map(|heights| self.skylines(heights));
        let covered = [&plain, &masked].map(|all| all.iter().filter(|one| one.is_none()).count().to_string());
        let pairs = [(&masked, &plain), (&plain, &self.full), (&masked, &self.full)];
        let counts = pair.meshes.each_ref().map(Vec::len);
        let left = 100.0 * counts[1] as f64 / counts[0].max(1) as f64;
        let [x, y] = self.window.at.map(|w| w.to_string());
        let head = [self.window.source.as_str(), &x, &y, pair.kind, &pair.tolerance, &pair.selected]
            .map(str::to_owned);
        let counts = counts.map(|count| count.to_string()).into_iter().chain([format!("{left:.1}")]);
        let differences = pairs.map(|(a, b)| Self::difference(a, b));
        let cells = differences.iter().flatten().map(|pixels| format!("{pixels:.2}"));
        (head.into_iter().chain(counts).chain(cells).chain(covered).collect(), differences[0][0])
    }

    /// What is seen from a place in the zone, towards the highest ground: of the full grid, and without and with the
    /// mask of each pair, whose skyline it moves by so many pixels; skylines; and the meshes.
    pub(super) fn pictures<'p>(
        &self,
        number: usize,
        pairs: impl Iterator<Item = &'p (Pair, f64)>,
    ) -> Result<Vec<Picture>, ExperimentError> {
        let field = &self.window.field;
        // One at the highest place of an eye.
        let middle = self.eyes.len() / 4 * 2;
        let Some(eye) = self.eyes.get(middle) else { return Ok(Vec::new()) };
        let known = (0..field.heights().len()).filter(|slot| !field.heights()[*slot].is_nan());
        let highest = known.max_by(|a, b| field.heights()[*a].total_cmp(&field.heights()[*b])).unwrap_or(0);
        let towards = field.point(highest).map(f64::from);
        let height = eye.height * QUANTUM;
        let [dx, dy] = [0, 1].map(|i| (towards[i] - eye.place[i]) * field.cell()[i]);
        let rise = (field.heights()[highest] - height) / dx.hypot(dy).max(f64::MIN_POSITIVE);
        let rise = if rise.is_finite() { rise.clamp(-1.0, 1.0) } else { 0.0 };
        let looker = view::Eye { at: eye.place, height, towards, rise };
        let drawn = |bytes: Result<Vec<u8>, png::EncodingError>| {
            bytes.map_err(|e| ExperimentError::Plot(e.to_string()))
        };
        let full = view::render(field, field.heights(), looker);
        let mut pictures = vec![Picture {
            file: format!("{number}-view-full.png"),
            caption: format!(
                "{}: the full grid from the zone, towards the highest ground",
                self.window.label()
            ),
            bytes: drawn(view::png(&full))?,
        }];
        for (pair, moved) in pairs {
            let name = pair.kind.split(' ').next().unwrap_or_default();
            let about = format!("{}: {} within {}", self.window.label(), pair.kind, pair.tolerance);
            let views = pair.surfaces.each_ref().map(|heights| view::render(field, heights, looker));
            for ((which, seen), mesh) in
                [("plain", &views[0]), ("masked", &views[1])].iter().zip(&pair.meshes)
            {
                let [changed, _] = view::difference(&full, seen);
                pictures.push(Picture {
                    file: format!("{number}-{name}-view-{which}.png"),
                    caption: format!(
                        "{about}, {which}: from the zone; {changed:.2} % of the pixels differ from the full grid"
                    ),
                    bytes: drawn(view::png(seen))?,
                });
                pictures.push(Picture {
                    file: format!("{number}-{name}-mesh-{which}.png"),
                    caption: format!("{about}, {which}: {} triangles", mesh.len()),
                    bytes: drawn(plot::mesh(field.side(), mesh))?,
                });
            }
            let [changed, _] = view::difference(&views[0], &views[1]);
            pictures.push(Picture {
                file: format!("{number}-{name}-view-changes.png"),
                caption: format!(
                    "{about}: red where the mask changes the view, {changed:.2} % of the pixels"
                ),
                bytes: drawn(view::changes(&views[0], &views[1]))?,
            });
            let skylines = pair.surfaces.each_ref().map(|heights| self.skylines(heights));
            let [plain, masked] = &skylines;
            let lines = [("full grid", &self.full), ("plain", plain), ("masked", masked)];
            let series = lines.into_iter().filter_map(|(name, all)| {
                let points = all[middle].as_ref().map(|skyline| {
                    let degrees: Vec<f64> =
                        skyline.iter().map(|pixels| (pixels * ANGLE).to_degrees()).collect();
                    thinned(&degrees)
                });
                points.map(|points| plot::Series { name: name.to_owned(), points })
            });
            let azimuth = "azimuth [degrees from east to north]";
            let axes = [azimuth, "elevation [degrees]"];
            let title = format!("{}, {}: skyline from the zone", self.window.label(), pair.kind);
            pictures.push(Picture {
                file: format!("{number}-{name}-skyline.svg"),
                caption: format!("{about}: skylines of the full grid and of both meshes"),
                bytes: plot::lines(&title, axes, false, &series.collect::<Vec<_>>())?,
            });
            let axes = [azimuth, "largest difference of all places [pixels]"];
            let points = thinned(&Self::apart(masked, plain));
            let series = [plot::Series { name: "moved by the mask".to_owned(), points }];
            let title = format!("{}, {}: how far the mask moves skylines", self.window.label(), pair.kind);
            pictures.push(Picture {
                file: format!("{number}-{name}-moved.svg"),
                caption: format!("{about}: the mask moves skylines by {moved:.2} pixels at most"),
                bytes: plot::lines(&title, axes, false, &series)?,
            });
        }
        Ok(pictures)
    }

    /// By azimuth, the largest difference in pixels over the places that neither surface covers.
    fn apart(a: &[Option<Vec<f64>>], b: &[Option<Vec<f64>>]) -> Vec<f64> {
        let mut apart = Vec::new();
        for (a, b) in a.iter().zip(b).filter_map(|(a, b)| a.as_ref().zip(b.as_ref())) {
            apart.resize(a.len(), 0.0f64);
            for (apart, (a, b)) in apart.iter_mut().zip(a.iter().zip(b)) {
                *apart = apart.max((a - b).abs());
            }
        }
        apart
    }
}

/// Values all around as points of a plot, the highest of each few: degrees and value.
fn thinned(values: &[f64]) -> Vec<[f64; 2]> {
    let every = (values.len() / PLOTTED).max(1);
    let degrees = 360.0 / values.len().max(1) as f64;
    let highest = |few: &[f64]| few.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    values.chunks(every).enumerate().map(|(i, few)| [(i * every) as f64 * degrees, highest(few)]).collect()
}
