//! Which of a layer's encodings is streamed, and what differs between them before anything is decoded.

use diamantina_protocol::bintree::Point;
use diamantina_protocol::message::{self, Layer, Scene};

/// How diamonds are encoded. All layers of a scene are streamed in the same way.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Encoding {
    /// Progressive points: fewest bytes.
    #[default]
    Points,
    /// Patches of irregular triangles: fewest triangles.
    Tin,
}

impl Encoding {
    /// The encoding of this name.
    #[must_use]
    pub fn of(name: &str) -> Option<Self> {
        [Self::Points, Self::Tin].into_iter().find(|encoding| encoding.name() == name)
    }

    /// The name, as scenes and addresses have it.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Points => "points",
            Self::Tin => "tin",
        }
    }

    /// A layer as it is streamed in this encoding: with the forest and the errors that go with it. `None` where the
    /// layer is not offered so.
    #[must_use]
    pub fn layer(self, layer: &Layer) -> Option<Layer> {
        if !layer.encodings.iter().any(|name| name == self.name()) {
            return None;
        }
        let layer = layer.clone();
        match (self, &layer.tin) {
            (Self::Points, _) => Some(layer),
            (Self::Tin, Some(tin)) => Some(Layer {
                forest: tin.forest,
                finest_error: tin.finest_error,
                errors: tin.errors.clone(),
                bytes: tin.bytes,
                ..layer
            }),
            (Self::Tin, None) => None,
        }
    }

    /// The path of a page of a layer's index.
    pub(crate) fn index_route(self, scene: &Scene, layer: usize, page: u32) -> String {
        let route = match self {
            Self::Points => message::index_route,
            Self::Tin => message::tin_index_route,
        };
        route(&scene.name, &scene.version, &scene.layers[layer].name, page)
    }

    /// The path of one of a layer's diamonds.
    pub(crate) fn route(self, scene: &Scene, layer: usize, centre: Point) -> String {
        let route = match self {
            Self::Points => message::points_route,
            Self::Tin => message::tin_route,
        };
        route(&scene.name, &scene.version, &scene.layers[layer].name, centre)
    }

    /// The path and query of a batch of a layer's diamonds.
    pub(crate) fn batch_route(self, scene: &Scene, layer: usize, centres: &[Point]) -> String {
        let route = match self {
            Self::Points => message::batch_route,
            Self::Tin => message::tin_batch_route,
        };
        route(&scene.name, &scene.version, &scene.layers[layer].name, centres)
    }
}
