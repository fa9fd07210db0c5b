//! Writes frames to a folder in the TUM RGB-D layout, which [`dataset`](crate::dataset) reads.
//!
//! | file | content |
//! |---|---|
//! | `rgb.txt` | `time_s rgb/TIME.png`, one line a frame, appended when its image is complete |
//! | `rgb/` | the images, named by their time |
//! | `frames.csv` | the source's own number and time of each frame, in the order of `rgb.txt` |
//! | `camera-intrinsics.txt`, `camera-distortion.txt` | the camera, where it is known |
//! | `recording.json` | source, clock, what was left out, whether the recording was ended properly |
//! | `README.txt` | the same for people |
//!
//! A frame counts from the moment at which its line is in `rgb.txt`: whoever is killed loses at most the frame
//! that was being written. (A power cut may also take what the system had not yet put on the disk.)

mod encode;
mod manifest;
mod writer;

use std::path::PathBuf;

use grnet_frame::Camera;

pub use manifest::Manifest;
pub use writer::{RecordingWriter, Written};

/// How images that did not come as JPEG are written. JPEG frames are always written as they came.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ImageFormat {
    /// Without loss.
    Png,
    /// Small.
    Jpeg {
        /// 1 to 100.
        quality: u8,
    },
}

/// What a recording is made with.
#[derive(Debug, Clone, PartialEq)]
pub struct RecordOptions {
    /// Format of the images.
    pub format: ImageFormat,
    /// The recording ends before the file system has fewer free bytes than this.
    pub least_free_bytes: u64,
    /// `CLOCK_REALTIME - CLOCK_MONOTONIC` at the start: frames on the monotonic clock are stamped with the time of
    /// day by it, so that they join with trajectories of other machines. One offset for the whole recording: a
    /// clock that is set meanwhile moves no frame.
    pub realtime_offset_ns: i64,
    /// Intrinsics instead of those that the frames carry.
    pub camera: Option<Camera>,
    /// What made the recording: a program and its version.
    pub generator: String,
    /// Where its frames came from.
    pub source: String,
}

/// Why a recording could not be begun or continued.
#[derive(Debug, thiserror::Error)]
pub enum RecordError {
    /// The folder holds something that a recording must not be mixed with.
    #[error(
        "cannot record into {folder}: it holds {found}, and a recording needs a folder of its own; name a new or \
         empty one"
    )]
    NotEmpty {
        /// The folder.
        folder: PathBuf,
        /// One thing in it.
        found: String,
    },
    /// A file or folder could not be written.
    #[error("cannot {action} {path}: {source}")]
    Io {
        /// What was tried.
        action: &'static str,
        /// On what.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// The file system is about to be full.
    #[error(
        "the file system of {folder} has {free_mib} MiB free, and a recording leaves at least {least_mib} MiB: \
         make room or record elsewhere"
    )]
    Full {
        /// The recording's folder.
        folder: PathBuf,
        /// What is free.
        free_mib: u64,
        /// What has to stay free.
        least_mib: u64,
    },
}

impl RecordError {
    pub(crate) fn io(
        action: &'static str,
        path: &std::path::Path,
    ) -> impl FnOnce(std::io::Error) -> Self + use<> {
        let path = path.to_path_buf();
        move |source| Self::Io { action, path, source }
    }
}

#[cfg(test)]
mod tests;
