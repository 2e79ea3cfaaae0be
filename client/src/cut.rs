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

mod near;
mod show;

pub use show::{Showing, show, sight};

use crate::camera::{Bounds, Camera, Plane, nearest_drawn};
use crate::drawing::{DrawItem, Share};
use crate::encoding::Encoding;
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
use near::Near;
use std::cmp::Ordering;
use std::collections::{BinaryHeap, HashMap, HashSet};
use std::sync::Arc;

/// Stands for "no such node".
const NONE: u32 = u32::MAX;

/// What is asked of a layer's cut.
#[derive(Debug, Clone, Copy)]
pub struct Ask<'a> {
    /// The layer, as it is streamed.
    pub layer: &'a Layer,
    /// How its diamonds are encoded.
    pub encoding: Encoding,
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
    /// What the surfaces that are drawn may take on the GPU; nothing: whatever they take.
    pub gpu: Option<Gpu<'a>>,
}

/// What a cut may take on the GPU.
#[derive(Clone, Copy)]
pub struct Gpu<'a> {
    /// Bytes that the surfaces that are drawn may take together. The roots are drawn in any case.
    pub bytes: u64,
    /// What the surface of a diamond takes, if it is resident: others take what is usual, until they are.
    pub of: &'a dyn Fn(Diamond) -> Option<u64>,
}

impl std::fmt::Debug for Gpu<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Gpu").field("bytes", &self.bytes).finish_non_exhaustive()
    }
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
    /// Bytes of memory that the surface of a diamond is expected to take.
    fn surface_bytes(&self, level: u32, entry: &Entry) -> usize {
        Surface::expected_bytes(self.encoding, &self.layer.forest, level, entry.bytes)
    }

    /// Bytes of GPU memory that the surface of a diamond takes, or is expected to.
    fn gpu_bytes(&self, d: Diamond, entry: &Entry) -> u64 {
        let Some(gpu) = &self.gpu else { return 0 };
        let usual = || Surface::expected_gpu_bytes(self.encoding, &self.layer.forest, d.level(), entry.bytes);
        (gpu.of)(d).unwrap_or_else(usual)
    }

    fn gpu_limit(&self) -> u64 {
        self.gpu.map_or(u64::MAX, |gpu| gpu.bytes)
    }

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
    is_limited: bool,
    /// What the surfaces of the split diamonds are expected to take.
    bytes: usize,
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
    /// What its surface takes on the GPU, once it is split.
    gpu_bytes: u64,
}

/// What the drawn surfaces take on the GPU, as one diamond after the other is split.
#[derive(Debug, Default)]
struct Drawn {
    /// How many triangles each of the split nodes shows.
    shows: HashMap<u32, u8, RandomState>,
    bytes: u64,
}

impl Drawn {
    /// Splits a node whose parents are split: it is drawn as long as it shows something, and so are they.
    fn split(&mut self, nodes: &[Node], number: u32, is_finest: bool) {
        let node = &nodes[number as usize];
        let is_seen = |node: &Node| node.in_view && !node.entry.is_empty();
        let open = |child: &&u32| **child != NONE && is_seen(&nodes[**child as usize]);
        let triangles = node.children.iter().filter(open).count();
        let shows = triangles + usize::from(is_finest && node.in_view);
        if shows > 0 {
            self.shows.insert(number, u8::try_from(shows).unwrap_or(u8::MAX));
            self.bytes += node.gpu_bytes;
        }
        for parent in node.parents.into_iter().filter(|parent| *parent != NONE && is_seen(node)) {
            if let Some(shows) = self.shows.get_mut(&parent) {
                *shows -= 1;
                if *shows == 0 {
                    self.shows.remove(&parent);
                    self.bytes -= nodes[parent as usize].gpu_bytes;
                }
            }
        }
    }
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

    /// Whether more would be split, had it the memory.
    #[must_use]
    pub fn is_limited(&self) -> bool {
        self.is_limited
    }

