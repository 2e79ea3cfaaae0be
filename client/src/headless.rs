//! Pictures and flights without a window.

use crate::annotate::{self, Subject};
use crate::camera::{Camera, FOV_Y};
use crate::drawing::DrawItem;
use crate::globe::Globe;
use crate::overview::{around, stretched};
use crate::pick::Picker;
use crate::picture::{Picture, write_png};
use crate::player::{self, Course};
use crate::render::{self, FrameStats, Look, Offscreen, RenderError};
use crate::surface::Surface;
use crate::terrain::{FrameView, Stats, Terrain, TerrainError};
use diamantina_protocol::NODATA;
use diamantina_protocol::diamond::{Block, Diamond};
use diamantina_protocol::message::{Layer, Scene};
use glam::{DVec2, DVec3};
use serde::{Deserialize, Serialize};
use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// Most key frames of a path.
const KEYS_MAX: usize = 100_000;

/// The longest flight at random, in seconds: a day.
pub const RANDOM_SECONDS_MAX: f64 = 86_400.0;

/// Seconds between its keys.
const RANDOM_STEP: f64 = 5.0;

/// The largest file with a path, in bytes.
const PATH_BYTES_MAX: u64 = 64 << 20;

pub use crate::overview::{extent, overview, stretched_overview};

/// Why there is no picture or flight.
#[derive(Debug, thiserror::Error)]
pub enum HeadlessError {
    /// The scene cannot be streamed.
    #[error(transparent)]
    Terrain(#[from] TerrainError),
    /// It cannot be drawn.
    #[error(transparent)]
    Render(#[from] RenderError),
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
    if points.is_empty() { camera } else { around(&points, size, exaggeration) }
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
    /// Bytes of GPU memory that the picture itself takes, and what all diamonds share: see [`FrameStats::fixed_bytes`].
    pub gpu_fixed_bytes: u64,
    /// Milliseconds to draw the finished picture.
    pub milliseconds_a_frame: f64,
}

/// Streams until the camera's view is as exact as asked, and draws it. Gives up waiting after `patience`
/// and draws what is there. Where the look stretches heights, the camera's are stretched, too.
///
/// # Errors
/// When there is no graphics adapter.
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

/// A path through a scene: eyes and targets at moments.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FlightPath {
    /// Moments, in rising order.
    pub keys: Vec<PathKey>,
}

/// The camera at a moment.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PathKey {
    /// Seconds from the start.
    pub seconds: f64,
    /// The eye, in the frame's metres.
    pub eye: [f64; 3],
    /// What the camera looks at.
    pub target: [f64; 3],
}

impl FlightPath {
    /// Reads a path from a JSON file.
    ///
    /// # Errors
    /// When the file cannot be read or holds no path.
    pub fn read(path: &Path) -> Result<Self, HeadlessError> {
        let wrong = |what: String| HeadlessError::Path { path: path.to_owned(), what };
        let bytes = std::fs::metadata(path).map_err(file_error("read", path))?.len();
        if bytes > PATH_BYTES_MAX {
            return Err(wrong(format!("{bytes} bytes, limit {PATH_BYTES_MAX}")));
        }
        let text = std::fs::read(path).map_err(file_error("read", path))?;
        let flight: Self = serde_json::from_slice(&text).map_err(|e| wrong(e.to_string()))?;
        if flight.keys.is_empty() || flight.keys.len() > KEYS_MAX {
            return Err(wrong(format!("{} keys, expected 1 to {KEYS_MAX}", flight.keys.len())));
        }
        if !flight.keys.is_sorted_by(|a, b| a.seconds < b.seconds) {
            return Err(wrong("its seconds do not rise".to_owned()));
        }
        if flight.keys.iter().any(|k| k.eye == k.target) {
            return Err(wrong("an eye is its own target".to_owned()));
        }
        Ok(flight)
    }

