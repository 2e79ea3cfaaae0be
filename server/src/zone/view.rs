//! Where the eyes of a zone stand, so that what is seen from anywhere in it is seen from one of them.
//!
//! The eye may be anywhere over a polygon, up to its *ceiling*: the polygon's highest ground and the given height
//! of the eye. Eyes along the contour at the height of the ceiling are enough:
//!
//! - Raising an eye over one place hides nothing: between it and whatever it sees, its ray rises everywhere.
//! - Let an eye P at the ceiling see a point T outside of the polygon. The line through both leaves the polygon
//!   behind P at Q', and between P and T at Q. If T lies above the ceiling, the ray from Q' to T runs below
//!   the ceiling nowhere and above the ray from P beyond P; so Q' sees T. If T lies below, the ray from Q to T
//!   runs above that from P; so Q sees T.
//!
//! What lies in the polygon counts as seen. So it is as Cifuentes et al. (2007) say of a lake, for any ground: inner
//! points add nothing. But the ceiling of sloping ground is far above its low end, and shows more than need be:
//! a long zone is better cut into parts. Between the eyes, which are only so many, it is a matter of spacing.
//!
//! Under a hole of the ground the first point does not hold: an eye below the edge of a hole may look up through it.

#![allow(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "places are clipped to the relief, whose sides are below 2^28"
)]

use super::cast::Eye;
use super::polygon::{Rings, contour, edges};
use super::relief::Relief;
use diamantina_protocol::NODATA;

/// A relief in the frame.
#[derive(Debug)]
pub struct Ground {
    /// The heights.
    pub relief: Relief,
    /// Frame coordinates of the south-west sample, in metres.
    pub origin: [f64; 2],
    /// Metres of a cell along x and y.
    pub cell: [f64; 2],
    /// Metres of a quantum.
    pub quantum: f64,
    /// Metres added to every height.
    pub height_offset: f64,
}

impl Ground {
    /// A place in the frame in cells from the south-west sample.
    #[must_use]
    pub fn place(&self, point: [f64; 2]) -> [f64; 2] {
        [0, 1].map(|axis| (point[axis] - self.origin[axis]) / self.cell[axis])
    }

    /// The box around the relief in the frame: south-west and north-east corner.
    #[must_use]
    pub fn extent(&self) -> [[f64; 2]; 2] {
        let far =
            [0, 1].map(|axis| self.origin[axis] + self.cell[axis] * (self.relief.size()[axis] - 1) as f64);
        [self.origin, far]
    }

    /// Whether the relief reaches all corners of some polygons, to the millimetre.
    #[must_use]
    pub fn holds(&self, polygons: &[Rings]) -> bool {
        let [low, high] = self.extent();
        let inside = |p: &[f64; 2]| (0..2).all(|k| (low[k] - 1e-3..=high[k] + 1e-3).contains(&p[k]));
        polygons.iter().flatten().flatten().all(inside)
    }

    /// The eye over a place of the frame, at a height in metres.
    #[must_use]
    pub fn eye(&self, point: [f64; 2], metres: f64) -> Eye {
        Eye { place: self.clipped(self.place(point)), height: (metres - self.height_offset) / self.quantum }
    }

    /// The highest ground of a polygon in metres: of its samples, and along its contour at each half cell.
    #[must_use]
    pub fn highest(&self, rings: &Rings) -> Option<f64> {
        let mut highest = None;
        let mut see = |quanta: f64| {
            let metres = quanta * self.quantum + self.height_offset;
            highest = Some(highest.map_or(metres, |h: f64| h.max(metres)));
        };
        self.samples(rings, |at| {
            let height = self.relief.at(at);
            if height != NODATA {
                see(f64::from(height));
            }
        });
        for point in self.rim(rings) {
            if let Some(height) = self.relief.height(point) {
                see(height);
            }
        }
        highest
    }

    /// Shows every sample of a polygon and of the triangles that its contour crosses.
    pub fn own(&self, rings: &Rings, mut visit: impl FnMut([usize; 2])) {
        self.samples(rings, &mut visit);
        for point in self.rim(rings) {
            self.relief.triangle(point).iter().for_each(|(corner, _)| visit(*corner));
        }
    }

