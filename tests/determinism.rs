//! The same input gives the same bytes, whatever the threads and the memory.

use crate::world::programs;
use diamantina_server::sample;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::Command;

/// Every file below a folder, by its path, with its bytes.
pub(crate) fn files(folder: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let mut found = BTreeMap::new();
    let mut folders = vec![folder.to_owned()];
    while let Some(next) = folders.pop() {
        for entry in std::fs::read_dir(&next).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                folders.push(path);
            } else {
                found.insert(path.strip_prefix(folder).unwrap().to_owned(), std::fs::read(&path).unwrap());
            }
        }
    }
    found
}

fn build(dem: &Path, store: &Path, options: &[&str]) {
    let mut command = Command::new(&programs().server);
    let output =
        command.arg("build").arg(dem).arg("-o").arg(store).args(["--scene", "same"]).args(options).output();
    let output = output.unwrap();
    assert!(output.status.success(), "{options:?}: {}", String::from_utf8_lossy(&output.stderr));
}

#[test]
fn threads_and_memory_change_no_byte_of_a_store() {
    let folder = tempfile::tempdir().unwrap();
    let dem = folder.path().join("dem.tif");
    // 2 x 2 chunks and more, with diamonds that straddle their borders.
    sample::write(&dem, 2500).unwrap();
    let store = |name: &str| folder.path().join(name);
    build(&dem, &store("reference"), &["--threads", "1", "--memory", "2GiB"]);
    let reference = files(&store("reference"));
    assert!(reference.len() >= 3 && reference.values().map(Vec::len).sum::<usize>() > 1 << 20);
    for options in [
        ["--threads", "2", "--memory", "2GiB"],
        ["--threads", "5", "--memory", "4GiB"],
        ["--threads", "2", "--memory", "300MiB"],
        ["--threads", "1", "--memory", "200MiB"],
    ] {
        build(&dem, &store("other"), &options);
        let other = files(&store("other"));
        assert_eq!(reference.keys().collect::<Vec<_>>(), other.keys().collect::<Vec<_>>(), "{options:?}");
        for (path, bytes) in &reference {
            assert!(*bytes == other[path], "{options:?}: {} differs", path.display());
        }
    }
}

#[test]
fn too_little_memory_is_refused_with_what_is_needed() {
    let folder = tempfile::tempdir().unwrap();
    let dem = folder.path().join("dem.tif");
    sample::write(&dem, 1025).unwrap();
    let try_with = |memory: &str| {
        let store = folder.path().join("store");
        let output = Command::new(&programs().server)
            .arg("build")
            .arg(&dem)
            .arg("-o")
            .arg(&store)
            .args(["--memory", memory])
            .output()
            .unwrap();
        (output.status.code(), String::from_utf8(output.stderr).unwrap())
    };
    let (code, message) = try_with("64MiB");
    assert_eq!(code, Some(2), "{message}");
    assert!(message.contains("--memory 64MiB"), "{message}");
    let needed = message.rsplit_once("--memory ").unwrap().1.split(' ').next().unwrap();
    let mebibytes: u64 = needed.strip_suffix("MiB").unwrap().parse().unwrap();
    // What the message asks for is enough, in its own words, and a unit less is not.
    let (code, message) = try_with(needed);
    assert_eq!(code, Some(0), "{message}");
    assert_eq!(try_with(&format!("{}MiB", mebibytes - 1)).0, Some(2));
}
