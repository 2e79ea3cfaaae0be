//! Makes what `scripts/bench-serve` asks for: stores whose diamonds have about 1, 8 and 64 kB, a store as it is built, and
//! the same diamonds as files, in the folders that their addresses name.
//!
//! `cargo run --release -p diamantina-tests --example blobs -- FOLDER` fills FOLDER with `stores/SIZE`, `files/scenes/...`
//! and `SIZE.paths`, `SIZE.batches`: addresses of single diamonds and of batches, one a line.

use clap::Parser;
use diamantina_protocol::message;
use diamantina_server::progress::Progress;
use diamantina_server::store::{Key, Kind, Store, Writer};
use diamantina_server::{hierarchy, ingest, inspect, sample};
use std::error::Error;
use std::fs;
use std::path::PathBuf;

/// Samples along each side of the source.
const SAMPLES: u32 = 1025;

/// Bytes of a batch, as the client asks for them.
const BATCH_BYTES: usize = 256 << 10;

/// Names of sizes, bytes of a diamond (none: its own, as it was built), diamonds at most.
const SIZES: [(&str, Option<usize>, usize); 4] =
    [("1kB", Some(1000), 2000), ("8kB", Some(8000), 2000), ("64kB", Some(64000), 600), ("built", None, 2000)];

#[derive(Parser)]
struct Arguments {
    /// Where to
    folder: PathBuf,
}

/// Bytes that are not to be compressed.
fn noise(state: &mut u64, count: usize) -> Vec<u8> {
    let mut next = || {
        *state = state.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut v = *state;
        v = (v ^ v >> 30).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        v = (v ^ v >> 27).wrapping_mul(0x94D0_49BB_1331_11EB);
        (v ^ v >> 31).to_le_bytes()
    };
    std::iter::repeat_with(&mut next).flatten().take(count).collect()
}

fn main() -> Result<(), Box<dyn Error>> {
    let Arguments { folder } = Arguments::parse();
    fs::create_dir_all(folder.join("stores"))?;
    let (dem, real) = (folder.join("dem.tif"), folder.join("real"));
    sample::write(&dem, SAMPLES)?;
    let source = ingest::open(&[dem], &ingest::Options::default())?;
    hierarchy::build(&source, &real, &hierarchy::Options::new("real"), &Progress::new())?;
    let real = Store::open(&real)?;
    let mut state = 1;
    for (name, bytes, most) in SIZES {
        // A server never looks into payloads: those of a size that is asked for have nothing to decode.
        let mut scene = real.scene().clone();
        name.clone_into(&mut scene.name);
        let layer = &scene.layers[0];
        let mut diamonds: Vec<_> = inspect::entries(&real, 0, layer)?.into_iter().collect();
        diamonds.retain(|(_, entry)| entry.bytes > 0);
        diamonds.sort_by_key(|(d, _)| (d.level(), d.centre()));
        diamonds.truncate(most);
        let place = folder.join("stores").join(name);
        let writer = Writer::create(&place)?;
        let key = |[x, y]: [u32; 2]| Key { layer: 0, kind: Kind::Points, a: x, b: y };
        for ((d, _), order) in diamonds.iter().zip(0..) {
            let payload = match bytes {
                Some(bytes) => noise(&mut state, bytes),
                None => real.get(key(d.centre()))?.ok_or("no such diamond")?.to_vec(),
            };
            writer.put(key(d.centre()), order, &payload)?;
        }
        writer.publish(scene, |_| true)?;
        let store = Store::open(&place)?;
        let (scene, layer) = (store.scene(), &store.scene().layers[0]);
        let (mut paths, mut batches, mut batch, mut batch_bytes) =
            (String::new(), String::new(), Vec::new(), 0);
        let mut total = 0;
        for (d, _) in &diamonds {
            let centre = d.centre();
            let route = message::points_route(&scene.name, &scene.version, &layer.name, centre);
            let file = folder.join("files").join(route.trim_start_matches('/'));
            fs::create_dir_all(file.parent().ok_or("no folder")?)?;
            let payload = store.get(key(centre))?.ok_or("no such diamond")?;
            total += payload.len();
            batch_bytes += payload.len();
            fs::write(file, payload)?;
            paths += &format!("{route}\n");
            batch.push(centre);
            if batch.len() == message::BATCH_MAX || batch_bytes >= BATCH_BYTES {
                let route = message::batch_route(&scene.name, &scene.version, &layer.name, &batch);
                batches += &format!("{} {route}\n", batch.len());
                batch.clear();
                batch_bytes = 0;
            }
        }
        fs::write(folder.join(format!("{name}.paths")), paths)?;
        fs::write(folder.join(format!("{name}.batches")), batches)?;
        println!("{name}: {} diamonds, {} bytes each", diamonds.len(), total / diamonds.len());
    }
    Ok(())
}
