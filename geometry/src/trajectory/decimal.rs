//! Seconds as decimal text to and from integer nanoseconds, without passing through floating point: a Unix time
//! in `f64` seconds resolves only 240 ns.

/// Parses decimal seconds (`12`, `-0.5`, `1305031102.160407`, `1.305031102160407e+09`) to nanoseconds, rounded to
/// the nearest.
///
/// `None` if the text is no decimal number or does not fit an `i64` of nanoseconds (about 292 years).
pub(super) fn parse_seconds_ns(text: &str) -> Option<i64> {
    let (negative, rest) = match text.as_bytes().first()? {
        b'-' => (true, &text[1..]),
        b'+' => (false, &text[1..]),
        _ => (false, text),
    };
    let (mantissa, exponent) = match rest.find(['e', 'E']) {
        Some(at) => (&rest[..at], rest[at + 1..].parse::<i32>().ok()?),
        None => (rest, 0),
    };
    let (whole, fraction) = mantissa.split_once('.').unwrap_or((mantissa, ""));
    if whole.is_empty() && fraction.is_empty() {
        return None;
    }
    // Position of the decimal point among the digits once the value is in nanoseconds.
    let point = whole.len() as i64 + i64::from(exponent) + 9;
    let mut value: i64 = 0;
    let mut round_up = false;
    for (i, digit) in whole.bytes().chain(fraction.bytes()).enumerate() {
        if !digit.is_ascii_digit() {
            return None;
        }
        let digit = i64::from(digit - b'0');
        match (i as i64).cmp(&point) {
            std::cmp::Ordering::Less => value = value.checked_mul(10)?.checked_add(digit)?,
            std::cmp::Ordering::Equal => round_up = digit >= 5,
            std::cmp::Ordering::Greater => {}
        }
    }
    // Zeros that the text leaves out before the point.
    let digits = (whole.len() + fraction.len()) as i64;
    if value != 0 {
        for _ in digits..point {
            value = value.checked_mul(10)?;
        }
    }
    value = value.checked_add(i64::from(round_up))?;
    Some(if negative { -value } else { value })
}

/// Writes nanoseconds as seconds with nine decimals.
pub(super) fn format_seconds(time_ns: i64) -> String {
    let sign = if time_ns < 0 { "-" } else { "" };
    let magnitude = time_ns.unsigned_abs();
    format!("{sign}{}.{:09}", magnitude / 1_000_000_000, magnitude % 1_000_000_000)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn forms_of_the_same_number() {
        for text in
            ["1305031102.160407", "+1305031102.160407000", "1.305031102160407e+09", "13050311021604.07E-4"]
        {
            assert_eq!(parse_seconds_ns(text), Some(1_305_031_102_160_407_000), "{text}");
        }
        assert_eq!(parse_seconds_ns("1.305031102160407066e+09"), Some(1_305_031_102_160_407_066));
        assert_eq!(parse_seconds_ns("-0.5"), Some(-500_000_000));
        assert_eq!(parse_seconds_ns("5."), Some(5_000_000_000));
        assert_eq!(parse_seconds_ns(".25"), Some(250_000_000));
        assert_eq!(parse_seconds_ns("2e3"), Some(2_000_000_000_000));
        assert_eq!(parse_seconds_ns("0.0000000014"), Some(1));
        assert_eq!(parse_seconds_ns("0.0000000015"), Some(2));
        assert_eq!(parse_seconds_ns("6e-10"), Some(1));
        assert_eq!(parse_seconds_ns("0e999999"), Some(0));
    }

    #[test]
    fn what_is_no_time() {
        for text in
            ["", "-", ".", "nan", "inf", "1,5", "1.2.3", "0x10", "1e", "1e99", "9223372037", "1e2147483647"]
        {
            assert_eq!(parse_seconds_ns(text), None, "{text}");
        }
    }

    proptest! {
        #[test]
        fn round_trip(time_ns in (i64::MIN + 1)..i64::MAX) {
            prop_assert_eq!(parse_seconds_ns(&format_seconds(time_ns)), Some(time_ns));
        }

        #[test]
        fn never_panics(text in "[-+0-9.eE]{0,24}|.{0,8}") {
            let _ = parse_seconds_ns(&text);
        }
    }
}
