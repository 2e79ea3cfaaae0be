//! The one thread that reads and writes the disk: nobody else waits for it.
//!
//! What is put is written in rounds, a transaction each: after [`ROUND`], or once there is [`ROUND_BYTES`] of it. Until
//! then it is found here. A disk that is full or fails is told once, left alone for [`PAUSE`], and tried again.

use super::entries::{Entries, Found, Key, Origin, Round, Trouble};
use bytes::Bytes;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};
use tokio::sync::oneshot;

/// How long what was put may wait.
const ROUND: Duration = Duration::from_millis(200);

/// Bytes at which it waits no longer.
const ROUND_BYTES: u64 = 1 << 20;

/// Bytes that may wait for the thread; what is put beyond is not kept.
pub(super) const WAITING_BYTES_MAX: u64 = 16 << 20;

/// How long a disk that failed is left alone.
const PAUSE: Duration = Duration::from_secs(60);

/// What the thread is asked to do.
#[derive(Debug)]
pub(super) enum Order {
    Get(Vec<Key>, oneshot::Sender<Vec<Option<Bytes>>>),
    Put(Key, u32, Bytes),
    Forget(Key),
    SetCurrent(Origin, String, String),
    Flush(Sender<u64>),
}

/// What others see of the thread.
#[derive(Debug, Default)]
pub(super) struct Watch {
    /// Bytes that were put and have not been written yet.
    pub(super) waiting: AtomicU64,
    problem: Mutex<Option<String>>,
}

impl Watch {
    /// What keeps things from being kept, in words.
    pub(super) fn problem(&self) -> Option<String> {
        self.problem.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }
}

/// The thread's own.
pub(super) struct Keeper {
    /// None once it can no longer be used.
    entries: Option<Entries>,
    round: Round,
    /// When the round is written at the latest.
    due: Option<Instant>,
    /// Nothing is written before this moment.
    resting: Option<Instant>,
    watch: Arc<Watch>,
}

impl Keeper {
    pub(super) fn new(entries: Entries, watch: Arc<Watch>) -> Self {
        let mut keeper =
            Self { entries: Some(entries), round: Round::default(), due: None, resting: None, watch };
        if keeper.entries.as_ref().is_some_and(|entries| !entries.is_writable()) {
            keeper.tell("it may not be written: what is there is used, and nothing is added");
        }
        keeper
    }

    /// Does as it is told until nobody is left who could tell.
    pub(super) fn run(mut self, orders: &Receiver<Order>) {
        loop {
            let order = match self.due {
                None => orders.recv().map_err(|_| RecvTimeoutError::Disconnected),
                Some(due) => orders.recv_timeout(due.saturating_duration_since(Instant::now())),
            };
            match order {
                Ok(order) => self.take(order),
                Err(RecvTimeoutError::Timeout) => self.write(),
                Err(RecvTimeoutError::Disconnected) => {
                    self.write();
                    return;
                }
            }
            if self.round.put_bytes >= ROUND_BYTES || self.due.is_some_and(|due| due <= Instant::now()) {
                self.write();
            }
        }
    }

    fn take(&mut self, order: Order) {
        match order {
            Order::Get(keys, reply) => {
                if !reply.is_closed() {
                    // Whoever asked may have gone.
                    let _ = reply.send(self.get(keys));
                }
            }
            Order::Put(key, rank, data) => {
                self.round.forgotten.retain(|gone| *gone != key);
                self.round.put_bytes += data.len() as u64;
                if let Some((_, old)) = self.round.put.insert(key, (rank, data)) {
                    self.drop_waiting(old.len());
                }
                self.note();
            }
            Order::Forget(key) => {
                if let Some((_, old)) = self.round.put.remove(&key) {
                    self.drop_waiting(old.len());
                }
                self.round.forgotten.push(key);
                self.note();
            }
            Order::SetCurrent(origin, scene, version) => {
                self.write();
                let done = self.entries.as_mut().map(|entries| entries.set_current(origin, &scene, &version));
                // The next session says so again.
                if let Some(Err(trouble)) = done {
                    self.suffer(trouble);
                }
            }
            Order::Flush(reply) => {
                self.write();
                let bytes = self.entries.as_ref().and_then(|entries| entries.bytes().ok());
                // As above.
                let _ = reply.send(bytes.unwrap_or_default());
            }
        }
    }

