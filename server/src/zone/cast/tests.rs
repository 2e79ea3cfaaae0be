//! The walk against a caster that knows no order, no blocks and no horizon: every ray of an azimuth meets every
//! triangle.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

use super::sheets::stepped;
use super::*;
use proptest::prelude::*;
use std::collections::BTreeMap;

/// Rays between slopes that are as near as this only graze: whether they pass is a matter of rounding.
const GRAZING: f64 = 1e-7;

/// A triangle's cut by the plane of an azimuth: distances and slopes of its ends, the nearer first.
#[derive(Debug, Clone)]
struct Cut {
    corners: [[usize; 2]; 3],
    distance: [f64; 2],
    slopes: [f64; 2],
}

/// Every triangle of a relief.
fn triangles(relief: &Relief) -> Vec<[[usize; 2]; 3]> {
    let [width, height] = relief.size();
    let mut list = Vec::new();
    for y in 0..height - 1 {
        for x in 0..width - 1 {
            let [a, b, c, d] = [[x, y], [x + 1, y], [x + 1, y + 1], [x, y + 1]];
            list.extend(if (x + y) % 2 == 0 { [[a, b, c], [c, d, a]] } else { [[d, a, b], [b, c, d]] });
        }
    }
    list
}

/// Cuts every triangle by the half plane of an azimuth, each on its own.
fn cuts(relief: &Relief, optics: &Optics, eye: Eye, azimuth: f64) -> Vec<Cut> {
    let (sin, cos) = azimuth.sin_cos();
    let mut list = Vec::new();
    for corners in triangles(relief) {
        if corners.iter().any(|c| relief.at(*c) == NODATA) {
            continue;
        }
        // In metres: along the azimuth, across it, and the height in quanta.
        let points = corners.map(|c| {
            let [x, y] = [0, 1].map(|axis| (c[axis] as f64 - eye.place[axis]) * optics.cell[axis]);
            [x * cos + y * sin, y * cos - x * sin, f64::from(relief.at(c))]
        });
        let mut ends = Vec::new();
        for i in 0..3 {
            let (p, q) = (points[i], points[(i + 1) % 3]);
            if (p[1] < 0.0) != (q[1] < 0.0) {
                let part = p[1] / (p[1] - q[1]);
                ends.push([0, 2].map(|k| p[k] + (q[k] - p[k]) * part));
            }
        }
        let [mut near, mut far] = match ends[..] {
            [a, b] if a[0] < b[0] => [a, b],
            [a, b] => [b, a],
            _ => continue,
        };
        if far[0] <= 1e-9 {
            continue;
        }
        if near[0] < 0.0 {
            // The eye stands over it.
            let part = near[0] / (near[0] - far[0]);
            near = [0.0, near[1] + (far[1] - near[1]) * part];
        }
        if far[0] - near[0] < 1e-9 {
            continue;
        }
        let slope = |[t, z]: [f64; 2]| {
            let above = z - optics.bend / optics.quantum * t * t - eye.height;
            if t > 1e-9 { above / t } else { f64::INFINITY.copysign(above) }
        };
        let slopes = [slope(near), slope(far)];
        far[0] = far[0].max(near[0]);
        list.push(Cut { corners, distance: [near[0], far[0]], slopes });
    }
    list
}

/// What the rays of the slope meet first.
fn first(cuts: &[Cut], slope: f64) -> Option<&Cut> {
    let met = cuts.iter().filter(|cut| {
        let [a, b] = cut.slopes;
        a.min(b) <= slope && slope <= a.max(b)
    });
    met.min_by(|a, b| a.distance[0].total_cmp(&b.distance[0]))
}

/// Slopes in the middle between all ends of cuts: between two neighbours nothing changes, so these are all rays.
/// With the width of what each stands for.
fn rays(cuts: &[Cut]) -> Vec<(f64, f64)> {
    let mut ends: Vec<f64> = cuts.iter().flat_map(|cut| cut.slopes).filter(|s| s.is_finite()).collect();
    ends.sort_by(f64::total_cmp);
    let mut rays: Vec<(f64, f64)> =
        ends.windows(2).map(|w| (f64::midpoint(w[0], w[1]), w[1] - w[0])).collect();
    // Straight down, too.
    rays.extend(ends.first().map(|lowest| (lowest - 1.0, 1.0)));
    rays
}

