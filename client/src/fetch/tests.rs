//! The fetcher against a server that fails in every way.

#![allow(clippy::cast_possible_truncation, reason = "small numbers")]

use super::*;
use crate::world::{Faults, Served, world};
use diamantina_protocol::message;
use std::time::Instant;

fn wants(level: u32) -> Vec<Want> {
    let built = &world()[0];
    let diamonds = built.layer.forest.diamonds(level).filter(|d| built.entries[d].bytes > 0);
    diamonds.map(|d| Want { key: Key::Diamond(0, d), bytes: Some(built.entries[&d].bytes) }).collect()
}

/// Events until `count` have come or some seconds have passed.
fn events(fetcher: &mut Fetcher, count: usize) -> Vec<Event> {
    let until = Instant::now() + Duration::from_secs(20);
    let mut list = Vec::new();
    while list.len() < count && Instant::now() < until {
        match fetcher.poll() {
            Some(event) => list.push(event),
            None => std::thread::sleep(Duration::from_millis(1)),
        }
    }
    list
}

#[test]
fn what_arrived_is_not_fetched_again_until_it_is_wished_for_knowingly() {
    let served = Served::start(1, Faults::default());
    let (mut fetcher, _) = Fetcher::open(&served.url, &Options::default()).unwrap();
    let wants = wants(4);
    fetcher.wish(wants.clone());
    // Wishes by an author who has not looked at the arrivals yet.
    for _ in 0..100 {
        fetcher.wish(wants.clone());
        std::thread::sleep(Duration::from_millis(2));
    }
    assert_eq!(fetcher.traffic().requests, 2, "the scene and one batch");
    let arrived = events(&mut fetcher, wants.len());
    for (want, event) in wants.iter().zip(&arrived) {
        let Event::Payload(0, d, payload) = event else { panic!("{event:?}") };
        assert_eq!(Key::Diamond(0, *d), want.key, "in the order of the wishes");
        assert_eq!(payload, &world()[0].payloads[d]);
    }
    fetcher.wish(wants[..3].to_vec());
    assert_eq!(events(&mut fetcher, 3).len(), 3, "now its author means it");
    assert_eq!(fetcher.traffic().round_trips, 3);
}

#[test]
fn requests_that_nobody_wants_any_more_are_dropped() {
    let served = Served::start(1, Faults { slow: 1.0, ..Faults::default() });
    let (mut fetcher, _) = Fetcher::open(&served.url, &Options::default()).unwrap();
    fetcher.wish(wants(9));
    std::thread::sleep(Duration::from_millis(200));
    let flights = fetcher.shared.lock().flights.len();
    assert!(flights > 1);
    fetcher.wish(Vec::new());
    std::thread::sleep(Duration::from_millis(200));
    assert_eq!(fetcher.shared.lock().flights.len(), 0);
    assert!(fetcher.shared.lock().flying.is_empty());
    assert_eq!(fetcher.traffic().cancelled, flights as u64);
}

#[test]
fn of_eight_requests_half_may_be_for_diamonds_and_one_is() {
    // More than this forest has: the server will be silent anyway.
    let pages: Vec<Want> = (0..8).map(|page| Want { key: Key::Page(0, page), bytes: None }).collect();
    // Each said to fill a batch.
    let diamonds: Vec<Want> =
        wants(9).into_iter().map(|want| Want { bytes: Some(BATCH_BYTES as u32), ..want }).collect();
    assert!(diamonds.len() >= 8);
    for (wishes, batches) in
        [([diamonds.clone(), pages.clone()].concat(), 4), ([pages, diamonds].concat(), 1)]
    {
        // Silent, so that what was sent stays in flight.
        let served = Served::start(1, Faults::default());
        let (mut fetcher, _) = Fetcher::open(&served.url, &Options::default()).unwrap();
        served.misbehave(Faults { silent: 1.0, ..Faults::default() });
        fetcher.wish(wishes);
        let until = Instant::now() + Duration::from_secs(20);
        while fetcher.shared.lock().flights.len() < 8 && Instant::now() < until {
            std::thread::sleep(Duration::from_millis(1));
        }
        let state = fetcher.shared.lock();
        let flying = state.flying.keys().filter(|key| matches!(key, Key::Diamond(..))).count();
        assert_eq!((state.flights.len(), flying), (8, batches));
    }
}

