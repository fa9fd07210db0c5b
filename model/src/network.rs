//! The whole network: CNN1, RCNN1, RCNN2 and FCFL over a window of frames or frame by frame.
//!
//! Both forms pair the first frame with itself and give the same numbers. Frame by frame CNN1 runs once: the features of
//! the frame that RCNN1 pairs the next ones with are part of the [`StreamState`].
//!
//! Departure from the paper: that frame need not be the previous one. A stream may keep a *key frame*, as visual odometry
//! does, and measure several frames against it ([`FrameRole`]): the motion since then is several pixels instead of a
//! fraction of one, and only the errors of key frames add up.

use candle_core::{DType, Device, Module, Tensor};
use candle_nn::VarBuilder;

use crate::cnn1::Cnn1;
use crate::config::{ConfigError, NetworkConfig};
use crate::fcfl::Fcfl;
use crate::heads::{HeadOutput, HeadTensors};
use crate::metadata::{HeadState, Heads};
use crate::ops::Operators;
use crate::rcnn1::Rcnn1;
use crate::rcnn2::Rcnn2;
use crate::recurrence::Memory;
use crate::resnet::Training;
use crate::statistics::BatchStatistics;

/// Why a network could not be built or run.
#[derive(Debug, thiserror::Error)]
pub enum ModelError {
    /// The configuration cannot be used.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// Images of another shape or type than the network reads.
    #[error("images of shape {found:?} ({dtype:?}); the network reads {expected} as F32")]
    Images {
        /// Shape found.
        found: Vec<usize>,
        /// Element type found.
        dtype: DType,
        /// What the network reads.
        expected: String,
    },
    /// Features of another shape or type than CNN1 gives.
    #[error("features of shape {found:?} ({dtype:?}); CNN1 gives {expected:?} as F32 for that window")]
    Features {
        /// Shape found.
        found: Vec<usize>,
        /// Element type found.
        dtype: DType,
        /// Shape that the window needs.
        expected: Vec<usize>,
    },
    /// A tensor operation failed.
    #[error("cannot {action}")]
    Tensor {
        /// What was tried.
        action: &'static str,
        /// What candle says.
        #[source]
        source: candle_core::Error,
    },
}

fn failed(action: &'static str) -> impl FnOnce(candle_core::Error) -> ModelError {
    move |source| ModelError::Tensor { action, source }
}

/// What a frame of a stream is to those that follow.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum FrameRole {
    /// RCNN1 pairs the next frames with it and remembers the pair that it was in.
    Key,
    /// RCNN1 measures it and forgets it. RCNN2 remembers every frame. The first frame of a stream is a key frame all the same.
    Passing,
}

/// Outputs over a window; every tensor is (B, T, n). A branch that does not exist, or a head that is not live, is none.
#[derive(Debug, Clone)]
pub struct WindowOutput {
    /// camera_previous_from_camera_current of every frame, from RCNN1; previous in the window.
    pub relative: Option<HeadTensors>,
    /// world_from_camera of every frame, from RCNN2.
    pub global: Option<HeadTensors>,
    /// world_from_camera of every frame, from FCFL.
    pub fused: Option<HeadTensors>,
}

/// Outputs of one streamed frame as tensors; every tensor is (1, n).
#[derive(Debug, Clone)]
pub struct StepTensors {
    /// CNN1's features, (1, C, h, w).
    pub features: Tensor,
    /// Whether this frame is the key frame of those that follow.
    pub is_key: bool,
    /// camera_key_from_camera_current, from RCNN1: the motion since the last key frame before this one.
    pub relative: Option<HeadTensors>,
    /// world_from_camera, from RCNN2.
    pub global: Option<HeadTensors>,
    /// world_from_camera, from FCFL.
    pub fused: Option<HeadTensors>,
}

/// Outputs of one streamed frame. A branch that does not exist, or a head that is not live, is none.
#[derive(Debug, Clone, PartialEq)]
pub struct StepOutput {
    /// Whether this frame is the key frame of those that follow.
    pub is_key: bool,
    /// camera_key_from_camera_current, from RCNN1: the motion since the last key frame before this one.
    pub relative: Option<HeadOutput>,
    /// world_from_camera, from RCNN2.
    pub global: Option<HeadOutput>,
    /// world_from_camera, from FCFL.
    pub fused: Option<HeadOutput>,
}

/// What a stream remembers between frames: the features of the last key frame and the memory of both recurrent branches.
#[derive(Debug, Clone, Default)]
pub struct StreamState {
    key_features: Option<Tensor>,
    relative: Memory,
    global: Memory,
}

impl StreamState {
    /// Forgets everything: the next frame is paired with itself.
    pub fn reset(&mut self) {
        *self = Self::default();
    }

