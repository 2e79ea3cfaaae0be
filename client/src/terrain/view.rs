//! What a zone's mask says of the errors in it.

use super::TerrainError;
use crate::cut::Seen;
use diamantina_protocol::message::Scene;
use diamantina_protocol::zone::{Mask, Zone};

/// What is seen from a zone.
#[derive(Debug)]
pub(super) struct ZoneView {
    pub(super) zone: Zone,
    /// Of each layer.
    pub(super) masks: Vec<Mask>,
}

impl ZoneView {
    /// The scene's zone of this name.
    pub(super) fn find(scene: &Scene, name: &str) -> Result<Zone, TerrainError> {
        let found = scene.zones.iter().find(|zone| zone.name == name);
        found.cloned().ok_or_else(|| TerrainError::Zone {
            scene: scene.name.clone(),
            asked: name.to_owned(),
            zones: scene.zones.iter().map(|zone| zone.name.clone()).collect(),
        })
    }

    /// What counts of a layer's errors.
    ///
    /// What is hidden may seem higher by `angle` over its share, and no more, lest it rises above what hides it.
    /// Where the tolerance, in radians, is larger than that angle, shares count for as much more.
    pub(super) fn seen(&self, layer: usize, tolerance: f64) -> Seen<'_> {
        let coarser = if self.zone.angle > 0.0 { (tolerance / self.zone.angle).max(1.0) } else { 1.0 };
        Seen { mask: &self.masks[layer], coarser }
    }
}
