//! The recipe of a training: one TOML file, every key documented here; unknown keys are refused.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use grnet_model::NetworkConfig;
use serde::{Deserialize, Serialize};

use super::parameters::Part;
use super::schedule::{Decay, Schedule};
use super::sources::DataConfig;
use super::{ConfigError, TrainError};
use crate::device::DeviceName;
use crate::loss::{Head, Loss};

/// A recipe.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Recipe {
    /// Seed of the initial weights and of every draw of windows.
    #[serde(default)]
    pub seed: u64,
    /// Threads that compute [default: one per core]. A run resumes bit for bit with the same number only.
    pub threads: Option<usize>,
    /// Threads that make windows ahead of the training.
    #[serde(default = "one")]
    pub loader_threads: usize,
    /// Where it computes: `cpu`, `cuda` or `cuda:N`. Only on the CPU do runs repeat and resume bit for bit.
    #[serde(default)]
    pub device: DeviceName,
    /// On a GPU: matrix products round their factors to 10 bits (TF32), which is faster.
    #[serde(default)]
    pub tf32: bool,
    /// The paper's losses as written, or with learned weights and a proper rotation residual, of squares or of lengths.
    #[serde(default = "learned")]
    pub loss: Loss,
    /// The network: `preset`, and any field of it that differs [default: that of `init.checkpoint`].
    pub network: Option<NetworkTable>,
    /// Where the weights start; drawn from the seed without it.
    #[serde(default)]
    pub init: Option<Init>,
    /// Where windows come from, by name.
    pub data: BTreeMap<String, DataConfig>,
    /// Held-out windows, for the curves and to calibrate the uncertainties.
    #[serde(default)]
    pub validation: Option<Validation>,
    /// What is trained, one after the other.
    #[serde(rename = "stage")]
    pub stages: Vec<Stage>,
    /// The place that the global branch learns.
    #[serde(default)]
    pub scene: Option<Scene>,
    /// Store the final weights in half precision.
    #[serde(default)]
    pub half_precision: bool,
    /// Seconds between two saved states.
    #[serde(default = "a_minute")]
    pub save_every_s: u64,
}

/// `preset = "..."` and fields of [`NetworkConfig`] that replace those of the preset.
#[derive(Debug, Clone, Deserialize)]
pub struct NetworkTable {
    preset: String,
    #[serde(flatten)]
    overrides: toml::Table,
}

/// Where the weights start.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Init {
    /// A checkpoint of ours: tensors of equal names and shapes are taken over.
    pub checkpoint: Option<PathBuf>,
    /// Parts that are taken over from the checkpoint [default: all that it holds].
    pub parts: Option<Vec<Part>>,
    /// ResNet-50 weights (torchvision or timm names), a file or `hf:owner/repo/file`.
    pub resnet50: Option<String>,
}

/// Held-out windows.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Validation {
    /// Name of the data set they come from.
    pub data: String,
    /// How many windows.
    #[serde(default = "validation_windows")]
    pub windows: u64,
    /// Steps between two validations.
    #[serde(default = "validation_steps")]
    pub every_steps: u64,
}

/// One stage of the training.
#[derive(Debug, Clone, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct Stage {
    /// Name in logs and curves.
    pub name: String,
    /// Name of the data set.
    pub data: String,
    /// Parts that change; the others are frozen, their batch norms included.
    pub train: Vec<Part>,
    /// Weights of the heads' losses.
    pub loss: LossWeights,
    /// Steps of the optimizer.
    pub steps: u64,
    /// Windows in a batch.
    pub batch: usize,
    /// Learning rate of Adam.
    #[serde(default = "paper_rate")]
    pub learning_rate: f64,
    /// How it falls.
    #[serde(default)]
    pub decay: Decay,
    /// Steps of a linear rise to the full rate.
    #[serde(default)]
    pub warmup_steps: u64,
    /// Largest global norm of the gradient; larger ones are scaled down. 0 clips nothing.
    #[serde(default = "clip")]
    pub clip_norm: f64,
    /// Batch norms keep their running statistics, as with pretrained weights and small batches.
    #[serde(default)]
    pub freeze_batch_norm: bool,
    /// Every window is shown so many times, a few hundred windows apart, every other time backwards: for windows that cost
    /// more to make than to train on.
    #[serde(default = "once")]
    pub echo: u64,
    /// With CNN1 frozen: its features of so many windows are computed once and kept in memory; 0 computes them at
    /// every step.
    #[serde(default)]
    pub cached_windows: u64,
}

