//! A build that was killed, stopped or ran out of disk is gone on with by the same command, and the store is the
//! same to the last byte as that of an unbroken build.

use crate::determinism::files;
use crate::hostile::{Ended, PATIENCE, assert_failed, end, server, signal, start, words};
use crate::world::{Dice, programs};
use diamantina_server::sample;
use diamantina_server::store::Store;
use std::collections::BTreeMap;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

/// A DEM of 3 x 3 chunks and more, the store of an unbroken build of it, and its files.
struct Unbroken {
    scratch: tempfile::TempDir,
    files: BTreeMap<PathBuf, Vec<u8>>,
    /// How long it took.
    whole: Duration,
}

/// The build, with the interval of its checkpoints to follow.
const EVERY: &str = "build {}/dem.tif -o {}/store --scene same --checkpoint";

/// The build, noting each chunk on the disk as soon as it is done.
const BUILD: &str = "build {}/dem.tif -o {}/store --scene same --checkpoint 0";

impl Unbroken {
    fn new() -> Self {
        let scratch = tempfile::tempdir().unwrap();
        sample::write(&scratch.path().join("dem.tif"), 2500).unwrap();
        let started = Instant::now();
        let ended = server(scratch.path(), "build {}/dem.tif -o {}/unbroken --scene same");
        assert_eq!(ended.code, Some(0), "{ended:?}");
        assert!(!ended.err.contains("resuming") && !ended.err.contains("anew"), "{ended:?}");
        let whole = started.elapsed();
        let files = finished(&scratch.path().join("unbroken"));
        Self { scratch, files, whole }
    }

    fn folder(&self) -> &Path {
        self.scratch.path()
    }

    fn journal(&self) -> PathBuf {
        self.folder().join("store/.building/journal")
    }

    /// Starts the build and waits until its journal has grown by so many bytes.
    fn until_journal(&self, options: &str, bytes: u64) -> Child {
        let length = || std::fs::metadata(self.journal()).map_or(0, |m| m.len());
        let (before, started) = (length(), Instant::now());
        let child = start(&programs().server, &words(self.folder(), &format!("{BUILD} {options}")));
        while length() < before + bytes {
            assert!(started.elapsed() < PATIENCE, "the journal does not grow");
            std::thread::sleep(Duration::from_millis(1));
        }
        child
    }

    /// A build that was killed after some chunks.
    fn broken(&self) -> Ended {
        let child = self.until_journal("--threads 1", 20_000);
        signal(&child, "KILL");
        let ended = end(child);
        assert_eq!(ended.code, None, "killed too late: {ended:?}");
        ended
    }

    /// The store is there, whole, the same as unbroken, and nothing else is.
    fn assert_same(&self, ended: &Ended, what: &str) {
        assert_eq!(ended.code, Some(0), "{what}: {ended:?}");
        let now = finished(&self.folder().join("store"));
        assert_eq!(now.keys().collect::<Vec<_>>(), self.files.keys().collect::<Vec<_>>(), "{what}");
        for (path, bytes) in &self.files {
            assert!(*bytes == now[path], "{what}: {} differs", path.display());
        }
    }
}

/// The files of a store that nobody writes any more.
pub(crate) fn finished(store: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    assert!(!store.join(".building").exists(), "the work folder is still there");
    let mut all = files(store);
    all.retain(|path, _| path != Path::new(".lock"));
    all
}

#[test]
fn killed_again_and_again_until_it_ends_a_build_gives_the_same_bytes() {
    let unbroken = Unbroken::new();
    let folder = unbroken.folder();
    // An older scene is there all the while.
    sample::write(&folder.join("old.tif"), 257).unwrap();
    assert_eq!(server(folder, "build {}/old.tif -o {}/store --scene same").code, Some(0));
    let old = finished(&folder.join("store"));
    let mut dice = Dice(1957);
    let (mut kills, mut resumed) = (0, 0);
    let last = loop {
        // Other numbers of threads in each run.
        let threads = 1 + dice.below(3);
        let build = words(folder, &format!("{BUILD} --threads {threads}"));
        let child = start(&programs().server, &build);
        // Short at first, however slow the unbroken build was; longer from kill to kill, so that the loop ends on any machine.
        let longest = unbroken.whole.mul_f64(0.1 + 0.05 * f64::from(kills));
        std::thread::sleep(longest.mul_f64(dice.roll()));
        let _ = Command::new("kill").args(["-KILL", &child.id().to_string()]).status();
        let ended = end(child);
        resumed += u32::from(ended.err.contains("resuming: "));
        assert!(!ended.err.contains("anew"), "{ended:?}");
        let store = Store::open(&folder.join("store")).unwrap();
        let version = folder.join("store").join(&store.scene().version);
        for (path, bytes) in files(&version) {
            let path = Path::new(&store.scene().version).join(path);
            let known = [&old, &unbroken.files].into_iter().any(|scene| scene.get(&path) == Some(&bytes));
            assert!(known, "{} is neither the old scene's nor the new one's", path.display());
        }
        if ended.code == Some(0) {
            break ended;
        }
        kills += 1;
        assert!(kills < 200, "it never ends: {ended:?}");
    };
    assert!(kills >= 3 && resumed >= 2, "killed {kills} times, resumed {resumed} times");
    unbroken.assert_same(&last, "after many kills");
}

