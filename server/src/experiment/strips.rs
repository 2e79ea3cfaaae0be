//! References of triangle strips beside separate triangles, and beside other orders of the same triangles.
//!
//! *Strip* is the one strip of the recursion, by the rules. *Shortest* keeps its path and chooses the corners' order in each
//! triangle; all show the same side, as they do in the strip by the rules, unless it is *of any winding*. *Strips* are several, grown greedily from triangle to neighbour, with one restart reference between two. *Cached* is a list of separate triangles in the recursion's order,
//! told by the vertices that a first-in first-out cache of 32 has to fetch for it.

use super::report::{Picture, Report, Table};
use super::select::{Ground, scale, select};
use super::{ExperimentError, Run, mean_and_spread, plot};
use diamantina_protocol::bintree::Point;
use diamantina_protocol::bitree::strip::Winding;
use diamantina_protocol::bitree::{Bitree, strip};
use std::cmp::Reverse;
use std::collections::{BTreeMap, VecDeque};

/// Vertices that the cache of a graphics processor is taken to hold.
const CACHE: usize = 32;

pub(super) fn run(run: &Run<'_>) -> Result<Report, ExperimentError> {
    let columns = [
        "DEM",
        "x",
        "y",
        "tolerance [%]",
        "strategy",
        "triangles",
        "separate references",
        "line triangles",
        "strip references",
        "saved by the strip [%]",
        "shortest strip's references",
        "saved by the shortest strip [%]",
        "references of the shortest of any winding",
        "saved by that [%]",
        "strips",
        "strips' references",
        "saved by the strips [%]",
        "cached: fetches a triangle",
    ];
    let caption = "Orders of the bitree's triangles; 'full' is every sample of the grid";
    let mut table = Table::new("strips", caption, &columns);
    // The full grid first, then the tolerances.
    let mut sums = vec![Vec::new(); run.options.tolerances.len() + 1];
    let steps = run.windows.len() * (run.options.tolerances.len() + 1);
    run.progress.stage("ordering", "meshes", steps as u64, 0);
    // Percent that the strip, the shortest, that of any winding and several save, by tolerance and window.
    let mut saved: [_; 4] = std::array::from_fn(|_| vec![Vec::new(); run.options.tolerances.len()]);
    for window in run.windows {
        let Some(ground) = Ground::new(&window.field, window.weights.as_deref()) else { continue };
        let mut push = |label: [String; 2], tree: &Bitree| {
            let place = [window.source.clone(), window.at[0].to_string(), window.at[1].to_string()];
            let row = row(tree);
            table.push(place.into_iter().chain(label).chain(row.cells.clone()));
            run.progress.advance(1);
            row
        };
        sums[0].push(push(["full".to_owned(), String::new()], &window.field.full_tree()).counts);
        for (i, percent) in run.options.tolerances.iter().enumerate() {
            if run.progress.is_stopping() {
                return Err(ExperimentError::Stopped);
            }
            let tolerance = percent / 100.0 * scale(&ground, run.options.criterion);
            let (tree, strategy) = select(&ground, run.options.criterion, tolerance);
            let row = push([percent.to_string(), strategy.to_string()], &tree);
            saved.iter_mut().zip(row.saved).for_each(|(saved, one)| saved[i].push(one));
            sums[i + 1].push(row.counts);
        }
    }
    let line = |(name, saved): (&str, &Vec<Vec<f64>>)| {
        let points = run.options.tolerances.iter().zip(saved);
        let points = points.map(|(percent, saved)| [*percent, mean_and_spread(saved)[0]]).collect();
        plot::Series { name: name.to_owned(), points }
    };
    let series: Vec<plot::Series> =
        ["one strip, by the rules", "one strip, the shortest", "one strip, any winding", "several strips"]
            .into_iter()
            .zip(&saved)
            .map(line)
            .collect();
    let axes = ["tolerance [%]", "references saved [%]"];
    let bytes = plot::lines("Strips beside separate triangles", axes, false, &series)?;
    let caption = "References that strips save of separate triangles': means of the windows.".to_owned();
    Ok(Report {
        title: "Triangle strips".to_owned(),
        notes: vec![format!(
            "Separate triangles take three references each. Strips show the same side of all, as these do, unless any winding is \
             allowed: then both sides have to be drawn. The selection is {}, the default by this criterion.",
            run.options.criterion.strategy()
        )],
        tables: vec![means(run, &sums), table],
        pictures: vec![Picture { file: "strips.svg".to_owned(), caption, bytes }],
    })
}

