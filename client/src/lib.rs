//! Draws streamed terrain.
//!
//! | module | what it holds |
//! |---|---|
//! | [`camera`] | the eye; how large a metre looks |
//! | [`sight`] | how large an error looks: metres and a box → pixels |
//! | [`cut`] | camera and resident diamonds → what to draw and what to ask for |
//! | [`background`] | work beside the frames: on threads, or between frames in a browser |
//! | [`disk`] | what was fetched, kept for the next session; not in a browser |
//! | [`fetch`] | requests by priority, retried, cancellable; answers as they stream in |
//! | [`cache`] | decoded diamonds under a byte budget |
//! | [`encoding`] | points or irregular triangles: which of them is streamed |
//! | [`surface`] | a decoded diamond: points with heights and normals, or triangles with normals |
//! | [`morph`] | how what is drawn moves from one cut to the next |
//! | [`controls`] | moving the eye as people know it from maps and globes |
//! | [`pick`] | what of the drawn terrain is under the cursor |
//! | [`terrain`] | one frame of streaming: cut, fetch, decode, cache |
//! | [`drawing`] | what a frame draws, as plain data |
//! | [`render`] | drawing + camera → pixels; the only module that knows the GPU |
//! | [`globe`] | where the frame lies on the globe: longitudes, true north, true lengths |
//! | [`annotate`] | scale bar, north arrow and legend over a picture |
//! | [`picture`] | pixels → PNG |
//! | [`player`] | the clock of series of water surfaces |
//! | [`overview`] | where a whole scene is seen from |
//! | [`headless`] | pictures and flights without a window |
//! | `load` | many users at once, to see what a server bears |
//! | [`doctor`] | what is wrong with a server as clients see it |
//! | [`viewer`] | the terrain with a panel and a mouse; in a window |
//! | `web` | the same on a page, in a browser |

pub mod annotate;
pub mod background;
pub mod cache;
pub mod camera;
pub mod controls;
pub mod cut;
#[cfg(not(target_arch = "wasm32"))]
pub mod disk;
#[cfg(target_arch = "wasm32")]
#[path = "disk/none.rs"]
pub mod disk;
#[cfg(not(target_arch = "wasm32"))]
pub mod doctor;
pub mod drawing;
pub mod encoding;
pub mod fetch;
pub mod globe;
#[cfg(not(target_arch = "wasm32"))]
pub mod headless;
#[cfg(not(target_arch = "wasm32"))]
pub mod load;
pub mod mirror;
pub mod morph;
pub mod overview;
pub mod pick;
pub mod picture;
pub mod player;
pub mod render;
pub mod sight;
pub mod surface;
pub mod terrain;
pub mod texture;
pub mod viewer;
#[cfg(target_arch = "wasm32")]
pub mod web;

#[cfg(test)]
#[allow(
    clippy::cast_possible_truncation,
    clippy::cast_possible_wrap,
    clippy::cast_sign_loss,
    reason = "small numbers"
)]
mod world;
