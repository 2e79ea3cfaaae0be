//! What a server counts, for Prometheus to fetch at `/metrics`.
//!
//! Labels have few values, whoever asks for what: routes are templates, and no name, version or token of a scene is one.

use super::Site;
use crate::store::{Shared, StoreError};
use axum::extract::State;
use axum::http::header;
use axum::response::IntoResponse;
use prometheus_client::encoding::{DescriptorEncoder, EncodeLabelSet, EncodeMetric};
use prometheus_client::metrics::counter::{ConstCounter, Counter};
use prometheus_client::metrics::family::Family;
use prometheus_client::metrics::gauge::{ConstGauge, Gauge};
use prometheus_client::metrics::histogram::{Histogram, exponential_buckets};
use prometheus_client::metrics::info::Info;
use prometheus_client::registry::Registry;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{SystemTime, UNIX_EPOCH};

/// What answers that no route gave are counted under.
pub(super) const NO_ROUTE: &str = "none";

/// A route's template, in the extensions of its answers.
#[derive(Debug, Clone, Copy)]
pub(super) struct Route(pub(super) &'static str);

#[derive(Debug, Clone, PartialEq, Eq, Hash, EncodeLabelSet)]
struct Answer {
    route: &'static str,
    status: u16,
}

#[derive(Debug, Clone, PartialEq, Eq, Hash, EncodeLabelSet)]
struct OfRoute {
    route: &'static str,
}

#[derive(Debug, Clone, PartialEq, Eq, Hash, EncodeLabelSet)]
struct Why {
    reason: &'static str,
}

/// Seconds, from a tenth of a millisecond to some 13 s.
fn seconds() -> Histogram {
    Histogram::new(exponential_buckets(1e-4, 2.0, 18))
}

/// All that is counted.
#[derive(Debug)]
pub(super) struct Metrics {
    registry: Registry,
    requests: Family<Answer, Counter>,
    head_seconds: Family<OfRoute, Histogram, fn() -> Histogram>,
    answer_seconds: Family<OfRoute, Histogram, fn() -> Histogram>,
    sent_bytes: Family<OfRoute, Counter>,
    /// Of these, what the kernel took by itself.
    pub(super) sent_uncopied_bytes: Counter,
    rejections: Family<Why, Counter>,
    pub(super) in_flight: Gauge,
    pub(super) connections: Gauge,
    pub(super) cache_hits: Counter,
    pub(super) cache_misses: Counter,
    pub(super) cache_bytes: Gauge,
    pub(super) cache_blobs: Gauge,
    pub(super) store_reads: Counter,
    pub(super) store_read_bytes: Counter,
    pub(super) store_read_seconds: Histogram,
    pub(super) store_errors: Counter,
    pub(super) store_away: Counter,
    pub(super) checksum_failures: Counter,
    pub(super) stores_away: Gauge,
    pub(super) scenes: Gauge,
    pub(super) swaps: Counter,
    pub(super) swaps_refused: Counter,
}

impl Metrics {
    /// Counts, and tells what stores count of what they share.
    pub(super) fn new(shared: Arc<Shared>) -> Self {
        let mut registry = Registry::with_prefix("diamantina");
        let metrics = Self {
            registry: Registry::default(),
            requests: Family::default(),
            head_seconds: Family::new_with_constructor(seconds),
            answer_seconds: Family::new_with_constructor(seconds),
            sent_bytes: Family::default(),
            sent_uncopied_bytes: Counter::default(),
            rejections: Family::default(),
            in_flight: Gauge::default(),
            connections: Gauge::default(),
            cache_hits: Counter::default(),
            cache_misses: Counter::default(),
            cache_bytes: Gauge::default(),
            cache_blobs: Gauge::default(),
            store_reads: Counter::default(),
            store_read_bytes: Counter::default(),
            store_read_seconds: seconds(),
            store_errors: Counter::default(),
            store_away: Counter::default(),
            stores_away: Gauge::default(),
            checksum_failures: Counter::default(),
            scenes: Gauge::default(),
            swaps: Counter::default(),
            swaps_refused: Counter::default(),
        };
        let m = &metrics;
        let r = &mut registry;
        r.register("requests", "Requests answered, by route and status", m.requests.clone());
        r.register("head_seconds", "From a request to the head of its answer", m.head_seconds.clone());
        r.register(
            "answer_seconds",
            "From a request to the last byte of its answer",
            m.answer_seconds.clone(),
        );
        r.register("sent_bytes", "Bytes of answers, without their heads", m.sent_bytes.clone());
        r.register(
            "sent_uncopied_bytes",
            "Bytes of answers that the kernel took by itself",
            m.sent_uncopied_bytes.clone(),
        );
        r.register("rejections", "Connections and requests refused for a limit", m.rejections.clone());
        r.register("in_flight", "Answers under way", m.in_flight.clone());
        r.register("connections", "Connections open", m.connections.clone());
        r.register("cache_hits", "Blobs found in the memory cache", m.cache_hits.clone());
        r.register("cache_misses", "Blobs not found in the memory cache", m.cache_misses.clone());
        r.register("cache_bytes", "Bytes in the memory cache", m.cache_bytes.clone());
        r.register("cache_blobs", "Blobs in the memory cache", m.cache_blobs.clone());
        r.register("store_reads", "Blobs read from stores", m.store_reads.clone());
        r.register("store_read_bytes", "Bytes read from stores", m.store_read_bytes.clone());
        r.register("store_read_seconds", "How long a blob took to read", m.store_read_seconds.clone());
        r.register("store_errors", "Blobs that could not be read", m.store_errors.clone());
        r.register(
            "store_away",
            "Blobs that could not be had since their object store could not be reached",
            m.store_away.clone(),
        );
        r.register(
            "checksum_failures",
            "Blobs that did not match their checksum",
            m.checksum_failures.clone(),
        );
        r.register("stores_away", "Scenes whose object store cannot be reached now", m.stores_away.clone());
        r.register("scenes", "Scenes served", m.scenes.clone());
        r.register("swaps", "Times that another version of a scene took over", m.swaps.clone());
        r.register("swaps_refused", "Published versions that were not sound", m.swaps_refused.clone());
        r.register("build", "This program", Info::new(vec![("version", env!("CARGO_PKG_VERSION"))]));
        registry.register_collector(Box::new(Process::new()));
        registry.register_collector(Box::new(Objects(shared)));
        Self { registry, ..metrics }
    }

    /// An answer's head was sent `seconds` after the request.
    pub(super) fn answered(&self, route: &'static str, status: u16, seconds: f64) {
        self.requests.get_or_create(&Answer { route, status }).inc();
        self.head_seconds.get_or_create(&OfRoute { route }).observe(seconds);
    }

    /// An answer's last byte was sent, or it was cut off.
    pub(super) fn ended(&self, route: &'static str, bytes: u64, seconds: f64) {
        self.sent_bytes.get_or_create(&OfRoute { route }).inc_by(bytes);
        self.answer_seconds.get_or_create(&OfRoute { route }).observe(seconds);
    }

    /// Something of a store could not be read, or is not what was written.
    pub(super) fn failed(&self, error: &StoreError) {
        match error {
            StoreError::Damaged { .. } => self.checksum_failures.inc(),
            StoreError::Away { .. } => self.store_away.inc(),
            _ => self.store_errors.inc(),
        };
    }

    /// A connection or a request was refused for a limit.
    pub(super) fn rejected(&self, reason: &'static str) {
        self.rejections.get_or_create(&Why { reason }).inc();
    }
}

/// What remote stores count, read at each scrape.
#[derive(Debug)]
struct Objects(Arc<Shared>);

impl prometheus_client::collector::Collector for Objects {
    fn encode(&self, mut encoder: DescriptorEncoder<'_>) -> Result<(), std::fmt::Error> {
        let counts = &self.0.counts;
        let counters = [
            ("object_requests", "Ranges asked of object stores", &counts.requests),
            ("object_bytes", "Bytes of these", &counts.bytes),
            ("object_failures", "Ranges that could not be had", &counts.failures),
            ("object_rereads", "Blobs asked for again for their checksum", &counts.rereads),
            ("disk_cache_hits", "Pieces of packs found in the disk cache", &counts.disk_hits),
            ("disk_cache_misses", "Pieces of packs not found there", &counts.disk_misses),
        ];
        for (name, help, count) in counters {
            let counter = ConstCounter::new(count.load(Ordering::Relaxed));
            counter.encode(encoder.encode_descriptor(name, help, None, counter.metric_type())?)?;
        }
        if let Some(disk) = &self.0.disk {
            let counter = ConstCounter::new(disk.failed());
            let help = "Pieces that the disk cache could not write";
            let kind = counter.metric_type();
            counter.encode(encoder.encode_descriptor("disk_cache_failures", help, None, kind)?)?;
            let gauge = ConstGauge::new(disk.bytes()[0]);
            gauge.encode(encoder.encode_descriptor(
                "disk_cache_bytes",
                "Bytes in the disk cache",
                None,
                gauge.metric_type(),
            )?)?;
        }
        Ok(())
    }
}

/// What the system knows of this process, asked for at each scrape.
#[derive(Debug)]
struct Process {
    started: f64,
}

impl Process {
    fn new() -> Self {
        let since = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
        Self { started: since.as_secs_f64() }
    }
}

/// Bytes of memory that this process holds, where the system tells.
fn resident_bytes() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:"))?;
    line.trim().strip_suffix("kB")?.trim().parse::<u64>().ok().map(|kibibytes| kibibytes << 10)
}

