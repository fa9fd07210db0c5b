//! KITTI odometry scores: translation and rotation error over segments of 100 to 800 m.
//!
//! From every tenth frame, segments end at the first frame whose path along the ground truth exceeds 100, 200, ...
//! 800 m. The error of a segment is `(estimate first_from_last)^-1 * (truth first_from_last)`, its translation and its
//! angle divided by the nominal length; the score is the plain mean over all segments of all lengths.
//!
//! The public tools multiply and invert the matrices as printed, which are rotations only to their last digit;
//! the angle comes from the trace. At 0.1 deg that last digit moves the figure by a few parts in a
//! thousand, so this module computes with the printed matrices too ([`KittiPose::matrix`]) instead of the
//! projected poses. [`Arithmetic::Double`] gives the figures of `kitti-odom-eval`; the C++ devkit rounds
//! several steps to `f32`, which [`Arithmetic::Devkit`] repeats.
//!
//! Frames that the estimate lacks drop the segments that begin or end there (as in `kitti-odom-eval`; the devkit
//! refuses such results).

use nalgebra::{Matrix3, Vector3};
use serde::{Deserialize, Serialize};

use super::ScoreError;
use crate::trajectory::{KittiPose, KittiPoses};

/// Lengths of the segments, in metres.
pub const LENGTHS_M: [u32; 8] = [100, 200, 300, 400, 500, 600, 700, 800];

/// A hundredth of them, in metres: the same figures for a room, whose paths never reach a hundred metres.
pub const ROOM_LENGTHS_M: [u32; 8] = [1, 2, 3, 4, 5, 6, 7, 8];

/// Segments start at every so many frames.
const STEP_FRAMES: usize = 10;

/// Frame rate that the speeds assume.
const RATE_HZ: f64 = 10.0;

/// Precision of the computation.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Arithmetic {
    /// `f64` throughout, as `kitti-odom-eval`.
    #[default]
    Double,
    /// Distances, traces, errors and sums in `f32`, as the C++ devkit.
    Devkit,
}

/// Errors of one segment.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Segment {
    /// Index of its first pose in the ground truth.
    pub first: usize,
    /// Index of its last pose in the ground truth.
    pub last: usize,
    /// Nominal length (m).
    pub length_m: u32,
    /// Translation error per metre (m/m).
    pub translation_per_m: f64,
    /// Rotation error per metre (rad/m).
    pub rotation_rad_per_m: f64,
    /// Mean speed (m/s), assuming 10 frames per second.
    pub speed_mps: f64,
}

/// Mean errors of a group of segments.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Mean {
    /// Number of segments.
    pub segments: usize,
    /// Mean translation error (%).
    pub t_rel_percent: f64,
    /// Mean rotation error (deg per 100 m).
    pub r_rel_deg_per_100m: f64,
}

/// Mean errors of the segments of one length.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct LengthRow {
    /// Nominal length (m).
    pub length_m: u32,
    /// The means.
    #[serde(flatten)]
    pub mean: Mean,
}

/// Mean errors of the segments driven within 2 m/s of a speed.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct SpeedRow {
    /// Centre of the bin (m/s): 2, 4, ... 24. Neighbouring bins overlap, as in the devkit.
    pub speed_mps: f64,
    /// The means.
    #[serde(flatten)]
    pub mean: Mean,
}

/// KITTI scores of one sequence.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct KittiScore {
    /// Over all segments; `None` if no segment fits (path shorter than 100 m, or no frame in common).
    pub overall: Option<Mean>,
    /// By length; lengths without a segment are left out.
    pub per_length: Vec<LengthRow>,
    /// By speed; bins with fewer than three segments are left out, as in the devkit's plots.
    pub per_speed: Vec<SpeedRow>,
    /// Frames of the ground truth that the estimate lacks.
    pub missing_frames: usize,
}