#[test]
fn what_is_for_later_has_a_quarter_of_the_requests_and_never_the_turn_of_what_presses() {
    let each: Vec<Want> =
        wants(9).into_iter().map(|want| Want { bytes: Some(BATCH_BYTES as u32), ..want }).collect();
    assert!(each.len() >= 8);
    let served = Served::start(1, Faults::default());
    let (mut fetcher, _) = Fetcher::open(&served.url, &Options::default()).unwrap();
    served.misbehave(Faults { silent: 1.0, ..Faults::default() });
    let flying = |fetcher: &mut Fetcher, least: usize| {
        let until = Instant::now() + Duration::from_secs(20);
        while fetcher.shared.lock().flying.len() < least && Instant::now() < until {
            std::thread::sleep(Duration::from_millis(1));
        }
        // A task more would have taken something by now.
        std::thread::sleep(Duration::from_millis(50));
        fetcher.shared.lock().flying.keys().copied().collect::<HashSet<Key>>()
    };
    // All is for later.
    fetcher.wish_ahead(each[4..].to_vec(), 0);
    assert_eq!(flying(&mut fetcher, 2), HashSet::from([each[4].key, each[5].key]));
    // Something presses: it has the requests that were kept for it.
    fetcher.wish_ahead(each.clone(), 4);
    let keys = flying(&mut fetcher, 4);
    assert_eq!(keys, HashSet::from([each[0].key, each[1].key, each[4].key, each[5].key]));
}

#[test]
fn batches_stay_within_their_limits() {
    let served = Served::start(1, Faults::default());
    let (mut fetcher, _) = Fetcher::open(&served.url, &Options::default()).unwrap();
    // The server of the tests panics, and so answers nothing, where a batch is too long.
    let wants = wants(9);
    fetcher.wish(wants.clone());
    assert_eq!(events(&mut fetcher, wants.len()).len(), wants.len());
    let requests = fetcher.traffic().requests as usize - 1;
    assert!(requests >= wants.len().div_ceil(message::BATCH_MAX) && requests <= 2 + wants.len() / 200);
    assert_eq!(fetcher.traffic().errors, 0);
}

#[test]
fn a_wish_that_keeps_failing_is_reported_and_rests() {
    let served = Served::start(1, Faults { status_500: 1.0, ..Faults::default() });
    let (mut fetcher, _) = Fetcher::open(&served.url, &Options::default()).unwrap();
    fetcher.wish(vec![wants(4)[0], Want { key: Key::Page(0, 0), bytes: None }]);
    let mut reported = events(&mut fetcher, 1);
    // The other has failed as often a moment later, but nobody has been told of it.
    std::thread::sleep(Duration::from_millis(300));
    assert!(!fetcher.is_stuck());
    reported.extend(events(&mut fetcher, 1));
    assert!(reported.iter().all(|event| matches!(event, Event::Failed(..))), "{reported:?}");
    assert!(fetcher.is_stuck());
    assert_eq!(fetcher.traffic().requests, 1 + 2 * u64::from(TRIES_MAX));
}

#[test]
fn a_page_that_is_a_bomb_is_refused() {
    let served = Served::start(1, Faults { bomb: 1.0, ..Faults::default() });
    let (mut fetcher, _) = Fetcher::open(&served.url, &Options::default()).unwrap();
    fetcher.wish(vec![Want { key: Key::Page(0, 0), bytes: None }]);
    let reported = events(&mut fetcher, 1);
    let [Event::Failed(Key::Page(0, 0), error)] = reported.as_slice() else { panic!("{reported:?}") };
    assert!(error.to_string().contains("does not decompress"), "{error}");
}

#[test]
fn no_server_is_said_plainly() {
    let error = Fetcher::open("http://127.0.0.1:9", &Options::default()).unwrap_err().to_string();
    assert!(error.contains("is the server running"), "{error}");
}
