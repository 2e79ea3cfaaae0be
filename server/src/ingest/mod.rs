//! DEM files → heights, window by window: one layer from one or several rasters.
//!
//! `open` finds each file's format by its content, joins the files to a mosaic on one grid and, where
//! asked, plans a reprojection; `Source::read` then answers any window from any thread. The first layer of a scene
//! decides the frame, and [`open_over`] lays others into it. Nothing is ever
//! read whole: TIFFs are read by strip or tile, other formats by position; what can only be read from
//! start to end is transcribed once to a temporary file (8 bytes a sample, 1 or 2 for PNG).
//!
//! ```text
//! (packed →) geotiff hgt ascii_grid usgs_dem png jpeg raw → raster → mosaic → (as it is | reproject) → windows
//! ```
//!
//! Imagery goes the same way, band by band: see [`Imagery`].
//!
//! Files may be hostile: every size is checked before memory is taken, and what is wrong is an
//! [`IngestError`] that names the file, what was expected, what was found and the remedy.

mod ascii_grid;
mod error;
mod geokeys;
mod geotiff;
mod hgt;
mod imagery;
mod jpeg;
mod mosaic;
mod over;
mod packed;
mod png;
mod raster;
mod reproject;
mod samples;
mod sentinels;
#[cfg(test)]
mod tests;
mod tiff_header;
mod units;
mod usgs_dem;
mod world_file;

use std::fmt;
use std::fs::File;
use std::num::NonZeroU32;
use std::os::unix::fs::{FileExt, MetadataExt};
use std::path::{Path, PathBuf};
use std::str::FromStr;
use std::sync::Arc;

pub use error::IngestError;
pub use imagery::Imagery;
pub use over::{level, open_over};

use crate::projection;
use error::{Result, broken, io_error, options as bad_options, unsupported};
use geotiff::ChunkCache;
use mosaic::Mosaic;
use over::Base;
use raster::{Dtype, Place, Raster, SIDE_MAX, SourceCrs, Wanted, Window};
use reproject::Reprojection;
use samples::{Order, SampleFile};

/// Decoded strips and tiles kept for one scene.
const CACHE_BYTES: usize = 128 << 20;
/// Widest geographic source that one UTM zone may carry, degrees; the scale is 6 % off at its rims.
const UTM_DEGREES_MAX: f64 = 40.0;
/// Cells of a source without CRS may be degrees below this: 11 km, coarser than any DEM on land.
const DEGREES_STEP_MAX: f64 = 0.1;

/// What the command line may say about sources.
#[derive(Clone, Debug, Default, clap::Args)]
pub struct Options {
    /// CRS of the frame: auto (degrees go to the UTM zone of the centre, metres stay), source (never
    /// resampled) or EPSG:N (resampled bilinearly)
    #[arg(long, value_name = "auto|source|EPSG:N", default_value_t = CrsChoice::Auto)]
    pub crs: CrsChoice,
    /// CRS of the sources that do not say theirs, such as EPSG:4326 for degrees
    #[arg(long, value_name = "EPSG:N", value_parser = parse_epsg)]
    pub assume_crs: Option<NonZeroU32>,
    /// Metres between samples, when reprojecting or for a source that does not say (PNG, raw, degrees
    /// without a CRS)
    #[arg(long, value_name = "METRES")]
    pub cell: Option<f64>,
    /// Metres of height in one unit of value [default: from the file, else 1]
    #[arg(long, value_name = "METRES")]
    pub height_scale: Option<f64>,
    /// Metres of height at value 0 [default: from the file, else 0]
    #[arg(long, value_name = "METRES")]
    pub height_offset: Option<f64>,
    /// The value that means "no data", instead of the file's; nan: all values are heights
    #[arg(long, value_name = "VALUE")]
    pub nodata: Option<f64>,
    /// Read the files as bare little-endian samples, rows from the north; types u8 i16 u16 i32 u32 f32 f64
    #[arg(long, value_name = "WIDTHxHEIGHT:TYPE")]
    pub raw: Option<RawShape>,
}

