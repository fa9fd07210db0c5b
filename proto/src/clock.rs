//! The two clocks of a publication.

use rustix::time::{ClockId, Timespec, clock_gettime};

/// `CLOCK_MONOTONIC` now, and how far `CLOCK_REALTIME` is ahead of it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Now {
    /// Nanoseconds on `CLOCK_MONOTONIC`.
    pub monotonic_ns: u64,
    /// `CLOCK_REALTIME - CLOCK_MONOTONIC` in nanoseconds.
    pub realtime_offset_ns: i64,
}

impl Now {
    /// Reads both clocks.
    pub fn read() -> Self {
        let before = monotonic_ns();
        let realtime = nanoseconds(clock_gettime(ClockId::Realtime));
        let after = monotonic_ns();
        // The realtime reading lies between the two others: their middle is the fairest partner.
        let middle = before + (after - before) / 2;
        Self { monotonic_ns: after, realtime_offset_ns: realtime - middle.cast_signed() }
    }
}

/// Nanoseconds on `CLOCK_MONOTONIC`.
pub fn monotonic_ns() -> u64 {
    // Monotonic time counts from boot and is never negative.
    nanoseconds(clock_gettime(ClockId::Monotonic)).cast_unsigned()
}

fn nanoseconds(time: Timespec) -> i64 {
    time.tv_sec * 1_000_000_000 + time.tv_nsec
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_offset_leads_to_the_time_of_day() {
        let now = Now::read();
        let since_1970 = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH).unwrap();
        let computed = i128::from(now.monotonic_ns) + i128::from(now.realtime_offset_ns);
        let difference_ns = (i128::try_from(since_1970.as_nanos()).unwrap() - computed).abs();
        assert!(difference_ns < 1_000_000_000, "{difference_ns} ns");
        assert!(monotonic_ns() >= now.monotonic_ns);
    }
}
