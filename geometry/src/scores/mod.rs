//! Scores of estimated trajectories, equal to the public tools.
//!
//! | module | score | equal to |
//! |---|---|---|
//! | [`kitti`] | t_rel (%), r_rel (deg/100 m) over segments of 100 to 800 m | KITTI devkit, `kitti-odom-eval` |
//! | [`ate`] | absolute trajectory error, with a choice of alignments | `evo_ape` |
//! | [`rpe`] | relative pose error by frames or metres | `evo_rpe` |
//! | [`relocalization`] | median errors, recall at 5 cm / 5 deg | 7-Scenes literature |
//! | [`calibration`] | NEES, coverage of the published covariance | - |
//!
//! What happens at the edges: lists of different length and empty lists are errors ([`ScoreError`]); one pose has an
//! absolute error but no relative one ([`ScoreError::NoPairs`]) and no alignment
//! ([`AlignmentError::Degenerate`]); a trajectory that stands still has relative
//! errors by frames but no KITTI segment and no pair by metres; missing frames are skipped by [`kitti`] as
//! `kitti-odom-eval` does, and counted.

use thiserror::Error;

use crate::{Pose, align::AlignmentError};

pub mod ate;
pub mod calibration;
pub mod kitti;
pub mod relocalization;
pub mod rpe;

/// Why a score is not defined.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum ScoreError {
    /// The lists of poses are not paired.
    #[error(
        "a score compares poses in pairs, found {reference} of the ground truth and {estimate} of the estimate"
    )]
    LengthMismatch {
        /// Poses of the ground truth.
        reference: usize,
        /// Poses of the estimate.
        estimate: usize,
    },
    /// There is nothing to compare.
    #[error("no pose to compare")]
    Empty,
    /// The alignment that the score asks for is not determined.
    #[error(transparent)]
    Alignment(#[from] AlignmentError),
    /// No two poses are as far apart as asked.
    #[error("no two of the {poses} poses are {delta} apart")]
    NoPairs {
        /// Number of poses.
        poses: usize,
        /// The distance, with its unit.
        delta: String,
    },
    /// An option is out of range.
    #[error("{option} is {found}, expected {expected}")]
    Option {
        /// Name of the option.
        option: &'static str,
        /// Its value.
        found: String,
        /// The allowed values.
        expected: &'static str,
    },
    /// The ground truth lacks a frame.
    #[error("the ground truth has no frame {missing}, expected every frame from {first} to {last}")]
    GroundTruthGap {
        /// The first missing frame.
        missing: u64,
        /// First frame of the ground truth.
        first: u64,
        /// Last frame of the ground truth.
        last: u64,
    },
    /// The estimate has a frame that the ground truth does not know.
    #[error("the estimate has frame {frame}, the ground truth only frames {first} to {last}")]
    UnknownFrame {
        /// The frame.
        frame: u64,
        /// First frame of the ground truth.
        first: u64,
        /// Last frame of the ground truth.
        last: u64,
    },
}

pub(crate) fn check_paired(reference: &[Pose], estimate: &[Pose]) -> Result<(), ScoreError> {
    if reference.len() != estimate.len() {
        return Err(ScoreError::LengthMismatch { reference: reference.len(), estimate: estimate.len() });
    }
    if reference.is_empty() { Err(ScoreError::Empty) } else { Ok(()) }
}
