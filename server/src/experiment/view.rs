//! What an observer sees of a field: a small software renderer, for counting pixels that change.
//!
//! Each column of the picture is one profile: going away from the eye, every height that rises above all nearer
//! ones fills the pixels up to it, shaded by the surface's slope there and paler with distance. No overhangs,
//! no anti-aliasing, no GPU; the same on every machine but for the last bit of sines.

use super::field::Field;
use diamantina_protocol::bintree::Point;

/// Where the eye is and where it looks.
#[derive(Debug, Clone, Copy)]
pub struct Eye {
    /// Samples from the south-west corner.
    pub at: [f64; 2],
    /// Metres above the same datum as the heights.
    pub height: f64,
    /// Samples from the south-west corner of what is in the middle of the picture.
    pub towards: [f64; 2],
    /// Metres up for a metre ahead, in the middle of the picture. Uprights stay upright, as with a shifted lens.
    pub rise: f64,
}

/// A picture in shades of grey, rows from the top.
#[derive(Debug, Clone)]
pub struct View {
    /// Pixels, 0 black to 255 white.
    pub pixels: Vec<u8>,
    /// By sample of the field, whether something of its cells is seen.
    pub seen: Vec<bool>,
}

/// Pixels across and down.
pub const SIZE: [usize; 2] = [690, 384];
/// Tangent of half the angle across: 60 degrees.
const HALF_ANGLE: f64 = 0.577;
/// Shades of 255 up to which a pixel counts as the same.
const CHANGED: u8 = 8;
/// Light from the north-west, half-way up.
const LIGHT: [f64; 3] = [-0.5, 0.5, 0.707];

/// The heights of a triangle mesh at every sample that it covers; NaN elsewhere, and where a corner has no
/// data. Corners are samples, turning left.
#[must_use]
pub fn surface(field: &Field, triangles: &[[Point; 3]]) -> Vec<f64> {
    let mut heights = vec![f64::NAN; field.heights().len()];
    for corners in triangles {
        let z = corners.map(|p| field.at(p));
        let [a, c, b] = corners.map(|p| p.map(i64::from));
        let turn = |u: [i64; 2], v: [i64; 2], p: [i64; 2]| {
            (v[0] - u[0]) * (p[1] - u[1]) - (v[1] - u[1]) * (p[0] - u[0])
        };
        let whole = turn(a, c, b) as f64;
        let span = |axis: usize| {
            let values = corners.map(|p| p[axis]);
            values.into_iter().min().unwrap_or(0)..=values.into_iter().max().unwrap_or(0)
        };
        for y in span(1) {
            for x in span(0) {
                let p = [i64::from(x), i64::from(y)];
                let parts = [turn(c, b, p), turn(b, a, p), turn(a, c, p)];
                if parts.iter().all(|part| *part >= 0) {
                    let sum: f64 = parts.iter().zip(z).map(|(part, z)| *part as f64 * z).sum();
                    heights[field.slot([x, y])] = sum / whole;
                }
            }
        }
    }
    heights
}

/// Draws heights, given for each sample of the field (NaN: nothing there), as the eye sees them.
#[must_use]
pub fn render(field: &Field, heights: &[f64], eye: Eye) -> View {
    let [width, height] = SIZE;
    let mut view = View { pixels: vec![235; width * height], seen: vec![false; heights.len()] };
    let [dx, dy] = field.cell();
    let ahead = [(eye.towards[0] - eye.at[0]) * dx, (eye.towards[1] - eye.at[1]) * dy];
    let length = ahead[0].hypot(ahead[1]).max(f64::MIN_POSITIVE);
    let ahead = [ahead[0] / length, ahead[1] / length];
    for column in 0..width {
        let aside = HALF_ANGLE * (2.0 * (column as f64 + 0.5) / width as f64 - 1.0);
        // Metres along x and y for each metre of depth.
        let ray = [ahead[0] + aside * ahead[1], ahead[1] - aside * ahead[0]];
        draw_column(field, heights, eye, ray, column, &mut view);
    }
    view
}

fn draw_column(field: &Field, heights: &[f64], eye: Eye, ray: [f64; 2], column: usize, view: &mut View) {
    let [width, height] = SIZE;
    let focal = width as f64 / (2.0 * HALF_ANGLE);
    let step = 0.5 * field.cell()[0].min(field.cell()[1]);
    let far = f64::from(field.side()) * field.cell()[0].hypot(field.cell()[1]);
    let (mut filled, mut depth) = (height, step);
    while depth < far && filled > 0 {
        let place = [0, 1].map(|i| eye.at[i] + ray[i] * depth / field.cell()[i]);
        if let Some((h, slope, slot)) = sample(field, heights, place) {
            let row = 0.5 * height as f64 - focal * ((h - eye.height) / depth - eye.rise);
            #[allow(
                clippy::cast_possible_truncation,
                clippy::cast_sign_loss,
                reason = "clamped to the picture"
            )]
            let top = row.clamp(0.0, height as f64) as usize;
            if top < filled {
                let shade = shade(slope, depth / far);
                (top..filled).for_each(|y| view.pixels[y * width + column] = shade);
                filled = top;
                view.seen[slot] = true;
            }
        }
        depth += step.max(depth / 800.0);
    }
}

