//! What all users have been sent: every payload is decoded once, and compared with that wherever it is sent again.
//!
//! Surfaces are held by the caches of users; what no cache holds any more is decoded again from the payloads, which
//! are kept. So a thousand users take the memory of what they see together.

use crate::cache::Key;
use crate::encoding::Encoding;
use crate::surface::{Surface, SurfaceError};
use bytes::Bytes;
use diamantina_protocol::bintree::Forest;
use diamantina_protocol::diamond::Diamond;
use diamantina_protocol::message::Scene;
use foldhash::fast::RandomState;
use std::collections::HashMap;
use std::sync::{Arc, Mutex, PoisonError, Weak};

/// Why a payload is not what it should be.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub(super) enum WrongError {
    /// Not what another user was sent.
    #[error("the payload of {0:?} is another one than before")]
    Other(Diamond),
    /// It does not decode.
    #[error("the payload of {0:?} does not decode: {1}")]
    Surface(Diamond, SurfaceError),
    /// Its parents were not sent before it.
    #[error("the payload of {0:?} came before its parents")]
    Early(Diamond),
}

#[derive(Debug)]
struct Known {
    payload: Bytes,
    surface: Weak<Surface>,
}

/// The payloads that were sent, by layer and diamond.
#[derive(Debug)]
pub(super) struct Ledger {
    scene: Scene,
    encoding: Encoding,
    known: Mutex<HashMap<Key, Known, RandomState>>,
}

impl Ledger {
    pub(super) fn new(scene: Scene, encoding: Encoding) -> Self {
        Self { scene, encoding, known: Mutex::default() }
    }

    /// The surface of a payload. `held` finds the caller's surfaces, which hold the parents.
    pub(super) fn surface(
        &self,
        key: Key,
        payload: &Bytes,
        held: impl Fn(Diamond) -> Option<Arc<Surface>>,
    ) -> Result<Arc<Surface>, WrongError> {
        let (number, d) = key;
        let known = |this: &Self| {
            let map = this.known.lock().unwrap_or_else(PoisonError::into_inner);
            map.get(&key).map(|known| (known.payload == payload, known.surface.upgrade()))
        };
        match known(self) {
            Some((false, _)) => return Err(WrongError::Other(d)),
            Some((true, Some(surface))) => return Ok(surface),
            Some((true, None)) | None => {}
        }
        let layer = &self.scene.layers[number];
        let forest: &Forest = &layer.forest;
        let parents: Option<Vec<_>> = forest.parents(d).map(|parent| Some((parent, held(parent)?))).collect();
        let parents = parents.ok_or(WrongError::Early(d))?;
        let parents: Vec<_> = parents.iter().map(|(parent, surface)| (*parent, &**surface)).collect();
        // Not under the lock: others need not wait for it.
        let surface = Surface::split(self.encoding, layer, d, &parents, payload)
            .map_err(|error| WrongError::Surface(d, error))?;
        let surface = Arc::new(surface);
        let known = Known { payload: payload.clone(), surface: Arc::downgrade(&surface) };
        self.known.lock().unwrap_or_else(PoisonError::into_inner).insert(key, known);
        Ok(surface)
    }

    /// How many payloads are known, and their bytes.
    pub(super) fn size(&self) -> (usize, usize) {
        let map = self.known.lock().unwrap_or_else(PoisonError::into_inner);
        (map.len(), map.values().map(|known| known.payload.len()).sum())
    }
}
