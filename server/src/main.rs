//! The command line of the server.

mod layer_args;
mod print;

use clap::{ArgMatches, Args, CommandFactory, FromArgMatches, Parser, Subcommand, ValueEnum};
use diamantina_protocol::message::is_name;
use diamantina_protocol::points::Rule;
use diamantina_server::experiment::ExperimentError;
use diamantina_server::hierarchy::{self, BuildError, TinOptions};
use diamantina_server::ingest::IngestError;
use diamantina_server::inspect;
use diamantina_server::progress::Progress;
use diamantina_server::settings::{self, LogFormat, Merged, Settings};
use diamantina_server::size::parse_bytes;
use diamantina_server::store::{Disk, Published, Publisher, Shared, Store, StoreError, is_address, repair};
use diamantina_server::tin::Metric;
use diamantina_server::zone::polygon::Coordinates;
use diamantina_server::zone::{self, ZoneError};
use diamantina_server::{curve, demo, experiment, http, ingest, texture};
use layer_args::{LayerArg, Layers};
use std::io::{IsTerminal, Write};
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::Arc;
use std::time::Duration;
use tokio::signal::unix::{SignalKind, signal};

/// Builds and serves streamed terrain.
#[derive(Parser)]
#[command(version, about, propagate_version = true)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Turn DEM files into a store of diamonds
    Build(Box<BuildArgs>),
    /// Offer stores over HTTP
    Serve(Box<ServeArgs>),
    /// Look at what `serve` is told by a file, the environment and flags
    #[command(subcommand)]
    Config(ConfigCommand),
    /// Make a token for a private scene, and the line for the file of `serve --tokens`
    Token(TokenArgs),
    /// Put a built store into an object store, or what of it is not there yet
    Publish(PublishArgs),
    /// Say what a store holds
    Inspect(InspectArgs),
    /// Check every blob of a store, and mend what is damaged from another copy
    Repair(RepairArgs),
    /// Compute what is seen from a region where the viewer stays, and add it to a store
    Zone(Box<ZoneArgs>),
    /// Build a sample scene, serve it and render a picture of it
    Demo(DemoArgs),
    /// Compare ways to select and transmit points: tables, plots and a report
    Experiment(Box<ExperimentArgs>),
    /// Ask a running server whether it is well (for container health checks)
    Health(HealthArgs),
}

#[derive(Args)]
struct BuildArgs {
    /// DEM files of the layer "terrain": GeoTIFF, .hgt, Arc ASCII, USGS DEM or PNG, also in a .gz, or alone in a .zip;
    /// raw, also in a .gz
    #[arg(required_unless_present = "layers", value_name = "DEM")]
    sources: Vec<PathBuf>,
    /// Another layer: NAME=terrain:DEM or NAME=water:DEM (there is water where the file has heights), or flat water over
    /// the first terrain: NAME=water:level=METRES; or imagery draped on the terrain, NAME=texture:PICTURE, as GeoTIFF, PNG
    /// or JPEG with a world file. Said again with the same name it adds a file. The first layer decides
    /// the frame, to which others are resampled; what is said of files holds for those of all layers
    #[arg(long = "layer", id = "layers", value_name = "NAME=KIND:FILE")]
    layers: Vec<LayerArg>,
    /// The folder of the store, or the address of an object store (s3://BUCKET/PREFIX, gs://..., az://...); an older
    /// scene there is replaced once the new one is complete
    #[arg(short, long, value_name = "STORE")]
    output: PathBuf,
    /// Where the store is built before it is sent to an object store; then it stays there [default: NAME.upload here,
    /// which goes once all is sent]
    #[arg(long, value_name = "FOLDER")]
    work: Option<PathBuf>,
    /// The largest error at the finest level, in metres; 0 is lossless (floats: to the quantum)
    #[arg(long, default_value_t = 0.0, value_name = "METRES", allow_negative_numbers = true)]
    max_error: f64,
    /// The most memory to use
    #[arg(long, default_value = "2GiB", value_name = "BYTES", value_parser = parse_bytes)]
    memory: u64,
    /// Threads [default: one a core]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=1024))]
    threads: Option<u16>,
    /// Encodings to build
    #[arg(long, default_value = "points", value_enum, value_delimiter = ',')]
    encoding: Vec<Encoding>,
    /// tin: triangles of a patch at which simplification stops, but for the finest: these keep --max-error
    #[arg(long, default_value_t = hierarchy::PATCH_TRIANGLES, value_name = "N")]
    patch_triangles: u32,
    /// tin: the order of collapses
    #[arg(long, default_value = "normal", value_enum)]
    metric: MetricName,
    /// tin: how much borders along nodata count in that order
    #[arg(long, default_value_t = hierarchy::LAMBDA, value_name = "WEIGHT", allow_negative_numbers = true)]
    lambda: f64,
    /// tin: stop at this error instead of a count, in metres: of the finest patches that are simplified, twice as much
    /// every two levels
    #[arg(long, value_name = "METRES", allow_negative_numbers = true)]
    patch_error: Option<f64>,
    /// How the receiver deduces the height of a fictitious point
    #[arg(long, default_value = "smooth", value_enum)]
    rule: RuleName,
    /// Metres of the unit in which heights are stored [default: the source's own unit, or found from it]
    #[arg(long, value_name = "METRES", allow_negative_numbers = true)]
    quantum: Option<f64>,
    /// How well textures keep their pictures: 1 to 99, as of JPEG; 100: exactly
    #[arg(long, default_value_t = texture::QUALITY, value_name = "N")]
    texture_quality: u8,
    /// Segments along each side of a patch
    #[arg(long, default_value = "64", value_name = "N", value_parser = ["32", "64", "128"])]
    patch_segments: String,
    /// The scene's name in addresses [default: the name of the store's folder]
    #[arg(long, value_name = "NAME")]
    scene: Option<String>,
    #[command(flatten)]
    ingest: ingest::Options,
    /// Begin anew even where an interrupted build of the same could be gone on with
    #[arg(long)]
    fresh: bool,
    /// Seconds between checkpoints: the most work that a kill costs
    #[arg(long, default_value_t = hierarchy::CHECKPOINT.as_secs(), value_name = "SECONDS")]
    checkpoint: u64,
    /// Only estimate, from a sample of the source, what a build of points would take and give; nothing is written
    #[arg(long)]
    dry_run: bool,
    /// Print the report as JSON
    #[arg(long)]
    json: bool,
}

