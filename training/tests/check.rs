//! `grnet-train check`: a clean recording has nothing to complain about, and every fault that is put into it is found.

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

use grnet_capture::dataset::{self, OpenOptions, Pose};
use grnet_frame::{Camera, Distortion};
use grnet_geometry::trajectory::{StampedPose, Trajectory, tum};
use grnet_train::check::{CheckOptions, CheckReport, Severity, check};
use grnet_train::synth::{ImageFormat, Recipe, SceneOptions, SensorOptions, Shutter, VolumeKind, write};
use nalgebra::{Quaternion, UnitQuaternion, Vector3};

const FRAMES: usize = 100;
const FOCAL_PX: f64 = 262.0;

/// One pass through a room as a webcam sees it. Rendered once.
fn room() -> &'static Path {
    static FOLDER: OnceLock<tempfile::TempDir> = OnceLock::new();
    let folder = FOLDER.get_or_init(|| {
        let folder = tempfile::tempdir().unwrap();
        let camera = Camera::new((320, 240), (FOCAL_PX, FOCAL_PX), (159.5, 119.5), Distortion::None).unwrap();
        let recipe = Recipe {
            scene: SceneOptions { room: 3, texel_m: 0.008 },
            volume: VolumeKind::Handheld,
            seed: 5,
            sequences: 1,
            test_sequences: 0,
            frames: FRAMES as u32,
            rate_hz: 30.0,
            camera,
            format: ImageFormat::Jpg(92),
            depth: false,
            edge_samples: 1,
            sensor: SensorOptions::default(),
            shutter: Shutter::default(),
        };
        write(&recipe, &folder.path().join("room"), &|| ()).unwrap();
        folder
    });
    Box::leak(folder.path().join("room").into_boxed_path())
}

/// A copy of the room that may be damaged, and how to open it.
struct Copy {
    folder: tempfile::TempDir,
    options: CheckOptions,
}

impl Copy {
    fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        fs::create_dir(folder.path().join("seq-01")).unwrap();
        for name in ["camera-intrinsics.txt", "seq-01"] {
            let from = room().join(name);
            let files = if from.is_dir() {
                fs::read_dir(&from).unwrap().map(|e| e.unwrap().path()).collect()
            } else {
                vec![from]
            };
            for file in files {
                fs::copy(&file, folder.path().join(file.strip_prefix(room()).unwrap())).unwrap();
            }
        }
        Self { folder, options: CheckOptions::default() }
    }

    fn image(&self, frame: usize) -> PathBuf {
        self.folder.path().join(format!("seq-01/frame-{frame:06}.color.jpg"))
    }

    fn pose_file(&self, frame: usize) -> PathBuf {
        self.folder.path().join(format!("seq-01/frame-{frame:06}.pose.txt"))
    }

    /// Moves the true pose of a frame along x.
    fn move_pose(&self, frame: usize, by_m: f64) {
        let text = fs::read_to_string(self.pose_file(frame)).unwrap();
        let mut numbers: Vec<f64> = text.split_whitespace().map(|v| v.parse().unwrap()).collect();
        numbers[3] += by_m;
        let row = |row: &[f64]| row.iter().map(f64::to_string).collect::<Vec<_>>().join(" ") + "\n";
        fs::write(self.pose_file(frame), numbers.chunks(4).map(row).collect::<String>()).unwrap();
    }

    /// Replaces the ground truth by what `change` makes of it.
    fn with_poses(mut self, change: impl Fn(&[Pose], usize) -> Pose) -> Self {
        let recording = dataset::open_one(self.folder.path(), &OpenOptions::default()).unwrap();
        let poses: Vec<Pose> = recording.frames.iter().map(|f| f.world_from_camera.unwrap()).collect();
        let stamped = |(i, frame): (usize, &dataset::RecordedFrame)| StampedPose {
            time_ns: frame.time_ns as i64,
            world_from_camera: change(&poses, i),
        };
        let stamped: Vec<StampedPose> = recording.frames.iter().enumerate().map(stamped).collect();
        let file = self.folder.path().join("truth.txt");
        tum::write(&file, &Trajectory::new(stamped).unwrap()).unwrap();
        self.options.open.poses = Some(file);
        self
    }

    fn check(&self) -> CheckReport {
        check(self.folder.path(), &self.options, &|| ()).unwrap()
    }
}

/// The one finding of this kind, with its severity and frames.
#[track_caller]
fn finding(report: &CheckReport, kind: &str) -> (Severity, Vec<u64>, String) {
    match report.of_kind(kind).as_slice() {
        [one] => (one.severity, one.frames.clone(), one.found.clone()),
        found => panic!("{} findings of kind {kind} in\n{}", found.len(), report.text()),
    }
}

