//! Uncertainties that mean what they say: after the training the log-variance layers are scaled, so that the mean squared error of
//! each component in units of the stated deviation is 1 on held-out windows or on windows like those of the training, and less on the other.
//!
//! Held-out frames of a recording may be few, and all from one corner of the place. What the network says of them is what it says of
//! things it does not know, and may be too cautious by several times: scaled by that alone, a covariance
//! that was learnt from thousands of windows would shrink below the errors of these very windows.

use std::collections::{BTreeMap, HashMap};

use candle_core::{Device, Tensor};
use grnet_model::Heads;
use grnet_model::metadata::LARGEST_MOTION_SHIFT;
use serde::Serialize;

use super::TrainError;
use super::config::{LossWeights, Stage};
use super::parameters::Parameters;
use super::sources::Sources;
use super::validate::{Residual, Validator};
use crate::loss::Head;

/// Fewer residuals than this calibrate nothing.
const FEWEST: usize = 50;
/// Squared errors beyond this many variances count as this many: a few outliers shall not blow up every covariance.
const LARGEST_SQUARED: f64 = 100.0;

/// What the calibration of a head found.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Calibration {
    /// Residuals on held-out windows.
    pub residuals: usize,
    /// Added to each log-variance (translation, rotation).
    pub shift: [f64; 6],
    /// Mean normalised squared error (6 components; 6 is perfect) before and after, on held-out windows.
    pub nees: [f64; 2],
    /// Likewise on windows like those of the training, where there are any.
    pub training_nees: Option<[f64; 2]>,
    /// Share of components of held-out windows within 1, 2 and 3 stated deviations after it (.683, .954, .997 are perfect).
    pub within_sigmas: [f64; 3],
}

/// Windows like those that a head was trained on last.
#[derive(Debug)]
pub struct Shown {
    windows: Validator,
    heads: Vec<Head>,
}

impl Shown {
    /// For each data set that the last stage of some head takes its windows from.
    ///
    /// # Errors
    /// When a window cannot be read.
    pub fn of(stages: &[Stage], sources: &Sources) -> Result<Vec<Self>, TrainError> {
        last_shown(stages)
            .into_iter()
            .map(|(data, heads)| Ok(Self { windows: Validator::of_training(data, sources)?, heads }))
            .collect()
    }
}

/// The heads by the data set of the last stage that trained their log-variances.
fn last_shown(stages: &[Stage]) -> BTreeMap<&str, Vec<Head>> {
    let mut shown: BTreeMap<&str, Vec<Head>> = BTreeMap::new();
    for head in [Head::Relative, Head::Global, Head::Fused] {
        let trains =
            |stage: &&Stage| stage.loss.uncertainty > 0.0 && stage.loss.heads().any(|(of, _)| of == head);
        if let Some(stage) = stages.iter().rev().find(trains) {
            shown.entry(&stage.data).or_default().push(head);
        }
    }
    shown
}

/// Shifts the biases of the log-variance layers in `parameters`; heads without enough residuals are left alone.
///
/// # Errors
/// When the network cannot be run.
pub fn calibrate(
    parameters: &mut Parameters,
    held_out: &Validator,
    shown: &[Shown],
    heads: Heads,
    device: &Device,
) -> Result<BTreeMap<Head, Calibration>, TrainError> {
    let weight = |live: bool| if live { 1.0 } else { 0.0 };
    let weights = LossWeights {
        relative: weight(heads.relative.log_variance),
        global: weight(heads.global.log_variance),
        fused: weight(heads.fused.log_variance),
        uncertainty: 0.0,
    };
    if weights == LossWeights::default() {
        return Ok(BTreeMap::new());
    }
    let mut of_training = BTreeMap::new();
    for shown in shown {
        let residuals = shown.windows.residuals(parameters, weights, device)?;
        of_training.extend(residuals.into_iter().filter(|(head, _)| shown.heads.contains(head)));
    }
    let mut found = BTreeMap::new();
    for (head, residuals) in held_out.residuals(parameters, weights, device)? {
        let Some(calibration) = fit(&residuals, of_training.get(&head).map_or(&[], Vec::as_slice)) else {
            continue;
        };
        let key = format!("{}.log_variance.bias", part_of(head));
        let bias =
            parameters.snapshot()?.remove(&key).ok_or(TrainError::UnknownTensor { tensor: key.clone() })?;
        let shift = calibration.shift.map(|v| v as f32);
        let bias = (bias + Tensor::from_slice(&shift, 6, device)?)?;
        parameters.restore(HashMap::from([(key, bias)]))?;
        found.insert(head, calibration);
    }
    Ok(found)
}

