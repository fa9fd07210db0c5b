//! Figures of one system, with the score functions of [`grnet_geometry::scores`].
//!
//! Errors over frames are pooled over blocks and sequences; alignments are made sequence by sequence; relative errors
//! never reach across the end of a block.

use std::ops::Range;

use grnet_geometry::align::Alignment;
use grnet_geometry::scores::{ate, calibration, kitti, relocalization, rpe};
use grnet_geometry::statistics::{Statistics, median};
use grnet_geometry::trajectory::KittiPoses;
use grnet_geometry::{Covariance6, Pose, covariance, se3};

use super::{
    Ate, Data, Drift, KittiScores, Motion, Scores, SequenceScores, System, SystemInfo, SystemScores,
};

/// Error of one frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FrameError {
    /// Distance of the positions, metres.
    pub translation_m: f64,
    /// Angle between the orientations, degrees.
    pub rotation_deg: f64,
}

impl FrameError {
    fn between(truth: &Pose, estimate: &Pose) -> Self {
        Self {
            translation_m: (truth.translation.vector - estimate.translation.vector).norm(),
            rotation_deg: se3::angle_rad(&truth.rotation.rotation_to(&estimate.rotation)).to_degrees(),
        }
    }
}

/// Error of every test frame; `None` where the truth or the prediction is missing.
pub fn frame_errors(data: &Data, system: &System) -> Vec<Option<FrameError>> {
    let test = data.task.test.iter().enumerate();
    test.map(|(frame, view)| {
        Some(FrameError::between(view.world_from_camera.as_ref()?, system.pose(frame).as_ref()?))
    })
    .collect()
}

/// All figures of one system.
pub fn score(data: &Data, system: &System, gap: usize) -> SystemScores {
    let tested = data.tested_sequences();
    let by_sequence = if tested.len() < 2 { Vec::new() } else { tested };
    let by_sequence = by_sequence.into_iter().map(|sequence| SequenceScores {
        sequence: data.recordings[sequence].name.clone(),
        scores: over(data, system, gap, &data.test_range(sequence)),
    });
    SystemScores {
        system: SystemInfo {
            name: system.name.clone(),
            slug: system.slug.clone(),
            kind: system.kind,
            knowledge: system.knowledge,
            about: system.about.clone(),
            model: system.model,
        },
        overall: over(data, system, gap, &(0..data.task.test.len())),
        by_sequence: by_sequence.collect(),
    }
}

fn over(data: &Data, system: &System, gap: usize, range: &Range<usize>) -> Scores {
    let paired = Paired::new(data, system, range.clone());
    let frames = range.clone().filter(|i| data.task.test[*i].world_from_camera.is_some()).count();
    let missing = frames - paired.truth.len();
    let place =
        relocalization::score(&paired.truth, &paired.estimate, missing, &relocalization::THRESHOLDS).ok();
    // A system without poses has nothing to recall; one that lost every frame recalls none.
    let recall = |index: usize| match &place {
        Some(place) => Some(place.recalls[index].recall_of_all),
        None => system.poses.as_ref().map(|_| 0.0),
    };
    let (rpe_translation_m, rpe_rotation_deg) = relative(data, system, range).unzip();
    Scores {
        frames,
        valid: paired.truth.len(),
        median_translation_m: place.as_ref().map(|p| p.median_translation_m),
        median_rotation_deg: place.as_ref().map(|p| p.median_rotation_deg),
        recall_5cm_5deg: recall(0),
        recall_25cm_10deg: recall(1),
        ate: Ate {
            none_m: absolute(data, system, range, Alignment::None),
            se3_m: absolute(data, system, range, Alignment::Se3),
            sim3_m: absolute(data, system, range, Alignment::Sim3),
        },
        rpe_translation_m,
        rpe_rotation_deg,
        kitti: drive(data, system, range),
        drift: drift(data, system, range),
        motion: motion(data, system, gap, range),
        calibration: calibrate(system, &paired),
    }
}

/// True and predicted poses of the frames that have both.
struct Paired {
    frames: Vec<usize>,
    truth: Vec<Pose>,
    estimate: Vec<Pose>,
}

impl Paired {
    fn new(data: &Data, system: &System, range: Range<usize>) -> Self {
        let mut paired = Self { frames: Vec::new(), truth: Vec::new(), estimate: Vec::new() };
        for frame in range {
            if let (Some(truth), Some(estimate)) =
                (data.task.test[frame].world_from_camera, system.pose(frame))
            {
                paired.frames.push(frame);
                paired.truth.push(truth);
                paired.estimate.push(estimate);
            }
        }
        paired
    }
}