/// What is told of a mesh.
struct Row {
    cells: Vec<String>,
    /// Percent that the strip, the shortest, that of any winding and several save.
    saved: [f64; 4],
    /// Triangles, line triangles; references: separate, of the strip, of the shortest, of that of any winding, of several; how
    /// many these are; vertices that a cache fetches for a triangle.
    counts: [f64; 9],
}

fn row(tree: &Bitree) -> Row {
    let one = strip::strip(tree);
    let triangles = strip::triangles(&one);
    let [shortest, any_winding] =
        [Winding::Kept, Winding::Free].map(|winding| strip::shortest(tree, winding).len());
    let several = greedy_strips(&triangles);
    let references = several.iter().map(Vec::len).sum::<usize>() + several.len().saturating_sub(1);
    let separate = 3 * triangles.len();
    let lines = strip::line_triangles(&one);
    let fetched = fetches(&triangles) as f64 / triangles.len() as f64;
    let saved =
        [one.len(), shortest, any_winding, references].map(|n| 100.0 * (1.0 - n as f64 / separate as f64));
    let cells = vec![
        triangles.len().to_string(),
        separate.to_string(),
        lines.to_string(),
        one.len().to_string(),
        format!("{:.1}", saved[0]),
        shortest.to_string(),
        format!("{:.1}", saved[1]),
        any_winding.to_string(),
        format!("{:.1}", saved[2]),
        several.len().to_string(),
        references.to_string(),
        format!("{:.1}", saved[3]),
        format!("{fetched:.3}"),
    ];
    let counts =
        [triangles.len(), lines, separate, one.len(), shortest, any_winding, references, several.len()];
    let [a, b, c, d, e, f, g, h] = counts.map(|count| count as f64);
    Row { cells, saved, counts: [a, b, c, d, e, f, g, h, fetched] }
}

/// The windows' means by tolerance; and what strips save of all their references together, in which large meshes count for more.
fn means(run: &Run<'_>, sums: &[Vec<[f64; 9]>]) -> Table {
    let columns = [
        "tolerance [%]",
        "windows",
        "triangles",
        "line triangles",
        "separate references",
        "strip references",
        "saved by the strip: mean of windows [%]",
        "saved by the strip: of all references [%]",
        "shortest strip's references",
        "saved by the shortest: mean of windows [%]",
        "saved by the shortest: of all references [%]",
        "references of the shortest of any winding",
        "saved by that: mean of windows [%]",
        "saved by that: of all references [%]",
        "strips",
        "strips' references",
        "saved by the strips: mean of windows [%]",
        "saved by the strips: of all references [%]",
        "cached: fetches a triangle",
    ];
    let mut table = Table::new("means", "Means of the windows", &columns);
    let tolerances = run.options.tolerances.iter().map(ToString::to_string);
    for (label, list) in ["full".to_owned()].into_iter().chain(tolerances).zip(sums) {
        let mean = |i: usize| list.iter().map(|c| c[i]).sum::<f64>() / list.len().max(1) as f64;
        let saved = |i: usize| {
            let each = list.iter().map(|c| 100.0 * (1.0 - c[i] / c[2])).collect::<Vec<_>>();
            [mean_and_spread(&each)[0], 100.0 * (1.0 - mean(i) / mean(2))].map(|p| format!("{p:.1}"))
        };
        let counts = |numbers: &[usize]| -> Vec<String> {
            numbers.iter().map(|i| format!("{:.1}", mean(*i))).collect()
        };
        let mut row = vec![label, list.len().to_string()];
        row.extend(counts(&[0, 1, 2, 3]).into_iter().chain(saved(3)));
        row.extend(counts(&[4]).into_iter().chain(saved(4)));
        row.extend(counts(&[5]).into_iter().chain(saved(5)));
        row.extend(counts(&[7, 6]).into_iter().chain(saved(6)));
        row.push(format!("{:.3}", mean(8)));
        table.push(row);
    }
    table
}

