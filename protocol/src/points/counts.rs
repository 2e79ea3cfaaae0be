//! What numbers were met, from which the sender learns a model's hazards.

#![allow(
    clippy::cast_possible_truncation,
    clippy::cast_possible_wrap,
    clippy::cast_sign_loss,
    reason = "classes and hazards are below 2^13, corrections -1 to 1"
)]

use super::model::{Kernel, Model, REFINER_PASSES, Refiner};
use super::tables::{
    CLASSES, CORRECTION_CLASSES, DIRECT_MAX, HAZARDS, LENGTH_BITS, class_shift, hazard_group,
};
use crate::rans::TOTAL;

/// How often each magnitude was met in each class: what hazards are learnt from.
#[derive(Debug, Clone)]
pub(super) struct Counts {
    /// By class and group of magnitudes: how often a magnitude was in the group, and how often it was
    /// at or beyond each of the group's magnitudes.
    numbers: Vec<[(u64, u64); HAZARDS]>,
    corrections: [[u64; 3]; CORRECTION_CLASSES],
    /// Bits of numbers that are sent plainly, signs included.
    plain_bits: u64,
}

impl Default for Counts {
    fn default() -> Self {
        let numbers = vec![[(0, 0); HAZARDS]; CLASSES];
        Self { numbers, corrections: [[0; 3]; CORRECTION_CLASSES], plain_bits: 0 }
    }
}

impl Counts {
    /// Notes a number or a correction.
    pub(super) fn add(&mut self, class: u8, value: i32) {
        let class = usize::from(class);
        if class >= CLASSES {
            self.corrections[class - CLASSES][(value.clamp(-1, 1) + 1) as usize] += 1;
            return;
        }
        let half = (1 << class_shift(class)) >> 1;
        let magnitude = ((value + half) >> class_shift(class)).unsigned_abs() as usize;
        self.plain_bits += u64::from(class_shift(class)) + u64::from(magnitude > 0);
        if let Some(below) = magnitude.saturating_sub(DIRECT_MAX).checked_ilog2() {
            self.plain_bits += u64::from(LENGTH_BITS + below);
        }
        for m in 0..=magnitude.min(DIRECT_MAX) {
            let (stopped, reached) = &mut self.numbers[class][hazard_group(m)];
            *reached += 1;
            *stopped += u64::from(m == magnitude);
        }
    }

    /// Adds up two counts.
    pub(super) fn merge(&mut self, other: &Self) {
        for (a, b) in self.numbers.iter_mut().flatten().zip(other.numbers.iter().flatten()) {
            *a = (a.0 + b.0, a.1 + b.1);
        }
        for (a, b) in self.corrections.iter_mut().flatten().zip(other.corrections.iter().flatten()) {
            *a += b;
        }
        self.plain_bits += other.plain_bits;
    }

    /// What all numbers counted cost, in bits, with tables that fit them alone. Corrections are left out.
    #[must_use]
    pub(super) fn bits(&self) -> f64 {
        let of = |part: u64, whole: u64| part as f64 * libm::log2(whole.max(1) as f64 / part.max(1) as f64);
        let hazards = self.numbers.iter().flatten();
        let told: f64 =
            hazards.map(|(stopped, reached)| of(*stopped, *reached) + of(reached - stopped, *reached)).sum();
        told + self.plain_bits as f64
    }

    /// The model with these kernels whose hazards fit the counts, where there are enough of them.
    #[must_use]
    pub(super) fn model(&self, levels: Vec<[Kernel; 2]>, refiners: Vec<[Refiner; REFINER_PASSES]>) -> Model {
        // What a hazard is worth before anything is counted.
        const PRIOR: u64 = 12;
        let hazard = |stopped: u64, reached: u64, prior: u16| {
            let h = (stopped * u64::from(TOTAL) + PRIOR * u64::from(prior)) / (reached + PRIOR);
            h.clamp(1, u64::from(TOTAL) - 1) as u16
        };
        let start = Model::default();
        let (prior_numbers, prior_corrections) = start.hazards();
        let numbers = std::array::from_fn(|c| {
            std::array::from_fn(|g| {
                let (stopped, reached) = self.numbers[c][g];
                hazard(stopped, reached, prior_numbers[c][g])
            })
        });
        let corrections = std::array::from_fn(|c| {
            let [farther, zero, nearer] = self.corrections[c];
            let prior = prior_corrections[c];
            [hazard(zero, farther + zero + nearer, prior[0]), hazard(nearer, farther + nearer, prior[1])]
        });
        Model::new(levels, refiners, numbers, corrections)
    }
}

#[cfg(test)]
mod tests {
    use super::super::tables::class;
    use super::*;
    use crate::rans::Encoder;

    #[test]
    fn counts_tell_what_their_numbers_cost_with_tables_made_of_them() {
        let mut counts = Counts::default();
        let mut dice = 1u64;
        let mut roll = || {
            dice = dice.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (dice >> 33) as f64 / f64::from(1u32 << 31)
        };
        // About as large as their classes say; now and then far off.
        let (classes, numbers): (Vec<u8>, Vec<i32>) = (0..60_000)
            .map(|i| {
                let mean = 0.05 * f64::from(1 << (i % 12));
                let far = if i % 1000 == 0 { 100.0 } else { 1.0 };
                let magnitude = -(1.0 - roll()).ln() * mean * far;
                let number = if roll() < 0.5 { -magnitude } else { magnitude };
                (class(mean as f32), number.round() as i32)
            })
            .unzip();
        for (class, number) in classes.iter().zip(&numbers) {
            counts.add(*class, *number);
        }
        let model = counts.model(vec![[Kernel::default(); 2]], vec![[Refiner::default(); REFINER_PASSES]]);
        let mut coder = Encoder::default();
        model.tables().encode(&mut coder, &classes, &numbers);
        let (told, sent) = (counts.bits(), coder.bits());
        assert!((told / sent - 1.0).abs() < 0.03, "{told} bits told, {sent} sent");
    }

    #[test]
    fn counts_of_a_class_make_what_is_frequent_cheap() {
        let mut counts = Counts::default();
        let usual = class(0.1);
        for i in 0..10_000 {
            counts.add(usual, i32::from(i % 100 == 0));
        }
        let tables = counts.model(vec![[Kernel::default(); 2]], vec![[Refiner::default(); REFINER_PASSES]]);
        let cost = |value| {
            let mut coder = Encoder::default();
            tables.tables().encode(&mut coder, &[usual], &[value]);
            coder.bits()
        };
        assert!(
            cost(0) < 0.02 && (7.0..9.0).contains(&cost(1)) && cost(-1) == cost(1),
            "{} {}",
            cost(0),
            cost(1)
        );
    }
}
