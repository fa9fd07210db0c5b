//! `grnet-train train` and `grnet-train scene` as processes, on a network small enough for a test.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::time::{Duration, Instant};

use grnet_capture::{FolderSource, Pace, dataset};
use grnet_frame::{Frame, FrameSource as _, Received};
use grnet_geometry::{Pose, quaternion, se3};
use grnet_model::candle_core::{self, Device, Tensor};
use grnet_model::{Checkpoint, HeadTensors, Kind, LoadedModel};
use grnet_pipeline::{Estimate, NoObserver, Pipeline, PipelineOptions};

/// Every stage of the paper on a room of its own, two threads, saved after each step.
const RECIPE: &str = r#"
seed = 3
threads = 2
save_every_s = 0
half_precision = true
scene = { id = "room-1" }

[network]
preset = "grnet-small"
width = 0.125
input_height_px = 48
input_width_px = 64
lstm_hidden = 32
fc1 = 32
fc2 = 32
fc3 = 32

[data.room.rendered]
rooms = [1]
size_px = [64, 48]
texel_mm = 40.0
window = { k = 3, strides = [2, 4] }

[data.held_out.rendered]
rooms = [1]
size_px = [64, 48]
texel_mm = 40.0
window = { k = 3, strides = [3], seed = 9 }
augment = {}

[validation]
data = "held_out"
windows = 24
every_steps = 5

[[stage]]
name = "relative"
data = "room"
train = ["cnn1", "rcnn1"]
loss = { relative = 1.0, uncertainty = 0.1 }
steps = 4
batch = 4

[[stage]]
name = "global"
data = "room"
train = ["rcnn2"]
loss = { global = 1.0, uncertainty = 0.1 }
steps = 4
batch = 4
cached_windows = 12

[[stage]]
name = "joint"
data = "room"
train = ["cnn1", "rcnn1", "rcnn2", "fcfl"]
loss = { relative = 1.0, global = 1.0, fused = 1.0, uncertainty = 0.1 }
steps = 4
batch = 4
echo = 2
"#;

fn program() -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_grnet-train"));
    command.stdin(Stdio::null());
    command
}

fn write(folder: &Path, name: &str, text: &str) -> PathBuf {
    let path = folder.join(name);
    std::fs::write(&path, text).unwrap();
    path
}

fn train(recipe: &Path, out: &Path, more: &[&str]) -> Output {
    program().arg("train").arg("--config").arg(recipe).arg("--out").arg(out).args(more).output().unwrap()
}

