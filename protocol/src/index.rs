//! Pages of the index: what a client must know of diamonds before it has their geometry.
//!
//! The squares of a root form a quadtree; a page holds [`BAND`] depths of it below one square (the topmost
//! pages hold what remains above full ones: the many pages at the bottom are the full ones). The square
//! owns the diamond of its centre and those of its west and south sides (squares along the
//! forest's east and north borders own those sides too). So which diamonds a page holds, and in what
//! order, follows from its number alone, and a page is nothing but columns of values.
//!
//! A page, before compression, is the format number ([`FORMAT`]) and four columns: errors, lowest
//! heights, spans of height, payload bytes.
//!
//! Errors are *saturated*: a diamond's is at least its children's, and likewise for the heights' range.

use crate::bintree::Forest;
use crate::diamond::Diamond;
use crate::wire::{self, Decode, Encode, WireError};

/// Depths of the quadtree in a page: at most 341 squares, 1087 diamonds.
pub const BAND: u32 = 5;

/// The format that this build writes, and the only one that it reads.
pub const FORMAT: u32 = 1;

/// The largest page before compression, in bytes.
pub const PAGE_BYTES_MAX: usize = 64 << 10;

/// What the index says of a diamond.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Entry {
    /// The largest distance, in metres, between the source and the diamond drawn unsplit, and
    /// between the source and anything below it.
    pub error_metres: f32,
    /// The lowest and highest height below the diamond, source and drawn, in quanta. `low > high`
    /// where there is none.
    pub low: i32,
    /// See `low`.
    pub high: i32,
    /// Bytes of the payload; 0: the split adds no height (there may be some further below).
    pub bytes: u32,
}

impl Entry {
    /// A diamond without any height.
    pub const EMPTY: Self = Self { error_metres: 0.0, low: 0, high: -1, bytes: 0 };

    /// Whether nothing is ever drawn here.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.low > self.high
    }
}

/// The columns of a page.
#[derive(Encode, Decode)]
struct Columns {
    format: u32,
    errors: Vec<u16>,
    lows: Vec<i32>,
    spans: Vec<u32>,
    bytes: Vec<u32>,
}

/// Why bytes are not a page.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum PageError {
    /// The message is damaged.
    #[error("index page: {0}")]
    Wire(#[from] WireError),
    /// Written by another version.
    #[error("index page has format {found}, this build reads {FORMAT}: rebuild the store")]
    Format {
        /// The format found.
        found: u32,
    },
    /// No such page.
    #[error("index page {page} does not exist: the layer has {pages}")]
    Number {
        /// The page asked for.
        page: u32,
        /// Pages of the layer.
        pages: u32,
    },
    /// The columns do not fit the diamonds of the page.
    #[error("index page has columns of {found:?} values, expected {expected} each: fetch it again")]
    Count {
        /// Lengths found.
        found: [usize; 4],
        /// Diamonds of the page.
        expected: usize,
    },
    /// A value that no index holds.
    #[error("index page has an impossible entry for the diamond at {0:?}: fetch it again")]
    Entry([u32; 2]),
}

/// The least 16-bit number (sign-free, 8 bits of exponent, 8 of mantissa) at or above `metres`.
fn pack_error(metres: f32) -> u16 {
    if metres <= 0.0 {
        return 0;
    }
    let up = metres.to_bits().div_ceil(1 << 15);
    u16::try_from(up).unwrap_or(u16::MAX)
}

fn unpack_error(packed: u16) -> f32 {
    f32::from_bits(u32::from(packed) << 15)
}

/// The value that `metres` takes when written to a page: itself, or up to 1/256 more.
#[must_use]
pub fn declared(metres: f32) -> f32 {
    unpack_error(pack_error(metres))
}

/// Depths of a root's quadtree whose squares own diamonds.
fn depths(forest: &Forest) -> u32 {
    forest.levels().div_ceil(2)
}

/// Squares of a depth along x and y.
fn squares(forest: &Forest, depth: u32) -> [u32; 2] {
    forest.roots().map(|r| r << depth)
}

/// The bands of the quadtree, from the top: first depth and number of depths.
fn bands(forest: &Forest) -> impl Iterator<Item = (u32, u32)> + use<> {
    let depths = depths(forest);
    // At least one depth: a root square splits at least twice.
    let top = (depths - 1) % BAND + 1;
    std::iter::once((0, top)).chain((top..depths).step_by(BAND as usize).map(|first| (first, BAND)))
}

