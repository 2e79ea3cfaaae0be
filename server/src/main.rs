//! The command line of the server.

mod arguments;
mod layer_args;
mod print;
mod series_args;

use arguments::{
    BuildArgs, Cli, Command, ConfigCommand, DemoArgs, Encoding, ExperimentArgs, InspectArgs, MetricName,
    PublishArgs, RepairArgs, RuleName, ZoneArgs,
};
use clap::{ArgMatches, CommandFactory, FromArgMatches};
use diamantina_protocol::arguments::with_negative_numbers;
use diamantina_protocol::message::is_name;
use diamantina_protocol::points::Rule;
use diamantina_protocol::series::STEP_SECONDS;
use diamantina_server::experiment::ExperimentError;
use diamantina_server::hierarchy::{self, BuildError, Content, TinOptions};
use diamantina_server::ingest::IngestError;
use diamantina_server::inspect;
use diamantina_server::progress::Progress;
use diamantina_server::settings::{self, LogFormat, Merged, Settings};
use diamantina_server::store::{Disk, Published, Publisher, Shared, Store, StoreError, is_address, repair};
use diamantina_server::tin::Metric;
use diamantina_server::zone::{self, ZoneError};
use diamantina_server::{curve, demo, experiment, http, texture};
use layer_args::{Layers, OpenError};
use std::io::{IsTerminal, Write};
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::Arc;
use std::time::Duration;
use tokio::signal::unix::{SignalKind, signal};

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
    let matches = Cli::command().get_matches_from(with_negative_numbers(std::env::args_os()));
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
    if !STEP_SECONDS.contains(&args.step_seconds) {
        let (least, most) = (STEP_SECONDS.start(), STEP_SECONDS.end());
        return Err(Failure(
            2,
            format!("--step-seconds {}: expected seconds from {least} to {most}", args.step_seconds),
        ));
    }
    let layers = layer_args::join(&args.sources, &args.layers).map_err(|e| Failure(2, e))?;
    for words in layer_args::gaps(&layers) {
        let _ = writeln!(std::io::stderr(), "notice: {words}");
    }
    // Flat water has as many cells as the least forest.
    let opened = Layers::open(layers, &args.ingest, options.patch_log2 + 1, args.step_seconds);
    let layers = opened.map_err(|e| match e {
        OpenError::Ingest(e) => refuse_build(None, &e.into()),
        OpenError::Steps { .. } => Failure(2, e.to_string()),
    })?;
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
            print::estimates(&mut out, &args.output, &estimates, layers.series())?;
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
    let content =
        Content { layers: &layers.sources(), textures: &layers.textures(), series: layers.series() };
    let report = hierarchy::build_scene(content, built, &options, &progress)
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
    let inspection = match inspect::inspect(&store, args.verify) {
        Err(first) if args.verify => return Err(all_damage(&store, &first.to_string())),
        inspected => inspected?,
    };
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

/// The first thing that was found wrong with a store, and all other blobs that are damaged.
fn all_damage(store: &Store, first: &str) -> Failure {
    let found: Vec<String> = inspect::damaged(store).iter().map(ToString::to_string).collect();
    let others: Vec<&str> = found.iter().map(String::as_str).filter(|other| *other != first).collect();
    if others.is_empty() {
        return Failure(1, first.to_owned());
    }
    let mut words = format!("{first}\n{} more of its blobs are damaged:", others.len());
    for other in others.iter().take(LOSSES_SHOWN) {
        words = words + "\n  " + other;
    }
    if others.len() > LOSSES_SHOWN {
        words += &format!("\n  and {} others", others.len() - LOSSES_SHOWN);
    }
    Failure(1, words)
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
    let is_new = experiment::report::prepare(&args.output)?;
    let found = experiment::run(&args.name, &args.sources, &args.ingest, &args.options, &progress);
    progress.finish();
    if found.is_err() && is_new {
        // Without an effect where something is in it.
        let _ = std::fs::remove_dir(&args.output);
    }
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
