//! Ground truth and estimate, paired pose by pose.

use std::path::Path;

use anyhow::{Context as _, ensure};
use grnet_geometry::{
    Pose,
    trajectory::{self, AssociationOptions, KittiPoses},
};

use super::TumArgs;

/// Everything that the scores need.
pub(super) struct Input {
    /// Name of the format, for the report.
    pub format: &'static str,
    /// Paired poses, as long as each other.
    pub truth: Vec<Pose>,
    pub estimate: Vec<Pose>,
    /// The same with frame numbers, for the segments.
    pub kitti_truth: KittiPoses,
    pub kitti_estimate: KittiPoses,
    /// Whether the frame rate is KITTI's, so that speeds mean something.
    pub speeds: bool,
    /// Poses of the ground truth that should have an estimate and do not.
    pub missing: usize,
    pub notes: Vec<String>,
}

/// Reads two KITTI files.
pub(super) fn kitti(ground_truth: &Path, estimate: &Path) -> anyhow::Result<Input> {
    let truth = trajectory::kitti::read(ground_truth)?;
    let estimate_poses = trajectory::kitti::read(estimate)?;
    let mut notes = Vec::new();
    if truth.len() > estimate_poses.len() {
        notes.push(format!(
            "{} of {} frames have no estimate: they are skipped, as kitti-odom-eval does (the devkit refuses)",
            truth.len() - estimate_poses.len(),
            truth.len()
        ));
    }
    numbered(truth, estimate_poses, notes)
        .with_context(|| format!("cannot score {} against {}", estimate.display(), ground_truth.display()))
}

fn numbered(truth: KittiPoses, estimate: KittiPoses, mut notes: Vec<String>) -> anyhow::Result<Input> {
    let common: Vec<_> = estimate.poses().iter().filter_map(|p| truth.frame(p.frame)).collect();
    let (first, last) = (truth.poses()[0].frame, truth.poses()[truth.len() - 1].frame);
    if let Some(foreign) = estimate.poses().iter().find(|p| truth.frame(p.frame).is_none()) {
        anyhow::bail!(
            "found frame {} in the estimate, expected only frames of the ground truth ({first} to {last})",
            foreign.frame
        );
    }
    let mut truth_poses: Vec<Pose> = common.iter().map(|p| p.world_from_camera).collect();
    let mut moved = estimate.clone();
    if estimate.is_indexed() {
        notes.push(format!(
            "the estimate has frame numbers: both trajectories start at the origin at frame {}, as in kitti-odom-eval",
            estimate.poses()[0].frame
        ));
        let origin = truth_poses[0].inverse();
        truth_poses.iter_mut().for_each(|p| *p = origin * *p);
        moved = estimate.anchored();
    }
    Ok(Input {
        format: "kitti",
        truth: truth_poses,
        estimate: moved.poses().iter().map(|p| p.world_from_camera).collect(),
        missing: truth.len() - estimate.len(),
        kitti_truth: truth,
        kitti_estimate: moved,
        speeds: true,
        notes,
    })
}

/// Reads two TUM files and pairs them by time.
pub(super) fn tum(args: &TumArgs) -> anyhow::Result<Input> {
    let truth = trajectory::tum::read(&args.ground_truth)?;
    let estimate = trajectory::tum::read(&args.estimate)?;
    let nanoseconds = |s: f64| (s * 1e9).round() as i64;
    let options = AssociationOptions {
        max_difference_ns: nanoseconds(args.max_difference),
        estimate_offset_ns: nanoseconds(args.offset),
        one_to_one: args.one_to_one,
    };
    let found = trajectory::associate(&truth, &estimate, &options).with_context(|| {
        format!("cannot pair {} with {}", args.estimate.display(), args.ground_truth.display())
    })?;
    let mut notes = Vec::new();
    let shorter = truth.len().min(estimate.len());
    if found.pairs.len() < shorter {
        notes.push(format!(
            "{} of {shorter} poses have no partner within {} s and are not compared",
            shorter - found.pairs.len(),
            args.max_difference
        ));
    }
    if found.reused > 0 {
        notes.push(format!(
            "{} poses of the longer file serve two of the shorter, as in evo; --one-to-one keeps the closest",
            found.reused
        ));
    }
    let select = |t: &trajectory::Trajectory, i: usize| t.poses()[i].world_from_camera;
    let pairs = found.pairs.iter();
    let (truth, estimate) = pairs.map(|&(i, j)| (select(&truth, i), select(&estimate, j))).unzip();
    Ok(Input::consecutive("tum", truth, estimate, 0, notes))
}

impl Input {
    /// Paired poses whose rate is unknown; segments take them as consecutive frames.
    pub(super) fn consecutive(
        format: &'static str,
        truth: Vec<Pose>,
        estimate: Vec<Pose>,
        missing: usize,
        notes: Vec<String>,
    ) -> Self {
        Self {
            format,
            kitti_truth: KittiPoses::from_poses(&truth),
            kitti_estimate: KittiPoses::from_poses(&estimate),
            truth,
            estimate,
            speeds: false,
            missing,
            notes,
        }
    }
}

/// Refuses an empty comparison.
pub(super) fn ensure_common(count: usize, estimate: &Path, ground_truth: &Path) -> anyhow::Result<()> {
    ensure!(
        count > 0,
        "found no frame in both {} and {}, expected at least one",
        estimate.display(),
        ground_truth.display()
    );
    Ok(())
}
