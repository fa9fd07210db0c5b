//! Numbers and times for people.

use std::io::IsTerminal as _;

/// May standard output be coloured? Only a terminal, and only without `NO_COLOR` (<https://no-color.org>).
pub fn colours() -> bool {
    let set = |name| std::env::var_os(name).is_some_and(|value| !value.is_empty());
    let dumb = std::env::var_os("TERM").is_some_and(|term| term == "dumb");
    std::io::stdout().is_terminal() && !set("NO_COLOR") && !dumb
}

/// `HH:MM:SS.mmm` of a time since 1970, in UTC.
pub fn time_of_day(epoch_ns: i64) -> String {
    let ms = epoch_ns.div_euclid(1_000_000).rem_euclid(86_400_000);
    format!("{:02}:{:02}:{:02}.{:03}", ms / 3_600_000, ms / 60_000 % 60, ms / 1000 % 60, ms % 1000)
}

/// A duration in its two largest units.
pub fn duration(ns: u64) -> String {
    let seconds = ns / 1_000_000_000;
    match seconds {
        0..60 => format!("{seconds} s"),
        60..3600 => format!("{} min {} s", seconds / 60, seconds % 60),
        3600..86_400 => format!("{} h {} min", seconds / 3600, seconds / 60 % 60),
        _ => format!("{} d {} h", seconds / 86_400, seconds / 3600 % 24),
    }
}

/// A rate, or a dash.
pub fn rate(hz: f64) -> String {
    if hz.is_finite() { format!("{hz:.1} Hz") } else { "-".to_owned() }
}

/// Microseconds as milliseconds, or a dash.
pub fn milliseconds(us: f32) -> String {
    if us.is_finite() { format!("{:.2}", f64::from(us) / 1e3) } else { "-".to_owned() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_are_readable() {
        assert_eq!(time_of_day(1_700_000_001_520_999_999), "22:13:21.520");
        assert_eq!(time_of_day(-1), "23:59:59.999");
        assert_eq!(duration(59_999_999_999), "59 s");
        assert_eq!(duration(3_600_000_000_000), "1 h 0 min");
        assert_eq!(duration(200_000_000_000_000), "2 d 7 h");
        assert_eq!(rate(f64::NAN), "-");
        assert_eq!(milliseconds(1500.0), "1.50");
    }
}
