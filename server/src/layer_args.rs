//! The layers that `build` is told of on the command line.

use crate::series_args;
use diamantina_protocol::message::Kind;
use diamantina_protocol::series::Series;
use diamantina_server::hierarchy::LayerSource;
use diamantina_server::ingest::{self, Grid, Imagery, IngestError, Source};
use diamantina_server::texture::TextureSource;
use std::path::PathBuf;
use std::str::FromStr;

/// The name of the layer that files without a name are of.
pub(super) const TERRAIN: &str = "terrain";

/// Characters of a layer's name, at most.
const NAME_LENGTH_MAX: usize = 64;

/// `NAME=KIND:PATH`, `NAME=water:PATTERN` or `NAME=water:level=METRES`.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct LayerArg {
    name: String,
    what: What,
    data: Data,
}

/// What a layer is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum What {
    Surface(Kind),
    Texture,
}

impl What {
    fn word(self) -> &'static str {
        match self {
            Self::Surface(kind) => word(kind),
            Self::Texture => "texture",
        }
    }
}

/// What a layer is made of.
#[derive(Debug, Clone, PartialEq)]
enum Data {
    Files(Vec<PathBuf>),
    /// A file for each step of a series, in the order of time.
    Steps(Vec<PathBuf>),
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
        let (kind, data) = rest.split_once(':').ok_or_else(form)?;
        if !is_layer_name(name) {
            return Err(format!(
                "expected a name of 1 to {NAME_LENGTH_MAX} small letters, digits, '-' or '_' other than 'zones', which \
                 addresses have a place for, found '{name}'"
            ));
        }
        let what = match kind {
            "terrain" => What::Surface(Kind::Terrain),
            "water" => What::Surface(Kind::Water),
            "texture" => What::Texture,
            other => return Err(format!("expected the kind terrain, water or texture, found '{other}'")),
        };
        let data = match data.strip_prefix("level=") {
            Some(_) if what != What::Surface(Kind::Water) => {
                return Err(
                    "level= is for water: all else comes from a file (one of that name is ./level=...)"
                        .to_owned(),
                );
            }
            Some(metres) => {
                let level = metres.parse().ok().filter(|level: &f64| level.is_finite());
                Data::Level(
                    level.ok_or_else(|| format!("expected level=METRES, a number, found '{metres}'"))?,
                )
            }
            None if data.is_empty() => return Err(form()),
            None => Data::Files(vec![data.into()]),
        };
        Ok(Self { name: name.to_owned(), what, data })
    }
}

/// Finds the files of patterns: each makes a series of its layer.
///
/// # Errors
/// When nothing matches, or the layer is not water.
fn expand(layer: &LayerArg) -> Result<LayerArg, String> {
    let pattern = match &layer.data {
        Data::Files(files) => files.iter().find(|file| series_args::is_pattern(file)),
        _ => None,
    };
    let Some(pattern) = pattern else { return Ok(layer.clone()) };
    let (name, pattern) = (&layer.name, pattern.to_string_lossy());
    if layer.what != What::Surface(Kind::Water) {
        return Err(format!(
            "--layer {name}: expected a file, found the pattern {pattern}: patterns are for water that changes with time; \
             name each file of {} with a --layer of its own",
            layer.what.word()
        ));
    }
    let files = series_args::files(&pattern).map_err(|error| format!("--layer {name}: {error}"))?;
    if series_args::step_name(name, files.len()).len() > NAME_LENGTH_MAX {
        return Err(format!(
            "--layer {name}: expected a shorter name, since steps are called NAME.0, NAME.1, ..., with {NAME_LENGTH_MAX} \
             characters at most"
        ));
    }
    Ok(LayerArg { data: Data::Steps(files), ..layer.clone() })
}

/// What to say of series whose files lack numbers.
pub(super) fn gaps(layers: &[LayerArg]) -> Vec<String> {
    let told = layers.iter().filter_map(|layer| match &layer.data {
        Data::Steps(files) => series_args::gap(files).map(|words| format!("--layer {}: {words}", layer.name)),
        _ => None,
    });
    told.collect()
}

