//! Every selection keeps what it promises, over all samples.

use super::*;
use crate::experiment::field::Field;
use crate::experiment::quadtree;
use proptest::prelude::{
    Just, ProptestConfig, any, prop, prop_assert, prop_assert_eq, prop_assume, prop_oneof, proptest,
};
use proptest::strategy::Strategy as Generator;

const SIDE: usize = 33;

/// Flat, stepped, spiky, random and partly missing fields.
fn any_field() -> impl Generator<Value = Field> {
    let flat = Just(vec![7.0; SIDE * SIDE]);
    let stepped = (1usize..8, 1usize..8).prop_map(|(i, j)| {
        (0..SIDE * SIDE).map(|s| (s % SIDE / i * 10 + s / SIDE / j * 3) as f64).collect::<Vec<f64>>()
    });
    let spiky = prop::collection::vec((0..SIDE * SIDE, -500i32..500), 1..12).prop_map(|spikes| {
        let mut heights = vec![0.0; SIDE * SIDE];
        spikes.into_iter().for_each(|(s, h)| heights[s] = f64::from(h));
        heights
    });
    let random = prop::collection::vec(-100i32..100, SIDE * SIDE)
        .prop_map(|list| list.into_iter().map(f64::from).collect::<Vec<f64>>());
    let smooth = (1.0f64..9.0, 1.0f64..9.0).prop_map(|(u, v)| {
        (0..SIDE * SIDE)
            .map(|s| 100.0 * ((s % SIDE) as f64 / u).sin() * ((s / SIDE) as f64 / v).cos())
            .collect::<Vec<f64>>()
    });
    let holes = prop::collection::vec((0..SIDE, 0..SIDE, 1..SIDE), 0..4);
    (prop_oneof![flat, stepped, spiky, random, smooth], holes, any::<bool>()).prop_filter_map(
        "some data",
        |(mut heights, holes, has_holes)| {
            for (x, y, size) in holes.into_iter().filter(|_| has_holes) {
                for j in y..(y + size).min(SIDE) {
                    heights[j * SIDE + x..j * SIDE + (x + size).min(SIDE)].fill(f64::NAN);
                }
            }
            Field::new(5, heights, [30.0, 20.0])
        },
    )
}

/// The largest vertical distance, sample by sample, by a walk of its own over each triangle's cells.
fn plainly(field: &Field, weights: Option<&[f32]>, tree: &Bitree) -> f64 {
    let mut worst = 0.0f64;
    for [(a, ha), (c, hc), (b, hb)] in tree.triangles() {
        let f = |v: u32| f64::from(v);
        let whole = (f(c[0]) - f(a[0])) * (f(b[1]) - f(a[1])) - (f(b[0]) - f(a[0])) * (f(c[1]) - f(a[1]));
        for slot in 0..field.heights().len() {
            let p = field.point(slot);
            let part = |u: [u32; 2], v: [u32; 2]| {
                ((f(u[0]) - f(p[0])) * (f(v[1]) - f(p[1])) - (f(v[0]) - f(p[0])) * (f(u[1]) - f(p[1])))
                    / whole
            };
            let [wa, wc, wb] = [part(c, b), part(b, a), part(a, c)];
            if wa >= 0.0 && wc >= 0.0 && wb >= 0.0 && !field.at(p).is_nan() {
                let weight = weights.map_or(1.0, |w| f64::from(w[slot]));
                worst = worst.max(weight * (field.at(p) - (wa * ha + wc * hc + wb * hb)).abs());
            }
        }
    }
    worst
}

/// Level by level over a list of triangles, each point added by itself and each error measured in full.
fn descend_plainly(ground: &Ground<'_>, criterion: Criterion, tolerance: f64, share: f64) -> Bitree {
    let field = ground.field();
    let mut tree = field.tree();
    let mut now = tree.roots().to_vec();
    for _ in 0..2 * field.log2() {
        now.retain(|facet| criterion.error(ground, facet, f64::INFINITY) > tolerance);
        let mut halved = now.clone();
        for facet in &now {
            let m = facet.middle();
            let [ha, _, hb] = facet.heights();
            let off = field.at(m) - (ha + hb) / 2.0;
            let is_off = match criterion {
                Criterion::Vertical | Criterion::Euclidean => off.abs() > share * tolerance,
                Criterion::Curvature => true,
                Criterion::Normal | Criterion::Coefficient => off != 0.0,
            };
            if off.is_nan() && criterion == Criterion::Curvature {
                if let Some(below) = field.known_below(facet.corners()) {
                    tree.add(below, field.at(below));
                }
            } else if is_off && !off.is_nan() && tree.add(m, field.at(m)).is_none() {
                halved.extend(tree.around(m).into_iter().flatten());
            }
        }
        halved.sort_by_key(|facet| facet.path());
        halved.dedup_by_key(|facet| facet.path());
        now = halved.iter().flat_map(|facet| tree.halves(facet)).collect();
    }
    tree
}

