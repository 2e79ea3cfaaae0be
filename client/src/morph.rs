//! Motions: from one cut to the next, what is drawn moves and does not jump.
//!
//! Of irregular triangles, which have no points that halve others' edges, a split *appears*: see [`Motion::share`]. All that
//! follows is of points.
//!
//! A diamond that begins to be drawn as split starts from the surface that its parents drew and reaches its own
//! heights after a set time; one that nothing wants split any more goes back the same way, and only then is it
//! merged. After Hoppe's geomorphs (*Smooth View-Dependent Level-of-Detail Control*, 1998).
//!
//! **Exact where diamonds meet.** The drawn height of a point is a function of the point alone, whichever patch
//! draws it: its height and a [`Record`] of where it comes from, where it goes to and since when. A split changes
//! only points strictly inside, so each point has one last change, in one diamond, which alone writes its
//! record; the diamonds within that diamond have their parents' records on their borders, as they have their parents'
//! heights. A diamond merges only after all within it are merged, so no record ever changes behind a copy.
//!
//! **From what is drawn.** A record starts where its point is at that moment: an old point where its parents draw
//! it, a new one in the middle of the hypotenuse that it halves. So a diamond need not wait for its parents'
//! motions, and turns round half way without a jump.
//!
//! ```text
//!   height                  __ own        A growing diamond: from `from` to 0 above its own heights.
//!      |                 ,-'              A merging one: from 0, or where it is, to where its parents'
//!      |              ,-'                 surface is; then it is held there until that stands still, and
//!      |  parents' _-'                    is gone.
//!      +-----------start-----end---- time
//! ```
//!
//! No clock is read here: moments come from outside, so a flight can be repeated.

#![allow(
    clippy::cast_possible_truncation,
    clippy::cast_precision_loss,
    reason = "local coordinates are at most 256, heights below 2^24 and motions shorter than 2^24 ticks"
)]

use crate::surface::{Points, Surface};
use diamantina_protocol::NODATA;
use diamantina_protocol::bintree::Forest;
use diamantina_protocol::diamond::{Block, Diamond, walk_shared};
use diamantina_protocol::message::Layer;
use foldhash::fast::RandomState;
use std::cmp::Reverse;
use std::collections::{HashMap, HashSet};
use std::sync::Arc;

/// Ticks of a second: 61 microseconds each, so that moments wrap around after 36 hours.
pub const TICKS_A_SECOND: f64 = 16_384.0;

/// The longest motion, in seconds: fewer than 2^24 ticks, which `f32` counts exactly.
pub const SECONDS_MAX: f64 = 60.0;

/// Diamonds of a layer in motion at a time; others wait for theirs to begin. Of n = 64 they take 85 MB here,
/// and as much on the GPU.
pub const MOTIONS_MAX: usize = 512;

/// Points whose motions begin in one frame, of all layers; some 28 ns each, so 1.4 ms: six diamonds of n = 64. The others begin
/// in the next frames. Points are counted, not time: so a flight can be repeated.
pub const STARTS_MAX: usize = 50_000;

/// Ticks in which as many begin as may in a frame, 20 ms: frames that follow one another faster begin fewer.
const STARTS_TICKS: i32 = 328;

/// A moment, in ticks from a beginning that all moments of a scene share. Wraps around.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Moment(i32);

impl Moment {
    /// The moment `seconds` after the beginning.
    #[must_use]
    pub fn at(seconds: f64) -> Self {
        // Wraps around on purpose: only differences count.
        Self((seconds * TICKS_A_SECOND) as i64 as i32)
    }

    /// The number of ticks, as the GPU takes it.
    #[must_use]
    pub fn ticks(self) -> i32 {
        self.0
    }

    /// Ticks from `earlier` to this moment; negative if that is the later one.
    #[must_use]
    pub fn since(self, earlier: Self) -> i32 {
        self.0.wrapping_sub(earlier.0)
    }
}

/// The motion of a point: how far above its own height it is drawn, in quanta, and with which normal (east and
/// north, as [`normal`](crate::surface::normal) gives them). 20 bytes, as the GPU takes them.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, bytemuck::Pod, bytemuck::Zeroable)]
pub struct Record {
    from: f32,
    to: f32,
    from_normal: [i16; 2],
    to_normal: [i16; 2],
    start: i32,
}

