//! From the raw numbers of a pose head to a pose, and how the rotation turns when they change.

use candle_core::{Device, Result, Tensor, bail};
use grnet_geometry::{Pose, quaternion, se3};
use grnet_model::HeadTensors;
use nalgebra::{Matrix3, Quaternion, SMatrix, Translation3, UnitQuaternion, Vector3};

/// `d_theta / d_raw`: `R(raw + d) ~ Exp(jacobian d) R(raw)`, about the fixed axes of the parent frame; columns beyond
/// the raw numbers are zero.
pub(super) type RotationJacobian = SMatrix<f64, 3, 6>;

/// The rotation that raw numbers stand for: a quaternion (x, y, z, w) by normalisation, six numbers by Gram-Schmidt.
///
/// Numbers that stand for none (shorter than 1e-6, parallel columns) count as no rotation, so that a loss stays finite;
/// their [`jacobian`] is zero. NaN and infinity give NaN.
pub(super) fn rotation(raw: &[f64]) -> UnitQuaternion<f64> {
    if raw.iter().any(|v| !v.is_finite()) {
        return UnitQuaternion::new_unchecked(Quaternion::from(nalgebra::Vector4::repeat(f64::NAN)));
    }
    let rotation = match *raw {
        [x, y, z, w] => quaternion::from_xyzw([x, y, z, w]),
        [a, b, c, d, e, f] => quaternion::from_6d([a, b, c, d, e, f]),
        _ => return UnitQuaternion::identity(),
    };
    rotation.unwrap_or_else(|_| UnitQuaternion::identity())
}

/// How [`rotation`] turns when the raw numbers change.
pub(super) fn jacobian(raw: &[f64]) -> RotationJacobian {
    match *raw {
        [x, y, z, w] if quaternion::from_xyzw([x, y, z, w]).is_ok() => {
            of_quaternion(Vector3::new(x, y, z), w)
        }
        [a, b, c, d, e, f] if quaternion::from_6d([a, b, c, d, e, f]).is_ok() => {
            of_6d(&Vector3::new(a, b, c), &Vector3::new(d, e, f))
        }
        _ if raw.iter().any(|v| !v.is_finite()) => RotationJacobian::repeat(f64::NAN),
        _ => RotationJacobian::zeros(),
    }
}

/// `d_theta = 2 Im(d_q q^-1)`, so `2 / |q|^2 (w d_v - d_w v + v x d_v)`; what only changes the length turns nothing.
fn of_quaternion(v: Vector3<f64>, w: f64) -> RotationJacobian {
    let norm_squared = v.norm_squared() + w * w;
    let mut jacobian = RotationJacobian::zeros();
    jacobian.fixed_view_mut::<3, 3>(0, 0).copy_from(&(Matrix3::identity() * w + se3::hat(&v)));
    jacobian.fixed_view_mut::<3, 1>(0, 3).copy_from(&-v);
    jacobian * (2.0 / norm_squared)
}

/// With the columns b1, b2, b3 of the rotation and `d_b = d_theta x b`: `b2 . d_b1 = theta_3`, `b3 . d_b1 = -theta_2`,
/// `b3 . d_b2 = theta_1`, the components of d_theta along b1, b2, b3.
fn of_6d(a1: &Vector3<f64>, a2: &Vector3<f64>) -> RotationJacobian {
    let b1 = a1.normalize();
    let along = b1.dot(a2);
    let rest = a2 - b1 * along;
    let b2 = rest.normalize();
    let b3 = b1.cross(&b2);
    let mut jacobian = RotationJacobian::zeros();
    let (length_1, length_2) = (a1.norm(), rest.norm());
    let by_a1 = (b3 * b2.transpose() - b2 * b3.transpose()) / length_1
        - b1 * b3.transpose() * (along / (length_1 * length_2));
    jacobian.fixed_view_mut::<3, 3>(0, 0).copy_from(&by_a1);
    jacobian.fixed_view_mut::<3, 3>(0, 3).copy_from(&(b1 * b3.transpose() / length_2));
    jacobian
}

/// The pose of one frame from its row: translation, then the raw rotation.
pub(super) fn pose(row: &[f64]) -> Pose {
    let (translation, raw) = row.split_at(3);
    Pose::from_parts(Translation3::new(translation[0], translation[1], translation[2]), rotation(raw))
}