/// Scores an estimate whose frames are all known to the ground truth.
///
/// # Errors
/// [`ScoreError`] if the ground truth lacks frames between its first and last or is empty, or the estimate has a frame
/// that the ground truth does not know.
pub fn score(
    ground_truth: &KittiPoses,
    estimate: &KittiPoses,
    arithmetic: Arithmetic,
) -> Result<KittiScore, ScoreError> {
    let segments = segments(ground_truth, estimate, arithmetic)?;
    let group = |inside: &dyn Fn(&Segment) -> bool| {
        let inside: Vec<&Segment> = segments.iter().filter(|s| inside(s)).collect();
        mean(&inside, arithmetic)
    };
    let per_length = LENGTHS_M
        .iter()
        .filter_map(|&length_m| Some(LengthRow { length_m, mean: group(&|s| s.length_m == length_m)? }));
    let per_speed = (1..=12).filter_map(|i| {
        let speed_mps = f64::from(2 * i);
        let mean = group(&|s| (s.speed_mps - speed_mps).abs() < 2.0)?;
        (mean.segments >= 3).then_some(SpeedRow { speed_mps, mean })
    });
    Ok(KittiScore {
        overall: group(&|_| true),
        per_length: per_length.collect(),
        per_speed: per_speed.collect(),
        missing_frames: ground_truth.len() - estimate.len(),
    })
}

/// The errors of all segments, ordered by first frame and length.
///
/// # Errors
/// As [`score`].
pub fn segments(
    ground_truth: &KittiPoses,
    estimate: &KittiPoses,
    arithmetic: Arithmetic,
) -> Result<Vec<Segment>, ScoreError> {
    segments_of(&LENGTHS_M, ground_truth, estimate, arithmetic)
}

/// The errors of all segments of these lengths, in metres and ascending, ordered by first frame and length.
///
/// # Errors
/// As [`score`].
pub fn segments_of(
    lengths_m: &[u32],
    ground_truth: &KittiPoses,
    estimate: &KittiPoses,
    arithmetic: Arithmetic,
) -> Result<Vec<Segment>, ScoreError> {
    let truth = ground_truth.poses();
    let (first, last) = match (truth.first(), truth.last()) {
        (Some(a), Some(b)) => (a.frame, b.frame),
        _ => return Err(ScoreError::Empty),
    };
    if let Some(gap) = truth.windows(2).find(|w| w[1].frame != w[0].frame + 1) {
        return Err(ScoreError::GroundTruthGap { missing: gap[0].frame + 1, first, last });
    }
    let mut result: Vec<Option<&KittiPose>> = vec![None; truth.len()];
    for pose in estimate.poses() {
        let index = pose.frame.checked_sub(first).filter(|_| pose.frame <= last);
        let index = index.ok_or(ScoreError::UnknownFrame { frame: pose.frame, first, last })?;
        result[index as usize] = Some(pose);
    }

    let distances = distances(truth, arithmetic);
    let mut segments = Vec::new();
    for first in (0..truth.len()).step_by(STEP_FRAMES) {
        let Some(result_first) = result[first].and_then(Affine::inverse_of) else { continue };
        let Some(truth_first) = Affine::inverse_of(&truth[first]) else { continue };
        for &length_m in lengths_m {
            let Some(last) = distances.first_beyond(first, f64::from(length_m)) else { break };
            let Some(result_last) = result[last] else { continue };
            let truth_delta = truth_first.times(&Affine::of(&truth[last]));
            let result_delta = result_first.times(&Affine::of(result_last));
            let Some(inverse) = result_delta.inverse() else { continue };
            let error = inverse.times(&truth_delta);
            let frames = (last - first + 1) as f64;
            let length = f64::from(length_m);
            let (translation, rotation, speed) = match arithmetic {
                Arithmetic::Double => {
                    (error.t.norm() / length, rotation_error(&error.r) / length, length / (frames / RATE_HZ))
                }
                Arithmetic::Devkit => {
                    let t = error.t.map(|v| v as f32);
                    let norm = (t.x * t.x + t.y * t.y + t.z * t.z).sqrt();
                    let angle = rotation_error_f32(&error.r);
                    let speed = (f64::from(length_m as f32) / (0.1 * frames)) as f32;
                    (f64::from(norm / length as f32), f64::from(angle / length as f32), f64::from(speed))
                }
            };
            segments.push(Segment {
                first,
                last,
                length_m,
                translation_per_m: translation,
                rotation_rad_per_m: rotation,
                speed_mps: speed,
            });
        }
    }
    Ok(segments)
}

