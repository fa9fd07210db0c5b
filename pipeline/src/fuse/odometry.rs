//! Motion since key frames, integrated.

use grnet_geometry::Pose;

use super::heads::Uncertain;

/// Where the body is in the odometry frame, as the pose at the last key frame and the motion since then.
///
/// Errors of a frame that is no key frame do not add up: the next frame is measured from the key frame again.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Odometry {
    odom_from_key: Uncertain,
    /// The body at the last frame in the body at the key frame; none where the last frame is the key frame.
    key_from_last: Option<Uncertain>,
    /// Frames and seconds from the key frame to the last one.
    frames: u32,
    since_key_s: f64,
    /// `odom_from_base` at the key frame before, and how long before the last one that was.
    before: Option<(Pose, f64)>,
}

/// What one more frame gives.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Moved {
    pub(crate) odometry: Odometry,
    pub(crate) last_from_current: Uncertain,
    /// A motion that ends at this frame and began `span_s` ago, for velocities.
    pub(crate) recently: Pose,
    pub(crate) span_s: f64,
}

impl Odometry {
    /// The first frame: the origin, and a key frame.
    pub(crate) fn start() -> Self {
        let odom_from_key = Uncertain::exact(Pose::identity());
        Self { odom_from_key, key_from_last: None, frames: 0, since_key_s: 0.0, before: None }
    }

    /// After one more frame `dt_s` later, of which the motion since the key frame is known.
    ///
    /// * Two motions from one key frame share most of their error, so that their difference is better known than either:
    ///   the error of `key_from_current` is taken as spread evenly over the frames since the key frame.
    /// * The recent motion is that since the last key frame which is at least `shortest_s` old, because the motion of a
    ///   frame or two is mostly noise.
    pub(crate) fn next(
        &self,
        key_from_current: &Uncertain,
        is_key: bool,
        dt_s: f64,
        shortest_s: f64,
    ) -> Moved {
        let frames = self.frames.saturating_add(1);
        let last_from_current = match &self.key_from_last {
            None => *key_from_current,
            Some(key_from_last) => {
                let covariance = key_from_current.covariance.scaled(1.0 / f64::from(frames));
                let last_from_key = Uncertain::exact(key_from_last.pose.inverse());
                last_from_key.then(&Uncertain { pose: key_from_current.pose, covariance })
            }
        };
        let since_key_s = self.since_key_s + dt_s;
        let (recently, span_s) = match self.before {
            Some((odom_from_before, before_key_s)) if since_key_s < shortest_s => {
                let odom_from_base = self.odom_from_key.pose * key_from_current.pose;
                (odom_from_before.inverse() * odom_from_base, before_key_s + since_key_s)
            }
            _ => (key_from_current.pose, since_key_s),
        };
        let odometry = if is_key {
            Self {
                odom_from_key: self.odom_from_key.then(key_from_current),
                before: Some((self.odom_from_key.pose, since_key_s)),
                ..Self::start()
            }
        } else {
            Self { key_from_last: Some(*key_from_current), frames, since_key_s, ..*self }
        };
        Moved { odometry, last_from_current, recently, span_s }
    }

    pub(crate) fn odom_from_base(&self) -> Uncertain {
        match &self.key_from_last {
            None => self.odom_from_key,
            Some(key_from_last) => self.odom_from_key.then(key_from_last),
        }
    }
}

#[cfg(test)]
mod tests {
    use grnet_geometry::{Covariance6, covariance};
    use nalgebra::{Isometry3, Matrix6, UnitQuaternion, Vector3};

    use super::*;

    fn pose(i: u32) -> Pose {
        let s = f64::from(i);
        let rotation = UnitQuaternion::from_euler_angles(0.02 * s, -0.05 * s, 0.3 * (0.2 * s).sin());
        Isometry3::from_parts(Vector3::new(0.1 * s, (0.3 * s).sin(), -0.02 * s).into(), rotation)
    }

    fn assert_same(found: &Pose, expected: &Pose) {
        let error = covariance::error(found, expected);
        assert!(error.0.norm() < 1e-9, "{found:?} is not {expected:?}");
    }

    const DT_S: f64 = 0.04;

