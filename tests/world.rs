//! The harness: synthetic DEM → store → server on a free port → client, and a network that misbehaves.

use diamantina_client::terrain::{self, Terrain};
use diamantina_server::hierarchy::{self, Report};
use diamantina_server::http::{self, Limits, Server};
use diamantina_server::progress::Progress;
use diamantina_server::{ingest, sample};
use std::io::{Read, Write};
use std::net::{Shutdown, TcpListener, TcpStream};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::Arc;
use std::sync::OnceLock;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;
use tempfile::TempDir;

/// Numbers that look random and are the same in each run.
pub(crate) struct Dice(pub(crate) u64);

impl Dice {
    /// The next number (splitmix64).
    pub(crate) fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut v = self.0;
        v = (v ^ v >> 30).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        v = (v ^ v >> 27).wrapping_mul(0x94D0_49BB_1331_11EB);
        v ^ v >> 31
    }

    /// A number from 0 to below 1.
    pub(crate) fn roll(&mut self) -> f64 {
        (self.next() >> 11) as f64 / (1u64 << 53) as f64
    }

    /// A number from 0 to below `n`.
    pub(crate) fn below(&mut self, n: u64) -> u64 {
        self.next() % n
    }
}

/// The programs, as a user has them.
pub(crate) struct Programs {
    pub(crate) server: PathBuf,
    pub(crate) client: PathBuf,
}

/// Builds both programs, once, in the profile of this test.
pub(crate) fn programs() -> &'static Programs {
    static PROGRAMS: OnceLock<Programs> = OnceLock::new();
    PROGRAMS.get_or_init(|| {
        // The test lies in target/PROFILE/deps. Of the profiles only dev has a folder with another name.
        let exe = std::env::current_exe().unwrap();
        let profile = exe.parent().and_then(Path::parent).and_then(Path::file_name).unwrap();
        let profile = profile.to_str().unwrap();
        let mut cargo = Command::new(std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into()));
        // All of the workspace, tests too: so dependencies have the features that `cargo test --workspace`
        // gave them, and only the programs themselves are left to build.
        cargo.current_dir(workspace()).args(["build", "--workspace", "--bins", "--tests"]);
        cargo.arg("--message-format=json-render-diagnostics");
        cargo.args(["--profile", if profile == "debug" { "dev" } else { profile }]);
        // What cargo told this test about its own package is not for the build: dependencies that look at it would be
        // built again, and all that needs them.
        let told = |name: &std::ffi::OsStr| {
            let name = name.to_string_lossy();
            name.starts_with("CARGO_PKG_")
                || name.starts_with("CARGO_MANIFEST_")
                || name == "CARGO_CRATE_NAME"
        };
        for (name, _) in std::env::vars_os().filter(|(name, _)| told(name)) {
            cargo.env_remove(name);
        }
        let output = cargo.stderr(Stdio::inherit()).output().unwrap();
        assert!(output.status.success(), "the programs do not build");
        let messages: Vec<serde_json::Value> = output
            .stdout
            .split(|b| *b == b'\n')
            .filter_map(|line| serde_json::from_slice(line).ok())
            .collect();
        let find = |name: &str| {
            let found = messages.iter().find(|m| {
                m["target"]["kind"][0] == "bin"
                    && m["target"]["name"] == name
                    && m["profile"]["test"] == false
            });
            PathBuf::from(
                found.unwrap_or_else(|| panic!("cargo built no {name}"))["executable"].as_str().unwrap(),
            )
        };
        Programs { server: find("diamantina-server"), client: find("diamantina-client") }
    })
}

/// The root of the workspace.
pub(crate) fn workspace() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap().to_owned()
}

/// The folder with real DEMs, if there is one: `DIAMANTINA_DATA`, or `shared/data` beside the workspace.
pub(crate) fn data() -> Option<PathBuf> {
    let given = std::env::var_os("DIAMANTINA_DATA").map(PathBuf::from);
    let folder = given.unwrap_or_else(|| workspace().join("../shared/data"));
    if folder.join("MANIFEST.tsv").exists() {
        return Some(folder);
    }
    // Not through the test harness, which keeps what a passing test prints to itself.
    let _ = writeln!(std::io::stderr(), "SKIPPED: no real DEMs: set DIAMANTINA_DATA");
    None
}

/// What a build is told unless a test says otherwise.
pub(crate) fn options() -> hierarchy::Options {
    hierarchy::Options::new("world")
}

