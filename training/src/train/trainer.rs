//! The loop over stages and steps.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use candle_core::{Device, Tensor, Var};
use grnet_geometry::{Pose, quaternion};
use grnet_model::ops::{Adam, AdamOptions, AdamParam};
use grnet_model::{BatchStatistics, Network};

use super::TrainError;
use super::config::{Recipe, Stage};
use super::feed::{Feed, Shown};
use super::objective::Objective;
use super::parameters::{Parameters, Part};
use super::replicas::{Gradient, Replica, gradient};
use super::sources::Sources;
use super::state::{self, Position};
use super::validate::Validator;
use crate::loss::{Head, Homoscedastic};
use crate::run::{LogEntry, LogKind, Progress, RunFolder, State, Update};

/// Steps between two lines of the log.
const LOG_EVERY: u64 = 10;

/// How a training ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Outcome {
    /// Every stage is done.
    Finished,
    /// Somebody asked for a stop; the state is saved.
    Stopped,
}

/// A training in its run folder.
#[derive(Debug)]
pub struct Trainer<'a> {
    recipe: &'a Recipe,
    sources: &'a Sources,
    device: Device,
    parameters: Parameters,
    homoscedastic: Option<Homoscedastic>,
    folder: RunFolder,
    validator: Option<Validator>,
    resumed: Option<State>,
    at: Position,
    started: Instant,
    elapsed_s: f64,
}

impl<'a> Trainer<'a> {
    /// A training at its start, or where the folder's saved state left it.
    ///
    /// # Errors
    /// When the saved state does not fit, or validation windows cannot be read.
    pub fn new(
        recipe: &'a Recipe,
        sources: &'a Sources,
        mut parameters: Parameters,
        mut folder: RunFolder,
        device: Device,
    ) -> Result<Self, TrainError> {
        let statistics = &sources.normalisation().targets;
        let initial = |norm| Homoscedastic::initial(norm, statistics, &recipe.heads(), &device);
        let homoscedastic = recipe.loss.norm().map(initial).transpose()?;
        let validator = match &recipe.validation {
            Some(validation) => Some(Validator::new(validation, sources)?),
            None => None,
        };
        let resumed = folder.load_state()?;
        let (mut at, mut elapsed_s) = (Position::default(), 0.0);
        if let Some(saved) = &resumed {
            at = state::position(saved)?;
            state::restore_weights(saved, &mut parameters, homoscedastic.as_ref(), &device)?;
            folder.truncate_log(at.step)?;
            elapsed_s =
                folder.read_log()?.iter().filter_map(|entry| entry.elapsed_s).next_back().unwrap_or(0.0);
        }
        Ok(Self {
            recipe,
            sources,
            device,
            parameters,
            homoscedastic,
            folder,
            validator,
            resumed,
            at,
            started: Instant::now(),
            elapsed_s,
        })
    }

    /// Trains to the end, or until `stop` is set.
    ///
    /// # Errors
    /// When windows cannot be read, the loss is not finite or the folder cannot be written to.
    pub fn run(&mut self, stop: &Arc<AtomicBool>) -> Result<Outcome, TrainError> {
        for index in self.at.stage..self.recipe.stages.len() {
            if index > self.at.stage {
                self.at = Position { stage: index, stage_step: 0, ..self.at };
            }
            if self.stage(&self.recipe.stages[index], stop)? == Outcome::Stopped {
                return Ok(Outcome::Stopped);
            }
        }
        self.folder.draw_curves()?;
        Ok(Outcome::Finished)
    }

    /// Steps over all stages so far.
    pub fn steps(&self) -> u64 {
        self.at.step
    }

    /// The weights as they are now, and the held-out windows.
    pub fn into_parts(self) -> (Parameters, Option<Validator>) {
        (self.parameters, self.validator)
    }

