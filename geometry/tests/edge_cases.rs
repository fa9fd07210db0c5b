//! What the scores say of sequences that break assumptions: missing frames, one pose, standing still.

use grnet_geometry::{
    Covariance6, Pose,
    align::{Alignment, AlignmentError},
    nalgebra::{Vector3, Vector6},
    scores::{
        ScoreError, ate, calibration, kitti,
        relocalization::{self, THRESHOLDS},
        rpe::{self, Delta, RpeOptions},
    },
    se3::Tangent,
    trajectory::KittiPoses,
};

fn straight(n: usize, step_m: f64) -> Vec<Pose> {
    (0..n).map(|i| Pose::translation(0.0, 0.0, i as f64 * step_m)).collect()
}

fn kitti_score(truth: &KittiPoses, estimate: &KittiPoses) -> Result<kitti::KittiScore, ScoreError> {
    kitti::score(truth, estimate, kitti::Arithmetic::Double)
}

#[test]
fn hand_computed_segments() {
    // 1.25 m a frame: 100 m are exceeded after 81 frames. The estimate is 2 % long: 101.25 m * 0.02 / 100 m.
    let truth = KittiPoses::from_poses(&straight(100, 1.25));
    let estimate = KittiPoses::from_poses(&straight(100, 1.275));
    let score = kitti_score(&truth, &estimate).unwrap();
    let overall = score.overall.unwrap();
    assert_eq!(overall.segments, 2);
    assert!((overall.t_rel_percent - 2.025).abs() < 1e-12);
    assert_eq!(overall.r_rel_deg_per_100m, 0.0);
    assert_eq!(score.per_length.len(), 1);
    // Two segments are too few for a bin of speed.
    assert!(score.per_speed.is_empty());
    let segments = kitti::segments(&truth, &estimate, kitti::Arithmetic::Double).unwrap();
    assert_eq!((segments[1].first, segments[1].last, segments[1].length_m), (10, 91, 100));
    assert!((segments[0].speed_mps - 100.0 / 8.2).abs() < 1e-12);
}

#[test]
fn too_short_still_or_single_gives_no_segment() {
    for poses in [straight(80, 1.25), straight(500, 0.0), straight(1, 1.0)] {
        let poses = KittiPoses::from_poses(&poses);
        let score = kitti_score(&poses, &poses).unwrap();
        assert_eq!((score.overall, score.per_length.len()), (None, 0));
    }
}

#[test]
fn missing_and_foreign_frames() {
    let truth = KittiPoses::from_poses(&straight(200, 1.25));
    let every = straight(200, 1.25).into_iter().enumerate().map(|(i, p)| (i as u64, p));
    let gap = KittiPoses::from_frames(every.clone().filter(|(i, _)| *i != 20 && *i != 121)).unwrap();
    let score = kitti_score(&truth, &gap).unwrap();
    // 12 segments of 100 m and 4 of 200 m, less those that begin at 20 (100 m) or end at 121 (first 40, 100 m).
    assert_eq!(kitti_score(&truth, &truth).unwrap().overall.unwrap().segments, 16);
    assert_eq!((score.overall.unwrap().segments, score.missing_frames), (13, 2));

    let shorter = KittiPoses::from_frames(every.clone().take(90)).unwrap();
    assert_eq!(kitti_score(&truth, &shorter).unwrap().overall.unwrap().segments, 1);
    let foreign = KittiPoses::from_frames(every.clone().chain([(200, Pose::identity())])).unwrap();
    assert_eq!(
        kitti_score(&truth, &foreign),
        Err(ScoreError::UnknownFrame { frame: 200, first: 0, last: 199 })
    );
    assert_eq!(kitti_score(&gap, &gap), Err(ScoreError::GroundTruthGap { missing: 20, first: 0, last: 199 }));
    assert_eq!(kitti_score(&KittiPoses::default(), &gap), Err(ScoreError::Empty));

    // A block of a longer sequence keeps its frame numbers.
    let block = KittiPoses::from_frames(every.skip(50)).unwrap();
    assert!(kitti_score(&block, &block).unwrap().overall.unwrap().segments > 0);
}

#[test]
fn absolute_errors_at_the_edges() {
    let one = [Pose::translation(1.0, 0.0, 0.0)];
    let ate = ate::score(&one, &[Pose::translation(1.0, 0.0, 2.0)], Alignment::None).unwrap();
    assert_eq!((ate.translation_m.rmse, ate.translation_m.std, ate.rotation_deg.max), (2.0, 0.0, 0.0));
    for alignment in [Alignment::Se3, Alignment::Sim3, Alignment::Scale] {
        let degenerate = ScoreError::Alignment(AlignmentError::Degenerate { points: 1, dimensions: 0 });
        assert_eq!(ate::score(&one, &one, alignment), Err(degenerate));
    }
    assert_eq!(ate::score(&[], &[], Alignment::None), Err(ScoreError::Empty));
    let mismatch = ScoreError::LengthMismatch { reference: 1, estimate: 0 };
    assert_eq!(ate::score(&one, &[], Alignment::None), Err(mismatch));
}

