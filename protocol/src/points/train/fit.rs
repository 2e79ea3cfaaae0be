//! Weighted least squares.

/// Weighted least squares in N unknowns.
#[derive(Clone)]
pub(super) struct Fit<const N: usize> {
    matrix: [[f64; N]; N],
    right: [f64; N],
    count: f64,
}

impl<const N: usize> Fit<N> {
    pub(super) fn new() -> Self {
        Self { matrix: [[0.0; N]; N], right: [0.0; N], count: 0.0 }
    }

    pub(super) fn add(&mut self, parts: &[f64; N], value: f64, weight: f64) {
        for (i, row) in self.matrix.iter_mut().enumerate() {
            let part = weight * parts[i];
            for (entry, other) in row.iter_mut().zip(parts) {
                *entry += part * other;
            }
            self.right[i] += part * value;
        }
        self.count += 1.0;
    }

    /// The sum of the weighted squares of each part.
    pub(super) fn diagonal(&self) -> [f64; N] {
        std::array::from_fn(|i| self.matrix[i][i])
    }

    /// Adds to an unknown's square, and to what it is multiplied by.
    pub(super) fn pull(&mut self, unknown: usize, square: f64, product: f64) {
        self.matrix[unknown][unknown] += square;
        self.right[unknown] += product;
    }

    /// The solution, drawn towards `prior` as strongly as a hundred of what was added would.
    pub(super) fn solve(mut self, prior: &[f64; N]) -> [f64; N] {
        const PRIOR_SAMPLES: f64 = 100.0;
        if self.count == 0.0 {
            return *prior;
        }
        for (i, prior) in prior.iter().enumerate() {
            let pull = (self.matrix[i][i] * PRIOR_SAMPLES / self.count).max(1e-12);
            self.matrix[i][i] += pull;
            self.right[i] += pull * prior;
        }
        self.eliminate().unwrap_or(*prior)
    }

    /// The solution, its unknowns held back by `damping` times what each one weighs in the sum of squares.
    pub(super) fn solve_damped(mut self, damping: f64) -> Option<[f64; N]> {
        for i in 0..N {
            self.matrix[i][i] += self.matrix[i][i] * damping + 1e-9;
        }
        self.eliminate()
    }

    /// Gaussian elimination, the largest pivots first; `None` where it leaves the finite numbers.
    fn eliminate(mut self) -> Option<[f64; N]> {
        for i in 0..N {
            let pivot = (i..N)
                .max_by(|a, b| self.matrix[*a][i].abs().total_cmp(&self.matrix[*b][i].abs()))
                .unwrap_or(i);
            self.matrix.swap(i, pivot);
            self.right.swap(i, pivot);
            for j in i + 1..N {
                let factor = self.matrix[j][i] / self.matrix[i][i];
                for k in i..N {
                    self.matrix[j][k] -= factor * self.matrix[i][k];
                }
                self.right[j] -= factor * self.right[i];
            }
        }
        let mut solution = [0.0; N];
        for i in (0..N).rev() {
            let known: f64 = (i + 1..N).map(|k| self.matrix[i][k] * solution[k]).sum();
            solution[i] = (self.right[i] - known) / self.matrix[i][i];
        }
        solution.iter().all(|w| w.is_finite()).then_some(solution)
    }
}

/// A weight as a whole number of 1/scale.
pub(super) fn fixed(weight: f64, scale: f64) -> i16 {
    (weight * scale).round().clamp(f64::from(i16::MIN), f64::from(i16::MAX)) as i16
}

/// The weight of what is expected to be so far off. (`powi` may differ from platform to platform.)
pub(super) fn inverse_square(expected: f64) -> f64 {
    1.0 / (expected * expected)
}