    /// That so many bytes need not be written any more.
    fn drop_waiting(&mut self, bytes: usize) {
        self.round.put_bytes -= bytes as u64;
        self.watch.waiting.fetch_sub(bytes as u64, Ordering::Relaxed);
    }

    /// That there is something to write.
    fn note(&mut self) {
        self.due.get_or_insert_with(|| Instant::now() + ROUND);
    }

    fn get(&mut self, keys: Vec<Key>) -> Vec<Option<Bytes>> {
        let waiting = |key: &Key| self.round.put.get(key).map(|(_, data)| data.clone());
        let mut blobs: Vec<Option<Bytes>> = keys.iter().map(waiting).collect();
        let is_gone = |key: &Key| self.round.forgotten.contains(key);
        let (places, keys): (Vec<usize>, Vec<Key>) =
            keys.into_iter().enumerate().filter(|(at, key)| blobs[*at].is_none() && !is_gone(key)).unzip();
        let Some(entries) = self.entries.as_mut().filter(|_| !keys.is_empty()) else { return blobs };
        let found = match entries.get(&keys) {
            Ok(found) => found,
            Err(trouble) => {
                self.suffer(trouble);
                return blobs;
            }
        };
        for ((at, key), found) in places.into_iter().zip(keys).zip(found) {
            match found {
                Found::Good(data, first) => {
                    self.round.used.extend(first);
                    blobs[at] = Some(data.into());
                }
                Found::Damaged => {
                    tracing::debug!(route = key.route, "a damaged entry of the disk cache is fetched again");
                    self.round.forgotten.push(key);
                }
                Found::Nothing => {}
            }
        }
        if !self.round.is_empty() {
            self.note();
        }
        blobs
    }

    /// Writes the round, unless the disk rests.
    fn write(&mut self) {
        self.due = None;
        if self.round.is_empty() {
            return;
        }
        let rests = self.resting.is_some_and(|until| Instant::now() < until);
        let Some(entries) = self.entries.as_mut().filter(|_| !rests) else {
            self.forget_round();
            return;
        };
        match entries.write(&self.round) {
            Ok(()) => {
                self.resting = None;
                self.forget_round();
            }
            // Once more, as long as there is room.
            Err(Trouble::Busy) if self.round.put_bytes < WAITING_BYTES_MAX / 2 => self.note(),
            Err(trouble) => {
                self.suffer(trouble);
                self.forget_round();
            }
        }
    }

    fn forget_round(&mut self) {
        self.watch.waiting.fetch_sub(self.round.put_bytes, Ordering::Relaxed);
        self.round = Round::default();
    }

    /// Makes the best of something that went wrong.
    fn suffer(&mut self, trouble: Trouble) {
        match trouble {
            Trouble::Busy => {}
            Trouble::Damaged(reason) => {
                tracing::debug!(reason, "a damaged disk cache begins anew");
                // Of the file that is gone.
                self.round.used.clear();
                if let Some(entries) = self.entries.take() {
                    match entries.renewed() {
                        Ok(entries) => self.entries = Some(entries),
                        Err(reason) => self.tell(&format!("{reason}: it is not used any more")),
                    }
                }
            }
            Trouble::Disk(reason) => {
                self.resting = Some(Instant::now() + PAUSE);
                self.tell(&format!("{reason}: what is fetched is not kept for now; free some space"));
            }
        }
    }

    /// Says what is wrong: the first time in the log, too.
    fn tell(&mut self, problem: &str) {
        let mut known = self.watch.problem.lock().unwrap_or_else(PoisonError::into_inner);
        if known.is_none() {
            tracing::warn!("disk cache: {problem}");
        }
        *known = Some(problem.to_owned());
    }
}