#[test]
fn a_clean_recording_has_no_error_and_no_warning() {
    let report = check(room(), &CheckOptions::default(), &|| ()).unwrap();
    assert_eq!((report.errors, report.warnings), (0, 0), "{}", report.text());
    assert_eq!(finding(&report, "poses-fit").0, Severity::Note);
    assert_eq!(report.frames, FRAMES);
}

#[test]
fn damaged_images_are_found_by_number() {
    let copy = Copy::new();
    let whole = fs::read(copy.image(10)).unwrap();
    fs::write(copy.image(10), &whole[..whole.len() / 2]).unwrap();
    fs::write(copy.image(11), b"no image").unwrap();
    let open = |frame| image::open(copy.image(frame)).unwrap();
    open(20).resize_exact(160, 120, image::imageops::FilterType::Triangle).save(copy.image(20)).unwrap();
    fs::copy(copy.image(29), copy.image(30)).unwrap();
    open(40).blur(4.0).save(copy.image(40)).unwrap();
    open(50).brighten(-250).save(copy.image(50)).unwrap();
    open(60).brighten(250).save(copy.image(60)).unwrap();
    let report = copy.check();
    let (severity, frames, found) = finding(&report, "unreadable-image");
    assert_eq!((severity, frames), (Severity::Error, vec![10, 11]));
    assert!(found.contains("frame-000010") && found.contains("cut short"), "{found}");
    assert_eq!(finding(&report, "image-size").1, [20]);
    assert_eq!(finding(&report, "repeated-image").1, [30]);
    assert!(finding(&report, "blur").1.contains(&40));
    assert_eq!(finding(&report, "too-dark").1, [50]);
    assert_eq!(finding(&report, "too-bright").1, [60]);
}

#[test]
fn gaps_and_repeated_times_are_found() {
    let copy = Copy::new();
    let mut list = String::new();
    for frame in (0..FRAMES).filter(|frame| !(30..45).contains(frame)) {
        let time = if frame == 60 { 59 } else { frame } as f64 / 30.0;
        list += &format!("{time:.6} seq-01/frame-{frame:06}.color.jpg\n");
    }
    fs::write(copy.folder.path().join("rgb.txt"), list).unwrap();
    let mut options = CheckOptions::default();
    options.open.layout = dataset::Layout::Tum;
    let report = check(copy.folder.path(), &options, &|| ()).unwrap();
    // Numbers count the lines of the list.
    let (severity, frames, found) = finding(&report, "time-gap");
    assert_eq!((severity, frames), (Severity::Warning, vec![30, 46]), "{found}");
    assert!(found.contains("0.533 s"), "{found}");
    assert_eq!(finding(&report, "repeated-time").1, [45]);
    assert_eq!(finding(&report, "no-poses").0, Severity::Error);
}

#[test]
fn missing_and_impossible_poses_and_jumps_are_found() {
    let copy = Copy::new();
    for frame in 20..40 {
        fs::remove_file(copy.pose_file(frame)).unwrap();
    }
    fs::write(copy.pose_file(5), "1 0 0 nan\n0 1 0 0\n0 0 1 0\n0 0 0 1\n").unwrap();
    fs::write(copy.pose_file(6), "1 0 0 0\n0 1 0 0\n0 0 -1 0\n0 0 0 1\n").unwrap();
    copy.move_pose(70, 0.3);
    let report = copy.check();
    let (severity, frames, _) = finding(&report, "missing-pose");
    assert_eq!(severity, Severity::Warning);
    assert_eq!(frames, [5, 6].into_iter().chain(20..40).collect::<Vec<u64>>());
    let (severity, _, found) = finding(&report, "invalid-pose");
    assert!(severity == Severity::Warning && found.contains("frame-000005.pose.txt"), "{found}");
    let (_, frames, found) = finding(&report, "pose-jump");
    assert_eq!(frames, [70, 71], "{found}");
}

#[test]
fn millimetres_and_standstill_are_found() {
    let scaled = |factor: f64| {
        Copy::new().with_poses(move |poses, i| {
            let pose = poses[i];
            Pose::from_parts((pose.translation.vector * factor).into(), pose.rotation)
        })
    };
    assert_eq!(finding(&scaled(1000.0).check(), "impossible-speed").0, Severity::Error);
    let still = Copy::new().with_poses(|poses, _| poses[0]);
    assert_eq!(finding(&still.check(), "little-motion").0, Severity::Warning);
}

