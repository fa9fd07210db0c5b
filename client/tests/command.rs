//! The command as a user meets it: what it prints, and how it ends.

mod common;

use std::{
    io::{BufRead as _, BufReader, Read as _},
    process::{Child, Command, Output, Stdio},
    time::{Duration, Instant},
};

use common::{Rig, SOON, wait_until};
use grnet_proto::{Node, PoseSubscription, StatusPublisher};
use rustix::process::{Pid, Signal, kill_process};

#[test]
#[ignore = "the daemon process of the other tests"]
fn daemon_process() {
    common::publish_for_ever();
}

fn command(rig: &Rig, arguments: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_grnet-client"));
    command
        .args(arguments)
        .env("GRNET_ROOT", rig.folder.path())
        .env("GRNET_PREFIX", rig.connection.root.prefix())
        .env_remove("GRNET_CAMERA")
        .stdin(Stdio::null());
    command
}

/// (exit code, standard output, standard error)
fn run(rig: &Rig, arguments: &[&str]) -> (Option<i32>, String, String) {
    let Output { status, stdout, stderr } = command(rig, arguments).output().unwrap();
    (status.code(), String::from_utf8(stdout).unwrap(), String::from_utf8(stderr).unwrap())
}

fn spawn(rig: &Rig, arguments: &[&str]) -> (Child, BufReader<std::process::ChildStdout>) {
    let mut child = command(rig, arguments).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    let out = BufReader::new(child.stdout.take().unwrap());
    (child, out)
}

/// (exit code, standard error) of a child that must end soon.
fn end(mut child: Child) -> (Option<i32>, String) {
    let start = Instant::now();
    let status = loop {
        if let Some(status) = child.try_wait().unwrap() {
            break status;
        }
        if start.elapsed() > SOON {
            child.kill().unwrap();
            panic!("the command did not end");
        }
        std::thread::sleep(Duration::from_millis(5));
    };
    let mut stderr = String::new();
    child.stderr.take().unwrap().read_to_string(&mut stderr).unwrap();
    (status.code(), stderr)
}

fn json(line: &str) -> serde_json::Value {
    serde_json::from_str(line).unwrap_or_else(|error| panic!("{error}: {line}"))
}

#[test]
fn without_a_daemon_one_line_names_the_remedy() {
    let rig = Rig::new();
    for arguments in [&["tail"][..], &["status"], &["tail", "--camera", "rear", "--timeout", "1"]] {
        let (code, out, error) = run(&rig, arguments);
        assert_eq!((code, &*out, error.lines().count()), (Some(69), "", 1), "{error}");
        assert!(error.contains("systemctl start grnetd"), "{error}");
    }
}

#[test]
fn usage_and_configuration_errors_have_their_codes() {
    let rig = Rig::new();
    for arguments in [
        &["tail", "--rate", "0"][..],
        &["tail", "--count", "0"],
        &["tail", "--timeout", "soon"],
        &["tail", "--format", "xml"],
        &["tail", "--json", "--format", "tum"],
        &["tail", "--camera", "a/b"],
        &["listen"],
        &[],
    ] {
        let (code, _, error) = run(&rig, arguments);
        assert_eq!(code, Some(2), "{arguments:?}: {error}");
    }
    let (code, _, error) = run(&rig, &["tail", "--root", "relative"]);
    assert_eq!(code, Some(78), "{error}");
    assert!(error.contains("relative") && error.contains("not absolute"), "{error}");
    assert_eq!(run(&rig, &["--help"]).0, Some(0));
}

#[test]
fn json_has_every_sample_once() {
    let rig = Rig::new();
    let _daemon = rig.daemon();
    let (code, out, error) = run(&rig, &["tail", "--json", "--count", "20"]);
    assert_eq!((code, &*error), (Some(0), ""));
    let samples: Vec<_> = out.lines().map(json).collect();
    assert_eq!(samples.len(), 20);
    for pair in samples.windows(2) {
        assert_eq!(pair[1]["sample"].as_u64().unwrap(), pair[0]["sample"].as_u64().unwrap() + 1);
        assert_eq!(pair[0]["boot_id"], pair[1]["boot_id"]);
    }
    let sample = &samples[0];
    assert_eq!((sample["status"].as_str(), sample["reason"].as_str()), (Some("TRACKING"), Some("NO_SCENE")));
    assert!(
        sample["map_from_base"].is_null()
            && sample["innovation_ratio"].is_null()
            && sample["scene"].is_null()
    );
    assert_eq!(sample["odom_from_base"]["translation_m"][1], 0.5);
    assert!(sample["odom_from_base"]["covariance"].is_null());
    assert_eq!(sample["latency_us"]["total"], 1000.0);
    assert!(sample["latency_us"]["infer"].is_null());
}

