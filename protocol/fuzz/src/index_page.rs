//! Pages of the index: any bytes are a page or an error, and a page written again is the same page.

use diamantina_protocol::bintree::Forest;
use diamantina_protocol::index;

/// One input.
pub fn run(data: &[u8]) {
    let [page, bytes @ ..] = data else { return };
    let forest = Forest::new(8, 2, [2, 1]).expect("within the documented limits");
    let Ok(entries) = index::decode(&forest, u32::from(*page), bytes) else { return };
    let list: Vec<_> = entries.iter().map(|(_, entry)| *entry).collect();
    let again = index::decode(&forest, u32::from(*page), &index::encode(&list));
    assert_eq!(again.as_ref(), Ok(&entries));
}
