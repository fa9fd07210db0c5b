//! `grnet-train evaluate` on a small synthetic recording with untrained networks.

use std::collections::HashSet;
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

use clap::Parser as _;
use grnet_frame::{Camera, Distortion};
use grnet_geometry::trajectory::{kitti, tum};
use grnet_model::{Branches, NetworkConfig, Preprocessing, untrained};
use grnet_train::evaluate::command::{self, EvaluateArgs};
use grnet_train::evaluate::{Kind, Knowledge, SCHEMA, Summary};
use grnet_train::synth::{ImageFormat, Recipe, SceneOptions, SensorOptions, Shutter, VolumeKind, write};

const FRAMES: usize = 14;

/// Three passes through one room; the last one is for testing. Rendered once.
fn recording() -> &'static Path {
    static FOLDER: OnceLock<tempfile::TempDir> = OnceLock::new();
    let folder = FOLDER.get_or_init(|| {
        let folder = tempfile::tempdir().unwrap();
        let recipe = Recipe {
            scene: SceneOptions { room: 3, texel_m: 0.03 },
            volume: VolumeKind::Handheld,
            seed: 11,
            sequences: 3,
            test_sequences: 1,
            frames: FRAMES as u32,
            rate_hz: 10.0,
            camera: Camera::new((96, 72), (79.0, 79.0), (47.5, 35.5), Distortion::None).unwrap(),
            format: ImageFormat::Png,
            depth: false,
            edge_samples: 1,
            sensor: SensorOptions::clean(),
            shutter: Shutter::default(),
        };
        write(&recipe, &folder.path().join("room"), &|| ()).unwrap();
        folder
    });
    Box::leak(folder.path().join("room").into_boxed_path())
}

fn checkpoint(folder: &Path, name: &str, branches: Branches, seed: u64) -> PathBuf {
    let config = NetworkConfig {
        width: 0.125,
        input_height_px: 48,
        input_width_px: 64,
        branches,
        ..NetworkConfig::grnet_small()
    };
    let path = folder.join(name);
    untrained::checkpoint(&config, seed, Preprocessing::default()).unwrap().save(&path).unwrap();
    path
}

const WHOLE: Branches = Branches { relative: true, global: true, fusion: true };

#[derive(clap::Parser)]
struct Cli {
    #[command(flatten)]
    args: EvaluateArgs,
}

fn evaluate(arguments: &[&str]) -> Result<(), String> {
    let cli =
        Cli::try_parse_from(std::iter::once(&"evaluate").chain(arguments)).map_err(|e| e.to_string())?;
    command::run(&cli.args).map_err(|error| format!("{error:#}"))
}

fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}

fn summary(out: &Path) -> Summary {
    serde_json::from_str(&fs::read_to_string(out.join("scores.json")).unwrap()).unwrap()
}