/// The number in `EPSG:N`.
fn parse_epsg(text: &str) -> std::result::Result<NonZeroU32, String> {
    let code = text.to_ascii_lowercase().strip_prefix("epsg:").and_then(|n| n.parse().ok());
    code.ok_or_else(|| format!("expected EPSG:N, such as EPSG:4326, found '{text}'"))
}

/// Which CRS the frame has.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum CrsChoice {
    /// Geographic sources go to the UTM zone of their centre, others stay as they are.
    #[default]
    Auto,
    /// The source's own grid, never resampled.
    Source,
    /// A projected CRS by its EPSG code.
    Epsg(u32),
}

impl FromStr for CrsChoice {
    type Err = String;

    fn from_str(text: &str) -> std::result::Result<Self, String> {
        let lower = text.to_ascii_lowercase();
        match (lower.as_str(), lower.strip_prefix("epsg:").map(str::parse)) {
            ("auto", _) => Ok(Self::Auto),
            ("source", _) => Ok(Self::Source),
            (_, Some(Ok(code))) => Ok(Self::Epsg(code)),
            _ => Err(format!("expected auto, source or EPSG:N, found '{text}'")),
        }
    }
}

impl fmt::Display for CrsChoice {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Auto => f.write_str("auto"),
            Self::Source => f.write_str("source"),
            Self::Epsg(code) => write!(f, "EPSG:{code}"),
        }
    }
}

/// Shape of a file of bare samples.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct RawShape {
    width: u32,
    height: u32,
    dtype: Dtype,
}

impl FromStr for RawShape {
    type Err = String;

    fn from_str(text: &str) -> std::result::Result<Self, String> {
        let shape = || {
            let (size, kind) = text.split_once(':')?;
            let (width, height) = size.split_once(['x', 'X'])?;
            let side = |s: &str| s.parse().ok().filter(|v| (1..=SIDE_MAX).contains(v));
            let kinds = [Dtype::U8, Dtype::I16, Dtype::U16, Dtype::I32, Dtype::U32, Dtype::F32, Dtype::F64];
            let dtype = kinds.into_iter().find(|d| d.name() == kind)?;
            Some(Self { width: side(width)?, height: side(height)?, dtype })
        };
        shape().ok_or_else(|| {
            format!(
                "expected WIDTHxHEIGHT:TYPE, sides from 1 to {SIDE_MAX}, one of u8 i16 u16 i32 u32 f32 f64, \
                 found '{text}'"
            )
        })
    }
}

/// The lattice of a source's samples. x is east, y is north.
#[derive(Clone, Debug, PartialEq)]
pub struct Grid {
    /// Samples, west to east.
    pub width: u32,
    /// Samples, south to north.
    pub height: u32,
    /// Frame coordinates of the south-west sample, metres.
    pub origin: [f64; 2],
    /// Metres between samples along x and y; unequal for some sources that are not resampled.
    pub cell: [f64; 2],
    /// `None`: the source does not say.
    pub crs: Option<Crs>,
    /// Every value of the source is an integer. Where `resampled`, the values read are not.
    pub integer: bool,
    /// Metres of height in one unit of value.
    pub height_scale: f64,
    /// Metres of height at value 0.
    pub height_offset: f64,
    /// Values are interpolated between the source's samples.
    pub resampled: bool,
}

impl Grid {
    /// The system of coordinates and how a frame with this grid's metres lies in it.
    #[must_use]
    pub fn frame_crs(&self) -> Option<diamantina_protocol::message::Crs> {
        let crs = self.crs.as_ref()?;
        let per_metre = [crs.step[0] / self.cell[0], crs.step[1] / self.cell[1]];
        let origin =
            [crs.origin[0] - self.origin[0] * per_metre[0], crs.origin[1] - self.origin[1] * per_metre[1]];
        let (name, proj4) = (crs.name.clone(), crs.proj4.clone());
        Some(diamantina_protocol::message::Crs { name, proj4, origin, per_metre })
    }
}

