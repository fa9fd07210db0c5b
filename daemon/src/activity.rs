//! Whether a thread makes progress: what the watchdog of the service manager is fed by.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use grnet_proto::clock::monotonic_ns;

/// Zero: waiting; otherwise when the piece of work in hand began, ns on `CLOCK_MONOTONIC`.
#[derive(Debug, Clone, Default)]
pub struct Activity {
    working_since_ns: Arc<AtomicU64>,
}

impl Activity {
    /// A bounded piece of work begins: a read with a time-out, a frame, a publication.
    pub fn work(&self) {
        self.working_since_ns.store(monotonic_ns().max(1), Ordering::Relaxed);
    }

    /// The thread waits for others (which is no lack of progress of its own) or has ended.
    pub fn wait(&self) {
        self.working_since_ns.store(0, Ordering::Relaxed);
    }

    /// How long the piece of work in hand has taken by `now_ns`.
    pub fn busy_for(&self, now_ns: u64) -> Duration {
        match self.working_since_ns.load(Ordering::Relaxed) {
            0 => Duration::ZERO,
            since_ns => Duration::from_nanos(now_ns.saturating_sub(since_ns)),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_work_in_hand_counts() {
        let activity = Activity::default();
        let later_ns = monotonic_ns() + 5_000_000_000;
        assert_eq!(activity.busy_for(later_ns), Duration::ZERO);
        activity.work();
        assert!(activity.busy_for(later_ns) > Duration::from_secs(4));
        activity.wait();
        assert_eq!(activity.busy_for(later_ns), Duration::ZERO);
    }
}
