//! The triangles of a layer in numbers; and, on request, whether each payload decodes and all borders fit.
//!
//! Two triangles of the bintree that a cut may draw side by side share a hypotenuse, or one's leg is the other's
//! hypotenuse. So a store's cuts have no cracks if, for each diamond, its two triangles have the same edges
//! along its hypotenuse, in both parents' payloads; and each of its sides the same as the parents have there, whose
//! legs these are. Where only one of both has triangles beside a line, the other has nodata there, and nothing to fit.

use super::{InspectError, read_page};
use crate::store::{Key, Kind, Store};
use diamantina_protocol::bintree::Forest;
use diamantina_protocol::diamond::Diamond;
use diamantina_protocol::index::{self, Entry};
use diamantina_protocol::message::{Layer, TinLayer};
use diamantina_protocol::tin::{self, Patch, Vertex};
use rayon::prelude::*;
use serde::Serialize;
use std::collections::HashMap;

/// The triangles of a layer in numbers.
#[derive(Debug, Clone, Serialize)]
pub struct TinInspection {
    /// Triangles of all payloads.
    pub triangles: u64,
    /// Bytes of all payloads.
    pub bytes: u64,
    /// Bytes of the index.
    pub index_bytes: u64,
    /// Bits of payload a triangle.
    pub bits_per_triangle: f64,
    /// By level of diamonds.
    pub levels: Vec<TinLevel>,
    /// The largest error, in metres, where every diamond is split.
    pub finest_error: f32,
    /// How errors were found.
    pub errors: String,
    /// What cuts draw, if the blobs were verified.
    pub cuts: Vec<TinCut>,
}

/// The coarsest cut that keeps an error everywhere.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct TinCut {
    /// The error, in metres.
    pub error: f64,
    /// The triangles that it draws.
    pub triangles: u64,
    /// The diamonds that it splits.
    pub diamonds: u64,
}

/// The diamonds of a level in numbers.
#[derive(Debug, Clone, Default, Serialize)]
pub struct TinLevel {
    /// The level.
    pub level: u32,
    /// Diamonds with some triangle below them.
    pub diamonds: u64,
    /// Triangles that are drawn where they are split, if the blobs were verified.
    pub triangles: Option<u64>,
    /// Bytes of their payloads.
    pub bytes: u64,
    /// The least declared error, in metres.
    pub error_min: f32,
    /// The largest declared error, in metres.
    pub error_max: f32,
    /// The largest distance of borders along nodata from the source's, in metres, where they are not split.
    pub apart_max: f32,
}

/// All that is needed to read the triangles of a layer.
struct Reader<'a> {
    store: &'a Store,
    number: u8,
    layer: &'a Layer,
    tin: &'a TinLayer,
    entries: HashMap<Diamond, Entry>,
}

/// Reads the index of a layer's triangles and, with `verify`, every payload.
///
/// # Errors
/// At the first thing that is wrong.
pub(super) fn inspect(
    store: &Store,
    number: u8,
    layer: &Layer,
    tin: &TinLayer,
    verify: bool,
) -> Result<TinInspection, InspectError> {
    let mut entries = HashMap::new();
    for page in 0..index::pages(&tin.forest) {
        entries.extend(read_page(store, number, layer, Kind::TinIndex, page)?);
    }
    let reader = Reader { store, number, layer, tin, entries };
    let index_bytes = reader.sizes()?;
    let mut levels: Vec<TinLevel> = (0..tin.forest.levels())
        .map(|level| TinLevel { level, error_min: f32::MAX, ..TinLevel::default() })
        .collect();
    for (d, e) in reader.entries.iter().filter(|(_, e)| !e.is_empty()) {
        let level = &mut levels[d.level() as usize];
        level.diamonds += 1;
        level.bytes += u64::from(e.bytes);
        level.error_min = level.error_min.min(e.error_metres);
        level.error_max = level.error_max.max(e.error_metres);
    }
    let mut ends = HashMap::new();
    for (i, level) in levels.iter_mut().enumerate() {
        level.apart_max = tin.borders.get(i).copied().unwrap_or(0.0);
        if level.diamonds == 0 {
            level.error_min = 0.0;
        }
        if verify {
            let verified = reader.verify(level.level)?;
            level.triangles = Some(verified.iter().map(|(_, ends)| u64::from(ends[3])).sum());
            ends.extend(verified);
        }
    }
    let largest = reader.entries.values().map(|e| f64::from(e.error_metres)).fold(0.0, f64::max);
    let round = (-3..7).flat_map(|ten| [1.0, 2.0, 3.0, 5.0].map(|digit| digit * 10f64.powi(ten)));
    let asked = round.filter(|e| verify && *e >= f64::from(tin.finest_error) && *e < largest);
    let cuts = asked.map(|error| reader.cut(&ends, error)).collect();
    let bytes = levels.iter().map(|l| l.bytes).sum();
    Ok(TinInspection {
        triangles: tin.triangles,
        bytes,
        index_bytes,
        bits_per_triangle: bytes as f64 * 8.0 / tin.triangles.max(1) as f64,
        levels,
        finest_error: tin.finest_error,
        errors: tin.errors.clone(),
        cuts,
    })
}