    /// Forgets motion: the key frame and the memory of RCNN1. The next frame is paired with itself.
    pub fn reset_relative(&mut self) {
        self.key_features = None;
        self.relative = Memory::default();
    }

    /// Forgets place: the memory of RCNN2.
    pub fn reset_global(&mut self) {
        self.global = Memory::default();
    }

    /// CNN1's features of the last key frame, (1, C, h, w); none before the first frame and after a reset.
    pub fn key_features(&self) -> Option<&Tensor> {
        self.key_features.as_ref()
    }

    /// Memory of RCNN1.
    pub fn relative(&self) -> &Memory {
        &self.relative
    }

    /// Memory of RCNN2.
    pub fn global(&self) -> &Memory {
        &self.global
    }
}

/// CNN1 and the sub-networks that the configuration asks for.
#[derive(Debug, Clone)]
pub struct Network {
    config: NetworkConfig,
    device: Device,
    live: Heads,
    cnn1: Cnn1,
    rcnn1: Option<Rcnn1>,
    rcnn2: Option<Rcnn2>,
    fcfl: Option<Fcfl>,
}

impl Network {
    /// Builds the network from the tensors behind `vb` (keys `cnn1`, `rcnn1`, `rcnn2`, `fcfl`), all heads live.
    ///
    /// # Errors
    /// When the configuration is out of range, or a tensor is missing or of another shape.
    pub fn new(config: &NetworkConfig, vb: VarBuilder<'_>) -> Result<Self, ModelError> {
        config.validate()?;
        let build = || -> candle_core::Result<Self> {
            let branches = config.branches;
            let rcnn1 = branches.relative.then(|| Rcnn1::new(config, vb.pp("rcnn1"))).transpose()?;
            let rcnn2 = branches.global.then(|| Rcnn2::new(config, vb.pp("rcnn2"))).transpose()?;
            let fcfl = branches.fusion.then(|| Fcfl::new(config, vb.pp("fcfl"))).transpose()?;
            Ok(Self {
                config: config.clone(),
                device: vb.device().clone(),
                live: Heads::all_of(config),
                cnn1: Cnn1::new(config, vb.pp("cnn1"))?,
                rcnn1,
                rcnn2,
                fcfl,
            })
        };
        build().map_err(failed("build the network from its weights"))
    }

    /// As [`Network::new`], for training: every operator has a fast gradient. `vb` may hand out variables (trained),
    /// plain tensors (frozen) and tensors computed from variables.
    ///
    /// With `statistics`, every batch norm whose weight is trained normalises by the statistics of its batch and records
    /// them there; frozen ones, and all without `statistics`, use their running statistics.
    ///
    /// # Errors
    /// As [`Network::new`].
    pub fn for_training(
        config: &NetworkConfig,
        vb: VarBuilder<'_>,
        statistics: Option<BatchStatistics>,
    ) -> Result<Self, ModelError> {
        let operators = Operators::for_device(vb.device());
        Self::for_training_with(config, vb, statistics, operators)
    }

    /// As [`Network::for_training`] with these operators: the portable ones run on the CPU as well.
    ///
    /// # Errors
    /// As [`Network::new`].
    pub fn for_training_with(
        config: &NetworkConfig,
        vb: VarBuilder<'_>,
        statistics: Option<BatchStatistics>,
        operators: Operators,
    ) -> Result<Self, ModelError> {
        let mut network = Self::new(config, vb)?;
        let training = Training { statistics, operators };
        network.cnn1.train(&training);
        if let Some(rcnn1) = &mut network.rcnn1 {
            rcnn1.train(&training);
        }
        if let Some(rcnn2) = &mut network.rcnn2 {
            rcnn2.train(&training);
        }
        Ok(network)
    }

    /// The same network, of which only these heads give an output.
    #[must_use]
    pub fn with_live_heads(mut self, live: Heads) -> Self {
        self.live = live;
        self
    }

    /// The same network, whose RCNN1 adds `shift` [translation, rotation] to its log-variances; nothing changes without that head.
    ///
    /// # Errors
    /// When the device has no memory.
    pub fn with_shifted_motion_log_variance(mut self, shift: [f64; 6]) -> Result<Self, ModelError> {
        if let Some(rcnn1) = &mut self.rcnn1 {
            rcnn1.shift_log_variance(shift).map_err(failed("shift the log-variances of RCNN1"))?;
        }
        Ok(self)
    }

    /// The configuration it was built from.
    pub fn config(&self) -> &NetworkConfig {
        &self.config
    }

    /// The device that holds the weights; images must be on it.
    pub fn device(&self) -> &Device {
        &self.device
    }

    /// The heads that give an output.
    pub fn live_heads(&self) -> Heads {
        self.live
    }

