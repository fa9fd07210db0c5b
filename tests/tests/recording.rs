//! Recordings of one's own: recorded by the daemon, joined with true poses, checked, and played again.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use grnet_tests::{Rig, program};
use rustix::process::Signal;
use serde_json::Value;

/// Frames of the rig's recording that are played.
const FRAMES: usize = 60;

fn train(arguments: &[&str]) -> Output {
    Command::new(program("grnet-train")).args(arguments).output().unwrap()
}

fn said(output: &Output) -> String {
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    text(&output.stdout) + &text(&output.stderr)
}

/// Stamps in nanoseconds and images of a recording, as they stand in its list.
fn list(folder: &Path) -> Vec<(u128, PathBuf)> {
    let text = fs::read_to_string(folder.join("rgb.txt")).unwrap();
    let entry = |line: &str| {
        let (stamp, image) = line.split_once(' ').unwrap();
        let (seconds, fraction) = stamp.split_once('.').unwrap();
        assert_eq!(fraction.len(), 9, "{line}");
        let ns = seconds.parse::<u128>().unwrap() * 1_000_000_000 + fraction.parse::<u128>().unwrap();
        (ns, folder.join(image))
    };
    text.lines().filter(|line| !line.starts_with('#')).map(entry).collect()
}

fn manifest(folder: &Path) -> Value {
    serde_json::from_str(&fs::read_to_string(folder.join("recording.json")).unwrap()).unwrap()
}

/// Records the beginning of the rig's recording as fast as the network goes.
fn record(rig: &Rig, folder: &Path, frames: usize, settings: &[&str]) {
    let limit = format!("source.frame_limit={frames}");
    let mut all = vec!["source.pace=\"max\"", &limit];
    all.extend(settings);
    let daemon = rig.daemon_with(&["--record", folder.to_str().unwrap()], &all);
    let (_, status, stderr) = daemon.finish();
    assert!(status.success(), "{stderr}");
    assert!(stderr.contains(&format!("{frames} frames recorded")), "{stderr}");
}

/// The true poses of the rig's recording as a TUM file, `time_s tx ty tz qx qy qz qw`.
fn truth(rig: &Rig) -> String {
    let mut text = String::new();
    for frame in 0..FRAMES {
        let file = rig.recording().join(format!("frame-{frame:06}.pose.txt"));
        let m: Vec<f64> =
            fs::read_to_string(file).unwrap().split_whitespace().map(|v| v.parse().unwrap()).collect();
        let (r, t) = (|row: usize, column: usize| m[4 * row + column], [m[3], m[7], m[11]]);
        // The quaternion's part that is largest comes first, as the others are divided by it.
        let squares = [
            1.0 + r(0, 0) - r(1, 1) - r(2, 2),
            1.0 - r(0, 0) + r(1, 1) - r(2, 2),
            1.0 - r(0, 0) - r(1, 1) + r(2, 2),
            1.0 + r(0, 0) + r(1, 1) + r(2, 2),
        ];
        let largest = (0..4).max_by(|a, b| squares[*a].total_cmp(&squares[*b])).unwrap();
        let half = squares[largest].sqrt();
        let sum = |a: usize, b: usize| (r(a, b) + r(b, a)) / half / 2.0;
        let difference = |a: usize, b: usize| (r(a, b) - r(b, a)) / half / 2.0;
        let (sx, sy, sz) = (difference(2, 1), difference(0, 2), difference(1, 0));
        let [x, y, z, w] = match largest {
            0 => [half / 2.0, sum(0, 1), sum(0, 2), sx],
            1 => [sum(0, 1), half / 2.0, sum(1, 2), sy],
            2 => [sum(0, 2), sum(1, 2), half / 2.0, sz],
            _ => [sx, sy, sz, half / 2.0],
        };
        let time_s = frame as f64 / 30.0;
        text += &format!("{time_s:.9} {} {} {} {x} {y} {z} {w}\n", t[0], t[1], t[2]);
    }
    text
}

#[test]
fn what_was_recorded_is_joined_checked_and_played_again() {
    let rig = Rig::new();
    let folder = rig.folder().join("recorded");
    record(&rig, &folder, FRAMES, &[]);

    let frames = list(&folder);
    assert_eq!(frames.len(), FRAMES);
    for (index, (ns, image)) in frames.iter().enumerate() {
        // The stamps of a recording played at pace "max" are its own.
        assert!(ns.abs_diff(index as u128 * 1_000_000_000 / 30) <= 1, "{ns}");
        let source = rig.recording().join(format!("frame-{index:06}.color.jpg"));
        let pixels = |path: &Path| image::open(path).unwrap().into_rgb8();
        assert!(pixels(image) == pixels(&source), "{}", image.display());
    }
    let manifest = manifest(&folder);
    assert_eq!((&manifest["complete"], &manifest["clock"]), (&true.into(), &"recorded".into()));
    assert_eq!(manifest["left_out_queue_full"], 0);

    let truth_file = rig.folder().join("truth.tum");
    fs::write(&truth_file, truth(&rig)).unwrap();
    let data = folder.to_str().unwrap();
    let before = train(&["check", data]);
    assert!(said(&before).contains("grnet-train join"), "{}", said(&before));
    let joined = train(&["join", data, "--trajectory", truth_file.to_str().unwrap(), "--json"]);
    assert!(joined.status.success(), "{}", said(&joined));
    let report: Value = serde_json::from_slice(&joined.stdout).unwrap();
    assert_eq!((&report["with_pose"], &report["scale"]), (&FRAMES.into(), &1.0.into()));
    let again = train(&["join", data, "--trajectory", truth_file.to_str().unwrap()]);
    assert!(!again.status.success() && said(&again).contains("--force"), "{}", said(&again));

    let checked = train(&["check", data, "--layout", "tum", "--json"]);
    assert!(checked.status.success(), "{}", said(&checked));
    let report: Value = serde_json::from_slice(&checked.stdout).unwrap();
    assert_eq!((&report["errors"], &report["frames"]), (&0.into(), &FRAMES.into()));

    let out = rig.folder().join("report");
    let evaluated = train(&["evaluate", "--data", data, "--gap", "5", "--out", out.to_str().unwrap()]);
    assert!(evaluated.status.success(), "{}", said(&evaluated));

    let replay = Rig::with_recording(&folder);
    let mut tail = replay.tail(&["--json", "--timeout", "30"]);
    let daemon = replay.daemon(&["source.pace=\"max\"", "publish.wait_for_subscribers=1"]);
    let mut played = 0;
    while tail.json()["reason"] != "SOURCE_ENDED" {
        played += 1;
    }
    assert!(played >= FRAMES, "{played} samples");
    tail.signal(Signal::TERM);
    assert!(daemon.finish().1.success());
}

