//! Random meshes there and back, and bytes that are none.

use super::*;
use crate::NODATA;
use proptest::prelude::*;
use std::collections::BTreeSet;

/// Numbers that look random, the same each time.
struct Dice(u64);

impl Dice {
    fn below(&mut self, limit: usize) -> usize {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 33) as usize % limit.max(1)
    }
}

fn any_forest() -> impl Strategy<Value = Forest> {
    (2u8..=4, 1u8..=3, 1u32..=3, 1u32..=2)
        .prop_map(|(patch, extra, columns, rows)| Forest::new(patch + extra, patch, [columns, rows]).unwrap())
}

fn pick(forest: &Forest, dice: &mut Dice) -> Diamond {
    let level = dice.below(forest.levels() as usize) as u32;
    let all: Vec<_> = forest.diamonds(level).collect();
    all[dice.below(all.len())]
}

/// A mesh of a diamond: regular, with edges collapsed at random and triangles torn out.
fn random_patch(forest: &Forest, d: Diamond, dice: &mut Dice) -> Patch {
    let (holes, relief, step) = (dice.below(4), 1 + dice.below(5000), 1 + dice.below(3) as i32 * 7);
    let mut roll = Dice(dice.0);
    let mut patch = Patch::regular(forest, d, forest.segments(), |_| {
        (holes == 0 || roll.below(12) > 0).then(|| (roll.below(relief) as i32 - 2000) * step)
    });
    for _ in 0..dice.below(2 * patch.triangles.len() + 1) {
        collapse(forest, d, &mut patch, dice);
    }
    if holes > 1 {
        let keep: Vec<bool> = patch.triangles.iter().map(|_| dice.below(10) > holes).collect();
        patch = with_triangles(&patch, |i| keep[i].then(|| patch.triangles[i]));
    }
    patch
}

/// The patch with each triangle as `of` says, or without it.
fn with_triangles(patch: &Patch, of: impl Fn(usize) -> Option<[u32; 3]>) -> Patch {
    let mut new = Patch { vertices: patch.vertices.clone(), ..Patch::default() };
    for child in 0..4 {
        new.triangles.extend(patch.range(child).filter_map(&of));
        new.ends[child] = new.triangles.len() as u32;
    }
    new
}

/// Moves a random corner's vertex to the next corner's, if no triangle turns or leaves its child triangle by it.
fn collapse(forest: &Forest, d: Diamond, patch: &mut Patch, dice: &mut Dice) {
    let Some(triangle) = patch.triangles.get(dice.below(patch.triangles.len())) else { return };
    let (from, to) = (triangle[0], triangle[1]);
    let square = Square::new(forest, d, 0);
    let centre = d.centre().map(i64::from);
    let place = |v: u32| {
        let vertex = patch.vertices[v as usize];
        [i64::from(vertex.x) - centre[0], i64::from(vertex.y) - centre[1]]
    };
    let moved = with_triangles(patch, |i| {
        let triangle = patch.triangles[i].map(|v| if v == from { to } else { v });
        (triangle.iter().filter(|v| **v == to).count() < 2).then_some(triangle)
    });
    let mut edges = BTreeSet::new();
    for child in 0..4 {
        for triangle in &moved.triangles[moved.range(child)] {
            let [a, b, c] = triangle.map(place);
            let turns = (b[0] - a[0]) * (c[1] - a[1]) > (b[1] - a[1]) * (c[0] - a[0]);
            let inside = [a, b, c].iter().all(|p| square.within(p[0], p[1]).children & 1 << child != 0);
            let fresh = (0..3).all(|i| edges.insert((triangle[i], triangle[(i + 1) % 3])));
            if !turns || !inside || !fresh {
                return;
            }
        }
    }
    // The areas say whether something was covered twice, or laid bare.
    if area(&moved) == area(patch) {
        *patch = moved;
    }
}

