//! What is kept between frames: surfaces under a byte budget, and pages of the index.
//!
//! A surface can be decoded only with its parents' at hand, so the resident set always holds the parents of
//! each of its members. Eviction keeps that true by taking leaves alone, least recently used first. What
//! the last cut wants is never evicted.

use crate::surface::Surface;
use diamantina_protocol::bintree::Forest;
use diamantina_protocol::diamond::Diamond;
use diamantina_protocol::index::{self, Entry};
use foldhash::fast::RandomState;
use std::cmp::Reverse;
use std::collections::{BinaryHeap, HashMap, HashSet};
use std::sync::Arc;

/// Pages of a layer's index that are kept beyond those that the cut looks at. A page takes some 40 kB, so
/// 20 MB.
pub const PAGES_MAX: usize = 512;

/// A layer's number and a diamond of it.
pub type Key = (usize, Diamond);

/// Surfaces under a byte budget.
#[derive(Debug)]
pub struct Cache {
    forests: Vec<Forest>,
    budget_bytes: usize,
    bytes: usize,
    /// Of each layer whether its roots stay, whatever the budget.
    keeps_roots: Vec<bool>,
    /// Counts cuts. What was used at `now` is wanted by the last one.
    now: u64,
    held: HashMap<Key, Held, RandomState>,
    asked: Asked,
}

/// How often a diamond was wanted that the cut before did not want.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, serde::Serialize)]
pub struct Asked {
    /// It was resident.
    pub found: u64,
    /// It had to come first, and did.
    pub came: u64,
}

impl Asked {
    /// The share of those that were resident, 0 to 1; `None` if nothing was wanted yet.
    #[must_use]
    pub fn found_share(&self) -> Option<f64> {
        let all = self.found + self.came;
        (all > 0).then(|| self.found as f64 / all as f64)
    }
}

#[derive(Debug)]
struct Held {
    surface: Arc<Surface>,
    used: u64,
    /// Resident children.
    children: u8,
}

impl Cache {
    /// An empty cache for layers with these forests. Every root stays resident whatever the budget, so
    /// that something can always be drawn.
    #[must_use]
    pub fn new(forests: Vec<Forest>, budget_bytes: usize) -> Self {
        let keeps_roots = vec![true; forests.len()];
        let asked = Asked::default();
        Self { forests, budget_bytes, bytes: 0, keeps_roots, now: 1, held: HashMap::default(), asked }
    }

    /// Says whether the roots of a layer stay resident whatever the budget. Those of a layer that is not to be drawn for
    /// now need not.
    pub fn keep_roots(&mut self, layer: usize, keep: bool) {
        self.keeps_roots[layer] = keep;
    }

    /// Whether a surface stays whatever is wanted: a root.
    fn stays(&self, (layer, d): Key) -> bool {
        d.level() == 0 && self.keeps_roots[layer]
    }

    /// The surface of a diamond, if it is resident.
    #[must_use]
    pub fn get(&self, key: Key) -> Option<&Arc<Surface>> {
        self.held.get(&key).map(|held| &held.surface)
    }

    /// Bytes of the resident surfaces.
    #[must_use]
    pub fn bytes(&self) -> usize {
        self.bytes
    }

    /// The bytes that they may take, but for roots.
    #[must_use]
    pub fn budget_bytes(&self) -> usize {
        self.budget_bytes
    }

    /// How often what was wanted anew was resident so far.
    #[must_use]
    pub fn asked(&self) -> Asked {
        self.asked
    }

    /// How many surfaces are resident.
    #[must_use]
    pub fn len(&self) -> usize {
        self.held.len()
    }