fn mean(segments: &[&Segment], arithmetic: Arithmetic) -> Option<Mean> {
    if segments.is_empty() {
        return None;
    }
    let average = |value: fn(&Segment) -> f64| match arithmetic {
        Arithmetic::Double => segments.iter().map(|s| value(s)).sum::<f64>() / segments.len() as f64,
        Arithmetic::Devkit => {
            let sum = segments.iter().fold(0f32, |sum, s| sum + value(s) as f32);
            f64::from(sum / segments.len() as f32)
        }
    };
    Some(Mean {
        segments: segments.len(),
        t_rel_percent: average(|s| s.translation_per_m) * 100.0,
        r_rel_deg_per_100m: average(|s| s.rotation_rad_per_m).to_degrees() * 100.0,
    })
}

/// Path length of the ground truth up to each frame.
enum Distances {
    Double(Vec<f64>),
    Devkit(Vec<f32>),
}

impl Distances {
    /// The first frame from `first` on whose path exceeds that of `first` by more than `length`.
    fn first_beyond(&self, first: usize, length: f64) -> Option<usize> {
        let (last, len) = match self {
            Distances::Double(d) => {
                let limit = d[first] + length;
                (first + d[first..].partition_point(|v| *v <= limit), d.len())
            }
            Distances::Devkit(d) => {
                let limit = d[first] + length as f32;
                (first + d[first..].partition_point(|v| *v <= limit), d.len())
            }
        };
        (last < len).then_some(last)
    }
}

fn distances(truth: &[KittiPose], arithmetic: Arithmetic) -> Distances {
    let step = |w: &[KittiPose]| Vector3::from(w[0].matrix.column(3) - w[1].matrix.column(3));
    match arithmetic {
        Arithmetic::Double => {
            let mut d = vec![0.0];
            d.extend(truth.windows(2).scan(0.0, |sum, w| {
                *sum += step(w).norm();
                Some(*sum)
            }));
            Distances::Double(d)
        }
        Arithmetic::Devkit => {
            let mut d = vec![0f32];
            d.extend(truth.windows(2).scan(0f32, |sum, w| {
                let s = step(w).map(|v| v as f32);
                *sum += (s.x * s.x + s.y * s.y + s.z * s.z).sqrt();
                Some(*sum)
            }));
            Distances::Devkit(d)
        }
    }
}

fn rotation_error(r: &Matrix3<f64>) -> f64 {
    (0.5 * (r.trace() - 1.0)).clamp(-1.0, 1.0).acos()
}

fn rotation_error_f32(r: &Matrix3<f64>) -> f32 {
    let (a, b, c) = (r[(0, 0)] as f32, r[(1, 1)] as f32, r[(2, 2)] as f32);
    let d = (0.5 * (f64::from(a + b + c) - 1.0)) as f32;
    d.clamp(-1.0, 1.0).acos()
}

/// `x -> r x + t` with `r` inverted as a matrix, not transposed.
struct Affine {
    r: Matrix3<f64>,
    t: Vector3<f64>,
}

impl Affine {
    fn of(pose: &KittiPose) -> Self {
        Self { r: pose.rotation(), t: pose.matrix.column(3).into_owned() }
    }

    fn inverse_of(pose: &KittiPose) -> Option<Self> {
        Self::of(pose).inverse()
    }

    /// `None` cannot happen for matrices within the reader's tolerance of a rotation.
    fn inverse(&self) -> Option<Self> {
        let r = self.r.try_inverse()?;
        Some(Self { r, t: -(r * self.t) })
    }

    fn times(&self, other: &Self) -> Self {
        Self { r: self.r * other.r, t: self.r * other.t + self.t }
    }
}
