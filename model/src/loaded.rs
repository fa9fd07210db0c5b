//! A network with its weights, ready to run.

use std::path::Path;

use candle_core::Device;

use crate::checkpoint::Checkpoint;
use crate::checkpoint_error::CheckpointError;
use crate::config::{Branches, NetworkConfig};
use crate::metadata::{CheckpointMetadata, Kind};
use crate::network::Network;
use crate::preprocessing::Preprocessing;
use crate::tensors::content_hash;
use crate::untrained;

/// A network with its weights and all that the checkpoint says about them.
#[derive(Debug, Clone)]
pub struct LoadedModel {
    /// The network; heads that the checkpoint does not list as trained give no output.
    pub network: Network,
    /// What the checkpoint says; of trunk and scene together where both were given.
    pub metadata: CheckpointMetadata,
    /// SHA-256 over the tensors in use: one and the same for a complete checkpoint and for its trunk with its scene.
    pub model_hash: [u8; 32],
    /// SHA-256 over the tensors of CNN1 and RCNN1 alone: equal for all scenes of one trunk.
    pub trunk_hash: [u8; 32],
    /// Whether every part was trained; the poses of an untrained model mean nothing.
    pub trained: bool,
}

impl LoadedModel {
    /// Loads a complete checkpoint, a trunk alone (relative poses only), or either with a scene in place of its own.
    ///
    /// # Errors
    /// As [`Checkpoint::load`] and [`Checkpoint::merge`]; also for a trunk alone that has no relative branch.
    pub fn load(checkpoint_or_trunk: &Path, scene: Option<&Path>) -> Result<Self, CheckpointError> {
        Self::load_on(checkpoint_or_trunk, scene, &Device::Cpu)
    }

    /// [`LoadedModel::load`] with the weights on another device.
    ///
    /// # Errors
    /// As [`LoadedModel::load`].
    pub fn load_on(
        checkpoint_or_trunk: &Path,
        scene: Option<&Path>,
        device: &Device,
    ) -> Result<Self, CheckpointError> {
        let checkpoint = Checkpoint::load(checkpoint_or_trunk)?;
        let checkpoint = match scene {
            Some(scene) => Checkpoint::merge(checkpoint, Checkpoint::load(scene)?)?,
            None => checkpoint,
        };
        Self::from_checkpoint(checkpoint, device)
    }

    /// Builds the network of a checkpoint in memory.
    ///
    /// # Errors
    /// For a scene alone, a trunk without a relative branch, or a device without memory.
    pub fn from_checkpoint(checkpoint: Checkpoint, device: &Device) -> Result<Self, CheckpointError> {
        let mut network = checkpoint.metadata().network.clone();
        match checkpoint.metadata().kind {
            Kind::Complete => {}
            Kind::Trunk if network.branches.relative => {
                network.branches = Branches { relative: true, global: false, fusion: false };
            }
            Kind::Trunk => return Err(CheckpointError::NothingToRun { path: checkpoint.origin }),
            found @ Kind::Scene => {
                let needed = "a trunk or a complete checkpoint";
                return Err(CheckpointError::Kind { path: checkpoint.origin, found, needed });
            }
        }
        let metadata = checkpoint.metadata().clone();
        let model_hash = content_hash(checkpoint.tensors.iter());
        let trunk_hash = content_hash(checkpoint.tensors.iter().filter(|(name, _)| Kind::Trunk.holds(name)));
        let mut network =
            Network::new(&network, checkpoint.into_var_builder(device)?)?.with_live_heads(metadata.heads);
        if let Some(shift) = metadata.motion_log_variance_shift {
            network = network.with_shifted_motion_log_variance(shift)?;
        }
        Ok(Self { network, trained: metadata.is_trained(), metadata, model_hash, trunk_hash })
    }

    /// A network with drawn weights: the same seed gives the same weights everywhere. See [`untrained::checkpoint`].
    ///
    /// # Errors
    /// When the configuration cannot be used.
    pub fn untrained(config: &NetworkConfig, seed: u64) -> Result<Self, CheckpointError> {
        let checkpoint = untrained::checkpoint(config, seed, Preprocessing::default())?;
        Self::from_checkpoint(checkpoint, &Device::Cpu)
    }
}
