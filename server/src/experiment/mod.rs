//! Experiments in progressive transmission: selections, baselines, and the tables of the papers.
//!
//! Each experiment is one file with a function from [`Run`] or [`Whole`] to [`Report`], and a line in [`ALL`]. What sender and
//! receiver share, the bitree and its strips, is in the protocol; here is what chooses points and what
//! they are compared with.
//!
//! ```text
//! DEM -> windows -> fields -> select | quadtree | curvature -> measured anew -> report: CSV, SVG, PNG, HTML, JSON
//! ```

pub mod curvature;
pub mod field;
pub mod lod;
pub mod plot;
pub mod quadtree;
pub mod report;
pub mod scan;
pub mod select;
pub mod view;
pub mod windows;

mod by_curvature;
mod by_zone;
mod progressive;
mod strips;
mod tolerances;

use crate::ingest::IngestError;
use crate::progress::Progress;
use clap::parser::ValueSource;
use diamantina_protocol::bintree::Point;
use report::Report;
use select::Criterion;
use std::path::PathBuf;

/// What an experiment is told.
#[derive(Debug, Clone, clap::Args)]
#[group(id = "experiment_options")]
pub struct Options {
    #[command(flatten)]
    pub(crate) windows: windows::Options,
    /// `tolerances`, `strips`, `zone`: tolerances, percent of each window's relief
    #[arg(long, value_delimiter = ',', default_value = "0,1,2,7,10,14,50", value_name = "PERCENT")]
    pub(crate) tolerances: Vec<f64>,
    /// `tolerances`: also bitrees of these numbers of points, the four corners included, the largest errors first
    #[arg(long, value_delimiter = ',', value_name = "N")]
    pub(crate) points: Vec<usize>,
    /// `tolerances`, `strips`, `zone`: how the error of a triangle is told
    #[arg(long, value_enum, default_value_t = Criterion::Vertical)]
    pub(crate) criterion: Criterion,
    /// `tolerances`, `strips`, `curvature`: weights of samples: a raster of numbers from 0 to 1 on the DEM's own grid; no data counts as 0
    #[arg(long, value_name = "RASTER")]
    pub(crate) mask: Option<PathBuf>,
    #[command(flatten)]
    pub(crate) flights: lod::Options,
    #[command(flatten)]
    pub(crate) zone: by_zone::Options,
    /// `curvature`: where the observer stands, in samples from the window's south-west corner [default: the highest of its southern eighth]
    #[arg(long, value_name = "X,Y", value_parser = windows::parse_place)]
    pub(crate) observer: Option<Point>,
    /// `curvature`, `zone`: metres of the observer's eye above the ground
    #[arg(long, default_value_t = 50.0, value_name = "METRES")]
    pub(crate) eye: f64,
    /// `curvature`: how much distance forgives: a in T (a d / D + 1)
    #[arg(long, default_value_t = 20.0, value_name = "A")]
    pub(crate) forgiveness: f64,
    /// `curvature`: thresholds T at which the polygons of all rules are counted, sums of changes of slope without a unit [default: those of the plain rule's shares]
    #[arg(long, value_delimiter = ',', value_name = "T")]
    pub(crate) thresholds: Vec<f64>,
}

/// One run of an experiment.
#[derive(Debug)]
pub struct Run<'a> {
    /// The fields to work on.
    pub(crate) windows: &'a [windows::Window],
    pub(crate) options: &'a Options,
    pub(crate) progress: &'a Progress,
}

/// One run of an experiment on whole DEMs.
#[derive(Debug)]
pub struct Whole<'a> {
    /// The files, each by itself.
    pub(crate) sources: &'a [PathBuf],
    pub(crate) ingest: &'a crate::ingest::Options,
    pub(crate) options: &'a Options,
    pub(crate) progress: &'a Progress,
}

