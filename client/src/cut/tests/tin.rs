//! Law 2 for irregular triangles: whatever is missing, they cover the forest once and fit along every side.

use super::*;
use crate::morph::{self, Change, Moment, Morphs};
use crate::world::BuiltTin;
use std::collections::{BTreeMap, BTreeSet};

type Place = [i64; 2];

/// The drawn triangles of an item: places with heights and normals.
fn triangles(item: &DrawItem) -> Vec<[(Place, i32, [i16; 2]); 3]> {
    let tin = item.surface.tin().unwrap();
    let mut list = Vec::new();
    for side in (0..4).filter(|side| item.sides & (1 << side) != 0) {
        let range = tin.sides()[side].start as usize..tin.sides()[side].end as usize;
        for triangle in tin.indices()[range].chunks_exact(3) {
            list.push([0, 1, 2].map(|i| {
                let corner = tin.corners()[usize::from(triangle[i])];
                let place = [0, 1].map(|k| i64::from(item.diamond.centre()[k]) + i64::from(corner.place[k]));
                (place, corner.height, corner.normal)
            }));
        }
    }
    list
}

/// The straight line through two places, and where they stand along it: the lesser first, and whether that is the way
/// from `a` to `b`.
fn line(a: Place, b: Place) -> ([i64; 3], [i64; 2], bool) {
    let (mut dx, mut dy) = (b[0] - a[0], b[1] - a[1]);
    let mut divisor = (dx.abs(), dy.abs());
    while divisor.1 != 0 {
        divisor = (divisor.1, divisor.0 % divisor.1);
    }
    (dx, dy) = (dx / divisor.0, dy / divisor.0);
    let forth = (dx, dy) > (0, 0);
    if !forth {
        (dx, dy) = (-dx, -dy);
    }
    let along = |p: Place| p[0] * dx + p[1] * dy;
    let (s, t) = (along(a), along(b));
    ([dx, dy, a[0] * dy - a[1] * dx], [s.min(t), s.max(t)], forth)
}

/// Asserts that the drawn triangles fit: no side of one lies along another's without being the same, heights and normals
/// included. Returns how many sides inside of the forest have triangles on both sides.
fn assert_fit(forest: &Forest, items: &[DrawItem]) -> usize {
    let mut points: HashMap<Place, (i32, [i16; 2])> = HashMap::new();
    let mut sides = BTreeSet::new();
    let root = 1i64 << forest.root_log2();
    for item in items {
        for triangle in triangles(item) {
            for i in 0..3 {
                let ((a, height, normal), (b, ..)) = (triangle[i], triangle[(i + 1) % 3]);
                assert!(sides.insert((a, b)), "two triangles on one side of {a:?} to {b:?}");
                let before = *points.entry(a).or_insert((height, normal));
                assert_eq!(before.0, height, "two heights at {a:?}");
                // Root squares know nothing of each other's heights: along their sides, normals differ.
                if a.iter().all(|i| i % root != 0) {
                    assert_eq!(before.1, normal, "two normals at {a:?}, one of them in {:?}", item.diamond);
                }
            }
        }
    }
    let mut open: BTreeMap<[i64; 3], Vec<([i64; 2], bool)>> = BTreeMap::new();
    for (a, b) in sides.iter().filter(|(a, b)| !sides.contains(&(*b, *a))) {
        let (line, span, forth) = line(*a, *b);
        open.entry(line).or_default().push((span, forth));
    }
    for (line, mut spans) in open.iter().map(|(line, spans)| (line, spans.clone())) {
        spans.sort_unstable();
        let (mut forth_until, mut back_until) = (i64::MIN, i64::MIN);
        for ([from, to], forth) in spans {
            let (same, other) =
                if forth { (&mut forth_until, back_until) } else { (&mut back_until, forth_until) };
            assert!(from >= other, "a crack along {line:?} from {from}");
            assert!(from >= *same, "an overlap along {line:?} from {from}");
            *same = to;
        }
    }
    sides.iter().filter(|(a, b)| sides.contains(&(*b, *a))).count() / 2
}

/// Twice the area of the child triangles that the items draw.
fn area(forest: &Forest, items: &[DrawItem]) -> i64 {
    let quarter = |d: Diamond| {
        let local = forest.local(d);
        let n = forest.segments() as i64;
        (local.u[0] * local.v[1] - local.u[1] * local.v[0]).abs() * n * n / 2
    };
    items.iter().map(|item| i64::from(item.sides.count_ones()) * quarter(item.diamond)).sum()
}

/// What is asked of a view that sees all, at any tolerance.
fn any_ask<'a>(built: &'a BuiltTin, camera: &'a Camera, dice: &mut Dice) -> Ask<'a> {
    let tolerance_pixels = 0.2 * 200f64.powf(dice.roll());
    Ask { layer: &built.layer, encoding: Encoding::Tin, ..ask(&world()[0], camera, tolerance_pixels) }
}

