//! What `serve` is told: by flags, by the environment, by a file, by default, in this order.
//!
//! All say the same in the same words: `--max-connections 10`, `DIAMANTINA_MAX_CONNECTIONS=10` and `max_connections = 10`.
//! What was not said by a flag is made one, so that there is one judge of values, clap.

use crate::http::Limits;
use crate::size::parse_bytes;
use crate::store::without_credentials;
use clap::parser::ValueSource;
use clap::{Arg, ArgMatches, Args, Command, FromArgMatches, ValueEnum};
use std::collections::HashMap;
use std::ffi::{OsStr, OsString};
use std::fmt::Write;
use std::io::Read;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};

/// What names of variables begin with.
const PREFIX: &str = "DIAMANTINA_";

/// The largest file, in bytes.
const FILE_BYTES_MAX: u64 = 1 << 20;

/// How alike two words are that may be meant for one another, from 0 to 1.
const ALIKE: f64 = 0.7;

/// How a server serves.
#[derive(Debug, Clone, Args)]
pub struct Settings {
    /// Stores: folders, or addresses of object stores (s3://BUCKET/PREFIX, gs://..., az://...)
    #[arg(value_name = "STORE")]
    pub stores: Vec<PathBuf>,
    /// The address to listen on; port 0 picks a free one
    #[arg(long, default_value = "127.0.0.1:8080", value_name = "ADDRESS:PORT")]
    pub listen: SocketAddr,
    /// A certificate with its chain, PEM: what is sent is encrypted then; read again when it changes
    #[arg(long, value_name = "FILE")]
    pub tls_cert: Option<PathBuf>,
    /// The certificate's key, PEM
    #[arg(long, value_name = "FILE")]
    pub tls_key: Option<PathBuf>,
    /// Scenes that only those with a token may see: a line SCENE HASH for each, as `token` prints it; read again when
    /// it changes
    #[arg(long, value_name = "FILE")]
    pub tokens: Option<PathBuf>,
    /// A folder of this server's own to keep what it reads from object stores [default: it is kept in memory alone]
    #[arg(long, value_name = "FOLDER")]
    pub disk_cache: Option<PathBuf>,
    /// The most bytes that --disk-cache takes
    #[arg(long, default_value = "10GiB", value_name = "BYTES", value_parser = parse_bytes)]
    pub disk_cache_size: u64,
    /// The folder with the viewer for browsers, which `make web` writes [default: web, beside this program or a folder up,
    /// if it is there]
    #[arg(long, value_name = "FOLDER")]
    pub web: Option<PathBuf>,
    /// How the log is written, on standard error; RUST_LOG says how much: info has a line for each request
    #[arg(long, default_value = "text", value_enum)]
    pub log_format: LogFormat,
    /// What is allowed.
    #[command(flatten)]
    pub limits: Limits,
}

impl Settings {
    /// The files of the certificate and its key, if there are any.
    ///
    /// # Errors
    /// When there is one of them.
    pub fn certificate(&self) -> Result<Option<(PathBuf, PathBuf)>, SettingsError> {
        match (&self.tls_cert, &self.tls_key) {
            (None, None) => Ok(None),
            (Some(certificate), Some(key)) => Ok(Some((certificate.clone(), key.clone()))),
            (given, _) => Err(SettingsError::Value {
                origin: if given.is_some() { "tls_cert" } else { "tls_key" }.to_owned(),
                reason: "a certificate and its key are given together: --tls-cert FILE --tls-key FILE"
                    .to_owned(),
            }),
        }
    }
}

/// How a log is written.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum LogFormat {
    /// Lines to read
    Text,
    /// A JSON object a line
    Json,
}

