//! Bitree and restricted quadtree within tolerances: the bitree paper's first table, over any windows.
//!
//! Two quadtrees stand beside each bitree. *Closed* is the paper's comparison: the points that the bitree selected, with
//! all that they depend on; and where these move the surface beyond the tolerance, with the points that bring it back
//! (counted by themselves, as the paper does not say that it has them). *Own* is what the quadtree selects for itself within the same tolerance:
//! its smallest, and the harder one to beat. Strips of all are by the same recursion. Whoever selects, the error
//! is measured anew, over all samples.

use super::report::{Picture, Report, Table};
use super::select::{Ground, Strategy, by_number, by_strategy, largest_error, scale};
use super::windows::Window;
use super::{Criterion, ExperimentError, Run, mean_and_spread, plot, quadtree};
use diamantina_protocol::bitree::{Bitree, Facet, strip};
use std::collections::BTreeMap;

/// What is counted of a mesh.
#[derive(Debug, Clone, Copy)]
struct Counts {
    /// Real points, corners included.
    transmitted: usize,
    /// Points that only complete the triangulation.
    added: usize,
    /// Those of them that are there for the tolerance alone.
    mended: usize,
    triangles: usize,
    references: usize,
    /// The largest vertical distance to any sample, whatever it weighs: metres.
    error: f64,
    /// The largest error by the criterion, in its own unit.
    judged: f64,
}

/// One bitree with its two baselines.
#[derive(Debug, Clone, Copy)]
struct Outcome {
    /// In the criterion's own unit.
    tolerance: f64,
    bitree: Counts,
    closed: Counts,
    own: Counts,
}

fn counts(ground: &Ground<'_>, criterion: Criterion, tree: &Bitree, added: usize) -> Counts {
    Counts {
        transmitted: tree.points().0,
        added,
        mended: 0,
        triangles: tree.triangle_count(),
        references: strip::strip(tree).len(),
        error: largest_error(&ground.unweighted(), Criterion::Vertical, tree),
        judged: largest_error(ground, criterion, tree),
    }
}

/// Everything at one tolerance, in metres (or the criterion's own unit).
fn outcome(ground: &Ground<'_>, criterion: Criterion, tolerance: f64, strategy: Strategy) -> Outcome {
    let field = ground.field();
    let bitree = by_strategy(ground, criterion, tolerance, strategy);
    let error = |facet: &Facet, enough: f64| criterion.error(ground, facet, enough);
    let closure = quadtree::close(field, &bitree).points().0;
    // Coefficients are of points by themselves: no triangle tells whether those below it have any.
    let [closed, own] = if criterion == Criterion::Coefficient {
        [quadtree::close(field, &bitree), quadtree::close(field, &bitree)]
    } else {
        let blindly = criterion.splits_level();
        [
            quadtree::complete(field, &bitree, tolerance, blindly, error),
            quadtree::select(field, tolerance, blindly, error),
        ]
    };
    let (real, fictitious) = bitree.points();
    let all = closed.points().0;
    Outcome {
        tolerance,
        bitree: counts(ground, criterion, &bitree, fictitious),
        closed: Counts { mended: all - closure, ..counts(ground, criterion, &closed, all - real) },
        own: counts(ground, criterion, &own, 0),
    }
}

/// Percent that the first saves of the second.
fn saving(ours: usize, theirs: usize) -> f64 {
    100.0 * (1.0 - ours as f64 / theirs.max(1) as f64)
}

