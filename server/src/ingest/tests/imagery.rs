//! Pictures of 64 x 48 pixels of 20 m, whose quarters have one colour each: small files that nothing here could write.

use super::super::Imagery;
use super::*;

/// South-west, south-east, north-west, north-east.
const QUARTERS: [[u8; 3]; 4] = [[40, 60, 190], [220, 210, 120], [200, 40, 30], [30, 160, 60]];

/// Ground in the pictures' own system.
fn ground(folder: &TempDir) -> Source {
    let values: Vec<u16> = (0..9 * 7).collect();
    let path = put(folder, "dem.tif", &tiff!(colortype::Gray16, 9, 7, values, &Tags::utm()));
    open(&[path], &Options::default()).unwrap()
}

fn check(imagery: &Imagery, off: u8, is_empty: impl Fn(usize, usize) -> bool) {
    let grid = imagery.grid();
    assert_eq!(
        ([grid.width, grid.height], grid.origin, grid.cell),
        ([64, 48], [500_010.0, 5_000_010.0], [20.0; 2])
    );
    let mut pixels = Vec::new();
    imagery.read([-3, -2], [70, 52], &mut pixels).unwrap();
    for (i, pixel) in pixels.iter().enumerate() {
        let (x, y) = (i % 70, i / 70);
        if !(3..67).contains(&x) || !(2..50).contains(&y) || is_empty(x - 3, y - 2) {
            assert_eq!(*pixel, [0; 4], "{x} {y}");
            continue;
        }
        let expected = QUARTERS[usize::from(x - 3 >= 32) + 2 * usize::from(y - 2 >= 24)];
        assert_eq!(pixel[3], 255);
        // JPEG of half as many colours as brightnesses mixes those of a block.
        if off > 0 && ((29..35).contains(&(x - 3)) || (14..34).contains(&(y - 2))) {
            continue;
        }
        let most = (0..3).map(|band| pixel[band].abs_diff(expected[band])).max().unwrap();
        assert!(most <= off, "{x} {y}: {pixel:?}, expected {expected:?}");
    }
}

#[test]
fn jpeg_lies_where_its_world_file_says() {
    let folder = folder();
    let first = ground(&folder);
    let path = put(&folder, "quarters.jpg", include_bytes!("quarters.jpg"));
    put(&folder, "quarters.jgw", b"20\n0\n0\n-20\n500010\n5000950\n");
    let options = Options { assume_crs: NonZeroU32::new(32632), ..Options::default() };
    check(&Imagery::open(&[path], &options, &first).unwrap(), 4, |_, _| false);
}

#[test]
fn tiffs_of_tiles_of_jpeg_and_of_a_plane_for_each_band_are_read() {
    let folder = folder();
    let first = ground(&folder);
    let jpeg = put(&folder, "jpeg.tif", include_bytes!("quarters_jpeg.tif"));
    check(&Imagery::open(&[jpeg], &Options::default(), &first).unwrap(), 4, |_, _| false);
    // Three bands that nobody calls red, green and blue.
    let unnamed = put(&folder, "unnamed.tif", include_bytes!("quarters_unnamed.tif"));
    check(&Imagery::open(&[unnamed], &Options::default(), &first).unwrap(), 0, |_, _| false);
    // 16 x 8 pixels of its north-west corner are the value that it declares as none.
    let planar = put(&folder, "planar.tif", include_bytes!("quarters_planar.tif"));
    check(&Imagery::open(&[planar], &Options::default(), &first).unwrap(), 0, |x, y| x < 16 && y >= 40);
}

#[test]
fn whatever_is_cut_off_or_garbled_is_refused_or_read() {
    let folder = folder();
    let first = ground(&folder);
    put(&folder, "a.jgw", b"20\n0\n0\n-20\n500010\n5000950\n");
    let options = Options { assume_crs: NonZeroU32::new(32632), ..Options::default() };
    let files: [(&str, &[u8]); 3] = [
        ("a.jpg", include_bytes!("quarters.jpg")),
        ("a.tif", include_bytes!("quarters_jpeg.tif")),
        ("b.tif", include_bytes!("quarters_planar.tif")),
    ];
    let mut state = 1u64;
    for (name, bytes) in files {
        for round in 0..150 {
            let mut bytes = bytes.to_vec();
            for _ in 0..=round % 3 {
                state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
                let at = usize::try_from(state >> 33).unwrap() % bytes.len();
                bytes[at] = state.to_le_bytes()[2];
            }
            if round % 5 == 0 {
                bytes.truncate(bytes.len() * (round + 1) / 151);
            }
            let path = put(&folder, name, &bytes);
            if let Ok(imagery) = Imagery::open(&[path], &options, &first) {
                let _ = imagery.read([0, 0], [64, 48], &mut Vec::new());
            }
        }
    }
}
