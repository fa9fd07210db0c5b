//! What one step gives.

use std::fmt;

use grnet_frame::CaptureTime;
use grnet_geometry::{Covariance6, Pose};
use nalgebra::Vector3;

/// A pose and how well it is known.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PoseEstimate {
    /// The pose; `None` when it is not known.
    pub pose: Option<Pose>,
    /// Covariance, [translation, rotation] about the fixed axes of the parent frame; NaN when not known.
    pub covariance: Covariance6,
}

impl PoseEstimate {
    /// A pose that is not known.
    pub fn unknown() -> Self {
        Self { pose: None, covariance: Covariance6::nan() }
    }

    /// A known pose; a covariance that is not finite throughout becomes NaN throughout.
    pub fn known(pose: Pose, covariance: Covariance6) -> Self {
        let covariance = if covariance.is_finite() { covariance } else { Covariance6::nan() };
        Self { pose: Some(pose), covariance }
    }
}

/// How far a sample can be trusted.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Status {
    /// The first samples after a start or a restart: no motion is known yet.
    Initializing,
    /// Everything that the model offers is there.
    Tracking,
    /// Numbers are there, a promise is missing; see the reason.
    Degraded,
    /// The pose is not known.
    Lost,
}

/// Why a sample has its status.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Reason {
    /// Nothing to report.
    None,
    /// No scene is loaded: `map_from_base` is not known, unless it was set and follows odometry.
    NoScene,
    /// The model has no live relative head: `odom_from_base` is not known.
    NoOdometry,
    /// The weights were never trained: the numbers mean nothing.
    UntrainedModel,
    /// The network gave NaN, infinity or a rotation that cannot be normalised.
    NonFiniteOutput,
    /// The time of capture jumped: odometry started anew.
    TimeJump,
    /// The source uses another clock than before: odometry started anew.
    ClockChanged,
    /// The source was lost and came back: odometry started anew.
    SourceReturned,
    /// Somebody asked for it: odometry started anew.
    OdometryReset,
    /// Another model was loaded: odometry started anew.
    ModelSwapped,
    /// The network's global pose contradicts the motion: `map_from_base` follows odometry, or is lost.
    InnovationRejected,
    /// After a run of contradictions `map_from_base` jumped to the network's pose.
    Reinitialised,
}

impl fmt::Display for Reason {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::None => "none",
            Self::NoScene => "no scene is loaded",
            Self::NoOdometry => "the model has no relative head",
            Self::UntrainedModel => "the model is not trained",
            Self::NonFiniteOutput => "the network's output is not a pose",
            Self::TimeJump => "the time of capture jumped",
            Self::ClockChanged => "the source's clock changed",
            Self::SourceReturned => "the source was lost",
            Self::OdometryReset => "the odometry was reset",
            Self::ModelSwapped => "another model was loaded",
            Self::InnovationRejected => "the global pose contradicts the motion",
            Self::Reinitialised => "the map pose was initialised again",
        })
    }
}

/// The result of one frame.
///
/// What is not known is `None` or NaN, never zero and never the identity. When the status is
/// [`Status::Lost`] because of the network's output, every pose is unknown; when it is lost because of
/// contradictions ([`Reason::InnovationRejected`]), the map poses are and the odometry goes on.
#[derive(Debug, Clone, PartialEq)]
pub struct Estimate {
    /// The frame's sequence number.
    pub sequence: u64,
    /// When the frame was captured.
    pub capture_time: CaptureTime,
    /// How far the sample can be trusted.
    pub status: Status,
    /// Why.
    pub reason: Reason,
    /// Counts every jump of the odometry frame.
    pub reset_epoch: u32,
    /// The body in the map: the fused network pose, or the last accepted one moved by the odometry; with
    /// [`map_smoothing_s`](crate::PipelineOptions::map_smoothing_s) a mean of such poses. May jump.
    pub map_from_base: PoseEstimate,
    /// The body in the odometry frame: integrated relative motion. Continuous within one `reset_epoch`;
    /// identity with zero covariance where it starts, for there it is the origin by definition.
    pub odom_from_base: PoseEstimate,
    /// The body now in the body at the last processed frame; unknown on the first frame after a restart.
    pub previous_from_current: PoseEstimate,
    /// The fused network pose of this frame (the global one for a model without fusion), before any gate or mean.
    pub network_map_from_base: PoseEstimate,
    /// Mean linear velocity in body axes since the last key frame that is at least a keyframe interval old (just after a
    /// start, since the first frame); where every frame is a key frame, since the last frame.
    pub linear_velocity_in_base_mps: Option<Vector3<f64>>,
    /// Mean angular velocity in body axes over the same time.
    pub angular_velocity_in_base_radps: Option<Vector3<f64>>,
    /// `v^T S^-1 v / 16.81`: below 0.5 normal, above 1 rejected; NaN when a covariance or a prediction is missing.
    pub innovation_ratio: f64,
    /// Landmarks that agree with the refined pose; 0 where no landmarks are used.
    pub landmark_inliers: u32,
}

/// A stage of [`Pipeline::step`](crate::Pipeline::step).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Stage {
    /// Frame to network input.
    Preprocess,
    /// The network.
    Infer,
    /// Network output to estimate.
    Fuse,
}

/// Told when a stage begins, so that a caller with a clock can measure.
pub trait StageObserver {
    /// The stage begins now; the one before has ended.
    fn enter(&mut self, stage: Stage);
}

/// For callers that do not care.
#[derive(Debug, Clone, Copy, Default)]
pub struct NoObserver;

impl StageObserver for NoObserver {
    fn enter(&mut self, _stage: Stage) {}
}
