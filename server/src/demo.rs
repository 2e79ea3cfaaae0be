//! The demonstration: a made landscape, built, served and drawn by the client.

use crate::client_program::{self, NoClient};
use crate::hierarchy::{self, BuildError, Options};
use crate::http::{self, ServeError, Server};
use crate::ingest::{self, IngestError};
use crate::progress::Progress;
use crate::sample;
use std::io::{self, Write};
use std::net::SocketAddr;
use std::path::{Path, PathBuf};

/// Why the demonstration stopped.
#[derive(Debug, thiserror::Error)]
pub enum DemoError {
    /// A folder or file cannot be written.
    #[error("{path}: {error}; choose a folder that you may write to with --folder")]
    Io {
        /// Which.
        path: PathBuf,
        /// What the system said.
        error: io::Error,
    },
    /// The sample cannot be written.
    #[error("{0}")]
    Sample(String),
    /// The sample cannot be read back.
    #[error(transparent)]
    Ingest(#[from] IngestError),
    /// The sample cannot be built.
    #[error(transparent)]
    Build(#[from] BuildError),
    /// The scene cannot be served.
    #[error(transparent)]
    Serve(#[from] ServeError),
    /// There is no client to draw with.
    #[error(transparent)]
    NoClient(#[from] NoClient),
    /// The client failed.
    #[error("the client could not draw the picture; its message is above")]
    Client,
}

/// A view among the mountains: the eye and what it looks at, each in parts of the whole and metres up.
const NEAR: [[f64; 3]; 2] = [[0.5697, 0.4303, 4200.0], [0.6673, 0.6093, 1000.0]];

/// Coordinates as the client's command line takes them.
fn position([east, north, up]: [f64; 3], samples: u32) -> String {
    let [x, y] = sample::place(east, north, samples);
    format!("{x:.0},{y:.0},{up:.0}")
}

/// Makes the sample scene in `folder`, serves it at `listen` (any free port if that one is taken), draws a
/// picture of it, says how to go on, and serves until interrupted, unless `headless`.
///
/// # Errors
/// When any of that fails.
pub fn run(folder: &Path, samples: u32, listen: SocketAddr, headless: bool) -> Result<(), DemoError> {
    let at = |path: &Path| {
        let path = path.to_owned();
        move |error| DemoError::Io { path, error }
    };
    std::fs::create_dir_all(folder).map_err(at(folder))?;
    let server_program = std::env::current_exe().map_err(at(folder))?;
    let client = client_program::path()?;
    let (dem, store, picture) = (folder.join("sample.tif"), folder.join("sample"), folder.join("sample.png"));
    say(&format!("Making a landscape of {samples} x {samples} samples: {}", dem.display()));
    sample::write(&dem, samples).map_err(DemoError::Sample)?;
    let photo = folder.join("photo.tif");
    say(&format!("Making a picture of it from the air: {}", photo.display()));
    sample::write_imagery(&photo, samples).map_err(DemoError::Sample)?;
    say(&format!("Building the store: {}", store.display()));
    let source = ingest::open(std::slice::from_ref(&dem), &ingest::Options::default())?;
    let options = Options { max_error: 0.5, memory: 1 << 30, ..Options::new("sample") };
    let report = hierarchy::build(&source, &store, &options, &Progress::new())?;
    say(&format!(
        "  {} diamonds, {} bytes, {:.2} bits a sample at 0.5 m, {:.1} s",
        report.diamonds, report.point_bytes, report.bits_per_sample, report.seconds
    ));
    let options = http::Options { web: http::web_folder(), ..http::Options::default() };
    let open = |listen| Server::open_with(std::slice::from_ref(&store), listen, &options);
    let server = match open(listen) {
        Err(ServeError::Listen { error, .. }) if error.kind() == io::ErrorKind::AddrInUse => {
            say(&format!("Port {} is taken; using a free one.", listen.port()));
            open(SocketAddr::new(listen.ip(), 0))?
        }
        other => other?,
    };
    let url = format!("{}/scenes/sample", server.address());
    let page = server.has_viewer().then(|| format!("{}/", server.address()));
    let (stop, stopped) = tokio::sync::oneshot::channel::<()>();
    std::thread::scope(|scope| {
        let serving = scope.spawn(move || {
            server.run(async move {
                // Dropped or sent, it means the same.
                let _ = stopped.await;
            })
        });
        let drawn = draw(&url, &picture);
        if drawn.is_ok() {
            say(&format!("Picture: {}", picture.display()));
            let program = client.display();
            let url = if headless {
                say("Go on with, for instance:");
                say(&format!("  {} serve {} --listen {listen}", server_program.display(), store.display()));
                format!("http://{listen}/scenes/sample")
            } else {
                say(&format!("Serving {url}\nGo on with, for instance:"));
                url.clone()
            };
            if let Some(page) = page.filter(|_| !headless) {
                say(&format!("  a browser, at {page}"));
            }
            let [eye, target] = NEAR.map(|view| position(view, samples));
            say(&format!("  {program} render {url} -o near.png --eye {eye} --target {target}"));
            let [x, y] = sample::place(NEAR[1][0], NEAR[1][1], samples);
            say(&format!("  curl '{url}/terrain/height?x={x:.0}&y={y:.0}'"));
        }
        if drawn.is_ok() && !headless {
            say("Press Ctrl-C to end.");
            wait_for_interrupt();
        }
        let _ = stop.send(());
        let served = serving.join().unwrap_or(Ok(()));
        drawn.and(served.map_err(DemoError::from))
    })
}

fn draw(url: &str, picture: &Path) -> Result<(), DemoError> {
    let mut command = client_program::command()?;
    match command.arg("render").arg(url).arg("-o").arg(picture).status() {
        Ok(status) if status.success() => Ok(()),
        Ok(_) => Err(DemoError::Client),
        Err(error) => Err(DemoError::Io { path: command.get_program().into(), error }),
    }
}

fn wait_for_interrupt() {
    if let Ok(runtime) = tokio::runtime::Builder::new_current_thread().enable_all().build() {
        // Without a signal handler the default one ends the process: as good.
        let _ = runtime.block_on(tokio::signal::ctrl_c());
    }
}

fn say(line: &str) {
    // Standard output may be closed; the work goes on.
    let _ = writeln!(io::stdout(), "{line}");
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_near_view_is_above_ground() {
        // The first half of the line of sight is free.
        let [eye, target] = NEAR;
        for step in 0..10 {
            let part = f64::from(step) / 20.0;
            let [x, y, z] = [0, 1, 2].map(|i| eye[i] + (target[i] - eye[i]) * part);
            let ground = f64::from(sample::height(x, y).expect("land"));
            assert!(z > ground + 300.0, "{part}: {z} m over {ground} m");
        }
        assert_eq!(position(eye, 2049), "655002,7954998,4200");
    }
}
