//! Whether poses and intrinsics fit how corners move through the images.
//!
//! The measure is the middle Sampson distance of corners followed between frames a few apart. It is compared with what
//! motions of other parts of the recording give, and with what the usual mistakes would explain: a wrong focal length,
//! poses that are early or late, inverted poses, poses of a body with other axes.

use grnet_capture::dataset::{Pose, Recording};
use grnet_frame::{Camera, Distortion};
use grnet_geometry::se3;
use nalgebra::{Matrix3, Rotation3, Translation3, UnitQuaternion};

use super::epipolar::{Fit, Pair, fit};
use super::finding::{Finding, Severity};
use super::pairs::collect;

/// Fewest pairs that allow a judgement.
const LEAST_PAIRS: usize = 8;

/// A mistake is believed when correcting it leaves less than this share of the distance.
const EXPLAINED: f64 = 0.5;

/// A shift in time, and a focal length, need less: they hide in small motions.
const EXPLAINED_BY_TIME: f64 = 0.8;
const EXPLAINED_BY_FOCAL: f64 = 0.93;

/// Focal lengths closer than this to the given one are the same.
const SAME_FOCAL: f64 = 0.03;
/// Farther ones are an error.
const WRONG_FOCAL: f64 = 0.2;

/// Poses fit when they leave this many pixels of a 640 px wide image, or this share of what wrong motions leave.
const FITS_PX: f64 = 1.5;
const FITS_SHARE: f64 = 0.4;
/// A convention of axes has to fit better than that.
const SURE_SHARE: f64 = 0.15;

/// Farthest shift in frames, in steps of half a frame.
const MOST_SHIFT: i32 = 6;

/// Looks at one sequence.
pub fn check(recording: &Recording) -> Vec<Finding> {
    let known = recording.frames.iter().filter(|frame| frame.world_from_camera.is_some()).count();
    if known < 2 {
        return Vec::new();
    }
    let (camera, is_guess) = match (recording.camera, recording.image_size_px) {
        (Some(camera), _) => (camera, false),
        (None, Some(size)) => match guess(size) {
            Some(camera) => (camera, true),
            None => return Vec::new(),
        },
        (None, None) => return Vec::new(),
    };
    let pairs: Vec<Pair> = collect(recording, &camera)
        .into_iter()
        .filter(|pair| [pair.first, pair.second].iter().all(|i| pose(recording, *i as f64).is_some()))
        .collect();
    if pairs.len() < LEAST_PAIRS {
        let found = format!(
            "corners could be followed between {} pairs of frames with poses, {LEAST_PAIRS} are needed: whether poses \
             fit the images is not known",
            pairs.len()
        );
        let advice = "images need texture and a few pixels of motion";
        return vec![Finding::new(Severity::Note, "few-tracks", found, advice)];
    }
    Judge { recording, pairs, camera, is_guess }.findings()
}

struct Judge<'a> {
    recording: &'a Recording,
    pairs: Vec<Pair>,
    camera: Camera,
    is_guess: bool,
}

