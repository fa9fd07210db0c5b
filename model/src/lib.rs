//! The global-relative network of Lin et al., "Deep Global-Relative Networks for End-to-End 6-DoF Visual Localization
//! and Odometry" (section "Proposed Model"), for inference on candle.
//!
//! ```text
//!  image ── CNN1 ──┬── with those of a key frame ── RCNN1 ── fc1 ──┬── relative pose
//!                  │                                                ├── FCFL ── fused absolute pose
//!                  └────────────────────────────── RCNN2 ── fc2 ───┴── global absolute pose
//! ```
//!
//! One file per network: [`cnn1`], [`rcnn1`], [`rcnn2`], [`fcfl`]; [`network`] puts them together. A [`NetworkConfig`]
//! fixes every shape, a [`Checkpoint`] holds the weights, a [`LoadedModel`] is both, ready to run.
//!
//! No function of this crate takes a pose: images and weights are the only inputs, in windows and in streams, so a
//! ground-truth pose cannot leak into a prediction.
//!
//! ```
//! use grnet_model::{LoadedModel, NetworkConfig, candle_core::{Device, Tensor, DType}};
//!
//! let config = NetworkConfig { width: 0.125, input_height_px: 48, input_width_px: 64, ..NetworkConfig::grnet_small() };
//! let model = LoadedModel::untrained(&config, 7)?;
//! let mut state = model.network.initial_state();
//! let image = Tensor::zeros((1, 3, 48, 64), DType::F32, &Device::Cpu)?; // normalised as model.metadata.preprocessing says
//! let output = model.network.step(&image, &mut state)?;
//! let fused = output.fused.unwrap();
//! assert_eq!(fused.rotation_raw.len(), 6);
//! assert!(fused.log_variance.is_none(), "an untrained model has no calibrated uncertainty");
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
#![deny(missing_docs)]

pub mod checkpoint;
pub mod cnn1;
pub mod config;
pub mod device;
pub mod fcfl;
pub mod heads;
pub mod layout;
pub mod loaded;
pub mod lstm;
pub mod metadata;
pub mod network;
pub mod ops;
pub mod pool;
pub mod preprocessing;
pub mod rcnn1;
pub mod rcnn2;
pub mod recurrence;
pub mod resnet;
pub mod statistics;
pub mod untrained;

mod checkpoint_error;
mod checkpoint_parts;
mod tensors;

pub use candle_core;
pub use candle_nn;

pub use checkpoint::{Checkpoint, Storage};
pub use checkpoint_error::CheckpointError;
pub use config::{Branches, ConfigError, NetworkConfig, PRESETS, Recurrence, Rotation, SpatialPool};
pub use heads::{HeadOutput, HeadTensors};
pub use layout::{Layer, LayerKind, TensorSpec};
pub use loaded::LoadedModel;
pub use metadata::{
    CameraIntrinsics, CheckpointMetadata, HeadState, Heads, Kind, Provenance, RigidTransform, SceneInfo,
};
pub use network::{FrameRole, ModelError, Network, StepOutput, StepTensors, StreamState, WindowOutput};
pub use preprocessing::{Colour, Filter, Preprocessing, ResizePolicy};
pub use statistics::{BatchStatistics, LayerStatistics};