#[test]
fn any_cut_of_irregular_triangles_with_any_data_missing_fits_and_covers_the_forest_once() {
    let built = world()[0].tin.as_ref().unwrap();
    let forest = built.layer.forest;
    let all = tin_surfaces(built, |_| true);
    let mut dice = Dice(70);
    let (mut fitting, mut levels) = (0, BTreeSet::new());
    for round in 0..40 {
        let camera = all_seeing(&mut dice);
        let ask = any_ask(built, &camera, &mut dice);
        let ideal = choose(&ask, |d| Some(built.entries[&d]));
        let chance = if round % 4 == 0 { 1.0 } else { 0.5 + 0.5 * dice.roll() };
        let arrived: HashSet<Diamond> =
            ideal.splits().filter(|d| d.level() == 0 || dice.roll() < chance).collect();
        let drawing = draw(0, &ask, &ideal, |d| arrived.contains(&d).then(|| Arc::clone(&all[&d])));
        fitting += assert_fit(&forest, &drawing.items);
        levels.extend(drawing.items.iter().map(|item| item.diamond.level()));
        let void: Vec<_> = forest
            .root_diamonds()
            .chain(drawing.splits.iter().flat_map(|d| forest.children(*d)).flatten())
            .filter(|d| built.entries[d].is_empty())
            .collect();
        let [w, h] = forest.size().map(i64::from);
        if void.is_empty() {
            assert_eq!(area(&forest, &drawing.items), 2 * w * h, "covered once");
        } else {
            assert!(area(&forest, &drawing.items) < 2 * w * h);
        }
        assert_eq!(drawing.wishes.is_empty(), ideal.splits().all(|d| arrived.contains(&d)));
    }
    println!("{fitting} sides shared, levels {levels:?}");
    assert!(fitting > 100_000 && levels.len() > 6, "{fitting} {levels:?}");
}

/// Splits that appear and go at all times, also before others have ended: whatever a pixel's number, what it sees fits, and is
/// there once.
#[test]
fn whatever_appears_each_pixel_sees_a_cut_that_fits() {
    let built = world()[0].tin.as_ref().unwrap();
    let forest = built.layer.forest;
    let all = tin_surfaces(built, |_| true);
    let mut dice = Dice(71);
    let mut morphs = Morphs::new(0.25);
    let mut frame = 0;
    let (mut mixed, mut turned) = (0, 0);
    for round in 0..16 {
        let camera = all_seeing(&mut dice);
        let ask = any_ask(built, &camera, &mut dice);
        let ideal = choose(&ask, |d| Some(built.entries[&d]));
        let wanted: Vec<Diamond> = ideal.splits().collect();
        // Some rounds end half way.
        for _ in 0..=(round * 5 % 12) {
            frame += 1;
            let now = Moment::at(f64::from(frame) * 0.25 / 8.0);
            let cut = morphs.step(&Change {
                layer: &built.layer,
                now,
                wanted: &wanted,
                surface: &|d| all.get(&d).cloned(),
                sight: &|_| morph::Sight { visible: true, error_metres: 1.0 },
            });
            assert!(cut.waiting.is_empty(), "what moves nothing waits for nothing");
            let showing = show(0, &ask, &ideal, |d| Some(built.entries[&d]), &cut, now);
            let share = |shown: &morph::Shown| shown.motion.as_ref().map_or(1.0, |motion| motion.share(now));
            for number in [0.0, 0.07, 0.31, 0.5, 0.77, 0.999] {
                let seen: HashSet<Diamond> = cut
                    .shown
                    .iter()
                    .filter(|shown| share(shown) > number)
                    .map(|shown| shown.diamond)
                    .collect();
                assert!(
                    seen.iter().all(|d| forest.parents(*d).all(|p| seen.contains(&p))),
                    "parents are there"
                );
                let is_seen = |item: &&DrawItem| (item.share.0[0]..item.share.0[1]).contains(&number);
                let items: Vec<DrawItem> = showing.items.iter().filter(is_seen).cloned().collect();
                assert_fit(&forest, &items);
                let mut drawn: Vec<(Diamond, usize)> = Vec::new();
                for item in &items {
                    drawn.extend(
                        (0..4).filter(|side| item.sides & 1 << side != 0).map(|side| (item.diamond, side)),
                    );
                }
                let mut expected: Vec<(Diamond, usize)> = Vec::new();
                for d in &seen {
                    let is_finest = d.level() + 1 == forest.levels();
                    let is_whole = |side: usize| match forest.children(*d)[side] {
                        Some(child) => !seen.contains(&child) && !built.entries[&child].is_empty(),
                        None => is_finest && (forest.local(*d).upper || side < 2),
                    };
                    expected.extend((0..4).filter(|side| is_whole(*side)).map(|side| (*d, side)));
                }
                drawn.sort_unstable();
                expected.sort_unstable();
                assert_eq!(drawn, expected, "in pixels of number {number}");
            }
            mixed += showing.items.iter().filter(|item| !item.share.is_all()).count();
            turned += cut.held;
        }
    }
    println!("{mixed} items in some of the pixels, {turned} diamonds go");
    assert!(mixed > 1000 && turned > 100, "{mixed} {turned}");
}

#[test]
fn a_crack_would_be_found() {
    let built = world()[0].tin.as_ref().unwrap();
    let forest = built.layer.forest;
    let all = tin_surfaces(built, |d| d.level() < 3);
    let of = |d: Diamond, sides| DrawItem {
        layer: 0,
        diamond: d,
        surface: Arc::clone(&all[&d]),
        sides,
        moving: None,
        share: Share::ALL,
    };
    // A child that is drawn as split beside a triangle that its parent still draws: what the cut never does.
    let d = forest.diamonds(1).find(|d| forest.local(*d).upper).unwrap();
    let child = forest.children(d).into_iter().flatten().next().unwrap();
    assert!(assert_fit(&forest, &[of(d, 0b1111)]) > 100);
    let overlapping = [of(d, 0b1111), of(child, 0b1111)];
    assert!(std::panic::catch_unwind(|| assert_fit(&forest, &overlapping)).is_err());
}
