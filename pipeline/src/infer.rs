//! Network input to head outputs, with the state that the network keeps between frames.

use candle_core::Tensor;
use grnet_model::{FrameRole, LoadedModel, ModelError, StepOutput, StreamState};

/// The network ran into an error; its state is as before the frame.
#[derive(Debug, thiserror::Error)]
pub enum InferError {
    /// The input could not be brought to the network's device.
    #[error("the network's input ({width_px}x{height_px}) cannot be made a tensor")]
    Input {
        /// Width of the input.
        width_px: usize,
        /// Height of the input.
        height_px: usize,
        /// What candle says.
        #[source]
        source: candle_core::Error,
    },
    /// The network failed.
    #[error("the network failed on a frame")]
    Network(#[from] ModelError),
}

/// A loaded model and the state of its stream.
#[derive(Debug)]
pub(crate) struct Infer {
    model: LoadedModel,
    state: StreamState,
    /// From the last key frame to the last frame.
    since_key_s: f64,
}

impl Infer {
    pub(crate) fn new(model: LoadedModel) -> Self {
        let state = model.network.initial_state();
        Self { model, state, since_key_s: 0.0 }
    }

    pub(crate) fn model(&self) -> &LoadedModel {
        &self.model
    }

    /// Runs the network on one input of shape (3, height, width), `dt_s` after the last one (0 for the first).
    pub(crate) fn run(&mut self, input: &[f32], dt_s: f64) -> Result<StepOutput, InferError> {
        let config = self.model.network.config();
        let (height_px, width_px) = (config.input_height_px, config.input_width_px);
        let image = Tensor::from_slice(input, (1, 3, height_px, width_px), self.model.network.device())
            .map_err(|source| InferError::Input { width_px, height_px, source })?;
        let since_key_s = self.since_key_s + dt_s;
        let is_due = since_key_s * 1e3 >= f64::from(config.keyframe_interval_ms);
        let role = if is_due { FrameRole::Key } else { FrameRole::Passing };
        let output = self.model.network.step_as(&image, &mut self.state, role)?;
        self.since_key_s = if output.is_key { 0.0 } else { since_key_s };
        Ok(output)
    }

    /// Forgets everything: the next frame is paired with itself.
    pub(crate) fn reset(&mut self) {
        self.state.reset();
    }

    /// Forgets motion, keeps what RCNN2 remembers of the place.
    pub(crate) fn reset_relative(&mut self) {
        self.state.reset_relative();
    }

    /// Forgets the place, keeps the motion.
    pub(crate) fn reset_global(&mut self) {
        self.state.reset_global();
    }

    /// Puts another model in place. Says whether motion goes on: it does when both have the same CNN1 and
    /// RCNN1 and see the same input; then only the memory of the place is dropped.
    pub(crate) fn swap(&mut self, model: LoadedModel) -> bool {
        let relative = |model: &LoadedModel| model.network.config().branches.relative;
        let goes_on = relative(&self.model)
            && relative(&model)
            && self.model.trunk_hash == model.trunk_hash
            && self.model.network.live_heads().relative == model.network.live_heads().relative
            && self.model.network.config().keyframe_interval_ms
                == model.network.config().keyframe_interval_ms
            && self.model.metadata.preprocessing == model.metadata.preprocessing;
        self.model = model;
        if goes_on {
            self.state.reset_global();
        } else {
            self.state.reset();
        }
        goes_on
    }
}
