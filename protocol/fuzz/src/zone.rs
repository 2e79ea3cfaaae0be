//! Zones: any bytes are masks or an error, and masks written again are the same bytes.

use diamantina_protocol::bintree::Forest;
use diamantina_protocol::zone;

/// One input.
pub fn run(data: &[u8]) {
    let [layers, bytes @ ..] = data else { return };
    let precise = Forest::new(5, 2, [1, 1]).and_then(|f| f.with_precision(3));
    let forests = [Forest::new(6, 2, [2, 1]), precise].map(|f| f.expect("within the documented limits"));
    let forests = &forests[..usize::from(*layers % 3)];
    let Ok(masks) = zone::decode(forests, bytes) else { return };
    assert_eq!(zone::encode(&masks), bytes);
}
