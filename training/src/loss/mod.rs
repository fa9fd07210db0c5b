//! The losses of the paper and the ones that weigh themselves (section "Temporal Geometric Consistency Loss").
//!
//! # The paper
//!
//! With outputs `P_t` for the K frames of a window and truth `P*_t`, over the N windows of a batch:
//!
//! ```text
//! Eq. (1)  P_ij = P_i^-1 P_j                                  camera_i_from_camera_j
//! Eq. (2)  L_k  = || P_ij - P*_ij ||^2                        (i, j) the k-th of the CTC pairs, see `pairs`
//! Eq. (3)  1/N sum_N   sum_k L_k                              stage 1: CNN1 and RCNN1       `relative_loss`
//! Eq. (4)  1/N sum_N { sum_k L_k + sum_t || P_t - P*_t ||^2 } stages 2 and 3: RCNN2, FCFL   `joint_loss`
//! ```
//!
//! How we read it:
//! * Eq. (1) prints `P_1 P_0^-1`, which is the same motion, up to inversion, of poses read as camera_from_world. With ours,
//!   world_from_camera, the printed product would depend on where the world's origin is, and no relative network could
//!   learn it.
//! * RCNN1 gives the motion of each step, `P_t` = camera_{t-1}_from_camera_t; a longer pair is composed,
//!   `P_02 = P_01 P_12`. The global and fused heads give absolute poses, and every pair comes from two of them.
//! * Frame 0 of a window is paired with itself, and its relative output is in no term: Eq. (3) has none for it, the truth
//!   is no motion whatever the image shows, and at run time the motion of a first frame is never used.
//! * `||.||^2` "is MSE": the mean over the 3 components of the translation (m) plus the mean over the 4 of the quaternion,
//!   each with weight 1. The true quaternion has w >= 0. A quaternion that the head wrote enters as it is, not normalised;
//!   one that is computed (composition, 6-D rotation) is the unit quaternion with the sign nearer to the true one.
//!
//! # The learned weights
//!
//! `Loss::Learned` keeps pairs and frames and replaces the norm: translations and rotations are terms of their own,
//! `L_t = mean |t - t*|^2 / 3` and `L_r = mean |Log(R*^T R)|^2 / 3` (radians; the mean also over windows and over pairs or
//! frames, so that K does not weigh), and each counts as `exp(-s) L + s` with a learned `s`: see [`Homoscedastic`]. The raw
//! rotation is first projected: a quaternion by its length, six numbers by Gram-Schmidt. Residuals are squared, the likelihood
//! of Gaussian errors, the same that the published covariances assume.
//!
//! `Loss::Robust` differs from that in one thing: it takes lengths instead of squares, `L_t = mean |t - t*| / sqrt(3)` and likewise
//! `L_r`, and a term counts as `2 exp(-s / 2) L + s`, the likelihood of errors with Laplace's heavier tails (Kendall & Cipolla,
//! CVPR 2017, prefer an L1 norm to squares, too). Images that say little then do not pull at the rest as their squares do. Below a
//! millimetre and a milliradian lengths are rounded off, so that a perfect prediction has a gradient.
//!
//! Beside each stands [`uncertainty_loss`] for the log-variance heads.
//!
//! Motions and residuals are computed on the CPU in f64 with analytic gradients, whatever the device of the network.

mod chart;
mod homoscedastic;
mod motion;
mod pairs;
mod residual;
mod targets;
mod uncertainty;

use candle_core::{Device, Result, Tensor, bail};
use grnet_geometry::{Pose, covariance};
use grnet_model::HeadTensors;
use serde::{Deserialize, Serialize};

pub use homoscedastic::Homoscedastic;
pub use pairs::pairs;
pub(crate) use targets::mean_rotation;
pub use targets::{TargetStatistics, Targets};
pub use uncertainty::uncertainty_loss;

use motion::Motion;
use residual::{Residuals, Space};

/// Which loss.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Loss {
    /// Eq. (3) and (4) as printed: a plain mean of squares over metres and quaternion components.
    Paper,
    /// The same pairs and frames with a rotation residual on SO(3) and learned weights.
    Learned,
    /// As `Learned`, of lengths instead of squares.
    Robust,
}

