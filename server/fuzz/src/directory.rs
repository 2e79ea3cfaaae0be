//! A store's directory, whose hash is right: what a builder gone wrong might leave.

use super::made;
use diamantina_protocol::message::Scene;
use diamantina_server::inspect;
use diamantina_server::store::{Store, StoreError};
use serde::{Deserialize, Serialize};
use std::fs;

/// `scene.json`, as a store has it.
#[derive(Clone, Deserialize, Serialize)]
struct Manifest {
    format: u32,
    directory_hash: String,
    pack_bytes: Vec<u64>,
    scene: Scene,
}

/// The directory with changes: of three bytes each, where (little endian, modulo its length; at its end: one more) and what
/// is there from now on. A byte that is left over says how much of it stays, in parts of 256.
fn changed(mut directory: Vec<u8>, data: &[u8]) -> Vec<u8> {
    let (changes, rest) = data.as_chunks::<3>();
    for [low, high, byte] in changes {
        let at = usize::from(u16::from_le_bytes([*low, *high])) % (directory.len() + 1);
        if at == directory.len() {
            directory.push(*byte);
        } else {
            directory[at] = *byte;
        }
    }
    if let [part] = rest {
        directory.truncate(directory.len() * usize::from(*part) / 256);
    }
    directory
}

/// Opens a store whose directory is changed like this. What opens has blobs that are read, or said to be damaged.
pub fn run(data: &[u8]) {
    let made = made::store();
    let text = fs::read(made.join("scene.json")).expect("a store has one");
    let mut manifest: Manifest = serde_json::from_slice(&text).expect("JSON");
    let before = made.join(std::mem::take(&mut manifest.scene.version));
    let directory = changed(fs::read(before.join("directory")).expect("a store has one"), data);
    manifest.directory_hash = blake3::hash(&directory).to_hex().to_string();
    let nameless = serde_json::to_vec(&manifest).expect("JSON");
    manifest.scene.version = blake3::hash(&nameless).to_hex()[..16].to_owned();

    let folder = tempfile::tempdir_in(made.parent().expect("a folder")).expect("a place for files");
    let inside = folder.path().join(&manifest.scene.version);
    fs::create_dir(&inside).expect("a folder");
    for entry in fs::read_dir(before).expect("a folder") {
        let path = entry.expect("a file").path();
        let name = path.file_name().expect("a name");
        if name == "directory" {
            fs::write(inside.join(name), &directory).expect("room for a file");
        } else {
            fs::hard_link(&path, inside.join(name)).expect("a link");
        }
    }
    fs::write(folder.path().join("scene.json"), serde_json::to_vec(&manifest).expect("JSON"))
        .expect("room for a file");
    match Store::open(folder.path()) {
        Ok(store) => {
            for (layer, number) in store.scene().layers.iter().zip(0..) {
                let _ = inspect::entries(&store, number, layer);
            }
        }
        Err(StoreError::Damaged { .. }) => {}
        Err(other) => panic!("expected damage to be told, found: {other}"),
    }
}