#[derive(Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Encoding {
    /// Progressive points: the fewest bytes
    Points,
    /// Irregular triangles: the fewest triangles
    Tin,
}

#[derive(Clone, Copy, ValueEnum)]
enum MetricName {
    /// How much normals change
    Normal,
    /// Squared distances to planes
    Quadric,
}

#[derive(Clone, Copy, ValueEnum)]
enum RuleName {
    Midpoint,
    Smooth,
}

#[derive(Args)]
struct ServeArgs {
    /// Settings as TOML, `max_connections = 10` for --max-connections 10; flags win, then variables such as
    /// DIAMANTINA_MAX_CONNECTIONS [also: DIAMANTINA_CONFIG]
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    #[command(flatten)]
    settings: Settings,
}

#[derive(Subcommand)]
enum ConfigCommand {
    /// Try all that `serve` would do with a file of settings, but for listening and the disk cache
    Check(Box<ServeArgs>),
    /// Print all settings as a file, and where each is from
    Print(Box<ServeArgs>),
}

#[derive(Args)]
struct TokenArgs {
    /// The scene's name
    scene: String,
}

#[derive(Args)]
struct PublishArgs {
    /// The folder of the store
    store: PathBuf,
    /// Where to: s3://BUCKET/PREFIX, gs://..., az://...
    address: PathBuf,
    /// Then remove all versions there but this one and the one before
    #[arg(long)]
    prune: bool,
}

#[derive(Args)]
struct InspectArgs {
    /// The folder of the store, or the address of an object store
    store: PathBuf,
    /// Print JSON
    #[arg(long)]
    json: bool,
    /// Read, check and decode every blob
    #[arg(long)]
    verify: bool,
    /// Write, for each prefix of each layer's progressive stream, its bytes and its declared and true errors
    /// here (- for standard output, and nothing else)
    #[arg(long, value_name = "CSV")]
    curve: Option<PathBuf>,
}

#[derive(Args)]
struct RepairArgs {
    /// The folder of the store, or the address of an object store
    store: PathBuf,
    /// A copy of the same version: a folder, the address of an object store, or http://HOST:PORT of a server [default:
    /// nothing is mended, only told]
    #[arg(long, value_name = "COPY")]
    from: Option<PathBuf>,
}