/// Why settings are none.
#[derive(Debug, thiserror::Error)]
pub enum SettingsError {
    /// The file cannot be read.
    #[error("{path}: cannot read settings: {error}")]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system said.
        error: std::io::Error,
    },
    /// The file is no TOML.
    #[error("{path}: not TOML: {reason}")]
    Toml {
        /// The file.
        path: PathBuf,
        /// Why not.
        reason: String,
    },
    /// There is no such setting.
    #[error("{path}: there is no setting '{key}'{}", meant.as_ref().map_or_else(String::new, |m| format!(": did you mean '{m}'?")))]
    Unknown {
        /// The file.
        path: PathBuf,
        /// What it says.
        key: String,
        /// What is nearest to it.
        meant: Option<String>,
    },
    /// The file says a setting twice, once with each way to write its name.
    #[error("{path}: '{one}' and '{other}' are one setting: say it once")]
    Twice {
        /// The file.
        path: PathBuf,
        /// A name of it.
        one: String,
        /// The other.
        other: String,
    },
    /// A setting has another kind of value.
    #[error("{origin}: {reason}")]
    Value {
        /// Who says so.
        origin: String,
        /// What is wrong with it.
        reason: String,
    },
}

/// Where a setting is from.
#[derive(Debug, Clone, PartialEq, Eq)]
enum Origin {
    Flag,
    Variable(String),
    File,
    Default,
}

/// Settings, and where each is from.
#[derive(Debug, Clone)]
pub struct Merged {
    /// What holds.
    pub settings: Settings,
    /// Words about variables that might have been meant for settings.
    pub notices: Vec<String>,
    /// A line of TOML for each, and where it is from.
    lines: Vec<(String, Origin)>,
}

fn command() -> Command {
    Settings::augment_args(Command::new("serve"))
}

/// The name of a setting in a file.
fn key(arg: &Arg) -> String {
    arg.get_long().map_or_else(|| arg.get_id().to_string(), |long| long.replace('-', "_"))
}

/// What was meant by a word, if any of these is like it.
fn nearest(word: &str, known: &[String]) -> Option<String> {
    let likeness = |known: &String| strsim::jaro_winkler(word, known);
    let best = known.iter().max_by(|a, b| likeness(a).total_cmp(&likeness(b)))?;
    (likeness(best) >= ALIKE).then(|| best.clone())
}

/// The settings of a file, as the values of flags.
fn read(path: &Path, known: &[String]) -> Result<Vec<(String, Vec<String>)>, SettingsError> {
    let failed = |error| SettingsError::Io { path: path.to_owned(), error };
    let mut text = String::new();
    let file = std::fs::File::open(path).map_err(failed)?;
    file.take(FILE_BYTES_MAX).read_to_string(&mut text).map_err(failed)?;
    let table: toml::Table = text
        .parse()
        .map_err(|e: toml::de::Error| SettingsError::Toml { path: path.to_owned(), reason: e.to_string() })?;
    let mut found = Vec::new();
    let mut names: HashMap<String, String> = HashMap::new();
    for (name, value) in table {
        let key = name.replace('-', "_");
        if !known.contains(&key) {
            let meant = nearest(&key, known);
            return Err(SettingsError::Unknown { path: path.to_owned(), key: name, meant });
        }
        if let Some(one) = names.insert(key.clone(), name.clone()) {
            return Err(SettingsError::Twice { path: path.to_owned(), one, other: name });
        }
        let wrong = || SettingsError::Value {
            origin: format!("{}: {name}", path.display()),
            reason: "expected a text, a whole number, or for stores a list of texts".to_owned(),
        };
        let word = |value: toml::Value| match value {
            toml::Value::String(text) => Some(text),
            toml::Value::Integer(number) => Some(number.to_string()),
            toml::Value::Boolean(flag) => Some(flag.to_string()),
            _ => None,
        };
        let words = match value {
            toml::Value::Array(values) if key == "stores" => values.into_iter().map(word).collect(),
            other => word(other).map(|word| vec![word]),
        };
        found.push((key, words.ok_or_else(wrong)?));
    }
    Ok(found)
}

