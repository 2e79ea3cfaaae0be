//! The command line of the client.

mod annotate;
mod keep;
mod load;
mod look;
mod size;
mod time;

use annotate::AnnotateArgs;
use clap::{Args, Parser, Subcommand, ValueEnum};
use diamantina_client::camera::{Camera, FOV_Y};
use diamantina_client::disk::Disk;
use diamantina_client::doctor::{self, Verdict};
use diamantina_client::encoding::Encoding;
use diamantina_client::fetch::{self, FetchError};
use diamantina_client::headless::{self, Flight, FlightPath, FrameLine, PictureReport};
use diamantina_client::morph;
use diamantina_client::render::{self, Look};
use diamantina_client::sight::Sight;
use diamantina_client::terrain::{self, Imagery, Terrain, TerrainError};
use diamantina_client::texture::{Coding, FADE_SECONDS};
use diamantina_client::viewer::{self, Viewer};
use diamantina_protocol::arguments::with_negative_numbers;
use glam::DVec3;
use keep::{KeepArgs, Kept, tell_offline};
use look::{LookArgs, untrue};
use size::parse_size as parse_bytes;
use std::io::{IsTerminal, Write};
use std::path::PathBuf;
use std::process::ExitCode;
use std::time::Duration;
use time::{PlayArgs, TimeArgs};

/// Seconds that points move in a window.
const MORPH_SECONDS: f64 = 0.3;

/// Draws streamed terrain.
#[derive(Parser)]
#[command(version, about, propagate_version = true)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Draw a picture once it is as exact as asked
    Render(RenderArgs),
    /// Fly along a path while data stream in
    Fly(FlyArgs),
    /// Look around in a window
    View(ViewerArgs),
    /// Tell what is wrong with a server, as clients see it through all the proxies and caches before it
    Doctor(DoctorArgs),
    /// Load a server with many users, and tell how it fares
    Load(load::LoadArgs),
}

/// What a private scene asks for.
#[derive(Args, Clone)]
struct TokenArgs {
    /// Show this to the server, for private scenes. Others of this machine can read arguments: rather set the variable
    #[arg(long, env = "DIAMANTINA_TOKEN", hide_env_values = true, value_name = "TOKEN")]
    token: Option<String>,
}

#[derive(Args)]
struct DoctorArgs {
    /// The server, or one of its scenes: http://HOST:PORT or http://HOST:PORT/scenes/NAME
    url: String,
    #[command(flatten)]
    token: TokenArgs,
    /// Write what was found here, one JSON object a line (- for standard output)
    #[arg(long, value_name = "JSON")]
    json: Option<PathBuf>,
}

#[derive(Args)]
struct ViewerArgs {
    #[command(flatten)]
    view: ViewArgs,
    /// Seconds that the ground takes to change where the level of detail does: points move, triangles appear [default: 0.3, and
    /// 0 with --true]
    #[arg(long, value_name = "SECONDS")]
    morph: Option<f64>,
    /// Keep nothing on the disk
    #[arg(long, conflicts_with_all = ["disk_cache", "offline"])]
    no_disk_cache: bool,
}

