//! How a server is reached: plain or encrypted, directly or by the system's proxy, with a token or without.

use super::FetchError;
use reqwest::header::{AUTHORIZATION, HeaderMap, HeaderValue};
use reqwest::{Client, ClientBuilder, Url};

/// A client for a server, which shows it the token with each request. Certificates are those that the system trusts;
/// on Linux `SSL_CERT_FILE` may name others. Whoever asks this machine wants no proxy between. In a browser all of that
/// is the browser's.
///
/// # Errors
/// When the token is none, or the system's certificates cannot be read.
pub(crate) fn client(base: &Url, token: Option<&str>) -> Result<Client, FetchError> {
    builder(base, token)?.build().map_err(|e| FetchError::Start(e.to_string()))
}

/// The same, to be told more.
pub(crate) fn builder(base: &Url, token: Option<&str>) -> Result<ClientBuilder, FetchError> {
    let mut headers = HeaderMap::new();
    if let Some(token) = token {
        let mut value = HeaderValue::from_str(&format!("Bearer {token}"))
            .map_err(|_| FetchError::Start("the token holds what no header may".to_owned()))?;
        value.set_sensitive(true);
        headers.insert(AUTHORIZATION, value);
    }
    Ok(on_this_system(base).default_headers(headers))
}

#[cfg(not(target_arch = "wasm32"))]
fn on_this_system(base: &Url) -> ClientBuilder {
    use std::sync::Once;
    // The first one stays; whoever embeds this may have chosen one.
    static PROVIDER: Once = Once::new();
    PROVIDER.call_once(|| drop(rustls::crypto::ring::default_provider().install_default()));
    let is_local = matches!(base.host_str(), Some("localhost" | "127.0.0.1" | "[::1]"));
    if is_local { Client::builder().no_proxy() } else { Client::builder() }
}

#[cfg(target_arch = "wasm32")]
fn on_this_system(_: &Url) -> ClientBuilder {
    Client::builder()
}
