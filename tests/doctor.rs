//! `doctor`: nothing to say of a server by itself; what a proxy spoils is named; certificates and tokens as clients use
//! them.

use crate::hostile::{Ended, end};
use crate::service::certify;
use crate::world::{World, build, options, programs, serve, serve_with, write_raw};
use diamantina_client::doctor::{Finding, Verdict, examine};
use diamantina_server::hierarchy;
use diamantina_server::http::{self, Options};
use std::io::{Read, Write};
use std::net::{Shutdown, TcpListener, TcpStream};
use std::path::Path;
use std::process::{Command, Stdio};
use std::sync::Arc;

fn findings(url: &str) -> Vec<Finding> {
    let mut all = Vec::new();
    examine(url, None, |finding| all.push(finding)).unwrap();
    all
}

/// What a proxy makes of the head of a request, and of the head of its answer.
type Spoil = Arc<dyn Fn(&str, String) -> String + Send + Sync>;

/// A proxy that passes one request a connection, and spoils heads of requests, which it shows to `ask`, and of answers.
/// Its threads end with the process.
fn spoiler(upstream: &str, ask: Option<Spoil>, tell: Spoil) -> String {
    let upstream = upstream.trim_start_matches("http://").to_owned();
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = format!("http://{}", listener.local_addr().unwrap());
    std::thread::spawn(move || {
        for from in listener.incoming().flatten() {
            let (upstream, ask, tell) = (upstream.clone(), ask.clone(), Arc::clone(&tell));
            // A connection that breaks is the client's to report.
            std::thread::spawn(move || pass(from, &upstream, ask.as_ref(), &tell).ok());
        }
    });
    address
}

fn pass(mut from: TcpStream, upstream: &str, ask: Option<&Spoil>, tell: &Spoil) -> std::io::Result<()> {
    let request = head(&mut from)?;
    let asked = request.replacen("\r\n", "\r\nconnection: close\r\n", 1);
    let asked = ask.map_or(asked.clone(), |spoil| spoil(&request, asked));
    let mut to = TcpStream::connect(upstream)?;
    to.write_all(asked.as_bytes())?;
    let answered = head(&mut to)?;
    from.write_all(tell(&request, answered).as_bytes())?;
    std::io::copy(&mut to, &mut from)?;
    from.shutdown(Shutdown::Both)
}

/// All up to the empty line.
fn head(stream: &mut TcpStream) -> std::io::Result<String> {
    let (mut bytes, mut byte) = (Vec::new(), [0]);
    while !bytes.ends_with(b"\r\n\r\n") {
        stream.read_exact(&mut byte)?;
        bytes.extend(byte);
    }
    Ok(String::from_utf8(bytes).unwrap())
}

/// A head without a header.
fn without(head: &str, name: &str) -> String {
    head.split_inclusive("\r\n").filter(|line| !line.starts_with(name)).collect()
}

/// A head with a header instead of what it has of that name.
fn with(head: &str, name: &str, value: &str) -> String {
    without(head, name).replacen("\r\n", &format!("\r\n{name}: {value}\r\n"), 1)
}

#[test]
fn of_a_server_by_itself_all_is_good() {
    let world = World::sample(257, 1.0);
    for url in [world.served.address.clone(), world.served.scene("world")] {
        let all = findings(&url);
        assert!(all.len() >= 15, "{all:#?}");
        assert!(all.iter().all(|finding| finding.verdict == Verdict::Good), "{all:#?}");
    }
}

#[test]
fn triangles_alone_are_examined_as_well() {
    let folder = tempfile::tempdir().unwrap();
    let (dem, store) = (folder.path().join("dem.raw"), folder.path().join("store"));
    let ingest = write_raw(&dem, [129, 129], |x, y| Some((x * y % 97) as f32));
    let tin = Some(hierarchy::TinOptions::default());
    build(&dem, &store, &ingest, &hierarchy::Options { points: false, tin, ..options() });
    let served = serve(&[store]);
    let all = findings(&served.scene("world"));
    let routes = all.iter().find(|finding| finding.check == "payload").map(|finding| &finding.found);
    assert!(routes.is_some_and(|found| found.contains("decode")), "{all:#?}");
    assert!(all.iter().all(|finding| finding.verdict == Verdict::Good), "{all:#?}");
}

