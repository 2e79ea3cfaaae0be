//! The cut: what to draw and what to ask for, from a camera and the index.
//!
//! A cut is a set of *split* diamonds that holds the parents of each of its members. Such a set covers the
//! forest once, and neighbours share their edges, whatever else is in it: so all that this module must
//! ensure is that no diamond is in a set without its parents. Two sets are made. The *ideal* one comes
//! from the index alone: the largest error in pixels is split first, until none is above the tolerance or
//! the memory is spent. The *drawn* one is what of it has arrived.
//!
//! A split diamond shows up to four triangles; each belongs to a child diamond and is drawn unless that
//! child is split too. What a drawn triangle lacks is therefore the error of the *child*.
//!
//! Pure functions: no clock, no network, no memory from frame to frame. The order of refinement is that of
//! Duchaineau et al., *ROAMing Terrain* (1997), the forced parents likewise.

mod show;

pub use show::{Showing, show, sight};

use crate::camera::{Bounds, Camera, Plane, nearest_drawn};
use crate::drawing::DrawItem;
use crate::sight::{self, Sight};
use crate::surface::Surface;
use diamantina_protocol::bintree::Forest;
use diamantina_protocol::diamond::Diamond;
use diamantina_protocol::index::{self, Entry};
use diamantina_protocol::message::Layer;
use diamantina_protocol::sight::is_vertical;
use diamantina_protocol::zone::Mask;
use foldhash::fast::RandomState;
use glam::DVec3;
use std::cmp::Ordering;
use std::collections::{BinaryHeap, HashMap, HashSet};
use std::sync::Arc;

/// Stands for "no such node".
const NONE: u32 = u32::MAX;

/// What is asked of a layer's cut.
#[derive(Debug, Clone, Copy)]
pub struct Ask<'a> {
    /// The layer.
    pub layer: &'a Layer,
    /// The view.
    pub camera: &'a Camera,
    /// What heights are multiplied by; those of the camera are already.
    pub exaggeration: f64,
    /// The error to reach, in pixels.
    pub tolerance_pixels: f64,
    /// How errors count on the screen.
    pub sight: Sight,
    /// What counts of errors, while the eye is in a zone.
    pub seen: Option<Seen<'a>>,
    /// Bytes that the surfaces of split diamonds may take; the roots are split in any case.
    pub memory_bytes: usize,
}

/// What is seen of a layer's diamonds from the zone that the eye is in.
#[derive(Debug, Clone, Copy)]
pub struct Seen<'a> {
    /// The visibility of each diamond.
    pub mask: &'a Mask,
    /// How many times as much as that counts of an error, though no more than all; 1 or more.
    pub coarser: f64,
}

impl Ask<'_> {
    /// The box of a diamond as it is drawn.
    fn bounds(&self, d: Diamond, entry: &Entry) -> Bounds {
        bounds(self.layer, d, entry).stretched(self.exaggeration)
    }

    /// What counts of the error of a diamond, 0 to 1: at most what counts of its parents'.
    fn share(&self, d: Diamond) -> f64 {
        self.seen.map_or(1.0, |seen| (seen.mask.share(d) * seen.coarser).min(1.0))
    }

    /// The largest apparent size, in pixels, of the error of triangles of a level anywhere in the box of a diamond, as
    /// far as it counts.
    fn pixels(&self, d: Diamond, level: u32, error_metres: f32, bounds: &Bounds) -> f64 {
        let layer = self.layer;
        let vertical = is_vertical(&layer.forest, level, error_metres, layer.cell);
        // Heights pressed together leave the errors of outlines as they are.
        let stretch = if vertical { self.exaggeration } else { self.exaggeration.max(1.0) };
        let error =
            sight::Error { metres: f64::from(error_metres) * stretch, vertical, share: self.share(d) };
        self.sight.pixels(self.camera, error, bounds, nearest_drawn(layer.cell))
    }
}

