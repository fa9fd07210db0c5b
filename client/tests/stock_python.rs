//! A stock iceoryx2 client in another language reads the memory as this build wrote it.

mod common;

use std::{
    path::{Path, PathBuf},
    process::{Command, Stdio},
};

use common::Rig;

/// A Python with iceoryx2 0.10: `GRNET_PYTHON`, the one that `make test` prepares, or the system's.
fn python() -> Option<PathBuf> {
    let target = Path::new(env!("CARGO_BIN_EXE_grnet-client")).ancestors().nth(2)?;
    let candidates = [
        std::env::var_os("GRNET_PYTHON").map(PathBuf::from),
        Some(target.join("venv/bin/python")),
        Some(PathBuf::from("python3")),
    ];
    candidates.into_iter().flatten().find(|python| {
        Command::new(python)
            .args(["-c", "import iceoryx2"])
            .stderr(Stdio::null())
            .stdout(Stdio::null())
            .status()
            .is_ok_and(|status| status.success())
    })
}

#[test]
#[ignore = "the daemon process of the other tests"]
fn daemon_process() {
    common::publish_for_ever();
}

#[test]
fn python_reads_what_rust_wrote() {
    let Some(python) = python() else {
        eprintln!("skipped: no Python with the package iceoryx2 0.10; set GRNET_PYTHON or run `make test`");
        return;
    };
    let rig = Rig::new();
    let _daemon = rig.daemon();
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/python/pose_tail.py");
    let arguments = |camera: &str| {
        let mut command = Command::new(&python);
        command.arg(&script).args([
            "--count",
            "5",
            "--camera",
            camera,
            "--prefix",
            &rig.connection.root.prefix(),
        ]);
        command.arg("--root").arg(rig.folder.path());
        command.output().unwrap()
    };
    let output = arguments("front");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let samples: Vec<serde_json::Value> = output
        .stdout
        .split(|&byte| byte == b'\n')
        .filter_map(|line| serde_json::from_slice(line).ok())
        .collect();
    assert_eq!(samples.len(), 5);
    let first = samples[0]["sequence"].as_u64().unwrap();
    for (offset, sample) in (0..).zip(&samples) {
        let sequence = first + offset;
        assert_eq!(sample["sequence"], sequence);
        assert_eq!(sample["sample"], sequence + 1);
        assert_eq!((sample["schema_version"].as_u64(), sample["camera"].as_str()), (Some(1), Some("front")));
        assert_eq!(
            (sample["status"].as_str(), sample["reason"].as_str()),
            (Some("TRACKING"), Some("NO_SCENE"))
        );
        assert_eq!(sample["odom_from_base"]["translation_m"][0], sequence as f64);
        assert_eq!(sample["odom_from_base"]["quaternion_xyzw"][3], 1.0);
        assert!(sample["map_from_base"].is_null() && sample["odom_from_base"]["covariance_upper"].is_null());
        let latency =
            sample["publish_time_ns"].as_u64().unwrap() - sample["capture_time_ns"].as_u64().unwrap();
        assert_eq!(latency, 1_000_000);
    }
    assert_eq!(arguments("rear").status.code(), Some(69));
}
