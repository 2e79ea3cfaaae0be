//! GeoTIFF and BigTIFF: strips or tiles, compressed or not, the first image of the file.
//!
//! The header is checked first (see `tiff_header`). Uncompressed samples are then read by position, whatever
//! the size of their strips; compressed chunks are decoded whole by the `tiff` crate, a few decoders at a
//! time, and kept in a cache bounded by bytes that all files of a scene share.

use std::collections::{BTreeMap, HashMap};
use std::fs::File;
use std::io::{self, BufReader, Read, Seek, SeekFrom};
use std::os::unix::fs::FileExt;
use std::path::Path;
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

use tiff::decoder::{Decoder, DecodingResult};

use super::error::{Result, broken, io_error, options, unsupported};
use super::geokeys::GeoKeys;
use super::raster::{Dtype, Picture, Place, Raster, SIDE_MAX, Samples, Wanted, Window};
use super::samples::{band_of, decode};
use super::tiff_header::{CHUNKS_MAX, Header};
use super::units::named_metres;
use super::world_file;

/// Decoded bytes of one strip or tile, at most: a tile of 8192 x 8192 floats.
const CHUNK_BYTES_MAX: u64 = 256 << 20;
/// Idle decoders kept for each file: about one a core; each holds 16 bytes a chunk.
const DECODERS_MAX: usize = 8;
/// Bands of a file, at most.
const BANDS_MAX: u32 = 64;
/// The compression that pictures alone have.
const JPEG: u64 = 7;
/// What a decoder reads at once.
const BUFFER_BYTES: usize = 1 << 16;

/// The samples of one TIFF.
pub(super) struct Chunks {
    file: Arc<File>,
    layout: Layout,
    dtype: Dtype,
    big_endian: bool,
    compressed: bool,
    /// Whether decoded chunks are brightness and two differences of colour.
    ycbcr: bool,
    /// Byte offset and length of every chunk; length 0 is a hole, all nodata.
    places: Vec<(u64, u64)>,
    decoders: Mutex<Vec<Decoder<BufReader<Cursor>>>>,
    cache: Arc<ChunkCache>,
    /// Names this file in the shared cache.
    id: u32,
    hole: f64,
}

#[derive(Clone, Copy)]
struct Layout {
    width: u32,
    height: u32,
    chunk_width: u32,
    chunk_height: u32,
    tiled: bool,
    /// Bands, and whether each has chunks of its own.
    bands: u32,
    planar: bool,
}

impl Layout {
    fn across(&self) -> u32 {
        self.width.div_ceil(self.chunk_width)
    }

    fn down(&self) -> u32 {
        self.height.div_ceil(self.chunk_height)
    }

    /// Values at each place of a chunk.
    fn interleaved(&self) -> u32 {
        if self.planar { 1 } else { self.bands }
    }

    /// Chunks of all bands.
    fn chunks(&self) -> u64 {
        let planes = if self.planar { self.bands } else { 1 };
        u64::from(self.across()) * u64::from(self.down()) * u64::from(planes)
    }

    /// Rows that a chunk stores: the last strip is shorter, tiles are padded.
    fn stored_rows(&self, chunk_row: u32) -> u32 {
        if self.tiled {
            self.chunk_height
        } else {
            self.chunk_height.min(self.height - chunk_row * self.chunk_height)
        }
    }
}