#[test]
fn interrupted_a_build_says_how_to_go_on_and_the_same_command_does() {
    let unbroken = Unbroken::new();
    for name in ["INT", "TERM"] {
        let child = unbroken.until_journal("--threads 1", 20_000);
        let asked = Instant::now();
        signal(&child, name);
        let ended = end(child);
        let took = asked.elapsed();
        assert_failed(&ended, 130, &["interrupted", " chunks are done", "the same command"], name);
        assert!(took < Duration::from_secs(10), "{name}: it took {took:?}");
        let left: Vec<_> = std::fs::read_dir(unbroken.folder().join("store"))
            .unwrap()
            .map(|entry| entry.unwrap().file_name().into_string().unwrap())
            .filter(|entry| entry != ".lock")
            .collect();
        assert_eq!(left, [".building"], "{name} leaves more");
        // With other threads, memory and interval: they change no byte.
        let ended = server(unbroken.folder(), &format!("{EVERY} 60 --threads 2 --memory 1GiB"));
        assert!(ended.err.contains("resuming: "), "{ended:?}");
        unbroken.assert_same(&ended, name);
        std::fs::remove_dir_all(unbroken.folder().join("store")).unwrap();
    }
}

#[test]
fn asked_twice_a_build_ends_at_once_and_is_gone_on_with_as_well() {
    let unbroken = Unbroken::new();
    let child = unbroken.until_journal("--threads 1", 20_000);
    // Held still, both arrive before it can do anything.
    for name in ["STOP", "INT", "TERM", "CONT"] {
        signal(&child, name);
    }
    let ended = end(child);
    assert_eq!(ended.code, Some(130), "{ended:?}");
    let ended = server(unbroken.folder(), BUILD);
    assert!(ended.err.contains("resuming: "), "{ended:?}");
    unbroken.assert_same(&ended, "after two signals");
}

#[test]
fn damage_to_what_a_kill_left_costs_work_but_no_byte() {
    let unbroken = Unbroken::new();
    // A torn tail.
    unbroken.broken();
    let journal = unbroken.journal();
    let bytes = std::fs::read(&journal).unwrap();
    std::fs::write(&journal, &bytes[..bytes.len() - 7]).unwrap();
    let ended = server(unbroken.folder(), BUILD);
    assert!(ended.err.contains("resuming: "), "{ended:?}");
    unbroken.assert_same(&ended, "a torn tail");
    // A flipped bit in the middle: what follows it is done again.
    unbroken.broken();
    let mut bytes = std::fs::read(&journal).unwrap();
    let middle = bytes.len() / 2;
    bytes[middle] ^= 4;
    std::fs::write(&journal, &bytes).unwrap();
    let ended = server(unbroken.folder(), BUILD);
    assert!(ended.err.contains("resuming: "), "{ended:?}");
    unbroken.assert_same(&ended, "a flipped bit in the journal");
    // A flipped bit in a payload is found before anything is published.
    unbroken.broken();
    let spool = unbroken.journal().with_file_name("spool");
    let mut bytes = std::fs::read(&spool).unwrap();
    bytes[1000] ^= 1;
    std::fs::write(&spool, &bytes).unwrap();
    let ended = server(unbroken.folder(), BUILD);
    // Byte 1000 may belong to a coarse level, which is coded again in any case.
    if ended.code != Some(0) {
        assert_failed(&ended, 1, &["spool", "damaged", "--fresh"], "a flipped bit in the spool");
    }
    let ended = server(unbroken.folder(), &format!("{BUILD} --fresh"));
    unbroken.assert_same(&ended, "built anew");
}

#[test]
fn another_source_or_other_options_start_anew_and_say_so() {
    let unbroken = Unbroken::new();
    let folder = unbroken.folder();
    unbroken.broken();
    // Wrong use does not touch what could be gone on with.
    let before = files(&folder.join("store"));
    assert_failed(&server(folder, &format!("{BUILD} --quantum -1")), 2, &["--quantum"], "wrong use");
    assert_failed(&server(folder, &format!("{BUILD} --memory 1MiB")), 2, &["--memory"], "too little memory");
    assert!(before == files(&folder.join("store")), "wrong use touched the work folder");
    let ended = server(folder, &format!("{BUILD} --fresh"));
    assert!(ended.err.contains("starting anew: --fresh"), "{ended:?}");
    unbroken.assert_same(&ended, "--fresh");
    // The same bytes with another time of change count as another source.
    unbroken.broken();
    let dem = folder.join("dem.tif");
    let same = std::fs::read(&dem).unwrap();
    std::fs::write(&dem, same).unwrap();
    let ended = server(folder, BUILD);
    assert!(ended.err.contains("starting anew: the source, the options"), "{ended:?}");
    unbroken.assert_same(&ended, "a changed source");
    unbroken.broken();
    let ended = server(folder, &format!("{BUILD} --max-error 5"));
    assert!(ended.code == Some(0) && ended.err.contains("starting anew"), "{ended:?}");
    assert!(finished(&folder.join("store")) != unbroken.files, "another error, another store");
}