    /// The state before the first frame of a stream.
    pub fn initial_state(&self) -> StreamState {
        StreamState::default()
    }

    /// A window of T frames from its first frame on: images (B, T, 3, H, W) -> poses (B, T, n).
    ///
    /// T is K in training; any T >= 1 is allowed and equals T calls of [`Network::step`] from the initial state. Each frame is
    /// paired with the one before it, so RCNN1's last output also equals that of a stream whose key frames were the window's
    /// earlier frames, whatever passed between them.
    ///
    /// # Errors
    /// When the images are of another shape or type, or a tensor operation fails.
    pub fn window(&self, images: &Tensor) -> Result<WindowOutput, ModelError> {
        let (height, width) = (self.config.input_height_px, self.config.input_width_px);
        match *images.dims() {
            [batch, frames, 3, h, w]
                if batch > 0 && frames > 0 && (h, w) == (height, width) && images.dtype() == DType::F32 =>
            {
                let run = || {
                    let features = self.cnn1.forward(&images.flatten(0, 1)?)?; // (B, T, 3, H, W) -> (B * T, C, h, w)
                    self.window_tensors(&features, batch, frames)
                };
                run().map_err(failed("run the network over a window"))
            }
            _ => Err(wrong_images(images, format!("(B, T, 3, {height}, {width})"))),
        }
    }

    /// CNN1 alone: images (N, 3, H, W) -> features (N, C, h, w).
    ///
    /// # Errors
    /// When the images are of another shape or type, or a tensor operation fails.
    pub fn features(&self, images: &Tensor) -> Result<Tensor, ModelError> {
        let (height, width) = (self.config.input_height_px, self.config.input_width_px);
        match *images.dims() {
            [n, 3, h, w] if n > 0 && (h, w) == (height, width) && images.dtype() == DType::F32 => {
                self.cnn1.forward(images).map_err(failed("run CNN1"))
            }
            _ => Err(wrong_images(images, format!("(N, 3, {height}, {width})"))),
        }
    }

    /// As [`Network::window`] from the features of its frames, (B * T, C, h, w) in the order of [`Tensor::flatten`].
    ///
    /// # Errors
    /// When the features are of another shape or type, or a tensor operation fails.
    pub fn window_from_features(
        &self,
        features: &Tensor,
        batch: usize,
        frames: usize,
    ) -> Result<WindowOutput, ModelError> {
        let (channels, height, width) = self.config.features_shape();
        let expected = [batch * frames, channels, height, width];
        if features.dims() != expected || batch * frames == 0 || features.dtype() != DType::F32 {
            return Err(ModelError::Features {
                found: features.dims().to_vec(),
                dtype: features.dtype(),
                expected: expected.to_vec(),
            });
        }
        self.window_tensors(features, batch, frames)
            .map_err(failed("run the network over a window's features"))
    }

    /// One frame of a stream, which the next one is paired with, as in the paper: [`Network::step_as`] with
    /// [`FrameRole::Key`].
    ///
    /// # Errors
    /// As [`Network::step_as`].
    pub fn step(&self, image: &Tensor, state: &mut StreamState) -> Result<StepOutput, ModelError> {
        self.step_as(image, state, FrameRole::Key)
    }

    /// One frame of a stream: image (1, 3, H, W) -> poses as plain numbers; `state` moves on.
    ///
    /// # Errors
    /// When the image is of another shape or type, or a tensor operation fails; `state` is then as before.
    pub fn step_as(
        &self,
        image: &Tensor,
        state: &mut StreamState,
        role: FrameRole,
    ) -> Result<StepOutput, ModelError> {
        let mut next = state.clone();
        let tensors = self.step_tensors(image, &mut next, role)?;
        let numbers = |head: &Option<HeadTensors>| head.as_ref().map(HeadTensors::to_output).transpose();
        let read = || -> candle_core::Result<StepOutput> {
            Ok(StepOutput {
                is_key: tensors.is_key,
                relative: numbers(&tensors.relative)?,
                global: numbers(&tensors.global)?,
                fused: numbers(&tensors.fused)?,
            })
        };
        let output = read().map_err(failed("read the poses of a frame"))?;
        *state = next;
        Ok(output)
    }

    /// As [`Network::step_as`], with the outputs left as tensors and CNN1's features beside them.
    ///
    /// # Errors
    /// As [`Network::step_as`].
    pub fn step_tensors(
        &self,
        image: &Tensor,
        state: &mut StreamState,
        role: FrameRole,
    ) -> Result<StepTensors, ModelError> {
        let (height, width) = (self.config.input_height_px, self.config.input_width_px);
        if image.dims() != [1, 3, height, width] || image.dtype() != DType::F32 {
            return Err(wrong_images(image, format!("(1, 3, {height}, {width})")));
        }
        let mut next = state.clone();
        let output = self.frame(image, &mut next, role).map_err(failed("run the network on a frame"))?;
        *state = next;
        Ok(output)
    }

