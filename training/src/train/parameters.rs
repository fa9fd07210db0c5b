//! The weights under training: candle variables by checkpoint key, and the running statistics of the batch norms.

use std::collections::{BTreeMap, HashMap};

use candle_core::{DType, Device, Tensor, Var};
use candle_nn::VarBuilder;
use grnet_geometry::{Pose, quaternion};
use grnet_model::{Checkpoint, LayerStatistics, NetworkConfig, Rotation};

use super::TrainError;
use super::normalisation::Normalisation;

/// How much of a batch's statistics enters the running ones at every step, PyTorch's default.
const MOMENTUM: f64 = 0.1;

/// Every tensor of a network.
#[derive(Debug)]
pub struct Parameters {
    config: NetworkConfig,
    weights: BTreeMap<String, Var>,
    statistics: BTreeMap<String, Tensor>,
}

impl Parameters {
    /// The weights of a complete checkpoint, ready to be changed.
    ///
    /// # Errors
    /// When memory runs out.
    pub fn new(checkpoint: Checkpoint, device: &Device) -> Result<Self, TrainError> {
        let config = checkpoint.metadata().network.clone();
        let (mut weights, mut statistics) = (BTreeMap::new(), BTreeMap::new());
        for (name, tensor) in checkpoint.into_tensors(device)? {
            if is_statistic(&name) {
                statistics.insert(name, tensor);
            } else {
                weights.insert(name, Var::from_tensor(&tensor)?);
            }
        }
        Ok(Self { config, weights, statistics })
    }

    /// The network that they belong to.
    pub fn config(&self) -> &NetworkConfig {
        &self.config
    }