fn area(patch: &Patch) -> i64 {
    let area = |t: &[u32; 3]| {
        let [a, b, c] =
            t.map(|v| [patch.vertices[v as usize].x, patch.vertices[v as usize].y].map(i64::from));
        (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
    };
    patch.triangles.iter().map(area).sum()
}

/// The triangles as sets of places, by child.
fn shapes(patch: &Patch) -> Vec<(usize, [Vertex; 3])> {
    let mut list = Vec::new();
    for child in 0..4 {
        for triangle in &patch.triangles[patch.range(child)] {
            let mut corners = triangle.map(|v| patch.vertices[v as usize]);
            let first = (0..3).min_by_key(|i| (corners[*i].y, corners[*i].x)).unwrap();
            corners.rotate_left(first);
            list.push((child, corners));
        }
    }
    list.sort_unstable_by_key(|(child, t)| (*child, t.map(|v| (v.y, v.x, v.height))));
    list
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(400))]

    #[test]
    fn meshes_come_back_and_encode_to_the_same_bytes(forest in any_forest(), seed in any::<u64>()) {
        let mut dice = Dice(seed);
        let d = pick(&forest, &mut dice);
        let patch = random_patch(&forest, d, &mut dice);
        let bytes = encode(&forest, d, &patch).unwrap();
        let back = decode(&forest, d, &bytes).unwrap();
        prop_assert_eq!(shapes(&back), shapes(&patch));
        prop_assert_eq!(encode(&forest, d, &back), Ok(bytes));
        // Vertices come in the order in which triangles use them, but for child triangles, none in vain.
        let used: BTreeSet<u32> = back.triangles.iter().flatten().copied().collect();
        prop_assert_eq!(used.len(), back.vertices.len());
    }

    #[test]
    fn bytes_with_a_change_are_refused_or_are_another_patch(forest in any_forest(), seed in any::<u64>(), flips in prop::collection::vec((any::<u16>(), 0u8..8), 1..4)) {
        let mut dice = Dice(seed);
        let d = pick(&forest, &mut dice);
        let mut bytes = encode(&forest, d, &random_patch(&forest, d, &mut dice)).unwrap();
        for (at, bit) in flips {
            let at = usize::from(at) % bytes.len().max(1);
            if let Some(byte) = bytes.get_mut(at) { *byte ^= 1 << bit; }
        }
        if let Ok(patch) = decode(&forest, d, &bytes) {
            prop_assert_eq!(encode(&forest, d, &patch), Ok(bytes));
        }
    }

    #[test]
    fn any_bytes_are_a_patch_or_an_error(forest in any_forest(), seed in any::<u64>(), flags in 0u8..8, mut bytes in prop::collection::vec(any::<u8>(), 0..600)) {
        let d = pick(&forest, &mut Dice(seed));
        bytes.insert(0, FORMAT << 4 | flags);
        if let Ok(patch) = decode(&forest, d, &bytes) {
            prop_assert_eq!(encode(&forest, d, &patch), Ok(bytes));
        }
    }
}

