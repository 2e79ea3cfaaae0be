//! Claims about ingest: small files made in code, then every real DEM at hand.

use diamantina_protocol::arguments::with_negative_numbers;
use std::collections::HashMap;
use std::fs;
use std::io::{Cursor, Write};
use std::path::{Path, PathBuf};

use tempfile::TempDir;
use tiff::encoder::{Compression, DeflateLevel, Predictor, TiffEncoder, colortype};
use tiff::tags::Tag;

use super::*;

fn source_crs() -> Options {
    Options { crs: CrsChoice::Source, ..Options::default() }
}

fn folder() -> TempDir {
    tempfile::tempdir().unwrap()
}

fn put(folder: &TempDir, name: &str, bytes: &[u8]) -> PathBuf {
    let path = folder.path().join(name);
    fs::write(&path, bytes).unwrap();
    path
}

fn whole_grid(source: &Source) -> Vec<f64> {
    let mut out = Vec::new();
    source.read(0, 0, source.grid().width, source.grid().height, &mut out).unwrap();
    out
}

#[derive(clap::Parser)]
struct CommandLine {
    #[command(flatten)]
    options: Options,
}

#[test]
fn the_command_line_says_it_all() {
    let parse = |line: &str| {
        let words = with_negative_numbers(line.split(' ').map(Into::into));
        <CommandLine as clap::Parser>::try_parse_from(words).map(|c| c.options)
    };
    let options =
        parse("x --crs epsg:32632 --cell 30 --nodata -9999 --height-offset -5 --raw 7x9:i16").unwrap();
    assert_eq!((options.crs, options.nodata), (CrsChoice::Epsg(32632), Some(-9999.0)));
    assert_eq!(options.raw, Some(RawShape { width: 7, height: 9, dtype: Dtype::I16 }));
    assert_eq!(parse("x").unwrap().crs, CrsChoice::Auto);
    assert_eq!(parse("x --assume-crs epsg:4326").unwrap().assume_crs, NonZeroU32::new(4326));
    for wrong in [
        "x --crs utm",
        "x --crs EPSG:-1",
        "x --assume-crs 4326",
        "x --raw 7x0:i16",
        "x --raw 7x9:i64",
        "x --nodata no",
    ] {
        assert!(parse(wrong).is_err(), "{wrong}");
    }
}

/// Where a small TIFF lies and how it is packed.
#[derive(Clone)]
struct Tags {
    origin: [f64; 2],
    step: f64,
    keys: Vec<u16>,
    nodata: Option<&'static str>,
    compression: Compression,
    predictor: Predictor,
    rows_per_strip: u32,
}

impl Tags {
    fn new(keys: &[[u16; 4]]) -> Self {
        let header = [1, 1, 0, u16::try_from(keys.len()).unwrap()];
        Self {
            origin: [500_000.0, 5_000_000.0],
            step: 30.0,
            keys: header.into_iter().chain(keys.iter().flatten().copied()).collect(),
            nodata: None,
            compression: Compression::Uncompressed,
            predictor: Predictor::None,
            rows_per_strip: 3,
        }
    }

    fn utm() -> Self {
        Self::new(&[[1024, 0, 1, 1], [1025, 0, 1, 1], [3072, 0, 1, 32632]])
    }

    fn degrees(origin: [f64; 2], step: f64) -> Self {
        let keys = [[1024, 0, 1, 2], [1025, 0, 1, 2], [2048, 0, 1, 4326]];
        Self { origin, step, ..Self::new(&keys) }
    }
}

/// A TIFF of the colour type $colour, whose samples run from the north-west.
macro_rules! tiff {
    ($colour:ty, $width:expr, $height:expr, $samples:expr, $tags:expr) => {{
        let mut bytes = Cursor::new(Vec::new());
        let tags: &Tags = $tags;
        let encoder = TiffEncoder::new(&mut bytes).unwrap();
        let mut encoder = encoder.with_compression(tags.compression).with_predictor(tags.predictor);
        let mut image = encoder.new_image::<$colour>($width, $height).unwrap();
        image.rows_per_strip(tags.rows_per_strip).unwrap();
        let directory = image.encoder();
        directory.write_tag(Tag::ModelPixelScaleTag, &[tags.step, tags.step, 0.0][..]).unwrap();
        let tie = [0.0, 0.0, 0.0, tags.origin[0], tags.origin[1], 0.0];
        directory.write_tag(Tag::ModelTiepointTag, &tie[..]).unwrap();
        directory.write_tag(Tag::GeoKeyDirectoryTag, &tags.keys[..]).unwrap();
        if let Some(nodata) = tags.nodata {
            directory.write_tag(Tag::GdalNodata, nodata).unwrap();
        }
        image.write_data(&$samples[..]).unwrap();
        bytes.into_inner()
    }};
}

