//! The laws of the hierarchy, on made fields: any cut closes, nothing is farther from the source than was said.

#![allow(
    clippy::cast_possible_truncation,
    clippy::cast_possible_wrap,
    clippy::cast_sign_loss,
    reason = "made heights are small"
)]

use super::*;
use diamantina_protocol::NODATA;
use diamantina_protocol::bintree::Forest;
use diamantina_protocol::diamond::Diamond;
use diamantina_protocol::tin::{self, Patch};
use proptest::prelude::*;
use std::collections::{BTreeMap, BTreeSet, HashMap};

/// A field of samples, one a lattice point of a forest.
pub(super) struct Field {
    pub(super) forest: Forest,
    pub(super) heights: Vec<i32>,
}

impl Field {
    pub(super) fn new(forest: Forest, height: impl Fn(u32, u32) -> i32) -> Self {
        let [w, h] = forest.size();
        let heights = (0..=h).flat_map(|y| (0..=w).map(move |x| (x, y))).map(|(x, y)| height(x, y)).collect();
        Self { forest, heights }
    }

    pub(super) fn ground(&self) -> Ground<'_> {
        Ground { origin: [0, 0], width: self.forest.size()[0] as usize + 1, heights: &self.heights }
    }
}

/// What simplifying left of a diamond that is not split.
struct Whole {
    simplified: Simplified,
    /// In quanta.
    vertical: f64,
}

/// A hierarchy in memory.
struct Built {
    forest: Forest,
    /// What diamonds are drawn as once they are split.
    split: HashMap<Diamond, Merged>,
    whole: HashMap<Diamond, Whole>,
}

fn build(field: &Field, rules: &Rules, until: impl Fn(u32) -> Until<'static>) -> Built {
    let forest = field.forest;
    let finest = forest.levels();
    let deep = forest.with_precision(1).unwrap();
    let mut built = Built { forest, split: HashMap::new(), whole: HashMap::new() };
    for level in (1..=finest).rev() {
        for d in deep.diamonds(level) {
            let merged = if level == finest {
                source(&deep, d, field.ground())
            } else {
                let empty = Tin::default();
                let children = deep.children(d);
                let tins = children
                    .map(|c| c.map_or(&empty, |c| &built.whole[&c].simplified.halves[half_of(&deep, c, d)]));
                merge(&deep, d, tins)
            };
            let until = match until(level) {
                Until::Error { vertical, border, .. } => {
                    Until::Error { ground: field.ground(), vertical, border }
                }
                Until::Within { triangles, .. } => Until::Within { triangles, ground: field.ground() },
                Until::Triangles(n) => Until::Triangles(n),
            };
            let simplified = simplify(&deep, d, &merged, rules, until);
            let mut vertical = 0.0f64;
            for half in &simplified.halves {
                for t in &half.triangles {
                    let corners = t.map(|v| half.vertices[v as usize]);
                    vertical = vertical.max(field.ground().distance(corners, f64::INFINITY));
                }
            }
            if let Some(known) = simplified.vertical {
                assert!(
                    (vertical..=vertical * 1.000_001).contains(&known),
                    "level {level}: {known}, {vertical}"
                );
            }
            if let Until::Error { vertical: limit, border, .. } = until {
                assert!(
                    vertical <= limit && simplified.apart <= border,
                    "level {level}: {vertical} > {limit}"
                );
            }
            if level < finest {
                encode(&forest, d, &merged.patch);
                built.split.insert(d, merged);
            }
            built.whole.insert(d, Whole { simplified, vertical });
        }
    }
    for d in forest.diamonds(0) {
        let children = forest.children(d);
        let empty = Tin::default();
        let tins = children
            .map(|c| c.map_or(&empty, |c| &built.whole[&c].simplified.halves[half_of(&forest, c, d)]));
        let merged = merge(&forest, d, tins);
        encode(&forest, d, &merged.patch);
        built.split.insert(d, merged);
    }
    built
}

