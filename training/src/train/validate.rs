//! Held-out windows: scores for the curves, residuals for the calibration.

use std::collections::BTreeMap;
use std::sync::Arc;

use candle_core::{Device, Tensor};
use grnet_geometry::{Pose, covariance, quaternion, se3, statistics};
use grnet_model::{HeadTensors, Network, NetworkConfig, WindowOutput};
use nalgebra::{Isometry3, Translation3, Vector3, Vector6};

use super::TrainError;
use super::config::{LossWeights, Stage, Validation};
use super::objective::Objective;
use super::parameters::Parameters;
use super::sources::Sources;
use crate::data::{Batch, Loader, Windows};
use crate::loss::{Head, Loss};

/// Windows in one forward pass.
const BATCH: u64 = 8;
/// Windows of a data set that stages learn from, and of a whole recording.
const OF_TRAINING: u64 = 96;
/// A batch that no training comes to.
const BEYOND_TRAINING: u64 = 1 << 40;

/// Windows that the network is asked about, in memory.
#[derive(Debug)]
pub struct Validator {
    batches: Vec<Batch>,
}

/// One prediction against the truth.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Residual {
    /// What the log-variance head says, where there is one.
    pub log_variance: Option<Vector6<f64>>,
    /// Error [translation, rotation] in the covariances' convention, metres and radians.
    pub error: Vector6<f64>,
}

impl Validator {
    /// Reads the windows.
    ///
    /// # Errors
    /// When one cannot be read.
    pub fn new(validation: &Validation, sources: &Sources) -> Result<Self, TrainError> {
        Self::read(sources.windows(&validation.data)?, 0, validation.windows)
    }

    /// Windows of a data set that stages learn from, drawn anew.
    ///
    /// # Errors
    /// As [`Validator::new`].
    pub fn of_training(data: &str, sources: &Sources) -> Result<Self, TrainError> {
        Self::read(sources.windows(data)?, BEYOND_TRAINING, OF_TRAINING)
    }

    /// The first windows of a data set.
    ///
    /// # Errors
    /// As [`Validator::new`].
    pub fn of(windows: Arc<dyn Windows>) -> Result<Self, TrainError> {
        Self::read(windows, 0, OF_TRAINING)
    }

    fn read(windows: Arc<dyn Windows>, first_batch: u64, count: u64) -> Result<Self, TrainError> {
        let mut loader = Loader::start(windows, BATCH as usize, first_batch, 1, 2);
        let batches = (0..count.div_ceil(BATCH)).map(|_| loader.next());
        Ok(Self { batches: batches.collect::<Result<_, _>>()? })
    }

    /// Median errors of the heads that a stage trains: of the last frame of each window for absolute poses, of the motion
    /// over the whole window for relative ones (beside that of a camera that stands still).
    ///
    /// # Errors
    /// When the network cannot be run.
    pub fn score(
        &self,
        parameters: &Parameters,
        stage: &Stage,
        device: &Device,
    ) -> Result<BTreeMap<String, f64>, TrainError> {
        let predictions = self.predict(parameters, stage.loss, device)?;
        let mut values = BTreeMap::new();
        let mut put = |head: Head, what: &str, errors: &[(f64, f64)]| {
            let median = |pick: fn(&(f64, f64)) -> f64| {
                statistics::median(&errors.iter().map(pick).collect::<Vec<_>>())
            };
            if let (Some(translation_m), Some(rotation_deg)) = (median(|e| e.0), median(|e| e.1)) {
                values.insert(format!("{head}.{what}translation_m"), translation_m);
                values.insert(format!("{head}.{what}rotation_deg"), rotation_deg);
            }
        };
        for (head, windows) in &predictions {
            let errors: Vec<_> = windows.iter().filter_map(|window| window.overall_error(*head)).collect();
            put(*head, "", &errors);
            if *head == Head::Relative {
                let still: Vec<_> =
                    windows.iter().map(|w| difference(&w.motion(), &Pose::identity())).collect();
                put(*head, "zero_motion_", &still);
            }
        }
        Ok(values)
    }

    /// Errors of every frame with what the log-variance heads say about them.
    ///
    /// # Errors
    /// When the network cannot be run.
    pub fn residuals(
        &self,
        parameters: &Parameters,
        weights: LossWeights,
        device: &Device,
    ) -> Result<BTreeMap<Head, Vec<Residual>>, TrainError> {
        let predictions = self.predict(parameters, weights, device)?;
        let of = |windows: Vec<Predicted>, head| {
            windows.iter().flat_map(|window| window.residuals(head)).collect::<Vec<_>>()
        };
        Ok(predictions.into_iter().map(|(head, windows)| (head, of(windows, head))).collect())
    }