impl Record {
    /// Of a point that does not move.
    #[must_use]
    fn still(normal: [i16; 2]) -> Self {
        Self { from: 0.0, to: 0.0, from_normal: normal, to_normal: normal, start: 0 }
    }

    fn moves(&self) -> bool {
        self.from != self.to || self.from_normal != self.to_normal
    }

    /// How far above its own height the point is drawn, in quanta, and with which normal. The twin of the vertex
    /// shader's.
    #[must_use]
    pub fn drawn(&self, now: Moment, duration: i32) -> Place {
        if now.since(Moment(self.start)) >= duration {
            return (self.to, self.to_normal);
        }
        let weight = weight(now.since(Moment(self.start)), duration);
        let normal = [0, 1].map(|i| {
            let [from, to] = [self.from_normal[i], self.to_normal[i]].map(f32::from);
            let between = from + (to - from) * weight;
            // To the nearest; `round` is a call where the architecture has no instruction for it.
            (between + 0.5f32.copysign(between)) as i16
        });
        (self.from + (self.to - self.from) * weight, normal)
    }
}

/// Where a point is, or will be: quanta above its own height, and its normal.
pub type Place = (f32, [i16; 2]);

/// The motion of a split diamond's points, or the way in which its irregular triangles appear.
///
/// Takes `20 ((n+1)^2 + n^2)` bytes: 166 kB for n = 64. Of irregular triangles it takes next to nothing.
#[derive(Debug, Clone, PartialEq)]
pub struct Motion {
    records: Vec<Record>,
    appears: Option<Appearance>,
    duration: i32,
    end: Moment,
    merging: bool,
    span: f32,
    error_metres: f32,
}

impl Motion {
    /// A record for each slot of the block; none of irregular triangles.
    #[must_use]
    pub fn records(&self) -> &[Record] {
        &self.records
    }

    /// Ticks from the start of each record to its end; above 0.
    #[must_use]
    pub fn duration(&self) -> i32 {
        self.duration
    }

    /// The most that a point is above or below its own height, or moves, at any time, in quanta.
    #[must_use]
    pub fn span(&self) -> f32 {
        self.span
    }

    /// An upper bound, in metres, on the vertical distance from what is drawn to the source samples. Points that
    /// move together blend two surfaces, and stay within the larger of both errors; where a border goes on
    /// moving with the parents', the error is larger by that motion.
    #[must_use]
    pub fn error_metres(&self) -> f32 {
        self.error_metres
    }

    /// The part of the picture's pixels in which a split of irregular triangles is seen, from 0 to 1: in the others the parents'
    /// surface is. Each pixel has a number, and the split is seen where that is below this share.
    ///
    /// A diamond has no less of it than its children, which begin after it, and go before it. So whatever a pixel's number is, the
    /// splits that it sees hold the parents of each, and are a cut without cracks like any other. Points appear at once.
    #[must_use]
    pub fn share(&self, now: Moment) -> f32 {
        self.appears.map_or(1.0, |appears| appears.at(now, self.duration))
    }

    fn is_over(&self, now: Moment) -> bool {
        now.since(self.end) >= 0
    }
}

/// How a share changes.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Appearance {
    from: f32,
    to: f32,
    start: Moment,
}

impl Appearance {
    fn at(&self, now: Moment, duration: i32) -> f32 {
        let part = weight(now.since(self.start), duration);
        // Exactly where it goes to in the end.
        self.from * (1.0 - part) + self.to * part
    }
}

/// How much of the way is done after an age: 0 at the start and before, 1 at the end, with no speed at either.
fn weight(age: i32, duration: i32) -> f32 {
    let t = (age as f32 / duration as f32).clamp(0.0, 1.0);
    t * t * (3.0 - 2.0 * t)
}

/// What is to be known of a diamond that would begin to move.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sight {
    /// Whether anyone would see it jump: it is in view, was so a frame ago, and not too small.
    pub visible: bool,
    /// Its error where it is not split, in metres, as declared.
    pub error_metres: f32,
}