/// The whole lattice of some diamond in steps of 2^shift, with its forest.
fn any_lattice() -> impl Strategy<Value = (Forest, Diamond, Patch)> {
    let heights = (any::<u64>(), 1usize..6000, 1i32..5);
    (3u8..=5, 0u8..=2, 1u32..=2, heights).prop_map(|(side, shift, columns, (seed, relief, step))| {
        let mut dice = Dice(seed);
        let [forest, large] = [side, side + shift].map(|log2| Forest::new(log2, 2, [columns, 1]).unwrap());
        let d = pick(&forest, &mut dice);
        let height = |_| (dice.below(relief) as i32 - 1000) * step;
        let (mut patch, _) = Patch::lattice(&forest, d, height).unwrap();
        for v in &mut patch.vertices {
            (v.x, v.y) = (v.x << shift, v.y << shift);
        }
        (large, large.diamond(d.centre().map(|w| w << shift)).unwrap(), patch)
    })
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(300))]

    #[test]
    fn whole_lattices_come_back_whatever_their_order(case in any_lattice(), seed in any::<u64>()) {
        let (forest, d, mut patch) = case;
        let bytes = encode(&forest, d, &patch).unwrap();
        prop_assert_eq!(bytes[0] & !TWO_LANES, FORMAT << 4 | LATTICE);
        prop_assert_eq!(decode(&forest, d, &bytes).unwrap(), patch.clone());
        let neighbours = Neighbours::of(&patch.triangles, patch.vertices.len());
        prop_assert_eq!(encode_with(&forest, d, &patch, &neighbours).unwrap(), &bytes[..]);
        let mut dice = Dice(seed);
        for child in 0..4 {
            let range = patch.range(child);
            let triangles = &mut patch.triangles[range];
            for i in 1..triangles.len() {
                triangles.swap(i, dice.below(i + 1));
                triangles[i].rotate_left(dice.below(3));
            }
        }
        prop_assert_eq!(encode(&forest, d, &patch), Ok(bytes));
    }

    /// A corner torn off, or a triangle there twice in the place of another: the walk tells it, or refuses it.
    #[test]
    fn what_is_nearly_a_lattice_is_none(case in any_lattice(), seed in any::<u64>(), tears: bool) {
        let (forest, d, mut patch) = case;
        let mut dice = Dice(seed);
        let at = dice.below(patch.triangles.len());
        if tears {
            let corner = dice.below(3);
            let torn = patch.triangles[at][corner];
            // A vertex of one triangle alone is only named anew.
            let tells = if patch.triangles.as_flattened().iter().filter(|v| **v == torn).count() > 1 { 0 } else { LATTICE };
            patch.vertices.push(patch.vertices[torn as usize]);
            patch.triangles[at][corner] = patch.vertices.len() as u32 - 1;
            if let Ok(bytes) = encode(&forest, d, &patch) {
                let back = decode(&forest, d, &bytes).unwrap();
                prop_assert_eq!(bytes[0] & LATTICE, tells);
                prop_assert_eq!(shapes(&back), shapes(&patch));
                prop_assert_eq!(encode(&forest, d, &back), Ok(bytes));
            }
        } else {
            let other = if at == 0 { 1 } else { at - 1 };
            patch.triangles[at] = patch.triangles[other];
            prop_assert!(encode(&forest, d, &patch).is_err());
        }
    }

    #[test]
    fn bytes_of_lattices_with_a_change_are_refused_or_are_another_patch(case in any_lattice(), flips in prop::collection::vec((any::<u16>(), 0u8..8), 1..4)) {
        let (forest, d, patch) = case;
        let mut bytes = encode(&forest, d, &patch).unwrap();
        for (at, bit) in flips {
            let at = usize::from(at) % bytes.len();
            bytes[at] ^= 1 << bit;
        }
        if let Ok(patch) = decode(&forest, d, &bytes) {
            prop_assert_eq!(encode(&forest, d, &patch), Ok(bytes));
        }
    }

    #[test]
    fn neighbours_in_a_lattice_are_those_of_its_triangles(forest in any_forest(), seed in any::<u64>()) {
        let d = pick(&forest, &mut Dice(seed));
        let (patch, neighbours) = Patch::lattice(&forest, d, |[x, y]| (x + y) as i32).unwrap();
        prop_assert_eq!(neighbours, Neighbours::of(&patch.triangles, patch.vertices.len()));
        prop_assert_eq!(area(&patch) / patch.triangles.len() as i64, 1);
    }
}

/// One after the other, whatever their shapes.
#[test]
fn lattices_made_like_others_are_as_if_made_alone() {
    let forest = Forest::new(5, 2, [2, 1]).unwrap();
    let mut lattices = Lattices::default();
    let height = |[x, y]: [u32; 2]| (7 * x + x * y) as i32;
    for d in (0..forest.levels()).flat_map(|level| forest.diamonds(level)) {
        let (patch, neighbours) = lattices.patch(&forest, d, height).unwrap();
        assert_eq!(encode_whole(&forest, d, &patch), encode(&forest, d, &patch));
        assert_eq!(Some((patch, neighbours)), Patch::lattice(&forest, d, height));
    }
}

/// Nothing can be said in two ways.
#[test]
fn a_whole_lattice_told_by_a_walk_is_refused() {
    let (forest, d, patch) = sample();
    let neighbours = Neighbours::of(&patch.triangles, patch.vertices.len());
    let bytes = encode_mesh(&forest, d, &patch, &neighbours).unwrap();
    assert_eq!(bytes[0] & LATTICE, 0);
    assert_eq!(decode(&forest, d, &bytes), Err(DecodeError::Symbols));
}

/// Walks wherever chance leads, and writes down what it would have been told.
struct Rambler {
    dice: Dice,
    /// Bits in 8 that are set.
    chance: usize,
    reach: usize,
    parts: usize,
    bits: usize,
    numbers: usize,
    coder: Encoder,
}

impl Wire for Rambler {
    fn number(&mut self, scale: &mut Scale, _: i64) -> Result<i64, Fault> {
        // The first vertex has the height that others are told from.
        self.numbers += 1;
        let reach = if self.numbers == 3 { 0 } else { self.reach };
        let number = self.dice.below(2 * reach + 1) as i64 - reach as i64;
        numbers::encode(&mut self.coder, 1, numbers::tables(), scale, number);
        Ok(number)
    }
    fn plain(&mut self, _: u32, bits: u32) -> u32 {
        let value = self.dice.below(1 << bits.min(5)) as u32;
        numbers::plain(&mut self.coder, 1, value, bits);
        value
    }
}

