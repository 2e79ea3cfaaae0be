//! Patterns on the command line: which files are the steps of a series, and in what order.

use diamantina_server::ingest::{Grid, Source};
use std::path::{Path, PathBuf};

/// What a pattern has, and the name of a file seldom.
const MARKS: [char; 3] = ['*', '?', '['];

/// The steps of a series, at most: layers of a scene are counted by a byte, and there is one of ground at least.
pub(super) const STEPS_MAX: usize = 254;

/// Whether a path is a pattern: it looks like one, and no file is called so.
pub(super) fn is_pattern(path: &Path) -> bool {
    path.to_string_lossy().contains(MARKS) && !path.exists()
}

/// The files that match a pattern, in the order of the numbers in their names: `frame_2` before `frame_10`.
///
/// # Errors
/// When it is no pattern, a folder cannot be read, or there are no such files, or too many.
pub(super) fn files(pattern: &str) -> Result<Vec<PathBuf>, String> {
    let wrong = |what: String| format!("{pattern}: {what}");
    let paths = glob::glob(pattern)
        .map_err(|e| wrong(format!("expected a pattern with * and ?, such as 'frame_*.tif', found {e}")))?;
    let mut files = Vec::new();
    for path in paths {
        let path = path.map_err(|e| wrong(format!("cannot read {}: {}", e.path().display(), e.error())))?;
        if !path.is_dir() {
            files.push(path);
        }
    }
    if files.is_empty() {
        return Err(wrong("expected files that match, found none: is the folder right?".to_owned()));
    }
    if files.len() > STEPS_MAX {
        let found = files.len();
        return Err(wrong(format!(
            "expected at most {STEPS_MAX} files, found {found}: match fewer, as 'frame_*0.tif' does, or build several scenes"
        )));
    }
    files.sort_by(|a, b| alphanumeric_sort::compare_path(a, b));
    Ok(files)
}

/// Numbers in a name, in their order, and the text around them.
fn numbers(name: &str) -> (Vec<u64>, Vec<&str>) {
    let found = name.split(|c: char| !c.is_ascii_digit()).filter(|digits| !digits.is_empty());
    let text = name.split(|c: char| c.is_ascii_digit()).filter(|text| !text.is_empty()).collect();
    // A number too long for this is some identifier; two such differ in no gap.
    (found.map(|digits| digits.parse().unwrap_or(u64::MAX)).collect(), text)
}

/// Where numbers in the names of steps are missing, if so: they differ in one number, which mostly grows by a stride. A
/// constant stride, whatever it is, has no gap.
pub(super) fn gap(files: &[PathBuf]) -> Option<String> {
    let names: Vec<_> =
        files.iter().map(|file| file.file_name().unwrap_or_default().to_string_lossy()).collect();
    let told: Vec<_> = names.iter().map(|name| numbers(name)).collect();
    let (first, text) = told.first()?;
    let is_alike = |(other, words): &(Vec<u64>, Vec<&str>)| other.len() == first.len() && words == text;
    if !told.iter().all(is_alike) {
        return None;
    }
    let mut varying = (0..first.len()).filter(|i| told.iter().any(|(other, _)| other[*i] != first[*i]));
    let (Some(place), None) = (varying.next(), varying.next()) else { return None };
    let strides: Vec<u64> =
        told.windows(2).map(|pair| pair[1].0[place].saturating_sub(pair[0].0[place])).collect();
    let least = strides.iter().copied().filter(|stride| *stride > 0).min()?;
    let wide: Vec<usize> = (0..strides.len()).filter(|i| strides[*i] > least).collect();
    let from = *wide.first()?;
    let more = match wide.len() {
        1 => String::new(),
        count => format!(", and at {} more places", count - 1),
    };
    Some(format!(
        "no file between {} and {}, where numbers go by {least} elsewhere{more}: all steps take equally long, this one too",
        names[from],
        names[from + 1]
    ))
}

/// The name of the layer that is a step of a series. No layer that users name has a dot in it.
pub(super) fn step_name(series: &str, step: usize) -> String {
    format!("{series}.{step}")
}

