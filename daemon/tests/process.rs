//! The daemon as a process: exit codes, messages, a run to the end, signals.

mod rig;

use std::os::unix::net::UnixDatagram;
use std::time::{Duration, Instant};

use grnet_proto::{
    Command, ControlClient, ControlRequest, Outcome, PoseSubscription, Reason, Recording, SourceState,
    Status, StatusSubscription,
};
use rig::{Daemon, Rig};
use rustix::process::Signal;

fn next<M: grnet_proto::Message>(subscription: &grnet_proto::Subscription<M>) -> M {
    let deadline = Instant::now() + Duration::from_secs(30);
    loop {
        if let Some(message) = subscription.receive().unwrap() {
            return message;
        }
        let left = deadline.saturating_duration_since(Instant::now());
        assert!(!left.is_zero(), "nothing came within 30 s");
        subscription.wait(left).unwrap();
    }
}

#[test]
fn usage_errors_end_with_2_and_help_with_0() {
    let rig = Rig::new(0);
    assert_eq!(rig.run(&["run", "--no-such-flag"]).code, 2);
    assert_eq!(rig.run(&["fly"]).code, 2);
    let version = rig.run(&["--version"]);
    assert_eq!((version.code, version.stdout.trim()), (0, concat!("grnetd ", env!("CARGO_PKG_VERSION"))));
    assert!(rig.run(&["--help"]).stdout.contains("77 no permission"));
}

#[test]
fn configuration_errors_end_with_78_and_name_key_and_line() {
    let rig = Rig::new(0);
    rig.write("bad.toml", "[publish]\n\ncreation_timeout = 20\n");
    let bad = rig.path("bad.toml");
    for command in ["run", "check"] {
        let ended = rig.run(&[command, "--config", &bad]);
        assert_eq!(ended.code, 78);
        assert!(
            ended.stderr.contains("bad.toml:3:1: unknown key `publish.creation_timeout`"),
            "{}",
            ended.stderr
        );
        assert!(ended.stderr.contains("creation_timeout_ms"), "{}", ended.stderr);
        assert_eq!(ended.stderr.lines().count(), 1, "{}", ended.stderr);
    }
    let ended = rig.run(&["run", "--config", "/nowhere/g.toml"]);
    assert!(ended.code == 78 && ended.stderr.contains("/nowhere/g.toml"), "{}", ended.stderr);
    let ended = rig.run(&["run", "--config", &rig.config(), "--set", "source.pase=max"]);
    assert!(ended.code == 78 && ended.stderr.contains("override `source.pase=max`"), "{}", ended.stderr);
}

#[test]
fn what_cannot_be_loaded_ends_with_78_and_is_named() {
    let rig = Rig::new(2);
    for command in ["run", "check"] {
        let ended = rig.run(&[
            command,
            "--config",
            &rig.config(),
            "--set",
            "model.checkpoint=/nowhere/m.safetensors",
        ]);
        assert!(ended.code == 78 && ended.stderr.contains("/nowhere/m.safetensors"), "{}", ended.stderr);
        let ended = rig.run(&[command, "--config", &rig.config(), "--set", "source.path=/nowhere/frames"]);
        assert!(ended.code == 78 && ended.stderr.contains("/nowhere/frames"), "{}", ended.stderr);
    }
    let whole = std::fs::read(rig.path("model.safetensors")).unwrap();
    std::fs::write(rig.path("cut.safetensors"), &whole[..whole.len() / 2]).unwrap();
    let cut = format!("model.checkpoint={}", rig.path("cut.safetensors"));
    let ended = rig.run(&["run", "--config", &rig.config(), "--set", &cut]);
    assert!(ended.code == 78 && ended.stderr.contains("cut.safetensors"), "{}", ended.stderr);
}

#[test]
fn a_camera_that_does_not_fit_ends_with_78() {
    let rig = Rig::new(2);
    let intrinsics = "[source.intrinsics]\nwidth_px = 640\nheight_px = 480\nfx_px = 500\nfy_px = 500\ncx_px = 320\n\
                      cy_px = 240\ndistortion = 'none'\ncoefficients = []\n";
    rig.write("intrinsics.toml", &(rig.config_text() + intrinsics));
    let ended = rig.run(&["run", "--config", &rig.path("intrinsics.toml")]);
    assert!(ended.code == 78 && ended.stderr.contains("640x480"), "{}", ended.stderr);
}