impl Pass for Rambler {
    fn bit(&mut self, context: &mut Context, _: bool) -> bool {
        // There is something, and an end to it.
        self.bits += 1;
        let bit = self.bits == 1 || self.dice.below(8) < self.chance;
        self.coder.bit(context, bit);
        bit
    }
    fn seed(&mut self) -> Option<Seed> {
        // The bit that follows says whether there is another part.
        self.parts += 1;
        self.chance = if self.parts > 3 { 0 } else { self.chance };
        None
    }
    fn beyond(&mut self, _: u32) -> Beyond {
        Beyond::Nothing
    }
    fn marks(&self, _: u32) -> [u32; 2] {
        [0; 2]
    }
}

/// What no encoder would write can still be a mesh: then it is the one whose bytes it is.
#[test]
fn whatever_walk_is_accepted_is_the_encoders_own() {
    let (mut accepted, mut large) = (0, 0);
    for round in 0..1_500_000 {
        let mut dice = Dice(round);
        let forest = Forest::new(4, 2, [2, 1]).unwrap();
        let d = pick(&forest, &mut dice);
        let (chance, reach, holes) = (2 + dice.below(5), 1 + dice.below(4), dice.below(4) > 0);
        let mut rambler =
            Rambler { dice, chance, reach, parts: 0, bits: 0, numbers: 0, coder: Encoder::default() };
        let units = Units { shift: 0, base: 100, step: 1 };
        numbers::plain(&mut rambler.coder, 1, 0, 5);
        for (expected, number) in [(1024, 100), (1, 0)] {
            numbers::encode(
                &mut rambler.coder,
                1,
                numbers::tables(),
                &mut Scale::expecting(expected),
                number,
            );
        }
        let mut walk = Walk::new(Square::new(&forest, d, 0), holes, 0);
        let found = walk.run(&mut rambler).map_err(DecodeError::from);
        let Ok(patch) = found.and_then(|()| gather(&walk, units, d)) else { continue };
        let mut bytes = rambler.coder.finish(1);
        bytes.insert(0, FORMAT << 4 | if holes { HOLES } else { 0 });
        if patch.triangles.is_empty() {
            assert!(decode(&forest, d, &bytes).is_err(), "no triangles are no bytes");
            continue;
        }
        assert_eq!(decode(&forest, d, &bytes).as_ref(), Ok(&patch), "round {round}");
        assert_eq!(encode(&forest, d, &patch), Ok(bytes), "round {round}");
        accepted += 1;
        large += usize::from(patch.triangles.len() > 4);
    }
    println!("{accepted} walks accepted, {large} of five triangles and more");
    assert!(accepted > 5000 && large > 10, "{accepted} {large}");
}

/// A patch of some relief, for tests that change its bytes.
fn sample() -> (Forest, Diamond, Patch) {
    let forest = Forest::new(6, 3, [2, 1]).unwrap();
    let d = forest.diamonds(3).nth(5).unwrap();
    let patch = Patch::regular(&forest, d, 8, |[x, y]| Some((x * x / 7 + 3 * y) as i32 % 911));
    (forest, d, patch)
}

#[test]
fn golden_bytes_of_format_2() {
    let forest = Forest::new(3, 2, [1, 1]).unwrap();
    let d = forest.root_diamonds().next().unwrap();
    let patch = Patch::regular(&forest, d, 1, |[x, y]| Some((10 * x + y) as i32));
    let bytes = encode(&forest, d, &patch).unwrap();
    assert_eq!(bytes, GOLDEN);
    assert_eq!(decode(&forest, d, &bytes).unwrap().vertices.len(), 5);
}

#[test]
fn golden_bytes_of_a_whole_lattice() {
    let forest = Forest::new(3, 2, [1, 1]).unwrap();
    let d = forest.diamonds(1).next().unwrap();
    let (patch, _) = Patch::lattice(&forest, d, |[x, y]| (10 * x * y + x) as i32).unwrap();
    let bytes = encode(&forest, d, &patch).unwrap();
    assert_eq!(bytes, GOLDEN_LATTICE);
    assert_eq!(decode(&forest, d, &bytes), Ok(patch));
}

const GOLDEN_LATTICE: [u8; 23] =
    [36, 64, 57, 59, 109, 76, 151, 79, 116, 174, 9, 220, 127, 235, 95, 241, 159, 94, 203, 106, 46, 102, 178];

const GOLDEN: [u8; 13] = [32, 130, 182, 29, 0, 77, 201, 169, 95, 175, 72, 103, 31];