/// A change from the cut of the last frame to this one's.
pub struct Change<'a> {
    /// The layer.
    pub layer: &'a Layer,
    /// The moment of this frame, not before the last one's.
    pub now: Moment,
    /// The diamonds that should be drawn as split, parents before children, each with its parents.
    pub wanted: &'a [Diamond],
    /// The surfaces that are resident, those of `wanted` among them.
    pub surface: &'a dyn Fn(Diamond) -> Option<Arc<Surface>>,
    /// What is seen of a diamond.
    pub sight: &'a dyn Fn(Diamond) -> Sight,
}

/// A diamond that is drawn as split.
#[derive(Debug, Clone)]
pub struct Shown {
    /// The diamond.
    pub diamond: Diamond,
    /// Its surface.
    pub surface: Arc<Surface>,
    /// The motion of its points, if some move.
    pub motion: Option<Arc<Motion>>,
}

/// What is drawn as split while it moves.
#[derive(Debug, Clone, Default)]
pub struct Cut {
    /// Each with its parents, and parents before children.
    pub shown: Vec<Shown>,
    /// Wanted diamonds whose turn comes later: they are drawn unsplit.
    pub waiting: Vec<Diamond>,
    /// How many diamonds merge, or wait for those within them.
    pub held: usize,
}

impl Cut {
    /// Diamonds that move, or are about to.
    #[must_use]
    pub fn moving(&self) -> usize {
        self.shown.iter().filter(|s| s.motion.is_some()).count() + self.waiting.len() + self.held
    }
}

/// What starts are worked out with, kept from one to the next.
#[derive(Debug, Default)]
struct Scratch {
    sources: Vec<Source>,
    before: Vec<Before>,
}

/// What may still begin in a frame.
#[derive(Debug, Clone, Copy)]
struct Starts {
    points: usize,
    /// Whether nothing has begun yet: one diamond does in any case, however short the frame or large the diamond.
    is_first: bool,
}

impl Starts {
    fn has_room(&self, points: usize) -> bool {
        self.is_first || points <= self.points
    }

    fn take(&mut self, points: usize) {
        *self = Self { points: self.points.saturating_sub(points), is_first: false };
    }
}

/// The motions of a layer, from frame to frame. Bounded by the cut and [`MOTIONS_MAX`].
#[derive(Debug, Default)]
pub struct Morphs {
    duration: i32,
    motions_max: usize,
    starts_max: usize,
    /// The moment of the last frame.
    moment: Option<Moment>,
    /// What the last frame drew as split.
    last: HashSet<Diamond, RandomState>,
    /// Those of diamonds with a point that moves.
    motions: HashMap<Diamond, Arc<Motion>, RandomState>,
    scratch: Scratch,
}

type Set = HashSet<Diamond, RandomState>;

impl Morphs {
    /// Motions that take `seconds`, at most [`SECONDS_MAX`]; with 0 there are none.
    #[must_use]
    pub fn new(seconds: f64) -> Self {
        let duration = (seconds.min(SECONDS_MAX) * TICKS_A_SECOND) as i32;
        Self { duration, motions_max: MOTIONS_MAX, starts_max: STARTS_MAX, ..Self::default() }
    }

    /// Has the motions of no more than so many points begin in a frame, at most [`STARTS_MAX`]; those of one diamond in any case.
    pub fn set_starts_max(&mut self, points: usize) {
        self.starts_max = points.min(STARTS_MAX);
    }

    /// Has no more than so many diamonds move at a time, at most [`MOTIONS_MAX`].
    pub fn set_motions_max(&mut self, motions_max: usize) {
        self.motions_max = motions_max.min(MOTIONS_MAX);
    }

    /// The diamonds whose points move.
    #[cfg(test)]
    pub(crate) fn moving(&self) -> impl Iterator<Item = Diamond> {
        self.motions.keys().copied()
    }

    /// Whether anything ever moves.
    #[must_use]
    pub fn is_on(&self) -> bool {
        self.duration > 0
    }

    /// Goes to a cut at once: nothing moves any more.
    pub fn jump(&mut self, wanted: &[Diamond]) {
        self.motions.clear();
        self.last = wanted.iter().copied().collect();
    }

