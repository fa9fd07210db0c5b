//! Judging checkpoints on a recording with ground truth, beside the [baselines](crate::baselines).
//!
//! Frames go through [`grnet_pipeline::Pipeline::step`], the code of the daemon, with the body axes put onto the camera's
//! and the map onto the recording's world. Recurrent state is reset on the first frame of every test block, and nothing
//! outside the test list is shown. A frame without a pose stays without: it lowers the coverage and the recall, and
//! never counts as a zero.

pub mod command;
mod data;
mod methods;
mod play;
mod score;
mod summary;
mod system;

#[cfg(test)]
pub(crate) use score::tests::{drive, system as drive_system};

use std::path::PathBuf;

use grnet_capture::dataset::DatasetError;
use grnet_frame::SourceError;
use grnet_model::CheckpointError;
use grnet_pipeline::PipelineError;

pub use data::{Data, DataOptions};
pub use methods::{BaselineName, NamedModel, add_baselines, add_model};
pub use play::{Played, play};
pub use score::{FrameError, frame_errors, score, sorted_nees};
pub use summary::{
    Ate, Drift, Evaluation, KittiScores, ModelInfo, Motion, SCHEMA, Scores, SequenceScores, Summary,
    SystemInfo, SystemScores,
};
pub use system::{Kind, Knowledge, System, slug};

use crate::baselines::BaselineError;

/// Why an evaluation could not be made.
#[derive(Debug, thiserror::Error)]
pub enum EvaluateError {
    /// The recording cannot be opened.
    #[error("cannot open the recording to evaluate on")]
    Dataset(#[from] DatasetError),
    /// The recording has no poses to compare with.
    #[error(
        "none of the {frames} test frames of {path} has a true pose: give a trajectory of this camera with --poses"
    )]
    NoTruth {
        /// The recording's folder.
        path: PathBuf,
        /// Number of test frames.
        frames: usize,
    },
    /// Training and test frames are the same.
    #[error("{count} frames are both trained and tested on, {example} for one: correct the lists")]
    Overlap {
        /// How many.
        count: usize,
        /// One of them.
        example: PathBuf,
    },
    /// A checkpoint cannot be loaded.
    #[error("cannot load {path}")]
    Checkpoint {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        #[source]
        source: Box<CheckpointError>,
    },
    /// A model cannot be run on this recording.
    #[error("cannot run {model} on {recording}")]
    Pipeline {
        /// Name of the model.
        model: String,
        /// Name of the recording.
        recording: String,
        /// What is wrong.
        #[source]
        source: Box<PipelineError>,
    },
    /// The frames cannot be played.
    #[error("cannot play the test frames")]
    Source(#[from] SourceError),
    /// A baseline cannot be computed.
    #[error(transparent)]
    Baseline(#[from] BaselineError),
}