#[derive(Args)]
struct ZoneArgs {
    /// The folder of the store
    store: PathBuf,
    /// The zone's name in addresses
    #[arg(long, value_name = "NAME")]
    name: String,
    /// The region, as GeoJSON: a Polygon or MultiPolygon, alone or in features. Ground that slopes is better cut
    /// into several polygons: each has its own ceiling
    #[arg(long, value_name = "GEOJSON", required_unless_present = "remove")]
    polygon: Option<PathBuf>,
    /// What the polygon's numbers mean
    #[arg(long, default_value = "auto", value_enum)]
    coordinates: Coordinates,
    /// How far above the highest ground of each polygon the eye may be
    #[arg(long, value_name = "METRES", required_unless_present = "remove", allow_negative_numbers = true)]
    eye: Option<f64>,
    /// The least height of the ground in the polygons, where the scene has none, as of water
    #[arg(long, value_name = "METRES", allow_negative_numbers = true)]
    level: Option<f64>,
    /// What the errors of hidden ground count for: 0 to below 1
    #[arg(long, default_value_t = zone::HIDDEN, value_name = "SHARE", allow_negative_numbers = true)]
    hidden: f64,
    /// The angle of a pixel: errors grow no larger than what hides them allows. 0: all that is hidden counts for
    /// --hidden, however little it is hidden
    #[arg(long, default_value_t = zone::ANGLE, value_name = "RADIANS", allow_negative_numbers = true)]
    angle: f64,
    /// The least apparent width of a triangle that a ray must not miss
    #[arg(long, default_value_t = zone::EPSILON, value_name = "RADIANS", allow_negative_numbers = true)]
    epsilon: f64,
    /// Between eyes along the contour [default: 4 cells, or more for 200 eyes at most]
    #[arg(long, value_name = "METRES", allow_negative_numbers = true)]
    spacing: Option<f64>,
    /// Let the Earth's curvature hide what is far (with refraction, coefficient 0.13). The client draws a plane:
    /// there, what lies behind the horizon is seen
    #[arg(long)]
    curvature: bool,
    /// Replace a zone of this name
    #[arg(long)]
    replace: bool,
    /// Remove the zone instead
    #[arg(long, conflicts_with_all = ["polygon", "eye", "replace"])]
    remove: bool,
    /// The most memory to use
    #[arg(long, default_value = "2GiB", value_name = "BYTES", value_parser = parse_bytes)]
    memory: u64,
    /// Threads [default: one a core]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=1024))]
    threads: Option<u16>,
    /// Print the report as JSON
    #[arg(long)]
    json: bool,
}

#[derive(Args)]
struct DemoArgs {
    /// The folder for the sample DEM, its store and the picture
    #[arg(long, default_value = "demo", value_name = "FOLDER")]
    folder: PathBuf,
    /// Samples along each side of the sample DEM
    #[arg(long, default_value_t = 2049, value_name = "N", value_parser = clap::value_parser!(u32).range(257..=16385))]
    samples: u32,
    /// The address to listen on
    #[arg(long, default_value = "127.0.0.1:8080", value_name = "ADDRESS:PORT")]
    listen: SocketAddr,
    /// End after the picture [also: HEADLESS=1]
    #[arg(long)]
    headless: bool,
}

#[derive(Args)]
struct ExperimentArgs {
    /// Which
    #[arg(value_name = "NAME", value_parser = experiment::ALL.iter().map(|e| e.name).collect::<Vec<_>>())]
    name: String,
    /// DEM files, each by itself, in any format that `build` reads
    #[arg(required = true, value_name = "DEM")]
    sources: Vec<PathBuf>,
    /// The folder for the tables (CSV), the pictures and report.html
    #[arg(short, long, value_name = "FOLDER")]
    output: PathBuf,
    #[command(flatten)]
    options: experiment::Options,
    #[command(flatten)]
    ingest: ingest::Options,
    /// Print the tables as JSON
    #[arg(long)]
    json: bool,
}

#[derive(Args)]
struct HealthArgs {
    /// The server's address
    #[arg(default_value = "127.0.0.1:8080", value_name = "ADDRESS:PORT")]
    address: SocketAddr,
}

/// The exit code of a build that was asked to stop.
const INTERRUPTED: u8 = 130;

/// How long a build may take to stop.
const STOP_MAX: Duration = Duration::from_millis(9500);

/// A failure with its exit code: 1 failed, 2 wrong use, 130 interrupted.
struct Failure(u8, String);

