//! Folders of `frame-XXXXXX.pose.txt`, and the other forms in which estimates of such frames come.

use std::{
    collections::{BTreeMap, BTreeSet},
    fs,
    path::Path,
};

use anyhow::{Context as _, bail};
use grnet_geometry::{
    Pose,
    nalgebra::{Isometry3, Matrix4, Translation3},
    quaternion, trajectory,
};

use super::{SevenScenesArgs, TumTime, input, input::Input};

/// Poses by frame number; `None` where a file holds NaN or infinite numbers.
type Frames = BTreeMap<u64, Option<Pose>>;

/// How far the seconds of a TUM file may be from a frame, in frames.
const SLACK_FRAMES: f64 = 0.25;

/// Reads ground truth and estimate and pairs them by frame number.
pub(super) fn read(args: &SevenScenesArgs) -> anyhow::Result<Input> {
    let mut truth = folder(&args.ground_truth)?;
    let mut notes = Vec::new();
    if let Some(list) = &args.frames {
        let listed = frame_list(list)?;
        if let Some(unknown) = listed.iter().find(|f| !truth.contains_key(f)) {
            bail!(
                "{}: found frame {unknown}, expected frames of {}",
                list.display(),
                args.ground_truth.display()
            );
        }
        truth.retain(|frame, _| listed.contains(frame));
    }
    let estimate = if args.estimate.is_dir() { folder(&args.estimate)? } else { file(args, &mut notes)? };
    if args.frames.is_none()
        && let Some(foreign) = estimate.keys().find(|f| !truth.contains_key(f))
    {
        bail!(
            "{}: found frame {foreign}, expected only frames of {} ({} to {})",
            args.estimate.display(),
            args.ground_truth.display(),
            truth.keys().next().copied().unwrap_or_default(),
            truth.keys().next_back().copied().unwrap_or_default(),
        );
    }

    let without_truth = truth.values().filter(|p| p.is_none()).count();
    if without_truth > 0 {
        notes.push(format!("{without_truth} frames have no valid ground truth and are not compared"));
    }
    let (mut truths, mut estimates, mut missing) = (Vec::new(), Vec::new(), 0);
    for (frame, world_from_camera) in truth.iter().filter_map(|(f, p)| Some((f, (*p)?))) {
        match estimate.get(frame).copied().flatten() {
            Some(found) => {
                truths.push(world_from_camera);
                estimates.push(found);
            }
            None => missing += 1,
        }
    }
    input::ensure_common(truths.len(), &args.estimate, &args.ground_truth)?;
    if missing > 0 {
        notes.push(format!(
            "{missing} of {} frames have no estimate: medians and recall are over the {} that have one",
            missing + truths.len(),
            truths.len()
        ));
    }
    Ok(Input::consecutive("7scenes", truths, estimates, missing, notes))
}

fn folder(path: &Path) -> anyhow::Result<Frames> {
    let entries = fs::read_dir(path).with_context(|| format!("cannot read folder {}", path.display()))?;
    let mut frames = Frames::new();
    for entry in entries {
        let file = entry.with_context(|| format!("cannot read folder {}", path.display()))?.path();
        let name = file.file_name().unwrap_or_default().to_string_lossy();
        let number = name.strip_prefix("frame-").and_then(|n| n.strip_suffix(".pose.txt"));
        if let Some(number) = number.and_then(|n| n.parse().ok()) {
            frames.insert(number, pose(&file)?);
        }
    }
    if frames.is_empty() {
        bail!("{}: found no frame-XXXXXX.pose.txt, expected the folder of one sequence", path.display());
    }
    Ok(frames)
}

/// A 4x4 matrix row by row.
fn pose(path: &Path) -> anyhow::Result<Option<Pose>> {
    let text = fs::read_to_string(path).with_context(|| format!("cannot read {}", path.display()))?;
    let mut values = Vec::with_capacity(16);
    for (i, line) in text.lines().enumerate() {
        for field in line.split_whitespace() {
            let number = field.parse::<f64>().ok().with_context(|| {
                format!("{}:{}: found {field:?}, expected a number", path.display(), i + 1)
            })?;
            values.push(number);
        }
    }
    if values.len() != 16 {
        bail!("{}: found {} numbers, expected the 16 of a 4x4 matrix", path.display(), values.len());
    }
    if values.iter().any(|v| !v.is_finite()) {
        return Ok(None);
    }
    let m = Matrix4::from_row_slice(&values);
    let last_row = m.row(3);
    if (last_row[0], last_row[1], last_row[2], last_row[3]) != (0.0, 0.0, 0.0, 1.0) {
        bail!("{}: found the last row {:?}, expected 0 0 0 1", path.display(), &values[12..]);
    }
    let rotation = m.fixed_view::<3, 3>(0, 0).into_owned();
    let rotation = quaternion::from_matrix(&rotation, trajectory::kitti::ROTATION_TOLERANCE)
        .with_context(|| path.display().to_string())?;
    let translation = Translation3::new(m[(0, 3)], m[(1, 3)], m[(2, 3)]);
    Ok(Some(Isometry3::from_parts(translation, rotation)))
}

