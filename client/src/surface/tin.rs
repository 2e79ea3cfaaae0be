//! A split diamond as irregular triangles: the patch as the GPU takes it, with a normal at each vertex.
//!
//! **Normals without seams.** A patch knows nothing of what lies beyond the sides of its square, but its parents
//! do: each side is half of a diagonal of a parent's square, with the same vertices, and the parent's patch has
//! triangles on both sides of it. So a vertex on the square's border takes the normal that it has there, as long as
//! there is a parent; so does whatever else borders on it, and all agree.
//!
//! A vertex's normal is the sum of those of the triangles around it, each by the sine of its angle over the lengths of
//! its sides there: a sphere's vertices have exact ones, however their triangles lie (Max 1999).

use super::normal;
use diamantina_protocol::diamond::Diamond;
use diamantina_protocol::message::Layer;
use diamantina_protocol::tin::{self, DecodeError, Patch, Vertex};
use glam::DVec3;
use std::ops::Range;

/// A vertex as the GPU takes it.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Eq, bytemuck::Pod, bytemuck::Zeroable)]
pub struct Corner {
    /// Lattice steps east and north of the diamond's centre.
    pub place: [i32; 2],
    /// Height, in quanta.
    pub height: i32,
    /// The normal's east and north, times 32767.
    pub normal: [i16; 2],
}

/// A vertex on a diagonal of the square, which the children of the diamond have on their borders.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Shared {
    /// Lattice coordinates.
    place: [u32; 2],
    normal: [i16; 2],
}

/// The irregular triangles of a split diamond.
///
/// Takes 16 bytes a vertex, 6 a triangle and 12 a vertex on a diagonal: some 28 bytes a vertex in all.
#[derive(Debug, Clone, PartialEq)]
pub struct Tin {
    corners: Vec<Corner>,
    indices: Vec<u16>,
    sides: [Range<u32>; 4],
    /// In rising order of places.
    diagonals: Vec<Shared>,
}

impl Tin {
    /// Decodes a payload. `parents`: what is there of the surfaces of `d`'s parents, for the normals on the border
    /// alone. The bytes may be hostile.
    ///
    /// # Errors
    /// When the bytes are not `d`'s payload.
    pub fn decode(layer: &Layer, d: Diamond, parents: &[&Self], payload: &[u8]) -> Result<Self, DecodeError> {
        Ok(Self::new(layer, d, parents, &tin::decode(&layer.forest, d, payload)?))
    }

    /// The surface of a patch that a decoder returned.
    fn new(layer: &Layer, d: Diamond, parents: &[&Self], patch: &Patch) -> Self {
        let centre = d.centre();
        // From the square's centre to its sides, or, of an odd level, to its corners.
        let half = 1u32 << (layer.forest.root_log2() - 1 - d.level() / 2);
        let (mut corners, mut diagonals) = (Vec::with_capacity(patch.vertices.len()), Vec::new());
        for (vertex, slope) in patch.vertices.iter().zip(slopes(layer, patch)) {
            // Of magnitude 2^24 at most.
            let place = [0, 1].map(|i| [vertex.x, vertex.y][i].wrapping_sub(centre[i]).cast_signed());
            let [x, y] = place.map(i32::unsigned_abs);
            let (is_border, is_diagonal) = if d.level() % 2 == 1 {
                (x + y == half, x == 0 || y == 0)
            } else {
                (x == half || y == half, x == y)
            };
            let mut normal = normal(slope);
            let at = [vertex.x, vertex.y];
            if is_border {
                // Only the roots have no parents, and what is torn from their sides.
                normal = parents.iter().find_map(|parent| parent.diagonal(at)).unwrap_or(normal);
            }
            if is_diagonal {
                diagonals.push(Shared { place: at, normal });
            }
            corners.push(Corner { place, height: vertex.height, normal });
        }
        diagonals.sort_by_key(|shared| shared.place);
        // The decoder allows for no more vertices than indices of 16 bits name.
        let index = |v: &u32| u16::try_from(*v).unwrap_or(u16::MAX);
        let end = |child: usize| 3 * patch.ends[child];
        Self {
            corners,
            indices: patch.triangles.iter().flatten().map(index).collect(),
            sides: std::array::from_fn(|child| if child == 0 { 0 } else { end(child - 1) }..end(child)),
            diagonals,
        }
    }

    /// The normal at a lattice point on a diagonal of the square.
    fn diagonal(&self, place: [u32; 2]) -> Option<[i16; 2]> {
        let at = self.diagonals.partition_point(|shared| shared.place < place);
        self.diagonals.get(at).filter(|shared| shared.place == place).map(|shared| shared.normal)
    }

    /// The vertices.
    #[must_use]
    pub fn corners(&self) -> &[Corner] {
        &self.corners
    }

    /// Vertices of the triangles, three each: turning left, seen from above.
    #[must_use]
    pub fn indices(&self) -> &[u16] {
        &self.indices
    }

    /// Where the triangles over each side of the diamond lie in [`Tin::indices`].
    #[must_use]
    pub fn sides(&self) -> &[Range<u32>; 4] {
        &self.sides
    }

    /// How many triangles there are.
    #[must_use]
    pub fn triangles(&self) -> usize {
        self.indices.len() / 3
    }

    /// Bytes of memory that it takes, with what a cache notes of it.
    #[must_use]
    pub fn bytes(&self) -> usize {
        size_of_val(self.corners.as_slice())
            + size_of_val(self.indices.as_slice())
            + size_of_val(self.diagonals.as_slice())
            + size_of::<super::Surface>()
    }

    /// Bytes of memory that the triangles of a payload usually take at most: those of a vertex are some 28 here, and
    /// seldom less than one there. Real ground takes 9 to 16 bits a vertex.
    pub(super) fn expected_bytes(payload_bytes: u32) -> usize {
        28 * payload_bytes as usize + 256 + size_of::<super::Surface>()
    }
}

/// The slope at each vertex of a patch: metres up for a metre east, and for a metre north.
#[allow(clippy::cast_possible_truncation, reason = "slopes need no more than f32")]
fn slopes(layer: &Layer, patch: &Patch) -> Vec<[f32; 2]> {
    let position = |v: u32| {
        let Vertex { x, y, height } = patch.vertices[v as usize];
        DVec3::new(
            f64::from(x) * layer.cell[0],
            f64::from(y) * layer.cell[1],
            f64::from(height) * layer.quantum,
        )
    };
    let mut sums = vec![DVec3::ZERO; patch.vertices.len()];
    for triangle in &patch.triangles {
        let [a, b, c] = triangle.map(position);
        let sides = [b - a, c - b, a - c];
        let normal = sides[0].cross(sides[1]);
        let squares = sides.map(DVec3::length_squared);
        for (corner, v) in triangle.iter().enumerate() {
            sums[*v as usize] += normal / (squares[corner] * squares[(corner + 2) % 3]);
        }
    }
    let slope = |n: DVec3| if n.z > 0.0 { [(-n.x / n.z) as f32, (-n.y / n.z) as f32] } else { [0.0; 2] };
    sums.into_iter().map(slope).collect()
}