/// Numbers per frame in a head's output: 3 and 4, or 3 and 6.
///
/// # Errors
/// When the output is not (B, K, 3) and (B, K, 4 or 6) for these B and K.
pub(super) fn row_length(head: &HeadTensors, batch: usize, frames: usize) -> Result<usize> {
    match (head.translation.dims(), head.rotation.dims()) {
        ([b, k, 3], [b_r, k_r, n @ (4 | 6)]) if [b, b_r] == [&batch; 2] && [k, k_r] == [&frames; 2] => {
            Ok(3 + n)
        }
        (translation, rotation) => bail!(
            "a pose head gave translations {translation:?} and rotations {rotation:?}; the targets are {batch} windows of \
             {frames} frames, so ({batch}, {frames}, 3) and ({batch}, {frames}, 4 or 6) are needed"
        ),
    }
}

/// The rows of a head's output side by side on the CPU, differentiable: (B, K, 3 + 4 or 6).
///
/// # Errors
/// As [`row_length`], or when a copy fails.
pub(super) fn rows(head: &HeadTensors, batch: usize, frames: usize) -> Result<Tensor> {
    row_length(head, batch, frames)?;
    // (B, K, 3) and (B, K, n) -> (B, K, 3 + n)
    Tensor::cat(&[&head.translation, &head.rotation], 2)?.to_device(&Device::Cpu)
}

/// The poses of a head, B * K of them window by window, without gradients.
///
/// # Errors
/// As [`rows`].
pub(super) fn poses(head: &HeadTensors, batch: usize, frames: usize) -> Result<Vec<Pose>> {
    let rows = rows(head, batch, frames)?.detach();
    let length = rows.dim(2)?;
    let numbers: Vec<f64> = rows.flatten_all()?.to_vec1::<f32>()?.into_iter().map(f64::from).collect(); // (B, K, n) -> B * K * n
    Ok(numbers.chunks_exact(length).map(pose).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// Central differences of [`rotation`], as turns about fixed axes.
    fn numeric(raw: &[f64]) -> RotationJacobian {
        let mut jacobian = RotationJacobian::zeros();
        for i in 0..raw.len() {
            let step = 1e-5;
            let moved = |d: f64| {
                let mut raw = raw.to_vec();
                raw[i] += d;
                rotation(&raw)
            };
            let turn = se3::so3_log(&(moved(step) * moved(-step).inverse())) / (2.0 * step);
            jacobian.set_column(i, &turn);
        }
        jacobian
    }

    proptest! {
        #[test]
        fn jacobian_of_a_quaternion(raw in prop::array::uniform4(-2.0..2.0f64)) {
            prop_assume!(nalgebra::Vector4::from(raw).norm() > 0.2);
            let difference = (jacobian(&raw) - numeric(&raw)).amax();
            prop_assert!(difference < 1e-6, "{difference}");
        }

        #[test]
        fn jacobian_of_six_numbers(raw in prop::array::uniform6(-2.0..2.0f64)) {
            let (a1, a2) = (Vector3::new(raw[0], raw[1], raw[2]), Vector3::new(raw[3], raw[4], raw[5]));
            prop_assume!(a1.norm() > 0.3 && a1.cross(&a2).norm() > 0.3 * a1.norm());
            let difference = (jacobian(&raw) - numeric(&raw)).amax();
            prop_assert!(difference < 1e-6, "{difference}");
        }
    }

    #[test]
    fn length_turns_nothing() {
        let raw = [0.3, -0.5, 0.2, 0.9];
        let along = jacobian(&raw).fixed_view::<3, 4>(0, 0) * nalgebra::Vector4::from(raw);
        assert!(along.norm() < 1e-15, "{along}");
    }

    #[test]
    fn what_is_no_rotation_is_finite_and_nan_stays_nan() {
        for raw in [&[0.0; 4][..], &[0.0; 6], &[1.0, 2.0, 3.0, 2.0, 4.0, 6.0]] {
            assert_eq!(rotation(raw), UnitQuaternion::identity());
            assert_eq!(jacobian(raw), RotationJacobian::zeros());
        }
        assert!(rotation(&[f64::NAN, 0.0, 0.0, 1.0]).w.is_nan());
        assert!(rotation(&[1.0, 0.0, 0.0, 0.0, f64::INFINITY, 0.0]).w.is_nan());
        assert!(jacobian(&[f64::NAN, 0.0, 0.0, 1.0]).iter().all(|v| v.is_nan()));
    }
}