/// Why two steps are not of one surface, if so: each lies on the samples of the first.
pub(super) fn differ([(first, a), (other, b)]: [(&[PathBuf], &Source); 2]) -> Option<String> {
    let ([a, b], name) = ([a.grid(), b.grid()], |files: &[PathBuf]| files[0].display().to_string());
    // Reprojected or not, places are computed alike: what is the same place is the same number, but for rounding.
    let is_near = |a: f64, b: f64, cell: f64| (a - b).abs() <= 1e-6 * cell;
    let is_same = (a.width, a.height) == (b.width, b.height)
        && (0..2).all(|i| {
            is_near(a.origin[i], b.origin[i], a.cell[i]) && is_near(a.cell[i], b.cell[i], 1e-3 * a.cell[i])
        });
    let told = |grid: &Grid| {
        format!(
            "{} x {} samples of {} x {} m from {}, {}",
            grid.width, grid.height, grid.cell[0], grid.cell[1], grid.origin[0], grid.origin[1]
        )
    };
    (!is_same).then(|| {
        format!(
            "{}: expected {}, as {} has, found {}: cut the steps of a series to one extent and one resolution \
             (gdalwarp -te -tr can), or make the pattern match fewer files",
            name(other),
            told(a),
            name(first),
            told(b)
        )
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn files_come_in_the_order_of_their_numbers() {
        let folder = tempfile::tempdir().unwrap();
        for name in
            ["frame_10.tif", "frame_2.tif", "frame_1.tif", "frame_003.tif", "frame_x.png", "other_0.tif"]
        {
            std::fs::write(folder.path().join(name), "").unwrap();
        }
        std::fs::create_dir(folder.path().join("frame_4.tif")).unwrap();
        let found = |pattern: &str| files(&folder.path().join(pattern).to_string_lossy());
        let names = |pattern: &str| -> Vec<String> {
            let name = |path: &PathBuf| path.file_name().unwrap().to_string_lossy().into_owned();
            found(pattern).unwrap().iter().map(name).collect()
        };
        assert_eq!(names("frame_*.tif"), ["frame_1.tif", "frame_2.tif", "frame_003.tif", "frame_10.tif"]);
        assert_eq!(names("frame_?.tif"), ["frame_1.tif", "frame_2.tif"]);
        assert_eq!(names("other_[0-9].tif"), ["other_0.tif"]);
        for (pattern, word) in [("none_*.tif", "found none"), ("frame_***.tif", "expected a pattern")] {
            let error = found(pattern).unwrap_err();
            assert!(error.contains(word) && error.contains(pattern), "{error}");
        }
        for i in 0..=STEPS_MAX {
            std::fs::write(folder.path().join(format!("many_{i}.asc")), "").unwrap();
        }
        let error = found("many_*.asc").unwrap_err();
        assert!(error.contains("at most 254 files, found 255"), "{error}");
        assert_eq!(names("many_*1.asc").len(), 26);
    }

    #[test]
    fn a_gap_in_the_numbers_is_told() {
        let told = |names: &[&str]| gap(&names.iter().map(PathBuf::from).collect::<Vec<_>>());
        let gap = told(&["a/f_0.tif", "a/f_1.tif", "a/f_3.tif"]).unwrap();
        assert!(gap.starts_with("no file between f_1.tif and f_3.tif") && gap.contains("go by 1 "), "{gap}");
        let more = told(&["sea2_0000.tif", "sea2_0010.tif", "sea2_0030.tif", "sea2_0050.tif"]).unwrap();
        assert!(more.contains("sea2_0010.tif and sea2_0030.tif"), "{more}");
        assert!(more.contains("go by 10 ") && more.contains("at 1 more places"), "{more}");
        for even in [
            &["f_0.tif", "f_10.tif", "f_20.tif"][..],
            &["f_7.tif"],
            &["f_7.tif", "f_9.tif"],
            // Days and hours are no count.
            &["d_1_h_1.tif", "d_1_h_2.tif", "d_2_h_4.tif"],
            &["ebb.tif", "flood.tif", "slack.tif"],
        ] {
            assert_eq!(told(even), None, "{even:?}");
        }
    }

    #[test]
    fn a_file_that_looks_like_a_pattern_is_a_file() {
        let folder = tempfile::tempdir().unwrap();
        let odd = folder.path().join("sea[1].tif");
        assert!(is_pattern(&odd) && is_pattern(Path::new("a?b")) && !is_pattern(Path::new("none.tif")));
        std::fs::write(&odd, "").unwrap();
        assert!(!is_pattern(&odd));
    }
}