#[test]
fn a_report_holds_every_system_and_every_file() {
    let folder = tempfile::tempdir().unwrap();
    let a = checkpoint(folder.path(), "small.safetensors", WHOLE, 1);
    let only_relative = Branches { relative: true, global: false, fusion: false };
    let b = checkpoint(folder.path(), "motion <b>.safetensors", only_relative, 2);
    let out = folder.path().join("report");
    evaluate(&[
        "--checkpoint",
        text(&a),
        text(&b),
        "--data",
        text(recording()),
        "--gap",
        "4",
        "--out",
        text(&out),
    ])
    .unwrap();

    let summary = summary(&out);
    assert_eq!((summary.schema, summary.gap_frames, summary.test_blocks), (SCHEMA, 4, 1));
    assert_eq!(
        (summary.train_frames, summary.test_frames, summary.judged_frames),
        (2 * FRAMES, FRAMES, FRAMES)
    );
    let kinds = |kind| summary.systems.iter().filter(|s| s.system.kind == kind).count();
    assert_eq!((kinds(Kind::Fused), kinds(Kind::Global), kinds(Kind::Odometry)), (1, 1, 2));
    // Six that need no model, and CNN1 of both.
    assert_eq!(kinds(Kind::Baseline), 8);
    assert!(summary.models.iter().all(|model| !model.trained && model.failed_frames == 0));
    for system in &summary.systems {
        let (scores, name) = (&system.overall, &system.system.name);
        assert_eq!(scores.frames, FRAMES);
        if name == "interpolated frame number" {
            assert_eq!(
                (scores.valid, scores.recall_5cm_5deg),
                (0, Some(0.0)),
                "no training frame is of this pass"
            );
            assert!(!out.join("trajectories").join(&system.system.slug).exists());
            continue;
        }
        let motion = scores.motion.unwrap_or_else(|| panic!("{name} has no motion"));
        assert_eq!(motion.all_pairs, FRAMES - 4);
        if ["zero motion", "constant velocity"].contains(&name.as_str()) {
            assert_eq!((scores.valid, scores.recall_5cm_5deg, scores.ate.none_m), (0, None, None), "{name}");
            continue;
        }
        assert_eq!(scores.valid, FRAMES, "{name}");
        assert!(scores.median_translation_m.unwrap().is_finite() && scores.ate.none_m.is_some(), "{name}");
        assert!(scores.kitti.is_none(), "{name}: the path is far below 100 m");
        assert!(scores.calibration.is_none(), "{name}: untrained covariances are unknown");

        let folder = out.join("trajectories").join(&system.system.slug);
        let tum = tum::read(&folder.join("seq-03.tum")).unwrap();
        let rows = kitti::read(&folder.join("seq-03.kitti")).unwrap();
        let truth = kitti::read(&folder.join("seq-03.truth.kitti")).unwrap();
        assert_eq!((tum.len(), rows.len(), truth.len()), (FRAMES, FRAMES, FRAMES), "{name}");
    }
    let slugs: HashSet<_> = summary.systems.iter().map(|s| &s.system.slug).collect();
    assert_eq!(slugs.len(), summary.systems.len());
    // Odometry starts at the truth, and knows nothing else of it.
    let odometry = summary.systems.iter().find(|s| s.system.kind == Kind::Odometry).unwrap();
    assert_eq!(odometry.system.knowledge, Knowledge::FirstPose);
    let estimate =
        tum::read(&out.join("trajectories").join(&odometry.system.slug).join("seq-03.tum")).unwrap();
    let truth = tum::read(&out.join("trajectories/truth/seq-03.tum")).unwrap();
    let gap = |n: usize| {
        let (a, b) = (estimate.poses()[n].world_from_camera, truth.poses()[n].world_from_camera);
        (a.translation.vector - b.translation.vector).norm()
    };
    assert!(gap(0) < 1e-9 && gap(FRAMES - 1) > 1e-6);

    let page = fs::read_to_string(out.join("index.html")).unwrap();
    assert!(page.contains("small fused") && page.contains("untrained") && page.contains("was never trained"));
    assert!(page.contains("motion &lt;b&gt;") && !page.contains("motion <b>"), "names are escaped");
    let no_references = ["src=", "href=", "url(", "@import", "<script"];
    assert!(no_references.iter().all(|word| !page.contains(word)), "the page needs nothing else");
    let markdown = fs::read_to_string(out.join("report.md")).unwrap();
    let plots: Vec<_> = fs::read_dir(out.join("plots")).unwrap().map(|f| f.unwrap().file_name()).collect();
    assert!(plots.len() >= 5, "{plots:?}");
    for plot in plots {
        assert!(markdown.contains(&format!("plots/{}", plot.to_str().unwrap())), "{plot:?} is not shown");
    }
    assert_eq!(page.matches("<svg role=\"img\"").count(), markdown.matches("![").count());
}

/// Poses of the fused system in the test sequence, by time.
fn fused(out: &Path) -> Vec<(i64, grnet_geometry::Pose)> {
    poses(out, "small-fused")
}

fn poses(out: &Path, system: &str) -> Vec<(i64, grnet_geometry::Pose)> {
    let path = out.join(format!("trajectories/{system}/seq-03.tum"));
    tum::read(&path).unwrap().poses().iter().map(|p| (p.time_ns, p.world_from_camera)).collect()
}

#[test]
fn nothing_is_carried_from_block_to_block_and_nothing_else_is_shown() {
    let folder = tempfile::tempdir().unwrap();
    let checkpoint = checkpoint(folder.path(), "small.safetensors", WHOLE, 1);
    let run = |name: &str, frames: &[usize]| {
        let list = folder.path().join(format!("{name}.txt"));
        let lines: Vec<String> = frames.iter().map(|n| format!("seq-03/frame-{n:06}")).collect();
        fs::write(&list, lines.join("\n")).unwrap();
        let out = folder.path().join(name);
        let data = text(recording());
        let arguments = ["--checkpoint", text(&checkpoint), "--data", data, "--no-baselines", "--test-list"];
        evaluate(&[&arguments[..], &[text(&list), "--out", text(&out)]].concat()).unwrap();
        assert_eq!(summary(&out).systems.iter().filter(|s| s.system.kind == Kind::Baseline).count(), 0);
        fused(&out)
    };
    let both = run("both", &[1, 2, 3, 7, 8, 9]);
    let second = run("second", &[7, 8, 9]);
    assert_eq!(both[3..], second[..]);
    // The state does matter: the same frames in the middle of a block give other poses.
    let through = run("through", &[5, 6, 7, 8, 9]);
    assert_ne!(through[2..], second[..]);
}