    /// Bytes of memory that the surfaces of the split diamonds are expected to take.
    #[must_use]
    pub fn bytes(&self) -> usize {
        self.bytes
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
        drawn: Drawn::default(),
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
    ideal.bytes = chooser.spent_bytes;
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
    let mut gpu = Drawn::default();
    for i in &ideal.splits {
        let node = ideal.node(*i);
        let mut here = surface(node.diamond);
        if here.is_none() {
            let bytes = node.known.then_some(node.entry.bytes);
            drawing.wishes.push(Wish { diamond: node.diamond, bytes, priority: node.priority });
            whole &= node.diamond.level() > 0;
        }
        if node.parents.iter().all(|p| *p == NONE || drawn[*p as usize].is_some()) {
            if ask.gpu.is_some() && here.is_some() {
                // What is still to come may leave a parent drawn beside its children.
                if node.diamond.level() > 0 && gpu.bytes + node.gpu_bytes > ask.gpu_limit() {
                    here = None;
                } else {
                    gpu.split(&ideal.nodes, *i, node.diamond.level() + 1 == ask.layer.forest.levels());
                }
            }
            drawing.splits.extend(here.as_ref().map(|_| node.diamond));
            drawn[*i as usize] = here;
        }
    }
    drawing.wishes.sort_by(Wish::order);
    let finest_pixels = finest_pixels(ask, ideal, &drawn);
    for (i, finest) in ideal.splits.iter().zip(&finest_pixels) {
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
                share: Share::ALL,
            });
        }
    }
    if !whole {
        drawing.error_pixels = f64::INFINITY;
    }
    drawing
}

/// The errors of [`Ideal::finest_pixels`], less where what is drawn is farther away than its box.
fn finest_pixels(ask: &Ask, ideal: &Ideal, drawn: &[Option<Arc<Surface>>]) -> Vec<f64> {
    let mut pixels = ideal.finest_pixels.clone();
    let (mut numbers, mut errors) = (Vec::new(), Vec::new());
    for (number, (i, pixels)) in ideal.splits.iter().zip(&pixels).enumerate() {
        let Some(surface) = drawn[*i as usize].as_deref().filter(|_| *pixels > ask.tolerance_pixels) else {
            continue;
        };
        numbers.push(number);
        errors.push(Near {
            diamond: ideal.node(*i).diamond,
            surface,
            level: ask.layer.forest.levels(),
            error_metres: ask.layer.finest_error,
            lift_metres: 0.0,
            pixels: *pixels,
        });
    }
    near::refine(ask, &errors, |at, less| pixels[numbers[at]] = less);
    pixels
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
    /// What the surfaces of the split diamonds take ...
    spent_bytes: usize,
    /// ... and on the GPU those that are drawn.
    drawn: Drawn,
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
            gpu_bytes: 0,
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
        self.spent_bytes += self.ask.surface_bytes(diamond.level(), &entry);
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
        let (level, error) = (self.forest.levels(), self.ask.layer.finest_error);
        let is_finest = diamond.level() + 1 == level && in_view;
        let finest =
            is_finest.then(|| self.ask.pixels(diamond, level, error, &self.ask.bounds(diamond, &entry)));
        self.ideal.finest_pixels.push(finest.unwrap_or(0.0));
        let gpu_bytes = self.ask.gpu_bytes(diamond, &entry);
        let node = &mut self.ideal.nodes[number as usize];
        (node.split, node.parents, node.children, node.gpu_bytes) = (true, parents, children, gpu_bytes);
        if self.ask.gpu.is_some() {
            self.drawn.split(&self.ideal.nodes, number, diamond.level() + 1 == level);
        }
        self.ideal.splits.push(number);
    }

    /// Splits a node and whichever ancestors are not split yet; or none of them, where the index does not
    /// know them all or the memory is spent.
    fn force(&mut self, number: u32) {
        if self.spent_bytes >= self.ask.memory_bytes {
            self.ideal.is_limited = true;
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
        let bytes = |i: &u32| self.ask.surface_bytes(level(i), &self.ideal.node(*i).entry);
        let bytes: usize = chain.iter().map(bytes).sum();
        let gpu = |i: &u32| {
            let node = self.ideal.node(*i);
            self.ask.gpu_bytes(node.diamond, &node.entry)
        };
        let gpu_bytes: u64 = chain.iter().map(gpu).sum();
        let is_too_much = self.spent_bytes + bytes > self.ask.memory_bytes
            || self.drawn.bytes.saturating_add(gpu_bytes) > self.ask.gpu_limit();
        if blocked || is_too_much {
            self.ideal.is_limited |= !blocked;
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
pub(crate) fn bounds(layer: &Layer, d: Diamond, entry: &Entry) -> Bounds {
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
mod tests;