/// How many pages a layer's index has.
#[must_use]
pub fn pages(forest: &Forest) -> u32 {
    bands(forest).map(|(first, _)| squares(forest, first)).map(|[c, r]| c * r).sum()
}

/// The square that owns a diamond, with its depth.
fn owner(forest: &Forest, d: Diamond) -> (u32, [u32; 2]) {
    let depth = d.level() / 2;
    let [columns, rows] = squares(forest, depth);
    let [x, y] = d.centre();
    let shift = forest.root_log2() - depth;
    (depth, [(x >> shift).min(columns - 1), (y >> shift).min(rows - 1)])
}

/// The number of the page that holds a diamond.
#[must_use]
pub fn page_of(forest: &Forest, d: Diamond) -> u32 {
    let (depth, [i, j]) = owner(forest, d);
    let mut before = 0;
    for (first, count) in bands(forest) {
        let [columns, rows] = squares(forest, first);
        if depth < first + count {
            let up = depth - first;
            return before + (j >> up) * columns + (i >> up);
        }
        before += columns * rows;
    }
    before
}

/// The diamonds of a page, in its order: depth by depth, row by row; `None` for a page that is not.
#[must_use]
pub fn page_diamonds(forest: &Forest, page: u32) -> Option<Vec<Diamond>> {
    let mut before = 0;
    for (first, count) in bands(forest) {
        let [columns, rows] = squares(forest, first);
        if page - before >= columns * rows {
            before += columns * rows;
            continue;
        }
        let (i0, j0) = ((page - before) % columns, (page - before) / columns);
        let mut list = Vec::with_capacity(1087);
        for depth in first..first + count {
            let up = depth - first;
            let [across, along] = squares(forest, depth);
            let half = 1 << (forest.root_log2() - depth - 1);
            for j in j0 << up..(j0 + 1) << up {
                for i in i0 << up..(i0 + 1) << up {
                    let (x, y) = ((2 * i + 1) * half, (2 * j + 1) * half);
                    list.extend(forest.diamond([x, y]));
                    list.extend(forest.diamond([x - half, y]));
                    list.extend(forest.diamond([x, y - half]));
                    if i + 1 == across {
                        list.extend(forest.diamond([x + half, y]));
                    }
                    if j + 1 == along {
                        list.extend(forest.diamond([x, y + half]));
                    }
                }
            }
        }
        return Some(list);
    }
    None
}

/// The bytes of a page, from the entries of its diamonds in order. The lowest and highest heights come
/// back as they are, errors as [`declared`].
#[must_use]
pub fn encode(entries: &[Entry]) -> Vec<u8> {
    wire::to_bytes(&Columns {
        format: FORMAT,
        errors: entries.iter().map(|e| pack_error(e.error_metres)).collect(),
        lows: entries.iter().map(|e| e.low).collect(),
        // A span is one more than high less low, so that 0 says "no heights".
        spans: entries.iter().map(|e| (e.high - e.low + 1).max(0).cast_unsigned()).collect(),
        bytes: entries.iter().map(|e| e.bytes).collect(),
    })
}

