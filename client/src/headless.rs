//! Pictures and flights without a window: pictures here, paths in `path`, flights along them in `fly`.

use crate::annotate::{self, Subject};
use crate::camera::Camera;
use crate::drawing::DrawItem;
use crate::globe::Globe;
use crate::overview::{Room, around, stretched};
use crate::pick::Picker;
use crate::picture::{Picture, write_png};
use crate::render::{self, FrameStats, Look, Offscreen, RenderError};
use crate::surface::Surface;
use crate::terrain::{FrameView, Stats, Terrain, TerrainError};
use diamantina_protocol::NODATA;
use diamantina_protocol::diamond::{Block, Diamond};
use diamantina_protocol::message::{Kind, Layer, Scene};
use glam::DVec3;
use serde::Serialize;
use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

mod fly;
mod path;

pub use crate::overview::{extent, overview, stretched_overview};
pub use fly::{Flight, FrameLine, Play, fly};
pub(crate) use path::Dice;
pub use path::{FlightPath, PathKey, RANDOM_SECONDS_MAX};

/// Why there is no picture or flight.
#[derive(Debug, thiserror::Error)]
pub enum HeadlessError {
    /// The scene cannot be streamed.
    #[error(transparent)]
    Terrain(#[from] TerrainError),
    /// It cannot be drawn.
    #[error(transparent)]
    Render(#[from] RenderError),
    /// The GPU's memory is too little for a picture of the size.
    #[error(
        "a picture of {} x {} pixels takes {} MiB of GPU memory before anything is drawn, of {} MiB: raise --gpu-memory, or ask for \
         a smaller --size, --no-antialias or --texture none",
        size[0], size[1], needed.div_ceil(1 << 20), budget >> 20
    )]
    GpuMemory {
        /// Its size.
        size: [u32; 2],
        /// What it takes, in bytes.
        needed: u64,
        /// What there is.
        budget: u64,
    },
    /// A file cannot be written or read.
    #[error("{path}: cannot {action}: {error}; {}", match error.kind() {
        std::io::ErrorKind::StorageFull | std::io::ErrorKind::QuotaExceeded => "free some space",
        std::io::ErrorKind::NotFound => "does its folder exist?",
        _ => "choose another path",
    })]
    File {
        /// What was being done.
        action: &'static str,
        /// The file.
        path: PathBuf,
        /// What the system said.
        error: std::io::Error,
    },
    /// The path makes no sense.
    #[error(
        "{path}: not a path: {what}; expected {{\"keys\": [{{\"seconds\": 0, \"eye\": [x, y, z], \"target\": [x, y, z]}}, ...]}} with rising seconds"
    )]
    Path {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        what: String,
    },
}

fn file_error<'a>(action: &'static str, path: &'a Path) -> impl Fn(std::io::Error) -> HeadlessError + 'a {
    move |error| HeadlessError::File { action, path: path.to_owned(), error }
}

/// The error, in pixels, at which what is drawn tells the outline of a scene.
const OUTLINE_PIXELS: f64 = 12.0;

/// Begins to stream what a picture from `camera` needs, in one request; [`picture`] (or [`framed`]) goes on from
/// there. The camera's heights are stretched as there.
pub fn stream(terrain: &mut Terrain, camera: &Camera, exaggeration: f64) {
    terrain.set_exaggeration(exaggeration);
    terrain.stream(&stretched(camera, exaggeration));
}