#[test]
fn no_triangles_are_no_bytes() {
    let (forest, d, _) = sample();
    assert_eq!(encode(&forest, d, &Patch::default()), Ok(Vec::new()));
    assert_eq!(decode(&forest, d, &[]), Ok(Patch::default()));
    let lone = Patch { vertices: vec![Vertex::default()], ..Patch::default() };
    assert_eq!(encode(&forest, d, &lone), Ok(Vec::new()));
}

#[test]
fn damaged_payloads_are_refused() {
    let (forest, d, patch) = sample();
    let good = encode(&forest, d, &patch).unwrap();
    for cut in 1..good.len() {
        assert!(decode(&forest, d, &good[..cut]).is_err(), "prefix of {cut} bytes");
    }
    let mut long = good.clone();
    long.push(0);
    assert!(decode(&forest, d, &long).is_err(), "a byte too many");
    let with = |header: u8| {
        let mut bytes = good.clone();
        bytes[0] = header;
        decode(&forest, d, &bytes)
    };
    assert_eq!(with(9 << 4), Err(DecodeError::Format { found: 9 }));
    assert_eq!(with(FORMAT << 4 | 12), Err(DecodeError::Flags { found: 12 }));
    assert!(with(FORMAT << 4 | HOLES).is_err() && with(FORMAT << 4 | TWO_LANES).is_err());
    assert_eq!(with(FORMAT << 4 | LATTICE | HOLES), Err(DecodeError::Flags { found: LATTICE | HOLES }));
    assert_eq!(with(1 << 4), Err(DecodeError::Format { found: 1 }));
}

#[test]
fn patches_that_are_none_are_refused() {
    let (forest, d, good) = sample();
    let with = |change: &dyn Fn(&mut Patch)| {
        let mut patch = good.clone();
        change(&mut patch);
        encode(&forest, d, &patch).unwrap_err()
    };
    assert!(matches!(with(&|p| p.triangles[3].swap(0, 1)), PatchError::Turn(_)));
    assert!(matches!(with(&|p| p.triangles[3][0] = 9999), PatchError::Vertex(_)));
    assert!(matches!(with(&|p| p.ends[3] -= 1), PatchError::Ends(_)));
    assert!(matches!(with(&|p| p.ends[0] -= 1), PatchError::Child(_, 1)));
    assert!(matches!(with(&|p| p.triangles[1] = p.triangles[0]), PatchError::Edge(..)));
    assert!(matches!(with(&|p| p.vertices[0].height = HEIGHT_MAX + 1), PatchError::Height(_)));
    assert!(matches!(with(&|p| p.vertices[0].height = NODATA), PatchError::Height(_)));
    assert!(matches!(with(&|p| p.vertices[0].x += 64), PatchError::Child(..) | PatchError::Turn(_)));
}

#[test]
fn the_largest_patch_fits_and_a_larger_one_does_not() {
    let forest = Forest::new(8, 7, [1, 1]).unwrap();
    let d = forest.root_diamonds().next().unwrap();
    let mut dice = Dice(3);
    let patch = Patch::regular(&forest, d, 128, |_| Some(dice.below(60_000) as i32 - 30_000));
    assert_eq!(patch.triangles.len(), TRIANGLES_MAX);
    let bytes = encode(&forest, d, &patch).unwrap();
    assert_eq!(shapes(&decode(&forest, d, &bytes).unwrap()), shapes(&patch));
    assert!(bytes.len() < crate::message::PAYLOAD_BYTES_MAX as usize, "{} bytes", bytes.len());
    let mut more = patch.clone();
    more.triangles.push(patch.triangles[0]);
    more.ends[3] += 1;
    assert_eq!(encode(&forest, d, &more), Err(PatchError::Triangles(TRIANGLES_MAX + 1)));
}

/// As many parts as triangles: more vertices than indices of 16 bits name.
#[test]
fn too_many_vertices_are_refused() {
    let forest = Forest::new(8, 7, [1, 1]).unwrap();
    let d = forest.root_diamonds().next().unwrap();
    let whole = Patch::regular(&forest, d, 128, |_| Some(0));
    // Of each cell the triangles to the south and to the north, which meet in points alone.
    let some = with_triangles(&whole, |i| (i % 2 == 0).then(|| whole.triangles[i]));
    assert!(some.triangles.len() * 3 > VERTICES_MAX);
    assert_eq!(encode(&forest, d, &some), Err(PatchError::Vertices));
}
