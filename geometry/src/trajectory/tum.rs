//! The TUM RGB-D text format: `t x y z qx qy qz qw`, seconds and metres, `#` comments.
//!
//! Times are read and written without loss at nanosecond resolution, positions and quaternions as the shortest
//! text that reads back to the same `f64`.

use std::{fmt::Write as _, fs, path::Path};

use nalgebra::{Isometry3, Translation3, Vector3};

use super::{
    StampedPose, Trajectory, TrajectoryError,
    decimal::{format_seconds, parse_seconds_ns},
    error::quoted,
};
use crate::quaternion;

const COLUMNS: &str = "8 numbers `t x y z qx qy qz qw`";

/// Reads a TUM file.
///
/// # Errors
/// [`TrajectoryError`] with file, line, what was found and what was expected: a wrong number of columns, text that
/// is no number, a quaternion that cannot be normalised, times that do not grow, no pose at all.
pub fn read(path: &Path) -> Result<Trajectory, TrajectoryError> {
    parse(&read_text(path)?, path)
}

/// Parses TUM text; `path` appears in errors only.
///
/// Columns are separated by blanks or tabs; empty lines, `#` comments, a byte order mark and CRLF are accepted.
///
/// # Errors
/// As [`read`].
pub fn parse(text: &str, path: &Path) -> Result<Trajectory, TrajectoryError> {
    let mut trajectory = Trajectory::default();
    for (number, line) in content_lines(text) {
        let fail = |found: String, expected: &str| TrajectoryError::Line {
            path: path.into(),
            line: number,
            found,
            expected: expected.into(),
        };
        let fields: Vec<&str> = line.split_ascii_whitespace().collect();
        if fields.len() != 8 {
            return Err(fail(format!("{} columns in {}", fields.len(), quoted(line)), COLUMNS));
        }
        let time_ns = parse_seconds_ns(fields[0]).ok_or_else(|| {
            fail(quoted(fields[0]), "a time in decimal seconds that fits 64 bits of nanoseconds")
        })?;
        let mut v = [0.0; 7];
        for (value, field) in v.iter_mut().zip(&fields[1..]) {
            *value = parse_finite(field).ok_or_else(|| fail(quoted(field), "a finite number"))?;
        }
        let rotation = quaternion::from_xyzw([v[3], v[4], v[5], v[6]])
            .map_err(|e| fail(e.to_string(), "a quaternion `qx qy qz qw` of norm 1"))?;
        let translation = Translation3::from(Vector3::new(v[0], v[1], v[2]));
        let pose = StampedPose { time_ns, world_from_camera: Isometry3::from_parts(translation, rotation) };
        trajectory.push(pose).map_err(|e| {
            fail(
                format!("time {} s", format_seconds(e.found_ns)),
                &format!("a time later than the line before ({} s)", format_seconds(e.previous_ns)),
            )
        })?;
    }
    if trajectory.is_empty() {
        return Err(TrajectoryError::Empty { path: path.into(), expected: COLUMNS });
    }
    Ok(trajectory)
}

/// Writes a TUM file.
///
/// # Errors
/// [`TrajectoryError::Io`] with the system's reason.
pub fn write(path: &Path, trajectory: &Trajectory) -> Result<(), TrajectoryError> {
    write_text(path, &format(trajectory))
}

/// The trajectory as TUM text.
pub fn format(trajectory: &Trajectory) -> String {
    let mut text = String::with_capacity(trajectory.len() * 160);
    for pose in trajectory.poses() {
        text.push_str(&format_line(pose));
        text.push('\n');
    }
    text
}

/// One line of a TUM file, without the line break; for streams that grow pose by pose.
pub fn format_line(pose: &StampedPose) -> String {
    let mut line = format_seconds(pose.time_ns);
    let t = &pose.world_from_camera.translation.vector;
    for v in t.iter().copied().chain(quaternion::xyzw(&pose.world_from_camera.rotation)) {
        // Writing to a String cannot fail.
        let _ = write!(line, " {v}");
    }
    line
}

pub(super) fn parse_finite(field: &str) -> Option<f64> {
    field.parse::<f64>().ok().filter(|v| v.is_finite())
}

/// Numbered lines that are neither empty nor comments.
pub(super) fn content_lines(text: &str) -> impl Iterator<Item = (usize, &str)> {
    text.trim_start_matches('\u{feff}')
        .lines()
        .enumerate()
        .map(|(i, line)| (i + 1, line.trim()))
        .filter(|(_, line)| !line.is_empty() && !line.starts_with('#'))
}

pub(super) fn read_text(path: &Path) -> Result<String, TrajectoryError> {
    let io = |source| TrajectoryError::Io { action: "read", path: path.into(), source };
    let bytes = fs::read(path).map_err(io)?;
    String::from_utf8(bytes).map_err(|e| {
        let before = &e.as_bytes()[..e.utf8_error().valid_up_to()];
        TrajectoryError::Line {
            path: path.into(),
            line: 1 + before.iter().filter(|b| **b == b'\n').count(),
            found: "bytes that are no UTF-8 text".into(),
            expected: "a text file".into(),
        }
    })
}

pub(super) fn write_text(path: &Path, text: &str) -> Result<(), TrajectoryError> {
    fs::write(path, text).map_err(|source| TrajectoryError::Io { action: "write", path: path.into(), source })
}