/// As [`overview`], but as near as the terrain itself allows, which may be less than its box: waits for a
/// coarse form of it. Heights are multiplied by `exaggeration` to find the camera, but its own are not.
pub fn framed(terrain: &mut Terrain, size: [u32; 2], exaggeration: f64, patience: Duration) -> Camera {
    let camera = stretched_overview(&terrain.shown_scene(), size, exaggeration);
    let wide = stretched(&camera, exaggeration);
    terrain.set_exaggeration(exaggeration);
    let until = Instant::now() + patience;
    // Always the same form of it, whatever else has arrived: where the camera stands is no matter of the network.
    let outline_pixels = OUTLINE_PIXELS.max(terrain.tolerance_pixels());
    let items = loop {
        let view = terrain.frame(&wide);
        let is_enough = view.complete || view.error_pixels <= outline_pixels;
        let outline = if is_enough { terrain.drawn_at(&wide, outline_pixels) } else { None };
        if outline.is_some() || view.complete || Instant::now() >= until {
            break outline.unwrap_or(view.items);
        }
        std::thread::sleep(Duration::from_millis(2));
    };
    let layers = &terrain.scene().layers;
    let mut points = Vec::new();
    // Whatever the time, it is seen from the same place.
    let is_still = |item: &&DrawItem| !terrain.is_step(item.layer);
    let is_any_still = items.iter().any(|item| is_still(&item));
    for item in items.iter().filter(|item| !is_any_still || is_still(item)) {
        let layer = &layers[item.layer];
        match &*item.surface {
            Surface::Points(here) => points.extend(points_of(layer, item.diamond, here.block())),
            Surface::Tin(tin) => points.extend(tin.corners().iter().map(|corner| {
                let place = |i: usize| f64::from(item.diamond.centre()[i]) + f64::from(corner.place[i]);
                let [x, y] = [0, 1].map(|i| layer.origin[i] + layer.cell[i] * place(i));
                DVec3::new(x, y, layer.metres(corner.height))
            })),
        }
    }
    if points.is_empty() { camera } else { around(&points, &Room::whole(size), exaggeration) }
}

/// All points of a diamond that have a height.
fn points_of(layer: &Layer, diamond: Diamond, block: &Block) -> impl Iterator<Item = DVec3> {
    let (local, n) = (layer.forest.local(diamond), block.segments());
    block.places().filter(move |[p, q]| local.upper || q <= p).filter_map(move |[p, q]| {
        let height = block.heights()[Block::slot(n, p, q)];
        let (p, q) = (p as f64 / 2.0, q as f64 / 2.0);
        let along = |i: usize| {
            let steps = local.origin[i] as f64 + local.u[i] as f64 * p + local.v[i] as f64 * q;
            layer.origin[i] + layer.cell[i] * steps
        };
        (height != NODATA).then(|| DVec3::new(along(0), along(1), layer.metres(height)))
    })
}

/// Numbers about a picture.
#[derive(Debug, Clone, Serialize)]
pub struct PictureReport {
    /// The scene.
    pub scene: String,
    /// Its version.
    pub version: String,
    /// The camera's eye, in the frame's metres.
    pub eye: [f64; 3],
    /// What the camera looks at.
    pub target: [f64; 3],
    /// How high the ground is below the eye, or above it: water is none. `null` where nothing is drawn.
    pub ground_at_eye: Option<f64>,
    /// Width and height, in pixels.
    pub size: [u32; 2],
    /// Bytes of all answers.
    pub bytes: u64,
    /// Requests sent.
    pub requests: u64,
    /// Requests sent while no other was in flight.
    pub round_trips: u64,
    /// Points received: real, deduced, corrected.
    pub points_received: u64,
    /// New points whose height was sent.
    pub real_points: u64,
    /// New points whose height was deduced.
    pub fictitious_points: u64,
    /// Older points that were made more precise.
    pub corrected_points: u64,
    /// Irregular triangles received.
    pub triangles_received: u64,
    /// Triangles drawn.
    pub triangles_drawn: u64,
    /// Draw calls.
    pub draws: u32,
    /// Seconds until something could be drawn.
    pub seconds_to_first_picture: Option<f64>,
    /// Seconds until the asked error was reached.
    pub seconds_to_asked_error: Option<f64>,
    /// What heights were multiplied by.
    pub exaggeration: f64,
    /// The asked error, in pixels.
    pub asked_error_pixels: f64,
    /// The largest error of what is drawn, in pixels, from the declared errors: the apparent size of the error
    /// at the point of its box that is nearest to the eye, though no nearer than the near plane. `null` in
    /// JSON if too little arrived to draw anything.
    pub largest_error_pixels: f64,
    /// The zone that was asked for.
    pub zone: Option<String>,
    /// Whether the eye was in it: then errors, those told here too, count for what is seen of them from the zone.
    pub zone_in_effect: bool,
    /// The texture on the terrain.
    pub texture: Option<String>,
    /// Tiles of it that arrived.
    pub texture_tiles: usize,
    /// The time of water that changes with it, in seconds; `null` where there is none.
    pub time_seconds: Option<f64>,
    /// Whether all that was wanted arrived.
    pub complete: bool,
    /// Whether the largest error is within the asked one. Where all has arrived and it is not, the scene has no more, or
    /// the memory holds no more.
    pub asked_error_reached: bool,
    /// Whether memory, here or on the GPU, kept it from the asked error.
    pub limited_by_memory: bool,
    /// Whether the server was not asked: what is drawn was fetched before.
    pub offline: bool,
    /// Bytes of payloads and pages that were fetched before, and came from the disk.
    pub disk_bytes: u64,
    /// Bytes of memory that resident diamonds take.
    pub resident_bytes: usize,
    /// Bytes of GPU memory that the drawn diamonds take.
    pub gpu_bytes: u64,
    /// Bytes of GPU memory that all else takes: see [`FrameStats::fixed_bytes`].
    pub gpu_fixed_bytes: u64,
    /// Both together.
    pub gpu_total_bytes: u64,
    /// Milliseconds to draw the finished picture.
    pub milliseconds_a_frame: f64,
}

