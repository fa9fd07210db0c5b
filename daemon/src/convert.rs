//! Pipeline types to wire types and back: the only place that knows both.

use grnet_frame::{CaptureTime, Clock};
use grnet_geometry::{Covariance6, Pose, quaternion};
use grnet_pipeline as pipeline;
use grnet_proto::{
    BootId, CameraName, CaptureClock, ContentHash, ControlRequest, FixedText, PoseSample, PoseWithCovariance,
    Reason, Status,
};
use nalgebra::{Isometry3, Translation3, Vector3};

use crate::scenes::ModelIdentity;

/// A sample without a pose: unknown throughout, with the identity of the model.
pub fn absent(
    boot_id: BootId,
    camera: &CameraName,
    model: &ModelIdentity,
    status: Status,
    reason: Reason,
) -> PoseSample {
    let mut sample = PoseSample::unknown(boot_id, camera, status, reason);
    sample.model_hash = ContentHash(model.model_hash);
    if let Some(scene) = &model.scene {
        sample.scene_hash = ContentHash(scene.hash);
        sample.scene = FixedText::new(&scene.name);
    }
    sample
}

/// The sample of an estimate; what the publisher knows (times, counters) is left open.
///
/// A LOST sample carries no number of a pose, as the wire contract says, and an estimate whose numbers are not
/// finite is LOST whatever it calls itself.
pub fn pose_sample(
    boot_id: BootId,
    camera: &CameraName,
    model: &ModelIdentity,
    estimate: &pipeline::Estimate,
) -> PoseSample {
    let poses = [
        &estimate.map_from_base,
        &estimate.odom_from_base,
        &estimate.previous_from_current,
        &estimate.network_map_from_base,
    ];
    let finite = poses.iter().filter_map(|pose| pose.pose.as_ref()).all(is_finite);
    let (status, reason) = if finite {
        (status(estimate.status), reason(estimate.reason))
    } else {
        (Status::LOST, Reason::NON_FINITE_OUTPUT)
    };
    let mut sample = absent(boot_id, camera, model, status, reason);
    sample.sequence = estimate.sequence;
    (sample.capture_time_ns, sample.capture_clock) = capture_time(estimate.capture_time);
    sample.reset_epoch = estimate.reset_epoch;
    if status.may_have_pose() {
        sample.landmark_inliers = estimate.landmark_inliers;
        sample.innovation_ratio = estimate.innovation_ratio;
        sample.linear_velocity_in_base_mps = vector(estimate.linear_velocity_in_base_mps);
        sample.angular_velocity_in_base_radps = vector(estimate.angular_velocity_in_base_radps);
        [
            sample.map_from_base,
            sample.odom_from_base,
            sample.previous_from_current,
            sample.network_map_from_base,
        ] = poses.map(pose_with_covariance);
    }
    sample
}

/// The pose of a "the base is here" request.
///
/// # Errors
/// What is wrong with its numbers.
pub fn requested_pose(request: &ControlRequest) -> Result<(Pose, Covariance6), String> {
    let translation_m = request.map_from_base_translation_m;
    if !translation_m.iter().all(|value| value.is_finite()) {
        return Err(format!("the translation {translation_m:?} is not finite"));
    }
    let rotation = quaternion::from_xyzw(request.map_from_base_quaternion_xyzw)
        .map_err(|error| format!("the rotation cannot be used: {error}"))?;
    let pose = Isometry3::from_parts(Translation3::from(Vector3::from(translation_m)), rotation);
    let covariance = match (request.translation_stddev_m, request.rotation_stddev_rad) {
        (0.0, 0.0) => Covariance6::nan(),
        (translation_m, rotation_rad) if translation_m > 0.0 && rotation_rad > 0.0 => {
            let (t, r) = (translation_m * translation_m, rotation_rad * rotation_rad);
            Covariance6::from_diagonal([t, t, t, r, r, r])
        }
        (translation_m, rotation_rad) => {
            return Err(format!(
                "the standard deviations {translation_m} m and {rotation_rad} rad have to be both greater than 0, or \
                 both 0 when they are not known"
            ));
        }
    };
    if covariance.is_finite() || covariance.matrix().iter().all(|value| value.is_nan()) {
        Ok((pose, covariance))
    } else {
        Err("the standard deviations are too large".to_owned())
    }
}

fn capture_time(time: CaptureTime) -> (u64, CaptureClock) {
    let clock = match time.clock {
        Clock::Monotonic => CaptureClock::MONOTONIC,
        Clock::Recorded => CaptureClock::RECORDED,
    };
    (time.ns, clock)
}

