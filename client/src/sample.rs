//! A received pose sample with types that cannot be mistaken.

use grnet_geometry::{
    Covariance6, Pose,
    nalgebra::{Matrix6, Translation3, Vector3},
    quaternion,
};
use grnet_proto::{
    BootId, CaptureClock, PoseSample, PoseWithCovariance, Reason, StageLatency, Status, UNKNOWN_U64,
    clock::Now,
};

/// When a frame was captured.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct CaptureTime {
    /// Nanoseconds on `clock`.
    pub ns: u64,
    /// The clock.
    pub clock: CaptureClock,
}

/// A pose sample as received: what is not known is `None`, never zero.
///
/// Frames are those of ROS REP-105: `map`, `odom`, and `base` with x forward, y left, z up.
#[derive(Debug, Clone, PartialEq)]
pub struct Sample {
    raw: Box<PoseSample>,
    received_ns: u64,
}

impl Sample {
    /// The sample in these bytes, received now.
    pub fn new(raw: PoseSample) -> Self {
        Self { raw: Box::new(raw), received_ns: Now::read().monotonic_ns }
    }

    /// The message itself.
    pub fn raw(&self) -> &PoseSample {
        &self.raw
    }

    /// When this process received the sample, ns on `CLOCK_MONOTONIC`.
    pub fn received_ns(&self) -> u64 {
        self.received_ns
    }

    /// How far the poses can be trusted.
    pub fn status(&self) -> Status {
        self.raw.status
    }

    /// Why the status is what it is.
    pub fn reason(&self) -> Reason {
        self.raw.reason
    }

    /// The run of the daemon that published the sample.
    pub fn boot_id(&self) -> BootId {
        self.raw.boot_id
    }

    /// The source's frame counter, `None` without a frame.
    pub fn sequence(&self) -> Option<u64> {
        Some(self.raw.sequence).filter(|&sequence| sequence != UNKNOWN_U64)
    }

    /// When the frame was captured, `None` without a frame.
    pub fn capture_time(&self) -> Option<CaptureTime> {
        let clock = self.raw.capture_clock;
        matches!(clock, CaptureClock::MONOTONIC | CaptureClock::RECORDED)
            .then_some(CaptureTime { ns: self.raw.capture_time_ns, clock })
    }

    /// When the frame was captured, in nanoseconds since 1970 for a camera, in the recording's own time
    /// for a recording.
    pub fn capture_epoch_ns(&self) -> Option<i64> {
        i64::try_from(self.raw.capture_epoch_ns()?).ok()
    }

    /// When the sample was published, in nanoseconds since 1970; `None` when the daemon did not say.
    pub fn publish_epoch_ns(&self) -> Option<i64> {
        let published = i64::try_from(self.raw.publish_time_ns).ok()?;
        published.checked_add(self.raw.realtime_offset_ns)
    }

    /// Pose of the base in the scene's map: fused, may jump.
    pub fn map_from_base(&self) -> Option<Pose> {
        self.pose(&self.raw.map_from_base)
    }

    /// Pose of the base in the odometry frame: continuous within one [`reset_epoch`](Self::reset_epoch).
    pub fn odom_from_base(&self) -> Option<Pose> {
        self.pose(&self.raw.odom_from_base)
    }

    /// Motion from the frame before to this one.
    pub fn previous_from_current(&self) -> Option<Pose> {
        self.pose(&self.raw.previous_from_current)
    }

    /// The network's map pose before refinement against landmarks.
    pub fn network_map_from_base(&self) -> Option<Pose> {
        self.pose(&self.raw.network_map_from_base)
    }

    /// Covariance of [`map_from_base`](Self::map_from_base), `None` when it is not known.
    pub fn map_covariance(&self) -> Option<Covariance6> {
        self.covariance(&self.raw.map_from_base)
    }

    /// Covariance of [`odom_from_base`](Self::odom_from_base), `None` when it is not known.
    pub fn odom_covariance(&self) -> Option<Covariance6> {
        self.covariance(&self.raw.odom_from_base)
    }

    /// Covariance of [`previous_from_current`](Self::previous_from_current), `None` when it is not known.
    pub fn motion_covariance(&self) -> Option<Covariance6> {
        self.covariance(&self.raw.previous_from_current)
    }

    /// Linear velocity of the base along its own axes, m/s.
    pub fn linear_velocity_in_base_mps(&self) -> Option<Vector3<f64>> {
        self.vector(self.raw.linear_velocity_in_base_mps)
    }

    /// Angular velocity of the base about its own axes, rad/s.
    pub fn angular_velocity_in_base_radps(&self) -> Option<Vector3<f64>> {
        self.vector(self.raw.angular_velocity_in_base_radps)
    }