/// Weights of the losses of the three heads; 0 leaves a head out.
#[derive(Debug, Clone, Copy, Default, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields, default)]
pub struct LossWeights {
    /// Eq. (3) on the relative head of RCNN1.
    pub relative: f64,
    /// Eq. (4) on the global head of RCNN2.
    pub global: f64,
    /// Eq. (4) on FCFL.
    pub fused: f64,
    /// Likelihood of the residuals under the log-variance heads of the heads above; moves those layers only.
    pub uncertainty: f64,
}

/// The place that the global branch learns.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Scene {
    /// Stable identifier.
    pub id: String,
    /// Name for people [default: the identifier].
    pub name: Option<String>,
}

impl Recipe {
    /// Reads and checks a recipe; paths in it are relative to its folder.
    ///
    /// # Errors
    /// When the file cannot be read, a key is unknown or a value cannot be used; the message names file and line or key.
    pub fn read(path: &Path) -> Result<(Self, String), TrainError> {
        let text = std::fs::read_to_string(path)
            .map_err(|source| ConfigError::Read { path: path.into(), source })?;
        let recipe = Self::parse(&text, path)?;
        Ok((recipe, text))
    }

    /// [`Recipe::read`] of a text; `origin` is what errors name and what relative paths start from.
    ///
    /// # Errors
    /// As [`Recipe::read`].
    pub fn parse(text: &str, origin: &Path) -> Result<Self, TrainError> {
        let mut recipe: Self = toml::from_str(text)
            .map_err(|source| ConfigError::Parse { path: origin.into(), source: Box::new(source) })?;
        recipe.check().map_err(|(key, problem)| ConfigError::Value { path: origin.into(), key, problem })?;
        let folder = origin.parent().unwrap_or(Path::new(""));
        recipe.data.values_mut().for_each(|data| data.resolve(folder));
        if let Some(checkpoint) = recipe.init.as_mut().and_then(|init| init.checkpoint.as_mut()) {
            *checkpoint = folder.join(&checkpoint);
        }
        Ok(recipe)
    }

    /// The heads that any stage trains.
    pub fn heads(&self) -> Vec<Head> {
        let weighed =
            |head: &Head| self.stages.iter().any(|stage| stage.loss.heads().any(|(of, _)| of == *head));
        [Head::Relative, Head::Global, Head::Fused].into_iter().filter(weighed).collect()
    }

    fn check(&self) -> Result<(), (String, String)> {
        let bad = |key: &str, problem: String| Err((key.to_owned(), problem));
        if self.stages.is_empty() {
            return bad("stage", "there is none; add at least one [[stage]]".into());
        }
        if self.threads == Some(0) {
            return bad("threads", "0 threads compute nothing; use 1 or more".into());
        }
        let known = |name: &str| {
            let names = self.data.keys().map(String::as_str).collect::<Vec<_>>().join(", ");
            if self.data.contains_key(name) {
                return Ok(());
            }
            Err(format!("no data set \"{name}\" is described; there are: {names}"))
        };
        if let Some(validation) = &self.validation {
            known(&validation.data).map_err(|problem| ("validation.data".to_owned(), problem))?;
        }
        for stage in &self.stages {
            let key = |field: &str| format!("stage \"{}\": {field}", stage.name);
            known(&stage.data).map_err(|problem| (key("data"), problem))?;
            stage.check().map_err(|(field, problem)| (key(field), problem))?;
        }
        let init = self.init.as_ref();
        if init.is_some_and(|init| init.checkpoint.is_some() == init.resnet50.is_some()) {
            return bad("init", "give either `checkpoint` or `resnet50`".into());
        }
        Ok(())
    }
}

impl LossWeights {
    /// The heads that count, and how much.
    pub fn heads(&self) -> impl Iterator<Item = (Head, f64)> + use<> {
        [(Head::Relative, self.relative), (Head::Global, self.global), (Head::Fused, self.fused)]
            .into_iter()
            .filter(|(_, weight)| *weight > 0.0)
    }
}

