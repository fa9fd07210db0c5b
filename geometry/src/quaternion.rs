//! Rotations to and from the numbers that networks, files and messages carry.

use nalgebra::{Matrix3, Quaternion, Rotation3, UnitQuaternion, Vector3};
use thiserror::Error;

/// Smallest norm that still counts as a direction.
const MIN_NORM: f64 = 1e-6;

/// Numbers that are no rotation.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum RotationError {
    /// A component is NaN or infinite.
    #[error("rotation {values:?} has a component that is not finite")]
    NotFinite {
        /// What was given.
        values: Vec<f64>,
    },
    /// The norm is too small to define a direction.
    #[error("rotation {values:?} has norm {norm:.3e}; at least {MIN_NORM:e} is needed to normalise it")]
    NearZero {
        /// What was given.
        values: Vec<f64>,
        /// Its norm.
        norm: f64,
    },
    /// The two columns of a 6-D rotation are parallel.
    #[error("6-D rotation {values:?} has two parallel columns, so it defines no rotation")]
    Parallel {
        /// What was given.
        values: Vec<f64>,
    },
    /// A 3x3 matrix is not close to any rotation.
    #[error(
        "3x3 matrix is no rotation: it differs from the nearest one by {deviation:.3e} \
         (Frobenius norm, allowed {tolerance:.1e}), determinant {determinant:.6}"
    )]
    NotARotation {
        /// Frobenius distance to the nearest rotation.
        deviation: f64,
        /// Largest distance that is accepted.
        tolerance: f64,
        /// Determinant of the matrix.
        determinant: f64,
    },
}

/// The components `[x, y, z, w]` with `w >= 0`; of the two forms of half a turn the one whose first
/// non-zero component is positive.
pub fn xyzw(rotation: &UnitQuaternion<f64>) -> [f64; 4] {
    let q = rotation.quaternion();
    let v = [q.i, q.j, q.k, q.w];
    let negate = match q.w {
        w if w != 0.0 => w < 0.0,
        _ => v.iter().find(|c| **c != 0.0).is_some_and(|c| *c < 0.0),
    };
    // Adding zero turns -0.0 into 0.0.
    v.map(|c| if negate { -c + 0.0 } else { c + 0.0 })
}

/// Normalises `[x, y, z, w]`.
///
/// # Errors
/// [`RotationError`] if a component is not finite or the norm is below 1e-6.
pub fn from_xyzw([x, y, z, w]: [f64; 4]) -> Result<UnitQuaternion<f64>, RotationError> {
    let q = Quaternion::new(w, x, y, z);
    check(&[x, y, z, w], q.norm())?;
    Ok(UnitQuaternion::new_normalize(q))
}

/// The rotation whose first two columns are, after Gram-Schmidt, the two given 3-vectors
/// (Zhou et al., *On the Continuity of Rotation Representations in Neural Networks*, CVPR 2019, Eq. 15).
///
/// # Errors
/// [`RotationError`] if a component is not finite, or the columns are near zero or parallel.
pub fn from_6d(v: [f64; 6]) -> Result<UnitQuaternion<f64>, RotationError> {
    let (a1, a2) = (Vector3::new(v[0], v[1], v[2]), Vector3::new(v[3], v[4], v[5]));
    check(&v, a1.norm().min(a2.norm()))?;
    let b1 = a1.normalize();
    let b2 = a2.normalize();
    let b2 = b2 - b1 * b1.dot(&b2);
    if b2.norm() < MIN_NORM {
        return Err(RotationError::Parallel { values: v.to_vec() });
    }
    let b2 = b2.normalize();
    let matrix = Matrix3::from_columns(&[b1, b2, b1.cross(&b2)]);
    Ok(unit(&matrix))
}

/// The first two columns of the rotation matrix: the inverse of [`from_6d`].
pub fn to_6d(rotation: &UnitQuaternion<f64>) -> [f64; 6] {
    let m = rotation.to_rotation_matrix().into_inner();
    [m[(0, 0)], m[(1, 0)], m[(2, 0)], m[(0, 1)], m[(1, 1)], m[(2, 1)]]
}

