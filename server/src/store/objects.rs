//! A prefix of an object store, as an address names it: `s3://bucket/prefix`, `gs://...`, `az://...`.
//!
//! Credentials and endpoints come from the environment, as the stores' own tools read them (`AWS_...`, `GOOGLE_...`,
//! `AZURE_...`). Requests are tried again, with growing and random pauses; when that does not help the store counts as away:
//! for a second nobody waits for it, then the next one who needs it asks again.
//!
//! All requests of the process run on one small runtime of their own, so that whoever waits for them may be a
//! thread or a task of any other.

use super::transport::Transport;
use super::{Key, StoreError};
use bytes::Bytes;
use object_store::aws::AmazonS3Builder;
use object_store::azure::MicrosoftAzureBuilder;
use object_store::gcp::GoogleCloudStorageBuilder;
use object_store::http::HttpBuilder;
use object_store::path::Path as Name;
use object_store::{
    BackoffConfig, ClientOptions, Error, GetOptions, GetResult, ObjectStore, RetryConfig, UpdateVersion,
};
use std::borrow::Cow;
use std::ops::Range;
use std::path::Path;
use std::sync::{Arc, Mutex, OnceLock, PoisonError};
use std::time::{Duration, Instant};
use tokio::runtime::{Builder, Handle, Runtime};
use tokio::sync::Semaphore;
use url::Url;

/// Threads that requests to object stores run on. What they do is to wait.
const THREADS: usize = 2;

/// Requests to one store at once; with the largest range, this bounds their memory.
const REQUESTS_MAX: usize = 32;

/// How long a store that is away is left alone.
const LEFT_ALONE: Duration = Duration::from_secs(1);

/// Characters of what a store said that are shown.
const WORDS_SHOWN: usize = 400;

/// What addresses of object stores begin with.
const SCHEMES: [&str; 7] = ["s3", "s3a", "gs", "az", "azure", "abfs", "abfss"];

/// How patient one is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Manner {
    /// Somebody waits for an answer.
    Serving,
    /// Hours of work are at stake.
    Publishing,
}

impl Manner {
    fn patience(self) -> Duration {
        Duration::from_secs(match self {
            Self::Serving => 5,
            Self::Publishing => 60,
        })
    }

    fn retries(self) -> RetryConfig {
        let (max_retries, seconds, pause) = match self {
            Self::Serving => (3, 5, 1),
            Self::Publishing => (12, 120, 10),
        };
        let backoff = BackoffConfig {
            init_backoff: Duration::from_millis(50),
            max_backoff: Duration::from_secs(pause),
            base: 2.0,
        };
        RetryConfig { backoff, max_retries, retry_timeout: Duration::from_secs(seconds) }
    }
}

/// Why something could not be had from a store.
#[derive(Debug, Clone)]
pub(super) enum Failure {
    /// There is no such thing.
    Missing,
    /// There is not even the bucket that it would be in.
    NoBucket,
    /// The store does not let us.
    Denied(String),
    /// It has fewer bytes than were written.
    Short,
    /// Something else is there than was expected.
    Changed,
    /// The store cannot be reached, or does not do its work.
    Away(String),
    /// It did others' work meanwhile, but not this.
    Unanswered(String),
}

impl From<Error> for Failure {
    fn from(error: Error) -> Self {
        match error {
            Error::NotFound { source, .. } => {
                // Of this, too, the library tells no more than the store's words.
                let words = source.to_string();
                let is_bucket = ["NoSuchBucket", "ContainerNotFound"].iter().any(|code| words.contains(code));
                if is_bucket { Self::NoBucket } else { Self::Missing }
            }
            Error::Precondition { .. } | Error::AlreadyExists { .. } => Self::Changed,
            Error::PermissionDenied { .. } | Error::Unauthenticated { .. } => {
                Self::Denied(short(&error.to_string()))
            }
            // Of this the library tells no more than its words.
            other if other.to_string().contains("416 Range Not Satisfiable") => Self::Short,
            other => Self::Away(short(&other.to_string())),
        }
    }
}

