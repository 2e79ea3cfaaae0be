//! Imagery: pictures laid into the frame that the heights of a scene have decided.
//!
//! A picture's bands are read as heights are, each through the same mosaic and the same reprojection; what is read are
//! pixels of red, green, blue and opacity.

use std::fs::File;
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use super::error::{Result, broken, io_error, options as bad_options, unsupported};
use super::geotiff::{self, ChunkCache};
use super::mosaic::Mosaic;
use super::over::lay;
use super::raster::{OPACITY, Raster, Wanted, Window};
use super::reproject::Reprojection;
use super::{Grid, IngestError, Options, Source, assume_crs, check_grid, jpeg, open_file, png};

/// One or several pictures, open for reading.
///
/// Holds what a [`Source`] holds, and shares its cache of decoded strips and tiles.
pub struct Imagery {
    grid: Grid,
    mosaic: Mosaic,
    reprojection: Option<Reprojection>,
}

impl std::fmt::Debug for Imagery {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Imagery").field("grid", &self.grid).finish_non_exhaustive()
    }
}

/// Chooses the format by content.
pub(super) fn detect(path: &Path, file: File, cache: &Arc<ChunkCache>) -> Result<Raster> {
    let mut start = vec![0; 64];
    let length = file.read_at(&mut start, 0).map_err(io_error(path, "read it"))?;
    start.truncate(length);
    match &start[..] {
        [] => Err(broken(path, "a picture", "an empty file", "fetch it again")),
        [b'I', b'I', 42 | 43, 0, ..] | [b'M', b'M', 0, 42 | 43, ..] => {
            geotiff::open(path, file, Arc::clone(cache), cache.name(), Wanted::Imagery)
        }
        [0x89, b'P', b'N', b'G', ..] => png::open(path, file, Wanted::Imagery),
        [0xff, 0xd8, 0xff, ..] => jpeg::open(path, file),
        _ => Err(unsupported(
            path,
            "a picture: GeoTIFF, PNG or JPEG",
            format!("bytes that begin with {:02x?}", &start[..start.len().min(8)]),
            "convert it to GeoTIFF, for instance with gdal_translate",
        )),
    }
}

impl Imagery {
    /// Opens one or several pictures over the frame that `first` has decided. Pictures in another CRS are resampled to the
    /// frame's, bilinearly; those without one need [`Options::assume_crs`] where the frame has one. What the other options
    /// say is of heights.
    ///
    /// # Errors
    /// When a file is missing, damaged, no picture of 8 bits a band, or does not fit the others or the frame.
    pub fn open(
        paths: &[PathBuf],
        options: &Options,
        first: &Source,
    ) -> std::result::Result<Self, IngestError> {
        let file = paths.first().ok_or(IngestError::NoInput)?;
        let options = Options { assume_crs: options.assume_crs, ..Options::default() };
        let mut rasters = Vec::with_capacity(paths.len());
        for path in paths {
            let mut raster = open_file(path, &options, &first.cache, Wanted::Imagery)?;
            if raster.place.is_none() {
                return Err(bad_options(
                    path,
                    "a picture that says where it lies",
                    "one that does not",
                    "put a world file beside it (.pgw, .jgw), or convert it to GeoTIFF with gdal_translate -a_srs -a_ullr",
                ));
            }
            assume_crs(&mut raster, &options)?;
            rasters.push(raster);
        }
        let mosaic = Mosaic::new(rasters)?;
        let (grid, reprojection) = lay(file, &mosaic, &options, &first.base)?;
        check_grid(file, &grid)?;
        Ok(Self { grid, mosaic, reprojection })
    }

    /// The lattice of its pixels' centres.
    #[must_use]
    pub fn grid(&self) -> &Grid {
        &self.grid
    }

    /// Red, green, blue and opacity of the window whose south-west pixel is (`x0`, `y0`), row by row from the south, each
    /// from west to east; pixels beyond the image are transparent. `out` is replaced. Any threads may read at once.
    ///
    /// Memory beside `out`: 16 bytes a pixel, and as [`Source::read`].
    ///
    /// # Errors
    /// When a file turns out damaged or unreadable.
    pub fn read(
        &self,
        [x0, y0]: [i64; 2],
        [width, height]: [u32; 2],
        out: &mut Vec<[u8; 4]>,
    ) -> std::result::Result<(), IngestError> {
        out.clear();
        out.resize(width as usize * height as usize, [0; 4]);
        let clip = |from: i64, size: u32, all: u32| -> Option<(u32, u32, usize)> {
            let start = from.clamp(0, all.into());
            let end = (from + i64::from(size)).clamp(0, all.into());
            let skipped = usize::try_from(start - from).ok()?;
            (end > start).then_some((u32::try_from(start).ok()?, u32::try_from(end - start).ok()?, skipped))
        };
        let columns = clip(x0, width, self.grid.width);
        let rows = clip(y0, height, self.grid.height);
        let (Some((x, columns, left)), Some((y, rows, below))) = (columns, rows) else { return Ok(()) };
        let window = Window { x0: x, y0: y, width: columns, height: rows };
        let mut band = vec![f64::NAN; window.samples()];
        for number in 0..=OPACITY {
            match &self.reprojection {
                Some(reprojection) => reprojection.read(&self.mosaic, window, number, &mut band)?,
                None => self.mosaic.read(window, number, &mut band)?,
            }
            let lines = out.chunks_exact_mut(width as usize).skip(below);
            for (line, from) in lines.zip(band.chunks_exact(columns as usize)) {
                for (pixel, value) in line[left..].iter_mut().zip(from) {
                    // NaN becomes 0, which is transparent.
                    #[expect(
                        clippy::cast_possible_truncation,
                        clippy::cast_sign_loss,
                        reason = "conversion saturates"
                    )]
                    let byte = value.round() as u8;
                    pixel[number as usize] = byte;
                }
            }
        }
        Ok(())
    }
}