#[derive(Args, Clone)]
struct ViewArgs {
    /// The server, or one of its scenes: http://HOST:PORT or http://HOST:PORT/scenes/NAME, or as a browser has it,
    /// http://HOST:PORT/?scene=NAME; for `view` also with #x,y,z,heading,pitch, or with ,seconds behind where water
    /// changes with time
    url: String,
    #[command(flatten)]
    token: TokenArgs,
    /// Width and height of the picture, in pixels
    #[arg(long, default_value = "1380x768", value_name = "WIDTHxHEIGHT", value_parser = parse_size)]
    size: [u32; 2],
    /// The largest error on the screen, in pixels
    #[arg(long, default_value_t = 1.0, value_name = "PIXELS")]
    error_pixels: f64,
    /// Take an error for a sphere of its size, which looks the same from all sides. Without it errors of heights
    /// count for less seen from above, where they hardly show
    #[arg(long)]
    sphere_error: bool,
    /// How many times as large as in the middle of the picture an error may look at its corners; 1: the same
    /// everywhere
    #[arg(long, default_value_t = 1.0, value_name = "TIMES")]
    foveation: f64,
    /// How diamonds are encoded: points take the fewest bytes, tin draws the fewest triangles
    #[arg(long, default_value = "points", value_enum)]
    encoding: EncodingName,
    /// Stream and draw these layers alone [default: all]
    #[arg(long = "layer", value_name = "NAME", value_delimiter = ',')]
    layers: Option<Vec<String>>,
    /// Ask for less where nothing is seen from this zone, while the eye is in it: errors in pixels, those reported
    /// too, then count for what is seen of them
    #[arg(long, value_name = "NAME")]
    zone: Option<String>,
    /// The imagery to lay on the terrain, or none [default: the scene's first, if it has any]
    #[arg(long, value_name = "NAME|none")]
    texture: Option<String>,
    /// Memory for tiles of imagery, at most 1000MiB, and as much again of --gpu-memory, of which they take a third at most; where it
    /// is too little, imagery is coarser
    #[arg(long, default_value = "128MiB", value_name = "SIZE", value_parser = parse_bytes)]
    texture_memory: u64,
    /// Keep imagery in blocks (BC7) where the graphics card reads them: four times as many tiles in --texture-memory, in colours
    /// that are a little off. Adapters in software draw them slowly [default: on for view but in software, else off]
    #[arg(long, value_name = "on|off", value_enum)]
    texture_compression: Option<Switch>,
    /// Memory for decoded diamonds; where it is too little for the error asked for, the view is coarser
    #[arg(long, default_value = "1GiB", value_name = "SIZE", value_parser = parse_bytes)]
    memory: u64,
    /// GPU memory for all that is drawn: first the pictures that a frame is made of (some 40 bytes a pixel, 12 with
    /// --no-antialias, and with water 16 more), then imagery, then diamonds and their motions. Where it is too little, the view is
    /// coarser; where there is no room for the pictures, render and fly fail
    #[arg(long, default_value = "512MiB", value_name = "SIZE", value_parser = parse_bytes)]
    gpu_memory: u64,
    #[command(flatten)]
    time: TimeArgs,
    #[command(flatten)]
    keep: KeepArgs,
    #[command(flatten)]
    look: LookArgs,
    #[command(flatten)]
    annotate: AnnotateArgs,
}

#[derive(Clone, Copy, ValueEnum)]
enum EncodingName {
    Points,
    Tin,
}

#[derive(Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Switch {
    On,
    Off,
}

#[derive(Args)]
struct RenderArgs {
    #[command(flatten)]
    view: ViewArgs,
    /// The picture to write (PNG)
    #[arg(short, long, value_name = "PNG")]
    output: PathBuf,
    /// The eye, in the frame's metres [default: where the whole scene is seen]
    #[arg(long, value_name = "X,Y,Z", value_parser = parse_point, requires = "target")]
    eye: Option<DVec3>,
    /// A point in the middle of the picture, in the frame's metres
    #[arg(long, value_name = "X,Y,Z", value_parser = parse_point, requires = "eye")]
    target: Option<DVec3>,
    /// Ask for the whole view in one request, the largest errors first: one round trip after the scene's
    /// description. Without --eye it is asked for as seen from a little farther away than it is then drawn, and
    /// more requests follow
    #[arg(long, conflicts_with = "zone")]
    stream: bool,
    /// Seconds to wait for data before drawing what is there
    #[arg(long, default_value_t = 60.0, value_name = "SECONDS")]
    timeout: f64,
    /// Write numbers about the picture here (- for standard output)
    #[arg(long, value_name = "JSON")]
    json: Option<PathBuf>,
}

#[derive(Args)]
struct FlyArgs {
    #[command(flatten)]
    view: ViewArgs,
    /// The path, as {"keys": [{"seconds": 0, "eye": [x,y,z], "target": [x,y,z]}, ...]} [default: a round over the scene]
    #[arg(long, value_name = "JSON")]
    path: Option<PathBuf>,
    /// Fly at random for --seconds, the same way for the same number
    #[arg(long, value_name = "SEED", conflicts_with = "path")]
    random: Option<u64>,
    /// How long a flight at random is, in the path's time
    #[arg(long, default_value_t = 60.0, value_name = "SECONDS", requires = "random")]
    seconds: f64,
    /// Frames to draw, spread evenly over the path
    #[arg(long, default_value_t = 300, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=1_000_000))]
    frames: u32,
    /// Frames a second at most; 0: as fast as they can be drawn
    #[arg(long, default_value_t = 30.0, value_name = "N")]
    fps: f64,
    /// Let each frame wait for its data, up to so many seconds: what a flight takes then follows from its path
    /// alone, and flights can be compared
    #[arg(long, value_name = "SECONDS")]
    settle: Option<f64>,
    /// Seconds of the path that the ground takes to change where its level of detail does, up to 60: points move, triangles
    /// appear; 0: it jumps
    #[arg(long, default_value_t = 0.0, value_name = "SECONDS")]
    morph: f64,
    #[command(flatten)]
    play: PlayArgs,
    /// Write a line for each frame here (- for standard output)
    #[arg(long, value_name = "CSV")]
    csv: Option<PathBuf>,
    /// Write each frame as a PNG into this folder
    #[arg(long, value_name = "FOLDER")]
    pictures: Option<PathBuf>,
}

