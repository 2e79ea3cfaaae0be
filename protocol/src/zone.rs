//! Zones: regions where the viewer is known to stay, and how much of each diamond can be seen from there.
//!
//! A zone's *visibility* is a share from 0 to 1 for each diamond: what its error counts for while the eye is in
//! the zone. It is a bound like the error itself: that of a sample is at most that of every diamond that holds
//! it, and a diamond's at most that of its parents. So errors times visibilities are saturated as errors are,
//! and a cut made of the products is as conforming as any. After Cifuentes et al., *Ray casting para la
//! definición de zonas de interés en simplificación topográfica* (2007), equation 5: v κ ≤ T.
//!
//! **The format.** One blob holds the masks of all layers of the scene. The store and the wire compress it with
//! zstd. Version 1:
//!
//! | offset | size | field | valid range |
//! |---|---|---|---|
//! | 0 | 1 | format | 1 |
//! | 1 | 1 | floor: the visibility of what is hidden, in 255ths | 0 to 254; 0 without layers |
//! | 2 | 1 | layers | as many as the scene has |
//! | 3 | 1 each | visibilities: layer by layer, level by level, in the order of [`Forest::diamonds`] | floor to bound |
//!
//! The *bound* of a diamond is the least visibility of its parents, 255 at level 0. Where the bound is the
//! floor there is no byte: all below is hidden too. Levels end where a layer's share of [`DIAMONDS_MAX`] does
//! (see [`Mask::levels`]); deeper diamonds have the least visibility of their parents.

#![allow(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "shares of 255 are between 0 and 255, positions below DIAMONDS_MAX"
)]

use crate::bintree::Forest;
use crate::diamond::Diamond;
use serde::{Deserialize, Serialize};

/// The format that this build writes, and the only one that it reads.
pub const FORMAT: u8 = 1;

/// The most diamonds whose visibility is kept, over all layers: one byte each, 64 MiB.
pub const DIAMONDS_MAX: u64 = 1 << 26;

/// The most layers of a scene, the steps of its series among them: a byte tells their number.
pub const LAYERS_MAX: usize = 255;

/// The most zones of a scene.
pub const ZONES_MAX: usize = 64;

/// The most corners of a zone, over all its rings: some 400 kB of JSON.
pub const CORNERS_MAX: usize = 10_000;

/// A zone as the scene's description tells it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Zone {
    /// The name in the address: letters, digits, `-`, `_` and `.`.
    pub name: String,
    /// Metres above the highest ground of each part up to which the eye is in the zone.
    pub eye: f64,
    /// The visibility of what is hidden: 0 to below 1.
    pub hidden: f64,
    /// Radians. Errors of what is hidden may look as large as this divided by the visibility, and no more, lest
    /// they rise above what hides them. 0: nothing is known of that.
    pub angle: f64,
    /// Whether the Earth's curvature was taken into account.
    pub curvature: bool,
    /// The polygons of the zone.
    pub parts: Vec<Part>,
    /// Bytes of the mask, compressed.
    pub bytes: u64,
}

/// A polygon of a zone.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Part {
    /// The highest place of the eye, in metres as heights are: the polygon's highest ground and the eye above it.
    pub ceiling: f64,
    /// The outline and the holes, in the frame's metres; the first corner is not repeated.
    pub rings: Vec<Vec<[f64; 2]>>,
}

impl Part {
    /// Whether a place lies in the polygon: not in its holes. Costs a few nanoseconds a corner.
    #[must_use]
    pub fn covers(&self, [x, y]: [f64; 2]) -> bool {
        let mut inside = false;
        for ring in &self.rings {
            for (a, b) in ring.iter().zip(ring.iter().cycle().skip(1)) {
                // A corner at the very height of the ray belongs to one of its two edges.
                if (a[1] > y) != (b[1] > y) && x < a[0] + (y - a[1]) / (b[1] - a[1]) * (b[0] - a[0]) {
                    inside = !inside;
                }
            }
        }
        inside
    }
}

impl Zone {
    /// Whether the mask tells what can be seen from an eye at `[x, y, z]`, in the frame's metres: in one of the
    /// parts, and not above its ceiling.
    #[must_use]
    pub fn contains(&self, [x, y, z]: [f64; 3]) -> bool {
        self.parts.iter().any(|part| z <= part.ceiling && part.covers([x, y]))
    }
}

