//! Averages of colours: of light, not of the numbers that stand for it, and by how opaque each is.
//!
//! sRGB numbers are about square roots of light (IEC 61966-2-1): their mean is darker than what one sees of the same
//! texels from farther away, and fine patterns would darken from level to level.

use diamantina_protocol::texture;

/// Steps of the table that leads back to sRGB: at the dark end, where it is steepest, a step is 0.8 of a number.
const STEPS: usize = 4096;

/// Tables from sRGB to light and back.
pub(super) struct Averages {
    light: [f32; 256],
    srgb: Vec<u8>,
}

impl Averages {
    pub(super) fn new() -> Self {
        #[expect(clippy::cast_possible_truncation, reason = "24 bits are enough for 8")]
        let light = std::array::from_fn(|srgb| texture::light(srgb as f64 / 255.0) as f32);
        #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "from 0 to 255")]
        let encoded = |step: usize| (texture::srgb(step as f64 / STEPS as f64) * 255.0).round() as u8;
        let srgb = (0..=STEPS).map(encoded).collect();
        Self { light, srgb }
    }

    /// Of the first `within` texels along x and y of some rows, each two by two; where there is no second one, the first
    /// counts alone. Row by row.
    pub(super) fn halve(&self, rows: &[&[[u8; 4]]], [width, height]: [usize; 2]) -> Vec<[u8; 4]> {
        let mut halved = Vec::with_capacity(width.div_ceil(2) * height.div_ceil(2));
        for pair in rows[..height].chunks(2) {
            for x in (0..width).step_by(2) {
                let texels = pair.iter().flat_map(|row| &row[x..width.min(x + 2)]);
                halved.push(self.average(texels));
            }
        }
        halved
    }

    fn average<'a>(&self, texels: impl Iterator<Item = &'a [u8; 4]>) -> [u8; 4] {
        let (mut sums, mut opacity, mut count) = ([0.0f32; 3], 0u32, 0u32);
        for [r, g, b, a] in texels {
            let weight = f32::from(*a);
            for (sum, colour) in sums.iter_mut().zip([r, g, b]) {
                *sum += weight * self.light[*colour as usize];
            }
            opacity += u32::from(*a);
            count += 1;
        }
        if opacity == 0 {
            return [0; 4];
        }
        let [r, g, b] = sums.map(|sum| {
            let light = sum / opacity as f32;
            #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "from 0 to STEPS")]
            let step = (light * STEPS as f32).round() as usize;
            self.srgb[step.min(STEPS)]
        });
        // Something is left of something.
        let opacity = ((opacity + count / 2) / count).max(1);
        [r, g, b, u8::try_from(opacity).unwrap_or(u8::MAX)]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_colour_stays_itself() {
        let averages = Averages::new();
        for value in 0..=255u8 {
            let texel = [value, 255 - value, 7, 255];
            let halved = averages.halve(&[&[texel; 4], &[texel; 4]], [4, 2]);
            for (found, expected) in halved.iter().flatten().zip([texel; 2].iter().flatten()) {
                // The table's steps are as wide as a number at the dark end.
                assert!(found.abs_diff(*expected) <= u8::from(*expected < 10), "{value}: {halved:?}");
            }
        }
    }

    #[test]
    fn black_and_white_make_half_the_light() {
        let averages = Averages::new();
        let halved = averages.halve(&[&[[0, 0, 0, 255], [255, 255, 255, 255]]], [2, 1]);
        assert_eq!(halved, [[188, 188, 188, 255]]);
    }

    #[test]
    fn what_is_transparent_lends_no_colour_and_what_is_beyond_does_not_count() {
        let averages = Averages::new();
        let rows: [&[[u8; 4]]; 2] =
            [&[[200, 10, 10, 255], [0; 4], [9, 9, 9, 255]], &[[0; 4], [0; 4], [9, 9, 9, 255]]];
        assert_eq!(averages.halve(&rows, [3, 2]), [[200, 10, 10, 64], [9, 9, 9, 255]]);
        assert_eq!(averages.halve(&rows, [1, 1]), [[200, 10, 10, 255]]);
    }
}
