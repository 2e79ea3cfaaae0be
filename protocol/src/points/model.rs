//! What a scene's numbers look like: kernels that predict heights, and how large a difference is likely to be.
//!
//! A model is small and goes with the scene's description, so that no diamond pays for learning it. Every
//! parameter is a whole number of fixed scale; from them both ends compute the same probabilities, in
//! [tables](super::tables).

use super::tables::{CLASSES, CORRECTION_CLASSES, HAZARDS, TILTS, Tables, default_hazards};
use crate::rans::TOTAL;
use serde::{Deserialize, Serialize};
use std::sync::{Arc, OnceLock};

/// Weights of kernels and activities are whole numbers of this part.
const WEIGHT: f32 = 1.0 / 4096.0;

/// Weights of causal neighbours are whole numbers of 2^-CAUSAL_BITS.
pub const CAUSAL_BITS: u32 = 8;

/// How the new points of a level are predicted, in one of the two ways in which a local grid lies on the
/// lattice (turned by a half or a quarter).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Kernel {
    /// Weights, in 1/4096, of what the pairs of opposite old points around a cell differ from the mean of
    /// the nearest four; the first one weighs the difference between the two pairs of nearest.
    pub pairs: [i16; PAIRS],
    /// Weights, in 1/256, of what was missing at the new points to the south, south-west, south-east and
    /// west.
    pub causal: [i16; 4],
    /// Weights, in 1/4096, of the cell's twist, the second differences at its corners, its spread, the
    /// numbers in the row below, and a constant: together the activity.
    pub activity: [i16; 5],
}

/// Pairs of a kernel; see `rows`.
pub const PAIRS: usize = 7;

impl Default for Kernel {
    /// The quincunx interpolation of Neville type (Kovacevic and Sweldens 2000): (10 * sum of the 4 nearest
    /// - sum of the 8 next) / 32; and activities as they are on average on terrain.
    fn default() -> Self {
        Self {
            pairs: [0, 0, 0, -128, -128, -128, -128],
            causal: [0, 0, 0, 0],
            activity: [60, 40, 40, 120, 900],
        }
    }
}

impl Kernel {
    /// The weights of pairs as numbers.
    #[must_use]
    pub fn pairs(&self) -> [f32; PAIRS] {
        self.pairs.map(|w| f32::from(w) * WEIGHT)
    }

    /// The weights of the activity as numbers.
    #[must_use]
    pub fn activity(&self) -> [f32; 5] {
        self.activity.map(|w| f32::from(w) * WEIGHT)
    }
}

/// What is expected of the corrections of a level in one of its passes; see `corrections`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Refiner {
    /// Weights, in 1/4096, of what the neighbours differ: the place where a point is expected.
    pub tilt: [i16; TILT_PARTS],
    /// Weights, in 1/4096, of how the neighbours differ among themselves, and of a step: how far off that
    /// place may be.
    pub spread: [i16; SPREAD_PARTS],
}

/// Passes over the points that a split corrects, each with weights of its own.
pub const REFINER_PASSES: usize = 3;
/// Parts of the place where a point is expected.
pub const TILT_PARTS: usize = 10;
/// Parts of how far off it may be; the last one is a constant.
pub const SPREAD_PARTS: usize = 5;

impl Default for Refiner {
    /// The mean of the four neighbours.
    fn default() -> Self {
        Self { tilt: [1024, 1024, 1024, 0, 0, 0, 0, 0, 0, 0], spread: [600, 400, 200, 0, 1200] }
    }
}

impl Refiner {
    /// The weights as numbers.
    #[must_use]
    pub fn tilt(&self) -> [f32; TILT_PARTS] {
        self.tilt.map(|w| f32::from(w) * WEIGHT)
    }

    /// The weights as numbers.
    #[must_use]
    pub fn spread(&self) -> [f32; SPREAD_PARTS] {
        self.spread.map(|w| f32::from(w) * WEIGHT)
    }
}

/// The model of a layer.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "ModelParts", into = "ModelParts")]
pub struct Model {
    /// Kernels by level; beyond the last one, that of the same parity before it.
    levels: Vec<[Kernel; 2]>,
    /// By level; beyond the last one, the last.
    refiners: Vec<[Refiner; REFINER_PASSES]>,
    numbers: [[u16; HAZARDS]; CLASSES],
    corrections: [[u16; 2]; CORRECTION_CLASSES],
    tables: Lazy,
}

/// Tables that are made when they are first asked for: they take 0.8 MB, and of a series' steps few are decoded.
#[derive(Debug, Clone, Default)]
struct Lazy(Arc<OnceLock<Tables>>);

impl PartialEq for Lazy {
    /// They follow from the hazards.
    fn eq(&self, _: &Self) -> bool {
        true
    }
}

impl Eq for Lazy {}

#[derive(Clone, Serialize, Deserialize)]
struct ModelParts {
    levels: Vec<[Kernel; 2]>,
    /// None where nothing was learnt.
    refiners: Vec<Option<[Refiner; REFINER_PASSES]>>,
    numbers: Vec<[u16; HAZARDS]>,
    corrections: Vec<[u16; 2]>,
}

/// Why numbers are not a model.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum ModelError {
    /// A list is not as long as it has to be.
    #[error("model with {found} {what}: expected {expected}; reload the scene")]
    Count {
        /// What is counted.
        what: &'static str,
        /// How many there are.
        found: usize,
        /// How many there have to be.
        expected: usize,
    },
    /// A hazard is no probability.
    #[error("hazard {0}: expected 1 to {max}; reload the scene", max = TOTAL - 1)]
    Hazard(u16),
}