#[test]
fn check_says_what_would_run_and_starts_nothing() {
    let rig = Rig::new(3);
    let ended = rig.run(&["check", "--config", &rig.config()]);
    assert_eq!(ended.code, 0, "{}", ended.stderr);
    for expected in [
        "grnet/front/pose",
        "NOT TRAINED",
        "model.safetensors",
        "3 frames",
        "OnDemand",
        "shared memory",
        "can run",
    ] {
        assert!(ended.stdout.contains(expected), "{expected}:\n{}", ended.stdout);
    }
    assert!(!rig.root().join("services").exists());
}

#[test]
fn a_recording_runs_to_its_end_without_a_loss() {
    let rig = Rig::new(12);
    let mut daemon = Daemon::start(&rig, &["--set", "publish.wait_for_subscribers=1"]);
    let node = rig.node_when_up();
    let statuses = rig.open_status(&node);
    let poses = PoseSubscription::open(&node, &rig.camera()).unwrap();

    let mut sequences = Vec::new();
    let last = loop {
        let sample = next(&poses);
        if sample.reason == Reason::SOURCE_ENDED {
            break sample;
        }
        if sample.reason == Reason::STARTING {
            assert!(!sample.odom_from_base.is_known() && sample.status == Status::INITIALIZING);
            continue;
        }
        sequences.push(sample.sequence);
        assert!(
            sample.status == Status::INITIALIZING || sample.reason == Reason::UNTRAINED_MODEL,
            "{sample:?}"
        );
        assert!(sample.odom_from_base.is_known() && sample.map_from_base.is_known());
        // Nobody calibrated the uncertainty of an untrained network.
        assert!(sample.map_from_base.covariance_upper.iter().all(|value| value.is_nan()));
        assert!(sample.latency.infer_us > 0.0 && sample.latency.total_us.is_nan());
        assert_eq!(sample.dropped_frames, 0);
    };
    assert_eq!(sequences, (0..12).collect::<Vec<u64>>());
    assert!(last.status == Status::SOURCE_LOST && !last.map_from_base.is_known());

    let ended = daemon.wait();
    assert_eq!(ended.code, 0, "{}", ended.stderr);
    assert!(
        ended.stderr.contains("12 frames processed of 12 captured, 0 dropped, 0 bad"),
        "{}",
        ended.stderr
    );
    let mut status = next(&statuses);
    while let Some(newer) = statuses.receive().unwrap() {
        status = newer;
    }
    assert_eq!((status.processed_frames, status.source_state), (12, SourceState::ENDED));
    assert!(status.latency.infer.p50_us > 0.0, "{:?}", status.latency);
}

#[test]
fn bad_frames_are_counted_and_left_out() {
    let rig = Rig::new(6);
    std::fs::write(rig.path("frames/000002.png"), b"no image").unwrap();
    let whole = std::fs::read(rig.path("frames/000004.png")).unwrap();
    std::fs::write(rig.path("frames/000004.png"), &whole[..whole.len() / 2]).unwrap();
    let ended = Daemon::start(&rig, &[]).wait();
    assert_eq!(ended.code, 0, "{}", ended.stderr);
    assert!(ended.stderr.contains("4 frames processed of 4 captured, 0 dropped, 2 bad"), "{}", ended.stderr);
    assert!(ended.stderr.contains("000002.png"), "{}", ended.stderr);
}

#[test]
fn a_signal_ends_the_daemon_within_a_second() {
    for (signal, name) in [(Signal::TERM, "SIGTERM"), (Signal::INT, "SIGINT")] {
        let rig = Rig::new(4);
        // Slow motion: frame intervals of half a minute, so that every thread waits.
        let mut daemon =
            Daemon::start(&rig, &["--set", "source.pace=0.001", "--set", "source.silence_ms=60000"]);
        let node = rig.node_when_up();
        let poses = PoseSubscription::open(&node, &rig.camera()).unwrap();
        while next(&poses).sequence != 0 {}
        daemon.signal(signal);
        let signalled = Instant::now();
        let ended = daemon.wait();
        assert!(signalled.elapsed() < Duration::from_secs(1), "{:?}", signalled.elapsed());
        assert_eq!(ended.code, 0, "{}", ended.stderr);
        assert!(ended.stderr.contains(name), "{}", ended.stderr);
        assert_eq!(next(&poses).reason, Reason::STOPPING);
    }
}

