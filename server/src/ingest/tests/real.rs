//! Claims about every real DEM at hand.

use super::*;

fn real_data() -> Option<PathBuf> {
    let beside = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared/data");
    let folder = std::env::var_os("DIAMANTINA_DATA").map_or(beside, PathBuf::from);
    let found = folder.join("MANIFEST.tsv").is_file();
    if !found {
        eprintln!("SKIPPED: no real DEMs at {} (set DIAMANTINA_DATA)", folder.display());
    }
    found.then_some(folder)
}

#[test]
fn every_real_dem_is_as_its_manifest_says() {
    let Some(folder) = real_data() else { return };
    let manifest = fs::read_to_string(folder.join("MANIFEST.tsv")).unwrap();
    let names: Vec<&str> = manifest.lines().next().unwrap().split('\t').collect();
    for line in manifest.lines().skip(1) {
        let row: HashMap<&str, &str> = names.iter().copied().zip(line.split('\t')).collect();
        let file = row["file"];
        if file.contains("gcanyon_color") || file.contains("Benchmark_2_input") {
            continue;
        }
        let cell = file.ends_with(".png").then_some(1.0);
        // Degrees, though the file does not say so.
        let assume_crs = file.contains("hilo").then(|| NonZeroU32::new(4326)).flatten();
        let source = open(&[folder.join(file)], &Options { cell, assume_crs, ..source_crs() });
        let source = source.unwrap_or_else(|e| panic!("{e}"));
        let grid = source.grid();
        assert_eq!(row["cols"], grid.width.to_string(), "{file}");
        assert_eq!(row["rows"], grid.height.to_string(), "{file}");
        let (mut low, mut high, mut valid, mut out) = (f64::INFINITY, f64::NEG_INFINITY, 0u64, Vec::new());
        for y in (0..grid.height).step_by(512) {
            source.read(0, y, grid.width, 512.min(grid.height - y), &mut out).unwrap();
            for v in out.iter().filter(|v| !v.is_nan()) {
                (low, high, valid) = (low.min(*v), high.max(*v), valid + 1);
            }
        }
        let share = valid as f64 / (f64::from(grid.width) * f64::from(grid.height));
        let expected: f64 = row["valid_share"].parse().unwrap();
        assert!((share - expected).abs() < 6e-4, "{file}: valid {share}, manifest {expected}");
        for (found, name) in [(low, "min"), (high, "max")] {
            if let Ok(expected) = row[name].parse::<f64>() {
                let tolerance = 1e-5 * expected.abs().max(0.01);
                assert!((found - expected).abs() <= tolerance, "{file}: {name} {found}, manifest {expected}");
            }
        }
        if row["crs"].starts_with("EPSG:") {
            assert_eq!(grid.crs.as_ref().unwrap().name, row["crs"], "{file}");
        }
        let integer = row["dtype"].contains("int");
        assert!(grid.integer == integer || file.ends_with(".asc"), "{file}: integer {}", grid.integer);
    }
}

/// A real file without a CRS, whose longitudes run from 0 to 360, became a scene of 6 cm.
#[test]
fn the_real_file_of_degrees_without_a_crs_is_refused_and_built_as_told() {
    let Some(folder) = real_data() else { return };
    let path = [folder.join("hilo/hilo_grid_1_3_arsec.tif")];
    for options in [Options::default(), source_crs()] {
        let message = open(&path, &options).unwrap_err().to_string();
        let words = ["hilo_grid_1_3_arsec.tif", "look like degrees", "--assume-crs EPSG:4326"];
        assert!(words.iter().all(|w| message.contains(w)), "{message}");
    }
    let told = Options { assume_crs: NonZeroU32::new(4326), ..Options::default() };
    let source = open(&path, &told).unwrap();
    let grid = source.grid();
    // Hilo lies in zone 5; a third of an arc second is some 10 m.
    assert_eq!(grid.crs.as_ref().unwrap().name, "EPSG:32605");
    assert!((9.0..11.0).contains(&grid.cell[0]), "{:?}", grid.cell);
    let valid = whole_grid(&source).iter().filter(|v| !v.is_nan()).count();
    assert!(valid as f64 > 0.9 * 701.0 * 692.0, "{valid}");
}

/// `--crs auto` on every real DEM: degrees are resampled and keep their mean height and cell.
#[test]
fn every_real_dem_has_a_frame_in_metres() {
    let Some(folder) = real_data() else { return };
    let statistics = |source: &Source| {
        let valid: Vec<f64> = whole_grid(source).into_iter().filter(|v| !v.is_nan()).collect();
        let low = valid.iter().copied().fold(f64::INFINITY, f64::min);
        let high = valid.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        (low, high, valid.iter().sum::<f64>() / valid.len() as f64)
    };
    for file in DEGREES {
        let path = [folder.join(file)];
        let source = open(&path, &source_crs()).unwrap();
        let projected = open(&path, &Options::default()).unwrap();
        let crs = projected.grid().crs.as_ref().unwrap();
        assert!(projected.grid().resampled && crs.name.starts_with("EPSG:32"), "{}", crs.name);
        let (a, b) = (statistics(&source), statistics(&projected));
        let range = a.1 - a.0;
        // The mean over degrees weights the poleward rows a little more; bilinear values never overshoot.
        assert!((a.2 - b.2).abs() < 0.01 * range && b.0 >= a.0 && b.1 <= a.1, "{file}: {a:?} {b:?}");
        assert!(b.1 > a.1 - 0.1 * range, "{file}: {a:?} {b:?}");
        let natural = (source.grid().cell[0] * source.grid().cell[1]).sqrt();
        assert!(
            (projected.grid().cell[0] / natural - 1.0).abs() < 2e-3,
            "{file}: {:?}",
            projected.grid().cell
        );
    }
}

/// The real DEMs whose unit is the degree.
const DEGREES: [&str; 9] = [
    "jacksboro/jacksboro.tif",
    "okushiri/HNO1993.tif",
    "okushiri/OK03.tif",
    "okushiri/OK24.tif",
    "osgearth_terrain/mt_fuji_90m.tif",
    "osgearth_terrain/mt_rainier_90m.tif",
    "qgis_training/SRTM.tif",
    "srtm3_geotiff/N46E008.tif",
    "srtm3_nh/N44W072.hgt.gz",
];
