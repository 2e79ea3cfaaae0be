//! The versions of the scene that is looked at.

use super::ledger::Ledger;
use super::{LoadError, Options};
use crate::encoding::Encoding;
use crate::fetch::{FetchError, check_layers, describe};
use diamantina_protocol::message::Scene;
use reqwest::Client;
use std::sync::Arc;
use tokio::sync::Mutex;

/// Where the scene is described.
pub(super) struct Source {
    pub(super) client: Client,
    /// The server's address.
    pub(super) root: String,
    /// The scene's name; of none, the only one that there is.
    pub(super) name: Option<String>,
}

/// A version: the layers that are looked at, and what was sent of them.
pub(super) struct Version {
    pub(super) scene: Scene,
    pub(super) ledger: Ledger,
}

/// All versions so far, the newest last.
pub(super) struct Versions {
    pub(super) source: Source,
    layers: Option<Vec<String>>,
    encoding: Encoding,
    known: Mutex<Vec<Arc<Version>>>,
}

impl Versions {
    /// Begins with the version that there is.
    pub(super) async fn open(source: Source, options: &Options) -> Result<Self, LoadError> {
        let (layers, encoding) = (options.layers.clone(), options.encoding);
        let this = Self { source, layers, encoding, known: Mutex::default() };
        let first = this.load().await?;
        this.known.lock().await.push(Arc::new(first));
        Ok(this)
    }

    /// The newest version that is known.
    pub(super) async fn newest(&self) -> Arc<Version> {
        let known = self.known.lock().await;
        Arc::clone(&known[known.len() - 1])
    }

    /// The version that took the place of one that is gone; `None` if the server still describes that one. All that ask at once
    /// wait for one answer.
    pub(super) async fn after(&self, gone: &Arc<Version>) -> Result<Option<Arc<Version>>, FetchError> {
        let mut known = self.known.lock().await;
        let newest = Arc::clone(&known[known.len() - 1]);
        if newest.scene.version != gone.scene.version {
            return Ok(Some(newest));
        }
        let newer = match self.load().await {
            Ok(newer) => Arc::new(newer),
            Err(LoadError::Fetch(error)) => return Err(error),
            Err(other) => return Err(FetchError::Start(other.to_string())),
        };
        if newer.scene.version == gone.scene.version {
            return Ok(None);
        }
        known.push(Arc::clone(&newer));
        Ok(Some(newer))
    }

    async fn load(&self) -> Result<Version, LoadError> {
        let Source { client, root, name } = &self.source;
        let mut scene = describe(client.clone(), root, name.as_deref()).await?;
        if let Some(names) = &self.layers {
            check_layers(&scene, names)?;
            let chosen: Vec<bool> = scene
                .layers
                .iter()
                .map(|layer| names.iter().any(|n| n == scene.chosen_as(&layer.name)))
                .collect();
            let mut chosen = chosen.into_iter();
            scene.layers.retain(|_| chosen.next().unwrap_or(false));
        }
        // Users look at the first step of a series.
        for series in std::mem::take(&mut scene.series) {
            scene.layers.retain(|layer| !series.layers[1..].contains(&layer.name));
        }
        for layer in &mut scene.layers {
            let (name, asked) = (layer.name.clone(), self.encoding.name());
            *layer = self.encoding.layer(layer).ok_or(LoadError::Encoding(name, asked))?;
        }
        let ledger = Ledger::new(scene.clone(), self.encoding);
        Ok(Version { scene, ledger })
    }

    /// How many payloads of all versions are known, and their bytes.
    pub(super) async fn size(&self) -> (usize, usize) {
        let known = self.known.lock().await;
        let sizes = known.iter().map(|version| version.ledger.size());
        sizes.fold((0, 0), |(count, bytes), (more, of)| (count + more, bytes + of))
    }
}