/// A little-endian TIFF by hand, one tile or strip list, for what the encoder cannot write.
fn raw_tiff(entries: &[(u16, u16, u32, u32)], data: &[u8]) -> Vec<u8> {
    let mut bytes = b"II*\0\x08\0\0\0".to_vec();
    bytes.extend(u16::try_from(entries.len()).unwrap().to_le_bytes());
    for (tag, kind, count, value) in entries {
        bytes.extend(tag.to_le_bytes());
        bytes.extend(kind.to_le_bytes());
        bytes.extend(count.to_le_bytes());
        bytes.extend(value.to_le_bytes());
    }
    bytes.extend([0; 4]);
    bytes.extend(data);
    bytes
}

fn pattern(i: usize) -> i16 {
    i16::try_from((i * 7919) % 3001).unwrap() - 1500
}

#[test]
fn every_encoding_of_the_same_samples_reads_the_same() {
    let folder = folder();
    let (w, h) = (23, 17);
    let samples: Vec<i16> = (0..w as usize * h as usize).map(pattern).collect();
    let expected: Vec<f64> =
        (0..h as usize).rev().flat_map(|y| samples[y * 23..][..23].iter().map(|v| f64::from(*v))).collect();
    let deflate = Compression::Deflate(DeflateLevel::Fast);
    for compression in [Compression::Uncompressed, deflate, Compression::Lzw, Compression::Packbits] {
        for predictor in [Predictor::None, Predictor::Horizontal] {
            for rows_per_strip in [1, 5, 17] {
                let tags = Tags { compression, predictor, rows_per_strip, ..Tags::utm() };
                let bytes = tiff!(colortype::GrayI16, w, h, samples, &tags);
                let path = put(&folder, "a.tif", &bytes);
                let source = open(&[path], &Options::default()).unwrap();
                assert_eq!(whole_grid(&source), expected, "{predictor:?} {rows_per_strip}");
                assert!(source.grid().integer && !source.grid().resampled);
            }
        }
    }
}

#[test]
fn every_sample_type_keeps_its_values() {
    let folder = folder();
    let check = |bytes: Vec<u8>, expected: &[f64], integer: bool| {
        let source = open(&[put(&folder, "a.tif", &bytes)], &Options::default()).unwrap();
        assert_eq!(whole_grid(&source), expected);
        assert_eq!(source.grid().integer, integer);
    };
    let tags = Tags { compression: Compression::Deflate(DeflateLevel::Fast), ..Tags::utm() };
    check(tiff!(colortype::Gray8, 2, 1, [0u8, 255], &tags), &[0.0, 255.0], true);
    check(tiff!(colortype::Gray16, 2, 1, [0u16, 65535], &tags), &[0.0, 65535.0], true);
    check(tiff!(colortype::Gray32, 2, 1, [0u32, u32::MAX], &tags), &[0.0, 4_294_967_295.0], true);
    check(tiff!(colortype::GrayI32, 2, 1, [i32::MIN, 7], &tags), &[-2_147_483_648.0, 7.0], true);
    check(tiff!(colortype::Gray32Float, 2, 1, [0.1f32, -3.5], &tags), &[f64::from(0.1f32), -3.5], false);
    check(tiff!(colortype::Gray64Float, 2, 1, [0.1f64, -3.5], &tags), &[0.1, -3.5], false);
}

#[test]
fn windows_are_cut_from_the_whole() {
    let folder = folder();
    let (w, h) = (150usize, 140usize);
    let samples: Vec<i16> = (0..w * h).map(pattern).collect();
    let tags = Tags {
        compression: Compression::Lzw,
        nodata: Some("-1500"),
        rows_per_strip: 7,
        ..Tags::degrees([8.0, 47.0], 1.0 / 1200.0)
    };
    let path = put(&folder, "a.tif", &tiff!(colortype::GrayI16, 150, 140, samples, &tags));
    for options in [source_crs(), Options::default(), Options { cell: Some(2500.0), ..Options::default() }] {
        let source = open(std::slice::from_ref(&path), &options).unwrap();
        let all = whole_grid(&source);
        let (gw, gh) = (source.grid().width, source.grid().height);
        let mut out = Vec::new();
        for (x0, y0, width, height) in [(0, 0, gw, 1), (gw - 1, 0, 1, gh), (gw / 3, gh / 3, gw / 2, gh / 2)] {
            source.read(x0, y0, width, height, &mut out).unwrap();
            let rows = (y0..y0 + height).map(|y| y as usize * gw as usize + x0 as usize);
            let expected: Vec<f64> = rows.flat_map(|at| all[at..at + width as usize].to_vec()).collect();
            let bits = |v: &[f64]| v.iter().map(|v| v.to_bits()).collect::<Vec<_>>();
            assert_eq!(bits(&out), bits(&expected), "{options:?}");
        }
        assert!(source.read(gw, 0, 1, 1, &mut out).is_err());
        assert!(source.read(u32::MAX, 0, 2, 1, &mut out).is_err());
        source.read(gw, gh, 0, 0, &mut out).unwrap();
        assert!(out.is_empty());
    }
}

