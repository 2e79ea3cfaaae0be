//! The fuzzers' seeds, and inputs like them, given to every decoder and to a server: what they once found stays mended.

#[allow(unreachable_pub, reason = "a library of its own where it is fuzzed")]
#[path = "../server/fuzz/src/lib.rs"]
mod server_targets;
#[allow(unreachable_pub, reason = "a library of its own where it is fuzzed")]
#[path = "../protocol/fuzz/src/lib.rs"]
mod targets;

use crate::world::workspace;

type Target = (&'static str, fn(&[u8]));

const SERVER_TARGETS: [Target; 2] =
    [("directory", server_targets::directory::run), ("request", server_targets::request::run)];

const TARGETS: [Target; 9] = [
    ("batch_query", targets::batch_query::run),
    ("coverage", targets::coverage::run),
    ("frames", targets::frames::run),
    ("index_page", targets::index_page::run),
    ("points", targets::points::run),
    ("scene", targets::scene::run),
    ("stream_query", targets::stream_query::run),
    ("tin", targets::tin::run),
    ("zone", targets::zone::run),
];

/// Inputs made of each seed.
const VARIANTS: u32 = 400;

/// Of those that a server is asked or a store is written for.
const SERVER_VARIANTS: u32 = 40;

/// Numbers that look random, the same every time (xorshift).
struct Dice(u64);

impl Dice {
    fn below(&mut self, limit: usize) -> usize {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        usize::try_from(self.0 % limit.max(1) as u64).unwrap()
    }

    fn byte(&mut self) -> u8 {
        self.below(256).to_le_bytes()[0]
    }
}

/// The seed with a few bytes changed, put in, taken out, or its end cut off.
fn varied(seed: &[u8], dice: &mut Dice) -> Vec<u8> {
    let mut bytes = seed.to_vec();
    for _ in 0..=dice.below(4) {
        let at = dice.below(bytes.len());
        match dice.below(5) {
            0 => bytes.insert(at, dice.byte()),
            1 if !bytes.is_empty() => drop(bytes.remove(at)),
            2 => bytes.truncate(at),
            3 if !bytes.is_empty() => bytes[at] ^= 1 << dice.below(8),
            _ if !bytes.is_empty() => bytes[at] = dice.byte(),
            _ => bytes.push(dice.byte()),
        }
    }
    bytes
}

#[test]
fn every_decoder_stands_its_seeds_and_what_is_like_them() {
    stand("protocol", &TARGETS, VARIANTS);
}

#[test]
fn a_server_and_a_store_stand_theirs() {
    stand("server", &SERVER_TARGETS, SERVER_VARIANTS);
}

fn stand(package: &str, targets: &[Target], variants: u32) {
    let corpus = workspace().join(package).join("fuzz/corpus");
    for (name, run) in targets {
        let mut seeds: Vec<_> = std::fs::read_dir(corpus.join(name))
            .unwrap_or_else(|e| panic!("{name}: {e}"))
            .map(|entry| entry.unwrap().path())
            .filter(|path| path.file_name().is_some_and(|n| n.to_string_lossy().starts_with("seed-")))
            .collect();
        seeds.sort();
        assert!(seeds.len() >= 2, "{name}: expected seeds, found {seeds:?}");
        for path in seeds {
            let seed = std::fs::read(&path).unwrap();
            run(&seed);
            let mut dice = Dice(0x9E37_79B9_7F4A_7C15);
            for _ in 0..variants {
                run(&varied(&seed, &mut dice));
            }
        }
    }
}

#[test]
fn every_target_is_tried_here() {
    for (package, known) in [("protocol", &TARGETS[..]), ("server", &SERVER_TARGETS)] {
        let targets = workspace().join(package).join("fuzz/fuzz_targets");
        for entry in std::fs::read_dir(targets).unwrap() {
            let name = entry.unwrap().file_name().into_string().unwrap();
            assert!(known.iter().any(|(known, _)| name == format!("{known}.rs")), "{package}: {name}");
        }
    }
}