/// Puts together what belongs to one layer: first the files without a name, then the others in the order in which they are
/// named.
///
/// # Errors
/// When one layer is said to be two things, a pattern matches nothing, or there is no terrain.
pub(super) fn join(files: &[PathBuf], named: &[LayerArg]) -> Result<Vec<LayerArg>, String> {
    let mut layers: Vec<LayerArg> = Vec::new();
    if !files.is_empty() {
        let data = Data::Files(files.to_vec());
        layers.push(LayerArg { name: TERRAIN.to_owned(), what: What::Surface(Kind::Terrain), data });
    }
    for more in named {
        let more = expand(more)?;
        let Some(layer) = layers.iter_mut().find(|layer| layer.name == more.name) else {
            layers.push(more);
            continue;
        };
        if layer.what != more.what {
            let whence =
                if files.is_empty() || more.name != TERRAIN { "" } else { " (as files without --layer are)" };
            return Err(format!(
                "--layer: '{}' is {}{whence} and {}: give one of both another name",
                more.name,
                layer.what.word(),
                more.what.word()
            ));
        }
        match (&mut layer.data, &more.data) {
            (Data::Files(all), Data::Files(files)) => all.extend_from_slice(files),
            (Data::Steps(_), _) | (_, Data::Steps(_)) => {
                return Err(format!(
                    "--layer: '{}' is a series and something else besides: give one of both another name, or say one \
                     pattern for all its files",
                    more.name
                ));
            }
            _ => {
                return Err(format!(
                    "--layer: '{}' has a level and something else besides: give one of both another name",
                    more.name
                ));
            }
        }
    }
    if !layers.iter().any(|layer| layer.what == What::Surface(Kind::Terrain)) {
        let found: Vec<&str> = layers.iter().map(|layer| layer.what.word()).collect();
        return Err(format!(
            "expected terrain, found {} alone: name a DEM of the ground, too",
            found.join(", ")
        ));
    }
    Ok(layers)
}

pub(super) fn word(kind: Kind) -> &'static str {
    match kind {
        Kind::Terrain => "terrain",
        Kind::Water => "water",
    }
}

/// The opened sources of layers, and pictures of textures.
pub(super) struct Layers {
    opened: Vec<Opened>,
    textures: Vec<(LayerArg, Imagery)>,
    series: Vec<Series>,
}

/// A layer with its source.
struct Opened {
    name: String,
    kind: Kind,
    files: Vec<PathBuf>,
    source: Source,
}