/// A coordinate reference system and how the lattice lies in it.
#[derive(Clone, Debug, PartialEq)]
pub struct Crs {
    /// Such as `EPSG:32611`, or what the file calls it.
    pub name: String,
    /// Definition for [`crate::projection::Projection`], where known.
    pub proj4: Option<String>,
    /// CRS coordinates of the south-west sample, CRS units (degrees, metres, feet).
    pub origin: [f64; 2],
    /// CRS units between samples along x and y.
    pub step: [f64; 2],
}

/// One layer's heights, open for reading.
///
/// Holds one file handle a source file (and temporary files, which vanish with it), 16 bytes for each
/// TIFF strip or tile, and at most 128 MiB of decoded ones, which layers of a scene share.
pub struct Source {
    grid: Grid,
    identity: String,
    heights: Heights,
    /// The frame that it lies in.
    base: Base,
    cache: Arc<ChunkCache>,
}

/// Where heights come from.
enum Heights {
    /// Files.
    Files(Box<Files>),
    /// The same everywhere: 0, above the grid's offset.
    Level,
}

/// The opened files of a layer.
struct Files {
    mosaic: Mosaic,
    reprojection: Option<Reprojection>,
    /// Whether the user says that no value stands for "no data".
    all_heights: bool,
}

impl fmt::Debug for Source {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Source").field("grid", &self.grid).finish_non_exhaustive()
    }
}

/// Opens one or several files as one layer. Sequential formats are read through once, TIFFs and raw files
/// only at their headers.
///
/// # Errors
/// When a file is missing, damaged, of an unknown kind, does not fit the others or the options.
pub fn open(paths: &[PathBuf], options: &Options) -> std::result::Result<Source, IngestError> {
    let cache = Arc::new(ChunkCache::new(CACHE_BYTES));
    open_with(paths, options, cache, |first, mosaic| {
        let (grid, reprojection, crs) = frame(first, mosaic, options)?;
        let base = Base::new(first, &grid, crs);
        Ok((grid, reprojection, base))
    })
}

/// Opens files as one layer whose place in a frame is found by `place`.
fn open_with(
    paths: &[PathBuf],
    options: &Options,
    cache: Arc<ChunkCache>,
    place: impl FnOnce(&Path, &Mosaic) -> Result<(Grid, Option<Reprojection>, Base)>,
) -> Result<Source> {
    let first = paths.first().ok_or(IngestError::NoInput)?;
    check_numbers(first, options)?;
    let mut rasters = Vec::with_capacity(paths.len());
    for path in paths {
        let mut raster = open_file(path, options, &cache, Wanted::Heights)?;
        override_values(&mut raster, options)?;
        assume_crs(&mut raster, options)?;
        rasters.push(raster);
    }
    let mosaic = Mosaic::new(rasters)?;
    let (grid, reprojection, base) = place(first, &mosaic)?;
    check_grid(first, &grid)?;
    let identity = identity(paths, options, &grid)?;
    let all_heights = options.nodata.is_some_and(f64::is_nan);
    let heights = Heights::Files(Box::new(Files { mosaic, reprojection, all_heights }));
    Ok(Source { grid, identity, heights, base, cache })
}

/// What tells this source from others without reading it.
fn identity(paths: &[PathBuf], options: &Options, grid: &Grid) -> Result<String> {
    let mut files = Vec::with_capacity(paths.len());
    for path in paths {
        let whole = path.canonicalize().map_err(io_error(path, "find it"))?;
        let about = whole.metadata().map_err(io_error(path, "ask for its length"))?;
        files.push((whole, about.len(), about.mtime(), about.mtime_nsec()));
    }
    Ok(format!("{files:?} {options:?} {grid:?}"))
}

impl Source {
    /// A text that is the same for the same files (paths, lengths, times of change) read with the same
    /// options, and for no others.
    #[must_use]
    pub fn identity(&self) -> &str {
        &self.identity
    }