#[test]
fn the_table_has_a_header_and_no_colours_in_a_pipe() {
    let rig = Rig::new();
    let _daemon = rig.daemon();
    let (code, out, error) = run(&rig, &["tail", "--count", "3", "--rate", "20"]);
    assert_eq!((code, &*error), (Some(0), ""));
    let lines: Vec<_> = out.lines().collect();
    assert_eq!(lines.len(), 5, "{out}");
    assert!(lines[0].contains("map from base") && lines[1].contains("yaw deg"), "{out}");
    assert!(lines[2].contains("TRACKING") && lines[2].ends_with("NO_SCENE"), "{out}");
    assert!(!out.contains('\x1b'), "{out}");
}

#[test]
fn the_rate_is_kept() {
    let rig = Rig::new();
    let _daemon = rig.daemon();
    let (_, out, _) = run(&rig, &["tail", "--json", "--count", "6", "--rate", "10"]);
    let times: Vec<_> = out.lines().map(|line| json(line)["publish_time_ns"].as_u64().unwrap()).collect();
    let seconds = (times[5] - times[0]) as f64 / 1e9;
    assert!((0.45..5.0).contains(&seconds), "5 periods of 100 ms took {seconds} s");
}

#[test]
fn trajectories_read_back_and_unknown_poses_are_left_out() {
    use grnet_geometry::trajectory::{kitti, tum};
    let rig = Rig::new();
    let _daemon = rig.daemon();
    let file = rig.folder.path().join("out");

    let (code, out, error) = run(&rig, &["tail", "--format", "tum", "--pose", "odom", "--count", "5"]);
    assert_eq!((code, &*error), (Some(0), ""));
    let trajectory = tum::parse(&out, &file).unwrap();
    assert_eq!(trajectory.len(), 5);
    let now_s = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH).unwrap().as_secs() as i64;
    assert!((trajectory.poses()[0].time_ns / 1_000_000_000 - now_s).abs() < 60, "epoch time");

    let (_, out, _) = run(&rig, &["tail", "--format", "kitti", "--pose", "odom", "--count", "5"]);
    assert_eq!(kitti::parse(&out, &file).unwrap().len(), 5);

    let (code, out, error) = run(&rig, &["tail", "--format", "tum", "--timeout", "0.3"]);
    assert_eq!((code, &*out), (Some(75), ""), "{error}");
    assert!(error.contains("had no map pose and were not printed"), "{error}");

    let (_, out, _) = run(&rig, &["tail", "--format", "csv", "--count", "2"]);
    let columns: Vec<_> = out.lines().map(|line| line.split(',').count()).collect();
    assert!(columns.len() == 3 && columns.iter().all(|&count| count == columns[0]), "{out}");
    assert!(out.lines().nth(1).unwrap().contains(",NO_SCENE,,,,,,,,"), "{out}");
}

#[test]
fn a_silent_daemon_is_a_timeout() {
    let rig = Rig::new();
    let _publisher = rig.publisher();
    let (code, out, error) = run(&rig, &["tail", "--json", "--timeout", "0.2"]);
    assert_eq!((code, &*out, error.lines().count()), (Some(75), "", 1), "{error}");
    let (code, _, error) = run(&rig, &["status", "--timeout", "0.2"]);
    assert_eq!(code, Some(69), "the status service does not exist: {error}");
}

#[test]
fn the_state_is_readable_for_people_and_programs() {
    let rig = Rig::new();
    let _daemon = rig.daemon();
    let (code, out, error) = run(&rig, &["status", "--json"]);
    assert_eq!((code, &*error), (Some(0), ""));
    let status = json(&out);
    assert_eq!((status["health"].as_str(), status["access"].as_str()), (Some("OK"), Some("user")));
    assert!(status["capture_rate_hz"].is_null() && status["latency_us"]["infer"]["p50"].is_null());
    let (code, out, _) = run(&rig, &["status"]);
    assert_eq!(code, Some(0));
    assert!(
        out.starts_with(&format!("grnetd     {} on camera front: OK, up ", env!("CARGO_PKG_VERSION"))),
        "{out}"
    );
}