/// Opens a TIFF. The cache is shared by the files of a scene, `id` tells them apart.
pub(super) fn open(
    path: &Path,
    file: File,
    cache: Arc<ChunkCache>,
    id: u32,
    wanted: Wanted,
) -> Result<Raster> {
    let header = Header::read(path, &file)?;
    let layout = layout(path, &header, wanted)?;
    let compression = header.integer(259)?.unwrap_or(1);
    let predictor = header.integer(317)?.unwrap_or(1);
    let (dtype, picture) = match wanted {
        Wanted::Heights => (dtype(path, &header)?, None),
        Wanted::Imagery => (Dtype::U8, Some(picture(path, &header, layout, compression)?)),
    };
    check_method(path, compression, predictor, wanted)?;
    let compressed = compression != 1 || predictor != 1;
    let places = places(path, &header, layout, dtype, compressed)?;
    if header.has_mask() {
        return Err(unsupported(
            path,
            "nodata as a value of the samples",
            "a mask of valid samples beside them",
            match wanted {
                Wanted::Heights => "write the mask into them, for instance with gdalwarp -dstnodata -32768",
                Wanted::Imagery => {
                    "make a band of it, with gdal_translate -b 1 -b 2 -b 3 -b mask -colorinterp_4 alpha"
                }
            },
        ));
    }
    let keys = GeoKeys::read(path, &header)?;
    let place = match place(path, &header, layout, &keys)? {
        None => world_file::find(path, layout.height)?,
        place => place,
    };
    let nodata = match header.text(42113)?.filter(|t| !t.is_empty()) {
        None => None,
        Some(text) => dtype.hold(text.parse().map_err(|_| {
            options(
                path,
                "a number as GDAL's nodata value",
                format!("'{text}'"),
                "say --nodata VALUE, or correct it with gdal_edit.py -a_nodata",
            )
        })?),
    };
    let metadata = Metadata::read(&header)?;
    let big_endian = header.big_endian;
    let ycbcr = compression == JPEG && header.integer(262)? == Some(6);
    let chunks = Chunks {
        file: Arc::new(file),
        layout,
        dtype,
        big_endian,
        compressed,
        ycbcr,
        places,
        decoders: Mutex::new(Vec::new()),
        cache,
        id,
        hole: nodata.unwrap_or(0.0),
    };
    if compressed {
        // The first decoder is made now, so that what the crate cannot do is said at once.
        let decoder = chunks.decoder(path)?;
        chunks.keep(decoder);
    }
    let vertical = metadata.unit_metres.or(keys.vertical_metres).unwrap_or(Ok(1.0));
    let metres = *vertical.as_ref().unwrap_or(&1.0);
    Ok(Raster {
        file: path.to_owned(),
        width: layout.width,
        height: layout.height,
        place,
        dtype,
        integer: dtype.is_integer(),
        height_scale: metadata.scale * metres,
        height_offset: metadata.offset * metres,
        height_doubt: vertical.err(),
        nodata,
        picture,
        samples: Samples::Tiff(chunks),
    })
}

fn layout(path: &Path, header: &Header<'_>, wanted: Wanted) -> Result<Layout> {
    let side = |tag, name: &str| -> Result<u32> {
        let value = header.integer(tag)?.unwrap_or(0);
        u32::try_from(value)
            .ok()
            .filter(|v| (1..=SIDE_MAX).contains(v))
            .ok_or_else(|| header.broken(format!("{name} from 1 to {SIDE_MAX}"), value.to_string()))
    };
    let (width, height) = (side(256, "a width")?, side(257, "a height")?);
    let bands = header.integer(277)?.unwrap_or(1);
    if bands != 1 && wanted == Wanted::Heights {
        return Err(unsupported(
            path,
            "one band of heights",
            format!("{bands} bands"),
            "extract one, for instance with gdal_translate -b 1; imagery has no heights",
        ));
    }
    let tiled = header.count(324) > 0;
    let (chunk_width, chunk_height) = if tiled {
        (side(322, "a tile width")?, side(323, "a tile height")?)
    } else {
        let rows = header.integer(278)?.unwrap_or(u64::from(height)).min(u64::from(height));
        (width, u32::try_from(rows).unwrap_or(0))
    };
    if chunk_height == 0 {
        return Err(header.broken("at least one row a strip".to_owned(), "none".to_owned()));
    }
    let bands = u32::try_from(bands).ok().filter(|bands| (1..=BANDS_MAX).contains(bands));
    let bands = bands.ok_or_else(|| header.broken(format!("1 to {BANDS_MAX} bands"), "others".to_owned()))?;
    let planar = bands > 1 && header.integer(284)? == Some(2);
    Ok(Layout { width, height, chunk_width, chunk_height, tiled, bands, planar })
}