#[test]
fn threads_read_the_same_as_one() {
    let folder = folder();
    let samples: Vec<i16> = (0..256 * 256).map(pattern).collect();
    let tags = Tags { compression: Compression::Lzw, rows_per_strip: 4, ..Tags::utm() };
    let path = put(&folder, "a.tif", &tiff!(colortype::GrayI16, 256, 256, samples, &tags));
    let source = open(&[path], &Options::default()).unwrap();
    let all = whole_grid(&open(&[folder.path().join("a.tif")], &Options::default()).unwrap());
    std::thread::scope(|scope| {
        for _ in 0..8 {
            scope.spawn(|| assert_eq!(whole_grid(&source), all));
        }
    });
}

#[test]
fn an_area_sample_lies_half_a_cell_inside_its_corner() {
    let folder = folder();
    let at = |kind: u16| {
        let tags = Tags::new(&[[1024, 0, 1, 1], [1025, 0, 1, kind], [3072, 0, 1, 32632]]);
        let path = put(&folder, "a.tif", &tiff!(colortype::GrayI16, 4, 3, [0i16; 12], &tags));
        open(&[path], &Options::default()).unwrap().grid().clone()
    };
    assert_eq!(at(1).origin, [500_015.0, 5_000_000.0 - 75.0]);
    assert_eq!(at(2).origin, [500_000.0, 5_000_000.0 - 60.0]);
    assert_eq!(at(2).cell, [30.0, 30.0]);
    assert_eq!(at(2).crs.unwrap().name, "EPSG:32632");
}

#[test]
fn feet_become_metres() {
    let folder = folder();
    // EPSG:2227 is California zone 3 in US survey feet; heights in international feet by key 4099.
    let tags = Tags::new(&[[1024, 0, 1, 1], [1025, 0, 1, 2], [3072, 0, 1, 2227], [4099, 0, 1, 9002]]);
    let path = put(&folder, "a.tif", &tiff!(colortype::GrayI16, 4, 3, [100i16; 12], &tags));
    let source = open(&[path], &Options::default()).unwrap();
    let grid = source.grid();
    assert!((grid.cell[0] - 30.0 * 1200.0 / 3937.0).abs() < 1e-9);
    assert!((grid.origin[0] - 500_000.0 * 1200.0 / 3937.0).abs() < 1e-6);
    assert_eq!(grid.crs.as_ref().unwrap().step, [30.0, 30.0]);
    assert!((grid.height_scale - 0.3048).abs() < 1e-12);
}

