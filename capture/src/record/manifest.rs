//! What a recording says about itself.

use std::fmt::Write as _;

use grnet_frame::{Camera, Distortion};
use serde::{Deserialize, Serialize};

/// `recording.json`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Manifest {
    /// What made it.
    pub generator: String,
    /// Where its frames came from.
    pub source: String,
    /// What the times in `rgb.txt` are: `realtime` (seconds since 1970 by the machine's clock at the start) or
    /// `recorded` (the source's own, of a recording that was played as fast as possible); unknown without a frame.
    pub clock: Option<String>,
    /// `CLOCK_REALTIME - CLOCK_MONOTONIC`, which is in the times of `realtime`.
    pub realtime_offset_ns: i64,
    /// Width and height of the first image.
    pub size_px: Option<(u32, u32)>,
    /// Whether the recording was ended properly; until then the numbers below are zero.
    pub complete: bool,
    /// Why it ended.
    pub ended: Option<String>,
    /// Frames in `rgb.txt`.
    pub frames: u64,
    /// Frames that found the queue to the disk full.
    pub left_out_queue_full: u64,
    /// Frames that were not later than the one before.
    pub left_out_not_later: u64,
    /// Frames that could not be made an image.
    pub left_out_unusable: u64,
}

impl Manifest {
    /// Frames that the source gave and the recording lacks.
    pub fn left_out(&self) -> u64 {
        self.left_out_queue_full + self.left_out_not_later + self.left_out_unusable
    }

    pub(super) fn json(&self) -> String {
        // Plain numbers and texts: there is nothing in it that JSON cannot say.
        let mut text = serde_json::to_string_pretty(self).unwrap_or_default();
        text.push('\n');
        text
    }
}

/// `camera-intrinsics.txt`.
pub(super) fn matrix(camera: &Camera) -> String {
    let ((fx, fy), (cx, cy)) = (camera.focal_px(), camera.centre_px());
    format!("{fx} 0 {cx}\n0 {fy} {cy}\n0 0 1\n")
}

/// `camera-distortion.txt`, where there is distortion.
pub(super) fn distortion(camera: &Camera) -> Option<String> {
    let (model, coefficients): (_, &[f64]) = match &camera.distortion() {
        Distortion::None => return None,
        Distortion::PlumbBob(k) => ("plumb_bob", &k.clone()),
        Distortion::Equidistant(k) => ("equidistant", &k.clone()),
    };
    let mut text = model.to_owned();
    for k in coefficients {
        // Writing to a String cannot fail.
        let _ = write!(text, " {k}");
    }
    text.push('\n');
    Some(text)
}

pub(super) const README: &str = "\
A recording of camera frames in the TUM RGB-D layout, written by grnet.

rgb.txt                `time_s image`, one line a frame; the times are those of capture
rgb/                   the images, named by their time
frames.csv             the source's own frame number and time, line by line as in rgb.txt;
                       a number that is skipped is a frame that the source or the recording lost
camera-intrinsics.txt  pinhole matrix in pixels, pixel centres at integers (only where the camera is known)
camera-distortion.txt  plumb_bob k1 k2 p1 p2 k3, or equidistant k1 k2 k3 k4 (only where there is any)
recording.json         source, clock, frames left out, and whether the recording was ended properly

Times are seconds since 1970 by this machine's clock as it was when the recording began (\"clock\": \"realtime\"),
so that they join with motion capture on another machine whose clock is synchronised; or the times of the
recording that was played (\"clock\": \"recorded\").

Poses come with `grnet-train join`, which writes groundtruth.txt; `grnet-train check` says what is wrong.
";
