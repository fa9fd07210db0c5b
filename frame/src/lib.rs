//! A camera frame as every stage of grnet sees it: pixels, time of capture, source sequence number,
//! intrinsics; and [`FrameSource`], the trait behind which cameras and recordings stand.
//!
//! Time enters the system here and nowhere else: a [`Frame`] carries the [`CaptureTime`] that its source
//! gave it, and nothing downstream reads a clock to decide anything about a pose.
#![forbid(unsafe_code)]
#![deny(missing_docs)]

mod camera;
mod pixels;
mod source;
mod time;

pub use camera::{Camera, CameraError, Distortion};
pub use pixels::{PixelFormat, Pixels, PixelsError};
pub use source::{FrameSource, Received, SourceError, SourceInfo, SourceKind};
pub use time::{CaptureTime, Clock};

use std::sync::Arc;

/// One camera frame.
///
/// Cloning is cheap: the pixels are shared.
#[derive(Debug, Clone, PartialEq)]
pub struct Frame {
    /// The pixels as the source delivered them.
    pub pixels: Arc<Pixels>,
    /// When the exposure took place, on the source's clock.
    pub capture_time: CaptureTime,
    /// The source's own frame counter; a gap is a visible drop.
    pub sequence: u64,
    /// Intrinsics of the camera at the size of `pixels`, where the source knows them.
    pub camera: Option<Camera>,
}
