use thiserror::Error;

use super::Trajectory;

/// How two trajectories are paired by time.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct AssociationOptions {
    /// Largest difference in time of a pair; `evo`'s default is 10 ms.
    pub max_difference_ns: i64,
    /// Added to the times of the estimate before they are compared.
    pub estimate_offset_ns: i64,
    /// Use every pose at most once (the closest pair wins). Off, as in `evo`: a pose of the longer trajectory
    /// can then be the nearest of two poses of the shorter one.
    pub one_to_one: bool,
}

impl Default for AssociationOptions {
    fn default() -> Self {
        Self { max_difference_ns: 10_000_000, estimate_offset_ns: 0, one_to_one: false }
    }
}

/// Pairs of poses of the same time.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Association {
    /// `(index in the reference, index in the estimate)`, in order of time; never empty.
    pub pairs: Vec<(usize, usize)>,
    /// Number of pairs whose pose of the longer trajectory stands in the pair before as well.
    pub reused: usize,
}

/// Two trajectories without a common time.
#[derive(Debug, Clone, Copy, PartialEq, Error)]
#[error(
    "found no poses of the same time: the reference covers {} to {} s, the estimate {} to {} s \
     with its offset; allowed difference {} s. Check the clocks, or give an offset or a larger difference",
    reference.0, reference.1, estimate.0, estimate.1, max_difference
)]
pub struct NoMatch {
    /// First and last time of the reference (s).
    pub reference: (f64, f64),
    /// First and last time of the estimate after the offset (s).
    pub estimate: (f64, f64),
    /// Largest allowed difference (s).
    pub max_difference: f64,
}

/// Pairs every pose of the shorter trajectory with the pose of the longer one that is nearest in time, as
/// `evo` does (of two equally near ones the earlier).
///
/// # Errors
/// [`NoMatch`] if no pair is within the allowed difference.
pub fn associate(
    reference: &Trajectory,
    estimate: &Trajectory,
    options: &AssociationOptions,
) -> Result<Association, NoMatch> {
    let times = |trajectory: &Trajectory, offset: i64| -> Vec<i128> {
        trajectory.poses().iter().map(|p| i128::from(p.time_ns) + i128::from(offset)).collect()
    };
    let (t_reference, t_estimate) = (times(reference, 0), times(estimate, options.estimate_offset_ns));
    let estimate_is_longer = t_estimate.len() > t_reference.len();
    let (short, long) =
        if estimate_is_longer { (&t_reference, &t_estimate) } else { (&t_estimate, &t_reference) };

    // (difference, index in the shorter, index in the longer)
    let mut matches: Vec<(i128, usize, usize)> = Vec::new();
    for (i, t) in short.iter().enumerate() {
        let after = long.partition_point(|u| u < t);
        let nearest = [after.checked_sub(1), Some(after)]
            .into_iter()
            .flatten()
            .filter_map(|j| long.get(j).map(|u| ((u - t).abs(), i, j)))
            .min_by_key(|m| m.0);
        matches.extend(nearest.filter(|m| m.0 <= i128::from(options.max_difference_ns)));
    }
    if options.one_to_one {
        // Neighbours that share a pose: times grow, so equal indices are adjacent.
        let mut kept: Vec<(i128, usize, usize)> = Vec::with_capacity(matches.len());
        for m in matches {
            match kept.last_mut().filter(|last| last.2 == m.2) {
                Some(last) if m.0 < last.0 => *last = m,
                Some(_) => {}
                None => kept.push(m),
            }
        }
        matches = kept;
    }
    if matches.is_empty() {
        let seconds = |ns: i128| ns as f64 * 1e-9;
        let span = |t: &[i128]| {
            (t.first().map_or(f64::NAN, |t| seconds(*t)), t.last().map_or(f64::NAN, |t| seconds(*t)))
        };
        return Err(NoMatch {
            reference: span(&t_reference),
            estimate: span(&t_estimate),
            max_difference: seconds(i128::from(options.max_difference_ns)),
        });
    }
    let reused = matches.windows(2).filter(|w| w[0].2 == w[1].2).count();
    let pairs = matches.iter().map(|&(_, s, l)| if estimate_is_longer { (s, l) } else { (l, s) }).collect();
    Ok(Association { pairs, reused })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Pose, StampedPose};

    fn at(times_ms: &[i64]) -> Trajectory {
        let stamped = |t: &i64| StampedPose { time_ns: t * 1_000_000, world_from_camera: Pose::identity() };
        Trajectory::new(times_ms.iter().map(stamped).collect()).unwrap()
    }

    fn pairs(reference: &[i64], estimate: &[i64], options: AssociationOptions) -> Vec<(usize, usize)> {
        associate(&at(reference), &at(estimate), &options).unwrap().pairs
    }

    #[test]
    fn nearest_within_the_difference() {
        let options = AssociationOptions::default();
        assert_eq!(pairs(&[0, 100, 200, 300], &[4, 111, 190], options), [(0, 0), (2, 2)]);
        assert_eq!(pairs(&[4, 111, 190], &[0, 100, 200, 300], options), [(0, 0), (2, 2)]);
        // Equally near: the earlier one.
        assert_eq!(pairs(&[0, 10, 20], &[5], options), [(0, 0)]);
        let offset = AssociationOptions { estimate_offset_ns: 50_000_000, ..options };
        assert_eq!(pairs(&[0, 100, 200], &[51, 150], offset), [(1, 0), (2, 1)]);
    }

    #[test]
    fn a_shared_pose_is_kept_or_given_to_the_closest() {
        let options = AssociationOptions::default();
        let (reference, estimate) = (at(&[0, 100, 200]), at(&[97, 102]));
        let shared = associate(&reference, &estimate, &options).unwrap();
        assert_eq!((shared.pairs, shared.reused), (vec![(1, 0), (1, 1)], 1));
        let unique = AssociationOptions { one_to_one: true, ..options };
        let unique = associate(&reference, &estimate, &unique).unwrap();
        assert_eq!((unique.pairs, unique.reused), (vec![(1, 1)], 0));
    }

    #[test]
    fn without_a_match_both_spans_are_named() {
        let error = associate(&at(&[0, 1000]), &at(&[5000]), &AssociationOptions::default()).unwrap_err();
        let text = error.to_string();
        assert!(text.contains("0 to 1 s") && text.contains("5 to 5 s") && text.contains("0.01 s"), "{text}");
    }
}