    /// A round over a scene: in from the overview, across it low, and out.
    #[must_use]
    pub fn round(scene: &Scene) -> Self {
        let [low, high] = extent(scene);
        let centre = (low + high) / 2.0;
        let span = high - low;
        let far = overview(scene, [16, 9]);
        let keys = (0..=12).map(|i| {
            let part = f64::from(i) / 12.0;
            let angle = part * std::f64::consts::TAU - std::f64::consts::FRAC_PI_2;
            // 0 at both ends, 1 in the middle: how far in.
            let near = (part * std::f64::consts::PI).sin();
            let around = DVec3::new(angle.cos() * span.x, angle.sin() * span.y, 0.0) * (0.9 - 0.65 * near);
            let height = high.z + (far.eye.z - high.z) * (1.0 - near) + span.truncate().length() * 0.03;
            let eye = if i % 12 == 0 { far.eye } else { (centre + around).with_z(height) };
            PathKey {
                seconds: f64::from(i) * 1.0,
                eye: eye.to_array(),
                target: centre.with_z(low.z).to_array(),
            }
        });
        Self { keys: keys.collect() }
    }

    /// A flight at random, the same for the same seed: from place to place, low over the ground and high above it, with a key
    /// every five seconds. At most [`RANDOM_SECONDS_MAX`].
    #[must_use]
    pub fn random(scene: &Scene, seed: u64, seconds: f64) -> Self {
        let [low, high] = extent(scene);
        let span = (high - low).truncate();
        let mut dice = Dice(seed);
        let seconds = seconds.clamp(1e-3, RANDOM_SECONDS_MAX);
        let count = (seconds / RANDOM_STEP).ceil().max(1.0);
        let mut place = low.truncate() + span * DVec2::new(dice.roll(), dice.roll());
        #[allow(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "at most some ten thousand"
        )]
        let keys = (0..=count as u32).map(|i| {
            // Mostly on to somewhere near, now and then far away.
            let reach = if dice.roll() < 0.15 { 0.6 } else { 0.08 };
            let step = span * reach * (DVec2::new(dice.roll(), dice.roll()) - 0.5);
            place = (place + step).clamp(low.truncate(), high.truncate());
            // From a two-hundredth to a third of the scene's size above its highest ground.
            let above = span.max_element() * 0.005 * 66f64.powf(dice.roll());
            let ahead =
                DVec2::from_angle(std::f64::consts::TAU * dice.roll()) * above * (1.0 + 3.0 * dice.roll());
            let (eye, target) =
                (place.extend(high.z + above), (place + ahead).extend(low.z.midpoint(high.z)));
            let at = f64::from(i) / count * seconds;
            PathKey { seconds: at, eye: eye.to_array(), target: target.to_array() }
        });
        Self { keys: keys.collect() }
    }

    /// Seconds from the first key to the last.
    #[must_use]
    pub fn seconds(&self) -> f64 {
        match (self.keys.first(), self.keys.last()) {
            (Some(first), Some(last)) => last.seconds - first.seconds,
            _ => 0.0,
        }
    }

    /// The camera at a part (0 to 1) of the path, on a smooth curve through its keys (Catmull and Rom
    /// 1974).
    #[must_use]
    pub fn camera(&self, part: f64, size: [u32; 2]) -> Camera {
        let keys = &self.keys;
        let at = |i: usize| keys[i.min(keys.len() - 1)];
        let seconds = at(0).seconds + self.seconds() * part.clamp(0.0, 1.0);
        let i = keys.partition_point(|k| k.seconds <= seconds).saturating_sub(1);
        let (p1, p2) = (at(i), at(i + 1));
        let (p0, p3) = (at(i.saturating_sub(1)), at(i + 2));
        let length = p2.seconds - p1.seconds;
        let t = if length > 0.0 { (seconds - p1.seconds) / length } else { 0.0 };
        let curve = |f: fn(&PathKey) -> [f64; 3]| {
            let [a, b, c, d] = [p0, p1, p2, p3].map(|k| DVec3::from_array(f(&k)));
            let (t2, t3) = (t * t, t * t * t);
            0.5 * (2.0 * b
                + (c - a) * t
                + (2.0 * a - 5.0 * b + 4.0 * c - d) * t2
                + (3.0 * b - a - 3.0 * c + d) * t3)
        };
        Camera { eye: curve(|k| k.eye), target: curve(|k| k.target), fov_y: FOV_Y, size }
    }
}

/// Numbers that look random, the same from the same beginning (splitmix64).
pub(crate) struct Dice(pub(crate) u64);