/// Why layers cannot be opened.
#[derive(Debug, thiserror::Error)]
pub(super) enum OpenError {
    /// A file cannot be read, or does not fit.
    #[error(transparent)]
    Ingest(#[from] IngestError),
    /// The steps of a series are not of one surface.
    #[error("--layer {series}: {what}")]
    Steps {
        /// The series.
        series: String,
        /// What is wrong.
        what: String,
    },
}

/// Each step of a series as a layer by itself; of other layers the layer.
fn steps_of(layer: &LayerArg) -> Vec<LayerArg> {
    let Data::Steps(files) = &layer.data else { return vec![layer.clone()] };
    let step = |(step, file): (usize, &PathBuf)| LayerArg {
        name: series_args::step_name(&layer.name, step),
        what: layer.what,
        data: Data::Files(vec![file.clone()]),
    };
    files.iter().enumerate().map(step).collect()
}

impl Layers {
    /// Opens the files of all layers. The first with files decides the frame. Flat water gets 2^`cells_log2` cells along each
    /// side, and series steps of `step_seconds`.
    ///
    /// # Errors
    /// As [`ingest::open`] and [`ingest::open_over`], and when the steps of a series lie elsewhere than its first.
    pub(super) fn open(
        layers: Vec<LayerArg>,
        options: &ingest::Options,
        cells_log2: u8,
        step_seconds: f64,
    ) -> Result<Self, OpenError> {
        let (surfaces, pictures): (Vec<_>, Vec<_>) =
            layers.into_iter().partition(|layer| layer.what != What::Texture);
        let is_series = |layer: &&LayerArg| matches!(layer.data, Data::Steps(_));
        let series = |layer: &LayerArg| Series {
            name: layer.name.clone(),
            layers: steps_of(layer).into_iter().map(|step| step.name).collect(),
            step_seconds,
        };
        let series: Vec<Series> = surfaces.iter().filter(is_series).map(series).collect();
        let surfaces: Vec<LayerArg> = surfaces.iter().flat_map(steps_of).collect();
        let mut sources: Vec<Option<Source>> = Vec::with_capacity(surfaces.len());
        for layer in &surfaces {
            let Data::Files(files) = &layer.data else {
                sources.push(None);
                continue;
            };
            let first = sources.iter().flatten().next();
            sources.push(Some(match first {
                None => ingest::open(files, options)?,
                Some(first) => ingest::open_over(files, options, first)?,
            }));
        }
        let ground = surfaces.iter().position(|layer| layer.what == What::Surface(Kind::Terrain));
        for (number, layer) in surfaces.iter().enumerate() {
            let ground = ground.and_then(|number| sources[number].as_ref());
            let (Data::Level(metres), Some(ground)) = (&layer.data, ground) else { continue };
            let level = ingest::level(*metres, cells_log2, ground)?;
            sources[number] = Some(level);
        }
        let mut textures = Vec::with_capacity(pictures.len());
        let first = sources.iter().flatten().next();
        for (texture, first) in pictures.into_iter().zip(std::iter::repeat(first)) {
            if let (Data::Files(files), Some(first)) = (&texture.data, first) {
                let imagery = Imagery::open(files, options, first)?;
                textures.push((texture, imagery));
            }
        }
        let opened = surfaces.into_iter().zip(sources).filter_map(|(layer, source)| {
            let What::Surface(kind) = layer.what else { return None };
            let files = if let Data::Files(files) = layer.data { files } else { Vec::new() };
            Some(Opened { name: layer.name, kind, files, source: source? })
        });
        let layers = Self { opened: opened.collect(), textures, series };
        layers.series.iter().try_for_each(|series| layers.check(series))?;
        Ok(layers)
    }

    /// Refuses steps that are not of one surface.
    fn check(&self, series: &Series) -> Result<(), OpenError> {
        let mut steps = self.opened.iter().filter(|layer| series.layers.contains(&layer.name));
        let Some(first) = steps.next() else { return Ok(()) };
        for step in steps {
            if let Some(what) = series_args::differ([first, step].map(|of| (of.files.as_slice(), &of.source)))
            {
                return Err(OpenError::Steps { series: series.name.clone(), what });
            }
        }
        Ok(())
    }

    /// Which layers are the steps of which series.
    pub(super) fn series(&self) -> &[Series] {
        &self.series
    }

    /// What is to be built.
    pub(super) fn sources(&self) -> Vec<LayerSource<'_>> {
        let each = self.opened.iter();
        each.map(|Opened { name, kind, source, .. }| LayerSource { name, kind: *kind, source }).collect()
    }