#[test]
fn a_silent_source_is_lost_at_once_and_never_shows_a_stale_pose() {
    let rig = Rig::new(4);
    let _daemon = Daemon::start(&rig, &["--set", "source.pace=0.001", "--set", "source.silence_ms=200"]);
    let node = rig.node_when_up();
    let poses = PoseSubscription::open(&node, &rig.camera()).unwrap();
    while next(&poses).sequence != 0 {}
    for _ in 0..3 {
        let sample = next(&poses);
        assert_eq!((sample.status, sample.reason), (Status::SOURCE_LOST, Reason::SOURCE_LOST));
        assert!(!sample.odom_from_base.is_known());
    }
    let late = PoseSubscription::open(&node, &rig.camera()).unwrap();
    assert_eq!(next(&late).status, Status::SOURCE_LOST);
}

#[test]
fn a_second_daemon_of_the_same_name_is_refused_with_the_process_id() {
    let rig = Rig::new(4);
    let daemon = Daemon::start(&rig, &["--set", "publish.wait_for_subscribers=16"]);
    let _node = rig.node_when_up();
    let ended = rig.run(&["run", "--config", &rig.config()]);
    assert_eq!(ended.code, 69, "{}", ended.stderr);
    let expected =
        format!("camera name front (camera.name) is in use by the grnetd with process id {}", daemon.id());
    assert!(ended.stderr.contains(&expected), "{}", ended.stderr);
}

#[test]
fn control_requests_are_answered() {
    let rig = Rig::new(8);
    let _daemon =
        Daemon::start(&rig, &["--set", "source.loop=true", "--set", "publish.wait_for_subscribers=1"]);
    let node = rig.node_when_up();
    let mut control = rig.open_control(&node);
    let poses = PoseSubscription::open(&node, &rig.camera()).unwrap();
    let mut call = |request: ControlRequest| {
        let reply = ControlClient::call(&mut control, &request, Duration::from_secs(20)).unwrap();
        (reply.outcome, reply.message.to_string(), reply.status)
    };
    while next(&poses).sequence > 1 << 40 {}

    let (outcome, _, status) = call(ControlRequest::new(Command::STATUS));
    assert!(outcome == Outcome::DONE && status.loaded_scenes().len() == 1, "{:?}", status.loaded_scenes());
    let epoch = status.reset_epoch;
    assert_eq!(call(ControlRequest::new(Command::RESET_ODOMETRY)).0, Outcome::DONE);
    while next(&poses).reset_epoch != epoch + 1 {}

    assert_eq!(call(ControlRequest::new(Command::PAUSE)).0, Outcome::DONE);
    while next(&poses).reason != Reason::PAUSED {}
    assert_eq!(next(&poses).reason, Reason::PAUSED);
    assert_eq!(call(ControlRequest::new(Command::RESUME)).0, Outcome::DONE);
    while !next(&poses).odom_from_base.is_known() {}

    let here = ControlRequest::set_pose([1.0, 2.0, 3.0], [0.0, 0.0, 0.0, 1.0]);
    assert_eq!(call(here).0, Outcome::DONE);
    let (outcome, message, _) = call(ControlRequest::new(Command::SET_POSE));
    assert!(outcome == Outcome::INVALID && message.contains("not finite"), "{message}");
    let (outcome, message, _) =
        call(ControlRequest::with_text(Command::START_RECORDING, "relative/folder").unwrap());
    assert!(outcome == Outcome::INVALID && message.contains("not an absolute path"), "{message}");
    let folder = rig.path("recorded");
    let (outcome, message, status) =
        call(ControlRequest::with_text(Command::START_RECORDING, &folder).unwrap());
    assert!(outcome == Outcome::DONE && status.recording == Recording::ON, "{message}");
    while !std::fs::read_to_string(format!("{folder}/rgb.txt")).unwrap().contains("rgb/") {
        next(&poses);
    }
    let (outcome, message, status) = call(ControlRequest::new(Command::STOP_RECORDING));
    assert!(outcome == Outcome::DONE && status.recording == Recording::OFF, "{message}");
    assert!(message.contains("frames recorded in"), "{message}");
    let (outcome, message, _) = call(ControlRequest::new(Command::NONE));
    assert!(outcome == Outcome::INVALID && message.contains("no command"), "{message}");
}

