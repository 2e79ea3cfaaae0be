//! A proxy that spoils answers: what a bad network, balancer or cache on the way may do to them.
//!
//! Each answer is had whole from the server, on a connection of its own, and then handed on, spoilt or not. Which trick is
//! played on it follows from the seed and from how many answers came before. Of three answers in a row one is left alone, so
//! that whoever asks again gets on. Descriptions of scenes are never garbled, for they have no checksum: they are cut off
//! instead.

use crate::world::Dice;
use std::io::{self, BufRead, BufReader, Read, Write};
use std::net::{TcpListener, TcpStream};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Condvar, Mutex};
use std::time::Duration;

/// What is done to an answer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Trick {
    /// It comes late.
    Late,
    /// Another one, on another connection, comes first.
    Overtaken,
    /// The connection is closed in the middle of it.
    Cut,
    /// It ends early, and its head says that this is all.
    Short,
    /// Some of its bytes are others.
    Garbled,
    /// Something comes that is no answer at all.
    Noise,
    /// Somebody on the way answers instead.
    Refused,
}

const TRICKS: [Trick; 7] =
    [Trick::Late, Trick::Overtaken, Trick::Cut, Trick::Short, Trick::Garbled, Trick::Noise, Trick::Refused];

/// The longest that an answer is late, or waits for another one.
const LATE: Duration = Duration::from_millis(250);

/// The proxy. Its threads end with the process.
pub(crate) struct Rough {
    /// `http://127.0.0.1:PORT`.
    pub(crate) address: String,
    road: Arc<Road>,
}

struct Road {
    upstream: String,
    seed: u64,
    /// Answers so far.
    answers: AtomicU64,
    /// Of each trick, how often it was played.
    played: [AtomicU64; TRICKS.len()],
    /// Answers that have been handed on.
    passed: Mutex<u64>,
    moved: Condvar,
}

struct Answer {
    /// The status line and the headers that are handed on.
    head: Vec<String>,
    body: Vec<u8>,
}

impl Rough {
    /// Starts a proxy before the server at `http://HOST:PORT`.
    pub(crate) fn start(upstream: &str, seed: u64) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let address = format!("http://{}", listener.local_addr().unwrap());
        let road = Arc::new(Road {
            upstream: upstream.strip_prefix("http://").unwrap().to_owned(),
            seed,
            answers: AtomicU64::new(0),
            played: Default::default(),
            passed: Mutex::new(0),
            moved: Condvar::new(),
        });
        let all = Arc::clone(&road);
        std::thread::spawn(move || {
            for client in listener.incoming().flatten() {
                let road = Arc::clone(&all);
                // A connection that fails is closed, which is how its client learns of it.
                std::thread::spawn(move || road.carry(client));
            }
        });
        Self { address, road }
    }

    /// The tricks, and how often each was played.
    pub(crate) fn played(&self) -> Vec<(Trick, u64)> {
        TRICKS.into_iter().zip(self.road.played.iter().map(|count| count.load(Ordering::Relaxed))).collect()
    }
}

/// The lines of a head; `None` where nothing comes.
fn head(from: &mut impl BufRead) -> io::Result<Option<Vec<String>>> {
    let mut lines = Vec::new();
    loop {
        let mut line = String::new();
        if from.read_line(&mut line)? == 0 {
            return Ok(None);
        }
        match line.trim_end() {
            "" => return Ok(Some(lines)),
            line => lines.push(line.to_owned()),
        }
    }
}

fn is_header(line: &str, name: &str) -> bool {
    line.split_once(':').is_some_and(|(found, _)| found.eq_ignore_ascii_case(name))
}

impl Road {
    fn carry(&self, mut client: TcpStream) -> io::Result<()> {
        client.set_nodelay(true)?;
        let mut asked = BufReader::new(client.try_clone()?);
        while let Some(request) = head(&mut asked)? {
            let answer = self.ask(&request)?;
            if !self.hand_on(&mut client, answer)? {
                break;
            }
        }
        Ok(())
    }