fn numbers<const N: usize>(text: &str) -> Result<[f64; N], String> {
    let parts: Vec<f64> = text
        .split(',')
        .map(|p| p.trim().parse().map_err(|_| format!("'{p}' is not a number")))
        .collect::<Result<_, _>>()?;
    let found = parts.len();
    let numbers: [f64; N] =
        parts.try_into().map_err(|_| format!("expected {N} numbers with commas between, found {found}"))?;
    if numbers.iter().all(|n| n.is_finite()) {
        Ok(numbers)
    } else {
        Err("expected finite numbers".to_owned())
    }
}

fn parse_point(text: &str) -> Result<DVec3, String> {
    numbers(text).map(DVec3::from_array)
}

fn parse_size(text: &str) -> Result<[u32; 2], String> {
    let pair = text.split_once('x').and_then(|(w, h)| Some([w.parse().ok()?, h.parse().ok()?]));
    pair.filter(|[w, h]: &[u32; 2]| *w > 0 && *h > 0)
        .ok_or_else(|| "expected WIDTHxHEIGHT in pixels, as in 1380x768".to_owned())
}

/// A failure with its exit code: 1 failed, 2 wrong use.
struct Failure(u8, String);

impl<E: std::error::Error> From<E> for Failure {
    fn from(error: E) -> Self {
        Self(1, error.to_string())
    }
}

/// What became of printing results. That nobody reads any more, as behind `| head`, is no failure.
fn shown(printed: std::io::Result<()>) -> std::io::Result<()> {
    match printed {
        Err(e) if e.kind() == std::io::ErrorKind::BrokenPipe => Ok(()),
        other => other,
    }
}

pub(crate) fn run() -> ExitCode {
    let filter = tracing_subscriber::EnvFilter::try_from_default_env()
        .unwrap_or_else(|_| "warn,wgpu_hal=error,wgpu_core=error".into());
    let colours =
        std::io::stderr().is_terminal() && std::env::var_os("NO_COLOR").is_none_or(|v| v.is_empty());
    let log = tracing_subscriber::fmt().with_env_filter(filter).with_ansi(colours);
    log.with_writer(std::io::stderr).init();
    let result = match Cli::parse_from(with_negative_numbers(std::env::args_os())).command {
        Command::Render(args) => render(&args),
        Command::Fly(args) => fly(&args),
        Command::View(args) => view(&args),
        Command::Doctor(args) => doctor(&args),
        Command::Load(args) => load::run(&args),
    };
    match result {
        Ok(()) => ExitCode::SUCCESS,
        Err(Failure(code, message)) => {
            // Nothing is left to do if standard error is closed.
            let _ = writeln!(std::io::stderr(), "error: {message}");
            ExitCode::from(code)
        }
    }
}

impl ViewArgs {
    fn look(&self, terrain: &Terrain) -> Look {
        Look { annotations: self.annotate.annotations(), ..self.look.look(terrain.scene()) }
    }

    fn render_options(&self) -> render::Options {
        render::Options { budget_bytes: self.gpu_memory, ..self.look.options() }
    }