#[test]
fn scenes_change_while_frames_flow_and_unfit_ones_change_nothing() {
    let rig = Rig::new(8);
    rig.save_scene("other.safetensors", 1, 2, "other");
    rig.save_scene("stranger.safetensors", 9, 9, "stranger");
    let _daemon = Daemon::start(&rig, &["--set", "source.loop=true"]);
    let node = rig.node_when_up();
    let mut control = rig.open_control(&node);
    let statuses = StatusSubscription::open(&node, &rig.camera()).unwrap();
    let mut call = |command, text: &str| {
        let request = ControlRequest::with_text(command, text).unwrap();
        let reply = control.call(&request, Duration::from_secs(20)).unwrap();
        (reply.outcome, reply.message.to_string(), reply.status)
    };
    let before = next(&statuses).model_hash;

    let (outcome, message, status) = call(Command::LOAD_SCENE, &rig.path("stranger.safetensors"));
    assert!(outcome == Outcome::FAILED && message.contains("stranger.safetensors"), "{message}");
    assert_eq!((status.model_hash, status.loaded_scenes().len()), (before, 1));
    rig.save_misshapen_scene("misshapen.safetensors", 1, "misshapen");
    let (outcome, message, status) = call(Command::LOAD_SCENE, &rig.path("misshapen.safetensors"));
    assert!(outcome == Outcome::FAILED && message.contains("misshapen.safetensors"), "{message}");
    assert!(message.contains("differ in"), "{message}");
    assert_eq!((status.model_hash, status.loaded_scenes().len()), (before, 1));
    assert_eq!(call(Command::LOAD_SCENE, "relative.safetensors").0, Outcome::INVALID);
    assert_eq!(call(Command::SELECT_SCENE, "other").0, Outcome::REFUSED);

    assert_eq!(call(Command::LOAD_SCENE, &rig.path("other.safetensors")).0, Outcome::DONE);
    let (outcome, message, status) = call(Command::SELECT_SCENE, "other");
    assert_eq!(outcome, Outcome::DONE, "{message}");
    assert!(status.scene_in_use().is_some_and(|scene| scene.name == "other") && status.model_hash != before);
    let (outcome, message, status) = call(Command::UNLOAD_SCENE, "other");
    assert_eq!((outcome, status.model_hash), (Outcome::DONE, before), "{message}");
    assert_eq!(status.loaded_scenes().len(), 1);
}

#[test]
fn the_service_manager_is_told_and_fed() {
    let rig = Rig::new(4);
    let socket = UnixDatagram::bind(rig.path("notify")).unwrap();
    socket.set_read_timeout(Some(Duration::from_secs(30))).unwrap();
    let environment = [("NOTIFY_SOCKET", rig.path("notify")), ("WATCHDOG_USEC", "2000000".into())];
    let mut daemon = Daemon::start_with(&rig, &["--set", "source.loop=true"], &environment);
    let until = |expected: &str| {
        let mut seen = String::new();
        let mut message = [0; 4096];
        while !seen.contains(expected) {
            let length =
                socket.recv(&mut message).unwrap_or_else(|error| panic!("{error}, no {expected} in {seen}"));
            seen += std::str::from_utf8(&message[..length]).unwrap();
        }
        seen
    };
    let start = until("READY=1");
    assert!(start.contains("STATUS=loading the model"), "{start}");
    until("WATCHDOG=1");
    daemon.signal(Signal::HUP);
    assert!(until("READY=1").contains("RELOADING=1\nMONOTONIC_USEC="));
    daemon.signal(Signal::TERM);
    until("STOPPING=1");
    assert_eq!(daemon.wait().code, 0);
}

#[test]
fn a_stopped_and_continued_daemon_goes_on() {
    let rig = Rig::new(4);
    let mut daemon = Daemon::start(&rig, &["--set", "source.loop=true"]);
    let node = rig.node_when_up();
    let poses = PoseSubscription::open(&node, &rig.camera()).unwrap();
    while !next(&poses).odom_from_base.is_known() {}
    daemon.signal(Signal::STOP);
    // Stopped when what was on the way has arrived.
    while poses.receive().unwrap().is_some() || poses.wait(Duration::from_millis(200)).unwrap() {}
    daemon.signal(Signal::CONT);
    while !next(&poses).odom_from_base.is_known() {}
    daemon.signal(Signal::TERM);
    assert_eq!(daemon.wait().code, 0);
}

#[test]
fn journal_lines_have_a_priority_and_no_time() {
    let rig = Rig::new(2);
    let ended = Daemon::start(&rig, &["--set", "log.format=journald"]).wait();
    assert_eq!(ended.code, 0, "{}", ended.stderr);
    assert!(
        ended.stderr.lines().all(|line| line.starts_with("<6>") || line.starts_with("<4>")),
        "{}",
        ended.stderr
    );
    let ended = Daemon::start(&rig, &["--set", "log.format=json"]).wait();
    assert!(ended.stderr.lines().all(|line| line.starts_with("{\"timestamp\"")), "{}", ended.stderr);
}