/// A patch goes through bytes and comes back with as many triangles, if in another order.
fn encode(forest: &Forest, d: Diamond, patch: &Patch) {
    let bytes = tin::encode(forest, d, patch).unwrap();
    let back = tin::decode(forest, d, &bytes).unwrap();
    let corners = |patch: &Patch| {
        let corner = |v: u32| patch.vertices[v as usize];
        let rotated = |t: &[u32; 3]| {
            let c = t.map(corner).map(|v| (v.x, v.y, v.height));
            [[c[0], c[1], c[2]], [c[1], c[2], c[0]], [c[2], c[0], c[1]]].into_iter().min()
        };
        let mut all: Vec<_> = patch.triangles.iter().map(rotated).collect();
        all.sort_unstable();
        all
    };
    assert_eq!(back.ends, patch.ends);
    assert_eq!(corners(&back), corners(patch));
}

/// A triangle as it is drawn, and the macro-triangle's distances.
struct Drawn {
    corners: [Vertex; 3],
    vertical: f64,
    apart: f64,
}

impl Built {
    /// What a cut draws in which the diamonds for which `wants` says so are split, if their parents are.
    fn draw(&self, mut wants: impl FnMut(Diamond) -> bool) -> Vec<Drawn> {
        let forest = &self.forest;
        let mut split: BTreeSet<Diamond> = BTreeSet::new();
        let mut drawn = Vec::new();
        for level in 0..forest.levels() {
            for d in forest.diamonds(level) {
                if forest.parents(d).all(|p| split.contains(&p)) && (level == 0 || wants(d)) {
                    split.insert(d);
                }
            }
        }
        let deep = forest.with_precision(1).unwrap();
        for d in &split {
            let merged = &self.split[d];
            let mut from = 0;
            for (child, end) in deep.children(*d).into_iter().zip(merged.patch.ends) {
                let triangles = &merged.patch.triangles[from as usize..end as usize];
                from = end;
                let Some(child) = child else {
                    assert!(triangles.is_empty());
                    continue;
                };
                if split.contains(&child) {
                    continue;
                }
                let whole = &self.whole[&child];
                let (vertical, apart) = (whole.vertical, whole.simplified.apart);
                let corners = triangles.iter().map(|t| t.map(|v| merged.patch.vertices[v as usize]));
                drawn.extend(corners.map(|corners| Drawn { corners, vertical, apart }));
            }
        }
        drawn
    }
}