    /// `in_window`: imagery is kept in blocks unless something else is asked for, and another version of the scene is looked for.
    fn open(&self, morph_seconds: f64, disk: Option<&Disk>, in_window: bool) -> Result<Terrain, Failure> {
        if !(self.error_pixels.is_finite() && self.error_pixels > 0.0) {
            return Err(Failure(
                2,
                format!("--error-pixels {}: expected a number above 0", self.error_pixels),
            ));
        }
        self.look.check()?;
        self.annotate.check(self.size)?;
        if self.look.is_true && morph_seconds > 0.0 {
            return Err(untrue("--morph", "what is drawn is what has arrived"));
        }
        if self.look.is_true && self.texture_compression == Some(Switch::On) {
            return Err(untrue("--texture-compression on", "imagery is shown as it was taken"));
        }
        if !(self.foveation.is_finite() && self.foveation >= 1.0) {
            return Err(Failure(2, format!("--foveation {}: expected a number from 1 on", self.foveation)));
        }
        let encoding = match self.encoding {
            EncodingName::Points => Encoding::Points,
            EncodingName::Tin => Encoding::Tin,
        };
        let options = terrain::Options {
            tolerance_pixels: self.error_pixels,
            memory_bytes: usize::try_from(self.memory).unwrap_or(usize::MAX),
            gpu_bytes: self.gpu_memory,
            sight: Sight { vertical: !self.sphere_error, foveation: self.foveation },
            morph_seconds,
            fetch: fetch::Options {
                encoding,
                token: self.token.token.as_deref().map(Into::into),
                disk: disk.cloned(),
                offline: self.keep.is_offline(),
                follow: in_window.then_some(viewer::FOLLOW),
                ..fetch::Options::default()
            },
            layers: self.layers.clone(),
            time: self.time.seconds(),
            zone: self.zone.clone(),
            // Colours tell heights, unless a picture is asked for.
            imagery: match &self.texture {
                None if self.look.is_true => Imagery::None,
                asked => Imagery::asked(asked.clone()),
            },
            texture_bytes: usize::try_from(self.texture_memory).unwrap_or(usize::MAX),
            texture_coding: Coding::blocks_if(match self.texture_compression {
                Some(asked) => asked == Switch::On,
                None => in_window && !self.look.is_true,
            }),
            fade_seconds: if morph_seconds > 0.0 { FADE_SECONDS.min(morph_seconds) } else { 0.0 },
            ..terrain::Options::default()
        };
        let terrain = Terrain::open(&self.url, options).map_err(|error| {
            let wrong_use = matches!(
                error,
                TerrainError::Fetch(FetchError::Address { .. } | FetchError::Layer { .. })
                    | TerrainError::Zone { .. }
                    | TerrainError::Texture { .. }
            );
            Failure(if wrong_use { 2 } else { 1 }, error.to_string())
        })?;
        self.time.check(&terrain)?;
        tell_offline(&terrain);
        Ok(terrain)
    }
}

fn render(args: &RenderArgs) -> Result<(), Failure> {
    let patience = Duration::try_from_secs_f64(args.timeout)
        .map_err(|_| Failure(2, format!("--timeout {}: expected seconds, 0 or more", args.timeout)))?;
    if args.stream && matches!(args.view.encoding, EncodingName::Tin) {
        return Err(Failure(2, "streams are of points: leave --stream or --encoding tin out".to_owned()));
    }
    let kept = args.view.keep.open(false)?;
    let mut terrain = args.view.open(0.0, kept.0.as_ref(), false)?;
    let ViewArgs { size, .. } = args.view;
    let exaggeration = args.view.look.exaggeration;
    let camera = match (args.eye, args.target) {
        (Some(eye), Some(target)) if eye == target => {
            return Err(Failure(
                2,
                "--eye and --target are the same point: there is no direction to look in".to_owned(),
            ));
        }
        (Some(eye), Some(target)) => {
            let camera = Camera { eye, target, fov_y: FOV_Y, size };
            if args.stream {
                headless::stream(&mut terrain, &camera, exaggeration);
            }
            camera
        }
        _ => {
            if args.stream {
                let wide = headless::stretched_overview(&terrain.shown_scene(), size, exaggeration);
                headless::stream(&mut terrain, &wide, exaggeration);
            }
            headless::framed(&mut terrain, size, exaggeration, patience)
        }
    };
    let look = args.view.look(&terrain);
    let (picture, report) =
        headless::picture(&mut terrain, &camera, &look, &args.view.render_options(), patience)?;
    headless::save(&picture, &args.output)?;
    if let Some(path) = &args.json {
        let mut out = headless::open_text(path)?;
        let printed = writeln!(out, "{}", serde_json::to_string_pretty(&report)?);
        shown(printed.and_then(|()| out.flush()))?;
    }
    if args.json.as_ref().is_none_or(|p| p.as_os_str() != "-") {
        shown(print_report(args, &report))?;
    }
    if report.gpu_total_bytes > args.view.gpu_memory {
        let _ = writeln!(
            std::io::stderr(),
            "notice: {}",
            too_large(report.gpu_total_bytes, args.view.gpu_memory)
        );
    }
    if let Some(words) = headless::below_ground(report.eye[2], report.ground_at_eye) {
        let _ = writeln!(std::io::stderr(), "notice: {words}");
    }
    let why = match (report.complete, report.limited_by_memory) {
        (true, false) => return Ok(()),
        (true, true) => "there is no memory for less: raise --memory or --gpu-memory",
        (false, _) if report.offline => "offline, and more was not fetched before",
        (false, _) => {
            terrain.problem().unwrap_or("the data did not arrive in time; wait longer with --timeout")
        }
    };
    let what = if report.asked_error_reached {
        // A tile of imagery, say.
        "not all of it arrived".to_owned()
    } else {
        format!("its largest error is {:.2} pixels", report.largest_error_pixels)
    };
    Err(Failure(1, format!("{}: written, but {what}: {why}", args.output.display())))
}