/// Root mean square over the frames of all sequences, each aligned on its own; `None` when one cannot be aligned.
fn absolute(data: &Data, system: &System, range: &Range<usize>, alignment: Alignment) -> Option<f64> {
    let mut pooled = Pool::default();
    for sequence in data.tested_sequences() {
        let within = intersection(&data.test_range(sequence), range);
        let paired = Paired::new(data, system, within);
        if !paired.truth.is_empty() {
            pooled.add(&ate::score(&paired.truth, &paired.estimate, alignment).ok()?.translation_m);
        }
    }
    pooled.rmse()
}

/// RPE of neighbouring frames: root mean square of translation (m) and rotation (deg).
fn relative(data: &Data, system: &System, range: &Range<usize>) -> Option<(f64, f64)> {
    let (mut translation, mut rotation) = (Pool::default(), Pool::default());
    for block in blocks(data, range) {
        let paired = Paired::new(data, system, block);
        let neighbours = paired.frames.chunk_by(|a, b| a + 1 == *b);
        let mut start = 0;
        for run in neighbours {
            let run = start..start + run.len();
            start = run.end;
            let options = rpe::RpeOptions::default();
            if let Ok(score) = rpe::score(&paired.truth[run.clone()], &paired.estimate[run], &options) {
                translation.add(&score.translation_m);
                rotation.add(&score.rotation_deg);
            }
        }
    }
    translation.rmse().zip(rotation.rmse())
}

/// KITTI's segments of these lengths within blocks whose every frame has a true pose; `None` without any.
fn segments(
    lengths_m: &[u32],
    data: &Data,
    system: &System,
    range: &Range<usize>,
) -> Option<Vec<kitti::Segment>> {
    let mut all = Vec::new();
    for block in blocks(data, range) {
        let numbered = |pose: &dyn Fn(usize) -> Option<Pose>| {
            let poses = block.clone().enumerate().filter_map(|(n, frame)| Some((n as u64, pose(frame)?)));
            KittiPoses::from_frames(poses).ok()
        };
        let truth = numbered(&|frame| data.task.test[frame].world_from_camera)?;
        let estimate = numbered(&|frame| system.pose(frame))?;
        if truth.len() == block.len() {
            all.extend(kitti::segments_of(lengths_m, &truth, &estimate, kitti::Arithmetic::Double).ok()?);
        }
    }
    (!all.is_empty()).then_some(all)
}

fn mean(segments: &[&kitti::Segment]) -> kitti::Mean {
    let n = segments.len() as f64;
    let average = |value: fn(&kitti::Segment) -> f64| segments.iter().map(|s| value(s)).sum::<f64>() / n;
    kitti::Mean {
        segments: segments.len(),
        t_rel_percent: 100.0 * average(|s| s.translation_per_m),
        r_rel_deg_per_100m: 100.0 * average(|s| s.rotation_rad_per_m).to_degrees(),
    }
}

fn drift(data: &Data, system: &System, range: &Range<usize>) -> Option<Drift> {
    let all = segments(&kitti::ROOM_LENGTHS_M, data, system, range)?;
    let mean = mean(&all.iter().collect::<Vec<_>>());
    Some(Drift {
        segments: mean.segments,
        t_rel_percent: mean.t_rel_percent,
        r_rel_deg_per_m: mean.r_rel_deg_per_100m / 100.0,
    })
}

fn drive(data: &Data, system: &System, range: &Range<usize>) -> Option<KittiScores> {
    let all = segments(&kitti::LENGTHS_M, data, system, range)?;
    let overall = mean(&all.iter().collect::<Vec<_>>());
    let per_length = kitti::LENGTHS_M.iter().filter_map(|&length_m| {
        let of_length: Vec<_> = all.iter().filter(|segment| segment.length_m == length_m).collect();
        (!of_length.is_empty()).then(|| kitti::LengthRow { length_m, mean: mean(&of_length) })
    });
    Some(KittiScores {
        segments: overall.segments,
        t_rel_percent: overall.t_rel_percent,
        r_rel_deg_per_100m: overall.r_rel_deg_per_100m,
        per_length: per_length.collect(),
    })
}