fn turn2(a: [i64; 2], b: [i64; 2], c: [i64; 2]) -> i64 {
    (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
}

fn flat(v: Vertex) -> [i64; 2] {
    [v.x.into(), v.y.into()]
}

/// Edges of one triangle alone must not run along others': that would be a crack.
fn assert_closed(forest: &Forest, drawn: &[Drawn], complete: bool) {
    let mut edges: BTreeMap<[Vertex2; 2], [Vertex; 2]> = BTreeMap::new();
    let mut area = 0;
    for t in drawn {
        let doubled = turn2(flat(t.corners[0]), flat(t.corners[1]), flat(t.corners[2]));
        assert!(doubled > 0, "a triangle is turned over");
        area += doubled;
        for i in 0..3 {
            let (p, q) = (t.corners[i], t.corners[(i + 1) % 3]);
            let key = [(p.x, p.y), (q.x, q.y)];
            assert!(edges.insert(key, [p, q]).is_none(), "an edge twice: {key:?}");
        }
    }
    let mut alone: BTreeMap<(i64, i64, i64), Vec<Span>> = BTreeMap::new();
    let [w, h] = forest.size();
    for ([p, q], [a, b]) in &edges {
        if let Some([b2, a2]) = edges.get(&[*q, *p]) {
            assert!(a == a2 && b == b2, "heights differ along an edge");
            continue;
        }
        if complete {
            let outer = (a.x == b.x && (a.x == 0 || a.x == w)) || (a.y == b.y && (a.y == 0 || a.y == h));
            assert!(outer, "a crack from {a:?} to {b:?}");
        }
        let (mut dx, mut dy) = (i64::from(b.x) - i64::from(a.x), i64::from(b.y) - i64::from(a.y));
        let mut divisor = (dx.unsigned_abs(), dy.unsigned_abs());
        while divisor.1 > 0 {
            divisor = (divisor.1, divisor.0 % divisor.1);
        }
        let forward = (dx, dy) > (0, 0);
        let sign = if forward { 1 } else { -1 };
        (dx, dy) = (dx / divisor.0.cast_signed() * sign, dy / divisor.0.cast_signed() * sign);
        let along = |v: &Vertex| i64::from(v.x) * dx + i64::from(v.y) * dy;
        let offset = i64::from(a.x) * dy - i64::from(a.y) * dx;
        let (s, t) = (along(a).min(along(b)), along(a).max(along(b)));
        alone.entry((dx, dy, offset)).or_default().push((s, t, forward));
    }
    for (line, spans) in alone {
        for (i, (s, t, forward)) in spans.iter().enumerate() {
            for (s2, t2, forward2) in &spans[..i] {
                let overlap = t.min(t2) > s.max(s2);
                assert!(!overlap || forward == forward2, "a crack on the line {line:?}");
            }
        }
    }
    if complete {
        assert_eq!(area, 2 * i64::from(w) * i64::from(h), "all is covered once");
    }
}

type Vertex2 = (u32, u32);

/// An edge along a line: from, to, and whether it runs forward.
type Span = (i64, i64, bool);

/// Each sample that belongs to a triangle of the source lies as near to what is drawn as was said.
fn assert_near(field: &Field, scale: &Scale, drawn: &[Drawn]) {
    let [w, _] = field.forest.size();
    let at = |x: u32, y: u32| field.heights[(y * (w + 1) + x) as usize];
    let mut covered = BTreeSet::new();
    for t in drawn {
        let [a, b, c] = t.corners.map(flat);
        let doubled = turn2(a, b, c);
        let xs = t.corners.map(|v| v.x);
        let ys = t.corners.map(|v| v.y);
        for y in *ys.iter().min().unwrap()..=*ys.iter().max().unwrap() {
            for x in *xs.iter().min().unwrap()..=*xs.iter().max().unwrap() {
                let p = [i64::from(x), i64::from(y)];
                let shares = [turn2(b, c, p), turn2(c, a, p), turn2(a, b, p)];
                if shares.iter().any(|s| *s < 0) {
                    continue;
                }
                assert_ne!(at(x, y), NODATA, "what has no data is covered at {x}, {y}");
                let height: i64 = (0..3).map(|i| shares[i] * i64::from(t.corners[i].height)).sum();
                let distance = (height as f64 / doubled as f64 - f64::from(at(x, y))).abs();
                assert!(distance <= t.vertical + 1e-9, "{distance} > {} at {x}, {y}", t.vertical);
                covered.insert((x, y));
            }
        }
    }
    let forest = &field.forest;
    let deep = forest.with_precision(1).unwrap();
    let apart = drawn.iter().map(|t| t.apart).fold(0.0, f64::max);
    for d in deep.diamonds(forest.levels()) {
        for v in source(&deep, d, field.ground()).patch.vertices {
            if covered.contains(&(v.x, v.y)) {
                continue;
            }
            let near = |t: &Drawn| {
                (0..3).any(|i| {
                    let ends = [t.corners[i], t.corners[(i + 1) % 3]];
                    collapse::distance_to(scale, [v.x, v.y], ends) <= apart + 1e-9
                })
            };
            assert!(drawn.iter().any(near), "{v:?} is farther than {apart} m from what is drawn");
        }
    }
}

fn dice(seed: u64) -> impl FnMut() -> u64 {
    let mut state = seed | 1;
    move || {
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        state
    }
}

/// A number of the lattice point that looks random.
fn noise(x: u32, y: u32, seed: u64) -> u64 {
    let mut n = u64::from(x) << 32 | u64::from(y);
    n = (n ^ seed).wrapping_mul(0x9e37_79b9_7f4a_7c15);
    (n ^ n >> 29).wrapping_mul(0xbf58_476d_1ce4_e5b9) >> 20
}

pub(super) fn fields() -> Vec<(&'static str, Field)> {
    let one = Forest::new(6, 3, [1, 1]).unwrap();
    let two = Forest::new(5, 3, [2, 1]).unwrap();
    let hills = |x: u32, y: u32| {
        let (x, y) = (f64::from(x), f64::from(y));
        ((x / 7.0).sin() * 300.0 + (y / 5.0 + x / 11.0).cos() * 200.0) as i32
    };
    let rough = |x: u32, y: u32| (noise(x, y, 7) % 2000) as i32;
    let only = |valid: bool, height: i32| if valid { height } else { NODATA };
    let circle = |x: u32, y: u32, r: i64| {
        let (dx, dy) = (i64::from(x) - 31, i64::from(y) - 29);
        dx * dx + dy * dy <= r * r
    };
    vec![
        ("flat", Field::new(one, |_, _| 12)),
        ("tilted", Field::new(two, |x, y| (3 * x + 5 * y) as i32)),
        ("step", Field::new(one, |x, _| if x < 21 { 0 } else { 900 })),
        ("spike", Field::new(one, |x, y| if (x, y) == (22, 41) { 5000 } else { 0 })),
        ("hills", Field::new(two, hills)),
        ("rough", Field::new(one, rough)),
        ("island", Field::new(one, move |x, y| only(circle(x, y, 17), hills(x, y)))),
        ("lake", Field::new(one, move |x, y| only(!circle(x, y, 17), hills(x, y)))),
        (
            "river",
            Field::new(two, move |x, y| {
                only(y.abs_diff(16 + (f64::from(x) / 6.0).sin() as u32 * 5) > 2, hills(x, y))
            }),
        ),
        ("holes", Field::new(one, move |x, y| only(!noise(x, y, 3).is_multiple_of(40), hills(x, y)))),
        ("torn", Field::new(one, move |x, y| only(!noise(x, y, 5).is_multiple_of(3), rough(x, y)))),
        ("checkerboard", Field::new(one, move |x, y| only((x + y).is_multiple_of(2), hills(x, y)))),
        ("sieve", Field::new(one, move |x, y| only(x.is_multiple_of(2) || y % 2 == 1, hills(x, y)))),
        ("one sample", Field::new(one, move |x, y| only((x, y) == (9, 50), 77))),
        ("one cell", Field::new(one, move |x, y| only((8..10).contains(&x) && (31..33).contains(&y), 77))),
        ("nothing", Field::new(one, |_, _| NODATA)),
        ("half", Field::new(two, move |x, y| only(x <= 37 && y <= 29, hills(x, y)))),
    ]
}

const SCALE: Scale = Scale { cell: [30.0, 20.0], quantum: 0.5 };

fn rules(metric: Metric, lambda: f64) -> Rules {
    Rules { metric, lambda, scale: SCALE, triangles_max: usize::MAX, vertices_max: usize::MAX }
}

/// A ground for limits that are given one by the builder.
fn nowhere() -> Ground<'static> {
    Ground { origin: [0, 0], width: 1, heights: &[] }
}

