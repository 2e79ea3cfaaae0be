//! What is typed: commands and their options.

use crate::layer_args::LayerArg;
use clap::{Args, Parser, Subcommand, ValueEnum};
use diamantina_server::settings::Settings;
use diamantina_server::size::parse_bytes;
use diamantina_server::zone::polygon::Coordinates;
use diamantina_server::{experiment, hierarchy, ingest, texture, zone};
use std::net::SocketAddr;
use std::path::PathBuf;

/// Builds and serves streamed terrain.
#[derive(Parser)]
#[command(version, about, propagate_version = true)]
pub(super) struct Cli {
    #[command(subcommand)]
    pub(super) command: Command,
}

#[derive(Subcommand)]
pub(super) enum Command {
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
pub(super) struct BuildArgs {
    /// DEM files of the layer "terrain": GeoTIFF, .hgt, Arc ASCII, USGS DEM or PNG, also in a .gz, or alone in a .zip;
    /// raw, also in a .gz
    #[arg(required_unless_present = "layers", value_name = "DEM")]
    pub(super) sources: Vec<PathBuf>,
    /// Another layer: NAME=terrain:DEM or NAME=water:DEM (there is water where the file has heights), or flat water over
    /// the first terrain: NAME=water:level=METRES; or water that changes with time, a file a step in the order of their
    /// numbers: NAME=water:'wave_*.tif', in quotes; or imagery draped on the terrain, NAME=texture:PICTURE, as GeoTIFF, PNG
    /// or JPEG with a world file. Said again with the same name it adds a file. The first layer decides
    /// the frame, to which others are resampled; what is said of files holds for those of all layers
    #[arg(long = "layer", id = "layers", value_name = "NAME=KIND:FILE")]
    pub(super) layers: Vec<LayerArg>,
    /// Seconds from a step to the next, of water that changes with time
    #[arg(long, default_value_t = 1.0, value_name = "SECONDS")]
    pub(super) step_seconds: f64,
    /// The folder of the store, or the address of an object store (s3://BUCKET/PREFIX, gs://..., az://...); an older
    /// scene there is replaced once the new one is complete
    #[arg(short, long, value_name = "STORE")]
    pub(super) output: PathBuf,
    /// Where the store is built before it is sent to an object store; then it stays there [default: NAME.upload here,
    /// which goes once all is sent]
    #[arg(long, value_name = "FOLDER")]
    pub(super) work: Option<PathBuf>,
    /// The largest error at the finest level, in metres; 0 is lossless (floats: to the quantum)
    #[arg(long, default_value_t = 0.0, value_name = "METRES")]
    pub(super) max_error: f64,
    /// The most memory to use
    #[arg(long, default_value = "2GiB", value_name = "BYTES", value_parser = parse_bytes)]
    pub(super) memory: u64,
    /// Threads [default: one a core]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=1024))]
    pub(super) threads: Option<u16>,
    /// Encodings to build
    #[arg(long, default_value = "points", value_enum, value_delimiter = ',')]
    pub(super) encoding: Vec<Encoding>,
    /// tin: triangles of a patch at which simplification stops, but for the finest: these keep --max-error
    #[arg(long, default_value_t = hierarchy::PATCH_TRIANGLES, value_name = "N")]
    pub(super) patch_triangles: u32,
    /// tin: the order of collapses
    #[arg(long, default_value = "normal", value_enum)]
    pub(super) metric: MetricName,
    /// tin: how much borders along nodata count in that order
    #[arg(long, default_value_t = hierarchy::LAMBDA, value_name = "WEIGHT")]
    pub(super) lambda: f64,
    /// tin: stop at this error instead of a count, in metres: of the finest patches that are simplified, twice as much
    /// every two levels
    #[arg(long, value_name = "METRES")]
    pub(super) patch_error: Option<f64>,
    /// How the receiver deduces the height of a fictitious point
    #[arg(long, default_value = "smooth", value_enum)]
    pub(super) rule: RuleName,
    /// Metres of the unit in which heights are stored [default: the source's own unit, or found from it]
    #[arg(long, value_name = "METRES")]
    pub(super) quantum: Option<f64>,
    /// How well textures keep their pictures: 1 to 99, as of JPEG; 100: exactly
    #[arg(long, default_value_t = texture::QUALITY, value_name = "N")]
    pub(super) texture_quality: u8,
    /// Segments along each side of a patch
    #[arg(long, default_value = "64", value_name = "N", value_parser = ["32", "64", "128"])]
    pub(super) patch_segments: String,
    /// The scene's name in addresses [default: the name of the store's folder]
    #[arg(long, value_name = "NAME")]
    pub(super) scene: Option<String>,
    #[command(flatten)]
    pub(super) ingest: ingest::Options,
    /// Begin anew even where an interrupted build of the same could be gone on with
    #[arg(long)]
    pub(super) fresh: bool,
    /// Seconds between checkpoints: the most work that a kill costs
    #[arg(long, default_value_t = hierarchy::CHECKPOINT.as_secs(), value_name = "SECONDS")]
    pub(super) checkpoint: u64,
    /// Only estimate, from a sample of the source, what a build of points would take and give; nothing is written
    #[arg(long)]
    pub(super) dry_run: bool,
    /// Print the report as JSON
    #[arg(long)]
    pub(super) json: bool,
}

#[derive(Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(super) enum Encoding {
    /// Progressive points: the fewest bytes
    Points,
    /// Irregular triangles: the fewest triangles
    Tin,
}