/// Streams until the camera's view is as exact as asked, and draws it. Gives up waiting after `patience`
/// and draws what is there. Where the look stretches heights, the camera's are stretched, too.
///
/// # Errors
/// When there is no graphics adapter, or no memory on it for such a picture.
pub fn picture(
    terrain: &mut Terrain,
    camera: &Camera,
    look: &Look,
    options: &render::Options,
    patience: Duration,
) -> Result<(Picture, PictureReport), HeadlessError> {
    let mut offscreen = Offscreen::new(options)?;
    terrain.suit_blocks(offscreen.reads_blocks());
    let drawn = stretched(camera, look.exaggeration);
    terrain.set_exaggeration(look.exaggeration);
    terrain.set_wires(look.wireframe);
    terrain.set_mirrors(look.mirrors().then_some(look.water.mirror_error));
    take_room(terrain, &offscreen, camera.size, look)?;
    let view = terrain.settle(&drawn, patience);
    let layers = &terrain.scene().layers;
    offscreen.drape(view.drape.as_ref());
    offscreen.mirror(&view.mirrors);
    offscreen.draw(layers, &drawn, &view.items, look)?;
    offscreen.read()?;
    // Everything is uploaded by now: this is what a frame costs.
    let started = Instant::now();
    let frame = offscreen.draw(layers, &drawn, &view.items, look)?;
    let mut picture = offscreen.read()?;
    let milliseconds_a_frame = started.elapsed().as_secs_f64() * 1e3;
    if look.annotations.is_any() {
        Annotator::new(terrain.scene()).annotate(&mut offscreen, terrain, &drawn, &view.items, look);
        picture = offscreen.read()?;
    }
    let report = report(terrain, camera, look, &view, frame, milliseconds_a_frame);
    Ok((picture, report))
}

/// Takes what pictures of a size take of the GPU's memory from what the terrain may.
fn take_room(
    terrain: &mut Terrain,
    offscreen: &Offscreen,
    size: [u32; 2],
    look: &Look,
) -> Result<(), HeadlessError> {
    let taken = offscreen.frame_bytes(&terrain.scene().layers, size, look, terrain.waters());
    terrain.set_gpu_taken(taken);
    let (needed, budget) = (terrain.gpu_least(), terrain.gpu_budget());
    if needed > budget {
        return Err(HeadlessError::GpuMemory { size, needed, budget });
    }
    Ok(())
}

/// Writes what a look asks for over pictures of a scene.
#[derive(Debug)]
struct Annotator {
    picker: Picker,
    globe: Option<Globe>,
}

impl Annotator {
    fn new(scene: &Scene) -> Self {
        Self { picker: Picker::default(), globe: Globe::of(&scene.frame) }
    }

