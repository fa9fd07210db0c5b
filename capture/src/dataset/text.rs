//! Text files read line by line, with errors that name file, line, what was found and what was expected.

use std::path::{Path, PathBuf};

use super::DatasetError;

/// Longest part of a bad line that an error repeats.
const QUOTED_CHARS: usize = 60;

/// A text file in memory.
#[derive(Debug)]
pub(crate) struct TextFile {
    path: PathBuf,
    text: String,
}

impl TextFile {
    /// Reads the file; it must be there.
    pub fn read(path: &Path) -> Result<Self, DatasetError> {
        let bytes = std::fs::read(path).map_err(DatasetError::read(path))?;
        Self::from_bytes(path, bytes)
    }

    /// Reads the file, or gives `None` when there is none.
    pub fn read_if_present(path: &Path) -> Result<Option<Self>, DatasetError> {
        match std::fs::read(path) {
            Ok(bytes) => Self::from_bytes(path, bytes).map(Some),
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => Ok(None),
            Err(error) => Err(DatasetError::read(path)(error)),
        }
    }

    /// Takes bytes as if they had been read from `path`; a byte-order mark is dropped.
    pub fn from_bytes(path: &Path, bytes: Vec<u8>) -> Result<Self, DatasetError> {
        match String::from_utf8(bytes) {
            Ok(mut text) => {
                if text.starts_with('\u{feff}') {
                    text.drain(..'\u{feff}'.len_utf8());
                }
                Ok(Self { path: path.to_path_buf(), text })
            }
            Err(error) => {
                let good = &error.as_bytes()[..error.utf8_error().valid_up_to()];
                let line = 1 + good.iter().filter(|&&byte| byte == b'\n').count();
                let byte = error.as_bytes()[good.len()];
                Err(DatasetError::Malformed {
                    path: path.to_path_buf(),
                    line,
                    found: format!("the byte 0x{byte:02x}"),
                    expected: "UTF-8 text".into(),
                })
            }
        }
    }

    pub fn path(&self) -> &Path {
        &self.path
    }

    pub fn text(&self) -> &str {
        &self.text
    }

    /// Every line without surrounding white space.
    pub fn lines(&self) -> impl Iterator<Item = Line<'_>> {
        self.text.lines().enumerate().map(|(index, text)| Line {
            path: &self.path,
            number: index + 1,
            text: text.trim(),
        })
    }

    /// The lines that hold data: neither blank nor a `#` comment.
    pub fn data_lines(&self) -> impl Iterator<Item = Line<'_>> {
        self.lines().filter(|line| !line.text.is_empty() && !line.text.starts_with('#'))
    }

    /// The line after the last one: where missing data would have been.
    pub fn end(&self) -> Line<'_> {
        Line { path: &self.path, number: self.text.lines().count() + 1, text: "" }
    }
}

/// One line of a [`TextFile`].
#[derive(Debug, Clone, Copy)]
pub(crate) struct Line<'a> {
    pub path: &'a Path,
    /// From 1.
    pub number: usize,
    pub text: &'a str,
}

impl<'a> Line<'a> {
    /// The parts between white space.
    pub fn fields(&self) -> Vec<&'a str> {
        self.text.split_whitespace().collect()
    }

    /// The parts between commas, without white space around them.
    pub fn comma_fields(&self) -> Vec<&'a str> {
        self.text.split(',').map(str::trim).collect()
    }

    /// An error at this line that repeats `found`.
    pub fn error(&self, found: impl std::fmt::Display, expected: impl Into<String>) -> DatasetError {
        DatasetError::Malformed {
            path: self.path.to_path_buf(),
            line: self.number,
            found: found.to_string(),
            expected: expected.into(),
        }
    }

    /// An error at this line that quotes the whole line.
    pub fn unexpected(&self, expected: impl Into<String>) -> DatasetError {
        let found = if self.text.is_empty() { "the end of the file".into() } else { quoted(self.text) };
        self.error(found, expected)
    }

    /// A number that may be NaN or infinite.
    pub fn number(&self, field: &str, expected: &str) -> Result<f64, DatasetError> {
        parse_number(field).ok_or_else(|| self.error(quoted(field), expected))
    }

    /// A finite number.
    pub fn finite(&self, field: &str, expected: &str) -> Result<f64, DatasetError> {
        match parse_number(field) {
            Some(value) if value.is_finite() => Ok(value),
            _ => Err(self.error(quoted(field), expected)),
        }
    }

    /// `N` numbers, each maybe NaN or infinite.
    pub fn numbers<const N: usize>(&self, fields: &[&str], expected: &str) -> Result<[f64; N], DatasetError> {
        if fields.len() != N {
            return Err(self.error(format!("{} fields in {}", fields.len(), quoted(self.text)), expected));
        }
        let mut values = [0.0; N];
        for (value, field) in values.iter_mut().zip(fields) {
            *value = self.number(field, expected)?;
        }
        Ok(values)
    }

    /// Seconds, as nanoseconds.
    pub fn seconds_ns(&self, field: &str, expected: &str) -> Result<u64, DatasetError> {
        parse_seconds_ns(field).ok_or_else(|| self.error(quoted(field), expected))
    }

    /// A whole number.
    pub fn integer(&self, field: &str, expected: &str) -> Result<u64, DatasetError> {
        field.parse().map_err(|_| self.error(quoted(field), expected))
    }
}

