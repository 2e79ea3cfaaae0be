//! The rim of water: a ring of triangles around what has heights, so that it runs on under the ground.
//!
//! Water has heights where it is wet, at samples. Drawn as far as those it would end in the corners of their cells, and in the
//! air, since the last of them stands above its bed. The ring goes as high as the points beside it, and the ground that it runs
//! under shows where the shore is.
//!
//! ```text
//!   o---o---.---.        o: points that have heights, and triangles between them.
//!   | \ | \ : \ :        .: points of the rim. Each triangle with a point of both belongs to the ring.
//!   o---o---.---.
//! ```
//!
//! Whether a triangle belongs to it follows from its own corners, so rings of diamonds that meet cover each place once. How high a
//! point is on the border between two is for each of them to say: under the ground nobody sees it.

use super::triangles::{Form, Lists, lists, places};
use diamantina_protocol::NODATA;
use diamantina_protocol::diamond::Block;

/// What is drawn around the water of a diamond.
pub(crate) struct Rim {
    /// The heights of all slots, those of the rim's points among them.
    pub(crate) heights: Vec<i32>,
    /// The ring's triangles.
    pub(crate) lists: Lists,
}

/// The rim of a diamond, of those points whose doubled local coordinates `is_within` accepts.
pub(crate) fn rim(block: &Block, is_within: impl Fn([u16; 2]) -> bool) -> Rim {
    let (form, own) = (Form::of(block), block.heights());
    let places = places(form);
    let all = lists(form, |slot| own[slot] != NODATA || is_within(places[slot]));
    let known = |slot: u16| Some(own[usize::from(slot)]).filter(|height| *height != NODATA);
    let is_mixed = |triangle: &&[u16]| {
        let count = triangle.iter().filter(|slot| known(**slot).is_some()).count();
        0 < count && count < 3
    };
    let mut sums = vec![(0i64, 0i64); own.len()];
    let parts = all.sides.map(|side| {
        let side = &all.indices[side.start as usize..side.end as usize];
        side.chunks_exact(3).filter(is_mixed).flatten().copied().collect::<Vec<u16>>()
    });
    for triangle in parts.iter().flat_map(|part| part.chunks_exact(3)) {
        for beside in triangle.iter().filter_map(|slot| known(*slot)) {
            for slot in triangle {
                let (sum, count) = &mut sums[usize::from(*slot)];
                (*sum, *count) = (*sum + i64::from(beside), *count + 1);
            }
        }
    }
    let height = |(own, (sum, count)): (&i32, &(i64, i64))| match (*own, *count) {
        (NODATA, 1..) => i32::try_from(sum / count).unwrap_or(NODATA),
        (own, _) => own,
    };
    Rim { heights: own.iter().zip(&sums).map(height).collect(), lists: Lists::of(&parts) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::surface::triangles::lists_of;
    use crate::world::Dice;
    use diamantina_protocol::bintree::Forest;
    use std::collections::HashSet;

    fn triangles(lists: &Lists) -> HashSet<[u16; 3]> {
        lists.indices.chunks_exact(3).map(|t| [t[0], t[1], t[2]]).collect()
    }

    #[test]
    fn each_triangle_with_a_height_is_waters_or_its_rims_and_no_other() {
        let forest = Forest::new(6, 3, [1, 1]).unwrap();
        let mut dice = Dice(5);
        for level in [2, 3] {
            let d = forest.diamonds(level).next().unwrap();
            let mut block = Block::empty(&forest, level);
            block.fill(&forest.local(d), |_, _| {
                if dice.roll() < 0.4 { NODATA } else { [100, 108][usize::from(dice.roll() < 0.5)] }
            });
            let rim = rim(&block, |_| true);
            let (wet, ring) = (triangles(&lists_of(&block)), triangles(&rim.lists));
            let heights = block.heights();
            let has = |slot: u16| heights[usize::from(slot)] != NODATA;
            for triangle in triangles(&lists(Form::of(&block), |_| true)) {
                let count = triangle.iter().filter(|slot| has(**slot)).count();
                assert_eq!((wet.contains(&triangle), ring.contains(&triangle)), (count == 3, count % 3 > 0));
                for slot in triangle.iter().filter(|_| count > 0) {
                    assert!((100..109).contains(&rim.heights[usize::from(*slot)]));
                }
            }
            assert!(!wet.is_empty() && !ring.is_empty());
            let unchanged =
                heights.iter().zip(&rim.heights).all(|(own, drawn)| *own == NODATA || own == drawn);
            assert!(unchanged, "what has heights keeps them");
        }
    }

    #[test]
    fn the_rim_ends_where_it_may_not_be() {
        let forest = Forest::new(6, 3, [1, 1]).unwrap();
        let d = forest.diamonds(2).next().unwrap();
        let mut block = Block::empty(&forest, 2);
        let centre = d.centre();
        block.fill(&forest.local(d), |x, _| if x < centre[0] { 7 } else { NODATA });
        assert!(!rim(&block, |_| true).lists.indices.is_empty());
        let none = rim(&block, |_| false);
        assert!(none.lists.indices.is_empty() && none.heights == block.heights());
    }
}
