//! The bytes of every message and its Python twin are as committed. After a change on purpose (and a
//! new schema version) run the tests once with `GRNET_BLESS=1`.

use std::{fs, path::PathBuf};

use grnet_proto::{
    Access, BootId, CaptureClock, Command, ContentHash, ControlReply, ControlRequest, DaemonStatus,
    FixedText, Health, LatencyPercentiles, Outcome, PoseSample, PoseWithCovariance, Provenance, Reason,
    Recording, SceneInfo, SourceState, StageLatency, StagePercentiles, Status, python,
};

fn compare(path: &str, actual: &[u8]) {
    let path = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join(path);
    if std::env::var_os("GRNET_BLESS").is_some() {
        fs::write(&path, actual).unwrap();
    }
    let committed = fs::read(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
    if let Some(index) = (0..committed.len().max(actual.len())).find(|&i| committed.get(i) != actual.get(i)) {
        panic!(
            "{} differs from byte {index} on ({} bytes committed, {} now): raise the schema version, then run with GRNET_BLESS=1",
            path.display(),
            committed.len(),
            actual.len()
        );
    }
}

fn pose(first: f64) -> PoseWithCovariance {
    PoseWithCovariance {
        translation_m: [first + 0.25, first + 0.5, first + 0.75],
        quaternion_xyzw: [0.5, -0.5, 0.5, 0.5],
        covariance_upper: std::array::from_fn(|i| first + i as f64),
    }
}

fn sample() -> PoseSample {
    PoseSample {
        schema_version: 1,
        status: Status::DEGRADED,
        reason: Reason::UNTRAINED_MODEL,
        capture_clock: CaptureClock::MONOTONIC,
        boot_id: BootId(std::array::from_fn(|i| i as u8 + 1)),
        model_hash: ContentHash([0xA5; 32]),
        scene_hash: ContentHash([0x5A; 32]),
        scene: FixedText::new("kitchen"),
        camera: FixedText::new("front"),
        sample: 0x0102_0304_0506_0708,
        sequence: 42,
        capture_time_ns: 1_000_000_001,
        publish_time_ns: 1_000_000_002,
        realtime_offset_ns: -3,
        dropped_frames: 4,
        reset_epoch: 5,
        landmark_inliers: 6,
        latency: StageLatency {
            wait_us: 1.5,
            preprocess_us: 2.5,
            infer_us: 3.5,
            fuse_us: 4.5,
            publish_us: 5.5,
            total_us: 6.5,
        },
        map_from_base: pose(100.0),
        odom_from_base: pose(200.0),
        previous_from_current: pose(300.0),
        network_map_from_base: pose(400.0),
        linear_velocity_in_base_mps: [1.0, 2.0, 3.0],
        angular_velocity_in_base_radps: [4.0, 5.0, 6.0],
        innovation_ratio: 0.125,
        reserved: [0; 7],
    }
}

fn status() -> DaemonStatus {
    let stage = |first: f32| StagePercentiles {
        p50_us: first,
        p90_us: first + 1.0,
        p99_us: first + 2.0,
        max_us: first + 3.0,
    };
    let mut scenes = [SceneInfo::NONE; 8];
    scenes[0] = SceneInfo { name: FixedText::new("kitchen"), hash: ContentHash([1; 32]) };
    scenes[7] = SceneInfo { name: FixedText::new("cellar"), hash: ContentHash([2; 32]) };
    DaemonStatus {
        schema_version: 1,
        health: Health::DEGRADED,
        source_state: SourceState::STREAMING,
        provenance: Provenance::UNTRAINED,
        access: Access::USER,
        recording: Recording::ON,
        pid: 4711,
        subscribers: 3,
        boot_id: BootId([9; 16]),
        model_hash: ContentHash([0xA5; 32]),
        model: FixedText::new("grnet.safetensors"),
        version: FixedText::new("0.1.0"),
        camera: FixedText::new("front"),
        source: FixedText::new("/dev/video0"),
        recording_path: FixedText::new("/var/lib/grnet/run.mcap"),
        sample: 11,
        publish_time_ns: 12,
        realtime_offset_ns: -13,
        uptime_ns: 14,
        captured_frames: 15,
        processed_frames: 16,
        published_samples: 17,
        dropped_frames: 18,
        bad_frames: 19,
        refused_frames: 20,
        capture_rate_hz: 29.5,
        publish_rate_hz: 28.5,
        reset_epoch: 21,
        active_scene: 7,
        latency: LatencyPercentiles {
            wait: stage(10.0),
            preprocess: stage(20.0),
            infer: stage(30.0),
            fuse: stage(40.0),
            publish: stage(50.0),
            total: stage(60.0),
        },
        scenes,
        error_count: 22,
        last_error_time_ns: 23,
        last_error: FixedText::new("camera unplugged"),
        reserved: [0; 7],
    }
}

#[test]
fn pose_sample_bytes() {
    compare("tests/golden/pose_sample.v1.bin", &sample().to_bytes());
}

#[test]
fn daemon_status_bytes() {
    compare("tests/golden/daemon_status.v1.bin", &status().to_bytes());
}

#[test]
fn control_bytes() {
    let mut request = ControlRequest::set_pose([1.0, 2.0, 3.0], [0.0, 0.0, 0.0, 1.0]);
    request.request_id = 77;
    request.text = FixedText::new("text");
    assert_eq!(request.command, Command::SET_POSE);
    compare("tests/golden/control_request.v1.bin", &request.to_bytes());
    let reply = ControlReply::new(&request, Outcome::REFUSED, "no scene is loaded", status());
    compare("tests/golden/control_reply.v1.bin", &reply.to_bytes());
}

/// Where a field lies in the bytes is where the layout table (and with it the Python twin) says.
#[test]
fn the_layout_table_finds_the_fields() {
    let bytes = sample().to_bytes();
    let layout = PoseSample::layout();
    let field = |name: &str| layout.fields.iter().find(|field| field.name == name).unwrap();
    let at = |name: &str| &bytes[field(name).offset..field(name).offset + field(name).size];
    assert_eq!(at("sample"), 0x0102_0304_0506_0708_u64.to_le_bytes());
    assert_eq!(at("innovation_ratio"), 0.125_f64.to_le_bytes());
    assert_eq!(at("camera")[..6], *b"front\0");
    assert_eq!(at("map_from_base")[..8], 100.25_f64.to_le_bytes());
    let mut end = 0;
    for field in &layout.fields {
        assert_eq!(field.offset, end, "{} leaves a gap", field.name);
        end += field.size;
    }
    assert_eq!(end, layout.size);
}

#[test]
fn the_python_module_is_current() {
    compare("../tests/python/grnet_messages.py", python::module().as_bytes());
}
