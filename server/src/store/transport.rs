//! How requests to object stores travel: by hyper, and rustls with ring, both of which the server has already.

use bytes::Bytes;
use http_body::{Body, Frame, SizeHint};
use hyper::body::Incoming;
use hyper_rustls::{HttpsConnector, HttpsConnectorBuilder};
use hyper_util::client::legacy::connect::HttpConnector as Tcp;
use hyper_util::client::legacy::{Client, Error as ClientError};
use hyper_util::rt::{TokioExecutor, TokioTimer};
use object_store::client::{
    HttpClient, HttpConnector, HttpError, HttpErrorKind, HttpRequest, HttpRequestBody, HttpResponse,
    HttpResponseBody, HttpService,
};
use object_store::{ClientConfigKey, ClientOptions};
use pin_project_lite::pin_project;
use std::error::Error;
use std::io;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};
use std::time::Duration;
use tokio::time::{Instant, Sleep, sleep_until, timeout_at};
use tokio_rustls::rustls::crypto::ring;
use tokio_rustls::rustls::{ClientConfig, RootCertStore};

/// How long a connection may take to come about.
const CONNECT: Duration = Duration::from_secs(2);

/// How long an idle connection is kept. Balancers of object stores keep theirs for some 20 s and more.
const IDLE: Duration = Duration::from_secs(15);

/// Idle connections that are kept.
const IDLE_MAX: usize = 16;

/// Makes clients whose requests end within a time, answer included.
#[derive(Debug, Clone, Copy)]
pub(super) struct Transport {
    pub(super) patience: Duration,
}

#[derive(Debug)]
struct Requests {
    client: Client<HttpsConnector<Tcp>, HttpRequestBody>,
    patience: Duration,
}

/// The system's certificates, or those of `SSL_CERT_FILE`. Without any, only plain HTTP is possible.
fn roots() -> RootCertStore {
    let mut roots = RootCertStore::empty();
    let found = rustls_native_certs::load_native_certs();
    roots.add_parsable_certificates(found.certs);
    roots
}

impl HttpConnector for Transport {
    fn connect(&self, options: &ClientOptions) -> object_store::Result<HttpClient> {
        let failed = |e: tokio_rustls::rustls::Error| object_store::Error::Generic {
            store: "TLS",
            source: Box::new(e),
        };
        let config = ClientConfig::builder_with_provider(Arc::new(ring::default_provider()))
            .with_safe_default_protocol_versions()
            .map_err(failed)?
            .with_root_certificates(roots())
            .with_no_client_auth();
        let is_plain = options.get_config_value(&ClientConfigKey::AllowHttp).is_some_and(|v| v == "true");
        let builder = HttpsConnectorBuilder::new().with_tls_config(config);
        let builder = if is_plain { builder.https_or_http() } else { builder.https_only() };
        let mut tcp = Tcp::new();
        tcp.set_connect_timeout(Some(CONNECT));
        tcp.set_nodelay(true);
        tcp.enforce_http(false);
        let client = Client::builder(TokioExecutor::new())
            .pool_timer(TokioTimer::new())
            .pool_idle_timeout(IDLE)
            .pool_max_idle_per_host(IDLE_MAX)
            .build(builder.enable_http1().wrap_connector(tcp));
        Ok(HttpClient::new(Requests { client, patience: self.patience }))
    }
}

fn too_slow(kind: &'static str) -> HttpError {
    HttpError::new(HttpErrorKind::Timeout, io::Error::new(io::ErrorKind::TimedOut, kind))
}

/// What can be done about a failure, which object_store wants to know before it tries again.
fn kind(error: &(dyn Error + 'static)) -> HttpErrorKind {
    let mut next = Some(error);
    while let Some(error) = next {
        if let Some(error) = error.downcast_ref::<hyper::Error>() {
            if error.is_canceled() || error.is_closed() || error.is_incomplete_message() {
                return HttpErrorKind::Request;
            }
            if error.is_timeout() {
                return HttpErrorKind::Timeout;
            }
        }
        if let Some(error) = error.downcast_ref::<io::Error>() {
            return match error.kind() {
                io::ErrorKind::TimedOut => HttpErrorKind::Timeout,
                _ => HttpErrorKind::Interrupted,
            };
        }
        next = error.source();
    }
    HttpErrorKind::Unknown
}

fn of_client(error: ClientError) -> HttpError {
    let kind = if error.is_connect() { HttpErrorKind::Connect } else { kind(&error) };
    HttpError::new(kind, Whole(Box::new(error)))
}

/// An error that tells its causes too: which address refused says more than that one did.
#[derive(Debug, thiserror::Error)]
#[error("{}", causes(.0.as_ref()))]
struct Whole(Box<dyn Error + Send + Sync>);

fn causes(error: &(dyn Error + 'static)) -> String {
    let mut text = error.to_string();
    let mut next = error.source();
    while let Some(error) = next {
        text = format!("{text}: {error}");
        next = error.source();
    }
    text
}

#[async_trait::async_trait]
impl HttpService for Requests {
    async fn call(&self, request: HttpRequest) -> Result<HttpResponse, HttpError> {
        let due = Instant::now() + self.patience;
        let answer = timeout_at(due, self.client.request(request))
            .await
            .map_err(|_| too_slow("no answer in time"))?
            .map_err(of_client)?;
        Ok(answer.map(|body| HttpResponseBody::new(Due { body, sleep: sleep_until(due) })))
    }
}

pin_project! {
    /// A body that has to be there by a time.
    struct Due {
        #[pin]
        body: Incoming,
        #[pin]
        sleep: Sleep,
    }
}

impl Body for Due {
    type Data = Bytes;
    type Error = HttpError;

    fn poll_frame(
        self: Pin<&mut Self>,
        context: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<Bytes>, HttpError>>> {
        let this = self.project();
        match this.body.poll_frame(context) {
            Poll::Ready(frame) => {
                Poll::Ready(frame.map(|f| f.map_err(|e| HttpError::new(kind(&e), Whole(Box::new(e))))))
            }
            Poll::Pending => {
                this.sleep.poll(context).map(|()| Some(Err(too_slow("the answer takes too long"))))
            }
        }
    }

    fn is_end_stream(&self) -> bool {
        self.body.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        self.body.size_hint()
    }
}