    /// How much the global pose contradicts the motion: below 0.5 is normal, above 1 was rejected.
    pub fn innovation_ratio(&self) -> Option<f64> {
        Some(self.raw.innovation_ratio).filter(|ratio| ratio.is_finite())
    }

    /// Name of the scene that the map belongs to.
    pub fn scene(&self) -> Option<String> {
        (!self.raw.scene.is_empty()).then(|| self.raw.scene.to_string())
    }

    /// Counts the jumps of the odometry frame.
    pub fn reset_epoch(&self) -> u32 {
        self.raw.reset_epoch
    }

    /// Frames the daemon dropped since it started.
    pub fn dropped_frames(&self) -> u64 {
        self.raw.dropped_frames
    }

    /// How long each stage took; NaN where it is not known.
    pub fn latency(&self) -> StageLatency {
        self.raw.latency
    }

    /// From publication to reception, in microseconds.
    pub fn transport_latency_us(&self) -> f64 {
        (i128::from(self.received_ns) - i128::from(self.raw.publish_time_ns)) as f64 / 1e3
    }

    /// A pose counts only when the status admits one, every number is finite and the quaternion is one:
    /// the bytes come from another process.
    fn pose(&self, pose: &PoseWithCovariance) -> Option<Pose> {
        if !self.raw.status.may_have_pose() || !pose.is_known() {
            return None;
        }
        let rotation = quaternion::from_xyzw(pose.quaternion_xyzw).ok()?;
        Some(Pose::from_parts(Translation3::from(Vector3::from(pose.translation_m)), rotation))
    }

    fn covariance(&self, pose: &PoseWithCovariance) -> Option<Covariance6> {
        self.pose(pose)?;
        let rows = pose.covariance();
        Some(Covariance6::new(Matrix6::from_fn(|row, column| rows[row][column])))
            .filter(Covariance6::is_finite)
    }

    fn vector(&self, vector: [f64; 3]) -> Option<Vector3<f64>> {
        (self.raw.status.may_have_pose() && vector.iter().all(|v| v.is_finite()))
            .then(|| Vector3::from(vector))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn raw(status: Status) -> PoseSample {
        let mut raw = PoseSample::unknown(BootId([1; 16]), &"front".parse().unwrap(), status, Reason::NONE);
        raw.map_from_base.translation_m = [1.0, 2.0, 3.0];
        raw.map_from_base.quaternion_xyzw = [0.0, 0.0, 0.6, 0.8];
        raw
    }

    #[test]
    fn known_numbers_become_types() {
        let sample = Sample::new(raw(Status::TRACKING));
        let map_from_base = sample.map_from_base().unwrap();
        assert_eq!(map_from_base.translation.vector, Vector3::new(1.0, 2.0, 3.0));
        assert_eq!(quaternion::xyzw(&map_from_base.rotation), [0.0, 0.0, 0.6, 0.8]);
        assert_eq!(sample.map_covariance(), None, "a pose without covariance");
        let mut raw = raw(Status::TRACKING);
        raw.map_from_base.covariance_upper = std::array::from_fn(|i| i as f64);
        let covariance = Sample::new(raw).map_covariance().unwrap();
        assert_eq!((covariance.matrix()[(0, 5)], covariance.matrix()[(5, 0)]), (5.0, 5.0));
        assert_eq!(covariance.matrix()[(5, 5)], 20.0);
    }

    #[test]
    fn what_is_unknown_is_none() {
        let sample = Sample::new(raw(Status::TRACKING));
        assert_eq!(sample.odom_from_base(), None);
        assert_eq!(sample.previous_from_current(), None);
        assert_eq!(sample.sequence(), None);
        assert_eq!(sample.capture_time(), None);
        assert_eq!(sample.capture_epoch_ns(), None);
        assert_eq!(sample.publish_epoch_ns(), None);
        assert_eq!(sample.linear_velocity_in_base_mps(), None);
        assert_eq!(sample.innovation_ratio(), None);
        assert_eq!(sample.scene(), None);
    }

    #[test]
    fn a_lost_sample_has_no_pose_whatever_its_bytes() {
        for status in [Status::LOST, Status::SOURCE_LOST, Status::UNKNOWN, Status(99)] {
            assert_eq!(Sample::new(raw(status)).map_from_base(), None);
        }
        let mut bent = raw(Status::TRACKING);
        bent.map_from_base.quaternion_xyzw = [0.0, 0.0, 0.6, 0.9];
        assert_eq!(Sample::new(bent).map_from_base(), None);
    }
}