/// What was said, on one line and not too long of it; never what stands before an @ in an address.
fn short(words: &str) -> String {
    let line = words.split_whitespace().map(masked).collect::<Vec<_>>().join(" ");
    match line.char_indices().nth(WORDS_SHOWN) {
        Some((end, _)) => format!("{}...", &line[..end]),
        None => line,
    }
}

/// A word without the credentials of an address in it.
fn masked(word: &str) -> Cow<'_, str> {
    let parts = word.split_once("://").and_then(|(scheme, rest)| {
        let end = rest.find(['/', '?', '#']).unwrap_or(rest.len());
        Some((scheme, &rest[rest[..end].rfind('@')? + 1..]))
    });
    parts.map_or(Cow::Borrowed(word), |(scheme, rest)| Cow::Owned(format!("{scheme}://{rest}")))
}

/// What may be said of an address that has credentials in it, if it is one: it may end in logs.
pub fn without_credentials(text: &str) -> Option<String> {
    let (scheme, rest) = text.split_once("://")?;
    let (authority, _) = rest.split_once('/').unwrap_or((rest, ""));
    // Azure's have the container there.
    let hidden = authority.rsplit_once('@').filter(|_| !scheme.starts_with("ab"));
    hidden.map(|(_, host)| format!("{scheme}://{host}/..."))
}

impl Failure {
    /// The same as an error about an address.
    pub(super) fn at(self, address: String) -> StoreError {
        match self {
            Self::Missing => StoreError::Damaged { path: address.into(), what: "it is missing".to_owned() },
            Self::Short => StoreError::Damaged {
                path: address.into(),
                what: "it has fewer bytes than were written".to_owned(),
            },
            Self::NoBucket => StoreError::Address {
                address,
                reason: "there is no such bucket or container: create it, or check the address".to_owned(),
            },
            Self::Denied(reason) => StoreError::Denied { address, reason },
            Self::Changed => StoreError::Overtaken { address },
            Self::Away(reason) => StoreError::Away { address, reason },
            Self::Unanswered(reason) => StoreError::Unanswered { address, reason },
        }
    }

    /// The same as an error about a blob of the pack at an address.
    pub(super) fn of_blob(self, address: String, key: Key) -> StoreError {
        let named = |words: String| format!("blob {key:?}: {words}");
        match self.at(address) {
            StoreError::Damaged { path, what } => StoreError::Damaged { path, what: named(what) },
            StoreError::Denied { address, reason } => StoreError::Denied { address, reason: named(reason) },
            StoreError::Unanswered { address, reason } => {
                StoreError::Unanswered { address, reason: named(reason) }
            }
            // Of those away it is the store that is told of, not each blob.
            other => other,
        }
    }
}

/// The runtime of all requests.
pub(super) fn runtime() -> Result<Handle, StoreError> {
    static RUNTIME: OnceLock<Result<Runtime, String>> = OnceLock::new();
    let made = RUNTIME.get_or_init(|| {
        let mut builder = Builder::new_multi_thread();
        builder.worker_threads(THREADS).thread_name("objects").enable_all();
        builder.build().map_err(|e| e.to_string())
    });
    match made {
        Ok(runtime) => Ok(runtime.handle().clone()),
        Err(reason) => Err(StoreError::Away { address: "this machine".to_owned(), reason: reason.clone() }),
    }
}

/// Whether a path is the address of an object store.
#[must_use]
pub fn is_address(path: &Path) -> bool {
    path.to_str().and_then(|text| text.split_once("://")).is_some_and(|(scheme, _)| scheme != "file")
}

/// The folder that a path or a `file://` address names.
pub(super) fn folder(path: &Path) -> &Path {
    path.to_str().and_then(|text| text.strip_prefix("file://")).map_or(path, Path::new)
}