/// The set of diamonds that should be split, from the index alone.
///
/// Takes about 80 bytes for each diamond that was looked at: some four for each one split.
#[derive(Debug, Default)]
pub struct Ideal {
    nodes: Vec<Node>,
    numbers: HashMap<Diamond, u32, RandomState>,
    /// Numbers of the split nodes, parents before children.
    splits: Vec<u32>,
    pages: Vec<u32>,
    /// For each of the splits, the error in pixels of the triangles that no child has; 0 above the finest level.
    finest_pixels: Vec<f64>,
}

/// A diamond that was looked at.
#[derive(Debug, Clone, Copy)]
struct Node {
    diamond: Diamond,
    /// From the index or, where the page is not there, a bound from the parent's.
    entry: Entry,
    known: bool,
    in_view: bool,
    /// The error in pixels where it is drawn unsplit; 0 out of view.
    pixels: f64,
    /// How urgently its payload is needed: the clamped error, of itself or of what needs it.
    priority: f64,
    split: bool,
    parents: [u32; 2],
    children: [u32; 4],
}

/// A payload that the ideal set lacks.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Wish {
    /// The diamond.
    pub diamond: Diamond,
    /// Bytes of its payload: 0 where there is nothing to fetch, `None` where the index is not there yet.
    pub bytes: Option<u32>,
    /// How urgent it is: pixels of error, of itself or of what needs it, at most the picture's height.
    pub priority: f64,
}

impl Wish {
    /// Most urgent first: roots, then by priority, then coarse before fine, so parents before children.
    #[must_use]
    pub fn order(&self, other: &Self) -> Ordering {
        let is_inner = |wish: &Self| wish.diamond.level() > 0;
        is_inner(self)
            .cmp(&is_inner(other))
            .then(other.priority.total_cmp(&self.priority))
            .then(self.diamond.level().cmp(&other.diamond.level()))
    }
}

/// What of the ideal set can be drawn, and what it lacks.
#[derive(Debug, Default)]
pub struct Drawing {
    /// The triangles to draw; those out of view are left out.
    pub items: Vec<DrawItem>,
    /// The payloads that the ideal set lacks, most urgent first, parents before children.
    pub wishes: Vec<Wish>,
    /// The largest declared error of what is drawn in view, in pixels; infinite while a root is missing.
    pub error_pixels: f64,
    /// The same, once all the wishes are there.
    pub error_pixels_goal: f64,
    /// Diamonds drawn as split, in view or not: parents before children.
    pub splits: Vec<Diamond>,
}

impl Ideal {
    /// The split diamonds, parents before children.
    pub fn splits(&self) -> impl Iterator<Item = Diamond> + '_ {
        self.splits.iter().map(|i| self.node(*i).diamond)
    }

    /// How many diamonds are split.
    #[must_use]
    pub fn len(&self) -> usize {
        self.splits.len()
    }

    /// Whether nothing is split.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.splits.is_empty()
    }

    /// Whether a diamond is split.
    #[must_use]
    pub fn contains(&self, d: Diamond) -> bool {
        self.numbers.get(&d).is_some_and(|i| self.node(*i).split)
    }

    /// Every diamond that was looked at: the split ones, their children and their parents.
    pub fn seen(&self) -> impl Iterator<Item = Diamond> + '_ {
        self.nodes.iter().map(|node| node.diamond)
    }

    /// Pages of the index without which it is not known what to split, most urgent first.
    #[must_use]
    pub fn pages(&self) -> &[u32] {
        &self.pages
    }

    fn node(&self, number: u32) -> &Node {
        &self.nodes[number as usize]
    }
}

/// Chooses what should be split. `entry` looks a diamond up in the index, as far as it has arrived.
///
/// Takes about a microsecond for each diamond looked at.
#[must_use]
pub fn choose(ask: &Ask, entry: impl Fn(Diamond) -> Option<Entry>) -> Ideal {
    let mut chooser = Chooser {
        ask,
        forest: ask.layer.forest,
        planes: ask.camera.planes(),
        entry,
        ideal: Ideal::default(),
        heap: BinaryHeap::new(),
        wanted: HashSet::default(),
        spent_bytes: 0,
    };
    let roots: Vec<u32> = chooser.forest.root_diamonds().map(|root| chooser.see(root, None)).collect();
    for root in roots {
        let node = *chooser.ideal.node(root);
        if !node.known {
            chooser.want_page(node.diamond);
        }
        if !node.entry.is_empty() {
            chooser.split(root);
        }
    }
    while let Some(Candidate { number, .. }) = chooser.heap.pop() {
        if !chooser.ideal.node(number).split {
            chooser.force(number);
        }
    }
    let mut ideal = chooser.ideal;
    // Whoever is needed is as urgent as who needs it; children come later in the list.
    for at in (0..ideal.splits.len()).rev() {
        let Node { parents, priority, .. } = *ideal.node(ideal.splits[at]);
        for parent in parents.into_iter().filter(|p| *p != NONE) {
            let parent = &mut ideal.nodes[parent as usize];
            parent.priority = parent.priority.max(priority);
        }
    }
    ideal
}