    fn stage(&mut self, stage: &Stage, stop: &Arc<AtomicBool>) -> Result<Outcome, TrainError> {
        let variables = self.variables(stage);
        let trained: Vec<Var> = variables.values().map(|param| param.var.clone()).collect();
        let mut adam = Adam::new(variables, AdamOptions::default())?;
        if let Some(saved) = self.resumed.take().filter(|_| self.at.stage_step > 0) {
            state::restore_adam(&saved, &mut adam)?;
        }
        let replicas = self.replicas(stage)?;
        let windows = self.sources.windows(&stage.data)?;
        let frames = (stage.batch * windows.k()) as u64;
        let mut feed = Feed::open(self.recipe, stage, windows, &replicas[0].network, self.at, stop)?;
        let mut progress = Progress::new(&stage.name, stage.steps, self.at.stage_step);
        let mut lines = Lines::default();
        let mut saved_at = Instant::now();
        let new_heads = self.new_heads(self.at.stage);

        while self.at.stage_step < stage.steps {
            if stop.load(Ordering::Relaxed) {
                self.save(Some(&adam))?;
                progress.say("stopped; the state is saved");
                progress.finish();
                return Ok(Outcome::Stopped);
            }
            let Shown { input, world_from_camera, names } = match feed.next(self.at) {
                Ok(shown) => shown,
                Err(error) => {
                    self.save(Some(&adam))?;
                    return Err(error);
                }
            };
            let objective = self.objective(stage);
            let input = input.to_device(&self.device)?;
            let batch = || gradient(&replicas, &objective, &input, &world_from_camera, &trained);
            let mut step = batch()?;
            if self.at.stage_step == 0 && objective.start_at(&new_heads, step.grads.as_ref())? {
                step = batch()?;
            }
            let Gradient { loss, parts, grads, statistics } = step;
            let lr = stage.schedule().at(self.at.stage_step);
            let norm = match &grads {
                Some(grads) => adam.step(grads, lr, stage.max_norm())?.grad_norm,
                None => f64::NAN,
            };
            if !norm.is_finite() {
                let what = if grads.is_some() { "gradient" } else { "loss" };
                let poses = poses(&world_from_camera)?;
                let others = [("world_from_camera", &poses)];
                let batch =
                    self.folder.save_bad_batch(self.at.step, &names, input.tensor(), &others, &parts)?;
                return Err(self.not_finite(stage, what, &parts, batch));
            }
            self.parameters.follow(statistics)?;
            self.at.step += 1;
            self.at.stage_step += 1;

            progress.step(Update { done: self.at.stage_step, frames, loss });
            lines.add(loss, parts, norm);
            let last = self.at.stage_step == stage.steps;
            if self.at.stage_step.is_multiple_of(LOG_EVERY) || last {
                let elapsed_s = self.elapsed_s + self.started.elapsed().as_secs_f64();
                let entry = lines.entry(frames);
                let stage = stage.name.clone();
                let step = self.at.step;
                self.folder.log(&LogEntry {
                    step,
                    stage,
                    lr: Some(lr),
                    elapsed_s: Some(elapsed_s),
                    ..entry
                })?;
            }
            self.validate(stage, last)?;
            if saved_at.elapsed() >= Duration::from_secs(self.recipe.save_every_s) {
                self.save(Some(&adam))?;
                self.folder.draw_curves()?;
                saved_at = Instant::now();
            }
        }
        // The next stage starts with moments of its own: what is saved here is its start.
        self.at = Position { step: self.at.step, stage: self.at.stage + 1, stage_step: 0 };
        self.save(None)?;
        progress.finish();
        Ok(Outcome::Finished)
    }

    /// The heads that the stage is the first to weigh.
    fn new_heads(&self, stage: usize) -> Vec<Head> {
        let heads = |stage: &Stage| stage.loss.heads().map(|(head, _)| head);
        let before: Vec<Head> = self.recipe.stages[..stage].iter().flat_map(heads).collect();
        heads(&self.recipe.stages[stage]).filter(|head| !before.contains(head)).collect()
    }

