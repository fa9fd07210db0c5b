//! Frames in, poses out: daemon and clients as processes.

use grnet_tests::{Rig, shared_files};
use rustix::process::Signal;
use serde_json::Value;

fn number(value: &Value, key: &str) -> u64 {
    value[key].as_u64().unwrap_or_else(|| panic!("{key} is {} in {value}", value[key]))
}

fn numbers(value: &Value) -> Vec<f64> {
    value
        .as_array()
        .unwrap_or_else(|| panic!("{value} is no list"))
        .iter()
        .map(|v| v.as_f64().unwrap())
        .collect()
}

#[test]
fn another_process_receives_every_part_of_the_pose() {
    let rig = Rig::new();
    let mut daemon = rig.daemon(&["source.loop=true"]);
    daemon.stderr_line_with("source");
    let mut tail = rig.tail(&["--json", "--count", "12"]);
    let samples: Vec<Value> = (0..12).map(|_| tail.json()).collect();
    let (_, status, _) = tail.finish();
    assert!(status.success());

    for pair in samples.windows(2) {
        assert_eq!(pair[0]["boot_id"], pair[1]["boot_id"]);
        assert_eq!(number(&pair[0], "sample") + 1, number(&pair[1], "sample"), "no sample is lost");
        assert!(number(&pair[0], "publish_time_ns") <= number(&pair[1], "publish_time_ns"));
    }
    let posed: Vec<&Value> = samples.iter().filter(|s| !s["map_from_base"].is_null()).collect();
    assert!(posed.len() >= 8, "{} of 12 samples have a pose", posed.len());
    for sample in &posed {
        assert_eq!(sample["capture_clock"], "MONOTONIC");
        assert!(number(sample, "capture_time_ns") < number(sample, "publish_time_ns"));
        for pose in ["map_from_base", "odom_from_base"] {
            let quaternion = numbers(&sample[pose]["quaternion_xyzw"]);
            let norm: f64 = quaternion.iter().map(|q| q * q).sum();
            assert!((norm - 1.0).abs() < 1e-9 && quaternion[3] >= 0.0, "{sample}");
        }
        assert_eq!(sample["map_from_base"]["covariance"], Value::Null, "nobody trained a covariance");
        assert!(sample["latency_us"]["infer"].as_f64().unwrap() > 0.0);
    }
    let settled = posed.last().unwrap();
    assert_eq!((&settled["status"], &settled["reason"]), (&"DEGRADED".into(), &"UNTRAINED_MODEL".into()));
    assert_ne!(settled["linear_velocity_in_base_mps"], Value::Null);
}

#[test]
fn a_recording_as_fast_as_possible_loses_nothing_and_repeats_itself_bit_by_bit() {
    let run = || {
        let rig = Rig::new();
        let daemon =
            rig.daemon(&["source.pace=\"max\"", "publish.wait_for_subscribers=1", "source.frame_limit=40"]);
        let mut tail = rig.tail(&["--json", "--timeout", "30"]);
        let mut poses = Vec::new();
        loop {
            let sample = tail.json();
            if sample["reason"] == "SOURCE_ENDED" {
                break;
            }
            if sample["sequence"].is_null() {
                continue;
            }
            assert_eq!(
                (&sample["capture_clock"], &sample["latency_us"]["total"]),
                (&"RECORDED".into(), &Value::Null)
            );
            assert_eq!(number(&sample, "dropped_frames"), 0);
            poses.push((
                number(&sample, "sequence"),
                sample["map_from_base"].to_string(),
                sample["odom_from_base"].to_string(),
            ));
        }
        tail.signal(Signal::TERM);
        let (_, status, stderr) = daemon.finish();
        assert!(status.success(), "{stderr}");
        poses
    };
    let first = run();
    assert_eq!(first.iter().map(|(sequence, ..)| *sequence).collect::<Vec<_>>(), (0..40).collect::<Vec<_>>());
    assert_eq!(first, run());
}

#[test]
fn trajectories_are_what_public_tools_read() {
    let rig = Rig::new();
    let _daemon = rig.daemon(&["source.loop=true"]);
    for (format, columns) in [("tum", 8), ("kitti", 12)] {
        let mut tail = rig.tail(&["--format", format, "--pose", "odom", "--count", "3"]);
        for _ in 0..3 {
            let line = tail.line();
            let values: Vec<f64> = line.split(' ').map(|v| v.parse().unwrap()).collect();
            assert_eq!(values.len(), columns, "{line}");
            assert!(values.iter().all(|v| v.is_finite()), "{line}");
        }
        assert!(tail.finish().1.success());
    }
    let mut csv = rig.tail(&["--format", "csv", "--count", "2"]);
    let header = csv.line();
    assert_eq!(header.split(',').count(), csv.line().split(',').count(), "{header}");
    let mut table = rig.tail(&["--count", "2"]);
    assert!(table.line().contains("status"));
}

#[test]
fn the_status_tells_what_runs() {
    let rig = Rig::new();
    let daemon = rig.daemon(&["source.loop=true"]);
    // The first sample says that the daemon is up.
    rig.tail(&["--json", "--count", "1"]).json();
    let status = rig.client(&["status", "--json"]).json();
    assert_eq!(number(&status, "pid"), u64::from(daemon.id()));
    assert_eq!((&status["camera"], &status["access"]), (&"front".into(), &"user".into()));
    assert_eq!(status["provenance"], "UNTRAINED");
    let (text, exit, _) = rig.client(&["status"]).finish();
    assert!(exit.success() && text.iter().any(|line| line.contains("UNTRAINED")), "{text:#?}");
}

#[test]
fn many_clients_are_served_and_the_seventeenth_is_told_why_not() {
    let rig = Rig::new();
    let _daemon = rig.daemon(&["source.loop=true"]);
    let mut clients: Vec<_> = (0..16)
        .map(|_| {
            let mut client = rig.tail(&["--json"]);
            client.json();
            client
        })
        .collect();
    let (_, status, stderr) = rig.tail(&["--json"]).finish();
    assert_eq!(status.code(), Some(75), "{stderr}");
    assert!(stderr.contains("16") && stderr.lines().count() == 1, "{stderr}");
    for client in &mut clients {
        client.json();
    }
}

#[test]
fn a_client_links_no_network() {
    let client = std::fs::read(grnet_tests::program("grnet-client")).unwrap();
    let daemon = std::fs::read(grnet_tests::program("grnetd")).unwrap();
    let has =
        |bytes: &[u8]| bytes.windows(11).any(|window| window == b"candle-core" || window == b"candle_core");
    assert!(has(&daemon), "the needle is not what the linker leaves");
    assert!(!has(&client));
    assert!(shared_files().is_dir());
}
