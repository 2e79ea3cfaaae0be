//! Wrong uses, broken files and sudden ends, through the real programs: each fails with its exit code, prints
//! nothing where results belong, says what is wrong and what to do, and leaves the old scene as it was.

use crate::determinism::files;
use crate::world::{Dice, World, programs, write_raw};
use diamantina_server::sample;
use diamantina_server::store::FORMAT;
use diamantina_server::store::Store;
use std::ffi::OsString;
use std::io::Read;
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

/// Longer than any of these may take on the slowest machine.
pub(crate) const PATIENCE: Duration = Duration::from_secs(180);

/// How a program ended.
#[derive(Debug)]
pub(crate) struct Ended {
    /// `None`: by a signal.
    pub(crate) code: Option<i32>,
    pub(crate) out: String,
    pub(crate) err: String,
}

/// Waits for a program, which must end by itself.
pub(crate) fn end(mut child: Child) -> Ended {
    let drain = |stream: Option<Box<dyn Read + Send>>| {
        std::thread::spawn(move || {
            let mut bytes = Vec::new();
            if let Some(mut stream) = stream {
                let _ = stream.read_to_end(&mut bytes);
            }
            String::from_utf8_lossy(&bytes).into_owned()
        })
    };
    let out = drain(child.stdout.take().map(|s| Box::new(s) as Box<dyn Read + Send>));
    let err = drain(child.stderr.take().map(|s| Box::new(s) as Box<dyn Read + Send>));
    let started = Instant::now();
    let status = loop {
        if let Some(status) = child.try_wait().unwrap() {
            break Some(status);
        }
        if started.elapsed() > PATIENCE {
            child.kill().unwrap();
            child.wait().unwrap();
            break None;
        }
        std::thread::sleep(Duration::from_millis(5));
    };
    let (out, err) = (out.join().unwrap(), err.join().unwrap());
    let status = status.unwrap_or_else(|| panic!("it does not end; it said: {out}\n{err}"));
    Ended { code: status.code(), out, err }
}

pub(crate) fn start(program: &Path, args: &[OsString]) -> Child {
    Command::new(program)
        .args(args)
        .env_remove("RUST_LOG")
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap()
}

/// Arguments: words, with `{}` standing for the folder.
pub(crate) fn words(folder: &Path, text: &str) -> Vec<OsString> {
    text.split_whitespace().map(|w| w.replace("{}", folder.to_str().unwrap()).into()).collect()
}

pub(crate) fn server(folder: &Path, text: &str) -> Ended {
    end(start(&programs().server, &words(folder, text)))
}

pub(crate) fn client(folder: &Path, text: &str) -> Ended {
    end(start(&programs().client, &words(folder, text)))
}

/// It failed as it should: code, empty standard output, and these words.
pub(crate) fn assert_failed(ended: &Ended, code: i32, wanted: &[&str], what: &str) {
    assert_eq!(ended.code, Some(code), "{what}: {ended:?}");
    assert_eq!(ended.out, "", "{what} prints to standard output");
    assert!(!ended.err.contains("panicked"), "{what}: {}", ended.err);
    for word in wanted {
        assert!(ended.err.contains(word), "{what}: no '{word}' in: {}", ended.err);
    }
}

/// A DEM of whole metres on a grid without a place.
fn asc(path: &Path, cell: f64, value: &str) {
    let row = [value; 80].join(" ");
    let rows = [row.as_str(); 80].join("\n");
    let text = format!(
        "ncols 80\nnrows 80\nxllcorner 0\nyllcorner 0\ncellsize {cell}\nNODATA_value -9999\n{rows}\n"
    );
    std::fs::write(path, text).unwrap();
}

/// Sets a field of a little-endian TIFF's first directory to a 32-bit number.
fn set_tag(bytes: &mut [u8], tag: u16, value: u32) {
    let offset = u32::from_le_bytes(bytes[4..8].try_into().unwrap()) as usize;
    let count = u16::from_le_bytes(bytes[offset..offset + 2].try_into().unwrap()) as usize;
    for entry in bytes[offset + 2..offset + 2 + 12 * count].chunks_exact_mut(12) {
        if entry[..2] == tag.to_le_bytes() {
            entry[2..4].copy_from_slice(&4u16.to_le_bytes());
            entry[4..8].copy_from_slice(&1u32.to_le_bytes());
            entry[8..12].copy_from_slice(&value.to_le_bytes());
            return;
        }
    }
    panic!("no tag {tag}");
}

