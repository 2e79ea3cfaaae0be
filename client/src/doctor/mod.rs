//! `doctor`: what is wrong with a server as clients see it, through all the proxies and caches before it.
//!
//! Each check asks as a client or a browser would, and says what it found; where that costs speed or breaks something,
//! also what to do. Nothing is taken from what the server says of itself: a description that promises an encoding is
//! tried by fetching and decoding a diamond.

mod checks;

use crate::fetch::{FetchError, connect, parse_address};
use checks::Subject;
use reqwest::header::HeaderMap;
use reqwest::{Client, Method, RequestBuilder, StatusCode, Version};
use serde::Serialize;
use std::fmt;
use std::time::{Duration, Instant};

/// How long a connection may be silent.
const PATIENCE: Duration = Duration::from_secs(15);

/// Bytes of an answer that are read.
const BYTES_MAX: usize = 4 << 20;

/// How a check ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Verdict {
    /// As it should be.
    Good,
    /// It works, but not as well as it could, or not for all.
    Warning,
    /// Something does not work.
    Bad,
}

impl fmt::Display for Verdict {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(match self {
            Self::Good => "good",
            Self::Warning => "warning",
            Self::Bad => "bad",
        })
    }
}

/// What a check found.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Finding {
    /// What was checked.
    pub check: &'static str,
    /// How it ended.
    pub verdict: Verdict,
    /// What was found, and what was expected if that is another thing.
    pub found: String,
    /// What to do.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub remedy: Option<&'static str>,
}

/// An answer, read to its end.
#[derive(Debug)]
struct Answer {
    status: StatusCode,
    version: Version,
    headers: HeaderMap,
    body: Vec<u8>,
    seconds: f64,
}

impl Answer {
    /// A header as text, in small letters; empty where there is none.
    fn header(&self, name: &str) -> String {
        let all = self.headers.get_all(name).iter().filter_map(|value| value.to_str().ok());
        all.collect::<Vec<_>>().join(", ").to_ascii_lowercase()
    }
}

/// A server and the ways to ask it.
struct Server {
    client: Client,
    base: String,
}

impl Server {
    /// A request for a route.
    fn request(&self, method: Method, route: &str) -> RequestBuilder {
        self.client.request(method, format!("{}{route}", self.base))
    }

    async fn get(&self, route: &str) -> Result<Answer, String> {
        answer(self.request(Method::GET, route)).await
    }
}

/// Sends a request and reads its answer; why there is none, if so.
async fn answer(request: RequestBuilder) -> Result<Answer, String> {
    let began = Instant::now();
    let told = |error: reqwest::Error| match crate::fetch::transport(&error) {
        FetchError::Transport(text) => text,
        other => other.to_string(),
    };
    let mut response = request.send().await.map_err(told)?;
    let (status, version, headers) = (response.status(), response.version(), response.headers().clone());
    let mut body = Vec::new();
    while let Some(chunk) = response.chunk().await.map_err(told)? {
        if body.len() + chunk.len() > BYTES_MAX {
            return Err(format!("an answer of more than {BYTES_MAX} bytes"));
        }
        body.extend_from_slice(&chunk);
    }
    Ok(Answer { status, version, headers, body, seconds: began.elapsed().as_secs_f64() })
}

/// Examines a server at the address of a scene, or of a server with one scene. Each finding is told as soon as it is there.
///
/// # Errors
/// When the address or the token is none; a server that does not answer is a finding.
pub fn examine(url: &str, token: Option<&str>, mut tell: impl FnMut(Finding)) -> Result<(), FetchError> {
    let (base, name) = parse_address(url)?;
    let start = |e: &dyn fmt::Display| FetchError::Start(e.to_string());
    let server = Server {
        client: connect::builder(&base, token)?.read_timeout(PATIENCE).build().map_err(|e| start(&e))?,
        base: base.as_str().trim_end_matches('/').to_owned(),
    };
    // A connection of its own that may only be HTTP/2, as a balancer before the server would open it.
    let plain = base.scheme() == "http";
    let prior = connect::builder(&base, token)?.read_timeout(PATIENCE).http2_prior_knowledge();
    let http2 = plain.then(|| prior.build()).transpose().map_err(|e| start(&e))?;
    let runtime =
        tokio::runtime::Builder::new_current_thread().enable_all().build().map_err(|e| start(&e))?;
    runtime.block_on(async {
        let Some(subject) = Subject::find(&server, name.as_deref(), &mut tell).await else { return };
        subject.examine(http2.as_ref(), &mut tell).await;
    });
    Ok(())
}