/// Writes `width` x `height` floats as a raw DEM and says how to read it. `height` is asked for each sample,
/// x to the east and y to the north; `None` is nodata.
pub(crate) fn write_raw(
    path: &Path,
    [width, height]: [u32; 2],
    at: impl Fn(u32, u32) -> Option<f32>,
) -> ingest::Options {
    let rows = (0..height).rev().flat_map(|y| (0..width).map(move |x| (x, y)));
    let bytes: Vec<u8> = rows.flat_map(|(x, y)| at(x, y).unwrap_or(-9999.0).to_le_bytes()).collect();
    std::fs::write(path, bytes).unwrap();
    ingest::Options {
        raw: Some(format!("{width}x{height}:f32").parse().unwrap()),
        cell: Some(30.0),
        nodata: Some(-9999.0),
        ..ingest::Options::default()
    }
}

/// Builds a store.
pub(crate) fn build(
    dem: &Path,
    store: &Path,
    ingest: &ingest::Options,
    options: &hierarchy::Options,
) -> Report {
    let source = ingest::open(&[dem.to_owned()], ingest).unwrap();
    hierarchy::build(&source, store, options, &Progress::new()).unwrap()
}

/// A client over HTTP that asks servers of this machine directly, to be told more.
pub(crate) fn asker() -> reqwest::ClientBuilder {
    // The first one stays; the client under test may have chosen it.
    let _ = tokio_rustls::rustls::crypto::ring::default_provider().install_default();
    reqwest::Client::builder().no_proxy()
}

/// A server of some stores, on a free port, until dropped.
pub(crate) struct Served {
    /// `http://127.0.0.1:PORT`.
    pub(crate) address: String,
    stop: Option<tokio::sync::oneshot::Sender<()>>,
}

/// Serves stores on a free port.
pub(crate) fn serve(stores: &[PathBuf]) -> Served {
    serve_within(stores, Limits::default())
}

/// Serves stores on a free port, within limits.
pub(crate) fn serve_within(stores: &[PathBuf], limits: Limits) -> Served {
    serve_with(stores, &http::Options { limits, ..http::Options::default() })
}

/// Serves stores on a free port, as told.
pub(crate) fn serve_with(stores: &[PathBuf], options: &http::Options) -> Served {
    let server = Server::open_with(stores, "127.0.0.1:0".parse().unwrap(), options).unwrap();
    let address = server.address();
    let (stop, stopped) = tokio::sync::oneshot::channel();
    std::thread::spawn(move || {
        server.run(async move {
            // Dropped or sent, it means the same.
            let _ = stopped.await;
        })
    });
    Served { address, stop: Some(stop) }
}

impl Served {
    /// The address of a scene.
    pub(crate) fn scene(&self, name: &str) -> String {
        format!("{}/scenes/{name}", self.address)
    }

    /// Opens the scene `world`.
    pub(crate) fn open(&self, tolerance_pixels: f64) -> Terrain {
        let options = terrain::Options { tolerance_pixels, ..terrain::Options::default() };
        Terrain::open(&self.scene("world"), options).unwrap()
    }
}

impl Drop for Served {
    fn drop(&mut self) {
        // Nobody waits for the thread: it lets its last answers end.
        self.stop.take();
    }
}

/// A folder with the made landscape as a DEM, its store, and a server of it.
pub(crate) struct World {
    /// The scratch folder: `dem.tif` and `store` lie in it.
    pub(crate) folder: TempDir,
    pub(crate) report: Report,
    pub(crate) served: Served,
}

impl World {
    /// The sample landscape, with its sea of nodata.
    pub(crate) fn sample(samples: u32, max_error: f64) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let dem = folder.path().join("dem.tif");
        sample::write(&dem, samples).unwrap();
        let options = hierarchy::Options { max_error, ..options() };
        Self::of(folder, &dem, &ingest::Options::default(), &options)
    }

    /// The same landscape without holes: the sea is flat ground.
    pub(crate) fn whole(samples: u32) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let dem = folder.path().join("dem.raw");
        let last = f64::from(samples - 1);
        let ingest = write_raw(&dem, [samples; 2], |x, y| {
            Some(sample::height(f64::from(x) / last, f64::from(y) / last).unwrap_or(0.0))
        });
        Self::of(folder, &dem, &ingest, &options())
    }

    /// As [`World::whole`], with triangles, too.
    pub(crate) fn whole_with_triangles(samples: u32) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let dem = folder.path().join("dem.raw");
        let last = f64::from(samples - 1);
        let ingest = write_raw(&dem, [samples; 2], |x, y| {
            Some(sample::height(f64::from(x) / last, f64::from(y) / last).unwrap_or(0.0))
        });
        let options = hierarchy::Options { tin: Some(hierarchy::TinOptions::default()), ..options() };
        Self::of(folder, &dem, &ingest, &options)
    }

    fn of(folder: TempDir, dem: &Path, ingest: &ingest::Options, options: &hierarchy::Options) -> Self {
        let store = folder.path().join("store");
        let report = build(dem, &store, ingest, options);
        let served = serve(&[store]);
        Self { folder, report, served }
    }
}

