//! Relocalization scores as the 7-Scenes literature reports them: median errors and recall within thresholds.

use serde::{Deserialize, Serialize};

use super::{ScoreError, ate, check_paired};
use crate::{Pose, align::Similarity, statistics::median};

/// A pair of thresholds, and the share of frames below both.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Recall {
    /// Translation threshold (m).
    pub translation_m: f64,
    /// Rotation threshold (deg).
    pub rotation_deg: f64,
    /// Share of the compared frames, 0 to 1.
    pub recall: f64,
    /// Share of all frames that should have been localized; a missing frame is not recalled.
    pub recall_of_all: f64,
}

/// Relocalization scores of a sequence.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Relocalization {
    /// Number of compared frames.
    pub count: usize,
    /// Number of frames of the ground truth without an estimate.
    pub missing: usize,
    /// Median distance of the positions (m) over the compared frames.
    pub median_translation_m: f64,
    /// Median angle between the orientations (deg) over the compared frames.
    pub median_rotation_deg: f64,
    /// One entry for each pair of thresholds, in the order given.
    pub recalls: Vec<Recall>,
}

/// The customary thresholds `(m, deg)`; the first one is the 7-Scenes figure.
pub const THRESHOLDS: [(f64, f64); 3] = [(0.05, 5.0), (0.25, 10.0), (0.5, 10.0)];

/// Compares poses pair by pair without any alignment.
///
/// A frame is recalled if its translation **and** its rotation error are below the thresholds (strictly). Medians
/// are over the compared frames; `missing` further frames enter only `recall_of_all`.
///
/// # Errors
/// [`ScoreError`] if the lists differ in length or are empty.
pub fn score(
    reference: &[Pose],
    estimate: &[Pose],
    missing: usize,
    thresholds: &[(f64, f64)],
) -> Result<Relocalization, ScoreError> {
    check_paired(reference, estimate)?;
    let (translation, rotation) = ate::errors(reference, estimate, &Similarity::identity());
    let count = translation.len();
    let recalls = thresholds.iter().map(|&(translation_m, rotation_deg)| {
        let below =
            translation.iter().zip(&rotation).filter(|(t, r)| **t < translation_m && **r < rotation_deg);
        let recalled = below.count() as f64;
        Recall {
            translation_m,
            rotation_deg,
            recall: recalled / count as f64,
            recall_of_all: recalled / (count + missing) as f64,
        }
    });
    Ok(Relocalization {
        count,
        missing,
        median_translation_m: median(&translation).ok_or(ScoreError::Empty)?,
        median_rotation_deg: median(&rotation).ok_or(ScoreError::Empty)?,
        recalls: recalls.collect(),
    })
}
