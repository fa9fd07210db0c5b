//! A stock Python subscriber of iceoryx2, with the structures that the daemon's own declarations render.

use std::path::Path;
use std::process::Command;

use grnet_tests::{Process, Rig, venv_python};

#[test]
fn a_stock_python_subscriber_reads_the_same_samples() {
    let rig = Rig::new();
    let _daemon = rig.daemon(&["source.loop=true"]);
    let mut tail = rig.tail(&["--json"]);
    tail.json();
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("python/pose_tail.py");
    let mut command = Command::new(venv_python());
    command.arg(script).args(["--count", "5", "--prefix", "e2e_", "--root"]).arg(rig.transport_root());
    let mut python = Process::start(command);
    let received: Vec<_> = (0..5).map(|_| python.json()).collect();
    assert!(python.finish().1.success());
    for theirs in received.iter().filter(|sample| !sample["map_from_base"].is_null()) {
        let mut ours = tail.json();
        while ours["sample"].as_u64() < theirs["sample"].as_u64() {
            ours = tail.json();
        }
        for key in ["sample", "sequence", "boot_id", "status", "reason", "capture_time_ns"] {
            assert_eq!(ours[key], theirs[key], "{key}");
        }
        for key in ["translation_m", "quaternion_xyzw"] {
            assert_eq!(ours["map_from_base"][key], theirs["map_from_base"][key], "{key}");
        }
    }
    assert!(received.iter().any(|sample| !sample["map_from_base"].is_null()), "{received:?}");
}