    /// Over the picture last drawn. `camera`: as it was drawn, its heights stretched.
    fn annotate(
        &mut self,
        offscreen: &mut Offscreen,
        terrain: &Terrain,
        camera: &Camera,
        items: &[DrawItem],
        look: &Look,
    ) {
        let centre = annotate::centre(&mut self.picker, &terrain.scene().layers, items, look, camera);
        let layers = terrain.drawn_layers();
        let (imagery, globe) = (terrain.texture_name(), self.globe.as_ref());
        let subject = Subject { camera, look, layers: &layers, imagery, globe, centre };
        offscreen.draw_over(annotate::pixels_per_point(camera.size), |painter, area| {
            annotate::show(painter, area, &subject);
        });
    }
}

/// The height of the drawn ground where the eye is, as it was measured.
fn ground_at_eye(terrain: &Terrain, camera: &Camera, look: &Look, items: &[DrawItem]) -> Option<f64> {
    let layers = &terrain.scene().layers;
    let is_ground = |item: &&DrawItem| layers.get(item.layer).is_some_and(|l| l.kind == Kind::Terrain);
    let ground: Vec<_> = items.iter().filter(is_ground).cloned().collect();
    let stretched = Picker::default().ground(layers, &ground, look.exaggeration, camera.eye.truncate())?;
    Some(stretched / look.exaggeration)
}

/// What to say where an eye of this height is under the ground, whose inside the picture shows.
#[must_use]
pub fn below_ground(eye: f64, ground: Option<f64>) -> Option<String> {
    let ground = ground.filter(|ground| eye < *ground)?;
    let deep = ground - eye;
    Some(format!(
        "the eye is {deep:.2} m below the ground, which is {ground:.2} m high there and is drawn as it is seen from below: \
         to look from above, give --eye a height of more than {ground:.2}"
    ))
}

fn report(
    terrain: &Terrain,
    camera: &Camera,
    look: &Look,
    view: &FrameView,
    frame: FrameStats,
    milliseconds_a_frame: f64,
) -> PictureReport {
    let Stats { traffic, .. } = view.stats;
    PictureReport {
        scene: terrain.scene().name.clone(),
        version: terrain.scene().version.clone(),
        eye: camera.eye.to_array(),
        target: camera.target.to_array(),
        ground_at_eye: ground_at_eye(terrain, camera, look, &view.items),
        size: camera.size,
        bytes: traffic.bytes,
        requests: traffic.requests,
        round_trips: traffic.round_trips,
        points_received: view.stats.points_real + view.stats.points_fictitious,
        real_points: view.stats.points_real,
        fictitious_points: view.stats.points_fictitious,
        corrected_points: view.stats.points_corrected,
        triangles_received: view.stats.triangles,
        triangles_drawn: frame.triangles,
        draws: frame.draws,
        seconds_to_first_picture: view.stats.first_picture_seconds,
        seconds_to_asked_error: view.stats.asked_error_seconds,
        exaggeration: look.exaggeration,
        asked_error_pixels: terrain.tolerance_pixels(),
        largest_error_pixels: view.error_pixels,
        zone: terrain.zone().map(|zone| zone.name.clone()),
        zone_in_effect: view.stats.zone_in_effect,
        texture: terrain.texture_name().map(str::to_owned),
        texture_tiles: view.stats.texture_tiles,
        time_seconds: (!terrain.scene().series.is_empty()).then(|| terrain.time()),
        complete: view.complete,
        asked_error_reached: view.error_pixels <= terrain.tolerance_pixels(),
        limited_by_memory: view.limited,
        offline: view.stats.offline,
        disk_bytes: traffic.disk_bytes,
        resident_bytes: view.stats.resident_bytes,
        gpu_bytes: frame.gpu_bytes,
        gpu_fixed_bytes: frame.fixed_bytes,
        gpu_total_bytes: frame.total_bytes(),
        milliseconds_a_frame,
    }
}