#[derive(Clone, Copy, ValueEnum)]
pub(super) enum MetricName {
    /// How much normals change
    Normal,
    /// Squared distances to planes
    Quadric,
}

#[derive(Clone, Copy, ValueEnum)]
pub(super) enum RuleName {
    Midpoint,
    Smooth,
}

#[derive(Args)]
pub(super) struct ServeArgs {
    /// Settings as TOML, `max_connections = 10` for --max-connections 10; flags win, then variables such as
    /// DIAMANTINA_MAX_CONNECTIONS [also: DIAMANTINA_CONFIG]
    #[arg(long, value_name = "FILE")]
    pub(super) config: Option<PathBuf>,
    #[command(flatten)]
    pub(super) settings: Settings,
}

#[derive(Subcommand)]
pub(super) enum ConfigCommand {
    /// Try all that `serve` would do with a file of settings, but for listening and the disk cache
    Check(Box<ServeArgs>),
    /// Print all settings as a file, and where each is from
    Print(Box<ServeArgs>),
}

#[derive(Args)]
pub(super) struct TokenArgs {
    /// The scene's name
    pub(super) scene: String,
}

#[derive(Args)]
pub(super) struct PublishArgs {
    /// The folder of the store
    pub(super) store: PathBuf,
    /// Where to: s3://BUCKET/PREFIX, gs://..., az://...
    pub(super) address: PathBuf,
    /// Then remove all versions there but this one and the one before
    #[arg(long)]
    pub(super) prune: bool,
}

#[derive(Args)]
pub(super) struct InspectArgs {
    /// The folder of the store, or the address of an object store
    pub(super) store: PathBuf,
    /// Print JSON
    #[arg(long)]
    pub(super) json: bool,
    /// Read, check and decode every blob
    #[arg(long)]
    pub(super) verify: bool,
    /// Write, for each prefix of each layer's progressive stream, its bytes and its declared and true errors
    /// here (- for standard output, and nothing else)
    #[arg(long, value_name = "CSV")]
    pub(super) curve: Option<PathBuf>,
}

#[derive(Args)]
pub(super) struct RepairArgs {
    /// The folder of the store, or the address of an object store
    pub(super) store: PathBuf,
    /// A copy of the same version: a folder, the address of an object store, or http://HOST:PORT of a server [default:
    /// nothing is mended, only told]
    #[arg(long, value_name = "COPY")]
    pub(super) from: Option<PathBuf>,
}

