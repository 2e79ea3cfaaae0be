//! Polygons by local curvature: plain, from an observer's place, behind a mask, and both; and what the observer
//! sees of the difference.
//!
//! For each share of the polygons of the full grid the threshold is found by bisection, since thresholds mean
//! nothing by themselves; and all rules are compared at the same thresholds, those of the plain rule or the ones asked for. The mask is the one given, or what the observer's picture shows of the full field: every
//! sample that some pixel shows, and its neighbours. *All around* is the same of pictures in all directions, for an
//! observer who turns: the change is still counted in the one picture.

use super::curvature::quadtree::{Observer, Quadtree, Sums};
use super::curvature::templates;
use super::field::Field;
use super::report::{Picture, Report, Table};
use super::view::{self, Eye, View};
use super::windows::Window;
use super::{ExperimentError, Run, plot};
use diamantina_protocol::bintree::Point;

/// Percent of the full grid's polygons that are tried.
const SHARES: [f64; 6] = [50.0, 20.0, 10.0, 7.0, 5.0, 2.0];
/// The shares that are pictured: between them lies what an observer begins to notice.
const PICTURED: [f64; 2] = [10.0, 5.0];
/// Pictures that together show all around: each is 60 degrees wide.
const DIRECTIONS: u32 = 6;
/// Halvings of the interval of a threshold's logarithm; the last are finer than any polygon.
const BISECTIONS: usize = 40;

const COLUMNS: [&str; 11] = [
    "DEM",
    "x",
    "y",
    "rule",
    "share asked [%]",
    "threshold T",
    "polygons",
    "share [%]",
    "RMS error [m]",
    "pixels changed [%]",
    "mean difference [shades]",
];

/// Rules that are compared.
const RULES: usize = 5;

const THRESHOLD_COLUMNS: [&str; 4 + RULES] = [
    "DEM",
    "x",
    "y",
    "threshold T",
    "plain: polygons",
    "view: polygons",
    "mask: polygons",
    "view and all around: polygons",
    "view and mask: polygons",
];

pub(super) fn run(run: &Run<'_>) -> Result<Report, ExperimentError> {
    let mut table = Table::new("curvature", "Polygons by curvature and what the observer sees", &COLUMNS);
    let mut thresholds =
        Table::new("thresholds", "Polygons of all rules at the same thresholds", &THRESHOLD_COLUMNS);
    let mut pictures = Vec::new();
    run.progress.stage("splitting", "meshes", (run.windows.len() * SHARES.len() * RULES) as u64, 0);
    for (i, window) in run.windows.iter().enumerate() {
        one(run, i, window, [&mut table, &mut thresholds], &mut pictures)?;
    }
    let o = run.options;
    let notes = vec![
        format!(
            "The observer stands {} m above the ground{}; distance forgives with a = {}.",
            o.eye,
            o.observer.map_or(String::new(), |[x, y]| format!(" at sample {x}, {y}")),
            o.forgiveness
        ),
        "Pixels count as changed beyond 8 of 255 shades.".to_owned(),
    ];
    Ok(Report {
        title: "Simplification by curvature".to_owned(),
        notes,
        tables: vec![table, thresholds],
        pictures,
    })
}

/// One rule with its sums.
struct Rule {
    name: &'static str,
    sums: Sums,
    observer: Option<Observer>,
}