/// The text in quotation marks, shortened and with control characters escaped.
pub(crate) fn quoted(text: &str) -> String {
    let short: String = text.chars().take(QUOTED_CHARS).collect();
    let dots = if short.len() < text.len() { "..." } else { "" };
    format!("{short:?}{dots}")
}

/// A decimal number; also the ways in which C libraries print NaN and infinity (`-1.#IND`, `1.#QNAN`, `inf`).
pub(crate) fn parse_number(text: &str) -> Option<f64> {
    if let Ok(value) = text.parse::<f64>() {
        return Some(value);
    }
    let unsigned = text.strip_prefix(['-', '+']).unwrap_or(text);
    let special = unsigned.strip_prefix("1.#")?.trim_end_matches('0');
    match special.to_ascii_uppercase().as_str() {
        "INF" | "J" => Some(if text.starts_with('-') { f64::NEG_INFINITY } else { f64::INFINITY }),
        "IND" | "QNAN" | "SNAN" | "R" => Some(f64::NAN),
        _ => None,
    }
}

/// Seconds as nanoseconds: exact for plain decimals (an `f64` would lose the last digits of a Unix time), to
/// the nearest nanosecond for exponents. `None` for what is negative, too large, or no number.
pub(crate) fn parse_seconds_ns(text: &str) -> Option<u64> {
    let (whole, fraction) = text.split_once('.').unwrap_or((text, ""));
    let digits = |part: &str| part.bytes().all(|byte| byte.is_ascii_digit());
    if digits(whole) && digits(fraction) && !(whole.is_empty() && fraction.is_empty()) {
        let seconds: u64 = if whole.is_empty() { 0 } else { whole.parse().ok()? };
        let kept = &fraction[..fraction.len().min(9)];
        let nanoseconds: u64 = format!("{kept:0<9}").parse().ok()?;
        return seconds.checked_mul(1_000_000_000)?.checked_add(nanoseconds);
    }
    let seconds: f64 = text.parse().ok()?;
    let ns = (seconds * 1e9).round();
    (ns >= 0.0 && ns < u64::MAX as f64).then_some(ns as u64)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn seconds_keep_every_digit() {
        for (text, ns) in [
            ("1305031102.160407", 1_305_031_102_160_407_000),
            ("1.037359e-01", 103_735_900),
            ("0.000000e+00", 0),
            ("12", 12_000_000_000),
            (".5", 500_000_000),
            ("1.0000000019", 1_000_000_001),
        ] {
            assert_eq!(parse_seconds_ns(text), Some(ns), "{text}");
        }
        for text in ["", ".", "-1", "nan", "inf", "1e30", "99999999999999", "1,5", "x"] {
            assert_eq!(parse_seconds_ns(text), None, "{text}");
        }
    }

    #[test]
    fn windows_prints_of_no_number_are_known() {
        assert!(parse_number("-1.#IND").unwrap().is_nan());
        assert!(parse_number("1.#QNAN0").unwrap().is_nan());
        assert_eq!(parse_number("-1.#INF00"), Some(f64::NEG_INFINITY));
        assert_eq!((parse_number("1.#X"), parse_number("1.2.3")), (None, None));
    }

    #[test]
    fn a_bad_byte_is_found_by_line() {
        let error = TextFile::from_bytes(Path::new("poses.txt"), b"1\n2\n\xff".to_vec()).unwrap_err();
        assert_eq!(error.to_string(), "poses.txt, line 3: found the byte 0xff, expected UTF-8 text");
    }

    #[test]
    fn comments_blanks_marks_and_carriage_returns_are_skipped() {
        let bytes = "\u{feff}# head\r\n\r\n a b \r\n".as_bytes().to_vec();
        let file = TextFile::from_bytes(Path::new("x"), bytes).unwrap();
        let lines: Vec<_> = file.data_lines().map(|line| (line.number, line.text)).collect();
        assert_eq!(lines, [(3, "a b")]);
        assert_eq!(file.end().number, 4);
    }

    proptest! {
        #[test]
        fn whole_and_fraction_are_joined(seconds in 0u64..10_000_000_000, ns in 0u64..1_000_000_000) {
            let text = format!("{seconds}.{ns:09}");
            prop_assert_eq!(parse_seconds_ns(&text), Some(seconds * 1_000_000_000 + ns));
        }

        #[test]
        fn no_text_panics(text in "\\PC{0,80}") {
            let _ = (parse_seconds_ns(&text), parse_number(&text), quoted(&text));
        }
    }
}
