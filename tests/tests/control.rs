//! `grnet-client control` against a running daemon, as a person uses it.

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Instant;

use grnet_tests::{DEADLINE, Process, Rig, program};
use rustix::process::Signal;
use serde_json::Value;

/// A trained network with its scene, and another scene for its trunk.
fn models() -> (PathBuf, PathBuf) {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap().join("models");
    (folder.join("room-1.safetensors"), folder.join("room-2.scene.safetensors"))
}

/// (exit code, standard output, standard error)
fn control(rig: &Rig, arguments: &[&str]) -> (i32, String, String) {
    let (out, status, err) = rig.client(&[&["control"], arguments].concat()).finish();
    (status.code().unwrap(), out.join("\n"), err)
}

fn control_json(rig: &Rig, arguments: &[&str]) -> (i32, Value) {
    let (code, out, err) = control(rig, &[&["--json"], arguments].concat());
    (code, serde_json::from_str(&out).unwrap_or_else(|error| panic!("{error} in {out}\n{err}")))
}

/// The name of the scene that `room-1.safetensors` brings along.
const ROOM_1: &str = "synthetic room 1";

/// Samples until one is as wanted.
fn until(tail: &mut Process, mut found: impl FnMut(&Value) -> bool) -> Value {
    let start = Instant::now();
    loop {
        let sample = tail.json();
        if found(&sample) {
            return sample;
        }
        assert!(start.elapsed() < DEADLINE, "no such sample for {DEADLINE:?}; the last one: {sample}");
    }
}

fn number(value: &Value, key: &str) -> u64 {
    value[key].as_u64().unwrap_or_else(|| panic!("{key} is {} in {value}", value[key]))
}

/// Frames go on at every swap: each becomes a sample, the odometry continues, and from one sample to the next the
/// scene is another.
#[test]
fn a_scene_changes_between_two_frames_and_none_is_lost() {
    let (room_1, room_2) = models();
    let rig = Rig::new().with_checkpoint(&room_1);
    let _daemon = rig.daemon(&["source.loop=true", "source.pace=\"max\"", "publish.wait_for_subscribers=1"]);
    let mut tail = rig.tail(&["--json"]);
    until(&mut tail, |sample| sample["scene"] == ROOM_1 && !sample["map_from_base"].is_null());

    let (code, loaded) = control_json(&rig, &["load-scene", room_2.to_str().unwrap()]);
    assert_eq!((code, &loaded["outcome"]), (0, &"DONE".into()), "{loaded}");
    assert_eq!(loaded["status"]["active_scene"], ROOM_1, "loading does not select");
    let names: Vec<&Value> =
        loaded["status"]["scenes"].as_array().unwrap().iter().map(|scene| &scene["name"]).collect();
    assert_eq!(names, [ROOM_1, "room-2"]);
    assert_eq!(control(&rig, &["select-scene", "room-2"]).0, 0);
    let (_, scenes, _) = control(&rig, &["scenes"]);
    assert!(scenes.contains("* room-2") && scenes.contains(&format!("  {ROOM_1}")), "{scenes}");

    let mut last = until(&mut tail, |sample| !sample["sequence"].is_null());
    let mut seen: Vec<String> = vec![last["scene"].as_str().unwrap().to_owned()];
    let mut after = 0;
    while after < 20 {
        let sample = tail.json();
        // A client that is slower than the daemon misses samples, and then as many frames: none is lost between.
        let frames = number(&sample, "sequence") - number(&last, "sequence");
        assert_eq!(number(&sample, "sample") - number(&last, "sample"), frames, "{last}\n{sample}");
        assert_eq!((number(&sample, "dropped_frames"), number(&sample, "reset_epoch")), (0, 0), "{sample}");
        assert!(!sample["odom_from_base"].is_null() && !sample["map_from_base"].is_null(), "{sample}");
        if sample["scene"] != last["scene"] {
            assert_ne!(sample["model_hash"], last["model_hash"]);
            seen.push(sample["scene"].as_str().unwrap().to_owned());
        }
        after += u32::from(sample["scene"] == "room-2");
        last = sample;
    }
    assert_eq!(seen.last().unwrap(), "room-2");
    assert_eq!(seen.iter().collect::<BTreeSet<_>>().len(), seen.len(), "{seen:?}");

    // Out again: the checkpoint's own scene takes over.
    let (code, out, err) = control(&rig, &["unload-scene", "room-2"]);
    assert!(code == 0 && out.contains(ROOM_1), "{out}{err}");
    until(&mut tail, |sample| sample["scene"] == ROOM_1);
    let (code, _, err) = control(&rig, &["unload-scene", ROOM_1]);
    assert!(code == 75 && err.contains("part of the checkpoint"), "{err}");
}

