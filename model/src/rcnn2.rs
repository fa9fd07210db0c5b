//! RCNN2, the global sub-network (section "RCNNs-type global sub-networks (RCNN2)"): CNN1's features of the current frame
//! go through a Res5 of its own, two LSTMs and fc2. It is what a scene retrains; CNN1 is shared.
//!
//! Departures and readings:
//! * "the previous CNNs features" is read as the features that CNN1, the previous network, gives for the current frame.
//! * Res5 keeps `res5_channels` outputs, and no activation stands behind fc2, as in RCNN1.
//! * The pose heads fc4 and fc5 on fc2 (stage 2 of "Training Strategy") stay at run time: they give the un-fused
//!   world_from_camera.

use candle_core::{Module, Result, Tensor};
use candle_nn::{Linear, VarBuilder, linear};

use crate::config::NetworkConfig;
use crate::heads::{HeadTensors, PoseHead};
use crate::ops::Operators;
use crate::pool::Pool;
use crate::recurrence::{Memory, Recurrent};
use crate::resnet::{Stage, Training};

/// Features of one frame -> fc2 and the absolute pose.
#[derive(Debug, Clone)]
pub struct Rcnn2 {
    res5: Stage,
    operators: Operators,
    pool: Pool,
    lstm: Recurrent,
    fc2: Linear,
    head: PoseHead,
}

impl Rcnn2 {
    /// Keys: `res5`, `reduce` (flattened pool only), `lstm`, `fc2`, `fc4`, `fc5`, `log_variance`.
    ///
    /// # Errors
    /// When a tensor is missing or of another shape.
    pub fn new(config: &NetworkConfig, vb: VarBuilder<'_>) -> Result<Self> {
        let inputs = config.features_shape().0;
        Ok(Self {
            res5: Stage::new(inputs, config.res5_planes(), 3, 2, vb.pp("res5"))?,
            operators: Operators::Cpu,
            pool: Pool::new(config, vb.clone())?,
            lstm: Recurrent::new(config, vb.pp("lstm"))?,
            fc2: linear(config.lstm_hidden, config.fc2, vb.pp("fc2"))?,
            head: PoseHead::new(config, config.fc2, vb)?,
        })
    }

    pub(crate) fn train(&mut self, training: &Training) {
        self.operators = training.operators;
        self.res5.train(training);
        self.pool.train(training);
    }

    /// Features of the current frame (N, C, h, w) -> pooled (N, F).
    ///
    /// # Errors
    /// When shapes do not fit.
    pub fn pooled(&self, features: &Tensor) -> Result<Tensor> {
        let map = self.res5.forward(&self.operators.enter(features)?)?;
        self.pool.forward(&self.operators.leave(&map)?)
    }

    /// One frame: pooled (1, F) -> fc2 (1, fc2); `remember` as in [`Recurrent::step`].
    ///
    /// # Errors
    /// When shapes do not fit.
    pub fn step(&self, pooled: &Tensor, memory: &mut Memory, remember: bool) -> Result<Tensor> {
        self.fc2.forward(&self.lstm.step(pooled, memory, remember)?)
    }

    /// A window: pooled (B, T, F) -> fc2 (B * T, fc2).
    ///
    /// # Errors
    /// When shapes do not fit.
    pub fn window(&self, pooled: &Tensor) -> Result<Tensor> {
        let y = self.lstm.window(pooled)?.flatten(0, 1)?; // (B, T, hidden) -> (B * T, hidden)
        self.fc2.forward(&y)
    }

    /// fc2 (N, fc2) -> absolute pose.
    ///
    /// # Errors
    /// When shapes do not fit.
    pub fn head(&self, fc2: &Tensor) -> Result<HeadTensors> {
        self.head.forward(fc2)
    }
}