impl Reader<'_> {
    /// Compares the sizes of payloads with the index; the bytes of its pages.
    fn sizes(&self) -> Result<u64, InspectError> {
        let (mut index_bytes, mut strays) = (0, 0);
        for (key, found) in self.store.keys().filter(|(key, _)| key.layer == self.number) {
            match key.kind {
                Kind::TinIndex => index_bytes += u64::from(found),
                Kind::Tin => {
                    let centre = [key.a, key.b];
                    let known = self.tin.forest.diamond(centre).and_then(|d| self.entries.get(&d));
                    match known {
                        Some(e) if e.bytes == found => {}
                        Some(e) => {
                            let (layer, expected) = (self.layer.name.clone(), e.bytes);
                            return Err(InspectError::Size { layer, centre, found, expected });
                        }
                        None => strays += 1,
                    }
                }
                Kind::Index | Kind::Points | Kind::Zone | Kind::Texture | Kind::TextureIndex => {}
            }
        }
        if strays > 0 {
            return Err(InspectError::Strays { layer: self.layer.name.clone(), count: strays });
        }
        Ok(index_bytes)
    }

    /// The patch of a diamond.
    fn patch(&self, d: Diamond) -> Result<Patch, InspectError> {
        let [a, b] = d.centre();
        let (layer, centre) = (|| self.layer.name.clone(), [a, b]);
        let payload = self.store.get(Key { layer: self.number, kind: Kind::Tin, a, b })?;
        if payload.is_none() && self.entries.get(&d).is_some_and(|e| e.bytes > 0) {
            return Err(InspectError::NoPoints { layer: layer(), centre });
        }
        tin::decode(&self.tin.forest, d, &payload.unwrap_or_default())
            .map_err(|error| InspectError::Triangles { layer: layer(), centre, error })
    }

    /// The coarsest cut that keeps an error: errors never rise where a diamond splits.
    fn cut(&self, ends: &HashMap<Diamond, [u32; 4]>, error: f64) -> TinCut {
        let forest = &self.tin.forest;
        let splits = |d: Diamond| {
            let declared = self.entries.get(&d).map_or(0.0, |e| f64::from(e.error_metres));
            d.level() == 0 || declared > error
        };
        let mut cut = TinCut { error, triangles: 0, diamonds: 0 };
        for (d, ends) in ends.iter().filter(|(d, _)| splits(**d)) {
            cut.diamonds += 1;
            let mut from = 0;
            for (child, end) in forest.children(*d).into_iter().zip(ends) {
                if child.is_none_or(|c| !splits(c)) {
                    cut.triangles += u64::from(end - from);
                }
                from = *end;
            }
        }
        cut
    }

    /// Decodes all payloads of a level and compares them with those that share a line with them; where the triangles
    /// of each diamond's children end.
    fn verify(&self, level: u32) -> Result<Vec<(Diamond, [u32; 4])>, InspectError> {
        let forest = &self.tin.forest;
        let diamonds: Vec<Diamond> = forest.diamonds(level).collect();
        let of_diamond = |d: &Diamond| {
            let patch = self.patch(*d)?;
            let fits = |line: [[u32; 2]; 2], other: &Patch| {
                let fit = fits(&along(&patch, line), &along(other, line));
                let (layer, centre) = (self.layer.name.clone(), d.centre());
                if fit { Ok(()) } else { Err(InspectError::Crack { layer, centre, line }) }
            };
            let corners = corners(forest, *d);
            for (side, child) in forest.children(*d).into_iter().enumerate() {
                let Some(child) = child else { continue };
                let split = self.patch(child)?;
                // The child's triangle here has two legs: lines from the centre to the ends of the side.
                for corner in [corners[side], corners[(side + 1) % 4]].into_iter().flatten() {
                    fits([d.centre(), corner], &split)?;
                }
                for parent in forest.parents(child).filter(|p| p != d) {
                    if let [Some(from), Some(to)] = [corners[side], corners[(side + 1) % 4]] {
                        fits([from, to], &self.patch(parent)?)?;
                    }
                }
            }
            Ok((*d, patch.ends))
        };
        diamonds.par_iter().map(of_diamond).collect()
    }
}

