//! What is refused, in which words; and that damage is no panic.

use super::*;

/// One row of the table: what is wrong, the file's name and bytes, options, words the message must have.
type Case = (&'static str, &'static str, Vec<u8>, Options, &'static [&'static str]);

fn cases() -> Vec<Case> {
    let plain = Options::default;
    let epsg = |code| Options { crs: CrsChoice::Epsg(code), ..Options::default() };
    let small = tiff!(colortype::GrayI16, 8, 8, [1i16; 64], &Tags::utm());
    let packed = Tags { compression: Compression::Lzw, ..Tags::utm() };
    let packed = tiff!(colortype::GrayI16, 8, 8, [1i16; 64], &packed);
    let bad_nodata = Tags { nodata: Some("none"), ..Tags::utm() };
    let bad_nodata = tiff!(colortype::GrayI16, 8, 8, [1i16; 64], &bad_nodata);
    let colour = tiff!(colortype::RGB8, 2, 2, [1u8; 12], &Tags::utm());
    let absurd = |tiled: bool| {
        let kind = if tiled { (324, 325) } else { (273, 279) };
        let size = [(256, 4, 1, 4_000_000_000), (257, 4, 1, 4_000_000_000), (258, 3, 1, 16)];
        let rest = [(262, 3, 1, 1), (kind.0, 4, 1, 8), (kind.1, 4, 1, 8), (322, 4, 1, 16), (323, 4, 1, 16)];
        raw_tiff(&[&size[..], &rest[..]].concat(), &[])
    };
    let big = [(256, 4, 1, 16_000_000), (257, 4, 1, 16_000_000), (258, 3, 1, 16), (262, 3, 1, 1)];
    let listed = [(273, 4, 1, 8), (279, 4, 1, 8)];
    let one_strip = raw_tiff(&[&big[..], &listed[..], &[(259, 3, 1, 5)]].concat(), &[]);
    let many = raw_tiff(&[&big[..], &[(273, 4, u32::MAX, 8)]].concat(), &[]);
    let side = [(256, 4, 1, 16), (257, 4, 1, 16), (258, 3, 1, 8), (262, 3, 1, 1)];
    let cut = raw_tiff(&[&side[..], &[(273, 4, 1, 122), (279, 4, 1, 256)]].concat(), &[0; 136]);
    let hgt = vec![0; 1200];
    let grey = png_bytes(::png::ColorType::Grayscale, ::png::BitDepth::Eight, 2, &[1; 4]);
    let rgb = png_bytes(::png::ColorType::Rgb, ::png::BitDepth::Eight, 2, &[1; 12]);
    let text = |t: &str| t.as_bytes().to_vec();
    let cut_usgs = usgs()[..1100].to_vec();
    vec![
        ("truncated", "a.tif", small[..small.len() - 40].to_vec(), plain(), &["directory"]),
        ("cut samples", "a.tif", cut, plain(), &["256 bytes", "a file of 222 bytes", "fetch it again"]),
        ("truncated, packed", "a.tif", packed[..40].to_vec(), plain(), &["inside the file"]),
        ("cut in the header", "a.tif", small[..9].to_vec(), plain(), &["directory"]),
        ("absurd strips", "a.tif", absurd(false), plain(), &["4000000000", "16777216"]),
        ("absurd tiles", "a.tif", absurd(true), plain(), &["4000000000", "16777216"]),
        ("one huge strip", "a.tif", one_strip, plain(), &["strips or tiles"]),
        ("a list beyond the file", "a.tif", many, plain(), &["inside the file", "273"]),
        ("colour TIFF", "a.tif", colour, plain(), &["3 bands", "gdal_translate -b 1"]),
        ("empty", "a.tif", Vec::new(), plain(), &["an empty file"]),
        ("no DEM", "a.txt", text("Dear reader,\n"), plain(), &["dear reader", "GeoTIFF"]),
        ("binary", "a.bin", vec![0, 1, 2, 3], plain(), &["00, 01, 02, 03"]),
        ("colour PNG", "a.png", rgb, plain(), &["imagery", "greyscale"]),
        ("PNG without --cell", "a.png", grey.clone(), plain(), &["--cell METRES"]),
        ("PNG cut", "a.png", grey[..50].to_vec(), plain(), &["a whole PNG"]),
        (
            "nodata out of range",
            "a.tif",
            small.clone(),
            Options { nodata: Some(-99_999.0), ..plain() },
            &["i16", "-99999", "--nodata"],
        ),
        (
            "nodata infinite",
            "a.tif",
            small.clone(),
            Options { nodata: Some(f64::INFINITY), ..plain() },
            &["i16", "inf", "--nodata"],
        ),
        ("nodata unreadable", "a.tif", bad_nodata, plain(), &["'none'", "--nodata"]),
        ("no CRS", "a.asc", text(ASC), epsg(32632), &["EPSG:32632", "none in the file"]),
        ("no CRS, no place", "a.png", grey, epsg(32632), &["EPSG:32632", "none in the file"]),
        ("unknown EPSG", "a.tif", small.clone(), epsg(99_999), &["EPSG:99999", "known"]),
        ("geographic EPSG", "a.tif", small.clone(), epsg(4326), &["degree"]),
        ("useless cell", "a.tif", small.clone(), Options { cell: Some(5.0), ..plain() }, &["--cell"]),
        ("cell 0", "a.tif", small.clone(), Options { cell: Some(0.0), ..plain() }, &["--cell above 0"]),
        ("oblong .hgt", "N00E000.hgt", hgt, plain(), &["a square", "1200 bytes"]),
        ("nameless .hgt", "alps.hgt", vec![0; 8], plain(), &["N46E008", "alps.hgt"]),
        ("few values", "a.asc", text(&ASC.replace(" 6", "")), plain(), &["6 values", "5 values"]),
        ("many values", "a.asc", text(&format!("{ASC} 7")), plain(), &["6 values", "more"]),
        ("words", "a.asc", text(&ASC.replace(" 6", " x")), plain(), &["numbers", "'x'"]),
        ("no size", "a.asc", text("ncols 3\ncellsize 1\n1"), plain(), &["'nrows'"]),
        ("absurd .asc", "a.asc", text("ncols 4e9\n"), plain(), &["sizes from 1", "ncols"]),
        ("long word", "a.asc", text(&format!("ncols {}", "1".repeat(99))), plain(), &["at most 64"]),
        ("no grid in zip", "a.zip", zip_of(&[("a.txt", b"x")]), plain(), &["exactly one DEM", "0 among 1"]),
        (
            "two grids",
            "a.zip",
            zip_of(&[("a.asc", ASC.as_bytes()), ("b.asc", ASC.as_bytes())]),
            plain(),
            &["2 among 2"],
        ),
        ("broken zip", "a.zip", b"PK\x03\x04xxxxxxx".to_vec(), plain(), &["zip"]),
        ("broken gzip", "a.asc.gz", gzip(ASC.as_bytes())[..30].to_vec(), plain(), &["a whole gzip"]),
        ("cut USGS", "a.dem", cut_usgs, plain(), &["2 columns"]),
        (
            "raw of another size",
            "a.raw",
            vec![0; 10],
            Options { raw: Some("2x2:i16".parse().unwrap()), cell: Some(1.0), ..plain() },
            &["8 bytes", "10 bytes"],
        ),
    ]
}