/// Why bytes are not the masks of a scene's layers. Whichever it is, drop them and ask again.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum ZoneError {
    /// Written by another version.
    #[error("zone has format {found}, this build reads {FORMAT}: compute the zone again")]
    Format {
        /// The format found.
        found: u8,
    },
    /// The bytes end early.
    #[error("zone ends early, after {found} bytes: fetch it again")]
    Early {
        /// Bytes found.
        found: usize,
    },
    /// Something follows.
    #[error("zone has {0} bytes too many: fetch it again")]
    Trailing(usize),
    /// Not the layers of this scene.
    #[error("zone tells of {found} layers, the scene has {expected} (at most {LAYERS_MAX}): fetch it again")]
    Layers {
        /// Layers found.
        found: u8,
        /// Layers of the scene.
        expected: usize,
    },
    /// What is hidden cannot count as much as what is seen.
    #[error("zone has a floor of {0}, expected 0 to 254: fetch it again")]
    Floor(u8),
    /// A visibility outside of its bounds.
    #[error("zone has visibility {found} at diamond {centre:?}, expected {least} to {most}: fetch it again")]
    Visibility {
        /// The diamond's centre.
        centre: [u32; 2],
        /// The visibility found, in 255ths.
        found: u8,
        /// The floor.
        least: u8,
        /// The least of the parents.
        most: u8,
    },
}

/// The byte of a share from 0 to 1: rounded up, so that it stays a bound.
#[must_use]
pub fn pack(share: f64) -> u8 {
    (share.clamp(0.0, 1.0) * 255.0).ceil() as u8
}

/// The visibility of each diamond of a layer.
///
/// Takes a byte a diamond, at most [`DIAMONDS_MAX`].
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Mask {
    forest: Forest,
    floor: u8,
    levels: Vec<Vec<u8>>,
}

impl Mask {
    /// A mask of one of `layers` layers in which everything is hidden: has visibility `floor`, in 255ths.
    #[must_use]
    pub fn hidden(forest: Forest, floor: u8, layers: usize) -> Self {
        let levels = (0..told_levels(&forest, layers)).map(|l| vec![floor; count(&forest, l) as usize]);
        Self { forest, floor, levels: levels.collect() }
    }

    /// A mask from the visibilities of the diamonds of the forest's finest level, in their order, in 255ths, none
    /// below `floor`. Coarser diamonds have the largest of their children's.
    #[must_use]
    pub fn saturated(forest: Forest, floor: u8, layers: usize, finest: Vec<u8>) -> Self {
        let told = told_levels(&forest, layers);
        let mut levels = Vec::new();
        let mut fine = finest;
        for level in (0..forest.levels()).rev() {
            let mut coarse = vec![floor; if level > 0 { count(&forest, level - 1) as usize } else { 0 }];
            for (d, value) in forest.diamonds(level).zip(&fine).filter(|(_, value)| **value > floor) {
                for parent in forest.parents(d) {
                    let parent = &mut coarse[slot(&forest, parent)];
                    *parent = (*parent).max(*value);
                }
            }
            if level < told {
                levels.push(fine);
            }
            fine = coarse;
        }
        levels.reverse();
        Self { forest, floor, levels }
    }

    /// How many levels have visibilities of their own.
    #[must_use]
    pub fn levels(&self) -> u32 {
        self.levels.len() as u32
    }

    /// The visibility of a diamond of the mask's forest, in 255ths.
    #[must_use]
    pub fn get(&self, d: Diamond) -> u8 {
        match self.levels.get(d.level() as usize) {
            Some(level) => level[slot(&self.forest, d)],
            None => self.forest.parents(d).map(|parent| self.get(parent)).min().unwrap_or(u8::MAX),
        }
    }

    /// The visibility of a diamond, from 0 to 1.
    #[must_use]
    pub fn share(&self, d: Diamond) -> f64 {
        f64::from(self.get(d)) / 255.0
    }

    /// Diamonds of a level and how many of them are hidden.
    #[must_use]
    pub fn tally(&self, level: u32) -> [u64; 2] {
        let level = self.levels.get(level as usize).map_or(&[][..], Vec::as_slice);
        [level.len() as u64, level.iter().filter(|v| **v == self.floor).count() as u64]
    }
}

