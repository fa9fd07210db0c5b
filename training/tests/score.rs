//! `grnet-train score` as a process, against the figures that the public tools give for the same files
//! (`geometry/tests/golden`).

use std::{
    fs,
    path::{Path, PathBuf},
    process::{Command, Output},
};

use grnet_geometry::trajectory::tum;
use serde_json::Value;

fn golden(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../geometry/tests/golden").join(name)
}

fn figures(case: &str) -> Value {
    let all: Value = serde_json::from_str(&fs::read_to_string(golden("golden.json")).unwrap()).unwrap();
    all["cases"][case].clone()
}

fn run(format: &str, ground_truth: &Path, estimate: &Path, options: &[&str]) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_grnet-train"));
    command.args(["score", format]).arg(ground_truth).arg(estimate).args(options);
    command.output().unwrap()
}

fn score(format: &str, ground_truth: &Path, estimate: &Path, options: &[&str]) -> Value {
    let output = run(format, ground_truth, estimate, &[&["--json"], options].concat());
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    serde_json::from_slice(&output.stdout).unwrap()
}

fn failure(format: &str, ground_truth: &Path, estimate: &Path, options: &[&str]) -> String {
    let output = run(format, ground_truth, estimate, options);
    assert!(!output.status.success());
    assert!(output.stdout.is_empty());
    String::from_utf8(output.stderr).unwrap()
}

#[track_caller]
fn close(ours: &Value, theirs: &Value) {
    let (a, b) = (ours.as_f64().unwrap(), theirs.as_f64().unwrap());
    assert!((a - b).abs() <= 1e-5 * b.abs(), "ours {a}, theirs {b}");
}

fn notes(report: &Value) -> String {
    report["notes"].as_array().unwrap().iter().map(|n| n.as_str().unwrap().to_owned() + "\n").collect()
}

#[test]
fn kitti_equals_devkit_odom_eval_and_evo_under_every_alignment() {
    let theirs = figures("drive");
    for (align, odom_eval) in [("none", "none"), ("se3", "6dof"), ("sim3", "7dof"), ("scale", "scale")] {
        let ours = score("kitti", &golden("drive_gt.txt"), &golden("drive_est.txt"), &["--align", align]);
        let segments = &theirs["kitti_odom_eval"][odom_eval];
        close(&ours["t_rel_percent"], &segments["t_rel_percent"]);
        close(&ours["r_rel_deg_per_100m"], &segments["r_rel_deg_per_100m"]);
        assert_eq!(ours["segments"], segments["segments"]);
        let rpe = &theirs["evo"][align]["rpe_1_frame"];
        close(&ours["rpe_trans_rmse_m"], &rpe["translation_m"]["rmse"]);
        close(&ours["rpe_rot_rmse_deg"], &rpe["rotation_deg"]["rmse"]);
        let ape = &theirs["evo"][align]["ape"];
        close(&ours["median_translation_m"], &ape["translation_m"]["median"]);
        close(&ours["median_rotation_deg"], &ape["rotation_deg"]["median"]);
        // The ATE is given under every alignment, whichever one the other scores use.
        for name in ["none", "se3", "sim3"] {
            close(&ours["ate_rmse_m"][name], &theirs["evo"][name]["ape"]["translation_m"]["rmse"]);
        }
        assert_eq!(ours["per_length"].as_array().unwrap().len(), 8);
        assert!(!ours["per_speed"].as_array().unwrap().is_empty());
    }
    let ours = score("kitti", &golden("drive_gt.txt"), &golden("drive_est.txt"), &[]);
    let devkit = theirs["devkit"]["overall"]["t_err"].as_f64().unwrap() * 100.0;
    close(&ours["devkit"]["t_rel_percent"], &devkit.into());
}

#[test]
fn kitti_with_frame_numbers_equals_odom_eval() {
    for case in ["drive_mono", "drive_gaps"] {
        let theirs = figures(case);
        let estimate = golden(theirs["estimate"].as_str().unwrap());
        for (align, odom_eval) in [("none", "none"), ("scale", "scale"), ("sim3", "7dof")] {
            let ours = score("kitti", &golden("drive_gt.txt"), &estimate, &["--align", align]);
            let theirs = &theirs["kitti_odom_eval"];
            close(&ours["t_rel_percent"], &theirs[odom_eval]["t_rel_percent"]);
            close(&ours["r_rel_deg_per_100m"], &theirs[odom_eval]["r_rel_deg_per_100m"]);
            close(&ours["ate_rmse_m"]["none"], &theirs["none"]["ate_rmse_m"]);
            close(&ours["ate_rmse_m"]["sim3"], &theirs["7dof"]["ate_rmse_m"]);
            assert!(ours["missing"].as_u64().unwrap() > 0);
            assert!(notes(&ours).contains("frames have no estimate"));
        }
    }
}