/// Lengths below this (m or rad) are nearly squares.
const ROUNDED: f64 = 1e-3;

/// What of the three components of an error counts.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Norm {
    /// The mean of their squares.
    Squares,
    /// Their root mean square.
    Length,
}

impl Loss {
    /// The norm, where weights are learned.
    pub const fn norm(self) -> Option<Norm> {
        match self {
            Self::Paper => None,
            Self::Learned => Some(Norm::Squares),
            Self::Robust => Some(Norm::Length),
        }
    }
}

impl Norm {
    /// (B, M, 3) squares of the components -> their mean over windows and motions, a scalar.
    fn mean(self, squares: &Tensor) -> Result<Tensor> {
        match self {
            Self::Squares => squares.mean_all(),
            Self::Length => {
                let square = squares.mean(2)?; // (B, M, 3) -> (B, M)
                square.affine(1.0, ROUNDED * ROUNDED)?.sqrt()?.mean_all()?.affine(1.0, -ROUNDED)
            }
        }
    }
}

/// The head whose outputs a loss is about.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Head {
    /// fc4 and fc5 on fc1: the motion since the previous frame.
    Relative,
    /// fc4 and fc5 on fc2: world_from_camera.
    Global,
    /// fc4 and fc5 on fc3: world_from_camera.
    Fused,
}

impl Head {
    /// Its name in logs and variables.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Relative => "relative",
            Self::Global => "global",
            Self::Fused => "fused",
        }
    }
}

impl std::fmt::Display for Head {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(self.name())
    }
}

/// Over what a term is summed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Term {
    Absolute,
    Pairs,
}

impl Term {
    const fn name(self) -> &'static str {
        match self {
            Self::Absolute => "absolute",
            Self::Pairs => "pairs",
        }
    }
}

/// Of what a term is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Component {
    Translation,
    Rotation,
}

impl Component {
    const fn name(self) -> &'static str {
        match self {
            Self::Translation => "translation",
            Self::Rotation => "rotation",
        }
    }
}

