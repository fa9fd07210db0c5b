//! The ground truth of a batch, and what of it is known before training.

use candle_core::{Device, Result, bail};
use grnet_geometry::{Pose, se3};
use nalgebra::{Matrix4, Quaternion, UnitQuaternion, Vector3};

use super::motion::Motion;
use super::pairs::pairs;

/// Ground truth of a batch of windows.
///
/// It meets the network's outputs in the losses only; no function of the network takes it.
#[derive(Debug, Clone)]
pub struct Targets {
    batch: usize,
    frames: usize,
    /// world_from_camera, window by window.
    poses: Vec<Pose>,
    device: Device,
}

impl Targets {
    /// B windows of K poses world_from_camera each; losses of these targets are computed on `device`.
    ///
    /// # Errors
    /// When there is no window, the windows are of different lengths or empty, or a pose is not finite.
    pub fn new(windows: &[Vec<Pose>], device: &Device) -> Result<Self> {
        let frames = windows.first().map_or(0, Vec::len);
        if frames == 0 {
            bail!(
                "a batch needs at least one window of at least one frame; it has {} windows",
                windows.len()
            );
        }
        if let Some((i, other)) = windows.iter().enumerate().find(|(_, w)| w.len() != frames) {
            bail!(
                "window {i} of a batch has {} poses, window 0 has {frames}: all must have the same",
                other.len()
            );
        }
        let poses = windows.concat();
        let finite = |pose: &Pose| pose.to_homogeneous().iter().all(|v| v.is_finite());
        if let Some(bad) = poses.iter().position(|pose| !finite(pose)) {
            bail!(
                "the true pose of frame {} of window {} is not finite: {}",
                bad % frames,
                bad / frames,
                poses[bad]
            );
        }
        Ok(Self { batch: windows.len(), frames, poses, device: device.clone() })
    }

    /// Windows, B.
    pub fn batch(&self) -> usize {
        self.batch
    }

    /// Frames per window, K.
    pub fn frames(&self) -> usize {
        self.frames
    }

    /// Where losses of these targets are computed.
    pub fn device(&self) -> &Device {
        &self.device
    }

    /// True values of motions for every window in turn, B * M. The poses are absolute, so a chain of steps is the motion
    /// between its ends.
    pub(super) fn truths(&self, motions: &[Motion]) -> Vec<Pose> {
        let of_window = |window: &[Pose]| -> Vec<Pose> {
            let truth = |motion: &Motion| match *motion {
                Motion::Chain(i, j) => Motion::Between(i, j).of(window),
                other => other.of(window),
            };
            motions.iter().map(truth).collect()
        };
        self.poses.chunks_exact(self.frames).flat_map(of_window).collect()
    }
}

/// How much true poses vary: the mean squared error, per component, of a network that always gives the mean.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TargetStatistics {
    /// Absolute translation about its mean, m^2.
    pub absolute_translation_m2: f64,
    /// Absolute rotation about its mean, rad^2.
    pub absolute_rotation_rad2: f64,
    /// Translation of the motions of all CTC pairs about no motion, m^2.
    pub pairs_translation_m2: f64,
    /// Rotation of the motions of all CTC pairs about no motion, rad^2.
    pub pairs_rotation_rad2: f64,
}

impl TargetStatistics {
    /// Over sample windows of K poses world_from_camera.
    ///
    /// Without any pose, or any pair, the numbers are 0.
    pub fn of(windows: &[Vec<Pose>]) -> Self {
        let poses: Vec<&Pose> = windows.iter().flatten().collect();
        let mean_translation =
            poses.iter().map(|p| p.translation.vector).sum::<Vector3<f64>>() / poses.len().max(1) as f64;
        let mean_rotation = mean_rotation(&poses);
        let motions: Vec<Pose> = windows
            .iter()
            .flat_map(|window| pairs(window.len()).into_iter().map(|(i, j)| Motion::Between(i, j).of(window)))
            .collect();
        let absolute_t = poses.iter().map(|p| p.translation.vector - mean_translation);
        let absolute_r = poses.iter().map(|p| se3::so3_log(&(mean_rotation.inverse() * p.rotation)));
        Self {
            absolute_translation_m2: mean_square(absolute_t),
            absolute_rotation_rad2: mean_square(absolute_r),
            pairs_translation_m2: mean_square(motions.iter().map(|m| m.translation.vector)),
            pairs_rotation_rad2: mean_square(motions.iter().map(|m| se3::so3_log(&m.rotation))),
        }
    }
}