impl TryFrom<ModelParts> for Model {
    type Error = ModelError;
    fn try_from(p: ModelParts) -> Result<Self, ModelError> {
        let count = |what, found, expected| ModelError::Count { what, found, expected };
        for found in [p.levels.len(), p.refiners.len()] {
            if !(1..=64).contains(&found) {
                return Err(count("levels", found, 64));
            }
        }
        let numbers = <[_; CLASSES]>::try_from(p.numbers);
        let numbers = numbers.map_err(|v| count("classes of numbers", v.len(), CLASSES))?;
        let corrections = <[_; CORRECTION_CLASSES]>::try_from(p.corrections);
        let corrections =
            corrections.map_err(|v| count("classes of corrections", v.len(), CORRECTION_CLASSES))?;
        let all = numbers.iter().flatten().chain(corrections.iter().flatten());
        if let Some(bad) = all.copied().find(|h| !(1..TOTAL as u16).contains(h)) {
            return Err(ModelError::Hazard(bad));
        }
        let refiners = p.refiners.into_iter().map(Option::unwrap_or_default).collect();
        Ok(Self::new(p.levels, refiners, numbers, corrections))
    }
}

impl From<Model> for ModelParts {
    fn from(m: Model) -> Self {
        let (numbers, corrections) = (m.numbers.to_vec(), m.corrections.to_vec());
        let learnt = |r: [Refiner; REFINER_PASSES]| (r != [Refiner::default(); REFINER_PASSES]).then_some(r);
        let refiners = m.refiners.into_iter().map(learnt).collect();
        Self { levels: m.levels, refiners, numbers, corrections }
    }
}

impl Default for Model {
    fn default() -> Self {
        let numbers = std::array::from_fn(default_hazards);
        // A correction is one of three: even odds first, then two to one for the nearer side.
        let corrections = std::array::from_fn(|c| {
            let tilt = (c % TILTS) as u16;
            [1400, 2048 + 180 * tilt]
        });
        Self::new(
            vec![[Kernel::default(); 2]],
            vec![[Refiner::default(); REFINER_PASSES]],
            numbers,
            corrections,
        )
    }
}

impl Model {
    /// From kernels and refiners (of at least one level), hazards by class, and those of corrections; hazards
    /// in 1..[`TOTAL`].
    #[must_use]
    pub fn new(
        levels: Vec<[Kernel; 2]>,
        refiners: Vec<[Refiner; REFINER_PASSES]>,
        numbers: [[u16; HAZARDS]; CLASSES],
        corrections: [[u16; 2]; CORRECTION_CLASSES],
    ) -> Self {
        Self { levels, refiners, numbers, corrections, tables: Lazy::default() }
    }

    /// With these kernels and refiners, and hazards that know nothing of the layer.
    #[must_use]
    pub fn of_weights(levels: Vec<[Kernel; 2]>, refiners: Vec<[Refiner; REFINER_PASSES]>) -> Self {
        Self { levels, refiners, ..Self::default() }
    }

    /// The refiners of a level.
    #[must_use]
    pub fn refiners(&self, level: u32) -> &[Refiner; REFINER_PASSES] {
        &self.refiners[(level as usize).min(self.refiners.len() - 1)]
    }

    /// The kernel of a level in one of the two ways.
    #[must_use]
    pub fn kernel(&self, level: u32, way: usize) -> &Kernel {
        let (level, last) = (level as usize, self.levels.len() - 1);
        let at = if level <= last { level } else { last - usize::from((level - last) % 2 == 1 && last > 0) };
        &self.levels[at][way]
    }

    /// Leaves its tables to its clones.
    pub(super) fn rest(&mut self) {
        self.tables = Lazy::default();
    }

    /// The tables that the hazards give, which all clones of this share.
    #[must_use]
    pub fn tables(&self) -> &Tables {
        self.tables.0.get_or_init(|| Tables::new(&self.numbers, &self.corrections))
    }

    /// Hazards by class, and those of corrections.
    pub(super) fn hazards(&self) -> (&[[u16; HAZARDS]; CLASSES], &[[u16; 2]; CORRECTION_CLASSES]) {
        (&self.numbers, &self.corrections)
    }

    /// The kernels by level.
    #[must_use]
    pub fn levels(&self) -> &[[Kernel; 2]] {
        &self.levels
    }
}

#[cfg(test)]
mod tests {
    use super::super::counts::Counts;
    use super::super::tables::class;
    use super::*;

    #[test]
    fn a_model_goes_through_its_description_and_damaged_ones_are_refused() {
        let mut counts = Counts::default();
        for i in 0..1000 {
            counts.add(class(2.0), i % 7 - 3);
        }
        let model =
            counts.model(vec![[Kernel::default(); 2]; 5], vec![[Refiner::default(); REFINER_PASSES]; 7]);
        assert_ne!(model, Model::default());
        let text = serde_json::to_string(&model).unwrap();
        assert_eq!(serde_json::from_str::<Model>(&text).unwrap(), model);
        let zero = text.replacen(":[[4", ":[[0,4", 1);
        assert!(serde_json::from_str::<Model>(&zero).is_err());
        let none =
            serde_json::from_str::<Model>(r#"{"levels":[],"refiners":[],"numbers":[],"corrections":[]}"#);
        assert!(none.unwrap_err().to_string().contains("0 levels"));
    }
}