/// Writes a picture as PNG: whole, or not at all. What is at `path` stays until it can be replaced.
///
/// # Errors
/// When the file cannot be written.
pub fn save(picture: &Picture, path: &Path) -> Result<(), HeadlessError> {
    let failed = file_error("write the picture", path);
    if path.exists() && !path.is_file() {
        // A device or a pipe takes bytes as they come.
        return write(picture, path).map_err(failed);
    }
    let mut aside = path.as_os_str().to_owned();
    aside.push(".part");
    let aside = Path::new(&aside);
    let moved = write(picture, aside).and_then(|()| std::fs::rename(aside, path));
    if moved.is_err() {
        // It is of no use to anybody; the error says why.
        let _ = std::fs::remove_file(aside);
    }
    moved.map_err(failed)
}

fn write(picture: &Picture, path: &Path) -> std::io::Result<()> {
    let mut out = BufWriter::new(File::create(path)?);
    write_png(picture, &mut out).map_err(std::io::Error::other)?;
    out.flush()
}

/// Writes lines of text to a file, or to standard output if it is named `-`.
///
/// # Errors
/// When the file cannot be written.
pub fn open_text(path: &Path) -> Result<Box<dyn Write>, HeadlessError> {
    if path.as_os_str() == "-" {
        return Ok(Box::new(std::io::stdout()));
    }
    let file = File::create(path).map_err(file_error("write", path))?;
    Ok(Box::new(BufWriter::new(file)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::terrain;
    use crate::world::{Served, above};

    #[test]
    fn an_eye_below_the_ground_is_told() {
        let words = below_ground(-3.25, Some(12.5)).unwrap();
        assert!(
            ["15.75 m below", "12.50 m high", "--eye"].iter().all(|word| words.contains(word)),
            "{words}"
        );
        for (eye, ground) in [(12.6, Some(12.5)), (12.5, Some(12.5)), (-9e9, None)] {
            assert_eq!(below_ground(eye, ground), None, "{eye} {ground:?}");
        }
    }

    #[test]
    fn pictures_stay_within_the_gpu_or_are_refused() {
        let served = Served::start_draped();
        let patience = Duration::from_secs(20);
        let look = Look::default();
        let draw = |gpu_bytes: u64, imagery| {
            let asked = terrain::Options { gpu_bytes, imagery, ..terrain::Options::default() };
            let mut terrain = Terrain::open(&served.url, asked).unwrap();
            let options = render::Options { budget_bytes: gpu_bytes, ..render::Options::default() };
            picture(&mut terrain, &Camera { size: [320, 200], ..above() }, &look, &options, patience)
        };
        let (_, whole) = draw(1 << 30, terrain::Imagery::None).unwrap();
        assert!(!whole.limited_by_memory);
        // Places of diamonds so small as these are more than a part of them.
        let places = 8192 + 112 * u64::from(whole.draws);
        let budget = whole.gpu_fixed_bytes + whole.gpu_bytes / 2 + places;
        let (_, half) = draw(budget, terrain::Imagery::None).unwrap();
        let total = half.gpu_total_bytes;
        assert!(half.limited_by_memory && total <= budget, "{total} of {budget}");
        assert_eq!(total, half.gpu_bytes + half.gpu_fixed_bytes);
        // Not even the picture has room, or there would be without imagery.
        for (budget, imagery) in [(1 << 20, terrain::Imagery::None), (budget, terrain::Imagery::First)] {
            let told = draw(budget, imagery).unwrap_err().to_string();
            assert!(["320 x 200", "--gpu-memory", "--size"].iter().all(|word| told.contains(word)), "{told}");
        }
    }

    #[test]
    fn a_picture_is_written_whole_or_not_at_all() {
        let folder = tempfile::tempdir().unwrap();
        let picture = Picture { size: [64, 64], pixels: (0..=255).cycle().take(4 * 64 * 64).collect() };
        let path = folder.path().join("a.png");
        save(&picture, &path).unwrap();
        let before = std::fs::read(&path).unwrap();
        // A folder in the way of what is written aside.
        std::fs::create_dir(folder.path().join("a.png.part")).unwrap();
        assert!(save(&Picture { size: [1, 1], pixels: vec![9; 4] }, &path).is_err());
        assert_eq!(std::fs::read(&path).unwrap(), before, "the old one stays");
        let full = save(&picture, Path::new("/dev/full")).unwrap_err().to_string();
        assert!(full.contains("/dev/full") && full.contains("write the picture"), "{full}");
    }
}