#[test]
fn a_wrong_focal_length_is_found_with_a_better_one() {
    for (given, severity) in [(FOCAL_PX * 1.13, Severity::Warning), (FOCAL_PX * 0.6, Severity::Error)] {
        let copy = Copy::new();
        let matrix = format!("{given} 0 159.5\n0 {given} 119.5\n0 0 1\n");
        fs::write(copy.folder.path().join("camera-intrinsics.txt"), matrix).unwrap();
        let (found_severity, _, found) = finding(&copy.check(), "focal-length");
        let better: f64 = found.split(' ').find_map(|word| word.parse().ok()).unwrap();
        assert!((better / FOCAL_PX - 1.0).abs() < 0.05, "{found}");
        assert_eq!(found_severity, severity, "{found}");
    }
}

#[test]
fn without_intrinsics_a_focal_length_is_proposed() {
    // The 7-Scenes layout has published ones, that of TUM has not.
    let mut copy = Copy::new().with_poses(|poses, i| poses[i]);
    let line = |i: usize| format!("{:.6} seq-01/frame-{i:06}.color.jpg\n", i as f64 / 30.0);
    fs::write(copy.folder.path().join("rgb.txt"), (0..FRAMES).map(line).collect::<String>()).unwrap();
    copy.options.open.layout = dataset::Layout::Tum;
    // The list rounds to microseconds.
    copy.options.open.association = dataset::Association::Nearest(std::time::Duration::from_millis(1));
    fs::remove_file(copy.folder.path().join("camera-intrinsics.txt")).unwrap();
    let (severity, _, found) = finding(&copy.check(), "no-intrinsics");
    let proposed: f64 = found.split(' ').find_map(|word| word.parse().ok()).unwrap();
    assert!(severity == Severity::Warning && (proposed / FOCAL_PX - 1.0).abs() < 0.06, "{found}");
}

#[test]
fn inverted_poses_and_other_axes_are_named() {
    let inverted = Copy::new().with_poses(|poses, i| poses[i].inverse()).check();
    assert_eq!(finding(&inverted, "inverted-poses").0, Severity::Error);
    // Body axes: x forward, y left, z up.
    let optical_from_body = UnitQuaternion::new_normalize(Quaternion::new(0.5, 0.5, -0.5, 0.5));
    let gl = UnitQuaternion::from_axis_angle(&Vector3::x_axis(), std::f64::consts::PI);
    for (camera_from_given, words) in [(optical_from_body, "REP-103"), (gl, "OpenGL")] {
        let report = Copy::new().with_poses(|poses, i| poses[i] * camera_from_given).check();
        let (severity, _, found) = finding(&report, "other-axes");
        assert!(severity == Severity::Error && found.contains(words), "{found}");
    }
}

#[test]
fn poses_that_are_early_or_late_and_poses_of_something_else_are_found() {
    for (shift, word) in [(2, "late"), (-2, "early")] {
        let copy = Copy::new().with_poses(|poses, i| {
            let from = (i as i64 - shift).clamp(0, FRAMES as i64 - 1);
            poses[from as usize]
        });
        let (_, _, found) = finding(&copy.check(), "time-offset");
        assert!(found.contains(word) && found.contains("about 2 frames"), "{found}");
    }
    let other = Copy::new().with_poses(|poses, i| {
        let (a, b) = (poses[(i + 37) % FRAMES], poses[FRAMES - 1 - i]);
        Pose::from_parts(a.translation, b.rotation)
    });
    assert_eq!(finding(&other.check(), "poses-do-not-fit").0, Severity::Error);
}

#[test]
fn far_test_frames_are_found_when_lists_are_given() {
    let mut copy = Copy::new();
    for frame in 80..FRAMES {
        copy.move_pose(frame, 5.0);
    }
    let list = |name: &str, frames: std::ops::Range<usize>| {
        let path = copy.folder.path().join(name);
        fs::write(&path, frames.map(|i| format!("seq-01/frame-{i:06}\n")).collect::<String>()).unwrap();
        path
    };
    let (train, near, far) =
        (list("train.txt", 0..60), list("near.txt", 60..70), list("far.txt", 80..FRAMES));
    copy.options.lists = Some((train.clone(), near));
    assert_eq!(finding(&copy.check(), "coverage").0, Severity::Note);
    copy.options.lists = Some((train, far));
    let (severity, frames, _) = finding(&copy.check(), "coverage");
    assert_eq!((severity, frames), (Severity::Warning, (80..FRAMES as u64).collect()));
}