    /// Whether, among the values read so far, there was one that usually means "no data" and that nobody
    /// declared.
    ///
    /// # Errors
    /// When there was: it would become a pit or a spire.
    pub fn check_nodata(&self) -> std::result::Result<(), IngestError> {
        let Heights::Files(files) = &self.heights else { return Ok(()) };
        match files.mosaic.suspect() {
            Some((file, value, [low, high])) if !files.all_heights => Err(bad_options(
                file,
                format!("heights about as far apart as the others, which are {low} to {high}"),
                format!("{value}, which usually means \"no data\" and is not declared here"),
                format!("say --nodata {value}; or, if it is a height, --nodata nan"),
            )),
            _ => Ok(()),
        }
    }

    /// The system of coordinates of the frame that this lies in, and how the frame lies in it: the same for all layers of
    /// a scene.
    #[must_use]
    pub fn frame_crs(&self) -> Option<diamantina_protocol::message::Crs> {
        self.base.lies().cloned()
    }

    /// The lattice that windows refer to.
    #[must_use]
    pub fn grid(&self) -> &Grid {
        &self.grid
    }

    /// Values (source units, NaN for nodata) of the window whose south-west sample is (`x0`, `y0`), row by
    /// row from the south, each from west to east. `out` is replaced. Any threads may read at once.
    ///
    /// Memory beside `out`'s 8 bytes a sample: the cache of the layer, one strip or tile while it is
    /// decoded, a copy of the window for a mosaic, 10 MiB when resampling.
    ///
    /// # Errors
    /// When the window leaves the grid, or the file turns out damaged or unreadable.
    pub fn read(
        &self,
        x0: u32,
        y0: u32,
        width: u32,
        height: u32,
        out: &mut Vec<f64>,
    ) -> std::result::Result<(), IngestError> {
        let fits = |from: u32, size: u32, all: u32| from.checked_add(size).is_some_and(|end| end <= all);
        if !fits(x0, width, self.grid.width) || !fits(y0, height, self.grid.height) {
            return Err(IngestError::Window {
                width: self.grid.width,
                height: self.grid.height,
                found: format!("{width} x {height} at ({x0}, {y0})"),
            });
        }
        let window = Window { x0, y0, width, height };
        out.clear();
        out.resize(window.samples(), f64::NAN);
        if window.samples() == 0 {
            return Ok(());
        }
        match &self.heights {
            Heights::Files(files) => match &files.reprojection {
                Some(reprojection) => reprojection.read(&files.mosaic, window, 0, out),
                None => files.mosaic.read(window, 0, out),
            },
            Heights::Level => {
                out.fill(0.0);
                Ok(())
            }
        }
    }
}

fn check_numbers(file: &Path, options: &Options) -> Result<()> {
    let bad = |what: &str, found: f64| {
        Err(bad_options(file, format!("a finite, sensible {what}"), found.to_string(), "correct the option"))
    };
    match options {
        Options { cell: Some(v), .. } if !(v.is_finite() && *v > 0.0) => bad("--cell above 0", *v),
        Options { height_scale: Some(v), .. } if !v.is_finite() || *v == 0.0 => {
            bad("--height-scale not 0", *v)
        }
        Options { height_offset: Some(v), .. } if !v.is_finite() => bad("--height-offset", *v),
        _ => Ok(()),
    }
}

/// Refuses lattices and scales that no description of a scene can hold and no client would draw. They come
/// from the options or from the file.
fn check_grid(file: &Path, grid: &Grid) -> Result<()> {
    let sensible = [
        ("cells from 1e-6 to 1e9 m", grid.cell, 1e-6..1e9),
        ("coordinates below 1e12 m", grid.origin, 0.0..1e12),
        ("a height scale from 1e-9 to 1e9 m", [grid.height_scale; 2], 1e-9..1e9),
        ("a height offset below 1e12 m", [grid.height_offset; 2], 0.0..1e12),
    ];
    for (expected, [a, b], range) in sensible {
        if !range.contains(&a.abs()) || !range.contains(&b.abs()) {
            let found = if a == b { a.to_string() } else { format!("{a} and {b}") };
            let remedy = "correct the option, or what the file says of itself (gdal_edit.py can)";
            return Err(bad_options(file, expected, found, remedy));
        }
    }
    Ok(())
}