#[test]
fn a_wrong_build_says_what_is_wrong_and_what_to_do() {
    let scratch = tempfile::tempdir().unwrap();
    let folder = scratch.path();
    let file = |name: &str| folder.join(name);
    sample::write(&file("good.tif"), 257).unwrap();
    let good = std::fs::read(file("good.tif")).unwrap();
    std::fs::write(file("half.tif"), &good[..good.len() / 2]).unwrap();
    std::fs::write(file("head.tif"), &good[..7]).unwrap();
    for (name, tag, value) in
        [("wide.tif", 256, 0xFFFF_FFF0), ("tall.tif", 257, 0x7FFF_FFFF), ("none.tif", 256, 0)]
    {
        let mut bytes = good.clone();
        set_tag(&mut bytes, tag, value);
        std::fs::write(file(name), bytes).unwrap();
    }
    std::fs::write(file("empty.tif"), b"").unwrap();
    std::fs::write(file("notes.txt"), b"Dear diary, today we measured nothing.").unwrap();
    std::fs::write(file("short.raw"), [0; 100]).unwrap();
    std::fs::create_dir(file("folder")).unwrap();
    asc(&file("ten.asc"), 10.0, "5");
    asc(&file("twelve.asc"), 12.0, "5");
    asc(&file("degrees.asc"), 0.001, "5");
    let text = std::fs::read_to_string(file("degrees.asc")).unwrap();
    std::fs::write(
        file("degrees.asc"),
        text.replace("xllcorner 0", "xllcorner 204.9").replace("yllcorner 0", "yllcorner 19.6"),
    )
    .unwrap();
    // A void of another value than the one that the file declares.
    let heights: Vec<String> =
        (0..6400).map(|i| if i == 777 { -9999 } else { 100 + i % 53 }.to_string()).collect();
    let head = "ncols 80\nnrows 80\nxllcorner 0\nyllcorner 0\ncellsize 10\nNODATA_value -1\n";
    std::fs::write(file("void.asc"), format!("{head}{}\n", heights.join(" "))).unwrap();
    let mut png = png::Encoder::new(std::fs::File::create(file("picture.png")).unwrap(), 80, 80);
    png.set_color(png::ColorType::Grayscale);
    png.set_depth(png::BitDepth::Eight);
    png.write_header().unwrap().write_image_data(&[7; 6400]).unwrap();

    for (args, code, wanted) in [
        // Broken files: the DEM is at fault.
        ("{}/half.tif", 1, ["half.tif", "expected", "fetch"].as_slice()),
        ("{}/head.tif", 1, &["head.tif", "expected", "fetch"]),
        ("{}/wide.tif", 1, &["wide.tif", "a width from 1 to", "fetch"]),
        ("{}/tall.tif", 1, &["tall.tif", "a height from 1 to", "fetch"]),
        ("{}/none.tif", 1, &["none.tif", "a width from 1 to", "fetch"]),
        ("{}/empty.tif", 1, &["empty.tif", "an empty file", "fetch it again"]),
        ("{}/notes.txt", 1, &["notes.txt", "diary", "--raw"]),
        ("{}/folder", 1, &["folder", "a directory", "name the files in it"]),
        ("/dev/null", 1, &["/dev/null", "a pipe or device", "into a file first"]),
        ("{}/nowhere.tif", 1, &["nowhere.tif", "check the path"]),
        (
            "{}/short.raw --raw 100x100:f32 --cell 1",
            1,
            &["short.raw", "40000 bytes", "found 100 bytes", "correct the shape"],
        ),
        // Files that do not fit the options.
        ("{}/ten.asc --nodata 5", 1, &["ten.asc", "all 6400 samples are nodata", "--nodata"]),
        ("{}/void.asc", 2, &["void.asc", "100 to 152", "say --nodata -9999", "--nodata nan"]),
        ("{}/void.asc --nodata 7", 2, &["void.asc", "say --nodata -9999"]),
        ("{}/degrees.asc", 2, &["degrees.asc", "look like degrees", "--assume-crs EPSG:4326", "--cell"]),
        ("{}/degrees.asc --crs source", 2, &["degrees.asc", "look like degrees", "--assume-crs EPSG:4326"]),
        ("{}/ten.asc --crs EPSG:32633", 2, &["ten.asc", "a source with a CRS", "leave --crs out"]),
        ("{}/good.tif --crs EPSG:64999", 2, &["good.tif", "EPSG:64999", "choose another code"]),
        ("{}/good.tif --crs EPSG:4326", 2, &["good.tif", "projected CRS"]),
        ("{}/picture.png", 2, &["picture.png", "--cell"]),
        ("{}/ten.asc {}/twelve.asc", 1, &["ten.asc", "twelve.asc", "cells of 12", "reproject or crop"]),
        ("{}/ten.asc {}/nowhere.asc", 1, &["nowhere.asc", "check the path"]),
        ("{}/good.tif --memory 1MiB", 2, &["--memory 1MiB", "too little", "say --memory ", "MiB or more"]),
        ("{}/good.tif --max-error=-1", 2, &["--max-error -1", "expected 0"]),
        ("{}/good.tif --max-error nan", 2, &["--max-error NaN", "expected 0"]),
        ("{}/good.tif --max-error 1e30", 2, &["--max-error", "expected 0"]),
        ("{}/good.tif --quantum 0", 2, &["--quantum 0", "above 0"]),
        ("{}/good.tif --quantum 1e300", 2, &["--quantum 1", "above 0 and below"]),
        ("{}/good.tif --threads 0", 2, &["--threads", "1..=1024"]),
        ("{}/good.tif --threads 100000", 2, &["--threads", "1..=1024"]),
        (
            "{}/good.tif --height-scale 1e300",
            2,
            &["good.tif", "a height scale from 1e-9", "correct the option"],
        ),
        (
            "{}/good.tif --height-offset 1e300",
            2,
            &["good.tif", "a height offset below", "correct the option"],
        ),
        ("{}/picture.png --cell 1e300", 2, &["picture.png", "cells from 1e-6", "correct the option"]),
        ("{}/picture.png --cell 1e-300", 2, &["picture.png", "cells from 1e-6", "correct the option"]),
        ("{}/good.tif --quantum nan", 2, &["--quantum NaN", "above 0"]),
        ("{}/good.tif --quantum 1e-9", 1, &["good.tif", "larger --quantum"]),
        // Wrong use: the command line itself makes no sense.
        ("{}/good.tif --crs mars", 2, &["mars", "EPSG:N"]),
        ("{}/good.tif --max-error -1", 2, &["--max-error -1", "expected 0"]),
        ("{}/good.tif --max-error much", 2, &["much", "--max-error"]),
        ("{}/good.tif --memory lots", 2, &["lots", "2GiB"]),
        ("{}/good.tif --memory 5parsecs", 2, &["parsecs", "GiB"]),
        ("{}/good.tif --patch-segments 33", 2, &["33", "64"]),
        ("{}/good.tif --raw 5:f99", 2, &["5:f99", "WIDTHxHEIGHT:TYPE"]),
        ("{}/good.tif --scene ../up", 2, &["--scene", "../up", "letters"]),
        ("{}/good.tif --no-such-option", 2, &["--no-such-option", "--help"]),
        ("", 2, &["<DEM>", "--help"]),
    ] {
        let ended = server(folder, &format!("build -o {{}}/store {args}"));
        assert_failed(&ended, code, wanted, args);
        // Whatever failed, no half of a store is left.
        let left = if file("store").exists() { files(&file("store")) } else { Default::default() };
        assert!(left.keys().all(|path| path == Path::new(".lock")), "{args} leaves {:?}", left.keys());
    }
    assert_failed(&server(folder, "build {}/good.tif"), 2, &["--output", "--help"], "no output");
    assert_failed(&server(folder, "fly {}/good.tif"), 2, &["fly", "--help"], "unknown command");
    // An output that cannot be: below a file.
    let ended = server(folder, "build {}/good.tif -o {}/notes.txt/store");
    assert_failed(
        &ended,
        1,
        &["notes.txt/store", "cannot create the folder", "choose another folder with -o"],
        "output below a file",
    );
}

