//! The query of a batch: any text is a list of centres or an error, and a list written again is the same.

use diamantina_protocol::message::{BATCH_MAX, batch_route, parse_batch};

/// One input.
pub fn run(data: &[u8]) {
    let Ok(text) = std::str::from_utf8(data) else { return };
    let Ok(centres) = parse_batch(text) else { return };
    assert!((1..=BATCH_MAX).contains(&centres.len()));
    let route = batch_route("s", "v", "l", &centres);
    let query = route.split_once("d=").expect("a batch's route has a query").1;
    assert_eq!(parse_batch(query), Ok(centres));
}