/// The corners of a diamond, in the order of its sides; the last may lie outside of the forest.
fn corners(forest: &Forest, d: Diamond) -> [Option<[u32; 2]>; 4] {
    let local = forest.local(d);
    let n = i64::try_from(forest.segments_at(d.level())).unwrap_or(0);
    [[0, 0], [1, 0], [1, 1], [0, 1]].map(|[u, v]: [i64; 2]| {
        let [x, y] = local.lattice2([2 * n * u, 2 * n * v]);
        Some([u32::try_from(x).ok()?, u32::try_from(y).ok()?]).filter(|corner| forest.contains(*corner))
    })
}

/// An edge on a line: how far its ends are along it, and their heights.
type Edge = [(i64, i32); 2];

/// The edges of a patch's triangles that lie on a line, from its beginning on, each once.
fn along(patch: &Patch, [from, to]: [[u32; 2]; 2]) -> Vec<Edge> {
    let step = |a: u32, b: u32| i64::from(b) - i64::from(a);
    let line = [step(from[0], to[0]), step(from[1], to[1])];
    let place = |v: &Vertex| {
        let way = [step(from[0], v.x), step(from[1], v.y)];
        let (along, beside) = (line[0] * way[0] + line[1] * way[1], line[0] * way[1] - line[1] * way[0]);
        let length2 = line[0] * line[0] + line[1] * line[1];
        (beside == 0 && (0..=length2).contains(&along)).then_some((along, v.height))
    };
    let places: Vec<Option<(i64, i32)>> = patch.vertices.iter().map(place).collect();
    let mut edges: Vec<Edge> = Vec::new();
    for t in &patch.triangles {
        for i in 0..3 {
            let ends = [t[i], t[(i + 1) % 3]].map(|v| places[v as usize]);
            if let [Some(a), Some(b)] = ends {
                edges.push([a.min(b), a.max(b)]);
            }
        }
    }
    edges.sort_unstable();
    edges.dedup();
    edges
}

/// Whether edges on one line that overlap are the same, ends and heights.
fn fits(here: &[Edge], there: &[Edge]) -> bool {
    let (mut i, mut j) = (0, 0);
    while let (Some(a), Some(b)) = (here.get(i), there.get(j)) {
        if a == b {
            (i, j) = (i + 1, j + 1);
        } else if a[1].0 <= b[0].0 {
            i += 1;
        } else if b[1].0 <= a[0].0 {
            j += 1;
        } else {
            return false;
        }
    }
    true
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn edges_fit_that_are_the_same_or_apart() {
        let edge = |a: i64, b: i64| [(a, 7), (b, 7)];
        let line = [edge(0, 4), edge(4, 6), edge(8, 9)];
        assert!(fits(&line, &line));
        assert!(fits(&line, &[]));
        assert!(fits(&line, &[edge(6, 8)]), "the one has nodata where the other has none");
        assert!(fits(&line, &[edge(4, 6), edge(6, 8)]));
        assert!(!fits(&line, &[edge(0, 2), edge(2, 4)]), "a vertex that the other has not");
        assert!(!fits(&line, &[edge(5, 6)]));
        assert!(!fits(&line, &[[(4, 7), (6, 8)]]), "another height");
    }
}
