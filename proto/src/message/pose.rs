//! The pose sample: what the daemon publishes for every frame.

use iceoryx2::prelude::ZeroCopySend;

use super::{BootId, CaptureClock, ContentHash, FixedText, Reason, Status, layout::wire_struct};
use crate::CameraName;

/// Version of the messages of this build; it is also part of every type name.
pub const SCHEMA_VERSION: u32 = 1;

/// The number that means "unknown" where a number is not a floating-point number.
pub const UNKNOWN_U64: u64 = u64::MAX;

wire_struct! {
    /// A pose with its uncertainty; every number is NaN when it is not known.
    PoseWithCovariance, type_name = "grnet.PoseWithCovariance.v1", size = 224, align = 8 {
        /// Translation x, y, z in metres.
        0 => translation_m: [f64; 3],
        /// Unit quaternion x, y, z, w with w >= 0.
        24 => quaternion_xyzw: [f64; 4],
        /// Upper triangle, row by row, of the symmetric 6x6 covariance in the order
        /// [x, y, z, rotation about x, y, z] (m^2, m rad, rad^2), about the fixed axes of the parent
        /// frame: R_true = Exp(d_theta) R_estimate, t_true = t_estimate + d_t.
        56 => covariance_upper: [f64; 21],
    }
}

wire_struct! {
    /// How long each stage took, in microseconds; NaN when the stage did not run or was not measured.
    StageLatency, type_name = "grnet.StageLatency.v1", size = 24, align = 4 {
        /// From the capture of the frame until the worker took it.
        0 => wait_us: f32,
        /// Decoding, resizing, normalising.
        4 => preprocess_us: f32,
        /// The network.
        8 => infer_us: f32,
        /// Fusion of relative and global pose.
        12 => fuse_us: f32,
        /// From the end of fusion until the sample was handed to the transport.
        16 => publish_us: f32,
        /// From capture to publication; NaN for recorded time stamps.
        20 => total_us: f32,
    }
}

wire_struct! {
    /// One publication of the pose stream, on `grnet/<camera>/pose`.
    ///
    /// Frames are those of ROS REP-105: `map`, `odom`, `base` (x forward, y left, z up).
    PoseSample, type_name = "grnet.PoseSample.v1", size = 1280, align = 8 {
        /// Version of the message: [`SCHEMA_VERSION`].
        0 => schema_version: u32,
        /// How far the poses can be trusted.
        4 => status: Status,
        /// Why the status is what it is.
        8 => reason: Reason,
        /// The clock of `capture_time_ns`.
        12 => capture_clock: CaptureClock,
        /// This run of the daemon.
        16 => boot_id: BootId,
        /// SHA-256 of the network's weights.
        32 => model_hash: ContentHash,
        /// SHA-256 of the scene's weights; zero without a scene.
        64 => scene_hash: ContentHash,
        /// Name of the scene that `map` belongs to; empty without a scene.
        96 => scene: FixedText<64>,
        /// Name of the camera.
        160 => camera: FixedText<32>,
        /// Counts the publications of this boot, from 1; a gap is a sample this subscriber lost.
        192 => sample: u64,
        /// The source's frame counter; a gap is a dropped frame. [`UNKNOWN_U64`] without a frame.
        200 => sequence: u64,
        /// When the frame was captured, ns on `capture_clock`; [`UNKNOWN_U64`] without a frame.
        208 => capture_time_ns: u64,
        /// When the sample was published, ns on `CLOCK_MONOTONIC`.
        216 => publish_time_ns: u64,
        /// `CLOCK_REALTIME - CLOCK_MONOTONIC` at publication, ns: add it to a monotonic time to get
        /// nanoseconds since 1970.
        224 => realtime_offset_ns: i64,
        /// Frames dropped since the daemon started: queue full, corrupt or refused.
        232 => dropped_frames: u64,
        /// Counts the jumps of the odometry frame.
        240 => reset_epoch: u32,
        /// Landmarks that support the map pose; 0 where landmarks are not used.
        244 => landmark_inliers: u32,
        /// How long each stage took.
        248 => latency: StageLatency,
        /// Pose of the base in the scene's map: fused, may jump.
        272 => map_from_base: PoseWithCovariance,
        /// Pose of the base in the odometry frame: integrated motion, continuous within a `reset_epoch`.
        496 => odom_from_base: PoseWithCovariance,
        /// Motion from the frame before to this one.
        720 => previous_from_current: PoseWithCovariance,
        /// The fused network pose before refinement against landmarks; NaN where not used.
        944 => network_map_from_base: PoseWithCovariance,
        /// Linear velocity of the base, along its own axes, m/s.
        1168 => linear_velocity_in_base_mps: [f64; 3],
        /// Angular velocity of the base, about its own axes, rad/s.
        1192 => angular_velocity_in_base_radps: [f64; 3],
        /// Squared Mahalanobis distance between global pose and motion over 16.81, the 99 % point of
        /// chi-square with 6 degrees of freedom: below 0.5 is normal, above 1 is rejected.
        1216 => innovation_ratio: f64,
        /// Zero; room for later fields of this version.
        1224 => reserved: [u64; 7],
    }
}

