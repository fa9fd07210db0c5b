//! The groups SO(3) and SE(3): exponential, logarithm, Jacobians, interpolation.
//!
//! Symbols as in Barfoot, *State Estimation for Robotics* (2017), chapter 7: a twist is
//! `xi = [rho, phi]` with `rho` in metres and `phi` in radians, `Exp(xi) = (Exp(phi), J(phi) rho)` where `J` is
//! the left Jacobian of SO(3).

use nalgebra::{Isometry3, Matrix3, Matrix6, Quaternion, Translation3, UnitQuaternion, Vector3, Vector6};

use crate::Pose;

/// Below this angle (rad) closed forms lose digits to cancellation and series take over.
///
/// At the switch the first omitted series term is below 1e-16 relative.
const SMALL_ANGLE_RAD: f64 = 1e-2;

/// A 6-vector `[translation, rotation]`: a twist of SE(3), or a pose error.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Tangent(pub Vector6<f64>);

impl Tangent {
    /// Joins a translational part (m) and a rotation vector (rad).
    pub fn new(translation: Vector3<f64>, rotation: Vector3<f64>) -> Self {
        let mut v = Vector6::zeros();
        v.fixed_rows_mut::<3>(0).copy_from(&translation);
        v.fixed_rows_mut::<3>(3).copy_from(&rotation);
        Self(v)
    }

    /// The zero vector.
    pub fn zero() -> Self {
        Self(Vector6::zeros())
    }

    /// The translational part, in metres.
    pub fn translation(&self) -> Vector3<f64> {
        self.0.fixed_rows::<3>(0).into_owned()
    }

    /// The rotational part, a rotation vector in radians.
    pub fn rotation(&self) -> Vector3<f64> {
        self.0.fixed_rows::<3>(3).into_owned()
    }

    /// The whole vector, `[translation, rotation]`.
    pub fn vector(&self) -> &Vector6<f64> {
        &self.0
    }
}

/// `Exp(xi)`: the pose reached by moving with the twist `xi` for one unit of time.
///
/// ```
/// use grnet_geometry::{nalgebra::Vector3, se3::{self, Tangent}};
/// let xi = Tangent::new(Vector3::new(1.0, 2.0, 3.0), Vector3::new(0.1, -0.2, 0.3));
/// assert!((se3::log(&se3::exp(&xi)).0 - xi.0).norm() < 1e-12);
/// ```
pub fn exp(xi: &Tangent) -> Pose {
    let phi = xi.rotation();
    let t = so3_left_jacobian(&phi) * xi.translation();
    Isometry3::from_parts(Translation3::from(t), so3_exp(&phi))
}

/// `Log(a_from_b)`: the twist `[rho, phi]` with `|phi| <= pi` whose exponential is the given pose.
pub fn log(a_from_b: &Pose) -> Tangent {
    let phi = so3_log(&a_from_b.rotation);
    Tangent::new(so3_left_jacobian_inverse(&phi) * a_from_b.translation.vector, phi)
}

/// `a_from_b = world_from_a^-1 * world_from_b`.
pub fn relative(world_from_a: &Pose, world_from_b: &Pose) -> Pose {
    world_from_a.inv_mul(world_from_b)
}

/// The pose at fraction `t` of the way from `a` to `b`: a straight line and the shorter rotation at constant rate.
///
/// `t = 0` gives `a`, `t = 1` gives `b`; values outside extrapolate at the same rates. Unlike a quaternion slerp it
/// is defined for every pair of poses, also half a turn apart.
pub fn interpolate(world_from_a: &Pose, world_from_b: &Pose, t: f64) -> Pose {
    let a_from_b = world_from_a.rotation.inverse() * world_from_b.rotation;
    let translation = world_from_a.translation.vector
        + (world_from_b.translation.vector - world_from_a.translation.vector) * t;
    let rotation = world_from_a.rotation * so3_exp(&(so3_log(&a_from_b) * t));
    Isometry3::from_parts(Translation3::from(translation), rotation)
}

/// The angle of a rotation in `[0, pi]`, in radians; accurate near 0 and near pi.
pub fn angle_rad(rotation: &UnitQuaternion<f64>) -> f64 {
    let q = rotation.quaternion();
    2.0 * q.imag().norm().atan2(q.scalar().abs())
}

/// `phi^`: the skew-symmetric matrix with `hat(a) * b = a x b`.
pub fn hat(a: &Vector3<f64>) -> Matrix3<f64> {
    a.cross_matrix()
}

/// `Exp(phi)` on SO(3), for a rotation vector of any length (rad).
pub fn so3_exp(phi: &Vector3<f64>) -> UnitQuaternion<f64> {
    let half = 0.5 * phi.norm();
    // sin(|phi|/2) / |phi|
    let k = if half < SMALL_ANGLE_RAD {
        let h2 = half * half;
        0.5 * (1.0 - h2 / 6.0 * (1.0 - h2 / 20.0 * (1.0 - h2 / 42.0)))
    } else {
        half.sin() / (2.0 * half)
    };
    UnitQuaternion::new_normalize(Quaternion::from_parts(half.cos(), phi * k))
}

/// `Log(R)` on SO(3): the rotation vector with length in `[0, pi]` (rad).
pub fn so3_log(rotation: &UnitQuaternion<f64>) -> Vector3<f64> {
    let q = rotation.quaternion();
    // q and -q are the same rotation; w >= 0 selects the angle in [0, pi].
    let (v, w) = if q.scalar() < 0.0 { (-q.imag(), -q.scalar()) } else { (q.imag(), q.scalar()) };
    let n = v.norm();
    if n == 0.0 { Vector3::zeros() } else { v * (2.0 * n.atan2(w) / n) }
}

