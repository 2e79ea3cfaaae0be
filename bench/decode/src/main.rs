//! Decodes the diamonds of the benchmark on this machine and writes what `run.mjs` compares with a browser's module.
//!
//! `decode-bench [SECONDS]`: how long each case is measured; 0 for the checksums alone.

use diamantina_decode_bench::{Work, names, sweep};
use std::process::ExitCode;
use std::time::Instant;

/// Diamonds decoded at a time: 3 MB of blocks.
const COPIES: usize = 100;

fn main() -> ExitCode {
    let seconds = std::env::args().nth(1).map_or(Ok(1.0), |text| text.parse::<f64>());
    let Ok(seconds) = seconds else {
        eprintln!("decode-bench: expected a number of seconds");
        return ExitCode::from(2);
    };
    println!("{{\"copies\": {COPIES}, \"cases\": [");
    for (number, name) in names().iter().enumerate() {
        let mut work = Work::new(number);
        let microseconds = if seconds > 0.0 { measure(&mut work, seconds) } else { 0.0 };
        let comma = if number + 1 < names().len() { "," } else { "" };
        println!(
            "  {{\"name\": \"{name}\", \"points\": {}, \"microseconds\": {microseconds:.3}, \"sums\": \"{:016x}\"}}{comma}",
            work.points(),
            sweep(number)
        );
    }
    println!("]}}");
    ExitCode::SUCCESS
}

/// Microseconds a diamond: the middle of as many rounds as fit.
fn measure(work: &mut Work, seconds: f64) -> f64 {
    let (started, mut rounds) = (Instant::now(), Vec::new());
    while rounds.len() < 5 || started.elapsed().as_secs_f64() < seconds {
        work.lay_out(COPIES);
        let round = Instant::now();
        work.decode();
        rounds.push(round.elapsed().as_secs_f64() * 1e6 / COPIES as f64);
    }
    assert!(work.is_right(), "what was decoded is not what was coded");
    rounds.sort_by(f64::total_cmp);
    rounds[rounds.len() / 2]
}
