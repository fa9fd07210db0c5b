//! What a stage minimises: the losses of the heads that it weighs, as one number.

use candle_core::backprop::GradStore;
use candle_core::{Tensor, Var};
use grnet_model::{Branches, NetworkConfig, WindowOutput};

use super::TrainError;
use super::config::LossWeights;
use crate::loss::{Head, Homoscedastic, Loss, Targets, joint_loss, relative_loss, uncertainty_loss};

/// The losses of a stage.
#[derive(Debug)]
pub struct Objective<'a> {
    /// As written in the paper, or learned.
    pub kind: Loss,
    /// Weights of the heads.
    pub weights: LossWeights,
    /// Learned weights of the terms; none for the paper's losses.
    pub homoscedastic: Option<&'a Homoscedastic>,
}

/// One batch's loss and what it is made of.
#[derive(Debug)]
pub struct Value {
    /// A scalar that gradients flow from.
    pub total: Tensor,
    /// Named scalars for the log.
    pub parts: Vec<(String, Tensor)>,
}

impl Objective<'_> {
    /// The branches that a forward pass needs for these weights.
    pub fn branches(&self, config: &NetworkConfig) -> Branches {
        let fusion = self.weights.fused > 0.0;
        Branches {
            relative: config.branches.relative && (fusion || self.weights.relative > 0.0),
            global: config.branches.global && (fusion || self.weights.global > 0.0),
            fusion,
        }
    }

    /// Starts the learned weights of the given heads from the gradients of a first batch; whether there are any to start.
    ///
    /// # Errors
    /// When a weight cannot be read or set.
    pub fn start_at(&self, heads: &[Head], grads: Option<&GradStore>) -> Result<bool, TrainError> {
        let (Some(homoscedastic), Some(grads)) = (self.homoscedastic, grads) else { return Ok(false) };
        for (head, weight) in self.weights.heads().filter(|(head, _)| heads.contains(head)) {
            let gradient =
                |var: &Var| grads.get(var).map(|g| g.to_scalar::<f32>().map(f64::from)).transpose();
            homoscedastic.start_at(head, weight, gradient)?;
        }
        Ok(!heads.is_empty())
    }

    /// The loss of a batch.
    ///
    /// # Errors
    /// When a head is missing or shapes do not fit.
    pub fn value(&self, output: &WindowOutput, targets: &Targets) -> Result<Value, TrainError> {
        let heads = [
            (Head::Relative, self.weights.relative, &output.relative),
            (Head::Global, self.weights.global, &output.global),
            (Head::Fused, self.weights.fused, &output.fused),
        ];
        let mut total: Option<Tensor> = None;
        let mut parts = Vec::new();
        for (head, weight, output) in heads.into_iter().filter(|(_, weight, _)| *weight > 0.0) {
            let output = output.as_ref().ok_or(TrainError::MissingHead { head })?;
            let terms = match head {
                Head::Relative => relative_loss(self.kind, output, targets, self.homoscedastic)?,
                Head::Global | Head::Fused => {
                    joint_loss(self.kind, output, targets, head, self.homoscedastic)?
                }
            };
            total = Some(add(total, terms.total.affine(weight, 0.0)?)?);
            parts.extend(terms.parts.into_iter().map(|(name, value)| (format!("{head}.{name}"), value)));
            if self.weights.uncertainty > 0.0
                && let Some(loss) = uncertainty_loss(output, targets, head)?
            {
                parts.push((format!("{head}.uncertainty"), loss.detach()));
                total = Some(add(total, loss.affine(self.weights.uncertainty, 0.0)?)?);
            }
        }
        let total = total.ok_or(TrainError::NoLoss)?;
        Ok(Value { total, parts })
    }
}

fn add(sum: Option<Tensor>, term: Tensor) -> candle_core::Result<Tensor> {
    match sum {
        Some(sum) => sum + term,
        None => Ok(term),
    }
}