/// What of `ideal` can be drawn. `surface` gives the surface of a diamond that is resident.
///
/// Until every root is there nothing is drawn; from then on the forest is always covered.
#[must_use]
pub fn draw(
    number: usize,
    ask: &Ask,
    ideal: &Ideal,
    surface: impl Fn(Diamond) -> Option<Arc<Surface>>,
) -> Drawing {
    let mut drawing = Drawing::default();
    // Surfaces of the nodes that are drawn as split.
    let mut drawn: Vec<Option<Arc<Surface>>> = vec![None; ideal.nodes.len()];
    let mut whole = true;
    for i in &ideal.splits {
        let node = ideal.node(*i);
        let here = surface(node.diamond);
        if here.is_none() {
            let bytes = node.known.then_some(node.entry.bytes);
            drawing.wishes.push(Wish { diamond: node.diamond, bytes, priority: node.priority });
            whole &= node.diamond.level() > 0;
        }
        if node.parents.iter().all(|p| *p == NONE || drawn[*p as usize].is_some()) {
            drawing.splits.extend(here.as_ref().map(|_| node.diamond));
            drawn[*i as usize] = here;
        }
    }
    drawing.wishes.sort_by(Wish::order);
    for (i, finest) in ideal.splits.iter().zip(&ideal.finest_pixels) {
        let sides = Sides::of(ask, ideal, *i, *finest, |child| ideal.node(child).split);
        drawing.error_pixels_goal = drawing.error_pixels_goal.max(sides.error_pixels);
        let Some(surface) = drawn[*i as usize].as_ref().filter(|_| whole) else { continue };
        let sides = Sides::of(ask, ideal, *i, *finest, |child| drawn[child as usize].is_some());
        drawing.error_pixels = drawing.error_pixels.max(sides.error_pixels);
        if sides.bits != 0 {
            let diamond = ideal.node(*i).diamond;
            drawing.items.push(DrawItem {
                layer: number,
                diamond,
                surface: Arc::clone(surface),
                sides: sides.bits,
                moving: None,
            });
        }
    }
    if !whole {
        drawing.error_pixels = f64::INFINITY;
    }
    drawing
}

/// The triangles that a split diamond shows.
struct Sides {
    bits: u8,
    error_pixels: f64,
}

impl Sides {
    fn of(ask: &Ask, ideal: &Ideal, number: u32, finest: f64, is_split: impl Fn(u32) -> bool) -> Self {
        let node = ideal.node(number);
        let forest = &ask.layer.forest;
        if node.diamond.level() + 1 == forest.levels() {
            // The finest triangles belong to no child.
            let bits = if forest.local(node.diamond).upper { 0b1111 } else { 0b11 };
            return Self { bits: if node.in_view { bits } else { 0 }, error_pixels: finest };
        }
        let mut sides = Self { bits: 0, error_pixels: 0.0 };
        for (side, child) in node.children.into_iter().enumerate() {
            if child == NONE || is_split(child) {
                continue;
            }
            let child = ideal.node(child);
            if child.in_view && !child.entry.is_empty() {
                sides.bits |= 1 << side;
                sides.error_pixels = sides.error_pixels.max(child.pixels);
            }
        }
        sides
    }
}

/// A node that wants to be split.
struct Candidate {
    pixels: f64,
    level: u32,
    number: u32,
}