/// What to say where the coarsest diamonds alone are too much for the GPU's memory.
fn too_large(taken: u64, budget: u64) -> String {
    let [taken, budget] = [taken, budget].map(|bytes| bytes as f64 / f64::from(1 << 20));
    format!(
        "{taken:.1} MiB of GPU memory were taken, of {budget:.1}: the coarsest diamonds are drawn in any case; raise --gpu-memory"
    )
}

fn print_report(args: &RenderArgs, r: &PictureReport) -> std::io::Result<()> {
    let mut out = std::io::stdout().lock();
    writeln!(
        out,
        "{}: {} x {} pixels, largest error {:.2} pixels",
        args.output.display(),
        r.size[0],
        r.size[1],
        r.largest_error_pixels
    )?;
    writeln!(
        out,
        "  {} bytes in {} requests and {} round trips; {} real points, {} fictitious",
        r.bytes, r.requests, r.round_trips, r.real_points, r.fictitious_points
    )?;
    if r.disk_bytes > 0 {
        writeln!(out, "  {} bytes fetched before{}", r.disk_bytes, if r.offline { ", offline" } else { "" })?;
    }
    writeln!(
        out,
        "  {} triangles in {} draws, {:.0} ms a frame",
        r.triangles_drawn, r.draws, r.milliseconds_a_frame
    )
}

fn view(args: &ViewerArgs) -> Result<(), Failure> {
    let morph = args.morph.unwrap_or(if args.view.look.is_true { 0.0 } else { MORPH_SECONDS });
    if !(0.0..=morph::SECONDS_MAX).contains(&morph) {
        let max = morph::SECONDS_MAX;
        return Err(Failure(2, format!("--morph {morph}: expected seconds from 0 to {max}")));
    }
    let (url, at) = match args.view.url.split_once('#') {
        Some((url, view)) => {
            let expected = "expected #x,y,z,heading,pitch, metres and degrees, or with ,seconds or &exaggeration=FACTOR (0.1 to 20) behind, as `Copy view` gives it";
            let at = viewer::View::parse(view, args.view.size);
            (url.to_owned(), Some(at.ok_or_else(|| Failure(2, format!("#{view}: {expected}")))?))
        }
        None => (args.view.url.clone(), None),
    };
    let view = ViewArgs { url: url.clone(), ..args.view.clone() };
    let kept = if args.no_disk_cache { Kept(None) } else { view.keep.open(true)? };
    let terrain = view.open(morph, kept.0.as_ref(), true)?;
    let look = view.look(&terrain);
    let title = format!("{} - Diamantina", terrain.scene().name);
    let viewer = Viewer::new(terrain, &url, look, view.size, at);
    viewer::window::run(viewer, &title, &view.render_options()).map_err(|e| Failure(1, e.to_string()))
}

fn doctor(args: &DoctorArgs) -> Result<(), Failure> {
    let mut json = args.json.as_deref().map(headless::open_text).transpose()?;
    let is_quiet = args.json.as_ref().is_some_and(|path| path.as_os_str() == "-");
    let (mut counts, mut failed) = ([0u32; 3], None);
    let told = doctor::examine(&args.url, args.token.token.as_deref(), |finding| {
        counts[finding.verdict as usize] += 1;
        let mut write = || -> std::io::Result<()> {
            if let Some(out) = &mut json {
                writeln!(out, "{}", serde_json::to_string(&finding)?)?;
            }
            if !is_quiet {
                let mut out = std::io::stdout().lock();
                writeln!(out, "{:8} {:18} {}", finding.verdict, finding.check, finding.found)?;
                if let Some(remedy) = finding.remedy {
                    writeln!(out, "{:27} {remedy}", "")?;
                }
            }
            Ok(())
        };
        if let Err(error) = write() {
            failed.get_or_insert(error);
        }
    });
    told.map_err(|e| Failure(if matches!(e, FetchError::Address { .. }) { 2 } else { 1 }, e.to_string()))?;
    if let Some(out) = &mut json {
        shown(out.flush())?;
    }
    if let Some(error) = failed {
        shown(Err(error))?;
    }
    match counts[Verdict::Bad as usize] {
        0 => Ok(()),
        1 => Err(Failure(1, "one thing does not work".to_owned())),
        n => Err(Failure(1, format!("{n} things do not work"))),
    }
}

