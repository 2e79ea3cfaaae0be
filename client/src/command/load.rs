//! `load` on the command line: its options, and what it prints.

use super::{EncodingName, Failure, TokenArgs, parse_size, shown};
use clap::Args;
use diamantina_client::encoding::Encoding;
use diamantina_client::fetch::FetchError;
use diamantina_client::headless::{self, FlightPath};
use diamantina_client::load::{self, Latencies, LoadError, Report};
use std::io::{IsTerminal, Write};
use std::path::PathBuf;
use std::time::Duration;

#[derive(Args)]
pub(super) struct LoadArgs {
    /// The server, or one of its scenes: http://HOST:PORT or http://HOST:PORT/scenes/NAME
    url: String,
    #[command(flatten)]
    token: TokenArgs,
    /// Users
    #[arg(long, default_value_t = 100, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=100_000))]
    users: u32,
    /// How long
    #[arg(long, default_value_t = 60.0, value_name = "SECONDS")]
    seconds: f64,
    /// The time in which all users arrive, one after another
    #[arg(long, default_value_t = 10.0, value_name = "SECONDS")]
    arrival: f64,
    /// The mean pause of a user between two views
    #[arg(long, default_value_t = 5.0, value_name = "SECONDS")]
    think: f64,
    /// Paths that users take turns in following, as for `fly` [default: each wanders over the scene by itself]
    #[arg(long, value_name = "JSON")]
    path: Vec<PathBuf>,
    /// Views of a path that a user looks at, evenly spread
    #[arg(long, default_value_t = 40, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=1_000_000))]
    views: u32,
    /// Width and height of a user's picture, in pixels
    #[arg(long, default_value = "1380x768", value_name = "WIDTHxHEIGHT", value_parser = parse_size)]
    size: [u32; 2],
    /// The largest error on the screen, in pixels
    #[arg(long, default_value_t = 2.0, value_name = "PIXELS")]
    error_pixels: f64,
    /// What each user's cache may hold, as a viewer counts it; what several hold is there once
    #[arg(long, default_value = "256", value_name = "MIB")]
    memory: usize,
    /// Look at these layers alone [default: all]
    #[arg(long = "layer", value_name = "NAME", value_delimiter = ',')]
    layers: Option<Vec<String>>,
    /// How diamonds are encoded
    #[arg(long, default_value = "points", value_enum)]
    encoding: EncodingName,
    /// Requests that a user has in flight at once
    #[arg(long, default_value_t = 4, value_name = "N", value_parser = clap::value_parser!(u8).range(1..=64))]
    requests: u8,
    /// One connection a user, of HTTP/2, instead of several of HTTP/1.1
    #[arg(long)]
    http2: bool,
    /// Where random numbers begin: the same number, the same users
    #[arg(long, default_value_t = 1, value_name = "N")]
    seed: u64,
    /// Write the figures here (- for standard output)
    #[arg(long, value_name = "JSON")]
    json: Option<PathBuf>,
}

fn duration(option: &str, seconds: f64) -> Result<Duration, Failure> {
    let found = || Failure(2, format!("--{option} {seconds}: expected seconds, 0 or more"));
    Duration::try_from_secs_f64(seconds).map_err(|_| found())
}