impl<E: std::error::Error> From<E> for Failure {
    fn from(error: E) -> Self {
        Self(1, error.to_string())
    }
}

/// What became of printing results. That nobody reads any more, as behind `| head`, is no failure.
fn shown(printed: std::io::Result<()>) -> std::io::Result<()> {
    match printed {
        Err(e) if e.kind() == std::io::ErrorKind::BrokenPipe => Ok(()),
        other => other,
    }
}

/// Writes the log on standard error; `RUST_LOG` says how much of it.
fn start_log(format: LogFormat) {
    let filter = tracing_subscriber::EnvFilter::try_from_default_env().unwrap_or_else(|_| "warn".into());
    let colours =
        std::io::stderr().is_terminal() && std::env::var_os("NO_COLOR").is_none_or(|v| v.is_empty());
    let log = tracing_subscriber::fmt().with_env_filter(filter).with_writer(std::io::stderr);
    match format {
        LogFormat::Text => log.with_ansi(colours).init(),
        LogFormat::Json => log.json().flatten_event(true).init(),
    }
}

fn main() -> ExitCode {
    let matches = Cli::command().get_matches();
    let cli = Cli::from_arg_matches(&matches).unwrap_or_else(|error| error.exit());
    if !matches!(cli.command, Command::Serve(_)) {
        start_log(LogFormat::Text);
    }
    // The arguments of the innermost command: which of them were given is seen there.
    let mut given = &matches;
    while let Some((_, inner)) = given.subcommand() {
        given = inner;
    }
    let result = match cli.command {
        Command::Build(args) => build(&args),
        Command::Serve(args) => serve(given, args.config),
        Command::Config(ConfigCommand::Check(args)) => check_config(given, args.config),
        Command::Config(ConfigCommand::Print(args)) => print_config(given, args.config),
        Command::Token(args) => make_token(&args.scene),
        Command::Publish(args) => publish(&args),
        Command::Inspect(args) => inspect_store(&args),
        Command::Repair(args) => repair_store(&args),
        Command::Zone(args) => compute_zone(*args),
        Command::Demo(args) => demonstrate(&args),
        Command::Experiment(args) => experiment(&args, given),
        Command::Health(args) => http::ask_health(args.address).map_err(|e| Failure(1, e)),
    };
    match result {
        Ok(()) => ExitCode::SUCCESS,
        Err(Failure(code, message)) => {
            // Nothing is left to do if standard error is closed.
            let _ = writeln!(std::io::stderr(), "error: {message}");
            ExitCode::from(code)
        }
    }
}

/// The scene's name: the one given, or the store's own folder, made fit for an address.
fn scene_name(given: Option<String>, store: &Path) -> Result<String, Failure> {
    if let Some(name) = given {
        return if is_name(&name) {
            Ok(name)
        } else {
            Err(Failure(
                2,
                format!(
                    "--scene '{name}': expected 1 to 64 letters, digits, '-', '_' or '.', not starting with '.'"
                ),
            ))
        };
    }
    let folder = store.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
    let fit: String = folder
        .chars()
        .map(|c| if c.is_ascii_alphanumeric() || "._-".contains(c) { c } else { '-' })
        .collect();
    let fit = fit.trim_start_matches('.').to_owned();
    match fit.as_str() {
        "" => Ok("scene".to_owned()),
        name if is_name(name) => Ok(fit),
        name => Err(Failure(
            2,
            format!(
                "{}: expected a folder whose name can be the scene's, at most 64 characters, found {}: \
                 name the scene with --scene NAME",
                store.display(),
                name.len()
            ),
        )),
    }
}