impl Stage {
    fn check(&self) -> Result<(), (&'static str, String)> {
        let LossWeights { relative, global, fused, uncertainty } = self.loss;
        let weights = [relative, global, fused, uncertainty];
        if weights.iter().any(|w| !(w.is_finite() && *w >= 0.0)) || weights[..3].iter().all(|w| *w == 0.0) {
            return Err((
                "loss",
                format!("{:?}: numbers from 0 on are expected, one head at least", self.loss),
            ));
        }
        if self.train.is_empty() {
            return Err(("train", "no part is trained; name some of cnn1, rcnn1, rcnn2, fcfl".into()));
        }
        if self.batch == 0 || self.steps == 0 || self.echo == 0 {
            return Err(("steps", "`steps`, `batch` and `echo` must be 1 or more".into()));
        }
        if !(self.learning_rate.is_finite() && self.learning_rate > 0.0) {
            return Err(("learning_rate", format!("{} is not a positive number", self.learning_rate)));
        }
        if !(self.clip_norm.is_finite() && self.clip_norm >= 0.0) {
            return Err(("clip_norm", format!("{} is not a number from 0 on", self.clip_norm)));
        }
        if self.cached_windows > 0 && self.train.contains(&Part::Cnn1) {
            return Err(("cached_windows", "features can be kept only while cnn1 is frozen".into()));
        }
        Ok(())
    }

    /// Whether a network has the heads that the stage weighs.
    ///
    /// # Errors
    /// The field, and what is wrong with it.
    pub fn check_network(&self, network: &NetworkConfig) -> Result<(), (&'static str, String)> {
        let LossWeights { relative, global, fused, uncertainty } = self.loss;
        for (weight, exists, head) in [
            (relative, network.branches.relative, "relative"),
            (global, network.branches.global, "global"),
            (fused, network.branches.fusion, "fused"),
        ] {
            if weight > 0.0 && !exists {
                return Err(("loss", format!("the network has no {head} head; set its weight to 0")));
            }
        }
        if uncertainty > 0.0 && !network.log_variance {
            return Err(("loss", "uncertainty needs a network with log_variance = true".into()));
        }
        Ok(())
    }

    /// The learning rate over its steps.
    pub fn schedule(&self) -> Schedule {
        Schedule {
            learning_rate: self.learning_rate,
            warmup_steps: self.warmup_steps,
            decay: self.decay,
            steps: self.steps,
        }
    }

    /// What the optimizer is told about clipping.
    pub fn max_norm(&self) -> Option<f64> {
        (self.clip_norm > 0.0).then_some(self.clip_norm)
    }
}

impl NetworkTable {
    /// The preset with `FIELD=VALUE` texts over it; the values are TOML, and a bare word is a string.
    ///
    /// # Errors
    /// When a text has no `=` or a value that is neither TOML nor a word.
    pub fn with_overrides(preset: &str, texts: &[String]) -> Result<Self, String> {
        let mut overrides = toml::Table::new();
        for text in texts {
            let (field, value) = text.split_once('=').ok_or_else(|| {
                format!("`{text}` has no `=`: write FIELD=VALUE, for example input_width_px=224")
            })?;
            let (field, value) = (field.trim(), value.trim());
            let is_word = !value.is_empty() && value.chars().all(|c| c.is_ascii_alphanumeric() || c == '_');
            let parsed = toml::from_str::<toml::Table>(&format!("value = {value}"))
                .ok()
                .and_then(|mut table| table.remove("value"))
                .or_else(|| is_word.then(|| value.into()))
                .ok_or_else(|| format!("`{text}`: the value is neither TOML nor a word"))?;
            overrides.insert(field.to_owned(), parsed);
        }
        Ok(Self { preset: preset.to_owned(), overrides })
    }

    /// The network.
    ///
    /// # Errors
    /// When the preset or a field does not exist, or a value is out of range.
    pub fn config(&self) -> Result<NetworkConfig, String> {
        let preset = NetworkConfig::preset(&self.preset).map_err(|error| error.to_string())?;
        let mut table = toml::Table::try_from(&preset).map_err(|error| error.to_string())?;
        let mut config = preset;
        for (field, value) in &self.overrides {
            table.insert(field.clone(), value.clone());
            config = table
                .clone()
                .try_into()
                .map_err(|error: toml::de::Error| format!("`{field} = {value}`: {}", error.message()))?;
        }
        config.validate().map_err(|error| error.to_string())?;
        Ok(config)
    }
}

fn once() -> u64 {
    1
}
fn one() -> usize {
    1
}
fn learned() -> Loss {
    Loss::Learned
}
fn a_minute() -> u64 {
    60
}
fn validation_windows() -> u64 {
    64
}
fn validation_steps() -> u64 {
    250
}
fn paper_rate() -> f64 {
    1e-3
}
fn clip() -> f64 {
    5.0
}