/// Heights in feet became 3.28 times as high where the vertical CRS alone said so.
#[test]
fn a_vertical_crs_tells_the_unit_of_heights() {
    let folder = folder();
    let open_with = |keys: &[[u16; 4]], options: &Options| {
        let plain = [[1024, 0, 1, 1], [1025, 0, 1, 2], [3072, 0, 1, 32632]];
        let tags = Tags::new(&if keys.iter().any(|k| matches!(k[0], 2048 | 3072)) {
            keys.to_vec()
        } else {
            [&plain[..], keys].concat()
        });
        let path = put(&folder, "a.tif", &tiff!(colortype::GrayI16, 4, 3, [100i16; 12], &tags));
        open(&[path], options).map(|source| source.grid().height_scale)
    };
    let us_foot = 1200.0 / 3937.0;
    for (keys, metres) in [
        (vec![[4096, 0, 1, 6360]], us_foot),
        (vec![[4096, 0, 1, 5702]], us_foot),
        (vec![[4096, 0, 1, 8228]], 0.3048),
        (vec![[4096, 0, 1, 5703]], 1.0),
        (vec![[4096, 0, 1, 3855]], 1.0),
        (vec![[4096, 0, 1, 5773]], 1.0),
        (vec![[4096, 0, 1, 32767]], 1.0),
        (vec![[4096, 0, 1, 4979]], 1.0),
        (vec![[4096, 0, 1, 4937]], 1.0),
        // The unit's own key has the last word.
        (vec![[4096, 0, 1, 5703], [4099, 0, 1, 9002]], 0.3048),
        (vec![[4096, 0, 1, 32767], [4099, 0, 1, 9003]], us_foot),
        // Compound systems in the place of plain ones: NAD27 + NGVD29 in feet, NAD83(2011) + NAVD88 in metres,
        // California zone 1 + NAVD88 in feet, OSGB36 + ODN in metres.
        (vec![[1024, 0, 1, 2], [2048, 0, 1, 7406]], us_foot),
        (vec![[1024, 0, 1, 2], [2048, 0, 1, 6349]], 1.0),
        (vec![[1024, 0, 1, 1], [3072, 0, 1, 8714]], us_foot),
        (vec![[1024, 0, 1, 1], [3072, 0, 1, 7405]], 1.0),
    ] {
        let found = open_with(&keys, &source_crs()).unwrap_or_else(|e| panic!("{keys:?}: {e}"));
        assert!((found - metres).abs() < 1e-12, "{keys:?}: {found} for {metres}");
    }
    for (keys, word) in [
        ([[4096, 0, 1, 5715], [4099, 0, 1, 9001]], "depths, which grow downwards"),
        ([[4096, 0, 1, 6358], [1025, 0, 1, 2]], "EPSG:6358"),
        ([[4096, 0, 1, 12_345], [1025, 0, 1, 2]], "EPSG:12345, whose unit is not known"),
        ([[4099, 0, 1, 9999], [1025, 0, 1, 2]], "unit EPSG:9999"),
    ] {
        let message = open_with(&keys, &Options::default()).unwrap_err().to_string();
        for word in [word, "a.tif", "--height-scale", "below 0 for depths"] {
            assert!(message.contains(word), "no '{word}' in: {message}");
        }
        let told = Options { height_scale: Some(-1.0), ..Options::default() };
        assert_eq!(open_with(&keys, &told).unwrap(), -1.0);
    }
}

/// Feet became metres where the projection itself is not built in.
#[test]
fn units_of_projections_that_are_not_built_in_are_known() {
    let folder = folder();
    // Oblique Mercator (Oregon) in feet, Cassini (Trinidad) in Clarke's links.
    for (code, metres) in [(6809, 0.3048), (2066, 0.201_166_195_164)] {
        assert!(crate::projection::Projection::new(crate::projection::epsg(code.into()).unwrap()).is_err());
        let tags = Tags::new(&[[1024, 0, 1, 1], [1025, 0, 1, 2], [3072, 0, 1, code]]);
        let path = put(&folder, "a.tif", &tiff!(colortype::GrayI16, 4, 3, [1i16; 12], &tags));
        let grid = open(&[path], &Options::default()).unwrap().grid().clone();
        assert!((grid.cell[0] - 30.0 * metres).abs() < 1e-9, "{code}: {:?}", grid.cell);
    }
}

#[test]
fn units_go_by_many_names() {
    for (text, metres) in [
        ("m", 1.0),
        ("Metres", 1.0),
        ("metre above sea level", 1.0),
        ("ft", 0.3048),
        ("feet (US)", 1200.0 / 3937.0),
        ("US survey foot", 1200.0 / 3937.0),
        ("us-ft", 1200.0 / 3937.0),
        ("US_survey_foot", 1200.0 / 3937.0),
        ("international foot", 0.3048),
        ("cm", 0.01),
        ("decimeters", 0.1),
        ("fathoms", 1.8288),
    ] {
        assert_eq!(super::units::named_metres(text), Some(metres), "{text}");
    }
    for text in ["", "degrees", "kelvin", "counts"] {
        assert_eq!(super::units::named_metres(text), None, "{text}");
    }
}

#[test]
fn units_of_coordinates_that_are_not_known_are_refused() {
    let folder = folder();
    for (keys, word) in [
        (vec![[1024, 0, 1, 1], [3072, 0, 1, 32767], [3075, 0, 1, 1], [3076, 0, 1, 9999]], "unit EPSG:9999"),
        (vec![[1024, 0, 1, 2], [2048, 0, 1, 4326], [2054, 0, 1, 9105]], "angles in unit EPSG:9105"),
        (vec![[1024, 0, 1, 2], [2048, 0, 1, 4807]], "unit is the grad"),
    ] {
        let path = put(&folder, "a.tif", &tiff!(colortype::GrayI16, 4, 3, [1i16; 12], &Tags::new(&keys)));
        let message = open(&[path], &source_crs()).unwrap_err().to_string();
        assert!(message.contains(word) && message.contains("gdalwarp"), "{message}");
    }
}

