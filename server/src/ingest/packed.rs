//! Packed files (gzip, zip) → what is in them, in temporary files that vanish when closed.

use std::fs::File;
use std::io::{BufReader, Read, Seek, SeekFrom, Write};
use std::path::Path;

use super::error::{Result, broken, io_error, unsupported};

/// What a file may unpack to: some 600 of the largest `.hgt`.
const UNPACKED_BYTES_MAX: u64 = 64 << 30;

/// How the names of DEMs in an archive end.
const ENDINGS: [&str; 6] = [".asc", ".dem", ".hgt", ".png", ".tif", ".tiff"];

/// What is in a gzip.
pub(super) fn gunzip(path: &Path, file: File) -> Result<File> {
    let failed = |e: std::io::Error| {
        broken(path, "a whole gzip", e.to_string(), "the file was cut short or damaged: fetch it again")
    };
    unpack(path, flate2::read::MultiGzDecoder::new(BufReader::new(file)), failed)
}

/// The only DEM in a zip archive, with its name in lower case.
pub(super) fn unzip(path: &Path, file: File) -> Result<(File, String)> {
    let failed = |reason: String| {
        broken(path, "a readable zip archive", reason, "fetch it again, or unzip it and give the DEM itself")
    };
    let mut archive = zip::ZipArchive::new(BufReader::new(file)).map_err(|e| failed(e.to_string()))?;
    // Names that are not text cannot have these endings either.
    let names = archive.file_names().filter_map(|name| Some(name.ok()?.into_owned()));
    let dems: Vec<String> = names
        .filter(|name| {
            let hidden = name.rsplit('/').next().is_some_and(|last| last.starts_with('.'));
            !hidden && ENDINGS.iter().any(|ending| name.to_lowercase().ends_with(ending))
        })
        .collect();
    let [name] = &dems[..] else {
        return Err(unsupported(
            path,
            format!("exactly one DEM in the archive ({})", ENDINGS.join(" ")),
            format!("{} among {} files", dems.len(), archive.len()),
            "unzip it and give the DEMs themselves",
        ));
    };
    let entry = archive.by_name(name).map_err(|e| failed(e.to_string()))?;
    let unpacked = unpack(path, entry, |e| failed(e.to_string()))?;
    let last = name.rsplit('/').next().unwrap_or(name);
    Ok((unpacked, last.to_lowercase()))
}

/// Copies all that `reader` has into a temporary file.
fn unpack(
    path: &Path,
    mut reader: impl Read,
    failed: impl Fn(std::io::Error) -> super::IngestError,
) -> Result<File> {
    let mut unpacked = tempfile::tempfile().map_err(io_error(path, "create a temporary file"))?;
    let mut buffer = vec![0; 1 << 18];
    let mut total = 0;
    loop {
        let read = reader.read(&mut buffer).map_err(&failed)?;
        if read == 0 {
            break;
        }
        total += read as u64;
        if total > UNPACKED_BYTES_MAX {
            let expected = format!("at most {UNPACKED_BYTES_MAX} bytes when unpacked");
            return Err(broken(path, expected, "more", "unpack it and give the file itself"));
        }
        unpacked.write_all(&buffer[..read]).map_err(io_error(path, "write a temporary file"))?;
    }
    unpacked.seek(SeekFrom::Start(0)).map_err(io_error(path, "rewind a temporary file"))?;
    Ok(unpacked)
}
