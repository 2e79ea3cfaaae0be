//! Streams: one request whose answer holds what the server finds worth the most, in an order that can be drawn
//! at any moment.
//!
//! Nobody wished for what comes, so nothing of it is owed: what arrived stays, and what did not is wished for
//! as ever once the stream has ended, well or not. Until then, wishes for its layer rest, or else everything
//! would come twice.

use super::batch::Frames;
use super::http::{decode_page, shortened};
use super::tasks::Shared;
use super::{Event, FetchError, Key};
use bytes::Bytes;
use diamantina_protocol::bintree::Forest;
use diamantina_protocol::diamond::Diamond;
use diamantina_protocol::index::Entry;
use diamantina_protocol::message::{self, FrameHeader, STREAM_MAX, Status, StreamAsk};
use foldhash::fast::RandomState;
use std::collections::HashSet;

/// Bytes of events that may wait for a frame to take them; beyond, a stream is not read on.
pub(super) const AHEAD_BYTES: usize = 4 << 20;

/// What a stream has held so far: everything once, and nothing without what it needs.
///
/// Takes some 32 bytes for each of at most [`STREAM_MAX`] diamonds, and 8 for each page.
struct Ledger {
    forest: Forest,
    diamonds: HashSet<Diamond, RandomState>,
    pages: HashSet<u32, RandomState>,
}

impl Ledger {
    /// The page or diamond of a frame, if it may come now.
    fn enter(&mut self, header: &FrameHeader, blob: &[u8]) -> Result<Entered, FetchError> {
        let centre = header.centre;
        if header.checksum != message::checksum(blob) {
            return Err(FetchError::Damaged(centre));
        }
        match header.status {
            Status::Page => {
                let number = centre[0];
                if centre[1] != 0 || self.pages.len() == STREAM_MAX || !self.pages.insert(number) {
                    return Err(FetchError::Unasked(centre));
                }
                Ok(Entered::Page(number, decode_page(&self.forest, number, blob)?))
            }
            Status::Ok => {
                let d = self.forest.diamond(centre).ok_or(FetchError::Unasked(centre))?;
                let has_parents = self.forest.parents(d).all(|parent| self.diamonds.contains(&parent));
                if !has_parents || self.diamonds.len() == STREAM_MAX || !self.diamonds.insert(d) {
                    return Err(FetchError::Unasked(centre));
                }
                Ok(Entered::Diamond(d))
            }
            Status::Missing | Status::Damaged => Err(FetchError::Missing(centre)),
        }
    }
}

enum Entered {
    Page(u32, Vec<(Diamond, Entry)>),
    Diamond(Diamond),
}

impl Shared {
    /// Reads a stream to its end and hands on what it holds, frame by frame.
    pub(super) async fn stream(&self, layer: usize, ask: &StreamAsk) -> Result<(), FetchError> {
        let layer_of = &self.scene.layers[layer];
        let route = message::stream_route(&self.scene.name, &self.scene.version, &layer_of.name, ask);
        let mut chunks = self.http.get(&route).await?;
        let mut frames = Frames::default();
        let (diamonds, pages) = (HashSet::default(), HashSet::default());
        let mut ledger = Ledger { forest: layer_of.forest, diamonds, pages };
        while let Some(chunk) = self.http.chunk(&mut chunks).await? {
            frames.push(&chunk);
            while let Some((header, blob)) = frames.take()? {
                match ledger.enter(&header, &blob)? {
                    Entered::Page(number, entries) => {
                        self.keep(|| self.route(Key::Page(layer, number)), 0, &blob);
                        self.deliver(Key::Page(layer, number), Event::Page(layer, number, entries));
                    }
                    Entered::Diamond(d) => {
                        self.keep(|| self.route(Key::Diamond(layer, d)), d.level(), &blob);
                        self.deliver(Key::Diamond(layer, d), Event::Payload(layer, d, blob));
                    }
                }
            }
            self.room().await;
        }
        if frames.is_empty() { Ok(()) } else { Err(FetchError::Early(shortened(&route))) }
    }

