//! A balanced quadtree as triangles, from a dictionary.
//!
//! A quadrant has its four corners, and the middle of each side beyond which the neighbour is finer: sixteen
//! cases, six but for turning. None needs a point inside, and together they have only four shapes of triangle:
//!
//! ```text
//! +-------+  +-------+  +-------+  +---+---+  +-------+  +---+---+
//! |     / |  |\     /|  |\ ---__|  |  /|  /|  |  __--/|  | /   \ |   half a square, large or small;
//! |   /   |  | \   / |  | \    /+  | / | / |  +--___/ +  +       +   legs 1 : 2; as high as its base;
//! | /     |  |  \ /  |  |  \ / |  |/  |/  |  | \   / |  | \   / |   and the one between two middles
//! +-------+  +---+---+  +---+---+  +---+---+  +---+---+  +---+---+   and the far corner
//! ```
//!
//! After the curvature paper, its section 2.1.

use super::quadtree::Quadtree;
use diamantina_protocol::bintree::Point;

/// For each set of middles (bit 0 south, then east, north, west) the triangles, turning left, by places
/// on the rim: 0 south-west corner, 1 south, 2 south-east, 3 east, 4 north-east, 5 north, 6 north-west, 7 west.
/// Derived from the six cases by turning: see `turned`.
const CASES: [(u8, &[[usize; 3]]); 6] = [
    (0b0000, &[[0, 2, 4], [0, 4, 6]]),
    (0b0001, &[[0, 1, 6], [1, 2, 4], [1, 4, 6]]),
    (0b0011, &[[1, 2, 3], [0, 1, 6], [3, 4, 6], [1, 3, 6]]),
    (0b0101, &[[0, 1, 5], [0, 5, 6], [1, 2, 4], [1, 4, 5]]),
    (0b1011, &[[0, 1, 7], [1, 2, 3], [1, 3, 7], [7, 3, 4], [7, 4, 6]]),
    (0b1111, &[[0, 1, 7], [2, 3, 1], [4, 5, 3], [6, 7, 5], [1, 3, 5], [1, 5, 7]]),
];

/// The triangles for a set of middles.
fn turned(middles: u8) -> Vec<[usize; 3]> {
    // Turned by quarters to the left until it is one of the six: places move on by two, sides by one.
    for quarters in 0..4u8 {
        let rotated = (middles >> quarters | middles << (4 - quarters)) & 0b1111;
        if let Some((_, triangles)) = CASES.iter().find(|(case, _)| *case == rotated) {
            return triangles
                .iter()
                .map(|t| t.map(|place| (place + 2 * usize::from(quarters)) % 8))
                .collect();
        }
    }
    Vec::new()
}