/// Opens one file, whatever its format.
fn open_file(path: &Path, options: &Options, cache: &Arc<ChunkCache>, wanted: Wanted) -> Result<Raster> {
    // Before it is opened: opening a pipe would wait for somebody to write into it.
    let metadata = path.metadata().map_err(io_error(path, "open it"))?;
    if metadata.is_dir() {
        return Err(unsupported(path, "a DEM file", "a directory", "name the files in it"));
    }
    if !metadata.is_file() {
        let remedy = "write what it holds into a file first, since windows of it are read";
        return Err(unsupported(path, "a DEM file", "a pipe or device", remedy));
    }
    let file = File::open(path).map_err(io_error(path, "open it"))?;
    let name = path.file_name().and_then(|n| n.to_str()).unwrap_or_default().to_ascii_lowercase();
    let mut magic = [0; 2];
    let gzipped = file.read_exact_at(&mut magic, 0).is_ok() && magic == [0x1f, 0x8b];
    if let Some(shape) = options.raw.filter(|_| wanted == Wanted::Heights) {
        // Bare samples may begin with any bytes.
        let file = if gzipped && name.ends_with(".gz") { packed::gunzip(path, file)? } else { file };
        return open_raw(path, file, shape);
    }
    let (file, name) = if gzipped {
        (packed::gunzip(path, file)?, name.strip_suffix(".gz").unwrap_or(&name).to_owned())
    } else if magic == *b"PK" {
        packed::unzip(path, file)?
    } else {
        (file, name)
    };
    match wanted {
        Wanted::Heights => detect(path, file, &name, cache),
        Wanted::Imagery => imagery::detect(path, file, cache),
    }
}

/// Chooses the format by content; `.hgt` alone has no mark of its own and goes by `name` (lower case).
fn detect(path: &Path, file: File, name: &str, cache: &Arc<ChunkCache>) -> Result<Raster> {
    let mut start = vec![0; 1024];
    let length = file.read_at(&mut start, 0).map_err(io_error(path, "read it"))?;
    start.truncate(length);
    let text = start.strip_prefix(b"\xef\xbb\xbf").unwrap_or(&start).trim_ascii_start();
    let text = text[..text.len().min(16)].to_ascii_lowercase();
    match &start[..] {
        [] => Err(broken(path, "a DEM", "an empty file", "fetch it again")),
        _ if name.ends_with(".hgt") => hgt::open(path, file, name),
        [b'I', b'I', 42 | 43, 0, ..] | [b'M', b'M', 0, 42 | 43, ..] => {
            geotiff::open(path, file, Arc::clone(cache), cache.name(), Wanted::Heights)
        }
        [0x89, b'P', b'N', b'G', ..] => png::open(path, file, Wanted::Heights),
        _ if text.starts_with(b"ncols") || text.starts_with(b"nrows") => ascii_grid::open(path, file),
        _ if usgs_dem::looks_like(&start) => usgs_dem::open(path, &file),
        _ => {
            let printable = text.iter().all(|b| b.is_ascii_graphic() || b.is_ascii_whitespace());
            let found = if printable {
                format!("text that begins with '{}'", String::from_utf8_lossy(&text).escape_default())
            } else {
                format!("bytes that begin with {:02x?}", &start[..start.len().min(8)])
            };
            Err(unsupported(
                path,
                "GeoTIFF, SRTM .hgt, Arc ASCII grid, USGS ASCII DEM or greyscale PNG, or one of these in a gzip or zip",
                found,
                "convert it to GeoTIFF, or describe bare samples with --raw WIDTHxHEIGHT:TYPE",
            ))
        }
    }
}