pub(super) fn run(args: &LoadArgs) -> Result<(), Failure> {
    if !(args.error_pixels.is_finite() && args.error_pixels > 0.0) {
        return Err(Failure(2, format!("--error-pixels {}: expected a number above 0", args.error_pixels)));
    }
    let options = load::Options {
        users: args.users,
        duration: duration("seconds", args.seconds)?,
        arrival: duration("arrival", args.arrival)?,
        think: duration("think", args.think)?,
        paths: args.path.iter().map(|path| FlightPath::read(path)).collect::<Result<_, _>>()?,
        views: args.views,
        size: args.size,
        tolerance_pixels: args.error_pixels,
        memory_bytes: args.memory << 20,
        layers: args.layers.clone(),
        encoding: match args.encoding {
            EncodingName::Points => Encoding::Points,
            EncodingName::Tin => Encoding::Tin,
        },
        requests_max: args.requests.into(),
        http2: args.http2,
        token: args.token.token.as_deref().map(Into::into),
        seed: args.seed,
    };
    let mut json = args.json.as_deref().map(headless::open_text).transpose()?;
    let has_screen = std::io::stderr().is_terminal();
    let report = load::run(&args.url, &options, |so_far| {
        if has_screen {
            // Nothing is left to do if standard error is closed.
            let _ = write!(
                std::io::stderr(),
                "\r{:.0} s: {:.0} requests/s, {:.0} diamonds/s, p99 {:.0} ms, {} errors ",
                so_far.seconds,
                so_far.requests_a_second,
                so_far.diamonds_a_second,
                so_far.diamonds.p99,
                so_far.errors.values().sum::<u64>()
            );
        }
    });
    if has_screen {
        let _ = writeln!(std::io::stderr());
    }
    let report = report.map_err(|error| {
        let is_wrong_use =
            matches!(error, LoadError::Fetch(FetchError::Address { .. } | FetchError::Layer { .. }));
        Failure(if is_wrong_use { 2 } else { 1 }, error.to_string())
    })?;
    if let Some(out) = &mut json {
        let printed = writeln!(out, "{}", serde_json::to_string_pretty(&report)?);
        shown(printed.and_then(|()| out.flush()))?;
    }
    if args.json.as_ref().is_none_or(|path| path.as_os_str() != "-") {
        shown(print(&report))?;
    }
    match report.errors.values().sum::<u64>() {
        0 if report.requests.count == 0 => Err(Failure(1, "no answer came".to_owned())),
        0 => Ok(()),
        n => Err(Failure(1, format!("{n} requests or payloads went wrong; {}", remedy(&report)))),
    }
}

/// What to do about what went wrong most often.
fn remedy(report: &Report) -> &'static str {
    let has = |word: &str| report.errors.keys().any(|kind| kind.contains(word));
    if has("429") {
        "429: raise `serve --rate`, or set it to 0"
    } else if has("503") {
        "503: raise `serve --max-in-flight`, of which one address gets half"
    } else if has("open files") {
        "raise the limit on open files (ulimit -n), or use --http2"
    } else if has("closed") || has("reset") {
        "all users come from one address: raise `serve --max-connections-per-address` and --max-connections, or use --http2"
    } else if has("refused") {
        "nothing listens there any more: start the server again"
    } else if has("404") || has("410") {
        "that server does not serve the scene, or a part of it, any more"
    } else {
        "the server's log says more (RUST_LOG=info tells each request)"
    }
}

fn print(report: &Report) -> std::io::Result<()> {
    let mut out = std::io::stdout().lock();
    writeln!(out, "{} users, {:.0} s", report.users, report.seconds)?;
    writeln!(
        out,
        "  {:.0} requests/s, {:.0} diamonds/s, {:.2} MB/s; {:.0} kB a user",
        report.requests_a_second,
        report.diamonds_a_second,
        report.bytes as f64 / report.seconds.max(1e-9) / 1e6,
        report.bytes_a_user / 1e3
    )?;
    writeln!(out, "  {:10} {:>9} {:>9} {:>9} {:>9} {:>9}", "[ms]", "count", "p50", "p90", "p99", "max")?;
    let mut line = |name: &str, l: &Latencies| {
        writeln!(out, "  {name:10} {:9} {:9.1} {:9.1} {:9.1} {:9.1}", l.count, l.p50, l.p90, l.p99, l.max)
    };
    line("requests", &report.requests)?;
    line("diamonds", &report.diamonds)?;
    line("views", &report.views)?;
    writeln!(
        out,
        "  {} views had not settled when the user went on, {} were still looked at in the end",
        report.unsettled, report.under_way
    )?;
    if report.went_over > 0 {
        writeln!(out, "  {} times a user went over to another version of the scene", report.went_over)?;
    }
    let (payloads, bytes) = report.decoded;
    writeln!(out, "  {payloads} different payloads decoded, {:.2} MB", bytes as f64 / 1e6)?;
    for (kind, count) in &report.errors {
        writeln!(out, "  {count} x {kind}")?;
    }
    out.flush()
}
