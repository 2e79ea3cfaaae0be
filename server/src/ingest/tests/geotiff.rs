//! TIFFs as others pack them, some written by hand.

use super::*;

/// The bytes of the only strip of a TIFF.
fn strip(bytes: &[u8]) -> Vec<u8> {
    let mut decoder = tiff::decoder::Decoder::new(Cursor::new(bytes)).unwrap();
    let mut tag = |tag| usize::try_from(decoder.get_tag_u64(tag).unwrap()).unwrap();
    let (at, length) = (tag(Tag::StripOffsets), tag(Tag::StripByteCounts));
    bytes[at..at + length].to_vec()
}

/// One LZW tile in ten at the right side of whole files was called damaged.
#[test]
fn a_packed_tile_beyond_the_image_reads_to_its_last_row() {
    let folder = folder();
    for pattern in 0..200usize {
        let sample = |x: usize, y: usize| match pattern % 3 {
            0 => (x / 8 * 7 + y * (pattern + 1)) % 251,
            1 => (x * y * pattern + x * x) % 7,
            _ => (x * 31 + y * 17 + x * y * pattern) % 256,
        };
        let samples: Vec<u8> = (0..256).map(|i| u8::try_from(sample(i % 16, i / 16)).unwrap()).collect();
        let packed = Tags { compression: Compression::Lzw, rows_per_strip: 16, ..Tags::new(&[]) };
        let data = strip(&tiff!(colortype::Gray8, 16, 16, samples, &packed));
        let length = u32::try_from(data.len()).unwrap();
        // One tile of 16 x 16, of which the image is the first 6 columns and 16 rows.
        let bytes = raw_tiff(
            &[
                (256, 4, 1, 6),
                (257, 4, 1, 16),
                (258, 3, 1, 8),
                (259, 3, 1, 5),
                (262, 3, 1, 1),
                (277, 3, 1, 1),
                (322, 4, 1, 16),
                (323, 4, 1, 16),
                (324, 4, 1, 8 + 2 + 10 * 12 + 4),
                (325, 4, 1, length),
            ],
            &data,
        );
        let path = put(&folder, "a.tif", &bytes);
        let source = open(&[path], &Options { cell: Some(1.0), ..Options::default() }).unwrap();
        let mut values = Vec::new();
        source.read(0, 0, 6, 16, &mut values).unwrap_or_else(|e| panic!("pattern {pattern}: {e}"));
        let expected = (0..16).rev().flat_map(|y| (0..6).map(move |x| (x, y)));
        let expected: Vec<f64> = expected.map(|(x, y)| f64::from(samples[y * 16 + x])).collect();
        assert_eq!(values, expected, "pattern {pattern}");
    }
}

#[test]
fn a_tiled_tiff_by_hand_reads_in_order() {
    let folder = folder();
    // Tags: size 20 x 18, 8 bits, two by two tiles of 16 x 16.
    let tile = |seed: u8| (0..256u32).map(move |i| seed.wrapping_add(u8::try_from(i % 16).unwrap()));
    let data: Vec<u8> = [0, 50, 100, 150].into_iter().flat_map(tile).collect();
    let directory = 8 + 2 + 12 * 10 + 4;
    let lists: Vec<u8> =
        (0..4u32).map(|i| directory + 32 + i * 256).chain([256; 4]).flat_map(u32::to_le_bytes).collect();
    let entries = [
        (256, 4, 1, 20),
        (257, 4, 1, 18),
        (258, 3, 1, 8),
        (259, 3, 1, 1),
        (262, 3, 1, 1),
        (277, 3, 1, 1),
        (322, 3, 1, 16),
        (323, 3, 1, 16),
        (324, 4, 4, directory),
        (325, 4, 4, directory + 16),
    ];
    let bytes = raw_tiff(&entries, &[lists, data].concat());
    let path = put(&folder, "a.tif", &bytes);
    assert!(
        open(std::slice::from_ref(&path), &Options::default()).unwrap_err().to_string().contains("--cell")
    );
    let source = open(&[path], &Options { cell: Some(2.0), ..Options::default() }).unwrap();
    let all = whole_grid(&source);
    // The north-west sample is the first of tile 0; south-east is in tile 3.
    assert_eq!((all[17 * 20], all[17 * 20 + 19], all[0], all[19]), (0.0, 53.0, 100.0, 153.0));
    assert_eq!(source.grid().cell, [2.0, 2.0]);
}

