//! Writes a large made source for measurements: raw little-endian int16, rows from the north.
//!
//! `cargo run --release -p diamantina-server --example made_source -- 16385 16385 FILE` writes 537 MB. Build
//! it with `diamantina-server build FILE --raw 16385x16385:i16 --cell 30 --nodata -32768 -o STORE`.

use diamantina_server::sample;
use std::fs::File;
use std::io::{BufWriter, Write};
use std::process::ExitCode;

fn main() -> ExitCode {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [width, height, path] = arguments.as_slice() else {
        eprintln!("expected WIDTH HEIGHT FILE");
        return ExitCode::from(2);
    };
    match (width.parse(), height.parse()) {
        (Ok(width), Ok(height)) => match write(width, height, path) {
            Ok(()) => ExitCode::SUCCESS,
            Err(error) => {
                eprintln!("{path}: {error}");
                ExitCode::FAILURE
            }
        },
        _ => {
            eprintln!("expected whole numbers of samples");
            ExitCode::from(2)
        }
    }
}

fn write(width: u32, height: u32, path: &str) -> std::io::Result<()> {
    let mut out = BufWriter::with_capacity(1 << 20, File::create(path)?);
    // The landscape at its own scale, however large the source: 2048 cells are one.
    let place = |cells: u32| f64::from(cells) / 2048.0;
    for row in 0..height {
        for column in 0..width {
            let metres = sample::height(place(column), place(height - 1 - row));
            #[allow(clippy::cast_possible_truncation, reason = "heights of the landscape are below 9000 m")]
            let value = metres.map_or(i16::MIN, |h| h.round() as i16);
            out.write_all(&value.to_le_bytes())?;
        }
    }
    out.flush()
}