fn assert_ok(output: &Output) {
    let (out, err) = (String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
    assert!(output.status.success(), "{out}\n{err}");
}

fn refused(output: &Output, expected: &[&str]) {
    let error = String::from_utf8_lossy(&output.stderr);
    assert!(!output.status.success(), "{error}");
    for text in expected {
        assert!(error.contains(text), "\"{text}\" in {error}");
    }
}

#[test]
fn a_run_that_was_killed_again_and_again_ends_with_the_same_bytes() {
    let folder = tempfile::tempdir().unwrap();
    let recipe = write(folder.path(), "all-stages.toml", RECIPE);
    let (whole, killed) = (folder.path().join("whole"), folder.path().join("killed"));
    assert_ok(&train(&recipe, &whole, &[]));

    // One kill in each stage and one while features are computed, each once the log shows some progress.
    let mut resume = false;
    for step in [2, 5, 9] {
        let mut command = program();
        command.arg("train").arg("--config").arg(&recipe).arg("--out").arg(&killed);
        if resume {
            command.arg("--resume");
        }
        let mut child = command.stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
        let limit = Instant::now() + Duration::from_secs(120);
        while saved_step(&killed) < step {
            assert!(Instant::now() < limit, "no state of step {step} within two minutes");
            assert!(child.try_wait().unwrap().is_none(), "it ended before step {step}");
            std::thread::sleep(Duration::from_millis(2));
        }
        child.kill().unwrap();
        child.wait().unwrap();
        resume = true;
    }
    assert_ok(&train(&recipe, &killed, &["--resume"]));
    for name in ["model.safetensors", "trunk.safetensors", "scene.safetensors"] {
        let bytes = |run: &Path| std::fs::read(run.join(name)).unwrap();
        assert!(bytes(&whole) == bytes(&killed), "{name} differs");
    }
    let steps = |run: &Path| {
        let log = std::fs::read_to_string(run.join("log.jsonl")).unwrap();
        let entry = |line: &str| {
            let entry: serde_json::Value = serde_json::from_str(line).unwrap();
            (entry["step"].as_u64(), entry["kind"].as_str().map(str::to_owned), entry["loss"].as_f64())
        };
        log.lines().map(entry).filter(|(.., loss)| loss.is_none_or(f64::is_finite)).collect::<Vec<_>>()
    };
    let valid = |run: &Path| steps(run).into_iter().filter(|e| e.1.as_deref() == Some("valid")).count();
    assert_eq!(valid(&whole), valid(&killed), "validations are neither lost nor written twice");
    assert!(whole.join("curves.svg").is_file() && whole.join("curves.png").is_file());
}

#[test]
fn an_interrupt_saves_and_the_run_goes_on_from_there() {
    let folder = tempfile::tempdir().unwrap();
    let long = RECIPE.replace("save_every_s = 0", "save_every_s = 3600").replace("steps = 4", "steps = 2000");
    let recipe = write(folder.path(), "long.toml", &long);
    let run = folder.path().join("run");
    let mut command = program();
    command.arg("train").arg("--config").arg(&recipe).arg("--out").arg(&run);
    let mut child = command.stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap();
    let limit = Instant::now() + Duration::from_secs(120);
    let has_begun =
        || std::fs::read_to_string(run.join("log.jsonl")).is_ok_and(|log| log.contains("\"train\""));
    while !has_begun() {
        assert!(Instant::now() < limit && child.try_wait().unwrap().is_none(), "no step within two minutes");
        std::thread::sleep(Duration::from_millis(5));
    }
    let pid = rustix::process::Pid::from_child(&child);
    rustix::process::kill_process(pid, rustix::process::Signal::INT).unwrap();
    let output = child.wait_with_output().unwrap();
    let error = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success() && error.contains("go on with --resume"), "{error}");
    assert!(saved_step(&run) >= 10, "the state of the interrupt");
    assert!(!run.join("model.safetensors").exists());
}

/// Steps of the last saved state, 0 before the first.
fn saved_step(run: &Path) -> u64 {
    let Ok(bytes) = std::fs::read(run.join("state.safetensors")) else { return 0 };
    // The header is JSON; "step" is a number written by the run folder.
    let header = String::from_utf8_lossy(&bytes[..bytes.len().min(4000)]).replace('\\', "");
    let Some(at) = header.find("\"step\":") else { return 0 };
    let digits: String = header[at + 7..]
        .chars()
        .skip_while(|c| !c.is_ascii_digit())
        .take_while(char::is_ascii_digit)
        .collect();
    digits.parse().unwrap_or(0)
}