/// Entries of a one-strip TIFF of 32-bit floats, `length` bytes right behind the directory.
fn float_strip(
    width: u32,
    height: u32,
    compression: u32,
    predictor: u32,
    length: u32,
) -> Vec<(u16, u16, u32, u32)> {
    vec![
        (256, 4, 1, width),
        (257, 4, 1, height),
        (258, 3, 1, 32),
        (259, 3, 1, compression),
        (262, 3, 1, 1),
        (273, 4, 1, 8 + 2 + 12 * 10 + 4),
        (277, 3, 1, 1),
        (279, 4, 1, length),
        (317, 3, 1, predictor),
        (339, 3, 1, 3),
    ]
}

#[test]
fn zstd_and_the_float_predictor_unpack() {
    let folder = folder();
    let values = [[1.5f32, -2.25, 1e-3, 7e5], [0.0, 3.5, -8.125, 4e8]];
    // Predictor 3: the bytes of a row sorted by significance, the highest first, then differences.
    let row = |row: [f32; 4]| {
        let mut bytes: Vec<u8> = (0..4).flat_map(|k| row.map(|v| v.to_be_bytes()[k])).collect();
        (1..bytes.len()).rev().for_each(|i| bytes[i] = bytes[i].wrapping_sub(bytes[i - 1]));
        bytes
    };
    let plain: Vec<u8> = values.iter().flatten().flat_map(|v| v.to_le_bytes()).collect();
    for (predictor, bytes) in [(1, plain), (3, values.into_iter().flat_map(row).collect())] {
        let packed = zstd::encode_all(&bytes[..], 3).unwrap();
        let length = u32::try_from(packed.len()).unwrap();
        let path = put(&folder, "a.tif", &raw_tiff(&float_strip(4, 2, 50000, predictor, length), &packed));
        let source = open(&[path], &Options { cell: Some(1.0), ..Options::default() }).unwrap();
        let expected: Vec<f64> = values.iter().rev().flatten().map(|v| f64::from(*v)).collect();
        assert_eq!(whole_grid(&source), expected, "predictor {predictor}");
    }
}

#[test]
fn big_tiff_and_big_endian_read_the_same() {
    let folder = folder();
    let samples: Vec<u16> = (0..30).map(|i| i * 2000).collect();
    let mut big = Cursor::new(Vec::new());
    TiffEncoder::new_big(&mut big).unwrap().write_image::<colortype::Gray16>(6, 5, &samples).unwrap();
    let short = |tag: u16, value: u16| [tag, 3, 0, 1, value, 0].map(u16::to_be_bytes).concat();
    let mut motorola = b"MM\0*\0\0\0\x08\0\x07".to_vec();
    for (tag, value) in [(256, 6), (257, 5), (258, 16), (262, 1), (273, 98), (277, 1), (279, 60)] {
        motorola.extend(short(tag, value));
    }
    motorola.extend([0; 4]);
    motorola.extend(samples.iter().flat_map(|v| v.to_be_bytes()));
    let expected: Vec<f64> = samples.chunks(6).rev().flatten().map(|v| f64::from(*v)).collect();
    for bytes in [big.into_inner(), motorola] {
        let options = Options { cell: Some(1.0), ..Options::default() };
        assert_eq!(whole_grid(&open(&[put(&folder, "a.tif", &bytes)], &options).unwrap()), expected);
    }
}
