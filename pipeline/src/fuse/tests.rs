//! The fusion on made-up network outputs.

use grnet_geometry::covariance;
use grnet_geometry::quaternion::{to_6d, xyzw};
use grnet_geometry::se3::Tangent;
use nalgebra::{Isometry3, Matrix6, UnitQuaternion, Vector6};
use proptest::prelude::*;

use super::*;
use crate::options::{AfterRejections, PipelineOptions};

mod rules;

const DT_S: f64 = 0.05;

fn pose(t: [f64; 3], r: [f64; 3]) -> Pose {
    Isometry3::new(t.into(), r.into())
}

/// A head as the network would write it: a quaternion of some length and sign.
fn head(pose: &Pose, log_variance: Option<[f64; 6]>) -> HeadOutput {
    let rotation_raw = xyzw(&pose.rotation).map(|q| -1.7 * q).to_vec();
    HeadOutput { translation_m: pose.translation.vector.into(), rotation_raw, log_variance }
}

const LOG_VARIANCE: Option<[f64; 6]> = Some([-8.0, -8.5, -9.0, -10.0, -10.5, -11.0]);

fn traits() -> ModelTraits {
    ModelTraits {
        is_trained: true,
        has_odometry: true,
        has_scene: true,
        keyframe_interval_s: 0.0,
        map_from_world: pose([3.0, -1.0, 0.5], [0.0, 0.0, 0.7]),
    }
}

fn base_from_camera() -> Pose {
    pose([0.2, 0.05, 0.4], [0.1, -0.2, 0.3]) * PipelineOptions::default().base_from_camera
}

fn rules(gate: Option<InnovationGate>) -> Rules {
    Rules { gate, map_smoothing_s: 0.0, initializing_frames: 1 }
}

fn fuse_with(gate: InnovationGate) -> Fuse {
    Fuse::new(traits(), base_from_camera(), rules(Some(gate)))
}

fn fuse() -> Fuse {
    fuse_with(InnovationGate::default())
}

/// Feeds one frame after the other, `DT_S` apart.
struct Feed {
    fuse: Fuse,
    frames: u64,
}

impl Feed {
    fn new(fuse: Fuse) -> Self {
        Self { fuse, frames: 0 }
    }

    fn raw(&mut self, outputs: &StepOutput) -> Estimate {
        let stamp = Stamp {
            sequence: self.frames,
            capture_time: CaptureTime::recorded(1 + self.frames * 50_000_000),
            dt_s: (self.frames > 0).then_some(DT_S),
        };
        self.frames += 1;
        self.fuse.fuse(stamp, outputs)
    }

    fn poses(&mut self, relative: &Pose, fused: &Pose) -> Estimate {
        let relative = Some(head(relative, LOG_VARIANCE));
        self.raw(&StepOutput { is_key: true, relative, global: None, fused: Some(head(fused, LOG_VARIANCE)) })
    }
}

fn world_from_camera(i: usize) -> Pose {
    let s = i as f64;
    pose([0.10 * s, 0.3 * (0.2 * s).sin(), 0.02 * s], [0.02 * s, 0.3 * (0.1 * s).cos(), 0.01 * s])
}

fn relative(i: usize) -> Pose {
    if i == 0 { Pose::identity() } else { world_from_camera(i - 1).inverse() * world_from_camera(i) }
}

fn assert_same(found: Option<Pose>, expected: &Pose) {
    let error = covariance::error(&found.expect("a pose"), expected);
    assert!(error.0.norm() < 1e-9, "{found:?} is not {expected:?}");
}