#[derive(Debug, Default)]
struct Health {
    /// Since when, and from when on it is asked again.
    away: Option<(Instant, Instant, String)>,
    /// Requests that it answered, whatever it said.
    answered: u64,
}

/// Things below a prefix of a store. Cheap to share.
#[derive(Debug, Clone)]
pub(super) struct Objects {
    store: Arc<dyn ObjectStore>,
    prefix: Name,
    address: Arc<str>,
    health: Arc<Mutex<Health>>,
    places: Arc<Semaphore>,
}

/// Something that was read whole.
#[derive(Debug)]
pub(super) struct Thing {
    pub(super) bytes: Bytes,
    pub(super) version: UpdateVersion,
}

impl Objects {
    /// What an address names; nothing is asked of the store yet.
    ///
    /// # Errors
    /// When the address is none, or the environment lacks what the store needs.
    pub(super) fn open(path: &Path, manner: Manner) -> Result<Self, StoreError> {
        let text = path.to_string_lossy();
        let masked = without_credentials(&text);
        let address = masked.clone().unwrap_or_else(|| text.trim_end_matches('/').to_owned());
        let wrong =
            |reason: &str| StoreError::Address { address: address.clone(), reason: reason.to_owned() };
        if masked.is_some() {
            return Err(wrong(
                "credentials do not belong in an address, but in variables such as AWS_SECRET_ACCESS_KEY",
            ));
        }
        let url = Url::parse(&text).map_err(|e| wrong(&e.to_string()))?;
        if url.query().is_some() || url.fragment().is_some() {
            return Err(wrong("expected neither '?' nor '#' in it"));
        }
        let prefix = Name::from_url_path(url.path()).map_err(|e| wrong(&e.to_string()))?;
        let transport = Transport { patience: manner.patience() };
        let unset = |e: Error| wrong(&short(&e.to_string()));
        let store: Arc<dyn ObjectStore> = match url.scheme() {
            "s3" | "s3a" => Arc::new(
                AmazonS3Builder::from_env()
                    .with_url(text.as_ref())
                    .with_retry(manner.retries())
                    .with_http_connector(transport)
                    .build()
                    .map_err(unset)?,
            ),
            "gs" => Arc::new(
                GoogleCloudStorageBuilder::from_env()
                    .with_url(text.as_ref())
                    .with_retry(manner.retries())
                    .with_http_connector(transport)
                    .build()
                    .map_err(unset)?,
            ),
            "az" | "azure" | "abfs" | "abfss" => Arc::new(
                MicrosoftAzureBuilder::from_env()
                    .with_url(text.as_ref())
                    .with_retry(manner.retries())
                    .with_http_connector(transport)
                    .build()
                    .map_err(unset)?,
            ),
            "http" | "https" => {
                let (options, root) =
                    (ClientOptions::new().with_allow_http(true), &url[..url::Position::BeforePath]);
                let builder = HttpBuilder::new().with_url(root).with_client_options(options);
                let builder = builder.with_retry(manner.retries()).with_http_connector(transport);
                Arc::new(builder.build().map_err(unset)?)
            }
            other => {
                let known = SCHEMES.map(|scheme| format!("{scheme}://"));
                return Err(wrong(&format!("'{other}://' is none of {}, and no folder", known.join(", "))));
            }
        };
        Ok(Self::of(store, prefix, address))
    }

    pub(super) fn of(store: Arc<dyn ObjectStore>, prefix: Name, address: String) -> Self {
        let places = Arc::new(Semaphore::new(REQUESTS_MAX));
        Self { store, prefix, address: address.into(), health: Arc::default(), places }
    }

    pub(super) fn store(&self) -> &dyn ObjectStore {
        self.store.as_ref()
    }

    /// A thing's full name.
    pub(super) fn name(&self, below: &str) -> Name {
        below
            .split('/')
            .filter(|part| !part.is_empty())
            .fold(self.prefix.clone(), |name, part| name.join(part))
    }

    /// A thing's address, for people.
    pub(super) fn address(&self, below: &str) -> String {
        if below.is_empty() { self.address.to_string() } else { format!("{}/{below}", self.address) }
    }

