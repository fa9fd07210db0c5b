//! Time of capture.

/// The clock on which a time of capture was taken.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Clock {
    /// `CLOCK_MONOTONIC` of this machine: a camera, or a recording played at real-time pace.
    Monotonic,
    /// The recording's own time stamps: a recording played as fast as possible, or replayed exactly.
    Recorded,
}

/// When a frame was captured: nanoseconds on the given [`Clock`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct CaptureTime {
    /// Nanoseconds since the clock's origin.
    pub ns: u64,
    /// Which clock.
    pub clock: Clock,
}

impl CaptureTime {
    /// A time on `CLOCK_MONOTONIC`.
    pub const fn monotonic(ns: u64) -> Self {
        Self { ns, clock: Clock::Monotonic }
    }

    /// A time on the recording's own clock.
    pub const fn recorded(ns: u64) -> Self {
        Self { ns, clock: Clock::Recorded }
    }

    /// Nanoseconds from `earlier` to `self`; negative when `self` lies before it.
    ///
    /// ```
    /// use grnet_frame::CaptureTime;
    /// let (a, b) = (CaptureTime::monotonic(5), CaptureTime::monotonic(3));
    /// assert_eq!(b.since(a), -2);
    /// ```
    pub fn since(self, earlier: Self) -> i128 {
        i128::from(self.ns) - i128::from(earlier.ns)
    }
}
