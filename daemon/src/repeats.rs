//! Aggregation of log lines that repeat.

use std::time::{Duration, Instant};

/// Lets the first occurrence through at once and then one summary per interval.
#[derive(Debug)]
pub struct Repeats {
    interval: Duration,
    last: Option<Instant>,
    count: u64,
}

impl Default for Repeats {
    fn default() -> Self {
        Self { interval: Duration::from_secs(10), last: None, count: 0 }
    }
}

impl Repeats {
    /// It happened again at `now`: `Some(times since the last line)` when a line is due.
    pub fn happened(&mut self, now: Instant) -> Option<u64> {
        self.count += 1;
        if self.last.is_some_and(|last| now.duration_since(last) < self.interval) {
            return None;
        }
        self.last = Some(now);
        Some(std::mem::take(&mut self.count))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_storm_gives_one_line_per_interval_and_none_is_uncounted() {
        let mut repeats = Repeats::default();
        let start = Instant::now();
        let lines: Vec<u64> =
            (0..=2500).filter_map(|i| repeats.happened(start + Duration::from_millis(10 * i))).collect();
        assert_eq!(lines, [1, 1000, 1000]);
    }
}
