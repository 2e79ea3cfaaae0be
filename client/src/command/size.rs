//! Bytes as people write them, on the command line.

/// Bytes of a number with a unit: 512MiB, 2GiB, 1500MB. Without one it counts MiB.
///
/// # Errors
/// When it is something else, in words for who wrote it.
pub(super) fn parse_size(text: &str) -> Result<u64, String> {
    let wrong = || format!("'{text}': expected a number with a unit, as in 512MiB or 2GiB");
    let unit_at = text.find(|c: char| c.is_ascii_alphabetic()).unwrap_or(text.len());
    let (number, unit) = text.split_at(unit_at);
    let number: u64 = number.trim_end().parse().map_err(|_| wrong())?;
    let unit = match unit {
        "B" => 1u64,
        "kB" => 1000,
        "KiB" => 1 << 10,
        "MB" => 1_000_000,
        "" | "MiB" => 1 << 20,
        "GB" => 1_000_000_000,
        "GiB" => 1 << 30,
        _ => return Err(wrong()),
    };
    // What is more than an exbibyte is a slip.
    number.checked_mul(unit).filter(|bytes| *bytes < 1 << 60).ok_or_else(wrong)
}

#[cfg(test)]
mod tests {
    use super::parse_size;

    #[test]
    fn numbers_alone_count_mebibytes() {
        let some = [("0", 0), ("1024", 1 << 30), ("256MiB", 256 << 20), ("2 GiB", 2 << 30), ("3kB", 3000)];
        for (text, bytes) in some {
            assert_eq!(parse_size(text), Ok(bytes), "{text}");
        }
        for bad in ["", "MiB", "-1", "1.5GiB", "2TiB", "2gib", "9999999999GiB"] {
            assert!(parse_size(bad).unwrap_err().contains("expected"), "{bad}");
        }
    }
}