/// What holds, of the flags given, the file and these variables.
///
/// # Errors
/// When the file cannot be read or says something that is no setting, or somebody something that is no value.
pub fn merge(
    given: &ArgMatches,
    file: Option<&Path>,
    variables: &[(String, OsString)],
) -> Result<Merged, SettingsError> {
    let command = command();
    let known: Vec<String> = command.get_arguments().map(key).collect();
    let filed = file.map_or_else(|| Ok(Vec::new()), |path| read(path, &known))?;
    let mut words: Vec<OsString> = vec!["serve".into()];
    let mut stores: Vec<OsString> = Vec::new();
    let mut origins = Vec::new();
    for arg in command.get_arguments() {
        let (id, key) = (arg.get_id().as_str(), key(arg));
        let name = format!("{PREFIX}{}", key.to_uppercase());
        let variable = variables.iter().find(|(n, value)| *n == name && !value.is_empty());
        let (values, origin): (Vec<OsString>, _) = if given.value_source(id) == Some(ValueSource::CommandLine)
        {
            let raw = given.get_raw(id).unwrap_or_default();
            (raw.map(OsStr::to_owned).collect(), Origin::Flag)
        } else if let Some((name, value)) = variable {
            let is_list = key == "stores";
            let values = if is_list { split(value) } else { vec![value.clone()] };
            (values, Origin::Variable(name.clone()))
        } else if let Some((_, values)) = filed.iter().find(|(k, _)| *k == key) {
            (values.iter().map(Into::into).collect(), Origin::File)
        } else {
            (Vec::new(), Origin::Default)
        };
        if let Some(long) = arg.get_long() {
            for value in values {
                let mut word = OsString::from(format!("--{long}="));
                word.push(&value);
                judge(arg, &value).map_err(|reason| SettingsError::Value {
                    origin: match (&origin, file) {
                        (Origin::Variable(name), _) => name.clone(),
                        (Origin::File, Some(path)) => format!("{}: {key}", path.display()),
                        _ => format!("--{long}"),
                    },
                    reason,
                })?;
                words.push(word);
            }
        } else {
            stores = values;
        }
        origins.push((key, origin));
    }
    words.push("--".into());
    words.extend(stores);
    let whole =
        |error: clap::Error| SettingsError::Value { origin: "settings".to_owned(), reason: plain(&error) };
    let matches = command.clone().try_get_matches_from(words).map_err(whole)?;
    let settings = Settings::from_arg_matches(&matches).map_err(whole)?;
    let lines = origins.into_iter().map(|(key, origin)| (line(&command, &matches, &key), origin)).collect();
    Ok(Merged { settings, lines, notices: notices(variables, &known) })
}

/// The parts of a list with colons. The one in the address of an object store parts nothing.
fn split(list: &OsStr) -> Vec<OsString> {
    let mut parts: Vec<OsString> = Vec::new();
    for part in std::env::split_paths(list).map(PathBuf::into_os_string) {
        match parts.last_mut() {
            Some(last) if part.as_encoded_bytes().starts_with(b"//") && is_scheme(last) => {
                last.push(":");
                last.push(&part);
            }
            _ => parts.push(part),
        }
    }
    parts
}

fn is_scheme(word: &OsStr) -> bool {
    let bytes = word.as_encoded_bytes();
    !bytes.is_empty() && bytes.iter().all(|b| b.is_ascii_lowercase() || b.is_ascii_digit())
}

/// Whether a value is one for this argument; if not, why.
fn judge(arg: &Arg, value: &OsStr) -> Result<(), String> {
    let alone = Arg::new("value").long("value").value_parser(arg.get_value_parser().clone());
    let mut word = OsString::from("--value=");
    word.push(value);
    let parsed = Command::new("judge").arg(alone).try_get_matches_from([OsString::from("judge"), word]);
    parsed.map(drop).map_err(|error| plain(&error).replace(" for '--value <value>'", ""))
}

