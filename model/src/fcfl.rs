//! FCFL, the fully-connected fusion layers (section "Fully-connected fusion layers (FCFL)"): fc1 and fc2 side by side,
//! fc3, then fc4 (translation) and fc5 (rotation): the fused world_from_camera.
//!
//! Departure: none, but for the optional log-variance head; no activation stands behind fc3, since the paper names none.

use candle_core::{Module, Result, Tensor};
use candle_nn::{Linear, VarBuilder, linear};

use crate::config::NetworkConfig;
use crate::heads::{HeadTensors, PoseHead};

/// fc1 and fc2 -> the fused pose.
#[derive(Debug, Clone)]
pub struct Fcfl {
    fc3: Linear,
    head: PoseHead,
}

impl Fcfl {
    /// Keys: `fc3`, `fc4`, `fc5`, `log_variance`.
    ///
    /// # Errors
    /// When a tensor is missing or of another shape.
    pub fn new(config: &NetworkConfig, vb: VarBuilder<'_>) -> Result<Self> {
        Ok(Self {
            fc3: linear(config.fc1 + config.fc2, config.fc3, vb.pp("fc3"))?,
            head: PoseHead::new(config, config.fc3, vb)?,
        })
    }

    /// (N, fc1) and (N, fc2) -> fused pose.
    ///
    /// # Errors
    /// When shapes do not fit.
    pub fn forward(&self, fc1: &Tensor, fc2: &Tensor) -> Result<HeadTensors> {
        let both = Tensor::cat(&[fc1, fc2], 1)?; // (N, fc1), (N, fc2) -> (N, fc1 + fc2)
        self.head.forward(&self.fc3.forward(&both)?)
    }
}
