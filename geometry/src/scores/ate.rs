//! Absolute trajectory error as `evo_ape` computes it (its *absolute pose error*, APE).

use serde::{Deserialize, Serialize};

use super::{ScoreError, check_paired};
use crate::{
    Pose,
    align::{Alignment, Similarity},
    se3,
    statistics::Statistics,
};

/// Absolute errors after an alignment.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Ate {
    /// What was aligned.
    pub alignment: Alignment,
    /// Scale by which the estimate was multiplied; 1 unless the alignment has one.
    pub scale: f64,
    /// Distance of the positions, in metres. `rmse` is "the ATE".
    pub translation_m: Statistics,
    /// Angle between the orientations, in degrees.
    pub rotation_deg: Statistics,
}

/// Aligns `estimate` to `reference` and compares pose by pose.
///
/// # Errors
/// [`ScoreError`] if the lists differ in length or are empty, or the alignment is not determined.
pub fn score(reference: &[Pose], estimate: &[Pose], alignment: Alignment) -> Result<Ate, ScoreError> {
    check_paired(reference, estimate)?;
    let reference_from_estimate = alignment.solve(estimate, reference)?;
    let (translation, rotation) = errors(reference, estimate, &reference_from_estimate);
    let statistics = |e: &[f64]| Statistics::of(e).ok_or(ScoreError::Empty);
    Ok(Ate {
        alignment,
        scale: reference_from_estimate.scale,
        translation_m: statistics(&translation)?,
        rotation_deg: statistics(&rotation)?,
    })
}

/// Translation (m) and rotation (deg) error of each pose after `reference_from_estimate`.
pub fn errors(
    reference: &[Pose],
    estimate: &[Pose],
    reference_from_estimate: &Similarity,
) -> (Vec<f64>, Vec<f64>) {
    let pairs = reference.iter().zip(estimate);
    pairs
        .map(|(truth, raw)| {
            let aligned = reference_from_estimate.apply(raw);
            let distance = (aligned.translation.vector - truth.translation.vector).norm();
            let angle = se3::angle_rad(&aligned.rotation.rotation_to(&truth.rotation));
            (distance, angle.to_degrees())
        })
        .unzip()
}
