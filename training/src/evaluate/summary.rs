//! What `scores.json` holds.

use grnet_geometry::scores::calibration::Calibration;
use grnet_geometry::scores::kitti::LengthRow;
use serde::{Deserialize, Serialize};

use super::{Data, Kind, Knowledge, System};

/// Version of `scores.json`; grows with every change that a reader could stumble over.
pub const SCHEMA: u32 = 1;

/// An evaluation: the figures, and the predictions that they were computed from.
#[derive(Debug, Clone)]
pub struct Evaluation {
    /// The recording.
    pub data: Data,
    /// Everything that was judged; the same order as in the summary.
    pub systems: Vec<System>,
    /// The figures.
    pub summary: Summary,
}

/// The content of `scores.json`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Summary {
    /// [`SCHEMA`].
    pub schema: u32,
    /// Version of the program.
    pub generator: String,
    /// Names of the sequences that were tested on.
    pub sequences: Vec<String>,
    /// Number of training frames with a pose.
    pub train_frames: usize,
    /// Number of test frames.
    pub test_frames: usize,
    /// Number of test frames with a true pose: those that can be judged.
    pub judged_frames: usize,
    /// Number of test blocks; recurrent state was reset on the first frame of each.
    pub test_blocks: usize,
    /// Length of the true path within the blocks, metres.
    pub path_m: f64,
    /// Frames between the two ends of a relative motion.
    pub gap_frames: usize,
    /// What a reader should know about the recording.
    pub notes: Vec<String>,
    /// The models.
    pub models: Vec<ModelInfo>,
    /// The figures, models first.
    pub systems: Vec<SystemScores>,
}

/// A model that was judged.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ModelInfo {
    /// What tables call it.
    pub name: String,
    /// File names of the checkpoint and its scene.
    pub files: Vec<String>,
    /// SHA-256 over the weights in use, hexadecimal.
    pub model_hash: String,
    /// Whether the weights were trained; the figures of untrained ones say what chance gives.
    pub trained: bool,
    /// Name of the scene, where it has one.
    pub scene: Option<String>,
    /// Input size, width and height in pixels.
    pub input_px: (usize, usize),
    /// Number of parameters of the whole network.
    pub parameters: usize,
    /// Test frames for which the pipeline gave no estimate.
    pub failed_frames: usize,
    /// Restarts of the odometry within test blocks.
    pub odometry_restarts: usize,
    /// What went wrong, and what the pipeline notes.
    pub notes: Vec<String>,
}

/// What a system is, without its predictions.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SystemInfo {
    /// What tables call it.
    pub name: String,
    /// Name of its folder below `trajectories`.
    pub slug: String,
    /// What it is.
    pub kind: Kind,
    /// What of the test frames' truth it is told.
    pub knowledge: Knowledge,
    /// One sentence for readers.
    pub about: String,
    /// Index in [`Summary::models`].
    pub model: Option<usize>,
}

/// The figures of one system.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SystemScores {
    /// What it is.
    pub system: SystemInfo,
    /// Over all test frames.
    pub overall: Scores,
    /// By sequence; empty when there is only one.
    pub by_sequence: Vec<SequenceScores>,
}

/// The figures of one sequence.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SequenceScores {
    /// Its name.
    pub sequence: String,
    /// The figures.
    pub scores: Scores,
}

/// Figures over a set of test frames; `null` where one is not defined.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Scores {
    /// Frames with a true pose.
    pub frames: usize,
    /// Of these, frames with a predicted pose; the others enter the recalls only, as not recalled.
    pub valid: usize,
    /// Median distance of the positions over the valid frames, metres.
    pub median_translation_m: Option<f64>,
    /// Median angle between the orientations over the valid frames, degrees.
    pub median_rotation_deg: Option<f64>,
    /// Share of all frames within 5 cm and 5 deg.
    pub recall_5cm_5deg: Option<f64>,
    /// Share of all frames within 25 cm and 10 deg.
    pub recall_25cm_10deg: Option<f64>,
    /// Absolute trajectory error, root mean square, metres; sequences are aligned one by one.
    pub ate: Ate,
    /// Relative pose error between neighbouring frames, root mean square of the translation, metres.
    pub rpe_translation_m: Option<f64>,
    /// Relative pose error between neighbouring frames, root mean square of the angle, degrees.
    pub rpe_rotation_deg: Option<f64>,
    /// KITTI's segment errors, where blocks are long enough.
    pub kitti: Option<KittiScores>,
    /// The same over a hundredth of the lengths.
    pub drift: Option<Drift>,
    /// Error of the motion over the gap.
    pub motion: Option<Motion>,
    /// Whether the covariances mean what they say, where there are any.
    pub calibration: Option<Calibration>,
}

/// Absolute trajectory error after no, a rigid and a similarity alignment.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Ate {
    /// As predicted.
    pub none_m: Option<f64>,
    /// After the best rotation and translation.
    pub se3_m: Option<f64>,
    /// After the best rotation, translation and scale.
    pub sim3_m: Option<f64>,
}

/// KITTI's segment errors: mean over all segments of 100 to 800 m within blocks.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct KittiScores {
    /// Number of segments.
    pub segments: usize,
    /// Translation error, per cent.
    pub t_rel_percent: f64,
    /// Rotation error, degrees per 100 m.
    pub r_rel_deg_per_100m: f64,
    /// By length.
    pub per_length: Vec<LengthRow>,
}

/// KITTI's segment errors at the scale of a room: mean over all segments of 1 to 8 m within blocks.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Drift {
    /// Number of segments.
    pub segments: usize,
    /// Translation error, per cent.
    pub t_rel_percent: f64,
    /// Rotation error, degrees per metre.
    pub r_rel_deg_per_m: f64,
}

/// Error of the motion between two frames of one block.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Motion {
    /// Pairs with a predicted and a true motion.
    pub pairs: usize,
    /// Pairs with a true motion.
    pub all_pairs: usize,
    /// Median of the translational part, metres.
    pub median_translation_m: f64,
    /// Median of the angle, degrees.
    pub median_rotation_deg: f64,
}
