//! Where what is fetched is kept, on the command line.

use super::Failure;
use super::size::parse_size;
use clap::Args;
use diamantina_client::disk::{Disk, DiskError};
use diamantina_client::terrain::Terrain;
use etcetera::BaseStrategy as _;
use std::io::Write as _;
use std::path::PathBuf;

#[derive(Clone, Args)]
pub(super) struct KeepArgs {
    /// Keep what is fetched in this folder, for the next time and for when the server cannot be reached; several
    /// programs may use one [default: for `view` the user's cache folder, else nothing is kept]
    #[arg(long, value_name = "FOLDER")]
    disk_cache: Option<PathBuf>,
    /// What the folder's files may take together, at least 32MiB; what has not been used for the longest goes first
    #[arg(long, default_value = "2GiB", value_name = "SIZE", value_parser = parse_size)]
    disk_cache_size: u64,
    /// Never ask the server: draw what was fetched before, from --disk-cache or the user's cache folder
    #[arg(long)]
    offline: bool,
}

/// An opened cache, if there is one. What was fetched last is on the disk once it is dropped.
pub(super) struct Kept(pub(super) Option<Disk>);

impl Drop for Kept {
    fn drop(&mut self) {
        if let Some(disk) = &self.0 {
            disk.flush();
        }
    }
}

/// Says something that is no result.
fn tell(what: &str) {
    // Nothing is left to do if standard error is closed.
    let _ = writeln!(std::io::stderr(), "{what}");
}

impl KeepArgs {
    pub(super) fn is_offline(&self) -> bool {
        self.offline
    }

    /// Opens the cache; `by_default`: also where no folder is named. One that cannot be used is told of, and done without,
    /// unless nothing is to be asked of the server.
    pub(super) fn open(&self, by_default: bool) -> Result<Kept, Failure> {
        let named = self.disk_cache.clone();
        let usual = || {
            let customs = etcetera::choose_base_strategy().ok()?;
            Some(customs.cache_dir().join("diamantina").join("fetched"))
        };
        let folder = if by_default || self.offline { named.or_else(usual) } else { named };
        let Some(folder) = folder else {
            if self.offline {
                let what = "--offline: there is no cache folder: name one with --disk-cache, or set HOME";
                return Err(Failure(2, what.to_owned()));
            }
            return Ok(Kept(None));
        };
        match Disk::open(&folder, self.disk_cache_size) {
            Ok(disk) => Ok(Kept(Some(disk))),
            Err(error @ DiskError::Limit(_)) => Err(Failure(2, error.to_string())),
            Err(error) if self.offline => Err(Failure(1, error.to_string())),
            Err(error) => {
                tell(&format!("notice: {error}. Nothing is kept"));
                Ok(Kept(None))
            }
        }
    }
}

/// Says so if what is shown is not the server's.
pub(super) fn tell_offline(terrain: &Terrain) {
    if let Some(reason) = terrain.offline() {
        let scene = terrain.scene();
        tell(&format!(
            "notice: offline ({reason}): scene '{}', version {}, as it was fetched before",
            scene.name, scene.version
        ));
    }
}
