//! The order of a stream: the largest error first, parents before children, and the pages of the index that
//! tell of them; found as it is read.
//!
//! The roots come first. Then, of all diamonds below what has been sent, the one with the largest error is
//! taken from a heap, and before it whichever of its ancestors are still missing. Where there is neither a
//! region nor a view none ever is: declared errors are saturated, in the index as it is written too (rounding
//! to its 16 bits keeps order), so a parent's error is no less than its child's, and of equal errors the
//! coarser goes first. At the edge of a region one of two parents may lie outside: that one is fetched when its
//! child comes up. The box of a diamond lies within those of its parents together, so whatever touches the
//! region has a parent that does, and is found.
//!
//! Nothing is made before somebody reads it. What is remembered: the diamonds sent, those in the heap and the
//! numbers of the pages, some 150 bytes for each diamond sent, and [`PAGES_HELD`] decoded pages, 2 MB.

use crate::inspect::{InspectError, read_page};
use crate::store::{Key, Kind, Store, StoreError};
use bytes::Bytes;
use diamantina_protocol::bintree::Forest;
use diamantina_protocol::diamond::Diamond;
use diamantina_protocol::index::{self, Entry};
use diamantina_protocol::message::{self, FrameHeader, Layer, StreamAsk};
use diamantina_protocol::sight::{is_vertical, vertical_angle};
use std::cmp::Ordering;
use std::collections::{BinaryHeap, HashMap, HashSet, VecDeque};
use std::sync::Arc;

/// Decoded pages that a stream keeps at hand: some 30 kB each.
pub const PAGES_HELD: usize = 64;

/// Payloads that are asked of an object store at once, and held until their turn comes: some 8 kB each.
const AHEAD: usize = 48;

/// What a frame holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Subject {
    /// A page of the index.
    Page(u32),
    /// The payload of a diamond.
    Diamond(Diamond),
}

/// A frame of a stream: header and what follows it.
#[derive(Debug, Clone)]
pub struct Frame {
    /// What it holds.
    pub subject: Subject,
    /// The bytes for the wire.
    pub bytes: Bytes,
}

/// A stream that is being read.
pub struct Stream {
    pages: Pages,
    ask: StreamAsk,
    forest: Forest,
    diamonds_max: usize,
    roots: Box<dyn Iterator<Item = Diamond> + Send>,
    heap: BinaryHeap<Candidate>,
    /// What has been sent, or is in `ready`.
    split: HashSet<Diamond>,
    /// Ancestors that come next, and the diamond that needs them.
    due: VecDeque<Diamond>,
    /// A diamond that comes once the pages before it have gone.
    ready: Option<Diamond>,
    bytes: u64,
}

impl std::fmt::Debug for Stream {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Stream")
            .field("ask", &self.ask)
            .field("sent", &self.split.len())
            .finish_non_exhaustive()
    }
}

impl Stream {
    /// What is asked of a layer, at most `diamonds_max` of it. `number` is the layer's place in the scene.
    #[must_use]
    pub fn new(store: Arc<Store>, number: u8, layer: &Layer, ask: StreamAsk, diamonds_max: usize) -> Self {
        let forest = layer.forest;
        Self {
            pages: Pages::new(store, number, layer.clone()),
            ask,
            forest,
            diamonds_max,
            roots: Box::new(forest.root_diamonds()),
            heap: BinaryHeap::new(),
            split: HashSet::new(),
            due: VecDeque::new(),
            ready: None,
            bytes: 0,
        }
    }

    /// The next frame; `None` at the end. Takes some microseconds, and a few hundred where pages are read.
    ///
    /// # Errors
    /// When the store is damaged there: then nothing below it could be told right.
    pub fn next_frame(&mut self) -> Result<Option<Frame>, InspectError> {
        if self.ask.limit.is_some_and(|limit| self.bytes >= limit) {
            return Ok(None);
        }
        if self.ready.is_none() && self.pages.fresh.is_empty() {
            if self.split.len() >= self.diamonds_max {
                return Ok(None);
            }
            if let Some(d) = self.choose()? {
                self.split(d)?;
                self.ready = Some(d);
            }
        }
        let (subject, header, blob) = if let Some(page) = self.pages.fresh.pop_front() {
            let blob = self.pages.blob(page)?;
            (Subject::Page(page), FrameHeader::of_page(page, &blob), blob)
        } else if let Some(d) = self.ready.take() {
            if self.pages.store.is_remote() && !self.pages.ahead.contains_key(&d) {
                let next = self.likely();
                self.pages.read_ahead(d, next);
            }
            let payload = self.pages.payload(d)?;
            (Subject::Diamond(d), FrameHeader::of(d.centre(), &payload), payload)
        } else {
            return Ok(None);
        };
        let mut bytes = Vec::with_capacity(message::FRAME_HEADER_BYTES_MAX + blob.len());
        header.write(&mut bytes);
        bytes.extend_from_slice(&blob);
        self.bytes += bytes.len() as u64;
        Ok(Some(Frame { subject, bytes: bytes.into() }))
    }