    /// Whether nothing is resident.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.held.is_empty()
    }

    /// Tells what a new cut wants. It must hold the parents of each of its members.
    pub fn want(&mut self, keys: impl Iterator<Item = Key>) {
        self.now += 1;
        for key in keys {
            if let Some(held) = self.held.get_mut(&key) {
                self.asked.found += u64::from(held.used + 1 < self.now);
                held.used = self.now;
            }
        }
    }

    /// Takes a surface in, and says whether it did: not without its parents, nor where only surfaces that
    /// the last cut wants could make room. One that is not `wanted` itself evicts nothing.
    pub fn insert(&mut self, key: Key, surface: Arc<Surface>, wanted: bool) -> bool {
        let (layer, d) = key;
        let forest = self.forests[layer];
        if self.held.contains_key(&key) || !self.has_parents(&forest, key) {
            return false;
        }
        let bytes = surface.bytes(&forest, d);
        let room = if wanted {
            // Unless it has a share in the cut, a parent could be evicted to make room for its child.
            self.touch_ancestors(&forest, key);
            self.make_room(bytes)
        } else {
            self.bytes + bytes <= self.budget_bytes
        };
        if !room && !self.stays(key) {
            return false;
        }
        for parent in forest.parents(d) {
            if let Some(held) = self.held.get_mut(&(layer, parent)) {
                held.children += 1;
            }
        }
        self.bytes += bytes;
        self.asked.came += u64::from(wanted);
        let used = if wanted { self.now } else { self.now - 1 };
        self.held.insert(key, Held { surface, used, children: 0 });
        true
    }

    fn has_parents(&self, forest: &Forest, (layer, d): Key) -> bool {
        forest.parents(d).all(|parent| self.held.contains_key(&(layer, parent)))
    }

    fn touch_ancestors(&mut self, forest: &Forest, (layer, d): Key) {
        let mut ancestors: Vec<Diamond> = forest.parents(d).collect();
        while let Some(ancestor) = ancestors.pop() {
            // Ancestors of what was used are used: this ends at the first one.
            if let Some(held) = self.held.get_mut(&(layer, ancestor)).filter(|held| held.used < self.now) {
                held.used = self.now;
                ancestors.extend(forest.parents(ancestor));
            }
        }
    }

    /// Evicts until `bytes` more fit; whether they do.
    fn make_room(&mut self, bytes: usize) -> bool {
        if self.bytes + bytes <= self.budget_bytes {
            return true;
        }
        // A little more than needed, so that the list of leaves is not made for each surface.
        let goal = self.budget_bytes.saturating_sub(bytes + self.budget_bytes / 32);
        let mut leaves: BinaryHeap<Reverse<(u64, Key)>> = self
            .held
            .iter()
            .filter(|(key, held)| held.children == 0 && held.used < self.now && !self.stays(**key))
            .map(|(key, held)| Reverse((held.used, *key)))
            .collect();
        while self.bytes > goal {
            let Some(Reverse((_, key))) = leaves.pop() else { break };
            let (layer, d) = key;
            let forest = self.forests[layer];
            let Some(held) = self.held.remove(&key) else { continue };
            self.bytes -= held.surface.bytes(&forest, d);
            for parent in forest.parents(d) {
                let stays = self.stays((layer, parent));
                let Some(held) = self.held.get_mut(&(layer, parent)) else { continue };
                held.children -= 1;
                if held.children == 0 && held.used < self.now && !stays {
                    leaves.push(Reverse((held.used, (layer, parent))));
                }
            }
        }
        self.bytes + bytes <= self.budget_bytes
    }
}

/// The pages of a layer's index that have arrived.
#[derive(Debug)]
pub struct Index {
    forest: Forest,
    entries: HashMap<Diamond, Entry, RandomState>,
    /// When each page was last looked at.
    pages: HashMap<u32, u64, RandomState>,
    now: u64,
}

impl Index {
    /// An index without pages.
    #[must_use]
    pub fn new(forest: Forest) -> Self {
        Self { forest, entries: HashMap::default(), pages: HashMap::default(), now: 0 }
    }

    /// What the index says of a diamond, if its page is there.
    #[must_use]
    pub fn get(&self, d: Diamond) -> Option<Entry> {
        self.entries.get(&d).copied()
    }

    /// How many pages are there.
    #[must_use]
    pub fn pages(&self) -> usize {
        self.pages.len()
    }

    /// Whether a page is there.
    #[must_use]
    pub fn has(&self, page: u32) -> bool {
        self.pages.contains_key(&page)
    }

