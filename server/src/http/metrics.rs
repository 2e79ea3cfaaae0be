//! What a server counts, for Prometheus to fetch at `/metrics`.
//!
//! Labels have few values, whoever asks for what: routes are templates, and no name, version or token of a scene is one.

use super::Site;
use axum::extract::State;
use axum::http::header;
use axum::response::IntoResponse;
use prometheus_client::encoding::{DescriptorEncoder, EncodeLabelSet, EncodeMetric};
use prometheus_client::metrics::counter::Counter;
use prometheus_client::metrics::family::Family;
use prometheus_client::metrics::gauge::{ConstGauge, Gauge};
use prometheus_client::metrics::histogram::{Histogram, exponential_buckets};
use prometheus_client::metrics::info::Info;
use prometheus_client::registry::Registry;
use std::sync::Arc;
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
    pub(super) checksum_failures: Counter,
    pub(super) scenes: Gauge,
    pub(super) swaps: Counter,
    pub(super) swaps_refused: Counter,
}

impl Metrics {
    pub(super) fn new() -> Self {
        let mut registry = Registry::with_prefix("diamantina");
        let metrics = Self {
            registry: Registry::default(),
            requests: Family::default(),
            head_seconds: Family::new_with_constructor(seconds),
            answer_seconds: Family::new_with_constructor(seconds),
            sent_bytes: Family::default(),
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
            "checksum_failures",
            "Blobs that did not match their checksum",
            m.checksum_failures.clone(),
        );
        r.register("scenes", "Scenes served", m.scenes.clone());
        r.register("swaps", "Times that another version of a scene took over", m.swaps.clone());
        r.register("swaps_refused", "Published versions that were not sound", m.swaps_refused.clone());
        r.register("build", "This program", Info::new(vec![("version", env!("CARGO_PKG_VERSION"))]));
        registry.register_collector(Box::new(Process::new()));
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

    /// A connection or a request was refused for a limit.
    pub(super) fn rejected(&self, reason: &'static str) {
        self.rejections.get_or_create(&Why { reason }).inc();
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
    let mut text = String::new();
    // Writing to a string does not fail.
    let _ = prometheus_client::encoding::text::encode(&mut text, &site.metrics.registry);
    let kind = "application/openmetrics-text; version=1.0.0; charset=utf-8";
    ([(header::CONTENT_TYPE, kind), (header::CACHE_CONTROL, "no-store")], text)
}
