//! What is asked of a camera.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::time::Duration;

use grnet_frame::{Camera, PixelFormat};

/// What is asked of a V4L2 camera. Whatever is `None` is left as the driver has it.
#[derive(Debug, Clone, PartialEq)]
pub struct V4l2Options {
    /// `/dev/video0`, or a stable name such as `/dev/v4l/by-id/usb-...-video-index0`.
    pub device: PathBuf,
    /// Pixel format.
    pub format: Option<PixelFormat>,
    /// Image size (width, height) in pixels.
    pub size_px: Option<(u32, u32)>,
    /// Frames per second.
    pub rate_hz: Option<f64>,
    /// Controls by the names that `v4l2-ctl --list-ctrls` prints, set and read back.
    pub controls: BTreeMap<String, i64>,
    /// Accept what the driver puts in place of a format, size or rate that it does not offer.
    pub accept_substitutes: bool,
    /// Buffers in the driver's queue.
    pub buffers: u32,
    /// No frame for so long means that the stream has stalled and is opened anew.
    pub stall_timeout: Duration,
    /// Intrinsics at the size that is captured.
    pub camera: Option<Camera>,
}

impl V4l2Options {
    /// The driver's own settings, four buffers, a stall after two seconds.
    pub fn new(device: impl Into<PathBuf>) -> Self {
        Self {
            device: device.into(),
            format: None,
            size_px: None,
            rate_hz: None,
            controls: BTreeMap::new(),
            accept_substitutes: false,
            buffers: 4,
            stall_timeout: Duration::from_secs(2),
            camera: None,
        }
    }
}
