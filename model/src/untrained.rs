//! Initial weights: drawn from a seed, the same on every machine, each tensor from a stream of its own (so that two
//! networks that share a part and a seed share its weights).
//!
//! * Convolutions: He-normal, standard deviation sqrt(2 / fan-in) (He et al., ICCV 2015).
//! * Batch norm: weight 1, bias 0, running mean 0, running variance 1; the weight of the last one of each bottleneck is
//!   1/4, which keeps the residual sums bounded before any statistics are known.
//! * LSTM: uniform in +-1/sqrt(hidden) for all tensors, as PyTorch does.
//! * Fully connected: uniform in +-1/sqrt(inputs) for weight and bias, as PyTorch does; but the bias of fc5 is the
//!   identity rotation and the bias of a log-variance layer is 0.
//!
//! candle's own generator cannot be seeded on the CPU, hence this one.

use std::path::PathBuf;

use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};
use sha2::{Digest, Sha256};

use crate::checkpoint::Checkpoint;
use crate::checkpoint_error::CheckpointError;
use crate::config::NetworkConfig;
use crate::layout::{Layer, LayerKind, TensorSpec};
use crate::metadata::{CheckpointMetadata, Heads, Provenance};
use crate::network::ModelError;
use crate::preprocessing::Preprocessing;
use crate::tensors::{StoredTensor, Tensors, Values};

/// Name and version of this generator, as recorded in [`Provenance::Untrained`].
pub const GENERATOR: &str = "grnet chacha8 v1";

/// A complete checkpoint with drawn weights. Its pose heads count as live, so that a pipeline can be exercised; its
/// log-variance heads do not, because an uncertainty that nobody calibrated is no number to publish.
///
/// Camera, scene and map can be added with [`Checkpoint::with_metadata`].
///
/// # Errors
/// When the configuration or the preprocessing cannot be used.
pub fn checkpoint(
    config: &NetworkConfig,
    seed: u64,
    preprocessing: Preprocessing,
) -> Result<Checkpoint, CheckpointError> {
    config.validate().map_err(ModelError::from)?;
    let heads = Heads::all_of(config).without_log_variance();
    let provenance = Provenance::Untrained { seed, generator: GENERATOR.to_owned() };
    let metadata = CheckpointMetadata::complete(config.clone(), preprocessing, heads, provenance);
    let mut tensors = Tensors::new();
    for layer in config.layers() {
        for spec in layer.tensors() {
            let values = draw(config, &layer, &spec, seed);
            tensors.insert(spec.name, StoredTensor { shape: spec.shape, values: Values::F32(values) });
        }
    }
    Checkpoint::from_parts(metadata, tensors, PathBuf::from("an untrained checkpoint in memory"))
}

fn draw(config: &NetworkConfig, layer: &Layer, spec: &TensorSpec, seed: u64) -> Vec<f32> {
    let count: usize = spec.shape.iter().product();
    let mut rng = stream(seed, &spec.name);
    let mut uniform = |fan: usize| {
        let bound = (fan as f64).sqrt().recip();
        (0..count).map(|_| ((2.0 * rng.random::<f64>() - 1.0) * bound) as f32).collect::<Vec<f32>>()
    };
    let tensor = spec.name.rsplit('.').next().unwrap_or_default();
    match layer.kind {
        LayerKind::Convolution { inputs, kernel, .. } => {
            let deviation = (2.0 / (inputs * kernel * kernel) as f64).sqrt();
            let mut normal = || -> f64 { StandardNormal.sample(&mut rng) };
            (0..count).map(|_| (normal() * deviation) as f32).collect()
        }
        LayerKind::BatchNorm { .. } => {
            let value = match tensor {
                "weight" if layer.name.ends_with(".bn3") => 0.25,
                "weight" | "running_var" => 1.0,
                _ => 0.0,
            };
            vec![value; count]
        }
        LayerKind::Lstm { hidden, .. } => uniform(hidden),
        LayerKind::Linear { inputs, .. } => match (layer.name.rsplit('.').next(), tensor) {
            (Some("fc5"), "bias") => config.rotation.identity().to_vec(),
            (Some("log_variance"), "bias") => vec![0.0; count],
            _ => uniform(inputs),
        },
        LayerKind::MaxPool | LayerKind::AveragePool | LayerKind::Flatten => vec![],
    }
}

fn stream(seed: u64, tensor: &str) -> ChaCha8Rng {
    let mut hash = Sha256::new();
    hash.update(GENERATOR.as_bytes());
    hash.update(seed.to_le_bytes());
    hash.update(tensor.as_bytes());
    ChaCha8Rng::from_seed(hash.finalize().into())
}