/// What the bands of a picture are.
fn picture(path: &Path, header: &Header<'_>, layout: Layout, compression: u64) -> Result<Picture> {
    let photometric = header.integer(262)?.unwrap_or(1);
    let bits = header.integers(258, u64::from(BANDS_MAX))?;
    let formats = header.integers(339, u64::from(BANDS_MAX))?;
    let is_bytes = bits.iter().all(|bits| *bits == 8) && !bits.is_empty() && formats.iter().all(|f| *f == 1);
    // How many bands the file itself takes for colours: the others are extra.
    let (named, colours) = match photometric {
        // Without names for its bands, as many programs write it.
        1 if layout.bands >= 3 => (1, Some(3)),
        1 => (1, Some(1)),
        2 => (3, Some(3)),
        6 if compression == JPEG => (3, Some(3)),
        _ => (0, None),
    };
    let Some(colours) = colours.filter(|colours| is_bytes && *colours <= layout.bands) else {
        let found =
            format!("{} bands of {bits:?} bits, photometric interpretation {photometric}", layout.bands);
        let remedy = if photometric == 3 {
            "convert it with gdal_translate -expand rgb"
        } else {
            "convert it, for instance with gdal_translate -ot Byte -scale -b 1 -b 2 -b 3 -colorinterp red,green,blue"
        };
        return Err(unsupported(
            path,
            "a picture of 8 bits a band: grey, or red, green and blue",
            found,
            remedy,
        ));
    };
    // Of the bands beyond the colours, those marked as opacity: 1 is multiplied into the colours, 2 is not.
    let extra = header.integers(338, u64::from(BANDS_MAX))?;
    let mut extra = (named..layout.bands).zip(&extra);
    let opacity = extra.find(|(band, kind)| *band >= colours && matches!(kind, 1 | 2));
    Ok(Picture { colours, opacity: opacity.map(|(band, _)| band) })
}

fn dtype(path: &Path, header: &Header<'_>) -> Result<Dtype> {
    let bits = header.integer(258)?.unwrap_or(1);
    let format = header.integer(339)?.unwrap_or(1);
    let photometric = header.integer(262)?.unwrap_or(1);
    let found = match (bits, format) {
        _ if photometric != 1 => None,
        (8, 1) => Some(Dtype::U8),
        (8, 2) => Some(Dtype::I8),
        (16, 1) => Some(Dtype::U16),
        (16, 2) => Some(Dtype::I16),
        (32, 1) => Some(Dtype::U32),
        (32, 2) => Some(Dtype::I32),
        (32, 3) => Some(Dtype::F32),
        (64, 3) => Some(Dtype::F64),
        _ => None,
    };
    found.ok_or_else(|| {
        unsupported(
            path,
            "samples of 8, 16 or 32 bit integers or 32 or 64 bit floats, black is zero",
            format!("{bits} bits of sample format {format}, photometric interpretation {photometric}"),
            "convert it, for instance with gdal_translate -ot Float32",
        )
    })
}

fn check_method(path: &Path, compression: u64, predictor: u64, wanted: Wanted) -> Result<()> {
    let is_picture = wanted == Wanted::Imagery && compression == JPEG;
    if (is_picture || matches!(compression, 1 | 5 | 8 | 32773 | 32946 | 50000)) && matches!(predictor, 1..=3)
    {
        return Ok(());
    }
    Err(unsupported(
        path,
        "no compression, LZW, Deflate, PackBits or ZSTD, and predictor 1 to 3",
        format!("compression {compression} with predictor {predictor}"),
        "convert it with gdal_translate -co COMPRESS=DEFLATE -co TILED=YES",
    ))
}

