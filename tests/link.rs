//! A shaped link: a proxy on this machine through which a server seems far away, behind a slow line.
//!
//! ```text
//!            ┌── up ───► one line for all connections ──► half a round trip ──┐
//!  client ◄══╡                                                                ╞══► server
//!            └── half a round trip ◄── one line for all connections ◄── down ─┘
//! ```
//!
//! What a user far away pays is all there: the line's rate, shared by all connections, headers included; half the
//! round trip each way; a round trip to set a connection up; and TCP's slow start, so a fresh connection sends ten
//! segments in its first round trip and twice as many in each further one. Left out are losses, jitter,
//! acknowledgements' own bytes and the slow start after a pause. No rights are needed, and nothing of the system is
//! changed: it is nothing but sockets of 127.0.0.1.
//!
//! The line is a clock that says when it is free again. Whoever has a segment to send moves that clock on by the
//! time which the segment takes, so connections take turns, and nothing that sleeps too long makes the line slower.

use std::collections::VecDeque;
use std::io::{Read, Write};
use std::net::{Shutdown, TcpListener, TcpStream};
use std::sync::{Arc, Mutex, PoisonError, mpsc};
use std::time::{Duration, Instant};

/// Bytes that a full segment carries: an Ethernet frame's 1500 less the headers of IPv4 and TCP with timestamps.
const SEGMENT_BYTES: usize = 1448;

/// Bytes that a segment takes on the line besides: Ethernet 14, IPv4 20, TCP 32.
const HEADER_BYTES: usize = 66;

/// What a connection may have under way at first (RFC 6928).
const WINDOW_BYTES: usize = 10 * SEGMENT_BYTES;

/// What it may have under way at last: about what systems set aside for a socket.
const WINDOW_BYTES_MAX: usize = 4 << 20;

/// The least that may wait for the line, in segments.
const QUEUE_MIN: f64 = 16.0;

/// How a link is shaped, alike in both directions.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Shape {
    /// Bits a second, headers included; above 0.
    pub(crate) bits_per_second: f64,
    /// From a byte sent to its answer, besides what the bytes take.
    pub(crate) round_trip: Duration,
}

impl Shape {
    /// How long bytes occupy the line, in full segments but for the last.
    pub(crate) fn time(&self, bytes: usize) -> Duration {
        let wire = bytes + bytes.div_ceil(SEGMENT_BYTES) * HEADER_BYTES;
        Duration::from_secs_f64(wire as f64 * 8.0 / self.bits_per_second)
    }

    /// What may wait for the line, as time: what the link holds in a round trip, which is what routers are given.
    fn queue(&self) -> Duration {
        self.round_trip.max(self.time(SEGMENT_BYTES).mul_f64(QUEUE_MIN))
    }

    /// Segments that a connection may have in the queue and on their way, twice over: small ones count as whole.
    fn segments_max(&self) -> usize {
        let under_way =
            (self.queue() + self.round_trip).as_secs_f64() / self.time(SEGMENT_BYTES).as_secs_f64();
        // Saturates; a connection's window is the bound where the line is fast.
        (under_way.ceil() as usize * 2).clamp(64, WINDOW_BYTES_MAX / SEGMENT_BYTES)
    }
}

/// A shaped link to a server. Its threads end with the process.
pub(crate) struct Link {
    /// `http://127.0.0.1:PORT`.
    pub(crate) address: String,
}

impl Link {
    /// Starts a link to `upstream`, `http://HOST:PORT`, on a free port.
    pub(crate) fn start(upstream: &str, shape: Shape) -> std::io::Result<Self> {
        let upstream = upstream.strip_prefix("http://").unwrap_or(upstream).to_owned();
        let listener = TcpListener::bind("127.0.0.1:0")?;
        let address = format!("http://{}", listener.local_addr()?);
        let (up, down) = (Arc::new(Line::new(shape)), Arc::new(Line::new(shape)));
        std::thread::spawn(move || {
            for client in listener.incoming() {
                // A connection that fails here is closed, which is how its client learns of it.
                let _ = client.and_then(|client| connect(client, &upstream, &up, &down));
            }
        });
        Ok(Self { address })
    }
}

/// Joins a client to the server by two pumps.
fn connect(client: TcpStream, upstream: &str, up: &Arc<Line>, down: &Arc<Line>) -> std::io::Result<()> {
    let server = TcpStream::connect(upstream)?;
    // Nothing but the link delays a segment.
    client.set_nodelay(true)?;
    server.set_nodelay(true)?;
    // The client has written already, for its system answered at once: in truth it would wait for that answer.
    let open = Instant::now() + up.shape.round_trip;
    pump([client.try_clone()?, server.try_clone()?], Arc::clone(up), open)?;
    pump([server, client], Arc::clone(down), open)
}

