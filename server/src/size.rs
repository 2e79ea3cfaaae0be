//! Bytes as people write them.

/// Bytes with an optional unit: 512MiB, 2GiB, 1500000000.
///
/// # Errors
/// When it is no number, has another unit, or is more than 64 bits hold; in words for who wrote it.
pub fn parse_bytes(text: &str) -> Result<u64, String> {
    let digits = text.find(|c: char| !c.is_ascii_digit()).unwrap_or(text.len());
    let (number, unit) = text.split_at(digits);
    let scale = match unit.trim() {
        "" | "B" => 1u64,
        "KiB" | "K" => 1 << 10,
        "MiB" | "M" => 1 << 20,
        "GiB" | "G" => 1 << 30,
        "kB" => 1000,
        "MB" => 1_000_000,
        "GB" => 1_000_000_000,
        _ => return Err(format!("unit '{unit}': expected KiB, MiB, GiB, kB, MB or GB, as in 2GiB")),
    };
    let value: u64 =
        number.parse().map_err(|_| "expected a whole number with a unit, as in 2GiB".to_owned())?;
    value.checked_mul(scale).ok_or_else(|| "more than 16 EiB".to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bytes_have_units_and_ends() {
        for (text, bytes) in [("0", 0), ("7B", 7), ("2GiB", 2 << 30), ("3 MB", 3_000_000), ("1K", 1024)] {
            assert_eq!(parse_bytes(text), Ok(bytes), "{text}");
        }
        for bad in ["", "GiB", "2TiB", "-1", "1.5GiB", "99999999999GiB"] {
            assert!(parse_bytes(bad).is_err(), "{bad}");
        }
    }
}
