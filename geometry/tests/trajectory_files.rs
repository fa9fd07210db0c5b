//! The text formats: lossless round trips, and errors that name file, line, what was found and what was expected.

use std::path::Path;

use grnet_geometry::{
    Pose, StampedPose, Trajectory,
    nalgebra::{Matrix3, Vector6},
    se3::{self, Tangent},
    trajectory::{KittiPoses, kitti, tum},
};
use proptest::prelude::*;

fn poses() -> impl Strategy<Value = Vec<Pose>> {
    let pose = prop::array::uniform6(-3.0..3.0f64).prop_map(|v| se3::exp(&Tangent(Vector6::from(v))));
    prop::collection::vec(pose, 1..20)
}

proptest! {
    #[test]
    fn tum_round_trip(poses in poses(), start in -5_000_000_000_000_000_000i64..5_000_000_000_000_000_000,
                      steps in prop::collection::vec(1i64..1_000_000_000, 20)) {
        let mut time_ns = start;
        let stamped = poses.iter().zip(steps).map(|(p, step)| {
            time_ns += step;
            StampedPose { time_ns, world_from_camera: *p }
        });
        let trajectory = Trajectory::new(stamped.collect()).unwrap();
        let back = tum::parse(&tum::format(&trajectory), Path::new("round.txt")).unwrap();
        prop_assert_eq!(back.len(), trajectory.len());
        for (a, b) in trajectory.poses().iter().zip(back.poses()) {
            prop_assert_eq!(a.time_ns, b.time_ns);
            prop_assert_eq!(a.world_from_camera.translation, b.world_from_camera.translation);
            let angle = se3::angle_rad(&a.world_from_camera.rotation.rotation_to(&b.world_from_camera.rotation));
            prop_assert!(angle < 1e-15);
        }
    }

    #[test]
    fn kitti_round_trip(poses in poses(), gap in 1u64..1000) {
        let plain = KittiPoses::from_poses(&poses);
        let numbered = poses.iter().enumerate().map(|(i, p)| (i as u64 * gap, *p));
        let indexed = KittiPoses::from_frames(numbered).unwrap();
        for original in [plain, indexed] {
            let back = kitti::parse(&kitti::format(&original), Path::new("round.txt")).unwrap();
            prop_assert_eq!(back.is_indexed(), original.is_indexed());
            for (a, b) in original.poses().iter().zip(back.poses()) {
                prop_assert_eq!((a.frame, a.matrix), (b.frame, b.matrix));
                let angle = se3::angle_rad(&a.world_from_camera.rotation.rotation_to(&b.world_from_camera.rotation));
                prop_assert!(angle < 1e-14);
            }
        }
    }

    #[test]
    fn foreign_text_never_panics(text in "([-+0-9.e# \tnaif]{0,40}\n){0,6}|\\PC{0,80}") {
        let _ = tum::parse(&text, Path::new("x"));
        let _ = kitti::parse(&text, Path::new("x"));
    }
}

fn tum_error(text: &str) -> String {
    tum::parse(text, Path::new("run/est.txt")).unwrap_err().to_string()
}

fn kitti_error(text: &str) -> String {
    kitti::parse(text, Path::new("run/05.txt")).unwrap_err().to_string()
}

#[test]
fn tum_accepts_what_tools_write() {
    let text = "\u{feff}# comment\r\n\r\n1305031102.160407\t1 2 3 0 0 0 2\r\n  1.3050311021944e+09 1 2 3 0 0 0 -1 \n";
    let trajectory = tum::parse(text, Path::new("x")).unwrap();
    let times: Vec<i64> = trajectory.poses().iter().map(|p| p.time_ns).collect();
    assert_eq!(times, [1_305_031_102_160_407_000, 1_305_031_102_194_400_000]);
    assert_eq!(trajectory.poses()[0].world_from_camera, trajectory.poses()[1].world_from_camera);
}