pub(super) fn run(run: &Run<'_>) -> Result<Report, ExperimentError> {
    let strategies = match run.options.criterion {
        Criterion::Coefficient => vec![Strategy::Direct],
        _ => vec![Strategy::Compact, Strategy::Sparse, Strategy::Greedy],
    };
    let steps = run.windows.len() * run.options.tolerances.len();
    run.progress.stage("selecting", "selections", steps as u64, 0);
    let mut found: BTreeMap<(usize, Strategy), Vec<Outcome>> = BTreeMap::new();
    let mut each = each_table();
    for window in run.windows {
        let weights = window.weights.as_deref();
        let Some(ground) = Ground::new(&window.field, weights) else { continue };
        for (i, percent) in run.options.tolerances.iter().enumerate() {
            if run.progress.is_stopping() {
                return Err(ExperimentError::Stopped);
            }
            let tolerance = percent / 100.0 * scale(&ground, run.options.criterion);
            for strategy in &strategies {
                let outcome = outcome(&ground, run.options.criterion, tolerance, *strategy);
                push_each(&mut each, window, *percent, *strategy, &outcome);
                found.entry((i, *strategy)).or_default().push(outcome);
            }
            run.progress.advance(1);
        }
    }
    let mut tables = vec![means_table(run, &found), savings_table(run, &found), each];
    if !run.options.points.is_empty() {
        tables.push(numbers_table(run)?);
    }
    let pictures = vec![savings_plot(run, &found)?];
    let notes = vec![
        format!(
            "{} window{} of {} x {} samples; criterion {}; tolerances in percent of each window's \
             relief, or, by criteria that are no distances, of the error of the corners' two triangles.",
            run.windows.len(),
            if run.windows.len() == 1 { "" } else { "s" },
            run.options.windows.samples,
            run.options.windows.samples,
            run.options.criterion
        ),
        quadtrees(run.options.criterion).to_owned(),
        format!(
            "Fewest points, then triangles, in the mean: {}. Other tables select {}, the default by this criterion.",
            best(&found, &run.options.tolerances),
            run.options.criterion.strategy()
        ),
    ];
    Ok(Report {
        title: "Bitree and restricted quadtree within tolerances".to_owned(),
        notes,
        tables,
        pictures,
    })
}

/// What the quadtrees are that the bitree is compared with.
fn quadtrees(criterion: Criterion) -> &'static str {
    if criterion == Criterion::Coefficient {
        return "Closed and own, the same here: the bitree's own points with all that a restricted quadtree makes them depend on. \
                Coefficients are of points by themselves: they bound no error, and no mesh need be within the tolerance. A bitree \
                transmits its real points, a quadtree all.";
    }
    "Closed: the bitree's own points with all that a restricted quadtree makes them depend on, and what it takes to \
     bring that back within the tolerance (mended; it counts as added, too). Own: the \
     smallest restricted quadtree within the same tolerance. A bitree transmits its real points, a quadtree all."
}

/// The strategy with the fewest points, then triangles, at each tolerance.
fn best(found: &BTreeMap<(usize, Strategy), Vec<Outcome>>, tolerances: &[f64]) -> String {
    let size = |list: &[Outcome]| -> (usize, usize) {
        (list.iter().map(|o| o.bitree.transmitted).sum(), list.iter().map(|o| o.bitree.triangles).sum())
    };
    let of = |i: usize| found.iter().filter(|((at, _), _)| *at == i).min_by_key(|(_, list)| size(list));
    let names = tolerances
        .iter()
        .enumerate()
        .filter_map(|(i, percent)| of(i).map(|((_, strategy), _)| format!("{strategy} at {percent} %")));
    names.collect::<Vec<_>>().join(", ")
}

const EACH: [&str; 27] = [
    "DEM",
    "x",
    "y",
    "tolerance [%]",
    "strategy",
    "BT added",
    "closed QT added",
    "closed QT mended",
    "BT transmitted",
    "closed QT transmitted",
    "own QT transmitted",
    "points saved of closed [%]",
    "points saved of own [%]",
    "BT triangles",
    "closed QT triangles",
    "own QT triangles",
    "triangles saved of closed [%]",
    "triangles saved of own [%]",
    "BT references",
    "closed QT references",
    "own QT references",
    "BT error [m]",
    "closed QT error [m]",
    "own QT error [m]",
    "BT error by the criterion",
    "closed QT error by the criterion",
    "own QT error by the criterion",
];