    /// Places along the contour, half a cell apart at most, in cells.
    fn rim(&self, rings: &Rings) -> impl Iterator<Item = [f64; 2]> + '_ {
        let half = self.cell[0].min(self.cell[1]) / 2.0;
        contour(rings, half).into_iter().map(|point| self.clipped(self.place(point)))
    }

    fn clipped(&self, place: [f64; 2]) -> [f64; 2] {
        [0, 1].map(|axis| place[axis].clamp(0.0, (self.relief.size()[axis] - 1) as f64))
    }

    /// Shows the samples within a polygon, row by row.
    fn samples(&self, rings: &Rings, mut visit: impl FnMut([usize; 2])) {
        let [width, height] = self.relief.size();
        let placed: Vec<Vec<[f64; 2]>> =
            rings.iter().map(|ring| ring.iter().map(|p| self.place(*p)).collect()).collect();
        let rows = placed.iter().flatten().map(|p| p[1]);
        let [south, north] = rows.fold([f64::INFINITY, 0.0], |[s, n]: [f64; 2], y| [s.min(y), n.max(y)]);
        let mut crossings = Vec::new();
        for row in south.max(0.0).ceil() as usize..=(north as usize).min(height - 1) {
            let y = row as f64;
            crossings.clear();
            let all = placed.iter().flat_map(|ring| edges(ring)).filter(|[a, b]| (a[1] > y) != (b[1] > y));
            crossings.extend(all.map(|[a, b]| a[0] + (y - a[1]) / (b[1] - a[1]) * (b[0] - a[0])));
            crossings.sort_by(f64::total_cmp);
            for pair in crossings.chunks_exact(2) {
                for column in pair[0].max(0.0).ceil() as usize..=(pair[1].max(0.0) as usize).min(width - 1) {
                    if pair[1] >= 0.0 {
                        visit([column, row]);
                    }
                }
            }
        }
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a test that cannot go on has failed")]
mod tests {
    use super::super::cast::{BEND, Optics, Region, cast, walk};
    use super::*;
    use crate::progress::Progress;
    use diamantina_protocol::zone::Part;
    use proptest::prelude::*;
    use std::f64::consts::TAU;

    fn dice(seed: u64) -> impl FnMut() -> f64 {
        let mut state = seed | 1;
        move || {
            state ^= state << 13;
            state ^= state >> 7;
            state ^= state << 17;
            (state >> 11) as f64 / (1u64 << 53) as f64
        }
    }

    /// Hills around and under a polygon, whose ground may slope.
    fn hills(side: usize, seed: u64) -> Ground {
        let mut roll = dice(seed);
        let waves: Vec<[f64; 4]> =
            (0..12).map(|_| [roll() * 0.5, roll() * 0.5, roll() * TAU, roll() * 40.0]).collect();
        let height = |i: usize| {
            let [x, y] = [(i % side) as f64, (i / side) as f64];
            waves.iter().map(|[a, b, c, h]| h * (a * x + b * y + c).sin()).sum::<f64>() as i32
        };
        let relief = Relief::from_rows([side, side], &(0..side * side).map(height).collect::<Vec<i32>>());
        Ground { relief, origin: [500.0, -300.0], cell: [10.0, 10.0], quantum: 1.0, height_offset: 7.0 }
    }

    fn star(roll: &mut impl FnMut() -> f64) -> Rings {
        let [x, y] = [500.0 + 200.0 + 200.0 * roll(), -300.0 + 200.0 + 200.0 * roll()];
        let corner = |i: i32, r: f64| {
            let angle = f64::from(i) / 9.0 * TAU;
            [x + r * angle.cos(), y + r * angle.sin()]
        };
        vec![(0..9).map(|i| corner(i, 30.0 + 120.0 * roll())).collect()]
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(24))]
        #[test]
        fn what_is_seen_from_inside_is_seen_from_the_contour_at_the_ceiling(seed in any::<u64>(), above in 1.0..30.0f64) {
            let ground = hills(61, seed);
            let mut roll = dice(seed ^ 0x5555);
            let rings = star(&mut roll);
            let ceiling = ground.highest(&rings).unwrap() + above;
            let optics = Optics {
                cell: ground.cell, quantum: ground.quantum, bend: BEND, epsilon: 0.0, hidden: 0.0, angle: 1e-3,
            };
            // Close enough that what only an eye between two of them sees is within the angle of being seen.
            let eyes: Vec<Eye> = contour(&rings, 4.0).into_iter().map(|p| ground.eye(p, ceiling)).collect();
            let mut mask = cast(&ground.relief, &optics, &eyes, &Progress::hidden()).unwrap();
            ground.own(&rings, |at| mask.set(at, 255));
            let part = Part { ceiling, rings };
            let [mut inside, mut seen, mut missed] = [0, 0, 0];
            while inside < 12 {
                let point = [500.0 + 600.0 * roll(), -300.0 + 600.0 * roll()];
                if !part.covers(point) {
                    continue;
                }
                inside += 1;
                // Anywhere between the ground and the ceiling.
                let low = ground.relief.height(ground.place(point)).unwrap() * ground.quantum + ground.height_offset;
                let eye = ground.eye(point, low + 0.05 + (ceiling - low - 0.05) * roll());
                for i in 0..200 {
                    walk(&ground.relief, &optics, eye, f64::from(i) / 200.0 * TAU + 1e-3, |s| {
                        if let Region::Triangle(corners) = s.region && s.share >= 1.0 && s.slopes[1] - s.slopes[0] > 1e-4 {
                            seen += 1;
                            let share = corners.iter().map(|at| mask.at(*at)).max();
                            missed += i32::from(share < Some(250));
                        }
                    });
                }
            }
            prop_assert!(seen > 1000);
            prop_assert!(f64::from(missed) <= 0.002 * f64::from(seen), "{} of {} are missed", missed, seen);
        }
    }

    #[test]
    fn a_polygon_owns_its_samples_and_those_around_its_contour() {
        let ground = hills(61, 3);
        let square = |x: f64, y: f64, w: f64| vec![[x, y], [x + w, y], [x + w, y + w], [x, y + w]];
        // Cells from the corner: 10 to 20, but for a hole from 13 to 17.
        let rings = vec![square(600.0, -200.0, 100.0), square(630.0, -170.0, 40.0)];
        let mut owned = std::collections::BTreeSet::new();
        ground.own(&rings, |at| {
            owned.insert(at);
        });
        assert!(owned.contains(&[10, 10]) && owned.contains(&[20, 20]) && owned.contains(&[11, 15]));
        assert!(!owned.contains(&[15, 15]) && !owned.contains(&[9, 15]) && !owned.contains(&[22, 15]));
        assert!(
            ground.holds(std::slice::from_ref(&rings)) && !ground.holds(&[vec![square(1095.0, 0.0, 10.0)]])
        );
        let inner = (10..=20).flat_map(|x| (10..=20).map(move |y| [x, y]));
        let inner = inner.filter(|p| !p.iter().all(|w| (14..=16).contains(w)));
        let highest = inner.map(|p| ground.relief.at(p)).max().unwrap();
        assert!((ground.highest(&rings).unwrap() - f64::from(highest) - 7.0).abs() < 1e-9);
    }
}