    fn next(odometry: &Odometry, key_from_current: &Uncertain, is_key: bool) -> (Odometry, Uncertain) {
        let moved = odometry.next(key_from_current, is_key, DT_S, 0.0);
        (moved.odometry, moved.last_from_current)
    }

    /// What a network says of the motion from one frame to another, `variance` for each frame between.
    fn measured(from: u32, to: u32, variance: f64) -> Uncertain {
        let covariance = Covariance6::from_diagonal([variance * f64::from(to - from); 6]);
        Uncertain { pose: pose(from).inverse() * pose(to), covariance }
    }

    #[test]
    fn exact_motions_since_key_frames_give_the_path_whatever_the_key_frames() {
        for interval in [1, 2, 5] {
            let mut odometry = Odometry::start();
            let mut key = 0;
            for i in 1..23 {
                let is_key = i % interval == 0;
                let (after, motion) = next(&odometry, &measured(key, i, 1e-6), is_key);
                assert_same(&motion.pose, &(pose(i - 1).inverse() * pose(i)));
                assert_same(&after.odom_from_base().pose, &(pose(0).inverse() * pose(i)));
                assert!(motion.covariance.is_valid() && after.odom_from_base().covariance.is_valid());
                odometry = after;
                key = if is_key { i } else { key };
            }
        }
    }

    #[test]
    fn only_the_errors_of_key_frames_stay() {
        let wrong = Isometry3::translation(0.5, 0.0, 0.0);
        let off = Uncertain { pose: pose(0).inverse() * pose(1) * wrong, ..measured(0, 1, 1e-6) };
        let (odometry, motion) = next(&Odometry::start(), &off, false);
        assert_same(&motion.pose, &(pose(0).inverse() * pose(1) * wrong));
        let (odometry, motion) = next(&odometry, &measured(0, 2, 1e-6), true);
        assert_same(&odometry.odom_from_base().pose, &(pose(0).inverse() * pose(2)));
        assert_same(&motion.pose, &(wrong.inverse() * pose(1).inverse() * pose(2)));
    }

    #[test]
    fn the_covariances_of_the_motions_between_two_key_frames_add_up_to_that_of_their_odometry() {
        // Without rotation they add up as matrices.
        let still = |frames: u32| Uncertain {
            pose: Isometry3::translation(0.01 * f64::from(frames), 0.0, 0.0),
            covariance: Covariance6::from_diagonal([1e-6 * f64::from(frames); 6]),
        };
        let mut odometry = Odometry::start();
        let mut sum = Matrix6::zeros();
        for frames in 1..=4 {
            let (after, motion) = next(&odometry, &still(frames), frames == 4);
            sum += motion.covariance.matrix();
            odometry = after;
        }
        let whole = *odometry.odom_from_base().covariance.matrix();
        assert!((sum - whole).amax() < 1e-15, "{sum} is not {whole}");
        // The next interval comes on top.
        let (after, _) = next(&odometry, &still(4), true);
        assert!(after.odom_from_base().covariance.matrix()[(3, 3)] > 1.9 * whole[(3, 3)]);
    }

    #[test]
    fn the_recent_motion_is_never_shorter_than_asked_once_there_is_enough() {
        // Key frames every third frame, and a wrong last motion: what matters is how long it is taken to have lasted.
        let mut odometry = Odometry::start();
        let mut key = 0;
        for i in 1..12 {
            let moved = odometry.next(&measured(key, i, 1e-6), i % 3 == 0, DT_S, 2.5 * DT_S);
            // Since the key frame where it is three frames old, else since the one before it.
            let from = if i % 3 == 0 || i < 3 { key } else { key - 3 };
            assert_same(&moved.recently, &(pose(from).inverse() * pose(i)));
            assert!(
                (moved.span_s - DT_S * f64::from(i - from)).abs() < 1e-12,
                "frame {i}: {} s",
                moved.span_s
            );
            odometry = moved.odometry;
            key = if i % 3 == 0 { i } else { key };
        }
        // Every frame a key frame: the motion since the last one.
        let mut odometry = Odometry::start();
        for i in 1..5 {
            let moved = odometry.next(&measured(i - 1, i, 1e-6), true, DT_S, 0.0);
            assert_same(&moved.recently, &(pose(i - 1).inverse() * pose(i)));
            assert_eq!(moved.span_s, DT_S);
            odometry = moved.odometry;
        }
    }
}