#[test]
fn errors_name_file_expected_found_and_remedy() {
    let folder = folder();
    for (what, name, bytes, options, words) in cases() {
        let path = put(&folder, name, &bytes);
        let message = match open(&[path], &options) {
            Err(e) => e.to_string(),
            Ok(source) => panic!("{what}: opened as {:?}", source.grid()),
        };
        for word in words.iter().chain(&[name, "expected ", ", found ", ": "]) {
            assert!(message.contains(word), "{what}: no '{word}' in: {message}");
        }
    }
    let refused = |paths: &[PathBuf]| open(paths, &Options::default()).unwrap_err().to_string();
    assert!(refused(&[folder.path().to_owned()]).contains("a directory"));
    assert!(refused(&[folder.path().join("nowhere.tif")]).contains("nowhere.tif"));
    assert!(refused(&[]).contains("at least one"));
}

#[test]
fn a_rotated_transform_is_refused() {
    let folder = folder();
    let mut bytes = Cursor::new(Vec::new());
    let mut encoder = TiffEncoder::new(&mut bytes).unwrap();
    let mut image = encoder.new_image::<colortype::Gray8>(2, 2).unwrap();
    let mut matrix = [0.0; 16];
    matrix[..8].copy_from_slice(&[30.0, 5.0, 0.0, 1e5, 5.0, -30.0, 0.0, 1e6]);
    image.encoder().write_tag(Tag::ModelTransformationTag, &matrix[..]).unwrap();
    image.write_data(&[1u8; 4]).unwrap();
    let path = put(&folder, "a.tif", &bytes.into_inner());
    let message = open(&[path], &Options::default()).unwrap_err().to_string();
    assert!(message.contains("rotated") && message.contains("gdalwarp"), "{message}");
}