/// `| head` made of a build that had succeeded one that had failed.
#[test]
fn a_reader_that_has_seen_enough_is_no_failure() {
    let world = World::sample(257, 0.0);
    let place = world.folder.path().display();
    let url = world.served.scene("world");
    let (server, client) = (programs().server.display(), programs().client.display());
    for command in [
        format!("{server} inspect {place}/store"),
        format!("{server} inspect --json {place}/store"),
        format!("{server} build {place}/dem.tif -o {place}/again"),
        format!("{client} render {url} -o {place}/a.png --size 64x64"),
        format!("{client} render {url} -o {place}/a.png --size 64x64 --json -"),
    ] {
        // The reader is gone before there is anything to read.
        let script = format!("{command} | exec 0<&-; exit ${{PIPESTATUS[0]}}");
        let mut bash = Command::new("bash");
        bash.args(["-c", &script]).env("NODEVICE_SELECT", "1").stdin(Stdio::null());
        let ended = end(bash.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap());
        assert_eq!((ended.code, ended.err.as_str()), (Some(0), ""), "{command}");
    }
}

/// One sample of 1e30 made all others of a float source the same height, without a word.
#[test]
fn nodata_that_nobody_declared_is_refused_with_the_remedy() {
    let scratch = tempfile::tempdir().unwrap();
    let folder = scratch.path();
    for (name, wrong) in [("1e30", 1e30), ("3.4028235e38", f32::MAX), ("-3.4028235e38", f32::MIN)] {
        for share in [1, 3000] {
            let hills = |x: u32, y: u32| (f64::from(x) / 9.0).sin() * 70.0 + f64::from(y) / 7.0;
            write_raw(&folder.join("dem.raw"), [200, 100], |x, y| {
                Some(if y * 200 + x < share { wrong } else { hills(x, y) as f32 })
            });
            let build = "build {}/dem.raw --raw 200x100:f32 --cell 10 -o {}/store";
            let ended = server(folder, build);
            assert_failed(&ended, 1, &["dem.raw", "if it stands for nodata, say --nodata"], name);
            let ended = server(folder, &format!("{build} --nodata={name}"));
            assert_eq!(ended.code, Some(0), "{name}: {ended:?}");
            assert!(ended.out.contains(" to 84.1"), "{ended:?}");
        }
    }
}

