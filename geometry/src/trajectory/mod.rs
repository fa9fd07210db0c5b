//! Time-stamped poses, and the text formats in which trajectories are exchanged.
//!
//! * [`tum`]: `t x y z qx qy qz qw`, one pose a line (TUM RGB-D benchmark).
//! * [`kitti`]: the 3x4 matrix row by row, one pose a line, optionally behind a frame number.
//! * [`associate`](associate()): pairs the poses of two trajectories by time.

mod associate;
mod decimal;
mod error;
pub mod kitti;
pub mod tum;

pub use associate::{Association, AssociationOptions, NoMatch, associate};
pub use error::{NotIncreasing, TrajectoryError};
pub use kitti::{KittiPose, KittiPoses};

use crate::{Pose, align::Similarity, se3};

/// The pose of the camera (or body) at one time.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StampedPose {
    /// Time in nanoseconds, on whatever clock the trajectory was recorded with.
    pub time_ns: i64,
    /// Pose of the camera in the world.
    pub world_from_camera: Pose,
}

/// Poses in strictly increasing order of time.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Trajectory {
    poses: Vec<StampedPose>,
}

impl Trajectory {
    /// Takes poses that are already in strictly increasing order of time.
    ///
    /// # Errors
    /// [`NotIncreasing`] names the first pose that is not later than the one before it.
    pub fn new(poses: Vec<StampedPose>) -> Result<Self, NotIncreasing> {
        for (i, pair) in poses.windows(2).enumerate() {
            NotIncreasing::check(i + 1, pair[0].time_ns, pair[1].time_ns)?;
        }
        Ok(Self { poses })
    }

    /// Appends a pose.
    ///
    /// # Errors
    /// [`NotIncreasing`] if it is not later than the last one.
    pub fn push(&mut self, pose: StampedPose) -> Result<(), NotIncreasing> {
        if let Some(last) = self.poses.last() {
            NotIncreasing::check(self.poses.len(), last.time_ns, pose.time_ns)?;
        }
        self.poses.push(pose);
        Ok(())
    }

    /// All poses in order.
    pub fn poses(&self) -> &[StampedPose] {
        &self.poses
    }

    /// Number of poses.
    pub fn len(&self) -> usize {
        self.poses.len()
    }

    /// Whether there is no pose.
    pub fn is_empty(&self) -> bool {
        self.poses.is_empty()
    }

    /// Length of the path through all positions, in metres.
    pub fn path_length_m(&self) -> f64 {
        let step = |w: &[StampedPose]| {
            (w[1].world_from_camera.translation.vector - w[0].world_from_camera.translation.vector).norm()
        };
        self.poses.windows(2).map(step).sum()
    }

    /// The pose at a time between the first and the last, [interpolated](se3::interpolate); `None` outside.
    pub fn at(&self, time_ns: i64) -> Option<Pose> {
        let after = self.poses.partition_point(|p| p.time_ns < time_ns);
        let b = self.poses.get(after)?;
        if b.time_ns == time_ns {
            return Some(b.world_from_camera);
        }
        let a = &self.poses[after.checked_sub(1)?];
        // Wide integers: the span of two i64 times can overflow.
        let t = (i128::from(time_ns) - i128::from(a.time_ns)) as f64
            / (i128::from(b.time_ns) - i128::from(a.time_ns)) as f64;
        Some(se3::interpolate(&a.world_from_camera, &b.world_from_camera, t))
    }

    /// The trajectory seen from another world: every pose becomes `similarity * world_from_camera`.
    pub fn transformed(&self, similarity: &Similarity) -> Self {
        let poses = self.poses.iter();
        Self {
            poses: poses
                .map(|p| StampedPose {
                    time_ns: p.time_ns,
                    world_from_camera: similarity.apply(&p.world_from_camera),
                })
                .collect(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn stamped(time_ns: i64, x: f64) -> StampedPose {
        StampedPose { time_ns, world_from_camera: Pose::translation(x, 0.0, 0.0) }
    }

    #[test]
    fn times_grow_strictly() {
        let error = Trajectory::new(vec![stamped(1, 0.0), stamped(3, 0.0), stamped(3, 0.0)]).unwrap_err();
        assert_eq!(error, NotIncreasing { index: 2, previous_ns: 3, found_ns: 3 });
        let mut trajectory = Trajectory::new(vec![stamped(1, 0.0)]).unwrap();
        assert!(trajectory.push(stamped(0, 0.0)).is_err());
        trajectory.push(stamped(5, 4.0)).unwrap();
        assert_eq!(trajectory.path_length_m(), 4.0);
    }

    #[test]
    fn interpolates_inside_only() {
        let trajectory = Trajectory::new(vec![stamped(0, 0.0), stamped(10, 1.0)]).unwrap();
        assert_eq!(trajectory.at(5).unwrap().translation.x, 0.5);
        assert_eq!(trajectory.at(0).unwrap().translation.x, 0.0);
        assert_eq!(trajectory.at(10).unwrap().translation.x, 1.0);
        assert_eq!((trajectory.at(-1), trajectory.at(11)), (None, None));
        let wide = Trajectory::new(vec![stamped(i64::MIN, 0.0), stamped(i64::MAX, 1.0)]).unwrap();
        assert!((wide.at(0).unwrap().translation.x - 0.5).abs() < 1e-12);
    }
}
