//! What a server allows those who ask (how many at once, for how long, and how much), and when it changes what it serves.

use crate::size::parse_bytes;
use std::time::Duration;

/// What a server allows. The figures that operators change are options of `serve`; the others are what no honest client
/// comes near to.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::Args)]
#[group(id = "limits")]
pub struct Limits {
    /// Connections open at once; more are closed as they come
    #[arg(long, default_value_t = 4096, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    pub max_connections: u32,
    /// Connections open at once from one address, and as many answers under way to it, of which HTTP/2 has several a
    /// connection
    #[arg(long, default_value_t = 256, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    pub max_connections_per_address: u32,
    /// Answers under way at once; more are told to come back (503)
    #[arg(long, default_value_t = 1024, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    pub max_in_flight: u32,
    /// Requests a second from one address, or by one token; more are told to come back (429). 0: as many as they like
    #[arg(long, default_value_t = 0, value_name = "N")]
    pub rate: u32,
    /// Requests that may come at once where there is a --rate
    #[arg(long, default_value_t = 200, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    pub burst: u32,
    /// The most memory for blobs that are asked for often, and a sixteenth of it more for decoded diamonds whose heights
    /// are; 0: none are kept
    #[arg(long, default_value = "256MiB", value_name = "BYTES", value_parser = parse_bytes)]
    pub cache: u64,
    /// Seconds between the signal to stop, from which on /ready says no, and the end of accepting connections: for
    /// balancers to notice
    #[arg(long, default_value_t = 0, value_name = "SECONDS")]
    pub shutdown_notice: u32,
    /// Seconds between looks for what has changed: versions of the scenes, certificates, tokens; 0: none
    #[arg(long, default_value_t = 5, value_name = "SECONDS")]
    pub reload: u32,
    /// Seconds for which a version is served after another took its place
    #[arg(long, default_value_t = 300, value_name = "SECONDS")]
    pub grace: u32,
    /// How long the head of a request may take, from its first byte.
    #[arg(skip = Duration::from_secs(10))]
    pub head: Duration,
    /// How long a connection may stand still, whether it waits for a request or for a reader; over HTTP/2, how long
    /// nothing may be asked.
    #[arg(skip = Duration::from_secs(30))]
    pub still: Duration,
    /// How long one answer may take in all.
    #[arg(skip = Duration::from_secs(600))]
    pub answer: Duration,
    /// How long a shutdown waits for answers under way.
    #[arg(skip = Duration::from_secs(25))]
    pub drain: Duration,
}

/// Bytes of an address, query included: a batch of 384 diamonds has some 5000.
pub(super) const URI_BYTES_MAX: usize = 16 << 10;

/// Bytes of the head of a request.
pub(super) const HEAD_BYTES_MAX: usize = 32 << 10;

/// Requests that one HTTP/2 connection may have under way.
pub(super) const STREAMS_MAX: u32 = 64;

/// Seconds after which whoever was refused for lack of room may ask again.
pub(super) const RETRY_AFTER: u64 = 1;

impl Default for Limits {
    fn default() -> Self {
        Self {
            max_connections: 4096,
            max_connections_per_address: 256,
            max_in_flight: 1024,
            rate: 0,
            burst: 200,
            cache: 256 << 20,
            shutdown_notice: 0,
            reload: 5,
            grace: 300,
            head: Duration::from_secs(10),
            still: Duration::from_secs(30),
            answer: Duration::from_secs(600),
            drain: Duration::from_secs(25),
        }
    }
}