#[test]
fn any_cut_closes_and_keeps_its_promise() {
    for (name, field) in fields() {
        let complete = !field.heights.contains(&NODATA);
        for metric in [Metric::Normal, Metric::Quadric] {
            for (count, lambda) in [(20usize, 1.0), (3, 0.0)] {
                let finest = field.forest.levels();
                let until = |level: u32| {
                    if level == finest {
                        Until::Error { ground: nowhere(), vertical: 0.0, border: 0.0 }
                    } else {
                        Until::Triangles(count)
                    }
                };
                println!("{name} {metric:?} {count}");
                let built = build(&field, &rules(metric, lambda), until);
                let mut dice = dice(1234);
                for round in 0..12 {
                    let drawn = match round {
                        0 => built.draw(|_| false),
                        1 => built.draw(|_| true),
                        _ => built.draw(|_| !dice().is_multiple_of(3)),
                    };
                    assert_closed(&field.forest, &drawn, complete);
                    assert_near(&field, &SCALE, &drawn);
                    if round == 1 {
                        assert!(drawn.iter().all(|t| t.vertical == 0.0 && t.apart == 0.0));
                    }
                }
            }
        }
    }
}

#[test]
fn an_error_that_was_asked_is_kept_at_every_collapse() {
    for (_, field) in fields() {
        let complete = !field.heights.contains(&NODATA);
        let until = |level: u32| {
            let vertical = [80.0, 40.0, 25.0, 6.5][level.min(3) as usize];
            Until::Error { ground: nowhere(), vertical, border: 15.0 }
        };
        let built = build(&field, &rules(Metric::Normal, 1.0), until);
        let drawn = built.draw(|d| (d.centre()[0] / 8).is_multiple_of(2));
        assert_closed(&field.forest, &drawn, complete);
        assert_near(&field, &SCALE, &drawn);
    }
}