    /// What is to be draped on it.
    pub(super) fn textures(&self) -> Vec<TextureSource<'_>> {
        let each = self.textures.iter();
        each.map(|(texture, imagery)| TextureSource { name: &texture.name, imagery }).collect()
    }

    /// The files of a layer; of the only one, if none is named.
    pub(super) fn files(&self, layer: Option<&str>) -> &[PathBuf] {
        let found = self.opened.iter().find(|of| layer.is_none_or(|name| of.name == name));
        found.map_or(&[], |of| &of.files)
    }

    /// Layers and textures that do not touch the first layer: they are shown far from it, which is seldom meant.
    pub(super) fn apart(&self) -> Vec<&str> {
        let Some(first) = self.opened.first() else { return Vec::new() };
        // All steps of a series lie where its first does.
        let is_later = |name: &String| self.series.iter().any(|series| series.layers[1..].contains(name));
        let surfaces = self.opened.iter().filter(|layer| !is_later(&layer.name));
        let surfaces = surfaces.map(|layer| (&layer.name, layer.source.grid()));
        let textures = self.textures.iter().map(|(texture, imagery)| (&texture.name, imagery.grid()));
        let far = surfaces.chain(textures).filter(|(_, grid)| !touch(first.source.grid(), grid));
        far.map(|(name, _)| name.as_str()).collect()
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
        let files = |names: &[&str]| Data::Files(names.iter().map(PathBuf::from).collect());
        let sea = LayerArg {
            name: "sea".to_owned(),
            what: What::Surface(Kind::Water),
            data: files(&["a=b:c.tif"]),
        };
        assert_eq!(arg("sea=water:a=b:c.tif"), sea);
        assert_eq!(arg("photo=texture:p.jpg").what, What::Texture);
        assert_eq!(arg("lake_2-b=water:level=-1.5").data, Data::Level(-1.5));
        assert_eq!(arg("lake=water:./level=3").data, files(&["./level=3"]));
        for (wrong, word) in [
            ("sea", "NAME=KIND:PATH"),
            ("sea=water", "NAME=KIND:PATH"),
            ("sea=water:", "NAME=KIND:PATH"),
            ("=water:a.tif", "1 to 64 small letters"),
            ("Sea=water:a.tif", "1 to 64 small letters"),
            ("zones=water:a.tif", "'zones'"),
            (&format!("{}=water:a.tif", "a".repeat(65)), "1 to 64 small letters"),
            ("sea=lava:a.tif", "terrain, water or texture, found 'lava'"),
            ("photo=texture:level=2", "level= is for water"),
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
            assert_eq!(layer.data, Data::Files(expected.map(PathBuf::from).to_vec()));
        }
        assert_eq!(joined(&[], &["ground=terrain:a.tif"]).unwrap().len(), 1);
        let folder = tempfile::tempdir().unwrap();
        let [w1, w2] = ["w_1.tif", "w_2.tif"].map(|name| folder.path().join(name));
        for file in [&w1, &w2] {
            std::fs::write(file, "").unwrap();
        }
        let pattern = folder.path().join("w_*.tif").display().to_string();
        let waves = format!("sea=water:{pattern}");
        let layers = joined(&some, &[&waves]).unwrap();
        assert_eq!((layers.len(), &layers[1].data), (2, &Data::Steps(vec![w1, w2])));
        let names: Vec<String> = steps_of(&layers[1]).into_iter().map(|step| step.name).collect();
        assert_eq!(names, ["sea.0", "sea.1"]);
        for (named, word) in [
            (&[&waves, "sea=water:s.tif"][..], "a series and something else besides"),
            (&[&waves, &waves], "a series and something else besides"),
            (&["sea=water:s.tif", &waves], "a series and something else besides"),
            (&["sea=water:none_*.tif"], "--layer sea: none_*.tif: expected files that match, found none"),
            (&[&format!("rock=terrain:{pattern}")], "patterns are for water"),
            (&[&format!("photo=texture:{pattern}")], "patterns are for water"),
            (&[&format!("{}=water:{pattern}", "a".repeat(63))], "a shorter name"),
        ] {
            let error = joined(&some, named).unwrap_err();
            assert!(error.contains(word), "{named:?}: {error}");
        }
        for (files, named, word) in [
            (&some[..], &["terrain=water:b.tif"][..], "as files without --layer are"),
            (&some, &["sea=water:a.tif", "sea=terrain:b.tif"], "'sea' is water and terrain"),
            (&some, &["sea=water:a.tif", "sea=water:level=0"], "a level and something else"),
            (&some, &["sea=water:level=1", "sea=water:level=0"], "a level and something else"),
            (&[], &["sea=water:a.tif", "photo=texture:p.png"], "found water, texture alone"),
            (
                &some,
                &["terrain=texture:p.png"],
                "'terrain' is terrain (as files without --layer are) and texture",
            ),
        ] {
            let error = joined(files, named).unwrap_err();
            assert!(error.contains(word), "{named:?}: {error}");
        }
    }
}