    fn objective(&self, stage: &Stage) -> Objective<'_> {
        Objective { kind: self.recipe.loss, weights: stage.loss, homoscedastic: self.homoscedastic.as_ref() }
    }

    /// One copy of the network for each thread, as far as there are windows for all.
    fn replicas(&self, stage: &Stage) -> Result<Vec<Replica>, TrainError> {
        let config = self.parameters.config();
        let branches = self.objective(stage).branches(config);
        let config = grnet_model::NetworkConfig { branches, ..config.clone() };
        // A GPU computes the whole batch at once.
        let cores = if self.device.is_cpu() { rayon::current_num_threads() } else { 1 };
        let count = cores.min(stage.batch);
        let copy = |_| {
            let statistics = (!stage.freeze_batch_norm).then(BatchStatistics::default);
            let vb = self.parameters.var_builder(&stage.train, &self.device);
            Ok(Replica { network: Network::for_training(&config, vb, statistics.clone())?, statistics })
        };
        (0..count).map(copy).collect()
    }

    fn variables(&self, stage: &Stage) -> BTreeMap<String, AdamParam> {
        let normalisation = self.sources.normalisation();
        let mut params = BTreeMap::new();
        for (name, var) in self.parameters.of_parts(&stage.train) {
            // A head that writes small numbers moves in small steps: the same as training on normalised targets.
            let relative = name.starts_with(Part::Rcnn1.prefix());
            let spread = if relative { normalisation.relative } else { normalisation.absolute };
            let lr_multiplier = match name.rsplit('.').nth(1) {
                Some("fc4") => spread.translation_m,
                Some("fc5") => spread.rotation_rad.min(1.0),
                _ => 1.0,
            };
            params.insert(name.clone(), AdamParam { var: var.clone(), lr_multiplier });
        }
        let homoscedastic = self.homoscedastic.iter().flat_map(Homoscedastic::vars);
        // Adam moves a variable by about its rate at every step: these have to follow errors that fall by orders of magnitude.
        params.extend(homoscedastic.map(|(name, var)| (name, AdamParam { var, lr_multiplier: 10.0 })));
        params
    }

    fn save(&self, adam: Option<&Adam>) -> Result<(), TrainError> {
        let state = state::pack(self.at, &self.parameters, self.homoscedastic.as_ref(), adam)?;
        Ok(self.folder.save_state(&state)?)
    }

    fn validate(&mut self, stage: &Stage, last: bool) -> Result<(), TrainError> {
        let (Some(validator), Some(validation)) = (&self.validator, &self.recipe.validation) else {
            return Ok(());
        };
        if !(last || self.at.step.is_multiple_of(validation.every_steps)) {
            return Ok(());
        }
        let values = validator.score(&self.parameters, stage, &self.device)?;
        let entry = LogEntry {
            step: self.at.step,
            stage: stage.name.clone(),
            kind: LogKind::Valid,
            values,
            ..LogEntry::default()
        };
        Ok(self.folder.log(&entry)?)
    }

    fn not_finite(
        &self,
        stage: &Stage,
        what: &'static str,
        parts: &BTreeMap<String, f64>,
        batch: std::path::PathBuf,
    ) -> TrainError {
        let parts =
            parts.iter().map(|(name, value)| format!("{name} {value}")).collect::<Vec<_>>().join(", ");
        TrainError::NotFinite { stage: stage.name.clone(), step: self.at.step, what, parts, batch }
    }
}

/// Sums between two lines of the log.
#[derive(Debug)]
struct Lines {
    steps: u64,
    loss: f64,
    parts: BTreeMap<String, f64>,
    grad_norm: f64,
    since: Instant,
}

impl Default for Lines {
    fn default() -> Self {
        Self { steps: 0, loss: 0.0, parts: BTreeMap::new(), grad_norm: 0.0, since: Instant::now() }
    }
}

impl Lines {
    fn add(&mut self, loss: f64, parts: BTreeMap<String, f64>, grad_norm: f64) {
        self.steps += 1;
        self.loss += loss;
        self.grad_norm = self.grad_norm.max(grad_norm);
        for (name, value) in parts {
            *self.parts.entry(name).or_default() += value;
        }
    }

    /// Means since the last line; the largest gradient.
    fn entry(&mut self, frames_per_step: u64) -> LogEntry {
        let Self { steps, loss, parts, grad_norm, since } = std::mem::take(self);
        let count = steps.max(1) as f64;
        LogEntry {
            loss: Some(loss / count),
            values: parts.into_iter().map(|(name, sum)| (name, sum / count)).collect(),
            grad_norm: Some(grad_norm),
            frames_per_s: Some((steps * frames_per_step) as f64 / since.elapsed().as_secs_f64().max(1e-9)),
            ..LogEntry::default()
        }
    }
}

/// (B, K, 7): translation in metres, quaternion (x, y, z, w).
fn poses(windows: &[Vec<Pose>]) -> candle_core::Result<Tensor> {
    let row = |pose: &Pose| {
        let [x, y, z]: [f64; 3] = pose.translation.vector.into();
        let [qx, qy, qz, qw] = quaternion::xyzw(&pose.rotation);
        [x, y, z, qx, qy, qz, qw]
    };
    let values: Vec<f64> = windows.iter().flatten().flat_map(row).collect();
    let frames = windows.first().map_or(0, Vec::len);
    Tensor::from_vec(values, (windows.len(), frames, 7), &Device::Cpu)
}