/// Half spacings of a level along x and y: see [`Forest::diamonds`].
fn spans(forest: &Forest, level: u32) -> [u64; 2] {
    let half_log2 = forest.root_log2() - 1 - level / 2;
    forest.size().map(|w| u64::from(w >> half_log2))
}

/// Diamonds of a level.
fn count(forest: &Forest, level: u32) -> u64 {
    let [columns, rows] = spans(forest, level);
    // Both are even. Of an odd level every second of the points of the grid is a centre.
    if level.is_multiple_of(2) { columns * rows / 4 } else { (columns + 1) * (rows + 1) / 2 }
}

/// The place of a diamond among those of its level.
fn slot(forest: &Forest, d: Diamond) -> usize {
    let half_log2 = forest.root_log2() - 1 - d.level() / 2;
    let [i, j] = d.centre().map(|w| u64::from(w >> half_log2));
    let [columns, _] = spans(forest, d.level());
    let slot = if d.level().is_multiple_of(2) {
        j / 2 * (columns / 2) + i / 2
    } else {
        // A row has an odd number of points, so centres are every second point across the rows, too.
        (j * (columns + 1) + i) / 2
    };
    slot as usize
}

/// How many levels of a forest are told where it is one of `layers`: as many as fit, one at least.
#[must_use]
pub fn told_levels(forest: &Forest, layers: usize) -> u32 {
    let most = DIAMONDS_MAX / layers.max(1) as u64;
    let mut total = 0;
    for level in 0..forest.levels() {
        total += count(forest, level);
        if level > 0 && total > most {
            return level;
        }
    }
    forest.levels()
}

/// The most bytes that the masks of layers with these forests can have: a header and a byte for each diamond told,
/// little more than [`DIAMONDS_MAX`] in all.
#[must_use]
pub fn bytes_max(forests: &[Forest]) -> usize {
    let told =
        |forest: &Forest| (0..told_levels(forest, forests.len())).map(|l| count(forest, l)).sum::<u64>();
    3 + forests.iter().map(told).sum::<u64>() as usize
}

/// The bytes of the masks of a scene's layers, which have one floor; at most [`LAYERS_MAX`].
#[must_use]
pub fn encode(masks: &[Mask]) -> Vec<u8> {
    let floor = masks.first().map_or(0, |mask| mask.floor);
    let mut out = vec![FORMAT, floor, masks.len().min(LAYERS_MAX) as u8];
    for mask in masks.iter().take(LAYERS_MAX) {
        for level in 0..mask.levels() {
            for (d, value) in mask.forest.diamonds(level).zip(&mask.levels[level as usize]) {
                if bound(mask, d) > floor {
                    out.push(*value);
                }
            }
        }
    }
    out
}

/// The most that a diamond's visibility may be: the least of its parents'.
fn bound(mask: &Mask, d: Diamond) -> u8 {
    mask.forest.parents(d).map(|parent| mask.get(parent)).min().unwrap_or(u8::MAX)
}

