//! What a stage is shown: fresh windows, or kept features. With CNN1 frozen its output for a window never changes, so that
//! it need not be computed again.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use candle_core::{Device, Tensor};
use grnet_geometry::Pose;
use grnet_model::Network;
use rand::{Rng as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;

use super::TrainError;
use super::config::{Recipe, Stage};
use super::replicas::Input;
use super::state::Position;
use crate::data::{Batch, Echoed, Loader, Windows};

/// Batches that are made ahead of the training.
const AHEAD: usize = 4;

/// A batch.
#[derive(Debug)]
pub struct Shown {
    /// What the network sees.
    pub input: Input,
    /// The truth.
    pub world_from_camera: Vec<Vec<Pose>>,
    /// Names of the windows.
    pub names: Vec<String>,
}

/// Where batches come from.
#[derive(Debug)]
pub enum Feed {
    /// Made by the loader.
    Fresh(Loader),
    /// Drawn from the kept features.
    Kept {
        /// The features.
        cache: FeatureCache,
        /// Seed of the draws.
        seed: u64,
        /// Windows in a batch.
        batch: usize,
    },
}

/// CNN1's features of some windows, with their poses.
#[derive(Debug)]
pub struct FeatureCache {
    /// (K, C, h, w) of each window.
    features: Vec<Tensor>,
    world_from_camera: Vec<Vec<Pose>>,
    names: Vec<String>,
}

impl Feed {
    /// Starts the loader at the stage's step, or computes the features to keep.
    ///
    /// # Errors
    /// When a window whose features are to be kept cannot be read.
    pub fn open(
        recipe: &Recipe,
        stage: &Stage,
        windows: Arc<dyn Windows>,
        network: &Network,
        at: Position,
        stop: &AtomicBool,
    ) -> Result<Self, TrainError> {
        if stage.cached_windows == 0 {
            let windows: Arc<dyn Windows> = match stage.echo {
                1 => windows,
                times => Arc::new(Echoed::new(windows, times)),
            };
            let loader = Loader::start(windows, stage.batch, at.stage_step, recipe.loader_threads, AHEAD);
            return Ok(Self::Fresh(loader));
        }
        eprintln!("{}: computing CNN1's features of {} windows to keep", stage.name, stage.cached_windows);
        let loader = Loader::start(windows, stage.batch, 0, recipe.loader_threads, AHEAD);
        let cache = FeatureCache::fill(network, loader, stage.cached_windows, stop)?;
        Ok(Self::Kept { cache, seed: recipe.seed, batch: stage.batch })
    }

    /// The batch of a step.
    ///
    /// # Errors
    /// When a window cannot be read.
    pub fn next(&mut self, at: Position) -> Result<Shown, TrainError> {
        match self {
            Self::Fresh(loader) => {
                let Batch { images, world_from_camera, names, .. } = loader.next()?;
                Ok(Shown { input: Input::Images(images), world_from_camera, names })
            }
            Self::Kept { cache, seed, batch } => cache.draw(*seed, at.step, *batch),
        }
    }
}

impl FeatureCache {
    /// Computes the features of the first `count` windows; fewer when `stop` is set meanwhile.
    fn fill(
        network: &Network,
        mut loader: Loader,
        count: u64,
        stop: &AtomicBool,
    ) -> Result<Self, TrainError> {
        let mut cache = Self { features: Vec::new(), world_from_camera: Vec::new(), names: Vec::new() };
        while (cache.features.len() as u64) < count {
            if stop.load(Ordering::Relaxed) && !cache.features.is_empty() {
                break;
            }
            let Batch { images, world_from_camera, names, .. } = loader.next()?;
            let (windows, frames, ..) = images.dims5()?;
            // (B, K, 3, H, W) -> (B K, C, h, w); kept in the host's memory, of which there is more.
            let images = images.flatten(0, 1)?.to_device(network.device())?;
            let features = network.features(&images)?.detach().to_device(&Device::Cpu)?;
            let (_, channels, height, width) = features.dims4()?;
            let by_window = features.reshape((windows, frames, channels, height, width))?;
            for index in 0..windows {
                // Its own numbers only: a view, and candle's `copy` of one, hold the whole batch.
                cache.features.push(by_window.get(index)?.force_contiguous()?);
            }
            cache.world_from_camera.extend(world_from_camera);
            cache.names.extend(names);
        }
        Ok(cache)
    }

    /// A batch of kept windows, drawn for this step.
    fn draw(&self, seed: u64, step: u64, batch: usize) -> Result<Shown, TrainError> {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        rng.set_stream(step);
        let chosen: Vec<usize> = (0..batch).map(|_| rng.random_range(0..self.features.len())).collect();
        let features: Vec<&Tensor> = chosen.iter().map(|index| &self.features[*index]).collect();
        Ok(Shown {
            input: Input::Features(Tensor::stack(&features, 0)?), // B x (K, C, h, w) -> (B, K, C, h, w)
            world_from_camera: chosen.iter().map(|index| self.world_from_camera[*index].clone()).collect(),
            names: chosen.iter().map(|index| self.names[*index].clone()).collect(),
        })
    }
}
