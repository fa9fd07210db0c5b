//! RCNN1, the relative sub-network (section "RCNNs-type relative sub-networks (RCNN1)"): the features of the previous
//! and the current frame, concatenated, go through the last residual blocks of ResNet-50 (Res 5), two LSTMs and fc1.
//!
//! Departures and readings:
//! * "Previous" is the last key frame, which is the frame before only where every frame is one, as in the paper
//!   ([`FrameRole`](crate::FrameRole)).
//! * Res5 keeps `res5_channels` outputs (2048 in ResNet-50); the paper's "W x H x 1024" is what Res4 gives per frame.
//! * No activation stands behind fc1: the paper names none.
//! * The pose heads fc4 and fc5, which the paper puts on fc1 "for the time being" of stage 1, stay at run time: they give
//!   the relative pose, camera_previous_from_camera_current (Eq. 1 read as a motion that does not depend on the world).

use candle_core::{Module, Result, Tensor};
use candle_nn::{Linear, VarBuilder, linear};

use crate::config::NetworkConfig;
use crate::heads::{HeadTensors, PoseHead};
use crate::ops::Operators;
use crate::pool::Pool;
use crate::recurrence::{Memory, Recurrent};
use crate::resnet::{Stage, Training};

/// Features of two frames -> fc1 and the relative pose.
#[derive(Debug, Clone)]
pub struct Rcnn1 {
    res5: Stage,
    operators: Operators,
    pool: Pool,
    lstm: Recurrent,
    fc1: Linear,
    head: PoseHead,
}

impl Rcnn1 {
    /// Keys: `res5`, `reduce` (flattened pool only), `lstm`, `fc1`, `fc4`, `fc5`, `log_variance`.
    ///
    /// # Errors
    /// When a tensor is missing or of another shape.
    pub fn new(config: &NetworkConfig, vb: VarBuilder<'_>) -> Result<Self> {
        let inputs = 2 * config.features_shape().0;
        Ok(Self {
            res5: Stage::new(inputs, config.res5_planes(), 3, 2, vb.pp("res5"))?,
            operators: Operators::Cpu,
            pool: Pool::new(config, vb.clone())?,
            lstm: Recurrent::new(config, vb.pp("lstm"))?,
            fc1: linear(config.lstm_hidden, config.fc1, vb.pp("fc1"))?,
            head: PoseHead::new(config, config.fc1, vb)?,
        })
    }

    pub(crate) fn train(&mut self, training: &Training) {
        self.operators = training.operators;
        self.res5.train(training);
        self.pool.train(training);
    }

    /// Features of the previous and of the current frame, (N, C, h, w) each -> pooled (N, F).
    ///
    /// # Errors
    /// When shapes do not fit.
    pub fn pooled(&self, previous: &Tensor, current: &Tensor) -> Result<Tensor> {
        let pair = Tensor::cat(&[previous, current], 1)?; // 2 x (N, C, h, w) -> (N, 2 C, h, w)
        let map = self.res5.forward(&self.operators.enter(&pair)?)?;
        self.pool.forward(&self.operators.leave(&map)?)
    }

    /// One frame: pooled (1, F) -> fc1 (1, fc1); `remember` as in [`Recurrent::step`].
    ///
    /// # Errors
    /// When shapes do not fit.
    pub fn step(&self, pooled: &Tensor, memory: &mut Memory, remember: bool) -> Result<Tensor> {
        self.fc1.forward(&self.lstm.step(pooled, memory, remember)?)
    }

    /// A window: pooled (B, T, F) -> fc1 (B * T, fc1).
    ///
    /// # Errors
    /// When shapes do not fit.
    pub fn window(&self, pooled: &Tensor) -> Result<Tensor> {
        let y = self.lstm.window(pooled)?.flatten(0, 1)?; // (B, T, hidden) -> (B * T, hidden)
        self.fc1.forward(&y)
    }

    /// Adds to the log-variances of the motion [translation, rotation].
    ///
    /// # Errors
    /// When the device has no memory.
    pub fn shift_log_variance(&mut self, shift: [f64; 6]) -> Result<()> {
        self.head.shift_log_variance(shift)
    }

    /// fc1 (N, fc1) -> relative pose.
    ///
    /// # Errors
    /// When shapes do not fit.
    pub fn head(&self, fc1: &Tensor) -> Result<HeadTensors> {
        self.head.forward(fc1)
    }
}