    fn health(&self) -> std::sync::MutexGuard<'_, Health> {
        self.health.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// How long the store has not been reached, if that is so.
    pub(super) fn away(&self) -> Option<Duration> {
        self.health().away.as_ref().map(|(since, ..)| since.elapsed())
    }

    /// Whether the store is not known to be away, or long enough that somebody should look. Whoever is about to look says so.
    fn is_worth_asking(&self, is_about_to: bool) -> Result<(), Failure> {
        if let Some((_, again, reason)) = &mut self.health().away {
            let now = Instant::now();
            if *again > now {
                return Err(Failure::Away(reason.clone()));
            }
            if is_about_to {
                *again = now + LEFT_ALONE;
            }
        }
        Ok(())
    }

    /// Does something with the store, unless it is away, and keeps in mind how that went.
    pub(super) async fn ask<T>(
        &self,
        what: impl Future<Output = Result<T, Error>> + Send,
    ) -> Result<T, Failure> {
        self.is_worth_asking(false)?;
        // The semaphore is never closed.
        let _place = self.places.acquire().await;
        // Those before may have found out.
        self.is_worth_asking(true)?;
        let answered = self.health().answered;
        let done = what.await.map_err(Failure::from);
        let mut health = self.health();
        match &done {
            // One thing that cannot be had is no reason to refuse all others.
            Err(Failure::Away(reason)) if health.away.is_none() && health.answered > answered => {
                return Err(Failure::Unanswered(reason.clone()));
            }
            Err(Failure::Away(reason)) => {
                let now = Instant::now();
                if let Some((_, again, last)) = &mut health.away {
                    (*again, *last) = (now + LEFT_ALONE, reason.clone());
                } else {
                    tracing::error!(store = %self.address, reason, "the object store cannot be reached");
                    health.away = Some((now, now + LEFT_ALONE, reason.clone()));
                }
            }
            _ => {
                health.answered += 1;
                if let Some((since, ..)) = health.away.take() {
                    let seconds = since.elapsed().as_secs_f64();
                    tracing::warn!(store = %self.address, seconds, "the object store can be reached again");
                }
            }
        }
        done
    }

    /// A thing of at most `bytes_max` bytes.
    pub(super) async fn read(&self, below: &str, bytes_max: u64) -> Result<Thing, Failure> {
        let name = self.name(below);
        self.ask(async {
            let found = self.store.get_opts(&name, GetOptions::default()).await?;
            whole(found, bytes_max).await
        })
        .await
    }

    /// A thing, unless it is still of a version.
    pub(super) async fn read_newer(
        &self,
        below: &str,
        bytes_max: u64,
        known: Option<&str>,
    ) -> Result<Option<Thing>, Failure> {
        let name = self.name(below);
        let options = GetOptions { if_none_match: known.map(str::to_owned), ..GetOptions::default() };
        self.ask(async {
            match self.store.get_opts(&name, options).await {
                Ok(found) => whole(found, bytes_max).await.map(Some),
                Err(Error::NotModified { .. }) => Ok(None),
                Err(error) => Err(error),
            }
        })
        .await
    }

    /// A thing of any length, by pieces: each of them is there in time, or asked for again.
    pub(super) async fn read_long(&self, below: &str, piece: u64) -> Result<Vec<u8>, Failure> {
        let name = self.name(below);
        let options = GetOptions::new().with_range(Some(0..piece));
        let (first, size) = self
            .ask(async {
                let found = self.store.get_opts(&name, options).await?;
                let size = found.meta.size;
                Ok((found.bytes().await?, size))
            })
            .await?;
        let mut bytes = Vec::from(first);
        while (bytes.len() as u64) < size {
            let start = bytes.len() as u64;
            bytes.extend_from_slice(&self.range(below, start..size.min(start + piece)).await?);
        }
        Ok(bytes)
    }

