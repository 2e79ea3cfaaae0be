//! The browser's viewer: the files that `make web` writes, held in memory.
//!
//! ```text
//! DIR/index.html           the page, asked for again each time
//! DIR/HASH/NAME            what the page needs: its address changes with its content, so it is kept for ever
//! DIR/HASH/NAME.br, .gz    the same, compressed, for those that take it
//! ```
//!
//! The folder is read once, at the start. A request names a file of that list, or none: no text of a request ever
//! becomes a path.

use super::answer::{IMMUTABLE, Refusal, tagged};
use axum::body::{Body, Bytes};
use axum::http::{HeaderMap, HeaderName, HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Response};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// The largest file, in bytes: four times what an unpacked program has.
const FILE_BYTES_MAX: u64 = 32 << 20;

/// Files that a folder may hold.
const FILES_MAX: usize = 64;

/// Endings of names, and what such files are.
const KINDS: &[(&str, &str)] = &[
    ("html", "text/html; charset=utf-8"),
    ("js", "text/javascript; charset=utf-8"),
    ("css", "text/css; charset=utf-8"),
    ("svg", "image/svg+xml"),
    ("wasm", "application/wasm"),
];

/// Encodings of answers, the best first, and the endings of files that have them.
const ENCODINGS: &[(&str, &str)] = &[("br", "br"), ("gzip", "gz")];

/// What the page may do: run its own scripts and WebAssembly, and ask this server.
const POLICY: &str = "default-src 'none'; script-src 'self' 'wasm-unsafe-eval'; style-src 'self'; img-src 'self' data: blob:; \
                      connect-src 'self'; base-uri 'none'; form-action 'none'";

/// Why a folder has no viewer.
#[derive(Debug, thiserror::Error)]
pub enum ViewerError {
    /// Nothing can be read there.
    #[error("{path}: cannot read the browser's viewer: {error}; `make web` builds it")]
    Io {
        /// The file or folder.
        path: PathBuf,
        /// What the system said.
        error: std::io::Error,
    },
    /// It holds something else.
    #[error("{path}: {what}: expected a folder that `make web` has written")]
    Other {
        /// The file or folder.
        path: PathBuf,
        /// What is found there.
        what: String,
    },
}

/// A file, and the same compressed.
#[derive(Debug)]
struct File {
    kind: &'static str,
    tag: String,
    plain: Bytes,
    /// One for each of [`ENCODINGS`], if it is there.
    packed: [Option<Bytes>; 2],
}

/// The viewer's files, by the rest of their address.
#[derive(Debug)]
pub(super) struct Viewer {
    page: File,
    files: BTreeMap<String, File>,
}

impl Viewer {
    /// Reads all files of a folder.
    pub(super) fn open(folder: &Path) -> Result<Self, ViewerError> {
        let page = File::read(&folder.join("index.html"))?;
        let mut files = BTreeMap::new();
        for inner in entries(folder)?.into_iter().filter(|path| path.is_dir()) {
            for path in entries(&inner)? {
                let ending = path.extension().and_then(|e| e.to_str()).unwrap_or_default();
                if ENCODINGS.iter().any(|(_, packed)| *packed == ending) {
                    continue;
                }
                let [Some(hash), Some(name)] =
                    [&inner, &path].map(|p| p.file_name().and_then(|n| n.to_str()))
                else {
                    continue;
                };
                if files.len() == FILES_MAX {
                    let what = format!("more than {FILES_MAX} files");
                    return Err(ViewerError::Other { path: folder.to_owned(), what });
                }
                files.insert(format!("{hash}/{name}"), File::read(&path)?);
            }
        }
        Ok(Self { page, files })
    }

    /// The page.
    pub(super) fn page(&self, headers: &HeaderMap) -> Response {
        let mut response = self.page.answer(headers, "no-cache");
        response.headers_mut().insert(header::CONTENT_SECURITY_POLICY, HeaderValue::from_static(POLICY));
        let referrer = HeaderName::from_static("referrer-policy");
        response.headers_mut().insert(referrer, HeaderValue::from_static("same-origin"));
        response
    }

