//! Who asks too much, too slowly or for nothing does not disturb the others.

use crate::service::metric;
use crate::world::{Served, World, serve_within};
use diamantina_protocol::diamond::Diamond;
use diamantina_protocol::message;
use diamantina_server::http::Limits;
use std::io::{self, Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::thread::sleep;
use std::time::{Duration, Instant};

/// What a test of short deadlines waits at most.
const PATIENCE: Duration = Duration::from_secs(20);

fn milliseconds(count: u64) -> Duration {
    Duration::from_millis(count)
}

fn address(url: &str) -> SocketAddr {
    url.trim_start_matches("http://").parse().unwrap()
}

pub(crate) fn connect(url: &str) -> TcpStream {
    let stream = TcpStream::connect(address(url)).unwrap();
    stream.set_read_timeout(Some(PATIENCE)).unwrap();
    stream
}

/// Connects from another address of this machine.
fn connect_from(from: &str, url: &str) -> TcpStream {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
    let stream = runtime.block_on(async {
        let socket = tokio::net::TcpSocket::new_v4().unwrap();
        socket.bind(SocketAddr::new(from.parse().unwrap(), 0)).unwrap();
        socket.connect(address(url)).await.unwrap().into_std().unwrap()
    });
    stream.set_nonblocking(false).unwrap();
    stream.set_read_timeout(Some(PATIENCE)).unwrap();
    stream
}

fn try_request(stream: &mut TcpStream, path: &str) -> io::Result<()> {
    write!(stream, "GET {path} HTTP/1.1\r\nHost: here\r\n\r\n")
}

pub(crate) fn request(stream: &mut TcpStream, path: &str) {
    try_request(stream, path).unwrap();
}

/// The first bytes of an answer; none if the connection was closed.
pub(crate) fn answer(stream: &mut TcpStream) -> String {
    let mut bytes = [0; 2048];
    let count = stream.read(&mut bytes).unwrap_or(0);
    String::from_utf8_lossy(&bytes[..count]).into_owned()
}

/// Whether the other side closes the connection.
fn is_closed(stream: &mut TcpStream) -> bool {
    match stream.read(&mut [0; 64]) {
        Ok(count) => count == 0,
        Err(error) => !matches!(error.kind(), io::ErrorKind::WouldBlock | io::ErrorKind::TimedOut),
    }
}

/// Asks until an answer has these words.
fn until_answered(url: &str, path: &str, words: &str) -> String {
    let started = Instant::now();
    loop {
        let mut stream = connect(url);
        // Whoever has no place is cut off, at times before the request is written.
        let found =
            try_request(&mut stream, path).map_or_else(|error| error.to_string(), |()| answer(&mut stream));
        if found.contains(words) {
            return found;
        }
        assert!(started.elapsed() < PATIENCE, "no '{words}': {found}");
        sleep(milliseconds(50));
    }
}

/// A path to more bytes than the system keeps for whoever does not read, when asked for often.
fn batch(world: &World) -> String {
    let scene = &world.report.scene;
    let layer = &scene.layers[0];
    let centres = (0..layer.forest.levels()).flat_map(|level| layer.forest.diamonds(level));
    let list: Vec<String> = centres.map(Diamond::centre).map(|[x, y]| format!("{x},{y}")).take(380).collect();
    format!("/scenes/{}/{}/{}/points?d={}", scene.name, scene.version, layer.name, list.join(";"))
}

#[test]
fn who_is_slow_to_ask_or_silent_is_cut_off() {
    let world = World::sample(129, 0.0);
    let store = world.folder.path().join("store");
    let limits = Limits { head: milliseconds(400), still: milliseconds(1200), ..Limits::default() };
    let served = serve_within(&[store], limits);
    // A byte now and then is not a request.
    let started = Instant::now();
    let mut dribbling = connect(&served.address);
    dribbling.set_read_timeout(Some(milliseconds(100))).unwrap();
    write!(dribbling, "GET /health HTTP/1.1\r\nHost: ").unwrap();
    let mut is_over = false;
    while !is_over && started.elapsed() < PATIENCE {
        is_over = dribbling.write_all(b"x").is_err() || is_closed(&mut dribbling);
    }
    assert!(is_over && started.elapsed() < milliseconds(5000), "{:?}", started.elapsed());
    // Nor is nothing at all, before the first request or after it.
    for path in [None, Some("/health")] {
        let mut silent = connect(&served.address);
        if let Some(path) = path {
            request(&mut silent, path);
            assert!(answer(&mut silent).contains("200 OK"));
        }
        assert!(is_closed(&mut silent), "{path:?}");
    }
    until_answered(&served.address, "/health", "200 OK");
}

#[test]
fn who_waits_before_asking_again_has_longer_than_a_head() {
    let world = World::sample(129, 0.0);
    let limits = Limits { head: milliseconds(300), still: milliseconds(5000), ..Limits::default() };
    let served = serve_within(&[world.folder.path().join("store")], limits);
    let mut stream = connect(&served.address);
    for _ in 0..3 {
        request(&mut stream, "/health");
        assert!(answer(&mut stream).contains("200 OK"));
        sleep(milliseconds(700));
    }
    // The next head has its own deadline all the same.
    let started = Instant::now();
    stream.write_all(b"GET /hea").unwrap();
    assert!(is_closed(&mut stream) && started.elapsed() < milliseconds(3000), "{:?}", started.elapsed());
}

#[test]
fn an_address_has_so_many_connections_and_no_more() {
    let world = World::sample(129, 0.0);
    let limits = Limits { max_connections_per_address: 2, ..Limits::default() };
    let served = serve_within(&[world.folder.path().join("store")], limits);
    let mut held: Vec<TcpStream> = (0..2).map(|_| connect(&served.address)).collect();
    for stream in &mut held {
        request(stream, "/health");
        assert!(answer(stream).contains("200 OK"));
    }
    let mut third = connect(&served.address);
    // The system may refuse the bytes already.
    if try_request(&mut third, "/health").is_ok() {
        assert_eq!(answer(&mut third), "");
    }
    held.pop();
    until_answered(&served.address, "/health", "200 OK");
    request(&mut held[0], "/health");
    assert!(answer(&mut held[0]).contains("200 OK"), "those who have a place keep it");
}

#[test]
fn without_room_for_an_answer_one_is_told_when_to_come_back() {
    let world = World::sample(513, 0.0);
    let limits = Limits { max_in_flight: 1, still: milliseconds(3000), ..Limits::default() };
    let served = serve_within(&[world.folder.path().join("store")], limits);
    // Asks for megabytes and reads nothing: one answer gets stuck, and the rest wait behind it.
    let mut greedy = connect(&served.address);
    let path = batch(&world);
    let asking = format!("GET {path} HTTP/1.1\r\nHost: here\r\n\r\n");
    greedy.set_write_timeout(Some(milliseconds(500))).unwrap();
    for _ in 0..400 {
        if greedy.write_all(asking.as_bytes()).is_err() {
            break;
        }
    }
    let refused = until_answered(&served.address, "/scenes", "503").to_lowercase();
    assert!(refused.contains("retry-after: 1") && refused.contains("application/problem+json"), "{refused}");
    assert!(refused.contains("access-control-allow-origin: *"), "{refused}");
    // Whoever looks after the server is told all the same that it is well.
    for path in ["/health", "/ready", "/metrics"] {
        let mut caller = connect(&served.address);
        request(&mut caller, path);
        let told = answer(&mut caller);
        assert!(told.contains("200 OK"), "{path}: {told}");
    }
    assert!(until_answered(&served.address, "/scenes", "503").contains("503"), "it was full meanwhile");
    // It is given up in the end, and its place is free.
    until_answered(&served.address, "/scenes", "200 OK");
}

/// Asks for a path on so many streams of HTTP/2 and takes none of the answers: its windows have no room.
fn ask_and_take_nothing(from: &str, address: &str, path: &str, streams: u32) -> TcpStream {
    let frame = |kind: u8, flags: u8, stream: u32, payload: &[u8]| {
        let length = u32::try_from(payload.len()).unwrap().to_be_bytes();
        [&length[1..], &[kind, flags], &stream.to_be_bytes(), payload].concat()
    };
    // SETTINGS_INITIAL_WINDOW_SIZE is 0.
    let settings = frame(4, 0, 0, &[0, 4, 0, 0, 0, 0]);
    let text =
        |name: u8, value: &str| [&[name, u8::try_from(value.len()).unwrap()], value.as_bytes()].concat();
    // GET, http, :path and :authority, neither compressed nor kept (RFC 7541).
    let head = [vec![0x82, 0x86], text(0x04, path), text(0x01, "here")].concat();
    let mut sent = [b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n".to_vec(), settings].concat();
    for stream in 0..streams {
        // The headers are whole, and nothing follows.
        sent.extend(frame(1, 0b101, 2 * stream + 1, &head));
    }
    let mut greedy = connect_from(from, address);
    greedy.write_all(&sent).unwrap();
    greedy
}

#[test]
fn no_number_of_addresses_takes_all_the_room_for_answers() {
    let world = World::sample(513, 0.0);
    let limits = Limits {
        max_connections_per_address: 6,
        max_in_flight: 8,
        still: milliseconds(20_000),
        ..Limits::default()
    };
    let served = serve_within(&[world.folder.path().join("store")], limits);
    let layer = &world.report.scene.layers[0];
    let root = layer.forest.root_diamonds().next().unwrap().centre();
    let path = message::points_route("world", &world.report.scene.version, &layer.name, root);
    let mut refused = 0.0;
    let mut greedy = Vec::new();
    // One alone gets half of the room, and the others half of what is left.
    for (address, taken) in [("127.0.0.1", 4), ("127.0.0.3", 2), ("127.0.0.4", 1)] {
        // A refusal has a body as well, which is not taken, either.
        greedy.push([3, 3].map(|streams| ask_and_take_nothing(address, &served.address, &path, streams)));
        refused += f64::from(6 - taken);
        let started = Instant::now();
        while rejections(&served, "in_flight_of_address") < refused {
            assert!(started.elapsed() < PATIENCE, "{address} was not refused");
            sleep(milliseconds(50));
        }
        let mut again = connect_from(address, &served.address);
        request(&mut again, "/scenes");
        let found = answer(&mut again).to_lowercase();
        assert!(found.contains("503") && found.contains("retry-after: 1"), "{address}: {found}");
        refused += 1.0;
    }
    let mut other = connect_from("127.0.0.2", &served.address);
    request(&mut other, "/scenes");
    let found = answer(&mut other);
    assert!(found.contains("200 OK"), "{found}");
    assert_eq!(rejections(&served, "in_flight_of_address"), refused);
}

/// How many were refused for a limit.
fn rejections(served: &Served, reason: &str) -> f64 {
    metric(served, &format!("diamantina_rejections_total{{reason=\"{reason}\"}}"))
}

#[test]
fn requests_have_no_bodies_and_addresses_an_end() {
    let world = World::sample(129, 0.0);
    for (head, status) in [
        ("GET /health HTTP/1.1\r\n\r\n".to_owned(), "400"),
        ("GET /health HTTP/1.1\r\nHost: here\r\nHost: there\r\n\r\n".to_owned(), "400"),
        ("GET /health HTTP/1.0\r\nHost: here\r\nHost: there\r\n\r\n".to_owned(), "400"),
        ("GET /health HTTP/1.0\r\n\r\n".to_owned(), "200"),
        ("GET /health HTTP/1.1\r\nHost: here\r\nContent-Length: 5\r\n\r\nhello".to_owned(), "413"),
        (
            "GET /health HTTP/1.1\r\nHost: here\r\nTransfer-Encoding: chunked\r\n\r\n0\r\n\r\n".to_owned(),
            "413",
        ),
        (format!("GET /health?{} HTTP/1.1\r\nHost: here\r\n\r\n", "x".repeat(17_000)), "414"),
        (format!("GET /health HTTP/1.1\r\nHost: here\r\nX: {}\r\n\r\n", "x".repeat(40_000)), "431"),
    ] {
        let mut stream = connect(&world.served.address);
        // A server that has seen enough does not take the rest.
        let _ = stream.write_all(head.as_bytes());
        let found = answer(&mut stream);
        let told = found.split_whitespace().nth(1);
        assert!(found.starts_with("HTTP/1.") && told == Some(status), "{status}: {found}");
    }
    // That is counted once the connection has ended.
    let started = Instant::now();
    while ["head", "address"].map(|reason| rejections(&world.served, reason)) != [1.0; 2] {
        assert!(started.elapsed() < PATIENCE, "a head that is too large is not counted");
        sleep(milliseconds(20));
    }
    assert_eq!(rejections(&world.served, "body"), 2.0);
}

#[test]
fn http_2_without_encryption_is_spoken() {
    let world = World::sample(129, 0.0);
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
    runtime.block_on(async {
        let client = crate::world::asker().http2_prior_knowledge().build().unwrap();
        let url = format!("{}{}", world.served.address, batch(&world));
        let answers: Vec<_> = (0..8).map(|_| tokio::spawn(client.get(&url).send())).collect();
        for answer in answers {
            let answer = answer.await.unwrap().unwrap();
            assert_eq!((answer.version(), answer.status().as_u16()), (reqwest::Version::HTTP_2, 200));
            assert!(answer.bytes().await.unwrap().len() > 1000);
        }
    });
}

#[test]
fn a_server_that_stops_says_so_and_ends_its_answers() {
    let world = World::sample(513, 0.0);
    let limits = Limits { shutdown_notice: 2, ..Limits::default() };
    let served = serve_within(&[world.folder.path().join("store")], limits);
    let address = served.address.clone();
    until_answered(&address, "/ready", "200 OK");
    let mut slow = connect(&address);
    let path = batch(&world);
    write!(slow, "GET {path} HTTP/1.1\r\nHost: here\r\nConnection: close\r\n\r\n").unwrap();
    let mut begun = [0; 512];
    slow.read_exact(&mut begun).unwrap();
    drop(served);
    // It still answers, and says that it is no longer to be counted on.
    until_answered(&address, "/ready", "503");
    until_answered(&address, "/health", "200 OK");
    let started = Instant::now();
    while TcpStream::connect(self::address(&address)).is_ok() {
        assert!(started.elapsed() < PATIENCE, "it goes on accepting");
        sleep(milliseconds(50));
    }
    let mut rest = Vec::new();
    slow.read_to_end(&mut rest).unwrap();
    assert!(rest.ends_with(b"0\r\n\r\n"), "the last piece of the answer came");
}
