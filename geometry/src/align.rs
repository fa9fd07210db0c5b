//! Least-squares alignment of trajectories (Umeyama, *Least-Squares Estimation of Transformation Parameters Between
//! Two Point Patterns*, PAMI 1991; equation numbers refer to it).

use nalgebra::{Isometry3, Matrix3, Rotation3, Translation3, UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::Pose;

/// What is estimated before an estimate is compared with the ground truth.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Alignment {
    /// Nothing: both are in the same frame.
    None,
    /// Rotation and translation.
    Se3,
    /// Rotation, translation and scale.
    Sim3,
    /// The scale of Sim(3) alone, without its rotation and translation (`evo`'s `--correct_scale` alone,
    /// `kitti-odom-eval`'s `scale_7dof`).
    Scale,
}

impl Alignment {
    /// The similarity of this kind that moves `estimate` closest to `reference`, judged by positions.
    ///
    /// # Errors
    /// [`AlignmentError`] as of [`umeyama`]; never for [`Alignment::None`].
    pub fn solve(self, estimate: &[Pose], reference: &[Pose]) -> Result<Similarity, AlignmentError> {
        if self == Alignment::None {
            return Ok(Similarity::identity());
        }
        let positions = |poses: &[Pose]| poses.iter().map(|p| p.translation.vector).collect::<Vec<_>>();
        let found = umeyama(&positions(estimate), &positions(reference), self != Alignment::Se3)?;
        Ok(match self {
            Alignment::Scale => Similarity { scale: found.scale, ..Similarity::identity() },
            _ => found,
        })
    }
}

/// Positions that admit no unique alignment.
#[derive(Debug, Clone, Copy, PartialEq, Error)]
pub enum AlignmentError {
    /// The lists differ in length.
    #[error("alignment needs as many points on both sides, found {from} and {to}")]
    LengthMismatch {
        /// Number of points to be moved.
        from: usize,
        /// Number of points of the reference.
        to: usize,
    },
    /// The positions lie in one point or on one line, so that the rotation is not determined.
    #[error(
        "{points} positions do not determine an alignment: they (or their correlation) span \
         {dimensions} dimension(s), at least 2 are needed; the trajectory stands still or is a straight line"
    )]
    Degenerate {
        /// Number of points.
        points: usize,
        /// Rank of the correlation of both point sets.
        dimensions: usize,
    },
    /// A position is NaN or infinite.
    #[error("position {index} is not finite")]
    NotFinite {
        /// Index of the first such position.
        index: usize,
    },
}

/// `x -> scale * rotation * x + translation`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Similarity {
    /// Scale, positive.
    pub scale: f64,
    /// Rotation.
    pub rotation: UnitQuaternion<f64>,
    /// Translation in metres, applied last.
    pub translation: Vector3<f64>,
}

impl Similarity {
    /// The map that changes nothing.
    pub fn identity() -> Self {
        Self { scale: 1.0, rotation: UnitQuaternion::identity(), translation: Vector3::zeros() }
    }

    /// Moves a point.
    pub fn apply_point(&self, x: &Vector3<f64>) -> Vector3<f64> {
        self.rotation * x * self.scale + self.translation
    }

    /// Moves a pose: its position as a point, its rotation by the rotation alone.
    pub fn apply(&self, world_from_camera: &Pose) -> Pose {
        Isometry3::from_parts(
            Translation3::from(self.apply_point(&world_from_camera.translation.vector)),
            self.rotation * world_from_camera.rotation,
        )
    }
}

/// The similarity that minimises `sum |to_i - (scale R from_i + t)|^2`; `scale = 1` unless `with_scale`.
///
/// # Errors
/// [`AlignmentError`] if the lists differ in length, hold a non-finite number, or lie in one point or on one line (fewer
/// than two singular values of Eq. 38 above rounding): a rotation about the line would be arbitrary.
pub fn umeyama(
    from: &[Vector3<f64>],
    to: &[Vector3<f64>],
    with_scale: bool,
) -> Result<Similarity, AlignmentError> {
    if from.len() != to.len() {
        return Err(AlignmentError::LengthMismatch { from: from.len(), to: to.len() });
    }
    let finite = |v: &Vector3<f64>| v.iter().all(|c| c.is_finite());
    if let Some(index) = from.iter().zip(to).position(|(a, b)| !finite(a) || !finite(b)) {
        return Err(AlignmentError::NotFinite { index });
    }
    let n = from.len() as f64;
    let degenerate = |dimensions| AlignmentError::Degenerate { points: from.len(), dimensions };
    if from.is_empty() {
        return Err(degenerate(0));
    }
    // Eq. (34)-(36), (38)
    let mean_x = from.iter().sum::<Vector3<f64>>() / n;
    let mean_y = to.iter().sum::<Vector3<f64>>() / n;
    let variance_x = from.iter().map(|x| (x - mean_x).norm_squared()).sum::<f64>() / n;
    let covariance =
        from.iter().zip(to).map(|(x, y)| (y - mean_y) * (x - mean_x).transpose()).sum::<Matrix3<f64>>() / n;

    let svd = covariance.svd(true, true);
    let d = svd.singular_values;
    let (Some(u), Some(v_t)) = (svd.u, svd.v_t) else { return Err(degenerate(0)) };
    // The first bound is evo's; the second catches what rounding leaves of points on a line far from the origin.
    let rounding = f64::EPSILON.max(1e-13 * d[0]);
    let rank = d.iter().filter(|v| **v > rounding).count();
    if rank < 2 {
        return Err(degenerate(rank));
    }
    // Eq. (39)-(43): keep a right-handed frame.
    let sign = if u.determinant() * v_t.determinant() < 0.0 { -1.0 } else { 1.0 };
    let s = Vector3::new(1.0, 1.0, sign);
    let r = u * Matrix3::from_diagonal(&s) * v_t;
    let scale = if with_scale { d.dot(&s) / variance_x } else { 1.0 };
    let mut rotation = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(r));
    rotation.renormalize();
    Ok(Similarity { scale, rotation, translation: mean_y - r * mean_x * scale })
}

/// The scale that minimises `sum |to_i - scale from_i|^2` without moving the origin: `kitti-odom-eval`'s
/// alignment `scale`, meant for trajectories that start at the origin.
///
/// # Errors
/// [`AlignmentError`] if the lists differ in length, hold a non-finite number, or all of `from` is zero.
pub fn scale_about_origin(from: &[Vector3<f64>], to: &[Vector3<f64>]) -> Result<f64, AlignmentError> {
    if from.len() != to.len() {
        return Err(AlignmentError::LengthMismatch { from: from.len(), to: to.len() });
    }
    let denominator = from.iter().map(|x| x.norm_squared()).sum::<f64>();
    let scale = from.iter().zip(to).map(|(x, y)| x.dot(y)).sum::<f64>() / denominator;
    if denominator == 0.0 {
        return Err(AlignmentError::Degenerate { points: from.len(), dimensions: 0 });
    }
    if !scale.is_finite() {
        let finite = |v: &Vector3<f64>| v.iter().all(|c| c.is_finite());
        let index = from.iter().zip(to).position(|(a, b)| !finite(a) || !finite(b)).unwrap_or(0);
        return Err(AlignmentError::NotFinite { index });
    }
    Ok(scale)
}
