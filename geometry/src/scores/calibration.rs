//! Whether a published covariance means what it says.
//!
//! For 6-DoF errors with the claimed covariance the NEES `e^T C^-1 e` follows a chi-square distribution with 6
//! degrees of freedom: mean 6, and a share `p` of the samples lies inside the `p` ellipsoid.

use serde::{Deserialize, Serialize};

use crate::{Covariance6, se3::Tangent, statistics::median};

/// The three customary confidence levels: 68, 95 and 99.7 %.
pub const LEVELS: [f64; 3] = [0.68, 0.95, 0.997];

/// A confidence level and the share of samples found inside.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Coverage {
    /// The level that the covariance promises, 0 to 1.
    pub nominal: f64,
    /// Largest NEES inside: the chi-square quantile with 6 degrees of freedom.
    pub nees_limit: f64,
    /// The share found inside, 0 to 1.
    pub measured: f64,
}

/// Calibration of the covariances of a sequence.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Calibration {
    /// Number of samples with a usable covariance.
    pub count: usize,
    /// Samples without: NaN (unknown), not positive definite, or an error that is not finite.
    pub skipped: usize,
    /// Mean NEES; 6 when calibrated, more when overconfident.
    pub nees_mean: f64,
    /// Median NEES; 5.348 when calibrated and Gaussian.
    pub nees_median: f64,
    /// Mean NEES of the translational block alone (3 when calibrated).
    pub nees_translation_mean: f64,
    /// Mean NEES of the rotational block alone (3 when calibrated).
    pub nees_rotation_mean: f64,
    /// Coverage of the 6-DoF ellipsoids at 68, 95 and 99.7 %.
    pub coverage: [Coverage; 3],
    /// Share of `|e_i|` below 1, 2 and 3 standard deviations, for each component `[translation, rotation]`.
    pub axis_coverage: [[f64; 3]; 6],
}

/// Scores pairs of error (of [`crate::covariance::error`]) and claimed covariance; `None` if no pair is usable.
pub fn score<'a>(samples: impl IntoIterator<Item = (&'a Tangent, &'a Covariance6)>) -> Option<Calibration> {
    let (mut nees, mut skipped) = (Vec::new(), 0);
    let (mut translation, mut rotation) = (0.0, 0.0);
    let mut axis_counts = [[0usize; 3]; 6];
    for (error, covariance) in samples {
        let Some(value) = covariance.nees(error) else {
            skipped += 1;
            continue;
        };
        nees.push(value);
        translation += block_nees(covariance, error, 0);
        rotation += block_nees(covariance, error, 3);
        for (i, counts) in axis_counts.iter_mut().enumerate() {
            let deviations = error.0[i].abs() / covariance.matrix()[(i, i)].sqrt();
            for (k, inside) in counts.iter_mut().enumerate() {
                *inside += usize::from(deviations <= (k + 1) as f64);
            }
        }
    }
    let n = nees.len() as f64;
    let coverage = LEVELS.map(|nominal| {
        let nees_limit = chi_square_6_quantile(nominal);
        let inside = nees.iter().filter(|v| **v <= nees_limit).count();
        Coverage { nominal, nees_limit, measured: inside as f64 / n }
    });
    Some(Calibration {
        count: nees.len(),
        skipped,
        nees_mean: nees.iter().sum::<f64>() / n,
        nees_median: median(&nees)?,
        nees_translation_mean: translation / n,
        nees_rotation_mean: rotation / n,
        coverage,
        axis_coverage: axis_counts.map(|counts| counts.map(|c| c as f64 / n)),
    })
}

/// `P(chi^2_6 <= x) = 1 - e^(-x/2) (1 + x/2 + x^2/8)`.
pub fn chi_square_6_cdf(x: f64) -> f64 {
    if x <= 0.0 {
        return 0.0;
    }
    let h = 0.5 * x;
    1.0 - (-h).exp() * (1.0 + h + 0.5 * h * h)
}

/// The `x` with [`chi_square_6_cdf`]`(x) = p`; 0 for `p <= 0`, infinite for `p >= 1`.
pub fn chi_square_6_quantile(p: f64) -> f64 {
    if p <= 0.0 {
        return 0.0;
    }
    if p >= 1.0 {
        return f64::INFINITY;
    }
    let (mut low, mut high) = (0.0, 1.0);
    while chi_square_6_cdf(high) < p {
        high *= 2.0;
    }
    // Bisection until the interval is one step of f64.
    loop {
        let middle = 0.5 * (low + high);
        if middle <= low || middle >= high {
            return high;
        }
        if chi_square_6_cdf(middle) < p { low = middle } else { high = middle }
    }
}

fn block_nees(covariance: &Covariance6, error: &Tangent, first: usize) -> f64 {
    let block = covariance.symmetrized().matrix().fixed_view::<3, 3>(first, first).into_owned();
    let part = error.0.fixed_rows::<3>(first).into_owned();
    // A block of a positive definite matrix is positive definite; NaN would show a failure of that.
    block.cholesky().map_or(f64::NAN, |c| part.dot(&c.solve(&part)))
}