#[test]
fn a_full_disk_stops_a_build_and_the_same_command_goes_on_once_there_is_room() {
    let unbroken = Unbroken::new();
    let store = unbroken.folder().join("store");
    std::fs::create_dir(&store).unwrap();
    let mount = |options: &str| {
        let mut command = Command::new("mount");
        command.args(["-t", "tmpfs", "-o", options, "tmpfs"]).arg(&store).stderr(Stdio::null());
        command.status().is_ok_and(|status| status.success())
    };
    // The planes take 33 MB, payloads 3 MB: it ends while it reads, then while it codes or publishes.
    if !mount("size=20m") {
        let _ = writeln!(std::io::stderr(), "SKIPPED: no small disk: mounting takes root");
        return;
    }
    let result = std::panic::catch_unwind(|| {
        for (size, words) in [("20m", "a disk too small to read"), ("35m", "a disk too small to publish")] {
            assert!(mount(&format!("remount,size={size}")));
            let ended = server(unbroken.folder(), BUILD);
            assert_failed(&ended, 1, &["store", "free some space", "the same command"], words);
        }
        assert!(mount("remount,size=100m"));
        let ended = server(unbroken.folder(), BUILD);
        assert!(ended.err.contains("resuming: "), "{ended:?}");
        unbroken.assert_same(&ended, "with room again");
    });
    let _ = Command::new("umount").arg(&store).status();
    if let Err(panic) = result {
        std::panic::resume_unwind(panic);
    }
}

#[test]
fn a_dry_run_writes_nothing_and_is_not_far_off() {
    let unbroken = Unbroken::new();
    let folder = unbroken.folder();
    let names = |folder: &Path| -> Vec<_> {
        std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().file_name()).collect()
    };
    let before = names(folder);
    let dry = server(folder, "build {}/dem.tif -o {}/store --dry-run --json");
    assert_eq!(dry.code, Some(0), "{dry:?}");
    assert_eq!(names(folder), before, "it wrote something");
    let text = server(folder, "build {}/dem.tif -o {}/store --dry-run");
    assert!(text.code == Some(0) && text.out.contains("nothing was written"), "{text:?}");
    let estimate: serde_json::Value = serde_json::from_str(&dry.out).unwrap();
    let whole = server(folder, "build {}/dem.tif -o {}/store --json --threads 2");
    let report: serde_json::Value = serde_json::from_str(&whole.out).unwrap();
    assert_eq!(estimate["samples"], report["samples"]);
    for (field, found) in [
        ("diamonds", &report["diamonds"]),
        ("point_bytes", &report["point_bytes"]),
        ("bits_per_sample", &report["bits_per_sample"]),
        ("valid_samples", &report["scene"]["layers"][0]["valid_samples"]),
    ] {
        let ratio = estimate[field].as_f64().unwrap() / found.as_f64().unwrap();
        assert!((0.8..1.25).contains(&ratio), "{field}: {} for {found}", estimate[field]);
    }
    for field in ["seconds", "memory_bytes", "disk_bytes"] {
        assert!(estimate[field].as_f64().unwrap() > 0.0, "{field}: {}", estimate[field]);
    }
    assert_eq!((&estimate["triangles"], &estimate["tin_bytes"]), (&0.into(), &0.into()));
    // Of triangles as well.
    let dry = server(folder, "build {}/dem.tif -o {}/tin --encoding tin --dry-run --json");
    let whole = server(folder, "build {}/dem.tif -o {}/tin --encoding tin --json");
    let estimate: serde_json::Value = serde_json::from_str(&dry.out).unwrap();
    let report: serde_json::Value = serde_json::from_str(&whole.out).unwrap();
    let found = &report["scene"]["layers"][0]["tin"];
    for (field, found) in [("triangles", &found["triangles"]), ("tin_bytes", &found["bytes"])] {
        let ratio = estimate[field].as_f64().unwrap() / found.as_f64().unwrap();
        assert!((0.8..1.2).contains(&ratio), "{field}: {} for {found}", estimate[field]);
    }
    assert_eq!((&estimate["diamonds"], &estimate["point_bytes"]), (&0.into(), &0.into()));
    // And the options that make no sense are refused as in a build.
    let wrong = server(folder, "build {}/dem.tif -o {}/store2 --dry-run --memory 1MiB");
    assert_failed(&wrong, 2, &["--memory"], "a dry run with too little memory");
}