/// A mask in a directory of its own was overlooked: what it hides was drawn.
#[test]
fn a_mask_beside_the_samples_is_refused() {
    let folder = folder();
    for (kind, is_mask) in [(1u32, false), (4, true), (5, true)] {
        let mut bytes = Cursor::new(Vec::new());
        let mut encoder = TiffEncoder::new(&mut bytes).unwrap();
        encoder.new_image::<colortype::GrayI16>(2, 2).unwrap().write_data(&[1i16; 4]).unwrap();
        let mut second = encoder.new_image::<colortype::Gray8>(2, 2).unwrap();
        second.encoder().write_tag(Tag::NewSubfileType, kind).unwrap();
        second.write_data(&[255u8; 4]).unwrap();
        let path = put(&folder, "a.tif", &bytes.into_inner());
        match open(&[path], &Options { cell: Some(1.0), ..Options::default() }) {
            Ok(_) => assert!(!is_mask, "a mask was overlooked"),
            Err(e) => assert!(is_mask && e.to_string().contains("gdalwarp -dstnodata"), "{e}"),
        }
    }
}

#[test]
fn nodata_becomes_nan_and_can_be_overridden() {
    let folder = folder();
    let tags = Tags { nodata: Some("-9999"), ..Tags::utm() };
    let samples = [1.0f32, -9999.0, f32::NAN, f32::INFINITY];
    let path = put(&folder, "a.tif", &tiff!(colortype::Gray32Float, 4, 1, samples, &tags));
    let valid = |options: &Options| {
        let out = whole_grid(&open(std::slice::from_ref(&path), options).unwrap());
        out.iter().map(|v| !v.is_nan()).collect::<Vec<_>>()
    };
    assert_eq!(valid(&Options::default()), [true, false, false, false]);
    let options = Options { nodata: Some(1.0), ..Options::default() };
    assert_eq!(valid(&options), [false, true, false, false]);
}

/// A void of -32768 under another nodata value than the file's was a pit 33 km deep.
#[test]
fn a_void_that_nobody_declared_is_refused_and_nan_says_that_all_are_heights() {
    let folder = folder();
    let tags = Tags { nodata: Some("-9999"), ..Tags::utm() };
    let samples = [263i16, 4370, -32768, -9999];
    let path = put(&folder, "a.tif", &tiff!(colortype::GrayI16, 4, 1, samples, &tags));
    let read = |nodata: Option<f64>| {
        let options = Options { nodata, ..Options::default() };
        let source = open(std::slice::from_ref(&path), &options).unwrap();
        (whole_grid(&source), source.check_nodata())
    };
    let refusal = |checked: Result<()>| checked.unwrap_err().to_string();
    let undeclared = refusal(read(None).1);
    for word in ["a.tif", "263 to 4370", "found -32768", "--nodata -32768", "--nodata nan"] {
        assert!(undeclared.contains(word), "{word}: {undeclared}");
    }
    // Another wrong value does not help.
    assert!(refusal(read(Some(7.0)).1).contains("--nodata -"));
    let (values, checked) = read(Some(f64::NAN));
    assert_eq!(values, [263.0, 4370.0, -32768.0, -9999.0], "all are heights, the file's nodata too");
    assert!(checked.is_ok());
}

#[test]
fn a_mosaic_joins_exactly() {
    let folder = folder();
    let (w, h) = (40usize, 30usize);
    let value = |x: usize, y: usize| pattern(y * w + x);
    let crop = |name: &str, x0: usize, y0: usize, cw: usize, ch: usize, hole: bool| {
        let samples: Vec<i16> = (y0..y0 + ch)
            .flat_map(|y| {
                (x0..x0 + cw).map(move |x| if hole && x == x0 + cw - 1 { -32768 } else { value(x, y) })
            })
            .collect();
        let origin = [500_000.0 + 30.0 * x0 as f64, 5_000_000.0 - 30.0 * y0 as f64];
        let tags = Tags { origin, nodata: Some("-32768"), ..Tags::utm() };
        let (cw, ch) = (u32::try_from(cw).unwrap(), u32::try_from(ch).unwrap());
        put(&folder, name, &tiff!(colortype::GrayI16, cw, ch, samples, &tags))
    };
    let whole = crop("whole.tif", 0, 0, w, h, false);
    // Four tiles share a rim; the rim column of one is nodata and must come from its neighbour.
    let tiles = [
        crop("a.tif", 0, 0, 21, 16, true),
        crop("b.tif", 20, 0, 20, 16, false),
        crop("c.tif", 0, 15, 21, 15, false),
        crop("d.tif", 20, 15, 20, 15, false),
    ];
    let whole = open(&[whole], &Options::default()).unwrap();
    for order in [[0, 1, 2, 3], [3, 1, 0, 2]] {
        let paths: Vec<PathBuf> = order.iter().map(|i| tiles[*i].clone()).collect();
        let source = open(&paths, &Options::default()).unwrap();
        assert_eq!(source.grid(), whole.grid());
        assert_eq!(whole_grid(&source), whole_grid(&whole));
    }
}