fn each_table() -> Table {
    Table::new("windows", "Each window: bitree (BT), restricted quadtree (QT)", &EACH)
}

fn push_each(table: &mut Table, window: &Window, percent: f64, strategy: Strategy, o: &Outcome) {
    let all = [o.bitree, o.closed, o.own];
    let mut row = vec![window.source.clone(), window.at[0].to_string(), window.at[1].to_string()];
    row.extend([percent.to_string(), strategy.to_string()]);
    row.extend([o.bitree.added, o.closed.added, o.closed.mended].map(|n| n.to_string()));
    for count in [|c: Counts| c.transmitted, |c: Counts| c.triangles] {
        row.extend(all.map(|c| count(c).to_string()));
        row.extend([o.closed, o.own].map(|c| format!("{:.1}", saving(count(o.bitree), count(c)))));
    }
    row.extend(all.map(|c| c.references.to_string()));
    row.extend(all.map(|c| format!("{:.3}", c.error)));
    row.extend(all.map(|c| format!("{:.3}", c.judged)));
    table.push(row);
}

/// What fixed numbers of points achieve, the largest errors first.
fn numbers_table(run: &Run<'_>) -> Result<Table, ExperimentError> {
    let columns = [
        "DEM",
        "x",
        "y",
        "points asked",
        "points",
        "added",
        "triangles",
        "references",
        "criterion's error",
        "error [m]",
    ];
    let mut table =
        Table::new("numbers", "Bitrees of fixed numbers of points, the largest errors first", &columns);
    run.progress.stage("selecting", "selections", (run.windows.len() * run.options.points.len()) as u64, 0);
    for window in run.windows {
        let Some(ground) = Ground::new(&window.field, window.weights.as_deref()) else { continue };
        for asked in &run.options.points {
            if run.progress.is_stopping() {
                return Err(ExperimentError::Stopped);
            }
            let tree = by_number(&ground, run.options.criterion, *asked);
            let c = counts(&ground, run.options.criterion, &tree, tree.points().1);
            let mut row = vec![window.source.clone()];
            row.extend(
                [window.at[0] as usize, window.at[1] as usize, *asked, c.transmitted].map(|n| n.to_string()),
            );
            row.extend([c.added, c.triangles, c.references].map(|n| n.to_string()));
            row.extend([c.judged, c.error].map(|error| format!("{error:.3}")));
            table.push(row);
            run.progress.advance(1);
        }
    }
    Ok(table)
}

/// What tables of means have a row for.
const FOR_EACH: [&str; 2] = ["tolerance [%]", "strategy"];

fn means_table(run: &Run<'_>, found: &BTreeMap<(usize, Strategy), Vec<Outcome>>) -> Table {
    let counted = [
        "BT added",
        "closed QT added",
        "closed QT mended",
        "BT transmitted",
        "closed QT transmitted",
        "own QT transmitted",
        "BT triangles",
        "closed QT triangles",
        "own QT triangles",
        "BT references",
        "closed QT references",
        "own QT references",
    ];
    let worst = [
        "largest BT error by the criterion [% of tolerance]",
        "largest QT error by the criterion [% of tolerance]",
    ];
    let mut table = Table::new("means", "Means over all windows ± standard deviation (sd)", &FOR_EACH);
    table.add_means(&counted);
    table.columns.extend(worst.map(str::to_owned));
    for ((i, strategy), list) in found {
        let mean = |count: &dyn Fn(&Outcome) -> usize| {
            mean_and_spread(&list.iter().map(|o| count(o) as f64).collect::<Vec<_>>())
        };
        let percent = run.options.tolerances[*i];
        let worst = |meshes: &dyn Fn(&Outcome) -> f64| {
            let share = |o: &Outcome| if meshes(o) == 0.0 { 0.0 } else { 100.0 * meshes(o) / o.tolerance };
            format!("{:.1}", list.iter().map(share).fold(0.0, f64::max))
        };
        let mut means =
            vec![mean(&|o| o.bitree.added), mean(&|o| o.closed.added), mean(&|o| o.closed.mended)];
        for count in [|c: Counts| c.transmitted, |c: Counts| c.triangles, |c: Counts| c.references] {
            means.extend([mean(&|o| count(o.bitree)), mean(&|o| count(o.closed)), mean(&|o| count(o.own))]);
        }
        let mut row = vec![percent.to_string(), strategy.to_string()];
        row.extend(means.as_flattened().iter().map(|number| format!("{number:.1}")));
        row.extend([worst(&|o| o.bitree.judged), worst(&|o| o.closed.judged.max(o.own.judged))]);
        table.push(row);
    }
    table
}

