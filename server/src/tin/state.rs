//! What is known of a vertex, and short numbers that err to the safe side.

use super::square::Role;

/// What has happened around a vertex of the source's mesh.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Around {
    /// Nothing has gone.
    Whole,
    /// Something has; what the vertex needs is still what it needed before.
    Thinned,
    /// Something has, and that has been seen.
    Changed,
}

/// What is known of a vertex as long as nothing changes around it.
#[derive(Debug, Clone, Copy)]
pub(super) struct State {
    /// How important it is.
    pub(super) key: f32,
    /// Whether nothing is lost with it.
    pub(super) flat: bool,
    /// Whether both are known.
    pub(super) is_known: bool,
    pub(super) role: Role,
    pub(super) around: Around,
}

impl State {
    /// Of a vertex that nothing is known of but where it lies.
    pub(super) fn new(role: Role) -> Self {
        Self { key: 0.0, flat: false, is_known: false, role, around: Around::Whole }
    }

    /// Numbers that sort as the keys do, none of which is negative, and of equal keys as the vertices: so that the order
    /// is the same on every run.
    pub(super) fn rank(&self, v: u32) -> u64 {
        u64::from(self.key.to_bits()) << 32 | u64::from(v)
    }
}

/// The vertex of a rank.
#[allow(clippy::cast_possible_truncation, reason = "the vertex is the lower half")]
pub(super) fn vertex(rank: u64) -> u32 {
    rank as u32
}

/// The least short number that is no less.
#[allow(clippy::cast_possible_truncation, reason = "rounded, and then made larger where that was to smaller")]
pub(super) fn at_least(value: f64) -> f32 {
    let short = value as f32;
    if f64::from(short) < value { short.next_up() } else { short }
}

/// A number that is not negative, without the last bits: so that what is equal but for rounding is equal, and goes in the
/// order of its places.
#[allow(clippy::cast_possible_truncation, reason = "an order need not be precise")]
pub(super) fn rounded(value: f64) -> f32 {
    f32::from_bits(((value as f32).to_bits() + 0x80) & !0xff)
}

/// The upper half of a number that is not negative: as much or a little less.
#[allow(clippy::cast_possible_truncation, reason = "the upper half")]
pub(super) fn shortened(value: f32) -> u16 {
    (value.to_bits() >> 16) as u16
}

/// What [`shortened`] made.
pub(super) fn unshortened(short: u16) -> f32 {
    f32::from_bits(u32::from(short) << 16)
}

/// The largest short number that is no more.
#[allow(clippy::cast_possible_truncation, reason = "rounded, and then made smaller where that was to larger")]
pub(super) fn at_most(value: f64) -> f32 {
    let short = value as f32;
    if f64::from(short) > value { short.next_down() } else { short }
}

/// The next smaller number that is short.
#[allow(clippy::cast_possible_truncation, reason = "rounded, and then made smaller")]
pub(super) fn below(value: f64) -> f32 {
    (value as f32).next_down()
}