fn build(args: &BuildArgs) -> Result<(), Failure> {
    if let Some(threads) = args.threads {
        rayon::ThreadPoolBuilder::new().num_threads(threads.into()).build_global()?;
    }
    let options = hierarchy::Options {
        scene: scene_name(args.scene.clone(), &args.output)?,
        max_error: args.max_error,
        rule: match args.rule {
            RuleName::Midpoint => Rule::Midpoint,
            RuleName::Smooth => Rule::Smooth,
        },
        quantum: args.quantum,
        texture_quality: args.texture_quality,
        patch_log2: match args.patch_segments.as_str() {
            "32" => 5,
            "128" => 7,
            _ => 6,
        },
        points: args.encoding.contains(&Encoding::Points),
        tin: args.encoding.contains(&Encoding::Tin).then_some(TinOptions {
            patch_triangles: args.patch_triangles,
            metric: match args.metric {
                MetricName::Normal => Metric::Normal,
                MetricName::Quadric => Metric::Quadric,
            },
            lambda: args.lambda,
            patch_error: args.patch_error,
        }),
        memory: args.memory,
        fresh: args.fresh,
        checkpoint: Duration::from_secs(args.checkpoint),
    };
    let layers = layer_args::join(&args.sources, &args.layers).map_err(|e| Failure(2, e))?;
    // Flat water has as many cells as the least forest.
    let layers = Layers::open(layers, &args.ingest, options.patch_log2 + 1)
        .map_err(|e| refuse_build(None, &e.into()))?;
    for name in layers.apart() {
        let words =
            "does not touch the first layer: are both files in the systems of coordinates that they name?";
        let _ = writeln!(std::io::stderr(), "notice: layer '{name}' {words}");
    }
    if args.dry_run {
        let estimates =
            hierarchy::estimate(&layers.sources(), &options).map_err(|e| refuse_build(Some(&layers), &e))?;
        let mut out = std::io::stdout().lock();
        if args.json {
            writeln!(out, "{}", serde_json::to_string_pretty(&estimates)?)?;
        } else {
            print::estimates(&mut out, &args.output, &estimates)?;
            for source in layers.textures() {
                let texture = texture::describe(source, options.texture_quality)
                    .map_err(|error| Failure(2, format!("texture '{}': {error}", source.name)))?;
                print::planned_texture(&mut out, &texture)?;
            }
        }
        return Ok(());
    }
    let upload = upload(args)?;
    let built = upload.as_ref().map_or(&args.output, |upload| &upload.folder);
    // What a build replaces need not be a store that can be read.
    let zones: Vec<String> = Store::open(built)
        .map(|s| s.scene().zones.iter().map(|z| z.name.clone()).collect())
        .unwrap_or_default();
    let progress = Arc::new(Progress::new());
    stop_on_signals(&progress)?;
    let report = hierarchy::build_scene(&layers.sources(), &layers.textures(), built, &options, &progress)
        .map_err(|e| refuse_build(Some(&layers), &e))?;
    if let Some(upload) = &upload {
        send(&upload.publisher, built, &args.output, false, &progress)?;
        if args.work.is_none() {
            std::fs::remove_dir_all(built)
                .map_err(|e| Failure(1, format!("{}: cannot remove it: {e}", built.display())))?;
        }
    }
    if !zones.is_empty() {
        let _ = writeln!(
            std::io::stderr(),
            "notice: the zones of the scene before are gone, since they told what was seen there ({}): compute them \
             again with `diamantina-server zone {}`",
            zones.join(", "),
            args.output.display()
        );
    }
    let mut out = std::io::stdout().lock();
    if args.json {
        shown(writeln!(out, "{}", serde_json::to_string_pretty(&report)?))?;
    } else {
        shown(print::report(&mut out, &args.output, &report))?;
    }
    Ok(())
}

/// Where a build for an object store goes first, and then.
struct Upload {
    publisher: Publisher,
    folder: PathBuf,
}

/// What a build needs whose output is an object store. That this can be written to is found before hours of work.
fn upload(args: &BuildArgs) -> Result<Option<Upload>, Failure> {
    if !is_address(&args.output) {
        return match &args.work {
            Some(_) => Err(Failure(2, "--work is for an output such as s3://BUCKET/PREFIX".to_owned())),
            None => Ok(None),
        };
    }
    let name = args.output.file_name().unwrap_or_default().to_string_lossy();
    let folder = args.work.clone().unwrap_or_else(|| PathBuf::from(format!("{name}.upload")));
    if is_address(&folder) {
        return Err(Failure(2, format!("--work {}: expected a folder of this machine", folder.display())));
    }
    Ok(Some(Upload { publisher: Publisher::open(&args.output)?, folder }))
}

/// Publishes the store in a folder at an address.
fn send(
    publisher: &Publisher,
    folder: &Path,
    address: &Path,
    prune: bool,
    progress: &Progress,
) -> Result<Published, Failure> {
    progress.stage("sending", "bytes", Publisher::bytes(folder)?, 0);
    let go_on = |bytes: u64| {
        progress.advance(bytes);
        !progress.is_stopping()
    };
    let again = || {
        let (folder, address) = (folder.display(), address.display());
        format!(
            "the scene is complete in {folder}: `diamantina-server publish {folder} {address}` sends what is missing"
        )
    };
    let published = publisher.publish(folder, prune, go_on);
    progress.finish();
    match published {
        Ok(Some(published)) => Ok(published),
        Ok(None) => Err(Failure(INTERRUPTED, format!("stopped; {}", again()))),
        Err(error) => Err(Failure(1, format!("{error}; {}", again()))),
    }
}

