//! Triangulated irregular networks of diamonds, made from finer ones by *mark, merge, simplify*.
//!
//! A diamond's square is covered by the four triangles of its split, each with its own [`Tin`]. They are *merged* into
//! one mesh; the square's outer border is *marked*, so that it stays; the mesh is *simplified*, and cut along the
//! hypotenuse into the two triangles that the diamond is drawn as when it is not split. Each of these is one of the four
//! of one of its parents, and so on up to the roots. Vertices on a hypotenuse are the same in both halves, since they
//! were simplified as one; on the other sides nothing was changed: so no cut that follows the diamonds has a
//! crack. After Cignoni et al., *BDAM* (2003).
//!
//! Collapses never make a vertex: each is a sample of the source, with whole numbers for x, y and height.
//!
//! Where the source has no data there are no triangles. Its finest triangulation is that of its lattice, each cell cut
//! along the diagonal of the bintree, without the triangles that have a corner without data: their edges are the
//! source's border. A sample that belongs to no triangle (one alone, or in a thread of diagonal steps) is
//! drawn at no level, and errors do not count it.
//!
//! What is drawn never grows beyond that: borders move inward alone, along themselves. So holes never close, and islands
//! never vanish; where nodata tears so much that a payload has no room for all borders, the smallest triangles are left
//! out, and the error is the diamond's width.

mod collapse;
mod fan;
mod few;
mod ground;
mod mesh;
mod metric;
mod narrow;
mod patch;
mod square;
mod state;

pub use collapse::Until;
pub use ground::Ground;
pub use patch::{Border, Merged, Simplified, Tin, half_of, lattice, merge, simplify, source};

use diamantina_protocol::tin::Vertex;
use serde::{Deserialize, Serialize};

/// The order of collapses.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Metric {
    /// By how much normals change.
    Normal,
    /// By squared distances to planes.
    Quadric,
}

/// Metres of the lattice's units.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Scale {
    /// Of a step along x and y.
    pub cell: [f64; 2],
    /// Of a quantum of height.
    pub quantum: f64,
}

/// How meshes are simplified.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Rules {
    /// The order of collapses.
    pub metric: Metric,
    /// How much borders along nodata count in it.
    pub lambda: f64,
    /// Metres of the lattice's units.
    pub scale: Scale,
    /// Triangles of each half of a diamond that are not exceeded for the sake of an error.
    pub triangles_max: usize,
    /// Vertices of each half, likewise.
    pub vertices_max: usize,
}

#[cfg(test)]
mod tests;