#[test]
fn a_live_recording_is_stamped_with_the_time_of_day_and_survives_a_kill() {
    let rig = Rig::new();
    let folder = rig.folder().join("live");
    let mut daemon =
        rig.daemon_with(&["--record", folder.to_str().unwrap()], &["source.loop=true", "record.format=jpeg"]);
    daemon.stderr_line_with("recording folder=");
    // Each sample is one more frame; the disk is not far behind.
    let mut tail = rig.tail(&["--json"]);
    while list(&folder).len() < 20 {
        tail.json();
    }
    daemon.kill();
    let frames = list(&folder);
    let now = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH).unwrap().as_nanos();
    for pair in frames.windows(2) {
        assert!(pair[0].0 < pair[1].0);
    }
    let (first, last) = (frames[0].0, frames[frames.len() - 1].0);
    assert!(first < now && now - first < 120_000_000_000 && last <= now, "{first} {last} {now}");
    for (_, image) in &frames {
        assert_eq!(image::image_dimensions(image).unwrap(), (160, 120));
    }
    assert_eq!(manifest(&folder)["complete"], false);
    let checked = train(&["check", folder.to_str().unwrap(), "--json"]);
    let report: Value = serde_json::from_slice(&checked.stdout).unwrap();
    let findings = report["findings"].as_array().unwrap();
    assert!(findings.iter().all(|finding| finding["kind"] != "unreadable-image"), "{report}");
}

#[test]
fn a_folder_that_is_not_empty_ends_the_start_with_78() {
    let rig = Rig::new();
    fs::write(rig.folder().join("thesis.tex"), "years").unwrap();
    let daemon = rig.daemon_with(&["--record", rig.folder().to_str().unwrap()], &[]);
    let (_, status, stderr) = daemon.finish();
    assert_eq!(status.code(), Some(78), "{stderr}");
    assert!(stderr.contains("empty") && !stderr.contains("frames arrive"), "{stderr}");
    assert_eq!(fs::read_to_string(rig.folder().join("thesis.tex")).unwrap(), "years");
}

#[test]
fn a_disk_that_fails_ends_the_recording_and_not_the_daemon() {
    let rig = Rig::new();
    let folder = rig.folder().join("greedy");
    let mut daemon =
        rig.daemon_with(&["--record", folder.to_str().unwrap()], &["source.loop=true", "source.pace=4.0"]);
    daemon.stderr_line_with("recording folder=");
    let mut tail = rig.tail(&["--json"]);
    while list(&folder).len() < 3 {
        tail.json();
    }
    // What a full disk does: the next image cannot be written. Moved, as a folder that grows cannot be removed.
    fs::rename(folder.join("rgb"), rig.folder().join("moved")).unwrap();
    let line = daemon.stderr_line_with("the recording has ended");
    assert!(line.contains("ERROR") && line.contains("rgb/"), "{line}");
    let mut status = rig.client(&["status", "--json"]);
    let status = status.json();
    assert_eq!(status["recording"], "OFF", "{status}");
    assert!(status["last_error"].to_string().contains("the recording has ended"), "{status}");
    tail.json();
    daemon.signal(Signal::TERM);
    assert!(daemon.wait().0.success());
}

#[test]
fn a_trajectory_of_another_day_is_refused_with_both_ranges() {
    let rig = Rig::new();
    let folder = rig.folder().join("recorded");
    record(&rig, &folder, 10, &["record.format=jpeg"]);
    let late = rig.folder().join("late.tum");
    fs::write(&late, "1000 0 0 0 0 0 0 1\n1001 1 0 0 0 0 0 1\n").unwrap();
    let joined = train(&["join", folder.to_str().unwrap(), "--trajectory", late.to_str().unwrap()]);
    let text = said(&joined);
    assert!(!joined.status.success() && !folder.join("groundtruth.txt").exists());
    for part in ["0.000 to 0.300", "1000.000 to 1001.000", "--time-offset"] {
        assert!(text.contains(part), "{text}");
    }
}
