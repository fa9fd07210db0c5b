//! Where the poses of a training lie and how far they spread: the scale on which heads and loss weights start.

use grnet_geometry::{Pose, se3};
use nalgebra::{Isometry3, Translation3, Vector3};

use crate::loss::{TargetStatistics, mean_rotation};

/// Root mean square deviations; never below a micrometre or a microradian.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Spread {
    /// Of one component of the translation, metres.
    pub translation_m: f64,
    /// Of one component of the rotation vector, radians.
    pub rotation_rad: f64,
}

/// Mean pose and spreads of the poses of a training.
#[derive(Debug, Clone, PartialEq)]
pub struct Normalisation {
    /// Mean `world_from_camera`.
    pub centre: Pose,
    /// Deviation of `world_from_camera` from the mean.
    pub absolute: Spread,
    /// Deviation of the motion between neighbouring frames of a window from no motion.
    pub relative: Spread,
    /// What the weights of the losses start from.
    pub targets: TargetStatistics,
}

impl Normalisation {
    /// Of some windows of `world_from_camera`, at least one pose.
    pub fn of(windows: &[Vec<Pose>]) -> Self {
        let poses: Vec<&Pose> = windows.iter().flatten().collect();
        let centre = mean(&poses);
        let absolute = spread(poses.iter().map(|pose| {
            let d_rotation = se3::so3_log(&(centre.rotation.inverse() * pose.rotation));
            (pose.translation.vector - centre.translation.vector, d_rotation)
        }));
        let relative = spread(windows.iter().flat_map(|window| window.windows(2)).map(|pair| {
            let motion = se3::relative(&pair[0], &pair[1]);
            (motion.translation.vector, se3::so3_log(&motion.rotation))
        }));
        Self { centre, absolute, relative, targets: TargetStatistics::of(windows) }
    }
}

/// Mean position and mean rotation (chordal).
fn mean(poses: &[&Pose]) -> Pose {
    let sum = poses.iter().map(|pose| pose.translation.vector).sum::<Vector3<f64>>();
    Isometry3::from_parts(Translation3::from(sum / poses.len().max(1) as f64), mean_rotation(poses))
}

fn spread(deviations: impl Iterator<Item = (Vector3<f64>, Vector3<f64>)>) -> Spread {
    let (mut count, mut translation, mut rotation) = (0usize, 0.0, 0.0);
    for (dt, dr) in deviations {
        count += 1;
        translation += dt.norm_squared() / 3.0;
        rotation += dr.norm_squared() / 3.0;
    }
    let root = |sum: f64| (sum / count.max(1) as f64).sqrt().max(1e-6);
    Spread { translation_m: root(translation), rotation_rad: root(rotation) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn windows_around_a_pose_give_that_pose_and_their_spread() {
        let at = Pose::new(Vector3::new(100.0, -3.0, 2.0), Vector3::new(0.0, 2.0, 0.0));
        let shifted = |d: f64| at * Pose::new(Vector3::new(d, d, d), Vector3::new(0.0, 0.0, d / 10.0));
        let windows = vec![vec![shifted(-0.3), shifted(0.3)], vec![shifted(0.3), shifted(-0.3)]];
        let found = Normalisation::of(&windows);
        assert!((found.centre.translation.vector - at.translation.vector).norm() < 1e-9);
        assert!(se3::angle_rad(&(found.centre.rotation.inverse() * at.rotation)) < 1e-6);
        assert!((found.absolute.translation_m - 0.3).abs() < 1e-3, "{found:?}");
        assert!((found.absolute.rotation_rad - 0.03 / 3f64.sqrt()).abs() < 1e-9, "{found:?}");
        assert!((found.relative.rotation_rad - 0.06 / 3f64.sqrt()).abs() < 1e-9, "{found:?}");
    }

    #[test]
    fn single_frames_have_no_motion_but_a_usable_spread() {
        let found = Normalisation::of(&[vec![Pose::identity()]]);
        assert_eq!(found.relative, Spread { translation_m: 1e-6, rotation_rad: 1e-6 });
    }
}
