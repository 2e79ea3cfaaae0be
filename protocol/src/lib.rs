//! What the Diamantina server and client share: geometry, encodings, messages.
//!
//! This crate is pure: no I/O, no async, no clock, no thread, no GPU. It builds for wasm32.
//!
//! | module | what it holds |
//! |---|---|
//! | [`bintree`] | addresses of right triangles and the forest of squares that they bisect |
//! | [`diamond`] | pairs of triangles that split together; the local grid of a diamond |
//! | [`bitree`] | a set of points, real and fictitious, and the one triangulation it implies |
//! | [`points`] | the progressive points of a diamond ⇄ bytes |
//! | [`tin`] | the irregular triangles of a diamond ⇄ bytes |
//! | [`rans`] | the entropy coder under both |
//! | [`index`] | pages of errors, heights and sizes, from which a client knows the cut |
//! | `projection` | longitude and latitude ⇄ the coordinates of a reference system (where the feature of this name is on) |
//! | [`sight`] | how large an error of heights looks |
//! | [`message`] | routes, catalogue, batch frames |
//! | [`series`] | a surface at several times, of which each is a layer |
//! | [`texture`] | imagery: a pyramid of tiles, and which of them there are |
//! | [`zone`] | regions where the viewer stays, and how much of each diamond is seen from there |
//! | [`wire`] | the one place that knows the serialisation crate |
//! | [`arguments`] | command lines, as both programs read them |
//!
//! **Units and axes, which both ends obey.** Lattice coordinates are integers: x counts samples to the
//! east, y to the north, both from the south-west corner of the forest. Heights are integers too,
//! multiples of the layer's quantum, at most [`HEIGHT_MAX`] in magnitude, so that every deduced height
//! is the same on every platform. Metres appear only in [`message`] and beyond.

pub mod arguments;
pub mod bintree;
pub mod bitree;
pub mod diamond;
pub mod index;
pub mod message;
pub mod points;
#[cfg(feature = "projection")]
pub mod projection;
pub mod rans;
pub mod series;
pub mod sight;
pub mod texture;
pub mod tin;
pub mod wire;
pub mod zone;

/// The height of a point that has none.
pub const NODATA: i32 = i32::MIN;

/// The largest magnitude of a height, in quanta: 24 bits, which `f32` holds exactly and whose
/// 40-fold (the largest weight sum of a prediction) fits in `i32`.
pub const HEIGHT_MAX: i32 = (1 << 24) - 1;