/// Carries bytes from one socket to another, on two threads: one puts them on the line, one hands them out when they
/// arrive.
fn pump([mut from, mut to]: [TcpStream; 2], line: Arc<Line>, open: Instant) -> std::io::Result<()> {
    let (sender, arrivals) = mpsc::sync_channel::<(Instant, Vec<u8>)>(line.shape.segments_max());
    let source = from.try_clone()?;
    std::thread::spawn(move || {
        for (arrives, bytes) in arrivals {
            sleep_until(arrives);
            if to.write_all(&bytes).is_err() {
                // Nobody listens: the other side learns of it, and the thread that reads from there ends.
                let _ = source.shutdown(Shutdown::Both);
                break;
            }
        }
        let _ = to.shutdown(Shutdown::Write);
    });
    std::thread::spawn(move || {
        let half = line.shape.round_trip / 2;
        let (mut buffer, mut window) = ([0; SEGMENT_BYTES], Window::default());
        while let Ok(count @ 1..) = from.read(&mut buffer) {
            sleep_until(open);
            window.wait(count);
            let left = line.take(count);
            window.note(count, left + half + half);
            if sender.send((left + half, buffer[..count].to_vec())).is_err() {
                break;
            }
            // So that no more waits for the line than its queue holds.
            if let Some(room) = left.checked_sub(line.shape.queue()) {
                sleep_until(room);
            }
        }
    });
    Ok(())
}

fn sleep_until(when: Instant) {
    std::thread::sleep(when.saturating_duration_since(Instant::now()));
}

/// One direction of a link.
struct Line {
    shape: Shape,
    /// When all that has been put on it has left.
    free: Mutex<Instant>,
}

impl Line {
    fn new(shape: Shape) -> Self {
        Self { shape, free: Mutex::new(Instant::now()) }
    }

    /// Puts a segment on the line, behind all others; when it has left.
    fn take(&self, bytes: usize) -> Instant {
        // A time is whole at any moment, whoever panicked.
        let mut free = self.free.lock().unwrap_or_else(PoisonError::into_inner);
        *free = Instant::now().max(*free) + self.shape.time(bytes);
        *free
    }
}

/// What one connection may have under way in one direction.
struct Window {
    bytes: usize,
    flying: usize,
    /// Bytes under way, and when their sender knows that they have arrived.
    segments: VecDeque<(usize, Instant)>,
}

impl Default for Window {
    fn default() -> Self {
        Self { bytes: WINDOW_BYTES, flying: 0, segments: VecDeque::new() }
    }
}

impl Window {
    /// Waits until a segment may be sent.
    fn wait(&mut self, bytes: usize) {
        while let Some((count, known)) = self.segments.front().copied() {
            if self.flying + bytes <= self.bytes && known > Instant::now() {
                return;
            }
            sleep_until(known);
            // As long as the window is what holds the sender back, each byte that arrived makes room for two.
            if 2 * self.flying > self.bytes {
                self.bytes = (self.bytes + count).min(WINDOW_BYTES_MAX);
            }
            self.flying -= count;
            self.segments.pop_front();
        }
    }

