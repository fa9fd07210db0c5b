//! What a network looks like: one typed [`NetworkConfig`], its presets and its limits.

use serde::{Deserialize, Serialize};

/// A field of the configuration that cannot be used.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("network config: `{field}` is {found}; allowed: {allowed}")]
pub struct ConfigError {
    /// The field's name, as written in the configuration.
    pub field: &'static str,
    /// The value found.
    pub found: String,
    /// What is allowed there.
    pub allowed: String,
}

/// Which parts exist beside CNN1.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Branches {
    /// RCNN1, the relative sub-network.
    pub relative: bool,
    /// RCNN2, the global sub-network.
    pub global: bool,
    /// FCFL, the fusion of both; needs both.
    pub fusion: bool,
}

/// How the rotation head (fc5) writes a rotation; the outputs are raw, not normalised.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Rotation {
    /// Four numbers (x, y, z, w), as in the paper.
    Quaternion,
    /// Six numbers: the first and the second column of the rotation matrix (Zhou et al., CVPR 2019).
    #[serde(rename = "rotation_6d")]
    Rotation6d,
}

impl Rotation {
    /// Outputs of fc5: 4 or 6.
    pub const fn outputs(self) -> usize {
        match self {
            Self::Quaternion => 4,
            Self::Rotation6d => 6,
        }
    }

    /// The raw outputs that stand for no rotation.
    pub const fn identity(self) -> &'static [f32] {
        match self {
            Self::Quaternion => &[0.0, 0.0, 0.0, 1.0],
            Self::Rotation6d => &[1.0, 0.0, 0.0, 0.0, 1.0, 0.0],
        }
    }
}

/// How the map of Res5 becomes the vector that the LSTM reads; the paper does not say.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum SpatialPool {
    /// Global average pool, as in ResNet-50.
    Average,
    /// A 1x1 convolution (with batch norm and ELU) to `channels`, then all positions side by side, as DeepVO does:
    /// keeps where in the image something was seen.
    Flatten {
        /// Channels after the reduction; not scaled by the width multiplier.
        channels: usize,
    },
}

/// Where the LSTM's state comes from at run time.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Recurrence {
    /// The state is carried from frame to frame until a reset.
    Carry,
    /// Each frame starts from the zero state and re-runs the LSTM over the pooled features of the last `k` frames.
    RerunLastK,
}

/// Everything that fixes the shapes of the network; the tensors of a checkpoint follow from it.
///
/// The fields are open so that a variant can be written as `NetworkConfig { k: 3, ..NetworkConfig::grnet() }`; every
/// consumer calls [`NetworkConfig::validate`] before it builds anything.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct NetworkConfig {
    /// Multiplies the channels of Res1..Res5 (rounded to multiples of 8); 0 < width <= 4.
    pub width: f64,
    /// Image height in pixels, 32..=2048; need not be a multiple of 32.
    pub input_height_px: usize,
    /// Image width in pixels, 32..=2048.
    pub input_width_px: usize,
    /// Temporal length K of the paper: frames in a training window and in a re-run, 1..=64.
    pub k: usize,
    /// Which sub-networks exist.
    pub branches: Branches,
    /// What fc5 writes.
    pub rotation: Rotation,
    /// Output channels of Res5 at width 1 (ResNet-50: 2048), a multiple of 32 in 32..=8192.
    pub res5_channels: usize,
    /// How Res5 meets the LSTM.
    pub spatial_pool: SpatialPool,
    /// Hidden states of each LSTM layer, 1..=8192.
    pub lstm_hidden: usize,
    /// Stacked LSTM layers, 1..=4.
    pub lstm_layers: usize,
    /// Outputs of fc1 (RCNN1), 1..=8192.
    pub fc1: usize,
    /// Outputs of fc2 (RCNN2), 1..=8192.
    pub fc2: usize,
    /// Outputs of fc3 (FCFL), 1..=8192.
    pub fc3: usize,
    /// Whether a log-variance head (6 outputs, translation then rotation) stands beside each pose head.
    pub log_variance: bool,
    /// Carried LSTM state or a re-run over the last K frames.
    pub recurrence: Recurrence,
    /// Least time between two key frames of a stream in milliseconds, 0..=10000: RCNN1 pairs every frame with the last key
    /// frame. 0, as in the paper, makes every frame one. A time and not a number of frames, so that a slower camera, or a
    /// slower computer, does not put the two further apart. Files that do not say were made for 0.
    #[serde(default)]
    pub keyframe_interval_ms: u32,
}

/// Names that [`NetworkConfig::preset`] knows.
pub const PRESETS: [&str; 4] = ["grnet", "grnet-small", "rcnn1-only", "rcnn2-only"];

