//! Further layers of a scene: laid into the frame that the first one decided.

use super::error::{Result, options as bad_options};
use super::mosaic::Mosaic;
use super::raster::{Place, SourceCrs};
use super::reproject::Reprojection;
use super::{
    Crs, Grid, Heights, IngestError, Options, Source, as_it_is, check_grid, frame, grid, open_with, resampled,
};
use diamantina_protocol::message;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// The frame that the first layer of a scene decides.
#[derive(Clone, Debug)]
pub(super) struct Base {
    /// A file of the layer.
    file: PathBuf,
    /// The system of coordinates and how the frame lies in it, if it is known.
    crs: Option<(SourceCrs, message::Crs)>,
}

impl Base {
    pub(super) fn new(file: &Path, grid: &Grid, crs: Option<SourceCrs>) -> Self {
        Self { file: file.to_owned(), crs: crs.zip(grid.frame_crs()) }
    }

    /// How the frame lies in its system of coordinates, if that is known.
    pub(super) fn lies(&self) -> Option<&message::Crs> {
        self.crs.as_ref().map(|(_, lies)| lies)
    }
}

/// Opens one or several files as a layer of a scene whose frame another layer, `first`, has decided. Where the files
/// have another CRS they are resampled to the frame's.
///
/// # Errors
/// As [`super::open`]; and when the CRS of one of both layers is known and of the other not, or the frame has degrees and
/// the files another CRS.
pub fn open_over(
    paths: &[PathBuf],
    options: &Options,
    first: &Source,
) -> std::result::Result<Source, IngestError> {
    open_with(paths, options, Arc::clone(&first.cache), |file, mosaic| {
        let (grid, reprojection) = lay(file, mosaic, options, &first.base)?;
        Ok((grid, reprojection, first.base.clone()))
    })
}

/// Whether two descriptions are of one system: units and all.
fn is_same(a: &SourceCrs, b: &SourceCrs) -> bool {
    match (&a.proj4, &b.proj4) {
        // Files may call one system by different names, and different ones by the same.
        (Some(a), Some(b)) => a == b,
        _ => a.name == b.name,
    }
}

/// The lattice of some files in a frame.
pub(super) fn lay(
    file: &Path,
    mosaic: &Mosaic,
    options: &Options,
    base: &Base,
) -> Result<(Grid, Option<Reprojection>)> {
    let own = mosaic.place.as_ref().and_then(|place| Some((place, place.crs.as_ref()?)));
    let first = base.file.display();
    match (&base.crs, own) {
        (None, None) => frame(file, mosaic, options).map(|(grid, reprojection, _)| (grid, reprojection)),
        (None, Some((_, crs))) => Err(bad_options(
            file,
            format!("a layer without a CRS, as {first}, which decides the frame, has none"),
            &crs.name,
            format!(
                "say --assume-crs EPSG:N with the CRS of {first}, or write it into that file (gdal_edit.py -a_srs can)"
            ),
        )),
        (Some((frame_crs, _)), None) => {
            let expected = format!("a CRS, as {first}, which decides the frame, has {}", frame_crs.name);
            Err(match mosaic.place {
                Some(_) => bad_options(
                    file,
                    expected,
                    "none in the file",
                    format!(
                        "say --assume-crs EPSG:N if you know it ({} where its coordinates are the frame's)",
                        frame_crs.name
                    ),
                ),
                None => bad_options(
                    file,
                    expected,
                    "a file that says nothing of its place",
                    "convert it to a GeoTIFF that says where it lies (gdal_translate -a_srs -a_ullr can)",
                ),
            })
        }
        (Some((frame_crs, lies)), Some((place, crs))) => {
            if is_same(crs, frame_crs) && options.cell.is_none() {
                let kept =
                    if crs.geographic { in_degrees(mosaic, place, lies) } else { as_it_is(mosaic, place) };
                return Ok((kept, None));
            }
            if frame_crs.geographic {
                return Err(bad_options(
                    file,
                    format!(
                        "coordinates in {}, as {first}, which decides the frame of degrees, has them",
                        frame_crs.name
                    ),
                    &crs.name,
                    "leave --crs source out, or choose --crs EPSG:N: then all layers are resampled to it",
                ));
            }
            resampled(mosaic, place, frame_crs, options.cell).map(|(grid, plan)| (grid, Some(plan)))
        }
    }
}

/// The lattice of samples in degrees, in a frame of the same degrees: its metres are those at the centre of the first
/// layer.
fn in_degrees(mosaic: &Mosaic, place: &Place, lies: &message::Crs) -> Grid {
    let mut from = [0, 1].map(|axis| place.origin[axis] - lies.origin[axis]);
    // Neighbours across the antimeridian may be a full turn apart.
    from[0] -= (from[0] / 360.0).round() * 360.0;
    let metres = |degrees: [f64; 2]| [0, 1].map(|axis| degrees[axis] / lies.per_metre[axis]);
    let crs = Crs {
        name: lies.name.clone(),
        proj4: lies.proj4.clone(),
        origin: [0, 1].map(|axis| lies.origin[axis] + from[axis]),
        step: place.step,
    };
    grid(mosaic, metres(from), metres(place.step), Some(crs))
}

/// A flat layer `metres` high over the extent of another one, of 2^`cells_log2` cells along each side: as few as a
/// forest has, whatever the other's size.
///
/// # Errors
/// When the height is none that a scene can hold.
pub fn level(metres: f64, cells_log2: u8, ground: &Source) -> std::result::Result<Source, IngestError> {
    let Source { grid: below, base, cache, .. } = ground;
    let cells = 1u32 << cells_log2;
    let share = |samples: u32| f64::from(samples.saturating_sub(1).max(1)) / f64::from(cells);
    let shares = [below.width, below.height].map(share);
    let scaled = |step: [f64; 2]| [step[0] * shares[0], step[1] * shares[1]];
    let grid = Grid {
        width: cells + 1,
        height: cells + 1,
        cell: scaled(below.cell),
        crs: below.crs.clone().map(|crs| Crs { step: scaled(crs.step), ..crs }),
        integer: true,
        height_scale: 1.0,
        height_offset: metres,
        resampled: false,
        ..*below
    };
    check_grid(&base.file, &grid)?;
    let identity = format!("level {grid:?}");
    Ok(Source { grid, identity, heights: Heights::Level, base: base.clone(), cache: Arc::clone(cache) })
}