#[test]
fn the_weights_of_terms_start_where_the_first_batch_is() {
    // At its minimum over s a term `w (exp(-s) L + s)` is `w (1 + s)`. The rate is so small that nothing moves afterwards.
    let folder = tempfile::tempdir().unwrap();
    let (head, _) = RECIPE.split_once("[[stage]]").unwrap();
    let stage = |name: &str, loss: &str| {
        format!(
            "[[stage]]\nname = \"{name}\"\ndata = \"room\"\ntrain = [\"cnn1\", \"rcnn1\", \"rcnn2\", \"fcfl\"]\n\
             loss = {{ {loss} }}\nsteps = 1\nbatch = 4\nlearning_rate = 1e-12\nfreeze_batch_norm = true\n"
        )
    };
    let first = stage("first", "relative = 1.5");
    let second = stage("second", "relative = 1.0, global = 1.0, fused = 2.0");
    let run = |name: &str, text: String| {
        let out = folder.path().join(name);
        assert_ok(&train(&write(folder.path(), &format!("{name}.toml"), &text), &out, &[]));
        let file = candle_core::safetensors::load(out.join("state.safetensors"), &Device::Cpu).unwrap();
        let weights: BTreeMap<String, f64> = file
            .into_iter()
            .filter(|(name, _)| name.starts_with("loss."))
            .map(|(name, s)| (name, f64::from(s.to_scalar::<f32>().unwrap())))
            .collect();
        let log = std::fs::read_to_string(out.join("log.jsonl")).unwrap();
        let losses: Vec<f64> = log
            .lines()
            .filter_map(|line| serde_json::from_str::<serde_json::Value>(line).unwrap()["loss"].as_f64())
            .collect();
        (weights, losses)
    };
    let of = |weights: &BTreeMap<String, f64>, head: &str| -> Vec<f64> {
        weights.iter().filter(|(name, _)| name.contains(head)).map(|(_, s)| *s).collect()
    };
    let (weights, losses) = run("one", format!("{head}{first}"));
    let relative = of(&weights, ".relative.");
    assert_eq!((weights.len(), relative.len()), (2, 2));
    let expected: f64 = relative.iter().map(|s| 1.5 * (1.0 + s)).sum();
    assert!((losses[0] - expected).abs() < 1e-3, "{losses:?}, {expected}");

    let (weights, losses) = run("all", format!("{head}{second}"));
    let of_head =
        |name: &str, weight: f64| of(&weights, name).iter().map(|s| weight * (1.0 + s)).sum::<f64>();
    let expected = of_head(".relative.", 1.0) + of_head(".global.", 1.0) + of_head(".fused.", 2.0);
    assert!((losses[0] - expected).abs() < 1e-3, "{losses:?}, {expected}");

    // A second stage weighs two heads for the first time and goes on with the weights of the third.
    let (weights, _) = run("both", format!("{head}{first}{second}"));
    let kept = of(&weights, ".relative.");
    assert!(kept.iter().zip(&relative).all(|(a, b)| (a - b).abs() < 1e-6), "{kept:?}, {relative:?}");
}

#[test]
fn trained_weights_stream_as_they_were_evaluated() {
    let folder = tempfile::tempdir().unwrap();
    let recipe = write(folder.path(), "all-stages.toml", RECIPE);
    let out = folder.path().join("run");
    assert_ok(&train(&recipe, &out, &[]));
    let model = LoadedModel::load(&out.join("model.safetensors"), None).unwrap();
    assert!(model.trained && model.metadata.heads.fused.pose && model.metadata.heads.relative.pose);
    assert_eq!(model.metadata.scene.as_ref().unwrap().id, "room-1");
    // Trunk and scene are the same model in two files.
    let parts =
        LoadedModel::load(&out.join("trunk.safetensors"), Some(&out.join("scene.safetensors"))).unwrap();
    assert_eq!(parts.model_hash, model.model_hash);

    let recording = folder.path().join("pass");
    let synth =
        ["synth", "--sequences", "1", "--frames", "9", "--size", "64x48", "--texel-mm", "40", "--out"];
    assert_ok(&program().args(synth).arg(&recording).output().unwrap());
    let recording = dataset::open_one(&recording, &dataset::OpenOptions::default()).unwrap();
    let mut source = FolderSource::new(recording, Pace::Max, false).unwrap();
    let mut preprocessor = grnet_pipeline::preprocess::Preprocessor::new(
        grnet_pipeline::preprocess::InputSpec {
            size_px: (64, 48),
            preprocessing: model.metadata.preprocessing.clone(),
            trained_camera: None,
        },
        grnet_pipeline::IntrinsicsOptions::default(),
        None,
    )
    .unwrap();
    let (mut frames, mut images) = (Vec::new(), Vec::new());
    while let Received::Frame(frame) = source.next_frame(Duration::from_secs(5)).unwrap() {
        images.extend_from_slice(preprocessor.run(&frame).unwrap());
        frames.push(frame);
    }
    assert_eq!(frames.len(), 9);
    let images = Tensor::from_vec(images, (frames.len(), 3, 48, 64), &Device::Cpu).unwrap();
    let window = |frames: &[u32]| {
        let index = Tensor::new(frames, &Device::Cpu).unwrap();
        model.network.window(&images.index_select(&index, 0).unwrap().unsqueeze(0).unwrap()).unwrap()
    };

    // With every frame a key frame, all poses are those of the window.
    let neighbours = Checkpoint::load(&out.join("model.safetensors"))
        .and_then(|checkpoint| checkpoint.with_metadata(|m| m.network.keyframe_interval_ms = 0))
        .and_then(|checkpoint| LoadedModel::from_checkpoint(checkpoint, &Device::Cpu))
        .unwrap();
    let whole = window(&[0, 1, 2, 3, 4, 5, 6, 7, 8]);
    for (i, estimate) in streamed(neighbours, &frames).iter().enumerate() {
        let fused = pose_of(whole.fused.as_ref().unwrap(), i);
        assert_near(i, &estimate.network_map_from_base.pose.unwrap(), &fused);
        if i > 0 {
            let motion = pose_of(whole.relative.as_ref().unwrap(), i);
            assert_near(i, &estimate.previous_from_current.pose.unwrap(), &motion);
        }
    }

    // As trained: at 30 frames a second 110 ms make every fourth frame a key frame.
    let mut odom_from_key = Pose::identity();
    for (i, estimate) in streamed(model.clone(), &frames).iter().enumerate().skip(1) {
        let keys: &[u32] = if i <= 4 { &[0] } else { &[0, 4] };
        let relative = window(&[keys, &[i as u32]].concat()).relative.unwrap();
        let odom_from_base = odom_from_key * pose_of(&relative, keys.len());
        assert_near(i, &estimate.odom_from_base.pose.unwrap(), &odom_from_base);
        if i == 4 {
            odom_from_key = odom_from_base;
        }
    }
}

