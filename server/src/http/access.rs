//! Who may see which scenes, and how often.
//!
//! A scene that a file of tokens names is private: without one of its tokens it is not there, in no list and in no words. The
//! file has a line for each token: the scene's name, the token's hash, and whatever the operator notes behind. Tokens are
//! 256 random bits, so that a plain hash is enough, and they are compared in constant time. They come in the
//! `Authorization` header alone and are never written anywhere.

use super::Site;
use axum::extract::FromRequestParts;
use axum::http::request::Parts;
use axum::http::{HeaderMap, header};
use diamantina_protocol::message::is_name;
use governor::clock::{Clock, DefaultClock};
use governor::{Quota, RateLimiter};
use std::collections::HashMap;
use std::convert::Infallible;
use std::hash::{BuildHasher, RandomState};
use std::io::Read;
use std::net::{IpAddr, Ipv6Addr};
use std::num::NonZeroU32;
use std::path::{Path, PathBuf};
use std::sync::{Arc, PoisonError, RwLock};
use std::time::{Duration, SystemTime};
use subtle::ConstantTimeEq;

/// Lines of a file of tokens, and bytes.
const TOKENS_MAX: usize = 10_000;
const FILE_BYTES_MAX: u64 = 4 << 20;

/// Bytes of a token, before it is written in hexadecimal digits.
const TOKEN_BYTES: usize = 32;

/// A token's hash, as the file has it.
type Hash = [u8; blake3::OUT_LEN];

/// Why a file of tokens is not one.
#[derive(Debug, thiserror::Error)]
pub enum TokensError {
    /// It cannot be read.
    #[error("{path}: cannot read tokens: {error}")]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system said.
        error: std::io::Error,
    },
    /// A line is none.
    #[error("{path}: line {line}: {what}: expected SCENE HASH, as `diamantina-server token SCENE` prints it")]
    Line {
        /// The file.
        path: PathBuf,
        /// Which.
        line: usize,
        /// What is wrong with it.
        what: &'static str,
    },
    /// It may have been cut off, or never have come: then all scenes would be everybody's.
    #[error(
        "{0}: no scene is named: expected lines SCENE HASH, as `diamantina-server token SCENE` prints them; where no scene is \
         to be private, leave --tokens out"
    )]
    Nobody(PathBuf),
    /// There are too many.
    #[error("{0}: more than {TOKENS_MAX} lines, or {FILE_BYTES_MAX} bytes")]
    Many(PathBuf),
}

/// A new token and its hash, both in hexadecimal digits: the token is for who may see a scene, the hash for the file.
///
/// # Errors
/// When the system has no random numbers to give.
pub fn new_token() -> std::io::Result<(String, String)> {
    let mut bytes = [0; TOKEN_BYTES];
    std::fs::File::open("/dev/urandom")?.read_exact(&mut bytes)?;
    let token = blake3::Hash::from_bytes(bytes).to_hex().to_string();
    let hash = blake3::hash(token.as_bytes()).to_hex().to_string();
    Ok((token, hash))
}

/// The hashes of a file, by scene.
fn parse(path: &Path) -> Result<HashMap<String, Vec<Hash>>, TokensError> {
    let failed = |error| TokensError::Io { path: path.to_owned(), error };
    let mut text = String::new();
    let file = std::fs::File::open(path).map_err(failed)?;
    file.take(FILE_BYTES_MAX + 1).read_to_string(&mut text).map_err(failed)?;
    if text.len() as u64 > FILE_BYTES_MAX || text.lines().count() > TOKENS_MAX {
        return Err(TokensError::Many(path.to_owned()));
    }
    let mut scenes: HashMap<String, Vec<Hash>> = HashMap::new();
    for (number, line) in text.lines().enumerate() {
        let wrong = |what| TokensError::Line { path: path.to_owned(), line: number + 1, what };
        let line = line.split('#').next().unwrap_or_default().trim();
        if line.is_empty() {
            continue;
        }
        let (scene, rest) = line.split_once(char::is_whitespace).ok_or_else(|| wrong("it has no hash"))?;
        if !is_name(scene) {
            return Err(wrong("its first word is no name of a scene"));
        }
        let word = rest.split_whitespace().next().unwrap_or_default();
        let hash = blake3::Hash::from_hex(word).map_err(|_| wrong("its second word is no hash"))?;
        scenes.entry(scene.to_owned()).or_default().push(*hash.as_bytes());
    }
    if scenes.is_empty() { Err(TokensError::Nobody(path.to_owned())) } else { Ok(scenes) }
}

