//! The viewer in a window of a virtual screen, driven by a mouse and keys as a person does.
#![cfg(target_os = "linux")]

use crate::world::{World, programs, serve};
use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::thread::sleep;
use std::time::{Duration, Instant};

const PATIENCE: Duration = Duration::from_secs(90);

/// A program that ends with the test.
struct Running(Child);

impl Drop for Running {
    fn drop(&mut self) {
        // It may have ended by itself.
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// A screen that nobody sees.
struct Screen {
    name: String,
    _server: Running,
}

impl Screen {
    fn start() -> Self {
        let mut command = Command::new("Xvfb");
        // Else it begins anew whenever a client has left it alone, and refuses who comes just then.
        command.args(["-displayfd", "1", "-screen", "0", "1000x700x24", "-nolisten", "tcp", "-noreset"]);
        let mut child = command.stdout(Stdio::piped()).stderr(Stdio::null()).spawn().unwrap_or_else(|e| {
            panic!("Xvfb: {e}; install the packages that scripts/setup names (xvfb, xdotool, x11-apps)")
        });
        let mut number = String::new();
        BufReader::new(child.stdout.take().unwrap()).read_line(&mut number).unwrap();
        Self { name: format!(":{}", number.trim()), _server: Running(child) }
    }

    /// Moves the mouse, presses keys.
    fn act(&self, words: &[&str]) {
        let status = Command::new("xdotool").args(words).env("DISPLAY", &self.name).status();
        assert!(status.unwrap().success(), "{words:?}");
    }

    /// What is on the screen: width, and red, green and blue of each pixel.
    fn picture(&self) -> (usize, Vec<[u8; 3]>) {
        let dump =
            Command::new("xwd").args(["-root", "-silent"]).env("DISPLAY", &self.name).output().unwrap();
        assert!(dump.status.success());
        // The header of an X window dump: 32-bit numbers, the highest byte first.
        let field = |i: usize| u32::from_be_bytes(dump.stdout[4 * i..4 * i + 4].try_into().unwrap()) as usize;
        let (width, height, bits, row) = (field(4), field(5), field(11), field(12));
        assert_eq!(bits, 32);
        let pixels = &dump.stdout[field(0) + 12 * field(19)..];
        let rows = pixels.chunks_exact(row).take(height);
        (width, rows.flat_map(|row| row.chunks_exact(4).take(width).map(|p| [p[2], p[1], p[0]])).collect())
    }
}

/// Whether a colour is that of ground: greener or redder than blue.
fn is_ground([r, g, b]: [u8; 3]) -> bool {
    g > b.saturating_add(8) || r > b.saturating_add(8)
}

/// The share of the pixels left of the panel that show ground.
fn ground(&(width, ref pixels): &(usize, Vec<[u8; 3]>)) -> f64 {
    let left = || pixels.iter().enumerate().filter(|(i, _)| i % width < width * 6 / 10);
    left().filter(|(_, p)| is_ground(**p)).count() as f64 / left().count() as f64
}

/// A place left of the panel with ground all around.
fn solid(&(width, ref pixels): &(usize, Vec<[u8; 3]>)) -> [usize; 2] {
    let shows = |x: usize, y: usize| is_ground(pixels[y * width + x]);
    let near = |[x, y]: &[usize; 2]| {
        (x - 60..=x + 60).step_by(20).all(|x| (y - 60..=y + 60).step_by(20).all(|y| shows(x, y)))
    };
    let all = (80..=600).rev().step_by(10).flat_map(|y| (80..=520).step_by(10).map(move |x| [x, y]));
    all.filter(|[_, y]| y + 60 < pixels.len() / width).find(near).expect("ground somewhere")
}

/// The share of pixels in which two pictures differ.
fn changed(a: &(usize, Vec<[u8; 3]>), b: &(usize, Vec<[u8; 3]>)) -> f64 {
    a.1.iter().zip(&b.1).filter(|(p, q)| p != q).count() as f64 / a.1.len() as f64
}

/// Looks until something is so.
fn until(
    screen: &Screen,
    what: &str,
    is_so: impl Fn(&(usize, Vec<[u8; 3]>)) -> bool,
) -> (usize, Vec<[u8; 3]>) {
    let started = Instant::now();
    loop {
        let picture = screen.picture();
        if is_so(&picture) {
            return picture;
        }
        assert!(started.elapsed() < PATIENCE, "{what}: ground {:.3}", ground(&picture));
        sleep(Duration::from_millis(200));
    }
}

/// What is on the screen once it shows ground and nothing more is on its way.
fn steady(screen: &Screen, what: &str) -> (usize, Vec<[u8; 3]>) {
    let mut before = until(screen, what, |picture| ground(picture) > 0.2);
    let started = Instant::now();
    loop {
        sleep(Duration::from_millis(500));
        let now = screen.picture();
        if (ground(&now) - ground(&before)).abs() < 1e-4 {
            return now;
        }
        assert!(started.elapsed() < PATIENCE, "{what}: it does not come to rest");
        before = now;
    }
}

/// Where the panel begins.
const PANEL_LEFT: usize = 741;

/// The share of the pixels within a rectangle of the screen in which two pictures differ.
fn changed_within(
    (width, a): &(usize, Vec<[u8; 3]>),
    (_, b): &(usize, Vec<[u8; 3]>),
    [left, top]: [usize; 2],
    [right, bottom]: [usize; 2],
) -> f64 {
    let inside = || (top..bottom).flat_map(|y| (left..right).map(move |x| y * width + x));
    inside().filter(|i| a[*i] != b[*i]).count() as f64 / inside().count() as f64
}

fn view(screen: &Screen, folder: &Path, url: &str) -> Running {
    let mut command = Command::new(&programs().client);
    command.args(["view", url, "--size", "1000x700", "--error-pixels", "4", "--no-antialias"]);
    command
        .env("DISPLAY", &screen.name)
        .env("XDG_CACHE_HOME", folder.join("cache"))
        .env_remove("WAYLAND_DISPLAY")
        .current_dir(folder);
    Running(command.stdout(Stdio::null()).stderr(Stdio::inherit()).spawn().unwrap())
}

#[test]
fn a_window_shows_the_terrain_and_obeys() {
    let world = World::sample(257, 0.0);
    let served = serve(&[world.folder.path().join("store")]);
    let (screen, folder) = (Screen::start(), tempfile::tempdir().unwrap());
    let mut viewer = view(&screen, folder.path(), &served.address);
    let first = steady(&screen, "terrain appears");
    // A drag moves the ground: to the right, and up.
    let [x, y] = solid(&first);
    let at = |x: usize, y: usize| [x.to_string(), y.to_string()];
    let go = |x: usize, y: usize, then: &[&str]| {
        let [x, y] = at(x, y);
        screen.act(&[&["mousemove", &x, &y], then].concat());
        sleep(Duration::from_millis(150));
    };
    go(x, y, &["mousedown", "1"]);
    (1..=4).for_each(|i| go(x + 12 * i, y - 8 * i, &[]));
    screen.act(&["mouseup", "1"]);
    let dragged = until(&screen, "the drag moves", |picture| changed(picture, &first) > 0.05);
    // The wheel goes nearer: more ground.
    (0..8).for_each(|_| go(x + 48, y - 32, &["click", "4"]));
    until(&screen, "the wheel goes nearer", |picture| ground(picture) > ground(&dragged) + 0.05);
    // Keys reach the window that has the focus; without a window manager somebody has to give it.
    screen.act(&["search", "--name", "Diamantina", "windowfocus", "--sync"]);
    screen.act(&["key", "p"]);
    let (saved, started) =
        (folder.path().join(format!("{}-001.png", world.report.scene.name)), Instant::now());
    while !saved.exists() {
        assert!(started.elapsed() < PATIENCE, "no picture was saved");
        sleep(Duration::from_millis(100));
    }
    let bytes = std::fs::read(&saved).unwrap();
    let info = png::Decoder::new(std::io::Cursor::new(bytes)).read_info().unwrap();
    assert_eq!([info.info().width, info.info().height], [1000, 700]);
    // Home is where it began.
    screen.act(&["key", "h"]);
    until(&screen, "home again", |picture| (ground(picture) - ground(&first)).abs() < 0.01);
    assert!(viewer.0.try_wait().unwrap().is_none(), "it runs");
    screen.act(&["key", "ctrl+q"]);
    let started = Instant::now();
    while started.elapsed() < PATIENCE {
        if let Some(status) = viewer.0.try_wait().unwrap() {
            assert!(status.success(), "{status}");
            return;
        }
        sleep(Duration::from_millis(50));
    }
    panic!("it does not close");
}

#[test]
fn a_click_on_the_ground_marks_the_place_and_the_panel_tells_of_it() {
    let world = World::sample(257, 0.0);
    let served = serve(&[world.folder.path().join("store")]);
    let (screen, folder) = (Screen::start(), tempfile::tempdir().unwrap());
    let mut viewer = view(&screen, folder.path(), &served.address);
    let first = steady(&screen, "terrain appears");
    // A click on the ground marks the place, and the panel tells its height; nothing else changes.
    let [x, y] = solid(&first);
    let ([left, top], [right, bottom]) = ([x - 12, y - 12], [x + 12, y + 12]);
    screen.act(&["mousemove", &x.to_string(), &y.to_string()]);
    sleep(Duration::from_millis(150));
    screen.act(&["click", "1"]);
    sleep(Duration::from_millis(150));
    let marked = until(&screen, "the click marks", |picture| {
        let mark = changed_within(picture, &first, [left, top], [right, bottom]);
        mark > 0.02 && changed_within(picture, &first, [PANEL_LEFT, 560], [980, 690]) > 0.005
    });
    assert!(changed_within(&marked, &first, [0, 0], [600, 700]) < 0.01, "the view stays");
    assert!(viewer.0.try_wait().unwrap().is_none(), "it runs");
}