    fn frame(
        &self,
        image: &Tensor,
        state: &mut StreamState,
        role: FrameRole,
    ) -> candle_core::Result<StepTensors> {
        let features = self.cnn1.forward(image)?.detach(); // (1, C, h, w)
        // The first frame, and the first after a reset, is a key frame and paired with itself.
        let is_key = role == FrameRole::Key || state.key_features.is_none();
        let key = state.key_features.get_or_insert_with(|| features.clone()).clone();
        let fc1 = match &self.rcnn1 {
            Some(rcnn1) => {
                let pooled = rcnn1.pooled(&key, &features)?; // (1, F)
                Some(rcnn1.step(&pooled, &mut state.relative, is_key)?) // (1, fc1)
            }
            None => None,
        };
        let fc2 = match &self.rcnn2 {
            Some(rcnn2) => {
                let pooled = rcnn2.pooled(&features)?; // (1, F)
                Some(rcnn2.step(&pooled, &mut state.global, true)?) // (1, fc2)
            }
            None => None,
        };
        if is_key {
            state.key_features = Some(features.clone());
        }
        let (relative, global, fused) = self.heads(fc1.as_ref(), fc2.as_ref())?;
        Ok(StepTensors { features, is_key, relative, global, fused })
    }

    /// The sub-networks on features (B * T, C, h, w).
    fn window_tensors(
        &self,
        features: &Tensor,
        batch: usize,
        frames: usize,
    ) -> candle_core::Result<WindowOutput> {
        let (_, channels, height, width) = features.dims4()?;
        let fc1 = match &self.rcnn1 {
            Some(rcnn1) => {
                let by_window = features.reshape((batch, frames, channels, height, width))?; // (B, T, C, h, w)
                let mut parts = vec![by_window.narrow(1, 0, 1)?];
                if frames > 1 {
                    parts.push(by_window.narrow(1, 0, frames - 1)?);
                }
                // Frame i - 1 beside frame i, frame 0 beside itself: (B, T, C, h, w) -> (B * T, C, h, w).
                let previous = Tensor::cat(&parts, 1)?.flatten(0, 1)?;
                let pooled = rcnn1.pooled(&previous, features)?; // (B * T, F)
                Some(rcnn1.window(&pooled.reshape((batch, frames, ()))?)?) // (B, T, F) -> (B * T, fc1)
            }
            None => None,
        };
        let fc2 = match &self.rcnn2 {
            Some(rcnn2) => {
                let pooled = rcnn2.pooled(features)?; // (B * T, F)
                Some(rcnn2.window(&pooled.reshape((batch, frames, ()))?)?) // (B, T, F) -> (B * T, fc2)
            }
            None => None,
        };
        let (relative, global, fused) = self.heads(fc1.as_ref(), fc2.as_ref())?;
        let unflatten = |head: Option<HeadTensors>| head.map(|h| h.unflatten(batch, frames)).transpose();
        Ok(WindowOutput {
            relative: unflatten(relative)?,
            global: unflatten(global)?,
            fused: unflatten(fused)?,
        })
    }

    /// The live heads on fc1 (N, fc1) and fc2 (N, fc2): relative, global, fused.
    fn heads(&self, fc1: Option<&Tensor>, fc2: Option<&Tensor>) -> candle_core::Result<ThreeHeads> {
        let relative = match (&self.rcnn1, fc1) {
            (Some(rcnn1), Some(fc1)) if self.live.relative.pose => Some(rcnn1.head(fc1)?),
            _ => None,
        };
        let global = match (&self.rcnn2, fc2) {
            (Some(rcnn2), Some(fc2)) if self.live.global.pose => Some(rcnn2.head(fc2)?),
            _ => None,
        };
        let fused = match (&self.fcfl, fc1, fc2) {
            (Some(fcfl), Some(fc1), Some(fc2)) if self.live.fused.pose => Some(fcfl.forward(fc1, fc2)?),
            _ => None,
        };
        let mask = |head: Option<HeadTensors>, live: HeadState| {
            head.map(|h| HeadTensors { log_variance: h.log_variance.filter(|_| live.log_variance), ..h })
        };
        Ok((mask(relative, self.live.relative), mask(global, self.live.global), mask(fused, self.live.fused)))
    }
}

type ThreeHeads = (Option<HeadTensors>, Option<HeadTensors>, Option<HeadTensors>);

fn wrong_images(images: &Tensor, expected: String) -> ModelError {
    ModelError::Images { found: images.dims().to_vec(), dtype: images.dtype(), expected }
}
