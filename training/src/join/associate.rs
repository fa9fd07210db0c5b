//! Which pose belongs to which frame.

use std::collections::HashMap;
use std::path::Path;

use grnet_capture::dataset::{self, Layout, OpenOptions, Pose, RecordedFrame};
use grnet_geometry::trajectory::Trajectory;

use super::{JoinError, LEAST_MATCHES};

/// Poses for frames, in the frames' order, and how they were found.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Matched {
    /// World from tracked body, as the trajectory has it.
    pub poses: Vec<Option<Pose>>,
    /// Frames before the first or after the last pose.
    pub outside: usize,
    /// Frames in a gap that is too long.
    pub in_gaps: usize,
    /// Frames whose name the trajectory does not have.
    pub unnamed: usize,
    /// Longest time between two poses that was interpolated over, nanoseconds.
    pub largest_gap_ns: Option<i64>,
}

/// The pose of a trajectory at a time, and over which gap it was interpolated.
pub(super) enum At {
    Pose(Pose, Option<i64>),
    Outside,
    InGap,
}

/// Looks up a time between poses that are at most `max_gap_ns` apart.
pub(super) fn at(trajectory: &Trajectory, time_ns: i64, max_gap_ns: i64) -> At {
    let poses = trajectory.poses();
    let after = poses.partition_point(|pose| pose.time_ns < time_ns);
    let gap_ns = match (after.checked_sub(1).map(|before| poses[before]), poses.get(after)) {
        (_, Some(next)) if next.time_ns == time_ns => None,
        (Some(last), Some(next)) => Some(next.time_ns.saturating_sub(last.time_ns)),
        _ => return At::Outside,
    };
    match trajectory.at(time_ns) {
        Some(_) if gap_ns.is_some_and(|gap_ns| gap_ns > max_gap_ns) => At::InGap,
        Some(pose) => At::Pose(pose, gap_ns),
        None => At::Outside,
    }
}

/// The time of a frame on the clock of trajectories.
pub(super) fn time_ns(frame: &RecordedFrame) -> i64 {
    i64::try_from(frame.time_ns).unwrap_or(i64::MAX)
}

/// Interpolates the trajectory, whose times are moved by `time_offset_ns`, at the frames' times.
///
/// # Errors
/// When they have no time in common, or fewer than [`LEAST_MATCHES`] frames get a pose.
pub fn by_time(
    frames: &[RecordedFrame],
    trajectory: &Trajectory,
    time_offset_ns: i64,
    max_gap_ns: i64,
) -> Result<Matched, JoinError> {
    let mut matched = Matched::default();
    for frame in frames {
        let found = at(trajectory, time_ns(frame).saturating_sub(time_offset_ns), max_gap_ns);
        matched.poses.push(match found {
            At::Pose(pose, gap_ns) => {
                matched.largest_gap_ns = matched.largest_gap_ns.max(gap_ns);
                Some(pose)
            }
            At::Outside => {
                matched.outside += 1;
                None
            }
            At::InGap => {
                matched.in_gaps += 1;
                None
            }
        });
    }
    if matched.outside == frames.len() {
        let seconds = |ns: i64| ns as f64 * 1e-9;
        let span = |first: Option<i64>, last: Option<i64>| {
            (first.map_or(f64::NAN, seconds), last.map_or(f64::NAN, seconds))
        };
        let moved = |pose: &grnet_geometry::StampedPose| pose.time_ns.saturating_add(time_offset_ns);
        return Err(JoinError::NoOverlap {
            frames: span(frames.first().map(time_ns), frames.last().map(time_ns)),
            trajectory: span(trajectory.poses().first().map(moved), trajectory.poses().last().map(moved)),
        });
    }
    enough(matched)
}

/// Takes the poses of the COLMAP text model in the folder `model` by the images' file names, without extension.
///
/// # Errors
/// When the model cannot be read, names are not unique, or fewer than [`LEAST_MATCHES`] frames get a pose.
pub fn by_name(frames: &[RecordedFrame], model: &Path) -> Result<Matched, JoinError> {
    let options = OpenOptions { layout: Layout::Colmap, ..OpenOptions::default() };
    let mut by_name = HashMap::new();
    for image in dataset::open(model, &options)?.into_iter().flat_map(|recording| recording.frames) {
        let name = name(&image.path);
        if by_name.insert(name.clone(), image.world_from_camera).is_some() {
            return Err(JoinError::TwoOfOneName { what: "the model", name });
        }
    }
    let example = |mut names: Vec<&String>| {
        names.sort();
        names.first().map_or_else(String::new, |name| (*name).clone())
    };
    let mut matched = Matched::default();
    let mut seen = HashMap::new();
    for frame in frames {
        let name = name(&frame.path);
        let pose = by_name.get(&name).copied().flatten();
        matched.unnamed += usize::from(pose.is_none());
        matched.poses.push(pose);
        if seen.insert(name.clone(), ()).is_some() {
            return Err(JoinError::TwoOfOneName { what: "the recording", name });
        }
    }
    if matched.unnamed == frames.len() {
        let (recording, model) = (example(seen.keys().collect()), example(by_name.keys().collect()));
        return Err(JoinError::NoNames { recording, model });
    }
    enough(matched)
}

