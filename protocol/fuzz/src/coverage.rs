//! Coverages of textures: any bytes are one or an error, each tile has its parent, and the bytes are those that came.

use diamantina_protocol::texture::{Coverage, Texture};

/// One input: the image's width and height, then the coverage.
pub fn run(data: &[u8]) {
    let [a, b, c, d, bytes @ ..] = data else { return };
    let side = |low: u8, high: u8| u32::from(u16::from_le_bytes([low, high])) + 1;
    let texture = Texture {
        name: "photo".to_owned(),
        origin: [0.0; 2],
        texel: [1.0; 2],
        size: [side(*a, *b), side(*c, *d)],
        format: "webp".to_owned(),
        quality: 80,
        tiles: 0,
        bytes: 0,
        resampled: false,
    };
    texture.check().expect("of a size within the limits");
    let Ok(coverage) = Coverage::decode(&texture, bytes) else { return };
    assert_eq!(coverage.bytes(), bytes);
    for tile in coverage.tiles() {
        assert!(texture.holds(tile) && tile.parent().is_none_or(|parent| coverage.has(parent)));
    }
}
