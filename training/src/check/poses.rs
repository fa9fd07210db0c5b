//! Whether the true poses can be true.

use grnet_capture::dataset::{Pose, Recording};
use grnet_geometry::se3;
use grnet_geometry::statistics::median;

use super::finding::{Finding, Severity, by_share};

/// Speeds beyond which nothing that carries a camera moves.
const MOST_SPEED_MPS: f64 = 60.0;
const MOST_RATE_RADPS: f64 = 20.0;

/// A step this many times faster than those around it, and by at least so much, is a jump.
const OUTLIER: f64 = 6.0;
const LEAST_JUMP_MPS: f64 = 0.3;
const LEAST_JUMP_RADPS: f64 = 1.0;

/// Steps on either side that a step is compared with.
const NEIGHBOURS: usize = 10;

/// Motions below which a network has nothing to learn from.
const LEAST_EXTENT_M: f64 = 0.05;
const LEAST_TURN_RAD: f64 = 0.05;

/// How fast the camera went from one frame to the next.
struct Step {
    to: u64,
    speed_mps: f64,
    rate_radps: f64,
}

/// Looks at the true poses; `first_invalid` says what is wrong with the first one that is no rigid motion.
pub fn check(recording: &Recording, first_invalid: Option<&str>) -> Vec<Finding> {
    let frames = &recording.frames;
    let missing: Vec<u64> =
        frames.iter().filter(|f| f.world_from_camera.is_none()).map(|f| f.sequence).collect();
    let mut findings = Vec::new();
    if recording.invalid_poses > 0 {
        let found = format!(
            "{} poses are no rigid motions (not finite, not orthogonal, or mirrored) and count as missing; the first: {}",
            recording.invalid_poses,
            first_invalid.unwrap_or("not found again")
        );
        let severity = by_share(recording.invalid_poses, frames.len(), 0.1);
        findings.push(Finding::new(
            severity,
            "invalid-pose",
            found,
            "mend or delete them in the ground truth",
        ));
    }
    if missing.len() == frames.len() {
        let found = "no frame has a true pose".to_owned();
        let advice = "join a trajectory with `grnet-train join`, or give one with --poses";
        findings.push(Finding::new(Severity::Error, "no-poses", found, advice));
        return findings;
    }
    if !missing.is_empty() {
        let found =
            format!("{} of {} frames have no true pose and are not trained on", missing.len(), frames.len());
        let severity = if missing.len() * 10 > frames.len() { Severity::Warning } else { Severity::Note };
        let advice = "see how far the trajectory reaches, and `grnet-train join --max-gap`";
        findings.push(Finding::new(severity, "missing-pose", found, advice).on(missing));
    }
    let steps = steps(recording);
    jumps(&steps, &mut findings);
    let poses: Vec<&Pose> = frames.iter().filter_map(|frame| frame.world_from_camera.as_ref()).collect();
    let (extent_m, turn_rad) = extent(&poses);
    if extent_m < LEAST_EXTENT_M && turn_rad < LEAST_TURN_RAD {
        let found = format!(
            "the camera hardly moves: {:.1} mm and {:.2} deg away from where it begins at most",
            1e3 * extent_m,
            turn_rad.to_degrees()
        );
        let advice =
            "record while moving; see whether the ground truth is in metres (`grnet-train join --scale`)";
        findings.push(Finding::new(Severity::Warning, "little-motion", found, advice));
    }
    findings
}

/// Steps between neighbouring frames that both have a pose.
fn steps(recording: &Recording) -> Vec<Step> {
    let step = |pair: &[grnet_capture::dataset::RecordedFrame]| {
        let (a, b) = (pair[0].world_from_camera?, pair[1].world_from_camera?);
        let seconds = pair[1].time_ns.checked_sub(pair[0].time_ns).filter(|ns| *ns > 0)? as f64 * 1e-9;
        let motion = se3::relative(&a, &b);
        Some(Step {
            to: pair[1].sequence,
            speed_mps: motion.translation.vector.norm() / seconds,
            rate_radps: se3::angle_rad(&motion.rotation) / seconds,
        })
    };
    recording.frames.windows(2).filter_map(step).collect()
}

fn jumps(steps: &[Step], findings: &mut Vec<Finding>) {
    let near = |index: usize, value: &dyn Fn(&Step) -> f64| {
        let range = index.saturating_sub(NEIGHBOURS)..(index + NEIGHBOURS + 1).min(steps.len());
        median(&steps[range].iter().map(value).collect::<Vec<f64>>()).unwrap_or_default()
    };
    let is_fast = |step: &Step| step.speed_mps > MOST_SPEED_MPS || step.rate_radps > MOST_RATE_RADPS;
    let is_jump = |(index, step): &(usize, &Step)| {
        let (speed_mps, rate_radps) = (near(*index, &|s| s.speed_mps), near(*index, &|s| s.rate_radps));
        step.speed_mps > OUTLIER * speed_mps + LEAST_JUMP_MPS
            || step.rate_radps > OUTLIER * rate_radps + LEAST_JUMP_RADPS
    };
    let fast: Vec<&Step> = steps.iter().filter(|step| is_fast(step)).collect();
    let jumps: Vec<&Step> = steps.iter().enumerate().filter(is_jump).map(|(_, step)| step).collect();
    let most = |steps: &[&Step]| {
        let most = |value: &dyn Fn(&Step) -> f64| steps.iter().map(|s| value(s)).fold(0.0, f64::max);
        (most(&|step| step.speed_mps), most(&|step| step.rate_radps).to_degrees())
    };
    let numbers = |steps: &[&Step]| steps.iter().map(|step| step.to).collect();
    let middle_mps =
        median(&steps.iter().map(|step| step.speed_mps).collect::<Vec<f64>>()).unwrap_or_default();
    if !jumps.is_empty() {
        let (speed_mps, rate_degps) = most(&jumps);
        let found = format!(
            "{} jumps into a frame: up to {speed_mps:.2} m/s and {rate_degps:.0} deg/s, {OUTLIER} times and more the \
             motion around them (middle speed {middle_mps:.2} m/s)",
            jumps.len()
        );
        let severity = by_share(jumps.len(), steps.len(), 0.01);
        let advice = "the ground truth lost track there: leave these frames without a pose";
        findings.push(Finding::new(severity, "pose-jump", found, advice).on(numbers(&jumps)));
    }
    if !fast.is_empty() {
        let (speed_mps, rate_degps) = most(&fast);
        let found =
            format!("{} steps are impossible: up to {speed_mps:.1} m/s, {rate_degps:.0} deg/s", fast.len());
        let advice =
            "see whether times are in seconds and positions in metres, and where the ground truth jumps";
        findings.push(Finding::new(Severity::Error, "impossible-speed", found, advice).on(numbers(&fast)));
    }
}

/// Largest distance and turn from the first pose.
fn extent(poses: &[&Pose]) -> (f64, f64) {
    let Some(first) = poses.first() else { return (0.0, 0.0) };
    let mut most = (0.0f64, 0.0f64);
    for pose in poses {
        let motion = se3::relative(first, pose);
        most = (most.0.max(motion.translation.vector.norm()), most.1.max(se3::angle_rad(&motion.rotation)));
    }
    most
}