#[test]
fn odometry_is_the_product_of_the_relative_motions_of_the_body() {
    let mut feed = Feed::new(fuse());
    let mut expected = Pose::identity();
    for i in 0..30 {
        let estimate = feed.poses(&relative(i), &world_from_camera(i));
        let motion = base_from_camera() * relative(i) * base_from_camera().inverse();
        if i == 0 {
            assert_eq!(estimate.previous_from_current.pose, None, "the first frame was paired with itself");
            assert_eq!(estimate.odom_from_base.covariance, Covariance6::zero());
            assert_eq!((estimate.status, estimate.reason), (Status::Initializing, Reason::None));
        } else {
            expected *= motion;
            assert_same(estimate.previous_from_current.pose, &motion);
            assert_eq!((estimate.status, estimate.reason), (Status::Tracking, Reason::None));
        }
        assert_same(estimate.odom_from_base.pose, &expected);
        let map_from_base = traits().map_from_world * world_from_camera(i) * base_from_camera().inverse();
        assert_same(estimate.map_from_base.pose, &map_from_base);
        assert_same(estimate.network_map_from_base.pose, &map_from_base);
        assert_eq!(estimate.reset_epoch, 0);
    }
    let whole = world_from_camera(0).inverse() * world_from_camera(29);
    assert_same(Some(base_from_camera().inverse() * expected * base_from_camera()), &whole);
}

#[test]
fn a_rotation_in_six_numbers_is_read_too() {
    let rotation = UnitQuaternion::from_euler_angles(0.3, -0.8, 2.0);
    let scaled: Vec<f64> =
        to_6d(&rotation).iter().enumerate().map(|(i, v)| v * if i < 3 { 2.5 } else { 0.3 }).collect();
    let head = HeadOutput { translation_m: [1.0, 2.0, 3.0], rotation_raw: scaled, log_variance: None };
    let read = heads::read(&head).unwrap();
    assert!(read.pose.rotation.angle_to(&rotation) < 1e-9);
    assert!(!read.covariance.is_finite());
    let wrong = HeadOutput { rotation_raw: vec![1.0; 5], ..head };
    assert_eq!(heads::read(&wrong), Err(NotAPose));
}

/// `J C J^T` with the Jacobian of a function of poses by central differences, in the convention of
/// [`covariance`]: perturb the input, take the error of the output.
fn numeric(function: impl Fn(&Pose) -> Pose, at: &Pose, input: &Matrix6<f64>) -> Matrix6<f64> {
    const STEP: f64 = 1e-5;
    let output = function(at);
    let mut jacobian = Matrix6::zeros();
    for i in 0..6 {
        let mut d = Vector6::zeros();
        d[i] = STEP;
        let plus = covariance::error(&output, &function(&covariance::perturb(at, &Tangent(d))));
        let minus = covariance::error(&output, &function(&covariance::perturb(at, &Tangent(-d))));
        jacobian.set_column(i, &((plus.0 - minus.0) / (2.0 * STEP)));
    }
    jacobian * input * jacobian.transpose()
}

fn assert_near(found: &Covariance6, expected: &Matrix6<f64>) {
    let error = (found.matrix() - expected).amax();
    assert!(error < 1e-6 * expected.amax(), "{found:?}\nis not\n{expected}");
}

#[test]
fn covariances_are_transported_as_finite_differences_say() {
    let mut feed = Feed::new(fuse());
    feed.poses(&relative(0), &world_from_camera(0));
    let diagonal = Matrix6::from_diagonal(&Vector6::from(LOG_VARIANCE.unwrap().map(f64::exp)));
    let camera_from_base = base_from_camera().inverse();
    let in_base = |camera: &Pose| base_from_camera() * camera * camera_from_base;
    let mut odom_covariance = Matrix6::zeros();
    let mut odom_from_base = Pose::identity();
    for i in 1..5 {
        let estimate = feed.poses(&relative(i), &world_from_camera(i));
        let motion_covariance = numeric(in_base, &relative(i), &diagonal);
        assert_near(&estimate.previous_from_current.covariance, &motion_covariance);
        let motion = in_base(&relative(i));
        odom_covariance = numeric(|odom| odom * motion, &odom_from_base, &odom_covariance)
            + numeric(|motion| odom_from_base * motion, &motion, &motion_covariance);
        odom_from_base *= motion;
        assert_near(&estimate.odom_from_base.covariance, &odom_covariance);
        let in_map = |camera: &Pose| traits().map_from_world * camera * camera_from_base;
        assert_near(&estimate.map_from_base.covariance, &numeric(in_map, &world_from_camera(i), &diagonal));
        assert!(estimate.odom_from_base.covariance.is_valid());
    }
}

