//! Bytes as they come on a connection, for a whole server: heads, addresses, queries, conditions, tokens.

use super::made;
use diamantina_server::http::{self, Server};
use std::io::{Read as _, Write as _};
use std::net::{Shutdown, SocketAddr, TcpStream};
use std::sync::OnceLock;
use std::time::Duration;

/// What stands for the scene's version, which is a hash.
const VERSION: &str = "VERSION";

/// How long an answer may take: the server's own patience with a head, and some more.
const PATIENCE: Duration = Duration::from_secs(20);

/// How long nothing comes until no more is waited for.
const QUIET: Duration = Duration::from_millis(5);

/// All that the server says when it is well.
const STATUSES: [&str; 13] =
    ["200", "204", "304", "400", "404", "405", "410", "412", "413", "414", "429", "431", "505"];

struct Served {
    address: SocketAddr,
    version: String,
}

/// A server, which runs as long as the process does.
fn served() -> &'static Served {
    static SERVED: OnceLock<Served> = OnceLock::new();
    SERVED.get_or_init(|| {
        let store = made::store().to_owned();
        let any = SocketAddr::from(([127, 0, 0, 1], 0));
        let server = Server::open_with(&[store], any, &http::Options::default()).expect("the store is whole");
        let address = server.address();
        std::thread::spawn(move || server.run(std::future::pending()));
        let address = address.trim_start_matches("http://").parse().expect("an address and a port");
        let scene =
            ask(address, b"GET /scenes/made HTTP/1.1\r\nHost: here\r\nConnection: close\r\n\r\n", None);
        let body = scene.split_once("\r\n\r\n").expect("a body").1;
        let scene: serde_json::Value = serde_json::from_str(body).expect("a description");
        Served { address, version: scene["version"].as_str().expect("a version").to_owned() }
    })
}

/// What comes back until the connection is closed: by the server, or, once it has been quiet, from here.
fn ask(address: SocketAddr, sent: &[u8], quiet: Option<Duration>) -> String {
    let mut stream = TcpStream::connect(address).expect("the server accepts");
    stream.set_write_timeout(Some(PATIENCE)).expect("more than 0");
    // It may have seen enough before all is sent.
    let _ = stream.write_all(sent);
    let mut found = Vec::new();
    if quiet.is_some() {
        stream.set_read_timeout(quiet).expect("more than 0");
        let mut part = [0; 4096];
        while let Ok(count) = stream.read(&mut part) {
            if count == 0 {
                break;
            }
            found.extend_from_slice(&part[..count]);
        }
        let _ = stream.shutdown(Shutdown::Write);
    }
    stream.set_read_timeout(Some(PATIENCE)).expect("more than 0");
    match stream.read_to_end(&mut found) {
        // Closed before all was read, which drops what was still on its way.
        Err(error) if error.kind() == std::io::ErrorKind::ConnectionReset => {}
        other => drop(other.unwrap_or_else(|error| panic!("no end of an answer: {error}"))),
    }
    String::from_utf8_lossy(&found).into_owned()
}

/// Sends bytes to a server, in which `VERSION` stands for that of its scene. Whatever they are, it ends the connection, has
/// one of the answers that it documents, none of which is a fault of its own, and goes on.
pub fn run(data: &[u8]) {
    let Served { address, version } = served();
    let mut sent = Vec::with_capacity(data.len() + 16);
    let mut rest = data;
    while let Some(at) = rest.windows(VERSION.len()).position(|part| part == VERSION.as_bytes()) {
        sent.extend_from_slice(&rest[..at]);
        sent.extend_from_slice(version.as_bytes());
        rest = &rest[at + VERSION.len()..];
    }
    sent.extend_from_slice(rest);
    let found = ask(*address, &sent, Some(QUIET));
    if let Some(head) = found.strip_prefix("HTTP/1.") {
        let status = head.get(2..5).unwrap_or_default();
        assert!(STATUSES.contains(&status), "{status} for {:?}", String::from_utf8_lossy(&sent));
    }
}