/// The triangles of a region.
fn inside(relief: &Relief, region: Region) -> Vec<[[usize; 2]; 3]> {
    let cells = match region {
        Region::Triangle(corners) => return vec![sorted(corners)],
        Region::Cell([x, y]) => [x..x + 1, y..y + 1],
        Region::Block(block) => block.map(|b| b << BLOCKS_LOG2[0]..(b + 1) << BLOCKS_LOG2[0]),
    };
    let holds = |t: &[[usize; 2]; 3]| {
        (0..2).all(|axis| cells[axis].contains(&t.iter().map(|c| c[axis]).min().unwrap()))
    };
    triangles(relief).into_iter().filter(holds).map(sorted).collect()
}

fn sorted(mut corners: [[usize; 2]; 3]) -> [[usize; 2]; 3] {
    corners.sort_unstable();
    corners
}

#[derive(Debug, Clone, Copy)]
enum Ground {
    Flat,
    Steps,
    Spikes,
    Slope,
    Random,
}

fn any_relief() -> impl Strategy<Value = Relief> {
    use Ground::{Flat, Random, Slope, Spikes, Steps};
    let ground = prop::sample::select(vec![Flat, Steps, Spikes, Slope, Random]);
    let holes = prop::sample::select(vec![0u64, 0, 0, 3, 12]);
    (2usize..30, 2usize..30, ground, holes, any::<u64>()).prop_map(|(width, height, ground, holes, seed)| {
        let mut state = seed | 1;
        let mut dice = move |n: u64| {
            state ^= state << 13;
            state ^= state >> 7;
            state ^= state << 17;
            state % n
        };
        let small = |n: u64| i32::try_from(n).unwrap();
        let heights = (0..width * height)
            .map(|i| {
                let [x, y] = [i % width, i / width].map(|w| small(w as u64));
                let height = match ground {
                    Flat => 7,
                    Steps => (x / 4 + y / 5) * 20,
                    Spikes => {
                        if dice(9) == 0 {
                            400
                        } else {
                            0
                        }
                    }
                    Slope => 3 * x - 5 * y,
                    Random => small(dice(300)),
                };
                if holes > 0 && dice(holes) == 0 { NODATA } else { height }
            })
            .collect();
        let heights: Vec<i32> = heights;
        Relief::from_rows([width, height], &heights)
    })
}

fn any_eye() -> impl Strategy<Value = ([f64; 2], f64)> {
    ([0.0..=1.0f64, 0.0..=1.0f64], prop_oneof![0.1..5.0f64, 5.0..500.0f64])
}

/// An azimuth along which no edges run.
fn any_azimuth() -> impl Strategy<Value = f64> {
    (0..4u8, 0.01..1.56f64).prop_map(|(quarter, rest)| f64::from(quarter) * TAU / 4.0 + rest)
}

/// An eye over the ground.
fn eye_over(relief: &Relief, ([x, y], above): ([f64; 2], f64)) -> Eye {
    let place = [x * (relief.size()[0] - 1) as f64, y * (relief.size()[1] - 1) as f64];
    Eye { place, height: relief.height(place).unwrap_or(0.0) + above }
}