/// How much more uncertain the motion of a trunk is in a place that it was not trained in than it says itself; none without
/// enough residuals. `windows` are of the place: to a frozen RCNN1 all of them are new.
///
/// The shifts are 0 or more: where the trunk does better than it says, the place may be the one it was trained in.
///
/// # Errors
/// When the network cannot be run.
pub fn measure_motion(
    parameters: &Parameters,
    windows: &Validator,
    device: &Device,
) -> Result<Option<Calibration>, TrainError> {
    let weights = LossWeights { relative: 1.0, ..LossWeights::default() };
    let residuals = windows.residuals(parameters, weights, device)?.remove(&Head::Relative);
    Ok(widen(&residuals.unwrap_or_default()))
}

/// The shifts of 0 or more with which the squared errors are no larger than stated.
fn widen(residuals: &[Residual]) -> Option<Calibration> {
    let residuals = Normalised::of(residuals);
    let shift = |component| residuals.shift(component).clamp(0.0, LARGEST_MOTION_SHIFT);
    residuals.calibration(std::array::from_fn(shift))
}

/// First component of the names of a head's layers.
fn part_of(head: Head) -> &'static str {
    match head {
        Head::Relative => "rcnn1",
        Head::Global => "rcnn2",
        Head::Fused => "fcfl",
    }
}

/// The least shift with which the mean squared error of each component is at most 1 in units of its stated variance, on the held-out
/// windows and on those of the training.
fn fit(held_out: &[Residual], training: &[Residual]) -> Option<Calibration> {
    let (held_out, training) = (Normalised::of(held_out), Normalised::of(training));
    let shift = std::array::from_fn(|component| held_out.shift(component).max(training.shift(component)));
    let calibration = held_out.calibration(shift)?;
    let training_nees = (!training.0.is_empty()).then(|| training.nees_around(&shift));
    Some(Calibration { training_nees, ..calibration })
}

/// Squared errors of the components in units of their stated variances.
struct Normalised(Vec<[f64; 6]>);

impl Normalised {
    fn of(residuals: &[Residual]) -> Self {
        let normalised = |residual: &Residual| {
            let log_variance = residual.log_variance?;
            Some(std::array::from_fn(|c| residual.error[c].powi(2) / log_variance[c].exp()))
        };
        Self(residuals.iter().filter_map(normalised).collect())
    }

    /// What makes the mean of a component 1; nothing is below everything.
    fn shift(&self, component: usize) -> f64 {
        if self.0.is_empty() {
            return f64::NEG_INFINITY;
        }
        // A bounded mean, solved by iteration: how much is too much depends on the scale itself.
        let mut scale = 1.0f64;
        for _ in 0..50 {
            let bounded = self.0.iter().map(|row| (row[component] / scale).min(LARGEST_SQUARED)).sum::<f64>();
            scale = (scale * bounded / self.0.len() as f64).max(1e-12);
        }
        scale.ln()
    }

    /// What there is to say of a shift; none of too few residuals.
    fn calibration(&self, shift: [f64; 6]) -> Option<Calibration> {
        (self.0.len() >= FEWEST).then(|| Calibration {
            residuals: self.0.len(),
            shift,
            nees: self.nees_around(&shift),
            training_nees: None,
            within_sigmas: [1.0, 2.0, 3.0].map(|sigmas| self.within(sigmas, &shift)),
        })
    }

    /// Before and after a shift.
    fn nees_around(&self, shift: &[f64; 6]) -> [f64; 2] {
        [self.nees(&[0.0; 6]), self.nees(shift)]
    }

    fn nees(&self, shift: &[f64; 6]) -> f64 {
        let sum = |row: &[f64; 6]| (0..6).map(|c| row[c] / shift[c].exp()).sum::<f64>();
        self.0.iter().map(sum).sum::<f64>() / self.0.len() as f64
    }

