//! The 6x6 pose covariance and how it moves between frames.
//!
//! Convention, the one of `nav_msgs/Odometry`: for a pose `a_from_b` the error is
//! `[d_t, d_theta]` about the **fixed axes of the parent frame `a`**,
//! `R_true = Exp(d_theta) R_est` and `t_true = t_est + d_t`. Translation and rotation are perturbed separately:
//! a rotation error does not swing the translation, so this is not the left perturbation of SE(3).
//!
//! All transports are first order in the error.

use std::ops::Add;

use nalgebra::{Matrix3, Matrix6, Translation3, Vector6};

use crate::{
    Pose,
    se3::{self, Tangent},
};

/// Covariance of a pose, `[translation, rotation]`, in m^2, m rad and rad^2 (convention in the [module](self)).
///
/// All NaN when unknown: never zero, which would claim certainty.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Covariance6(Matrix6<f64>);

impl Covariance6 {
    /// Wraps a matrix as it is; see [`is_valid`](Self::is_valid) for the check.
    pub fn new(matrix: Matrix6<f64>) -> Self {
        Self(matrix)
    }

    /// Independent errors with the given variances (m^2 three times, rad^2 three times).
    pub fn from_diagonal(variances: [f64; 6]) -> Self {
        Self(Matrix6::from_diagonal(&Vector6::from(variances)))
    }

    /// "Unknown": every entry is NaN.
    pub fn nan() -> Self {
        Self(Matrix6::repeat(f64::NAN))
    }

    /// "Exactly known": every entry is zero. For constants such as a fixed extrinsic only.
    pub fn zero() -> Self {
        Self(Matrix6::zeros())
    }

    /// Reads 36 numbers row by row.
    pub fn from_row_major(values: &[f64; 36]) -> Self {
        Self(Matrix6::from_row_slice(values))
    }

    /// The 36 numbers row by row, as messages carry them.
    pub fn to_row_major(&self) -> [f64; 36] {
        let mut values = [0.0; 36];
        for (i, v) in values.iter_mut().enumerate() {
            *v = self.0[(i / 6, i % 6)];
        }
        values
    }

    /// The matrix, rows and columns `[translation, rotation]`.
    pub fn matrix(&self) -> &Matrix6<f64> {
        &self.0
    }

    /// The translational block (m^2).
    pub fn translation(&self) -> Matrix3<f64> {
        self.0.fixed_view::<3, 3>(0, 0).into_owned()
    }

    /// The rotational block (rad^2).
    pub fn rotation(&self) -> Matrix3<f64> {
        self.0.fixed_view::<3, 3>(3, 3).into_owned()
    }

    /// Whether no entry is NaN or infinite.
    pub fn is_finite(&self) -> bool {
        self.0.iter().all(|v| v.is_finite())
    }

    /// Whether the matrix is finite and symmetric up to `relative` times its largest entry.
    pub fn is_symmetric(&self, relative: f64) -> bool {
        self.is_finite() && (self.0 - self.0.transpose()).amax() <= relative * self.0.amax()
    }

    /// Whether the matrix is symmetric and no eigenvalue is below `-relative` times the largest.
    pub fn is_positive_semidefinite(&self, relative: f64) -> bool {
        if !self.is_symmetric(relative) {
            return false;
        }
        let eigenvalues = self.symmetrized().0.symmetric_eigenvalues();
        eigenvalues.min() >= -relative * eigenvalues.amax()
    }

    /// Whether this can be published: finite, symmetric, positive semidefinite (to 1e-9).
    pub fn is_valid(&self) -> bool {
        self.is_positive_semidefinite(1e-9)
    }

    /// `(C + C^T) / 2`: removes the asymmetry that rounding leaves.
    pub fn symmetrized(&self) -> Self {
        Self((self.0 + self.0.transpose()) * 0.5)
    }

