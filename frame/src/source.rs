//! Where frames come from.

use std::fmt;
use std::time::Duration;

use crate::{Camera, Frame};

/// Whether a source waits for its consumer.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum SourceKind {
    /// Frames come when the world makes them (a camera, a recording at real-time pace): a slow consumer
    /// gets the newest and the drops are counted.
    Live,
    /// Frames come when they are asked for (a recording as fast as possible): nothing is ever dropped.
    OnDemand,
}

/// What is known about a source once it is open.
#[derive(Debug, Clone, PartialEq)]
pub struct SourceInfo {
    /// What a log line should call it: `/dev/video0`, `7-Scenes redkitchen seq-01`.
    pub name: String,
    /// Whether it waits for its consumer.
    pub kind: SourceKind,
    /// Frames per second that it intends to deliver, where it knows.
    pub nominal_rate_hz: Option<f64>,
    /// Number of frames until [`Received::End`], where it is finite and known.
    pub length: Option<u64>,
    /// Intrinsics that its frames will carry, where it knows them.
    pub camera: Option<Camera>,
}

/// What a wait for the next frame gave.
#[derive(Debug, Clone, PartialEq)]
pub enum Received {
    /// A frame.
    Frame(Frame),
    /// No frame within the time allowed; the source is still there.
    Timeout,
    /// The recording is over; every further call gives `End` again.
    End,
}

/// Why no frame came.
#[derive(Debug, thiserror::Error)]
pub enum SourceError {
    /// One frame was unusable (corrupt, truncated, of the wrong size). It is gone; the next may be good.
    #[error("frame {sequence} of {source_name} is unusable: {reason}")]
    BadFrame {
        /// The source's name.
        source_name: String,
        /// The frame's sequence number.
        sequence: u64,
        /// What was wrong: file, what was found, what was expected.
        reason: String,
    },
    /// The device is gone or cannot be opened now; calling again tries to get it back.
    #[error("{source_name} is lost: {reason}")]
    Lost {
        /// The source's name.
        source_name: String,
        /// What happened.
        reason: String,
    },
    /// The source can never give a frame as configured.
    #[error("{source_name} cannot be used: {reason}")]
    Unusable {
        /// The source's name.
        source_name: String,
        /// What was tried, found, and what to do.
        reason: String,
    },
}

/// A camera or a recording.
///
/// Contract, held by the conformance suite over every implementation: sequence numbers grow strictly
/// until the source is reopened; times of capture never fall on one clock; a call returns within the time
/// allowed plus the time to read one frame; after [`SourceError::BadFrame`] the next frame follows; after
/// [`Received::End`] comes `End` for ever; [`SourceKind::OnDemand`] sources give the same frames at every
/// run, bit by bit.
pub trait FrameSource: Send + fmt::Debug {
    /// What is known about this source.
    fn info(&self) -> SourceInfo;

    /// Waits for the next frame, at most for `timeout`.
    ///
    /// # Errors
    /// See [`SourceError`]; only [`SourceError::Unusable`] is final.
    fn next_frame(&mut self, timeout: Duration) -> Result<Received, SourceError>;

    /// Frames that this source itself has lost since it was opened (driver drops, real-time pace missed).
    fn dropped_frames(&self) -> u64;
}