fn streamed(model: LoadedModel, frames: &[Frame]) -> Vec<Estimate> {
    let options =
        PipelineOptions { base_from_camera: Pose::identity(), gate: None, ..PipelineOptions::default() };
    let mut pipeline = Pipeline::new(model, options).unwrap();
    frames.iter().map(|frame| pipeline.step(frame, &mut NoObserver).unwrap()).collect()
}

/// Of one frame of the only window.
fn pose_of(head: &HeadTensors, frame: usize) -> Pose {
    let row = |tensor: &Tensor| -> Vec<f64> {
        let row = tensor.get(0).unwrap().get(frame).unwrap().to_vec1::<f32>().unwrap();
        row.into_iter().map(f64::from).collect()
    };
    let translation: [f64; 3] = row(&head.translation).try_into().unwrap();
    let rotation = quaternion::from_6d(row(&head.rotation).try_into().unwrap()).unwrap();
    Pose::from_parts(translation.into(), rotation)
}

fn assert_near(frame: usize, found: &Pose, expected: &Pose) {
    let metres = (found.translation.vector - expected.translation.vector).amax();
    let radians = se3::angle_rad(&(found.rotation.inverse() * expected.rotation));
    assert!(metres < 1e-4 && radians < 1e-4, "frame {frame}: {metres} m, {radians} rad");
}