impl Ord for Candidate {
    fn cmp(&self, other: &Self) -> Ordering {
        // Largest error first, then coarse before fine, then the order of discovery.
        self.pixels
            .total_cmp(&other.pixels)
            .then(other.level.cmp(&self.level))
            .then(other.number.cmp(&self.number))
    }
}

impl PartialOrd for Candidate {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

impl PartialEq for Candidate {
    fn eq(&self, other: &Self) -> bool {
        self.cmp(other) == Ordering::Equal
    }
}

impl Eq for Candidate {}

struct Chooser<'a, F> {
    ask: &'a Ask<'a>,
    forest: Forest,
    planes: [Plane; 5],
    entry: F,
    ideal: Ideal,
    heap: BinaryHeap<Candidate>,
    wanted: HashSet<u32, RandomState>,
    /// What the surfaces of the split diamonds take.
    spent_bytes: usize,
}

impl<F: Fn(Diamond) -> Option<Entry>> Chooser<'_, F> {
    /// The node of a diamond. Where the index does not know it, its `parent`'s error and heights hold,
    /// since they are saturated.
    fn see(&mut self, d: Diamond, parent: Option<Entry>) -> u32 {
        if let Some(number) = self.ideal.numbers.get(&d) {
            return *number;
        }
        let found = (self.entry)(d);
        let known = found.is_some();
        let entry = found.or(parent).unwrap_or_else(|| unknown(self.ask.layer));
        let bounds = self.ask.bounds(d, &entry);
        let in_view = !entry.is_empty() && bounds.touches(&self.planes);
        let pixels = if in_view { self.ask.pixels(d, d.level(), entry.error_metres, &bounds) } else { 0.0 };
        // Beyond the picture's height, more error is no worse.
        let priority = pixels.min(f64::from(self.ask.camera.size[1]));
        let number = u32::try_from(self.ideal.nodes.len()).unwrap_or(NONE);
        self.ideal.numbers.insert(d, number);
        self.ideal.nodes.push(Node {
            diamond: d,
            entry,
            known,
            in_view,
            pixels,
            priority,
            split: false,
            parents: [NONE; 2],
            children: [NONE; 4],
        });
        if pixels > self.ask.tolerance_pixels {
            self.heap.push(Candidate { pixels, level: d.level(), number });
        }
        number
    }

    fn want_page(&mut self, d: Diamond) {
        let page = index::page_of(&self.forest, d);
        if self.wanted.insert(page) {
            self.ideal.pages.push(page);
        }
    }

    /// Splits a node whose parents are split.
    fn split(&mut self, number: u32) {
        let Node { diamond, entry, in_view, .. } = *self.ideal.node(number);
        self.spent_bytes += Surface::bytes(&self.forest, diamond.level());
        let mut children = [NONE; 4];
        for (slot, child) in children.iter_mut().zip(self.forest.children(diamond)) {
            if let Some(child) = child {
                *slot = self.see(child, Some(entry));
            }
        }
        let mut parents = [NONE; 2];
        for (slot, parent) in parents.iter_mut().zip(self.forest.parents(diamond)) {
            *slot = self.see(parent, None);
        }
        let finest = diamond.level() + 1 == self.forest.levels() && in_view;
        self.ideal.finest_pixels.push(if finest {
            {
                let (level, finest) = (self.forest.levels(), self.ask.layer.finest_error);
                self.ask.pixels(diamond, level, finest, &self.ask.bounds(diamond, &entry))
            }
        } else {
            0.0
        });
        let node = &mut self.ideal.nodes[number as usize];
        (node.split, node.parents, node.children) = (true, parents, children);
        self.ideal.splits.push(number);
    }

    /// Splits a node and whichever ancestors are not split yet; or none of them, where the index does not
    /// know them all or the memory is spent.
    fn force(&mut self, number: u32) {
        if self.spent_bytes >= self.ask.memory_bytes {
            return;
        }
        let mut chain = vec![number];
        let mut blocked = false;
        let mut at = 0;
        while let Some(number) = chain.get(at).copied() {
            at += 1;
            let Node { diamond, entry, known, .. } = *self.ideal.node(number);
            if entry.is_empty() {
                return;
            }
            if !known {
                self.want_page(diamond);
                blocked = true;
            }
            for parent in self.forest.parents(diamond) {
                let parent = self.see(parent, None);
                if !self.ideal.node(parent).split && !chain.contains(&parent) {
                    chain.push(parent);
                }
            }
        }
        let level = |i: &u32| self.ideal.node(*i).diamond.level();
        let bytes: usize = chain.iter().map(|i| Surface::bytes(&self.forest, level(i))).sum();
        if blocked || self.spent_bytes + bytes > self.ask.memory_bytes {
            return;
        }
        chain.sort_by_key(|i| self.ideal.node(*i).diamond.level());
        for number in chain {
            self.split(number);
        }
    }
}

