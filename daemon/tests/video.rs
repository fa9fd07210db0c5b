//! `grnetd` with a video file and with calibration files, against the same frames from a folder.

mod rig;

use std::process::Command;
use std::time::{Duration, Instant};

use grnet_proto::{PoseSample, PoseSubscription, Reason};
use rig::{Daemon, Rig, next};
use rustix::process::Signal;

const FRAMES: u32 = 12;

const CALIBRATION: &str = "image_width: 64
image_height: 48
camera_matrix:
  rows: 3
  cols: 3
  data: [60.0, 0, 31.5, 0, 60.5, 23.5, 0, 0, 1]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.1, 0.02, 0.001, 0.0, 0.0]
";

/// The rig's images as a video without loss at 30 frames/s.
fn make_video(rig: &Rig, name: &str) {
    let made = Command::new("ffmpeg")
        .args(["-nostdin", "-loglevel", "error", "-framerate", "30", "-i", &rig.path("frames/%06d.png")])
        .args(["-c:v", "ffv1", "-pix_fmt", "bgr0", &rig.path(name)])
        .output()
        .expect("the tests need ffmpeg: scripts/install-packages test");
    assert!(made.status.success(), "{}", String::from_utf8_lossy(&made.stderr));
}

/// Every sample of a run as the network made it: number, time, poses.
fn poses(rig: &Rig, settings: &[&str]) -> Vec<(u64, u64, [[u64; 7]; 3])> {
    let arguments: Vec<&str> = settings.iter().flat_map(|setting| ["--set", setting]).collect();
    let _daemon =
        Daemon::start(rig, &[&["--set", "publish.wait_for_subscribers=1"], &arguments[..]].concat());
    let node = rig.node_when_up();
    let subscription = PoseSubscription::open(&node, &rig.camera()).unwrap();
    let mut found = Vec::new();
    loop {
        let sample: PoseSample = next(&subscription);
        match sample.reason {
            Reason::STARTING => {}
            Reason::SOURCE_ENDED => return found,
            _ => {
                let bits = |pose: &grnet_proto::PoseWithCovariance| {
                    let [x, y, z] = pose.translation_m;
                    let [i, j, k, w] = pose.quaternion_xyzw;
                    [x, y, z, i, j, k, w].map(f64::to_bits)
                };
                let poses = [&sample.map_from_base, &sample.odom_from_base, &sample.previous_from_current];
                found.push((sample.sequence, sample.capture_time_ns, poses.map(bits)));
            }
        }
    }
}

#[test]
fn a_lossless_video_gives_the_poses_of_its_images_bit_by_bit() {
    let rig = Rig::new(FRAMES);
    make_video(&rig, "v.avi");
    let folder = poses(&rig, &["source.rate_hz=30"]);
    assert_eq!(folder.len(), FRAMES as usize);
    let path = format!("source.path={}", rig.path("v.avi"));
    let video = ["source.kind=video", &path];
    assert_eq!(poses(&rig, &video), folder);

    rig.write("c.yaml", CALIBRATION);
    let calibrated = format!("source.calibration={}", rig.path("c.yaml"));
    let folder_calibrated = poses(&rig, &["source.rate_hz=30", &calibrated]);
    assert_ne!(folder_calibrated, folder, "frames are undistorted");
    assert_eq!(poses(&rig, &[&video[..], &[&calibrated]].concat()), folder_calibrated);
}

#[test]
fn check_tells_of_video_and_intrinsics_and_refuses_what_does_not_fit() {
    let rig = Rig::new(3);
    make_video(&rig, "v.avi");
    rig.write("c.yaml", CALIBRATION);
    rig.write("wide.yaml", &CALIBRATION.replace("64", "128"));
    rig.write("broken.yaml", &CALIBRATION.replace("plumb_bob", "magic"));
    let check = |settings: &[&str]| {
        let config = rig.config();
        let mut arguments = vec!["check", "--config", &config];
        settings.iter().for_each(|setting| arguments.extend(["--set", setting]));
        rig.run(&arguments)
    };
    let path = format!("source.path={}", rig.path("v.avi"));
    let ended = check(&["source.kind=video", &path, &format!("source.calibration={}", rig.path("c.yaml"))]);
    assert_eq!(ended.code, 0, "{}", ended.stderr);
    for expected in
        ["frames of 64x48", "ffv1", "to the end of the file", "f (60, 60.5) px, c (31.5, 23.5) px, PlumbBob"]
    {
        assert!(ended.stdout.contains(expected), "{expected}:\n{}", ended.stdout);
    }
    for (file, part) in [
        ("wide.yaml", "wide.yaml is for 128x48 images, those of"),
        ("broken.yaml", "broken.yaml, line 7: found distortion_model \"magic\""),
        ("none.yaml", "No such file"),
    ] {
        for kind in [&["source.kind=folder"][..], &["source.kind=video", &path]] {
            let calibration = format!("source.calibration={}", rig.path(file));
            let ended = check(&[kind, &[&calibration]].concat());
            assert!(ended.code == 78 && ended.stderr.contains(part), "{part}: {}", ended.stderr);
        }
    }
    let ended = check(&["source.kind=video", "source.path=/nowhere/v.avi"]);
    assert!(ended.code == 78 && ended.stderr.contains("/nowhere/v.avi"), "{}", ended.stderr);
    // The program is looked for in PATH.
    let ended = Command::new(env!("CARGO_BIN_EXE_grnetd"))
        .args(["check", "--config", &rig.config(), "--set", "source.kind=video", "--set", &path])
        .env("PATH", rig.path(""))
        .output()
        .unwrap();
    let said = String::from_utf8_lossy(&ended.stderr);
    assert!(ended.status.code() == Some(78) && said.contains("ffmpeg is not there: install it"), "{said}");
}

#[test]
fn ffmpeg_does_not_outlive_a_killed_daemon() {
    let rig = Rig::new(FRAMES);
    make_video(&rig, "v.avi");
    let path = format!("source.path={}", rig.path("v.avi"));
    let settings = ["--set", "source.kind=video", "--set", &path, "--set", "source.loop=true"];
    let mut daemon = Daemon::start(&rig, &[&settings[..], &["--set", "source.pace=realtime"]].concat());
    daemon.wait_for_line("frames arrive");
    let video = std::fs::canonicalize(rig.path("v.avi")).unwrap();
    let decoders = || {
        std::fs::read_dir("/proc").unwrap().map_while(Result::ok).any(|entry| {
            let program = std::fs::read_link(entry.path().join("exe")).unwrap_or_default();
            program.ends_with("ffmpeg")
                && std::fs::read_link(entry.path().join("fd/0")).is_ok_and(|input| input == video)
        })
    };
    daemon.signal(Signal::KILL);
    daemon.wait();
    let begin = Instant::now();
    while decoders() {
        assert!(begin.elapsed() < Duration::from_secs(20), "ffmpeg still runs");
        // Another's child has no event to wait for.
        std::thread::sleep(Duration::from_millis(5));
    }
}
