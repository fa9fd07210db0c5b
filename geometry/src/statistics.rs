//! Summary statistics of a list of errors, as `evo` and NumPy define them.

use serde::{Deserialize, Serialize};

/// Statistics of a non-empty list of non-negative errors, in the unit of the errors.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Statistics {
    /// Number of errors.
    pub count: usize,
    /// Root of the mean square.
    pub rmse: f64,
    /// Mean.
    pub mean: f64,
    /// Median; the mean of the two middle values of an even count.
    pub median: f64,
    /// Standard deviation of the population (divides by `count`).
    pub std: f64,
    /// Smallest.
    pub min: f64,
    /// Largest.
    pub max: f64,
    /// Sum of squares.
    pub sse: f64,
}

impl Statistics {
    /// Summarises `errors`; `None` if there are none.
    pub fn of(errors: &[f64]) -> Option<Self> {
        if errors.is_empty() {
            return None;
        }
        let n = errors.len() as f64;
        let sse = errors.iter().map(|e| e * e).sum::<f64>();
        let mean = errors.iter().sum::<f64>() / n;
        let variance = errors.iter().map(|e| (e - mean).powi(2)).sum::<f64>() / n;
        let min = errors.iter().copied().fold(f64::INFINITY, f64::min);
        let max = errors.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        Some(Self {
            count: errors.len(),
            rmse: (sse / n).sqrt(),
            mean,
            median: median(errors)?,
            std: variance.sqrt(),
            min,
            max,
            sse,
        })
    }
}

/// The median; the mean of the two middle values of an even count, `None` of an empty list.
///
/// NaN sorts above every number.
pub fn median(values: &[f64]) -> Option<f64> {
    let mut sorted = values.to_vec();
    sorted.sort_unstable_by(f64::total_cmp);
    let upper = *sorted.get(sorted.len() / 2)?;
    if sorted.len() % 2 == 1 { Some(upper) } else { Some(0.5 * (sorted[sorted.len() / 2 - 1] + upper)) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn hand_computed() {
        let s = Statistics::of(&[3.0, 1.0, 2.0, 6.0]).unwrap();
        assert_eq!((s.count, s.mean, s.median, s.min, s.max, s.sse), (4, 3.0, 2.5, 1.0, 6.0, 50.0));
        assert!((s.rmse - 12.5f64.sqrt()).abs() < 1e-15 && (s.std - 3.5f64.sqrt()).abs() < 1e-15);
        assert_eq!(Statistics::of(&[]), None);
        assert_eq!(median(&[5.0]), Some(5.0));
    }
}