/// A build into a folder with other things in it left a store among them, hard to take out again.
#[test]
fn a_folder_with_foreign_files_is_no_place_for_a_store() {
    let scratch = tempfile::tempdir().unwrap();
    let folder = scratch.path();
    sample::write(&folder.join("dem.tif"), 257).unwrap();
    let build = "build {}/dem.tif -o {}/place --scene place";
    let place = folder.join("place");
    for name in ["holiday.jpg", "scene.json", "0123456789abcdef", ".hidden"] {
        std::fs::create_dir(&place).unwrap();
        std::fs::write(place.join(name), "{\"format\": \"three\"}").unwrap();
        let wanted = ["place", "an empty folder or a store", name, "choose another folder with -o"];
        assert_failed(&server(folder, build), 2, &wanted, name);
        assert_eq!(files(&place).len(), 1, "{name}: something was written beside it");
        std::fs::remove_dir_all(&place).unwrap();
    }
    // Nothing yet; an empty folder; the root of a file system; what a killed build leaves; a store; a store
    // with a note in it; a store whose description is damaged: these are right.
    let builds = |what: &str| {
        let ended = server(folder, build);
        assert_eq!(ended.code, Some(0), "{what}: {ended:?}");
    };
    builds("nothing yet");
    std::fs::remove_dir_all(&place).unwrap();
    std::fs::create_dir_all(place.join("lost+found")).unwrap();
    builds("the root of a file system");
    std::fs::remove_dir_all(&place).unwrap();
    std::fs::create_dir_all(place.join(".building")).unwrap();
    std::fs::create_dir_all(place.join("0123456789abcdef")).unwrap();
    std::fs::write(place.join(".lock"), "").unwrap();
    builds("a killed build");
    std::fs::write(place.join("note.txt"), "ours").unwrap();
    builds("a store with a note");
    std::fs::remove_file(place.join("note.txt")).unwrap();
    std::fs::write(place.join("scene.json"), "damaged").unwrap();
    builds("a damaged description");
    assert_eq!(server(folder, "inspect --verify {}/place").code, Some(0));
}

/// Names were cut at 64 characters, so that two folders could become one scene.
#[test]
fn a_folder_whose_name_is_too_long_for_a_scene_is_refused_with_the_remedy() {
    let scratch = tempfile::tempdir().unwrap();
    let folder = scratch.path();
    sample::write(&folder.join("dem.tif"), 257).unwrap();
    let long = "a".repeat(65);
    let ended = server(folder, &format!("build {{}}/dem.tif -o {{}}/{long}"));
    assert_failed(&ended, 2, &[&long, "at most 64 characters", "found 65", "--scene NAME"], "a long name");
    assert!(!folder.join(&long).exists());
    let ended = server(folder, &format!("build {{}}/dem.tif -o {{}}/{long} --scene short"));
    assert_eq!(ended.code, Some(0), "{ended:?}");
    let ended = server(folder, &format!("build {{}}/dem.tif -o {{}}/{}", &long[1..]));
    assert_eq!(ended.code, Some(0), "{ended:?}");
}

