//! Textures: that each has the tiles that its coverage tells of, no others, and that they are pictures.

use super::InspectError;
use crate::store::{Key, Kind, Store};
use diamantina_protocol::texture::{Coverage, SIDE, Texture, Tile, coverage_bytes};
use rayon::prelude::*;
use std::collections::HashSet;

/// Compares the blobs of the `number`th texture with its coverage and, with `verify`, decodes each tile.
pub(super) fn inspect(
    store: &Store,
    number: u8,
    texture: &Texture,
    verify: bool,
) -> Result<(), InspectError> {
    let wrong = |what: String| InspectError::Texture { texture: texture.name.clone(), what };
    texture.check().map_err(wrong)?;
    let page =
        store.get(Key::coverage(number))?.ok_or_else(|| wrong("its coverage is missing".to_owned()))?;
    let bytes = zstd::bulk::decompress(&page, coverage_bytes(texture))
        .map_err(|e| wrong(format!("its coverage does not decompress ({e})")))?;
    let coverage = Coverage::decode(texture, &bytes).map_err(|e| wrong(e.to_string()))?;
    let of_it = |key: &Key| key.layer == number && key.kind == Kind::Texture;
    let mut stored: HashSet<Key> = store.keys().map(|(key, _)| key).filter(of_it).collect();
    let tiles: Vec<Tile> = coverage.tiles().collect();
    if let Some(missing) = tiles.iter().find(|tile| !stored.remove(&Key::tile(number, **tile))) {
        return Err(wrong(format!("{missing:?} is missing")));
    }
    if !stored.is_empty() {
        return Err(wrong(format!("{} tiles are not in its coverage", stored.len())));
    }
    if verify {
        tiles.par_iter().try_for_each(|tile| {
            let blob =
                store.get(Key::tile(number, *tile))?.ok_or_else(|| wrong(format!("{tile:?} is missing")))?;
            let picture = webp::Decoder::new(&blob).decode();
            let is_whole = picture.is_some_and(|picture| [picture.width(), picture.height()] == [SIDE; 2]);
            if is_whole {
                Ok(())
            } else {
                Err(wrong(format!("{tile:?} is no picture of {SIDE} x {SIDE} texels")))
            }
        })?;
    }
    Ok(())
}