    /// A file that the page needs.
    pub(super) fn file(&self, headers: &HeaderMap, hash: &str, name: &str) -> Response {
        match self.files.get(&format!("{hash}/{name}")) {
            Some(file) => file.answer(headers, IMMUTABLE),
            None => none().into_response(),
        }
    }
}

/// There is no such file.
pub(super) fn none() -> Refusal {
    Refusal::new(StatusCode::NOT_FOUND, "no such file of the viewer: load the page at / again")
}

/// What a folder holds, in order.
fn entries(folder: &Path) -> Result<Vec<PathBuf>, ViewerError> {
    let failed = |error| ViewerError::Io { path: folder.to_owned(), error };
    let listed = std::fs::read_dir(folder).map_err(failed)?.take(4 * FILES_MAX);
    let mut paths = listed.map(|entry| Ok(entry?.path())).collect::<Result<Vec<_>, _>>().map_err(failed)?;
    paths.sort();
    Ok(paths)
}

fn read(path: &Path) -> Result<Bytes, ViewerError> {
    let failed = |error| ViewerError::Io { path: path.to_owned(), error };
    let length = std::fs::metadata(path).map_err(failed)?.len();
    if length > FILE_BYTES_MAX {
        let what = format!("{length} bytes, limit {FILE_BYTES_MAX}");
        return Err(ViewerError::Other { path: path.to_owned(), what });
    }
    Ok(std::fs::read(path).map_err(failed)?.into())
}

impl File {
    /// A file with its compressed twins.
    fn read(path: &Path) -> Result<Self, ViewerError> {
        let ending = path.extension().and_then(|e| e.to_str()).unwrap_or_default();
        let Some((_, kind)) = KINDS.iter().find(|(of, _)| *of == ending) else {
            let what = "a file of no kind that pages have".to_owned();
            return Err(ViewerError::Other { path: path.to_owned(), what });
        };
        let plain = read(path)?;
        let mut packed = [None, None];
        for (slot, (_, ending)) in packed.iter_mut().zip(ENCODINGS) {
            let twin = PathBuf::from(format!("{}.{ending}", path.display()));
            if twin.exists() {
                *slot = Some(read(&twin)?);
            }
        }
        let tag = blake3::hash(&plain).to_hex()[..16].to_owned();
        Ok(Self { kind, tag, plain, packed })
    }

    fn answer(&self, headers: &HeaderMap, cache: &'static str) -> Response {
        let found = ENCODINGS.iter().zip(&self.packed).find_map(|((name, _), bytes)| {
            let bytes = bytes.as_ref().filter(|_| takes(headers, name))?;
            Some((*name, bytes))
        });
        let (encoding, bytes) = found.map_or((None, &self.plain), |(name, bytes)| (Some(name), bytes));
        // Each form has a tag of its own, since their bytes differ.
        let tag = encoding.map_or_else(|| self.tag.clone(), |name| format!("{}-{name}", self.tag));
        let mut response = tagged(headers, &tag, cache, self.kind, || Body::from(bytes.clone()));
        response.headers_mut().insert(header::VARY, HeaderValue::from_static("accept-encoding"));
        if let Some(name) = encoding.filter(|_| response.status() == StatusCode::OK) {
            response.headers_mut().insert(header::CONTENT_ENCODING, HeaderValue::from_static(name));
        }
        response
    }
}

/// Whether who asks takes an encoding (RFC 9110, 12.5.3): named or by `*`, and not with a weight of 0.
fn takes(headers: &HeaderMap, name: &str) -> bool {
    let lists = headers.get_all(header::ACCEPT_ENCODING).iter().filter_map(|value| value.to_str().ok());
    let mut any = false;
    for item in lists.flat_map(|list| list.split(',')) {
        let mut parts = item.split(';').map(str::trim);
        let coding = parts.next().unwrap_or_default();
        let weight = parts.find_map(|part| part.strip_prefix("q=")?.parse::<f32>().ok()).unwrap_or(1.0);
        if coding.eq_ignore_ascii_case(name) {
            return weight > 0.0;
        }
        any |= coding == "*" && weight > 0.0;
    }
    any
}

#[cfg(test)]
mod tests {
    use super::*;

    fn headers(accept: &str) -> HeaderMap {
        HeaderMap::from_iter([(header::ACCEPT_ENCODING, HeaderValue::from_str(accept).unwrap())])
    }

