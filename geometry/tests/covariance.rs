//! Covariance transport against finite differences and against sampled errors.

use grnet_geometry::{
    Covariance6, Pose,
    covariance::{error, perturb},
    nalgebra::{Cholesky, Matrix6, Vector3, Vector6},
    scores::calibration,
    se3::{self, Tangent},
};
use proptest::prelude::*;
use rand_chacha::{ChaCha8Rng, rand_core::SeedableRng};
use rand_distr::{Distribution, StandardNormal};

fn pose() -> impl Strategy<Value = Pose> {
    prop::array::uniform6(-3.0..3.0f64).prop_map(|v| se3::exp(&Tangent(Vector6::from(v))))
}

/// A positive definite matrix with correlations between all components.
fn covariance() -> impl Strategy<Value = Covariance6> {
    prop::collection::vec(-1.0..1.0f64, 36).prop_map(|v| {
        let m = Matrix6::from_row_slice(&v);
        Covariance6::new((m * m.transpose() + Matrix6::identity() * 0.1) * 1e-4)
    })
}

/// `J C J^T` with `J` the numeric derivative of the output's error by the input's error.
fn numeric(input: &Pose, covariance: &Covariance6, output: impl Fn(&Pose) -> Pose) -> Covariance6 {
    const H: f64 = 1e-6;
    let mut jacobian = Matrix6::zeros();
    for k in 0..6 {
        let step = |h: f64| {
            let mut e = Vector6::zeros();
            e[k] = h;
            error(&output(input), &output(&perturb(input, &Tangent(e)))).0
        };
        jacobian.set_column(k, &((step(H) - step(-H)) / (2.0 * H)));
    }
    Covariance6::new(jacobian * covariance.matrix() * jacobian.transpose())
}

fn close(a: &Covariance6, b: &Covariance6) -> bool {
    (a.matrix() - b.matrix()).norm() <= 1e-7 * b.matrix().norm()
}

proptest! {
    #[test]
    fn error_inverts_perturb(a in pose(), e in prop::array::uniform6(-1.0..1.0f64)) {
        let e = Tangent(Vector6::from(e));
        prop_assert!((error(&a, &perturb(&a, &e)).0 - e.0).norm() < 1e-12);
    }

    #[test]
    fn compose_is_the_derivative(ab in pose(), bc in pose(), c1 in covariance(), c2 in covariance()) {
        let expected = numeric(&ab, &c1, |x| x * bc) + numeric(&bc, &c2, |x| ab * x);
        prop_assert!(close(&Covariance6::compose(&ab, &c1, &bc, &c2), &expected));
    }

    #[test]
    fn inverse_is_the_derivative(ab in pose(), c in covariance()) {
        let inverse = Covariance6::inverse(&ab, &c);
        prop_assert!(close(&inverse, &numeric(&ab, &c, |x| x.inverse())));
        prop_assert!(close(&Covariance6::inverse(&ab.inverse(), &inverse), &c));
    }

    #[test]
    fn extrinsics_are_the_derivative(ab in pose(), constant in pose(), c in covariance()) {
        let child = c.with_child_moved(&ab, &constant);
        prop_assert!(close(&child, &numeric(&ab, &c, |x| x * constant)));
        prop_assert!(close(&child.with_child_moved(&(ab * constant), &constant.inverse()), &c));
        let parent = c.with_parent_moved(&constant);
        prop_assert!(close(&parent, &numeric(&ab, &c, |x| constant * x)));
        prop_assert!(close(&parent.with_parent_moved(&constant.inverse()), &c));
    }

    #[test]
    fn transport_keeps_validity(ab in pose(), bc in pose(), c in covariance()) {
        let composed = Covariance6::compose(&ab, &c, &bc, &c);
        prop_assert!(composed.is_valid() && composed.is_symmetric(0.0));
        prop_assert!(Covariance6::inverse(&ab, &c).is_valid());
        prop_assert_eq!(Covariance6::from_row_major(&composed.to_row_major()), composed);
    }
}