#[test]
fn a_scene_is_added_to_a_trunk_that_stays_as_it_is() {
    let folder = tempfile::tempdir().unwrap();
    let recipe = write(folder.path(), "all-stages.toml", &RECIPE.replace("windows = 24", "windows = 32"));
    let out = folder.path().join("run");
    assert_ok(&train(&recipe, &out, &[]));
    let trunk = out.join("trunk.safetensors");

    let other_room = r#"
[data.room.rendered]
rooms = [2]
size_px = [64, 48]
texel_mm = 40.0
window = { k = 3, strides = [2] }

[[stage]]
name = "scene"
data = "room"
train = ["rcnn2", "fcfl"]
loss = { global = 1.0, fused = 1.0 }
steps = 3
batch = 4
cached_windows = 8
"#;
    let scene_recipe = write(folder.path(), "scene.toml", other_room);
    let scene = folder.path().join("room-2.safetensors");
    let arguments = |scene_recipe: &Path| {
        let mut command = program();
        command.arg("scene").arg("--trunk").arg(&trunk).arg("--config").arg(scene_recipe);
        command.arg("--run").arg(folder.path().join("scene-run")).arg("--out").arg(&scene);
        command.output().unwrap()
    };
    assert_ok(&arguments(&scene_recipe));
    let stored = Checkpoint::load(&scene).unwrap();
    assert_eq!(stored.metadata().kind, Kind::Scene);
    assert_eq!(stored.metadata().scene.as_ref().unwrap().id, "room-2");
    let model = LoadedModel::load(&trunk, Some(&scene)).unwrap();
    assert!(model.metadata.heads.relative.pose && model.metadata.heads.fused.pose);
    assert!(!model.metadata.heads.fused.log_variance, "nothing was held out to calibrate it on");
    assert_eq!(model.metadata.motion_log_variance_shift, None, "nor to see how wrong the trunk is here");

    // With held-out windows the scene says how much more uncertain the trunk's motion is in its place.
    let judged = format!("{other_room}\n[validation]\ndata = \"room\"\nwindows = 24\nevery_steps = 3\n")
        .replace("fused = 1.0 }", "fused = 1.0, uncertainty = 0.1 }")
        // Motions twice as large as any that the trunk has seen.
        .replace("strides = [2]", "strides = [8]");
    let judged = write(folder.path(), "judged.toml", &judged);
    let scene = folder.path().join("judged.safetensors");
    let mut command = program();
    command.arg("scene").arg("--trunk").arg(&trunk).arg("--config").arg(&judged);
    command.arg("--run").arg(folder.path().join("judged-run")).arg("--out").arg(&scene);
    let output = command.output().unwrap();
    assert_ok(&output);
    let said = String::from_utf8_lossy(&output.stdout);
    assert!(said.contains("uncertainty of the trunk's motion in this place"), "{said}");
    let trunk_alone = LoadedModel::load(&trunk, None).unwrap();
    let model = LoadedModel::load(&trunk, Some(&scene)).unwrap();
    assert_eq!(model.trunk_hash, trunk_alone.trunk_hash);
    let shift = model.metadata.motion_log_variance_shift.unwrap();
    assert!(shift.iter().all(|v| (0.0..=16.0).contains(v)), "{shift:?}");
    assert!(shift.iter().any(|v| *v > 0.0), "the trunk has not seen such motions: {shift:?}");

    let greedy = other_room.replace("[\"rcnn2\", \"fcfl\"]", "[\"cnn1\", \"rcnn2\"]");
    refused(
        &arguments(&write(folder.path(), "greedy.toml", &greedy.replace("cached_windows = 8", ""))),
        &["trains cnn1 or rcnn1"],
    );
}

#[test]
fn what_cannot_go_on_stops_with_a_reason_and_loses_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    // A step far too large: the weights, then the loss, leave the range of numbers.
    let wild = RECIPE.replace(
        "steps = 4\nbatch = 4\n\n",
        "steps = 60\nbatch = 4\nlearning_rate = 1e30\nclip_norm = 0.0\n\n",
    );
    assert_ne!(wild, RECIPE);
    let output = train(&write(folder.path(), "wild.toml", &wild), &at("wild"), &[]);
    refused(&output, &["is not finite", "bad-batch-", "learning_rate"]);
    assert!(at("wild/state.safetensors").is_file(), "the last good state stays");
    let kept = std::fs::read_dir(at("wild")).unwrap().filter_map(Result::ok);
    assert!(kept.filter(|entry| entry.file_name().to_string_lossy().starts_with("bad-batch-")).count() == 2);

    let typo = RECIPE.replace("half_precision", "half_precison");
    refused(&train(&write(folder.path(), "typo.toml", &typo), &at("t"), &[]), &["half_precison", "line"]);
    let head = RECIPE.replace(
        "[network]\n",
        "[network]\nbranches = { relative = false, global = true, fusion = false }\n",
    );
    refused(
        &train(&write(folder.path(), "head.toml", &head), &at("h"), &[]),
        &["stage \"relative\"", "no relative head"],
    );
    let data = RECIPE.replace("data = \"held_out\"", "data = \"elsewhere\"");
    refused(
        &train(&write(folder.path(), "data.toml", &data), &at("d"), &[]),
        &["elsewhere", "held_out, room"],
    );

    let recipe = write(folder.path(), "recipe.toml", RECIPE);
    std::fs::create_dir(at("foreign")).unwrap();
    std::fs::write(at("foreign/thesis.tex"), "years of work").unwrap();
    refused(&train(&recipe, &at("foreign"), &[]), &["foreign"]);
    refused(&train(&recipe, &at("none"), &["--resume"]), &["none"]);
    // Another recipe in the same folder is not the same run.
    refused(&train(&recipe, &at("wild"), &["--resume"]), &["wild", "learning_rate"]);
}
