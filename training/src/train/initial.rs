//! The weights that a training starts from.

use std::path::Path;

use candle_core::Device;
use grnet_model::{Checkpoint, CheckpointMetadata, Heads, Kind, NetworkConfig, Preprocessing, untrained};

use super::config::{Init, Recipe};
use super::normalisation::Normalisation;
use super::parameters::{Parameters, Part, is_of};
use super::{ConfigError, TrainError};
use crate::import;

/// Weights with what their file said.
#[derive(Debug)]
pub struct Initial {
    /// The weights.
    pub parameters: Parameters,
    /// Of the file they come from, or of drawn weights.
    pub metadata: CheckpointMetadata,
    /// Heads that were trained before.
    pub heads: Heads,
    /// Content hash of the file, if any.
    pub source: Option<String>,
}

/// Network and preprocessing of a recipe: known before any weight is read, for the windows depend on them.
///
/// # Errors
/// When the checkpoint cannot be read or the network does not fit the stages.
pub fn plan(
    recipe: &Recipe,
    path: &Path,
) -> Result<(NetworkConfig, Preprocessing, Option<Checkpoint>), TrainError> {
    let bad = |key: String, problem: String| ConfigError::Value { path: path.into(), key, problem };
    let file = recipe.init.as_ref().and_then(|init| init.checkpoint.as_deref());
    let checkpoint = file.map(Checkpoint::load).transpose()?;
    let network = match (&recipe.network, &checkpoint) {
        (Some(table), _) => table.config().map_err(|problem| bad("network".into(), problem))?,
        (None, Some(checkpoint)) => checkpoint.metadata().network.clone(),
        (None, None) => {
            let problem = "give `preset`, or a checkpoint under [init] whose network is taken";
            return Err(bad("network".into(), problem.into()).into());
        }
    };
    for stage in &recipe.stages {
        let stage_key = |field| format!("stage \"{}\": {field}", stage.name);
        stage.check_network(&network).map_err(|(field, problem)| bad(stage_key(field), problem))?;
    }
    let preprocessing =
        checkpoint.as_ref().map_or_else(Preprocessing::default, |c| c.metadata().preprocessing.clone());
    Ok((network, preprocessing, checkpoint))
}

/// Draws the weights of `network` from the recipe's seed, then takes over what the recipe's `init` names; heads of drawn parts
/// start at the middle of the training poses.
///
/// # Errors
/// When weights cannot be read or do not fit.
pub fn weights(
    recipe: &Recipe,
    network: &NetworkConfig,
    preprocessing: &Preprocessing,
    checkpoint: Option<Checkpoint>,
    normalisation: &Normalisation,
    device: &Device,
) -> Result<Initial, TrainError> {
    let drawn = untrained::checkpoint(network, recipe.seed, preprocessing.clone())?;
    let mut metadata = drawn.metadata().clone();
    let mut parameters = Parameters::new(drawn, device)?;
    let (mut heads, mut source) = (Heads::default(), None);
    let mut centred = vec![Part::Cnn1, Part::Rcnn1, Part::Rcnn2, Part::Fcfl];
    centred.retain(|part| parameters.of_parts(&[*part]).next().is_some());
    if let Some(checkpoint) = checkpoint {
        let held = checkpoint.metadata().kind;
        let all = [Part::Cnn1, Part::Rcnn1, Part::Rcnn2, Part::Fcfl];
        let named = recipe.init.as_ref().and_then(|init: &Init| init.parts.clone());
        let parts = named.unwrap_or_else(|| all.iter().copied().filter(|p| holds(held, *p)).collect());
        centred.retain(|part| !parts.contains(part));
        heads = of_parts(checkpoint.metadata().heads, &parts);
        source = Some(checkpoint.content_hash().to_owned());
        metadata.camera = checkpoint.metadata().camera;
        let known: std::collections::HashMap<_, _> =
            parameters.snapshot()?.into_iter().map(|(name, tensor)| (name, tensor.dims().to_vec())).collect();
        let taken = checkpoint.into_tensors(device)?.into_iter().filter(|(name, tensor)| {
            is_of(&parts, name) && known.get(name).is_some_and(|shape| shape == tensor.dims())
        });
        parameters.restore(taken.collect::<Vec<_>>())?;
    } else if let Some(resnet50) = recipe.init.as_ref().and_then(|init| init.resnet50.as_deref()) {
        let file = import::resolve(resnet50)?;
        parameters.restore(import::resnet50(&file, network)?)?;
    }
    parameters.centre_heads(&centred, normalisation)?;
    let foreign = recipe.init.as_ref().is_some_and(|init| init.resnet50.is_some());
    if centred.contains(&Part::Rcnn1) && !foreign {
        parameters.start_with_differences()?;
    }
    Ok(Initial { parameters, metadata, heads, source })
}

fn holds(kind: Kind, part: Part) -> bool {
    kind.holds(&format!("{}.", part.prefix()))
}

/// The heads whose layers, and all below them, were taken over.
fn of_parts(heads: Heads, parts: &[Part]) -> Heads {
    let has = |needed: &[Part]| needed.iter().all(|part| parts.contains(part));
    let keep = |head, kept: bool| if kept { head } else { grnet_model::HeadState::default() };
    Heads {
        relative: keep(heads.relative, has(&[Part::Cnn1, Part::Rcnn1])),
        global: keep(heads.global, has(&[Part::Cnn1, Part::Rcnn2])),
        fused: keep(heads.fused, has(&[Part::Cnn1, Part::Rcnn1, Part::Rcnn2, Part::Fcfl])),
    }
}