fn changed(path: &Path) -> Option<SystemTime> {
    std::fs::metadata(path).and_then(|data| data.modified()).ok()
}

#[derive(Debug, Default)]
struct Known {
    scenes: HashMap<String, Vec<Hash>>,
    read_at: Option<SystemTime>,
    /// When the file was last changed, as of the last look at it.
    seen_at: Option<SystemTime>,
}

/// The private scenes and their tokens.
#[derive(Debug, Default)]
pub(super) struct Access {
    path: Option<PathBuf>,
    known: RwLock<Known>,
}

/// Who asks: the hash of the token that came with the request.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Caller(Option<Hash>);

impl Access {
    /// Reads a file of tokens; without one, all scenes are everybody's.
    pub(super) fn open(path: Option<&Path>) -> Result<Self, TokensError> {
        let Some(path) = path else { return Ok(Self::default()) };
        let read_at = changed(path);
        let known = Known { read_at, seen_at: read_at, scenes: parse(path)? };
        Ok(Self { path: Some(path.to_owned()), known: RwLock::new(known) })
    }

    /// Reads the file again if it has changed, once it has stayed the same from one look to the next: one that is being
    /// written may be empty for a moment, and would make every scene everybody's. A bad one changes nothing, and neither does
    /// one that names no scene any more: that is what is left of a file that was cut off, or of a secret that never came.
    pub(super) fn refresh(&self) {
        let Some(path) = &self.path else { return };
        let now = changed(path);
        if self.look(|known| known.read_at == now) {
            return;
        }
        let mut known = self.known.write().unwrap_or_else(PoisonError::into_inner);
        if std::mem::replace(&mut known.seen_at, now) != now {
            return;
        }
        drop(known);
        let read = parse(path);
        let mut known = self.known.write().unwrap_or_else(PoisonError::into_inner);
        known.read_at = now;
        match read {
            Ok(scenes) => {
                let before = std::mem::replace(&mut known.scenes, scenes);
                for scene in known.scenes.keys().filter(|scene| !before.contains_key(*scene)) {
                    tracing::warn!(
                        scene,
                        "is private from now on; caches may keep for a year what it has answered to everybody: purge \
                         them, or build it under another name"
                    );
                }
                for scene in before.keys().filter(|scene| !known.scenes.contains_key(*scene)) {
                    tracing::warn!(scene, "is everybody's from now on: the file of tokens names it no more");
                }
                drop(known);
                tracing::info!(file = %path.display(), "tokens were read again");
            }
            Err(error) => tracing::error!(%error, "the tokens before go on"),
        }
    }

    fn look<T>(&self, look: impl FnOnce(&Known) -> T) -> T {
        look(&self.known.read().unwrap_or_else(PoisonError::into_inner))
    }

    /// Who asks with these headers.
    pub(super) fn caller(&self, headers: &HeaderMap) -> Caller {
        if self.path.is_none() {
            return Caller(None);
        }
        let value = headers.get(header::AUTHORIZATION).and_then(|value| value.to_str().ok());
        let token = value
            .and_then(|value| value.split_once(' '))
            .and_then(|(scheme, token)| scheme.eq_ignore_ascii_case("bearer").then(|| token.trim()));
        Caller(token.map(|token| *blake3::hash(token.as_bytes()).as_bytes()))
    }

    /// Whether not everybody may see a scene.
    pub(super) fn is_private(&self, scene: &str) -> bool {
        self.path.is_some() && self.look(|known| known.scenes.contains_key(scene))
    }

    /// Whether somebody may see a scene.
    pub(super) fn allows(&self, caller: Caller, scene: &str) -> bool {
        if self.path.is_none() {
            return true;
        }
        self.look(|known| known.scenes.get(scene).is_none_or(|hashes| caller.is_among(hashes)))
    }

    /// Whether somebody's token is one of any scene.
    fn knows(&self, caller: Caller) -> bool {
        caller.0.is_some() && self.look(|known| known.scenes.values().any(|hashes| caller.is_among(hashes)))
    }
}

