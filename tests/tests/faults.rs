//! The fault contract: every promise is tested by injecting its fault.

use std::fs;
use std::process::Command;
use std::time::Duration;

use grnet_tests::{Process, Rig, program};
use rustix::process::Signal;

#[test]
fn clients_go_on_when_the_daemon_is_killed_and_restarted() {
    let rig = Rig::new();
    let mut daemon = rig.daemon(&["source.loop=true"]);
    let mut tail = rig.tail(&["--json"]);
    let first = tail.json()["boot_id"].clone();
    for _ in 0..3 {
        daemon.kill();
        daemon = rig.daemon(&["source.loop=true"]);
        let mut sample = tail.json();
        while sample["boot_id"] == first || sample["map_from_base"].is_null() {
            sample = tail.json();
        }
    }
    let said = tail.stderr_line_with("restart");
    assert!(said.contains("boot"), "{said}");
    daemon.signal(Signal::TERM);
    assert!(daemon.wait().0.success());
}

#[test]
fn a_signal_ends_the_daemon_within_a_second_and_says_goodbye() {
    for which in [Signal::TERM, Signal::INT] {
        let rig = Rig::new();
        let mut daemon = rig.daemon(&["source.loop=true"]);
        let mut tail = rig.tail(&["--json"]);
        while tail.json()["map_from_base"].is_null() {}
        daemon.signal(which);
        let (status, took) = daemon.wait();
        assert!(status.success());
        assert!(took < Duration::from_secs(1), "{took:?}");
        let mut last = tail.json();
        while last["reason"] != "STOPPING" {
            last = tail.json();
        }
        assert_eq!(last["map_from_base"], serde_json::Value::Null, "the last word is no stale pose");
        tail.signal(Signal::TERM);
        assert!(tail.finish().1.success());
    }
}

#[test]
fn a_stopped_client_loses_samples_and_the_daemon_none() {
    let rig = Rig::new();
    let mut daemon = rig.daemon(&["source.loop=true", "source.pace=4.0"]);
    let mut slow = rig.tail(&["--json"]);
    let mut quick = rig.tail(&["--json"]);
    slow.json();
    slow.signal(Signal::STOP);
    let start = quick.json()["sample"].as_u64().unwrap();
    let mut now = start;
    while now < start + 120 {
        let sample = quick.json();
        assert_eq!(sample["sample"].as_u64().unwrap(), now + 1, "the quick client loses nothing");
        now += 1;
    }
    slow.signal(Signal::CONT);
    let mut lost = 0;
    for _ in 0..200 {
        lost = slow.json()["lost_samples"].as_u64().unwrap();
        if lost > 0 {
            break;
        }
    }
    assert!(lost > 0, "120 samples passed a client that was stopped, and it counted none as lost");
    daemon.signal(Signal::TERM);
    assert!(daemon.wait().0.success());
}

#[test]
fn unusable_frames_are_counted_and_the_next_good_one_is_used() {
    let source = Rig::new();
    let folder = source.folder().join("damaged");
    fs::create_dir(&folder).unwrap();
    let mut images: Vec<_> = fs::read_dir(source.recording()).unwrap().flatten().map(|e| e.path()).collect();
    images.retain(|path| path.to_string_lossy().contains(".color."));
    images.sort();
    for image in &images[..12] {
        fs::copy(image, folder.join(image.file_name().unwrap())).unwrap();
    }
    let victim = |n: usize| folder.join(images[n].file_name().unwrap());
    let whole = fs::read(victim(3)).unwrap();
    fs::write(victim(3), &whole[..whole.len() / 3]).unwrap();
    fs::write(victim(5), b"this is no image").unwrap();
    fs::write(victim(6), b"").unwrap();

    let rig = Rig::with_recording(&folder);
    let daemon =
        rig.daemon(&["source.pace=\"max\"", "publish.wait_for_subscribers=1", "source.layout=\"images\""]);
    let mut tail = rig.tail(&["--json"]);
    let mut good = Vec::new();
    loop {
        let sample = tail.json();
        if sample["reason"] == "SOURCE_ENDED" {
            assert_eq!(sample["dropped_frames"], 3);
            break;
        }
        if !sample["odom_from_base"].is_null() {
            good.push(sample["sequence"].as_u64().unwrap());
        }
    }
    assert_eq!(good, [0, 1, 2, 4, 7, 8, 9, 10, 11]);
    let (_, status, stderr) = daemon.finish();
    assert!(status.success(), "{stderr}");
    assert!(stderr.contains("unusable"), "{stderr}");
}

#[test]
fn without_a_daemon_the_client_says_so_in_one_line() {
    let rig = Rig::new();
    for arguments in [&["tail", "--timeout", "0.2"][..], &["status", "--timeout", "0.2"]] {
        let (out, status, stderr) = rig.client(arguments).finish();
        assert_eq!((out.len(), status.code()), (0, Some(69)), "{stderr}");
        assert_eq!(stderr.lines().count(), 1, "{stderr}");
        assert!(stderr.contains("grnetd"), "{stderr}");
    }
}

#[test]
fn a_second_daemon_of_the_same_name_is_refused() {
    let rig = Rig::new();
    let first = rig.daemon(&["source.loop=true"]);
    rig.tail(&["--json", "--count", "1"]).json();
    let (_, status, stderr) = rig.daemon(&["source.loop=true"]).finish();
    assert_eq!(status.code(), Some(69), "{stderr}");
    assert!(stderr.contains("front") && stderr.contains(&first.id().to_string()), "{stderr}");
}

#[test]
fn bad_configuration_and_damaged_weights_end_the_start_with_78() {
    let rig = Rig::new();
    let broken = rig.folder().join("broken.safetensors");
    let whole = fs::read(grnet_tests::shared_files().join("model.safetensors")).unwrap();
    let refused = |setting: &str, words: &[&str]| {
        let (_, status, stderr) = rig.daemon(&[setting]).finish();
        assert_eq!(status.code(), Some(78), "{setting}: {stderr}");
        for word in words {
            assert!(stderr.contains(word), "{setting}: no '{word}' in {stderr}");
        }
    };
    refused("source.pcae=\"max\"", &["pcae", "pace"]);
    refused("source.path=\"/nonexistent\"", &["/nonexistent"]);
    let checkpoint = format!("model.checkpoint={broken:?}");
    fs::write(&broken, &whole[..whole.len() - 7]).unwrap();
    refused(&checkpoint, &["broken.safetensors"]);
    let mut flipped = whole;
    *flipped.last_mut().unwrap() ^= 0x40;
    fs::write(&broken, flipped).unwrap();
    refused(&checkpoint, &["broken.safetensors", "hash"]);
}

#[test]
fn check_says_what_would_run_without_running_it() {
    let rig = Rig::new();
    drop(rig.daemon(&[]));
    let mut command = Command::new(program("grnetd"));
    command.args(["check", "--config"]).arg(rig.folder().join("grnetd.toml"));
    let (text, status, stderr) = Process::start(command).finish();
    let text = text.join("\n");
    assert!(status.success(), "{stderr}");
    for word in ["NOT TRAINED", "grnet/front/pose", "160x120"] {
        assert!(text.contains(word), "no '{word}' in {text}");
    }
}