    /// The server's whole answer. Asked in HTTP/1.0 it sends it in one piece, and closes behind it.
    fn ask(&self, request: &[String]) -> io::Result<Answer> {
        let mut server = TcpStream::connect(&self.upstream)?;
        let first = request.first().map_or("", |line| line.trim_end_matches("HTTP/1.1"));
        let mut text = format!("{first}HTTP/1.0\r\n");
        for line in request.iter().skip(1).filter(|line| !is_header(line, "connection")) {
            text += &format!("{line}\r\n");
        }
        server.write_all(format!("{text}\r\n").as_bytes())?;
        let mut reader = BufReader::new(server);
        let mut head = head(&mut reader)?.ok_or(io::ErrorKind::UnexpectedEof)?;
        let mut body = Vec::new();
        reader.read_to_end(&mut body)?;
        head.retain(|line| !["connection", "content-length"].into_iter().any(|name| is_header(line, name)));
        head[0] = head[0].replacen("HTTP/1.0", "HTTP/1.1", 1);
        Ok(Answer { head, body })
    }

    /// What is played on the answer of this number.
    fn trick(&self, number: u64, dice: &mut Dice, answer: &Answer) -> Option<Trick> {
        if number % 3 == 2 || dice.roll() > 0.8 {
            return None;
        }
        // In turn, so that none is left out where answers are few.
        let turn = number - number / 3 + 3 * self.seed;
        let trick = TRICKS[(turn % TRICKS.len() as u64) as usize];
        let is_json = answer.head.iter().any(|line| is_header(line, "content-type") && line.contains("json"));
        Some(if trick == Trick::Garbled && is_json { Trick::Cut } else { trick })
    }

    /// Hands an answer on; whether the connection is still of use.
    fn hand_on(&self, client: &mut TcpStream, mut answer: Answer) -> io::Result<bool> {
        let number = self.answers.fetch_add(1, Ordering::Relaxed);
        let mut dice = Dice(self.seed ^ number.wrapping_mul(0x2545_F491_4F6C_DD1D));
        let trick = self.trick(number, &mut dice, &answer);
        if let Some(trick) = trick {
            self.played[trick as usize].fetch_add(1, Ordering::Relaxed);
        }
        let length = answer.body.len();
        let mut told = length;
        match trick {
            Some(Trick::Late) => std::thread::sleep(LATE.mul_f64(dice.roll())),
            Some(Trick::Overtaken) => self.wait_for_another(),
            Some(Trick::Cut) => answer.body.truncate(dice.below(1 + length as u64) as usize),
            Some(Trick::Short) => {
                answer.body.truncate(dice.below(1 + length as u64) as usize);
                told = answer.body.len();
            }
            Some(Trick::Garbled) => garble(&mut answer.body, &mut dice),
            Some(Trick::Noise) => {
                let noise: Vec<u8> = (0..200).map(|_| dice.next() as u8).collect();
                client.write_all(&noise)?;
                return Ok(false);
            }
            Some(Trick::Refused) => {
                answer.head =
                    vec!["HTTP/1.1 502 Bad Gateway".to_owned(), "Content-Type: text/html".to_owned()];
                answer.body = b"<html>The balancer found nobody.</html>".to_vec();
                told = answer.body.len();
            }
            None => {}
        }
        let mut bytes = answer.head.join("\r\n").into_bytes();
        bytes.extend(format!("\r\nContent-Length: {told}\r\n\r\n").into_bytes());
        bytes.extend(&answer.body);
        client.write_all(&bytes)?;
        *self.passed.lock().unwrap() += 1;
        self.moved.notify_all();
        Ok(answer.body.len() == told)
    }

    fn wait_for_another(&self) {
        let passed = self.passed.lock().unwrap();
        let before = *passed;
        let waited = self.moved.wait_timeout_while(passed, LATE, |passed| *passed == before);
        drop(waited);
    }
}

/// Makes up to 64 bytes in a row others than they were.
fn garble(body: &mut [u8], dice: &mut Dice) {
    if body.is_empty() {
        return;
    }
    let start = dice.below(body.len() as u64) as usize;
    let end = body.len().min(start + 1 + dice.below(64) as usize);
    for byte in &mut body[start..end] {
        *byte ^= 1 + dice.below(255) as u8;
    }
}