/// Where every chunk lies, all of them inside the file.
fn places(
    path: &Path,
    header: &Header<'_>,
    layout: Layout,
    dtype: Dtype,
    compressed: bool,
) -> Result<Vec<(u64, u64)>> {
    let chunks = layout.chunks();
    let (offset_tag, count_tag) = if layout.tiled { (324, 325) } else { (273, 279) };
    let found = header.count(offset_tag);
    if chunks > CHUNKS_MAX || found != chunks || header.count(count_tag) != chunks {
        return Err(header.broken(
            format!("{chunks} strips or tiles for {} x {} (limit {CHUNKS_MAX})", layout.width, layout.height),
            format!("{found} offsets and {} lengths", header.count(count_tag)),
        ));
    }
    let row_bytes = u64::from(layout.chunk_width) * dtype.bytes() as u64 * u64::from(layout.interleaved());
    let chunk_bytes = row_bytes.saturating_mul(u64::from(layout.chunk_height));
    if compressed && chunk_bytes > CHUNK_BYTES_MAX {
        return Err(unsupported(
            path,
            format!("compressed strips or tiles of at most {CHUNK_BYTES_MAX} bytes"),
            format!("{chunk_bytes} bytes"),
            "write smaller ones with gdal_translate -co TILED=YES -co COMPRESS=DEFLATE",
        ));
    }
    let offsets = header.integers(offset_tag, CHUNKS_MAX)?;
    let lengths = header.integers(count_tag, CHUNKS_MAX)?;
    let places: Vec<_> = offsets.into_iter().zip(lengths).collect();
    for (i, (offset, length)) in (0u32..).zip(&places) {
        if *length == 0 {
            continue;
        }
        let needed = row_bytes * u64::from(layout.stored_rows(i / layout.across() % layout.down()));
        let ends = offset.checked_add(if compressed { *length } else { needed.max(*length) });
        if ends.is_none_or(|end| end > header.length) || (!compressed && *length < needed) {
            return Err(broken(
                path,
                format!("strip or tile {i} of {length} bytes (of {needed} when unpacked) at byte {offset}"),
                format!("a file of {} bytes", header.length),
                "the file was cut short or damaged: fetch it again",
            ));
        }
    }
    Ok(places)
}

/// South-west sample and step from the tie point and scale, or from the matrix.
fn place(path: &Path, header: &Header<'_>, layout: Layout, keys: &GeoKeys) -> Result<Option<Place>> {
    let scale = header.reals(33550, 3)?;
    let tie = header.reals(33922, 6)?;
    let matrix = header.reals(34264, 16)?;
    // CRS coordinates of the corner (0, 0) of the raster, x step and y step.
    let (corner, step) = if let [a, b, _, x, c, d, _, y, ..] = matrix[..] {
        if b != 0.0 || c != 0.0 {
            return Err(unsupported(
                path,
                "rows that run west to east and columns north to south",
                format!("a rotated geotransform ({a}, {b}; {c}, {d})"),
                "warp it upright, for instance with gdalwarp",
            ));
        }
        ([x, y], [a, -d])
    } else if let ([sx, sy, ..], [i, j, _, x, y, _]) = (&scale[..], &tie[..]) {
        ([x - i * sx, y + j * sy], [*sx, *sy])
    } else {
        return Ok(None);
    };
    if !(step.iter().all(|s| s.is_finite() && *s > 0.0) && corner.iter().all(|c| c.is_finite())) {
        return Err(unsupported(
            path,
            "rows from the north, cells of positive size",
            format!("steps of {} east and {} south", step[0], step[1]),
            "warp it north up, for instance with gdalwarp",
        ));
    }
    let half = if keys.sample_is_point { 0.0 } else { 0.5 };
    let rows = f64::from(layout.height - 1) + half;
    let origin = [corner[0] + half * step[0], corner[1] - rows * step[1]];
    Ok(Some(Place { origin, step, crs: keys.crs.clone() }))
}

/// Scale, offset and unit of heights in GDAL's metadata (tag 42112).
struct Metadata {
    scale: f64,
    offset: f64,
    /// As [`GeoKeys::vertical_metres`].
    unit_metres: Option<std::result::Result<f64, String>>,
}