#[test]
fn what_a_proxy_spoils_is_named() {
    let world = World::sample(257, 1.0);
    let upstream = &world.served.address;
    let through = |ask: Option<Spoil>, tell: Spoil| {
        let address = spoiler(upstream, ask, tell);
        findings(&format!("{address}/scenes/world"))
    };
    let plain: Spoil = Arc::new(|_, head| head);
    let all = through(None, Arc::clone(&plain));
    assert!(all.iter().all(|finding| finding.verdict == Verdict::Good), "{all:#?}");

    let is_below = |request: &str| request.contains("/points/") || request.contains("/index/");
    let told: [(&str, Verdict, Spoil); 9] = [
        ("caching", Verdict::Warning, Arc::new(|_, head| with(&head, "cache-control", "no-store"))),
        ("tags", Verdict::Warning, Arc::new(|_, head| without(&head, "etag"))),
        ("vary", Verdict::Warning, Arc::new(|_, head| with(&head, "vary", "Accept, User-Agent"))),
        ("other sites", Verdict::Warning, Arc::new(|_, head| without(&head, "access-control-allow-origin"))),
        ("clock", Verdict::Warning, Arc::new(|_, head| with(&head, "date", "Sun, 06 Nov 1994 08:49:37 GMT"))),
        (
            "compression",
            Verdict::Warning,
            Arc::new(move |request, head| {
                let asked = request.contains("gzip");
                if asked && is_below(request) { with(&head, "content-encoding", "gzip") } else { head }
            }),
        ),
        ("description", Verdict::Warning, Arc::new(|_, head| with(&head, "cache-control", "max-age=3600"))),
        (
            "ranges",
            Verdict::Bad,
            Arc::new(|request, head| {
                let asked = request.contains("range: ");
                if asked { head.replacen("200 OK", "206 Partial Content", 1) } else { head }
            }),
        ),
        (
            "long addresses",
            Verdict::Bad,
            Arc::new(|request, head| {
                let long = request.len() > 1000;
                if long { head.replacen("200 OK", "414 URI Too Long", 1) } else { head }
            }),
        ),
    ];
    for (check, verdict, spoil) in told {
        let all = through(None, spoil);
        let found = all.iter().find(|finding| finding.check == check && finding.verdict == verdict);
        assert!(found.is_some_and(|finding| finding.remedy.is_some()), "{check}: {all:#?}");
    }
    // A proxy that asks for another address than it was asked for.
    let astray: Spoil =
        Arc::new(
            |request, asked| {
                if request.contains("/points/") { asked.replacen("/points/", "/index/", 1) } else { asked }
            },
        );
    let all = through(Some(astray), plain);
    assert!(all.iter().any(|f| f.check == "payload" && f.verdict == Verdict::Bad), "{all:#?}");
}

#[test]
fn a_server_that_is_not_there_is_a_finding() {
    let all = findings("http://127.0.0.1:9/scenes/world");
    assert_eq!(all.len(), 1);
    assert_eq!((all[0].check, all[0].verdict), ("reach", Verdict::Bad));
}

/// Runs the client with a certificate to trust, and a token.
fn client(arguments: &[&str], certificate: &Path, token: Option<&str>) -> Ended {
    let mut command = Command::new(&programs().client);
    command.args(arguments).env("SSL_CERT_FILE", certificate).env_remove("DIAMANTINA_TOKEN");
    if let Some(token) = token {
        command.env("DIAMANTINA_TOKEN", token);
    }
    end(command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap())
}

#[test]
fn private_scenes_are_examined_and_drawn_over_an_encrypted_connection() {
    let world = World::sample(129, 1.0);
    let folder = world.folder.path();
    let (_, certificate, key) = certify(folder);
    let (token, hash) = http::new_token().unwrap();
    let tokens = folder.join("tokens");
    std::fs::write(&tokens, format!("world {hash}")).unwrap();
    let options =
        Options { certificate: Some((certificate.clone(), key)), tokens: Some(tokens), ..Options::default() };
    let served = serve_with(&[folder.join("store")], &options);
    let url = served.scene("world").replace("127.0.0.1", "localhost");

    let refused = client(&["doctor", &url], &certificate, None);
    assert_eq!(refused.code, Some(1), "{}{}", refused.out, refused.err);
    assert!(refused.out.contains("need a token"), "{}", refused.out);
    let examined = client(&["doctor", &url], &certificate, Some(&token));
    assert_eq!(examined.code, Some(0), "{}{}", examined.out, examined.err);
    assert!(examined.out.contains("agreed on") && !examined.out.contains("warning"), "{}", examined.out);
    assert!(!examined.out.contains(&token) && !examined.err.contains(&token));
    let picture = folder.join("picture.png");
    let drawn =
        ["render", url.as_str(), "-o", picture.to_str().unwrap(), "--size", "160x90", "--error-pixels", "4"];
    assert_eq!(client(&drawn, &certificate, None).code, Some(1));
    let done = client(&drawn, &certificate, Some(&token));
    assert_eq!(done.code, Some(0), "{}{}", done.out, done.err);
    // Nobody vouches for the certificate.
    let stranger = client(&["doctor", &url], Path::new("/dev/null"), None);
    assert_eq!(stranger.code, Some(1), "{}{}", stranger.out, stranger.err);
}