#[derive(Args)]
pub(super) struct ZoneArgs {
    /// The folder of the store
    pub(super) store: PathBuf,
    /// The zone's name in addresses
    #[arg(long, value_name = "NAME")]
    pub(super) name: String,
    /// The region, as GeoJSON: a Polygon or MultiPolygon, alone or in features. Ground that slopes is better cut
    /// into several polygons: each has its own ceiling
    #[arg(long, value_name = "GEOJSON", required_unless_present = "remove")]
    pub(super) polygon: Option<PathBuf>,
    /// What the polygon's numbers mean
    #[arg(long, default_value = "auto", value_enum)]
    pub(super) coordinates: Coordinates,
    /// How far above the highest ground of each polygon the eye may be
    #[arg(long, value_name = "METRES", required_unless_present = "remove")]
    pub(super) eye: Option<f64>,
    /// The least height of the ground in the polygons, where the scene has none, as of water
    #[arg(long, value_name = "METRES")]
    pub(super) level: Option<f64>,
    /// What the errors of hidden ground count for: 0 to 0.996
    #[arg(long, default_value_t = zone::HIDDEN, value_name = "SHARE")]
    pub(super) hidden: f64,
    /// The angle of a pixel: errors grow no larger than what hides them allows. 0: all that is hidden counts for
    /// --hidden, however little it is hidden
    #[arg(long, default_value_t = zone::ANGLE, value_name = "RADIANS")]
    pub(super) angle: f64,
    /// The least apparent width of a triangle that a ray must not miss
    #[arg(long, default_value_t = zone::EPSILON, value_name = "RADIANS")]
    pub(super) epsilon: f64,
    /// Between eyes along the contour [default: 4 cells, or more for 200 eyes at most]
    #[arg(long, value_name = "METRES")]
    pub(super) spacing: Option<f64>,
    /// Let the Earth's curvature hide what is far (with refraction, coefficient 0.13). The client draws a plane:
    /// there, what lies behind the horizon is seen
    #[arg(long)]
    pub(super) curvature: bool,
    /// Replace a zone of this name
    #[arg(long)]
    pub(super) replace: bool,
    /// Remove the zone instead
    #[arg(long, conflicts_with_all = ["polygon", "eye", "replace"])]
    pub(super) remove: bool,
    /// The most memory to use
    #[arg(long, default_value = "2GiB", value_name = "BYTES", value_parser = parse_bytes)]
    pub(super) memory: u64,
    /// Threads [default: one a core]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=1024))]
    pub(super) threads: Option<u16>,
    /// Print the report as JSON
    #[arg(long)]
    pub(super) json: bool,
}

#[derive(Args)]
pub(super) struct DemoArgs {
    /// The folder for the sample DEM, its store and the picture
    #[arg(long, default_value = "demo", value_name = "FOLDER")]
    pub(super) folder: PathBuf,
    /// Samples along each side of the sample DEM
    #[arg(long, default_value_t = 2049, value_name = "N", value_parser = clap::value_parser!(u32).range(257..=16385))]
    pub(super) samples: u32,
    /// The address to listen on
    #[arg(long, default_value = "127.0.0.1:8080", value_name = "ADDRESS:PORT")]
    pub(super) listen: SocketAddr,
    /// End after the picture [also: HEADLESS=1]
    #[arg(long)]
    pub(super) headless: bool,
}

#[derive(Args)]
pub(super) struct ExperimentArgs {
    /// Which
    #[arg(value_name = "NAME", value_parser = experiment::ALL.iter().map(|e| e.name).collect::<Vec<_>>())]
    pub(super) name: String,
    /// DEM files, each by itself, in any format that `build` reads
    #[arg(required = true, value_name = "DEM")]
    pub(super) sources: Vec<PathBuf>,
    /// The folder for the tables (CSV), the pictures and report.html
    #[arg(short, long, value_name = "FOLDER")]
    pub(super) output: PathBuf,
    #[command(flatten)]
    pub(super) options: experiment::Options,
    #[command(flatten)]
    pub(super) ingest: ingest::Options,
    /// Print the tables as JSON
    #[arg(long)]
    pub(super) json: bool,
}

#[derive(Args)]
pub(super) struct HealthArgs {
    /// The server's address
    #[arg(default_value = "127.0.0.1:8080", value_name = "ADDRESS:PORT")]
    pub(super) address: SocketAddr,
}

#[cfg(test)]
#[allow(clippy::unwrap_used, clippy::panic, reason = "a test that cannot go on has failed")]
mod tests {
    use super::*;
    use diamantina_protocol::arguments::with_negative_numbers;

    #[test]
    fn negative_values_are_none_of_the_options() {
        let nodata = "-3.4028234663852886e+38";
        let words = ["", "build", "dem.tif", "--nodata", nodata, "-o", "out", "--height-offset", "-.5"];
        let words = with_negative_numbers(words.map(Into::into));
        let Command::Build(args) = Cli::try_parse_from(words).unwrap().command else {
            panic!("another command");
        };
        assert_eq!(args.output, PathBuf::from("out"));
        assert_eq!(
            (args.ingest.nodata, args.ingest.height_offset),
            (Some(nodata.parse().unwrap()), Some(-0.5))
        );
    }
}