impl Dice {
    /// From 0 to below 1.
    pub(crate) fn roll(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut v = self.0;
        v = (v ^ v >> 30).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        v = (v ^ v >> 27).wrapping_mul(0x94D0_49BB_1331_11EB);
        ((v ^ v >> 31) >> 11) as f64 / (1u64 << 53) as f64
    }
}

/// How water that changes with time goes on while a path is flown.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Play {
    /// Seconds of it for a second of the path; below 0: backwards; 0: it stands.
    pub speed: f64,
    /// Whether it begins again after the last step.
    pub is_round: bool,
}

/// How to fly.
#[derive(Debug, Clone)]
pub struct Flight {
    /// How water that changes with time goes on, from the terrain's time.
    pub play: Play,
    /// Frames to draw.
    pub frames: u32,
    /// Frames a second at most; 0: as fast as they can be drawn.
    pub frames_a_second: f64,
    /// Width and height, in pixels.
    pub size: [u32; 2],
    /// A folder for a PNG of each frame.
    pub pictures: Option<PathBuf>,
    /// Whether pictures come back from the graphics adapter even where they are not written; else each frame waits until
    /// it is drawn.
    pub reads: bool,
    /// Let each frame wait up to so long for data, so that what a flight takes follows from its path alone.
    pub patience: Option<Duration>,
}

/// One frame of a flight: a line of the CSV.
#[derive(Debug, Clone, Serialize)]
pub struct FrameLine {
    /// From 0.
    pub frame: u32,
    /// Seconds since the start.
    pub seconds: f64,
    /// Milliseconds to choose the cut and take what has arrived.
    pub cut_ms: f64,
    /// Milliseconds to upload and draw, until the picture is there; and to read it back, where pictures are.
    pub draw_ms: f64,
    /// The largest error of what is drawn, in pixels, as in [`PictureReport`]; `inf` until all roots are there.
    pub error_pixels: f64,
    /// The error of the ideal cut.
    pub goal_pixels: f64,
    /// Whether all that the ideal cut wants is there.
    pub complete: bool,
    /// Diamonds in motion.
    pub moving: usize,
    /// Diamonds drawn.
    pub diamonds: usize,
    /// Triangles drawn.
    pub triangles: u64,
    /// Draw calls.
    pub draws: u32,
    /// Bytes uploaded to the GPU for this frame.
    pub uploaded_bytes: u64,
    /// Bytes of surfaces on the GPU.
    pub gpu_bytes: u64,
    /// Diamonds resident.
    pub resident: usize,
    /// Bytes of memory that they take.
    pub resident_bytes: usize,
    /// Bytes received so far.
    pub bytes: u64,
    /// Requests sent so far.
    pub requests: u64,
    /// Round trips so far.
    pub round_trips: u64,
    /// Real points received so far.
    pub real_points: u64,
    /// Fictitious points deduced so far.
    pub fictitious_points: u64,
    /// Whether the eye was in the zone that was asked for: see [`PictureReport::zone_in_effect`].
    pub zone_in_effect: bool,
    /// Bytes of GPU memory besides those of surfaces: see [`FrameStats::fixed_bytes`].
    pub gpu_fixed_bytes: u64,
    /// Bytes so far that were fetched before, and came from the disk.
    pub disk_bytes: u64,
    /// Whether the server was not asked.
    pub offline: bool,
    /// Whether memory, here or on the GPU, kept the ideal cut from the asked error.
    pub limited_by_memory: bool,
    /// The time of water that changes with it, in seconds.
    pub time_seconds: f64,
    /// Series of which an earlier step was drawn, since that of this time had not arrived.
    pub late: usize,
    /// Steps of series that come next and were there already.
    pub steps_ahead: usize,
}

impl FrameLine {
    /// The heading of the CSV.
    pub const HEADING: &str = "frame,seconds,cut_ms,draw_ms,error_pixels,goal_pixels,complete,moving,diamonds,triangles,draws,uploaded_bytes,gpu_bytes,resident,resident_bytes,bytes,requests,round_trips,real_points,fictitious_points,zone_in_effect,gpu_fixed_bytes,disk_bytes,offline,limited_by_memory,time_seconds,late,steps_ahead";

