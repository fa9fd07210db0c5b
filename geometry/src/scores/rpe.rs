//! Relative pose error as `evo_rpe` computes it: drift over a fixed number of frames or metres.

use std::fmt;

use serde::{Deserialize, Serialize};

use super::{ScoreError, check_paired};
use crate::{Pose, se3, statistics::Statistics};

/// Distance between the two poses of a pair.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Delta {
    /// A number of poses, at least 1.
    Frames(usize),
    /// A length of path, in metres.
    Metres(f64),
}

impl fmt::Display for Delta {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Delta::Frames(n) => write!(f, "{n} frame(s)"),
            Delta::Metres(m) => write!(f, "{m} m"),
        }
    }
}

/// Which pairs of poses are compared. The default is `evo`'s: one frame, consecutive pairs.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct RpeOptions {
    /// Distance of a pair.
    pub delta: Delta,
    /// Start a pair at every pose; otherwise each pair starts where the one before ended.
    pub all_pairs: bool,
    /// With `all_pairs` and metres: how far the path of a pair may be from `delta`, relative to it.
    pub relative_tolerance: f64,
    /// Measure metres along the ground truth; otherwise along the estimate, as `evo` does by default.
    pub pairs_from_reference: bool,
}

impl Default for RpeOptions {
    fn default() -> Self {
        Self {
            delta: Delta::Frames(1),
            all_pairs: false,
            relative_tolerance: 0.1,
            pairs_from_reference: false,
        }
    }
}

/// Relative errors.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Rpe {
    /// Which pairs were compared.
    pub options: RpeOptions,
    /// Translational part of the error of the relative motion, in metres.
    pub translation_m: Statistics,
    /// Its rotation angle, in degrees.
    pub rotation_deg: Statistics,
}

/// Compares the motion `i_from_j` of both lists over all selected pairs `(i, j)`.
///
/// The error of a pair is `(reference i_from_j)^-1 * (estimate i_from_j)`.
///
/// # Errors
/// [`ScoreError`] if the lists differ in length or are empty, an option is out of range, or no pair is that far apart.
pub fn score(reference: &[Pose], estimate: &[Pose], options: &RpeOptions) -> Result<Rpe, ScoreError> {
    check_paired(reference, estimate)?;
    let pairs = pairs(if options.pairs_from_reference { reference } else { estimate }, options)?;
    let (translation, rotation): (Vec<f64>, Vec<f64>) = pairs
        .iter()
        .map(|&(i, j)| {
            let truth = se3::relative(&reference[i], &reference[j]);
            let found = se3::relative(&estimate[i], &estimate[j]);
            let error = se3::relative(&truth, &found);
            (error.translation.vector.norm(), se3::angle_rad(&error.rotation).to_degrees())
        })
        .unzip();
    let none = || ScoreError::NoPairs { poses: estimate.len(), delta: options.delta.to_string() };
    Ok(Rpe {
        options: *options,
        translation_m: Statistics::of(&translation).ok_or_else(none)?,
        rotation_deg: Statistics::of(&rotation).ok_or_else(none)?,
    })
}

/// The pairs `(i, j)`, `i < j`, that [`score`] compares.
///
/// # Errors
/// [`ScoreError::Option`] or [`ScoreError::NoPairs`].
pub fn pairs(poses: &[Pose], options: &RpeOptions) -> Result<Vec<(usize, usize)>, ScoreError> {
    let wrong = |option, found: String, expected| ScoreError::Option { option, found, expected };
    let found = match options.delta {
        Delta::Frames(0) => return Err(wrong("delta", "0 frames".into(), "at least 1 frame")),
        Delta::Frames(step) => {
            let stride = if options.all_pairs { 1 } else { step };
            (0..poses.len()).step_by(stride).map(|i| (i, i + step)).filter(|p| p.1 < poses.len()).collect()
        }
        Delta::Metres(m) if !(m.is_finite() && m > 0.0) => {
            return Err(wrong("delta", format!("{m} m"), "a finite length above 0 m"));
        }
        Delta::Metres(_) if options.relative_tolerance.is_nan() || options.relative_tolerance < 0.0 => {
            return Err(wrong("relative_tolerance", options.relative_tolerance.to_string(), "at least 0"));
        }
        Delta::Metres(m) if options.all_pairs => all_by_path(poses, m, m * options.relative_tolerance),
        Delta::Metres(m) => consecutive_by_path(poses, m),
    };
    if found.is_empty() {
        return Err(ScoreError::NoPairs { poses: poses.len(), delta: options.delta.to_string() });
    }
    Ok(found)
}

fn steps(poses: &[Pose]) -> impl Iterator<Item = f64> + '_ {
    poses.windows(2).map(|w| (w[1].translation.vector - w[0].translation.vector).norm())
}

fn consecutive_by_path(poses: &[Pose], delta: f64) -> Vec<(usize, usize)> {
    let (mut pairs, mut start, mut path) = (Vec::new(), 0, 0.0);
    for (i, step) in steps(poses).enumerate() {
        path += step;
        if path >= delta {
            pairs.push((start, i + 1));
            (start, path) = (i + 1, 0.0);
        }
    }
    pairs
}

/// For every start the later pose whose path length is nearest to `delta`, of equally near ones the first.
fn all_by_path(poses: &[Pose], delta: f64, tolerance: f64) -> Vec<(usize, usize)> {
    let mut distance = vec![0.0];
    for step in steps(poses) {
        distance.push(distance[distance.len() - 1] + step);
    }
    let mut pairs = Vec::new();
    for (i, from) in distance.iter().enumerate() {
        let later = &distance[i + 1..];
        if later.is_empty() {
            break;
        }
        // Path lengths never decrease, so the nearest is at or just before the first that reaches `delta`.
        let reached = later.partition_point(|d| d - from < delta);
        let before = reached.checked_sub(1).map(|last| {
            let path = later[last] - from;
            later.partition_point(|d| d - from < path)
        });
        let nearest = [before, Some(reached)]
            .into_iter()
            .flatten()
            .filter_map(|k| later.get(k).map(|d| (k, ((d - from) - delta).abs())))
            .reduce(|a, b| if b.1 < a.1 { b } else { a });
        if let Some((k, _)) = nearest.filter(|n| n.1 <= tolerance) {
            pairs.push((i, i + 1 + k));
        }
    }
    pairs
}
