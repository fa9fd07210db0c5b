//! How far test frames are from what a network was shown: pose regression knows places, it does not extrapolate.

use grnet_capture::dataset::{Pose, Recording};
use grnet_geometry::se3;
use grnet_geometry::statistics::median;

use super::finding::{Finding, Severity};

/// Farther than this from every training frame, a test frame is of an unknown place.
const FAR_M: f64 = 0.5;
const FAR_RAD: f64 = 0.5;

/// Compares places of test frames with those of training frames.
pub fn check(train: &[Recording], test: &[Recording]) -> Vec<Finding> {
    let poses = |recordings: &[Recording]| -> Vec<(u64, Pose)> {
        let frames = recordings.iter().flat_map(|recording| &recording.frames);
        frames.filter_map(|frame| Some((frame.sequence, frame.world_from_camera?))).collect()
    };
    let (train, test) = (poses(train), poses(test));
    if train.is_empty() || test.is_empty() {
        let found = format!("{} training and {} test frames have a pose", train.len(), test.len());
        return vec![Finding::new(Severity::Error, "coverage", found, "both lists need frames with poses")];
    }
    // Half a metre is as far as half a radian.
    let distance = |(m, rad): (f64, f64)| (m / FAR_M).max(rad / FAR_RAD);
    let nearest = |pose: &Pose| {
        let apart = |(_, other): &(u64, Pose)| {
            let motion = se3::relative(pose, other);
            (motion.translation.vector.norm(), se3::angle_rad(&motion.rotation))
        };
        let all = train.iter().map(apart);
        all.min_by(|a, b| distance(*a).total_cmp(&distance(*b))).unwrap_or((f64::NAN, f64::NAN))
    };
    let found: Vec<(u64, (f64, f64))> = test.iter().map(|(number, pose)| (*number, nearest(pose))).collect();
    let middle = |value: &dyn Fn(&(f64, f64)) -> f64| {
        median(&found.iter().map(|(_, apart)| value(apart)).collect::<Vec<f64>>()).unwrap_or(f64::NAN)
    };
    let far: Vec<u64> =
        found.iter().filter(|(_, apart)| distance(*apart) > 1.0).map(|(number, _)| *number).collect();
    let share = far.len() as f64 / test.len() as f64;
    let text = format!(
        "test frames are {:.3} m and {:.1} deg from the nearest training frame (middle); {} of {} ({:.0} %) are more \
         than {FAR_M} m or {:.0} deg away",
        middle(&|apart| apart.0),
        middle(&|apart| apart.1).to_degrees(),
        far.len(),
        test.len(),
        100.0 * share,
        FAR_RAD.to_degrees()
    );
    let severity = if share > 0.25 { Severity::Warning } else { Severity::Note };
    let advice = if share > 0.25 { "record training frames where it will be used" } else { "" };
    vec![Finding::new(severity, "coverage", text, advice).on(far)]
}