    /// Goes on to the next frame: what it draws as split. Costs some 0.2 ms for each motion of n = 64 that begins.
    pub fn step(&mut self, change: &Change) -> Cut {
        let forest = change.layer.forest;
        self.motions.retain(|_, motion| motion.merging || !motion.is_over(change.now));
        let mut starts = self.starts(change.now);
        let (mut order, mut waiting) = (Vec::with_capacity(change.wanted.len()), Vec::new());
        let mut set = Set::default();
        for d in change.wanted.iter().copied() {
            // Those within one that waits are wanted again once it is split.
            if !forest.parents(d).all(|parent| set.contains(&parent)) {
                continue;
            }
            if self.grow(change, d, &mut starts) {
                set.insert(d);
                order.push(d);
            } else {
                waiting.push(d);
            }
        }
        let held = self.hold(change, &mut set, &mut starts);
        order.extend(held.iter().copied());
        self.motions.retain(|d, _| set.contains(d));
        let shown = order.into_iter().filter_map(|diamond| {
            let motion = self.motions.get(&diamond).cloned();
            Some(Shown { diamond, surface: (change.surface)(diamond)?, motion })
        });
        let cut = Cut { shown: shown.collect(), waiting, held: held.len() };
        self.last = set;
        cut
    }

    /// How much may begin in this frame.
    fn starts(&mut self, now: Moment) -> Starts {
        let ticks = self.moment.replace(now).map_or(STARTS_TICKS, |last| now.since(last));
        let part = f64::from(ticks.clamp(0, STARTS_TICKS)) / f64::from(STARTS_TICKS);
        #[allow(clippy::cast_sign_loss, reason = "a part of it")]
        let points = (self.starts_max as f64 * part) as usize;
        Starts { points, is_first: true }
    }

    /// Begins or turns the motion of a wanted diamond whose parents are drawn as split, where there is something
    /// to see. Whether it can be drawn as split now.
    fn grow(&mut self, change: &Change, d: Diamond, starts: &mut Starts) -> bool {
        let way = if self.last.contains(&d) {
            if !self.motions.get(&d).is_some_and(|motion| motion.merging) {
                return true;
            }
            Way::Back
        } else {
            let visible = d.level() > 0 && (change.sight)(d).visible;
            let parents_move = change.layer.forest.parents(d).any(|p| self.motions.contains_key(&p));
            match (visible, parents_move) {
                (true, _) => Way::Out,
                // Its border moves with theirs.
                (false, true) => Way::Along,
                (false, false) => return true,
            }
        };
        self.start(change, d, way, starts)
    }

    /// What the last frame drew and nothing wants any more is held while it moves back, finest first; parents
    /// before children.
    fn hold(&mut self, change: &Change, set: &mut Set, starts: &mut Starts) -> Vec<Diamond> {
        let forest = change.layer.forest;
        let mut lost: Vec<Diamond> = self.last.iter().copied().filter(|d| !set.contains(d)).collect();
        lost.sort_unstable_by_key(|d| (Reverse(d.level()), *d));
        let mut held = Vec::new();
        for d in lost {
            let is_whole = !forest.children(d).iter().flatten().any(|child| set.contains(child));
            if is_whole && !self.merge(change, d, starts) {
                continue;
            }
            set.insert(d);
            held.push(d);
        }
        held.reverse();
        // What is resident has its parents resident, so this drops nothing, as long as that holds.
        held.retain(|d| {
            let stays = (change.surface)(*d).is_some() && forest.parents(*d).all(|p| set.contains(&p));
            if !stays {
                set.remove(d);
            }
            stays
        });
        held
    }

    /// Moves an unwanted diamond back, in which no other is split. Whether it stays drawn as split.
    fn merge(&mut self, change: &Change, d: Diamond, starts: &mut Starts) -> bool {
        if d.level() == 0 || (change.surface)(d).is_none() || !(change.sight)(d).visible {
            return false;
        }
        match self.motions.get(&d) {
            Some(motion) if motion.merging => {
                // It is where its parents will be in the end, which are to be there, too.
                let mut parents = change.layer.forest.parents(d);
                !motion.is_over(change.now) || parents.any(|p| self.motions.contains_key(&p))
            }
            _ => {
                // Until its turn comes, it stays as it is.
                self.start(change, d, Way::Home, starts);
                true
            }
        }
    }