    /// Takes a page in.
    pub fn insert(&mut self, page: u32, entries: impl IntoIterator<Item = (Diamond, Entry)>) {
        self.entries.extend(entries);
        self.pages.insert(page, self.now);
    }

    /// Forgets the pages least recently looked at, down to `pages_max`, but none that holds a diamond of
    /// `seen`: what the last cut looked at. Costs nothing while there are few.
    pub fn trim(&mut self, pages_max: usize, seen: impl Iterator<Item = Diamond>) {
        if self.pages.len() <= pages_max {
            return;
        }
        self.now += 1;
        let needed: HashSet<u32, RandomState> = seen.map(|d| index::page_of(&self.forest, d)).collect();
        for page in &needed {
            if let Some(used) = self.pages.get_mut(page) {
                *used = self.now;
            }
        }
        let mut idle: Vec<(u64, u32)> =
            self.pages.iter().filter(|(p, _)| !needed.contains(p)).map(|(p, used)| (*used, *p)).collect();
        idle.sort_unstable();
        for (_, page) in idle.into_iter().take(self.pages.len() - pages_max) {
            self.pages.remove(&page);
            for d in index::page_diamonds(&self.forest, page).unwrap_or_default() {
                self.entries.remove(&d);
            }
        }
    }
}

#[cfg(test)]
#[allow(
    clippy::cast_possible_truncation,
    clippy::cast_possible_wrap,
    clippy::cast_sign_loss,
    reason = "small numbers"
)]
mod tests {
    use super::*;
    use crate::cut::{Ask, choose};
    use crate::encoding::Encoding;
    use crate::sight::Sight;
    use crate::surface::Points;
    use crate::world::{Dice, any_camera, surfaces, world};

    #[test]
    fn over_a_random_flight_the_budget_holds_and_no_needed_ancestor_goes() {
        let built = &world()[0];
        let forest = built.layer.forest;
        let all = surfaces(built, |_| true);
        let size = Points::bytes(&forest, 0);
        let mut cache = Cache::new(vec![forest], 300 * size + size / 2);
        let mut dice = Dice(11);
        let mut evicted = 0;
        for _ in 0..300 {
            let camera = any_camera(&mut dice);
            let ask = Ask {
                layer: &built.layer,
                encoding: Encoding::Points,
                camera: &camera,
                exaggeration: 1.0,
                tolerance_pixels: 0.5,
                sight: Sight::default(),
                seen: None,
                memory_bytes: 225 * size,
                gpu: None,
            };
            let ideal = choose(&ask, |d| Some(built.entries[&d]));
            cache.want(ideal.splits().map(|d| (0, d)));
            let before = cache.len();
            let mut inserted = 0;
            for d in ideal.splits() {
                // Some arrive for a cut that is no longer wanted, some without their parents.
                let stray = built.diamonds[(dice.roll() * built.diamonds.len() as f64) as usize];
                inserted +=
                    usize::from(cache.insert((0, stray), Arc::clone(&all[&stray]), ideal.contains(stray)));
                if dice.roll() < 0.9 {
                    inserted += usize::from(cache.insert((0, d), Arc::clone(&all[&d]), true));
                }
                assert!(cache.bytes() <= cache.budget_bytes);
                let sum: usize = cache.held.keys().map(|(_, d)| Points::bytes(&forest, d.level())).sum();
                assert_eq!(cache.bytes(), sum);
            }
            evicted += before + inserted - cache.len();
            for (_, d) in cache.held.keys() {
                assert!(forest.parents(*d).all(|p| cache.get((0, p)).is_some()), "an ancestor is gone");
            }
            // What the cut wants, asked for in its order, always finds room, and then all of it is there.
            for d in ideal.splits() {
                cache.insert((0, d), Arc::clone(&all[&d]), true);
            }
            assert!(ideal.splits().all(|d| cache.get((0, d)).is_some()), "something wanted is gone");
        }
        println!("{evicted} surfaces evicted, {} resident", cache.len());
        assert!(evicted > 1000);
    }