/// Rows of 12 or 13 (KITTI) or 8 columns (TUM).
fn file(args: &SevenScenesArgs, notes: &mut Vec<String>) -> anyhow::Result<Frames> {
    let path = &args.estimate;
    let text = fs::read_to_string(path).with_context(|| format!("cannot read {}", path.display()))?;
    let first = text.lines().map(str::trim).find(|l| !l.is_empty() && !l.starts_with('#')).unwrap_or("");
    match first.split_whitespace().count() {
        12 | 13 => {
            let poses = trajectory::kitti::parse(&text, path)?;
            if !poses.is_indexed() {
                notes.push("the estimate has no frame numbers: its lines are frames 0, 1, 2, ...".into());
            }
            Ok(poses.poses().iter().map(|p| (p.frame, Some(p.world_from_camera))).collect())
        }
        8 => tum(args, &trajectory::tum::parse(&text, path)?, notes),
        columns => bail!(
            "{}: found {columns} columns in the first pose, expected 12 or 13 (KITTI) or 8 (TUM)",
            path.display()
        ),
    }
}

fn tum(
    args: &SevenScenesArgs,
    trajectory: &trajectory::Trajectory,
    notes: &mut Vec<String>,
) -> anyhow::Result<Frames> {
    const SECOND_NS: i64 = 1_000_000_000;
    let numbers = match args.tum_time {
        TumTime::Frames => true,
        TumTime::Seconds => false,
        TumTime::Auto => trajectory.poses().iter().all(|p| p.time_ns % SECOND_NS == 0),
    };
    if args.tum_time == TumTime::Auto {
        notes.push(if numbers {
            "the times of the estimate are whole: taken as frame numbers (--tum-time)".into()
        } else {
            format!("the times of the estimate are taken as seconds at {} Hz (--tum-time, --rate)", args.rate)
        });
    }
    let mut frames = Frames::new();
    for p in trajectory.poses() {
        let time = p.time_ns as f64 * 1e-9;
        let at = if numbers { time } else { time * args.rate };
        let frame = at.round();
        let slack = if numbers { 0.0 } else { SLACK_FRAMES };
        if frame < 0.0 || (at - frame).abs() > slack {
            bail!(
                "{}: found time {time} s, which is frame {at:.3}; expected a frame number from 0 \
                 (see --tum-time and --rate)",
                args.estimate.display()
            );
        }
        if frames.insert(frame as u64, Some(p.world_from_camera)).is_some() {
            bail!(
                "{}: found two poses for frame {frame} at {time} s, expected one (see --rate)",
                args.estimate.display()
            );
        }
    }
    Ok(frames)
}

/// Frame numbers from lines such as `123` or `seq-01/frame-000123.color.png`.
fn frame_list(path: &Path) -> anyhow::Result<BTreeSet<u64>> {
    let text = fs::read_to_string(path).with_context(|| format!("cannot read {}", path.display()))?;
    let mut frames = BTreeSet::new();
    for (i, line) in text.lines().enumerate() {
        let line = line.trim();
        if line.is_empty() || line.starts_with('#') {
            continue;
        }
        let name = line.rsplit('/').next().unwrap_or(line);
        let digits = name.strip_prefix("frame-").unwrap_or(name);
        let digits = digits.split('.').next().unwrap_or(digits);
        let frame = digits.parse().ok().with_context(|| {
            format!("{}:{}: found {line:?}, expected a frame number or frame-XXXXXX", path.display(), i + 1)
        })?;
        frames.insert(frame);
    }
    if frames.is_empty() {
        bail!("{}: found no frame, expected one a line", path.display());
    }
    Ok(frames)
}