#[test]
fn what_is_no_store_is_refused() {
    let world = World::sample(257, 0.0);
    let folder = world.folder.path();
    std::fs::create_dir(folder.join("bare")).unwrap();
    let scene = std::fs::read_to_string(folder.join("store/scene.json")).unwrap();
    std::fs::create_dir(folder.join("newer")).unwrap();
    let format = |number: u32| format!("\"format\": {number}");
    let newer = scene.replacen(&format(FORMAT), &format(FORMAT + 1), 1);
    std::fs::write(folder.join("newer/scene.json"), newer).unwrap();
    std::fs::create_dir(folder.join("text")).unwrap();
    std::fs::write(folder.join("text/scene.json"), "not JSON").unwrap();
    std::fs::create_dir(folder.join("alone")).unwrap();
    std::fs::write(folder.join("alone/scene.json"), &scene).unwrap();
    let taken = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let port = taken.local_addr().unwrap().port();
    let newer_format = format!("format {}", FORMAT + 1);
    for command in ["inspect", "inspect --verify", "inspect --json", "serve --listen 127.0.0.1:0"] {
        for (store, wanted) in [
            ("bare", ["bare", "not a store", "diamantina-server build"]),
            ("nowhere", ["nowhere", "not a store", "diamantina-server build"]),
            ("dem.tif", ["dem.tif", "not a store", "diamantina-server build"]),
            ("newer", ["newer", newer_format.as_str(), "build it again"]),
            ("text", ["text", "not JSON", "repair"]),
            ("alone", ["alone", "directory", "cannot read"]),
        ] {
            let ended = server(folder, &format!("{command} {{}}/{store}"));
            assert_failed(&ended, 1, &wanted, &format!("{command} {store}"));
        }
    }
    let ended = server(folder, &format!("serve {{}}/store --listen 127.0.0.1:{port}"));
    assert_failed(&ended, 1, &["another program has that port", "--listen"], "port in use");
    let ended = server(folder, "serve {}/store {}/store --listen 127.0.0.1:0");
    assert_failed(&ended, 1, &["both hold a scene named 'world'", "--scene"], "one name twice");
    assert_failed(&server(folder, "serve {}/store --listen here"), 2, &["--listen"], "no address");
    assert_failed(&server(folder, "serve"), 2, &["no store to serve", "--config"], "no store");
    let ended = server(folder, &format!("health 127.0.0.1:{}", free_port()));
    assert_failed(&ended, 1, &["is the server running"], "no health");
}

/// A port that nobody listens on.
fn free_port() -> u16 {
    std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port()
}