/// Savings of points, triangles and references, of closed and own, mean and spread.
fn savings(list: &[Outcome]) -> [[f64; 2]; 6] {
    let of = |count: fn(Counts) -> usize, theirs: fn(&Outcome) -> Counts| {
        let all = list.iter().map(|o| saving(count(o.bitree), count(theirs(o))));
        mean_and_spread(&all.collect::<Vec<_>>())
    };
    let (closed, own) = (|o: &Outcome| o.closed, |o: &Outcome| o.own);
    [
        of(|c| c.transmitted, closed),
        of(|c| c.triangles, closed),
        of(|c| c.references, closed),
        of(|c| c.transmitted, own),
        of(|c| c.triangles, own),
        of(|c| c.references, own),
    ]
}

fn savings_table(run: &Run<'_>, found: &BTreeMap<(usize, Strategy), Vec<Outcome>>) -> Table {
    let saved = [
        "points of closed",
        "triangles of closed",
        "references of closed",
        "points of own",
        "triangles of own",
        "references of own",
    ];
    let caption =
        "What the bitree saves, percent of the quadtree's: mean of the windows ± standard deviation (sd)";
    let mut table = Table::new("savings", caption, &FOR_EACH);
    table.add_means(&saved);
    for ((i, strategy), list) in found {
        let savings = savings(list);
        let cells = savings.as_flattened().iter().map(|number| format!("{number:.1}"));
        table.push([run.options.tolerances[*i].to_string(), strategy.to_string()].into_iter().chain(cells));
    }
    table
}

/// The savings that are of interest: of sparse points of their own closure, as the paper has it; and of compact ones of the
/// smallest quadtree. (Of a compact bitree both quadtrees are nearly the same.)
fn savings_plot(
    run: &Run<'_>,
    found: &BTreeMap<(usize, Strategy), Vec<Outcome>>,
) -> Result<Picture, ExperimentError> {
    let mut series = Vec::new();
    for (strategy, quadtree, columns) in [
        (Strategy::Sparse, "closed", [0, 1, 2]),
        (Strategy::Compact, "own", [3, 4, 5]),
        (Strategy::Direct, "closed", [0, 1, 2]),
    ] {
        for (column, what) in columns.into_iter().zip(["points", "triangles", "references"]) {
            let lists = found.iter().filter(|((_, s), _)| *s == strategy);
            let points = lists.map(|((i, _), list)| [run.options.tolerances[*i], savings(list)[column][0]]);
            let points: Vec<[f64; 2]> = points.collect();
            if !points.is_empty() {
                series.push(plot::Series { name: format!("{what}, {strategy} of {quadtree}"), points });
            }
        }
    }
    let axes = ["tolerance [% of relief]", "saved [%]"];
    let bytes = plot::lines("Saved by the bitree of the restricted quadtree's", axes, false, &series)?;
    let caption = "Mean savings of points to transmit, triangles and strip references.".to_owned();
    Ok(Picture { file: "savings.svg".to_owned(), caption, bytes })
}