impl NetworkConfig {
    /// The paper's network: ResNet-50 at width 1, 224x224, K = 5, two LSTMs of 1000, fc1..fc3 of 1024, quaternion.
    ///
    /// Departures: Res5 keeps ResNet-50's 2048 outputs, so that public weights load (the 1024 that the paper calls
    /// "the output dimension of this layer" is what Res4 gives), and a log-variance head stands beside each pose head.
    pub fn grnet() -> Self {
        Self {
            width: 1.0,
            input_height_px: 224,
            input_width_px: 224,
            k: 5,
            branches: Branches { relative: true, global: true, fusion: true },
            rotation: Rotation::Quaternion,
            res5_channels: 2048,
            spatial_pool: SpatialPool::Average,
            lstm_hidden: 1000,
            lstm_layers: 2,
            fc1: 1024,
            fc2: 1024,
            fc3: 1024,
            log_variance: true,
            recurrence: Recurrence::Carry,
            keyframe_interval_ms: 0,
        }
    }

    /// A network that runs in real time on one small core: width 1/4 at 112x112, flattened pool, 6-D rotation, LSTMs of 128.
    ///
    /// Its LSTMs are re-run over the last K frames, as they were trained: with a state carried on over hundreds of frames the
    /// odometry drifted faster (`docs/results.md`). Key frames: at 30 frames a second every fourth frame is one.
    pub fn grnet_small() -> Self {
        Self {
            width: 0.25,
            input_height_px: 112,
            input_width_px: 112,
            rotation: Rotation::Rotation6d,
            spatial_pool: SpatialPool::Flatten { channels: 32 },
            lstm_hidden: 128,
            fc1: 128,
            fc2: 128,
            fc3: 128,
            recurrence: Recurrence::RerunLastK,
            keyframe_interval_ms: 110,
            ..Self::grnet()
        }
    }

    /// The paper's ablation without the global branch: CNN1 and RCNN1 of [`NetworkConfig::grnet`].
    pub fn rcnn1_only() -> Self {
        Self { branches: Branches { relative: true, global: false, fusion: false }, ..Self::grnet() }
    }

    /// The paper's ablation without the relative branch: CNN1 and RCNN2 of [`NetworkConfig::grnet`].
    pub fn rcnn2_only() -> Self {
        Self { branches: Branches { relative: false, global: true, fusion: false }, ..Self::grnet() }
    }

    /// The preset of that name, one of [`PRESETS`].
    ///
    /// # Errors
    /// When no preset has that name.
    pub fn preset(name: &str) -> Result<Self, ConfigError> {
        match name {
            "grnet" => Ok(Self::grnet()),
            "grnet-small" => Ok(Self::grnet_small()),
            "rcnn1-only" => Ok(Self::rcnn1_only()),
            "rcnn2-only" => Ok(Self::rcnn2_only()),
            _ => Err(ConfigError {
                field: "preset",
                found: format!("{name:?}"),
                allowed: PRESETS.map(|p| format!("{p:?}")).join(", "),
            }),
        }
    }

    /// Checks every field.
    ///
    /// # Errors
    /// The first field out of its range, with the value found and what is allowed.
    pub fn validate(&self) -> Result<(), ConfigError> {
        let range = |field, found: usize, allowed: std::ops::RangeInclusive<usize>| {
            if allowed.contains(&found) {
                return Ok(());
            }
            let allowed = format!("{}..={}", allowed.start(), allowed.end());
            Err(ConfigError { field, found: found.to_string(), allowed })
        };
        if !(self.width > 0.0 && self.width <= 4.0) {
            return Err(ConfigError {
                field: "width",
                found: self.width.to_string(),
                allowed: "a number above 0 and up to 4".into(),
            });
        }
        range("input_height_px", self.input_height_px, 32..=2048)?;
        range("input_width_px", self.input_width_px, 32..=2048)?;
        range("k", self.k, 1..=64)?;
        let Branches { relative, global, fusion } = self.branches;
        if !(relative || global) || (fusion && !(relative && global)) {
            return Err(ConfigError {
                field: "branches",
                found: format!("relative {relative}, global {global}, fusion {fusion}"),
                allowed: "relative or global or both; fusion only with both".into(),
            });
        }
        range("res5_channels", self.res5_channels, 32..=8192)?;
        if !self.res5_channels.is_multiple_of(32) {
            return Err(ConfigError {
                field: "res5_channels",
                found: self.res5_channels.to_string(),
                allowed: "multiples of 32".into(),
            });
        }
        if let SpatialPool::Flatten { channels } = self.spatial_pool {
            range("spatial_pool.flatten.channels", channels, 1..=4096)?;
        }
        range("lstm_hidden", self.lstm_hidden, 1..=8192)?;
        range("lstm_layers", self.lstm_layers, 1..=4)?;
        range("fc1", self.fc1, 1..=8192)?;
        range("fc2", self.fc2, 1..=8192)?;
        range("fc3", self.fc3, 1..=8192)?;
        range("keyframe_interval_ms", self.keyframe_interval_ms as usize, 0..=10_000)
    }