    /// The line, with the fields of the heading.
    #[must_use]
    pub fn csv(&self) -> String {
        format!(
            "{},{:.4},{:.3},{:.3},{:.4},{:.4},{},{},{},{},{},{},{},{},{},{},{},{},{},{},{},{},{},{},{},{:.4},{},{}",
            self.frame,
            self.seconds,
            self.cut_ms,
            self.draw_ms,
            self.error_pixels,
            self.goal_pixels,
            self.complete,
            self.moving,
            self.diamonds,
            self.triangles,
            self.draws,
            self.uploaded_bytes,
            self.gpu_bytes,
            self.resident,
            self.resident_bytes,
            self.bytes,
            self.requests,
            self.round_trips,
            self.real_points,
            self.fictitious_points,
            self.zone_in_effect,
            self.gpu_fixed_bytes,
            self.disk_bytes,
            self.offline,
            self.limited_by_memory,
            self.time_seconds,
            self.late,
            self.steps_ahead,
        )
    }
}

/// Flies along a path while data stream in. Unless told to, no frame waits for them: each draws what is there. `each` sees
/// every frame's line and picture as soon as it is drawn. Motions take the path's time, not the wall's: so a flight
/// looks the same however long its frames take.
///
/// # Errors
/// When there is no graphics adapter, a picture cannot be written, or `each` says so.
pub fn fly(
    terrain: &mut Terrain,
    path: &FlightPath,
    flight: &Flight,
    look: &Look,
    options: &render::Options,
    mut each: impl FnMut(&FrameLine, Option<&Picture>) -> Result<(), HeadlessError>,
) -> Result<(), HeadlessError> {
    let mut offscreen = Offscreen::new(options)?;
    terrain.suit_blocks(offscreen.reads_blocks());
    terrain.set_exaggeration(look.exaggeration);
    // Of a version of the scene.
    let mut annotator: Option<(String, Annotator)> = None;
    terrain.set_wires(look.wireframe);
    terrain.set_mirrors(look.mirrors().then_some(look.water.mirror_error));
    let (play, from) = (flight.play, terrain.time());
    let is_playing = play.speed != 0.0;
    let course = is_playing.then_some(Course { is_backward: play.speed < 0.0, is_round: play.is_round });
    let started = Instant::now();
    for frame in 0..flight.frames {
        if flight.frames_a_second > 0.0 {
            let due = Duration::from_secs_f64(f64::from(frame) / flight.frames_a_second);
            std::thread::sleep(due.saturating_sub(started.elapsed()));
        }
        let part = f64::from(frame) / f64::from((flight.frames - 1).max(1));
        let camera = path.camera(part, flight.size);
        let clock = Instant::now();
        let drawn = stretched(&camera, look.exaggeration);
        let seconds = part * path.seconds();
        if is_playing {
            // It follows the path and waits for nothing: flights can be compared.
            let time = player::time_at(&terrain.scene().series, from, seconds, play.speed, play.is_round);
            terrain.set_time(time, course);
        }
        if let Some(patience) = flight.patience {
            terrain.settle_at(&drawn, seconds, patience);
        }
        let clock = flight.patience.map_or(clock, |_| Instant::now());
        let view = terrain.frame_at(&drawn, seconds);
        let cut_ms = clock.elapsed().as_secs_f64() * 1e3;
        let clock = Instant::now();
        // Waves move in the path's time, too.
        let mut look = *look;
        look.water.seconds += seconds;
        // Of this frame's version: another may have taken over, and lie elsewhere.
        offscreen.drape(view.drape.as_ref());
        offscreen.mirror(&view.mirrors);
        let stats = offscreen.draw(&terrain.scene().layers, &drawn, &view.items, &look)?;
        if look.annotations.is_any() {
            let version = &terrain.scene().version;
            let kept = annotator.take().filter(|(of, _)| of == version);
            let (_, annotator) =
                annotator.insert(kept.unwrap_or_else(|| (version.clone(), Annotator::new(terrain.scene()))));
            annotator.annotate(&mut offscreen, terrain, &drawn, &view.items, &look);
        }
        let picture = if flight.reads || flight.pictures.is_some() {
            Some(offscreen.read()?)
        } else {
            offscreen.wait()?;
            None
        };
        let draw_ms = clock.elapsed().as_secs_f64() * 1e3;
        let line = FrameLine {
            frame,
            seconds: started.elapsed().as_secs_f64(),
            cut_ms,
            draw_ms,
            error_pixels: view.error_pixels,
            goal_pixels: view.error_pixels_goal,
            complete: view.complete,
            moving: view.moving,
            diamonds: view.items.len(),
            triangles: stats.triangles,
            draws: stats.draws,
            uploaded_bytes: stats.uploaded_bytes,
            gpu_bytes: stats.gpu_bytes,
            resident: view.stats.resident,
            resident_bytes: view.stats.resident_bytes,
            bytes: view.stats.traffic.bytes,
            requests: view.stats.traffic.requests,
            round_trips: view.stats.traffic.round_trips,
            real_points: view.stats.points_real,
            fictitious_points: view.stats.points_fictitious,
            zone_in_effect: view.stats.zone_in_effect,
            gpu_fixed_bytes: stats.fixed_bytes,
            disk_bytes: view.stats.traffic.disk_bytes,
            offline: view.stats.offline,
            limited_by_memory: view.limited,
            time_seconds: terrain.time(),
            late: view.late,
            steps_ahead: view.stats.steps_ahead,
        };
        if let (Some(folder), Some(picture)) = (&flight.pictures, &picture) {
            save(picture, &folder.join(format!("frame-{frame:05}.png")))?;
        }
        each(&line, picture.as_ref())?;
    }
    Ok(())
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

    fn key(seconds: f64, x: f64) -> PathKey {
        PathKey { seconds, eye: [x, 0.0, 100.0], target: [x, 500.0, 0.0] }
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

    #[test]
    fn a_path_passes_through_its_keys() {
        let path = FlightPath { keys: vec![key(0.0, 0.0), key(1.0, 10.0), key(4.0, 5.0)] };
        for (part, x) in [(0.0, 0.0), (0.25, 10.0), (1.0, 5.0), (2.0, 5.0)] {
            assert!((path.camera(part, [4, 3]).eye.x - x).abs() < 1e-9, "{part}");
        }
        let lone = FlightPath { keys: vec![key(3.0, 7.0)] };
        assert_eq!(lone.camera(0.5, [4, 3]).eye.x, 7.0);
    }

    #[test]
    fn a_path_that_makes_no_sense_is_refused_with_its_name() {
        let folder = std::env::temp_dir().join(format!("diamantina-paths-{}", std::process::id()));
        std::fs::create_dir_all(&folder).unwrap();
        for (text, word) in [
            ("", "EOF"),
            ("{\"keys\": []}", "0 keys"),
            (
                "{\"keys\": [{\"seconds\":1,\"eye\":[0,0,1],\"target\":[0,0,0]},{\"seconds\":1,\"eye\":[0,0,1],\"target\":[0,0,0]}]}",
                "rise",
            ),
            ("{\"keys\": [{\"seconds\":1,\"eye\":[0,0,0],\"target\":[0,0,0]}]}", "its own target"),
        ] {
            let path = folder.join("path.json");
            std::fs::write(&path, text).unwrap();
            let message = FlightPath::read(&path).unwrap_err().to_string();
            assert!(message.contains("path.json") && message.contains(word), "{message}");
        }
        std::fs::remove_dir_all(&folder).unwrap();
    }

    #[test]
    fn the_csv_has_as_many_fields_as_its_heading() {
        let line = FrameLine {
            frame: 1,
            seconds: 2.0,
            cut_ms: 3.0,
            draw_ms: 4.0,
            error_pixels: f64::INFINITY,
            goal_pixels: 0.5,
            complete: false,
            moving: 0,
            diamonds: 1,
            triangles: 2,
            draws: 3,
            uploaded_bytes: 4,
            gpu_bytes: 5,
            resident: 6,
            resident_bytes: 7,
            bytes: 8,
            requests: 9,
            round_trips: 10,
            real_points: 11,
            fictitious_points: 12,
            zone_in_effect: true,
            gpu_fixed_bytes: 13,
            disk_bytes: 14,
            offline: false,
            limited_by_memory: true,
            time_seconds: 14.5,
            late: 1,
            steps_ahead: 2,
        };
        assert_eq!(line.csv().split(',').count(), FrameLine::HEADING.split(',').count());
        let json = serde_json::to_value(&line).unwrap();
        for name in FrameLine::HEADING.split(',') {
            assert!(json.get(name).is_some(), "{name}");
        }
    }
}
