//! What is wrong with a triangle, by several measures.

use super::Strategy;
use crate::experiment::curvature::curvatures;
use crate::experiment::field::Field;
use crate::experiment::scan::{Plane, exceeds, exceeds_between, rows, vertical_error};
use clap::ValueEnum;
use diamantina_protocol::bintree::Point;
use diamantina_protocol::bitree::{Bitree, Facet};
use std::ops::ControlFlow;
use std::sync::OnceLock;

/// A field, with the weight of each sample and what criteria derive from it once.
#[derive(Debug)]
pub struct Ground<'a> {
    field: &'a Field,
    weights: Option<&'a [f32]>,
    curvatures: OnceLock<Vec<f64>>,
    full: OnceLock<Bitree>,
}

impl<'a> Ground<'a> {
    /// A field whose samples all count fully, or by a mask: a weight of 0 to 1 for each, rows from the south.
    /// `None` if there are not as many weights as samples, or one is out of range.
    #[must_use]
    pub fn new(field: &'a Field, weights: Option<&'a [f32]>) -> Option<Self> {
        let fits = weights
            .is_none_or(|w| w.len() == field.heights().len() && w.iter().all(|v| (0.0..=1.0).contains(v)));
        fits.then(|| Self { field, weights, curvatures: OnceLock::new(), full: OnceLock::new() })
    }

    /// The heights.
    #[must_use]
    pub fn field(&self) -> &'a Field {
        self.field
    }

    /// The same field with all samples counting fully.
    #[must_use]
    pub fn unweighted(&self) -> Ground<'a> {
        Self { field: self.field, weights: None, curvatures: OnceLock::new(), full: OnceLock::new() }
    }

    fn weight(&self, slot: usize) -> f64 {
        self.weights.map_or(1.0, |w| f64::from(w[slot]))
    }
}

/// How the error of a triangle is told. Each sample's part is multiplied with its weight; samples without
/// data have none. Borders count.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, clap::ValueEnum)]
pub enum Criterion {
    /// The largest vertical distance to a sample, metres: the guarantee.
    Vertical,
    /// The largest distance at right angles to the triangle's plane, metres.
    Euclidean,
    /// The sum of the samples' curvatures, as the changes of slope from sample to sample.
    Curvature,
    /// The largest angle between the triangle and the finest triangles that it stands for, degrees.
    Normal,
    /// How far a point is off the mean of its hypotenuse's ends, all being samples, metres: of each point
    /// alone, no bound on anything.
    Coefficient,
}

impl std::fmt::Display for Criterion {
    /// The word of the command line.
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let word = self.to_possible_value();
        f.write_str(word.as_ref().map_or("", |word| word.get_name()))
    }
}

impl Criterion {
    /// The error of a triangle; the search may end once it is more than `enough`.
    #[must_use]
    pub fn error(self, ground: &Ground<'_>, facet: &Facet, enough: f64) -> f64 {
        let field = ground.field;
        match self {
            Self::Vertical => vertical_error(field, ground.weights, facet.corners(), facet.heights(), enough),
            Self::Euclidean => euclidean_error(ground, facet.corners(), facet.heights(), enough),
            Self::Curvature => curvature_sum(ground, facet, enough),
            Self::Normal => normal_error(ground, facet, enough),
            Self::Coefficient => {
                let m = facet.middle();
                let [ha, _, hb] = facet.heights();
                let off = (field.at(m) - (ha + hb) / 2.0).abs();
                let is_finest = facet.level() >= 2 * u32::from(field.log2());
                if off.is_nan() || is_finest { 0.0 } else { ground.weight(field.slot(m)) * off }
            }
        }
    }