/// Samples a chain `world_from_base = (camera1_from_world)^-1 * camera1_from_camera2 * camera_from_base` and asks
/// whether the transported covariance describes the errors that come out.
#[test]
fn sampled_errors_match_the_transported_covariance() {
    let mut rng = ChaCha8Rng::seed_from_u64(7);
    let pose = |v: [f64; 6]| se3::exp(&Tangent(Vector6::from(v)));
    let camera1_from_world = pose([0.5, -1.0, 2.0, 0.4, 1.1, -0.7]);
    let camera1_from_camera2 = pose([1.5, 0.3, -0.2, -0.9, 0.2, 1.3]);
    let camera_from_base = pose([0.1, -0.4, 0.3, 1.2, -1.2, 1.2]);
    let spread = |s: f64| {
        let m = Matrix6::from_fn(|i, j| if i == j { 1.0 } else { 0.3 / (1.0 + (i as f64 - j as f64).abs()) });
        Covariance6::new(m * s * s)
    };
    let (c1, c2) = (spread(0.01), spread(0.02));

    let world_from_camera1 = camera1_from_world.inverse();
    let world_from_camera2 = world_from_camera1 * camera1_from_camera2;
    let estimate = world_from_camera2 * camera_from_base;
    let claimed = Covariance6::compose(
        &world_from_camera1,
        &Covariance6::inverse(&camera1_from_world, &c1),
        &camera1_from_camera2,
        &c2,
    )
    .with_child_moved(&world_from_camera2, &camera_from_base);

    let mut sample = |c: &Covariance6| {
        let l = Cholesky::new(*c.matrix()).unwrap().l();
        Tangent(l * Vector6::from_fn(|_, _| StandardNormal.sample(&mut rng)))
    };
    let errors: Vec<Tangent> = (0..20_000)
        .map(|_| {
            let first = perturb(&camera1_from_world, &sample(&c1));
            let second = perturb(&camera1_from_camera2, &sample(&c2));
            error(&estimate, &(first.inverse() * second * camera_from_base))
        })
        .collect();
    let score = calibration::score(errors.iter().map(|e| (e, &claimed))).unwrap();
    // 20000 samples: standard error of the mean NEES 0.025, of a coverage at most 0.33 %.
    assert!((score.nees_mean - 6.0).abs() < 0.12, "{score:?}");
    assert!((score.nees_translation_mean - 3.0).abs() < 0.08, "{score:?}");
    assert!((score.nees_rotation_mean - 3.0).abs() < 0.08, "{score:?}");
    for level in score.coverage {
        assert!((level.measured - level.nominal).abs() < 0.012, "{level:?}");
    }
    for axis in score.axis_coverage {
        for (measured, nominal) in axis.iter().zip([0.6827, 0.9545, 0.9973]) {
            assert!((measured - nominal).abs() < 0.012, "{axis:?}");
        }
    }
}

#[test]
fn the_convention_is_that_of_nav_msgs_odometry() {
    // A yaw error about the parent's z axis does not move the position.
    let estimate = Pose::translation(10.0, 0.0, 0.0);
    let truth = perturb(&estimate, &Tangent::new(Vector3::zeros(), Vector3::new(0.0, 0.0, 0.1)));
    assert_eq!(truth.translation, estimate.translation);
    // It does move a point that the child carries 2 m ahead, sideways by 0.2 m: variance (2 m)^2 * 0.01 rad^2.
    let yaw = Covariance6::from_diagonal([0.0, 0.0, 0.0, 0.0, 0.0, 0.01]);
    let ahead = yaw.with_child_moved(&estimate, &Pose::translation(2.0, 0.0, 0.0));
    assert!((ahead.translation()[(1, 1)] - 0.04).abs() < 1e-15);
    assert!((ahead.matrix()[(1, 5)] - 0.02).abs() < 1e-15);
    assert_eq!(ahead.rotation(), yaw.rotation());
}

#[test]
fn unknown_stays_unknown() {
    let unknown = Covariance6::nan();
    let pose = Pose::translation(1.0, 2.0, 3.0);
    assert!(!unknown.is_finite() && !unknown.is_valid() && !unknown.is_symmetric(1.0));
    assert!(!Covariance6::compose(&pose, &unknown, &pose, &Covariance6::zero()).is_valid());
    assert_eq!(unknown.nees(&Tangent::zero()), None);
    assert_eq!(Covariance6::zero().nees(&Tangent::zero()), None);
    assert_eq!(Covariance6::from_diagonal([1.0; 6]).nees(&Tangent(Vector6::repeat(f64::NAN))), None);
    assert!(!Covariance6::from_diagonal([1.0, 1.0, 1.0, 1.0, 1.0, -1e-3]).is_valid());
    let mut skewed = Matrix6::identity();
    skewed[(0, 1)] = 0.1;
    assert!(!Covariance6::new(skewed).is_valid());
    assert_eq!(Covariance6::from_diagonal([4.0; 6]).nees(&Tangent(Vector6::repeat(2.0))), Some(6.0));
}