    /// The variables whose name begins with one of the prefixes.
    pub fn of_parts<'a>(&'a self, parts: &'a [Part]) -> impl Iterator<Item = (&'a String, &'a Var)> {
        self.weights.iter().filter(move |(name, _)| is_of(parts, name))
    }

    /// The tensors for a network of which the given parts are trained: those are variables, the others constants.
    pub fn var_builder(&self, trained: &[Part], device: &Device) -> VarBuilder<'static> {
        let weights = self.weights.iter().map(|(name, var)| {
            let tensor =
                if is_of(trained, name) { var.as_tensor().clone() } else { var.as_detached_tensor() };
            (name.clone(), tensor)
        });
        let statistics = self.statistics.iter().map(|(name, tensor)| (name.clone(), tensor.clone()));
        VarBuilder::from_tensors(weights.chain(statistics).collect(), DType::F32, device)
    }

    /// Moves the running statistics towards those of a batch.
    ///
    /// # Errors
    /// When a record does not belong to this network.
    pub fn follow(&mut self, batch: Vec<LayerStatistics>) -> Result<(), TrainError> {
        for LayerStatistics { layer, mean, variance } in batch {
            for (name, of_batch) in [("running_mean", mean), ("running_var", variance)] {
                let key = format!("{layer}.{name}");
                let Some(running) = self.statistics.get_mut(&key) else {
                    return Err(TrainError::UnknownTensor { tensor: key });
                };
                *running = (running.affine(1.0 - MOMENTUM, 0.0)? + of_batch.affine(MOMENTUM, 0.0)?)?;
            }
        }
        Ok(())
    }

    /// Everything by name, as constants that later steps do not change.
    ///
    /// # Errors
    /// When memory runs out.
    pub fn snapshot(&self) -> Result<HashMap<String, Tensor>, TrainError> {
        let weights = self.weights.iter().map(|(name, var)| Ok((name.clone(), var.copy()?.detach())));
        let statistics = self.statistics.iter().map(|(name, tensor)| Ok((name.clone(), tensor.clone())));
        weights.chain(statistics).collect()
    }

    /// Puts back what [`Parameters::snapshot`] gave, or other tensors of the same names; what is not given stays.
    ///
    /// # Errors
    /// When a tensor is not of this network or of another shape.
    pub fn restore(&mut self, tensors: impl IntoIterator<Item = (String, Tensor)>) -> Result<(), TrainError> {
        for (name, tensor) in tensors {
            if let Some(var) = self.weights.get(&name) {
                var.set(&tensor.to_device(var.device())?)?;
            } else if let Some(statistic) = self.statistics.get_mut(&name) {
                *statistic = tensor.to_device(statistic.device())?;
            } else {
                return Err(TrainError::UnknownTensor { tensor: name });
            }
        }
        Ok(())
    }

    /// Starts the pose heads at the middle of the training poses: fc4 and fc5 give the mean pose (absolute heads) or no
    /// motion (relative head) and small multiples of the targets' deviation around it, as they would on normalised
    /// targets. Without this a room that lies 100 m from its origin would cost thousands of steps.
    ///
    /// # Errors
    /// When a layer is missing.
    pub fn centre_heads(&mut self, parts: &[Part], normalisation: &Normalisation) -> Result<(), TrainError> {
        let rotation = self.config.rotation;
        for part in parts {
            let (centre, scales) = match part {
                Part::Cnn1 => continue,
                Part::Rcnn1 => (Pose::identity(), normalisation.relative),
                Part::Rcnn2 | Part::Fcfl => (normalisation.centre, normalisation.absolute),
            };
            let translation: Vec<f32> = centre.translation.vector.iter().map(|v| *v as f32).collect();
            self.set_head(*part, "fc4", &translation, scales.translation_m)?;
            let raw: Vec<f32> = match rotation {
                Rotation::Quaternion => quaternion::xyzw(&centre.rotation).map(|v| v as f32).to_vec(),
                Rotation::Rotation6d => quaternion::to_6d(&centre.rotation).map(|v| v as f32).to_vec(),
            };
            self.set_head(*part, "fc5", &raw, scales.rotation_rad.min(1.0))?;
        }
        Ok(())
    }

    /// Lets RCNN1 start with differences: its first convolutions give the features of the previous frame the weights of the
    /// current one's with the opposite sign, so that what the batch norms behind them scale up is motion. With independent
    /// weights it would be appearance, of which motion is a small part, and learning starts an order of magnitude later.
    ///
    /// # Errors
    /// When a layer is missing.
    pub fn start_with_differences(&mut self) -> Result<(), TrainError> {
        for layer in ["conv1", "downsample.0"] {
            let key = format!("{}.res5.0.{layer}.weight", Part::Rcnn1.prefix());
            let weight = self.weights.get(&key).ok_or(TrainError::UnknownTensor { tensor: key })?;
            let inputs = weight.dim(1)? / 2;
            // (outputs, previous | current, kernel, kernel)
            let current = weight.narrow(1, inputs, inputs)?;
            weight.set(&Tensor::cat(&[&current.neg()?, &current], 1)?)?;
        }
        Ok(())
    }

    fn set_head(&mut self, part: Part, layer: &str, bias: &[f32], scale: f64) -> Result<(), TrainError> {
        let find = |key: String| self.weights.get(&key).ok_or(TrainError::UnknownTensor { tensor: key });
        let weight = find(format!("{}.{layer}.weight", part.prefix()))?;
        weight.set(&weight.affine(scale, 0.0)?)?;
        let var = find(format!("{}.{layer}.bias", part.prefix()))?;
        var.set(&Tensor::from_slice(bias, bias.len(), weight.device())?)?;
        Ok(())
    }
}

/// What a stage can train, called as in the paper.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Part {
    /// The shared features.
    Cnn1,
    /// The relative sub-network.
    Rcnn1,
    /// The global sub-network.
    Rcnn2,
    /// The fusion layers.
    Fcfl,
}

impl Part {
    /// First component of the names of its tensors.
    pub fn prefix(self) -> &'static str {
        match self {
            Self::Cnn1 => "cnn1",
            Self::Rcnn1 => "rcnn1",
            Self::Rcnn2 => "rcnn2",
            Self::Fcfl => "fcfl",
        }
    }
}

pub(super) fn is_of(parts: &[Part], name: &str) -> bool {
    parts.iter().any(|part| name.split('.').next() == Some(part.prefix()))
}

fn is_statistic(name: &str) -> bool {
    name.ends_with(".running_mean") || name.ends_with(".running_var")
}
