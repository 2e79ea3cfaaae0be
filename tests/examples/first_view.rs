//! How soon a view is there over a slow link: serves stores, puts a shaped link before them and watches the client's
//! error on screen, with and without `stream`.
//!
//! `cargo run --release -p diamantina-tests --example first_view -- STORE...`; `--help` has the options. Prints a
//! table. Ends with 1 if the error on screen grew while the eye stood still, or if the view was not completed.
#![allow(
    clippy::cast_possible_truncation,
    clippy::cast_possible_wrap,
    clippy::cast_sign_loss,
    reason = "bytes and pixels are small numbers"
)]

#[path = "../first_view.rs"]
mod first_view;
#[path = "../link.rs"]
mod link;

use clap::Parser;
use diamantina_client::camera::{Camera, FOV_Y};
use diamantina_client::{fetch, headless, terrain};
use diamantina_protocol::message::Scene;
use diamantina_server::http::Server;
use diamantina_server::{height, store::Store};
use first_view::{Watch, Watched, watch};
use glam::DVec3;
use link::{Link, Shape};
use std::error::Error;
use std::io::Write;
use std::path::PathBuf;
use std::process::ExitCode;
use std::time::Duration;

/// Seconds from nothing to a view, over a shaped link.
#[derive(Parser)]
struct Arguments {
    /// Stores, each of one scene
    #[arg(required = true)]
    stores: Vec<PathBuf>,
    /// Megabits a second, each way; several with commas between
    #[arg(long, value_delimiter = ',', default_value = "20,4")]
    rate: Vec<f64>,
    /// Milliseconds there and back
    #[arg(long, default_value_t = 50)]
    round_trip: u64,
    /// Views, with commas between: overview (the whole scene), ground (from above its middle, to the north)
    #[arg(long, value_delimiter = ',', default_value = "overview,ground")]
    view: Vec<View>,
    /// Metres above the ground, in the view from there
    #[arg(long, default_value_t = 1000.0)]
    above: f64,
    /// The error to reach, in pixels
    #[arg(long, default_value_t = 1.0)]
    error_pixels: f64,
    /// Width and height of the picture, in pixels
    #[arg(long, value_delimiter = 'x', num_args = 1, default_value = "1380x768")]
    size: Vec<u32>,
    /// Frames a second
    #[arg(long, default_value_t = 60.0)]
    frames: f64,
    /// Requests in flight at once
    #[arg(long, default_value_t = fetch::Options::default().requests_max)]
    requests: usize,
    /// Memory for surfaces, in MiB
    #[arg(long, default_value_t = terrain::Options::default().memory_bytes >> 20)]
    memory: usize,
    /// How often each is measured; the table has the middle one by the seconds to the asked error
    #[arg(long, default_value_t = 3)]
    times: usize,
    /// Write every frame here: seconds, error in pixels, bytes
    #[arg(long)]
    csv: Option<PathBuf>,
}

#[derive(Clone, Copy, clap::ValueEnum)]
enum View {
    Overview,
    Ground,
}

fn main() -> ExitCode {
    match run(&Arguments::parse()) {
        Ok(true) => ExitCode::SUCCESS,
        Ok(false) => ExitCode::FAILURE,
        Err(error) => {
            eprintln!("first_view: {error}");
            ExitCode::FAILURE
        }
    }
}

/// Whether all views came, and none got worse.
fn run(arguments: &Arguments) -> Result<bool, Box<dyn Error>> {
    let [width, height] = arguments.size[..] else { return Err("--size: expected WIDTHxHEIGHT".into()) };
    let positive = arguments.rate.iter().chain([&arguments.frames, &arguments.error_pixels]);
    if arguments.times == 0 || !positive.copied().all(|x| x > 0.0 && x.is_finite()) {
        return Err("rates, frames, times and errors: expected numbers above 0".into());
    }
    let mut csv = arguments.csv.as_ref().map(std::fs::File::create).transpose()?;
    if let Some(csv) = &mut csv {
        writeln!(csv, "store,view,mbit,round_trip_ms,how,run,seconds,error_pixels,bytes")?;
    }
    println!(
        "| store, view | link | how | first picture | 8 px | {:.2} px: 1/100 | asked error | bytes | the line alone | requests | round trips |",
        f64::from(height) / 100.0
    );
    println!("|---|---|---|---|---|---|---|---|---|---|---|");
    let mut good = true;
    for path in &arguments.stores {
        let address = serve(path)?;
        let store = Store::open(path)?;
        let label =
            path.file_name().map_or_else(|| path.display().to_string(), |n| n.to_string_lossy().into());
        for view in &arguments.view {
            let camera = camera(&store, *view, arguments.above, [width, height])?;
            let name = match view {
                View::Overview => "overview",
                View::Ground => "ground",
            };
            for mbit in &arguments.rate {
                let shape = Shape {
                    bits_per_second: mbit * 1e6,
                    round_trip: Duration::from_millis(arguments.round_trip),
                };
                for streamed in [false, true] {
                    let how = if streamed { "stream" } else { "wishes" };
                    let mut runs = Vec::new();
                    for number in 0..arguments.times {
                        let watched = one(&address, &store, shape, streamed, arguments, camera)?;
                        if let Some(csv) = &mut csv {
                            for s in &watched.seen {
                                let (trip, first) = (arguments.round_trip, number + 1);
                                writeln!(
                                    csv,
                                    "{label},{name},{mbit},{trip},{how},{first},{:.4},{:.4},{}",
                                    s.seconds, s.error_pixels, s.bytes
                                )?;
                            }
                        }
                        good &= is_good(&watched);
                        runs.push(watched);
                    }
                    let row = row(runs, shape, f64::from(height), arguments.error_pixels);
                    println!("| {label}, {name} | {mbit} Mbit/s | {how} | {row} |");
                }
            }
        }
    }
    Ok(good)
}