impl prometheus_client::collector::Collector for Process {
    fn encode(&self, mut encoder: DescriptorEncoder<'_>) -> Result<(), std::fmt::Error> {
        let mut gauge = |name: &str, help: &str, value: f64| {
            let gauge = ConstGauge::new(value);
            gauge.encode(encoder.encode_descriptor(name, help, None, gauge.metric_type())?)
        };
        gauge("process_start_seconds", "When the process began, in Unix time", self.started)?;
        if let Some(bytes) = resident_bytes() {
            gauge("process_resident_bytes", "Memory that the process holds", bytes as f64)?;
        }
        if let Ok(open) = std::fs::read_dir("/proc/self/fd") {
            gauge(
                "process_open_files",
                "Files and connections that the process has open",
                open.count() as f64,
            )?;
        }
        Ok(())
    }
}

/// Answers with all that was counted.
pub(super) async fn metrics(State(site): State<Arc<Site>>) -> impl IntoResponse {
    site.blobs.measure();
    site.metrics.scenes.set(i64::try_from(site.scenes.all().len()).unwrap_or(i64::MAX));
    let away = site.scenes.all().iter().filter(|store| store.away().is_some()).count();
    site.metrics.stores_away.set(i64::try_from(away).unwrap_or(i64::MAX));
    let mut text = String::new();
    // Writing to a string does not fail.
    let _ = prometheus_client::encoding::text::encode(&mut text, &site.metrics.registry);
    let kind = "application/openmetrics-text; version=1.0.0; charset=utf-8";
    ([(header::CONTENT_TYPE, kind), (header::CACHE_CONTROL, "no-store")], text)
}
