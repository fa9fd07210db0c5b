//! The mean of map poses, and rules that change while frames come.

use super::*;

fn smoothing(map_smoothing_s: f64) -> Rules {
    Rules { map_smoothing_s, ..rules(Some(InnovationGate::default())) }
}

fn feed(map_smoothing_s: f64) -> Feed {
    Feed::new(Fuse::new(traits(), base_from_camera(), smoothing(map_smoothing_s)))
}

fn in_map(camera: &Pose) -> Pose {
    traits().map_from_world * camera * base_from_camera().inverse()
}

/// By how much the network's pose is wrong, in the world: from frame to frame on another side, well within the gate.
fn wrong(i: usize) -> Pose {
    let sign = if i.is_multiple_of(2) { 1.0 } else { -1.0 };
    pose([0.02 * sign, -0.012 * sign, 0.0], [0.0, 0.0, 0.005 * sign])
}

fn distance_m(found: &PoseEstimate, truth: &Pose) -> f64 {
    (found.pose.expect("a pose").translation.vector - truth.translation.vector).norm()
}

#[test]
fn errors_that_change_from_frame_to_frame_average_out_along_the_motion() {
    let (mut smooth, mut plain) = (feed(1.0), feed(0.0));
    for i in 0..60 {
        let (network, truth) = (wrong(i) * world_from_camera(i), in_map(&world_from_camera(i)));
        let estimate = smooth.poses(&relative(i), &network);
        assert_same(estimate.network_map_from_base.pose, &in_map(&network));
        assert!(i == 0 || estimate.status == Status::Tracking, "{:?}", estimate.reason);
        if i >= 20 {
            let (now_m, network_m) = (
                distance_m(&estimate.map_from_base, &truth),
                distance_m(&estimate.network_map_from_base, &truth),
            );
            assert!(now_m < 0.1 * network_m, "frame {i}: {now_m} m, the network {network_m} m");
        }
        let estimate = plain.poses(&relative(i), &network);
        assert_eq!(estimate.map_from_base, estimate.network_map_from_base);
    }
}

#[test]
fn the_first_poses_weigh_the_same_and_older_ones_fade_with_the_time_constant() {
    let still = Uncertain::exact(Pose::identity());
    let at = |x_m: f64| Uncertain {
        pose: pose([x_m, 0.0, 0.0], [0.0; 3]),
        covariance: Covariance6::from_diagonal([1.0; 6]),
    };
    let x_m = |update: MapUpdate| update.map_from_base.unwrap().pose.translation.x;
    let mut tracker = MapTracker::new(None, 10.0);
    for (i, (measured_m, mean_m)) in [(1.0, 1.0), (2.0, 1.5), (6.0, 3.0), (3.0, 3.0)].into_iter().enumerate()
    {
        let found_m = x_m(tracker.update(Some(&still), Some(&at(measured_m)), Some(DT_S)));
        assert!((found_m - mean_m).abs() < 1e-12, "pose {i}: {found_m} m");
    }
    // A step of one metre is made to 1 - 1/e after one time constant, whatever the rate of the frames.
    for dt_s in [0.01, 0.05, 0.25] {
        let mut tracker = MapTracker::new(None, 0.5);
        let frames = |s: f64| (s / dt_s).round() as usize;
        let mut found_m = 0.0;
        for i in 0..frames(5.0) + frames(0.5) {
            let measured = at(if i < frames(5.0) { 0.0 } else { 1.0 });
            found_m = x_m(tracker.update(Some(&still), Some(&measured), Some(dt_s)));
        }
        assert!((found_m - (1.0 - (-1.0_f64).exp())).abs() < 1e-6, "{found_m} m at {dt_s} s");
    }
}

#[test]
fn the_covariance_of_a_mean_is_no_smaller_than_errors_that_never_change_ask_for() {
    let mut smooth = feed(1.0);
    let mut before = None;
    for i in 0..40 {
        let estimate = smooth.poses(&relative(i), &world_from_camera(i));
        let (mean, network) = (estimate.map_from_base.covariance, estimate.network_map_from_base.covariance);
        assert!(mean.is_valid());
        let trace = |c: &Covariance6| c.translation().trace();
        assert!(trace(&mean) >= trace(&network) * (1.0 - 1e-9), "frame {i}");
        // It grows by what the motion adds, and comes to an end.
        if let (true, Some(before)) = (i > 35, before) {
            assert!(trace(&mean) < 1.05 * before, "frame {i}: {} after {before}", trace(&mean));
        }
        before = Some(trace(&mean));
    }
}