impl Judge<'_> {
    fn findings(&self) -> Vec<Finding> {
        let given = |pair: &Pair| self.motion(pair, 0.0, |pose| pose);
        let elsewhere = self.fit(1.0, |pair| self.motion_elsewhere(pair));
        let (Some(as_given), Some(elsewhere), Some((focal_scale, with_focal))) =
            (self.fit(1.0, given), elsewhere, self.best_focal(&given))
        else {
            return Vec::new();
        };
        let as_given = if self.is_guess { with_focal } else { as_given.middle_px };
        let wrong = elsewhere.middle_px;
        let limit = (FITS_PX * self.width() / 640.0).max(FITS_SHARE * wrong);
        let fits = as_given < limit;
        // Among so many conventions one comes near by chance.
        let sure = (FITS_PX * self.width() / 640.0).max(SURE_SHARE * wrong);

        let mut findings = Vec::new();
        let measured = format!(
            "corners miss their epipolar lines by {as_given:.2} px (middle of {} pairs of frames); motions of other \
             parts of the recording would leave {wrong:.2} px",
            self.pairs.len()
        );
        if fits {
            findings.push(Finding::new(Severity::Note, "poses-fit", measured.clone(), ""));
        }
        if let Some(finding) = self.convention(as_given, sure) {
            findings.push(finding);
        } else {
            // What does not explain the distance is no explanation.
            let time = self.shift(limit);
            let focal = if with_focal < limit { self.focal(focal_scale, with_focal, as_given) } else { None };
            if time.is_none() && focal.is_none() && !fits {
                let advice = "the ground truth is of another recording or camera, or its clock is off by more than a \
                              few frames: see `grnet-train join --time-offset` and `--body-from-camera`";
                findings.push(Finding::new(Severity::Error, "poses-do-not-fit", measured, advice));
            }
            findings.extend(time);
            findings.extend(focal);
        }
        findings
    }

    fn fit(&self, scale: f64, motion: impl Fn(&Pair) -> Option<Pose>) -> Option<Fit> {
        let (fx, fy) = self.camera.focal_px();
        fit(&self.pairs, (fx + fy) / 2.0, scale, motion)
    }

    fn width(&self) -> f64 {
        f64::from(self.camera.size_px().0)
    }

    /// The motion of a pair by the poses `shift` frames later, each changed by `change`.
    fn motion(&self, pair: &Pair, shift: f64, change: impl Fn(Pose) -> Pose) -> Option<Pose> {
        let first = pose(self.recording, pair.first as f64 + shift)?;
        let second = pose(self.recording, pair.second as f64 + shift)?;
        Some(se3::relative(&change(first), &change(second)))
    }

    /// The motion of a pair from another part of the recording: what fits by chance.
    fn motion_elsewhere(&self, pair: &Pair) -> Option<Pose> {
        let index = self.pairs.iter().position(|other| other.first == pair.first)?;
        let other = &self.pairs[(index + self.pairs.len() / 2) % self.pairs.len()];
        self.motion(other, 0.0, |pose| pose)
    }

    /// Inverted poses, other axes, or both.
    fn convention(&self, as_given: f64, limit: f64) -> Option<Finding> {
        let mut best: Option<(Fit, bool, usize)> = None;
        let turns = quarter_turns();
        for is_inverted in [false, true] {
            for (index, given_from_camera) in turns.iter().enumerate() {
                let change = |pose: Pose| {
                    let pose = if is_inverted { pose.inverse() } else { pose };
                    pose * Pose::from_parts(Translation3::identity(), *given_from_camera)
                };
                if let Some(fit) = self.fit(1.0, |pair| self.motion(pair, 0.0, change))
                    && best.is_none_or(|(least, ..)| fit.cost < least.cost)
                {
                    best = Some((fit, is_inverted, index));
                }
            }
        }
        let (fit, is_inverted, index) = best?;
        let score = fit.middle_px;
        if score > limit.min(EXPLAINED * as_given) {
            return None;
        }
        let axes = axes(&turns[index]);
        let with = format!("corners miss by {score:.2} px instead of {as_given:.2} px");
        let (kind, found, advice) = match (is_inverted, axes) {
            (true, None) => (
                "inverted-poses",
                format!("the poses are camera_from_world: inverted, {with}"),
                "invert them: ground truth is world_from_camera",
            ),
            (false, Some(axes)) => (
                "other-axes",
                format!("the poses are of other axes than the camera's: with {axes}, {with}"),
                "turn them to x right, y down, z forward, as `grnet-train join --body-from-camera` does",
            ),
            (true, Some(axes)) => (
                "inverted-poses",
                format!("the poses are inverted and of other axes than the camera's: with {axes}, {with}"),
                "give world_from_camera with x right, y down, z forward",
            ),
            (false, None) => return None,
        };
        Some(Finding::new(Severity::Error, kind, found, advice))
    }

    /// Poses that fit the images of some frames earlier or later.
    fn shift(&self, limit: f64) -> Option<Finding> {
        let shifts: Vec<f64> = (-MOST_SHIFT..=MOST_SHIFT).map(|half| f64::from(half) / 2.0).collect();
        let widest = f64::from(MOST_SHIFT) / 2.0;
        // All shifts are judged on the same pairs.
        let inside = |pair: &Pair| {
            [-widest, widest].iter().all(|shift| self.motion(pair, *shift, |pose| pose).is_some())
        };
        let scores = shifts.iter().filter_map(|shift| {
            let motion = |pair: &Pair| inside(pair).then(|| self.motion(pair, *shift, |pose| pose))?;
            Some((*shift, self.fit(1.0, motion)?))
        });
        let scores: Vec<(f64, Fit)> = scores.collect();
        let unshifted = scores.iter().find(|(shift, _)| *shift == 0.0)?.1.middle_px;
        let (shift, best) = scores.iter().copied().min_by(|a, b| a.1.cost.total_cmp(&b.1.cost))?;
        let best = best.middle_px;
        if shift == 0.0 || best > limit || best > EXPLAINED_BY_TIME * unshifted {
            return None;
        }
        let period_s = self.recording.nominal_rate_hz.map_or(f64::NAN, |rate_hz| 1.0 / rate_hz);
        let found = format!(
            "the poses are {} by about {} frames ({:.3} s): moved, corners miss by {best:.2} px instead of \
             {unshifted:.2} px",
            if shift > 0.0 { "late" } else { "early" },
            shift.abs(),
            shift.abs() * period_s
        );
        let advice = "join again with another --time-offset: a negative one for poses that are late, a positive one for early ones";
        Some(Finding::new(Severity::Warning, "time-offset", found, advice))
    }

    /// The factor on the focal length that fits best, and what it leaves.
    fn best_focal(&self, given: &impl Fn(&Pair) -> Option<Pose>) -> Option<(f64, f64)> {
        // Half to twice the given one, in steps of 2 %.
        let scales = (-35..=35).map(|step| 1.02f64.powi(step));
        let fits = scales.filter_map(|scale| Some((scale, self.fit(scale, given)?)));
        let (scale, fit) = fits.min_by(|a, b| a.1.cost.total_cmp(&b.1.cost))?;
        Some((scale, fit.middle_px))
    }

    fn focal(&self, scale: f64, with_focal: f64, as_given: f64) -> Option<Finding> {
        let focal_px = (self.camera.focal_px().0 + self.camera.focal_px().1) / 2.0;
        let better_px = focal_px * scale;
        if self.is_guess {
            let found =
                format!("the intrinsics are not known; a focal length of about {better_px:.0} px fits best");
            let advice = "calibrate the camera and put camera-intrinsics.txt beside the images";
            return Some(Finding::new(Severity::Warning, "no-intrinsics", found, advice));
        }
        let is_same = (scale - 1.0).abs() < SAME_FOCAL;
        if is_same || with_focal > EXPLAINED_BY_FOCAL * as_given {
            return None;
        }
        let found = format!(
            "a focal length of about {better_px:.0} px fits better than {focal_px:.0} px: corners miss by \
             {with_focal:.2} px instead of {as_given:.2} px"
        );
        let far = (scale - 1.0).abs() > WRONG_FOCAL;
        let severity = if far { Severity::Error } else { Severity::Warning };
        let advice =
            "calibrate the camera; see whether the intrinsics are those of another camera or image size";
        Some(Finding::new(severity, "focal-length", found, advice))
    }
}