    fn start(&mut self, change: &Change, d: Diamond, way: Way, starts: &mut Starts) -> bool {
        let Some(resident) = (change.surface)(d) else { return false };
        let Some(surface) = resident.points() else {
            self.appear(change, d, way);
            return true;
        };
        let is_full = self.motions.len() >= self.motions_max && !self.motions.contains_key(&d);
        if is_full || !starts.has_room(surface.normals().len()) {
            return false;
        }
        let parents = change.layer.forest.parents(d);
        let parent = |p: Diamond| {
            let motion = self.motions.get(&p).map(Arc::as_ref);
            Some(Parent { diamond: p, surface: (change.surface)(p)?, motion })
        };
        let Some(parents) = parents.map(parent).collect::<Option<Vec<_>>>() else { return false };
        let start = Start {
            forest: &change.layer.forest,
            d,
            surface,
            parents: &parents,
            own: self.motions.get(&d).map(Arc::as_ref),
            now: change.now,
            duration: self.duration,
        };
        let declared = (change.sight)(d).error_metres;
        let motion = start.motion(way, declared, change.layer.quantum, &mut self.scratch);
        starts.take(surface.normals().len());
        if way != Way::Home && !motion.records.iter().any(Record::moves) {
            self.motions.remove(&d);
            return true;
        }
        self.motions.insert(d, Arc::new(motion));
        true
    }

    /// Has irregular triangles appear, or go.
    fn appear(&mut self, change: &Change, d: Diamond, way: Way) {
        let here = self.motions.get(&d).map(|motion| motion.share(change.now));
        let [from, to] = match way {
            Way::Out => [0.0, 1.0],
            Way::Back => [here.unwrap_or(1.0), 1.0],
            Way::Home => [here.unwrap_or(1.0), 0.0],
            // What the parents' border does is nothing to it.
            Way::Along => return,
        };
        let parents = change.layer.forest.parents(d).filter_map(|parent| self.motions.get(&parent));
        let errors = parents.map(|motion| motion.error_metres);
        let motion = Motion {
            records: Vec::new(),
            appears: Some(Appearance { from, to, start: change.now }),
            duration: self.duration,
            end: Moment(change.now.0.wrapping_add(self.duration)),
            merging: way == Way::Home,
            span: 0.0,
            error_metres: errors.fold((change.sight)(d).error_metres, f32::max),
        };
        self.motions.insert(d, Arc::new(motion));
    }
}

/// Where a motion leads.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Way {
    /// From the parents' surface to its own.
    Out,
    /// From where it is to its own surface.
    Back,
    /// From where it is to the parents' surface.
    Home,
    /// It is there already: only the border moves, with the parents.
    Along,
}

/// All that the motion of a diamond starts from.
struct Start<'a> {
    forest: &'a Forest,
    d: Diamond,
    surface: &'a Points,
    parents: &'a [Parent<'a>],
    own: Option<&'a Motion>,
    now: Moment,
    duration: i32,
}

/// A diamond that gives a triangle to the one that starts.
struct Parent<'a> {
    diamond: Diamond,
    surface: Arc<Surface>,
    motion: Option<&'a Motion>,
}

/// Which slot of which parent has a point; [`NOWHERE`] for those that are new.
type Source = u32;

const NOWHERE: Source = Source::MAX;

/// Two parents at most.
const PARENT: Source = 1 << 31;

/// A point as the parents have it: its height, how far above that it is drawn, and with which normal.
#[derive(Debug, Clone, Copy)]
struct Before {
    height: i32,
    lift: f32,
    normal: [i16; 2],
}

