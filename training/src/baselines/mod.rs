//! What a learned method has to beat: poses predicted without the network, or with nothing of it but its features.
//!
//! | baseline | what it does | needs |
//! |---|---|---|
//! | [`nearest_pose`] | the training pose nearest to the true one: what retrieval could reach at best | poses |
//! | [`small_image`] | the pose of the training image that looks most alike at 32x24 grey pixels | images |
//! | [`cnn1`] | the same with the features of a checkpoint's CNN1, averaged over the image | images, a checkpoint |
//! | [`vlad`] | the same with a VLAD of dense gradient descriptors | images |
//! | [`interpolation`] | between the training frames before and after, by frame number; no image is looked at | frame numbers |
//! | [`motion`] | relative motion only: none at all, or that of the frames before again | true poses of the frames before |
//!
//! Pose regression that cannot beat retrieval has learnt nothing (Sattler et al., "Understanding the Limitations of
//! CNN-based Absolute Camera Pose Regression", CVPR 2019).

pub mod cnn1;
pub mod interpolation;
pub mod motion;
pub mod nearest_pose;
pub mod retrieval;
pub mod small_image;
pub mod vlad;

mod dense;
mod kmeans;
mod picture;
mod task;

use std::path::PathBuf;

use grnet_capture::decode::DecodeError;
use grnet_geometry::Pose;

pub use task::{Task, View};

/// Poses of the test frames, in their order; `None` where the method has no answer.
pub type Predictions = Vec<Option<Pose>>;

/// Told after every image that was looked at, so that a caller can show progress.
pub type Progress<'a> = &'a (dyn Fn() + Sync);

/// Why a baseline could not be computed.
#[derive(Debug, thiserror::Error)]
pub enum BaselineError {
    /// Retrieval has nothing to retrieve from.
    #[error("the {baseline} baseline needs training frames with a pose: there are none; give --train-list")]
    NoTrainingFrames {
        /// Name of the baseline.
        baseline: &'static str,
    },
    /// A training image cannot be read; a test image that cannot has no prediction instead.
    #[error("training image {path} cannot be used")]
    TrainingImage {
        /// The image.
        path: PathBuf,
        /// What is wrong with it.
        #[source]
        source: ImageError,
    },
    /// No training image shows any structure.
    #[error(
        "none of the {images} training images has a gradient anywhere: nothing can be told apart by VLAD"
    )]
    NoDescriptors {
        /// How many images were looked at.
        images: usize,
    },
}

/// Why an image could not be described.
#[derive(Debug, thiserror::Error)]
pub enum ImageError {
    /// It cannot be read.
    #[error(transparent)]
    Decode(#[from] DecodeError),
    /// Its pixel format is none that image files have.
    #[error("pixels are {found}, Gray8 or Rgb8 expected")]
    Format {
        /// The format found.
        found: String,
    },
    /// The network that describes it failed.
    #[error("{0}")]
    Network(String),
}