#[test]
fn files_off_the_grid_are_refused_by_both_names() {
    let folder = folder();
    let first = put(&folder, "first.tif", &tiff!(colortype::GrayI16, 4, 4, [1i16; 16], &Tags::utm()));
    let other = |tags: &Tags| {
        let second = put(&folder, "second.tif", &tiff!(colortype::GrayI16, 4, 4, [1i16; 16], tags));
        open(&[first.clone(), second], &Options::default()).unwrap_err().to_string()
    };
    let cell = other(&Tags { step: 31.0, ..Tags::utm() });
    let offset = other(&Tags { origin: [500_010.0, 5_000_000.0], ..Tags::utm() });
    let crs = other(&Tags::new(&[[1024, 0, 1, 1], [3072, 0, 1, 32633]]));
    let far = other(&Tags { origin: [500_000.0 + 30e8, 5_000_000.0], ..Tags::utm() });
    let wanted = ["cells of 30 x 30", "0.333", "EPSG:32633", "samples a side"];
    for (message, word) in [cell, offset, crs, far].iter().zip(wanted) {
        for word in [word, "first.tif", "second.tif"] {
            assert!(message.contains(word), "no '{word}' in: {message}");
        }
    }
}

#[test]
fn tiles_across_the_antimeridian_are_neighbours() {
    let folder = folder();
    let hgt: Vec<u8> = (1..=9i16).flat_map(i16::to_be_bytes).collect();
    let paths = [put(&folder, "N10E179.hgt", &hgt), put(&folder, "N10W180.hgt", &hgt)];
    let source = open(&paths, &source_crs()).unwrap();
    assert_eq!((source.grid().width, source.grid().height), (5, 3));
    assert_eq!(whole_grid(&source)[..5], [7.0, 8.0, 9.0, 8.0, 9.0]);
    let projected = open(&paths, &Options::default()).unwrap();
    assert!(whole_grid(&projected).iter().any(|v| !v.is_nan()));
}

/// Bytes changed anywhere give an error or values, never a panic.
#[test]
fn damaged_files_do_not_panic() {
    let folder = folder();
    let samples: Vec<i16> = (0..32 * 32).map(pattern).collect();
    let packed = Tags { compression: Compression::Deflate(DeflateLevel::Fast), ..Tags::utm() };
    let lzw = Tags { compression: Compression::Lzw, predictor: Predictor::Horizontal, ..Tags::utm() };
    let files = [
        ("a.tif", tiff!(colortype::GrayI16, 32, 32, samples, &Tags::utm())),
        ("a.tif", tiff!(colortype::GrayI16, 32, 32, samples, &packed)),
        ("a.tif", tiff!(colortype::GrayI16, 32, 32, samples, &lzw)),
        ("a.dem", usgs()),
        ("a.asc", ASC.as_bytes().to_vec()),
        ("a.zip", zip_of(&[("a.asc", ASC.as_bytes())])),
    ];
    let mut random = 0x2545_f491_4f6c_dd1d_u64;
    let mut next = |below: usize| {
        random ^= random << 13;
        random ^= random >> 7;
        random ^= random << 17;
        usize::try_from(random % below as u64).unwrap()
    };
    for (name, bytes) in files {
        for round in 0..600 {
            let mut bytes = bytes.clone();
            for _ in 0..=next(3) {
                // Half the changes hit the ends, where headers and directories lie.
                let at = if round % 2 == 0 {
                    next(bytes.len())
                } else {
                    bytes.len() - 1 - next(bytes.len().min(400))
                };
                bytes[at] = u8::try_from(next(256)).unwrap();
            }
            let path = put(&folder, name, &bytes);
            for options in [Options::default(), source_crs()] {
                if let Ok(source) = open(std::slice::from_ref(&path), &options) {
                    let (w, h) = (source.grid().width.min(64), source.grid().height.min(64));
                    let _ = source.read(0, 0, w, h, &mut Vec::new());
                }
            }
        }
    }
}
