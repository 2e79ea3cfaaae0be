//! A picture of the made landscape as if taken from the air: forests, fields, rock, snow, and the light of the day on them.

use super::{CELL, CORNER, EPSG, LAND, fade, hash, height, hills};
use rayon::prelude::*;
use std::fs::File;
use std::io::BufWriter;
use std::path::Path;
use std::sync::LazyLock;
use tiff::encoder::{TiffEncoder, colortype};
use tiff::tags::Tag;

/// Texels along each side of a sample of heights, where that makes no more than `SIDE_MAX` in all.
const FINER: u32 = 2;

/// Texels along each side of the picture, at most: 50 MB, not compressed.
const SIDE_MAX: u32 = 4096;

/// Rows that are made and written at once.
const ROWS: u32 = 64;

/// Metres of a field, more or less.
const FIELD: f64 = 260.0;

type Colour = [f64; 3];

const SAND: Colour = [196.0, 180.0, 140.0];
const FOREST: Colour = [46.0, 68.0, 38.0];
const MEADOW: Colour = [104.0, 118.0, 66.0];
const ROCK: Colour = [112.0, 104.0, 96.0];
const SNOW: Colour = [236.0, 240.0, 246.0];
/// What grows on fields.
const CROPS: [Colour; 6] = [
    [122.0, 134.0, 70.0],
    [150.0, 146.0, 86.0],
    [96.0, 122.0, 62.0],
    [172.0, 160.0, 112.0],
    [84.0, 104.0, 58.0],
    [132.0, 112.0, 82.0],
];

fn mix(a: Colour, b: Colour, part: f64) -> Colour {
    std::array::from_fn(|i| a[i] + (b[i] - a[i]) * part)
}

/// The field that a place lies in: the nearest of points strewn over a lattice (Worley 1996); what grows there, and how near
/// the place is to the next field, in parts of one.
fn field(x: f64, y: f64) -> (Colour, f64) {
    let (i, j) = (x.floor() as i32, y.floor() as i32);
    let (mut nearest, mut second, mut crop) = (f64::MAX, f64::MAX, 0.0);
    for (di, dj) in (-1..=1).flat_map(|di| (-1..=1).map(move |dj| (di, dj))) {
        let (i, j) = (i + di, j + dj);
        let strewn = [hash(i, j, 71), hash(i, j, 72)].map(|h| 0.5 + 0.42 * h);
        let distance = (f64::from(i) + strewn[0] - x).hypot(f64::from(j) + strewn[1] - y);
        if distance < nearest {
            (second, nearest, crop) = (nearest, distance, hash(i, j, 73));
        } else {
            second = second.min(distance);
        }
    }
    let number = ((crop * 0.5 + 0.5) * CROPS.len() as f64) as usize;
    (CROPS[number.min(CROPS.len() - 1)], second - nearest)
}

/// The colour at a place, `x` and `y` metres from the south-west, of such a height and slopes.
fn colour([x, y]: [f64; 2], above: f64, [east, north]: [f64; 2]) -> Colour {
    let steep = east.hypot(north);
    let fine = hills(x / 90.0, y / 90.0, 3, 11);
    let wide = hills(x / 1500.0, y / 1500.0, 3, 12);
    let flat = 1.0 - fade((steep - 0.10 - 0.04 * wide) / 0.06);
    let (crop, edge) = field(x / FIELD + 0.3 * y / FIELD, y / FIELD);
    let fields = mix(FOREST, crop, fade(edge / 0.07));
    let mut ground = mix(FOREST, fields, flat * (1.0 - fade((above - 500.0) / 200.0)));
    ground = mix(ground, MEADOW, fade((above - 1000.0 - 160.0 * wide) / 300.0));
    ground = mix(
        ground,
        ROCK,
        fade((steep - 0.62 + 0.1 * fine) / 0.25).max(fade((above - 1500.0 - 120.0 * wide) / 300.0)),
    );
    ground = mix(
        ground,
        SNOW,
        fade((above - 1750.0 - 130.0 * fine - 150.0 * wide + 260.0 * (steep - 0.5).max(0.0)) / 120.0),
    );
    ground = mix(ground, SAND, (1.0 - fade((above - 2.0) / 4.0)) * flat);
    // Afternoon: the sun stands in the north-west.
    let light = (1.0 + 0.55 * (east - north) / (1.0 + steep * steep).sqrt()).clamp(0.45, 1.35);
    let grain = 1.0 + 0.07 * fine + 0.05 * hash(x as i32, y as i32, 13);
    ground.map(|value| value * light * grain)
}