fn pose_with_covariance(estimate: &pipeline::PoseEstimate) -> PoseWithCovariance {
    let Some(pose) = &estimate.pose else { return PoseWithCovariance::UNKNOWN };
    let mut wire = PoseWithCovariance {
        translation_m: pose.translation.vector.into(),
        quaternion_xyzw: quaternion::xyzw(&pose.rotation),
        ..PoseWithCovariance::UNKNOWN
    };
    if estimate.covariance.is_finite() {
        let matrix = estimate.covariance.matrix();
        wire.set_covariance(&std::array::from_fn(|row| std::array::from_fn(|column| matrix[(row, column)])));
    }
    wire
}

fn vector(value: Option<Vector3<f64>>) -> [f64; 3] {
    value.map_or([f64::NAN; 3], Into::into)
}

fn is_finite(pose: &Pose) -> bool {
    pose.translation.vector.iter().chain(pose.rotation.coords.iter()).all(|value| value.is_finite())
}

fn status(status: pipeline::Status) -> Status {
    match status {
        pipeline::Status::Initializing => Status::INITIALIZING,
        pipeline::Status::Tracking => Status::TRACKING,
        pipeline::Status::Degraded => Status::DEGRADED,
        pipeline::Status::Lost => Status::LOST,
    }
}

fn reason(reason: pipeline::Reason) -> Reason {
    use pipeline::Reason as R;
    match reason {
        R::None => Reason::NONE,
        R::NoScene => Reason::NO_SCENE,
        R::NoOdometry => Reason::NO_ODOMETRY,
        R::UntrainedModel => Reason::UNTRAINED_MODEL,
        R::NonFiniteOutput => Reason::NON_FINITE_OUTPUT,
        R::TimeJump | R::ClockChanged => Reason::TIME_JUMP,
        R::SourceReturned | R::OdometryReset | R::ModelSwapped => Reason::ODOMETRY_RESET,
        R::InnovationRejected => Reason::INNOVATION_REJECTED,
        R::Reinitialised => Reason::REINITIALIZED,
    }
}

#[cfg(test)]
mod tests {
    use grnet_geometry::Covariance6;
    use grnet_proto::{Command, UNKNOWN_U64};
    use nalgebra::UnitQuaternion;
    use proptest::prelude::*;

    use super::*;
    use crate::scenes::SceneIdentity;

    fn model() -> ModelIdentity {
        ModelIdentity {
            model_hash: [3; 32],
            name: "m.safetensors".into(),
            trained: true,
            scene: Some(SceneIdentity { name: "kitchen".into(), hash: [4; 32] }),
        }
    }

    fn estimate(pose: Option<Pose>, status: pipeline::Status) -> pipeline::Estimate {
        let known = |pose: Option<Pose>| match pose {
            Some(pose) => pipeline::PoseEstimate::known(
                pose,
                Covariance6::from_diagonal([1.0, 2.0, 3.0, 4.0, 5.0, 6.0]),
            ),
            None => pipeline::PoseEstimate::unknown(),
        };
        pipeline::Estimate {
            sequence: 7,
            capture_time: CaptureTime::recorded(11),
            status,
            reason: pipeline::Reason::None,
            reset_epoch: 2,
            map_from_base: known(pose),
            odom_from_base: known(pose),
            previous_from_current: pipeline::PoseEstimate::unknown(),
            network_map_from_base: known(pose),
            linear_velocity_in_base_mps: Some(Vector3::new(1.0, 0.0, 0.0)),
            angular_velocity_in_base_radps: None,
            innovation_ratio: 0.25,
            landmark_inliers: 0,
        }
    }

    fn convert(estimate: &pipeline::Estimate) -> PoseSample {
        pose_sample(BootId([1; 16]), &CameraName::default(), &model(), estimate)
    }

    #[test]
    fn a_known_estimate_arrives_whole() {
        let pose = Isometry3::from_parts(
            Translation3::new(1.0, 2.0, 3.0),
            UnitQuaternion::from_euler_angles(0.1, 0.2, 3.0),
        );
        let sample = convert(&estimate(Some(pose), pipeline::Status::Tracking));
        assert_eq!((sample.status, sample.reason), (Status::TRACKING, Reason::NONE));
        assert_eq!((sample.sequence, sample.capture_time_ns, sample.reset_epoch), (7, 11, 2));
        assert_eq!(sample.capture_clock, CaptureClock::RECORDED);
        assert_eq!(sample.map_from_base.translation_m, [1.0, 2.0, 3.0]);
        assert!(sample.map_from_base.quaternion_xyzw[3] >= 0.0 && sample.map_from_base.is_known());
        let covariance = sample.map_from_base.covariance();
        assert_eq!((covariance[0][0], covariance[5][5], covariance[0][5]), (1.0, 6.0, 0.0));
        assert!(!sample.previous_from_current.is_known());
        assert_eq!(sample.linear_velocity_in_base_mps, [1.0, 0.0, 0.0]);
        assert!(sample.angular_velocity_in_base_radps.iter().all(|value| value.is_nan()));
        assert!(
            sample.scene == "kitchen" && sample.scene_hash.0 == [4; 32] && sample.model_hash.0 == [3; 32]
        );
    }