fn open_raw(path: &Path, file: File, shape: RawShape) -> Result<Raster> {
    let RawShape { width, height, dtype } = shape;
    let samples =
        SampleFile { file, dtype, big_endian: false, order: Order::RowsFromNorth, width, height, bands: 1 };
    samples.check_length(path)?;
    Ok(Raster::plain(path, samples, None, None))
}

/// Applies what the command line says of values.
fn override_values(raster: &mut Raster, options: &Options) -> Result<()> {
    if options.nodata.is_some_and(f64::is_nan) {
        raster.nodata = None;
    } else if let Some(nodata) = options.nodata {
        raster.nodata = Some(raster.dtype.hold(nodata).ok_or_else(|| {
            bad_options(
                &raster.file,
                format!("a --nodata that samples of type {} can hold", raster.dtype.name()),
                nodata.to_string(),
                "correct it, or leave it out to use the file's own",
            )
        })?);
    }
    if let (Some(found), None) = (&raster.height_doubt, options.height_scale) {
        return Err(bad_options(
            &raster.file,
            "heights that grow upwards, in a unit known here",
            found.as_str(),
            "say --height-scale with the metres of one unit: 1 for metres, 0.3048 for feet, below 0 for depths",
        ));
    }
    raster.height_scale = options.height_scale.unwrap_or(raster.height_scale);
    raster.height_offset = options.height_offset.unwrap_or(raster.height_offset);
    Ok(())
}

/// Gives a source without CRS the one that the command line names.
fn assume_crs(raster: &mut Raster, options: &Options) -> Result<()> {
    let Some(code) = options.assume_crs else { return Ok(()) };
    let Some(place) = &mut raster.place else {
        return Err(bad_options(
            &raster.file,
            "--assume-crs only for a file that says where it lies",
            "one that says nothing of its place",
            "leave --assume-crs out and give --cell METRES",
        ));
    };
    if place.crs.is_none() {
        let crs = SourceCrs::epsg(code.get(), false);
        if crs.proj4.is_none() {
            return Err(bad_options(
                &raster.file,
                "--assume-crs with a known EPSG code",
                crs.name,
                "choose another code, such as EPSG:4326 for degrees",
            ));
        }
        place.crs = Some(crs);
    }
    Ok(())
}

/// Whether coordinates without a CRS must be longitudes (from -180 or from 0) and latitudes: small cells in the
/// range of degrees, away from (0, 0), where the local systems of laboratories and sites begin and where there
/// is nothing but sea; or once around the globe.
fn looks_like_degrees(mosaic: &Mosaic, place: &Place) -> bool {
    let ends = |axis: usize, samples: u32| {
        let (low, step) = (place.origin[axis], place.step[axis]);
        // A cell may reach half beyond its sample, and rounding a little more.
        (low + 0.5 * step + 1e-6, low + step * (f64::from(samples) - 1.5) - 1e-6)
    };
    let [(west, east), (south, north)] = [ends(0, mosaic.width), ends(1, mosaic.height)];
    let in_range = west >= -180.0 && east <= 360.0 && south >= -90.0 && north <= 90.0;
    let small = place.step.iter().all(|step| *step < DEGREES_STEP_MAX);
    let beyond = |far: f64| move |(low, high): &(f64, f64)| *low > far || *high < -far;
    let sides = [(west, east), (south, north)];
    // The nearest land is off by 4.7 degrees of latitude (Ghana), the nearest on the equator by 9 (Gabon).
    let away = sides.iter().all(beyond(1.0)) || sides.iter().any(beyond(4.5));
    let around = (place.step[0] * f64::from(mosaic.width) - 360.0).abs() < 2.0 * place.step[0];
    in_range && ((small && away) || around)
}

/// A grid, how to reach it if heights are resampled, and the CRS of the frame, if it is known.
type Framed = (Grid, Option<Reprojection>, Option<SourceCrs>);