/// Height, slopes in metres a metre, and the nearest sample at a place in samples; `None` outside of the data.
fn sample(field: &Field, heights: &[f64], [x, y]: [f64; 2]) -> Option<(f64, [f64; 2], usize)> {
    let last = f64::from(field.side());
    if !(0.0..last).contains(&x) || !(0.0..last).contains(&y) {
        return None;
    }
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "inside of the field")]
    let (i, j) = (x as usize, y as usize);
    let slot = j * field.row() + i;
    let [sw, se, nw, ne] = [slot, slot + 1, slot + field.row(), slot + field.row() + 1].map(|s| heights[s]);
    let (u, v) = (x - i as f64, y - j as f64);
    let h = (sw * (1.0 - u) + se * u) * (1.0 - v) + (nw * (1.0 - u) + ne * u) * v;
    let east = ((se - sw) * (1.0 - v) + (ne - nw) * v) / field.cell()[0];
    let north = ((nw - sw) * (1.0 - u) + (ne - se) * u) / field.cell()[1];
    let nearest = slot + usize::from(u > 0.5) + if v > 0.5 { field.row() } else { 0 };
    (!h.is_nan()).then_some((h, [east, north], nearest))
}

/// The shade of a slope, in metres a metre, at a distance as a share of the farthest.
pub(super) fn shade([east, north]: [f64; 2], distance: f64) -> u8 {
    let normal = 1.0 / (1.0 + east * east + north * north).sqrt();
    let light = (normal * (LIGHT[2] - LIGHT[0] * east - LIGHT[1] * north)).max(0.0);
    let fog = 0.6 * distance.min(1.0);
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "from 0 to 255")]
    let shade = ((30.0 + 200.0 * light) * (1.0 - fog) + 235.0 * fog).clamp(0.0, 255.0) as u8;
    shade
}

/// Percent of the pixels that differ by more than 8 of 255 shades, and the mean difference in shades.
#[must_use]
pub fn difference(a: &View, b: &View) -> [f64; 2] {
    let n = a.pixels.len() as f64;
    let apart = || a.pixels.iter().zip(&b.pixels).map(|(p, q)| p.abs_diff(*q));
    let changed = apart().filter(|d| *d > CHANGED).count() as f64;
    [100.0 * changed / n, apart().map(f64::from).sum::<f64>() / n]
}

/// The first picture, paler, with red where the second differs by more than 8 of 255 shades, as PNG.
///
/// # Errors
/// Never in practice: it is written to memory.
pub fn changes(a: &View, b: &View) -> Result<Vec<u8>, png::EncodingError> {
    let pixel = |(p, q): (&u8, &u8)| {
        let pale = 128 + p / 2;
        if p.abs_diff(*q) > CHANGED { [200, 0, 0] } else { [pale; 3] }
    };
    let pixels: Vec<u8> = a.pixels.iter().zip(&b.pixels).flat_map(pixel).collect();
    encoded(SIZE, png::ColorType::Rgb, &pixels)
}

/// The picture as PNG.
///
/// # Errors
/// Never in practice: it is written to memory.
pub fn png(view: &View) -> Result<Vec<u8>, png::EncodingError> {
    encoded(SIZE, png::ColorType::Grayscale, &view.pixels)
}

/// Pixels of a byte a channel as PNG, rows from the top.
pub(super) fn encoded(
    size: [usize; 2],
    colour: png::ColorType,
    pixels: &[u8],
) -> Result<Vec<u8>, png::EncodingError> {
    let mut bytes = Vec::new();
    let [width, height] = size.map(|v| u32::try_from(v).unwrap_or(u32::MAX));
    let mut encoder = png::Encoder::new(&mut bytes, width, height);
    encoder.set_color(colour);
    encoder.set_depth(png::BitDepth::Eight);
    encoder.write_header()?.write_image_data(pixels)?;
    Ok(bytes)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn eye() -> Eye {
        Eye { at: [16.0, 1.0], height: 40.0, towards: [16.0, 32.0], rise: 0.0 }
    }

    #[test]
    fn a_rise_moves_the_picture_down() {
        let mut heights = vec![0.0; 33 * 33];
        heights[30 * 33..31 * 33].fill(200.0);
        let field = Field::new(5, heights, [30.0, 30.0]).unwrap();
        let sky = |rise: f64| {
            let view = render(&field, field.heights(), Eye { rise, ..eye() });
            (0..SIZE[1]).take_while(|y| view.pixels[y * SIZE[0] + SIZE[0] / 2] == 235).count()
        };
        let focal = SIZE[0] as f64 / (2.0 * HALF_ANGLE);
        assert!(sky(0.0) < SIZE[1] / 2, "above the horizon");
        let moved = sky(0.2) as f64 - sky(0.0) as f64;
        assert!((moved - 0.2 * focal).abs() <= 1.0, "{moved}");
    }

    #[test]
    fn a_hill_hides_what_is_behind_it() {
        let mut heights = vec![0.0; 33 * 33];
        heights[10 * 33..11 * 33].fill(90.0);
        let field = Field::new(5, heights, [30.0, 30.0]).unwrap();
        let view = render(&field, field.heights(), eye());
        assert!(view.seen[9 * 33 + 16] || view.seen[10 * 33 + 16]);
        assert!((13..33).all(|y| !view.seen[y * 33 + 16]));
        assert_eq!(difference(&view, &view), [0.0, 0.0]);
        // Only what is hidden changes: nobody sees it. In front of the hill, everybody.
        let mut changed = field.heights().to_vec();
        changed[20 * 33 + 16] = 30.0;
        assert_eq!(difference(&view, &render(&field, &changed, eye())), [0.0, 0.0]);
        changed[5 * 33 + 16] = 30.0;
        assert!(difference(&view, &render(&field, &changed, eye()))[0] > 1.0);
    }

    #[test]
    fn a_mesh_of_a_plane_is_the_plane() {
        let heights: Vec<f64> = (0..81).map(|s| f64::from(s % 9 * 3 + s / 9 * 2)).collect();
        let field = Field::new(3, heights, [1.0, 1.0]).unwrap();
        let mesh = [[[0, 0], [8, 0], [0, 8]], [[8, 8], [0, 8], [8, 0]]];
        assert_eq!(surface(&field, &mesh), field.heights());
    }
}