fn optics(bend: f64) -> Optics {
    Optics { cell: [10.0, 13.0], quantum: 0.5, bend, epsilon: 0.0, hidden: 0.05, angle: 1e-3 }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(1500))]
    #[test]
    fn the_walk_sees_what_the_rays_meet_first(
        relief in any_relief(),
        above in any_eye(),
        azimuth in any_azimuth(),
        bend in prop::sample::select(vec![0.0, BEND, 1e-4]),
    ) {
        let eye = eye_over(&relief, above);
        // What is hidden by less than an angle counts as seen, too: not here.
        let optics = Optics { angle: 0.0, ..optics(bend) };
        let mut seen = BTreeMap::new();
        walk(&relief, &optics, eye, azimuth, |s| {
            if s.share >= 1.0 {
                seen.extend(inside(&relief, s.region).into_iter().map(|corners| (corners, s.slopes)));
            }
        });
        let cuts = cuts(&relief, &optics, eye, azimuth);
        let mut met = BTreeMap::new();
        for (slope, width) in rays(&cuts) {
            if let Some(cut) = first(&cuts, slope) {
                let widest: &mut f64 = met.entry(sorted(cut.corners)).or_default();
                *widest = widest.max(width);
            }
        }
        for (corners, width) in &met {
            prop_assert!(*width < GRAZING || seen.contains_key(corners), "{:?} is met and not seen", corners);
        }
        for corners in seen.keys().filter(|corners| !met.contains_key(*corners)) {
            // Only rounding may have shown it: some slope of it is open once all that is nearer is a little less.
            let cut = cuts.iter().find(|cut| sorted(cut.corners) == *corners).unwrap();
            let nearer = cuts.iter().filter(|c| c.distance[0] < cut.distance[0]);
            let less: Vec<Cut> = nearer.map(|c| {
                let [a, b] = c.slopes;
                let [lo, hi] = [a.min(b), a.max(b)];
                Cut { slopes: [lo + GRAZING * (1.0 + lo.abs()), hi - GRAZING * (1.0 + hi.abs())], ..c.clone() }
            }).filter(|c| c.slopes[0] <= c.slopes[1]).collect();
            let [a, b] = cut.slopes;
            let both: Vec<Cut> = less.iter().cloned().chain([cut.clone()]).collect();
            let grazed = rays(&both).iter().any(|(ray, _)| {
                (a.min(b)..=a.max(b)).contains(ray) && first(&less, *ray).is_none()
            });
            prop_assert!(grazed || (a - b).abs() < GRAZING, "{:?} is seen and not met", cut);
        }
    }

    #[test]
    fn what_is_hidden_stays_hidden_with_the_error_that_its_share_allows(
        relief in any_relief(),
        above in any_eye(),
        azimuth in any_azimuth(),
        angle in prop::sample::select(vec![1e-3, 1e-2, 0.1]),
    ) {
        let eye = eye_over(&relief, above);
        let optics = Optics { angle, ..optics(0.0) };
        let mut shares: BTreeMap<_, f64> = BTreeMap::new();
        walk(&relief, &optics, eye, azimuth, |s| {
            for corners in inside(&relief, s.region) {
                let share = shares.entry(corners).or_default();
                *share = share.max(s.share);
            }
        });
        let cuts = cuts(&relief, &optics, eye, azimuth);
        for cut in &cuts {
            let share = shares.get(&sorted(cut.corners)).copied().unwrap_or(optics.least());
            if share >= 1.0 {
                continue;
            }
            let nearer: Vec<Cut> = cuts.iter().filter(|c| c.distance[0] < cut.distance[0]).cloned().collect();
            for (slope, distance) in cut.slopes.iter().zip(cut.distance) {
                // The error is seen as `angle / share`: how far does that raise the slope?
                let rise = slope * optics.quantum;
                let error = angle / share * distance * (1.0 + rise * rise);
                let raised = slope + 0.999 * error / distance / optics.quantum;
                let between = rays(&cuts).into_iter().filter(|(ray, width)| *width > GRAZING && (*slope..raised).contains(ray));
                for (ray, _) in between {
                    prop_assert!(first(&nearer, ray).is_some(), "{:?} rises from {} to {} past {}", cut, slope, raised, ray);
                }
            }
        }
    }
}

/// A mask by rays that know nothing of each other.
fn by_each_ray(relief: &Relief, optics: &Optics, eyes: &[Eye]) -> Vec<u8> {
    let [width, height] = relief.size();
    let floor = pack(optics.hidden);
    let mut mask = vec![floor; width * height];
    for eye in eyes {
        let azimuths = optics.azimuths(relief, eye.place);
        for i in 0..azimuths {
            walk(relief, optics, *eye, (i as f64 + 0.5) / azimuths as f64 * TAU, |seen| {
                let share = stepped(seen.share, floor);
                let mut raise = |[x, y]: [usize; 2]| mask[y * width + x] = mask[y * width + x].max(share);
                let (first, side) = match seen.region {
                    Region::Triangle(corners) => return corners.into_iter().for_each(raise),
                    Region::Cell(cell) => (cell, 1),
                    Region::Block(block) => (block.map(|b| b << BLOCKS_LOG2[0]), 1 << BLOCKS_LOG2[0]),
                };
                for y in first[1]..=(first[1] + side).min(height - 1) {
                    (first[0]..=(first[0] + side).min(width - 1)).for_each(|x| raise([x, y]));
                }
            });
        }
    }
    mask
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(200))]
    #[test]
    fn what_rays_know_of_others_changes_no_mask(
        relief in any_relief(),
        above in prop::collection::vec(any_eye(), 1..4),
        bend in prop::sample::select(vec![0.0, BEND, 1e-4]),
        angle in prop::sample::select(vec![0.0, 1e-3, 1e-2, 0.1]),
    ) {
        let optics = Optics { angle, ..optics(bend) };
        let eyes: Vec<Eye> = above.into_iter().map(|above| eye_over(&relief, above)).collect();
        // From the same places again, all that is seen is known.
        let twice = [eyes.clone(), eyes.clone()].concat();
        let mask = cast(&relief, &optics, &twice, &Progress::hidden()).unwrap();
        prop_assert_eq!(mask.rows().collect::<Vec<u8>>(), by_each_ray(&relief, &optics, &eyes));
    }
}

