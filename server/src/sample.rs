//! A made landscape: mountains with branching valleys, and a drowned coast where the data end. The same on
//! every machine, since it uses only hashing, addition, multiplication, division and square roots.

#![allow(
    clippy::cast_possible_truncation,
    clippy::cast_possible_wrap,
    clippy::cast_sign_loss,
    reason = "cells of noise, a few thousand a side, and heights of some kilometres"
)]

mod erosion;
mod imagery;

use erosion::{Lattice, Plan};
pub use imagery::write_imagery;
use rayon::prelude::*;
use std::fs::File;
use std::io::BufWriter;
use std::path::Path;
use std::sync::LazyLock;
use tiff::encoder::{TiffEncoder, TiffValue, colortype};
use tiff::tags::Tag;

/// Metres between samples.
pub const CELL: f64 = 30.0;

/// The value of samples in the sea.
pub const NODATA: f32 = -9999.0;

/// UTM zone 23 south: the frame of the made landscape.
const EPSG: u16 = 32723;

/// Coordinates of the north-west sample.
const CORNER: [f64; 2] = [620_000.0, 7_990_000.0];

/// A number in -1..1 for a point of the noise lattice.
fn hash(x: i32, y: i32, seed: u32) -> f64 {
    let mut v = x.cast_unsigned().wrapping_mul(0x9E37_79B1)
        ^ y.cast_unsigned().wrapping_mul(0x85EB_CA6B)
        ^ seed.wrapping_mul(0xC2B2_AE35);
    v ^= v >> 16;
    v = v.wrapping_mul(0x7FEB_352D);
    v ^= v >> 15;
    v = v.wrapping_mul(0x846C_A68B);
    v ^= v >> 16;
    f64::from(v) / f64::from(u32::MAX) * 2.0 - 1.0
}

/// From 0 to 1 as `t` does, level at both ends.
fn fade(t: f64) -> f64 {
    let t = t.clamp(0.0, 1.0);
    t * t * t * (t * (t * 6.0 - 15.0) + 10.0)
}

/// Gradient noise (Perlin 2002, with gradients of any length): smooth, 0 on the lattice.
fn noise(x: f64, y: f64, seed: u32) -> f64 {
    let (i, j) = (x.floor(), y.floor());
    let (s, t) = (x - i, y - j);
    let (i, j) = (i as i32, j as i32);
    let corner = |di: i32, dj: i32| {
        let gradient = [hash(i + di, j + dj, seed), hash(i + di, j + dj, seed ^ 0x55)];
        gradient[0] * (s - f64::from(di)) + gradient[1] * (t - f64::from(dj))
    };
    let (u, v) = (fade(s), fade(t));
    let lower = corner(0, 0) + (corner(1, 0) - corner(0, 0)) * u;
    let upper = corner(0, 1) + (corner(1, 1) - corner(0, 1)) * u;
    (lower + (upper - lower) * v) * 1.6
}

/// Octaves of noise, each half as wide and half as high.
fn hills(x: f64, y: f64, octaves: u32, seed: u32) -> f64 {
    (0..octaves)
        .map(|o| noise(x * f64::from(1 << o), y * f64::from(1 << o), seed + o) / f64::from(1 << o))
        .sum()
}

/// Metres along each side of the landscape that rivers wear. Larger samples spread it wider.
const EXTENT: f64 = 61_440.0;

/// How far the sea has risen since the rivers cut their valleys, in metres: their mouths are bays now.
const DROWNED: f64 = 90.0;

/// Metres of height for one that erosion made: what the summits of a young range reach.
const TALLNESS: f64 = 0.7;

/// The share of the landscape that the sample leaves out along each side, where water found no way on.
const RIM: f64 = 0.012;

static LAND: LazyLock<Lattice> =
    LazyLock::new(|| erosion::wear(&Plan { extent: EXTENT, is_sea: |e, n| inland(e, n) < 0.0, uplift }));

/// How far a place is from the old shore, in parts of the whole; below 0 in the sea. Land fills the north
/// around a bay, and an arc of islands lies before it.
fn inland(east: f64, north: f64) -> f64 {
    let from = |x: f64, y: f64, widen: f64| {
        let (dx, dy) = (east - x, north - y);
        (widen * dx * dx + dy * dy).sqrt()
    };
    let bay = from(0.44, 0.02, 1.4) - 0.30;
    let coast = (north - 0.13 + 0.06 * (east - 0.5)).min(bay);
    let arc = 0.008 - (from(0.50, -0.12, 1.0) - 0.24).abs();
    let rough = hills(east * 4.5 + 0.3, north * 4.5, 6, 5);
    (coast + 0.085 * rough).max(arc + 0.055 * rough)
}

/// How fast the land rises: slowly at the coast, and in ranges further in.
fn uplift(east: f64, north: f64) -> f64 {
    let ranges = 0.70 + 0.60 * hills(east * 2.1 + 5.0, north * 2.1 + 1.0, 3, 91);
    0.05 + 1.35 * fade(inland(east, north) / 0.34) * ranges.max(0.15)
}