/// What holds for any diamond of a layer.
fn unknown(layer: &Layer) -> Entry {
    #[allow(clippy::cast_possible_truncation, reason = "saturates, and is a bound of what fits")]
    let quanta = |metres: f64| ((metres - layer.height_offset) / layer.quantum) as i32;
    Entry {
        error_metres: f32::INFINITY,
        low: quanta(layer.heights[0]).saturating_sub(1),
        high: quanta(layer.heights[1]).saturating_add(1),
        bytes: 0,
    }
}

/// The box around a diamond, in the frame's metres.
fn bounds(layer: &Layer, d: Diamond, entry: &Entry) -> Bounds {
    let [least, most] = layer.forest.bounds(d).map(|p| layer.position(p));
    let (low, high) = (layer.metres(entry.low), layer.metres(entry.high));
    Bounds {
        min: DVec3::new(least[0].min(most[0]), least[1].min(most[1]), low),
        max: DVec3::new(least[0].max(most[0]), least[1].max(most[1]), high),
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
    use crate::world::{Built, Dice, above, any_camera, surfaces, world};
    use diamantina_protocol::NODATA;
    use diamantina_protocol::diamond::Block;
    use std::time::Instant;

    type Side = Vec<([i64; 2], i32)>;

    fn ask<'a>(built: &'a Built, camera: &'a Camera, tolerance_pixels: f64) -> Ask<'a> {
        let sight = Sight::default();
        Ask {
            layer: &built.layer,
            camera,
            exaggeration: 1.0,
            tolerance_pixels,
            sight,
            seen: None,
            memory_bytes: usize::MAX,
        }
    }

    /// The three sides of a drawn triangle: lattice points with their heights, from the lesser end.
    fn sides_of(built: &Built, item: &DrawItem, side: usize) -> [Side; 3] {
        let local = built.layer.forest.local(item.diamond);
        let (n, centres) = (item.surface.block().segments(), item.surface.block().has_centres());
        let m = 2 * n as i64;
        let corners = [[0, 0], [m, 0], [m, m], [0, m]];
        let (a, b, centre) = (corners[side], corners[(side + 1) % 4], [m / 2, m / 2]);
        // Where centres are no points, half of a diagonal has half as many segments.
        let inner = if centres { n } else { n / 2 };
        [(a, b, n), (b, centre, inner), (centre, a, inner)].map(|(from, to, count)| {
            let mut points: Side = (0..=count as i64)
                .map(|i| {
                    let p = [0, 1].map(|k| from[k] + (to[k] - from[k]) * i / count as i64);
                    let slot = Block::slot(n, p[0] as usize, p[1] as usize);
                    (local.lattice2(p), item.surface.block().heights()[slot])
                })
                .collect();
            if points[0].0 > points[count].0 {
                points.reverse();
            }
            points
        })
    }

    fn double_area(side: &Side, other: &Side) -> i64 {
        let vector = |s: &Side| {
            let (a, b) = (s[0].0, s[s.len() - 1].0);
            [b[0] - a[0], b[1] - a[1]]
        };
        let (u, v) = (vector(side), vector(other));
        (u[0] * v[1] - u[1] * v[0]).abs()
    }

    /// Law 2: the drawn triangles cover the forest once, and neighbours share every height of their edge.
    fn assert_conforming(built: &Built, drawn: &[Diamond], items: &[DrawItem]) {
        let forest = &built.layer.forest;
        let mut area = 0;
        let mut sides: HashMap<Vec<[i64; 2]>, Vec<Vec<i32>>> = HashMap::new();
        for item in items {
            for q in (0..4).filter(|q| item.sides & (1 << q) != 0) {
                let triangle = sides_of(built, item, q);
                area += double_area(&triangle[0], &triangle[1]);
                for side in triangle {
                    let (points, heights): (Vec<_>, Vec<_>) = side.into_iter().unzip();
                    sides.entry(points).or_default().push(heights);
                }
            }
        }
        // Triangles left out because the index says that nothing is there.
        let mut void = 0;
        for root in forest.root_diamonds().filter(|root| built.entries[root].is_empty()) {
            let [a, b] = forest.bounds(root);
            void += 2 * i64::from(b[0] - a[0]) * i64::from(b[1] - a[1]);
        }
        for d in drawn.iter().copied() {
            let [u, v] = [forest.local(d).u, forest.local(d).v];
            let n = forest.segments_at(d.level()) as i64;
            let quarter = (u[0] * v[1] - u[1] * v[0]).abs() * n * n / 2;
            let empty = |c: &Diamond| built.entries[c].is_empty();
            void += quarter * forest.children(d).iter().flatten().filter(|c| empty(c)).count() as i64;
        }
        let [w, h] = forest.size().map(i64::from);
        assert_eq!(area + void, 2 * w * h, "covered once");
        for (points, heights) in sides {
            let on_border = |k: usize, at: i64| points.iter().all(|p| p[k] == at);
            let border = on_border(0, 0) || on_border(0, w) || on_border(1, 0) || on_border(1, h);
            match heights.as_slice() {
                [a, b] => assert!(!border && a == b, "a crack along {points:?}: {a:?} {b:?}"),
                [a] => assert!(
                    border || a.iter().all(|h| *h == NODATA),
                    "nothing beyond {points:?}, which has heights {a:?}"
                ),
                more => panic!("{} triangles along {points:?}", more.len()),
            }
        }
    }

    /// Sees everything: the eye is far above, and the field of view wide.
    fn all_seeing(dice: &mut Dice) -> Camera {
        let camera = any_camera(dice);
        let eye = DVec3::new(camera.eye.x, camera.eye.y, 30_000.0);
        Camera { eye, target: eye - DVec3::Z, fov_y: 2.6, ..camera }
    }

    #[test]
    fn any_cut_with_any_data_missing_covers_the_forest_once_without_cracks() {
        let mut dice = Dice(7);
        for built in world() {
            for round in 0..60 {
                let camera = all_seeing(&mut dice);
                let ask = ask(built, &camera, 0.02 * 300f64.powf(dice.roll()));
                let known = if round % 3 == 0 { 0.5 + dice.roll() / 2.0 } else { 1.0 };
                let levels = built.layer.forest.levels();
                let has = |d: Diamond, chance: f64| {
                    let [x, y] = d.centre();
                    d.level() == 0 || Dice(u64::from(x) << 32 | u64::from(y) ^ round).roll() < chance
                };
                // A page is there or not, with all its entries.
                let page = |d: Diamond| index::page_of(&built.layer.forest, d);
                let entry = |d: Diamond| {
                    (Dice(u64::from(page(d)) ^ round << 40).roll() < known).then(|| built.entries[&d])
                };
                let ideal = choose(&ask, entry);
                let arrived = 0.7 + 0.3 * dice.roll();
                let surfaces = surfaces(built, |d| has(d, arrived) && d.level() < levels);
                let drawing = draw(0, &ask, &ideal, |d| surfaces.get(&d).cloned());
                let splits: HashSet<Diamond> = ideal.splits().collect();
                for d in &splits {
                    assert!(
                        built.layer.forest.parents(*d).all(|p| splits.contains(&p)),
                        "closed under parents"
                    );
                }
                assert!(!drawing.items.is_empty());
                if known == 1.0 {
                    let drawn: Vec<_> = ideal.splits().filter(|d| surfaces.contains_key(d)).collect();
                    assert_eq!(drawn, drawing.splits);
                    assert_conforming(built, &drawn, &drawing.items);
                    assert!(drawing.error_pixels >= drawing.error_pixels_goal);
                }
            }
        }
    }

    #[test]
    fn chosen_from_any_view_the_ideal_set_reaches_the_tolerance() {
        let mut dice = Dice(3);
        let built = &world()[0];
        for _ in 0..200 {
            let camera = any_camera(&mut dice);
            let tolerance = 0.5 + 20.0 * dice.roll();
            let ask = ask(built, &camera, tolerance);
            let ideal = choose(&ask, |d| Some(built.entries[&d]));
            let splits: HashSet<Diamond> = ideal.splits().collect();
            let forest = &built.layer.forest;
            assert!(splits.iter().all(|d| forest.parents(*d).all(|p| splits.contains(&p))));
            for d in splits.iter() {
                for child in forest.children(*d).into_iter().flatten().filter(|c| !splits.contains(c)) {
                    let entry = built.entries[&child];
                    let bounds = bounds(&built.layer, child, &entry);
                    assert!(
                        entry.is_empty()
                            || !bounds.touches(&camera.planes())
                            || ask.pixels(child, child.level(), entry.error_metres, &bounds) <= tolerance
                    );
                }
            }
            let drawing = draw(0, &ask, &ideal, |_| None);
            assert!(drawing.items.is_empty() && drawing.error_pixels.is_infinite(), "no root, no picture");
            let order: Vec<Diamond> = drawing.wishes.iter().map(|wish| wish.diamond).collect();
            for (at, d) in order.iter().enumerate() {
                assert!(forest.parents(*d).all(|p| order[..at].contains(&p)), "parents are asked for first");
            }
        }
    }

    #[test]
    fn seen_from_above_the_same_tolerance_needs_fewer_splits() {
        let built = &world()[0];
        let mut dice = Dice(5);
        let sphere = Sight { vertical: false, ..Sight::default() };
        let (mut with, mut without) = (0, 0);
        for _ in 0..40 {
            let above = above();
            // Straight down, from where a level or so is too coarse.
            let eye = above.eye + DVec3::Z * above.eye.z * dice.roll();
            let camera = Camera { eye, target: eye - DVec3::Z, ..above };
            let splits = |sight| -> HashSet<Diamond> {
                let ask = Ask { sight, ..ask(built, &camera, 1.0) };
                choose(&ask, |d| Some(built.entries[&d])).splits().collect()
            };
            let (vertical, sphere) = (splits(Sight::default()), splits(sphere));
            assert!(vertical.is_subset(&sphere), "what is not split looks no larger than a sphere does");
            with += vertical.len();
            without += sphere.len();
        }
        println!("{with} splits, {without} with spheres");
        assert!(with < without, "{with} of {without}");
    }

    #[test]
    fn heights_multiplied_are_cut_as_a_terrain_of_that_height() {
        let mut dice = Dice(77);
        let built = &world()[0];
        for round in 0..40 {
            let exaggeration = [1.5, 5.0, 40.0][round % 3];
            let tall = Layer {
                quantum: built.layer.quantum * exaggeration,
                height_offset: built.layer.height_offset * exaggeration,
                finest_error: built.layer.finest_error * exaggeration as f32,
                ..built.layer.clone()
            };
            let taller = |e: Entry| Entry { error_metres: e.error_metres * exaggeration as f32, ..e };
            // Every third one looks straight down, where multiplied heights are multiplied distances, too.
            let camera = any_camera(&mut dice);
            let eye = camera.eye.with_z(camera.eye.z * exaggeration);
            let target = if round % 3 == 0 { eye - DVec3::Z } else { camera.target };
            let camera = Camera { eye, target, ..camera };
            // Taller errors might be taken for those of outlines: all count as spheres here.
            let sight = Sight { vertical: false, ..Sight::default() };
            let ask = Ask { exaggeration, sight, ..ask(built, &camera, 2.0) };
            let ideal = choose(&ask, |d| Some(built.entries[&d]));
            let as_tall = Ask { layer: &tall, exaggeration: 1.0, ..ask };
            let expected = choose(&as_tall, |d| Some(taller(built.entries[&d])));
            let count = |a: &Ideal| a.splits().collect::<HashSet<_>>();
            let different = count(&ideal).symmetric_difference(&count(&expected)).count();
            // Errors are f32, so one that is just at the tolerance may fall on either side.
            assert!(different * 200 <= expected.len().max(200), "{different} of {}", expected.len());
        }
    }

    #[test]
    fn an_eye_within_the_terrain_sees_an_error_of_finite_size() {
        let built = &world()[0];
        let lossy = Layer { finest_error: 1.5, ..built.layer.clone() };
        let [low, high] = built.layer.forest.bounds(built.layer.forest.root_diamonds().next().unwrap());
        let [x, y] = built.layer.position([(low[0] + high[0]) / 2, (low[1] + high[1]) / 2]);
        let eye = DVec3::new(x, y, f64::midpoint(built.layer.heights[0], built.layer.heights[1]));
        let camera = Camera { eye, target: eye + DVec3::X, ..above() };
        let ask = Ask { layer: &lossy, ..ask(built, &camera, 1.0) };
        let ideal = choose(&ask, |d| Some(built.entries[&d]));
        let goal = draw(0, &ask, &ideal, |_| None).error_pixels_goal;
        let sphere = |distance: f64| 1.5 * camera.pixels_per_radian() / distance;
        assert!(goal > sphere(1000.0) && goal <= sphere(0.05) * (1.0 + 1e-6), "{goal}");
    }

    #[test]
    fn memory_bounds_the_ideal_set_and_spends_itself_on_the_largest_errors() {
        let built = &world()[0];
        let camera = above();
        let mut last = f64::INFINITY;
        let forest = &built.layer.forest;
        let largest = Surface::bytes(forest, 0);
        for surfaces in [2, 50, 200, 800] {
            let memory_bytes = surfaces * largest;
            let ask = Ask { memory_bytes, ..ask(built, &camera, 0.1) };
            let ideal = choose(&ask, |d| Some(built.entries[&d]));
            let bytes: usize = ideal.splits().map(|d| Surface::bytes(forest, d.level())).sum();
            assert!(bytes <= memory_bytes && bytes * 10 >= memory_bytes * 9, "{bytes} of {memory_bytes}");
            let goal = draw(0, &ask, &ideal, |_| None).error_pixels_goal;
            assert!(goal < last);
            last = goal;
        }
    }

    #[test]
    fn without_an_index_the_roots_are_wished_for_with_their_pages_and_drawn() {
        let built = &world()[0];
        let camera = above();
        let ask = ask(built, &camera, 1.0);
        let ideal = choose(&ask, |_| None);
        assert_eq!((ideal.len(), ideal.pages()), (2, [0, 1].as_slice()));
        let drawing = draw(0, &ask, &ideal, |_| None);
        assert_eq!(drawing.wishes.len(), 2);
        assert!(drawing.wishes.iter().all(|wish| wish.bytes.is_none()));
        let surfaces = surfaces(built, |d| d.level() == 0);
        let drawing = draw(0, &ask, &ideal, |d| surfaces.get(&d).cloned());
        assert_eq!(drawing.items.len(), 2);
    }

    #[test]
    fn a_cut_of_a_thousand_diamonds_takes_less_than_a_frame() {
        let built = &world()[0];
        let camera = above();
        let memory_bytes = 1000 * Surface::bytes(&built.layer.forest, 0);
        let ask = Ask { memory_bytes, ..ask(built, &camera, 0.1) };
        let entries: HashMap<Diamond, Entry, RandomState> = built.entries.clone().into_iter().collect();
        let surfaces = surfaces(built, |_| true);
        let surfaces: HashMap<Diamond, Arc<Surface>, RandomState> = surfaces.into_iter().collect();
        let mut best = f64::INFINITY;
        let mut items = 0;
        for _ in 0..50 {
            let started = Instant::now();
            let ideal = choose(&ask, |d| entries.get(&d).copied());
            let drawing = draw(0, &ask, &ideal, |d| surfaces.get(&d).cloned());
            best = best.min(started.elapsed().as_secs_f64());
            items = drawing.items.len();
        }
        println!("1000 splits, {items} items: {:.3} ms", best * 1e3);
        assert!(best < 0.010, "{best} s");
    }
}
