//! A queue of vertices, the least key first, whose keys may change: a heap of four branches that knows where each
//! vertex stands. Of equal keys the lower number comes first, so that the order is the same on every run.

/// Branches of the heap: fewer levels than with two, and siblings share a cache line.
const BRANCHES: usize = 4;

const OUT: u32 = u32::MAX;

/// Vertices by key. Takes 12 bytes a vertex.
#[derive(Debug)]
pub(super) struct Queue {
    /// Key above, vertex below.
    heap: Vec<u64>,
    place: Vec<u32>,
}

/// Numbers that sort as the keys, none of which is negative, do.
fn rank(key: f32, v: u32) -> u64 {
    u64::from(key.max(0.0).to_bits()) << 32 | u64::from(v)
}

#[allow(clippy::cast_possible_truncation, reason = "the vertex is the lower half")]
fn vertex(rank: u64) -> u32 {
    rank as u32
}

impl Queue {
    /// An empty queue for vertices below `count`.
    pub(super) fn new(count: usize) -> Self {
        Self { heap: Vec::with_capacity(count), place: vec![OUT; count] }
    }

    /// Takes the vertex of the least key.
    pub(super) fn pop(&mut self) -> Option<(f32, u32)> {
        let top = *self.heap.first()?;
        self.remove(vertex(top));
        #[allow(clippy::cast_possible_truncation, reason = "the key is the upper half")]
        let key = f32::from_bits((top >> 32) as u32);
        Some((key, vertex(top)))
    }

    /// Puts a vertex in, or gives it another key.
    pub(super) fn set(&mut self, v: u32, key: f32) {
        let rank = rank(key, v);
        let at = self.place[v as usize];
        if at == OUT {
            self.heap.push(rank);
            self.up(self.heap.len() - 1);
            return;
        }
        let at = at as usize;
        let before = std::mem::replace(&mut self.heap[at], rank);
        if rank < before { self.up(at) } else { self.down(at) }
    }

    /// Takes a vertex out, if it is in.
    pub(super) fn remove(&mut self, v: u32) {
        let at = self.place[v as usize] as usize;
        let Some(last) = self.heap.pop() else { return };
        if self.place[v as usize] == OUT {
            self.heap.push(last);
            return;
        }
        self.place[v as usize] = OUT;
        if at < self.heap.len() {
            let before = std::mem::replace(&mut self.heap[at], last);
            if last < before { self.up(at) } else { self.down(at) }
        }
    }

    fn put(&mut self, at: usize, rank: u64) {
        self.heap[at] = rank;
        self.place[vertex(rank) as usize] = u32::try_from(at).unwrap_or(OUT);
    }

    fn up(&mut self, mut at: usize) {
        let rank = self.heap[at];
        while at > 0 {
            let above = (at - 1) / BRANCHES;
            if self.heap[above] <= rank {
                break;
            }
            self.put(at, self.heap[above]);
            at = above;
        }
        self.put(at, rank);
    }

    fn down(&mut self, mut at: usize) {
        let rank = self.heap[at];
        loop {
            let first = at * BRANCHES + 1;
            let below = self.heap.get(first..(first + BRANCHES).min(self.heap.len())).unwrap_or_default();
            let Some((i, least)) = below.iter().copied().enumerate().min_by_key(|(_, rank)| *rank) else {
                break;
            };
            if rank <= least {
                break;
            }
            self.put(at, least);
            at = first + i;
        }
        self.put(at, rank);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn vertices_come_by_key_whatever_was_changed(
            changes in prop::collection::vec((0u32..40, prop::option::of(0u32..9)), 0..200),
        ) {
            let mut queue = Queue::new(40);
            let mut keys = std::collections::BTreeMap::new();
            for (v, key) in changes {
                match key {
                    Some(key) => {
                        queue.set(v, key as f32);
                        keys.insert(v, key);
                    }
                    None => {
                        queue.remove(v);
                        keys.remove(&v);
                    }
                }
            }
            let mut expected: Vec<(u32, u32)> = keys.into_iter().map(|(v, key)| (key, v)).collect();
            expected.sort_unstable();
            let expected: Vec<(f32, u32)> = expected.into_iter().map(|(key, v)| (key as f32, v)).collect();
            let popped: Vec<(f32, u32)> = std::iter::from_fn(|| queue.pop()).collect();
            prop_assert_eq!(popped, expected);
        }
    }
}
