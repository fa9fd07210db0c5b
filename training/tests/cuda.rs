//! `--device`: refused with a reason in a build without CUDA; on a GPU the same training as on the CPU.

use std::path::Path;
use std::process::{Command, Output, Stdio};

/// Every stage on a room of its own; with one thread the CPU, too, normalises over the whole batch.
const RECIPE: &str = r#"
seed = 3
threads = 1
save_every_s = 0
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

[validation]
data = "room"
windows = 24
every_steps = 5

[[stage]]
name = "joint"
data = "room"
train = ["cnn1", "rcnn1", "rcnn2", "fcfl"]
loss = { relative = 1.0, global = 1.0, fused = 1.0, uncertainty = 0.1 }
steps = 4
batch = 4

[[stage]]
name = "settle"
data = "room"
train = ["rcnn1", "rcnn2", "fcfl"]
loss = { relative = 1.0, global = 1.0, fused = 1.0, uncertainty = 0.1 }
steps = 4
batch = 4
freeze_batch_norm = true

[[stage]]
name = "kept"
data = "room"
train = ["rcnn2", "fcfl"]
loss = { global = 1.0, fused = 1.0 }
steps = 4
batch = 4
cached_windows = 8
"#;

fn train(folder: &Path, name: &str, more: &[&str]) -> Output {
    let recipe = folder.join("recipe.toml");
    std::fs::write(&recipe, RECIPE).unwrap();
    let mut command = Command::new(env!("CARGO_BIN_EXE_grnet-train"));
    command
        .stdin(Stdio::null())
        .arg("train")
        .arg("--config")
        .arg(&recipe)
        .arg("--out")
        .arg(folder.join(name));
    command.args(more).output().unwrap()
}

#[cfg(not(feature = "cuda"))]
#[test]
fn a_build_without_cuda_says_how_to_get_one() {
    let folder = tempfile::tempdir().unwrap();
    let output = train(folder.path(), "run", &["--device", "cuda:1"]);
    let error = String::from_utf8_lossy(&output.stderr);
    assert!(!output.status.success() && error.contains("cuda:1"), "{error}");
    assert!(error.contains("--features cuda") && error.contains("docs/training.md"), "{error}");
    assert!(!folder.path().join("run").exists(), "nothing was begun");
}

#[cfg(feature = "cuda")]
mod on_a_gpu {
    use super::*;

    fn log(folder: &Path, name: &str) -> Vec<serde_json::Value> {
        let text = std::fs::read_to_string(folder.join(name).join("log.jsonl")).unwrap();
        text.lines().map(|line| serde_json::from_str(line).unwrap()).collect()
    }

    fn assert_ok(output: &Output) {
        let (out, err) = (String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
        assert!(output.status.success(), "{out}\n{err}");
    }

    #[test]
    #[ignore = "needs an NVIDIA GPU"]
    fn a_training_loses_as_much_as_on_the_cpu() {
        let folder = tempfile::tempdir().unwrap();
        assert_ok(&train(folder.path(), "cpu", &[]));
        assert_ok(&train(folder.path(), "gpu", &["--device", "cuda"]));
        let (cpu, gpu) = (log(folder.path(), "cpu"), log(folder.path(), "gpu"));
        assert_eq!(cpu.len(), gpu.len());
        for (a, b) in cpu.iter().zip(&gpu) {
            if let (Some(a), Some(b)) = (a["loss"].as_f64(), b["loss"].as_f64()) {
                assert!((a - b).abs() < 0.02 * (1.0 + a.abs()), "{cpu:?}\n{gpu:?}");
            }
        }
        let record = std::fs::read_to_string(folder.path().join("gpu/run.json")).unwrap();
        assert!(record.contains("cuda:0"), "{record}");
        // On another device it is another run.
        let refused = train(folder.path(), "gpu", &["--resume"]);
        let error = String::from_utf8_lossy(&refused.stderr);
        assert!(!refused.status.success() && error.contains("device"), "{error}");
        // A finished one writes its checkpoints again.
        assert_ok(&train(folder.path(), "gpu", &["--resume", "--device", "cuda"]));
    }
}