    /// Frames of `bytes` together, or what is left; less than one frame more. `None` at the end.
    ///
    /// # Errors
    /// As [`Stream::next_frame`].
    pub fn next_piece(&mut self, bytes: usize) -> Result<Option<Bytes>, InspectError> {
        let mut piece = Vec::new();
        while piece.len() < bytes {
            let Some(frame) = self.next_frame()? else { break };
            piece.extend_from_slice(&frame.bytes);
        }
        Ok((!piece.is_empty()).then(|| piece.into()))
    }

    /// What is split next: a root, or the largest error, with the ancestors that it lacks before it.
    fn choose(&mut self) -> Result<Option<Diamond>, InspectError> {
        if let Some(d) = self.due.pop_front() {
            return Ok(Some(d));
        }
        for root in self.roots.by_ref() {
            if !self.pages.entry(root)?.is_empty() {
                return Ok(Some(root));
            }
        }
        while let Some(Candidate { diamond, .. }) = self.heap.pop() {
            if !self.split.contains(&diamond) {
                self.due = self.lineage(diamond);
                break;
            }
        }
        Ok(self.due.pop_front())
    }

    /// Diamonds that probably come next: those that are due, and the largest errors of the heap.
    fn likely(&self) -> Vec<Diamond> {
        let mut heap: Vec<&Candidate> = self.heap.iter().collect();
        if heap.len() > AHEAD {
            heap.select_nth_unstable_by(AHEAD, |a, b| b.cmp(a));
            heap.truncate(AHEAD);
        }
        self.due.iter().copied().chain(heap.into_iter().map(|c| c.diamond)).take(AHEAD).collect()
    }

    /// A diamond and those of its ancestors that have not been sent, coarse first.
    fn lineage(&self, d: Diamond) -> VecDeque<Diamond> {
        let mut list = vec![d];
        let mut at = 0;
        while let Some(d) = list.get(at).copied() {
            at += 1;
            for parent in self.forest.parents(d) {
                if !self.split.contains(&parent) && !list.contains(&parent) {
                    list.push(parent);
                }
            }
        }
        // Stable, so that the order is the same each time.
        list.sort_by_key(|d| d.level());
        list.into()
    }

    /// Marks a diamond whose parents are split, and looks at the children that nobody has looked at yet.
    fn split(&mut self, d: Diamond) -> Result<(), InspectError> {
        self.split.insert(d);
        for child in self.forest.children(d).into_iter().flatten() {
            let entry = self.pages.entry(child)?;
            let known = self.forest.parents(child).any(|p| p != d && self.split.contains(&p));
            if known || entry.is_empty() {
                continue;
            }
            if let Some(urgency) = self.urgency(child, &entry) {
                self.heap.push(Candidate { urgency, diamond: child });
            }
        }
        Ok(())
    }

    /// The error to order by, if it is asked for at all.
    fn urgency(&self, d: Diamond, entry: &Entry) -> Option<f64> {
        let error = f64::from(entry.error_metres);
        let layer = &self.pages.layer;
        let [a, b] = self.forest.bounds(d).map(|p| layer.position(p));
        let low = [a[0].min(b[0]), a[1].min(b[1]), layer.metres(entry.low)];
        let high = [a[0].max(b[0]), a[1].max(b[1]), layer.metres(entry.high)];
        let in_region = self
            .ask
            .bbox
            .is_none_or(|[x0, y0, x1, y1]| low[0] <= x1 && high[0] >= x0 && low[1] <= y1 && high[1] >= y0);
        if !in_region || error <= self.ask.error {
            return None;
        }
        let Some(view) = &self.ask.view else { return Some(error) };
        let mut apparent_max = f64::INFINITY;
        if view.vertical && is_vertical(&self.forest, d.level(), entry.error_metres, layer.cell) {
            apparent_max = vertical_angle(view.eye, error, low, high);
        }
        let from_eye = |corner: [f64; 3]| [0, 1, 2].map(|i| corner[i] - view.eye[i]);
        let (low, high) = (from_eye(low), from_eye(high));
        let beyond = |side: &[f64; 3]| {
            // The corner that is farthest inside.
            (0..3).map(|i| side[i] * if side[i] >= 0.0 { high[i] } else { low[i] }).sum::<f64>() < 0.0
        };
        if view.sides.iter().any(beyond) {
            return None;
        }
        let distance2: f64 = (0..3).map(|i| low[i].max(-high[i]).max(0.0).powi(2)).sum();
        let apparent = if error > 0.0 { (error / distance2.sqrt()).min(apparent_max) } else { 0.0 };
        (apparent > view.angle).then_some(apparent)
    }
}

