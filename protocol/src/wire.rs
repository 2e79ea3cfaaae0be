//! The one place that knows the serialisation crate.
//!
//! Our own types ([`crate::index`], [`crate::message`]) go through here. Numbers are little-endian
//! varints of at most ten bytes. The crate below is complete but no longer maintained, so nothing else
//! may name it; to replace it, replace this file and raise the formats of what goes through it.

pub(crate) use bincode::{Decode, Encode};

use bincode::config::{Configuration, Limit, LittleEndian, Varint};

/// Why bytes are not the value that was asked for.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum WireError {
    /// The bytes end early, claim more than they may, or hold an impossible value.
    #[error("message is damaged ({0}): fetch it again")]
    Damaged(String),
    /// Something follows the value.
    #[error("message has {0} bytes too many: fetch it again")]
    Trailing(usize),
}

const fn limited<const BYTES: usize>() -> Configuration<LittleEndian, Varint, Limit<BYTES>> {
    bincode::config::standard().with_limit::<BYTES>()
}

/// The bytes of a value.
#[must_use]
pub(crate) fn to_bytes<T: bincode::Encode>(value: &T) -> Vec<u8> {
    // Writing to memory fails only for types that our messages do not use.
    bincode::encode_to_vec(value, bincode::config::standard()).unwrap_or_default()
}

/// The value in front of `bytes`, which may be hostile, and how many bytes it took. Never allocates
/// more than `LIMIT` bytes.
///
/// # Errors
/// When the bytes do not start with such a value.
pub(crate) fn from_prefix<const LIMIT: usize, T: bincode::Decode<()>>(
    bytes: &[u8],
) -> Result<(T, usize), WireError> {
    bincode::decode_from_slice(bytes, limited::<LIMIT>()).map_err(|e| WireError::Damaged(e.to_string()))
}

/// The value that takes all of `bytes`.
///
/// # Errors
/// As [`from_prefix`], and when something follows.
pub(crate) fn from_bytes<const LIMIT: usize, T: bincode::Decode<()>>(bytes: &[u8]) -> Result<T, WireError> {
    match from_prefix::<LIMIT, T>(bytes)? {
        (value, used) if used == bytes.len() => Ok(value),
        (_, used) => Err(WireError::Trailing(bytes.len() - used)),
    }
}