fn one(
    run: &Run<'_>,
    number: usize,
    window: &Window,
    [table, thresholds]: [&mut Table; 2],
    pictures: &mut Vec<Picture>,
) -> Result<(), ExperimentError> {
    let field = &window.field;
    let eye = eye(run, window)?;
    let full = view::render(field, field.heights(), eye);
    let mask = window.weights.clone().unwrap_or_else(|| grown(field, &full.seen));
    let around = grown(field, &seen_around(field, eye));
    let observer = Observer { at: eye.at, forgiveness: run.options.forgiveness };
    let rules: [Rule; RULES] = [
        Rule { name: "plain", sums: Sums::new(field, None), observer: None },
        Rule { name: "view", sums: Sums::new(field, None), observer: Some(observer) },
        Rule { name: "mask", sums: Sums::new(field, Some(&mask)), observer: None },
        Rule { name: "view and all around", sums: Sums::new(field, Some(&around)), observer: Some(observer) },
        Rule { name: "view and mask", sums: Sums::new(field, Some(&mask)), observer: Some(observer) },
    ];
    let (mut series, mut plain) = (Vec::new(), Vec::new());
    let about = format!("{}: all polygons, from the observer's place", window.label());
    pictures.push(png(format!("{number}-full.png"), &about, &full)?);
    for rule in &rules {
        let mut points = Vec::new();
        for share in SHARES {
            if run.progress.is_stopping() {
                return Err(ExperimentError::Stopped);
            }
            let (threshold, mesh) = with_share(field, &rule.sums, rule.observer, share / 100.0);
            if rule.name == "plain" {
                plain.push(threshold);
            }
            let surface = view::surface(field, &mesh);
            let seen = view::render(field, &surface, eye);
            let [changed, mean] = view::difference(&full, &seen);
            let polygons = mesh.len() as f64 / full_polygons(field) * 100.0;
            let [x, y] = window.at.map(|w| w.to_string());
            let rule_is = [rule.name.to_owned(), share.to_string(), format!("{threshold:.4e}")];
            let row = [window.source.clone(), x, y].into_iter().chain(rule_is);
            let rms = rms(field, &surface);
            let cells = [
                format!("{polygons:.2}"),
                format!("{rms:.2}"),
                format!("{changed:.2}"),
                format!("{mean:.2}"),
            ];
            table.push(row.chain([mesh.len().to_string()]).chain(cells));
            points.push([polygons, changed]);
            if PICTURED.contains(&share) {
                let name = format!("{number}-{}-{share}", rule.name.replace(' ', "-"));
                let about = format!(
                    "{}, {} rule, {polygons:.1} % of the polygons: {changed:.2} % of the pixels change",
                    window.label(),
                    rule.name
                );
                pictures.push(png(format!("{name}.png"), &about, &seen)?);
                let bytes = view::changes(&full, &seen).map_err(|e| ExperimentError::Plot(e.to_string()))?;
                let caption = format!("{about}, those in red");
                pictures.push(Picture { file: format!("{name}-changes.png"), caption, bytes });
                let bytes =
                    plot::mesh(field.side(), &mesh).map_err(|e| ExperimentError::Plot(e.to_string()))?;
                let caption = format!("{} rule: {} polygons", rule.name, mesh.len());
                pictures.push(Picture { file: format!("{name}-mesh.png"), caption, bytes });
            }
            run.progress.advance(1);
        }
        series.push(plot::Series { name: rule.name.to_owned(), points });
    }
    let axes = ["polygons [% of the full grid]", "pixels changed [%]"];
    let bytes = plot::lines(&format!("{}: what the observer notices", window.label()), axes, false, &series)?;
    pictures.push(Picture {
        file: format!("{number}-pixels.svg"),
        caption: "Pixels against polygons".to_owned(),
        bytes,
    });
    let asked = if run.options.thresholds.is_empty() { plain } else { run.options.thresholds.clone() };
    let series = at_thresholds(window, &rules, asked, thresholds);
    let axes = ["threshold T (a sum of changes of slope: no unit)", "polygons"];
    let bytes = plot::lines(&format!("{}: the same thresholds", window.label()), axes, true, &series)?;
    let caption = "Polygons against the threshold, by rule".to_owned();
    pictures.push(Picture { file: format!("{number}-thresholds.svg"), caption, bytes });
    Ok(())
}

/// Counts the polygons of each rule at each threshold.
fn at_thresholds(
    window: &Window,
    rules: &[Rule; RULES],
    mut asked: Vec<f64>,
    table: &mut Table,
) -> Vec<plot::Series> {
    asked.sort_by(f64::total_cmp);
    let empty = |rule: &Rule| plot::Series { name: rule.name.to_owned(), points: Vec::new() };
    let mut series: Vec<plot::Series> = rules.iter().map(empty).collect();
    for threshold in asked {
        let mut row = vec![window.source.clone(), window.at[0].to_string(), window.at[1].to_string()];
        row.push(format!("{threshold:.4e}"));
        for (rule, line) in rules.iter().zip(&mut series) {
            let tree = Quadtree::new(&window.field, &rule.sums, threshold, rule.observer);
            let polygons = templates::triangles(&tree).len();
            row.push(polygons.to_string());
            line.points.push([threshold, polygons as f64]);
        }
        table.push(row);
    }
    series
}

fn png(file: String, caption: &str, view: &View) -> Result<Picture, ExperimentError> {
    let bytes = view::png(view).map_err(|e| ExperimentError::Plot(e.to_string()))?;
    Ok(Picture { file, caption: caption.to_owned(), bytes })
}

/// The observer of the options, or on the highest sample of the southern eighth; looks at the field's middle.
fn eye(run: &Run<'_>, window: &Window) -> Result<Eye, ExperimentError> {
    let field = &window.field;
    let side = f64::from(field.side());
    let strip = (field.row() / 8 + 1) * field.row();
    let known = (0..strip).filter(|slot| !field.heights()[*slot].is_nan());
    let highest = known.max_by(|a, b| field.heights()[*a].total_cmp(&field.heights()[*b])).unwrap_or(0);
    let [x, y] = run.options.observer.unwrap_or_else(|| field.point(highest)).map(|v| v.min(field.side()));
    let ground = match (field.at([x, y]), run.options.observer) {
        (height, _) if !height.is_nan() => height,
        // Nothing of the strip has data.
        (_, None) => field.range()[0].midpoint(field.range()[1]),
        (_, Some(_)) => {
            return Err(ExperimentError::Options {
                option: "--observer",
                expected: "a sample with data".to_owned(),
                found: format!("none at {x},{y} of {}", window.label()),
            });
        }
    };
    let at = [f64::from(x), f64::from(y)];
    Ok(Eye { at, height: ground + run.options.eye, towards: [0.5 * side, 0.55 * side], rise: 0.0 })
}

