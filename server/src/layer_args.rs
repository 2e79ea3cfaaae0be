//! The layers that `build` is told of on the command line.

use diamantina_protocol::message::Kind;
use diamantina_server::hierarchy::LayerSource;
use diamantina_server::ingest::{self, Grid, IngestError, Source};
use std::path::PathBuf;
use std::str::FromStr;

/// The name of the layer that files without a name are of.
pub(super) const TERRAIN: &str = "terrain";

/// Characters of a layer's name, at most.
const NAME_LENGTH_MAX: usize = 64;

/// `NAME=KIND:PATH` or `NAME=water:level=METRES`.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct LayerArg {
    name: String,
    kind: Kind,
    heights: Heights,
}

/// Where the heights of a layer are from.
#[derive(Debug, Clone, PartialEq)]
enum Heights {
    Files(Vec<PathBuf>),
    /// Metres, the same everywhere.
    Level(f64),
}

/// Whether a layer may be called so: its name stands in addresses, where zones have theirs.
fn is_layer_name(name: &str) -> bool {
    (1..=NAME_LENGTH_MAX).contains(&name.len())
        && name.bytes().all(|b| b.is_ascii_lowercase() || b.is_ascii_digit() || matches!(b, b'_' | b'-'))
        && name != "zones"
}

impl FromStr for LayerArg {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let form = || {
            format!(
                "expected NAME=KIND:PATH, such as sea=water:surface.tif, or NAME=water:level=METRES, found '{text}'"
            )
        };
        let (name, rest) = text.split_once('=').ok_or_else(form)?;
        let (kind, heights) = rest.split_once(':').ok_or_else(form)?;
        if !is_layer_name(name) {
            return Err(format!(
                "expected a name of 1 to {NAME_LENGTH_MAX} small letters, digits, '-' or '_' other than 'zones', which \
                 addresses have a place for, found '{name}'"
            ));
        }
        let kind = match kind {
            "terrain" => Kind::Terrain,
            "water" => Kind::Water,
            "texture" => {
                return Err("textures are not built yet: expected the kind terrain or water".to_owned());
            }
            other => return Err(format!("expected the kind terrain or water, found '{other}'")),
        };
        let heights = match heights.strip_prefix("level=") {
            Some(_) if kind == Kind::Terrain => {
                return Err(
                    "level= is for water: ground comes from a file (one of that name is ./level=...)"
                        .to_owned(),
                );
            }
            Some(metres) => {
                let level = metres.parse().ok().filter(|level: &f64| level.is_finite());
                Heights::Level(
                    level.ok_or_else(|| format!("expected level=METRES, a number, found '{metres}'"))?,
                )
            }
            None if heights.is_empty() => return Err(form()),
            None => Heights::Files(vec![heights.into()]),
        };
        Ok(Self { name: name.to_owned(), kind, heights })
    }
}

/// Puts together what belongs to one layer: first the files without a name, then the others in the order in which they are
/// named.
///
/// # Errors
/// When one layer is said to be two things, or there is no terrain.
pub(super) fn join(files: &[PathBuf], named: &[LayerArg]) -> Result<Vec<LayerArg>, String> {
    let mut layers: Vec<LayerArg> = Vec::new();
    if !files.is_empty() {
        let heights = Heights::Files(files.to_vec());
        layers.push(LayerArg { name: TERRAIN.to_owned(), kind: Kind::Terrain, heights });
    }
    for more in named {
        let Some(layer) = layers.iter_mut().find(|layer| layer.name == more.name) else {
            layers.push(more.clone());
            continue;
        };
        if layer.kind != more.kind {
            let whence =
                if files.is_empty() || more.name != TERRAIN { "" } else { " (as files without --layer are)" };
            return Err(format!(
                "--layer: '{}' is {}{whence} and {}: give one of both another name",
                more.name,
                word(layer.kind),
                word(more.kind)
            ));
        }
        match (&mut layer.heights, &more.heights) {
            (Heights::Files(all), Heights::Files(files)) => all.extend_from_slice(files),
            _ => {
                return Err(format!(
                    "--layer: '{}' has a level and something else besides: give one of both another name",
                    more.name
                ));
            }
        }
    }
    if !layers.iter().any(|layer| layer.kind == Kind::Terrain) {
        return Err("expected terrain, found water alone: name a DEM of the ground, too".to_owned());
    }
    Ok(layers)
}

pub(super) fn word(kind: Kind) -> &'static str {
    match kind {
        Kind::Terrain => "terrain",
        Kind::Water => "water",
    }
}

/// The opened sources of layers.
pub(super) struct Layers {
    opened: Vec<(LayerArg, Source)>,
}

impl Layers {
    /// Opens the files of all layers. The first with files decides the frame. Flat water gets 2^`cells_log2` cells along each
    /// side.
    ///
    /// # Errors
    /// As [`ingest::open`] and [`ingest::open_over`].
    pub(super) fn open(
        layers: Vec<LayerArg>,
        options: &ingest::Options,
        cells_log2: u8,
    ) -> Result<Self, IngestError> {
        let mut sources: Vec<Option<Source>> = Vec::with_capacity(layers.len());
        for layer in &layers {
            let Heights::Files(files) = &layer.heights else {
                sources.push(None);
                continue;
            };
            let first = sources.iter().flatten().next();
            sources.push(Some(match first {
                None => ingest::open(files, options)?,
                Some(first) => ingest::open_over(files, options, first)?,
            }));
        }
        let ground = layers.iter().position(|layer| layer.kind == Kind::Terrain);
        for (number, layer) in layers.iter().enumerate() {
            let ground = ground.and_then(|number| sources[number].as_ref());
            let (Heights::Level(metres), Some(ground)) = (&layer.heights, ground) else { continue };
            let level = ingest::level(*metres, cells_log2, ground)?;
            sources[number] = Some(level);
        }
        let opened = layers.into_iter().zip(sources).filter_map(|(layer, source)| Some((layer, source?)));
        Ok(Self { opened: opened.collect() })
    }