    #[test]
    fn numbers_that_are_not_finite_never_leave_as_a_pose() {
        let pose = Isometry3::translation(f64::NAN, 0.0, 0.0);
        for pose in [pose, Isometry3::translation(0.0, f64::INFINITY, 0.0)] {
            let sample = convert(&estimate(Some(pose), pipeline::Status::Tracking));
            assert_eq!((sample.status, sample.reason), (Status::LOST, Reason::NON_FINITE_OUTPUT));
            assert!(sample.map_from_base.translation_m.iter().all(|value| value.is_nan()));
            assert!(sample.innovation_ratio.is_nan() && sample.linear_velocity_in_base_mps[0].is_nan());
            assert_eq!(sample.sequence, 7);
        }
    }

    #[test]
    fn a_lost_estimate_carries_no_numbers() {
        let sample = convert(&estimate(Some(Isometry3::identity()), pipeline::Status::Lost));
        assert_eq!(sample.status, Status::LOST);
        assert!(!sample.odom_from_base.is_known() && sample.odom_from_base.covariance_upper[0].is_nan());
    }

    #[test]
    fn an_unknown_covariance_stays_unknown() {
        let mut estimate = estimate(Some(Isometry3::identity()), pipeline::Status::Tracking);
        estimate.map_from_base.covariance = Covariance6::nan();
        let sample = convert(&estimate);
        assert!(sample.map_from_base.is_known());
        assert!(sample.map_from_base.covariance_upper.iter().all(|value| value.is_nan()));
    }

    #[test]
    fn an_absent_pose_has_no_frame() {
        let sample = absent(
            BootId([1; 16]),
            &CameraName::default(),
            &model(),
            Status::SOURCE_LOST,
            Reason::SOURCE_LOST,
        );
        assert_eq!((sample.sequence, sample.capture_time_ns), (UNKNOWN_U64, UNKNOWN_U64));
        assert!(!sample.map_from_base.is_known() && sample.scene == "kitchen");
    }

    #[test]
    fn requests_with_nonsense_are_refused() {
        assert!(requested_pose(&ControlRequest::new(Command::SET_POSE)).unwrap_err().contains("not finite"));
        let zero = ControlRequest::set_pose([0.0; 3], [0.0; 4]);
        assert!(requested_pose(&zero).unwrap_err().contains("rotation"));
        let here = ControlRequest::set_pose([1.0, 2.0, 3.0], [0.0, 0.0, 0.0, 1.0]);
        let (pose, covariance) = requested_pose(&here).unwrap();
        assert!(!covariance.is_finite());
        let (_, covariance) = requested_pose(&here.with_stddev(0.5, 0.25)).unwrap();
        assert_eq!(covariance, Covariance6::from_diagonal([0.25, 0.25, 0.25, 0.0625, 0.0625, 0.0625]));
        for (translation_m, rotation_rad) in [(0.5, 0.0), (-1.0, 1.0), (f64::NAN, 1.0), (f64::MAX, 1.0)] {
            assert!(
                requested_pose(&here.with_stddev(translation_m, rotation_rad)).is_err(),
                "{translation_m}"
            );
        }
        assert_eq!(pose, Isometry3::translation(1.0, 2.0, 3.0));
    }

    proptest! {
        #[test]
        fn poses_survive_the_wire(t in prop::array::uniform3(-1e3..1e3f64), a in prop::array::uniform3(-3.0..3.0f64)) {
            let pose = Isometry3::new(Vector3::from(t), Vector3::from(a));
            let wire = pose_with_covariance(&pipeline::PoseEstimate::known(pose, Covariance6::nan()));
            let (back, _) = requested_pose(&ControlRequest::set_pose(wire.translation_m, wire.quaternion_xyzw)).unwrap();
            prop_assert!((back.translation.vector - pose.translation.vector).norm() == 0.0);
            prop_assert!(back.rotation.angle_to(&pose.rotation) < 1e-7);
        }
    }
}
