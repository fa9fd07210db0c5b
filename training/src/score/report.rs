//! The scores in one serialisable object.

use std::collections::BTreeMap;

use grnet_geometry::{
    Pose,
    align::{Alignment, Similarity, scale_about_origin},
    scores::{
        ScoreError,
        ate::{self, Ate},
        kitti::{self, Arithmetic, LengthRow, SpeedRow},
        relocalization::{self, Recall},
        rpe::{self, Delta, Rpe, RpeOptions},
    },
};
use serde::Serialize;

use super::{CommonArgs, input::Input};

/// What `--json` prints; a figure that is not defined is null and has its reason in `notes`.
#[derive(Debug, Serialize)]
pub(super) struct Report {
    pub format: &'static str,
    /// Applied to the estimate before everything but `ate`.
    pub alignment: Alignment,
    pub alignment_scale: Option<f64>,
    /// Number of compared poses.
    pub poses: usize,
    /// Poses of the ground truth that have no estimate.
    pub missing: usize,
    /// Length of the ground truth's path through the compared poses.
    pub path_length_m: f64,
    pub t_rel_percent: Option<f64>,
    pub r_rel_deg_per_100m: Option<f64>,
    pub segments: usize,
    pub per_length: Vec<LengthRow>,
    pub per_speed: Vec<SpeedRow>,
    /// The same in the devkit's single precision.
    pub devkit: Option<Devkit>,
    pub ate_rmse_m: AteRmse,
    pub rpe_trans_rmse_m: Option<f64>,
    pub rpe_rot_rmse_deg: Option<f64>,
    pub median_translation_m: Option<f64>,
    pub median_rotation_deg: Option<f64>,
    pub recall_5cm_5deg: Option<f64>,
    pub recalls: Vec<Recall>,
    /// Full statistics under each alignment.
    pub ate: BTreeMap<&'static str, Ate>,
    /// Full statistics.
    pub rpe: Option<Rpe>,
    pub notes: Vec<String>,
}

#[derive(Debug, Serialize)]
pub(super) struct Devkit {
    pub t_rel_percent: f64,
    pub r_rel_deg_per_100m: f64,
}

#[derive(Debug, Serialize)]
pub(super) struct AteRmse {
    pub none: Option<f64>,
    pub se3: Option<f64>,
    pub sim3: Option<f64>,
}

const ALIGNMENTS: [(&str, Alignment); 4] = [
    ("none", Alignment::None),
    ("se3", Alignment::Se3),
    ("sim3", Alignment::Sim3),
    ("scale", Alignment::Scale),
];

impl Report {
    /// Computes every score that is defined.
    ///
    /// # Errors
    /// Only when the ground truth cannot be scored at all (frames missing within it).
    pub(super) fn of(input: &Input, args: &CommonArgs) -> Result<Self, ScoreError> {
        let mut notes = input.notes.clone();
        let (truth, raw) = (&input.truth, &input.estimate);

        let mut absolute = BTreeMap::new();
        let mut reasons: Vec<(ScoreError, Vec<&str>)> = Vec::new();
        for (name, alignment) in ALIGNMENTS {
            match ate::score(truth, raw, alignment) {
                Ok(ate) => {
                    absolute.insert(name, ate);
                }
                Err(e) => match reasons.iter_mut().find(|(seen, _)| *seen == e) {
                    Some((_, names)) => names.push(name),
                    None => reasons.push((e, vec![name])),
                },
            }
        }
        for (reason, names) in reasons {
            notes.push(format!("ATE {}: {reason}", names.join(", ")));
        }

        let alignment = Alignment::from(args.align);
        let similarity = match alignment.solve(raw, truth) {
            Ok(similarity) => Some(similarity),
            Err(e) => {
                notes.push(format!("no score with this alignment: {e}"));
                None
            }
        };
        let rmse = |name: &str| absolute.get(name).map(|a: &Ate| a.translation_m.rmse);
        let mut report = Self {
            format: input.format,
            alignment,
            alignment_scale: similarity.map(|s| s.scale),
            poses: truth.len(),
            missing: input.missing,
            path_length_m: path_length_m(truth),
            t_rel_percent: None,
            r_rel_deg_per_100m: None,
            segments: 0,
            per_length: Vec::new(),
            per_speed: Vec::new(),
            devkit: None,
            ate_rmse_m: AteRmse { none: rmse("none"), se3: rmse("se3"), sim3: rmse("sim3") },
            rpe_trans_rmse_m: None,
            rpe_rot_rmse_deg: None,
            median_translation_m: None,
            median_rotation_deg: None,
            recall_5cm_5deg: None,
            recalls: Vec::new(),
            ate: absolute,
            rpe: None,
            notes,
        };
        if let Some(similarity) = similarity {
            let moved: Vec<Pose> = raw.iter().map(|p| similarity.apply(p)).collect();
            report.relative(truth, &moved, args);
            report.relocalization(truth, &moved, args)?;
            report.segments(input, similarity)?;
        }
        Ok(report)
    }

