//! Changes that a camera in the same place could have made, drawn anew for every window.
//!
//! All frames of a window share the draw, except for what is said to be per frame: a network that sees a motion must
//! not be told by its colours which frame is which. Nothing is ever mirrored.
//!
//! A rotation of the camera about its centre moves every pixel by a homography, whatever the depth, so its label is
//! exact. With `R = camera_from_rotated` the new pose is
//!
//! `world_from_rotated = world_from_camera * R`
//!
//! and pixel `p` of the rotated camera shows pixel `K_source R K^-1 p` of the stored image.

mod develop;
mod draw;
mod warp;

use serde::{Deserialize, Serialize};

use super::DataError;
use super::window::check_share;

pub(crate) use develop::{Canvas, Developer, Scratch, Source};
pub(crate) use draw::Augmentation;
pub(crate) use warp::Warp;

/// What a rotated camera sees beyond the border of the stored image.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Border {
    /// The nearest pixel of the image, again and again: no new edges appear.
    #[default]
    Edge,
    /// The mean colour, as where a converted frame does not fill the network's input at run time. Its edge tells how
    /// far the camera was rotated.
    Mean,
}

/// How windows are changed. Fields that a configuration leaves out are off; all off is exactly what runs on the robot.
///
/// A factor "up to 1 + x" lies between 1/(1 + x) and 1 + x, to either side equally often.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct AugmentOptions {
    /// Share of windows that stay exactly as at run time.
    pub plain_share: f64,
    /// Largest rotation of the camera in degrees, about any axis, the same for all frames of a window. Rendered
    /// windows are rendered from the rotated pose and have no border.
    pub rotation_deg: f64,
    /// Largest further rotation of each frame of its own in degrees: relative rotations that were never recorded.
    pub frame_rotation_deg: f64,
    /// What lies beyond the border of a rotated image.
    pub border: Border,
    /// Largest change of brightness, as a share of white.
    pub brightness: f64,
    /// Contrast about mid-grey: a factor up to 1 + this.
    pub contrast: f64,
    /// Exponent of the tone curve: up to 1 + this.
    pub gamma: f64,
    /// Saturation: a factor up to 1 + this.
    pub saturation: f64,
    /// Gain of red, green and blue, each of its own: a factor up to 1 + this.
    pub colour: f64,
    /// Gain of each frame, as an automatic exposure has it: a factor up to 1 + this.
    pub frame_gain: f64,
    /// Largest standard deviation of the noise, as a share of white; drawn for the window, the noise for each frame.
    pub noise: f64,
    /// Share of windows that are blurred.
    pub blur_share: f64,
    /// Largest standard deviation of the blur in pixels of the network's input.
    pub blur_px: f64,
    /// Largest length of the motion blur in pixels of the network's input; its direction is the window's.
    pub motion_blur_px: f64,
    /// Share of frames of which a rectangle is covered with one colour.
    pub erase_share: f64,
    /// Largest area of the rectangle, as a share of the image.
    pub erase_area: f64,
}

impl AugmentOptions {
    /// For recordings, which have few views of a place: rotations up to 12 degrees and all else in moderation.
    pub fn recorded() -> Self {
        Self { plain_share: 0.1, rotation_deg: 12.0, frame_rotation_deg: 1.0, ..Self::rendered() }
    }

    /// For rendered frames, whose views are always new: colours, noise and blur only.
    pub fn rendered() -> Self {
        Self {
            plain_share: 0.1,
            rotation_deg: 0.0,
            frame_rotation_deg: 0.0,
            border: Border::Edge,
            brightness: 0.1,
            contrast: 0.25,
            gamma: 0.2,
            saturation: 0.3,
            colour: 0.1,
            frame_gain: 0.05,
            noise: 0.015,
            blur_share: 0.3,
            blur_px: 0.8,
            motion_blur_px: 2.5,
            erase_share: 0.1,
            erase_area: 0.1,
        }
    }

    /// Whether the camera is ever rotated.
    pub fn rotates(&self) -> bool {
        self.plain_share < 1.0 && (self.rotation_deg > 0.0 || self.frame_rotation_deg > 0.0)
    }

    pub(crate) fn check(&self) -> Result<(), DataError> {
        for (option, share) in [
            ("plain_share", self.plain_share),
            ("blur_share", self.blur_share),
            ("erase_share", self.erase_share),
            ("brightness", self.brightness),
            ("noise", self.noise),
            ("erase_area", self.erase_area),
        ] {
            check_share(option, share)?;
        }
        for (option, value, most, unit) in [
            ("rotation_deg", self.rotation_deg, 30.0, "degrees"),
            ("frame_rotation_deg", self.frame_rotation_deg, 30.0, "degrees"),
            ("blur_px", self.blur_px, 1.5, "pixels"),
            ("motion_blur_px", self.motion_blur_px, 7.0, "pixels"),
            ("contrast", self.contrast, 3.0, "above 1"),
            ("gamma", self.gamma, 3.0, "above 1"),
            ("saturation", self.saturation, 3.0, "above 1"),
            ("colour", self.colour, 3.0, "above 1"),
            ("frame_gain", self.frame_gain, 3.0, "above 1"),
        ] {
            if !(0.0..=most).contains(&value) {
                return Err(DataError::option(option, value, format!("0 to {most} {unit}")));
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn presets_are_sound_and_the_default_is_off() {
        for options in [AugmentOptions::default(), AugmentOptions::recorded(), AugmentOptions::rendered()] {
            options.check().unwrap();
        }
        assert!(AugmentOptions::recorded().rotates() && !AugmentOptions::rendered().rotates());
        let parsed: AugmentOptions =
            serde_json::from_str(r#"{"rotation_deg": 3.0, "border": "mean"}"#).unwrap();
        let expected =
            AugmentOptions { rotation_deg: 3.0, border: Border::Mean, ..AugmentOptions::default() };
        assert_eq!(parsed, expected);
        assert!(serde_json::from_str::<AugmentOptions>(r#"{"mirror": 1}"#).is_err());
    }

    #[test]
    fn senseless_values_are_named() {
        let error = AugmentOptions { rotation_deg: 40.0, ..AugmentOptions::default() }.check().unwrap_err();
        assert_eq!(
            error.to_string(),
            "option `rotation_deg` of the training data: found 40, expected 0 to 30 degrees"
        );
        assert!(AugmentOptions { noise: f64::NAN, ..AugmentOptions::default() }.check().is_err());
        assert!(AugmentOptions { blur_px: -0.1, ..AugmentOptions::default() }.check().is_err());
    }
}
