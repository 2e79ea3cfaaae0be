//! The geometry of a split diamond, as it is drawn: a grid of points, or irregular triangles.
//!
//! Shading follows the same rule as heights in both: a split changes only what lies strictly inside, so two
//! surfaces that meet along a side agree about its normals too, and light shows no seams.

mod points;
pub(crate) mod rim;
mod shade;
mod tin;
pub(crate) mod triangles;

pub use points::Points;
pub use tin::{Corner, Tin};

use crate::encoding::Encoding;
use diamantina_protocol::bintree::Forest;
use diamantina_protocol::diamond::Diamond;
use diamantina_protocol::message::Layer;
use diamantina_protocol::{points as points_format, tin as tin_format};

/// The upward normal of a surface with a slope (metres up for a metre east, and for a metre north): its east and
/// north, times 32767.
#[must_use]
#[allow(clippy::cast_possible_truncation, reason = "a float to integer cast saturates")]
pub fn normal([east, north]: [f32; 2]) -> [i16; 2] {
    let length = (1.0 + east * east + north * north).sqrt();
    // To the nearest; `round` is a call where the architecture has no instruction for it.
    [east, north].map(|s| -s / length * 32767.0).map(|s| (s + 0.5f32.copysign(s)) as i16)
}

/// Why a payload gives no surface.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum SurfaceError {
    /// Not points of the diamond.
    #[error(transparent)]
    Points(#[from] points_format::DecodeError),
    /// Not triangles of the diamond.
    #[error(transparent)]
    Tin(#[from] tin_format::DecodeError),
}

/// What is drawn of a split diamond.
#[derive(Debug, Clone, PartialEq)]
pub enum Surface {
    /// A grid of points.
    Points(Points),
    /// Irregular triangles.
    Tin(Tin),
}

impl Surface {
    /// Decodes what `d`'s split adds to what its parents have. `parents` are the surfaces of
    /// `forest.parents(d)`, in that order and of the same encoding. The bytes may be hostile.
    ///
    /// # Errors
    /// When the bytes are not `d`'s payload.
    pub fn split(
        encoding: Encoding,
        layer: &Layer,
        d: Diamond,
        parents: &[(Diamond, &Self)],
        payload: &[u8],
    ) -> Result<Self, SurfaceError> {
        match encoding {
            Encoding::Points => {
                let parents: Vec<_> = parents.iter().filter_map(|(p, s)| Some((*p, s.points()?))).collect();
                Ok(Self::Points(Points::split(layer, d, &parents, payload)?))
            }
            Encoding::Tin => {
                let parents: Vec<_> = parents.iter().filter_map(|(_, surface)| surface.tin()).collect();
                Ok(Self::Tin(Tin::decode(layer, d, &parents, payload)?))
            }
        }
    }

    /// The grid of points, if it is one.
    #[must_use]
    pub fn points(&self) -> Option<&Points> {
        if let Self::Points(points) = self { Some(points) } else { None }
    }

    /// The irregular triangles, if it has such.
    #[must_use]
    pub fn tin(&self) -> Option<&Tin> {
        if let Self::Tin(tin) = self { Some(tin) } else { None }
    }

    /// Bytes of memory that it takes, with what a cache notes of it, as a surface of `d`.
    #[must_use]
    pub fn bytes(&self, forest: &Forest, d: Diamond) -> usize {
        match self {
            Self::Points(_) => Points::bytes(forest, d.level()),
            Self::Tin(tin) => tin.bytes(),
        }
    }

    /// Bytes of GPU memory that it takes at most, motions aside; with `wires` also the lines around its triangles.
    #[must_use]
    pub fn gpu_bytes(&self, wires: bool) -> u64 {
        let (vertices, indices) = match self {
            Self::Points(points) => points.gpu_bytes(),
            Self::Tin(tin) => (size_of_val(tin.corners()), 2 * tin.indices().len() + 2),
        };
        (vertices + indices * if wires { 3 } else { 1 }) as u64
    }

    /// The same, before it is there, as is usual: where there are data all over it.
    #[must_use]
    pub fn expected_gpu_bytes(encoding: Encoding, forest: &Forest, level: u32, payload_bytes: u32) -> u64 {
        let bytes = match encoding {
            Encoding::Points => Points::expected_gpu_bytes(forest, level),
            Encoding::Tin => Tin::expected_bytes(payload_bytes),
        };
        bytes as u64
    }

    /// Bytes of memory that a diamond's surface will take, before it is there: exactly so for points; for irregular
    /// triangles as many as those of so long a payload usually take at most.
    #[must_use]
    pub fn expected_bytes(encoding: Encoding, forest: &Forest, level: u32, payload_bytes: u32) -> usize {
        match encoding {
            Encoding::Points => Points::bytes(forest, level),
            Encoding::Tin => Tin::expected_bytes(payload_bytes),
        }
    }
}
