//! Command lines, as both programs read them.

use std::ffi::OsString;

/// Writes an option and a value that begins like a negative number (`--nodata -1e38`, `--sun -10,20`, `--nodata -inf`) as one word
/// (`--nodata=-1e38`), which nobody takes for an option. What is wrong with such a value is then told in the option's own words,
/// and not that there is no option `-1`.
pub fn with_negative_numbers(words: impl IntoIterator<Item = OsString>) -> Vec<OsString> {
    let mut joined: Vec<OsString> = Vec::new();
    let mut is_over = false;
    for word in words {
        let option = joined.last_mut().filter(|last| {
            let last = last.to_string_lossy();
            last.len() > 2 && last.starts_with("--") && !last.contains('=')
        });
        match option {
            Some(option) if !is_over && is_negative(&word) => {
                option.push("=");
                option.push(word);
            }
            _ => {
                is_over |= word == "--";
                joined.push(word);
            }
        }
    }
    joined
}

fn is_negative(word: &OsString) -> bool {
    let word = word.to_string_lossy();
    word.strip_prefix('-').is_some_and(|rest| {
        let is_digits = rest.starts_with(|c: char| c.is_ascii_digit() || c == '.');
        is_digits
            || rest.get(..3).is_some_and(|head| ["inf", "nan"].iter().any(|w| head.eq_ignore_ascii_case(w)))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn negative_values_go_with_their_options() {
        let join = |words: &str| {
            let words = with_negative_numbers(words.split(' ').map(OsString::from));
            words.iter().map(|word| word.to_string_lossy().into_owned()).collect::<Vec<_>>().join(" ")
        };
        for (words, expected) in [
            ("build a.tif --nodata -3.4e+38 -o s", "build a.tif --nodata=-3.4e+38 -o s"),
            ("render --sun -10,20 --level -.5", "render --sun=-10,20 --level=-.5"),
            ("build a --nodata -inf -n -Infinity", "build a --nodata=-inf -n -Infinity"),
            ("fly --frames -1 --play -1e-3", "fly --frames=-1 --play=-1e-3"),
            // What is none of a number, or has its value, stays as it is; so does all behind the two dashes.
            ("fly --play -x --time=5 -6 -o -7", "fly --play -x --time=5 -6 -o -7"),
            ("build -- -5 --cell -6", "build -- -5 --cell -6"),
        ] {
            assert_eq!(join(words), expected);
        }
    }
}