#[test]
fn a_reprojected_plane_stays_a_plane() {
    let folder = folder();
    // Values are the longitude (or latitude) itself, so bilinear interpolation is exact and what remains is
    // the error of the map. The last case is so coarse that parabolas do not suffice everywhere.
    let fine = 1.0 / 1200.0;
    let places = [
        (8.0, 47.0, fine),
        (-70.5, -44.0, fine),
        (179.9, 10.0, fine),
        (15.0, 78.0, fine),
        (-0.1, 86.0, fine),
        (-0.1, -86.0, fine),
        (0.0, 45.0, 0.1),
    ];
    for ((lon, lat, step), axis) in places.into_iter().flat_map(|p| [(p, 0), (p, 1)]) {
        let n = 241u32;
        let position = |i: u32| [lon + f64::from(i % n) * step, lat - f64::from(i / n) * step];
        let samples: Vec<f64> = (0..n * n).map(|i| position(i)[axis]).collect();
        let tags = Tags { compression: Compression::Lzw, ..Tags::degrees([lon, lat], step) };
        let path = put(&folder, "a.tif", &tiff!(colortype::Gray64Float, n, n, samples, &tags));
        let source = open(&[path], &Options::default()).unwrap();
        let grid = source.grid().clone();
        let crs = grid.crs.clone().unwrap();
        let projection = crate::projection::Projection::new(&crs.proj4.unwrap()).unwrap();
        let all = whole_grid(&source);
        let mut valid = 0;
        for (i, value) in all.iter().enumerate().filter(|(_, v)| !v.is_nan()) {
            let (x, y) = (i % grid.width as usize, i / grid.width as usize);
            let at = |axis: usize, k: usize| crs.origin[axis] + k as f64 * crs.step[axis];
            let exact: [f64; 2] = projection.inverse(at(0, x), at(1, y)).unwrap().into();
            let error = (value - exact[axis] + 180.0).rem_euclid(360.0) - 180.0;
            assert!(error.abs() < 0.01 * step, "{value} {exact:?} at {x} {y}");
            valid += 1;
        }
        // A rotated square fills most of its bounding box, and nothing valid is lost.
        assert!(valid * 10 > all.len() * 6, "{valid} of {}", all.len());
        assert!(grid.resampled && (grid.cell[0] - grid.cell[1]).abs() < 1e-9);
    }
}

#[test]
fn resampling_keeps_nodata_out_of_its_neighbours() {
    let folder = folder();
    let n = 101u32;
    let samples: Vec<i16> = (0..n * n).map(|i| if i == 50 * n + 50 { -32768 } else { 100 }).collect();
    let tags = Tags { nodata: Some("-32768"), ..Tags::degrees([8.0, 47.0], 1.0 / 1200.0) };
    let path = put(&folder, "a.tif", &tiff!(colortype::GrayI16, n, n, samples, &tags));
    let source = open(&[path], &Options::default()).unwrap();
    let all = whole_grid(&source);
    assert!(all.iter().all(|v| v.is_nan() || (v - 100.0).abs() < 1e-9));
    let (w, h) = (source.grid().width as usize, source.grid().height as usize);
    let inner = |i: &usize| (w / 4..w * 3 / 4).contains(&(i % w)) && (h / 4..h * 3 / 4).contains(&(i / w));
    let holes = (0..all.len()).filter(inner).filter(|i| all[*i].is_nan()).count();
    assert!((1..=9).contains(&holes), "{holes}");
}