impl Start<'_> {
    fn motion(&self, way: Way, declared_metres: f32, quantum: f64, scratch: &mut Scratch) -> Motion {
        let (heights, normals) = (self.surface.block().heights(), self.surface.normals());
        let Scratch { sources, before } = scratch;
        self.look_at_parents(way, sources, before);
        let mut records: Vec<Record> = normals.iter().map(|normal| Record::still(*normal)).collect();
        let (mut end, shift) = self.take_borders(sources, &mut records);
        let mut begin = |slot: usize, from: Place, to: Place| {
            records[slot] =
                Record { from: from.0, to: to.0, from_normal: from.1, to_normal: to.1, start: self.now.0 };
        };
        let own = |slot: usize| (0.0, normals[slot]);
        let here = |slot: usize| self.own.map_or(own(slot), |motion| self.drawn(&motion.records[slot]));
        let inside = self.inside().filter(|(slot, _)| heights[*slot] != NODATA);
        let parents = |(slot, ends): (usize, _)| Some((slot, parents_place(before, heights[slot], ends)?));
        match way {
            Way::Out => {
                inside.filter_map(parents).for_each(|(slot, from)| begin(slot, from, own(slot)));
            }
            Way::Home => {
                inside.filter_map(parents).for_each(|(slot, to)| begin(slot, here(slot), to));
            }
            Way::Back => inside.for_each(|(slot, _)| begin(slot, here(slot), own(slot))),
            Way::Along => {}
        }
        if way != Way::Along {
            end = Moment(self.now.0.wrapping_add(self.duration));
        }
        let far = |r: &Record| r.from.abs().max(r.to.abs()).max((r.to - r.from).abs());
        let span = records.iter().map(far).fold(0.0, f32::max);
        // It starts from what the parents draw, and its border goes on with them.
        let errors = self.parents.iter().filter_map(|parent| parent.motion).chain(self.own);
        let errors = errors.map(|motion| motion.error_metres);
        let error_metres = errors.fold(declared_metres, f32::max) + shift * quantum as f32;
        let merging = way == Way::Home;
        Motion { records, appears: None, duration: self.duration, end, merging, span, error_metres }
    }

    /// Gives the border the parents' records; until when it moves, and how far it has still to go, in quanta.
    fn take_borders(&self, sources: &[Source], records: &mut [Record]) -> (Moment, f32) {
        if sources.is_empty() {
            return (self.now, 0.0);
        }
        let (heights, n) = (self.surface.block().heights(), self.surface.block().segments());
        let upper = self.forest.local(self.d).upper;
        let (mut end, mut shift) = (self.now, 0.0f32);
        let border = (0..=n).flat_map(|k| [[k, 0], [k, n], [0, k], [n, k]]).filter(|[i, j]| upper || j <= i);
        for slot in border.map(|[i, j]| Block::slot(n, 2 * i, 2 * j)).filter(|slot| heights[*slot] != NODATA)
        {
            // Records that are over say nothing any more.
            let over = |r: &Record| self.now.since(Moment(r.start)) >= self.duration;
            let Some(record) = self.record(sources[slot]).filter(|r| !over(r)) else { continue };
            let until = Moment(record.start.wrapping_add(self.duration));
            if until.since(end) > 0 && record.moves() {
                end = until;
            }
            shift = shift.max((record.to - self.drawn(&record).0).abs());
            records[slot] = record;
        }
        (end, shift)
    }

    /// The slots strictly inside, each with the two between which it lies on the parents' surface: the ends of the
    /// hypotenuse that a new point halves, and the slot itself, twice, where the parents have the point.
    fn inside(&self) -> impl Iterator<Item = (usize, [usize; 2])> + use<> {
        let (n, upper) = (self.surface.block().segments(), self.forest.local(self.d).upper);
        let adds_points = self.forest.adds_points(self.d.level());
        let old = (1..n).flat_map(move |j| (if upper { 1 } else { j }..n).map(move |i| j * (n + 1) + i));
        let rows = if self.surface.block().has_centres() { n } else { 0 };
        let centres = (0..rows).flat_map(move |v| {
            (if upper { 0 } else { v }..n).map(move |u| {
                let (slot, corner) = ((n + 1).pow(2) + v * n + u, v * (n + 1) + u);
                // The diagonals of cells alternate, as the bintree's do.
                let ends = if (u + v).is_multiple_of(2) { [0, n + 2] } else { [1, n + 1] };
                (slot, if adds_points { ends.map(|step| corner + step) } else { [slot; 2] })
            })
        });
        old.map(|slot| (slot, [slot; 2])).chain(centres)
    }

    /// Where the parents that move have each slot, if any does; and, where the way leads from or to their surface, what they
    /// have there: as they draw it at this moment, or as it will be in the end.
    fn look_at_parents(&self, way: Way, sources: &mut Vec<Source>, before: &mut Vec<Before>) {
        let slots = self.surface.block().heights().len();
        sources.clear();
        before.clear();
        if self.parents.iter().any(|parent| parent.motion.is_some()) {
            sources.resize(slots, NOWHERE);
        }
        let is_needed = matches!(way, Way::Out | Way::Home);
        if is_needed {
            before.resize(slots, Before { height: NODATA, lift: 0.0, normal: [0; 2] });
        }
        for (parent, bit) in self.parents.iter().zip([0, PARENT]) {
            let Some(points) = parent.surface.points() else { continue };
            let (heights, normals) = (points.block().heights(), points.normals());
            let still = |from: usize| (0.0, normals[from]);
            let (forest, d, at) = (self.forest, self.d, parent.diamond);
            if let Some(motion) = parent.motion {
                walk_shared(forest, d, at, |to, from| {
                    sources[to] = bit | from as Source;
                    if is_needed {
                        let is_now = way == Way::Out;
                        let (lift, normal) =
                            if is_now { self.drawn(&motion.records[from]) } else { still(from) };
                        before[to] = Before { height: heights[from], lift, normal };
                    }
                });
            } else if is_needed {
                walk_shared(forest, d, at, |to, from| {
                    let (lift, normal) = still(from);
                    before[to] = Before { height: heights[from], lift, normal };
                });
            }
        }
    }

    /// What a parent that moves notes of the motion of a point.
    fn record(&self, source: Source) -> Option<Record> {
        let parent = &self.parents[usize::from(source != NOWHERE && source & PARENT != 0)];
        let motion = parent.motion.filter(|_| source != NOWHERE)?;
        Some(motion.records[(source & !PARENT) as usize])
    }

    fn drawn(&self, record: &Record) -> Place {
        record.drawn(self.now, self.duration)
    }
}