    /// `factor * C`; a calibration scales covariances, a standard deviation scales with its root.
    pub fn scaled(&self, factor: f64) -> Self {
        Self(self.0 * factor)
    }

    /// `J C J^T`.
    pub fn transported(&self, jacobian: &Matrix6<f64>) -> Self {
        Self(jacobian * self.0 * jacobian.transpose()).symmetrized()
    }

    /// Covariance of `a_from_c = a_from_b * b_from_c` for independent errors of the two factors.
    ///
    /// `d_theta = d_theta_1 + R_ab d_theta_2`, `d_t = d_t_1 + R_ab d_t_2 - (R_ab t_bc)^ d_theta_1`.
    pub fn compose(a_from_b: &Pose, cov_ab: &Self, b_from_c: &Pose, cov_bc: &Self) -> Self {
        cov_ab.with_child_moved(a_from_b, b_from_c) + cov_bc.with_parent_moved(a_from_b)
    }

    /// Covariance of `b_from_a`, given `a_from_b` and its covariance.
    ///
    /// `d_theta' = -R^T d_theta`, `d_t' = -R^T d_t - R^T t^ d_theta`.
    pub fn inverse(a_from_b: &Pose, cov_ab: &Self) -> Self {
        let r_t = a_from_b.rotation.inverse().to_rotation_matrix().into_inner();
        let upper = -r_t * se3::hat(&a_from_b.translation.vector);
        cov_ab.transported(&se3::blocks(&-r_t, &upper, &-r_t))
    }

    /// Covariance of `parent_from_other = parent_from_child * child_from_other` for an exactly known extrinsic
    /// (for example from the camera to the base of the robot), given that of `parent_from_child`.
    pub fn with_child_moved(&self, parent_from_child: &Pose, child_from_other: &Pose) -> Self {
        let lever = parent_from_child.rotation * child_from_other.translation.vector;
        let identity = Matrix3::identity();
        self.transported(&se3::blocks(&identity, &-se3::hat(&lever), &identity))
    }

    /// Covariance of `other_from_child = other_from_parent * parent_from_child` for an exactly known
    /// `other_from_parent` (for example `map_from_world`), given that of `parent_from_child`.
    pub fn with_parent_moved(&self, other_from_parent: &Pose) -> Self {
        let r = other_from_parent.rotation.to_rotation_matrix().into_inner();
        self.transported(&se3::blocks(&r, &Matrix3::zeros(), &r))
    }

    /// Normalised estimation error squared, `e^T C^-1 e`; its mean over many samples is 6 where the covariance
    /// means what it says.
    ///
    /// `None` if the covariance is not finite or not positive definite, or the error not finite.
    pub fn nees(&self, error: &Tangent) -> Option<f64> {
        if !self.is_finite() || error.0.iter().any(|v| !v.is_finite()) {
            return None;
        }
        let solved = self.symmetrized().0.cholesky()?.solve(&error.0);
        Some(error.0.dot(&solved)).filter(|nees| nees.is_finite())
    }
}

/// The covariance of a sum or difference of independent errors; for example the `S` of an innovation.
impl Add for Covariance6 {
    type Output = Self;

    fn add(self, other: Self) -> Self {
        Self(self.0 + other.0)
    }
}

/// The error `[d_t, d_theta]` of an estimate in this module's convention:
/// `d_t = t_true - t_est`, `d_theta = Log(R_true R_est^T)`.
pub fn error(estimate: &Pose, truth: &Pose) -> Tangent {
    Tangent::new(
        truth.translation.vector - estimate.translation.vector,
        se3::so3_log(&(truth.rotation * estimate.rotation.inverse())),
    )
}

/// The pose that is off by `error`: the inverse of [`error`](fn@error) in its second argument.
pub fn perturb(estimate: &Pose, error: &Tangent) -> Pose {
    Pose::from_parts(
        Translation3::from(estimate.translation.vector + error.translation()),
        se3::so3_exp(&error.rotation()) * estimate.rotation,
    )
}