/// Decides the frame: the source's own lattice or a resampled one.
fn frame(file: &Path, mosaic: &Mosaic, options: &Options) -> Result<Framed> {
    let Some(place) = &mosaic.place else {
        if let CrsChoice::Epsg(code) = options.crs {
            return Err(no_crs(file, &format!("EPSG:{code}")));
        }
        let cell = options.cell.ok_or_else(|| {
            let found = "a file that does not say how far its samples are apart";
            bad_options(file, "--cell METRES", found, "add --cell with the metres between samples")
        })?;
        return Ok((grid(mosaic, [0.0; 2], [cell; 2], None), None, None));
    };
    if place.crs.is_none() && looks_like_degrees(mosaic, place) && !matches!(options.crs, CrsChoice::Epsg(_))
    {
        // As metres they would make a scene of centimetres.
        let [x, y] = place.origin;
        return match options.cell {
            Some(cell) => Ok((grid(mosaic, [0.0; 2], [cell; 2], None), None, None)),
            None => Err(bad_options(
                file,
                "a CRS, or coordinates in metres",
                format!(
                    "no CRS, cells of {} and a corner at {x:.4}, {y:.4}, which look like degrees",
                    place.step[0]
                ),
                "say --assume-crs EPSG:4326 if they are degrees, or --cell METRES to take the samples as they are",
            )),
        };
    }
    let target = match (options.crs, &place.crs) {
        (CrsChoice::Source, _) | (CrsChoice::Auto, None) => None,
        (CrsChoice::Auto, Some(crs)) if crs.geographic => Some(natural_crs(file, mosaic, place, crs)?),
        (CrsChoice::Auto, Some(_)) => None,
        (CrsChoice::Epsg(code), None) => return Err(no_crs(file, &format!("EPSG:{code}"))),
        (CrsChoice::Epsg(code), Some(crs)) => {
            let target = known_crs(file, code)?;
            // The same CRS needs no resampling unless another cell is asked for.
            (target.name != crs.name || options.cell.is_some()).then_some(target)
        }
    };
    match target {
        Some(target) => {
            let (grid, plan) = resampled(mosaic, place, &target, options.cell)?;
            Ok((grid, Some(plan), Some(target)))
        }
        None if options.cell.is_some() => Err(bad_options(
            file,
            "--cell only with a reprojection",
            "a source that keeps its own cells",
            "leave --cell out, or say --crs EPSG:N",
        )),
        None => Ok((as_it_is(mosaic, place), None, place.crs.clone())),
    }
}

fn no_crs(file: &Path, asked: &str) -> IngestError {
    bad_options(
        file,
        format!("a source with a CRS, to reproject it to {asked}"),
        "none in the file",
        "say --assume-crs EPSG:N if you know it, or leave --crs out",
    )
}

/// A projected CRS that the command line names.
fn known_crs(file: &Path, code: u32) -> Result<SourceCrs> {
    let crs = SourceCrs::epsg(code, false);
    if crs.proj4.is_none() {
        let expected = "--crs with a known EPSG code";
        return Err(bad_options(
            file,
            expected,
            crs.name,
            "choose another code, such as EPSG:32632 for UTM 32 north",
        ));
    }
    if crs.geographic {
        let found = format!("{}, whose unit is the degree", crs.name);
        return Err(bad_options(
            file,
            "--crs with a projected CRS",
            found,
            "use --crs source to keep degrees",
        ));
    }
    Ok(crs)
}