/// The triangles of a balanced quadtree, turning left, in samples from the south-west corner.
#[must_use]
pub fn triangles(tree: &Quadtree) -> Vec<[Point; 3]> {
    let dictionary: Vec<Vec<[usize; 3]>> = (0..16).map(turned).collect();
    let mut list = Vec::new();
    for (level, i, j) in tree.leaves() {
        let beyond = [(i, j.wrapping_sub(1)), (i + 1, j), (i, j + 1), (i.wrapping_sub(1), j)];
        let middles = beyond.iter().enumerate().filter(|(_, (i, j))| tree.is_split(level, *i, *j));
        let case: usize = middles.map(|(side, _)| 1 << side).sum();
        let size = 1u32 << (usize::from(tree.log2()) - level);
        let at = |v: usize| u32::try_from(v).unwrap_or(u32::MAX);
        let (x, y, half) = (at(i) * size, at(j) * size, size / 2);
        let rim: [Point; 8] = [
            [x, y],
            [x + half, y],
            [x + size, y],
            [x + size, y + half],
            [x + size, y + size],
            [x + half, y + size],
            [x, y + size],
            [x, y + half],
        ];
        list.extend(dictionary[case].iter().map(|t| t.map(|place| rim[place])));
    }
    list
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::experiment::curvature::quadtree::{Observer, Sums};
    use crate::experiment::field::Field;
    use proptest::prelude::*;
    use std::collections::{BTreeMap, BTreeSet};

    fn double_area([a, c, b]: [Point; 3]) -> i64 {
        let d = |p: Point, i: usize| i64::from(p[i]) - i64::from(a[i]);
        d(c, 0) * d(b, 1) - d(c, 1) * d(b, 0)
    }

    proptest! {
        #[test]
        fn triangles_cover_the_field_once_without_t_junctions_in_four_shapes(
            bumps in prop::collection::vec((0usize..33 * 33, -50i32..50), 0..12),
            threshold in 0.0f64..3.0, observer in prop::option::of((0.0f64..32.0, 0.0f64..32.0))
        ) {
            let mut heights = vec![0.0; 33 * 33];
            for (slot, h) in bumps { heights[slot] = f64::from(h); }
            let field = Field::new(5, heights, [10.0, 10.0]).unwrap();
            let observer = observer.map(|(x, y)| Observer { at: [x, y], forgiveness: 5.0 });
            let tree = Quadtree::new(&field, &Sums::new(&field, None), threshold, observer);
            let all = triangles(&tree);
            prop_assert!(all.iter().all(|t| double_area(*t) > 0));
            prop_assert_eq!(all.iter().map(|t| double_area(*t)).sum::<i64>(), 2 * 32 * 32);
            let mut edges: BTreeMap<[Point; 2], i32> = BTreeMap::new();
            let mut shapes = BTreeSet::new();
            for t in &all {
                let mut sides: Vec<i64> = (0..3).map(|i| {
                    let (u, v) = (t[i], t[(i + 1) % 3]);
                    *edges.entry([u, v]).or_default() += 1;
                    *edges.entry([v, u]).or_default() -= 1;
                    (0..2).map(|k| (i64::from(u[k]) - i64::from(v[k])).pow(2)).sum()
                }).collect();
                sides.sort_unstable();
                // Ratios of squares to the shortest, times four: whole numbers for all shapes.
                shapes.insert([4 * sides[1] / sides[0], 4 * sides[2] / sides[0]]);
            }
            prop_assert!(shapes.len() <= 4, "{:?}", shapes);
            for ([u, v], balance) in edges {
                let border = (0..2).any(|i| u[i] == v[i] && (u[i] == 0 || u[i] == 32));
                prop_assert!(balance == 0 || border, "{:?} {:?}", u, v);
            }
        }
    }

    #[test]
    fn every_case_has_two_triangles_and_one_more_for_each_middle() {
        for middles in 0..16u8 {
            assert_eq!(turned(middles).len(), 2 + middles.count_ones() as usize, "{middles:04b}");
        }
    }

    #[test]
    fn distance_and_masks_take_triangles_away() {
        let heights = (0..65 * 65).map(|s: u32| f64::from(s.wrapping_mul(2_654_435_761) >> 24)).collect();
        let field = Field::new(6, heights, [30.0, 30.0]).unwrap();
        let sums = Sums::new(&field, None);
        let count = |sums: &Sums, observer| triangles(&Quadtree::new(&field, sums, 300.0, observer)).len();
        let plain = count(&sums, None);
        let observer = Observer { at: [0.0, 0.0], forgiveness: 20.0 };
        assert!(count(&sums, Some(observer)) < plain);
        let mut mask = vec![0.0; 65 * 65];
        mask[..65 * 20].fill(1.0);
        assert!(count(&Sums::new(&field, Some(&mask)), None) < plain);
    }

    #[test]
    fn one_sample_without_data_takes_no_more_away_than_its_own_triangles() {
        for missing in [[64u32, 0], [0, 0], [40, 17], [33, 64]] {
            let mut heights = vec![100.0; 65 * 65];
            heights[missing[1] as usize * 65 + missing[0] as usize] = f64::NAN;
            let field = Field::new(6, heights, [30.0, 30.0]).unwrap();
            let all = triangles(&Quadtree::new(&field, &Sums::new(&field, None), 1e9, None));
            let drawn: Vec<_> = all.iter().filter(|t| t.iter().all(|p| !field.at(*p).is_nan())).collect();
            let area: i64 = drawn.iter().map(|t| double_area(**t)).sum();
            // The finest triangles around it, of one or two halves of a cell.
            assert!(2 * 64 * 64 - area <= 8, "{missing:?}: {area}");
            assert!(all.len() < 500, "{missing:?}: {}", all.len());
        }
    }
}