fn motion(data: &Data, system: &System, gap: usize, range: &Range<usize>) -> Option<Motion> {
    let truth = |frame: usize| data.task.test[frame].world_from_camera;
    let pairs = data.task.pairs(gap).into_iter().filter(|(earlier, _)| range.contains(earlier));
    let (mut all_pairs, mut translation, mut rotation) = (0, Vec::new(), Vec::new());
    for (earlier, current) in pairs {
        let (Some(a), Some(b)) = (truth(earlier), truth(current)) else { continue };
        all_pairs += 1;
        if let Some(found) = system.motion((earlier, current)) {
            let error = se3::relative(&se3::relative(&a, &b), &found);
            translation.push(error.translation.vector.norm());
            rotation.push(se3::angle_rad(&error.rotation).to_degrees());
        }
    }
    Some(Motion {
        pairs: translation.len(),
        all_pairs,
        median_translation_m: median(&translation)?,
        median_rotation_deg: median(&rotation)?,
    })
}

fn calibrate(system: &System, paired: &Paired) -> Option<calibration::Calibration> {
    let samples = normalised_errors(system, paired);
    calibration::score(samples.iter().map(|(error, covariance)| (error, covariance)))
}

fn normalised_errors(system: &System, paired: &Paired) -> Vec<(se3::Tangent, Covariance6)> {
    let of = |n: usize| {
        let covariance = *system.covariances.get(paired.frames[n])?;
        // Zero covariance is a pose that was given, not estimated: the anchor of the odometry.
        let given = covariance.matrix().iter().all(|v| *v == 0.0);
        (!given).then(|| (covariance::error(&paired.estimate[n], &paired.truth[n]), covariance))
    };
    (0..paired.frames.len()).filter_map(of).collect()
}

/// NEES of every judged frame with a usable covariance, in ascending order.
pub fn sorted_nees(data: &Data, system: &System) -> Vec<f64> {
    let paired = Paired::new(data, system, 0..data.task.test.len());
    let samples = normalised_errors(system, &paired);
    let mut nees: Vec<f64> =
        samples.iter().filter_map(|(error, covariance)| covariance.nees(error)).collect();
    nees.sort_unstable_by(f64::total_cmp);
    nees
}

/// Length of the true path within blocks, metres.
pub fn path_m(data: &Data) -> f64 {
    let truth = |frame: usize| data.task.test[frame].world_from_camera;
    let step = |(a, b): (usize, usize)| {
        truth(a).zip(truth(b)).map(|(a, b)| (a.translation.vector - b.translation.vector).norm())
    };
    data.task.pairs(1).into_iter().filter_map(step).sum()
}

fn blocks(data: &Data, range: &Range<usize>) -> Vec<Range<usize>> {
    data.task.blocks().into_iter().filter(|block| range.contains(&block.start)).collect()
}

fn intersection(a: &Range<usize>, b: &Range<usize>) -> Range<usize> {
    a.start.max(b.start)..a.end.min(b.end)
}

/// Mean square over several lists.
#[derive(Default)]
struct Pool {
    sse: f64,
    count: usize,
}

impl Pool {
    fn add(&mut self, statistics: &Statistics) {
        self.sse += statistics.sse;
        self.count += statistics.count;
    }

