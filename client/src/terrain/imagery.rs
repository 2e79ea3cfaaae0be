//! The imagery of a scene: which is shown, and what a frame asks of it.

use super::{FrameView, Terrain, TerrainError};
use crate::camera::{Bounds, Camera, nearest_drawn};
use crate::cut;
use crate::fetch::{self, FetchError, Want};
use crate::texture::{Coding, Draping};
use diamantina_protocol::message::{Kind, Scene};

/// Which imagery lies on the terrain.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub enum Imagery {
    /// The scene's first, if it has any.
    #[default]
    First,
    /// None: terrain is coloured by its heights.
    None,
    /// The texture of this name.
    Named(String),
}

impl Imagery {
    /// What a user asks for by a name, by "none", or not at all.
    #[must_use]
    pub fn asked(name: Option<String>) -> Self {
        match name {
            None => Self::First,
            Some(name) if name == "none" => Self::None,
            Some(name) => Self::Named(name),
        }
    }

    /// The position of the texture in a scene.
    pub(super) fn find(&self, scene: &Scene) -> Result<Option<usize>, TerrainError> {
        match self {
            Self::None => Ok(None),
            Self::First => Ok((!scene.textures.is_empty()).then_some(0)),
            Self::Named(name) => {
                let found = scene.textures.iter().position(|texture| texture.name == *name);
                found.map(Some).ok_or_else(|| TerrainError::Texture {
                    scene: scene.name.clone(),
                    asked: name.clone(),
                    textures: scene.textures.iter().map(|texture| texture.name.clone()).collect(),
                })
            }
        }
    }
}

impl Terrain {
    /// The position in the scene of the texture that lies on the terrain.
    #[must_use]
    pub fn texture(&self) -> Option<usize> {
        self.draping.as_ref().map(Draping::number)
    }

    /// The name of that texture.
    #[must_use]
    pub fn texture_name(&self) -> Option<&str> {
        self.texture().map(|number| self.scene.textures[number].name.as_str())
    }

    /// Lays the texture at a position in the scene on the terrain, or none.
    pub fn set_texture(&mut self, number: Option<usize>) {
        let number = number.filter(|number| *number < self.scene.textures.len());
        if number == self.texture() {
            return;
        }
        self.options.imagery = match number {
            None => Imagery::None,
            Some(number) => Imagery::Named(self.scene.textures[number].name.clone()),
        };
        self.start_draping(number);
    }

    fn start_draping(&mut self, number: Option<usize>) {
        self.draping = None;
        if let Some(number) = number {
            match self.drape(number) {
                Ok(draping) => self.draping = Some(draping),
                Err(error) => self.problem = Some(TerrainError::Thread(error).to_string()),
            }
        }
        self.share_out();
    }

    pub(super) fn drape(&self, number: usize) -> std::io::Result<Draping> {
        let texture = &self.scene.textures[number];
        let super::Options { texture_bytes, texture_coding, fade_seconds, .. } = &self.options;
        Draping::start(number, texture, *texture_bytes, *texture_coding, *fade_seconds)
    }

    /// Says whether what draws imagery is to have it in blocks: if not, it comes plain, whatever was asked for. Tiles that are
    /// there come again, from the disk cache if there is one.
    pub fn suit_blocks(&mut self, suits: bool) {
        if !suits && self.options.texture_coding != Coding::Plain {
            self.options.texture_coding = Coding::Plain;
            let number = self.texture();
            self.start_draping(number);
        }
    }

    /// Takes what has been decoded of tiles.
    pub(super) fn take_tiles(&mut self) {
        let Some(draping) = &mut self.draping else { return };
        let number = draping.number();
        for (tile, result) in draping.take_decoded() {
            let key = fetch::Key::Tile(number, tile);
            match result {
                Ok(()) => self.fetcher.accept(key),
                Err(reason) => {
                    let texture = self.scene.textures[number].name.clone();
                    self.fetcher.refuse(key, &FetchError::Tile { texture, tile, reason });
                }
            }
        }
    }

    /// Puts imagery on what a frame draws; what is to be asked for.
    pub(super) fn imagery(&mut self, camera: &Camera, seconds: f64, view: &mut FrameView) -> Vec<Want> {
        let Some(draping) = &mut self.draping else { return Vec::new() };
        let (layers, exaggeration) = (&self.scene.layers, self.options.exaggeration);
        let planes = camera.planes();
        let boxes: Vec<Bounds> = view
            .items
            .iter()
            .filter(|item| layers[item.layer].kind == Kind::Terrain)
            .filter_map(|item| {
                let entry = self.layers[item.layer].index.get(item.diamond)?;
                let bounds = cut::bounds(&layers[item.layer], item.diamond, &entry).stretched(exaggeration);
                (!entry.is_empty() && bounds.touches(&planes)).then_some(bounds)
            })
            .collect();
        let nearest = nearest_drawn(layers.iter().flat_map(|layer| layer.cell));
        let step = draping.step(camera, &boxes, nearest, seconds);
        view.moving += step.fading;
        view.complete &= step.complete && draping.is_idle();
        view.drape = step.drape;
        (self.stats.texture_tiles, self.stats.texture_bytes) = (draping.tiles(), draping.bytes());
        let number = draping.number();
        let coverage = step.lacks_coverage.then_some(fetch::Key::Coverage(number));
        let tiles = step.wishes.into_iter().map(|tile| fetch::Key::Tile(number, tile));
        coverage.into_iter().chain(tiles).map(|key| Want { key, bytes: None }).collect()
    }
}
