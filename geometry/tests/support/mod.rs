//! Comparison with figures of the public tools.
#![allow(dead_code, reason = "each test binary uses a part")]

use std::collections::BTreeMap;

use grnet_geometry::{
    Pose,
    align::{Alignment, Similarity, scale_about_origin},
    scores::{ScoreError, ate, kitti},
    statistics::Statistics,
    trajectory::{KittiPoses, Trajectory},
};
use serde_json::Value;

/// Largest relative difference seen for each tool and figure; compares as it records.
pub struct Ledger {
    relative: f64,
    worst: BTreeMap<String, (f64, String)>,
    compared: usize,
}

impl Ledger {
    /// Differences up to `relative` of the tool's figure are accepted.
    pub fn new(relative: f64) -> Self {
        Self { relative, worst: BTreeMap::new(), compared: 0 }
    }

    /// Compares one figure; below `floor` both are rounding noise.
    #[track_caller]
    pub fn compare(&mut self, tool: &str, what: &str, ours: f64, theirs: f64, floor: f64) {
        self.compared += 1;
        if ours.abs() <= floor && theirs.abs() <= floor {
            return;
        }
        let difference = (ours - theirs).abs() / theirs.abs();
        assert!(
            difference <= self.relative || (ours - theirs).abs() <= floor,
            "{tool} {what}: ours {ours:.12e}, theirs {theirs:.12e}, relative difference {difference:.2e}"
        );
        let entry = self.worst.entry(tool.into()).or_insert((0.0, String::new()));
        if difference > entry.0 && theirs.abs() > 100.0 * floor {
            *entry = (difference, what.into());
        }
    }

    /// Compares every statistic that the tool printed.
    #[track_caller]
    pub fn statistics(&mut self, tool: &str, what: &str, ours: &Statistics, theirs: &Value, floor: f64) {
        let ours = serde_json::to_value(ours).unwrap();
        for (name, value) in theirs.as_object().unwrap() {
            let floor = if name == "sse" { floor * floor * 1e4 } else { floor };
            self.compare(tool, &format!("{what} {name}"), number(&ours[name]), number(value), floor);
        }
    }

    /// Prints the largest differences and checks that enough was compared to mean something.
    #[track_caller]
    pub fn finish(self, at_least: usize) {
        for (tool, (difference, what)) in &self.worst {
            println!("largest relative difference to {tool}: {difference:.2e} ({what})");
        }
        println!("{} figures compared", self.compared);
        assert!(self.compared >= at_least, "only {} figures compared, expected {at_least}", self.compared);
    }
}

/// `kitti-odom-eval`'s figures `{t_rel_percent, r_rel_deg_per_100m, ate_rmse_m}` under each of its alignments.
#[track_caller]
pub fn compare_odom_eval(
    ledger: &mut Ledger,
    name: &str,
    truth: &KittiPoses,
    estimate: &KittiPoses,
    theirs: &Value,
) {
    let tool = "kitti-odom-eval";
    let start = truth.frame(estimate.poses()[0].frame).unwrap().world_from_camera.inverse();
    let anchored = estimate.anchored();
    let truth_poses: Vec<Pose> =
        anchored.poses().iter().map(|p| start * truth.frame(p.frame).unwrap().world_from_camera).collect();
    let estimate_poses: Vec<Pose> = anchored.poses().iter().map(|p| p.world_from_camera).collect();
    for (alignment, figures) in theirs.as_object().unwrap() {
        let solve = |alignment: Alignment| alignment.solve(&estimate_poses, &truth_poses).unwrap();
        let moved = match alignment.as_str() {
            "none" => Similarity::identity(),
            "scale" => {
                let points = |poses: &[Pose]| poses.iter().map(|p| p.translation.vector).collect::<Vec<_>>();
                let scale = scale_about_origin(&points(&estimate_poses), &points(&truth_poses)).unwrap();
                Similarity { scale, ..Similarity::identity() }
            }
            "scale_7dof" => solve(Alignment::Scale),
            "7dof" => solve(Alignment::Sim3),
            "6dof" => solve(Alignment::Se3),
            other => panic!("unknown alignment {other}"),
        };
        let what = |figure: &str| format!("{name} {alignment} {figure}");
        let score = kitti::score(truth, &anchored.transformed(&moved), kitti::Arithmetic::Double).unwrap();
        let overall = score.overall.unwrap();
        let segments = figures.get("segments").or(figures.get("n_segments")).unwrap();
        assert_eq!(overall.segments as u64, segments.as_u64().unwrap(), "{}", what("segments"));
        ledger.compare(tool, &what("t_rel"), overall.t_rel_percent, number(&figures["t_rel_percent"]), 0.0);
        let theirs = number(&figures["r_rel_deg_per_100m"]);
        ledger.compare(tool, &what("r_rel"), overall.r_rel_deg_per_100m, theirs, 0.0);
        let (distances, _) = ate::errors(&truth_poses, &estimate_poses, &moved);
        let rmse = Statistics::of(&distances).unwrap().rmse;
        ledger.compare(tool, &what("ate"), rmse, number(&figures["ate_rmse_m"]), 1e-9);
    }
}

/// The scores of `compute`, or the demand that the tool failed as well.
#[track_caller]
pub fn both_or_neither<T>(what: &str, ours: Result<T, ScoreError>, theirs: &Value) -> Option<T> {
    match (ours, theirs.get("error")) {
        (Ok(ours), None) => Some(ours),
        (Err(_), Some(_)) => None,
        (Ok(_), Some(error)) => panic!("{what}: the tool says {error}, we have a figure"),
        (Err(error), None) => panic!("{what}: the tool has a figure, we say {error}"),
    }
}

pub fn number(value: &Value) -> f64 {
    value.as_f64().unwrap_or_else(|| panic!("{value} is no number"))
}

/// The poses of a list of indices.
pub fn select(trajectory: &Trajectory, indices: impl Iterator<Item = usize>) -> Vec<Pose> {
    indices.map(|i| trajectory.poses()[i].world_from_camera).collect()
}