#[test]
fn relative_errors_at_the_edges() {
    let walk = straight(10, 0.5);
    let options = |delta| RpeOptions { delta, ..RpeOptions::default() };
    let still = straight(10, 0.0);
    assert_eq!(rpe::score(&still, &still, &options(Delta::Frames(1))).unwrap().translation_m.max, 0.0);
    for (poses, delta) in [
        (&walk[..1], Delta::Frames(1)),
        (&walk[..], Delta::Frames(10)),
        (&walk[..], Delta::Metres(5.0)),
        (&still[..], Delta::Metres(0.1)),
    ] {
        assert!(
            matches!(rpe::score(poses, poses, &options(delta)), Err(ScoreError::NoPairs { .. })),
            "{delta}"
        );
    }
    for delta in [Delta::Frames(0), Delta::Metres(0.0), Delta::Metres(-1.0), Delta::Metres(f64::NAN)] {
        assert!(
            matches!(rpe::score(&walk, &walk, &options(delta)), Err(ScoreError::Option { .. })),
            "{delta}"
        );
    }
    let negative = RpeOptions { relative_tolerance: -0.1, ..options(Delta::Metres(1.0)) };
    assert!(matches!(rpe::score(&walk, &walk, &negative), Err(ScoreError::Option { .. })));
    // Of equally near poses the first: 1.2 m lie between 1.0 m (two steps) and 1.5 m; a pause repeats distances.
    let mut pause = straight(5, 0.5);
    pause.insert(2, pause[2]);
    let all = RpeOptions { all_pairs: true, relative_tolerance: 0.3, ..options(Delta::Metres(1.0)) };
    assert_eq!(rpe::pairs(&pause, &all).unwrap(), [(0, 2), (1, 4), (2, 5), (3, 5)]);
}

#[test]
fn relocalization_counts() {
    let truth = vec![Pose::identity(); 4];
    let estimate = [
        Pose::translation(0.01, 0.0, 0.0),
        Pose::translation(0.04, 0.0, 0.0),
        Pose::new(Vector3::new(0.02, 0.0, 0.0), Vector3::new(0.0, 6f64.to_radians(), 0.0)),
        // Exactly at a threshold is not below it.
        Pose::translation(0.05, 0.0, 0.0),
    ];
    let score = relocalization::score(&truth, &estimate, 4, &THRESHOLDS).unwrap();
    assert!((score.median_translation_m - 0.03).abs() < 1e-15 && score.median_rotation_deg < 1e-12);
    assert_eq!((score.recalls[0].recall, score.recalls[0].recall_of_all), (0.5, 0.25));
    assert_eq!(score.recalls[1].recall, 1.0);
    assert_eq!(relocalization::score(&[], &[], 4, &THRESHOLDS), Err(ScoreError::Empty));
}

#[test]
fn calibration_counts() {
    // Quantiles from the chi-square table with 6 degrees of freedom.
    for (p, x) in [(0.5, 5.348_120_627), (0.95, 12.591_587_244), (0.99, 16.811_893_830)] {
        assert!((calibration::chi_square_6_quantile(p) - x).abs() < 1e-8);
        assert!((calibration::chi_square_6_cdf(x) - p).abs() < 1e-9);
    }
    assert_eq!(calibration::chi_square_6_quantile(0.0), 0.0);
    assert_eq!(calibration::chi_square_6_quantile(1.0), f64::INFINITY);

    let covariance = Covariance6::from_diagonal([0.01, 0.01, 0.01, 1e-4, 1e-4, 1e-4]);
    let error = Tangent(Vector6::new(0.1, 0.25, 0.0, 0.005, 0.0, 0.031));
    let unknown = Covariance6::nan();
    let score = calibration::score([(&error, &covariance), (&error, &unknown)]).unwrap();
    assert_eq!((score.count, score.skipped), (1, 1));
    assert!((score.nees_mean - (1.0 + 6.25 + 0.25 + 9.61)).abs() < 1e-9);
    assert!((score.nees_translation_mean - 7.25).abs() < 1e-9);
    assert_eq!(score.axis_coverage[1], [0.0, 0.0, 1.0]);
    assert_eq!(score.axis_coverage[5], [0.0, 0.0, 0.0]);
    assert_eq!(score.coverage.map(|c| c.measured), [0.0, 0.0, 1.0]);
    assert!(calibration::score([(&error, &unknown)]).is_none());
}