/// The masks of layers with these forests. The bytes may be hostile; takes a byte a diamond, at most
/// [`DIAMONDS_MAX`], and some 50 ns for each.
///
/// # Errors
/// When the bytes are not the masks of such layers.
pub fn decode(forests: &[Forest], bytes: &[u8]) -> Result<Vec<Mask>, ZoneError> {
    let early = || ZoneError::Early { found: bytes.len() };
    match bytes.first() {
        None => return Err(early()),
        Some(&FORMAT) => {}
        Some(found) => return Err(ZoneError::Format { found: *found }),
    }
    let (floor, layers) = (*bytes.get(1).ok_or_else(early)?, *bytes.get(2).ok_or_else(early)?);
    // A floor without masks could not be written again.
    if floor == u8::MAX || (layers == 0 && floor > 0) {
        return Err(ZoneError::Floor(floor));
    }
    if usize::from(layers) != forests.len() || forests.len() > LAYERS_MAX {
        return Err(ZoneError::Layers { found: layers, expected: forests.len() });
    }
    let mut rest = bytes[3..].iter();
    let mut masks = Vec::with_capacity(forests.len());
    for forest in forests {
        let mut mask = Mask::hidden(*forest, floor, forests.len());
        for level in 0..mask.levels() {
            for (i, d) in forest.diamonds(level).enumerate() {
                let most = bound(&mask, d);
                if most == floor {
                    continue;
                }
                let found = *rest.next().ok_or_else(early)?;
                if !(floor..=most).contains(&found) {
                    let (centre, least) = (d.centre(), floor);
                    return Err(ZoneError::Visibility { centre, found, least, most });
                }
                mask.levels[level as usize][i] = found;
            }
        }
        masks.push(mask);
    }
    if rest.len() > 0 { Err(ZoneError::Trailing(rest.len())) } else { Ok(masks) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn forests() -> Vec<Forest> {
        let plain = |k, m, r| Forest::new(k, m, r).unwrap();
        vec![
            plain(3, 2, [1, 1]),
            plain(6, 2, [2, 1]),
            plain(6, 3, [1, 3]),
            plain(5, 2, [1, 1]).with_precision(3).unwrap(),
        ]
    }

    /// A mask whose finest visibilities come from numbers that look random.
    fn any_mask(forest: Forest, floor: u8, layers: usize, seed: u64) -> Mask {
        let mut state = seed | 1;
        let mut dice = move || {
            state ^= state << 13;
            state ^= state >> 7;
            state ^= state << 17;
            state
        };
        let last = forest.levels() - 1;
        // Most is hidden, in long stretches, as in a real mask.
        let hidden = dice() % 4;
        let finest = (0..count(&forest, last)).map(|i| {
            let seen = i / 16 % 4 >= hidden;
            if seen { (dice() % 256) as u8 } else { floor }.max(floor)
        });
        Mask::saturated(forest, floor, layers, finest.collect())
    }

    #[test]
    fn each_diamond_has_its_place_in_order() {
        for forest in forests() {
            for level in 0..forest.levels() {
                let slots: Vec<usize> = forest.diamonds(level).map(|d| slot(&forest, d)).collect();
                assert_eq!(
                    slots,
                    (0..count(&forest, level) as usize).collect::<Vec<_>>(),
                    "{forest:?} {level}"
                );
            }
        }
    }

    #[test]
    fn levels_that_do_not_fit_take_after_their_parents() {
        let huge = Forest::new(14, 3, [8, 8]).unwrap();
        let told = told_levels(&huge, 1);
        assert!(told < huge.levels());
        let mut forest = forests()[1];
        let mut mask = any_mask(forest, 9, 1, 77);
        let whole = mask.clone();
        mask.levels.truncate(3);
        for d in (3..forest.levels()).flat_map(|l| forest.diamonds(l)) {
            assert!(mask.get(d) >= whole.get(d), "still a bound");
            assert!(forest.parents(d).all(|p| mask.get(p) >= mask.get(d)), "still saturated");
        }
        forest = forests()[0];
        assert_eq!(told_levels(&forest, LAYERS_MAX), forest.levels());
    }

    proptest! {
        #[test]
        fn visibilities_are_saturated_and_come_back(seed in any::<u64>(), floor in 0u8..255, which in 0usize..4) {
            let forest = forests()[which];
            let mask = any_mask(forest, floor, 1, seed);
            for d in (0..forest.levels()).flat_map(|l| forest.diamonds(l)) {
                prop_assert!(mask.get(d) >= floor);
                for parent in forest.parents(d) {
                    prop_assert!(mask.get(parent) >= mask.get(d), "{:?}", d);
                }
            }
            let bytes = encode(std::slice::from_ref(&mask));
            prop_assert!(bytes.len() <= bytes_max(&[forest]));
            prop_assert_eq!(decode(&[forest], &bytes), Ok(vec![mask]));
        }

        #[test]
        fn every_prefix_and_every_longer_text_is_refused(seed in any::<u64>(), which in 0usize..4) {
            let forest = forests()[which];
            let mut bytes = encode(&[any_mask(forest, 3, 1, seed)]);
            for cut in 0..bytes.len() {
                prop_assert!(decode(&[forest], &bytes[..cut]).is_err(), "prefix of {} bytes", cut);
            }
            bytes.push(3);
            prop_assert_eq!(decode(&[forest], &bytes), Err(ZoneError::Trailing(1)));
        }

        #[test]
        fn any_bytes_are_masks_or_an_error(mut bytes in prop::collection::vec(any::<u8>(), 0..400), which in 0usize..4) {
            let forest = forests()[which];
            for layers in [vec![forest], vec![], vec![forest; 3]] {
                if let Ok(masks) = decode(&layers, &bytes) {
                    prop_assert_eq!(encode(&masks), bytes.clone());
                }
                if let [format, _, count, ..] = bytes.as_mut_slice() {
                    (*format, *count) = (FORMAT, layers.len() as u8);
                }
            }
        }

        #[test]
        fn shares_round_up(share in 0.0..=1.0f64) {
            let byte = f64::from(pack(share)) / 255.0;
            prop_assert!(byte >= share && byte < share + 1.0 / 254.9);
        }
    }

    #[test]
    fn the_bytes_of_version_1_stay_the_same() {
        // One root of 8 cells in patches of 4: a root, four sides. Both corners of the north see something.
        let forest = Forest::new(3, 2, [1, 1]).unwrap();
        let mask = Mask::saturated(forest, 5, 1, vec![5, 7, 255, 100]);
        assert_eq!(encode(&[mask]), [1, 5, 1, 255, 5, 7, 255, 100]);
        let hidden = Mask::hidden(forest, 5, 2);
        let two = [hidden.clone(), hidden];
        assert_eq!(encode(&two), [1, 5, 2, 5, 5], "all below a hidden root is hidden");
        assert_eq!(decode(&[forest; 2], &[1, 5, 2, 5, 5]), Ok(two.to_vec()));
        assert_eq!(decode(&[], &encode(&[])), Ok(vec![]), "no layers");
    }

    #[test]
    fn wrong_headers_are_named() {
        let forest = Forest::new(3, 2, [1, 1]).unwrap();
        let refused = |bytes: &[u8]| decode(&[forest], bytes).unwrap_err();
        assert_eq!(refused(&[]), ZoneError::Early { found: 0 });
        assert_eq!(refused(&[2, 5, 1, 5]), ZoneError::Format { found: 2 });
        assert_eq!(refused(&[1, 255, 1, 255]), ZoneError::Floor(255));
        // More layers than the scene has, before anything is allocated for them.
        assert_eq!(refused(&[1, 5, 255]), ZoneError::Layers { found: 255, expected: 1 });
        // A floor without layers came back as 0.
        assert_eq!(decode(&[], &[1, 5, 0]), Err(ZoneError::Floor(5)));
        let outside = |centre, found, least, most| ZoneError::Visibility { centre, found, least, most };
        assert_eq!(refused(&[1, 5, 1, 4]), outside([4, 4], 4, 5, 255), "below the floor");
        assert_eq!(refused(&[1, 5, 1, 9, 10]), outside([4, 0], 10, 5, 9), "above its parent");
    }

    #[test]
    fn a_zone_is_its_polygons_without_holes_up_to_their_ceilings() {
        let square = |x: f64, y: f64, w: f64| vec![[x, y], [x + w, y], [x + w, y + w], [x, y + w]];
        let zone = Zone {
            name: "lake".into(),
            eye: 2.0,
            hidden: 0.05,
            angle: 1e-3,
            curvature: false,
            parts: vec![
                Part { ceiling: 12.0, rings: vec![square(0.0, 0.0, 10.0), square(4.0, 4.0, 2.0)] },
                Part { ceiling: 90.0, rings: vec![square(20.0, 0.0, 5.0)] },
            ],
            bytes: 0,
        };
        assert!(zone.contains([1.0, 1.0, 12.0]) && zone.contains([9.0, 4.0, -50.0]));
        assert!(!zone.contains([1.0, 1.0, 12.1]), "above the ceiling");
        assert!(!zone.contains([5.0, 5.0, 1.0]), "on the island");
        assert!(!zone.contains([15.0, 1.0, 1.0]) && !zone.contains([-1.0, 4.0, 1.0]), "between and beside");
        assert!(zone.contains([22.0, 1.0, 80.0]), "each part has its own ceiling");
        let json = serde_json::to_string(&zone).unwrap();
        assert_eq!(serde_json::from_str::<Zone>(&json).unwrap(), zone);
    }
}