impl Metadata {
    fn read(header: &Header<'_>) -> Result<Self> {
        let text = header.text(42112)?.unwrap_or_default();
        let item = |role: &str| {
            let (_, rest) = text.split_once(&format!("role=\"{role}\""))?;
            let (_, rest) = rest.split_once('>')?;
            Some(rest.split_once('<')?.0.trim())
        };
        let number = |role| item(role).and_then(|v| v.parse::<f64>().ok()).filter(|v| v.is_finite());
        let said = item("unittype").filter(|t| !matches!(*t, "" | "-" | "unknown"));
        let unit_metres =
            said.map(|text| named_metres(text).ok_or(format!("heights in '{text}', a unit not known here")));
        Ok(Self {
            scale: number("scale").filter(|s| *s != 0.0).unwrap_or(1.0),
            offset: number("offset").unwrap_or(0.0),
            unit_metres,
        })
    }
}

impl Chunks {
    /// Values of a band as stored, rows from the south.
    pub(super) fn read(&self, path: &Path, window: Window, band: u32, out: &mut [f64]) -> Result<()> {
        if window.samples() == 0 {
            return Ok(());
        }
        let l = self.layout;
        let north = l.height - window.y0 - window.height;
        // Bands either share chunks or follow each other.
        let (first_chunk, band) = if l.planar { (band * l.across() * l.down(), 0) } else { (0, band) };
        let (columns, rows) = (window.x0..window.x0 + window.width, north..north + window.height);
        for chunk_row in rows.start / l.chunk_height..=(rows.end - 1) / l.chunk_height {
            for chunk_column in columns.start / l.chunk_width..=(columns.end - 1) / l.chunk_width {
                let (left, top) = (chunk_column * l.chunk_width, chunk_row * l.chunk_height);
                let part = Part {
                    chunk: first_chunk + chunk_row * l.across() + chunk_column,
                    band,
                    columns: columns.start.max(left)..columns.end.min(left + l.chunk_width),
                    rows: rows.start.max(top)..rows.end.min(top + l.chunk_height),
                    left,
                    top,
                };
                self.read_part(
                    path,
                    &part,
                    |row| {
                        let start = (rows.end - 1 - row) as usize * window.width as usize
                            + (part.columns.start - columns.start) as usize;
                        start..start + part.columns.len()
                    },
                    out,
                )?;
            }
        }
        Ok(())
    }

    /// Copies one chunk's share; `target` gives where a row of the raster goes in `out`.
    fn read_part(
        &self,
        path: &Path,
        part: &Part,
        target: impl Fn(u32) -> std::ops::Range<usize>,
        out: &mut [f64],
    ) -> Result<()> {
        let (offset, length) = self.places[part.chunk as usize];
        let skip = (part.columns.start - part.left) as usize;
        let stride = self.layout.chunk_width as usize;
        let bands = self.layout.interleaved();
        let at_once = bands as usize;
        if length == 0 {
            part.rows.clone().for_each(|row| out[target(row)].fill(self.hole));
        } else if self.compressed {
            let data = self.chunk(path, part.chunk)?;
            for row in part.rows.clone() {
                let from = ((row - part.top) as usize * stride + skip) * at_once + part.band as usize;
                if !copy(&data, from, at_once, &mut out[target(row)]) {
                    return Err(self.short_chunk(path, part.chunk));
                }
            }
        } else {
            let size = self.dtype.bytes();
            let mut bytes = vec![0; part.columns.len() * size * at_once];
            for row in part.rows.clone() {
                let at = ((row - part.top) as usize * stride + skip) * size * at_once;
                self.file
                    .read_exact_at(&mut bytes, offset + at as u64)
                    .map_err(io_error(path, "read samples"))?;
                let values = band_of(&mut bytes, size, bands, part.band);
                decode(values, self.dtype, self.big_endian, out[target(row)].iter_mut());
            }
        }
        Ok(())
    }