#[test]
fn a_mean_rides_out_rejections_and_jumps_at_once_when_that_is_announced() {
    let gate = InnovationGate { rejections_allowed: 2, ..InnovationGate::default() };
    let rules = Rules { gate: Some(gate), ..smoothing(1.0) };
    let mut feed = Feed::new(Fuse::new(traits(), base_from_camera(), rules));
    for i in 0..5 {
        feed.poses(&relative(i), &world_from_camera(i));
    }
    for i in 5..7 {
        let estimate = feed.poses(&relative(i), &far());
        assert_eq!(estimate.reason, Reason::InnovationRejected);
        assert_same(estimate.map_from_base.pose, &in_map(&world_from_camera(i)));
    }
    let estimate = feed.poses(&Pose::identity(), &far());
    assert_eq!(estimate.reason, Reason::Reinitialised);
    assert_eq!(estimate.map_from_base, estimate.network_map_from_base);
    // The mean begins anew there: two poses weigh the same.
    let beside = pose([0.02, 0.0, 0.0], [0.0; 3]) * far();
    let estimate = feed.poses(&Pose::identity(), &beside);
    assert!((distance_m(&estimate.map_from_base, &in_map(&far())) - 0.01).abs() < 1e-9);
}

#[test]
fn where_one_covariance_is_unknown_the_pose_with_the_known_one_counts() {
    let mut feed = feed(1.0);
    feed.poses(&relative(0), &world_from_camera(0));
    feed.poses(&relative(1), &world_from_camera(1));
    let outputs = |i: usize, fused: &Pose, known: Option<[f64; 6]>| StepOutput {
        is_key: true,
        relative: Some(head(&relative(i), LOG_VARIANCE)),
        global: None,
        fused: Some(head(fused, known)),
    };
    let off = wrong(2) * world_from_camera(2);
    let estimate = feed.raw(&outputs(2, &off, None));
    assert_same(estimate.map_from_base.pose, &in_map(&world_from_camera(2)));
    assert!(estimate.map_from_base.covariance.is_finite());
    // A pose that was set without a covariance gives way to the first that has one.
    feed.fuse.place(pose([7.0, 8.0, 0.0], [0.0; 3]), Covariance6::nan());
    let estimate = feed.raw(&outputs(3, &world_from_camera(3), LOG_VARIANCE));
    assert_same(estimate.map_from_base.pose, &in_map(&world_from_camera(3)));
    // Without any, poses are averaged and nothing is claimed.
    let mut feed = super::Feed::new(Fuse::new(traits(), base_from_camera(), smoothing(1.0)));
    let none = |i: usize, x_m: f64| StepOutput {
        relative: Some(head(&Pose::identity(), None)),
        ..outputs(i, &pose([x_m, 0.0, 0.0], [0.0; 3]), None)
    };
    feed.raw(&none(0, 0.0));
    let estimate = feed.raw(&none(1, 0.2));
    assert!((distance_m(&estimate.map_from_base, &in_map(&Pose::identity())) - 0.1).abs() < 1e-9);
    assert!(!estimate.map_from_base.covariance.is_finite());
}

#[test]
fn another_time_constant_holds_from_the_next_frame_on() {
    let mut feed = feed(5.0);
    for i in 0..6 {
        feed.poses(&relative(i), &(wrong(i) * world_from_camera(i)));
    }
    feed.fuse.set_rules(smoothing(0.0));
    let estimate = feed.poses(&relative(6), &(wrong(6) * world_from_camera(6)));
    assert_eq!(estimate.map_from_base, estimate.network_map_from_base);
    assert_eq!((estimate.status, estimate.reset_epoch), (Status::Tracking, 0));
}

#[test]
fn another_gate_holds_from_the_next_frame_on() {
    let strict = InnovationGate { rejections_allowed: 100, ..InnovationGate::default() };
    let mut feed = Feed::new(fuse_with(strict));
    feed.poses(&relative(0), &world_from_camera(0));
    let elsewhere = pose([50.0, 0.0, 0.0], [0.0; 3]) * world_from_camera(1);
    let rejected = feed.poses(&relative(1), &elsewhere);
    assert_eq!((rejected.status, rejected.reason), (Status::Degraded, Reason::InnovationRejected));
    feed.fuse.set_rules(rules(None));
    let elsewhere = pose([50.0, 0.0, 0.0], [0.0; 3]) * world_from_camera(2);
    let taken = feed.poses(&relative(2), &elsewhere);
    assert_eq!((taken.status, taken.reason, taken.reset_epoch), (Status::Tracking, Reason::None, 0));
    assert_eq!(taken.map_from_base.pose, taken.network_map_from_base.pose);
}