#[test]
fn a_limit_that_grows_ends_at_the_count_with_smaller_errors() {
    let (mut fewer, mut all) = (0, 0);
    for (name, field) in fields() {
        let finest = field.forest.levels();
        let until = |within: bool| {
            move |level: u32| match (level == finest, within) {
                (true, _) => Until::Error { ground: nowhere(), vertical: 0.0, border: 0.0 },
                (_, true) => Until::Within { triangles: 20, ground: nowhere() },
                (_, false) => Until::Triangles(20),
            }
        };
        let [free, held] =
            [false, true].map(|within| build(&field, &rules(Metric::Normal, 1.0), until(within)));
        for (d, whole) in &held.whole {
            let count = |w: &Whole| w.simplified.halves.iter().map(|h| h.triangles.len()).sum::<usize>();
            if d.level() < finest && !field.heights.contains(&NODATA) {
                assert!(count(whole) <= 80, "{name}: {} triangles of {d:?}", count(whole));
            }
            if d.level() < finest && free.whole[d].vertical > 0.0 {
                all += 1;
                fewer += usize::from(whole.vertical <= free.whole[d].vertical);
            }
        }
        let mut dice = dice(55);
        for _ in 0..4 {
            let drawn = held.draw(|_| !dice().is_multiple_of(3));
            assert_closed(&field.forest, &drawn, !field.heights.contains(&NODATA));
            assert_near(&field, &SCALE, &drawn);
        }
    }
    assert!(10 * fewer > 8 * all, "{fewer} of {all} have no larger error");
}