/// The same where blocks of all kinds become plain, and where holes open windows.
#[test]
fn what_rays_know_of_others_changes_no_mask_of_rough_ground() {
    let side = 200usize;
    let optics = Optics { epsilon: 0.004, hidden: 0.05, angle: 1e-3, ..ROUGH };
    let mut heights = rough(side);
    for is_whole in [true, false] {
        if !is_whole {
            // Two lakes, one of them around an eye.
            let (x, y) = (|i: usize| i % side, |i: usize| i / side);
            let is_lake = |i: usize| {
                x(i).abs_diff(30) + y(i).abs_diff(100) < 12 || x(i).abs_diff(120) + y(i).abs_diff(60) < 9
            };
            (0..side * side).filter(|i| is_lake(*i)).for_each(|i| heights[i] = NODATA);
        }
        let relief = Relief::from_rows([side; 2], &heights);
        let places = [[30.2, 100.7], [100.0, 100.0], [170.9, 20.1], [199.0, 199.0]];
        let eyes = places.map(|place| Eye { place, height: 3.2e6 }).to_vec();
        let twice = [eyes.clone(), eyes.clone()].concat();
        let mask = cast(&relief, &optics, &twice, &Progress::hidden()).unwrap();
        let mask: Vec<u8> = mask.rows().collect();
        assert!(mask == by_each_ray(&relief, &optics, &eyes), "whole: {is_whole}");
        let seen = mask.iter().filter(|share| **share == u8::MAX).count();
        assert!((side * side / 8..side * side).contains(&seen), "{seen} are seen");
    }
}

#[test]
fn masks_do_not_depend_on_threads_and_hold_what_each_azimuth_shows() {
    let side = 150usize;
    let height = |i: usize| {
        let (x, y) = ((i % side) as f64, (i / side) as f64);
        (300.0 * (x / 11.0).sin() * (y / 17.0).cos()) as i32
    };
    let relief = Relief::from_rows([side, side], &(0..side * side).map(height).collect::<Vec<i32>>());
    let optics = optics(BEND);
    let eyes: Vec<Eye> =
        [[3.3, 70.0], [75.0, 75.5], [149.0, 0.0]].map(|p| Eye { place: p, height: 310.0 }).to_vec();
    let whole = cast(&relief, &optics, &eyes, &Progress::hidden()).unwrap();
    let one = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    assert_eq!(one.install(|| cast(&relief, &optics, &eyes, &Progress::hidden())).unwrap(), whole);
    let expected = by_each_ray(&relief, &optics, &eyes);
    assert_eq!(whole.rows().collect::<Vec<u8>>(), expected);
    let seen = whole.rows().filter(|v| *v == 255).count();
    assert!((side * side / 20..side * side * 19 / 20).contains(&seen), "{seen} of {} are seen", side * side);
    let stopped = Progress::hidden();
    stopped.stop();
    assert!(cast(&relief, &optics, &eyes, &stopped).is_none());
}

#[test]
fn the_step_of_azimuth_is_half_the_least_triangle_that_counts() {
    let relief = Relief::from_rows([101, 101], &[0; 101 * 101]);
    let fine = optics(0.0);
    // The farthest corner is 1000 m east and 1300 m north.
    let ratio = 10.0 / SQRT_2 / 1000.0f64.hypot(1300.0);
    let at_least = (TAU / (ratio / 2.0).atan()).ceil() as usize;
    assert_eq!(fine.azimuths(&relief, [0.0, 0.0]), at_least.next_multiple_of(4));
    let coarse = Optics { epsilon: 0.02, ..fine };
    assert_eq!(
        coarse.azimuths(&relief, [0.0, 0.0]),
        ((TAU / 0.01f64.atan()).ceil() as usize).next_multiple_of(4)
    );
    // So each triangle is crossed by a ray from anywhere.
    let eye = Eye { place: [20.4, 31.7], height: 5000.0 };
    let mask = cast(&relief, &fine, &[eye], &Progress::hidden()).unwrap();
    assert!(mask.rows().all(|v| v == 255), "all of a plain is seen from above");
}

/// Steep and rough ground of `side` by `side` samples, in millimetres.
fn rough(side: usize) -> Vec<i32> {
    let height = |i: usize| {
        let (x, y) = ((i % side) as f64, (i / side) as f64);
        let noise = f64::from((i as u32).wrapping_mul(0x9E37_79B1) >> 20);
        ((1500.0 + 1400.0 * (x / 9.0).sin() * (y / 13.0).cos()) * 1000.0 + 90.0 * noise) as i32
    };
    (0..side * side).map(height).collect()
}