#[test]
fn a_wrong_render_says_what_is_wrong_and_what_to_do() {
    let world = World::sample(257, 0.0);
    let folder = world.folder.path();
    std::fs::write(folder.join("file.txt"), "").unwrap();
    std::fs::write(folder.join("path.json"), "{\"keys\": []}").unwrap();
    let url = world.served.scene("world");
    let dead = format!("http://127.0.0.1:{}/scenes/world", free_port());
    let other = world.served.scene("mars");
    for (args, code, wanted) in [
        (format!("{dead} -o {{}}/a.png"), 1, ["is the server running"].as_slice()),
        (format!("{other} -o {{}}/a.png"), 1, &["/scenes/mars", "404", "GET /scenes lists"]),
        (format!("{url} -o {{}}/file.txt/a.png --size 64x64"), 1, &["file.txt/a.png", "cannot write"]),
        (
            format!("{url} -o {{}}/a.png --size 64x64 --json {{}}/file.txt/a.json"),
            1,
            &["a.json", "cannot write"],
        ),
        (format!("{url} -o {{}}/a.png --size 99999x99999"), 1, &["99999"]),
        ("ftp://127.0.0.1/scenes/world -o {}/a.png".to_owned(), 2, &["ftp", "http"]),
        ("nonsense -o {}/a.png".to_owned(), 2, &["nonsense", "http://HOST:PORT/scenes/NAME"]),
        (format!("{url} -o {{}}/a.png --size 0x100"), 2, &["0x100", "WIDTHxHEIGHT"]),
        (format!("{url} -o {{}}/a.png --size big"), 2, &["big", "WIDTHxHEIGHT"]),
        (format!("{url} -o {{}}/a.png --eye 1,2 --target 0,0,0"), 2, &["1,2", "3 numbers"]),
        (format!("{url} -o {{}}/a.png --eye 1,2,x --target 0,0,0"), 2, &["'x' is not a number"]),
        (format!("{url} -o {{}}/a.png --eye nan,2,3 --target 0,0,0"), 2, &["finite"]),
        (format!("{url} -o {{}}/a.png --eye 1,2,3"), 2, &["--target"]),
        (format!("{url} -o {{}}/a.png --eye 1,2,3 --target 1,2,3"), 2, &["same point"]),
        (format!("{url} -o {{}}/a.png --error-pixels 0"), 2, &["--error-pixels 0", "above 0"]),
        (format!("{url} -o {{}}/a.png --error-pixels -1"), 2, &["--error-pixels -1", "above 0"]),
        (format!("{url} -o {{}}/a.png --error-pixels nan"), 2, &["--error-pixels NaN", "above 0"]),
        (format!("{url} -o {{}}/a.png --encoding smoke"), 2, &["smoke", "points"]),
        (format!("{url} -o {{}}/a.png --background mauve"), 2, &["mauve", "ff00ff"]),
        (url.clone(), 2, &["--output"]),
    ] {
        assert_failed(&client(folder, &format!("render {args}")), code, wanted, &args);
    }
    let ended = client(folder, &format!("fly {url} --frames 2 --path {{}}/path.json"));
    assert_failed(&ended, 1, &["path.json", "0 keys"], "an empty path");
    let ended = client(folder, &format!("fly {url} --frames 0"));
    assert_failed(&ended, 2, &["--frames"], "no frames");
}

/// Flips a bit of a file while `judge` looks, then flips it back.
fn with_flip(path: &Path, byte: usize, bit: u32, judge: impl FnOnce()) {
    // In place: a file that is cut off and written anew goes to the disk each time.
    let file = std::fs::OpenOptions::new().read(true).write(true).open(path).unwrap();
    let mut good = [0];
    file.read_exact_at(&mut good, byte as u64).unwrap();
    file.write_all_at(&[good[0] ^ 1 << bit], byte as u64).unwrap();
    judge();
    file.write_all_at(&good, byte as u64).unwrap();
}

#[test]
fn a_flipped_bit_anywhere_is_found_and_its_file_named() {
    let world = World::sample(257, 0.0);
    let folder = world.folder.path();
    let store = folder.join("store");
    let data = store.join(&world.report.scene.version);
    let mut dice = Dice(12);
    let mut packs = 0;
    let mut list: Vec<PathBuf> = std::fs::read_dir(&data).unwrap().map(|e| e.unwrap().path()).collect();
    list.push(store.join("scene.json"));
    list.sort();
    for path in &list {
        let name = path.file_name().unwrap().to_str().unwrap();
        let length = std::fs::metadata(path).unwrap().len();
        packs += usize::from(name.starts_with("pack-"));
        // The ends, and places between.
        let mut places = vec![0, length - 1];
        places.extend((0..4).map(|_| dice.below(length)));
        for byte in places {
            let bit = dice.below(8) as u32;
            with_flip(path, byte as usize, bit, || {
                let what = format!("bit {bit} of byte {byte} of {name}");
                let named = if name == "scene.json" { "store" } else { name };
                assert_failed(&server(folder, "inspect --verify {}/store"), 1, &[named, "again"], &what);
                if !name.starts_with("pack-") {
                    assert_failed(&server(folder, "inspect {}/store"), 1, &[named, "again"], &what);
                    let ended = server(folder, "serve {}/store --listen 127.0.0.1:0");
                    assert_failed(&ended, 1, &[named, "again"], &what);
                }
            });
        }
    }
    assert!(packs >= 1 && list.len() >= 3);
    let ended = server(folder, "inspect --verify {}/store");
    assert!(ended.code == Some(0) && ended.out.contains("verified"), "{ended:?}");
}