/// Where degrees go unless told otherwise: the UTM zone of the centre, polar stereographic beyond UTM, and
/// on other bodies a transverse Mercator about the centre.
fn natural_crs(file: &Path, mosaic: &Mosaic, place: &Place, crs: &SourceCrs) -> Result<SourceCrs> {
    let middle =
        |axis: usize, samples: u32| place.origin[axis] + place.step[axis] * f64::from(samples - 1) / 2.0;
    let lon = (middle(0, mosaic.width) + 180.0).rem_euclid(360.0) - 180.0;
    let lat = middle(1, mosaic.height);
    let degrees = place.step[0] * f64::from(mosaic.width);
    let polar = !(-80.0..=84.0).contains(&lat);
    if degrees > UTM_DEGREES_MAX && !polar {
        return Err(bad_options(
            file,
            format!("a source at most {UTM_DEGREES_MAX} degrees wide for one UTM zone"),
            format!("{degrees:.1} degrees"),
            "choose --crs EPSG:N, or --crs source",
        ));
    }
    let (a, b) = crs.proj4.as_deref().map_or(projection::ellipsoid(""), projection::ellipsoid);
    if (a - projection::ellipsoid("").0).abs() > 10_000.0 {
        let proj4 = format!("+proj=tmerc +lat_0=0 +lon_0={lon} +k=1 +x_0=0 +y_0=0 +a={a} +b={b} +no_defs");
        return Ok(SourceCrs::new(format!("transverse Mercator at {lon}"), Some(proj4), false));
    }
    let zone = whole(((lon + 180.0) / 6.0).floor()).unwrap_or(0).min(59) + 1;
    let code = match (polar, lat >= 0.0) {
        (true, true) => 32661,
        (true, false) => 32761,
        (false, true) => 32600 + zone,
        (false, false) => 32700 + zone,
    };
    known_crs(file, code)
}

/// The source's own lattice. Degrees become metres at the centre's latitude.
fn as_it_is(mosaic: &Mosaic, place: &Place) -> Grid {
    let crs = place.crs.as_ref().map(|crs| Crs {
        name: crs.name.clone(),
        proj4: crs.proj4.clone(),
        origin: place.origin,
        step: place.step,
    });
    let (origin, cell) = match &place.crs {
        Some(source) if source.geographic => {
            let (a, b) = projection::ellipsoid(source.proj4.as_deref().unwrap_or_default());
            let lat = (place.origin[1] + place.step[1] * f64::from(mosaic.height - 1) / 2.0).to_radians();
            // Radii of curvature: n along the parallel's normal, m along the meridian.
            let e2 = 1.0 - (b / a) * (b / a);
            let w2 = 1.0 - e2 * lat.sin() * lat.sin();
            let (n, m) = (a / w2.sqrt(), a * (1.0 - e2) / (w2 * w2.sqrt()));
            let [dx, dy] = place.step.map(f64::to_radians);
            ([0.0; 2], [n * lat.cos().abs() * dx, m * dy])
        }
        Some(source) => {
            (place.origin.map(|v| v * source.metres_per_unit), place.step.map(|v| v * source.metres_per_unit))
        }
        None => (place.origin, place.step),
    };
    grid(mosaic, origin, cell, crs)
}

fn resampled(
    mosaic: &Mosaic,
    place: &Place,
    target: &SourceCrs,
    cell: Option<f64>,
) -> Result<(Grid, Reprojection)> {
    let plan = Reprojection::new(mosaic, place, target, cell)?;
    let crs = Crs {
        name: target.name.clone(),
        proj4: target.proj4.clone(),
        origin: plan.origin,
        step: [plan.step; 2],
    };
    let origin = plan.origin.map(|v| v * target.metres_per_unit);
    let own = grid(mosaic, origin, [plan.step * target.metres_per_unit; 2], Some(crs));
    let grid = Grid { width: plan.width, height: plan.height, resampled: true, ..own };
    Ok((grid, plan))
}

fn grid(mosaic: &Mosaic, origin: [f64; 2], cell: [f64; 2], crs: Option<Crs>) -> Grid {
    let first = mosaic.first();
    Grid {
        width: mosaic.width,
        height: mosaic.height,
        origin,
        cell,
        crs,
        integer: mosaic.integer(),
        height_scale: first.height_scale,
        height_offset: first.height_offset,
        resampled: false,
    }
}

/// A whole number from 0 to `u32::MAX`, or `None`.
#[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "the range is checked")]
fn whole(value: f64) -> Option<u32> {
    (value.fract() == 0.0 && (0.0..=f64::from(u32::MAX)).contains(&value)).then_some(value as u32)
}