    /// What is to be built.
    pub(super) fn sources(&self) -> Vec<LayerSource<'_>> {
        let each = self.opened.iter();
        each.map(|(layer, source)| LayerSource { name: &layer.name, kind: layer.kind, source }).collect()
    }

    /// The files of a layer; of the only one, if none is named.
    pub(super) fn files(&self, layer: Option<&str>) -> &[PathBuf] {
        let found = self.opened.iter().find(|(of, _)| layer.is_none_or(|name| of.name == name));
        match found.map(|(of, _)| &of.heights) {
            Some(Heights::Files(files)) => files,
            _ => &[],
        }
    }

    /// Layers that do not touch the first one: they are shown far from it, which is seldom meant.
    pub(super) fn apart(&self) -> Vec<&str> {
        let Some((_, first)) = self.opened.first() else { return Vec::new() };
        let far = self.opened.iter().filter(|(_, source)| !touch(first.grid(), source.grid()));
        far.map(|(layer, _)| layer.name.as_str()).collect()
    }
}

/// Whether two lattices have a place in common.
fn touch(a: &Grid, b: &Grid) -> bool {
    let ends = |grid: &Grid, axis: usize| {
        let samples = f64::from([grid.width, grid.height][axis].saturating_sub(1));
        [grid.origin[axis], grid.origin[axis] + grid.cell[axis] * samples]
    };
    (0..2).all(|axis| {
        let ([a0, a1], [b0, b1]) = (ends(a, axis), ends(b, axis));
        a0 <= b1 && b0 <= a1
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn arg(text: &str) -> LayerArg {
        text.parse().unwrap()
    }

    #[test]
    fn a_layer_is_a_name_a_kind_and_a_file_or_a_level() {
        let files = |names: &[&str]| Heights::Files(names.iter().map(PathBuf::from).collect());
        let sea = LayerArg { name: "sea".to_owned(), kind: Kind::Water, heights: files(&["a=b:c.tif"]) };
        assert_eq!(arg("sea=water:a=b:c.tif"), sea);
        assert_eq!(arg("lake_2-b=water:level=-1.5").heights, Heights::Level(-1.5));
        assert_eq!(arg("lake=water:./level=3").heights, files(&["./level=3"]));
        for (wrong, word) in [
            ("sea", "NAME=KIND:PATH"),
            ("sea=water", "NAME=KIND:PATH"),
            ("sea=water:", "NAME=KIND:PATH"),
            ("=water:a.tif", "1 to 64 small letters"),
            ("Sea=water:a.tif", "1 to 64 small letters"),
            ("zones=water:a.tif", "'zones'"),
            (&format!("{}=water:a.tif", "a".repeat(65)), "1 to 64 small letters"),
            ("sea=lava:a.tif", "terrain or water, found 'lava'"),
            ("sea=texture:a.tif", "not built yet"),
            ("sea=water:level=high", "level=METRES"),
            ("sea=water:level=inf", "level=METRES"),
            ("rock=terrain:level=3", "level= is for water"),
        ] {
            let error = wrong.parse::<LayerArg>().unwrap_err();
            assert!(error.contains(word), "{wrong}: {error}");
        }
    }

    #[test]
    fn files_of_one_name_are_one_layer_and_of_one_kind() {
        let some = [PathBuf::from("a.tif")];
        let joined = |files: &[PathBuf], named: &[&str]| {
            join(files, &named.iter().map(|text| arg(text)).collect::<Vec<_>>())
        };
        let layers = joined(&some, &["sea=water:s.tif", "terrain=terrain:b.tif", "sea=water:t.tif"]).unwrap();
        let names: Vec<_> = layers.iter().map(|layer| layer.name.as_str()).collect();
        assert_eq!(names, ["terrain", "sea"]);
        for (layer, expected) in layers.iter().zip([["a.tif", "b.tif"], ["s.tif", "t.tif"]]) {
            assert_eq!(layer.heights, Heights::Files(expected.map(PathBuf::from).to_vec()));
        }
        assert_eq!(joined(&[], &["ground=terrain:a.tif"]).unwrap().len(), 1);
        for (files, named, word) in [
            (&some[..], &["terrain=water:b.tif"][..], "as files without --layer are"),
            (&some, &["sea=water:a.tif", "sea=terrain:b.tif"], "'sea' is water and terrain"),
            (&some, &["sea=water:a.tif", "sea=water:level=0"], "a level and something else"),
            (&some, &["sea=water:level=1", "sea=water:level=0"], "a level and something else"),
            (&[], &["sea=water:a.tif"], "found water alone"),
        ] {
            let error = joined(files, named).unwrap_err();
            assert!(error.contains(word), "{named:?}: {error}");
        }
    }
}