    fn note(&mut self, bytes: usize, known: Instant) {
        self.flying += bytes;
        self.segments.push_back((bytes, known));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Answers four bytes, a number, with as many bytes, again and again on each connection.
    fn source() -> String {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let address = format!("http://{}", listener.local_addr().unwrap());
        std::thread::spawn(move || {
            for client in listener.incoming() {
                std::thread::spawn(move || {
                    let (mut client, mut asked) = (client.unwrap(), [0; 4]);
                    while client.read_exact(&mut asked).is_ok() {
                        if client.write_all(&answer(u32::from_le_bytes(asked) as usize)).is_err() {
                            break;
                        }
                    }
                });
            }
        });
        address
    }

    fn answer(bytes: usize) -> Vec<u8> {
        (0..bytes).map(|i| (i % 251) as u8).collect()
    }

    fn open(link: &Link) -> TcpStream {
        TcpStream::connect(link.address.strip_prefix("http://").unwrap()).unwrap()
    }

    /// Asks for bytes and checks them; the seconds it took.
    fn ask(connection: &mut TcpStream, bytes: usize) -> f64 {
        let started = Instant::now();
        connection.write_all(&(bytes as u32).to_le_bytes()).unwrap();
        let mut got = vec![0; bytes];
        connection.read_exact(&mut got).unwrap();
        assert!(got == answer(bytes), "the bytes arrive as they were sent");
        started.elapsed().as_secs_f64()
    }

    fn link(bits_per_second: f64, milliseconds: u64) -> (Link, Shape) {
        let shape = Shape { bits_per_second, round_trip: Duration::from_millis(milliseconds) };
        (Link::start(&source(), shape).unwrap(), shape)
    }

    /// Beyond what a link owes, a busy machine may add this: half again, and a second.
    fn assert_owed(what: &str, seconds: f64, owed: f64) {
        println!("{what}: {seconds:.3} s, by the link's arithmetic {owed:.3} s");
        assert!(seconds >= 0.98 * owed, "{what} in {seconds} s: not before {owed} s");
        assert!(seconds <= 1.5 * owed + 1.0, "{what} in {seconds} s: expected about {owed} s");
    }

    #[test]
    fn the_rate_is_what_was_asked_and_shared_by_all_connections() {
        const BYTES: usize = 600_000;
        for connections in [1, 4] {
            let (link, shape) = link(8e6, 10);
            let started = Instant::now();
            std::thread::scope(|scope| {
                for _ in 0..connections {
                    scope.spawn(|| ask(&mut open(&link), BYTES / connections));
                }
            });
            // A round trip to set up, one to ask, and the bytes.
            let owed = shape.time(BYTES) + shape.round_trip * 2;
            assert_owed(
                &format!("{connections} connections"),
                started.elapsed().as_secs_f64(),
                owed.as_secs_f64(),
            );
        }
    }

    #[test]
    fn connections_take_turns() {
        let (link, shape) = link(8e6, 10);
        std::thread::scope(|scope| {
            scope.spawn(|| ask(&mut open(&link), 800_000));
            let (mut small, started) = (open(&link), Instant::now());
            ask(&mut small, 100_000);
            let seconds = started.elapsed().as_secs_f64();
            let alone = shape.time(100_000).as_secs_f64();
            println!("beside a long answer: {seconds:.3} s, alone {alone:.3} s");
            // Not behind all of the long one, which takes 0.84 s.
            assert!(seconds < shape.time(800_000).as_secs_f64(), "{seconds}");
        });
    }

    #[test]
    fn the_round_trip_is_what_was_asked_and_a_connection_costs_one_more() {
        let (link, shape) = link(100e6, 120);
        let trip = shape.round_trip.as_secs_f64();
        let mut connection = open(&link);
        assert_owed("set-up and a question", ask(&mut connection, 1), 2.0 * trip);
        assert_owed("a question", ask(&mut connection, 1), trip);
        assert_owed("a question", ask(&mut connection, WINDOW_BYTES), trip);
    }

    #[test]
    fn a_fresh_connection_doubles_what_it_sends_each_round_trip() {
        let (link, shape) = link(1e9, 100);
        let trip = shape.round_trip.as_secs_f64();
        let mut connection = open(&link);
        // 10 + 20 + 40 + 80 segments hold 100.
        assert_owed(
            "set-up, a question, three more trips",
            ask(&mut connection, 100 * SEGMENT_BYTES),
            5.0 * trip,
        );
        assert_owed("again, in the window that it has now", ask(&mut connection, 40 * SEGMENT_BYTES), trip);
    }

    #[test]
    fn who_does_not_read_holds_the_sender_back_and_who_leaves_ends_it() {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let shape = Shape { bits_per_second: 4e9, round_trip: Duration::from_millis(1) };
        let link = Link::start(&listener.local_addr().unwrap().to_string(), shape).unwrap();
        let client = open(&link);
        let (mut server, _) = listener.accept().unwrap();
        server.set_write_timeout(Some(Duration::from_millis(500))).unwrap();
        let (piece, mut sent) = (vec![0; 1 << 16], 0);
        while let Ok(count) = server.write(&piece) {
            sent += count;
            // Four buffers of the system, and what the link holds.
            assert!(sent < 100 << 20, "{sent} bytes for nobody");
        }
        println!("{sent} bytes, then it waits");
        drop(client);
        server.set_write_timeout(None).unwrap();
        let until = Instant::now() + Duration::from_secs(20);
        while server.write_all(&piece).is_ok() {
            assert!(Instant::now() < until, "the server is not told that its client has left");
        }
    }
}