/// The rotation with the smallest sum of squared quaternion distances (signs chosen nearest): the leading eigenvector of
/// `sum q q^T` (Markley et al., *Averaging Quaternions*, JGCD 2007).
pub(crate) fn mean_rotation(poses: &[&Pose]) -> UnitQuaternion<f64> {
    let q_q = poses.iter().map(|p| p.rotation.coords * p.rotation.coords.transpose());
    let sum = q_q.sum::<Matrix4<f64>>().symmetric_eigen();
    match sum.eigenvalues.imax() {
        _ if poses.is_empty() => UnitQuaternion::identity(),
        largest => {
            UnitQuaternion::new_normalize(Quaternion::from(sum.eigenvectors.column(largest).into_owned()))
        }
    }
}

/// Of the components.
fn mean_square(vectors: impl ExactSizeIterator<Item = Vector3<f64>>) -> f64 {
    let count = 3 * vectors.len().max(1);
    vectors.map(|v| v.norm_squared()).sum::<f64>() / count as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pose(t: [f64; 3], r: [f64; 3]) -> Pose {
        Pose::new(Vector3::from(t), Vector3::from(r))
    }

    #[test]
    fn what_is_no_batch_is_refused_by_name() {
        let refused = |windows: &[Vec<Pose>]| Targets::new(windows, &Device::Cpu).unwrap_err().to_string();
        let p = Pose::identity();
        assert!(refused(&[]).contains("0 windows"));
        assert!(refused(&[vec![]]).contains("at least one frame"));
        let error = refused(&[vec![p; 3], vec![p; 2]]);
        assert!(
            error.contains("window 1") && error.contains("2 poses") && error.contains("has 3"),
            "{error}"
        );
        let error = refused(&[vec![p; 2], vec![p, pose([f64::NAN, 0.0, 0.0], [0.0; 3])]]);
        assert!(error.contains("frame 1 of window 1"), "{error}");
    }

    #[test]
    fn statistics_by_hand() {
        // Two windows of two poses: x = 0, 2 and 4, 6 (mean 3, squares 9, 1, 1, 9), turned by -+0.1 about z.
        let at = |x: f64, turn: f64| pose([x, 0.0, 0.0], [0.0, 0.0, turn]);
        let windows = [vec![at(0.0, -0.1), at(2.0, 0.1)], vec![at(4.0, -0.1), at(6.0, 0.1)]];
        let s = TargetStatistics::of(&windows);
        assert!((s.absolute_translation_m2 - 20.0 / 12.0).abs() < 1e-12, "{s:?}");
        assert!((s.absolute_rotation_rad2 - 0.01 / 3.0).abs() < 1e-12, "{s:?}");
        assert!((s.pairs_translation_m2 - 4.0 / 3.0).abs() < 1e-12, "{s:?}");
        assert!((s.pairs_rotation_rad2 - 0.04 / 3.0).abs() < 1e-12, "{s:?}");
        // The mean rotation is that of the data, wherever the data are turned, and a quaternion's sign means nothing.
        let turned: Vec<Vec<Pose>> = windows
            .iter()
            .map(|w| w.iter().map(|p| pose([0.0; 3], [1.0, 2.0, -0.5]) * p).collect())
            .collect();
        let mut flipped = turned.clone();
        flipped[1][0].rotation = UnitQuaternion::new_unchecked(-flipped[1][0].rotation.into_inner());
        for windows in [turned, flipped] {
            let s = TargetStatistics::of(&windows);
            assert!((s.absolute_rotation_rad2 - 0.01 / 3.0).abs() < 1e-12, "{s:?}");
        }
        let none = TargetStatistics::of(&[]);
        assert_eq!((none.absolute_translation_m2, none.pairs_rotation_rad2), (0.0, 0.0));
        assert_eq!(TargetStatistics::of(&[vec![at(1.0, 0.0)]]).pairs_translation_m2, 0.0);
    }
}
