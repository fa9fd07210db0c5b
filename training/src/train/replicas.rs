//! One batch on several cores: each copy of the network takes some of the windows, forward and backward, and the gradients
//! are averaged in a fixed order.
//!
//! The copies share their weights. Batch statistics are those of a copy's own windows ("ghost batch norm", Hoffer et al.,
//! NeurIPS 2017), and enter the running ones in the order of the copies. The result depends on the number of copies, which is
//! the number of threads, and on nothing else.

use std::collections::BTreeMap;

use candle_core::backprop::GradStore;
use candle_core::{Device, Tensor, Var};
use grnet_geometry::Pose;
use grnet_model::{BatchStatistics, LayerStatistics, Network};
use rayon::iter::{IntoParallelRefIterator as _, ParallelIterator as _};

use super::TrainError;
use super::objective::{Objective, Value};
use crate::loss::Targets;

/// What a network is shown.
#[derive(Debug, Clone)]
pub enum Input {
    /// Images, (B, K, 3, H, W).
    Images(Tensor),
    /// CNN1's features, (B, K, C, h, w).
    Features(Tensor),
}

/// A copy of the network with what its batch norms saw.
#[derive(Debug)]
pub struct Replica {
    /// The network; weights are shared with the other copies.
    pub network: Network,
    /// None with frozen batch norms.
    pub statistics: Option<BatchStatistics>,
}

/// The outcome of one step of all copies.
#[derive(Debug)]
pub struct Gradient {
    /// Mean loss over the windows.
    pub loss: f64,
    /// Named terms, means over the windows.
    pub parts: BTreeMap<String, f64>,
    /// Mean gradient; none when the loss is not finite.
    pub grads: Option<GradStore>,
    /// Batch statistics in the order of the copies.
    pub statistics: Vec<LayerStatistics>,
}

struct Share {
    weight: f64,
    loss: f64,
    parts: Vec<(String, f64)>,
    grads: GradStore,
}

/// Runs a batch forward and backward.
///
/// # Errors
/// When shapes do not fit.
pub fn gradient(
    replicas: &[Replica],
    objective: &Objective<'_>,
    input: &Input,
    world_from_camera: &[Vec<Pose>],
    variables: &[Var],
) -> Result<Gradient, TrainError> {
    let windows = world_from_camera.len();
    let per_replica = windows.div_ceil(replicas.len().max(1));
    let jobs: Vec<(&Replica, usize)> =
        replicas.iter().zip((0..windows).step_by(per_replica.max(1))).collect();
    let run = |(replica, first): &(&Replica, usize)| {
        let count = per_replica.min(windows - first);
        let poses = &world_from_camera[*first..first + count];
        share(replica, objective, &input.narrow(*first, count)?, poses, count as f64 / windows as f64)
    };
    // A single copy may be on a GPU, whose work belongs on this thread.
    let shares: Vec<Result<Share, TrainError>> = match jobs.as_slice() {
        [job] => vec![run(job)],
        jobs => jobs.par_iter().map(run).collect(),
    };
    let mut merged = Gradient { loss: 0.0, parts: BTreeMap::new(), grads: None, statistics: Vec::new() };
    let mut stores = Vec::new();
    for share in shares {
        let Share { weight, loss, parts, grads } = share?;
        merged.loss += weight * loss;
        for (name, value) in parts {
            *merged.parts.entry(name).or_default() += weight * value;
        }
        stores.push((weight, grads));
    }
    for replica in replicas {
        merged.statistics.extend(replica.statistics.iter().flat_map(BatchStatistics::take));
    }
    if merged.loss.is_finite() {
        merged.grads = mean(stores, variables)?;
    }
    Ok(merged)
}

fn share(
    replica: &Replica,
    objective: &Objective<'_>,
    input: &Input,
    poses: &[Vec<Pose>],
    weight: f64,
) -> Result<Share, TrainError> {
    let network = &replica.network;
    let output = match input {
        Input::Images(images) => network.window(images)?,
        Input::Features(features) => {
            let (windows, frames, ..) = features.dims5()?;
            network.window_from_features(&features.flatten(0, 1)?, windows, frames)? // (B, K, ...) -> (B K, ...)
        }
    };
    let targets = Targets::new(poses, network.device())?;
    let Value { total, parts } = objective.value(&output, &targets)?;
    let number = |tensor: &Tensor| tensor.to_scalar::<f32>().map(f64::from);
    Ok(Share {
        weight,
        loss: number(&total)?,
        parts: parts
            .iter()
            .map(|(name, tensor)| Ok((name.clone(), number(tensor)?)))
            .collect::<Result<_, TrainError>>()?,
        grads: total.backward()?,
    })
}

/// The weighted sum of the gradients of `variables`, added in the order given.
fn mean(stores: Vec<(f64, GradStore)>, variables: &[Var]) -> Result<Option<GradStore>, TrainError> {
    let mut stores = stores.into_iter();
    let Some((weight, mut sum)) = stores.next() else { return Ok(None) };
    let others: Vec<_> = stores.collect();
    if others.is_empty() {
        return Ok(Some(sum));
    }
    for var in variables {
        let Some(own) = sum.remove(var) else { continue };
        let mut total = own.affine(weight, 0.0)?;
        for (weight, other) in &others {
            if let Some(grad) = other.get(var) {
                total = (total + grad.affine(*weight, 0.0)?)?;
            }
        }
        sum.insert(var, total);
    }
    Ok(Some(sum))
}

impl Input {
    /// Some of the windows.
    fn narrow(&self, first: usize, count: usize) -> candle_core::Result<Self> {
        match self {
            Self::Images(images) => Ok(Self::Images(images.narrow(0, first, count)?)),
            Self::Features(features) => Ok(Self::Features(features.narrow(0, first, count)?)),
        }
    }

    /// The same on another device.
    ///
    /// # Errors
    /// When that has no memory left.
    pub fn to_device(&self, device: &Device) -> candle_core::Result<Self> {
        match self {
            Self::Images(images) => Ok(Self::Images(images.to_device(device)?)),
            Self::Features(features) => Ok(Self::Features(features.to_device(device)?)),
        }
    }

    /// What it holds.
    pub fn tensor(&self) -> &Tensor {
        match self {
            Self::Images(tensor) | Self::Features(tensor) => tensor,
        }
    }
}