/// The height in metres at a place given in parts of the whole (0..1 east, 0..1 north), or nothing in the
/// sea. The first call takes about a second.
#[must_use]
pub fn height(east: f64, north: f64) -> Option<f32> {
    let [x, y] = [east, north].map(|part| RIM + (1.0 - 2.0 * RIM) * part);
    let above = LAND.height(x, y) - DROWNED;
    if above < 0.0 {
        return None;
    }
    // Rocks and gullies smaller than the rivers know of, on what is high.
    let rocks = 5.0 * fade(above / 2000.0) * hills(x * 500.0, y * 500.0, 3, 40);
    // Decimetres: what a survey would give.
    Some((((TALLNESS * above + rocks).max(0.3) * 10.0).round() / 10.0) as f32)
}

/// Coordinates, in metres, of a place given in parts of the whole, in a sample of `samples` a side.
#[must_use]
pub fn place(east: f64, north: f64, samples: u32) -> [f64; 2] {
    let side = CELL * f64::from(samples - 1);
    [CORNER[0] + east * side, CORNER[1] + (north - 1.0) * side]
}

/// Writes the landscape as a GeoTIFF of 32-bit floats, `samples` a side.
///
/// # Errors
/// When the file cannot be written.
pub fn write(path: &Path, samples: u32) -> Result<(), String> {
    let failed = |e: &dyn std::fmt::Display| {
        let path = path.display();
        format!("{path}: cannot write the sample DEM: {e}; free some space or choose another --folder")
    };
    let file = BufWriter::new(File::create(path).map_err(|e| failed(&e))?);
    let mut encoder = TiffEncoder::new(file).map_err(|e| failed(&e))?;
    let mut image = encoder.new_image::<colortype::Gray32Float>(samples, samples).map_err(|e| failed(&e))?;
    let scale: &[f64] = &[CELL, CELL, 0.0];
    let tie: &[f64] = &[0.0, 0.0, 0.0, CORNER[0], CORNER[1], 0.0];
    // Projected, samples are points, and the system's code.
    let keys: &[u16] = &[1, 1, 0, 3, 1024, 0, 1, 1, 1025, 0, 1, 2, 3072, 0, 1, EPSG];
    let nodata = NODATA.to_string();
    let mut tag = |tag: u16, value: &dyn WriteTag| value.write(&mut image, tag).map_err(|e| failed(&e));
    tag(33550, &scale)?;
    tag(33922, &tie)?;
    tag(34735, &keys)?;
    tag(42113, &nodata.as_str())?;
    // Made here and not by whichever worker asks first: making it needs the workers, who would wait for it.
    LazyLock::force(&LAND);
    let last = f64::from(samples - 1);
    let rows_a_strip = 64;
    image.rows_per_strip(rows_a_strip).map_err(|e| failed(&e))?;
    for first in (0..samples).step_by(rows_a_strip as usize) {
        let rows = first..(first + rows_a_strip).min(samples);
        let strip: Vec<f32> = rows
            .into_par_iter()
            .flat_map_iter(|row| {
                let north = 1.0 - f64::from(row) / last;
                (0..samples).map(move |column| height(f64::from(column) / last, north).unwrap_or(NODATA))
            })
            .collect();
        image.write_strip(&strip).map_err(|e| failed(&e))?;
    }
    image.finish().map_err(|e| failed(&e))
}

type Image<'a> =
    tiff::encoder::ImageEncoder<'a, BufWriter<File>, colortype::Gray32Float, tiff::encoder::TiffKindStandard>;

/// A tag of any type.
trait WriteTag {
    fn write(&self, image: &mut Image<'_>, tag: u16) -> Result<(), tiff::TiffError>;
}

impl<T: TiffValue> WriteTag for T {
    fn write(&self, image: &mut Image<'_>, tag: u16) -> Result<(), tiff::TiffError> {
        // The image's own directory takes values by reference.
        image.encoder().write_tag(Tag::Unknown(tag), self)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_landscape_is_the_same_everywhere() {
        let (mut sum, mut land) = (0xcbf2_9ce4_8422_2325u64, 0);
        for j in 0..100 {
            for i in 0..100 {
                let height = height(f64::from(i) / 99.0, f64::from(j) / 99.0);
                land += usize::from(height.is_some());
                let bits = height.unwrap_or(NODATA).to_bits();
                sum = (sum ^ u64::from(bits)).wrapping_mul(0x100_0000_01b3);
                assert!(height.is_none_or(|h| (0.3..3600.0).contains(&h)), "{height:?} at {i} {j}");
            }
        }
        assert!((6500..8000).contains(&land), "{land} of 10000 are land");
        assert_eq!(
            sum, 0x886_bdd9_2ebc_fee2,
            "the landscape changed, or this machine calculates otherwise: {sum:#x}"
        );
    }
}