#[test]
fn velocities_are_those_of_the_body() {
    let mut feed = Feed::new(Fuse::new(traits(), Pose::identity(), rules(None)));
    feed.poses(&Pose::identity(), &Pose::identity());
    let (linear, angular) = (Vector3::new(1.0, 0.2, -0.1), Vector3::new(0.1, -0.3, 2.0));
    let motion = se3::exp(&Tangent::new(linear * DT_S, angular * DT_S));
    let estimate = feed.poses(&motion, &motion);
    assert!((estimate.linear_velocity_in_base_mps.unwrap() - linear).norm() < 1e-9);
    assert!((estimate.angular_velocity_in_base_radps.unwrap() - angular).norm() < 1e-9);
}

fn far() -> Pose {
    pose([40.0, 0.0, 0.0], [0.0; 3])
}

#[test]
fn the_ratio_is_the_mahalanobis_distance_over_the_99_percent_point() {
    let mut feed = Feed::new(Fuse::new(
        ModelTraits { map_from_world: Pose::identity(), ..traits() },
        Pose::identity(),
        rules(Some(InnovationGate::default())),
    ));
    let still = Pose::identity();
    let variance = LOG_VARIANCE.unwrap()[0].exp();
    assert!(feed.poses(&still, &still).innovation_ratio.is_nan(), "nothing to compare the first with");
    // S = prediction (global + relative) + measurement.
    let shift_m = 2.0 * variance.sqrt();
    let estimate = feed.poses(&still, &pose([shift_m, 0.0, 0.0], [0.0; 3]));
    let expected = shift_m * shift_m / (3.0 * variance) / 16.81;
    assert!((estimate.innovation_ratio - expected).abs() < 1e-9, "{}", estimate.innovation_ratio);
    assert_eq!(estimate.reason, Reason::None);
}

#[test]
fn a_contradicting_pose_is_rejected_and_the_map_follows_odometry() {
    let mut feed = Feed::new(fuse());
    for i in 0..5 {
        feed.poses(&relative(i), &world_from_camera(i));
    }
    let estimate = feed.poses(&relative(5), &far());
    assert!(estimate.innovation_ratio > 1.0);
    assert_eq!((estimate.status, estimate.reason), (Status::Degraded, Reason::InnovationRejected));
    let in_map = |camera: &Pose| traits().map_from_world * camera * base_from_camera().inverse();
    assert_same(estimate.map_from_base.pose, &in_map(&world_from_camera(5)));
    assert_same(estimate.network_map_from_base.pose, &in_map(&far()));
    let estimate = feed.poses(&relative(6), &world_from_camera(6));
    assert!(estimate.innovation_ratio < 0.5);
    assert_eq!((estimate.status, estimate.reason), (Status::Tracking, Reason::None));
}

#[test]
fn a_run_of_rejections_ends_in_an_announced_jump() {
    let gate = InnovationGate { rejections_allowed: 3, ..InnovationGate::default() };
    let mut feed = Feed::new(fuse_with(gate));
    for i in 0..5 {
        feed.poses(&relative(i), &world_from_camera(i));
    }
    for i in 5..8 {
        assert_eq!(feed.poses(&relative(i), &far()).reason, Reason::InnovationRejected);
    }
    let estimate = feed.poses(&relative(8), &far());
    assert_eq!((estimate.status, estimate.reason), (Status::Degraded, Reason::Reinitialised));
    assert_eq!(estimate.map_from_base, estimate.network_map_from_base);
    assert_eq!(estimate.reset_epoch, 0, "the odometry did not jump");
    let estimate = feed.poses(&relative(9), &(far() * relative(9)));
    assert_eq!((estimate.status, estimate.reason), (Status::Tracking, Reason::None));
}