/// `J(phi)`, the left Jacobian of SO(3): `Exp(phi + d) ~ Exp(J d) Exp(phi)` (Barfoot Eq. 7.77).
pub fn so3_left_jacobian(phi: &Vector3<f64>) -> Matrix3<f64> {
    let c = Coefficients::at(phi.norm());
    let p = hat(phi);
    Matrix3::identity() + p * c.one_minus_cos + p * p * c.angle_minus_sin
}

/// `J(phi)^-1` (Barfoot Eq. 7.76); finite for `|phi| < 2 pi`, so for everything that [`so3_log`] returns.
pub fn so3_left_jacobian_inverse(phi: &Vector3<f64>) -> Matrix3<f64> {
    let theta = phi.norm();
    let t2 = theta * theta;
    // 1/theta^2 - (1 + cos) / (2 theta sin); the half-angle form stays finite at pi.
    let k = if theta < 10.0 * SMALL_ANGLE_RAD {
        1.0 / 12.0 + t2 / 720.0 + t2 * t2 / 30240.0 + t2 * t2 * t2 / 1_209_600.0
    } else {
        (1.0 - 0.5 * theta * (0.5 * theta).cos() / (0.5 * theta).sin()) / t2
    };
    let p = hat(phi);
    Matrix3::identity() - p * 0.5 + p * p * k
}

/// The left Jacobian of SE(3), 6x6: `Exp(xi + d) ~ Exp(J d) Exp(xi)` (Barfoot Eq. 7.85).
pub fn left_jacobian(xi: &Tangent) -> Matrix6<f64> {
    let j = so3_left_jacobian(&xi.rotation());
    blocks(&j, &q_block(xi), &j)
}

/// The inverse of [`left_jacobian`] (Barfoot Eq. 7.95).
pub fn left_jacobian_inverse(xi: &Tangent) -> Matrix6<f64> {
    let j_inv = so3_left_jacobian_inverse(&xi.rotation());
    blocks(&j_inv, &(-j_inv * q_block(xi) * j_inv), &j_inv)
}

/// `Ad(T)`, 6x6: `T Exp(xi) T^-1 = Exp(Ad(T) xi)` (Barfoot Eq. 7.45).
pub fn adjoint(a_from_b: &Pose) -> Matrix6<f64> {
    let r = a_from_b.rotation.to_rotation_matrix().into_inner();
    blocks(&r, &(hat(&a_from_b.translation.vector) * r), &r)
}

/// `[[a, b], [0, d]]`.
pub(crate) fn blocks(a: &Matrix3<f64>, b: &Matrix3<f64>, d: &Matrix3<f64>) -> Matrix6<f64> {
    let mut m = Matrix6::zeros();
    m.fixed_view_mut::<3, 3>(0, 0).copy_from(a);
    m.fixed_view_mut::<3, 3>(0, 3).copy_from(b);
    m.fixed_view_mut::<3, 3>(3, 3).copy_from(d);
    m
}

/// `Q(xi)` of the SE(3) Jacobian (Barfoot Eq. 7.86).
fn q_block(xi: &Tangent) -> Matrix3<f64> {
    let (p, r) = (hat(&xi.rotation()), hat(&xi.translation()));
    let c = Coefficients::at(xi.rotation().norm());
    r * 0.5
        + (p * r + r * p + p * r * p) * c.angle_minus_sin
        + (p * p * r + r * p * p - p * r * p * 3.0) * c.q3
        + (p * r * p * p + p * p * r * p) * c.q4
}

/// Scalar functions of the angle that the Jacobians share.
struct Coefficients {
    /// `(1 - cos t) / t^2`
    one_minus_cos: f64,
    /// `(t - sin t) / t^3`
    angle_minus_sin: f64,
    /// `(t^2/2 + cos t - 1) / t^4`
    q3: f64,
    /// `(t - 1.5 sin t + 0.5 t cos t) / t^5`
    q4: f64,
}

impl Coefficients {
    fn at(t: f64) -> Self {
        let t2 = t * t;
        // The fourth- and fifth-order forms cancel much earlier than the others.
        if t < 0.5 {
            let series = |c: [f64; 6]| c.iter().rev().fold(0.0, |sum, c| sum * t2 + c);
            return Self {
                one_minus_cos: series([
                    1.0 / 2.0,
                    -1.0 / 24.0,
                    1.0 / 720.0,
                    -1.0 / 40_320.0,
                    1.0 / 3_628_800.0,
                    -1.0 / 479_001_600.0,
                ]),
                angle_minus_sin: series([
                    1.0 / 6.0,
                    -1.0 / 120.0,
                    1.0 / 5_040.0,
                    -1.0 / 362_880.0,
                    1.0 / 39_916_800.0,
                    -1.0 / 6_227_020_800.0,
                ]),
                q3: series([
                    1.0 / 24.0,
                    -1.0 / 720.0,
                    1.0 / 40_320.0,
                    -1.0 / 3_628_800.0,
                    1.0 / 479_001_600.0,
                    -1.0 / 87_178_291_200.0,
                ]),
                // Terms (-1)^m (m + 1) / (2 m + 5)! of the expansion of q4.
                q4: series([
                    1.0 / 120.0,
                    -2.0 / 5_040.0,
                    3.0 / 362_880.0,
                    -4.0 / 39_916_800.0,
                    5.0 / 6_227_020_800.0,
                    -6.0 / 1_307_674_368_000.0,
                ]),
            };
        }
        let (sin, cos) = t.sin_cos();
        Self {
            one_minus_cos: (1.0 - cos) / t2,
            angle_minus_sin: (t - sin) / (t2 * t),
            q3: (0.5 * t2 + cos - 1.0) / (t2 * t2),
            q4: (t - 1.5 * sin + 0.5 * t * cos) / (t2 * t2 * t),
        }
    }
}