/// The polygons of a mesh of all samples.
pub(super) fn full_polygons(field: &Field) -> f64 {
    2.0 * f64::from(field.side()).powi(2)
}

/// The smallest threshold, up to the last bisection, that leaves at most a share of the polygons.
pub(super) fn with_share(
    field: &Field,
    sums: &Sums,
    observer: Option<Observer>,
    share: f64,
) -> (f64, Vec<[Point; 3]>) {
    let mesh = |threshold: f64| templates::triangles(&Quadtree::new(field, sums, threshold, observer));
    let (mut low, mut high) = (1e-9f64.ln(), 1e9f64.ln());
    for _ in 0..BISECTIONS {
        let middle = f64::midpoint(low, high);
        if mesh(middle.exp()).len() as f64 > share * full_polygons(field) {
            low = middle
        } else {
            high = middle
        }
    }
    (high.exp(), mesh(high.exp()))
}

/// Root mean square of the vertical distances at samples that both have.
fn rms(field: &Field, surface: &[f64]) -> f64 {
    let squares = field.heights().iter().zip(surface).map(|(a, b)| (a - b) * (a - b)).filter(|s| !s.is_nan());
    let (sum, n) = squares.fold((0.0, 0u32), |(sum, n), s| (sum + s, n + 1));
    (sum / f64::from(n.max(1))).sqrt()
}

/// What is seen from an eye in all directions.
fn seen_around(field: &Field, eye: Eye) -> Vec<bool> {
    let [dx, dy] = field.cell();
    let ahead = [(eye.towards[0] - eye.at[0]) * dx, (eye.towards[1] - eye.at[1]) * dy];
    let mut seen = vec![false; field.heights().len()];
    for i in 0..DIRECTIONS {
        let (sine, cosine) = (f64::from(i) / f64::from(DIRECTIONS) * std::f64::consts::TAU).sin_cos();
        let turned = [ahead[0] * cosine - ahead[1] * sine, ahead[0] * sine + ahead[1] * cosine];
        let towards = [eye.at[0] + turned[0] / dx, eye.at[1] + turned[1] / dy];
        let view = view::render(field, field.heights(), Eye { towards, ..eye });
        seen.iter_mut().zip(view.seen).for_each(|(seen, here)| *seen |= here);
    }
    seen
}

/// What is seen and one sample around it.
fn grown(field: &Field, seen: &[bool]) -> Vec<f32> {
    let row = field.row();
    let near = |slot: usize| {
        let (x, y) = (slot % row, slot / row);
        (y.saturating_sub(1)..=(y + 1).min(row - 1))
            .any(|j| (x.saturating_sub(1)..=(x + 1).min(row - 1)).any(|i| seen[j * row + i]))
    };
    (0..seen.len()).map(|slot| if near(slot) { 1.0 } else { 0.0 }).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn polygons_fall_as_thresholds_rise_and_neither_mask_nor_distance_adds_any() {
        let height =
            |slot: usize| ((slot % 33) as f64 * 0.7).sin() * 40.0 + ((slot / 33) as f64 * 0.9).cos() * 25.0;
        let field = Field::new(5, (0..33 * 33).map(height).collect(), [30.0, 30.0]).unwrap();
        let half: Vec<f32> = (0..33 * 33).map(|slot| if slot % 33 < 16 { 1.0 } else { 0.0 }).collect();
        let observer = Some(Observer { at: [4.0, 4.0], forgiveness: 20.0 });
        let rule =
            |name, mask: Option<&[f32]>, observer| Rule { name, sums: Sums::new(&field, mask), observer };
        let rules = [
            rule("plain", None, None),
            rule("view", None, observer),
            rule("mask", Some(&half), None),
            rule("view and all around", Some(&half), observer),
            rule("view and mask", Some(&half), observer),
        ];
        let window = Window {
            source: "made".to_owned(),
            at: [0, 0],
            origin: [0.0; 2],
            crs: None,
            field: field.clone(),
            weights: None,
        };
        let mut table = Table::new("thresholds", "", &THRESHOLD_COLUMNS);
        let series = at_thresholds(&window, &rules, vec![100.0, 0.01, 0.1, 1.0, 10.0], &mut table);
        assert_eq!(series[0].points.iter().map(|p| p[0]).collect::<Vec<_>>(), [0.01, 0.1, 1.0, 10.0, 100.0]);
        let polygons = |series: &plot::Series| series.points.iter().map(|p| p[1]).collect::<Vec<_>>();
        let plain = polygons(&series[0]);
        assert!(plain[0] > 10.0 * plain[4], "{plain:?}");
        for one in &series {
            let line = polygons(one);
            assert!(line.array_windows().all(|[a, b]| a >= b), "{}: {line:?}", one.name);
            assert!(line.iter().zip(&plain).all(|(here, plain)| here <= plain), "{}: {line:?}", one.name);
        }
    }
}