    fn rmse(&self) -> Option<f64> {
        (self.count > 0).then(|| (self.sse / self.count as f64).sqrt())
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use crate::baselines::{Task, View};
    use crate::evaluate::{Kind, System};
    use grnet_capture::dataset::{Layout, RecordedFrame, Recording};
    use nalgebra::Vector3;

    /// A straight drive of 1 m a frame along z; `index` says which frames of it are tested.
    pub fn drive(sequence_frames: &[u64]) -> Data {
        let view = |index: &u64| View {
            image: format!("{index}.png").into(),
            sequence: 0,
            index: *index,
            time_ns: index * 100_000_000,
            world_from_camera: Some(Pose::translation(0.0, 0.0, *index as f64)),
        };
        let task = Task::new(Vec::new(), sequence_frames.iter().map(view).collect());
        let frames = task.test.iter().map(|view| RecordedFrame {
            path: view.image.clone(),
            time_ns: view.time_ns,
            sequence: view.index,
            world_from_camera: view.world_from_camera,
            camera: None,
        });
        let recording = Recording {
            name: "drive".into(),
            id: "00".into(),
            layout: Layout::Kitti,
            frames: frames.collect(),
            camera: None,
            image_size_px: None,
            nominal_rate_hz: Some(10.0),
            invalid_poses: 0,
            notes: Vec::new(),
        };
        Data { path: "drive".into(), recordings: vec![recording], task, notes: Vec::new() }
    }

    pub fn system(data: &Data, predict: impl Fn(usize, Pose) -> Option<Pose>) -> System {
        let test = data.task.test.iter().enumerate();
        let poses = test.map(|(n, view)| predict(n, view.world_from_camera.unwrap())).collect();
        System { poses: Some(poses), ..System::new("test", Kind::Fused, "") }
    }

    #[track_caller]
    fn close(found: Option<f64>, expected: f64) {
        assert!((found.unwrap() - expected).abs() < 1e-9, "found {found:?}, expected {expected}");
    }

    #[test]
    fn a_scaled_drive_has_the_drift_of_its_scale() {
        let data = drive(&(0..301).collect::<Vec<_>>());
        let long = system(&data, |_, truth| Some(Pose::translation(0.0, 0.0, 1.1 * truth.translation.z)));
        let scores = score(&data, &long, 10).overall;
        // Segments end one frame past their length: 20 of 101 m for 100 m, 10 of 201 m for 200 m.
        close(scores.kitti.as_ref().map(|k| k.t_rel_percent), (20.0 * 10.1 + 10.0 * 10.05) / 30.0);
        close(scores.kitti.as_ref().map(|k| k.r_rel_deg_per_100m), 0.0);
        // Here too: 2 m for 1 m, 3 m for 2 m, from each of 30 starts.
        let drift = scores.drift.unwrap();
        assert_eq!(drift.segments, 30 * 8);
        let expected =
            (1..=8).map(|length| 10.0 * f64::from(length + 1) / f64::from(length)).sum::<f64>() / 8.0;
        close(Some(drift.t_rel_percent), expected);
        close(Some(drift.r_rel_deg_per_m), 0.0);
        close(scores.rpe_translation_m, 0.1);
        close(scores.motion.map(|m| m.median_translation_m), 1.0);
        close(scores.median_translation_m, 15.0);
        // A straight line determines no alignment: no figure, not a wrong one.
        assert_eq!((scores.ate.se3_m, scores.ate.sim3_m), (None, None));
        assert!((path_m(&data) - 300.0).abs() < 1e-9);
    }

    #[test]
    fn missing_poses_lower_the_recall_and_not_the_median() {
        let data = drive(&[0, 1, 2, 3]);
        let half = system(&data, |n, truth| (n % 2 == 0).then(|| Pose::translation(0.01, 0.0, 0.0) * truth));
        let scores = score(&data, &half, 2).overall;
        assert_eq!((scores.frames, scores.valid), (4, 2));
        close(scores.median_translation_m, 0.01);
        close(scores.recall_5cm_5deg, 0.5);
        // No two neighbours are valid, but frames 0 and 2 are a pair of the gap.
        assert_eq!(scores.rpe_translation_m, None);
        let motion = scores.motion.unwrap();
        assert_eq!((motion.pairs, motion.all_pairs), (1, 2));
        let lost = score(&data, &system(&data, |_, _| None), 2).overall;
        assert_eq!((lost.valid, lost.median_translation_m, lost.ate.none_m), (0, None, None));
        close(lost.recall_25cm_10deg, 0.0);
    }

    #[test]
    fn relative_errors_do_not_reach_over_the_end_of_a_block() {
        let data = drive(&[0, 1, 10, 11]);
        // Each block is off by another metre: absolute errors see it, relative ones must not.
        let jump = system(&data, |n, truth| Some(Pose::translation((n / 2) as f64, 0.0, 0.0) * truth));
        let scores = score(&data, &jump, 1).overall;
        close(scores.rpe_translation_m, 0.0);
        close(scores.motion.map(|m| m.median_translation_m), 0.0);
        assert_eq!(scores.motion.unwrap().all_pairs, 2);
        close(scores.ate.none_m, 0.5f64.sqrt());
        assert_eq!(score(&data, &jump, 5).overall.motion, None);
    }

    #[test]
    fn given_poses_do_not_count_as_calibrated() {
        let data = drive(&[0, 1, 2]);
        let exact = system(&data, |_, truth| Some(truth));
        let covariances = [0.0, 0.01, f64::NAN].map(|v| Covariance6::from_diagonal([v; 6])).to_vec();
        let system = System { covariances, ..exact };
        let calibration = score(&data, &system, 1).overall.calibration.unwrap();
        assert_eq!((calibration.count, calibration.skipped), (1, 1));
        assert_eq!(sorted_nees(&data, &system), [0.0]);
    }

    #[test]
    fn frame_errors_are_distance_and_angle() {
        let data = drive(&[0]);
        let turned = Pose::new(Vector3::new(0.0, 3.0, 4.0), Vector3::new(0.0, 0.0, 90f64.to_radians()));
        let errors = frame_errors(&data, &system(&data, |_, _| Some(turned)));
        close(errors[0].map(|e| e.translation_m), 5.0);
        close(errors[0].map(|e| e.rotation_deg), 90.0);
    }
}
