//! Properties of the group operations, near zero and near half a turn in particular.

use std::f64::consts::PI;

use grnet_geometry::{
    Pose,
    nalgebra::{Matrix3, Matrix6, Vector3, Vector6},
    se3::{self, Tangent},
};
use proptest::prelude::*;

fn vector(size: f64) -> impl Strategy<Value = Vector3<f64>> {
    prop::array::uniform3(-size..size).prop_map(Vector3::from)
}

fn direction() -> impl Strategy<Value = Vector3<f64>> {
    vector(1.0).prop_filter_map("direction", |v| (v.norm() > 0.1).then(|| v.normalize()))
}

/// Angles over the whole range with weight on both ends.
fn angle() -> impl Strategy<Value = f64> {
    prop_oneof![
        0.0..PI,
        (-14.0..-1.0f64).prop_map(|e| 10f64.powf(e)),
        (-14.0..-1.0f64).prop_map(|e| PI - 10f64.powf(e)),
    ]
}

fn tangent() -> impl Strategy<Value = Tangent> {
    (vector(5.0), direction(), angle()).prop_map(|(rho, axis, angle)| Tangent::new(rho, axis * angle))
}

fn pose() -> impl Strategy<Value = Pose> {
    tangent().prop_map(|xi| se3::exp(&xi))
}

fn distance(a: &Pose, b: &Pose) -> f64 {
    (a.translation.vector - b.translation.vector).norm()
        + se3::angle_rad(&a.rotation.rotation_to(&b.rotation))
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(1024))]

    #[test]
    fn log_inverts_exp(xi in tangent()) {
        let back = se3::log(&se3::exp(&xi));
        // Within 1e-7 of half a turn the axis may flip sign: there the poses are compared below.
        if xi.rotation().norm() < PI - 1e-7 {
            prop_assert!((back.0 - xi.0).norm() < 1e-11, "{} {}", xi.0, back.0);
        }
        prop_assert!(back.rotation().norm() <= PI + 1e-15);
    }

    #[test]
    fn exp_inverts_log(a_from_b in pose()) {
        prop_assert!(distance(&se3::exp(&se3::log(&a_from_b)), &a_from_b) < 1e-12);
    }

    #[test]
    fn small_rotations_keep_their_digits(axis in direction(), e in -140.0..-8.0f64) {
        let phi = axis * 10f64.powf(e);
        prop_assert!((se3::so3_log(&se3::so3_exp(&phi)) - phi).norm() <= 1e-15 * phi.norm());
    }

    #[test]
    fn composition_and_inverse(a in pose(), b in pose(), c in pose()) {
        prop_assert!(distance(&(a * b * c), &(a * (b * c))) < 1e-11);
        prop_assert!(distance(&(a * a.inverse()), &Pose::identity()) < 1e-11);
        prop_assert!(distance(&(a * se3::relative(&a, &b)), &b) < 1e-11);
        prop_assert!((se3::log(&a.inverse()).0 + se3::log(&a).0).norm() < 1e-10
            || se3::log(&a).rotation().norm() > PI - 1e-6);
    }

    #[test]
    fn interpolation_end_points(a in pose(), b in pose(), t in 0.0..1.0f64) {
        prop_assert!(distance(&se3::interpolate(&a, &b, 0.0), &a) < 1e-12);
        prop_assert!(distance(&se3::interpolate(&a, &b, 1.0), &b) < 1e-11);
        let at = se3::interpolate(&a, &b, t);
        let whole = se3::angle_rad(&a.rotation.rotation_to(&b.rotation));
        prop_assert!((se3::angle_rad(&a.rotation.rotation_to(&at.rotation)) - t * whole).abs() < 1e-12);
        let straight = a.translation.vector.lerp(&b.translation.vector, t);
        prop_assert!((at.translation.vector - straight).norm() < 1e-12);
    }

    #[test]
    fn jacobian_is_the_derivative_of_exp(xi in tangent()) {
        let jacobian = se3::left_jacobian(&xi);
        let base_inverse = se3::exp(&xi).inverse();
        const H: f64 = 1e-5;
        for k in 0..6 {
            let step = |h: f64| {
                let mut v = xi.0;
                v[k] += h;
                se3::log(&(se3::exp(&Tangent(v)) * base_inverse)).0
            };
            let numeric: Vector6<f64> = (step(H) - step(-H)) / (2.0 * H);
            prop_assert!((numeric - jacobian.column(k)).norm() < 1e-8, "column {k} at {}", xi.0);
        }
    }

    #[test]
    fn jacobian_inverse(xi in tangent()) {
        let product = se3::left_jacobian(&xi) * se3::left_jacobian_inverse(&xi);
        prop_assert!((product - Matrix6::identity()).norm() < 1e-10);
        let so3 = se3::so3_left_jacobian(&xi.rotation()) * se3::so3_left_jacobian_inverse(&xi.rotation());
        prop_assert!((so3 - Matrix3::identity()).norm() < 1e-12);
    }

    #[test]
    fn adjoint_moves_twists(a in pose(), xi in tangent()) {
        let small = Tangent(xi.0 * 0.1);
        let left = a * se3::exp(&small) * a.inverse();
        let right = se3::exp(&Tangent(se3::adjoint(&a) * small.0));
        prop_assert!(distance(&left, &right) < 1e-11);
    }
}

#[test]
fn exactly_zero_and_exactly_half_a_turn() {
    assert_eq!(se3::log(&Pose::identity()), Tangent::zero());
    assert_eq!(se3::exp(&Tangent::zero()), Pose::identity());
    for axis in [Vector3::x(), Vector3::y(), -Vector3::z()] {
        let half_turn = se3::so3_exp(&(axis * PI));
        let back = se3::so3_log(&half_turn);
        assert!((back.norm() - PI).abs() < 1e-15 && back.cross(&axis).norm() < 1e-15);
        let start = Pose::from_parts(Vector3::x().into(), half_turn);
        let middle = se3::interpolate(&Pose::identity(), &start, 0.5);
        assert!((se3::angle_rad(&middle.rotation) - PI / 2.0).abs() < 1e-14);
    }
}

#[test]
fn series_meet_closed_forms() {
    // On both sides of every switch between series and closed form the results are continuous.
    let axis = Vector3::new(0.6, -0.64, 0.48);
    for switch in [0.02, 0.1, 0.5] {
        let at = |factor: f64| Tangent::new(Vector3::new(1.0, -2.0, 0.5), axis * switch * factor);
        let (below, above) = (at(1.0 - 1e-13), at(1.0 + 1e-13));
        assert!((se3::exp(&below).to_matrix() - se3::exp(&above).to_matrix()).norm() < 2e-12);
        assert!((se3::left_jacobian(&below) - se3::left_jacobian(&above)).norm() < 2e-12);
        assert!((se3::left_jacobian_inverse(&below) - se3::left_jacobian_inverse(&above)).norm() < 2e-12);
    }
}
