//! The baselines on real images, against figures measured with an independent program (VLAD: of SIFT at key points, by
//! which the dense descriptors here are not far off).
//!
//! Needs the recording `redkitchen` (7-Scenes layout, lists `interleave_*.txt` and `returnsweep_*.txt`) in the folder that
//! `GRNET_DATA` names, or in `../shared/data` beside the workspace; without it the tests say so and pass.

use std::path::{Path, PathBuf};

use grnet_capture::dataset::OpenOptions;
use grnet_train::baselines::{self, Predictions, Task};
use grnet_train::evaluate::{BaselineName, Data, DataOptions, Scores, System, add_baselines, score};

fn data(split: &str) -> Option<Data> {
    let root = std::env::var_os("GRNET_DATA")
        .map_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared/data"), PathBuf::from);
    let path = root.join("redkitchen");
    if !path.is_dir() {
        eprintln!(
            "SKIPPED: {} is not there; set GRNET_DATA to the folder that holds redkitchen",
            path.display()
        );
        return None;
    }
    let options = DataOptions {
        open: OpenOptions::default(),
        train_list: Some(path.join(format!("{split}_train.txt"))),
        test_list: Some(path.join(format!("{split}_test.txt"))),
    };
    Some(Data::open(&path, &options).unwrap())
}

fn scores(data: &Data, name: BaselineName) -> Scores {
    let mut systems: Vec<System> = Vec::new();
    add_baselines(&mut systems, data, &[name], 10, &|| ()).unwrap();
    score(data, &systems[0], 10).overall
}

/// Median m, median deg, recall at 25 cm / 10 deg; `within` is relative, recalls may differ by 0.04.
#[track_caller]
fn assert_close(name: BaselineName, scores: &Scores, expected: (f64, f64, f64), within: f64) {
    let found = (
        scores.median_translation_m.unwrap(),
        scores.median_rotation_deg.unwrap(),
        scores.recall_25cm_10deg.unwrap(),
    );
    println!("{name:?}: {found:.4?}, expected {expected:?}");
    assert!((found.0 / expected.0 - 1.0).abs() < within, "{name:?}: {found:?}, expected {expected:?}");
    assert!((found.1 / expected.1 - 1.0).abs() < within, "{name:?}: {found:?}, expected {expected:?}");
    assert!((found.2 - expected.2).abs() < 0.04, "{name:?}: {found:?}, expected {expected:?}");
    assert_eq!(scores.valid, scores.frames, "{name:?}");
}

#[test]
fn data_baselines_of_interleaved_blocks() {
    let Some(data) = data("interleave") else { return };
    assert_eq!((data.task.train.len(), data.task.test.len(), data.task.blocks().len()), (540, 180, 18));
    for (name, expected, within) in [
        (BaselineName::NearestPose, (0.0534, 2.60, 1.0), 0.01),
        (BaselineName::SmallImage, (0.058, 3.06, 0.98), 0.03),
        (BaselineName::Vlad, (0.068, 3.7, 0.98), 0.12),
        (BaselineName::Interpolation, (0.0125, 1.14, 1.0), 0.01),
    ] {
        assert_close(name, &scores(&data, name), expected, within);
    }
}

#[test]
fn data_baselines_of_a_sweep_that_returns() {
    let Some(data) = data("returnsweep") else { return };
    assert_eq!((data.task.train.len(), data.task.test.len(), data.task.blocks().len()), (650, 250, 1));
    for (name, expected, within) in [
        (BaselineName::NearestPose, (0.2387, 12.84, 0.232), 0.01),
        (BaselineName::SmallImage, (0.3385, 13.51, 0.216), 0.03),
        (BaselineName::Vlad, (0.264, 14.1, 0.19), 0.12),
        (BaselineName::Interpolation, (0.1808, 9.75, 0.548), 0.01),
    ] {
        assert_close(name, &scores(&data, name), expected, within);
    }
    for (name, metres, degrees, pairs) in [
        (BaselineName::ZeroMotion, 0.0759, 3.227, 240),
        (BaselineName::ConstantVelocity, 0.02625, 3.090, 230),
    ] {
        let motion = scores(&data, name).motion.unwrap();
        println!("{name:?}: {motion:?}");
        assert_eq!((motion.pairs, motion.all_pairs), (pairs, 240), "{name:?}");
        assert!((motion.median_translation_m / metres - 1.0).abs() < 0.01, "{name:?}: {motion:?}");
        assert!((motion.median_rotation_deg / degrees - 1.0).abs() < 0.01, "{name:?}: {motion:?}");
    }
}

#[test]
fn data_retrieval_answers_only_with_training_poses() {
    let Some(data) = data("interleave") else { return };
    // A few frames suffice: every answer is one of the poses that retrieval may know.
    let few = Task::new(data.task.train[..40].to_vec(), data.task.test[..10].to_vec());
    let known = |predictions: Predictions| {
        predictions.into_iter().all(|pose| few.train_poses().any(|(_, train)| Some(train) == pose))
    };
    assert!(known(baselines::small_image::predict(&few, &|| ()).unwrap()));
    assert!(known(baselines::vlad::predict(&few, &|| ()).unwrap()));
}
