//! Network input to head outputs, with the state that the network keeps between frames.

use candle_core::{Device, Tensor};
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
    /// RCNN1; then only the memory of the place is dropped.
    pub(crate) fn swap(&mut self, model: LoadedModel) -> Result<bool, InferError> {
        let same_trunk = has_same_trunk(&self.model, &model)?;
        self.model = model;
        if same_trunk {
            self.state.reset_global();
        } else {
            self.state.reset();
        }
        Ok(same_trunk)
    }
}

/// Whether two models have the same CNN1 and RCNN1, found out by running both on the same two images from the
/// initial state: equal features and equal relative motion, bit by bit. (A model's hash covers its scene too.)
fn has_same_trunk(a: &LoadedModel, b: &LoadedModel) -> Result<bool, InferError> {
    let (config_a, config_b) = (a.network.config(), b.network.config());
    let trunk_of = |model: &LoadedModel| {
        let mut config = model.network.config().clone();
        config.branches =
            grnet_model::Branches { relative: config.branches.relative, global: false, fusion: false };
        // What only RCNN2 and FCFL have.
        (config.fc2, config.fc3) = (0, 0);
        (config, model.network.live_heads().relative, model.metadata.preprocessing.clone())
    };
    if trunk_of(a) != trunk_of(b) || !config_a.branches.relative || !config_b.branches.relative {
        return Ok(false);
    }
    let (mut state_a, mut state_b) = (a.network.initial_state(), b.network.initial_state());
    let (height_px, width_px) = (config_a.input_height_px, config_a.input_width_px);
    for seed in [1, 2] {
        let probe = probe(height_px, width_px, seed);
        let run = |model: &LoadedModel, state: &mut StreamState| -> Result<_, InferError> {
            let image = Tensor::from_slice(&probe, (1, 3, height_px, width_px), model.network.device())
                .map_err(|source| InferError::Input { width_px, height_px, source })?;
            let tensors = model.network.step_tensors(&image, state)?;
            let numbers = |tensor: &Tensor| tensor.to_device(&Device::Cpu)?.flatten_all()?.to_vec1::<f32>();
            let read = || -> candle_core::Result<_> {
                let mut values = numbers(&tensors.features)?;
                for (h, c) in state.relative().lstm_state().iter().flat_map(|state| state.layers()) {
                    values.extend(numbers(h)?);
                    values.extend(numbers(c)?);
                }
                if let Some(relative) = &tensors.relative {
                    values.extend(numbers(&relative.translation)?);
                    values.extend(numbers(&relative.rotation)?);
                }
                Ok(values)
            };
            read().map_err(|source| InferError::Input { width_px, height_px, source })
        };
        let (values_a, values_b) = (run(a, &mut state_a)?, run(b, &mut state_b)?);
        let bits = |values: &[f32]| values.iter().map(|value| value.to_bits()).collect::<Vec<_>>();
        if bits(&values_a) != bits(&values_b) {
            return Ok(false);
        }
    }
    Ok(true)
}

/// Noise in -1..1 from a xorshift generator.
fn probe(height_px: usize, width_px: usize, seed: u32) -> Vec<f32> {
    let mut state = 0x9E37_79B9 ^ seed;
    std::iter::repeat_with(|| {
        state ^= state << 13;
        state ^= state >> 17;
        state ^= state << 5;
        f32::from((state >> 16) as u16) / 32768.0 - 1.0
    })
    .take(3 * height_px * width_px)
    .collect()
}