#[test]
fn a_lost_map_pose_comes_back_when_global_poses_agree() {
    let gate =
        InnovationGate { rejections_allowed: 2, then: AfterRejections::Lost, agreements_to_recover: 2 };
    let mut feed = Feed::new(fuse_with(gate));
    feed.poses(&relative(0), &world_from_camera(0));
    let still = Pose::identity();
    // Each one contradicts the one before.
    let wild = |i: usize| pose([30.0 * i as f64, 0.0, 0.0], [0.0; 3]);
    for i in 1..3 {
        assert_eq!(feed.poses(&still, &wild(i)).reason, Reason::InnovationRejected);
    }
    for i in 3..7 {
        let estimate = feed.poses(&still, &wild(i));
        assert_eq!((estimate.status, estimate.reason), (Status::Lost, Reason::InnovationRejected));
        assert_eq!((estimate.map_from_base.pose, estimate.network_map_from_base.pose), (None, None));
        assert!(estimate.odom_from_base.pose.is_some(), "odometry goes on");
    }
    let second_place = wild(6);
    assert_eq!(feed.poses(&still, &second_place).status, Status::Lost);
    let estimate = feed.poses(&still, &second_place);
    assert_eq!((estimate.status, estimate.reason), (Status::Degraded, Reason::Reinitialised));
    assert_eq!(feed.poses(&still, &second_place).status, Status::Tracking);
}

#[test]
fn without_covariances_nothing_is_rejected_and_nothing_is_claimed() {
    let mut feed = Feed::new(fuse());
    for i in 0..4 {
        let fused = if i == 2 { far() } else { world_from_camera(i) };
        let outputs = StepOutput {
            is_key: true,
            relative: Some(head(&relative(i), None)),
            global: None,
            fused: Some(head(&fused, None)),
        };
        let estimate = feed.raw(&outputs);
        assert!(estimate.innovation_ratio.is_nan());
        assert!(estimate.map_from_base.covariance.matrix().iter().all(|v| v.is_nan()));
        assert_eq!(estimate.odom_from_base.covariance.is_finite(), i == 0);
        assert_eq!(estimate.map_from_base.pose, estimate.network_map_from_base.pose);
    }
}

#[test]
fn output_that_is_no_pose_is_lost_and_restarts() {
    let good = |i| StepOutput {
        is_key: true,
        relative: Some(head(&relative(i), LOG_VARIANCE)),
        global: None,
        fused: Some(head(&world_from_camera(i), LOG_VARIANCE)),
    };
    let spoil: [fn(&mut StepOutput); 6] = [
        |o| o.relative.as_mut().unwrap().translation_m[1] = f64::NAN,
        |o| o.fused.as_mut().unwrap().translation_m[0] = f64::INFINITY,
        |o| o.fused.as_mut().unwrap().rotation_raw[2] = f64::NEG_INFINITY,
        |o| o.relative.as_mut().unwrap().rotation_raw = vec![0.0; 4],
        |o| o.relative.as_mut().unwrap().rotation_raw = vec![1.0, 0.0, 0.0, 2.0, 0.0, 0.0],
        |o| o.fused.as_mut().unwrap().log_variance = Some([f64::NAN; 6]),
    ];
    for (case, spoil) in spoil.into_iter().enumerate() {
        let mut feed = Feed::new(fuse());
        feed.raw(&good(0));
        feed.raw(&good(1));
        let mut bad = good(2);
        spoil(&mut bad);
        for again in 0..2 {
            let estimate = feed.raw(&bad);
            let found = (estimate.status, estimate.reason, estimate.reset_epoch);
            assert_eq!(found, (Status::Lost, Reason::NonFiniteOutput, 1), "case {case}, frame {again}");
            for unknown in [
                estimate.map_from_base,
                estimate.odom_from_base,
                estimate.previous_from_current,
                estimate.network_map_from_base,
            ] {
                assert_eq!(unknown.pose, None);
                assert!(unknown.covariance.matrix().iter().all(|v| v.is_nan()));
            }
            assert_eq!(estimate.linear_velocity_in_base_mps, None);
        }
        let estimate = feed.raw(&good(3));
        assert_same(estimate.odom_from_base.pose, &Pose::identity());
        assert_eq!((estimate.reset_epoch, estimate.previous_from_current.pose), (1, None));
        assert_eq!((estimate.status, estimate.reason), (Status::Initializing, Reason::NonFiniteOutput));
        assert!(estimate.map_from_base.pose.is_some());
    }
}