/// Vertices that a first-in first-out cache has to fetch for triangles in their order.
fn fetches(triangles: &[[Point; 3]]) -> usize {
    let mut cache: VecDeque<Point> = VecDeque::with_capacity(CACHE + 1);
    let mut count = 0;
    for point in triangles.iter().flatten() {
        if !cache.contains(point) {
            count += 1;
            cache.push_back(*point);
            if cache.len() > CACHE {
                cache.pop_front();
            }
        }
    }
    count
}

/// A side, the smaller end first.
fn side(u: Point, v: Point) -> [Point; 2] {
    if u <= v { [u, v] } else { [v, u] }
}

/// Strips that draw each triangle once, all of them turning left: each starts at the first triangle left, in whichever of
/// its six ways goes on the longest, and goes from side to side while a triangle with that whole side is left. A way that
/// turns right begins with its first corner twice.
fn greedy_strips(triangles: &[[Point; 3]]) -> Vec<Vec<Point>> {
    let mut by_side: BTreeMap<[Point; 2], Vec<usize>> = BTreeMap::new();
    for (i, [a, b, c]) in triangles.iter().enumerate() {
        for s in [side(*a, *b), side(*b, *c), side(*c, *a)] {
            by_side.entry(s).or_default().push(i);
        }
    }
    let mut used = vec![false; triangles.len()];
    let mut strips = Vec::new();
    for start in 0..triangles.len() {
        if used[start] {
            continue;
        }
        let [a, b, c] = triangles[start];
        let ways = [[a, b, c], [b, c, a], [c, a, b], [a, c, b], [c, b, a], [b, a, c]];
        let grown = ways.map(|way| grow(triangles, &by_side, &used, start, way));
        // Of the longest one that takes no reference more, if there is any.
        let key = |(strip, members): &(Vec<Point>, Vec<usize>)| (members.len(), Reverse(strip.len()));
        let Some((strip, members)) = grown.into_iter().max_by_key(key) else { continue };
        members.into_iter().for_each(|i| used[i] = true);
        strips.push(strip);
    }
    strips
}

fn grow(
    triangles: &[[Point; 3]],
    by_side: &BTreeMap<[Point; 2], Vec<usize>>,
    used: &[bool],
    start: usize,
    way: [Point; 3],
) -> (Vec<Point>, Vec<usize>) {
    let begins_twice = (!strip::is_left(way)).then_some(way[0]);
    let (mut strip, mut members) = (begins_twice.into_iter().chain(way).collect::<Vec<_>>(), vec![start]);
    while let [.., u, v] = strip[..]
        && let Some(next) =
            by_side.get(&side(u, v)).and_then(|list| list.iter().find(|i| !used[**i] && !members.contains(i)))
    {
        strip.extend(triangles[*next].into_iter().filter(|p| *p != u && *p != v));
        members.push(*next);
    }
    (strip, members)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn greedy_strips_draw_each_triangle_once(
            points in prop::collection::vec([0u32..=16, 0u32..=16], 0..40)
        ) {
            let mut tree = Bitree::new(4, [0.0; 4]).unwrap();
            for p in points { tree.add(p, 1.0); }
            let sorted = |list: Vec<[Point; 3]>| {
                let mut list: Vec<_> = list.into_iter().map(|mut t| { t.sort_unstable(); t }).collect();
                list.sort_unstable();
                list
            };
            let one = strip::triangles(&strip::strip(&tree));
            let several = greedy_strips(&one);
            let drawn = several.iter().flat_map(|s| strip::triangles(s)).collect();
            prop_assert!(several.iter().all(|s| strip::line_triangles(s) == usize::from(s[0] == s[1])));
            let turns_left = |s: &Vec<Point>| {
                let mut turns = s.array_windows().enumerate();
                turns.all(|(i, w)| w[0] == w[1] || strip::is_left(*w) == (i % 2 == 0))
            };
            prop_assert!(several.iter().all(turns_left));
            prop_assert_eq!(sorted(drawn), sorted(one));
        }
    }
}