impl PoseWithCovariance {
    /// A pose that is not known: NaN everywhere, never zero and never identity.
    pub const UNKNOWN: Self = Self {
        translation_m: [f64::NAN; 3],
        quaternion_xyzw: [f64::NAN; 4],
        covariance_upper: [f64::NAN; 21],
    };

    /// Is the pose (not necessarily its covariance) known?
    pub fn is_known(&self) -> bool {
        let quaternion_norm = self.quaternion_xyzw.iter().map(|q| q * q).sum::<f64>().sqrt();
        self.translation_m.iter().all(|t| t.is_finite()) && (quaternion_norm - 1.0).abs() < 1e-6
    }

    /// The covariance as 6 rows of 6.
    pub fn covariance(&self) -> [[f64; 6]; 6] {
        let mut matrix = [[0.0; 6]; 6];
        for ((row, column), &value) in upper_triangle().zip(&self.covariance_upper) {
            matrix[row][column] = value;
            matrix[column][row] = value;
        }
        matrix
    }

    /// Stores a symmetric covariance given as 6 rows of 6; the upper triangle is what counts.
    pub fn set_covariance(&mut self, matrix: &[[f64; 6]; 6]) {
        for ((row, column), value) in upper_triangle().zip(&mut self.covariance_upper) {
            *value = matrix[row][column];
        }
    }
}

impl StageLatency {
    /// Nothing was measured.
    pub const UNKNOWN: Self = Self {
        wait_us: f32::NAN,
        preprocess_us: f32::NAN,
        infer_us: f32::NAN,
        fuse_us: f32::NAN,
        publish_us: f32::NAN,
        total_us: f32::NAN,
    };
}

impl PoseSample {
    /// A sample without a pose: every unknown number is NaN or [`UNKNOWN_U64`]. Valid samples start
    /// from it too, so that what nobody fills in stays unknown.
    pub fn unknown(boot_id: BootId, camera: &CameraName, status: Status, reason: Reason) -> Self {
        Self {
            schema_version: SCHEMA_VERSION,
            status,
            reason,
            capture_clock: CaptureClock::UNKNOWN,
            boot_id,
            model_hash: ContentHash::NONE,
            scene_hash: ContentHash::NONE,
            scene: FixedText::EMPTY,
            camera: FixedText::new(camera.as_str()),
            sample: 0,
            sequence: UNKNOWN_U64,
            capture_time_ns: UNKNOWN_U64,
            publish_time_ns: UNKNOWN_U64,
            realtime_offset_ns: 0,
            dropped_frames: 0,
            reset_epoch: 0,
            landmark_inliers: 0,
            latency: StageLatency::UNKNOWN,
            map_from_base: PoseWithCovariance::UNKNOWN,
            odom_from_base: PoseWithCovariance::UNKNOWN,
            previous_from_current: PoseWithCovariance::UNKNOWN,
            network_map_from_base: PoseWithCovariance::UNKNOWN,
            linear_velocity_in_base_mps: [f64::NAN; 3],
            angular_velocity_in_base_radps: [f64::NAN; 3],
            innovation_ratio: f64::NAN,
            reserved: [0; 7],
        }
    }