    /// The better way to select by this criterion, as measured (docs/EXPERIMENTS.md): from the top and greedily, each pruned,
    /// the one that needs fewer points and triangles. By vertical error that is from the top at every tolerance, by curvature
    /// greedy; by distances at right angles and by normals points are the same within a percent, and triangles fewer from the top.
    #[must_use]
    pub fn strategy(self) -> Strategy {
        match self {
            Self::Vertical | Self::Euclidean | Self::Normal => Strategy::Compact,
            Self::Curvature => Strategy::Greedy,
            Self::Coefficient => Strategy::Direct,
        }
    }

    /// Whether the error depends on the triangle's own heights, so that it tells what may be left out.
    #[must_use]
    pub fn is_measured(self) -> bool {
        !matches!(self, Self::Curvature | Self::Coefficient)
    }

    /// Whether a triangle splits at a middle that lies on its hypotenuse, too: sums over the triangle fall with its area,
    /// whatever its heights. Where the middle has no data, it splits at what is known below.
    pub(in crate::experiment) fn splits_level(self) -> bool {
        self == Self::Curvature
    }

    /// Whether errors are distances. Upright they are never less than at right angles to whatever triangle will be
    /// there in the end.
    pub(super) fn is_distance(self) -> bool {
        matches!(self, Self::Vertical | Self::Euclidean)
    }

    /// Whether a sample that is off the surface by so much makes its triangle worse than a tolerance by itself.
    pub(super) fn is_beyond(self, ground: &Ground<'_>, slot: usize, off: f64, tolerance: f64) -> bool {
        self.is_of_samples() && ground.weight(slot) * off.abs() > tolerance
    }

    /// Whether a triangle is as bad as the worst of its samples by itself, whatever triangle that is in.
    pub(super) fn is_of_samples(self) -> bool {
        self == Self::Vertical
    }

    /// Whether the error of a triangle with these corners, apex in the middle, is more than the tolerance.
    pub(super) fn exceeds(
        self,
        ground: &Ground<'_>,
        corners: [Point; 3],
        heights: [f64; 3],
        tolerance: f64,
    ) -> bool {
        let field = ground.field;
        let error = match self {
            Self::Vertical => return exceeds(field, ground.weights, corners, heights, tolerance),
            Self::Euclidean => euclidean_error(ground, corners, heights, tolerance),
            Self::Curvature | Self::Normal | Self::Coefficient => Facet::new(field.log2(), corners, heights)
                .map_or(0.0, |facet| self.error(ground, &facet, tolerance)),
        };
        error > tolerance
    }

    /// The same where none of the corners is beyond the tolerance by itself, see [`Criterion::is_beyond`].
    pub(super) fn exceeds_between(
        self,
        ground: &Ground<'_>,
        corners: [Point; 3],
        heights: [f64; 3],
        tolerance: f64,
    ) -> bool {
        match self.is_of_samples() {
            true => exceeds_between(ground.field, ground.weights, corners, heights, tolerance),
            false => self.exceeds(ground, corners, heights, tolerance),
        }
    }

    /// The points whose coefficients are more than the tolerance; by another criterion, the corners alone.
    pub(super) fn direct(self, ground: &Ground<'_>, tolerance: f64) -> Bitree {
        let mut tree = ground.field.tree();
        if self == Self::Coefficient {
            for (_, point) in coefficients(ground).into_iter().filter(|(size, _)| *size > tolerance) {
                tree.add(point, ground.field.at(point));
            }
        }
        tree
    }

    /// The points with the largest coefficients, so many with the corners; `None` by another criterion.
    pub(super) fn largest(self, ground: &Ground<'_>, points: usize) -> Option<Bitree> {
        let mut tree = (self == Self::Coefficient).then(|| ground.field.tree())?;
        let mut all = coefficients(ground);
        all.sort_by(|(a, p), (b, q)| b.total_cmp(a).then([p[1], p[0]].cmp(&[q[1], q[0]])));
        for (_, point) in all.into_iter().take(points.saturating_sub(4)).filter(|(size, _)| *size > 0.0) {
            tree.add(point, ground.field.at(point));
        }
        Some(tree)
    }
}