impl Caller {
    /// Looks at all of them, whichever it is.
    fn is_among(self, hashes: &[Hash]) -> bool {
        let Some(own) = self.0 else { return false };
        hashes.iter().fold(subtle::Choice::from(0), |found, hash| found | own.ct_eq(hash)).into()
    }
}

impl FromRequestParts<Arc<Site>> for Caller {
    type Rejection = Infallible;

    async fn from_request_parts(parts: &mut Parts, site: &Arc<Site>) -> Result<Self, Infallible> {
        Ok(site.access.caller(&parts.headers))
    }
}

/// Whom a bucket is for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
enum Asker {
    Token(Hash),
    Address(IpAddr),
}

/// How often each address or token may ask: a bucket that fills at a rate.
#[derive(Debug)]
pub(super) struct Rates {
    limiter: RateLimiter<Asker, governor::state::keyed::HashMapStateStore<Asker>, DefaultClock>,
    clock: DefaultClock,
}

impl Rates {
    /// `rate` requests a second, and `burst` at once.
    pub(super) fn new(rate: NonZeroU32, burst: NonZeroU32) -> Self {
        let quota = Quota::per_second(rate).allow_burst(burst);
        Self { limiter: RateLimiter::hashmap(quota), clock: DefaultClock::default() }
    }

    /// Takes a request from its asker's bucket; if that is empty, says how long until there is one. A token that no
    /// scene has is nobody: else each would have a bucket of its own.
    pub(super) fn take(&self, address: IpAddr, access: &Access, caller: Caller) -> Result<(), Duration> {
        let asker = match caller.0.filter(|_| access.knows(caller)) {
            Some(hash) => Asker::Token(hash),
            None => Asker::Address(subscriber(address)),
        };
        self.limiter.check_key(&asker).map_err(|until| until.wait_time_from(self.clock.now()))
    }

    /// Forgets whoever has a full bucket again.
    pub(super) fn forget(&self) {
        self.limiter.retain_recent();
    }
}

/// An address as one that a subscriber has: with IPv6 that is a whole network of 2⁶⁴.
pub(super) fn subscriber(address: IpAddr) -> IpAddr {
    match address {
        IpAddr::V6(v6) => match v6.to_ipv4_mapped() {
            Some(v4) => v4.into(),
            None => Ipv6Addr::from_bits(v6.to_bits() & !u128::from(u64::MAX)).into(),
        },
        v4 @ IpAddr::V4(_) => v4,
    }
}

/// Names of requests: those that clients give, if they are fit for a log, or else new ones.
#[derive(Debug)]
pub(super) struct RequestIds {
    state: RandomState,
    next: std::sync::atomic::AtomicU64,
}

impl RequestIds {
    pub(super) fn new() -> Self {
        Self { state: RandomState::new(), next: 0.into() }
    }

    pub(super) fn of(&self, given: Option<&str>) -> String {
        let is_fit = |id: &&str| {
            (1..=64).contains(&id.len())
                && id.bytes().all(|b| b.is_ascii_alphanumeric() || b"-_.".contains(&b))
        };
        given.filter(is_fit).map_or_else(
            || {
                let number = self.next.fetch_add(1, std::sync::atomic::Ordering::Relaxed);
                format!("{:016x}", self.state.hash_one(number))
            },
            str::to_owned,
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use axum::http::HeaderValue;

    fn headers(authorization: &str) -> HeaderMap {
        let value = HeaderValue::from_str(authorization).unwrap();
        [(header::AUTHORIZATION, value)].into_iter().collect()
    }

    fn file(text: &str) -> tempfile::NamedTempFile {
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), text).unwrap();
        file
    }

    #[test]
    fn only_its_own_tokens_open_a_private_scene() {
        let ((one, first), (other, second)) = (new_token().unwrap(), new_token().unwrap());
        assert!(one != other && one.len() == 64);
        let file = file(&format!("# who\n\nalps {first} # anna\nalps {second}\nmars {second} x\n"));
        let access = Access::open(Some(file.path())).unwrap();
        let may = |authorization: &str, scene| access.allows(access.caller(&headers(authorization)), scene);
        assert!(may(&format!("Bearer {one}"), "alps") && may(&format!("bearer  {other} "), "alps"));
        assert!(may(&format!("Bearer {other}"), "mars") && !may(&format!("Bearer {one}"), "mars"));
        for wrong in [format!("Basic {one}"), one, format!("Bearer {first}"), "Bearer ".to_owned()] {
            assert!(!may(&wrong, "alps"), "{wrong}");
            assert!(may(&wrong, "free"), "a scene that has no tokens is everybody's");
        }
        assert!(!access.allows(access.caller(&HeaderMap::new()), "alps"));
        assert!(access.is_private("alps") && !access.is_private("free"));
    }