/// What an experiment works on.
#[derive(Debug, Clone, Copy)]
enum Work {
    /// Square windows of the DEMs.
    Windows(fn(&Run<'_>) -> Result<Report, ExperimentError>),
    /// The DEMs as they are.
    Whole(fn(&Whole<'_>) -> Result<Report, ExperimentError>),
}

/// An experiment by its name.
#[derive(Debug, Clone, Copy)]
pub struct Experiment {
    /// What the command line calls it.
    pub name: &'static str,
    /// What it shows.
    pub about: &'static str,
    /// The options that it heeds, by their identifiers.
    takes: &'static [&'static str],
    work: Work,
}

impl Experiment {
    /// Whether it heeds an option.
    fn takes(&self, option: &str) -> bool {
        self.takes.contains(&option) || matches!(self.work, Work::Windows(_)) && WINDOWS.contains(&option)
    }
}

/// The options of all that work on windows.
const WINDOWS: [&str; 3] = ["samples", "windows", "at"];

/// All there are.
pub const ALL: &[Experiment] = &[
    Experiment {
        name: "tolerances",
        about: "points, triangles and strips of bitree and restricted quadtree within tolerances",
        takes: &["tolerances", "points", "criterion", "mask"],
        work: Work::Windows(tolerances::run),
    },
    Experiment {
        name: "strips",
        about: "references of triangle strips beside separate triangles and other orders",
        takes: &["tolerances", "criterion", "mask"],
        work: Work::Windows(strips::run),
    },
    Experiment {
        name: "lod",
        about: "bytes and triangles of flights with each term of the client's level of detail on and off",
        takes: &["error_pixels", "frames", "foveation"],
        work: Work::Whole(lod::run),
    },
    Experiment {
        name: "curvature",
        about: "polygons by local curvature, and the pixels that an observer sees change",
        takes: &["mask", "observer", "eye", "forgiveness", "thresholds"],
        work: Work::Windows(by_curvature::run),
    },
    Experiment {
        name: "zone",
        about: "what is seen from a region, what its mask saves, and whether the skyline stays",
        takes: &[
            "tolerances",
            "criterion",
            "polygon",
            "coordinates",
            "hidden",
            "angle",
            "epsilon",
            "spacing",
            "eye",
        ],
        work: Work::Windows(by_zone::run),
    },
    Experiment {
        name: "progressive",
        about: "errors against points and bytes: by level, tolerance, error; quadtree, points payloads, raster",
        takes: &[],
        work: Work::Windows(progressive::run),
    },
];

/// Why an experiment has no result.
#[derive(Debug, thiserror::Error)]
pub enum ExperimentError {
    /// The name is of none.
    #[error("experiment '{found}': expected one of {}", names())]
    Unknown {
        /// What was asked for.
        found: String,
    },
    /// The DEM or the mask cannot be read.
    #[error(transparent)]
    Ingest(#[from] IngestError),
    /// An option makes no sense, or not for this DEM.
    #[error("{option}: expected {expected}, found {found}")]
    Options {
        /// Which.
        option: &'static str,
        /// What would do.
        expected: String,
        /// What was given.
        found: String,
    },
    /// Heights that nothing on a planet has.
    #[error(
        "{file}: expected heights below 262 km, found one of {largest} m in the window at sample {}, {}: beside it the others are rounded by \
         up to {rounding} m; if it stands for no data, say --nodata", at[0], at[1]
    )]
    Heights {
        /// The DEM.
        file: String,
        /// The window's south-west sample.
        at: [u32; 2],
        /// The largest height, in metres.
        largest: f64,
        /// How far others are off, in metres.
        rounding: f64,
    },
    /// An option would change nothing.
    #[error("--{option}: '{name}' does not heed it; leave it out, or run {heeding}")]
    Ignored {
        /// Which, without the dashes.
        option: String,
        /// The experiment.
        name: &'static str,
        /// Those that heed it.
        heeding: String,
    },
    /// A result cannot be written.
    #[error("{}: cannot write: {source}; name another folder with -o", path.display())]
    Write {
        /// Where.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// A plot cannot be drawn.
    #[error("plot: {0}")]
    Plot(String),
    /// The polygon is none.
    #[error(transparent)]
    Polygon(#[from] crate::zone::polygon::PolygonError),
    /// The flights did not come to an end.
    #[error(transparent)]
    Lod(#[from] lod::LodError),
    /// A coder failed, which is a fault of this program.
    #[error("{0}")]
    Coding(String),
    /// It was asked to stop.
    #[error("stopped; nothing was written")]
    Stopped,
}

fn names() -> String {
    ALL.iter().map(|e| e.name).collect::<Vec<_>>().join(", ")
}

/// Runs the experiment of a name on DEM files.
///
/// # Errors
/// When there is no such experiment, a file cannot be read, or an option does not fit.
pub fn run(
    name: &str,
    sources: &[PathBuf],
    ingest: &crate::ingest::Options,
    options: &Options,
    progress: &Progress,
) -> Result<Report, ExperimentError> {
    let unknown = || ExperimentError::Unknown { found: name.to_owned() };
    let experiment = ALL.iter().find(|e| e.name == name).ok_or_else(unknown)?;
    check(options)?;
    match experiment.work {
        Work::Windows(run) => {
            let windows =
                windows::read(sources, ingest, &options.windows, options.mask.as_deref(), progress)?;
            let mut report = run(&Run { windows: &windows, options, progress })?;
            if options.windows.windows != windows::Rule::One {
                report.notes.push(windows::counts(sources, &windows));
            }
            let padded = windows.iter().filter(|w| w.field.samples() < w.field.heights().len()).count();
            if padded > 0 {
                let all = windows.len();
                report.notes.push(format!(
                    "{padded} of {all} windows have samples without data, or reach beyond their DEM, which is the same."
                ));
            }
            Ok(report)
        }
        Work::Whole(run) => run(&Whole { sources, ingest, options, progress }),
    }
}

/// Refuses options that were given to an experiment which heeds them not: `matches` are of a command with [`Options`].
///
/// # Errors
/// Names the first of them, and who heeds it.
pub fn refuse_ignored(name: &str, matches: &clap::ArgMatches) -> Result<(), ExperimentError> {
    let unknown = || ExperimentError::Unknown { found: name.to_owned() };
    let experiment = ALL.iter().find(|e| e.name == name).ok_or_else(unknown)?;
    let command = <Options as clap::Args>::augment_args(clap::Command::new(""));
    for argument in command.get_arguments() {
        let id = argument.get_id().as_str();
        let is_given = matches.value_source(id) == Some(ValueSource::CommandLine);
        if is_given && !experiment.takes(id) {
            let heeding = ALL.iter().filter(|e| e.takes(id)).map(|e| e.name).collect::<Vec<_>>().join(", ");
            return Err(ExperimentError::Ignored {
                option: argument.get_long().unwrap_or(id).to_owned(),
                name: experiment.name,
                heeding,
            });
        }
    }
    Ok(())
}

/// Refuses options that make no sense for any DEM.
fn check(options: &Options) -> Result<(), ExperimentError> {
    let wrong = |option, expected: &str, found: &dyn std::fmt::Display| {
        let (expected, found) = (expected.to_owned(), found.to_string());
        Err(ExperimentError::Options { option, expected, found })
    };
    if let Some(bad) = options.tolerances.iter().find(|t| !(0.0..=1e6).contains(*t)) {
        return wrong("--tolerances", "percentages from 0", bad);
    }
    if let Some(bad) = options.points.iter().find(|n| **n < 4) {
        return wrong("--points", "numbers from 4, the corners", bad);
    }
    if !(options.eye > 0.0 && options.eye <= 1e6) {
        return wrong("--eye", "metres above the ground, above 0 and at most a million", &options.eye);
    }
    if !(0.0..=1e9).contains(&options.forgiveness) {
        return wrong("--forgiveness", "a number from 0", &options.forgiveness);
    }
    if let Some(bad) = options.thresholds.iter().find(|t| !(**t > 0.0 && **t <= 1e9)) {
        return wrong("--thresholds", "numbers above 0 and at most a billion", bad);
    }
    let last = options.windows.samples.saturating_sub(1);
    if let Some([x, y]) = options.observer.filter(|p| p.iter().any(|w| *w > last)) {
        return wrong(
            "--observer",
            &format!("a sample of the window, 0,0 to {last},{last}"),
            &format!("{x},{y}"),
        );
    }
    Ok(())
}

/// The mean of some numbers and their sample standard deviation, 0 for fewer than two.
fn mean_and_spread(values: &[f64]) -> [f64; 2] {
    let n = values.len().max(1) as f64;
    let mean = values.iter().sum::<f64>() / n;
    let squares: f64 = values.iter().map(|v| (v - mean) * (v - mean)).sum();
    [mean, if values.len() < 2 { 0.0 } else { (squares / (n - 1.0)).sqrt() }]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_option_is_heeded_by_some_and_refused_by_the_others() {
        let command = <Options as clap::Args>::augment_args(clap::Command::new("").no_binary_name(true));
        let known: Vec<&str> = command.get_arguments().map(|a| a.get_id().as_str()).collect();
        assert!(known.iter().all(|id| ALL.iter().any(|e| e.takes(id))), "{known:?}");
        assert!(ALL.iter().flat_map(|e| e.takes).all(|id| known.contains(id)));
        let refused = |name: &str, words: &[&str]| {
            let matches = command.clone().try_get_matches_from(words).unwrap();
            refuse_ignored(name, &matches).err().map(|e| e.to_string())
        };
        assert_eq!(refused("tolerances", &[]), None);
        assert_eq!(
            refused("tolerances", &["--samples", "33", "--points", "9", "--criterion", "normal"]),
            None
        );
        let told = refused("progressive", &["--samples", "33", "--tolerances", "1"]).unwrap();
        assert!(told.starts_with("--tolerances: 'progressive' does not heed it"), "{told}");
        assert!(told.contains("tolerances, strips, zone"), "{told}");
        assert!(refused("lod", &["--samples", "65"]).unwrap().contains("--samples"));
        // A default is nothing that was given.
        assert_eq!(refused("curvature", &["--eye", "10"]), None);
        assert!(refused("strips", &["--eye", "50"]).is_some());
    }
}
