//! Simplification by local curvature: a restricted quadtree with templates.
//!
//! The curvature of a sample is a norm of how its gradient changes from neighbour to neighbour. With centred
//! differences G_x = (h[i+1,j] - h[i-1,j]) / 2 dx, and G_y likewise,
//!
//! ```text
//! kappa^2 = (G_x[i+1,j] - G_x[i-1,j])^2 + (G_y[i+1,j] - G_y[i-1,j])^2
//!         + (G_x[i,j+1] - G_x[i,j-1])^2 + (G_y[i,j+1] - G_y[i,j-1])^2
//! ```
//!
//! A quadrant splits while the sum of its curvatures is more than a threshold T; from an observer's place,
//! while it is at least T (a d / D + 1), d being the distance to the quadrant's centre and D the field's
//! diagonal; behind a mask, each sample's curvature counts by its visibility. [`quadtree`] splits and
//! balances, [`templates`] triangulates.
//!
//! After the curvature paper, its equations 1 to 6.

pub mod quadtree;
pub mod templates;

use super::field::Field;

/// Each sample's curvature, rows from the south; no unit (slopes). At borders, and beside samples without
/// data, differences are taken as far as there are heights; 0 where there is no height, or no two of them.
#[must_use]
pub fn curvatures(field: &Field) -> Vec<f64> {
    let gradients = [0, 1].map(|axis| difference(field, field.heights(), axis, true));
    let mut squares = vec![0.0; field.heights().len()];
    for gradient in &gradients {
        for axis in [0, 1] {
            for (square, d) in squares.iter_mut().zip(difference(field, gradient, axis, false)) {
                // Unknown differences bend nothing.
                *square += if d.is_nan() { 0.0 } else { d * d };
            }
        }
    }
    let known = field.heights().iter().map(|h| if h.is_nan() { 0.0 } else { 1.0 });
    squares.iter().zip(known).map(|(square, known)| square.sqrt() * known).collect()
}

/// Value after less value before along an axis, over their distance in metres if `per_metre`.
fn difference(field: &Field, values: &[f64], axis: usize, per_metre: bool) -> Vec<f64> {
    let (row, step) = (field.row(), if axis == 0 { 1 } else { field.row() });
    (0..values.len())
        .map(|slot| {
            let place = if axis == 0 { slot % row } else { slot / row };
            let before = Some(slot.wrapping_sub(step)).filter(|s| place > 0 && !values[*s].is_nan());
            let after = Some(slot + step).filter(|s| place + 1 < row && !values[*s].is_nan());
            let steps = f64::from(u8::from(before.is_some()) + u8::from(after.is_some()));
            let d = values[after.unwrap_or(slot)] - values[before.unwrap_or(slot)];
            match (per_metre, steps > 0.0) {
                (_, false) => f64::NAN,
                (true, _) => d / (steps * field.cell()[axis]),
                (false, _) => d,
            }
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn planes_have_no_curvature_and_a_parabola_has_the_equations() {
        let row = 17;
        let plane: Vec<f64> = (0..row * row).map(|s| (s % row * 3 + s / row * 5) as f64).collect();
        let field = Field::new(4, plane, [10.0, 20.0]).unwrap();
        assert!(curvatures(&field).iter().all(|k| *k == 0.0));
        // h = x^2 in samples 10 m apart: G_x = 4 i / 20, so it changes by 0.4 over two samples.
        let parabola: Vec<f64> = (0..row * row).map(|s| ((s % row) * (s % row)) as f64).collect();
        let field = Field::new(4, parabola, [10.0, 20.0]).unwrap();
        let found = curvatures(&field)[8 * row + 8];
        assert!((found - 0.4).abs() < 1e-12, "{found}");
    }

    #[test]
    fn nodata_bends_nothing() {
        let mut heights = vec![5.0; 25];
        heights[12] = f64::NAN;
        let field = Field::new(2, heights, [1.0, 1.0]).unwrap();
        assert!(curvatures(&field).iter().all(|k| *k == 0.0));
    }
}