    #[test]
    fn roots_stay_however_small_the_budget() {
        let built = &world()[0];
        let all = surfaces(built, |d| d.level() < 2);
        let mut cache = Cache::new(vec![built.layer.forest], 0);
        for d in built.layer.forest.root_diamonds() {
            assert!(cache.insert((0, d), Arc::clone(&all[&d]), true));
        }
        let child = built.layer.forest.diamonds(1).next().unwrap();
        assert!(!cache.insert((0, child), Arc::clone(&all[&child]), true));
        assert_eq!(cache.len(), 2);
    }

    #[test]
    fn what_comes_into_sight_again_is_found_once() {
        let built = &world()[0];
        let all = surfaces(built, |d| d.level() < 2);
        let mut cache = Cache::new(vec![built.layer.forest], usize::MAX);
        assert_eq!(cache.asked().found_share(), None);
        let roots: Vec<Diamond> = built.layer.forest.root_diamonds().collect();
        let want = |cache: &mut Cache, wanted: &[Diamond]| cache.want(wanted.iter().map(|d| (0, *d)));
        want(&mut cache, &roots);
        for d in &roots {
            assert!(cache.insert((0, *d), Arc::clone(&all[d]), true));
        }
        assert_eq!(cache.asked(), Asked { found: 0, came: 2 });
        // As long as they stay in sight nothing is asked for.
        want(&mut cache, &roots);
        want(&mut cache, &roots);
        assert_eq!(cache.asked(), Asked { found: 0, came: 2 });
        want(&mut cache, &roots[..1]);
        want(&mut cache, &roots);
        assert_eq!(cache.asked(), Asked { found: 1, came: 2 });
        want(&mut cache, &[]);
        want(&mut cache, &roots);
        want(&mut cache, &roots);
        assert_eq!(cache.asked(), Asked { found: 3, came: 2 });
        assert_eq!(cache.asked().found_share(), Some(0.6));
    }

    #[test]
    fn roots_of_a_layer_that_is_not_drawn_make_room_for_what_is() {
        let built = &world()[0];
        let forest = built.layer.forest;
        let all = surfaces(built, |d| d.level() < 2);
        let roots: Vec<Diamond> = forest.root_diamonds().collect();
        let size = all[&roots[0]].bytes(&forest, roots[0]);
        let mut cache = Cache::new(vec![forest; 3], 2 * size);
        // Two roots of each: those of the first are wanted, those of the second were.
        for layer in [1, 0] {
            cache.want(std::iter::empty());
            for d in &roots {
                assert!(cache.insert((layer, *d), Arc::clone(&all[d]), true), "roots always find room");
            }
        }
        assert_eq!(cache.len(), 4);
        cache.keep_roots(1, false);
        cache.keep_roots(2, false);
        assert!(!cache.insert((2, roots[0]), Arc::clone(&all[&roots[0]]), false), "not beyond the budget");
        cache.want(roots.iter().map(|d| (0, *d)));
        let child = forest.diamonds(1).next().unwrap();
        let _ = cache.insert((0, child), Arc::clone(&all[&child]), true);
        assert!(roots.iter().all(|d| cache.get((0, *d)).is_some() && cache.get((1, *d)).is_none()));
    }

    #[test]
    fn pages_beyond_the_limit_go_but_not_those_looked_at() {
        let built = &world()[1];
        let forest = built.layer.forest;
        let mut index = Index::new(forest);
        for page in 0..index::pages(&forest) {
            let diamonds = index::page_diamonds(&forest, page).unwrap();
            index.insert(page, diamonds.into_iter().map(|d| (d, built.entries[&d])));
        }
        assert!(index.pages() > 3);
        let one = index::page_of(&forest, built.diamonds[built.diamonds.len() - 1]);
        let seen: Vec<Diamond> =
            built.diamonds.iter().copied().filter(|d| index::page_of(&forest, *d) == one).collect();
        index.trim(3, seen.iter().copied());
        assert_eq!(index.pages(), 3);
        assert!(seen.iter().all(|d| index.get(*d) == Some(built.entries[d])));
        let held = built.diamonds.iter().filter(|d| index.get(**d).is_some()).count();
        assert_eq!(held, index.entries.len());
        index.trim(2, std::iter::empty());
        assert_eq!(index.pages(), 2);
    }
}