fn publish(args: &PublishArgs) -> Result<(), Failure> {
    let progress = Arc::new(Progress::new());
    stop_on_signals(&progress)?;
    let publisher = Publisher::open(&args.address)?;
    let Published { scene, sent, kept, pruned } =
        send(&publisher, &args.store, &args.address, args.prune, &progress)?;
    let mut out = std::io::stdout().lock();
    let printed = writeln!(
        out,
        "{}: scene '{}', version {}: {sent} bytes sent, {kept} were there{}",
        args.address.display(),
        scene.name,
        scene.version,
        if args.prune { format!(", {pruned} objects of versions before removed") } else { String::new() }
    );
    shown(printed.and_then(|()| writeln!(out, "Next: diamantina-server serve {}", args.address.display())))?;
    Ok(())
}

/// The first Ctrl-C or SIGTERM asks for a stop, which keeps what is done; a second one ends the program at once,
/// and so do ten seconds.
fn stop_on_signals(progress: &Arc<Progress>) -> std::io::Result<()> {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    let guard = runtime.enter();
    let mut interrupt = signal(SignalKind::interrupt())?;
    let mut terminate = signal(SignalKind::terminate())?;
    drop(guard);
    let progress = Arc::clone(progress);
    std::thread::spawn(move || {
        runtime.block_on(async {
            tokio::select! { _ = interrupt.recv() => {}, _ = terminate.recv() => {} }
            progress.stop();
            progress.say("stopping; once more ends at once");
            // Whatever holds the build up, its last checkpoint is on the disk.
            let patience = tokio::time::sleep(STOP_MAX);
            tokio::select! { _ = interrupt.recv() => {}, _ = terminate.recv() => {}, () = patience => {} }
        });
        std::process::exit(i32::from(INTERRUPTED));
    });
    Ok(())
}

/// Options that make no sense, or not for this source, are wrong use; all else is failure.
fn refuse_build(layers: Option<&Layers>, error: &BuildError) -> Failure {
    let cause = error.cause();
    let wrong_use = matches!(
        cause,
        BuildError::MaxError { .. }
            | BuildError::Quantum(_)
            | BuildError::Memory { .. }
            | BuildError::PatchErrorMemory { .. }
            | BuildError::TinOption { .. }
            | BuildError::Layers(_)
            | BuildError::Textures(_)
            | BuildError::TextureQuality(_)
            | BuildError::Store(StoreError::Foreign { .. })
            | BuildError::Ingest(IngestError::Options { .. })
    );
    // What the heights themselves are to blame for names where they came from.
    let about_heights = matches!(cause, BuildError::AllNodata(_) | BuildError::Range { .. });
    let layer = match error {
        BuildError::Layer { layer, .. } => Some(layer.as_str()),
        _ => None,
    };
    let files = layers.filter(|_| about_heights).map_or(&[][..], |layers| layers.files(layer));
    let names: Vec<String> = files.iter().map(|file| file.display().to_string()).collect();
    let from = if names.is_empty() { String::new() } else { format!("{}: ", names.join(", ")) };
    let code = match error {
        BuildError::Interrupted { .. } => INTERRUPTED,
        _ if wrong_use => 2,
        _ => 1,
    };
    Failure(code, format!("{from}{error}"))
}

/// What holds for `serve`, of the arguments given, the environment and a file.
fn settings(given: &ArgMatches, config: Option<PathBuf>) -> Result<Merged, Failure> {
    let variables: Vec<_> =
        std::env::vars_os().filter_map(|(name, value)| Some((name.into_string().ok()?, value))).collect();
    let named = || std::env::var_os("DIAMANTINA_CONFIG").filter(|path| !path.is_empty()).map(PathBuf::from);
    let merged = settings::merge(given, config.or_else(named).as_deref(), &variables);
    merged.map_err(|e| Failure(2, e.to_string()))
}