    /// Time of capture in nanoseconds since 1970 for a camera, the recording's own time for a
    /// recording, `None` without a frame.
    pub fn capture_epoch_ns(&self) -> Option<i128> {
        match self.capture_clock {
            CaptureClock::MONOTONIC => {
                Some(i128::from(self.capture_time_ns) + i128::from(self.realtime_offset_ns))
            }
            CaptureClock::RECORDED => Some(i128::from(self.capture_time_ns)),
            _ => None,
        }
    }

    /// Stamps the sample just before it is published: `publish_time_ns`, `realtime_offset_ns`, and from
    /// them the total latency (cameras only: recorded time stamps are of another clock) and the
    /// latency of publishing since `fused_at_ns`.
    pub fn stamp_publication(&mut self, now: crate::clock::Now, fused_at_ns: Option<u64>) {
        self.publish_time_ns = now.monotonic_ns;
        self.realtime_offset_ns = now.realtime_offset_ns;
        let since_us =
            |earlier: u64| ((i128::from(now.monotonic_ns) - i128::from(earlier)) as f64 / 1e3) as f32;
        self.latency.publish_us = fused_at_ns.map_or(f32::NAN, since_us);
        self.latency.total_us = match self.capture_clock {
            CaptureClock::MONOTONIC => since_us(self.capture_time_ns),
            _ => f32::NAN,
        };
    }
}

/// (row, column) of the upper triangle of a 6x6 matrix, row by row.
fn upper_triangle() -> impl Iterator<Item = (usize, usize)> {
    (0..6).flat_map(|row| (row..6).map(move |column| (row, column)))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn camera() -> CameraName {
        "front".parse().unwrap()
    }

    #[test]
    fn an_unknown_sample_is_nan_everywhere() {
        let sample = PoseSample::unknown(BootId([7; 16]), &camera(), Status::LOST, Reason::NON_FINITE_OUTPUT);
        for pose in [
            sample.map_from_base,
            sample.odom_from_base,
            sample.previous_from_current,
            sample.network_map_from_base,
        ] {
            assert!(!pose.is_known());
            let numbers =
                pose.translation_m.iter().chain(&pose.quaternion_xyzw).chain(&pose.covariance_upper);
            assert!(numbers.into_iter().all(|number| number.is_nan()));
        }
        assert!(sample.innovation_ratio.is_nan());
        assert!(sample.latency.total_us.is_nan());
        assert_eq!(sample.capture_epoch_ns(), None);
    }

    #[test]
    fn zeros_are_no_pose() {
        let zeros = PoseWithCovariance {
            translation_m: [0.0; 3],
            quaternion_xyzw: [0.0; 4],
            covariance_upper: [0.0; 21],
        };
        assert!(!zeros.is_known());
    }

    #[test]
    fn covariance_survives_the_triangle() {
        let mut matrix = [[0.0; 6]; 6];
        for (row, values) in matrix.iter_mut().enumerate() {
            for (column, value) in values.iter_mut().enumerate() {
                *value = (row.min(column) * 10 + row.max(column)) as f64;
            }
        }
        let mut pose = PoseWithCovariance::UNKNOWN;
        pose.set_covariance(&matrix);
        assert_eq!(pose.covariance(), matrix);
        assert_eq!(pose.covariance_upper[..7], [0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 11.0]);
    }

    #[test]
    fn publication_is_stamped() {
        let mut sample = PoseSample::unknown(BootId::NONE, &camera(), Status::TRACKING, Reason::NONE);
        sample.capture_clock = CaptureClock::MONOTONIC;
        sample.capture_time_ns = 1_000_000;
        let now = crate::clock::Now { monotonic_ns: 3_500_000, realtime_offset_ns: 10_000_000_000 };
        sample.stamp_publication(now, Some(3_400_000));
        assert_eq!((sample.latency.total_us, sample.latency.publish_us), (2500.0, 100.0));
        assert_eq!(sample.capture_epoch_ns(), Some(10_001_000_000));
        sample.capture_clock = CaptureClock::RECORDED;
        sample.stamp_publication(now, None);
        assert!(sample.latency.total_us.is_nan() && sample.latency.publish_us.is_nan());
    }
}
