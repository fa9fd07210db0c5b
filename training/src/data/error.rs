//! Why training data could not be made.

use std::path::PathBuf;

use grnet_capture::decode::DecodeError;
use grnet_pipeline::PreprocessError;

use crate::synth::SynthError;

/// What went wrong, on what, and what to do.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum DataError {
    /// An option makes no sense.
    #[error("option `{option}` of the training data: found {found}, expected {expected}")]
    Option {
        /// Its name.
        option: &'static str,
        /// Its value.
        found: String,
        /// What it must be.
        expected: String,
    },
    /// No run of neighbouring frames is long enough.
    #[error(
        "{path} has no window of {k} neighbouring frames: {frames} training frames have a pose and the longest run of \
         neighbours is {longest} frames; lower k, or correct the training list"
    )]
    NoWindows {
        /// The recording's folder.
        path: PathBuf,
        /// Frames in a window.
        k: usize,
        /// Training frames with a pose.
        frames: usize,
        /// Length of the longest run.
        longest: usize,
    },
    /// Rotations and shifts of the camera need its intrinsics.
    #[error(
        "the camera cannot be rotated or moved: {path} has no intrinsics; set `focal_px`, or leave out `views` and set \
         `rotation_deg` and `frame_rotation_deg` to 0"
    )]
    NoIntrinsics {
        /// The first image without.
        path: PathBuf,
    },
    /// A file cannot be read.
    #[error("cannot read {path}")]
    Read {
        /// The file.
        path: PathBuf,
        /// What the system said.
        #[source]
        source: std::io::Error,
    },
    /// A training image cannot be used.
    #[error("training frame {path} cannot be used: mend it or take it out of the training list")]
    Frame {
        /// The image.
        path: PathBuf,
        /// What is wrong with it.
        #[source]
        source: FrameError,
    },
    /// A rendered frame cannot be used.
    #[error("{name} cannot be brought to the network's input")]
    Rendered {
        /// The window.
        name: String,
        /// What is wrong.
        #[source]
        source: FrameError,
    },
    /// The synthetic place cannot be rendered.
    #[error("cannot render {name}")]
    Synth {
        /// The window.
        name: String,
        /// What is wrong.
        #[source]
        source: SynthError,
    },
    /// Windows do not fit together in one batch.
    #[error("{name} has {found} numbers and poses, {expected} expected as in the rest of its batch")]
    Shape {
        /// The window.
        name: String,
        /// Numbers and poses found.
        found: String,
        /// Numbers and poses expected.
        expected: String,
    },
    /// The batch's tensor cannot be made.
    #[error("cannot make the tensor of batch {batch}")]
    Tensor {
        /// Index of the batch.
        batch: u64,
        /// What the library says.
        #[source]
        source: candle_core::Error,
    },
    /// A fault of the program.
    #[error("making batch {batch} panicked: {reason}; this is a fault of the program, please report it")]
    Panicked {
        /// Index of the batch.
        batch: u64,
        /// The panic's message.
        reason: String,
    },
    /// Worker threads could not be started or ended by themselves.
    #[error("the data threads do not run: {reason}; lower `threads`")]
    Threads {
        /// What is known.
        reason: String,
    },
}

/// Why an image gave no network input.
#[derive(Debug, thiserror::Error)]
pub enum FrameError {
    /// It cannot be decoded.
    #[error(transparent)]
    Decode(#[from] DecodeError),
    /// The run-time preprocessing refuses it.
    #[error(transparent)]
    Preprocess(#[from] PreprocessError),
    /// Its buffer does not fit its size.
    #[error(transparent)]
    Pixels(#[from] grnet_frame::PixelsError),
}

impl DataError {
    pub(crate) fn option(
        option: &'static str,
        found: impl std::fmt::Display,
        expected: impl Into<String>,
    ) -> Self {
        Self::Option { option, found: found.to_string(), expected: expected.into() }
    }
}