#[test]
fn a_corrupt_image_costs_its_frame_and_is_never_a_zero() {
    let folder = tempfile::tempdir().unwrap();
    let data = folder.path().join("room");
    copy(recording(), &data);
    fs::write(data.join("seq-03/frame-000005.color.png"), b"no image").unwrap();
    let checkpoint = checkpoint(folder.path(), "small.safetensors", WHOLE, 1);
    let out = folder.path().join("report");
    evaluate(&["--checkpoint", text(&checkpoint), "--data", text(&data), "--out", text(&out)]).unwrap();
    let summary = summary(&out);
    assert_eq!(summary.models[0].failed_frames, 1);
    assert!(
        summary.models[0].notes.iter().any(|note| note.contains("frame-000005")),
        "{:?}",
        summary.models[0].notes
    );
    for system in summary.systems.iter().filter(|s| s.system.kind != Kind::Baseline) {
        assert_eq!(
            (system.overall.frames, system.overall.valid),
            (FRAMES, FRAMES - 1),
            "{}",
            system.system.name
        );
    }
    assert_eq!(fused(&out).len(), FRAMES - 1);
    assert!(fs::read_to_string(out.join("index.html")).unwrap().contains("13 &#x2f; 14"));
}

fn copy(from: &Path, to: &Path) {
    fs::create_dir_all(to).unwrap();
    for entry in fs::read_dir(from).unwrap().map(Result::unwrap) {
        let target = to.join(entry.file_name());
        if entry.path().is_dir() {
            copy(&entry.path(), &target);
        } else {
            fs::copy(entry.path(), target).unwrap();
        }
    }
}

#[test]
fn what_cannot_be_judged_is_refused_with_what_to_do() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("report");
    let data = text(recording());
    let refused = |arguments: &[&str], parts: &[&str]| {
        let all = [&["--data", data, "--out", text(&out)], arguments].concat();
        let error = evaluate(&all).unwrap_err();
        for part in parts {
            assert!(error.contains(part), "{error:?} lacks {part:?}");
        }
        assert!(!out.exists(), "{arguments:?} left a report");
    };
    let missing = folder.path().join("none.safetensors");
    refused(&["--checkpoint", text(&missing)], &["none.safetensors"]);
    refused(&["--scene", text(&missing)], &["exactly one --checkpoint"]);
    refused(&["--baselines", "cnn1"], &["--checkpoint"]);
    refused(&["--gap", "0"], &["--gap"]);
    refused(&["--map-smoothing-ms", "60001"], &["--map-smoothing-ms", "60000"]);
    refused(&["--sequence", "seq-09"], &["seq-09"]);
    let list = folder.path().join("all.txt");
    fs::write(&list, "seq-03\n").unwrap();
    refused(
        &["--train-list", text(&list), "--test-list", text(&list)],
        &["14 frames", "both trained and tested"],
    );
    refused(&["--test-list", text(&list), "--baselines", "vlad"], &["vlad", "--train-list"]);

    let images = folder.path().join("images");
    fs::create_dir(&images).unwrap();
    fs::copy(recording().join("seq-03/frame-000000.color.png"), images.join("0.png")).unwrap();
    let error = evaluate(&["--data", text(&images), "--out", text(&out)]).unwrap_err();
    assert!(error.contains("true pose") && error.contains("--poses"), "{error}");

    fs::create_dir(&out).unwrap();
    fs::write(out.join("thesis.tex"), "").unwrap();
    let error = evaluate(&["--data", data, "--out", text(&out)]).unwrap_err();
    assert!(error.contains("not empty") && error.contains("--out"), "{error}");
    assert!(out.join("thesis.tex").exists());
}

#[test]
fn published_poses_are_a_row_of_their_own_where_they_are_smoothed() {
    let folder = tempfile::tempdir().unwrap();
    let model = checkpoint(folder.path(), "small.safetensors", WHOLE, 1);
    let out = folder.path().join("report");
    let published = |ms: &str| {
        let data = text(recording());
        let model = ["--checkpoint", text(&model), "--data", data, "--no-baselines", "--out", text(&out)];
        evaluate(&[&model[..], &["--map-smoothing-ms", ms]].concat()).unwrap();
        summary(&out).systems.into_iter().find(|s| s.system.kind == Kind::Published)
    };
    let found = published("2500").expect("a row");
    assert!(found.system.about.contains("over 2500 ms"), "{}", found.system.about);
    let (mean, network) = (poses(&out, "small-published"), poses(&out, "small-fused"));
    assert_eq!((mean.len(), &mean[0]), (FRAMES, &network[0]));
    assert!(mean[1..].iter().zip(&network[1..]).all(|(mean, network)| mean.1 != network.1));
    assert!(published("0").is_none());
}

#[test]
fn a_second_report_replaces_the_first() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("report");
    let run = |baselines: &str| {
        evaluate(&["--data", text(recording()), "--baselines", baselines, "--out", text(&out)]).unwrap();
        let names: Vec<_> = summary(&out).systems.into_iter().map(|s| s.system.name).collect();
        names
    };
    assert_eq!(run("nearest-pose,interpolation").len(), 2);
    assert!(out.join("trajectories/nearest-training-pose").is_dir());
    assert_eq!(run("small-image"), ["retrieval, small image"]);
    assert!(!out.join("trajectories/nearest-training-pose").exists());
}