    fn relative(&mut self, truth: &[Pose], moved: &[Pose], args: &CommonArgs) {
        let options = RpeOptions {
            delta: Delta::Frames(args.rpe_delta as usize),
            all_pairs: args.rpe_all_pairs,
            ..RpeOptions::default()
        };
        match rpe::score(truth, moved, &options) {
            Ok(rpe) => {
                self.rpe_trans_rmse_m = Some(rpe.translation_m.rmse);
                self.rpe_rot_rmse_deg = Some(rpe.rotation_deg.rmse);
                self.rpe = Some(rpe);
                if self.missing > 0 {
                    self.notes.push("RPE pairs poses across missing frames, as evo does".into());
                }
            }
            Err(e) => self.notes.push(format!("RPE: {e}")),
        }
    }

    fn relocalization(
        &mut self,
        truth: &[Pose],
        moved: &[Pose],
        args: &CommonArgs,
    ) -> Result<(), ScoreError> {
        let mut thresholds = vec![relocalization::THRESHOLDS[0]];
        thresholds.extend(&args.recall);
        let score = relocalization::score(truth, moved, self.missing, &thresholds)?;
        self.median_translation_m = Some(score.median_translation_m);
        self.median_rotation_deg = Some(score.median_rotation_deg);
        self.recall_5cm_5deg = score.recalls.first().map(|r| r.recall);
        self.recalls = score.recalls;
        Ok(())
    }

    fn segments(&mut self, input: &Input, similarity: Similarity) -> Result<(), ScoreError> {
        let mut similarity = similarity;
        if self.alignment == Alignment::Scale && input.format == "kitti" {
            match kitti_scale(input) {
                Ok(scale) => similarity.scale = scale,
                Err(e) => {
                    self.notes.push(format!("t_rel, r_rel: {e}"));
                    return Ok(());
                }
            }
            self.notes.push(format!(
                "t_rel and r_rel use kitti-odom-eval's scale {:.6}, the other scores evo's {:.6}",
                similarity.scale,
                self.alignment_scale.unwrap_or(f64::NAN)
            ));
        }
        let moved = input.kitti_estimate.transformed(&similarity);
        let score = kitti::score(&input.kitti_truth, &moved, Arithmetic::Double)?;
        let Some(overall) = score.overall else {
            self.notes.push(format!(
                "t_rel, r_rel: no segment of 100 m or more begins and ends at compared poses \
                 (the path is {:.3} m long)",
                self.path_length_m
            ));
            return Ok(());
        };
        self.t_rel_percent = Some(overall.t_rel_percent);
        self.r_rel_deg_per_100m = Some(overall.r_rel_deg_per_100m);
        self.segments = overall.segments;
        self.per_length = score.per_length;
        if input.speeds {
            self.per_speed = score.per_speed;
            let single = kitti::score(&input.kitti_truth, &moved, Arithmetic::Devkit)?.overall;
            self.devkit = single.map(|mean| Devkit {
                t_rel_percent: mean.t_rel_percent,
                r_rel_deg_per_100m: mean.r_rel_deg_per_100m,
            });
        } else {
            self.notes.push("t_rel, r_rel: segments start at every tenth compared pose; no speeds".into());
        }
        Ok(())
    }
}

/// The scale of `kitti-odom-eval`'s alignment `scale`: about the first pose of both trajectories.
fn kitti_scale(input: &Input) -> Result<f64, ScoreError> {
    let positions = |poses: &[Pose]| {
        let origin = poses[0].inverse();
        poses.iter().map(|p| (origin * p).translation.vector).collect::<Vec<_>>()
    };
    Ok(scale_about_origin(&positions(&input.estimate), &positions(&input.truth))?)
}

fn path_length_m(poses: &[Pose]) -> f64 {
    poses.windows(2).map(|w| (w[1].translation.vector - w[0].translation.vector).norm()).sum()
}