/// The stores and options of settings, if they are complete.
fn serving(settings: &Settings) -> Result<http::Options, Failure> {
    if settings.stores.is_empty() {
        let words =
            "no store to serve: name folders of stores, or say stores = [\"STORE\"] in a --config file";
        return Err(Failure(2, words.to_owned()));
    }
    let certificate = settings.certificate().map_err(|e| Failure(2, e.to_string()))?;
    let disk_cache = settings.disk_cache.clone().map(|folder| (folder, settings.disk_cache_size));
    let web = settings.web.clone().or_else(http::web_folder);
    Ok(http::Options {
        limits: settings.limits,
        tokens: settings.tokens.clone(),
        certificate,
        disk_cache,
        web,
    })
}

fn serve(given: &ArgMatches, config: Option<PathBuf>) -> Result<(), Failure> {
    let Merged { settings, notices, .. } = settings(given, config)?;
    start_log(settings.log_format);
    for notice in notices {
        tracing::warn!("{notice}");
    }
    let server = http::Server::open_with(&settings.stores, settings.listen, &serving(&settings)?)?;
    let mut out = std::io::stdout().lock();
    let mut printed = writeln!(out, "Serving {} at {}", server.scenes().join(", "), server.address());
    if server.has_viewer() {
        printed = printed.and_then(|()| writeln!(out, "Open {}/ in a browser", server.address()));
    }
    shown(printed.and_then(|()| out.flush()))?;
    drop(out);
    Ok(server.run_until_signal()?)
}

fn check_config(given: &ArgMatches, config: Option<PathBuf>) -> Result<(), Failure> {
    let Merged { settings, notices, .. } = settings(given, config)?;
    let scenes = http::check(&settings.stores, &serving(&settings)?)?;
    let mut out = std::io::stdout().lock();
    for notice in notices {
        shown(writeln!(out, "notice: {notice}"))?;
    }
    Ok(shown(writeln!(out, "These settings are well: {} would be served", scenes.join(", ")))?)
}

fn print_config(given: &ArgMatches, config: Option<PathBuf>) -> Result<(), Failure> {
    let merged = settings(given, config)?;
    Ok(shown(write!(std::io::stdout().lock(), "{}", merged.to_toml()))?)
}

fn make_token(scene: &str) -> Result<(), Failure> {
    if !is_name(scene) {
        return Err(Failure(2, format!("'{scene}' is no name of a scene")));
    }
    let (token, hash) = http::new_token()?;
    let mut out = std::io::stdout().lock();
    shown(writeln!(
        out,
        "For who may see '{scene}', as `Authorization: Bearer TOKEN`; it is shown only now:\n  {token}\n\
         For the file of `serve --tokens`:\n  {scene} {hash}"
    ))?;
    Ok(())
}

/// Losses that are listed.
const LOSSES_SHOWN: usize = 20;

fn repair_store(args: &RepairArgs) -> Result<(), Failure> {
    let progress = Progress::new();
    progress.stage("checking", "blobs", 0, 0);
    let repaired = repair::repair(&args.store, args.from.as_deref(), |blobs| progress.advance(blobs));
    progress.finish();
    let report = repaired?;
    let mut out = std::io::stdout().lock();
    let printed = writeln!(
        out,
        "{}: version {}, {} blobs: {} mended, {} damaged{}",
        args.store.display(),
        report.version,
        report.blobs,
        report.mended,
        report.lost.len(),
        if report.directory { "; the directory was replaced" } else { "" }
    );
    let listed = report.lost.iter().take(LOSSES_SHOWN).try_for_each(|lost| writeln!(out, "  {lost}"));
    shown(printed.and(listed))?;
    if report.lost.is_empty() {
        return Ok(());
    }
    let words = "not all could be mended: name another copy of this version with --from; or build the same DEM with the same \
                 options into another folder, which gives the same version, and mend --from that one";
    Err(Failure(1, words.to_owned()))
}

/// Bytes of a remote store that are kept on the disk while it is inspected.
const INSPECTED_BYTES: u64 = 1 << 30;

