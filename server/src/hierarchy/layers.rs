//! The layers of a scene before they are built: what each is, and what it may take of the memory.
//!
//! Layers are built one after the other, but what is known of all their diamonds waits in memory until all are
//! published. So each is planned with what the others leave.

use super::plan::{Plan, held_bytes};
use super::transcribe::find_quantum;
use super::{BuildError, Content, Options, forest_of, tins};
use crate::ingest::{IngestError, Source};
use crate::texture::describe;
use diamantina_protocol::message::{Kind, is_name};
use diamantina_protocol::series::Series;
use diamantina_protocol::texture::TEXTURES_MAX;
use diamantina_protocol::zone::LAYERS_MAX;

/// A layer to be built: what it is called, what it is, and where its heights are from.
#[derive(Debug, Clone, Copy)]
pub struct LayerSource<'a> {
    /// The name in addresses.
    pub name: &'a str,
    /// Terrain or water.
    pub kind: Kind,
    /// Its heights.
    pub source: &'a Source,
}

impl<'a> LayerSource<'a> {
    /// The layer of a scene that has no other: terrain of that name.
    #[must_use]
    pub fn terrain(source: &'a Source) -> Self {
        Self { name: "terrain", kind: Kind::Terrain, source }
    }
}

/// A layer that is about to be built.
pub(super) struct Part<'a> {
    /// Position in the scene.
    pub(super) number: u8,
    pub(super) layer: LayerSource<'a>,
    pub(super) plan: Plan,
    /// Metres of a quantum.
    pub(super) quantum: f64,
    /// Those of the build, with the memory that the other layers leave.
    pub(super) options: Options,
    is_alone: bool,
}

impl Part<'_> {
    /// What to call it where several are under way.
    pub(super) fn label(&self) -> Option<&str> {
        (!self.is_alone).then_some(self.layer.name)
    }

    /// A failure, with the layer that it is of, if there are several.
    pub(super) fn failed(&self, error: BuildError) -> BuildError {
        in_layer(self.label(), error)
    }
}

fn in_layer(label: Option<&str>, error: BuildError) -> BuildError {
    match (label, error) {
        (None, error) => error,
        // These are of the whole build.
        (_, error @ (BuildError::Interrupted { .. } | BuildError::Work { .. } | BuildError::Store(_))) => {
            error
        }
        (Some(layer), error) => BuildError::Layer { layer: layer.to_owned(), error: Box::new(error) },
    }
}

/// What is to be built of each layer.
pub(super) fn parts<'a>(layers: &[LayerSource<'a>], options: &Options) -> Result<Vec<Part<'a>>, BuildError> {
    tins::check(options)?;
    check(layers)?;
    let is_alone = layers.len() == 1;
    let label = |layer: &LayerSource<'a>| (!is_alone).then_some(layer.name);
    let mut forests = Vec::with_capacity(layers.len());
    for layer in layers {
        let forest =
            forest_of(layer.source.grid(), options).map_err(|error| in_layer(label(layer), error))?;
        forests.push(forest);
    }
    let held: Vec<u64> = forests
        .iter()
        .map(|forest| tins::bytes(forest, options).map(|tins| held_bytes(forest) + tins))
        .collect::<Result<_, BuildError>>()?;
    let all: u64 = held.iter().sum();
    // The most that any layer needs is what to ask for.
    let (mut plans, mut lacking) = (Vec::with_capacity(layers.len()), None::<BuildError>);
    for (forest, own) in forests.iter().zip(&held) {
        let aside = all - own;
        let granted = Options { memory: options.memory.saturating_sub(aside), ..options.clone() };
        let plan = tins::bytes(forest, &granted).and_then(|tins| Plan::new(*forest, granted.memory, tins));
        match plan.map_err(|error| error.beside(aside, options.memory)) {
            Ok(plan) => plans.push((plan, granted)),
            Err(error) if error.memory_needed().is_none() => return Err(error),
            Err(error) => {
                let most = lacking.as_ref().and_then(BuildError::memory_needed);
                lacking = if error.memory_needed() > most { Some(error) } else { lacking };
            }
        }
    }
    if let Some(error) = lacking {
        return Err(error);
    }
    let part = |(number, (layer, (plan, options))): (usize, (&LayerSource<'a>, (Plan, Options)))| -> Result<Part<'a>, BuildError> {
        let quantum = find_quantum(layer.source, &options).map_err(|error| in_layer(label(layer), error))?;
        let number = u8::try_from(number).unwrap_or(u8::MAX);
        Ok(Part { number, layer: *layer, plan, quantum, options, is_alone })
    };
    layers.iter().zip(plans).enumerate().map(part).collect()
}

/// Refuses what would be no scene.
fn check(layers: &[LayerSource<'_>]) -> Result<(), BuildError> {
    if layers.is_empty() {
        return Err(IngestError::NoInput.into());
    }
    if layers.len() > LAYERS_MAX {
        return Err(BuildError::Layers(layers.len()));
    }
    for (number, layer) in layers.iter().enumerate() {
        let is_taken = layers[..number].iter().any(|other| other.name == layer.name);
        // In addresses, zones stand where layers do.
        if is_taken || !is_name(layer.name) || layer.name == "zones" {
            return Err(BuildError::LayerName(layer.name.to_owned()));
        }
    }
    Ok(())
}

/// Refuses series that no scene with these layers can have.
pub(super) fn check_series(layers: &[LayerSource<'_>], series: &[Series]) -> Result<(), BuildError> {
    if let Some(series) = series.iter().find(|series| !is_name(&series.name) || series.name == "zones") {
        return Err(BuildError::LayerName(series.name.clone()));
    }
    Series::positions(series, layers.iter().map(|layer| (layer.name, layer.kind == Kind::Water)))?;
    Ok(())
}

/// Refuses textures that no scene with these layers can have.
pub(super) fn check_textures(content: &Content<'_>, options: &Options) -> Result<(), BuildError> {
    let Content { layers, textures, series } = content;
    if !(1..=100).contains(&options.texture_quality) {
        return Err(BuildError::TextureQuality(options.texture_quality));
    }
    if textures.len() > TEXTURES_MAX {
        return Err(BuildError::Textures(textures.len()));
    }
    for (number, texture) in textures.iter().enumerate() {
        // They stand in the same place of addresses.
        let is_taken = layers.iter().any(|layer| layer.name == texture.name)
            || series.iter().any(|series| series.name == texture.name)
            || textures[..number].iter().any(|other| other.name == texture.name);
        if is_taken || !is_name(texture.name) || texture.name == "zones" {
            return Err(BuildError::LayerName(texture.name.to_owned()));
        }
        let failed = |error| BuildError::Texture { texture: texture.name.to_owned(), error: Box::new(error) };
        describe(*texture, options.texture_quality).map_err(failed)?;
    }
    Ok(())
}