/// Writes the picture of a sample of `samples` a side as a GeoTIFF: two texels along each side of a sample of heights, or 4096
/// in all. It is black in the sea, which it declares as nothing.
///
/// # Errors
/// When the file cannot be written.
pub fn write_imagery(path: &Path, samples: u32) -> Result<(), String> {
    let failed = |e: &dyn std::fmt::Display| {
        let path = path.display();
        format!("{path}: cannot write the sample picture: {e}; free some space or choose another --folder")
    };
    // As with heights: by a worker it would wait for itself.
    LazyLock::force(&LAND);
    let last = f64::from(samples - 1);
    let side = (FINER * (samples - 1)).min(SIDE_MAX);
    let texel = CELL * last / f64::from(side);
    let at = |column: f64, row: f64| {
        height((column + 0.5) * texel / (last * CELL), 1.0 - (row + 0.5) * texel / (last * CELL))
            .map(f64::from)
    };
    let line = |row: u32| -> Vec<u8> {
        let heights: Vec<[Option<f64>; 2]> = (0..=side)
            .map(|column| [0.0, 1.0].map(|down| at(f64::from(column), f64::from(row) + down)))
            .collect();
        let one = |column: usize| -> [u8; 3] {
            let [Some(above), below] = heights[column] else { return [0; 3] };
            let slope = |other: Option<f64>| (other.unwrap_or(0.0) - above) / texel;
            let place = [column as f64 * texel, f64::from(side - row) * texel];
            let slopes = [slope(heights[column + 1][0]), -slope(below)];
            // Nothing of the ground is quite black: that is the sea.
            colour(place, above, slopes).map(|value| value.round().clamp(1.0, 255.0) as u8)
        };
        (0..side as usize).flat_map(one).collect()
    };
    let file = BufWriter::new(File::create(path).map_err(|e| failed(&e))?);
    let mut encoder = TiffEncoder::new(file).map_err(|e| failed(&e))?;
    let mut image = encoder.new_image::<colortype::RGB8>(side, side).map_err(|e| failed(&e))?;
    image.rows_per_strip(ROWS).map_err(|e| failed(&e))?;
    let scale: &[f64] = &[texel, texel, 0.0];
    let tie: &[f64] = &[0.0, 0.0, 0.0, CORNER[0], CORNER[1], 0.0];
    // Projected, pixels are areas, and the system's code.
    let keys: &[u16] = &[1, 1, 0, 3, 1024, 0, 1, 1, 1025, 0, 1, 1, 3072, 0, 1, EPSG];
    let tags = image.encoder();
    tags.write_tag(Tag::ModelPixelScaleTag, scale).map_err(|e| failed(&e))?;
    tags.write_tag(Tag::ModelTiepointTag, tie).map_err(|e| failed(&e))?;
    tags.write_tag(Tag::GeoKeyDirectoryTag, keys).map_err(|e| failed(&e))?;
    tags.write_tag(Tag::GdalNodata, "0").map_err(|e| failed(&e))?;
    for first in (0..side).step_by(ROWS as usize) {
        let rows = first..(first + ROWS).min(side);
        let strip: Vec<u8> = rows.into_par_iter().flat_map_iter(line).collect();
        image.write_strip(&strip).map_err(|e| failed(&e))?;
    }
    image.finish().map_err(|e| failed(&e))
}