/// A diamond below what has been sent.
#[derive(Debug)]
struct Candidate {
    urgency: f64,
    diamond: Diamond,
}

impl Ord for Candidate {
    fn cmp(&self, other: &Self) -> Ordering {
        // Diamonds sort by level, then by place: of equal errors the coarse first, in the same order each time.
        self.urgency.total_cmp(&other.urgency).then(other.diamond.cmp(&self.diamond))
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

/// The index of a layer, page by page, with the pages lately used at hand.
struct Pages {
    store: Arc<Store>,
    number: u8,
    layer: Layer,
    /// With the time of last use, and entries by diamond.
    held: HashMap<u32, (u64, Vec<(Diamond, Entry)>)>,
    now: u64,
    /// Pages that have ever been looked into.
    seen: HashSet<u32>,
    /// Those of them that have not been sent.
    fresh: VecDeque<u32>,
    /// Payloads that were asked for before their turn. Each is sent sooner or later, or the stream ends.
    ahead: HashMap<Diamond, Result<Option<Bytes>, StoreError>>,
}

impl Pages {
    fn new(store: Arc<Store>, number: u8, layer: Layer) -> Self {
        let (held, seen, fresh) = (HashMap::new(), HashSet::new(), VecDeque::new());
        Self { store, number, layer, held, now: 0, seen, fresh, ahead: HashMap::new() }
    }

    fn entry(&mut self, d: Diamond) -> Result<Entry, InspectError> {
        let page = index::page_of(&self.layer.forest, d);
        self.now += 1;
        if !self.held.contains_key(&page) {
            if self.held.len() >= PAGES_HELD
                && let Some(idle) = self.held.iter().min_by_key(|(_, (used, _))| *used).map(|(page, _)| *page)
            {
                self.held.remove(&idle);
            }
            let mut entries = read_page(&self.store, self.number, &self.layer, Kind::Index, page)?;
            entries.sort_unstable_by_key(|(d, _)| *d);
            self.held.insert(page, (self.now, entries));
            if self.seen.insert(page) {
                self.fresh.push_back(page);
            }
        }
        let found = self.held.get_mut(&page).and_then(|(used, entries)| {
            *used = self.now;
            let at = entries.binary_search_by_key(&d, |(d, _)| *d).ok()?;
            entries.get(at).map(|(_, entry)| *entry)
        });
        // Each diamond is in the page that `page_of` says: the index module's own law.
        Ok(found.unwrap_or(Entry::EMPTY))
    }

    /// A page as it is stored.
    fn blob(&self, page: u32) -> Result<Bytes, InspectError> {
        let blob = self.store.get(Key { layer: self.number, kind: Kind::Index, a: page, b: 0 })?;
        blob.ok_or_else(|| InspectError::NoPage { layer: self.layer.name.clone(), page })
    }

    /// Reads the payload of a diamond, and of others where that is as much as of these.
    fn read_ahead(&mut self, d: Diamond, others: Vec<Diamond>) {
        let others = others.into_iter().filter(|other| *other != d && !self.ahead.contains_key(other));
        let wanted: Vec<Diamond> = std::iter::once(d).chain(others).collect();
        let key =
            |d: &Diamond| Key { layer: self.number, kind: Kind::Points, a: d.centre()[0], b: d.centre()[1] };
        let blobs = self.store.get_many(&wanted.iter().map(key).collect::<Vec<_>>());
        self.ahead.extend(wanted.into_iter().zip(blobs));
    }

    /// A diamond's payload; without bytes where the index says that there is none.
    fn payload(&mut self, d: Diamond) -> Result<Bytes, InspectError> {
        let expected = self.entry(d)?.bytes;
        let [a, b] = d.centre();
        let payload = match self.ahead.remove(&d) {
            Some(read) => read?,
            None => self.store.get(Key { layer: self.number, kind: Kind::Points, a, b })?,
        };
        let payload = payload.unwrap_or_default();
        let (layer, centre) = (|| self.layer.name.clone(), [a, b]);
        match u32::try_from(payload.len()).unwrap_or(u32::MAX) {
            found if found == expected => Ok(payload),
            0 => Err(InspectError::NoPoints { layer: layer(), centre }),
            found => Err(InspectError::Size { layer: layer(), centre, found, expected }),
        }
    }
}