    /// Waits until frames have taken enough of what has arrived.
    async fn room(&self) {
        loop {
            let mut taken = std::pin::pin!(self.taken.notified());
            // Before looking, so that nothing taken is missed.
            taken.as_mut().enable();
            if self.waiting_bytes() <= AHEAD_BYTES {
                return;
            }
            taken.await;
        }
    }
}

/// What an event takes while it waits, in bytes.
pub(super) fn weight(event: &Event) -> usize {
    match event {
        Event::Page(_, _, entries) => size_of_val(entries.as_slice()),
        Event::Payload(_, _, payload) => Bytes::len(payload),
        Event::Tile(_, _, picture) => Bytes::len(picture),
        Event::Coverage(_, coverage) => coverage.bytes().len(),
        Event::Failed(..) | Event::SceneChanged => 0,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::world::world;
    use diamantina_protocol::index;

    fn ledger() -> Ledger {
        let (diamonds, pages) = (HashSet::default(), HashSet::default());
        Ledger { forest: world()[0].layer.forest, diamonds, pages }
    }

    fn is_unasked(entered: &Result<Entered, FetchError>) -> bool {
        matches!(entered, Err(FetchError::Unasked(_)))
    }

    #[test]
    fn everything_comes_once_after_its_parents_and_from_the_forest() {
        let mut ledger = ledger();
        let forest = ledger.forest;
        let roots: Vec<Diamond> = forest.root_diamonds().collect();
        let child = forest.children(roots[0]).into_iter().flatten().find(|c| forest.parents(*c).count() == 2);
        let frame = |d: Diamond| FrameHeader::of(d.centre(), b"x");
        assert!(is_unasked(&ledger.enter(&FrameHeader::of([1, 3], b"x"), b"x")), "no diamond of the forest");
        assert!(is_unasked(&ledger.enter(&frame(child.unwrap()), b"x")), "no parent is there");
        assert!(matches!(ledger.enter(&frame(roots[0]), b"x"), Ok(Entered::Diamond(d)) if d == roots[0]));
        assert!(is_unasked(&ledger.enter(&frame(child.unwrap()), b"x")), "one parent of two is there");
        assert!(ledger.enter(&frame(roots[1]), b"x").is_ok());
        assert!(ledger.enter(&frame(child.unwrap()), b"x").is_ok());
        assert!(is_unasked(&ledger.enter(&frame(roots[1]), b"x")), "twice");
        let damaged = FrameHeader::of(child.unwrap().centre(), b"y");
        assert!(matches!(ledger.enter(&damaged, b"x"), Err(FetchError::Damaged(_))));
    }

    #[test]
    fn a_page_comes_once_and_is_a_page() {
        let mut ledger = ledger();
        let built = &world()[0];
        let diamonds = index::page_diamonds(&ledger.forest, 0).unwrap();
        let entries: Vec<Entry> = diamonds.iter().map(|d| built.entries[d]).collect();
        let blob = zstd::bulk::compress(&index::encode(&entries), 3).unwrap();
        let header = FrameHeader::of_page(0, &blob);
        assert!(
            matches!(ledger.enter(&header, &blob), Ok(Entered::Page(0, list)) if list.len() == entries.len())
        );
        assert!(is_unasked(&ledger.enter(&header, &blob)));
        let beyond = FrameHeader::of_page(u32::MAX, &blob);
        assert!(matches!(ledger.enter(&beyond, &blob), Err(FetchError::Page(_))));
        let bomb = zstd::bulk::compress(&vec![0u8; 64 << 20], 1).unwrap();
        let header = FrameHeader::of_page(1, &bomb);
        assert!(matches!(ledger.enter(&header, &bomb), Err(FetchError::Compression(1))));
    }
}