    /// A decoded chunk, from the cache or decoded now. Two threads that miss at once both decode.
    fn chunk(&self, path: &Path, chunk: u32) -> Result<Arc<DecodingResult>> {
        if let Some(data) = self.cache.get((self.id, chunk)) {
            return Ok(data);
        }
        let kept = self.decoders.lock().unwrap_or_else(PoisonError::into_inner).pop();
        let mut decoder = match kept {
            Some(decoder) => decoder,
            None => self.decoder(path)?,
        };
        // With its padding, in one piece: read row by row, the crate (0.11.3) takes the end of some LZW tiles for
        // damage, where a row's padding and the data end together.
        let mut data = DecodingResult::U8(Vec::new());
        let row_bytes =
            self.layout.chunk_width as usize * self.dtype.bytes() * self.layout.interleaved() as usize;
        decoder.read_chunk_to_buffer(&mut data, chunk, row_bytes).map_err(|e| {
            let found = format!("an error in strip or tile {chunk} ({e})");
            broken(path, "samples that unpack", found, "the file is damaged: fetch it again")
        })?;
        self.keep(decoder);
        if let DecodingResult::U8(values) = &mut data
            && self.ycbcr
        {
            values.as_chunks_mut::<3>().0.iter_mut().for_each(|pixel| *pixel = rgb(*pixel));
        }
        let data = Arc::new(data);
        self.cache.put((self.id, chunk), &data);
        Ok(data)
    }

    fn decoder(&self, path: &Path) -> Result<Decoder<BufReader<Cursor>>> {
        let cursor = Cursor { file: Arc::clone(&self.file), at: 0 };
        Decoder::new(BufReader::with_capacity(BUFFER_BYTES, cursor)).map_err(|e| {
            let remedy = "convert it with gdal_translate -co COMPRESS=DEFLATE -co TILED=YES";
            unsupported(path, "a baseline TIFF", e.to_string(), remedy)
        })
    }

    fn keep(&self, decoder: Decoder<BufReader<Cursor>>) {
        let mut kept = self.decoders.lock().unwrap_or_else(PoisonError::into_inner);
        if kept.len() < DECODERS_MAX {
            kept.push(decoder);
        }
    }

    fn short_chunk(&self, path: &Path, chunk: u32) -> super::IngestError {
        let found = format!("fewer in strip or tile {chunk}");
        broken(path, format!("{} samples", self.dtype.name()), found, "the file is damaged: fetch it again")
    }
}

/// The share of a window that lies in one chunk, in columns and rows of the raster.
struct Part {
    chunk: u32,
    /// Of those that share the chunk.
    band: u32,
    columns: std::ops::Range<u32>,
    rows: std::ops::Range<u32>,
    left: u32,
    top: u32,
}

/// Red, green and blue of brightness and differences of colour, as JPEG has them (ITU-T T.871).
fn rgb([y, cb, cr]: [u8; 3]) -> [u8; 3] {
    let (y, cb, cr) = (f32::from(y), f32::from(cb) - 128.0, f32::from(cr) - 128.0);
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "conversion saturates")]
    [y + 1.402 * cr, y - 0.344_136 * cb - 0.714_136 * cr, y + 1.772 * cb].map(|value| value.round() as u8)
}

/// Copies every `step`th sample from `from` on; false if there are too few or the type is unexpected.
fn copy(data: &DecodingResult, from: usize, step: usize, out: &mut [f64]) -> bool {
    macro_rules! each {
        ($samples:expr) => {{
            let needed = (out.len() * step).saturating_sub(step - 1);
            let Some(samples) = $samples.get(from..from + needed) else { return false };
            out.iter_mut().zip(samples.iter().step_by(step)).for_each(|(o, s)| *o = f64::from(*s));
            true
        }};
    }
    match data {
        DecodingResult::U8(s) => each!(s),
        DecodingResult::I8(s) => each!(s),
        DecodingResult::U16(s) => each!(s),
        DecodingResult::I16(s) => each!(s),
        DecodingResult::U32(s) => each!(s),
        DecodingResult::I32(s) => each!(s),
        DecodingResult::F32(s) => each!(s),
        DecodingResult::F64(s) => each!(s),
        _ => false,
    }
}

