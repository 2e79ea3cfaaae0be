//! What each term of the client's level of detail saves: bytes and triangles of flights.
//!
//! A source is built, served on this machine alone, and flown over by `diamantina-client`, which must lie beside
//! this program: the cut is the client's, and no copy of it is kept here. Each frame waits for its data, so what a
//! flight takes follows from its path and the terms alone.

use super::report::{Picture, Report, Table};
use super::{ExperimentError, Whole, plot};
use crate::client_program::{self, NoClient};
use crate::hierarchy::{self, BuildError};
use crate::http::{ServeError, Server};
use crate::ingest::{self, Source};
use crate::progress::Progress;
use diamantina_protocol::message::Scene;
use serde::Serialize;
use std::io;
use std::net::{Ipv4Addr, SocketAddr};
use std::path::{Path, PathBuf};

/// How to fly.
#[derive(Debug, Clone, Copy, clap::Args)]
#[group(id = "flight_options")]
pub struct Options {
    /// `lod`: the error that each frame reaches, in pixels
    #[arg(long, default_value_t = 1.0, value_name = "PIXELS")]
    error_pixels: f64,
    /// `lod`: frames of each flight
    #[arg(long, default_value_t = 33, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=100_000))]
    frames: u32,
    /// `lod`: how many times that error foveation allows at the picture's corners
    #[arg(long, default_value_t = 4.0, value_name = "TIMES")]
    foveation: f64,
}

/// A flight with some terms.
#[derive(Debug, Clone, PartialEq)]
struct Flown {
    flight: &'static str,
    terms: &'static str,
    /// That went over the wire.
    bytes: u64,
    /// The same up to each frame.
    received: Vec<u64>,
    /// Drawn a frame, on average.
    triangles: f64,
    /// The largest error of any frame, as the terms count it.
    error_pixels: f64,
}

