//! Head outputs to an estimate: odometry, map pose, covariances, velocities, status. Knows no network and no
//! pixels, so it can be tested on made-up outputs.

mod heads;
mod map;
mod odometry;

use grnet_frame::CaptureTime;
use grnet_geometry::{Covariance6, Pose, se3};
use grnet_model::{HeadOutput, StepOutput};
use nalgebra::Vector3;

use crate::estimate::{Estimate, PoseEstimate, Reason, Status};
use crate::options::InnovationGate;
use heads::{NotAPose, Uncertain};
use map::{MapTracker, MapUpdate, Verdict};
use odometry::Odometry;

/// What of the model matters to the fusion.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct ModelTraits {
    pub(crate) is_trained: bool,
    /// There is a live relative head.
    pub(crate) has_odometry: bool,
    /// There is a live global or fused head.
    pub(crate) has_scene: bool,
    /// Velocities are means over this long at least.
    pub(crate) keyframe_interval_s: f64,
    pub(crate) map_from_world: Pose,
}

/// Options that may change between two frames.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Rules {
    pub(crate) gate: Option<InnovationGate>,
    pub(crate) map_smoothing_s: f64,
    pub(crate) initializing_frames: u32,
}

/// Which frame an output belongs to.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Stamp {
    pub(crate) sequence: u64,
    pub(crate) capture_time: CaptureTime,
    /// Seconds since the last processed frame; `None` for the first one, and after a restart.
    pub(crate) dt_s: Option<f64>,
}

/// Integrates relative motion and tracks the pose in the map.
#[derive(Debug, Clone)]
pub(crate) struct Fuse {
    traits: ModelTraits,
    base_from_camera: Pose,
    initializing_frames: u32,
    /// Of the last frame; `None` before the first one and after a restart.
    odometry: Option<Odometry>,
    map: MapTracker,
    reset_epoch: u32,
    /// Frames since the start or the last restart.
    frames: u32,
    /// Why the odometry starts at the next frame.
    start_reason: Reason,
}

impl Fuse {
    pub(crate) fn new(traits: ModelTraits, base_from_camera: Pose, rules: Rules) -> Self {
        Self {
            traits,
            base_from_camera,
            initializing_frames: rules.initializing_frames,
            odometry: None,
            map: MapTracker::new(rules.gate, rules.map_smoothing_s),
            reset_epoch: 0,
            frames: 0,
            start_reason: Reason::None,
        }
    }

    /// One frame. When the estimate's reason is [`Reason::NonFiniteOutput`] the odometry was restarted and the
    /// network's state has to be reset, too.
    pub(crate) fn fuse(&mut self, stamp: Stamp, outputs: &StepOutput) -> Estimate {
        self.try_fuse(stamp, outputs).unwrap_or_else(|NotAPose| {
            self.restart(Reason::NonFiniteOutput);
            self.all_unknown(stamp, Status::Lost, Reason::NonFiniteOutput)
        })
    }

    /// Odometry starts anew at the next frame, whose motion since the last one is not known; nor is the map
    /// pose before the next global pose.
    pub(crate) fn restart(&mut self, reason: Reason) {
        self.restart_odometry(reason);
        self.map.forget();
    }

    /// Odometry starts anew at the next frame; the map pose is kept as it is.
    pub(crate) fn restart_odometry(&mut self, reason: Reason) {
        // The odometry frame jumps only once, however many causes come before the next frame.
        if self.frames > 0 {
            self.reset_epoch = self.reset_epoch.wrapping_add(1);
        }
        (self.odometry, self.frames, self.start_reason) = (None, 0, reason);
        self.map.hold();
    }

    /// The map pose is not known until the next global pose, which is taken unseen.
    pub(crate) fn reset_map(&mut self) {
        self.map.forget();
    }

    pub(crate) fn place(&mut self, map_from_base: Pose, covariance: Covariance6) {
        self.map.place(Uncertain { pose: map_from_base, covariance }, self.frames > 0);
    }

    /// Another scene, or another model after [`Fuse::restart`].
    pub(crate) fn set_traits(&mut self, traits: ModelTraits) {
        self.traits = traits;
        self.map.forget();
    }

    /// Other rules from the next frame on.
    pub(crate) fn set_rules(&mut self, rules: Rules) {
        self.map.set_rules(rules.gate, rules.map_smoothing_s);
        self.initializing_frames = rules.initializing_frames;
    }

    pub(crate) fn reset_epoch(&self) -> u32 {
        self.reset_epoch
    }