/// Takes out each point and puts it back where the selection is not good then, three times over all of them.
fn prune_plainly(field: &Field, tree: &mut Bitree, is_good: impl Fn(&Bitree, [u32; 2]) -> bool) {
    let mut all: Vec<_> = (0..field.heights().len()).map(|slot| field.point(slot)).collect();
    all.sort_by_key(|p| (std::cmp::Reverse(tree.level(*p)), p[1], p[0]));
    for point in all.repeat(3) {
        if let Some(height) = tree.remove(point)
            && !is_good(tree, point)
        {
            tree.add(point, height);
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]

    #[test]
    fn every_strategy_keeps_every_sample_within_the_tolerance(field in any_field(), share in 0.0f64..0.6, masked in any::<bool>()) {
        let tolerance = if share < 0.1 { 0.0 } else { share * field.relief() };
        let mask: Vec<f32> = (0..SIDE * SIDE).map(|s| [1.0, 0.5, 0.0][s / SIDE / 5 % 3]).collect();
        let weights = masked.then_some(&mask[..]);
        let ground = Ground::new(&field, weights).unwrap();
        for strategy in [Strategy::Compact, Strategy::Sparse, Strategy::Greedy] {
            let tree = by_strategy(&ground, Criterion::Vertical, tolerance, strategy);
            let found = plainly(&field, weights, &tree);
            prop_assert!(found <= tolerance + 1e-9 * (1.0 + field.relief()), "{} {} {}", strategy, found, tolerance);
            prop_assert!(largest_error(&ground, Criterion::Vertical, &tree) <= tolerance);
            let tree = by_strategy(&ground, Criterion::Euclidean, tolerance, strategy);
            prop_assert!(largest_error(&ground, Criterion::Euclidean, &tree) <= tolerance);
        }
        let vertical = |facet: &diamantina_protocol::bitree::Facet, enough: f64| Criterion::Vertical.error(&ground, facet, enough);
        let quadtree = quadtree::select(&field, tolerance, false, vertical);
        prop_assert!(largest_error(&ground, Criterion::Vertical, &quadtree) <= tolerance);
        // So does the closure of a bitree's points, with what brings it back.
        let tree = by_strategy(&ground, Criterion::Vertical, tolerance, Strategy::Compact);
        let closed = quadtree::complete(&field, &tree, tolerance, false, vertical);
        prop_assert!(largest_error(&ground, Criterion::Vertical, &closed) <= tolerance);
        for slot in 0..SIDE * SIDE {
            let p = field.point(slot);
            prop_assert!(tree.real(p).is_none_or(|height| closed.real(p) == Some(height)));
        }
    }

    #[test]
    fn criteria_that_are_no_distances_are_kept_too(field in any_field(), part in 0.0f64..0.6, masked in any::<bool>()) {
        let mask: Vec<f32> = (0..SIDE * SIDE).map(|s| [1.0, 0.5, 0.0][s / SIDE / 5 % 3]).collect();
        let ground = Ground::new(&field, masked.then_some(&mask[..])).unwrap();
        for criterion in [Criterion::Curvature, Criterion::Normal] {
            let tolerance = part * scale(&ground, criterion);
            for strategy in [Strategy::Compact, Strategy::Sparse, Strategy::Greedy] {
                let tree = by_strategy(&ground, criterion, tolerance, strategy);
                let found = largest_error(&ground, criterion, &tree);
                prop_assert!(found <= tolerance, "{criterion:?} {strategy} {found} {tolerance}");
                let error = |facet: &diamantina_protocol::bitree::Facet, enough: f64| criterion.error(&ground, facet, enough);
                let closed = quadtree::complete(&field, &tree, tolerance, criterion.splits_level(), error);
                let own = quadtree::select(&field, tolerance, criterion.splits_level(), error);
                for quadtree in [closed, own] {
                    let found = largest_error(&ground, criterion, &quadtree);
                    prop_assert!(found <= tolerance, "quadtree, {criterion:?} {strategy} {found} {tolerance}");
                }
            }
        }
    }

    #[test]
    fn a_descent_finds_what_a_plain_one_does(field in any_field(), part in 0.0f64..0.6, share in 0.0f64..=1.0, masked in any::<bool>()) {
        let weights: Vec<f32> = (0..SIDE * SIDE).map(|s| [1.0, 0.25, 0.0][s % 3]).collect();
        let ground = Ground::new(&field, masked.then_some(&weights[..])).unwrap();
        for criterion in [Criterion::Vertical, Criterion::Euclidean, Criterion::Curvature, Criterion::Normal, Criterion::Coefficient] {
            for tolerance in [0.0, part * scale(&ground, criterion)] {
                for share in [0.0, share, 1.0] {
                    let plain = descend_plainly(&ground, criterion, tolerance, share);
                    prop_assert!(top_down(&ground, criterion, tolerance, share) == plain, "{criterion:?} {tolerance} {share}");
                }
            }
        }
    }

    #[test]
    fn points_that_are_not_tried_again_would_have_stayed(field in any_field(), part in 0.0f64..0.6, masked in any::<bool>()) {
        let weights: Vec<f32> = (0..SIDE * SIDE).map(|s| [1.0, 0.25, 0.0][s % 3]).collect();
        let ground = Ground::new(&field, masked.then_some(&weights[..])).unwrap();
        let (criterion, tolerance) = (Criterion::Vertical, part * field.relief());
        for (strategy, share) in [(Strategy::Compact, 0.0), (Strategy::Sparse, 1.0)] {
            let descended = top_down(&ground, criterion, tolerance, share);
            let [mut tried, mut all] = [descended.clone(), descended];
            prune(&ground, criterion, tolerance, &mut tried);
            prune_plainly(&field, &mut all, |tree, _| largest_error(&ground, criterion, tree) <= tolerance);
            prop_assert!(tried == all, "{strategy}");
            prop_assert!(by_strategy(&ground, criterion, tolerance, strategy) == tried, "{strategy}");
        }
    }

    #[test]
    fn without_tolerance_exactly_the_points_off_their_means_are_real(field in any_field()) {
        // Nothing else can be: a point that is off has to be sent, and one that is not is deduced.
        prop_assume!(field.samples() == SIDE * SIDE);
        let ground = Ground::new(&field, None).unwrap();
        let tree = by_strategy(&ground, Criterion::Vertical, 0.0, Strategy::Compact);
        prop_assert!(by_strategy(&ground, Criterion::Coefficient, 0.0, Strategy::Direct) == tree);
        for strategy in [Strategy::Sparse, Strategy::Greedy] {
            prop_assert!(by_strategy(&ground, Criterion::Vertical, 0.0, strategy) == tree, "{strategy}");
        }
    }

    #[test]
    fn a_number_of_points_is_kept_and_more_of_them_reach_the_field(field in any_field(), points in 4usize..200) {
        let ground = Ground::new(&field, None).unwrap();
        let tree = by_number(&ground, Criterion::Vertical, points);
        prop_assert!(tree.points().0 <= points);
        let all = by_number(&ground, Criterion::Vertical, usize::MAX);
        prop_assert_eq!(largest_error(&ground, Criterion::Vertical, &all), 0.0);
    }
}

#[test]
fn on_larger_fields_nothing_that_could_go_is_passed_over() {
    const LOG2: u8 = 7;
    let side = 1usize << LOG2;
    for seed in 0..8u32 {
        let mut state = seed;
        let mut noise = || {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            f64::from(state >> 24) - 128.0
        };
        let heights = (0..(side + 1).pow(2)).map(|s| {
            let (x, y) = ((s % (side + 1)) as f64, (s / (side + 1)) as f64);
            (300.0 * (x / 23.0).sin() * (y / 17.0).cos() + noise() * (0.1 + x / 200.0)).round()
        });
        let field = Field::new(LOG2, heights.collect(), [30.0, 30.0]).unwrap();
        let ground = Ground::new(&field, None).unwrap();
        for (criterion, share) in
            [Criterion::Vertical, Criterion::Euclidean].into_iter().flat_map(|c| [(c, 0.0), (c, 1.0)])
        {
            let tolerance = 0.01 * f64::from(1 + seed) * field.relief();
            let refined = greedy(
                &ground,
                criterion,
                tolerance,
                GREEDY_SHARE,
                usize::MAX,
                top_down(&ground, criterion, tolerance, share),
            );
            let [mut tried, mut all] = [refined.clone(), refined];
            prune(&ground, criterion, tolerance, &mut tried);
            prune_plainly(&field, &mut all, |tree, point| {
                tree.around(point).into_iter().flatten().all(|facet| {
                    let within = |error: f64| match error <= tolerance {
                        true => ControlFlow::Continue(()),
                        false => ControlFlow::Break(()),
                    };
                    let visit = &mut |leaf: &_| within(criterion.error(&ground, leaf, tolerance));
                    tree.leaves(&facet, visit).is_continue()
                })
            });
            assert!(
                tried == all,
                "{criterion:?}, seed {seed}, share {share}: {:?}, {:?}",
                tried.points(),
                all.points()
            );
        }
    }
}

#[test]
fn each_criterion_sees_its_own_fault() {
    // A plane has none but its slope; a bump has one.
    let plane: Vec<f64> = (0..SIDE * SIDE).map(|s| (s % SIDE * 20 + s / SIDE * 12) as f64).collect();
    let mut bump = plane.clone();
    bump[16 * SIDE + 9] += 50.0;
    for criterion in [
        Criterion::Vertical,
        Criterion::Euclidean,
        Criterion::Curvature,
        Criterion::Normal,
        Criterion::Coefficient,
    ] {
        let field = Field::new(5, plane.clone(), [30.0, 30.0]).unwrap();
        let (tree, _) = select(&Ground::new(&field, None).unwrap(), criterion, 1e-3);
        assert_eq!(tree.points(), (4, 0), "{criterion:?} on a plane");
        let field = Field::new(5, bump.clone(), [30.0, 30.0]).unwrap();
        let ground = Ground::new(&field, None).unwrap();
        let (tree, _) = select(&ground, criterion, 1e-3);
        assert_eq!(tree.height([9, 16]), Some(field.at([9, 16])), "{criterion:?} on a bump");
        // Where nobody looks it does not matter.
        let mut mask = vec![1.0; SIDE * SIDE];
        for row in mask.chunks_mut(SIDE) {
            row[..20].fill(0.0);
        }
        let (tree, _) = select(&Ground::new(&field, Some(&mask)).unwrap(), criterion, 1e-3);
        assert_eq!(tree.points(), (4, 0), "{criterion:?} behind a mask");
    }
}

#[test]
fn a_mask_costs_no_triangles_even_where_it_counts_nothing() {
    let heights = |s: usize| {
        let (x, y) = ((s % SIDE) as f64, (s / SIDE) as f64);
        100.0 * (x / 5.0).sin() * (y / 7.0).cos() + 9.0 * (x * 1.7).sin() + 7.0 * (y * 2.1).cos()
    };
    let field = Field::new(5, (0..SIDE * SIDE).map(heights).collect(), [30.0, 30.0]).unwrap();
    for hidden in [0.0, 0.001, 0.05] {
        // A quarter is seen, in strips.
        let mask: Vec<f32> =
            (0..SIDE * SIDE).map(|s| if (s % SIDE / 4).is_multiple_of(4) { 1.0 } else { hidden }).collect();
        let [plain, masked] = [None, Some(&mask[..])].map(|w| Ground::new(&field, w).unwrap());
        for percent in [0.5, 1.0, 2.0, 5.0, 10.0] {
            let tolerance = percent / 100.0 * field.relief();
            let [plain, masked] =
                [&plain, &masked].map(|g| by_strategy(g, Criterion::Vertical, tolerance, Strategy::Compact));
            let counts = [&masked, &plain].map(|tree| tree.triangle_count());
            assert!(counts[0] < counts[1], "{hidden}, {percent} %: {counts:?}");
        }
    }
}

#[test]
fn coefficients_are_weighed_and_the_largest_come_first() {
    let mut heights = vec![0.0; SIDE * SIDE];
    for (slot, height) in [(16 * SIDE + 9, 50.0), (5 * SIDE + 21, 30.0), (27 * SIDE + 3, 10.0)] {
        heights[slot] = height;
    }
    let field = Field::new(5, heights, [30.0, 30.0]).unwrap();
    let first = |weights: Option<&[f32]>| {
        let tree = by_number(&Ground::new(&field, weights).unwrap(), Criterion::Coefficient, 5);
        [[9, 16], [21, 5], [3, 27]].map(|p| tree.real(p).is_some())
    };
    assert_eq!(first(None), [true, false, false]);
    let mut mask = vec![1.0; SIDE * SIDE];
    mask[16 * SIDE + 9] = 0.1;
    assert_eq!(first(Some(&mask)), [false, true, false]);
}

#[test]
fn a_tilted_plane_is_nearer_at_right_angles_than_upright() {
    let mut heights: Vec<f64> = (0..SIDE * SIDE).map(|s| (s % SIDE * 30) as f64).collect();
    heights[16 * SIDE + 16] += 10.0;
    let field = Field::new(5, heights, [30.0, 30.0]).unwrap();
    let ground = Ground::new(&field, None).unwrap();
    let tree = field.tree();
    assert_eq!(largest_error(&ground, Criterion::Vertical, &tree), 10.0);
    let right_angled = largest_error(&ground, Criterion::Euclidean, &tree);
    assert!((right_angled - 10.0 / 2f64.sqrt()).abs() < 1e-12, "{right_angled}");
}

#[test]
fn masks_of_the_wrong_size_or_range_are_refused() {
    let field = Field::new(1, vec![0.0; 9], [1.0, 1.0]).unwrap();
    assert!(Ground::new(&field, Some(&[1.0; 8])).is_none());
    assert!(Ground::new(&field, Some(&[1.5; 9])).is_none());
    assert!(Ground::new(&field, Some(&[0.5; 9])).is_some());
}