fn inspect_store(args: &InspectArgs) -> Result<(), Failure> {
    // Blobs are read one by one, and an object store is asked for whole pieces of packs.
    let folder = is_address(&args.store).then(tempfile::tempdir).transpose()?;
    let disk = folder.as_ref().map(|folder| Disk::open(folder.path(), INSPECTED_BYTES)).transpose()?;
    let shared = Arc::new(Shared { disk, ..Shared::default() });
    let store = Arc::new(Store::open_sharing(&args.store, &shared)?);
    let inspection = inspect::inspect(&store, args.verify)?;
    let mut out = std::io::stdout().lock();
    if let Some(path) = &args.curve {
        if path.as_os_str() == "-" {
            return Ok(curve::write(&store, &mut out)??);
        }
        let unwritten = |e: std::io::Error| Failure(1, format!("{}: cannot write: {e}", path.display()));
        let mut file = std::fs::File::create(path).map_err(unwritten)?;
        curve::write(&store, &mut file)?.map_err(unwritten)?;
    }
    if args.json {
        shown(writeln!(out, "{}", serde_json::to_string_pretty(&inspection)?))?;
    } else {
        shown(print::inspection(&mut out, &inspection))?;
    }
    Ok(())
}

fn compute_zone(args: ZoneArgs) -> Result<(), Failure> {
    let mut out = std::io::stdout().lock();
    if args.remove {
        let scene = zone::remove(&args.store, &args.name).map_err(|e| refuse_zone(&e))?;
        let what = if args.json {
            serde_json::to_string_pretty(&scene.zones)?
        } else {
            format!("{}: zone '{}' is gone; version {}", args.store.display(), args.name, scene.version)
        };
        return Ok(shown(writeln!(out, "{what}"))?);
    }
    if let Some(threads) = args.threads {
        rayon::ThreadPoolBuilder::new().num_threads(threads.into()).build_global()?;
    }
    let options = zone::Options {
        name: args.name,
        polygon: args.polygon.unwrap_or_default(),
        coordinates: args.coordinates,
        eye: args.eye.unwrap_or_default(),
        level: args.level,
        hidden: args.hidden,
        angle: args.angle,
        epsilon: args.epsilon,
        spacing: args.spacing,
        curvature: args.curvature,
        replace: args.replace,
        memory: args.memory,
    };
    let progress = Arc::new(Progress::new());
    stop_on_signals(&progress)?;
    let report = zone::add(&args.store, &options, &progress).map_err(|e| refuse_zone(&e))?;
    if args.json {
        shown(writeln!(out, "{}", serde_json::to_string_pretty(&report)?))?;
    } else {
        shown(print::zone(&mut out, &args.store, &report))?;
    }
    Ok(())
}

/// Options that make no sense, or not for this store, are wrong use; all else is failure.
fn refuse_zone(error: &ZoneError) -> Failure {
    let code = match error {
        ZoneError::Interrupted => INTERRUPTED,
        ZoneError::Option { .. }
        | ZoneError::Exists { .. }
        | ZoneError::Unknown { .. }
        | ZoneError::Eyes { .. }
        | ZoneError::Memory { .. } => 2,
        _ => 1,
    };
    Failure(code, error.to_string())
}

fn demonstrate(args: &DemoArgs) -> Result<(), Failure> {
    let headless = args.headless || std::env::var("HEADLESS").is_ok_and(|v| !v.is_empty() && v != "0");
    demo::run(&args.folder, args.samples, args.listen, headless).map_err(|e| Failure(1, e.to_string()))
}

fn experiment(args: &ExperimentArgs, given: &clap::ArgMatches) -> Result<(), Failure> {
    experiment::refuse_ignored(&args.name, given).map_err(|e| Failure(2, e.to_string()))?;
    let progress = Arc::new(Progress::new());
    stop_on_signals(&progress)?;
    let found = experiment::run(&args.name, &args.sources, &args.ingest, &args.options, &progress);
    progress.finish();
    let report = found.map_err(|e| {
        let code = match e {
            ExperimentError::Unknown { .. } | ExperimentError::Options { .. } => 2,
            ExperimentError::Ingest(IngestError::Options { .. }) => 2,
            ExperimentError::Stopped => INTERRUPTED,
            _ => 1,
        };
        Failure(code, e.to_string())
    })?;
    report.write(&args.output)?;
    let others = report.others(&args.output);
    if !others.is_empty() {
        // Nothing is left to do if standard error is closed.
        let _ = writeln!(
            std::io::stderr(),
            "notice: {}: these are of another run, and not in report.html: {}",
            args.output.display(),
            others.join(", ")
        );
    }
    let mut out = std::io::stdout().lock();
    if args.json {
        return Ok(shown(writeln!(out, "{}", serde_json::to_string_pretty(&report)?))?);
    }
    Ok(shown(print::experiment(&mut out, &args.output, &report))?)
}