/// Reads a shared file by position, so that decoders need no handles of their own.
struct Cursor {
    file: Arc<File>,
    at: u64,
}

impl Read for Cursor {
    fn read(&mut self, bytes: &mut [u8]) -> io::Result<usize> {
        let read = self.file.read_at(bytes, self.at)?;
        self.at += read as u64;
        Ok(read)
    }
}

impl Seek for Cursor {
    fn seek(&mut self, to: SeekFrom) -> io::Result<u64> {
        let (base, delta) = match to {
            SeekFrom::Start(at) => (at, 0),
            SeekFrom::Current(delta) => (self.at, delta),
            SeekFrom::End(delta) => (self.file.metadata()?.len(), delta),
        };
        let invalid = || io::Error::new(io::ErrorKind::InvalidInput, "seek out of range");
        self.at = base.checked_add_signed(delta).ok_or_else(invalid)?;
        Ok(self.at)
    }
}

type Key = (u32, u32);

/// Decoded chunks of all files of a layer, the least recently used dropped first.
///
/// Holds at most `budget_bytes`, or a single chunk where one alone is larger.
pub(super) struct ChunkCache {
    budget_bytes: usize,
    state: Mutex<CacheState>,
    /// Names given so far.
    names: AtomicU32,
}

#[derive(Default)]
struct CacheState {
    chunks: HashMap<Key, (Arc<DecodingResult>, u64)>,
    /// Use → chunk, oldest first.
    uses: BTreeMap<u64, Key>,
    clock: u64,
    bytes: usize,
}

impl ChunkCache {
    pub(super) fn new(budget_bytes: usize) -> Self {
        Self { budget_bytes, state: Mutex::default(), names: AtomicU32::new(0) }
    }

    /// A name for another file that shares this cache.
    pub(super) fn name(&self) -> u32 {
        self.names.fetch_add(1, Ordering::Relaxed)
    }

    fn get(&self, key: Key) -> Option<Arc<DecodingResult>> {
        let mut state = self.state.lock().unwrap_or_else(PoisonError::into_inner);
        let state = &mut *state;
        state.clock += 1;
        let (data, used) = state.chunks.get_mut(&key)?;
        state.uses.remove(used);
        state.uses.insert(state.clock, key);
        *used = state.clock;
        Some(Arc::clone(data))
    }

    fn put(&self, key: Key, data: &Arc<DecodingResult>) {
        let mut state = self.state.lock().unwrap_or_else(PoisonError::into_inner);
        let state = &mut *state;
        state.clock += 1;
        state.bytes += bytes_of(data);
        state.uses.insert(state.clock, key);
        if let Some((old, used)) = state.chunks.insert(key, (Arc::clone(data), state.clock)) {
            state.uses.remove(&used);
            state.bytes -= bytes_of(&old);
        }
        while state.bytes > self.budget_bytes && state.chunks.len() > 1 {
            let Some((_, oldest)) = state.uses.pop_first() else { break };
            if let Some((old, _)) = state.chunks.remove(&oldest) {
                state.bytes -= bytes_of(&old);
            }
        }
    }
}

fn bytes_of(data: &DecodingResult) -> usize {
    match data {
        DecodingResult::U8(s) => s.len(),
        DecodingResult::I8(s) => s.len(),
        DecodingResult::U16(s) => s.len() * 2,
        DecodingResult::I16(s) => s.len() * 2,
        DecodingResult::F16(s) => s.len() * 2,
        DecodingResult::U32(s) => s.len() * 4,
        DecodingResult::I32(s) => s.len() * 4,
        DecodingResult::F32(s) => s.len() * 4,
        DecodingResult::U64(s) => s.len() * 8,
        DecodingResult::I64(s) => s.len() * 8,
        DecodingResult::F64(s) => s.len() * 8,
    }
}