/// What a network does to answers.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Faults {
    /// The longest pause before each piece of an answer. Each connection has its own, so answers overtake one
    /// another.
    pub(crate) delay: Duration,
    /// How likely a connection is to be cut at some random byte.
    pub(crate) cut: f64,
    /// The connection that is the first to carry more bytes than this is cut there, and no other.
    pub(crate) first_cut_at: Option<u64>,
    /// How likely a connection is to fall silent for `stall` at some random byte.
    pub(crate) stalled: f64,
    /// See `stalled`.
    pub(crate) stall: Duration,
}

/// A TCP proxy in front of a server.
pub(crate) struct Proxy {
    /// `http://127.0.0.1:PORT`.
    pub(crate) address: String,
    /// Connections that were cut or fell silent so far.
    pub(crate) faults_done: Arc<AtomicU64>,
}

impl Proxy {
    /// Starts a proxy, whose threads end with the process. The first connection, which reads the scene's
    /// description, is neither cut nor silent before that has come; clients may ask for all the rest over it, too.
    pub(crate) fn start(upstream: &str, faults: Faults, seed: u64) -> Self {
        let upstream = upstream.strip_prefix("http://").unwrap().to_owned();
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let address = format!("http://{}", listener.local_addr().unwrap());
        let faults_done = Arc::new(AtomicU64::new(0));
        let done = Arc::clone(&faults_done);
        std::thread::spawn(move || {
            for (number, client) in listener.incoming().enumerate() {
                let (Ok(client), Ok(server)) = (client, TcpStream::connect(&upstream)) else { continue };
                let (mut up, mut down) = (client.try_clone().unwrap(), server.try_clone().unwrap());
                std::thread::spawn(move || {
                    let _ = std::io::copy(&mut up, &mut down);
                    let _ = down.shutdown(Shutdown::Write);
                });
                let done = Arc::clone(&done);
                let dice = Dice(seed ^ (number as u64) << 20);
                let spared = if number == 0 { DESCRIPTION_BYTES_MAX } else { 0 };
                std::thread::spawn(move || pump(server, client, faults, dice, spared, &done));
            }
        });
        Self { address, faults_done }
    }
}

/// More than the description of any scene here takes.
const DESCRIPTION_BYTES_MAX: u64 = 16 << 10;

/// Hands a server's answers to a client, late, in pieces, or not at all; but nothing happens to so many bytes at first.
fn pump(
    mut from: TcpStream,
    mut to: TcpStream,
    faults: Faults,
    mut dice: Dice,
    spared: u64,
    done: &AtomicU64,
) {
    // Where in the connection's life something happens to it.
    let cut_at = (dice.roll() < faults.cut).then(|| spared + dice.below(60_000));
    let stall_at = (dice.roll() < faults.stalled).then(|| spared + dice.below(60_000));
    let delay = faults.delay.mul_f64(dice.roll());
    let (mut sent, mut stalled) = (0, false);
    let mut buffer = vec![0; 4096];
    while let Ok(count @ 1..) = from.read(&mut buffer) {
        std::thread::sleep(delay.mul_f64(dice.roll()));
        sent += count as u64;
        if !stalled && stall_at.is_some_and(|at| sent > at) {
            stalled = true;
            done.fetch_add(1, Ordering::Relaxed);
            std::thread::sleep(faults.stall);
        }
        let is_first = faults.first_cut_at.is_some_and(|at| sent > at)
            && done.compare_exchange(0, 1, Ordering::Relaxed, Ordering::Relaxed).is_ok();
        if !is_first && cut_at.is_some_and(|at| sent > at) {
            done.fetch_add(1, Ordering::Relaxed);
        }
        if is_first || cut_at.is_some_and(|at| sent > at) {
            let _ = to.write_all(&buffer[..count / 2]);
            break;
        }
        if to.write_all(&buffer[..count]).is_err() {
            break;
        }
    }
    let _ = to.shutdown(Shutdown::Both);
    let _ = from.shutdown(Shutdown::Both);
}
