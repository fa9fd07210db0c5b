//! Trajectory files that public tools read.

use std::path::Path;

use grnet_geometry::trajectory::{KittiPoses, kitti, tum};
use grnet_geometry::{Pose, StampedPose, Trajectory};

use super::ReportError;
use crate::evaluate::{Evaluation, System};

/// Writes the truth and every system that predicts poses.
pub fn write(evaluation: &Evaluation, folder: &Path) -> Result<(), ReportError> {
    for sequence in evaluation.data.tested_sequences() {
        let file = crate::evaluate::slug(&evaluation.data.recordings[sequence].id);
        let truth = create(&folder.join("truth"))?;
        let frames = frames(evaluation, sequence, &|_, truth| truth);
        if !frames.is_empty() {
            tum::write(&truth.join(format!("{file}.tum")), &trajectory(&frames))?;
        }
        for system in evaluation.systems.iter().filter(|system| system.poses.is_some()) {
            system_files(evaluation, system, sequence, &file, folder)?;
        }
    }
    Ok(())
}

fn system_files(
    evaluation: &Evaluation,
    system: &System,
    sequence: usize,
    file: &str,
    folder: &Path,
) -> Result<(), ReportError> {
    let estimates = frames(evaluation, sequence, &|frame, _| system.pose(frame));
    if estimates.is_empty() {
        return Ok(());
    }
    let folder = create(&folder.join(&system.slug))?;
    tum::write(&folder.join(format!("{file}.tum")), &trajectory(&estimates))?;
    // KITTI files have no times: only frames that both have, so that rows pair.
    let both = |frame: usize, truth: Option<Pose>| system.pose(frame).zip(truth);
    let paired: Vec<(i64, (Pose, Pose))> = frames(evaluation, sequence, &both);
    let rows =
        |pose: fn(&(Pose, Pose)) -> &Pose| KittiPoses::from_poses(paired.iter().map(|(_, both)| pose(both)));
    if !paired.is_empty() {
        kitti::write(&folder.join(format!("{file}.kitti")), &rows(|both| &both.0))?;
        kitti::write(&folder.join(format!("{file}.truth.kitti")), &rows(|both| &both.1))?;
    }
    Ok(())
}

/// Times and values of the test frames of a sequence for which there is a value.
fn frames<T>(
    evaluation: &Evaluation,
    sequence: usize,
    value: &dyn Fn(usize, Option<Pose>) -> Option<T>,
) -> Vec<(i64, T)> {
    let test = &evaluation.data.task.test;
    let mut last = None;
    let of = |frame: usize| {
        let view = &test[frame];
        let time_ns = i64::try_from(view.time_ns).ok()?;
        let value = value(frame, view.world_from_camera)?;
        // Two frames of one time cannot both stand in a trajectory.
        (last.replace(time_ns) != Some(time_ns)).then_some((time_ns, value))
    };
    evaluation.data.test_range(sequence).filter_map(of).collect()
}

fn trajectory(frames: &[(i64, Pose)]) -> Trajectory {
    let mut trajectory = Trajectory::default();
    for &(time_ns, world_from_camera) in frames {
        // Times of a recording never fall, and equal ones were left out.
        let pushed = trajectory.push(StampedPose { time_ns, world_from_camera });
        debug_assert!(pushed.is_ok(), "{pushed:?}");
    }
    trajectory
}

fn create(folder: &Path) -> Result<std::path::PathBuf, ReportError> {
    std::fs::create_dir_all(folder).map_err(ReportError::write(folder))?;
    Ok(folder.to_path_buf())
}