    /// Bytes of a thing.
    pub(super) async fn range(&self, below: &str, range: Range<u64>) -> Result<Bytes, Failure> {
        let name = self.name(below);
        let expected = range.end - range.start;
        let options = GetOptions::new().with_range(Some(range));
        let bytes = self.ask(async { self.store.get_opts(&name, options).await?.bytes().await }).await?;
        // Of a thing that is too short there is less than was asked for: it is not what was written.
        if bytes.len() as u64 == expected { Ok(bytes) } else { Err(Failure::Short) }
    }
}

async fn whole(found: GetResult, bytes_max: u64) -> Result<Thing, Error> {
    let size = found.meta.size;
    if size > bytes_max {
        let source = format!("it has {size} bytes, expected at most {bytes_max}").into();
        return Err(Error::Generic { store: "object", source });
    }
    let version = UpdateVersion { e_tag: found.meta.e_tag.clone(), version: found.meta.version.clone() };
    Ok(Thing { bytes: found.bytes().await?, version })
}

#[cfg(test)]
mod tests {
    use super::*;
    use object_store::memory::InMemory;

    fn refused(address: &str) -> String {
        Objects::open(Path::new(address), Manner::Serving).unwrap_err().to_string()
    }

    #[test]
    fn addresses_that_are_none_are_refused_and_secrets_in_them_are_not_repeated() {
        let told = refused("s3://key:secret@bucket/x");
        assert!(told.contains("variables") && !told.contains("secret@") && !told.contains("key"), "{told}");
        assert!(refused("ftp://x/y").contains("ftp://"));
        assert!(refused("s3://bucket/x?token=y").contains('?'));
        assert!(!is_address(Path::new("/a/b")) && !is_address(Path::new("file:///a")));
        assert!(is_address(Path::new("s3://a/b")));
        assert_eq!(folder(Path::new("file:///a/b")), Path::new("/a/b"));
        assert_eq!(folder(Path::new("a/b")), Path::new("a/b"));
    }

    #[test]
    fn what_a_library_says_tells_no_credentials() {
        let said = "sending to http://u:p@sekret@127.0.0.1:9/b?x=a@b failed: (https://host/a@b) me@here";
        assert_eq!(short(said), "sending to http://127.0.0.1:9/b?x=a@b failed: (https://host/a@b) me@here");
    }

    #[tokio::test(start_paused = true)]
    async fn a_store_that_is_away_is_left_alone_for_a_second() {
        let objects = Objects::of(Arc::new(InMemory::new()), Name::from("a"), "memory".to_owned());
        let gone = || async { Err::<(), _>(Error::Generic { store: "x", source: "no route".into() }) };
        assert!(matches!(objects.ask(gone()).await, Err(Failure::Away(_))));
        assert!(objects.away().is_some());
        // It would answer, but nobody asks.
        let told = objects.ask(async { Ok(()) }).await;
        assert!(matches!(told, Err(Failure::Away(reason)) if reason.contains("no route")));
        std::thread::sleep(LEFT_ALONE);
        assert!(objects.ask(async { Ok(()) }).await.is_ok() && objects.away().is_none());
        // What is missing is an answer.
        assert!(matches!(objects.read("b", 9).await, Err(Failure::Missing)));
        assert!(objects.away().is_none());
    }

    /// One pack that a store could not read made it count as away, and nothing else of it was served.
    #[tokio::test]
    async fn a_store_that_answers_others_meanwhile_is_not_away() {
        let objects = Objects::of(Arc::new(InMemory::new()), Name::from("a"), "memory".to_owned());
        let failed = Error::Generic { store: "x", source: "500".into() };
        let told = objects
            .ask(async {
                objects.ask(async { Ok(()) }).await.unwrap();
                Err::<(), _>(failed)
            })
            .await;
        assert!(matches!(told, Err(Failure::Unanswered(reason)) if reason.contains("500")));
        assert!(objects.away().is_none() && objects.ask(async { Ok(()) }).await.is_ok());
    }
}