/// Why there are no figures.
#[derive(Debug, thiserror::Error)]
pub enum LodError {
    /// A file cannot be written or read.
    #[error("{path}: {error}; set TMPDIR to a folder that you may write to")]
    Io {
        /// Which.
        path: PathBuf,
        /// What the system said.
        error: io::Error,
    },
    /// The source cannot be built.
    #[error(transparent)]
    Build(#[from] BuildError),
    /// The scene cannot be served.
    #[error(transparent)]
    Serve(#[from] ServeError),
    /// There is no client to fly with.
    #[error(transparent)]
    NoClient(#[from] NoClient),
    /// There is nowhere to fly.
    #[error("the DEM is one sample: a larger one is needed to fly over it")]
    Point,
    /// The client failed.
    #[error("the client could not fly '{flight}': {message}")]
    Client {
        /// The flight.
        flight: &'static str,
        /// What it said.
        message: String,
    },
}

/// Terms of the cut: each is the client's arguments that turn them on or off.
struct Terms {
    name: &'static str,
    vertical: bool,
    foveation: bool,
}

const TERMS: [Terms; 4] = [
    Terms { name: "distance", vertical: false, foveation: false },
    Terms { name: "vertical", vertical: true, foveation: false },
    Terms { name: "foveation", vertical: false, foveation: true },
    Terms { name: "vertical and foveation", vertical: true, foveation: true },
];

/// Moments of a path.
const KEYS: u32 = 9;
/// Seconds that a frame waits for data at most.
const PATIENCE: &str = "60";
/// Pixels of a frame.
const SIZE: [u32; 2] = [1380, 768];

pub(super) fn run(whole: &Whole<'_>) -> Result<Report, ExperimentError> {
    let plan = &whole.options.flights;
    for (option, value, least) in
        [("--error-pixels", plan.error_pixels, f64::MIN_POSITIVE), ("--foveation", plan.foveation, 1.0)]
    {
        if !(value.is_finite() && value >= least) {
            let expected = if least < 1.0 { "a number above 0" } else { "a number from 1 on" }.to_owned();
            return Err(ExperimentError::Options { option, expected, found: value.to_string() });
        }
    }
    let columns = [
        "DEM",
        "flight",
        "terms",
        "bytes",
        "bytes saved [%]",
        "triangles a frame",
        "triangles saved [%]",
        "largest error [px]",
    ];
    let caption = "Flights with each term on and off; savings are against distance alone";
    let mut table = Table::new("lod", caption, &columns);
    let mut pictures = Vec::new();
    for path in whole.sources {
        let source = ingest::open(std::slice::from_ref(path), whole.ingest)?;
        let name = path.file_name().unwrap_or(path.as_os_str()).to_string_lossy().into_owned();
        let mut plain: Option<Flown> = None;
        let all = fly_over(&source, plan, whole.progress)?;
        pictures.extend(plots(&name, pictures.len(), &all)?);
        for flown in all {
            if plain.as_ref().is_none_or(|p| p.flight != flown.flight) {
                plain = Some(flown.clone());
            }
            let Some(all) = &plain else { continue };
            table.push([
                name.clone(),
                flown.flight.to_owned(),
                flown.terms.to_owned(),
                flown.bytes.to_string(),
                saved(flown.bytes as f64, all.bytes as f64),
                format!("{:.0}", flown.triangles),
                saved(flown.triangles, all.triangles),
                format!("{:.3}", flown.error_pixels),
            ]);
        }
    }
    let Options { error_pixels, frames, foveation } = plan;
    let notes = vec![
        format!(
            "Each flight has {frames} frames of {} x {} pixels, each of which waits until no error looks larger than \
             {error_pixels} pixels, with an empty cache at the start.",
            SIZE[0], SIZE[1]
        ),
        "Distance: an error counts as a sphere of its size. Vertical: errors of heights count as they are seen. \
         Foveation: at the picture's corners an error may look so many times as large as in the middle: "
            .to_owned()
            + &format!("{foveation}."),
    ];
    Ok(Report { title: "Level of detail".to_owned(), notes, tables: vec![table], pictures })
}

/// Percent that are saved where all would be so many; of nothing, nothing.
fn saved(own: f64, all: f64) -> String {
    format!("{:.1}", if all > 0.0 { 100.0 * (1.0 - own / all) } else { 0.0 })
}

/// The bytes received up to each frame, a plot a flight.
fn plots(source: &str, first: usize, all: &[Flown]) -> Result<Vec<Picture>, ExperimentError> {
    let mut pictures = Vec::new();
    for flights in all.chunk_by(|a, b| a.flight == b.flight) {
        let line = |flown: &Flown| {
            let points =
                flown.received.iter().enumerate().map(|(i, bytes)| [i as f64, *bytes as f64 / 1000.0]);
            plot::Series { name: flown.terms.to_owned(), points: points.collect() }
        };
        let series: Vec<plot::Series> = flights.iter().map(line).collect();
        let title = format!("{source}: bytes of the flight '{}'", flights[0].flight);
        let bytes = plot::lines(&title, ["frame", "received [kB]"], false, &series)?;
        let file = format!("{}-{}.svg", first + pictures.len(), flights[0].flight);
        pictures.push(Picture { file, caption: title, bytes });
    }
    Ok(pictures)
}

/// Builds a source, flies over it with each set of terms, and says what that took.
fn fly_over(source: &Source, plan: &Options, progress: &Progress) -> Result<Vec<Flown>, LodError> {
    let at = |path: &Path| {
        let path = path.to_owned();
        move |error| LodError::Io { path, error }
    };
    let folder = std::env::temp_dir();
    client_program::path()?;
    let work = tempfile::Builder::new().prefix("diamantina-lod").tempdir_in(&folder).map_err(at(&folder))?;
    let store = work.path().join("scene");
    let scene = hierarchy::build(source, &store, &hierarchy::Options::new("flight"), progress)?.scene;
    if scene.layers.iter().all(|layer| layer.samples == [1, 1]) {
        return Err(LodError::Point);
    }
    let server = Server::open(&[store], SocketAddr::from((Ipv4Addr::LOCALHOST, 0)))?;
    let url = format!("{}/scenes/{}", server.address(), scene.name);
    let (stop, stopped) = tokio::sync::oneshot::channel::<()>();
    std::thread::scope(|scope| {
        let serving = scope.spawn(move || {
            server.run(async move {
                // Dropped or sent, it means the same.
                let _ = stopped.await;
            })
        });
        let flown = fly_all(&url, work.path(), &scene, plan, progress);
        let _ = stop.send(());
        let served = serving.join().unwrap_or(Ok(()));
        flown.and_then(|flown| served.map(|()| flown).map_err(LodError::from))
    })
}

fn fly_all(
    url: &str,
    work: &Path,
    scene: &Scene,
    plan: &Options,
    progress: &Progress,
) -> Result<Vec<Flown>, LodError> {
    let paths = paths(scene);
    progress.stage("fly", "flights", (paths.len() * TERMS.len()) as u64, 0);
    let mut all: Vec<Flown> = Vec::new();
    for (flight, keys) in paths {
        let file = work.join(format!("{flight}.json"));
        let text = serde_json::json!({ "keys": keys }).to_string();
        std::fs::write(&file, text).map_err(|error| LodError::Io { path: file.clone(), error })?;
        for terms in &TERMS {
            let mut command = client_program::command()?;
            command.arg("fly").arg(url).arg("--path").arg(&file).args(["--csv", "-", "--fps", "0"]);
            command.args(["--settle", PATIENCE, "--no-antialias"]);
            command.args(["--size".to_owned(), format!("{}x{}", SIZE[0], SIZE[1])]);
            command.args(["--frames".to_owned(), plan.frames.to_string()]);
            command.args(["--error-pixels".to_owned(), plan.error_pixels.to_string()]);
            if !terms.vertical {
                command.arg("--sphere-error");
            }
            if terms.foveation {
                command.args(["--foveation".to_owned(), plan.foveation.to_string()]);
            }
            let failed = |message: String| LodError::Client { flight, message };
            let output = command.output().map_err(|error| failed(error.to_string()))?;
            if !output.status.success() {
                let told = String::from_utf8_lossy(&output.stderr).trim().to_owned();
                return Err(failed(if told.is_empty() { output.status.to_string() } else { told }));
            }
            let csv = String::from_utf8_lossy(&output.stdout);
            let flown = read(&csv, flight, terms.name).ok_or_else(|| failed(format!("it wrote {csv:?}")))?;
            all.push(flown);
            progress.advance(1);
        }
    }
    Ok(all)
}

/// What the lines of a flight sum up to; `None` where they are not such lines.
fn read(csv: &str, flight: &'static str, terms: &'static str) -> Option<Flown> {
    let mut lines = csv.lines();
    let names: Vec<&str> = lines.next()?.split(',').collect();
    let column = |name: &str| names.iter().position(|n| *n == name);
    let (bytes, triangles, error) = (column("bytes")?, column("triangles")?, column("error_pixels")?);
    let mut flown =
        Flown { flight, terms, bytes: 0, received: Vec::new(), triangles: 0.0, error_pixels: 0.0 };
    let mut frames = 0.0;
    for line in lines {
        let fields: Vec<&str> = line.split(',').collect();
        flown.bytes = fields.get(bytes)?.parse().ok()?;
        flown.received.push(flown.bytes);
        flown.triangles += fields.get(triangles)?.parse::<f64>().ok()?;
        flown.error_pixels = flown.error_pixels.max(fields.get(error)?.parse().ok()?);
        frames += 1.0;
    }
    flown.triangles /= frames;
    (frames > 0.0).then_some(flown)
}

/// A moment of a path, as the client reads it.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
struct Key {
    seconds: f64,
    eye: [f64; 3],
    target: [f64; 3],
}

/// The flights: straight down over a diagonal, as a map is looked at; slanting over it; and low across.
fn paths(scene: &Scene) -> Vec<(&'static str, Vec<Key>)> {
    let Some(layer) = scene.layers.first() else { return Vec::new() };
    let far = layer.position([layer.samples[0].saturating_sub(1), layer.samples[1].saturating_sub(1)]);
    let near = layer.position([0, 0]);
    let size = [far[0] - near[0], far[1] - near[1]];
    let span = size[0].hypot(size[1]);
    let top = layer.heights[1];
    let place = |part: f64| [0, 1].map(|i| near[i] + size[i] * part);
    let along = |eye: &dyn Fn(f64) -> [f64; 3], aim: &dyn Fn([f64; 3]) -> [f64; 3]| -> Vec<Key> {
        let key = |i: u32| {
            let eye = eye(f64::from(i) / f64::from(KEYS - 1));
            Key { seconds: f64::from(i), eye, target: aim(eye) }
        };
        (0..KEYS).map(key).collect()
    };
    let over = |up: f64| {
        move |part: f64| {
            let [x, y] = place(0.25 + 0.5 * part);
            [x, y, top + up * span]
        }
    };
    let ahead = |down: f64| move |[x, y, z]: [f64; 3]| [x + size[0], y + size[1], z - down * span];
    vec![
        ("down", along(&over(0.4), &|[x, y, z]| [x, y, z - span])),
        ("slanting", along(&over(0.08), &ahead(0.7))),
        ("low", along(&over(0.01), &ahead(0.1))),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_of_a_flight_sum_up() {
        let csv = "frame,error_pixels,triangles,bytes\n0,0.5,100,10\n1,0.9,300,70\n";
        let flown = read(csv, "down", "distance").unwrap();
        assert_eq!((flown.bytes, flown.triangles, flown.error_pixels), (70, 200.0, 0.9));
        for csv in [
            "",
            "frame,bytes\n0,1\n",
            "frame,error_pixels,triangles,bytes\n",
            "error_pixels,triangles,bytes\n1,x,2\n",
        ] {
            assert!(read(csv, "down", "distance").is_none(), "{csv:?}");
        }
    }
}
