//! What a pipeline can be told.

use grnet_frame::Camera;
use grnet_geometry::Pose;
use nalgebra::{Isometry3, Quaternion, Translation3, UnitQuaternion};

use crate::fuse::Rules;
use crate::preprocess::IntrinsicsOptions;

/// Options of a [`Pipeline`](crate::Pipeline); the defaults suit a forward-looking camera at 10 to 60 frames/s.
#[derive(Debug, Clone, PartialEq)]
pub struct PipelineOptions {
    /// Where the camera sits on the robot. The default turns optical axes (x right, y down, z forward) into
    /// REP-103 body axes (x forward, y left, z up) without translation.
    pub base_from_camera: Pose,
    /// Overrides the scene's own `map_from_world`; identity where neither says anything.
    pub map_from_world: Option<Pose>,
    /// Overrides the intrinsics that the frames carry; holds at the frames' size.
    pub camera: Option<Camera>,
    /// How intrinsics are compared with those of the training.
    pub intrinsics: IntrinsicsOptions,
    /// When relative motion is no longer believed.
    pub time: TimeOptions,
    /// When a global pose is no longer believed; `None` believes every one.
    pub gate: Option<InnovationGate>,
    /// Time constant in seconds of the mean that `map_from_base` is of accepted global poses, each moved by the odometry
    /// since; 0, the default, publishes them as they are. Long constants suit a network whose motion is better than its
    /// global pose is steady: views that its training came near to only now and then.
    pub map_smoothing_s: f64,
    /// Samples that are marked INITIALIZING after a start or a restart; the first one has no motion.
    pub initializing_frames: u32,
}

impl Default for PipelineOptions {
    fn default() -> Self {
        Self {
            base_from_camera: base_from_optical(),
            map_from_world: None,
            camera: None,
            intrinsics: IntrinsicsOptions::default(),
            time: TimeOptions::default(),
            gate: Some(InnovationGate::default()),
            map_smoothing_s: 0.0,
            initializing_frames: 1,
        }
    }
}

/// Rules for times of capture.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct TimeOptions {
    /// A frame that comes later than this after the one before starts the odometry anew.
    pub longest_gap_ns: u64,
    /// Frames that are not newer than the last one are refused; after this many of them in a row whose times
    /// grow among themselves, the clock is taken to have been set back and the odometry starts anew.
    /// `None` refuses for ever.
    pub refused_before_restart: Option<u32>,
}

impl Default for TimeOptions {
    fn default() -> Self {
        Self { longest_gap_ns: 1_000_000_000, refused_before_restart: Some(30) }
    }
}

/// When the global pose of a frame contradicts the last accepted one moved by the relative motion.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct InnovationGate {
    /// How many rejections in a row are ridden out on odometry; the next one has the consequence `then`.
    pub rejections_allowed: u32,
    /// What follows a run of rejections.
    pub then: AfterRejections,
    /// Global poses that have to agree with each other, one after the other, before LOST ends.
    pub agreements_to_recover: u32,
}

impl Default for InnovationGate {
    fn default() -> Self {
        Self { rejections_allowed: 10, then: AfterRejections::Reinitialise, agreements_to_recover: 3 }
    }
}

/// What follows a run of rejected global poses.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum AfterRejections {
    /// The map pose jumps to the network's, announced by [`Reason::Reinitialised`](crate::Reason::Reinitialised).
    Reinitialise,
    /// The map pose is LOST until global poses agree with each other or with the odometry again.
    Lost,
}

/// An option that cannot be used.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum OptionsError {
    /// A pose is not finite.
    #[error("{name} is not a finite pose: {found}")]
    Pose {
        /// Which option.
        name: &'static str,
        /// What was given.
        found: Pose,
    },
    /// A number is out of range.
    #[error("{name} is {found}, {allowed} expected")]
    Range {
        /// Which option.
        name: &'static str,
        /// What was given.
        found: f64,
        /// What is allowed.
        allowed: &'static str,
    },
}

impl PipelineOptions {
    pub(crate) fn rules(&self) -> Rules {
        let Self { gate, map_smoothing_s, initializing_frames, .. } = *self;
        Rules { gate, map_smoothing_s, initializing_frames }
    }

    pub(crate) fn validate(&self) -> Result<(), OptionsError> {
        check_pose("base_from_camera", &self.base_from_camera)?;
        if let Some(pose) = &self.map_from_world {
            check_pose("map_from_world", pose)?;
        }
        let range = |name, found: f64, ok: bool, allowed| {
            if ok { Ok(()) } else { Err(OptionsError::Range { name, found, allowed }) }
        };
        let IntrinsicsOptions { tolerance, least_coverage, .. } = self.intrinsics;
        let fine = tolerance.is_finite() && tolerance >= 0.0;
        range("intrinsics.tolerance", tolerance, fine, "a number of at least 0")?;
        let fine = (0.0..=1.0).contains(&least_coverage);
        range("intrinsics.least_coverage", least_coverage, fine, "a share between 0 and 1")?;
        let smoothing_s = self.map_smoothing_s;
        let fine = smoothing_s.is_finite() && smoothing_s >= 0.0;
        range("map_smoothing_s", smoothing_s, fine, "a number of at least 0")?;
        let gap_ns = self.time.longest_gap_ns;
        range("time.longest_gap_ns", gap_ns as f64, gap_ns > 0, "a positive number")
    }
}

/// Refuses poses with NaN or infinite parts.
pub(crate) fn check_pose(name: &'static str, pose: &Pose) -> Result<(), OptionsError> {
    if is_finite(pose) { Ok(()) } else { Err(OptionsError::Pose { name, found: *pose }) }
}

/// Whether every number of a pose is finite.
pub(crate) fn is_finite(pose: &Pose) -> bool {
    pose.translation.vector.iter().chain(pose.rotation.coords.iter()).all(|x| x.is_finite())
}

fn base_from_optical() -> Pose {
    // Columns: where optical x, y, z point in the body: -y, -z, x.
    let rotation = UnitQuaternion::from_quaternion(Quaternion::new(0.5, -0.5, 0.5, -0.5));
    Isometry3::from_parts(Translation3::identity(), rotation)
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;

    use super::*;

    #[test]
    fn the_default_camera_looks_forward() {
        let base_from_camera = PipelineOptions::default().base_from_camera;
        let body = |v: [f64; 3]| base_from_camera * Vector3::from(v);
        assert_eq!(body([0.0, 0.0, 1.0]), Vector3::x());
        assert_eq!(body([1.0, 0.0, 0.0]), -Vector3::y());
        assert_eq!(body([0.0, 1.0, 0.0]), -Vector3::z());
    }

    #[test]
    fn unusable_options_are_refused_by_name() {
        let broken = PipelineOptions {
            map_from_world: Some(Isometry3::translation(f64::NAN, 0.0, 0.0)),
            ..PipelineOptions::default()
        };
        assert!(
            broken.validate().unwrap_err().to_string().starts_with("map_from_world is not a finite pose")
        );
        let mut broken = PipelineOptions::default();
        broken.intrinsics.least_coverage = 1.5;
        let error = broken.validate().unwrap_err().to_string();
        assert_eq!(error, "intrinsics.least_coverage is 1.5, a share between 0 and 1 expected");
        let broken = PipelineOptions { map_smoothing_s: -0.1, ..PipelineOptions::default() };
        let error = broken.validate().unwrap_err().to_string();
        assert_eq!(error, "map_smoothing_s is -0.1, a number of at least 0 expected");
        assert!(PipelineOptions::default().validate().is_ok());
    }
}
