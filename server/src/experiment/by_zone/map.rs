//! A mask as a picture.

use super::super::field::Field;
use super::super::view;
use diamantina_protocol::bintree::Point;

/// The mask over the shaded ground, north up.
pub(super) fn draw(field: &Field, mask: &[u8], own: &[(Point, f64)]) -> Result<Vec<u8>, png::EncodingError> {
    let row = field.row();
    let mut pixels = vec![[0u8; 3]; row * row];
    for (slot, pixel) in pixels.iter_mut().enumerate() {
        let [x, y] = field.point(slot);
        let [before, after] = [x.saturating_sub(1), (x + 1).min(field.side())];
        let [below, above] = [y.saturating_sub(1), (y + 1).min(field.side())];
        let east =
            (field.at([after, y]) - field.at([before, y])) / (f64::from(after - before) * field.cell()[0]);
        let north =
            (field.at([x, above]) - field.at([x, below])) / (f64::from(above - below) * field.cell()[1]);
        let share = f64::from(mask[slot]) / 255.0;
        if !east.is_nan() && !north.is_nan() {
            let shade = f64::from(view::shade([east, north], 0.0));
            let lit =
                [0.30 + 0.70 * share, 0.30 + 0.66 * share, 0.34 + 0.46 * share].map(|part| part * shade);
            #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "from 0 to 255")]
            let lit = lit.map(|v| v as u8);
            *pixel = lit;
        }
    }
    own.iter().for_each(|(p, _)| pixels[field.slot(*p)] = [40, 90, 170]);
    let northern_first: Vec<u8> = pixels.chunks(row).rev().flatten().flatten().copied().collect();
    view::encoded([row; 2], png::ColorType::Rgb, &northern_first)
}