    /// Computes everything before it changes anything, so that a bad output leaves no trace.
    fn try_fuse(&mut self, stamp: Stamp, outputs: &StepOutput) -> Result<Estimate, NotAPose> {
        let [relative, global, fused] = [&outputs.relative, &outputs.global, &outputs.fused].map(read);
        let (relative, global, fused) = (relative?, global?, fused?);
        let is_first = self.frames == 0;
        // The first frame was paired with itself: its output says nothing about motion.
        let key_from_current =
            relative.filter(|_| !is_first && stamp.dt_s.is_some()).map(|camera| self.in_base(&camera));
        let moved = match (self.odometry, key_from_current, stamp.dt_s) {
            (Some(odometry), Some(key_from_current), Some(dt_s)) => {
                let shortest_s = self.traits.keyframe_interval_s;
                Some(odometry.next(&key_from_current, outputs.is_key, dt_s, shortest_s))
            }
            _ => None,
        };
        let motion = moved.map(|moved| moved.last_from_current);
        let started = (is_first && relative.is_some()).then(Odometry::start);
        let odometry = moved.map(|moved| moved.odometry).or(started);
        let odom_from_base = odometry.map(|odometry| odometry.odom_from_base());
        let network = fused.or(global).map(|world_from_camera| self.in_map(&world_from_camera));
        let mut map = self.map.clone();
        let update = map.update(motion.as_ref(), network.as_ref(), stamp.dt_s);
        for pose in [&odom_from_base, &motion, &network, &update.map_from_base].into_iter().flatten() {
            if !pose.is_presentable() {
                return Err(NotAPose);
            }
        }
        let velocity = moved.map(|moved| body_velocity(&moved.recently, moved.span_s)).transpose()?;
        let (status, reason) = self.status(&update, odometry.is_some());

        (self.map, self.odometry) = (map, odometry);
        self.frames = self.frames.saturating_add(1);
        let estimate = |pose: Option<Uncertain>| {
            pose.map_or_else(PoseEstimate::unknown, |known| PoseEstimate::known(known.pose, known.covariance))
        };
        Ok(Estimate {
            sequence: stamp.sequence,
            capture_time: stamp.capture_time,
            status,
            reason,
            reset_epoch: self.reset_epoch,
            map_from_base: estimate(update.map_from_base),
            odom_from_base: estimate(odom_from_base),
            previous_from_current: estimate(motion),
            network_map_from_base: estimate(network.filter(|_| status != Status::Lost)),
            linear_velocity_in_base_mps: velocity.map(|v| v.0),
            angular_velocity_in_base_radps: velocity.map(|v| v.1),
            innovation_ratio: update.innovation_ratio,
            landmark_inliers: 0,
        })
    }

    /// The gravest thing there is to say.
    fn status(&self, update: &MapUpdate, has_odometry: bool) -> (Status, Reason) {
        match update.verdict {
            Verdict::Lost => (Status::Lost, Reason::InnovationRejected),
            _ if !self.traits.is_trained => (Status::Degraded, Reason::UntrainedModel),
            Verdict::Rejected => (Status::Degraded, Reason::InnovationRejected),
            Verdict::Reinitialised => (Status::Degraded, Reason::Reinitialised),
            _ if self.frames < self.initializing_frames => (Status::Initializing, self.start_reason),
            _ if !self.traits.has_scene => (Status::Tracking, Reason::NoScene),
            _ if !has_odometry => (Status::Tracking, Reason::NoOdometry),
            _ => (Status::Tracking, Reason::None),
        }
    }

    /// `previous_from_current` of the camera to that of the body. The camera is fixed to the body, so
    /// `base_previous_from_base = base_from_camera * camera_previous_from_camera * camera_from_base`.
    fn in_base(&self, camera: &Uncertain) -> Uncertain {
        let base_from_camera = Uncertain::exact(self.base_from_camera);
        let camera_from_base = Uncertain::exact(self.base_from_camera.inverse());
        base_from_camera.then(camera).then(&camera_from_base)
    }

    /// `map_from_base = map_from_world * world_from_camera * camera_from_base`.
    fn in_map(&self, world_from_camera: &Uncertain) -> Uncertain {
        let camera_from_base = Uncertain::exact(self.base_from_camera.inverse());
        Uncertain::exact(self.traits.map_from_world).then(world_from_camera).then(&camera_from_base)
    }

    fn all_unknown(&self, stamp: Stamp, status: Status, reason: Reason) -> Estimate {
        Estimate {
            sequence: stamp.sequence,
            capture_time: stamp.capture_time,
            status,
            reason,
            reset_epoch: self.reset_epoch,
            map_from_base: PoseEstimate::unknown(),
            odom_from_base: PoseEstimate::unknown(),
            previous_from_current: PoseEstimate::unknown(),
            network_map_from_base: PoseEstimate::unknown(),
            linear_velocity_in_base_mps: None,
            angular_velocity_in_base_radps: None,
            innovation_ratio: f64::NAN,
            landmark_inliers: 0,
        }
    }
}

fn read(head: &Option<HeadOutput>) -> Result<Option<Uncertain>, NotAPose> {
    head.as_ref().map(heads::read).transpose()
}

/// The constant body twist that makes this motion in `dt_s`: linear (m/s) and angular (rad/s), in body axes.
fn body_velocity(earlier_from_current: &Pose, dt_s: f64) -> Result<(Vector3<f64>, Vector3<f64>), NotAPose> {
    let tangent = se3::log(earlier_from_current);
    let (linear, angular) = (tangent.translation() / dt_s, tangent.rotation() / dt_s);
    let known = linear.iter().chain(angular.iter()).all(|v| v.is_finite());
    if known { Ok((linear, angular)) } else { Err(NotAPose) }
}

#[cfg(test)]
mod tests;