#[test]
fn tum_equals_evo_and_every_option_counts() {
    let theirs = &figures("hand")["evo"];
    let (gt, est) = (golden("hand_gt.txt"), golden("hand_est.txt"));
    for align in ["none", "se3", "sim3", "scale"] {
        let ours = score("tum", &gt, &est, &["--align", align]);
        assert_eq!(ours["poses"], theirs["count"]);
        close(&ours["rpe_trans_rmse_m"], &theirs[align]["rpe_1_frame"]["translation_m"]["rmse"]);
        close(&ours["median_translation_m"], &theirs[align]["ape"]["translation_m"]["median"]);
        close(&ours["ate_rmse_m"]["se3"], &theirs["se3"]["ape"]["translation_m"]["rmse"]);
    }
    let every = score("tum", &gt, &est, &["--rpe-delta", "7", "--rpe-all-pairs"]);
    close(&every["rpe_rot_rmse_deg"], &theirs["none"]["rpe_7_frames_all"]["rotation_deg"]["rmse"]);

    let late = golden("hand_late.txt");
    let moved = score("tum", &gt, &late, &["--offset", "-3.25"]);
    close(&moved["ate_rmse_m"]["none"], &figures("hand_late")["evo"]["none"]["ape"]["translation_m"]["rmse"]);
    let narrow = score("tum", &gt, &est, &["--max-difference", "0.002"]);
    assert!(narrow["poses"].as_u64() < every["poses"].as_u64());
    assert!(notes(&narrow).contains("have no partner within 0.002 s"));
    let dense = golden("hand_dense.txt");
    let shared = score("tum", &gt, &dense, &[]);
    assert_eq!(shared["poses"], figures("hand_dense")["evo"]["count"]);
    let single = score("tum", &gt, &dense, &["--one-to-one"]);
    assert!(single["poses"].as_u64() < shared["poses"].as_u64());

    let wide =
        score("tum", &gt, &est, &["--align", "sim3", "--recall", "0.5,180", "--recall", "0.0001,0.0001"]);
    let recall = |i: usize| wide["recalls"][i]["recall"].as_f64().unwrap();
    assert_eq!(
        (wide["recalls"][0]["recall"].as_f64(), recall(1), recall(2)),
        (wide["recall_5cm_5deg"].as_f64(), 1.0, 0.0)
    );
    assert!((0.01..0.99).contains(&recall(0)));
}

#[test]
fn what_is_not_defined_is_null_and_says_why() {
    let one = score("tum", &golden("plane_gt.txt"), &golden("one_pose.txt"), &[]);
    for key in ["t_rel_percent", "r_rel_deg_per_100m", "rpe_trans_rmse_m", "rpe_rot_rmse_deg"] {
        assert!(one.as_object().unwrap()[key].is_null(), "{key}");
    }
    assert_eq!(one["segments"], 0);
    assert_eq!(one["ate_rmse_m"]["none"], 0.0);
    assert!(one["ate_rmse_m"]["se3"].is_null() && one["ate_rmse_m"]["sim3"].is_null());
    let text = notes(&one);
    for reason in ["RPE: no two of the 1 poses", "ATE se3, sim3, scale: 1 positions", "no segment of 100 m"] {
        assert!(text.contains(reason), "{text}");
    }
    let still = score("tum", &golden("still_gt.txt"), &golden("still_est.txt"), &["--align", "sim3"]);
    assert!(still["median_translation_m"].is_null() && still["recall_5cm_5deg"].is_null());
    assert!(notes(&still).contains("no score with this alignment"));
}

/// Writes frames as a 7-Scenes folder.
fn seven_scenes(folder: &Path, frames: impl Iterator<Item = (u64, [f64; 16])>) {
    fs::create_dir_all(folder).unwrap();
    for (frame, m) in frames {
        let rows: Vec<String> =
            m.chunks(4).map(|r| r.iter().map(|v| format!("{v:e}")).collect::<Vec<_>>().join("\t ")).collect();
        fs::write(folder.join(format!("frame-{frame:06}.pose.txt")), rows.join("\n") + "\n").unwrap();
    }
}