#[test]
fn tum_errors_name_the_place() {
    let good = "1 0 0 0 0 0 0 1\n";
    let cases = [
        ("1 2 3\n", "run/est.txt:1: found 3 columns in \"1 2 3\", expected 8 numbers"),
        ("# c\n\nx 0 0 0 0 0 0 1\n", "run/est.txt:3: found \"x\", expected a time"),
        ("1 0 nan 0 0 0 0 1\n", "run/est.txt:1: found \"nan\", expected a finite number"),
        ("1 0 0 0 0 0 0 0\n", "run/est.txt:1: found rotation [0.0, 0.0, 0.0, 0.0] has norm"),
        (
            "1 0 0 0 0 0 0 1\n0.5 0 0 0 0 0 0 1\n",
            "run/est.txt:2: found time 0.500000000 s, expected a time later",
        ),
        ("# nothing\n", "run/est.txt: found no pose"),
    ];
    for (text, expected) in cases {
        assert!(tum_error(text).starts_with(expected), "{}", tum_error(text));
    }
    assert!(tum_error(&good.repeat(2)).contains("(1.000000000 s)"));
}

#[test]
fn kitti_errors_name_the_place() {
    let pose = "1 0 0 0 0 1 0 0 0 0 1 0";
    let cases = [
        ("1 2 3\n".to_owned(), "run/05.txt:1: found 3 columns in \"1 2 3\", expected 12 numbers"),
        (
            format!("{pose}\n0 {pose}\n"),
            "run/05.txt:2: found 13 columns, expected 12 columns as in the first pose",
        ),
        (format!("1.5 {pose}\n"), "run/05.txt:1: found \"1.5\", expected a frame number"),
        (format!("-1 {pose}\n"), "run/05.txt:1: found \"-1\", expected a frame number"),
        (format!("4 {pose}\n4 {pose}\n"), "run/05.txt:2: found frame 4, expected a number above 4"),
        ("2 0 0 0 0 1 0 0 0 0 1 0\n".to_owned(), "run/05.txt:1: found 3x3 matrix is no rotation"),
        ("1 0 0 inf 0 1 0 0 0 0 1 0\n".to_owned(), "run/05.txt:1: found \"inf\", expected a finite number"),
        (String::new(), "run/05.txt: found no pose"),
    ];
    for (text, expected) in cases {
        assert!(kitti_error(&text).starts_with(expected), "{}", kitti_error(&text));
    }
    // A mirror image is never a pose, however exact its digits.
    assert!(kitti_error("1 0 0 0 0 1 0 0 0 0 -1 0\n").contains("determinant -1"));
    assert!(KittiPoses::from_frames([(3, Pose::identity()), (3, Pose::identity())]).is_err());
}

#[test]
fn kitti_projects_printed_digits() {
    let text = "0.99999 -0.00450 0 1 0.00450 0.99999 0 2 0 0 1 3\n";
    let poses = kitti::parse(text, Path::new("x")).unwrap();
    let pose = &poses.poses()[0];
    assert_eq!(pose.matrix[(0, 0)], 0.99999);
    let r = pose.world_from_camera.rotation.to_rotation_matrix().into_inner();
    assert!((r * r.transpose() - Matrix3::identity()).norm() < 1e-15);
    assert!((r - pose.rotation()).norm() < 2e-5);
}

#[test]
fn files_round_trip_and_missing_files_are_named() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("est.txt");
    let trajectory = Trajectory::new(vec![StampedPose {
        time_ns: -1,
        world_from_camera: Pose::translation(1.0, 0.0, 0.0),
    }])
    .unwrap();
    tum::write(&path, &trajectory).unwrap();
    assert_eq!(tum::read(&path).unwrap(), trajectory);
    let poses = KittiPoses::from_poses(&[Pose::translation(1.0, 0.0, 0.0)]);
    kitti::write(&path, &poses).unwrap();
    assert_eq!(kitti::read(&path).unwrap(), poses);
    std::fs::write(&path, b"1 0 0\n\xff\n").unwrap();
    let error = tum::read(&path).unwrap_err().to_string();
    assert!(
        error.ends_with("est.txt:2: found bytes that are no UTF-8 text, expected a text file"),
        "{error}"
    );
    let missing = dir.path().join("none").join("est.txt");
    assert!(tum::read(&missing).unwrap_err().to_string().contains("none/est.txt"));
    assert!(tum::write(&missing, &trajectory).unwrap_err().to_string().starts_with("cannot write"));
}