fn fly(args: &FlyArgs) -> Result<(), Failure> {
    if !(args.fps.is_finite() && args.fps >= 0.0) {
        return Err(Failure(2, format!("--fps {}: expected 0 or more", args.fps)));
    }
    let patience = args.settle.map(Duration::try_from_secs_f64).transpose();
    let patience = patience.map_err(|_| {
        let found = args.settle.unwrap_or_default();
        Failure(2, format!("--settle {found}: expected seconds, 0 or more"))
    })?;
    if !(0.0..=morph::SECONDS_MAX).contains(&args.morph) {
        let max = morph::SECONDS_MAX;
        return Err(Failure(2, format!("--morph {}: expected seconds from 0 to {max}", args.morph)));
    }
    let path = args.path.as_deref().map(FlightPath::read).transpose()?;
    if !(args.seconds > 0.0 && args.seconds <= headless::RANDOM_SECONDS_MAX) {
        let (found, most) = (args.seconds, headless::RANDOM_SECONDS_MAX);
        return Err(Failure(2, format!("--seconds {found}: expected seconds above 0, at most {most}")));
    }
    let kept = args.view.keep.open(false)?;
    let mut terrain = args.view.open(args.morph, kept.0.as_ref(), false)?;
    let path = path.unwrap_or_else(|| {
        let scene = terrain.shown_scene();
        args.random
            .map_or_else(|| FlightPath::round(&scene), |seed| FlightPath::random(&scene, seed, args.seconds))
    });
    let mut csv = args.csv.as_deref().map(headless::open_text).transpose()?;
    if let Some(out) = &mut csv {
        writeln!(out, "{}", FrameLine::HEADING)?;
    }
    if let Some(folder) = &args.pictures {
        std::fs::create_dir_all(folder).map_err(|e| {
            Failure(
                1,
                format!(
                    "{}: cannot create the folder: {e}; choose another with --pictures",
                    folder.display()
                ),
            )
        })?;
    }
    let flight = Flight {
        play: args.play.play()?,
        frames: args.frames,
        frames_a_second: args.fps,
        size: args.view.size,
        pictures: args.pictures.clone(),
        reads: false,
        patience,
    };
    let (mut slowest_cut, mut draw_sum, mut gpu_most, mut last) = (0.0f64, 0.0, 0, None);
    let mut failed = None;
    let bar = indicatif::ProgressBar::new(args.frames.into());
    let look = args.view.look(&terrain);
    headless::fly(&mut terrain, &path, &flight, &look, &args.view.render_options(), |line, _| {
        slowest_cut = slowest_cut.max(line.cut_ms);
        draw_sum += line.draw_ms;
        gpu_most = gpu_most.max(line.gpu_total_bytes);
        bar.inc(1);
        if let Some(out) = &mut csv
            && let Err(e) = writeln!(out, "{}", line.csv())
        {
            failed.get_or_insert(e);
        }
        last = Some(line.clone());
        Ok(())
    })?;
    bar.finish_and_clear();
    if let Some(out) = &mut csv {
        out.flush()?;
    }
    if let Some(error) = failed {
        return Ok(shown(Err(error))?);
    }
    if let Some(last) = last.filter(|_| args.csv.as_ref().is_none_or(|p| p.as_os_str() != "-")) {
        let mut out = std::io::stdout().lock();
        writeln!(
            out,
            "{} frames in {:.1} s: slowest cut {slowest_cut:.1} ms, mean draw {:.1} ms",
            args.frames,
            last.seconds,
            draw_sum / f64::from(args.frames)
        )?;
        writeln!(
            out,
            "  {} bytes in {} requests and {} round trips; error at the end {:.2} pixels",
            last.bytes, last.requests, last.round_trips, last.error_pixels
        )?;
        writeln!(out, "  {:.1} MiB of GPU memory at most", gpu_most as f64 / f64::from(1 << 20))?;
    }
    if gpu_most > args.view.gpu_memory {
        let _ = writeln!(std::io::stderr(), "notice: {}", too_large(gpu_most, args.view.gpu_memory));
    }
    Ok(())
}