    #[test]
    fn encodings_are_taken_as_they_are_asked_for() {
        for (accept, name, expected) in [
            ("gzip, deflate, br, zstd", "br", true),
            ("gzip", "br", false),
            ("br;q=0, *", "br", false),
            ("*;q=0.1", "gzip", true),
            ("*;q=0", "gzip", false),
            ("GZIP;q=0.5", "gzip", true),
            ("", "gzip", false),
            ("brotli", "br", false),
        ] {
            assert_eq!(takes(&headers(accept), name), expected, "{accept} {name}");
        }
        assert!(!takes(&HeaderMap::new(), "gzip"));
    }

    fn folder() -> tempfile::TempDir {
        let folder = tempfile::tempdir().unwrap();
        std::fs::create_dir(folder.path().join("0a1b")).unwrap();
        for (name, text) in [
            ("index.html", "page"),
            ("0a1b/a.wasm", "plain"),
            ("0a1b/a.wasm.br", "brotli"),
            ("0a1b/a.wasm.gz", "gzip"),
            ("0a1b/b.js", "script"),
        ] {
            std::fs::write(folder.path().join(name), text).unwrap();
        }
        folder
    }

    #[test]
    fn files_come_in_the_best_form_that_is_taken() {
        let folder = folder();
        let viewer = Viewer::open(folder.path()).unwrap();
        let about = |response: &Response, name: HeaderName| {
            response.headers().get(name).map(|value| value.to_str().unwrap().to_owned())
        };
        let mut tags = std::collections::HashSet::new();
        for (accept, encoding) in [("gzip, br", Some("br")), ("gzip", Some("gzip")), ("identity", None)] {
            let response = viewer.file(&headers(accept), "0a1b", "a.wasm");
            assert_eq!(response.status(), StatusCode::OK);
            assert_eq!(about(&response, header::CONTENT_ENCODING).as_deref(), encoding);
            assert_eq!(about(&response, header::CONTENT_TYPE).as_deref(), Some("application/wasm"));
            assert_eq!(about(&response, header::CACHE_CONTROL).as_deref(), Some(IMMUTABLE));
            assert_eq!(about(&response, header::VARY).as_deref(), Some("accept-encoding"));
            let tag = about(&response, header::ETAG).unwrap();
            let mut again = headers(accept);
            again.insert(header::IF_NONE_MATCH, tag.parse().unwrap());
            assert_eq!(viewer.file(&again, "0a1b", "a.wasm").status(), StatusCode::NOT_MODIFIED);
            assert!(tags.insert(tag), "forms of different bytes have different tags");
        }
        let page = viewer.page(&HeaderMap::new());
        assert_eq!(about(&page, header::CACHE_CONTROL).as_deref(), Some("no-cache"));
        assert!(about(&page, header::CONTENT_SECURITY_POLICY).unwrap().contains("'wasm-unsafe-eval'"));
        assert_eq!(viewer.file(&headers("br"), "0a1b", "b.js").headers().get(header::CONTENT_ENCODING), None);
    }

    #[test]
    fn only_listed_files_are_found() {
        let folder = folder();
        std::fs::write(folder.path().join("secret.js"), "outside").unwrap();
        let viewer = Viewer::open(folder.path()).unwrap();
        for (hash, name) in [
            ("..", "secret.js"),
            (".", "secret.js"),
            ("0a1b", "../secret.js"),
            ("0a1b", "a.wasm.br"),
            ("", ""),
            ("0a1b", ""),
        ] {
            let status = viewer.file(&HeaderMap::new(), hash, name).status();
            assert_eq!(status, StatusCode::NOT_FOUND, "{hash}/{name}");
        }
    }

    #[test]
    fn a_folder_that_is_none_is_refused_with_its_name() {
        let folder = tempfile::tempdir().unwrap();
        let error = Viewer::open(folder.path()).unwrap_err().to_string();
        assert!(error.contains("index.html") && error.contains("make web"), "{error}");
        let other = self::folder();
        std::fs::write(other.path().join("0a1b/notes.txt"), "x").unwrap();
        let error = Viewer::open(other.path()).unwrap_err().to_string();
        assert!(error.contains("notes.txt"), "{error}");
    }
}