#[test]
fn seven_scenes_takes_every_form_of_estimate() {
    let dir = tempfile::tempdir().unwrap();
    let at = |name: &str| dir.path().join(name);
    let matrix = |x: f64| [1.0, 0.0, 0.0, x, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0];
    let curve = |i: u64| {
        let mut m = matrix(i as f64 * 0.1);
        m[7] = (i as f64).sin();
        m
    };
    // Frames 0 to 9; the estimate is off by 2 cm, from frame 6 on by 1 m.
    let off = |i: u64| {
        let mut m = curve(i);
        m[11] = if i < 6 { 0.02 } else { 1.0 };
        m
    };
    seven_scenes(&at("gt"), (0..10).map(|i| (i, curve(i))));
    seven_scenes(&at("est"), (0..10).map(|i| (i, off(i))));
    let row = |m: [f64; 16]| m[..12].iter().map(f64::to_string).collect::<Vec<_>>().join(" ");
    let lines = |line: &dyn Fn(u64) -> String| (0..10).map(|i| line(i) + "\n").collect::<String>();
    let tum_line = |t: String, m: [f64; 16]| format!("{t} {} {} {} 0 0 0 1", m[3], m[7], m[11]);
    fs::write(at("kitti12.txt"), lines(&|i| row(off(i)))).unwrap();
    fs::write(at("kitti13.txt"), lines(&|i| format!("{i} {}", row(off(i))))).unwrap();
    fs::write(at("frames.txt"), lines(&|i| tum_line(i.to_string(), off(i)))).unwrap();
    fs::write(at("seconds.txt"), lines(&|i| tum_line(format!("{:.6}", i as f64 / 30.0), off(i)))).unwrap();
    for estimate in ["est", "kitti12.txt", "kitti13.txt", "frames.txt", "seconds.txt"] {
        let report = score("7scenes", &at("gt"), &at(estimate), &[]);
        assert_eq!((report["poses"].as_u64(), report["missing"].as_u64()), (Some(10), Some(0)), "{estimate}");
        assert!((report["median_translation_m"].as_f64().unwrap() - 0.02).abs() < 1e-12, "{estimate}");
        assert_eq!(report["recall_5cm_5deg"], 0.6, "{estimate}");
    }
    let slow = failure("7scenes", &at("gt"), &at("seconds.txt"), &["--rate", "40"]);
    assert!(slow.contains("which is frame 1.333"), "{slow}");
    let frames = failure("7scenes", &at("gt"), &at("seconds.txt"), &["--tum-time", "frames"]);
    assert!(frames.contains("expected a frame number"), "{frames}");

    // Half the frames, and a pose that says "not localized".
    let mut lost = off(1);
    lost[0] = f64::NAN;
    seven_scenes(&at("half"), (0..5).map(|i| (i, if i == 1 { lost } else { off(i) })));
    let report = score("7scenes", &at("gt"), &at("half"), &[]);
    assert_eq!((report["poses"].as_u64(), report["missing"].as_u64()), (Some(4), Some(6)));
    assert_eq!(
        (&report["recall_5cm_5deg"], &report["recalls"][0]["recall_of_all"]),
        (&1.0.into(), &0.4.into())
    );
    assert!(notes(&report).contains("6 of 10 frames have no estimate"));
    fs::write(at("list.txt"), "0\nseq-01/frame-000002\n# c\nseq-01/frame-000003.color.png\n").unwrap();
    let list = at("list.txt");
    let listed = score("7scenes", &at("gt"), &at("half"), &["--frames", list.to_str().unwrap()]);
    assert_eq!((listed["poses"].as_u64(), listed["missing"].as_u64()), (Some(3), Some(0)));

    seven_scenes(&at("more"), (0..11).map(|i| (i, curve(i))));
    let foreign = failure("7scenes", &at("gt"), &at("more"), &[]);
    assert!(foreign.contains("found frame 10, expected only frames of"), "{foreign}");
    fs::write(at("more/frame-000003.pose.txt"), "1 0 0\n0 x 0\n").unwrap();
    let broken = failure("7scenes", &at("more"), &at("gt"), &[]);
    assert!(broken.contains("frame-000003.pose.txt:2: found \"x\", expected a number"), "{broken}");
    fs::create_dir(at("empty")).unwrap();
    assert!(failure("7scenes", &at("empty"), &at("gt"), &[]).contains("found no frame-XXXXXX.pose.txt"));
}

#[test]
fn errors_name_the_file_and_the_remedy() {
    let (gt, est) = (golden("drive_gt.txt"), golden("hand_est.txt"));
    let wrong = failure("kitti", &gt, &est, &[]);
    assert!(wrong.contains("hand_est.txt:2: found 8 columns"), "{wrong}");
    let late = failure("tum", &golden("hand_gt.txt"), &golden("still_est.txt"), &[]);
    assert!(late.contains("still_est.txt") && late.contains("found no poses of the same time"), "{late}");
    let gaps = failure("kitti", &golden("drive_gaps.txt"), &golden("drive_gaps.txt"), &[]);
    assert!(gaps.contains("drive_gaps.txt: the ground truth has no frame 150"), "{gaps}");
    assert!(failure("kitti", &gt, Path::new("none.txt"), &[]).contains("cannot read trajectory none.txt"));
    for options in [["--rpe-delta", "0"], ["--recall", "5"], ["--align", "affine"]] {
        assert!(failure("kitti", &gt, &gt, &options).contains(options[0]), "{options:?}");
    }
}

#[test]
fn the_table_shows_the_same_figures() {
    let output = run("kitti", &golden("drive_gt.txt"), &golden("drive_est.txt"), &[]);
    let text = String::from_utf8(output.stdout).unwrap();
    let json = score("kitti", &golden("drive_gt.txt"), &golden("drive_est.txt"), &[]);
    for key in ["t_rel_percent", "r_rel_deg_per_100m", "rpe_trans_rmse_m", "median_rotation_deg"] {
        let figure = format!("{:.6}", json[key].as_f64().unwrap());
        assert!(text.contains(&figure), "{key} {figure} is not in\n{text}");
    }
    let still = run("tum", &golden("still_gt.txt"), &golden("still_est.txt"), &[]);
    let text = String::from_utf8(still.stdout).unwrap();
    assert!(text.contains("t_rel                              - %") && text.contains("note: "), "{text}");
    // The reader agrees with the library's.
    assert_eq!(tum::read(&golden("still_gt.txt")).unwrap().len(), 60);
}
