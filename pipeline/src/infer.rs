//! Network input to head outputs, with the state that the network keeps between frames.

use candle_core::Tensor;
use grnet_model::{LoadedModel, ModelError, StepOutput, StreamState};

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
}

impl Infer {
    pub(crate) fn new(model: LoadedModel) -> Self {
        let state = model.network.initial_state();
        Self { model, state }
    }

    pub(crate) fn model(&self) -> &LoadedModel {
        &self.model
    }

    /// Runs the network on one input of shape (3, height, width).
    pub(crate) fn run(&mut self, input: &[f32]) -> Result<StepOutput, InferError> {
        let config = self.model.network.config();
        let (height_px, width_px) = (config.input_height_px, config.input_width_px);
        let image = Tensor::from_slice(input, (1, 3, height_px, width_px), self.model.network.device())
            .map_err(|source| InferError::Input { width_px, height_px, source })?;
        Ok(self.model.network.step(&image, &mut self.state)?)
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