/// The weighted coefficient of each point that has one.
fn coefficients(ground: &Ground<'_>) -> Vec<(f64, Point)> {
    let field = ground.field;
    let full = field.full_tree();
    let of = |slot: usize| {
        let point = field.point(slot);
        let facet = full.around(point).into_iter().flatten().next()?;
        Some((Criterion::Coefficient.error(ground, &facet, f64::INFINITY), point))
    };
    (0..field.heights().len()).filter_map(of).collect()
}

fn euclidean_error(ground: &Ground<'_>, corners: [Point; 3], heights: [f64; 3], enough: f64) -> f64 {
    let [sx, sy] = slopes(ground.field, corners, heights);
    // The vertical part of the triangle's unit normal.
    let upright = 1.0 / (1.0 + sx * sx + sy * sy).sqrt();
    // A little more, lest a search end at what rounds down to enough.
    let enough = enough / upright * (1.0 + 1e-12);
    upright * vertical_error(ground.field, ground.weights, corners, heights, enough)
}

/// Metres of height a metre along x and y.
fn slopes(field: &Field, corners: [Point; 3], heights: [f64; 3]) -> [f64; 2] {
    let [sx, sy] = Plane::new(corners, heights).slope();
    [sx / field.cell()[0], sy / field.cell()[1]]
}

fn curvature_sum(ground: &Ground<'_>, facet: &Facet, enough: f64) -> f64 {
    let field = ground.field;
    let all = ground.curvatures.get_or_init(|| curvatures(field));
    let mut sum = 0.0;
    // The finest triangles have nothing to split.
    if facet.level() >= 2 * u32::from(field.log2()) {
        return sum;
    }
    rows(facet.corners(), |y, first, last| {
        let run = field.slot([first, y])..field.slot([last, y]) + 1;
        sum +=
            run.clone().zip(&all[run]).map(|(slot, curvature)| ground.weight(slot) * curvature).sum::<f64>();
        sum <= enough
    });
    // Nor has one that knows nothing but its corners.
    let has_middle = !field.at(facet.middle()).is_nan();
    if sum > 0.0 && !has_middle && field.known_below(facet.corners()).is_none() { 0.0 } else { sum }
}

/// Over the finest triangles that this one stands for; without data at a corner they have no angle.
fn normal_error(ground: &Ground<'_>, facet: &Facet, enough: f64) -> f64 {
    let field = ground.field;
    let full = ground.full.get_or_init(|| field.full_tree());
    let own = unit_normal(slopes(field, facet.corners(), facet.heights()));
    let mut worst = 0.0f64;
    if let Some(all) = full.facet(facet.path()) {
        let _ = full.leaves(&all, &mut |finest| {
            let corners = finest.corners();
            if corners.iter().all(|p| !field.at(*p).is_nan()) {
                let other = unit_normal(slopes(field, corners, finest.heights()));
                let weight = corners.iter().map(|p| ground.weight(field.slot(*p))).fold(0.0, f64::max);
                worst = worst.max(weight * angle(own, other).to_degrees());
            }
            if worst > enough { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
        });
    }
    worst
}

/// Between two unit vectors. By the sine as well as by the cosine, which for small angles is all rounding.
fn angle(a: [f64; 3], b: [f64; 3]) -> f64 {
    let cross = [0, 1, 2].map(|i| a[(i + 1) % 3] * b[(i + 2) % 3] - a[(i + 2) % 3] * b[(i + 1) % 3]);
    let cosine: f64 = a.iter().zip(b).map(|(a, b)| a * b).sum();
    cross.iter().map(|w| w * w).sum::<f64>().sqrt().atan2(cosine)
}

fn unit_normal([sx, sy]: [f64; 2]) -> [f64; 3] {
    let length = (1.0 + sx * sx + sy * sy).sqrt();
    [-sx / length, -sy / length, 1.0 / length]
}