#[test]
fn all_blobs_that_are_damaged_are_named() {
    let world = World::sample(257, 0.0);
    let folder = world.folder.path();
    let version = &world.report.scene.version;
    let path = folder.join("store").join(version).join("pack-00000");
    let length = std::fs::metadata(&path).unwrap().len();
    // The first and the last byte, and one between, are of three blobs.
    with_flip(&path, 0, 3, || {
        with_flip(&path, length as usize / 2, 1, || {
            with_flip(&path, length as usize - 1, 7, || {
                let ended = server(folder, "inspect --verify {}/store");
                assert_failed(&ended, 1, &["pack-00000", "2 more of its blobs", "at byte 0 "], "three flips");
                assert_eq!(ended.err.matches("has checksum").count(), 3, "{}", ended.err);
            });
        });
    });
}

#[test]
fn no_bit_of_the_description_can_flip_unseen() {
    let world = World::sample(257, 0.0);
    let store = world.folder.path().join("store");
    let path = store.join("scene.json");
    let good = std::fs::read(&path).unwrap();
    let mut unseen = Vec::new();
    let mut dice = Dice(41);
    for byte in 0..good.len() {
        // Bit 5 tells small letters from large ones, which some parsers take for the same.
        for bit in [5, dice.below(8) as u32] {
            with_flip(&path, byte, bit, || {
                if Store::open(&store).is_ok() {
                    let around = &good[byte.saturating_sub(20)..(byte + 20).min(good.len())];
                    unseen.push(format!("bit {bit} of byte {byte}: {}", String::from_utf8_lossy(around)));
                }
            });
        }
    }
    assert!(Store::open(&store).is_ok());
    assert!(unseen.is_empty(), "{} flips pass unseen: {unseen:#?}", unseen.len());
}

/// A store with a small scene, and a larger DEM to build into it. The old scene's files.
fn old_scene(folder: &Path) -> std::collections::BTreeMap<PathBuf, Vec<u8>> {
    sample::write(&folder.join("old.tif"), 257).unwrap();
    sample::write(&folder.join("new.tif"), 1100).unwrap();
    let ended = server(folder, "build {}/old.tif -o {}/disk/store --scene keep");
    assert_eq!(ended.code, Some(0), "{ended:?}");
    scene_files(folder)
}

/// The files of the store that a reader uses.
pub(crate) fn scene_files(folder: &Path) -> std::collections::BTreeMap<PathBuf, Vec<u8>> {
    let mut all = files(&folder.join("disk/store"));
    all.retain(|path, _| !path.starts_with(".building") && path != Path::new(".lock"));
    all
}

/// The store verifies.
fn assert_intact(folder: &Path, what: &str) {
    let ended = server(folder, "inspect --verify {}/disk/store");
    assert!(ended.code == Some(0) && ended.out.contains("verified"), "{what}: {ended:?}");
}

#[test]
fn a_disk_that_fills_up_leaves_the_old_scene_untouched() {
    let scratch = tempfile::tempdir().unwrap();
    let folder = scratch.path();
    std::fs::create_dir(folder.join("disk")).unwrap();
    let disk = folder.join("disk");
    // A real small disk where one may be mounted.
    let mounted = Command::new("mount")
        .args(["-t", "tmpfs", "-o", "size=4m", "tmpfs"])
        .arg(&disk)
        .stderr(Stdio::null())
        .status()
        .is_ok_and(|s| s.success());
    let result = std::panic::catch_unwind(|| {
        let old = old_scene(folder);
        if mounted {
            let ended = server(folder, "build {}/new.tif -o {}/disk/store --scene keep");
            assert_failed(&ended, 1, &["disk/store", "free some space", "build again"], "a full disk");
            assert_eq!(scene_files(folder), old, "the old scene was touched");
            assert_intact(folder, "after a full disk");
        }
        // And a limit on the size of files: here each step of the build runs into it somewhere.
        for blocks in [0, 8, 64, 512, 2048, 4096] {
            let program = programs().server.display();
            let place = folder.display();
            let script = format!(
                "trap '' XFSZ; ulimit -f {blocks}; exec '{program}' build '{place}/new.tif' -o '{place}/disk/store' --scene keep"
            );
            let ended = end(start(Path::new("sh"), &["-c".into(), script.into()]));
            assert_failed(&ended, 1, &["disk/store", "cannot write"], &format!("{blocks} blocks"));
            assert_eq!(scene_files(folder), old, "the old scene was touched");
            assert_intact(folder, "after a full file");
        }
    });
    if mounted {
        let _ = Command::new("umount").arg(&disk).status();
    }
    if let Err(panic) = result {
        std::panic::resume_unwind(panic);
    }
}

