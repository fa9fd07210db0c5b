//! Plays a recording of any kind: like a camera, or as fast as frames are asked for.

mod live;
mod on_demand;

use std::fmt::Debug;
use std::sync::Arc;
use std::time::Duration;

use grnet_frame::{Camera, CaptureTime, Frame, Pixels, Received, SourceError, SourceKind};

use live::Live;
use on_demand::OnDemand;

/// How fast a recording is played.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Pace {
    /// At the recorded intervals, like a camera.
    Realtime,
    /// At the recorded intervals divided by this factor: 2 is twice as fast.
    Factor(f64),
    /// As fast as frames are asked for; nothing is dropped and every run is the same.
    Max,
}

impl Pace {
    /// What a source that is played so is to its consumer.
    pub(crate) fn kind(self) -> SourceKind {
        if self == Self::Max { SourceKind::OnDemand } else { SourceKind::Live }
    }

    /// Seconds of the recording in one second of the clock on which frames are stamped.
    pub(crate) fn factor(self) -> f64 {
        if let Self::Factor(factor) = self { factor } else { 1.0 }
    }

    /// What is wrong with a factor.
    pub(crate) fn check(self) -> Result<(), String> {
        match self {
            Self::Factor(factor) if !(factor.is_finite() && factor > 0.0) => {
                Err(format!("found a pace of {factor}, expected a positive factor"))
            }
            _ => Ok(()),
        }
    }
}

/// A decoded frame that has no time yet.
#[derive(Debug)]
pub(crate) struct Undated {
    pub pixels: Arc<Pixels>,
    pub sequence: u64,
    pub camera: Option<Camera>,
}

impl Undated {
    fn at(self, capture_time: CaptureTime) -> Frame {
        Frame { pixels: self.pixels, capture_time, sequence: self.sequence, camera: self.camera }
    }
}

/// A frame of a recording, or why there is none.
#[derive(Debug)]
pub(crate) struct Shot {
    /// Since the first frame of the first round, on the recording's clock.
    pub offset_ns: u64,
    /// Time of capture on the recording's clock.
    pub recorded_ns: u64,
    pub frame: Result<Undated, SourceError>,
}

/// The frames of a recording, in order, over all rounds.
pub(crate) trait Footage: Debug + Send + 'static {
    /// A frame that comes later than this (on the recording's clock) for want of a newer one makes the recording
    /// wait for it: `u64::MAX` where newer ones can always be reached.
    const MOST_LAG_NS: u64;

    /// Leaves out frames that a newer one, which is due within `elapsed_ns` of the start on the recording's clock,
    /// replaces: how many.
    fn skip_to(&mut self, elapsed_ns: u64) -> u64;

    /// The next frame; `None` after the last.
    fn next(&mut self) -> Option<Shot>;
}

/// Why the playing thread gave no frame.
#[derive(Debug)]
pub(crate) enum Failed {
    Source(SourceError),
    Thread,
}

/// A recording that is being played.
#[derive(Debug)]
pub(crate) enum Player {
    Live(Live),
    OnDemand(OnDemand),
    Failed,
}

impl Player {
    /// Starts the thread that reads.
    ///
    /// # Errors
    /// When it cannot be started now.
    pub fn start(footage: impl Footage, pace: Pace, source_name: &str) -> Result<Self, SourceError> {
        let started = match pace {
            Pace::Max => OnDemand::start(footage).map(Self::OnDemand),
            Pace::Realtime | Pace::Factor(_) => Live::start(footage, pace.factor()).map(Self::Live),
        };
        started.map_err(|error| SourceError::Lost {
            source_name: source_name.to_owned(),
            reason: format!("cannot start its thread: {error}"),
        })
    }

    pub fn next(&mut self, timeout: Duration, source_name: &str) -> Result<Received, SourceError> {
        let received = match self {
            Self::Live(live) => live.next(timeout),
            Self::OnDemand(on_demand) => on_demand.next(timeout),
            Self::Failed => Err(Failed::Thread),
        };
        received.map_err(|failed| match failed {
            Failed::Source(error) => error,
            Failed::Thread => {
                *self = Self::Failed;
                SourceError::Unusable {
                    source_name: source_name.to_owned(),
                    reason: "its reading thread ended by a fault of the program; open it again".into(),
                }
            }
        })
    }

    pub fn dropped(&self) -> u64 {
        match self {
            Self::Live(live) => live.dropped(),
            Self::OnDemand(_) | Self::Failed => 0,
        }
    }
}
