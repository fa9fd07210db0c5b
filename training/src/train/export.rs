//! From the weights of a run to the files that the daemon loads.

use std::collections::BTreeMap;

use grnet_model::metadata::SCHEMA;
use grnet_model::{
    CameraIntrinsics, Checkpoint, CheckpointMetadata, HeadState, Heads, Kind, Provenance, SceneInfo, Storage,
};
use serde_json::json;

use super::TrainError;
use super::calibrate::Calibration;
use super::config::{LossWeights, Recipe, Stage};
use super::parameters::{Parameters, Part};
use crate::loss::Head;

/// What the checkpoint says beside the weights.
#[derive(Debug, Clone)]
pub struct Facts {
    /// Heads that give numbers.
    pub heads: Heads,
    /// Intrinsics of the training images.
    pub camera: Option<CameraIntrinsics>,
    /// Hash of the training data.
    pub fingerprint: String,
    /// Steps that were made.
    pub steps: u64,
    /// What the calibration found.
    pub calibration: BTreeMap<Head, Calibration>,
    /// What was found of the motion of a frozen trunk.
    pub motion: Option<Calibration>,
}

/// The heads that a recipe leaves trained: those that its stages weigh, unless a part below them changed afterwards without
/// them, and those that came with the initial weights and were not touched.
pub fn trained_heads(initial: Heads, stages: &[Stage]) -> Heads {
    let mut heads = initial;
    for stage in stages {
        let LossWeights { relative, global, fused, uncertainty } = stage.loss;
        let has = |parts: &[Part]| parts.iter().any(|part| stage.train.contains(part));
        let update = |head: &mut HeadState, weight: f64, below: &[Part]| {
            if weight > 0.0 && has(below) {
                let log_variance = uncertainty > 0.0;
                *head = HeadState { pose: true, log_variance };
            } else if has(below) {
                // What feeds it moved away from under it.
                *head = HeadState::default();
            }
        };
        update(&mut heads.relative, relative, &[Part::Cnn1, Part::Rcnn1]);
        update(&mut heads.global, global, &[Part::Cnn1, Part::Rcnn2]);
        update(&mut heads.fused, fused, &[Part::Cnn1, Part::Rcnn1, Part::Rcnn2, Part::Fcfl]);
    }
    heads
}

/// A head whose uncertainty could not be calibrated states none.
pub fn only_calibrated(heads: Heads, calibration: &BTreeMap<Head, Calibration>, untouched: Heads) -> Heads {
    let state = |state: HeadState, head: Head, before: HeadState| {
        let log_variance = state.log_variance && (calibration.contains_key(&head) || before.log_variance);
        HeadState { log_variance, ..state }
    };
    Heads {
        relative: state(heads.relative, Head::Relative, untouched.relative),
        global: state(heads.global, Head::Global, untouched.global),
        fused: state(heads.fused, Head::Fused, untouched.fused),
    }
}

/// The complete checkpoint of a run.
///
/// # Errors
/// When a weight is not finite or does not fit the storage.
pub fn checkpoint(
    parameters: &Parameters,
    recipe: &Recipe,
    facts: &Facts,
    base: &CheckpointMetadata,
) -> Result<Checkpoint, TrainError> {
    let stages: Vec<_> = recipe.stages.iter().map(|stage| json!(stage)).collect();
    let record = [
        ("generator", json!(concat!("grnet-train ", env!("CARGO_PKG_VERSION")))),
        ("seed", json!(recipe.seed)),
        ("loss", json!(recipe.loss)),
        ("steps", json!(facts.steps)),
        ("data", json!(facts.fingerprint)),
        ("stages", json!(stages)),
        (
            "calibration",
            json!(
                facts.calibration.iter().map(|(head, c)| (head.to_string(), c)).collect::<BTreeMap<_, _>>()
            ),
        ),
        ("motion", json!(facts.motion)),
    ];
    let record = record.map(|(key, value)| (key.to_owned(), value));
    let scene = recipe.scene.as_ref().map(|scene| SceneInfo {
        id: scene.id.clone(),
        name: scene.name.clone().unwrap_or_else(|| scene.id.clone()),
    });
    let metadata = CheckpointMetadata {
        schema: SCHEMA,
        kind: Kind::Complete,
        network: parameters.config().clone(),
        heads: facts.heads,
        camera: facts.camera.or(base.camera),
        scene: scene.filter(|_| facts.heads.global.pose || facts.heads.fused.pose),
        map_from_world: None,
        motion_log_variance_shift: facts.motion.as_ref().map(|motion| motion.shift),
        provenance: Provenance::Trained(record.into()),
        trunk_hash: None,
        ..base.clone()
    };
    let checkpoint = Checkpoint::new(metadata, &parameters.snapshot()?)?;
    let storage = if recipe.half_precision { Storage::F16 } else { Storage::F32 };
    Ok(checkpoint.with_storage(storage)?)
}

#[cfg(test)]
mod tests {
    use super::*;
    use grnet_model::NetworkConfig;

    fn stage(train: &[Part], loss: LossWeights) -> Stage {
        let text =
            "name = \"s\"\ndata = \"d\"\ntrain = [\"fcfl\"]\nsteps = 1\nbatch = 1\nloss = { fused = 1.0 }";
        let base: Stage = toml::from_str(text).unwrap();
        Stage { train: train.to_vec(), loss, ..base }
    }

    #[test]
    fn the_papers_three_stages_leave_every_head_trained() {
        let all = [Part::Cnn1, Part::Rcnn1, Part::Rcnn2, Part::Fcfl];
        let weights = |relative, global, fused| LossWeights { relative, global, fused, uncertainty: 1.0 };
        let stages = [
            stage(&all[..2], weights(1.0, 0.0, 0.0)),
            stage(&[Part::Rcnn2], weights(0.0, 1.0, 0.0)),
            stage(&all, weights(1.0, 1.0, 1.0)),
        ];
        let heads = trained_heads(Heads::default(), &stages);
        assert_eq!(heads, Heads::all_of(&NetworkConfig::grnet()));
        let first = trained_heads(Heads::default(), &stages[..1]);
        assert!(first.relative.pose && !first.global.pose && !first.fused.pose);
    }

    #[test]
    fn the_papers_letter_leaves_the_auxiliary_heads_untrained() {
        let all = [Part::Cnn1, Part::Rcnn1, Part::Rcnn2, Part::Fcfl];
        let fused_only = LossWeights { fused: 1.0, ..LossWeights::default() };
        let heads = trained_heads(Heads::all_of(&NetworkConfig::grnet()), &[stage(&all, fused_only)]);
        assert!(heads.fused.pose && !heads.fused.log_variance);
        assert!(!heads.relative.pose && !heads.global.pose);
    }

    #[test]
    fn a_scene_on_a_frozen_trunk_keeps_the_trunks_head() {
        let trunk = Heads::all_of(&NetworkConfig::rcnn1_only());
        let weights = LossWeights { global: 1.0, fused: 1.0, uncertainty: 1.0, ..LossWeights::default() };
        let heads = trained_heads(trunk, &[stage(&[Part::Rcnn2, Part::Fcfl], weights)]);
        assert_eq!(heads, Heads::all_of(&NetworkConfig::grnet()));
    }
}
