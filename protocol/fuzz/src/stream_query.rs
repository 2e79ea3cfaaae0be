//! The query of a stream: any text asks for one or is an error, and what is asked for comes back when written
//! again.

use diamantina_protocol::message::{SIDES_MAX, StreamAsk, StreamError, parse_stream, stream_route};

/// One input.
pub fn run(data: &[u8]) {
    let Ok(text) = std::str::from_utf8(data) else { return };
    let Ok(ask) = parse(text) else { return };
    assert!(ask.error >= 0.0 && ask.limit != Some(0));
    assert!(ask.bbox.is_none_or(|[x0, y0, x1, y1]| x0 <= x1 && y0 <= y1));
    assert!(ask.view.as_ref().is_none_or(|view| view.angle > 0.0 && view.sides.len() <= SIDES_MAX));
    let route = stream_route("s", "v", "l", &ask);
    let query = route.split_once('?').expect("a stream's route has a query").1;
    assert_eq!(parse(query), Ok(ask));
}

fn parse(query: &str) -> Result<StreamAsk, StreamError> {
    parse_stream(query.split('&').map(|pair| pair.split_once('=').unwrap_or((pair, ""))))
}
