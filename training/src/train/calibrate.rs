//! Uncertainties that mean what they say: after the training the log-variance layers are scaled on held-out windows, so that
//! the mean squared error in units of the stated deviation is 1 for each component.

use std::collections::{BTreeMap, HashMap};

use candle_core::{Device, Tensor};
use grnet_model::Heads;
use serde::Serialize;

use super::TrainError;
use super::config::LossWeights;
use super::parameters::Parameters;
use super::validate::{Residual, Validator};
use crate::loss::Head;

/// Fewer residuals than this calibrate nothing.
const FEWEST: usize = 50;
/// Squared errors beyond this many variances count as this many: a few outliers shall not blow up every covariance.
const LARGEST_SQUARED: f64 = 100.0;

/// What the calibration of a head found.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Calibration {
    /// Residuals used.
    pub residuals: usize,
    /// Added to each log-variance (translation, rotation).
    pub shift: [f64; 6],
    /// Mean normalised squared error (6 components; 6 is perfect) before and after.
    pub nees: [f64; 2],
    /// Share of components within 1, 2 and 3 stated deviations after it (.683, .954, .997 are perfect).
    pub within_sigmas: [f64; 3],
}

/// Shifts the biases of the log-variance layers in `parameters`; heads without enough residuals are left alone.
///
/// # Errors
/// When the network cannot be run.
pub fn calibrate(
    parameters: &mut Parameters,
    validator: &Validator,
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
    let mut found = BTreeMap::new();
    for (head, residuals) in validator.residuals(parameters, weights, device)? {
        let Some(calibration) = fit(&residuals) else { continue };
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

/// First component of the names of a head's layers.
fn part_of(head: Head) -> &'static str {
    match head {
        Head::Relative => "rcnn1",
        Head::Global => "rcnn2",
        Head::Fused => "fcfl",
    }
}

/// The shift that makes the mean squared error of each component 1 in units of its stated variance.
fn fit(residuals: &[Residual]) -> Option<Calibration> {
    let normalised: Vec<[f64; 6]> = residuals
        .iter()
        .filter_map(|residual| {
            let log_variance = residual.log_variance?;
            Some(std::array::from_fn(|c| residual.error[c].powi(2) / log_variance[c].exp()))
        })
        .collect();
    if normalised.len() < FEWEST {
        return None;
    }
    let count = normalised.len() as f64;
    let shift: [f64; 6] = std::array::from_fn(|component| {
        // A bounded mean, solved by iteration: how much is too much depends on the scale itself.
        let mut scale = 1.0f64;
        for _ in 0..50 {
            let bounded =
                normalised.iter().map(|row| (row[component] / scale).min(LARGEST_SQUARED)).sum::<f64>();
            scale = (scale * bounded / count).max(1e-12);
        }
        scale.ln()
    });
    let nees = |shift: &[f64; 6]| {
        let sum = |row: &[f64; 6]| (0..6).map(|c| row[c] / shift[c].exp()).sum::<f64>();
        normalised.iter().map(sum).sum::<f64>() / count
    };
    let within = |sigmas: f64| {
        let inside = normalised.iter().flat_map(|row| (0..6).map(|c| row[c] / shift[c].exp()));
        inside.filter(|squared| *squared <= sigmas * sigmas).count() as f64 / (6.0 * count)
    };
    Some(Calibration {
        residuals: normalised.len(),
        shift,
        nees: [nees(&[0.0; 6]), nees(&shift)],
        within_sigmas: [1.0, 2.0, 3.0].map(within),
    })
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
        let found = fit(&drawn(0.01, 0.05, 4000)).unwrap();
        for shift in found.shift {
            assert!((shift - 25f64.ln()).abs() < 0.15, "{found:?}");
        }
        assert!((found.nees[0] - 150.0).abs() < 10.0 && (found.nees[1] - 6.0).abs() < 0.05, "{found:?}");
        assert!((found.within_sigmas[0] - 0.683).abs() < 0.02, "{found:?}");
    }

    #[test]
    fn a_few_residuals_or_none_calibrate_nothing() {
        assert_eq!(fit(&drawn(0.01, 0.05, FEWEST - 1)), None);
        let unknown: Vec<Residual> =
            drawn(1.0, 1.0, 100).into_iter().map(|r| Residual { log_variance: None, ..r }).collect();
        assert_eq!(fit(&unknown), None);
    }
}