    #[test]
    fn a_line_that_is_none_is_named() {
        let good = new_token().unwrap().1;
        for (text, line) in
            [("alps", 1), ("../x 00", 1), ("\nalps 12", 2), (&format!("# x\n\n{good} alps"), 3)]
        {
            let path = file(text);
            let error = Access::open(Some(path.path())).unwrap_err().to_string();
            assert!(error.contains(&format!("line {line}:")), "{error}");
        }
        for text in ["", "# nobody\n\n"] {
            let error = Access::open(Some(file(text).path())).unwrap_err().to_string();
            assert!(error.contains("no scene is named") && error.contains("leave --tokens out"), "{error}");
        }
    }

    #[test]
    fn tokens_are_read_again_and_a_bad_file_changes_nothing() {
        let (token, hash) = new_token().unwrap();
        let file = file(&format!("mars {hash}"));
        let access = Access::open(Some(file.path())).unwrap();
        let caller = access.caller(&headers(&format!("Bearer {token}")));
        let write = |text: &str, minutes: u64| {
            std::fs::write(file.path(), text).unwrap();
            let before = access.look(|known| known.scenes.len());
            let later = SystemTime::now() + Duration::from_secs(60 * minutes);
            std::fs::File::options().write(true).open(file.path()).unwrap().set_modified(later).unwrap();
            access.refresh();
            // Whoever writes it may not have done.
            assert_eq!(access.look(|known| known.scenes.len()), before);
            access.refresh();
        };
        assert!(access.allows(Caller(None), "alps"));
        write(&format!("alps {hash}"), 1);
        assert!(!access.allows(Caller(None), "alps") && access.allows(caller, "alps"));
        write("alps", 2);
        assert!(!access.allows(Caller(None), "alps") && access.allows(caller, "alps"));
        // A file that names nobody is one that was cut off.
        for (minutes, text) in [(3, ""), (4, "# nobody\n\n")] {
            write(text, minutes);
            assert!(!access.allows(Caller(None), "alps") && access.allows(caller, "alps"), "{text:?}");
        }
        write(&format!("mars {hash}"), 5);
        assert!(access.allows(Caller(None), "alps") && !access.allows(Caller(None), "mars"));
    }

    #[test]
    fn an_empty_bucket_says_when_it_is_not() {
        let access = Access::default();
        let rates = Rates::new(NonZeroU32::new(2).unwrap(), NonZeroU32::new(3).unwrap());
        let take = |address: &str| rates.take(address.parse().unwrap(), &access, Caller(None));
        let wait = [(); 4].map(|()| take("2001:db8::1"))[3].unwrap_err();
        assert!(wait > Duration::ZERO && wait <= Duration::from_millis(500), "{wait:?}");
        assert!(take("2001:db8::2").is_err(), "the same network");
        assert!(take("2001:db8:0:1::2").is_ok() && take("10.0.0.1").is_ok(), "others have their own");
        assert!(rates.take("::ffff:10.0.0.1".parse().unwrap(), &access, Caller(Some([7; 32]))).is_ok());
        assert!([(); 2].map(|()| take("10.0.0.1"))[1].is_err(), "a token of no scene is nobody");
    }

    #[test]
    fn a_request_keeps_a_fit_name_and_gets_one_else() {
        let ids = RequestIds::new();
        assert_eq!(ids.of(Some("a-1.B_2")), "a-1.B_2");
        let made: Vec<String> = [None, Some(""), Some("a b"), Some("x\u{1b}[2J"), Some(&"x".repeat(65))]
            .map(|id| ids.of(id))
            .into();
        assert!(
            made.iter().all(|id| id.len() == 16 && id.bytes().all(|b| b.is_ascii_hexdigit())),
            "{made:?}"
        );
        assert_ne!(made[0], made[1]);
    }
}