/// The diamonds of a page with their entries. The bytes may be hostile; memory stays within a small
/// multiple of [`PAGE_BYTES_MAX`].
///
/// # Errors
/// When the bytes are not that page.
pub fn decode(forest: &Forest, page: u32, bytes: &[u8]) -> Result<Vec<(Diamond, Entry)>, PageError> {
    let Some(diamonds) = page_diamonds(forest, page) else {
        return Err(PageError::Number { page, pages: pages(forest) });
    };
    let columns: Columns = wire::from_bytes::<{ 4 * PAGE_BYTES_MAX }, _>(bytes)?;
    if columns.format != FORMAT {
        return Err(PageError::Format { found: columns.format });
    }
    let found = [columns.errors.len(), columns.lows.len(), columns.spans.len(), columns.bytes.len()];
    if found != [diamonds.len(); 4] {
        return Err(PageError::Count { found, expected: diamonds.len() });
    }
    let mut list = Vec::with_capacity(diamonds.len());
    for (i, d) in diamonds.into_iter().enumerate() {
        let (low, span, bytes) = (columns.lows[i], columns.spans[i], columns.bytes[i]);
        let high = i64::from(low) + i64::from(span) - 1;
        let error_metres = unpack_error(columns.errors[i]);
        let in_range = |h: i64| h.abs() <= i64::from(crate::HEIGHT_MAX) + 1;
        if !error_metres.is_finite() || !in_range(low.into()) || !in_range(high) {
            return Err(PageError::Entry(d.centre()));
        }
        let high = i32::try_from(high).map_err(|_| PageError::Entry(d.centre()))?;
        list.push((d, Entry { error_metres, low, high, bytes }));
    }
    Ok(list)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::collections::BTreeSet;

    fn forests() -> Vec<Forest> {
        [(3, 2, [1, 1]), (8, 2, [1, 1]), (9, 2, [2, 1]), (7, 3, [1, 3])]
            .map(|(k, m, r)| Forest::new(k, m, r).unwrap())
            .to_vec()
    }

    #[test]
    fn each_diamond_is_in_one_page_and_that_page_says_so() {
        for forest in forests() {
            let all: BTreeSet<_> = (0..forest.levels()).flat_map(|l| forest.diamonds(l)).collect();
            let mut seen = BTreeSet::new();
            for page in 0..pages(&forest) {
                for d in page_diamonds(&forest, page).unwrap() {
                    assert_eq!(page_of(&forest, d), page, "{d:?}");
                    assert!(seen.insert(d), "{d:?} twice");
                }
            }
            assert_eq!(seen, all);
            assert!(page_diamonds(&forest, pages(&forest)).is_none());
        }
    }

    fn entries(count: usize) -> Vec<Entry> {
        (0..i32::try_from(count).unwrap())
            .map(|i| {
                if i % 7 == 3 {
                    Entry::EMPTY
                } else {
                    Entry {
                        error_metres: declared(i as f32 * 1.37),
                        low: i - 40,
                        high: 3 * i,
                        bytes: (i * 31).cast_unsigned(),
                    }
                }
            })
            .collect()
    }

    #[test]
    fn a_page_comes_back() {
        let forest = Forest::new(9, 2, [2, 1]).unwrap();
        for page in 0..pages(&forest) {
            let diamonds = page_diamonds(&forest, page).unwrap();
            let entries = entries(diamonds.len());
            let bytes = encode(&entries);
            assert!(bytes.len() <= PAGE_BYTES_MAX);
            let back = decode(&forest, page, &bytes).unwrap();
            assert_eq!(back, diamonds.into_iter().zip(entries).collect::<Vec<_>>());
        }
    }

    #[test]
    fn damaged_pages_are_refused() {
        let forest = Forest::new(5, 2, [1, 1]).unwrap();
        let good = encode(&entries(page_diamonds(&forest, 0).unwrap().len()));
        for cut in 0..good.len() {
            assert!(decode(&forest, 0, &good[..cut]).is_err(), "prefix of {cut} bytes");
        }
        let mut long = good.clone();
        long.push(0);
        assert_eq!(decode(&forest, 0, &long), Err(PageError::Wire(WireError::Trailing(1))));
        let mut version = good.clone();
        version[0] = 9;
        assert_eq!(decode(&forest, 0, &version), Err(PageError::Format { found: 9 }));
        assert_eq!(decode(&forest, 7, &good), Err(PageError::Number { page: 7, pages: 1 }));
        // A column that claims 2^60 values is refused before it is allocated.
        assert!(decode(&forest, 0, &[1, 253, 0, 0, 0, 0, 0, 0, 0, 16]).is_err());
    }

    proptest! {
        #[test]
        fn declared_errors_never_shrink(metres in prop_oneof![0f32..1e-3, 0f32..10.0, 0f32..1e5]) {
            let up = declared(metres);
            prop_assert!(up >= metres && up <= metres * (1.0 + 1.0 / 128.0) + f32::MIN_POSITIVE);
            prop_assert_eq!(declared(up), up);
        }

        #[test]
        fn any_bytes_are_a_page_or_an_error(bytes in prop::collection::vec(any::<u8>(), 0..400)) {
            let _ = decode(&Forest::new(5, 2, [1, 1]).unwrap(), 0, &bytes);
        }
    }
}