    /// Channels after the width multiplier: the nearest multiple of 8, at least 8.
    pub fn channels(&self, at_width_1: usize) -> usize {
        let eighths = (at_width_1 as f64 * self.width / 8.0).round();
        (eighths as usize).max(1) * 8
    }

    /// Planes (channels of the 3x3 convolutions) of Res2, Res3 and Res4.
    pub fn cnn1_planes(&self) -> [usize; 3] {
        [64, 128, 256].map(|planes| self.channels(planes))
    }

    /// Planes of Res5; its output has four times as many channels.
    pub fn res5_planes(&self) -> usize {
        self.channels(self.res5_channels / 4)
    }

    /// Shape (C, H, W) of CNN1's features of one frame; (1024, 14, 14) for [`NetworkConfig::grnet`].
    pub fn features_shape(&self) -> (usize, usize, usize) {
        // Four halvings, each rounding up: conv1, max-pool, Res3, Res4.
        let side = |px: usize| (0..4).fold(px, |n, _| n.div_ceil(2));
        (4 * self.cnn1_planes()[2], side(self.input_height_px), side(self.input_width_px))
    }

    /// Numbers per frame that the LSTM reads; 2048 for [`NetworkConfig::grnet`].
    pub fn pooled_features(&self) -> usize {
        let (_, height, width) = self.features_shape();
        match self.spatial_pool {
            SpatialPool::Average => 4 * self.res5_planes(),
            SpatialPool::Flatten { channels } => channels * height.div_ceil(2) * width.div_ceil(2),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn presets_are_valid_and_survive_json() {
        for name in PRESETS {
            let config = NetworkConfig::preset(name).unwrap();
            config.validate().unwrap();
            let json = serde_json::to_string(&config).unwrap();
            assert_eq!(serde_json::from_str::<NetworkConfig>(&json).unwrap(), config);
        }
        let error = NetworkConfig::preset("resnet").unwrap_err().to_string();
        assert!(error.contains("\"resnet\"") && error.contains("\"grnet-small\""), "{error}");
    }

    #[test]
    fn unknown_fields_are_refused() {
        let mut json = serde_json::to_value(NetworkConfig::grnet()).unwrap();
        json["colour"] = "blue".into();
        let error = serde_json::from_value::<NetworkConfig>(json).unwrap_err().to_string();
        assert!(error.contains("colour"), "{error}");
    }

    #[test]
    fn every_field_out_of_range_is_named() {
        let base = NetworkConfig::grnet();
        let bad = [
            ("width", NetworkConfig { width: 0.0, ..base.clone() }),
            ("width", NetworkConfig { width: f64::NAN, ..base.clone() }),
            ("width", NetworkConfig { width: 4.5, ..base.clone() }),
            ("input_height_px", NetworkConfig { input_height_px: 31, ..base.clone() }),
            ("input_width_px", NetworkConfig { input_width_px: 4096, ..base.clone() }),
            ("k", NetworkConfig { k: 0, ..base.clone() }),
            (
                "branches",
                NetworkConfig {
                    branches: Branches { relative: false, global: false, fusion: false },
                    ..base.clone()
                },
            ),
            (
                "branches",
                NetworkConfig {
                    branches: Branches { relative: true, global: false, fusion: true },
                    ..base.clone()
                },
            ),
            ("res5_channels", NetworkConfig { res5_channels: 1000, ..base.clone() }),
            ("res5_channels", NetworkConfig { res5_channels: 0, ..base.clone() }),
            (
                "spatial_pool.flatten.channels",
                NetworkConfig { spatial_pool: SpatialPool::Flatten { channels: 0 }, ..base.clone() },
            ),
            ("lstm_hidden", NetworkConfig { lstm_hidden: 0, ..base.clone() }),
            ("lstm_layers", NetworkConfig { lstm_layers: 5, ..base.clone() }),
            ("fc1", NetworkConfig { fc1: 0, ..base.clone() }),
            ("fc2", NetworkConfig { fc2: 8193, ..base.clone() }),
            ("fc3", NetworkConfig { fc3: 0, ..base.clone() }),
            ("keyframe_interval_ms", NetworkConfig { keyframe_interval_ms: 10_001, ..base.clone() }),
        ];
        for (field, config) in bad {
            let error = config.validate().unwrap_err();
            assert_eq!(error.field, field, "{error}");
            assert!(error.to_string().contains(&error.found), "{error}");
        }
    }

    #[test]
    fn shapes_follow_the_paper() {
        let config = NetworkConfig::grnet();
        assert_eq!(config.features_shape(), (1024, 14, 14));
        assert_eq!(config.pooled_features(), 2048);
        let odd = NetworkConfig { input_height_px: 100, input_width_px: 225, ..config };
        assert_eq!(odd.features_shape(), (1024, 7, 15));
        assert_eq!(NetworkConfig::grnet_small().pooled_features(), 32 * 4 * 4);
    }
}