/// A loss and what it is made of.
#[derive(Debug, Clone)]
pub struct Terms {
    /// What to minimise, a scalar on the device of the targets.
    pub total: Tensor,
    /// Mean errors for logs, scalars on the CPU without gradient: `pairs_translation_m`, `pairs_rotation_deg`, and for
    /// [`joint_loss`] `absolute_translation_m`, `absolute_rotation_deg`. Means of lengths and angles, whatever the loss.
    pub parts: Vec<(&'static str, Tensor)>,
}

/// Eq. (3) for the motions of single steps that RCNN1's head gives.
///
/// Without `homoscedastic` the learned weights are those of `s = 0`; `Loss::Paper` has no use for them.
///
/// # Errors
/// When the windows have a single frame, the head's tensors are not of the targets' windows, a weight is missing or a
/// tensor operation fails.
pub fn relative_loss(
    kind: Loss,
    output: &HeadTensors,
    targets: &Targets,
    homoscedastic: Option<&Homoscedastic>,
) -> Result<Terms> {
    if targets.frames() < 2 {
        bail!("the relative loss compares motions: it needs windows of at least 2 frames, not of 1");
    }
    let chains = pairs(targets.frames()).into_iter().map(|(i, j)| Motion::Chain(i, j)).collect();
    terms(kind, output, targets, (Head::Relative, homoscedastic), &[(Term::Pairs, chains)])
}

/// Eq. (4) for the absolute poses that the global or the fused head gives. A window of one frame has no pairs.
///
/// Without `homoscedastic` the learned weights are those of `s = 0`; `Loss::Paper` has no use for them.
///
/// # Errors
/// When `head` is the relative one, the head's tensors are not of the targets' windows, a weight is missing or a tensor
/// operation fails.
pub fn joint_loss(
    kind: Loss,
    output: &HeadTensors,
    targets: &Targets,
    head: Head,
    homoscedastic: Option<&Homoscedastic>,
) -> Result<Terms> {
    if head == Head::Relative {
        bail!("the joint loss is about absolute poses: the relative head has `relative_loss`");
    }
    let mut groups = Vec::new();
    let between: Vec<_> = pairs(targets.frames()).into_iter().map(|(i, j)| Motion::Between(i, j)).collect();
    if !between.is_empty() {
        groups.push((Term::Pairs, between));
    }
    groups.push((Term::Absolute, (0..targets.frames()).map(Motion::Absolute).collect()));
    terms(kind, output, targets, (head, homoscedastic), &groups)
}

/// The total over groups of motions; one operation gives the residuals of all of them.
fn terms(
    kind: Loss,
    output: &HeadTensors,
    targets: &Targets,
    (head, homoscedastic): (Head, Option<&Homoscedastic>),
    groups: &[(Term, Vec<Motion>)],
) -> Result<Terms> {
    let motions: Vec<Motion> = groups.iter().flat_map(|(_, motions)| motions).copied().collect();
    let truths = targets.truths(&motions);
    let parts = parts(&errors(output, targets, &motions, &truths)?, groups)?;
    let space = if kind == Loss::Paper { Space::Quaternion } else { Space::Log };
    let residuals = Residuals { space, frames: targets.frames(), motions, truths };
    let residuals = residuals.of(output, targets.device())?; // (B, M, 7 or 6)
    let squares = residuals.sqr()?;
    let total = match kind.norm() {
        None => {
            let translation = squares.narrow(2, 0, 3)?.sum_all()?.affine(1.0 / 3.0, 0.0)?;
            let rotation = squares.narrow(2, 3, 4)?.sum_all()?.affine(1.0 / 4.0, 0.0)?;
            (translation + rotation)?.affine(1.0 / targets.batch() as f64, 0.0)?
        }
        Some(norm) => {
            let mut weighed = Vec::new();
            let mut first = 0;
            for (term, motions) in groups {
                let of_group = squares.narrow(1, first, motions.len())?; // (B, M, 6) -> (B, group, 6)
                for (component, at) in [(Component::Translation, 0), (Component::Rotation, 3)] {
                    let loss = norm.mean(&of_group.narrow(2, at, 3)?)?;
                    weighed.push(match homoscedastic {
                        Some(weights) => weights.weigh(head, *term, component, &loss)?,
                        None => norm.weigh(&loss, &loss.zeros_like()?)?,
                    });
                }
                first += motions.len();
            }
            Tensor::stack(&weighed, 0)?.sum_all()?
        }
    };
    Ok(Terms { total, parts })
}

/// Length (m) and angle (deg) of every motion's error, window by window.
fn errors(
    output: &HeadTensors,
    targets: &Targets,
    motions: &[Motion],
    truths: &[Pose],
) -> Result<Vec<(f64, f64)>> {
    let frames = targets.frames();
    let poses = chart::poses(output, targets.batch(), frames)?;
    let error = |(window, (motion, truth)): (&[Pose], (&Motion, &Pose))| {
        let error = covariance::error(&motion.of(window), truth);
        (error.translation().norm(), error.rotation().norm().to_degrees())
    };
    let of_window = |(window, truths): (&'_ [Pose], &'_ [Pose])| -> Vec<(f64, f64)> {
        motions.iter().zip(truths).map(|pair| error((window, pair))).collect()
    };
    Ok(poses.chunks_exact(frames).zip(truths.chunks_exact(motions.len())).flat_map(of_window).collect())
}

/// Their means, group by group.
fn parts(errors: &[(f64, f64)], groups: &[(Term, Vec<Motion>)]) -> Result<Vec<(&'static str, Tensor)>> {
    let motions: usize = groups.iter().map(|(_, motions)| motions.len()).sum();
    let mut parts = Vec::new();
    let mut first = 0;
    for (term, group) in groups {
        let of_group = errors.chunks_exact(motions).flat_map(|window| &window[first..first + group.len()]);
        let (count, metres, degrees) =
            of_group.fold((0.0, 0.0, 0.0), |(n, t, r), error| (n + 1.0, t + error.0, r + error.1));
        let names = match term {
            Term::Absolute => ["absolute_translation_m", "absolute_rotation_deg"],
            Term::Pairs => ["pairs_translation_m", "pairs_rotation_deg"],
        };
        for (name, sum) in names.into_iter().zip([metres, degrees]) {
            parts.push((name, Tensor::new((sum / count) as f32, &Device::Cpu)?));
        }
        first += group.len();
    }
    Ok(parts)
}

#[cfg(test)]
mod tests;