/// Where the parents' surface is at a point with a height of its own, half way between two slots; `None` where they
/// have nothing.
fn parents_place(before: &[Before], own: i32, ends: [usize; 2]) -> Option<Place> {
    let [a, b] = ends.map(|slot| &before[slot]);
    if a.height == NODATA || b.height == NODATA {
        return None;
    }
    let [here, there] = [a, b].map(|end| (end.height - own) as f32 + end.lift);
    let normal = [0, 1].map(|i| i16::midpoint(a.normal[i], b.normal[i]));
    Some((f32::midpoint(here, there), normal))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::world::Dice;

    #[test]
    fn a_motion_begins_and_ends_where_it_should_and_stays_between() {
        let mut dice = Dice(1);
        for _ in 0..2000 {
            let mut roll = || ((dice.roll() - 0.5) * 1e4) as f32;
            let start = (f64::from(roll()) * 2e5) as i32;
            let duration = 2 + (f64::from(roll()).abs() * 100.0) as i32;
            let (from, to) = (roll(), roll());
            let record = Record { from, to, from_normal: [-32767, 5], to_normal: [300, 32767], start };
            let at = |age: i32| record.drawn(Moment(start.wrapping_add(age)), duration).0;
            assert_eq!((at(-5), at(0), at(duration), at(i32::MAX)), (from, from, to, to));
            let (mut last, steps) = (from, duration.min(50));
            for step in 1..=steps {
                let age = (i64::from(duration) * i64::from(step) / i64::from(steps)) as i32;
                let here = at(age);
                let [low, high] = [from.min(to), from.max(to)];
                assert!((low - 0.01..=high + 0.01).contains(&here), "{record:?} {here}");
                // The steepest that a smooth step is, and a step of ticks.
                let part = 1.0 / steps as f32 + 1.0 / duration as f32;
                assert!((here - last).abs() <= 1.51 * part * (to - from).abs() + 0.01, "{record:?} {age}");
                last = here;
            }
            let normal = |age: i32| record.drawn(Moment(start.wrapping_add(age)), duration).1;
            assert_eq!((normal(0), normal(duration)), (record.from_normal, record.to_normal));
        }
    }

    #[test]
    fn moments_wrap_around_and_their_differences_do_not() {
        let week = 7.0 * 86_400.0;
        for seconds in [0.0, 131_071.9, 131_072.0, week] {
            let (a, b) = (Moment::at(seconds), Moment::at(seconds + 0.5));
            assert_eq!((b.since(a), a.since(b)), (8192, -8192), "{seconds}");
        }
    }
}
