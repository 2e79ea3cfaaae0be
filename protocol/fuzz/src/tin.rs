//! Patches of diamonds: any bytes decode to a patch or an error; and what decodes encodes to the same bytes.
//!
//! The first byte chooses the level, the second the diamond and the header, which is made to fit unless it says
//! otherwise (else few inputs would have a known format); the rest is the payload.

use diamantina_protocol::bintree::Forest;
use diamantina_protocol::diamond::Diamond;
use diamantina_protocol::tin::{self, FORMAT, TRIANGLES_MAX, VERTICES_MAX};

/// One input.
pub fn run(data: &[u8]) {
    let [choice, shape, rest @ ..] = data else { return };
    let patch_log2 = 2 + choice % 6;
    let forest = Forest::new(patch_log2 + 3, patch_log2, [2, 1]).expect("within the documented limits");
    let level = u32::from(choice >> 3) % forest.levels();
    let diamonds: Vec<Diamond> = forest.diamonds(level).collect();
    let d = diamonds[usize::from(*shape >> 3) % diamonds.len()];
    let mut payload = rest.to_vec();
    if shape & 1 == 0 {
        payload.insert(0, FORMAT << 4 | shape >> 5 & 4 | shape >> 1 & 3);
    }
    if let Ok(patch) = tin::decode(&forest, d, &payload) {
        assert!(patch.triangles.len() <= TRIANGLES_MAX && patch.vertices.len() <= VERTICES_MAX);
        assert_eq!(tin::encode(&forest, d, &patch), Ok(payload));
    }
}
