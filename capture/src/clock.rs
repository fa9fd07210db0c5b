//! The clock of live sources.

use rustix::time::{ClockId, clock_gettime};

/// Nanoseconds on `CLOCK_MONOTONIC`: the clock on which V4L2 stamps its buffers and on which every live
/// source of this crate stamps its frames.
pub fn monotonic_ns() -> u64 {
    let now = clock_gettime(ClockId::Monotonic);
    let seconds = u64::try_from(now.tv_sec).unwrap_or(0);
    let nanoseconds = u64::try_from(now.tv_nsec).unwrap_or(0);
    seconds.saturating_mul(1_000_000_000).saturating_add(nanoseconds)
}

#[cfg(test)]
mod tests {
    #[test]
    fn the_clock_does_not_fall() {
        let (a, b) = (super::monotonic_ns(), super::monotonic_ns());
        assert!(0 < a && a <= b);
    }
}