    fn within(&self, sigmas: f64, shift: &[f64; 6]) -> f64 {
        let inside = self.0.iter().flat_map(|row| (0..6).map(|c| row[c] / shift[c].exp()));
        inside.filter(|squared| *squared <= sigmas * sigmas).count() as f64 / (6 * self.0.len()) as f64
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Vector6;
    use rand::SeedableRng as _;
    use rand_distr::{Distribution as _, StandardNormal};

    fn drawn(stated: f64, actual: f64, count: usize) -> Vec<Residual> {
        let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(7);
        let mut normal = || -> f64 { StandardNormal.sample(&mut rng) };
        let log_variance = Some(Vector6::repeat((stated * stated).ln()));
        (0..count)
            .map(|_| Residual { log_variance, error: Vector6::from_fn(|_, _| actual * normal()) })
            .collect()
    }

    #[test]
    fn an_overconfident_head_is_widened_by_as_much_as_it_errs() {
        let found = fit(&drawn(0.01, 0.05, 4000), &drawn(0.01, 0.02, 4000)).unwrap();
        for shift in found.shift {
            assert!((shift - 25f64.ln()).abs() < 0.15, "{found:?}");
        }
        assert!((found.nees[0] - 150.0).abs() < 10.0 && (found.nees[1] - 6.0).abs() < 0.05, "{found:?}");
        assert!((found.within_sigmas[0] - 0.683).abs() < 0.02, "{found:?}");
        assert!((found.training_nees.unwrap()[1] - 0.96).abs() < 0.05, "{found:?}");
    }

    #[test]
    fn caution_on_a_few_held_out_frames_does_not_shrink_what_is_right_elsewhere() {
        let found = fit(&drawn(1.0, 0.05, 400), &drawn(0.1, 0.1, 4000)).unwrap();
        assert!((found.training_nees.unwrap()[1] - 6.0).abs() < 0.05 && found.nees[1] < 0.1, "{found:?}");
        assert!(found.shift.iter().all(|shift| shift.abs() < 0.1), "{found:?}");
        // Caution everywhere does shrink: to what the worse of the two allows.
        let found = fit(&drawn(1.0, 0.05, 4000), &drawn(1.0, 0.1, 4000)).unwrap();
        assert!((found.training_nees.unwrap()[1] - 6.0).abs() < 0.05, "{found:?}");
        assert!(found.shift.iter().all(|shift| (shift - 0.01f64.ln()).abs() < 0.15), "{found:?}");
    }

    #[test]
    fn a_head_is_measured_on_what_it_was_shown_last() {
        let text = r#"name = "a"
            data = "d"
            train = ["rcnn2"]
            loss = { global = 1.0 }
            steps = 1
            batch = 1"#;
        let base: Stage = toml::from_str(text).unwrap();
        let stage = |data: &str, loss| Stage { data: data.into(), loss, ..base.clone() };
        let weights = |global, fused, uncertainty| LossWeights { relative: 0.0, global, fused, uncertainty };
        let stages = [
            stage("frames", weights(1.0, 0.0, 0.1)),
            stage("near", weights(1.0, 1.0, 0.1)),
            stage("far", weights(0.0, 1.0, 0.5)),
            stage("poses alone", weights(1.0, 0.0, 0.0)),
        ];
        let shown = last_shown(&stages);
        assert_eq!(shown, BTreeMap::from([("near", vec![Head::Global]), ("far", vec![Head::Fused])]));
    }

    #[test]
    fn a_trunk_that_errs_less_than_it_says_stays_as_cautious() {
        let found = widen(&drawn(0.01, 0.05, 4000)).unwrap();
        assert!(found.shift.iter().all(|shift| (shift - 25f64.ln()).abs() < 0.15), "{found:?}");
        assert_eq!(widen(&drawn(0.05, 0.01, 4000)).unwrap().shift, [0.0; 6]);
        assert_eq!(widen(&drawn(1e-9, 1.0, 4000)).unwrap().shift, [LARGEST_MOTION_SHIFT; 6]);
        assert_eq!(widen(&drawn(0.01, 0.05, FEWEST - 1)), None);
    }

    #[test]
    fn a_few_residuals_or_none_calibrate_nothing() {
        assert_eq!(fit(&drawn(0.01, 0.05, FEWEST - 1), &drawn(0.01, 0.05, FEWEST)), None);
        let unknown: Vec<Residual> =
            drawn(1.0, 1.0, 100).into_iter().map(|r| Residual { log_variance: None, ..r }).collect();
        assert_eq!(fit(&unknown, &[]), None);
    }
}