#[test]
fn an_absurd_log_variance_is_no_covariance() {
    let absurd = head(&far(), Some([-8.0, 800.0, -8.0, -8.0, -8.0, -8.0]));
    assert!(!heads::read(&absurd).unwrap().covariance.is_finite());
}

#[test]
fn without_a_scene_there_is_odometry_only_until_the_pose_is_set() {
    let traits = ModelTraits { has_scene: false, ..traits() };
    let mut feed = Feed::new(Fuse::new(traits, base_from_camera(), rules(Some(InnovationGate::default()))));
    let next = |feed: &mut Feed, i| {
        let relative = Some(head(&relative(i), LOG_VARIANCE));
        feed.raw(&StepOutput { is_key: true, relative, global: None, fused: None })
    };
    next(&mut feed, 0);
    let estimate = next(&mut feed, 1);
    assert_eq!((estimate.status, estimate.reason), (Status::Tracking, Reason::NoScene));
    assert_eq!((estimate.map_from_base.pose, estimate.network_map_from_base.pose), (None, None));

    let here = pose([7.0, 8.0, 0.0], [0.0, 0.0, 1.0]);
    feed.fuse.place(here, Covariance6::nan());
    let estimate = next(&mut feed, 2);
    let motion = estimate.previous_from_current.pose.unwrap();
    assert_same(estimate.map_from_base.pose, &(here * motion));
    assert!(!estimate.map_from_base.covariance.is_finite());

    // A reset of the odometry leaves the map where it is; a restart (unknown motion) does not.
    feed.fuse.restart_odometry(Reason::OdometryReset);
    let after = next(&mut feed, 3);
    assert_eq!((after.map_from_base.pose, after.reset_epoch), (estimate.map_from_base.pose, 1));
    assert_same(after.odom_from_base.pose, &Pose::identity());
    feed.fuse.restart(Reason::TimeJump);
    let after = next(&mut feed, 4);
    assert_eq!((after.map_from_base.pose, after.reset_epoch), (None, 2));
    assert_eq!((after.status, after.reason), (Status::Initializing, Reason::TimeJump));
}

#[test]
fn a_pose_set_with_its_covariance_has_to_be_confirmed() {
    let mut feed = Feed::new(fuse());
    for i in 0..3 {
        feed.poses(&relative(i), &world_from_camera(i));
    }
    let here = pose([-50.0, 0.0, 0.0], [0.0; 3]);
    feed.fuse.place(here, Covariance6::from_diagonal([1e-4; 6]));
    let estimate = feed.poses(&relative(3), &world_from_camera(3));
    assert_eq!(estimate.reason, Reason::InnovationRejected);
    assert_same(estimate.map_from_base.pose, &(here * estimate.previous_from_current.pose.unwrap()));
    feed.fuse.place(here, Covariance6::nan());
    let estimate = feed.poses(&relative(4), &world_from_camera(4));
    assert_eq!(estimate.reason, Reason::None);
    assert_eq!(estimate.map_from_base, estimate.network_map_from_base);
}

#[test]
fn an_untrained_model_gives_numbers_that_are_never_tracking() {
    let traits = ModelTraits { is_trained: false, ..traits() };
    let mut feed = Feed::new(Fuse::new(traits, base_from_camera(), rules(Some(InnovationGate::default()))));
    for i in 0..4 {
        let fused = if i == 3 { far() } else { world_from_camera(i) };
        let estimate = feed.poses(&relative(i), &fused);
        assert_eq!((estimate.status, estimate.reason), (Status::Degraded, Reason::UntrainedModel));
        assert!(estimate.map_from_base.pose.is_some());
    }
}