/// A grid of degrees that did not say so became a scene of 6 cm.
#[test]
fn degrees_without_a_crs_are_refused_or_assumed() {
    let folder = folder();
    let plain = |origin: [f64; 2], step: f64| {
        let tags = Tags { origin, step, ..Tags::new(&[]) };
        let bytes = tiff!(colortype::GrayI16, 20, 20, [7i16; 400], &tags);
        [put(&folder, "plain.tif", &bytes)]
    };
    let degrees = plain([-155.1, 19.75], 1e-4);
    for options in [Options::default(), source_crs()] {
        let message = open(&degrees, &options).unwrap_err().to_string();
        let words = ["plain.tif", "look like degrees", "--assume-crs EPSG:4326", "--cell METRES"];
        assert!(words.iter().all(|w| message.contains(w)), "{message}");
    }
    let assumed = Options { assume_crs: NonZeroU32::new(4326), ..Options::default() };
    let grid = open(&degrees, &assumed).unwrap().grid().clone();
    assert_eq!(grid.crs.unwrap().name, "EPSG:32605");
    assert!((grid.cell[0] - 10.8).abs() < 0.2, "{:?}", grid.cell);
    let as_it_is = Options { cell: Some(10.0), ..Options::default() };
    let grid = open(&degrees, &as_it_is).unwrap().grid().clone();
    assert_eq!((grid.crs, grid.origin, grid.cell), (None, [0.0; 2], [10.0; 2]));
    // Longitudes from 0 to 360; across Greenwich; across the equator.
    for origin in [[204.9, 19.75], [-0.001, 51.5], [35.2, 0.001]] {
        for options in [Options::default(), source_crs()] {
            let message = open(&plain(origin, 1e-4), &options).unwrap_err().to_string();
            assert!(message.contains("look like degrees"), "{origin:?}: {message}");
        }
    }
    // Coarse, but once around the globe.
    let globe = Tags { origin: [-180.0, 90.0], step: 9.0, ..Tags::new(&[]) };
    let globe = put(&folder, "globe.tif", &tiff!(colortype::GrayI16, 40, 20, [7i16; 800], &globe));
    assert!(open(&[globe], &Options::default()).unwrap_err().to_string().contains("look like degrees"));
    let east = open(&plain([204.9, 19.75], 1e-4), &assumed).unwrap().grid().clone();
    assert_eq!(east.crs.as_ref().unwrap().name, "EPSG:32605");
    let west = open(&plain([-155.1, 19.75], 1e-4), &assumed).unwrap().grid().clone();
    assert!((east.origin[0] - west.origin[0]).abs() < 1e-3, "{:?} {:?}", east.origin, west.origin);
    // A wave tank at (0, 0), a site in metres, a source with a CRS: all as before.
    for (origin, step) in [([0.0, 3.4], 0.014), ([382_250.0, 6_354_700.0], 1.0), ([-155.1, 19.75], 30.0)] {
        let grid = open(&plain(origin, step), &Options::default()).unwrap().grid().clone();
        assert_eq!((grid.crs, grid.cell), (None, [step; 2]));
    }
    let known = tiff!(colortype::GrayI16, 20, 20, [7i16; 400], &Tags::utm());
    let known = [put(&folder, "known.tif", &known)];
    assert_eq!(open(&known, &assumed).unwrap().grid().crs.as_ref().unwrap().name, "EPSG:32632");
    let unknown = Options { assume_crs: NonZeroU32::new(1), ..Options::default() };
    assert!(open(&degrees, &unknown).unwrap_err().to_string().contains("known EPSG code"));
}

#[test]
fn the_same_crs_is_not_resampled() {
    let folder = folder();
    let path = put(&folder, "a.tif", &tiff!(colortype::GrayI16, 9, 9, [5i16; 81], &Tags::utm()));
    let options = Options { crs: CrsChoice::Epsg(32632), ..Options::default() };
    assert!(!open(std::slice::from_ref(&path), &options).unwrap().grid().resampled);
    let options = Options { crs: CrsChoice::Epsg(32632), cell: Some(10.0), ..Options::default() };
    let source = open(&[path], &options).unwrap();
    assert_eq!(source.grid().cell, [10.0, 10.0]);
    assert!(source.grid().resampled);
    assert!(whole_grid(&source).iter().filter(|v| !v.is_nan()).all(|v| *v == 5.0));
}

fn png_bytes(colour: ::png::ColorType, depth: ::png::BitDepth, side: u32, data: &[u8]) -> Vec<u8> {
    let mut bytes = Vec::new();
    let mut encoder = ::png::Encoder::new(&mut bytes, side, side);
    encoder.set_color(colour);
    encoder.set_depth(depth);
    let mut writer = encoder.write_header().unwrap();
    writer.write_image_data(data).unwrap();
    writer.finish().unwrap();
    bytes
}

fn gzip(bytes: &[u8]) -> Vec<u8> {
    let mut encoder = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
    encoder.write_all(bytes).unwrap();
    encoder.finish().unwrap()
}

fn zip_of(files: &[(&str, &[u8])]) -> Vec<u8> {
    let mut writer = zip::ZipWriter::new(Cursor::new(Vec::new()));
    for (name, bytes) in files {
        writer.start_file(*name, zip::write::SimpleFileOptions::default()).unwrap();
        writer.write_all(bytes).unwrap();
    }
    writer.finish().unwrap().into_inner()
}

const ASC: &str =
    "NCOLS 3\nnrows 2\nxllcorner 10\nyllcenter 20\ndx 2\ndy 4\nNODATA_value -9\n1 2\n3 4 -9\n 6\r\n";

