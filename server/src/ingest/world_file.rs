//! World files: six numbers in a text beside a picture, which tell where it lies.
//!
//! In this order: metres (or degrees) of a pixel to the east; two of rotation; of a pixel to the north, below 0 where rows
//! run from north to south; east and north of the centre of the first pixel of the first row.

use std::fs::File;
use std::io::{self, Read};
use std::path::{Path, PathBuf};

use super::error::{Result, broken, io_error, unsupported};
use super::raster::Place;

/// A world file has some hundred bytes.
const BYTES_MAX: u64 = 4096;

/// The names that a world file of a picture may have: of `photo.jpg` `photo.jgw`, `photo.jpgw`, `photo.jpg.wld`... and
/// `photo.wld`, as GDAL looks for them.
fn names(path: &Path) -> Vec<PathBuf> {
    let extension = path.extension().and_then(|e| e.to_str()).unwrap_or_default();
    let mut endings = Vec::new();
    let letters: Vec<char> = extension.chars().collect();
    if let [first, .., last] = letters[..] {
        endings.extend([format!("{first}{last}w"), format!("{extension}w")]);
    }
    endings.push("wld".to_owned());
    let upper: Vec<String> = endings.iter().map(|ending| ending.to_ascii_uppercase()).collect();
    endings.extend(upper);
    endings.into_iter().map(|ending| path.with_extension(ending)).collect()
}

/// Where a picture of so many rows lies, if there is a world file of it.
pub(super) fn find(path: &Path, height: u32) -> Result<Option<Place>> {
    for name in names(path) {
        let mut file = match File::open(&name) {
            Ok(file) => file,
            Err(e) if e.kind() == io::ErrorKind::NotFound => continue,
            Err(e) => return Err(io_error(&name, "open it")(e)),
        };
        let mut bytes = Vec::new();
        Read::by_ref(&mut file)
            .take(BYTES_MAX)
            .read_to_end(&mut bytes)
            .map_err(io_error(&name, "read it"))?;
        return place(&name, &String::from_utf8_lossy(&bytes), height).map(Some);
    }
    Ok(None)
}

fn place(name: &Path, text: &str, height: u32) -> Result<Place> {
    // Some write commas for points.
    let numbers: Option<Vec<f64>> =
        text.split_whitespace().map(|word| word.replace(',', ".").parse().ok()).collect();
    let numbers = numbers.filter(|numbers| numbers.len() == 6 && numbers.iter().all(|v| v.is_finite()));
    let Some([east, b, d, north, x, y]) = numbers.as_deref().and_then(|n| <[f64; 6]>::try_from(n).ok())
    else {
        let found = format!("'{}'", text.chars().take(60).collect::<String>().escape_default());
        return Err(broken(
            name,
            "six numbers of a world file",
            found,
            "write it again, as gdal_translate -co WORLDFILE=YES does",
        ));
    };
    if b != 0.0 || d != 0.0 || east <= 0.0 || north >= 0.0 {
        return Err(unsupported(
            name,
            "rows from north to south and columns from west to east",
            format!("steps of ({east}, {d}) and ({b}, {north})"),
            "warp the picture upright, for instance with gdalwarp",
        ));
    }
    let origin = [x, y + north * f64::from(height.saturating_sub(1))];
    Ok(Place { origin, step: [east, -north], crs: None })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn six_numbers_tell_where_the_south_west_pixel_is() {
        let found = place(Path::new("a.jgw"), "0.5\n0\n0\r\n-0,25\n1000\n2000\n", 5).unwrap();
        assert_eq!((found.origin, found.step), ([1000.0, 1999.0], [0.5, 0.25]));
        for wrong in ["", "1 0 0 -1 5", "1 0 0 -1 5 x", "1 0.1 0 -1 5 6", "1 0 0 1 5 6", "inf 0 0 -1 5 6"] {
            assert!(place(Path::new("a.jgw"), wrong, 5).is_err(), "{wrong}");
        }
    }

    #[test]
    fn it_is_named_after_the_picture() {
        let names: Vec<_> = names(Path::new("a/photo.v2.jpeg")).into_iter().take(3).collect();
        assert_eq!(names, ["a/photo.v2.jgw", "a/photo.v2.jpegw", "a/photo.v2.wld"].map(PathBuf::from));
    }
}