#[test]
fn a_reader_that_goes_away_is_no_error() {
    let rig = Rig::new();
    let _daemon = rig.daemon();
    let (child, mut out) = spawn(&rig, &["tail", "--json"]);
    out.read_line(&mut String::new()).unwrap();
    drop(out);
    assert_eq!(end(child), (Some(0), String::new()));
}

#[test]
fn signals_end_the_command_at_once_and_silently() {
    let rig = Rig::new();
    let daemon = rig.publisher();
    for signal in [Signal::INT, Signal::TERM] {
        let (child, out) = spawn(&rig, &["tail"]);
        wait_until("the command has attached", || daemon.subscribers() == 1);
        let start = Instant::now();
        kill_process(Pid::from_child(&child), signal).unwrap();
        assert_eq!(end(child), (Some(0), String::new()));
        assert!(start.elapsed() < Duration::from_secs(1), "{:?}", start.elapsed());
        drop(out);
        wait_until("its place is free", || daemon.subscribers() == 0);
    }
}

#[test]
fn a_signal_ends_the_wait_for_a_state() {
    let rig = Rig::new();
    let silent = StatusPublisher::open(&rig.node(), &rig.connection.camera).unwrap();
    let (child, _out) = spawn(&rig, &["status", "--timeout", "60"]);
    wait_until("the command has attached", || silent.subscribers() == 1);
    let start = Instant::now();
    kill_process(Pid::from_child(&child), Signal::INT).unwrap();
    let (code, error) = end(child);
    assert_eq!((code, error.lines().count()), (Some(75), 1), "{error}");
    assert!(start.elapsed() < Duration::from_secs(1), "{:?}", start.elapsed());
}

#[test]
fn a_restart_of_the_daemon_is_survived_and_announced() {
    let rig = Rig::new();
    let daemon = rig.daemon();
    let (child, mut out) = spawn(&rig, &["tail", "--json"]);
    let mut next_boot = || {
        let mut line = String::new();
        out.read_line(&mut line).unwrap();
        json(&line)["boot_id"].as_str().unwrap().to_owned()
    };
    let first = next_boot();
    daemon.kill();
    let _daemon = rig.daemon();
    let second = loop {
        let boot = next_boot();
        if boot != first {
            break boot;
        }
    };
    kill_process(Pid::from_child(&child), Signal::INT).unwrap();
    drop(out);
    let (code, error) = end(child);
    assert_eq!(code, Some(0));
    assert!(error.contains(&format!("the daemon restarted: boot {second} follows {first}")), "{error}");
}

#[test]
fn the_seventeenth_subscriber_is_told_so() {
    let rig = Rig::new();
    let _publisher = rig.publisher();
    let node: Node = rig.node();
    let _subscriptions: Vec<_> = (0..grnet_proto::qos::MAX_SUBSCRIBERS)
        .map(|_| PoseSubscription::open(&node, &rig.connection.camera).unwrap())
        .collect();
    let (code, _, error) = run(&rig, &["tail"]);
    assert_eq!((code, error.lines().count()), (Some(75), 1), "{error}");
    assert!(error.contains("already has 16 subscribers"), "{error}");
}

#[test]
fn another_user_is_told_whose_the_files_are() {
    use std::os::unix::process::CommandExt as _;
    if !rustix::process::geteuid().is_root() {
        eprintln!("skipped: only root can run the command as another user");
        return;
    }
    let rig = Rig::new();
    let _publisher = rig.publisher();
    // Reachable but not theirs, as /tmp/iceoryx2 is.
    let open = std::os::unix::fs::PermissionsExt::from_mode(0o755);
    std::fs::set_permissions(rig.folder.path(), open).unwrap();
    let copy = rig.folder.path().join("grnet-client");
    std::fs::copy(env!("CARGO_BIN_EXE_grnet-client"), &copy).unwrap();
    let output = Command::new(copy)
        .arg("tail")
        .env("GRNET_ROOT", rig.folder.path())
        .env("GRNET_PREFIX", rig.connection.root.prefix())
        .uid(65534)
        .gid(65534)
        .output()
        .unwrap();
    let error = String::from_utf8(output.stderr).unwrap();
    assert_eq!((output.status.code(), error.lines().count()), (Some(77), 1), "{error}");
    assert!(error.contains("belongs to user root (0)") && error.contains("(65534), who may not"), "{error}");
    assert!(error.contains("run as user root (0)") && error.contains("--root"), "{error}");
}