#[test]
fn an_unfit_scene_changes_nothing_and_the_reason_is_said() {
    let (room_1, room_2) = models();
    let rig = Rig::new().with_checkpoint(&room_1);
    let _daemon = rig.daemon(&["source.loop=true"]);
    let mut tail = rig.tail(&["--json"]);
    until(&mut tail, |sample| !sample["sequence"].is_null());
    let whole = fs::read(&room_2).unwrap();
    let path = |name: &str| rig.folder().join(name).to_str().unwrap().to_owned();
    fs::write(path("cut.safetensors"), &whole[..whole.len() - 1000]).unwrap();
    let mut changed = whole.clone();
    *changed.last_mut().unwrap() ^= 1;
    fs::write(path("changed.safetensors"), &changed).unwrap();
    fs::write(path("words.safetensors"), "no weights").unwrap();
    let own = grnet_tests::shared_files().join("model.safetensors").to_str().unwrap().to_owned();

    for (file, reason) in [
        (path("absent.safetensors"), "No such file"),
        (path("cut.safetensors"), "cut.safetensors"),
        (path("changed.safetensors"), "hash"),
        (path("words.safetensors"), "no complete safetensors"),
        (rig.folder().to_str().unwrap().to_owned(), "not a regular file"),
        (own, "complete file where a scene file is needed"),
    ] {
        let (code, out, err) = control(&rig, &["load-scene", &file]);
        assert_eq!((code, out.as_str()), (78, ""), "{file}: {err}");
        assert!(err.to_lowercase().contains(&reason.to_lowercase()), "{file}: {err}");
        assert_eq!(err.lines().count(), 1, "{err}");
    }
    // A file that changes after it was loaded is found out when it is selected.
    fs::write(path("later.safetensors"), &whole).unwrap();
    assert_eq!(control(&rig, &["load-scene", &path("later.safetensors")]).0, 0);
    fs::write(path("later.safetensors"), &whole[..500]).unwrap();
    let (code, answer) = control_json(&rig, &["select-scene", "room-2"]);
    assert_eq!(
        (code, &answer["outcome"], &answer["status"]["active_scene"]),
        (78, &"FAILED".into(), &ROOM_1.into())
    );

    let before = number(&until(&mut tail, |sample| !sample["sequence"].is_null()), "sequence");
    let later = until(&mut tail, |sample| sample["sequence"].as_u64().is_some_and(|now| now > before));
    assert_eq!((&later["scene"], number(&later, "reset_epoch")), (&ROOM_1.into(), 0));
}

#[test]
fn every_request_is_answered_with_its_exit_code() {
    let rig = Rig::new();
    let (code, _, err) = control(&rig, &["status"]);
    assert_eq!(code, 69, "{err}");
    let mut daemon = rig.daemon(&["source.loop=true"]);
    let mut tail = rig.tail(&["--json"]);
    let epoch = number(&until(&mut tail, |sample| !sample["odom_from_base"].is_null()), "reset_epoch");

    let (code, status, _) = control(&rig, &["status"]);
    assert!(code == 0 && status.contains("UNTRAINED") && status.contains("latency ms"), "{status}");
    assert_eq!(control(&rig, &["reset"]).0, 0);
    until(&mut tail, |sample| number(sample, "reset_epoch") == epoch + 1);

    let (code, out, _) = control(&rig, &["pause"]);
    assert_eq!((code, out.as_str()), (0, "paused"));
    until(&mut tail, |sample| sample["reason"] == "PAUSED");
    assert_eq!(control_json(&rig, &["status"]).1["status"]["health"], "PAUSED");
    assert_eq!(control(&rig, &["resume"]).0, 0);
    until(&mut tail, |sample| !sample["odom_from_base"].is_null());

    for fine in [
        &["set-pose", "1", "-2", "0.5", "--yaw", "-90"][..],
        &["set-pose", "0", "0", "0", "--stddev-m", "0.1", "--stddev-deg", "2"],
    ] {
        let (code, _, err) = control(&rig, fine);
        assert_eq!(code, 0, "{fine:?}: {err}");
    }
    for (usage, said) in [
        (&["set-pose", "1", "2"][..], "<Z>"),
        (&["set-pose", "nan", "0", "0"], "not finite"),
        (&["set-pose", "0", "0", "0", "--quaternion", "0", "0", "0", "0"], "--quaternion"),
        (&["select-scene", ""], "name or path"),
        (&["fly"], "fly"),
    ] {
        let (code, _, err) = control(&rig, usage);
        assert!(code == 2 && err.contains(said), "{usage:?}: {code} {err}");
    }
    let (code, answer) = control_json(&rig, &["select-scene", "kitchen"]);
    assert_eq!(
        (code, &answer["outcome"], &answer["request"]),
        (75, &"REFUSED".into(), &"select-scene".into())
    );
    assert!(answer["message"].as_str().unwrap().contains("kitchen"), "{answer}");

    // Killed, it answers no more, and its leftovers are not taken for a daemon.
    daemon.kill();
    let (code, _, err) = control(&rig, &["pause"]);
    assert_eq!(code, 69, "{err}");
}

#[test]
fn a_recording_goes_where_the_client_says_from_where_it_stands() {
    let rig = Rig::new();
    let _daemon = rig.daemon(&["source.loop=true"]);
    let mut tail = rig.tail(&["--json"]);
    until(&mut tail, |sample| !sample["sequence"].is_null());
    let mut command = Command::new(program("grnet-client"));
    command.current_dir(rig.folder()).args(["control", "start-recording", "seen"]);
    command.arg("--root").arg(rig.transport_root()).args(["--prefix", "e2e_"]);
    let (out, status, err) = Process::start(command).finish();
    assert!(status.success(), "{out:?} {err}");
    let recording = rig.folder().join("seen");
    assert!(out[0].contains(recording.to_str().unwrap()), "{out:?}");
    let (code, _, err) = control(&rig, &["start-recording"]);
    assert!(code == 75 && err.contains("stop it first"), "{err}");
    until(&mut tail, |_| {
        fs::read_to_string(recording.join("rgb.txt")).is_ok_and(|list| list.contains("rgb/"))
    });
    let (code, out, _) = control(&rig, &["stop-recording"]);
    assert!(code == 0 && out.contains("frames recorded"), "{out}");
    let (code, _, err) = control(&rig, &["stop-recording"]);
    assert!(code == 75 && err.contains("nothing is recorded"), "{err}");
    tail.signal(Signal::TERM);
}