/// A camera without distortion, with the focal length of an ordinary lens: the scan goes from half of it to twice.
fn guess((width, height): (u32, u32)) -> Option<Camera> {
    let focal = f64::from(width) * 0.85;
    let centre = (f64::from(width - 1) / 2.0, f64::from(height - 1) / 2.0);
    Camera::new((width, height), (focal, focal), centre, Distortion::None).ok()
}

/// The pose at an index, between frames by interpolation.
fn pose(recording: &Recording, index: f64) -> Option<Pose> {
    let frames = &recording.frames;
    if index < 0.0 {
        return None;
    }
    let before = frames.get(index.floor() as usize)?.world_from_camera?;
    if index.fract() == 0.0 {
        return Some(before);
    }
    let after = frames.get(index.ceil() as usize)?.world_from_camera?;
    Some(se3::interpolate(&before, &after, index.fract()))
}

/// The 24 rotations that map axes to axes, the identity first: what one convention is to another.
fn quarter_turns() -> Vec<UnitQuaternion<f64>> {
    let mut found = Vec::new();
    for columns in [[0, 1, 2], [1, 2, 0], [2, 0, 1], [0, 2, 1], [2, 1, 0], [1, 0, 2]] {
        for signs in 0..8 {
            let mut matrix = Matrix3::zeros();
            for (row, column) in columns.into_iter().enumerate() {
                matrix[(row, column)] = if signs >> row & 1 == 0 { 1.0 } else { -1.0 };
            }
            if matrix.determinant() > 0.0 {
                let rotation = Rotation3::from_matrix_unchecked(matrix);
                found.push(UnitQuaternion::from_rotation_matrix(&rotation));
            }
        }
    }
    found
}

/// The given poses' axes, seen from the camera; `None` when they are the camera's own.
fn axes(given_from_camera: &UnitQuaternion<f64>) -> Option<String> {
    let camera_from_given = given_from_camera.to_rotation_matrix().inverse().into_inner();
    let names = [["left", "right"], ["up", "down"], ["backward", "forward"]];
    let name = |axis: usize| {
        let column = camera_from_given.column(axis);
        let along = (0..3).find(|row| column[*row].abs() > 0.5)?;
        Some(names[along][usize::from(column[along] > 0.0)])
    };
    let [x, y, z] = [name(0)?, name(1)?, name(2)?];
    let text = format!("x {x}, y {y}, z {z}");
    let known = match (x, y, z) {
        ("right", "down", "forward") => return None,
        ("forward", "left", "up") => " (a body's axes, REP-103)",
        ("forward", "right", "down") => " (a vehicle's axes)",
        ("right", "up", "backward") => " (OpenGL's axes)",
        _ => "",
    };
    Some(text + known)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn there_are_24_conventions_and_the_known_ones_have_names() {
        let turns = quarter_turns();
        assert_eq!(turns.len(), 24);
        assert!(axes(&turns[0]).is_none());
        let named = turns.iter().filter_map(axes).filter(|text| text.contains('('));
        assert_eq!(named.count(), 3);
        let texts: std::collections::BTreeSet<_> = turns.iter().map(axes).collect();
        assert_eq!(texts.len(), 24);
    }
}