/// The first line of what clap says, without its own decoration.
fn plain(error: &clap::Error) -> String {
    let text = error.to_string();
    let lines = text.lines().map(str::trim).take_while(|line| !line.starts_with("For more information"));
    lines
        .filter(|line| !line.is_empty())
        .collect::<Vec<_>>()
        .join("; ")
        .trim_start_matches("error: ")
        .to_owned()
}

/// A setting as a line of TOML; one that nobody made is a comment.
fn line(command: &Command, matches: &ArgMatches, key: &str) -> String {
    let arg = command.get_arguments().find(|arg| self::key(arg) == key);
    let values: Vec<String> = arg
        .and_then(|arg| matches.get_raw(arg.get_id().as_str()))
        .map(|raw| raw.map(|value| value.to_string_lossy().into_owned()).collect())
        .unwrap_or_default();
    let quoted = |value: &String| match value.parse::<i64>() {
        // A file may be named 007.
        Ok(number) if key != "stores" && number.to_string() == *value => number.to_string(),
        _ => toml::Value::String(without_credentials(value).unwrap_or_else(|| value.clone())).to_string(),
    };
    match values.as_slice() {
        [] if key == "stores" => format!("{key} = []"),
        [] => format!("# {key} ="),
        values if key == "stores" => {
            format!("{key} = [{}]", values.iter().map(quoted).collect::<Vec<_>>().join(", "))
        }
        [value, ..] => format!("{key} = {}", quoted(value)),
    }
}

/// Words about variables that are no settings, but nearly.
fn notices(variables: &[(String, OsString)], known: &[String]) -> Vec<String> {
    let names: Vec<String> = known.iter().map(|key| format!("{PREFIX}{}", key.to_uppercase())).collect();
    let own = |name: &String| {
        name.starts_with(PREFIX) && !names.contains(name) && *name != format!("{PREFIX}CONFIG")
    };
    let unknown = variables.iter().map(|(name, _)| name).filter(|name| own(name));
    let close = |name: &String| {
        let meant = nearest(name, &names)?;
        (strsim::damerau_levenshtein(name, &meant) == 1)
            .then(|| format!("{name} is no setting: did you mean {meant}?"))
    };
    unknown.filter_map(close).collect()
}

