//! A small store, made once.

use diamantina_server::progress::Progress;
use diamantina_server::{hierarchy, ingest, sample};
use std::path::{Path, PathBuf};
use std::sync::OnceLock;
use tempfile::TempDir;

/// Samples along each side of its source.
const SAMPLES: u32 = 129;

/// The folder of a store of the scene `made`; it stays as long as the process does.
pub(crate) fn store() -> &'static Path {
    static MADE: OnceLock<(TempDir, PathBuf)> = OnceLock::new();
    let (_, store) = MADE.get_or_init(|| {
        let folder = tempfile::tempdir().expect("a place for files");
        let (dem, store) = (folder.path().join("dem.tif"), folder.path().join("made"));
        sample::write(&dem, SAMPLES).expect("a DEM");
        let source = ingest::open(&[dem], &ingest::Options::default()).expect("it was just written");
        hierarchy::build(&source, &store, &hierarchy::Options::new("made"), &Progress::new())
            .expect("it is a DEM like any other");
        (folder, store)
    });
    store
}
