//! Descriptions of scenes: any JSON is a catalogue, a scene or an error, and comes back as it was written.

use diamantina_protocol::message::{Catalogue, Scene};
use diamantina_protocol::texture::Coverage;

/// One input.
pub fn run(data: &[u8]) {
    let _ = serde_json::from_slice::<Catalogue>(data);
    let Ok(scene) = serde_json::from_slice::<Scene>(data) else { return };
    let json = serde_json::to_vec(&scene).expect("a scene is JSON");
    let again: Scene = serde_json::from_slice(&json).expect("what we wrote is a scene");
    assert_eq!(again, scene);
    // What a client asks of each layer at once.
    for layer in &scene.layers {
        let _ = layer.forest.levels();
        for d in layer.forest.root_diamonds().take(4) {
            let _ = layer.forest.bounds(d);
        }
        let _ = diamantina_protocol::index::pages(&layer.forest);
    }
    for texture in scene.textures.iter().filter(|texture| texture.check().is_ok()) {
        let _ = Coverage::empty(texture).tiles().count();
    }
}
