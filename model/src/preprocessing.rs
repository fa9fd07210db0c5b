//! How a camera image becomes the network's input; fixed by the training, stored with the weights, done by the pipeline.

use serde::{Deserialize, Serialize};

/// How an image of another shape is brought to the input size.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ResizePolicy {
    /// Both sides are scaled on their own: the whole image, possibly distorted.
    Stretch,
    /// Scaled until the image just covers the input, then the centre is cut out: no distortion, smaller field of view.
    CropCentre,
}

/// The filter of the resize.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Filter {
    /// Triangle filter, widened by the scale when shrinking (no aliasing), as Pillow's BILINEAR.
    Bilinear,
    /// Mean over the covered area, as OpenCV's INTER_AREA when shrinking.
    Area,
}

/// Order of the three input channels.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Colour {
    /// Red, green, blue.
    Rgb,
}

/// What happens between a camera image and the tensor (1, 3, H, W): resize, colour order, (value - mean) / std.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Preprocessing {
    /// How an image of another shape is brought to the input size.
    pub resize: ResizePolicy,
    /// The filter of the resize.
    pub filter: Filter,
    /// Order of the input channels.
    pub colour: Colour,
    /// Subtracted per channel; pixel values are in 0..=1.
    pub mean: [f64; 3],
    /// Divides per channel; pixel values are in 0..=1.
    pub std: [f64; 3],
}

impl Default for Preprocessing {
    /// Mean and deviation of ImageNet, as public ResNet-50 weights expect; the whole image, bilinear.
    fn default() -> Self {
        Self {
            resize: ResizePolicy::Stretch,
            filter: Filter::Bilinear,
            colour: Colour::Rgb,
            mean: [0.485, 0.456, 0.406],
            std: [0.229, 0.224, 0.225],
        }
    }
}

impl Preprocessing {
    /// Why these values cannot be used, if they cannot.
    pub(crate) fn problem(&self) -> Option<String> {
        let bad_mean = self.mean.iter().find(|v| !v.is_finite());
        let bad_std = self.std.iter().find(|v| !(v.is_finite() && **v > 0.0));
        match (bad_mean, bad_std) {
            (Some(found), _) => Some(format!("preprocessing.mean holds {found}; finite numbers expected")),
            (_, Some(found)) => Some(format!("preprocessing.std holds {found}; positive numbers expected")),
            _ => None,
        }
    }
}