#[test]
fn causes_of_one_restart_count_once() {
    let mut feed = Feed::new(fuse());
    feed.fuse.restart(Reason::SourceReturned);
    assert_eq!(feed.poses(&relative(0), &world_from_camera(0)).reset_epoch, 0, "nothing had started");
    feed.fuse.restart(Reason::SourceReturned);
    feed.fuse.restart_odometry(Reason::OdometryReset);
    let estimate = feed.poses(&relative(1), &world_from_camera(1));
    assert_eq!((estimate.reset_epoch, estimate.reason), (1, Reason::OdometryReset));
}

fn any_head() -> impl Strategy<Value = Option<HeadOutput>> {
    let number = prop_oneof![
        4 => -3.0..3.0f64,
        1 => any::<f64>(),
        1 => prop::sample::select(vec![0.0, 1e-300, 1e154, -1e200, f64::MAX, f64::MIN_POSITIVE]),
    ];
    let rotation =
        prop_oneof![prop::collection::vec(number.clone(), 4), prop::collection::vec(number.clone(), 6),];
    let log_variance = prop::option::of(prop::array::uniform6(prop_oneof![-40.0..40.0f64, any::<f64>()]));
    let head = (prop::array::uniform3(number), rotation, log_variance).prop_map(
        |(translation_m, rotation_raw, log_variance)| HeadOutput {
            translation_m,
            rotation_raw,
            log_variance,
        },
    );
    prop::option::weighted(0.9, head)
}

/// What a client relies on without knowing anything about the network.
fn check(estimate: &Estimate) -> Result<(), TestCaseError> {
    for estimate in [
        &estimate.map_from_base,
        &estimate.odom_from_base,
        &estimate.previous_from_current,
        &estimate.network_map_from_base,
    ] {
        let covariance = estimate.covariance.matrix();
        let all_nan = covariance.iter().all(|v| v.is_nan());
        match &estimate.pose {
            None => prop_assert!(all_nan, "a covariance without a pose"),
            Some(pose) => {
                prop_assert!(crate::options::is_finite(pose), "{pose:?}");
                prop_assert!((pose.rotation.norm() - 1.0).abs() < 1e-6, "{pose:?}");
                prop_assert!(all_nan || estimate.covariance.is_finite(), "half a covariance");
                prop_assert!(all_nan || covariance.diagonal().iter().all(|v| *v >= 0.0), "{covariance}");
            }
        }
    }
    for velocity in [&estimate.linear_velocity_in_base_mps, &estimate.angular_velocity_in_base_radps]
        .into_iter()
        .flatten()
    {
        prop_assert!(velocity.iter().all(|v| v.is_finite()));
    }
    prop_assert!(!estimate.innovation_ratio.is_infinite());
    if estimate.status == Status::Lost {
        prop_assert_eq!(estimate.map_from_base.pose, None);
    }
    if estimate.status == Status::Tracking && estimate.reason == Reason::None {
        prop_assert!(estimate.map_from_base.pose.is_some() && estimate.odom_from_base.pose.is_some());
    }
    Ok(())
}

proptest! {
    #[test]
    fn no_output_makes_an_invalid_estimate_look_valid(
        outputs in prop::collection::vec((any_head(), any_head(), any_head()), 1..12),
        lost in any::<bool>(),
    ) {
        let then = if lost { AfterRejections::Lost } else { AfterRejections::Reinitialise };
        let gate = InnovationGate { rejections_allowed: 1, then, agreements_to_recover: 1 };
        let mut feed = Feed::new(fuse_with(gate));
        for (relative, global, fused) in outputs {
            let is_finite = [&relative, &global, &fused].into_iter().flatten().all(|head| {
                let variances = head.log_variance.iter().flatten();
                head.translation_m.iter().chain(&head.rotation_raw).chain(variances).all(|v| v.is_finite())
            });
            let estimate = feed.raw(&StepOutput { is_key: true, relative, global, fused });
            check(&estimate)?;
            prop_assert!(is_finite || estimate.status == Status::Lost);
        }
    }
}
