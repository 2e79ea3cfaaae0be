//! How a server is reached: plain or encrypted, directly or by the system's proxy, with a token or without.

use super::FetchError;
use reqwest::header::{AUTHORIZATION, HeaderMap, HeaderValue};
use reqwest::{Client, ClientBuilder, Url};
use std::sync::Once;
use std::time::Duration;

/// A client for a server, which gives up a connection that is silent for as long as `patience`, and shows the token
/// with each request. Certificates are those that the system trusts; on Linux `SSL_CERT_FILE` may name others.
///
/// # Errors
/// When the token is none, or the system's certificates cannot be read.
pub(crate) fn client(base: &Url, patience: Duration, token: Option<&str>) -> Result<Client, FetchError> {
    builder(base, patience, token)?.build().map_err(|e| FetchError::Start(e.to_string()))
}

/// The same, to be told more.
pub(crate) fn builder(
    base: &Url,
    patience: Duration,
    token: Option<&str>,
) -> Result<ClientBuilder, FetchError> {
    // The first one stays; whoever embeds this may have chosen one.
    static PROVIDER: Once = Once::new();
    PROVIDER.call_once(|| drop(rustls::crypto::ring::default_provider().install_default()));
    let mut headers = HeaderMap::new();
    if let Some(token) = token {
        let mut value = HeaderValue::from_str(&format!("Bearer {token}"))
            .map_err(|_| FetchError::Start("the token holds what no header may".to_owned()))?;
        value.set_sensitive(true);
        headers.insert(AUTHORIZATION, value);
    }
    let builder = Client::builder().connect_timeout(patience).read_timeout(patience).default_headers(headers);
    let is_local = matches!(base.host_str(), Some("localhost" | "127.0.0.1" | "[::1]"));
    Ok(if is_local { builder.no_proxy() } else { builder })
}
