//! Ground truth in the form that the recording's reader takes.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use grnet_capture::dataset::{Layout, Pose, RecordedFrame, Recording};
use grnet_geometry::trajectory::{Trajectory, tum};
use grnet_geometry::{StampedPose, quaternion};

use super::JoinError;
use super::associate::time_ns;

/// Where the ground truth goes, and in which form.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Target {
    /// `time_s tx ty tz qx qy qz qw`, `world_from_camera`.
    Tum(PathBuf),
    /// `image qw qx qy qz tx ty tz`, `camera_from_world`: for images that have no times of their own.
    Names(PathBuf),
}

impl Target {
    /// The file.
    pub fn path(&self) -> &Path {
        let (Self::Tum(path) | Self::Names(path)) = self;
        path
    }
}

/// `groundtruth.txt` in the folder for the layouts that look for it there; otherwise a TUM file at `out`.
///
/// # Errors
/// When the layout keeps its ground truth elsewhere and no `out` is given, or a file is there and not to be replaced.
pub fn target(
    folder: &Path,
    recording: &Recording,
    out: Option<&Path>,
    force: bool,
) -> Result<Target, JoinError> {
    let own = folder.join("groundtruth.txt");
    let target = match (out, recording.layout) {
        (Some(out), _) => Target::Tum(out.to_path_buf()),
        (None, Layout::Tum) => Target::Tum(own),
        (None, Layout::Images) => Target::Names(own),
        (None, layout) => {
            return Err(JoinError::Option {
                option: "--out",
                problem: format!(
                    "the {layout} layout has ground truth of its own: name a file, and open the recording with \
                     --poses FILE"
                ),
            });
        }
    };
    if target.path().exists() && !force {
        return Err(JoinError::Exists { path: target.path().to_path_buf() });
    }
    Ok(target)
}

/// Writes the poses, the whole file or nothing.
///
/// # Errors
/// When times repeat, a name cannot stand in a list, or the file cannot be written.
pub fn write(
    target: &Target,
    origin: &str,
    frames: &[RecordedFrame],
    poses: &[Option<Pose>],
) -> Result<(), JoinError> {
    let text = match target {
        Target::Tum(_) => {
            format!(
                "# time_s tx ty tz qx qy qz qw: world_from_camera, from {origin}\n{}",
                timed(frames, poses)?
            )
        }
        Target::Names(_) => {
            format!(
                "# image qw qx qy qz tx ty tz: camera_from_world, from {origin}\n{}",
                named(frames, poses)?
            )
        }
    };
    let path = target.path();
    let partial = path.with_extension("partial");
    let fail = |source| JoinError::Write { path: path.to_path_buf(), source };
    std::fs::write(&partial, text).map_err(fail)?;
    std::fs::rename(&partial, path).map_err(fail)
}

fn timed(frames: &[RecordedFrame], poses: &[Option<Pose>]) -> Result<String, JoinError> {
    let mut trajectory = Trajectory::default();
    let mut last = 0;
    for (frame, pose) in frames.iter().zip(poses) {
        let Some(world_from_camera) = *pose else { continue };
        trajectory
            .push(StampedPose { time_ns: time_ns(frame), world_from_camera })
            .map_err(|_| JoinError::SameTime { first: last, second: frame.sequence })?;
        last = frame.sequence;
    }
    Ok(tum::format(&trajectory))
}

fn named(frames: &[RecordedFrame], poses: &[Option<Pose>]) -> Result<String, JoinError> {
    let mut text = String::new();
    for (frame, pose) in frames.iter().zip(poses) {
        let Some(world_from_camera) = *pose else { continue };
        let name = frame.path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        if name.contains(|c: char| c.is_whitespace() || c == ',') || name.starts_with('#') {
            return Err(JoinError::Option {
                option: "--out",
                problem: format!(
                    "the image name {name:?} cannot stand in a list: rename the images, or write a trajectory by \
                     time with --out FILE"
                ),
            });
        }
        let camera_from_world = world_from_camera.inverse();
        let [x, y, z, w] = quaternion::xyzw(&camera_from_world.rotation);
        let t = &camera_from_world.translation.vector;
        // Writing to a String cannot fail.
        let _ = writeln!(text, "{name} {w} {x} {y} {z} {} {} {}", t.x, t.y, t.z);
    }
    Ok(text)
}
