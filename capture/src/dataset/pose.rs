//! Poses from the numbers that datasets write.

use grnet_geometry::{Pose, quaternion};
use nalgebra::{Matrix3, Translation3};

use super::{DatasetError, InvalidPoses, text::Line};

/// Largest entry of |R^T R - I| of a matrix that still counts as a rotation: datasets print six digits, and
/// the fused poses of depth cameras drift by some 1e-4.
const MAX_ROTATION_ERROR: f64 = 0.01;

/// Largest deviation of a quaternion's norm from 1: some datasets print four digits.
const MAX_NORM_ERROR: f64 = 0.01;

/// A rigid motion from the rows of [R | t]; R is replaced by the nearest rotation.
pub(crate) fn from_rows(rows: &[f64; 12]) -> Result<Pose, String> {
    if let Some(bad) = rows.iter().find(|value| !value.is_finite()) {
        return Err(format!("the pose holds {bad}, which is no finite number"));
    }
    let matrix =
        Matrix3::new(rows[0], rows[1], rows[2], rows[4], rows[5], rows[6], rows[8], rows[9], rows[10]);
    let error = (matrix.transpose() * matrix - Matrix3::identity()).amax();
    // The product of huge finite numbers overflows to NaN, which is no rotation either.
    if error.is_nan() || error > MAX_ROTATION_ERROR {
        return Err(format!("R^T R differs from the identity by {error:.3}: R is no rotation"));
    }
    if matrix.determinant() < 0.0 {
        return Err("R has determinant -1: a mirror image is no rotation".into());
    }
    let rotation = quaternion::from_matrix(&matrix, f64::INFINITY).map_err(|error| error.to_string())?;
    Ok(Pose::from_parts(Translation3::new(rows[3], rows[7], rows[11]), rotation))
}

/// A rigid motion from a translation and a quaternion (x, y, z, w), which is normalised.
pub(crate) fn from_quaternion(translation: [f64; 3], xyzw: [f64; 4]) -> Result<Pose, String> {
    if let Some(bad) = translation.iter().chain(&xyzw).find(|value| !value.is_finite()) {
        return Err(format!("the pose holds {bad}, which is no finite number"));
    }
    let norm = xyzw.iter().map(|c| c * c).sum::<f64>().sqrt();
    if norm.is_nan() || (norm - 1.0).abs() > MAX_NORM_ERROR {
        return Err(format!("the quaternion has norm {norm:.4}, not 1"));
    }
    let rotation = quaternion::from_xyzw(xyzw).map_err(|error| error.to_string())?;
    Ok(Pose::from_parts(Translation3::from(translation), rotation))
}

/// Poses read so far that were no rigid motions.
#[derive(Debug, Default)]
pub(crate) struct Invalid {
    pub policy: InvalidPoses,
    pub count: usize,
}

impl Invalid {
    pub fn new(policy: InvalidPoses) -> Self {
        Self { policy, count: 0 }
    }

    /// Forgets and counts an impossible pose, or makes it an error at `line`.
    pub fn judge(
        &mut self,
        line: &Line<'_>,
        pose: Result<Pose, String>,
    ) -> Result<Option<Pose>, DatasetError> {
        match (pose, self.policy) {
            (Ok(pose), _) => Ok(Some(pose)),
            (Err(_), InvalidPoses::Forget) => {
                self.count += 1;
                Ok(None)
            }
            (Err(problem), InvalidPoses::Refuse) => {
                Err(DatasetError::InvalidPose { path: line.path.to_path_buf(), line: line.number, problem })
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Vector3;
    use proptest::prelude::*;

    fn rows(pose: &Pose) -> [f64; 12] {
        let m = pose.to_homogeneous();
        std::array::from_fn(|i| m[(i / 4, i % 4)])
    }

    #[test]
    fn what_is_no_rotation_is_refused_by_reason() {
        let identity = rows(&Pose::identity());
        let changed = |index: usize, value| {
            let mut rows = identity;
            rows[index] = value;
            from_rows(&rows).unwrap_err()
        };
        assert_eq!(changed(3, f64::NEG_INFINITY), "the pose holds -inf, which is no finite number");
        assert_eq!(changed(0, f64::NAN), "the pose holds NaN, which is no finite number");
        assert!(changed(0, 1.1).contains("R is no rotation"));
        assert!(changed(0, 1e200).contains("R is no rotation"));
        assert!(changed(0, -1.0).contains("mirror"));
        assert!(from_quaternion([0.0; 3], [0.0; 4]).unwrap_err().contains("norm 0"));
        assert!(from_quaternion([0.0; 3], [0.0, 0.0, 0.0, f64::NAN]).is_err());
    }

    proptest! {
        #[test]
        fn matrix_and_quaternion_agree(t: [i16; 3], axis in prop::array::uniform3(-3.0..3.0f64), noise in -1e-4..1e-4f64) {
            let pose = Pose::new(Vector3::from(t.map(f64::from)), Vector3::from(axis));
            let mut numbers = rows(&pose);
            numbers[5] += noise;
            let from_matrix = from_rows(&numbers).unwrap();
            let q = pose.rotation.coords;
            let from_quaternion = from_quaternion([t[0], t[1], t[2]].map(f64::from), [q.x, q.y, q.z, q.w]).unwrap();
            prop_assert!(from_matrix.rotation.angle_to(&from_quaternion.rotation) < 2e-4);
            prop_assert!((from_matrix.translation.vector - from_quaternion.translation.vector).norm() < 1e-9);
        }

        #[test]
        fn no_numbers_panic(rows in prop::array::uniform12(any::<f64>()), q: [f64; 4]) {
            let _ = (from_rows(&rows), from_quaternion([rows[0], rows[1], rows[2]], q));
        }
    }
}
