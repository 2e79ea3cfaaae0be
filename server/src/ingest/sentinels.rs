//! Values that usually mean "no data", met where nobody declared them.
//!
//! A void of -32768 in a file that declares another nodata value, or none, would become a pit 33 km deep.
//! Such a value is told from heights by its distance: farther from all other values than these are from one
//! another. Only values that are known to stand for "no data" are suspected.

use std::sync::{Mutex, PoisonError};

/// What files use: the ends of 16-bit integers, and what surveys write.
const SENTINELS: [f64; 6] = [-32768.0, -32767.0, 32767.0, 65535.0, -9999.0, -99999.0];

/// The values met so far, by any thread.
#[derive(Debug)]
pub(super) struct Seen(Mutex<Values>);

#[derive(Debug, Clone, Copy)]
struct Values {
    /// The lowest and highest value that is no sentinel.
    range: [f64; 2],
    /// The number of the file in which each sentinel was met first.
    sentinels: [Option<usize>; SENTINELS.len()],
}

const NONE: Values = Values { range: [f64::INFINITY, f64::NEG_INFINITY], sentinels: [None; SENTINELS.len()] };

impl Default for Seen {
    fn default() -> Self {
        Self(Mutex::new(NONE))
    }
}

impl Seen {
    /// Notes the values of a window of file number `file`, NaN for nodata.
    pub(super) fn note(&self, file: usize, values: &[f64]) {
        // Comparisons with NaN are false: nodata changes nothing.
        let (low, high) = values.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), v| {
            (if *v < low { *v } else { low }, if *v > high { *v } else { high })
        });
        let mut here = Values { range: [low, high], ..NONE };
        // Where a sentinel is not an extreme, other values lie beyond it: it is none.
        if SENTINELS.contains(&low) || SENTINELS.contains(&high) {
            here.range = NONE.range;
            for value in values.iter().filter(|v| !v.is_nan()) {
                match SENTINELS.iter().position(|s| s == value) {
                    Some(i) => here.sentinels[i] = Some(file),
                    None => here.range = [here.range[0].min(*value), here.range[1].max(*value)],
                }
            }
        }
        let mut all = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        all.range = [all.range[0].min(here.range[0]), all.range[1].max(here.range[1])];
        for (all, here) in all.sentinels.iter_mut().zip(here.sentinels) {
            *all = all.or(here);
        }
    }

    /// A sentinel that lies apart from all other values, the number of its file, and their range.
    pub(super) fn suspect(&self) -> Option<(f64, usize, [f64; 2])> {
        let all = *self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let [low, high] = all.range;
        let apart = |s: f64| low <= high && (low - s).max(s - high) > high - low;
        let met = SENTINELS.into_iter().zip(all.sentinels).filter_map(|(s, file)| Some((s, file?)));
        met.filter(|(s, _)| apart(*s)).map(|(s, file)| (s, file, all.range)).next()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn suspect(windows: &[&[f64]]) -> Option<f64> {
        let seen = Seen::default();
        for (file, values) in windows.iter().enumerate() {
            seen.note(file, values);
        }
        seen.suspect().map(|(s, ..)| s)
    }

    #[test]
    fn a_void_apart_from_all_heights_is_suspected() {
        assert_eq!(suspect(&[&[263.0, 4370.0, f64::NAN], &[900.0, -32768.0]]), Some(-32768.0));
        assert_eq!(suspect(&[&[-9999.0, -32767.0, 12.5, 13.0]]), Some(-32767.0));
        assert_eq!(suspect(&[&[5.0, 5.0, -9999.0]]), Some(-9999.0));
        assert_eq!(suspect(&[&[100.0, 32767.0]]), Some(32767.0));
    }

    #[test]
    fn heights_among_heights_are_not() {
        // The deepest sea and the highest mountain.
        assert_eq!(suspect(&[&[-10984.0, -9999.0, 8848.0]]), None);
        assert_eq!(suspect(&[&[-9999.0, -9000.0, 3000.0]]), None);
        // Tenths of a metre in 16 bits.
        assert_eq!(suspect(&[&[0.0, 43798.0, 65535.0]]), None);
        assert_eq!(suspect(&[&[f64::NAN], &[]]), None);
        assert_eq!(
            suspect(&[&[-9999.0, -9999.0]]),
            None,
            "nothing to be apart from: all nodata is another error"
        );
    }
}