/// Sends a signal to a child.
pub(crate) fn signal(child: &Child, name: &str) {
    let status = Command::new("kill").args([&format!("-{name}"), &child.id().to_string()]).status().unwrap();
    assert!(status.success());
}

#[test]
fn a_second_build_into_a_store_is_told_to_wait() {
    let scratch = tempfile::tempdir().unwrap();
    let folder = scratch.path();
    std::fs::create_dir(folder.join("disk")).unwrap();
    old_scene(folder);
    let first = start(&programs().server, &words(folder, "build {}/new.tif -o {}/disk/store --scene keep"));
    let started = Instant::now();
    while !folder.join("disk/store/.building").exists() {
        assert!(started.elapsed() < PATIENCE, "the first build never starts");
        std::thread::sleep(Duration::from_millis(1));
    }
    // Held still, so that it cannot be done before the second has looked.
    signal(&first, "STOP");
    let second = server(folder, "build {}/old.tif -o {}/disk/store --scene keep");
    signal(&first, "CONT");
    assert_failed(
        &second,
        1,
        &["disk/store", "another program is writing", "choose another folder"],
        "a second build",
    );
    let first = end(first);
    assert_eq!(first.code, Some(0), "{first:?}");
    assert_intact(folder, "after two builds");
}

#[test]
fn a_build_killed_at_any_moment_leaves_a_whole_scene_and_the_next_one_succeeds() {
    let scratch = tempfile::tempdir().unwrap();
    let folder = scratch.path();
    std::fs::create_dir(folder.join("disk")).unwrap();
    let old = old_scene(folder);
    let build = "build {}/new.tif -o {}/disk/store --scene keep";
    // How long a whole build takes here, and what it leaves.
    let started = Instant::now();
    assert_eq!(server(folder, &build.replace("disk/store", "whole")).code, Some(0));
    let whole = started.elapsed();
    let mut new = files(&folder.join("whole"));
    new.retain(|path, _| path != Path::new(".lock"));
    let mut dice = Dice(2003);
    let mut interrupted = 0;
    for moment in 0..10 {
        let child = start(&programs().server, &words(folder, build));
        std::thread::sleep(whole.mul_f64((f64::from(moment) + dice.roll()) / 10.0));
        signal(&child, "KILL");
        let ended = end(child);
        interrupted += usize::from(ended.code.is_none());
        assert_intact(folder, "after a kill");
        // The current scene is one of the two, to the last byte; at the very end the other may still lie there.
        let now = scene_files(folder);
        let is = |scene: &std::collections::BTreeMap<PathBuf, Vec<u8>>| {
            scene.iter().all(|(path, bytes)| now.get(path) == Some(bytes))
        };
        assert!(is(&old) || is(&new), "neither the old scene nor the new one: {:?}", now.keys());
        // Back to the old scene for the next moment: which is a build after a kill, and must succeed.
        let ended = server(folder, "build {}/old.tif -o {}/disk/store --scene keep");
        assert_eq!(ended.code, Some(0), "{ended:?}");
        assert!(old.iter().all(|(path, bytes)| scene_files(folder).get(path) == Some(bytes)));
    }
    assert!(interrupted >= 5, "only {interrupted} of 10 builds were interrupted");
    assert_eq!(server(folder, build).code, Some(0));
    assert_eq!(scene_files(folder), new, "resumed, the bytes are the same as unbroken");
}

#[test]
fn a_gap_in_a_raw_dem_is_no_crash() {
    // A DEM one sample wide, one sample high, and of one sample: thin, but DEMs.
    let scratch = tempfile::tempdir().unwrap();
    let folder = scratch.path();
    for (width, height) in [(1, 1), (1, 300), (300, 1), (2, 2), (5, 2000)] {
        write_raw(&folder.join("thin.raw"), [width, height], |x, y| Some((x + y) as f32));
        let args = format!("build {{}}/thin.raw --raw {width}x{height}:f32 --cell 1 -o {{}}/thin");
        let ended = server(folder, &args);
        assert!(!ended.err.contains("panicked") && matches!(ended.code, Some(0 | 1)), "{args}: {ended:?}");
        if ended.code == Some(0) {
            let ended = server(folder, "inspect --verify {}/thin");
            assert_eq!(ended.code, Some(0), "{args}: {ended:?}");
        }
    }
}