    fn predict(
        &self,
        parameters: &Parameters,
        weights: LossWeights,
        device: &Device,
    ) -> Result<BTreeMap<Head, Vec<Predicted>>, TrainError> {
        let objective = Objective { kind: Loss::Learned, weights, homoscedastic: None };
        let branches = objective.branches(parameters.config());
        let config = NetworkConfig { branches, ..parameters.config().clone() };
        // No part is trained: constants and running statistics, on the operators of the training.
        let network = Network::for_training(&config, parameters.var_builder(&[], device), None)?;
        let mut found: BTreeMap<Head, Vec<Predicted>> = BTreeMap::new();
        for batch in &self.batches {
            let WindowOutput { relative, global, fused } =
                network.window(&batch.images.to_device(device)?)?;
            let heads = [
                (Head::Relative, weights.relative, relative),
                (Head::Global, weights.global, global),
                (Head::Fused, weights.fused, fused),
            ];
            for (head, weight, output) in heads {
                if let Some(output) = output.filter(|_| weight > 0.0) {
                    found.entry(head).or_default().extend(read(&output, &batch.world_from_camera)?);
                }
            }
        }
        Ok(found)
    }
}

/// One window's predictions and truth.
#[derive(Debug)]
struct Predicted {
    truth: Vec<Pose>,
    poses: Vec<Option<Pose>>,
    log_variances: Option<Vec<Vector6<f64>>>,
}

impl Predicted {
    fn motion(&self) -> Pose {
        match (self.truth.first(), self.truth.last()) {
            (Some(first), Some(last)) => se3::relative(first, last),
            _ => Pose::identity(),
        }
    }

    fn overall_error(&self, head: Head) -> Option<(f64, f64)> {
        match head {
            Head::Relative => {
                let motions = self.poses.iter().skip(1);
                let composed =
                    motions.copied().try_fold(Pose::identity(), |sum, motion| Some(sum * motion?))?;
                Some(difference(&self.motion(), &composed))
            }
            Head::Global | Head::Fused => Some(difference(self.truth.last()?, &(*self.poses.last()?)?)),
        }
    }

    fn residuals(&self, head: Head) -> Vec<Residual> {
        let first = usize::from(head == Head::Relative);
        let residual = |frame: usize| {
            let truth = match head {
                Head::Relative => se3::relative(&self.truth[frame - 1], &self.truth[frame]),
                Head::Global | Head::Fused => self.truth[frame],
            };
            let error = *covariance::error(&self.poses[frame]?, &truth).vector();
            let log_variance = self.log_variances.as_ref().map(|all| all[frame]);
            Some(Residual { log_variance, error })
        };
        (first..self.truth.len()).filter_map(residual).collect()
    }
}

/// Translation in metres and rotation in degrees between two poses.
fn difference(a: &Pose, b: &Pose) -> (f64, f64) {
    let translation_m = (a.translation.vector - b.translation.vector).norm();
    (translation_m, se3::angle_rad(&(a.rotation.inverse() * b.rotation)).to_degrees())
}

fn read(output: &HeadTensors, truth: &[Vec<Pose>]) -> Result<Vec<Predicted>, TrainError> {
    let rows = |tensor: &Tensor| tensor.to_vec3::<f32>();
    let (translations, rotations) = (rows(&output.translation)?, rows(&output.rotation)?);
    let log_variances = output.log_variance.as_ref().map(rows).transpose()?;
    let window = |index: usize| {
        let poses = translations[index].iter().zip(&rotations[index]).map(|(t, r)| pose(t, r)).collect();
        let log_variances = log_variances.as_ref().map(|all| {
            let row = |values: &Vec<f32>| Vector6::from_iterator(values.iter().map(|v| f64::from(*v)));
            all[index].iter().map(row).collect()
        });
        Predicted { truth: truth[index].clone(), poses, log_variances }
    };
    Ok((0..truth.len()).map(window).collect())
}

/// A head's raw numbers as a pose; none when they are none.
fn pose(translation: &[f32], rotation: &[f32]) -> Option<Pose> {
    let wide = |v: &[f32]| v.iter().map(|v| f64::from(*v)).collect::<Vec<_>>();
    let rotation = match wide(rotation).as_slice() {
        [x, y, z, w] => quaternion::from_xyzw([*x, *y, *z, *w]),
        [a, b, c, d, e, f] => quaternion::from_6d([*a, *b, *c, *d, *e, *f]),
        _ => return None,
    };
    let translation = Vector3::from_iterator(translation.iter().map(|v| f64::from(*v)));
    Some(Isometry3::from_parts(Translation3::from(translation), rotation.ok()?))
}
