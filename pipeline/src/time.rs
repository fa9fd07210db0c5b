//! Whether a frame's time of capture fits those before it.

use grnet_frame::CaptureTime;

use crate::estimate::Reason;
use crate::options::TimeOptions;

/// A frame that is not newer than the last one.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error(
    "frame {sequence} was captured {behind_ns} ns before the last one (or at the same time): it is refused; the \
     source repeats frames or its clock was set back"
)]
pub struct StaleFrame {
    /// The frame's sequence number.
    pub sequence: u64,
    /// How far its time of capture lies before that of the last frame; 0 for the same time.
    pub behind_ns: u64,
}

/// How a frame follows the one before.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Arrival {
    /// There is none before, or its time means nothing any more.
    First,
    /// This many seconds later.
    After { dt_s: f64 },
    /// Relative motion since the last frame means nothing.
    Jumped(Reason),
}

/// Remembers the last time of capture and applies [`TimeOptions`].
#[derive(Debug, Clone)]
pub(crate) struct TimeRule {
    options: TimeOptions,
    last: Option<CaptureTime>,
    /// Of the refused frames in a row: how many, and the time of the newest.
    refused: Option<(u32, CaptureTime)>,
}

impl TimeRule {
    pub(crate) fn new(options: TimeOptions) -> Self {
        Self { options, last: None, refused: None }
    }

    /// Other rules from the next frame on.
    pub(crate) fn set_options(&mut self, options: TimeOptions) {
        self.options = options;
    }

    /// Judges a frame; a refusal is remembered, an admission only by [`TimeRule::accept`].
    pub(crate) fn judge(&mut self, sequence: u64, time: CaptureTime) -> Result<Arrival, StaleFrame> {
        let Some(last) = self.last else { return Ok(Arrival::First) };
        if time.clock != last.clock {
            return Ok(Arrival::Jumped(Reason::ClockChanged));
        }
        let ahead_ns = time.since(last);
        if ahead_ns > i128::from(self.options.longest_gap_ns) {
            return Ok(Arrival::Jumped(Reason::TimeJump));
        }
        if ahead_ns > 0 {
            return Ok(Arrival::After { dt_s: ahead_ns as f64 * 1e-9 });
        }
        let run = match self.refused {
            Some((count, newest)) if time.clock == newest.clock && time.since(newest) > 0 => count + 1,
            _ => 1,
        };
        if self.options.refused_before_restart.is_some_and(|allowed| run > allowed) {
            return Ok(Arrival::Jumped(Reason::TimeJump));
        }
        self.refused = Some((run, time));
        Err(StaleFrame { sequence, behind_ns: u64::try_from(-ahead_ns).unwrap_or(u64::MAX) })
    }

    /// The frame of this time was processed.
    pub(crate) fn accept(&mut self, time: CaptureTime) {
        (self.last, self.refused) = (Some(time), None);
    }

    /// Times from here on need not follow those before.
    pub(crate) fn forget(&mut self) {
        (self.last, self.refused) = (None, None);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: u64 = 1_000_000;

    fn rule() -> TimeRule {
        let options = TimeOptions { longest_gap_ns: 100 * MS, refused_before_restart: Some(3) };
        let mut rule = TimeRule::new(options);
        assert_eq!(rule.judge(0, at(1000)), Ok(Arrival::First));
        rule.accept(at(1000));
        rule
    }

    fn at(ms: u64) -> CaptureTime {
        CaptureTime::monotonic(ms * MS)
    }

    #[test]
    fn ahead_is_fine_up_to_the_gap() {
        let mut rule = rule();
        assert_eq!(rule.judge(1, at(1100)), Ok(Arrival::After { dt_s: 0.1 }));
        assert_eq!(rule.judge(1, at(1101)), Ok(Arrival::Jumped(Reason::TimeJump)));
        assert_eq!(
            rule.judge(1, CaptureTime::recorded(1050 * MS)),
            Ok(Arrival::Jumped(Reason::ClockChanged))
        );
    }

    #[test]
    fn equal_and_earlier_frames_are_refused() {
        let mut rule = rule();
        assert_eq!(rule.judge(7, at(1000)), Err(StaleFrame { sequence: 7, behind_ns: 0 }));
        assert_eq!(rule.judge(8, at(400)), Err(StaleFrame { sequence: 8, behind_ns: 600 * MS }));
        assert_eq!(rule.judge(9, at(1033)), Ok(Arrival::After { dt_s: 0.033 }));
    }

    #[test]
    fn a_clock_that_was_set_back_for_good_is_followed() {
        let mut rule = rule();
        for ms in [500, 533, 566] {
            assert!(rule.judge(0, at(ms)).is_err());
        }
        assert_eq!(rule.judge(0, at(600)), Ok(Arrival::Jumped(Reason::TimeJump)));
        // A source that repeats one old frame never gets there.
        let mut rule = self::rule();
        for _ in 0..50 {
            assert!(rule.judge(0, at(500)).is_err());
        }
    }

    #[test]
    fn the_largest_times_do_not_overflow() {
        let mut rule = rule();
        assert_eq!(rule.judge(0, CaptureTime::monotonic(u64::MAX)), Ok(Arrival::Jumped(Reason::TimeJump)));
        rule.accept(CaptureTime::monotonic(u64::MAX));
        assert_eq!(
            rule.judge(0, CaptureTime::monotonic(0)),
            Err(StaleFrame { sequence: 0, behind_ns: u64::MAX })
        );
    }
}
