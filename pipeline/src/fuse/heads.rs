//! Raw head outputs to poses and covariances.

use grnet_geometry::{Covariance6, Pose, quaternion};
use grnet_model::HeadOutput;
use nalgebra::{Isometry3, Translation3, Vector3};

use crate::options::is_finite;

/// A pose with its covariance (NaN when not known).
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Uncertain {
    pub(crate) pose: Pose,
    pub(crate) covariance: Covariance6,
}

/// A head's output holds NaN or infinity, or its rotation cannot be normalised.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct NotAPose;

/// Log-variances further from 0 than this (3e-7 m and 3e6 m of deviation) are no statement about a pose; the
/// covariance then is unknown. It also keeps sums of covariances invertible.
const LARGEST_LOG_VARIANCE: f64 = 30.0;

/// Reads a head: the rotation normalised, the diagonal covariance from the log-variances.
pub(crate) fn read(head: &HeadOutput) -> Result<Uncertain, NotAPose> {
    let rotation = match *head.rotation_raw.as_slice() {
        [x, y, z, w] => quaternion::from_xyzw([x, y, z, w]),
        [a, b, c, d, e, f] => quaternion::from_6d([a, b, c, d, e, f]),
        _ => return Err(NotAPose),
    };
    let rotation = rotation.map_err(|_| NotAPose)?;
    let pose = Isometry3::from_parts(Translation3::from(Vector3::from(head.translation_m)), rotation);
    if !is_finite(&pose) {
        return Err(NotAPose);
    }
    let covariance = match head.log_variance {
        None => Covariance6::nan(),
        Some(log_variance) if log_variance.iter().any(|v| !v.is_finite()) => return Err(NotAPose),
        Some(log_variance) if log_variance.iter().any(|v| v.abs() > LARGEST_LOG_VARIANCE) => {
            Covariance6::nan()
        }
        Some(log_variance) => Covariance6::from_diagonal(log_variance.map(f64::exp)),
    };
    Ok(Uncertain { pose, covariance })
}

impl Uncertain {
    /// A pose that is exact by definition or calibration.
    pub(crate) fn exact(pose: Pose) -> Self {
        Self { pose, covariance: Covariance6::zero() }
    }

    /// `a_from_b.then(b_from_c)` is `a_from_c`; the two errors are taken as independent.
    pub(crate) fn then(&self, b_from_c: &Self) -> Self {
        Self {
            pose: self.pose * b_from_c.pose,
            covariance: Covariance6::compose(
                &self.pose,
                &self.covariance,
                &b_from_c.pose,
                &b_from_c.covariance,
            ),
        }
    }

    /// The mean of two statements about one pose, `other` with the weight `share` (0 to 1): translations on the line between
    /// them, rotations on the great circle; where that is not unique, `other`.
    ///
    /// How the two errors depend on each other does not matter: the square of a mean is at most the mean of the squares, so
    /// that the mean of the covariances is never too small.
    pub(crate) fn towards(&self, other: &Self, share: f64) -> Self {
        let pose = self.pose.try_lerp_slerp(&other.pose, share, 1e-9).unwrap_or(other.pose);
        let covariance = self.covariance.scaled(1.0 - share) + other.covariance.scaled(share);
        Self { pose, covariance }
    }

    /// Both numbers that a caller sees are finite, or the covariance is NaN throughout.
    pub(crate) fn is_presentable(&self) -> bool {
        is_finite(&self.pose)
    }
}
