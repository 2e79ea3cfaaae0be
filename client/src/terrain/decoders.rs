//! Decodes payloads whose parents are there, and holds the others: on threads, or, where there are none, between
//! frames, a slice after the other.

use crate::background::{Background, HAS_THREADS, sleep};
use crate::cache::Key;
use crate::encoding::Encoding;
use crate::surface::{Surface, SurfaceError};
use bytes::Bytes;
use diamantina_protocol::diamond::Diamond;
use diamantina_protocol::message::Scene;
use foldhash::fast::RandomState;
use std::collections::{HashMap, VecDeque};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::Duration;
use web_time::Instant;

/// How long decoding goes on at once where frames wait for it.
const SLICE: Duration = Duration::from_millis(4);

/// A payload with its parents' surfaces, as far as they are there.
#[derive(Debug)]
pub(super) struct Job {
    pub(super) payload: Bytes,
    pub(super) parents: Vec<(Diamond, Option<Arc<Surface>>)>,
}

impl Job {
    fn is_ready(&self) -> bool {
        self.parents.iter().all(|(_, surface)| surface.is_some())
    }
}

pub(super) type Decoded = (Key, Result<Arc<Surface>, SurfaceError>);

/// Decodes payloads whose parents are there, and holds the others.
#[derive(Debug)]
pub(super) struct Decoders {
    shared: Arc<Bench>,
    threads: Vec<JoinHandle<()>>,
    /// What runs the slices, if there are no threads.
    slices: Option<Background>,
}

#[derive(Debug)]
struct Bench {
    scene: Arc<Scene>,
    encoding: Encoding,
    /// Surfaces that may wait for a frame.
    done_max: usize,
    state: Mutex<Jobs>,
    changed: Condvar,
}

#[derive(Debug, Default)]
struct Jobs {
    /// Without all their parents. Bounded with `ready` by what the terrain holds and the ideal cut.
    held: HashMap<Key, Job, RandomState>,
    ready: VecDeque<(Key, Job)>,
    /// What no frame has taken yet, in the order of decoding, so parents before children.
    done: Vec<Decoded>,
    fresh: HashMap<Key, Arc<Surface>, RandomState>,
    running: usize,
    /// Whether a task goes through the slices.
    slicing: bool,
    closed: bool,
}

impl Decoders {
    /// Threads, which pause where so many surfaces wait for a frame.
    pub(super) fn start(scene: &Arc<Scene>, encoding: Encoding, done_max: usize) -> std::io::Result<Self> {
        let shared = Arc::new(Bench {
            scene: Arc::clone(scene),
            encoding,
            done_max,
            state: Mutex::default(),
            changed: Condvar::new(),
        });
        let mut decoders = Self { shared, threads: Vec::new(), slices: None };
        if HAS_THREADS {
            for _ in 0..std::thread::available_parallelism()?.get() {
                let bench = Arc::clone(&decoders.shared);
                let thread = std::thread::Builder::new().name("diamantina-decode".into());
                decoders.threads.push(thread.spawn(move || bench.work())?);
            }
        } else {
            decoders.slices = Some(Background::start("diamantina-decode")?);
        }
        Ok(decoders)
    }

    /// Sees to it that somebody does what there is to do.
    fn call(&self, jobs: &mut Jobs) {
        match &self.slices {
            None => self.shared.changed.notify_one(),
            Some(slices) if !jobs.slicing && !jobs.ready.is_empty() => {
                jobs.slicing = true;
                slices.spawn(slice(Arc::clone(&self.shared)));
            }
            Some(_) => {}
        }
    }

    pub(super) fn submit(&self, key: Key, mut job: Job) {
        let mut jobs = self.shared.lock();
        for (parent, surface) in job.parents.iter_mut().filter(|(_, surface)| surface.is_none()) {
            *surface = jobs.fresh.get(&(key.0, *parent)).cloned();
        }
        if job.is_ready() {
            jobs.ready.push_back((key, job));
            self.call(&mut jobs);
        } else {
            jobs.held.insert(key, job);
        }
    }