const ROUGH: Optics =
    Optics { cell: [77.0, 93.0], quantum: 1e-3, bend: 0.0, epsilon: 0.0, hidden: 0.0, angle: 0.0 };

/// A ground without holes leaves nothing open below the horizon, however fine the quantum.
#[test]
fn rounding_opens_no_windows_in_a_surface_without_holes() {
    let relief = Relief::from_rows([120; 2], &rough(120));
    let place = [60.3, 58.9];
    let eye = Eye { place, height: relief.height(place).unwrap() + 3000.0 };
    for i in 0..20_000 {
        let plane = Plane::new(&relief, &ROUGH, eye, f64::from(i) / 20_000.0 * TAU + 1e-4);
        let mut walk = Walk::new(&plane, &ROUGH, |_: Seen| {});
        walk.run();
        assert!(walk.sky.windows.is_empty(), "azimuth {i}: {:?}", walk.sky.windows);
    }
}

/// Where triangles of a cell have their heights, the ground goes on from one to the next, though another sample of the
/// cell has none. What opens behind a hole is as wide as the hole is seen; what rounding opens would be a slit.
#[test]
fn rounding_opens_no_windows_beside_holes() {
    let mut heights = rough(120);
    let holes = (0u32..).map(|i| i.wrapping_mul(0x85EB_CA77) >> 16).map(|hash| hash % 9 == 0);
    heights.iter_mut().zip(holes).filter(|(_, hole)| *hole).for_each(|(height, _)| *height = NODATA);
    let relief = Relief::from_rows([120; 2], &heights);
    let eye = Eye { place: [60.3, 58.9], height: 6e6 };
    let mut opened = 0;
    for i in 0..20_000 {
        let plane = Plane::new(&relief, &ROUGH, eye, f64::from(i) / 20_000.0 * TAU + 1e-4);
        let mut walk = Walk::new(&plane, &ROUGH, |_: Seen| {});
        walk.run();
        opened += walk.sky.windows.len();
        let slit = walk.sky.windows.iter().find(|[least, most]| most - least < 1e-9 * (1.0 + most.abs()));
        assert_eq!(slit, None, "azimuth {i}");
    }
    assert!(opened > 1000, "{opened}");
}

/// A ray along the edges of triangles keeps to one side of them: it does not look through a void on the one side and then
/// through one on the other.
#[test]
fn along_a_diagonal_rays_keep_to_one_side() {
    // An odd count, so that diagonals turn with it.
    let side = 25usize;
    // Two peaks on the diagonal to the east and north, the first with voids to its right, the second to its left.
    let mut heights = vec![0; side * side];
    let [first, second] = [15, 18];
    for (peak, voids) in [
        (first, [[first, first - 1], [first + 1, first]]),
        (second, [[second - 1, second], [second, second + 1]]),
    ] {
        heights[peak * side + peak] = 1000;
        voids.iter().for_each(|[x, y]| heights[y * side + x] = NODATA);
    }
    for cell in [[1.0, 1.0], [77.0, 93.0], [93.0, 77.0]] {
        let optics = Optics { cell, quantum: 1.0, ..ROUGH };
        // All four diagonals, by turning the relief a quarter each time.
        for quarter in 0..4 {
            let turned = |[x, y]: [usize; 2]| (0..quarter).fold([x, y], |[x, y], _| [y, side - 1 - x]);
            let rows = (0..side * side).map(|i| turned([i % side, i / side]));
            let rows: Vec<i32> = rows.map(|[x, y]| heights[y * side + x]).collect();
            let relief = Relief::from_rows([side; 2], &rows);
            let [x, y] = [[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]][quarter];
            let azimuth = f64::atan2(y * cell[1], x * cell[0]);
            for i in 0..1000 {
                let along = f64::from(i) / 997.0;
                let at = |sign: f64| if sign > 0.0 { along } else { (side - 1) as f64 - along } + sign * 10.0;
                let eye = Eye { place: [at(x), at(y)], height: 1.0 };
                walk(&relief, &optics, eye, azimuth, |seen| {
                    let Region::Triangle(corners) = seen.region else { return };
                    // From the turned relief back to the first.
                    let beyond = corners.map(turned).into_iter().all(|c| c.iter().all(|w| *w > second));
                    assert!(!beyond, "{cell:?}, {quarter} quarters, eye {i}: {corners:?}");
                });
            }
        }
    }
}