/// What levels above do not try again since a half says that it is in vain.
#[test]
fn vertices_need_as_much_as_halves_say() {
    let (mut said, mut all) = (0, 0);
    for (name, field) in fields() {
        let rules = rules(Metric::Normal, 1.0);
        let ground = field.ground();
        let built = build(&field, &rules, |_| Until::Within { triangles: 40, ground: nowhere() });
        for half in built.whole.values().flat_map(|whole| &whole.simplified.halves) {
            let point = |v: u32| half.vertices[v as usize];
            all += half.vertices.len();
            for (v, need) in (0u32..).zip(&half.needs).filter(|(_, need)| **need > 0) {
                said += 1;
                let around: Vec<&[u32; 3]> = half.triangles.iter().filter(|t| t.contains(&v)).collect();
                let ways: BTreeSet<u32> = around.iter().flat_map(|t| **t).filter(|u| *u != v).collect();
                let needed = ways.into_iter().map(|u| {
                    let moved = |t: &&[u32; 3]| t.map(|w| point(if w == v { u } else { w }));
                    let rest = around.iter().filter(|t| !t.contains(&u)).map(moved);
                    let distance = |t: [Vertex; 3]| {
                        let turns_over = super::metric::turn(t[0], t[1], t[2]) <= 0;
                        if turns_over { f64::INFINITY } else { ground.distance(t, f64::INFINITY) }
                    };
                    rest.map(distance).fold(0.0, f64::max)
                });
                let needed = needed.fold(f64::INFINITY, f64::min);
                let known = f64::from(super::state::unshortened(*need));
                assert!(known <= needed, "{name}: {known} said, {needed} needed");
            }
        }
    }
    assert!(said > 1000, "{said} of {all}");
}

#[test]
fn ground_that_is_plane_is_two_triangles_a_square() {
    for (name, field) in fields() {
        if matches!(name, "flat" | "tilted") {
            let until = |_| Until::Triangles(0);
            let built = build(&field, &rules(Metric::Normal, 1.0), until);
            let roots = field.forest.root_diamonds().count();
            assert_eq!(built.draw(|_| false).len(), 4 * roots, "{name}");
        }
    }
}

#[test]
fn what_is_free_to_go_goes_down_to_the_count() {
    for (name, field) in fields() {
        if matches!(name, "hills" | "rough" | "step" | "spike") {
            let finest = field.forest.levels();
            let until = |level: u32| {
                if level == finest { Until::Triangles(usize::MAX) } else { Until::Triangles(20) }
            };
            let built = build(&field, &rules(Metric::Normal, 1.0), until);
            for (d, whole) in &built.whole {
                let count: usize = whole.simplified.halves.iter().map(|h| h.triangles.len()).sum();
                // The locked border has up to 16 edges a side on this lattice.
                assert!(d.level() == finest || count <= 80, "{name}: {count} triangles of {d:?}");
            }
        }
    }
}

#[test]
fn shreds_that_have_no_room_are_left_out_and_the_error_says_so() {
    for (name, field) in fields() {
        if !matches!(name, "torn" | "sieve") {
            continue;
        }
        let tight = Rules { triangles_max: 60, vertices_max: 50, ..rules(Metric::Normal, 1.0) };
        let built = build(&field, &tight, |_| Until::Triangles(20));
        let mut wide = 0;
        for whole in built.whole.values() {
            for half in &whole.simplified.halves {
                assert!(half.triangles.len() <= 60 && half.vertices.len() <= 50, "{name}");
                wide += usize::from(half.lost > 0.0);
                assert!(whole.simplified.apart >= half.lost);
            }
        }
        assert!(wide > 0, "{name} is not torn enough for this test");
        let mut dice = dice(77);
        for _ in 0..6 {
            let drawn = built.draw(|_| !dice().is_multiple_of(3));
            assert_closed(&field.forest, &drawn, false);
            assert_near(&field, &SCALE, &drawn);
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]
    #[test]
    fn any_holes_leave_any_cut_closed(seed in any::<u64>(), share in 2u64..30, size in 0u32..3) {
        let forest = Forest::new(5, 2, [1, 2]).unwrap();
        let field = Field::new(forest, |x, y| {
            if noise(x >> size, y >> size, seed).is_multiple_of(share) { NODATA } else { (noise(x / 3, y / 3, seed) % 400) as i32 }
        });
        let built = build(&field, &rules(Metric::Normal, 0.3), |_| Until::Triangles(6));
        let mut dice = dice(seed);
        for _ in 0..6 {
            let drawn = built.draw(|_| !dice().is_multiple_of(3));
            assert_closed(&forest, &drawn, false);
            assert_near(&field, &SCALE, &drawn);
        }
    }
}