    /// What has been decoded since the last call, parents before children.
    pub(super) fn take(&self) -> Vec<Decoded> {
        let mut jobs = self.shared.lock();
        jobs.fresh.clear();
        if jobs.done.len() >= self.shared.done_max {
            self.shared.changed.notify_all();
        }
        self.call(&mut jobs);
        std::mem::take(&mut jobs.done)
    }

    /// Whether nothing is being decoded, about to be, or left to take.
    pub(super) fn is_idle(&self) -> bool {
        let jobs = self.shared.lock();
        jobs.ready.is_empty() && jobs.running == 0 && jobs.done.is_empty()
    }

    /// Drops what has not been begun and need not be kept; tells what it was.
    pub(super) fn forget(&self, keep: impl Fn(Key) -> bool) -> Vec<Key> {
        let mut jobs = self.shared.lock();
        let mut forgotten = Vec::new();
        let mut keep = |key: Key| {
            let keep = keep(key);
            if !keep {
                forgotten.push(key);
            }
            keep
        };
        jobs.held.retain(|key, _| keep(*key));
        jobs.ready.retain(|(key, _)| keep(*key));
        forgotten
    }
}

impl Drop for Decoders {
    fn drop(&mut self) {
        self.shared.lock().closed = true;
        self.shared.changed.notify_all();
        for thread in self.threads.drain(..) {
            // A thread that panicked has said so already.
            let _ = thread.join();
        }
    }
}

impl Bench {
    fn lock(&self) -> MutexGuard<'_, Jobs> {
        // The jobs are whole between any two statements, whoever panicked.
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn work(&self) {
        let mut jobs = self.lock();
        while !jobs.closed {
            jobs = match self.one(jobs) {
                (jobs, true) => jobs,
                (jobs, false) => self.changed.wait(jobs).unwrap_or_else(PoisonError::into_inner),
            };
        }
    }

    /// Decodes for so long; whether there is more to do.
    fn work_for(&self, duration: Duration) -> bool {
        let until = Instant::now() + duration;
        let mut jobs = self.lock();
        loop {
            let (after, did) = self.one(jobs);
            jobs = after;
            jobs.slicing = did;
            if !did || Instant::now() >= until {
                return did;
            }
        }
    }

    /// Decodes a payload, if one is ready and there is room for what becomes of it.
    fn one<'a>(&'a self, mut jobs: MutexGuard<'a, Jobs>) -> (MutexGuard<'a, Jobs>, bool) {
        let job = if jobs.done.len() < self.done_max { jobs.ready.pop_front() } else { None };
        let Some((key, job)) = job else { return (jobs, false) };
        jobs.running += 1;
        drop(jobs);
        let (layer, d) = key;
        let parents: Vec<(Diamond, &Surface)> =
            job.parents.iter().filter_map(|(parent, s)| Some((*parent, s.as_deref()?))).collect();
        let layer_of = &self.scene.layers[layer];
        let result = Surface::split(self.encoding, layer_of, d, &parents, &job.payload).map(Arc::new);
        drop(job);
        jobs = self.lock();
        jobs.running -= 1;
        if let Ok(surface) = &result {
            jobs.fresh.insert(key, Arc::clone(surface));
            for child in layer_of.forest.children(d).into_iter().flatten() {
                self.release(&mut jobs, (layer, child), d, surface);
            }
        }
        jobs.done.push((key, result));
        (jobs, true)
    }

    /// Gives a parent to a held child, which may be all that it waits for.
    fn release(&self, jobs: &mut Jobs, child: Key, parent: Diamond, surface: &Arc<Surface>) {
        let Some(job) = jobs.held.get_mut(&child) else { return };
        for (_, slot) in job.parents.iter_mut().filter(|(p, _)| *p == parent) {
            *slot = Some(Arc::clone(surface));
        }
        if job.is_ready()
            && let Some(job) = jobs.held.remove(&child)
        {
            jobs.ready.push_back((child, job));
            self.changed.notify_one();
        }
    }
}

/// Decodes what is ready, a slice at a time, and lets others go on in between.
async fn slice(bench: Arc<Bench>) {
    while bench.work_for(SLICE) {
        sleep(Duration::ZERO).await;
    }
}