#[test]
fn other_formats_read_their_values() {
    let folder = folder();
    let nan = f64::NAN;
    let check = |path: PathBuf, options: &Options, expected: &[f64]| {
        let source = open(&[path], options).unwrap();
        let text = |v: &[f64]| format!("{v:?}");
        assert_eq!(text(&whole_grid(&source)), text(expected));
        source.grid().clone()
    };
    for bytes in [ASC.into(), zip_of(&[("a.prj", b""), ("b/c.ASC", ASC.as_bytes())]), gzip(ASC.as_bytes())] {
        let grid = check(put(&folder, "a.bin", &bytes), &Options::default(), &[4.0, nan, 6.0, 1.0, 2.0, 3.0]);
        assert_eq!((grid.origin, grid.cell, grid.integer), ([11.0, 20.0], [2.0, 4.0], true));
    }
    let hgt: Vec<u8> = [1i16, 2, -32768, 4].iter().flat_map(|v| v.to_be_bytes()).collect();
    let check_hgt = |name: &str, bytes: &[u8]| {
        let grid = check(put(&folder, name, bytes), &source_crs(), &[nan, 4.0, 1.0, 2.0]);
        assert_eq!(grid.crs.unwrap().origin, [-66.0, -46.0]);
    };
    check_hgt("S46W066.hgt", &hgt);
    check_hgt("s46w066.SRTMGL1.hgt.gz", &gzip(&hgt));
    let notes: (&str, &[u8]) = ("readme.txt", b"");
    check_hgt("tile.zip", &zip_of(&[notes, ("S46W066.hgt", &hgt)]));
    check_hgt("tile.zip", &zip_of(&[("__MACOSX/._S46W066.hgt", b"x"), ("deep/S46W066.HGT", &hgt)]));
    let tiff = tiff!(colortype::GrayI16, 2, 2, [1i16, 2, 3, 4], &Tags::utm());
    check(
        put(&folder, "a.zip", &zip_of(&[("a.tif", &tiff), ("a.tif.aux.xml", b"")])),
        &source_crs(),
        &[3.0, 4.0, 1.0, 2.0],
    );
    let png = png_bytes(::png::ColorType::Grayscale, ::png::BitDepth::Sixteen, 2, &[0, 1, 1, 0, 0, 3, 0, 4]);
    let options = Options { cell: Some(160.0), height_scale: Some(0.1), ..Options::default() };
    let grid = check(put(&folder, "a.png", &png), &options, &[3.0, 4.0, 1.0, 256.0]);
    assert_eq!((grid.cell, grid.height_scale, grid.origin), ([160.0; 2], 0.1, [0.0; 2]));
    let raw: Vec<u8> = [1.5f32, 2.0, 3.0, 4.0].iter().flat_map(|v| v.to_le_bytes()).collect();
    let raw_options =
        Options { cell: Some(1.0), raw: Some("2x2:f32".parse().unwrap()), ..Options::default() };
    check(put(&folder, "a.raw", &raw), &raw_options, &[3.0, 4.0, 1.5, 2.0]);
    check(put(&folder, "a.raw.gz", &gzip(&raw)), &raw_options, &[3.0, 4.0, 1.5, 2.0]);
}

/// A USGS DEM of two columns, the second one sample shorter and higher.
fn usgs() -> Vec<u8> {
    let mut a = vec![b' '; 1024];
    let mut field = |at: usize, text: &str| a[at..at + text.len()].copy_from_slice(text.as_bytes());
    field(144, "     1     1     1    10");
    field(528, "     2     2     4");
    field(816, "0.300000E+020.300000E+020.100000E+01     1     2");
    let column = |x: &str, y: &str, heights: &[&str]| {
        let zero = "   0.000000000000000D+00";
        let counts = format!("     1     1{:6}     1", heights.len());
        let text = format!("{counts}{x:>24}{y:>24}{zero}{zero}{zero}{}", heights.concat());
        format!("{text:<1024}").into_bytes()
    };
    let b = column("0.5D+06", "0.51D+07", &["   100", "   101", "-32767"]);
    let c = column("0.50003D+06", "5100030.0", &["   202", "   203"]);
    [a, b, c].concat()
}

#[test]
fn a_usgs_dem_is_padded_where_its_columns_are_ragged() {
    let folder = folder();
    let source = open(&[put(&folder, "a.dem", &usgs())], &Options::default()).unwrap();
    let nan = f64::NAN;
    assert_eq!(format!("{:?}", whole_grid(&source)), format!("{:?}", [100.0, nan, 101.0, 202.0, nan, 203.0]));
    assert_eq!(source.grid().crs.as_ref().unwrap().name, "EPSG:26710");
    assert_eq!(source.grid().origin, [500_000.0, 5_100_000.0]);
    assert!(source.grid().integer);
}

// Behind the macro that they use.
mod errors;
mod geotiff;
mod imagery;
mod real;