/// The rotation nearest to a matrix in the Frobenius norm.
///
/// Files print matrices with few digits, so a small deviation is normal; a large one means that the file is not
/// what it is taken for.
///
/// # Errors
/// [`RotationError`] if an entry is not finite or the matrix differs from its projection by more than
/// `tolerance`.
pub fn from_matrix(matrix: &Matrix3<f64>, tolerance: f64) -> Result<UnitQuaternion<f64>, RotationError> {
    if matrix.iter().any(|v| !v.is_finite()) {
        return Err(RotationError::NotFinite { values: matrix.transpose().iter().copied().collect() });
    }
    let svd = matrix.svd(true, true);
    let (Some(u), Some(v_t)) = (svd.u, svd.v_t) else {
        return Err(RotationError::NotFinite { values: matrix.transpose().iter().copied().collect() });
    };
    let nearest = u * v_t;
    let deviation = (matrix - nearest).norm();
    let determinant = matrix.determinant();
    if determinant <= 0.0 || deviation > tolerance {
        return Err(RotationError::NotARotation { deviation, tolerance, determinant });
    }
    Ok(unit(&nearest))
}

fn unit(matrix: &Matrix3<f64>) -> UnitQuaternion<f64> {
    let mut q = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(*matrix));
    q.renormalize();
    q
}

fn check(values: &[f64], norm: f64) -> Result<(), RotationError> {
    if values.iter().any(|v| !v.is_finite()) {
        return Err(RotationError::NotFinite { values: values.to_vec() });
    }
    if norm < MIN_NORM || !norm.is_finite() {
        return Err(RotationError::NearZero { values: values.to_vec(), norm });
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn rotation() -> impl Strategy<Value = UnitQuaternion<f64>> {
        prop::array::uniform3(-4.0..4.0f64).prop_map(|v| crate::se3::so3_exp(&Vector3::from(v)))
    }

    proptest! {
        #[test]
        fn xyzw_round_trip(q in rotation()) {
            let v = xyzw(&q);
            prop_assert!(v[3] >= 0.0);
            prop_assert!(from_xyzw(v).unwrap().angle_to(&q) < 1e-14);
            prop_assert_eq!(v, xyzw(&UnitQuaternion::new_unchecked(-q.into_inner())));
        }

        #[test]
        fn six_dimensions_round_trip(q in rotation(), a in 0.1..5.0f64, b in 0.1..5.0f64, mix in -2.0..2.0f64) {
            let mut v = to_6d(&q);
            prop_assert!(from_6d(v).unwrap().angle_to(&q) < 1e-12);
            // Gram-Schmidt ignores lengths and whatever of the first column is mixed into the second.
            for i in 0..3 {
                v[i + 3] = b * v[i + 3] + mix * v[i];
                v[i] *= a;
            }
            prop_assert!(from_6d(v).unwrap().angle_to(&q) < 1e-12);
        }

        #[test]
        fn matrix_round_trip(q in rotation(), noise in prop::array::uniform9(-1e-7..1e-7f64)) {
            let m = q.to_rotation_matrix().into_inner() + Matrix3::from_row_slice(&noise);
            prop_assert!(from_matrix(&m, 1e-5).unwrap().angle_to(&q) < 1e-6);
        }
    }

    #[test]
    fn half_turns_have_one_form() {
        let q = UnitQuaternion::new_unchecked(Quaternion::new(-0.0, 0.0, -1.0, 0.0));
        assert_eq!(xyzw(&q), [0.0, 1.0, 0.0, 0.0]);
        assert!(xyzw(&q).iter().all(|c| c.is_sign_positive()));
    }

    #[test]
    fn what_is_no_rotation_is_refused() {
        assert!(matches!(from_xyzw([0.0; 4]), Err(RotationError::NearZero { .. })));
        assert!(matches!(from_xyzw([f64::NAN, 0.0, 0.0, 1.0]), Err(RotationError::NotFinite { .. })));
        assert!(matches!(from_xyzw([1e300; 4]), Err(RotationError::NearZero { .. })));
        assert!(matches!(from_6d([1.0, 0.0, 0.0, -2.0, 0.0, 0.0]), Err(RotationError::Parallel { .. })));
        assert!(matches!(from_6d([0.0; 6]), Err(RotationError::NearZero { .. })));
        let mirror = Matrix3::from_diagonal(&Vector3::new(1.0, 1.0, -1.0));
        assert!(matches!(from_matrix(&mirror, 1e-2), Err(RotationError::NotARotation { .. })));
        assert!(from_matrix(&(Matrix3::identity() * 1.1), 1e-2).is_err());
        assert!(from_matrix(&Matrix3::zeros(), 1e-2).is_err());
        assert!(from_matrix(&(Matrix3::identity() * f64::INFINITY), 1e-2).is_err());
    }
}
