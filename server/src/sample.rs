//! A made landscape: mountains with valleys, and a coast where the data end. The same on every machine,
//! since it uses only hashing, addition, multiplication and square roots.

use rayon::prelude::*;
use std::fs::File;
use std::io::BufWriter;
use std::path::Path;
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

/// Gradient noise (Perlin 2002, with gradients of any length): smooth, 0 on the lattice.
fn noise(x: f64, y: f64, seed: u32) -> f64 {
    let (i, j) = (x.floor(), y.floor());
    let (s, t) = (x - i, y - j);
    let (i, j) = (i as i32, j as i32);
    let fade = |w: f64| w * w * w * (w * (w * 6.0 - 15.0) + 10.0);
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

/// Ridges (Musgrave 1994): sharp where noise crosses zero, and detailed only where it is high already, so
/// that valleys stay smooth.
fn ridges(x: f64, y: f64, octaves: u32, seed: u32) -> f64 {
    let (mut sum, mut weight, mut amplitude, mut frequency) = (0.0, 1.0, 0.5, 1.0);
    for o in 0..octaves {
        let ridge = 1.0 - noise(x * frequency, y * frequency, seed + 31 * o).abs();
        let signal = ridge * ridge * weight;
        sum += signal * amplitude;
        weight = (signal * 1.9).clamp(0.0, 1.0);
        amplitude *= 0.5;
        frequency *= 2.03;
    }
    sum
}

/// The height in metres at a place given in parts of the whole (0..1 east, 0..1 north), or nothing in the
/// sea.
#[must_use]
pub fn height(east: f64, north: f64) -> Option<f32> {
    let (x, y) = (east * 5.0, north * 5.0);
    // Bend everything a little, so that no line is straight.
    let bend = [hills(x * 0.9 + 7.0, y * 0.9, 4, 11), hills(x * 0.9, y * 0.9 + 3.0, 4, 23)];
    let (x, y) = (x + 0.35 * bend[0], y + 0.35 * bend[1]);
    // Land rises from a coast in the south-west.
    let inland = (east + north * 0.8) * 0.75 - 0.30 + 0.20 * hills(x * 0.8, y * 0.8, 7, 5);
    if inland < 0.0 {
        return None;
    }
    let plain = 260.0 * inland + 60.0 * inland * hills(x * 3.0, y * 3.0, 6, 77);
    let rise = ((inland - 0.05) / 0.45).clamp(0.0, 1.0);
    let rise = rise * rise * (3.0 - 2.0 * rise);
    let mountains = ridges(x * 0.9, y * 0.9, 11, 3);
    let height = plain + rise * 3400.0 * (mountains * mountains * 0.9 + mountains * 0.1);
    // Decimetres: what a survey would give.
    Some(((height.max(0.3) * 10.0).round() / 10.0) as f32)
}

/// Writes the landscape as a GeoTIFF of 32-bit floats, `samples` a side.
///
/// # Errors
/// When the file cannot be written.
pub fn write(path: &Path, samples: u32) -> Result<(), String> {
    let failed = |e: &dyn std::fmt::Display| format!("{}: cannot write the sample DEM: {e}", path.display());
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
