//! The full-size network over real camera frames. Needs recordings that are not in this repository.

use std::path::Path;
use std::process::Command;

use grnet_tests::{Rig, data_folder, program};

fn stream(name: &str, recording: impl FnOnce(&Path) -> std::path::PathBuf, frames: u64) {
    let Some(data) = data_folder() else {
        println!("skipped {name}: no recordings in GRNET_DATA or ../shared/data");
        return;
    };
    let rig = Rig::with_recording(&recording(&data));
    let checkpoint = rig.folder().join("grnet.safetensors");
    let made = Command::new(program("grnet-train"))
        .args(["init", "--preset", "grnet", "--seed", "1", "--out"])
        .arg(&checkpoint)
        .output()
        .unwrap();
    assert!(made.status.success(), "{}", String::from_utf8_lossy(&made.stderr));
    let rig = rig.with_checkpoint(&checkpoint);
    let limit = format!("source.frame_limit={frames}");
    let daemon = rig.daemon(&["source.pace=\"max\"", "publish.wait_for_subscribers=1", &limit]);
    let mut tail = rig.tail(&["--json"]);
    let mut posed = 0;
    loop {
        let sample = tail.json();
        if sample["reason"] == "SOURCE_ENDED" {
            break;
        }
        posed += u64::from(!sample["map_from_base"].is_null());
    }
    assert_eq!(posed, frames);
    let (_, status, stderr) = daemon.finish();
    assert!(status.success(), "{stderr}");
}

#[test]
fn data_redkitchen_streams_through_the_full_size_network() {
    stream("redkitchen", |data| data.join("redkitchen/seq-01"), 6);
}

#[test]
fn data_kitti_streams_through_the_full_size_network() {
    stream("kitti", |data| data.join("kitti/sequences/06"), 6);
}