fn enough(matched: Matched) -> Result<Matched, JoinError> {
    let found = matched.poses.iter().flatten().count();
    if found < LEAST_MATCHES {
        let Matched { outside, in_gaps, .. } = matched;
        return Err(JoinError::TooFew { found, frames: matched.poses.len(), outside, in_gaps });
    }
    Ok(matched)
}

fn name(image: &Path) -> String {
    image.file_stem().unwrap_or_default().to_string_lossy().into_owned()
}

#[cfg(test)]
mod tests {
    use grnet_geometry::StampedPose;

    use super::*;

    fn frames(times_ms: &[u64]) -> Vec<RecordedFrame> {
        let frame = |(sequence, ms): (u64, &u64)| RecordedFrame {
            path: format!("rgb/{sequence}.png").into(),
            time_ns: ms * 1_000_000,
            sequence,
            world_from_camera: None,
            camera: None,
        };
        (0..).zip(times_ms).map(frame).collect()
    }

    /// One metre a second along x.
    fn trajectory(times_ms: &[i64]) -> Trajectory {
        let stamped = |ms: &i64| StampedPose {
            time_ns: ms * 1_000_000,
            world_from_camera: Pose::translation(*ms as f64 / 1000.0, 0.0, 0.0),
        };
        Trajectory::new(times_ms.iter().map(stamped).collect()).unwrap()
    }

    const MS: i64 = 1_000_000;

    #[test]
    fn poses_are_interpolated_and_long_gaps_and_ends_are_left_without() {
        let trajectory = trajectory(&[100, 200, 300, 900, 1000]);
        let matched =
            by_time(&frames(&[50, 100, 150, 250, 600, 950, 2000]), &trajectory, 0, 100 * MS).unwrap();
        let millimetres = |pose: Pose| (1000.0 * pose.translation.x).round() as i64;
        let x: Vec<Option<i64>> = matched.poses.iter().map(|pose| pose.map(millimetres)).collect();
        assert_eq!(x, [None, Some(100), Some(150), Some(250), None, Some(950), None]);
        assert_eq!((matched.outside, matched.in_gaps), (2, 1));
        assert_eq!(matched.largest_gap_ns, Some(100 * MS));
        let wide = by_time(&frames(&[50, 100, 250, 600]), &trajectory, 0, 600 * MS).unwrap();
        assert_eq!((wide.in_gaps, wide.largest_gap_ns), (0, Some(600 * MS)));
    }

    #[test]
    fn an_offset_moves_the_trajectory() {
        let trajectory = trajectory(&[0, 100, 200]);
        let matched = by_time(&frames(&[1050, 1100, 1150]), &trajectory, 1000 * MS, 100 * MS).unwrap();
        assert_eq!(matched.poses[0].unwrap().translation.x, 0.05);
    }

    #[test]
    fn without_overlap_both_ranges_and_the_offset_are_named() {
        let error =
            by_time(&frames(&[5000, 6000]), &trajectory(&[0, 1000]), 500 * MS, MS).unwrap_err().to_string();
        for part in ["5.000 to 6.000", "0.500 to 1.500", "would be 4.500"] {
            assert!(error.contains(part), "{error}");
        }
        let error =
            by_time(&frames(&[0, 500, 1000]), &trajectory(&[0, 1000]), 0, MS).unwrap_err().to_string();
        assert!(error.contains("2 of 3 frames") && error.contains("1 in its gaps"), "{error}");
    }

    #[test]
    fn a_colmap_model_is_joined_by_name() {
        let folder = tempfile::tempdir().unwrap();
        let put = |name: &str, text: &str| std::fs::write(folder.path().join(name), text).unwrap();
        put("cameras.txt", "1 PINHOLE 64 48 50 50 32 24\n");
        let line = |id: u32, name: &str| format!("{id} 1 0 0 0 {id} 0 0 1 {name}\n\n");
        put("images.txt", &(line(1, "rgb/0.png") + &line(2, "1.jpg") + &line(3, "rgb/3.png")));
        let matched = by_name(&frames(&[0, 1, 2, 3]), folder.path()).unwrap();
        let x: Vec<Option<f64>> = matched.poses.iter().map(|p| p.map(|p| p.translation.x)).collect();
        assert_eq!(x, [Some(-1.0), Some(-2.0), None, Some(-3.0)]);
        assert_eq!(matched.unnamed, 1);

        put("images.txt", &(line(1, "a/0.png") + &line(2, "b/0.png")));
        let error = by_name(&frames(&[0, 1]), folder.path()).unwrap_err().to_string();
        assert!(error.contains("the model has two images \"0\""), "{error}");
        put("images.txt", &line(1, "other.png"));
        let error = by_name(&frames(&[0, 1]), folder.path()).unwrap_err().to_string();
        assert!(error.contains("\"other\"") && error.contains("\"0\""), "{error}");
    }
}
