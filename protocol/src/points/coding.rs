//! What a sender and a receiver agree on for a layer: the rule of prediction, the steps, the model.

#![allow(clippy::cast_possible_truncation, reason = "a layer has fewer than 64 levels")]

use super::model::Model;

/// The largest step, in quanta.
pub const STEP_MAX: u32 = 1 << 21;

/// How a receiver deduces the height of a new point.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Rule {
    /// The mean of the two ends of the hypotenuse: the rule of the bitree papers.
    Midpoint,
    /// A weighted sum of the sixteen old points around and of what was missing at new points before, with
    /// the weights of the layer's [`Model`].
    #[default]
    Smooth,
}

/// What a sender and a receiver agree on for a layer.
#[derive(Debug, Clone, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(try_from = "CodingParts", into = "CodingParts")]
pub struct Coding {
    rule: Rule,
    fine_step: u32,
    exponents: Vec<u8>,
    model: Model,
}

#[derive(Clone, serde::Serialize, serde::Deserialize)]
struct CodingParts {
    rule: Rule,
    fine_step: u32,
    exponents: Vec<u8>,
    model: Model,
}

/// Why numbers do not describe a coding.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum CodingError {
    /// The fine step is not 2E+1 for a whole E.
    #[error("fine step of {0} quanta: expected an odd number below {STEP_MAX}")]
    FineStep(u32),
    /// The exponents rise, make a step too large, or are none.
    #[error("exponents {0:?}: expected at least two, none rising, steps below {STEP_MAX}")]
    Exponents(Vec<u8>),
}

impl TryFrom<CodingParts> for Coding {
    type Error = CodingError;
    fn try_from(p: CodingParts) -> Result<Self, CodingError> {
        Ok(Self::new(p.rule, p.fine_step, p.exponents)?.with_model(p.model))
    }
}

impl From<Coding> for CodingParts {
    fn from(c: Coding) -> Self {
        Self { rule: c.rule, fine_step: c.fine_step, exponents: c.exponents, model: c.model }
    }
}

impl Coding {
    /// `fine_step` = 2E+1 quanta; `exponents[0]` is for the root squares' own points, `exponents[l+1]`
    /// for level l. The model is one that knows nothing of the layer.
    ///
    /// # Errors
    /// When the step is even, or the exponents rise or are too large.
    pub fn new(rule: Rule, fine_step: u32, exponents: Vec<u8>) -> Result<Self, CodingError> {
        if fine_step.is_multiple_of(2) || fine_step >= STEP_MAX {
            return Err(CodingError::FineStep(fine_step));
        }
        let fits = |e: u8| {
            3u32.checked_pow(e.into()).and_then(|p| p.checked_mul(fine_step)).is_some_and(|s| s < STEP_MAX)
        };
        if exponents.len() < 2
            || !exponents.is_sorted_by(|a, b| a >= b)
            || !exponents.iter().all(|e| fits(*e))
        {
            return Err(CodingError::Exponents(exponents));
        }
        Ok(Self { rule, fine_step, exponents, model: Model::default() })
    }

    /// The same with a model learnt from the layer.
    #[must_use]
    pub fn with_model(self, model: Model) -> Self {
        Self { model, ..self }
    }

    /// The same, without the tables of 0.8 MB that were made to code by it: they are made again when they are needed.
    #[must_use]
    pub fn rested(&self) -> Self {
        let mut rested = self.clone();
        rested.model.rest();
        rested
    }

    /// The model of predictions and of what they miss.
    #[must_use]
    pub fn model(&self) -> &Model {
        &self.model
    }

    /// The prediction rule.
    #[must_use]
    pub fn rule(&self) -> Rule {
        self.rule
    }

    /// The finest step, 2E+1 quanta.
    #[must_use]
    pub fn fine_step(&self) -> u32 {
        self.fine_step
    }

    /// Levels that these exponents serve; must equal [`crate::bintree::Forest::levels`].
    #[must_use]
    pub fn levels(&self) -> u32 {
        self.exponents.len() as u32 - 1
    }

    /// The step of most points that a split at `level` adds or corrects, in quanta.
    #[must_use]
    pub fn level_step(&self, level: u32) -> u32 {
        self.step(self.exponent(level, Place::Off)).cast_unsigned()
    }

    pub(super) fn step(&self, exponent: u8) -> i32 {
        (self.fine_step * 3u32.pow(exponent.into())).cast_signed()
    }

    /// The exponent of the root squares' own points.
    pub(super) fn first_exponent(&self) -> u8 {
        self.exponents[0]
    }

    pub(super) fn level_exponent(&self, level: u32) -> u8 {
        self.exponents.get(level as usize + 1).copied().unwrap_or(0)
    }

    /// The exponent with which a split at `level` leaves a point strictly inside the diamond.
    ///
    /// Points off both diagonals lie strictly inside a diamond of the next level, those on a diagonal
    /// inside one of the level after it, and the centre inside none: whoever is last gives the fine step.
    /// The diagonals become the sides of the next level's diamonds, and have its step in advance: with a
    /// coarser one, the few points there would keep the error of all that is drawn at that level.
    pub(super) fn exponent(&self, level: u32, place: Place) -> u8 {
        match place {
            Place::Off if level + 1 < self.levels() => self.level_exponent(level),
            Place::Hypotenuse | Place::OtherDiagonal if level + 2 < self.levels() => {
                self.level_exponent(level + 1)
            }
            _ => 0,
        }
    }

    /// The exponent that an old point strictly inside a diamond of `level` has before the split.
    ///
    /// It was last strictly inside a parent, off its diagonals, or, on the hypotenuse (the parents' border), on
    /// a diagonal of a grandparent. Both left it the exponent of the level before this one.
    pub(super) fn exponent_before(&self, level: u32, place: Place) -> u8 {
        let since = match place {
            Place::Hypotenuse | Place::Centre => 2,
            Place::OtherDiagonal | Place::Off => 1,
        };
        if level >= since { self.level_exponent(level - 1) } else { self.first_exponent() }
    }
}

/// Where a point lies in its diamond.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Place {
    Centre,
    Hypotenuse,
    OtherDiagonal,
    Off,
}

/// The place of a point at doubled local coordinates.
pub(super) fn place(n: usize, p: usize, q: usize) -> Place {
    match (p == q, p + q == 2 * n) {
        (true, true) => Place::Centre,
        (true, false) => Place::Hypotenuse,
        (false, true) => Place::OtherDiagonal,
        (false, false) => Place::Off,
    }
}