impl Merged {
    /// The settings as a file that says the same, with where each is from.
    #[must_use]
    pub fn to_toml(&self) -> String {
        let mut text = String::new();
        for (line, origin) in &self.lines {
            let from = match origin {
                Origin::Flag => " # flag".to_owned(),
                Origin::Variable(name) => format!(" # {name}"),
                Origin::File => " # file".to_owned(),
                Origin::Default => String::new(),
            };
            // Writing to a string does not fail.
            let _ = writeln!(text, "{line}{from}");
        }
        text
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn merged(flags: &[&str], file: &str, variables: &[(&str, &str)]) -> Result<Merged, SettingsError> {
        let given = command().try_get_matches_from([&["serve"], flags].concat()).unwrap();
        let path = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(path.path(), file).unwrap();
        let variables: Vec<(String, OsString)> =
            variables.iter().map(|(name, value)| ((*name).to_owned(), (*value).into())).collect();
        merge(&given, Some(path.path()), &variables)
    }

    #[test]
    fn flags_win_over_variables_and_these_over_files() {
        let file = "max_in_flight = 1\nmax-connections = 1\nreload = 1\ncache = \"1MiB\"\nstores = [\"a\", \"b c\"]\n";
        let variables = [("DIAMANTINA_MAX_IN_FLIGHT", "2"), ("DIAMANTINA_MAX_CONNECTIONS", "2")];
        let found = merged(&["--max-in-flight", "3", "--grace=9"], file, &variables).unwrap();
        let Settings { stores, limits, listen, .. } = &found.settings;
        assert_eq!((limits.max_in_flight, limits.max_connections, limits.reload), (3, 2, 1));
        assert_eq!((limits.grace, limits.cache, limits.rate), (9, 1 << 20, 0));
        assert_eq!(stores, &["a", "b c"].map(PathBuf::from));
        assert_eq!(listen.port(), 8080);
        let elsewhere = merged(&["x"], file, &[("DIAMANTINA_STORES", "y:z")]).unwrap();
        assert_eq!(elsewhere.settings.stores, [PathBuf::from("x")]);
        let varied = merged(&[], file, &[("DIAMANTINA_STORES", "y:z")]).unwrap();
        assert_eq!(varied.settings.stores, ["y", "z"].map(PathBuf::from));
        let remote =
            merged(&[], "", &[("DIAMANTINA_STORES", "s3://b/x:/y:gs://c/z")]).unwrap().settings.stores;
        assert_eq!(remote, ["s3://b/x", "/y", "gs://c/z"].map(PathBuf::from));
        // What is printed says the same again.
        let printed = found.to_toml();
        let again = merged(&[], &printed, &[]).unwrap();
        assert_eq!(format!("{:?}", again.settings), format!("{:?}", found.settings), "{printed}");
        for line in [
            "max_in_flight = 3 # flag",
            "max_connections = 2 # DIAMANTINA_MAX_CONNECTIONS",
            "reload = 1 # file",
        ] {
            assert!(printed.contains(line), "{printed}");
        }
    }

    #[test]
    fn what_is_printed_has_names_as_they_are_and_no_credentials() {
        let printed = merged(&["--tokens=007", "s3://user:secret@bucket/x"], "", &[]).unwrap().to_toml();
        assert!(printed.contains("tokens = \"007\"") && printed.contains("s3://bucket/..."), "{printed}");
        assert!(!printed.contains("secret"), "{printed}");
    }

    #[test]
    fn what_is_no_setting_is_refused_with_what_was_meant() {
        let refused = |flags: &[&str], file: &str, variables: &[(&str, &str)], words: &[&str]| {
            let error = merged(flags, file, variables).unwrap_err().to_string();
            assert!(words.iter().all(|word| error.contains(word)), "{error} lacks one of {words:?}");
        };
        refused(&[], "max_conections = 1", &[], &["max_conections", "did you mean 'max_connections'?"]);
        let twice = "max_connections = 2\nmax-connections = 1";
        // Also where a flag would win over both.
        for flags in [&[][..], &["--max-connections=3"]] {
            refused(flags, twice, &[], &["'max_connections'", "'max-connections'", "once"]);
        }
        refused(&[], "[limits]\nrate = 1", &[], &["no setting 'limits'"]);
        refused(&[], "rate = -1", &[], &["rate", "-1"]);
        refused(&[], "rate = 1.5", &[], &["rate", "whole number"]);
        refused(&[], "rate = ", &[], &["TOML"]);
        refused(&[], "listen = \"here\"", &[], &["listen", "here"]);
        refused(&[], "cache = \"2TiB\"", &[], &["cache", "expected KiB"]);
        refused(&[], "", &[("DIAMANTINA_LOG_FORMAT", "yaml")], &["DIAMANTINA_LOG_FORMAT", "yaml", "json"]);
        let half = merged(&[], "tls_cert = \"x\"", &[]).unwrap().settings.certificate().unwrap_err();
        assert!(half.to_string().contains("--tls-key"), "{half}");
        let both = merged(&["--tls-key=y"], "tls_cert = \"x\"", &[]).unwrap().settings;
        assert_eq!(both.certificate().unwrap(), Some(("x".into(), "y".into())));
    }

    #[test]
    fn variables_that_are_nearly_settings_are_told_and_others_are_not() {
        let variables =
            [("DIAMANTINA_LISTN", "x"), ("DIAMANTINA_PORT_8080_TCP_ADDR", "x"), ("DIAMANTINA_DATA", "x")];
        let notices = merged(&[], "", &variables).unwrap().notices;
        assert_eq!(notices, ["DIAMANTINA_LISTN is no setting: did you mean DIAMANTINA_LISTEN?"]);
    }
}