/// Serves a store on a free port until the process ends.
fn serve(store: &PathBuf) -> Result<String, Box<dyn Error>> {
    let server = Server::open(std::slice::from_ref(store), "127.0.0.1:0".parse()?)?;
    let address = server.address();
    std::thread::spawn(move || {
        if let Err(error) = server.run(std::future::pending()) {
            eprintln!("first_view: the server ended: {error}");
        }
    });
    Ok(address)
}

/// The eye of a view. From the ground it looks north and ten degrees down, from above the middle of the scene.
fn camera(store: &Store, view: View, above: f64, size: [u32; 2]) -> Result<Camera, Box<dyn Error>> {
    let scene = store.scene();
    if let View::Overview = view {
        return Ok(headless::overview(scene, size));
    }
    let [low, high] = headless::extent(scene);
    let middle = low.midpoint(high);
    let found = height::height(
        &height::Decoded::new(0),
        store,
        0,
        &scene.layers[0],
        scene.frame.crs.as_ref(),
        [middle.x, middle.y],
    )?;
    // Where there is nothing, the middle of all heights will do.
    let eye = middle.with_z(found.height.unwrap_or(middle.z) + above);
    let down = 10f64.to_radians();
    let target = eye + DVec3::new(0.0, down.cos(), -down.sin()) * (high.y - middle.y);
    Ok(Camera { eye, target, fov_y: FOV_Y, size })
}

fn one(
    address: &str,
    store: &Store,
    shape: Shape,
    streamed: bool,
    arguments: &Arguments,
    camera: Camera,
) -> Result<Watched, Box<dyn Error>> {
    // A link of its own, so that nothing is under way, nor any connection open.
    let link = Link::start(address, shape)?;
    let fetch = fetch::Options { requests_max: arguments.requests, ..fetch::Options::default() };
    let options = terrain::Options {
        tolerance_pixels: arguments.error_pixels,
        memory_bytes: arguments.memory.saturating_mul(1 << 20),
        fetch,
        ..terrain::Options::default()
    };
    let pause = Duration::from_secs_f64(1.0 / arguments.frames);
    let how = Watch { options, streamed, pause, patience: Duration::from_secs(120) };
    let url = format!("{}/scenes/{}", link.address, store.scene().name);
    Ok(watch(&url, &how, |_: &Scene| camera)?)
}

/// Whether a view came and never got worse; says so if not.
fn is_good(watched: &Watched) -> bool {
    if let Some([before, after]) = watched.growth() {
        eprintln!("first_view: FAILED: the eye stood still and the error grew: {before:?}, then {after:?}");
        return false;
    }
    if !watched.last.complete {
        eprintln!("first_view: FAILED: not complete: {:?}", watched.last.stats);
    }
    watched.last.complete
}

/// The middle of several runs, as columns.
fn row(mut runs: Vec<Watched>, shape: Shape, height: f64, asked: f64) -> String {
    let reached = |watched: &Watched| watched.asked(asked).map_or(f64::INFINITY, |s| s.seconds);
    runs.sort_by(|a, b| reached(a).total_cmp(&reached(b)));
    let watched = &runs[(runs.len() - 1) / 2];
    let at =
        |seen: Option<first_view::Seen>| seen.map_or("–".to_owned(), |s| format!("{:.2} s", s.seconds));
    let traffic = watched.last.stats.traffic;
    format!(
        "{} | {} | {} | {:.2} s ({:.2} px) | {} | {:.2} s | {} | {}",
        at(watched.first_picture()),
        at(watched.within(8.0)),
        at(watched.within(height / 100.0)),
        reached(watched),
        watched.last.error_pixels,
        traffic.bytes,
        shape.time(traffic.bytes as usize).as_secs_f64(),
        traffic.requests,
        traffic.round_trips,
    )
}
