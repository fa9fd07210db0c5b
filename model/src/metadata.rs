//! What a checkpoint says about its weights: one JSON object in the safetensors header, under the key `grnet`.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use crate::config::NetworkConfig;
use crate::preprocessing::Preprocessing;

/// Version of the metadata that this crate writes and reads.
pub const SCHEMA: u32 = 1;
/// Bound of each of [`CheckpointMetadata::motion_log_variance_shift`]: with deviations 3000 times those that the trunk says, the
/// motion is not known at all.
pub const LARGEST_MOTION_SHIFT: f64 = 16.0;

/// Which part of the network a file holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Kind {
    /// Every tensor.
    Complete,
    /// `cnn1.*` and `rcnn1.*`: knows motion, no place.
    Trunk,
    /// `rcnn2.*` and `fcfl.*`: knows one place; bound to its trunk by hash.
    Scene,
}

impl Kind {
    /// Whether a tensor of that name belongs into a file of this kind.
    pub fn holds(self, tensor: &str) -> bool {
        let trunk = tensor.starts_with("cnn1.") || tensor.starts_with("rcnn1.");
        match self {
            Self::Complete => true,
            Self::Trunk => trunk,
            Self::Scene => !trunk,
        }
    }
}

impl std::fmt::Display for Kind {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::Complete => "complete",
            Self::Trunk => "trunk",
            Self::Scene => "scene",
        })
    }
}

/// Which outputs of one pose head are trained; what is not gives no number.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct HeadState {
    /// fc4 and fc5.
    pub pose: bool,
    /// The log-variance layer; false where the network has none.
    pub log_variance: bool,
}

/// State of the three pose heads.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Heads {
    /// On fc1 of RCNN1.
    pub relative: HeadState,
    /// On fc2 of RCNN2.
    pub global: HeadState,
    /// On fc3 of FCFL.
    pub fused: HeadState,
}

impl Heads {
    /// Every head that a network of this configuration has.
    pub fn all_of(config: &NetworkConfig) -> Self {
        let head = |exists| HeadState { pose: exists, log_variance: exists && config.log_variance };
        Self {
            relative: head(config.branches.relative),
            global: head(config.branches.global),
            fused: head(config.branches.fusion),
        }
    }

    /// The pose heads of `self`, no log-variance.
    #[must_use]
    pub fn without_log_variance(self) -> Self {
        let pose_only = |head: HeadState| HeadState { log_variance: false, ..head };
        Self {
            relative: pose_only(self.relative),
            global: pose_only(self.global),
            fused: pose_only(self.fused),
        }
    }

    /// The heads whose layers a file of that kind holds; the others are off.
    #[must_use]
    pub fn of_kind(self, kind: Kind) -> Self {
        let off = HeadState::default();
        match kind {
            Kind::Complete => self,
            Kind::Trunk => Self { global: off, fused: off, ..self },
            Kind::Scene => Self { relative: off, ..self },
        }
    }

    fn is_within(self, other: Self) -> bool {
        let within = |a: HeadState, b: HeadState| a.pose <= b.pose && a.log_variance <= b.log_variance;
        within(self.relative, other.relative)
            && within(self.global, other.global)
            && within(self.fused, other.fused)
    }
}

/// Lens distortion in the parametrisations that calibration tools write.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum Distortion {
    /// An ideal pinhole.
    None,
    /// OpenCV / ROS `plumb_bob`: k1, k2, p1, p2, k3.
    PlumbBob([f64; 5]),
    /// Kannala-Brandt fisheye, OpenCV `fisheye`, ROS `equidistant`: k1, k2, k3, k4.
    Equidistant([f64; 4]),
}

/// Intrinsics of the camera that took the training images; pixel centres at integer coordinates.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CameraIntrinsics {
    /// Image width in pixels.
    pub width_px: u32,
    /// Image height in pixels.
    pub height_px: u32,
    /// Focal length along x in pixels.
    pub fx_px: f64,
    /// Focal length along y in pixels.
    pub fy_px: f64,
    /// Principal point, x in pixels.
    pub cx_px: f64,
    /// Principal point, y in pixels.
    pub cy_px: f64,
    /// Lens distortion.
    pub distortion: Distortion,
}

/// The place that a scene was trained in.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SceneInfo {
    /// Stable identifier.
    pub id: String,
    /// Name for people.
    pub name: String,
}

/// A rigid transform as plain numbers.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RigidTransform {
    /// Translation in metres.
    pub translation_m: [f64; 3],
    /// Unit quaternion (x, y, z, w).
    pub rotation_xyzw: [f64; 4],
}

/// Where the weights come from.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "state", rename_all = "snake_case", deny_unknown_fields)]
pub enum Provenance {
    /// Drawn, never trained: poses mean nothing.
    Untrained {
        /// Seed of the generator.
        seed: u64,
        /// Name and version of the generator.
        generator: String,
    },
    /// Trained; whatever the trainer wants to record.
    Trained(BTreeMap<String, serde_json::Value>),
}

/// Everything that a checkpoint says about its weights.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CheckpointMetadata {
    /// [`SCHEMA`].
    pub schema: u32,
    /// Which part of the network the file holds.
    pub kind: Kind,
    /// The network that the tensors belong to; for a scene, the complete network that it makes with its trunk.
    pub network: NetworkConfig,
    /// How images are brought to the network's input.
    pub preprocessing: Preprocessing,
    /// Intrinsics of the training camera.
    #[serde(default)]
    pub camera: Option<CameraIntrinsics>,
    /// The place that the global branch knows.
    #[serde(default)]
    pub scene: Option<SceneInfo>,
    /// From the training's world frame to the map frame of the place.
    #[serde(default)]
    pub map_from_world: Option<RigidTransform>,
    /// Which heads are trained.
    pub heads: Heads,
    /// Added to the log-variances of RCNN1's motion in this place [translation, rotation], where the scene was made for a trunk that
    /// was trained elsewhere: the natural logarithm of how much larger its squared errors are here than the trunk says.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub motion_log_variance_shift: Option<[f64; 6]>,
    /// Where the weights come from.
    pub provenance: Provenance,
    /// SHA-256 over the tensors in hexadecimal; see [`crate::Checkpoint::content_hash`].
    pub content_hash: String,
    /// Content hash of the trunk that a scene belongs to; scenes have it, no other kind does.
    #[serde(default)]
    pub trunk_hash: Option<String>,
}

impl CheckpointMetadata {
    /// Metadata of a complete checkpoint without camera, scene or map; the hash is filled in by
    /// [`crate::Checkpoint::new`].
    pub fn complete(
        network: NetworkConfig,
        preprocessing: Preprocessing,
        heads: Heads,
        provenance: Provenance,
    ) -> Self {
        Self {
            schema: SCHEMA,
            kind: Kind::Complete,
            network,
            preprocessing,
            camera: None,
            scene: None,
            map_from_world: None,
            heads,
            motion_log_variance_shift: None,
            provenance,
            content_hash: String::new(),
            trunk_hash: None,
        }
    }

    /// Whether the weights were trained.
    pub fn is_trained(&self) -> bool {
        matches!(self.provenance, Provenance::Trained(_))
    }

    /// What contradicts itself or is out of range, if anything.
    pub(crate) fn problem(&self) -> Option<String> {
        if let Err(error) = self.network.validate() {
            return Some(error.to_string());
        }
        if let Some(problem) = self.preprocessing.problem() {
            return Some(problem);
        }
        if (self.kind == Kind::Scene) != self.trunk_hash.is_some() {
            let found = if self.trunk_hash.is_some() { "has" } else { "has no" };
            return Some(format!(
                "a {} file {found} trunk_hash; scenes must have one, other kinds must not",
                self.kind
            ));
        }
        if self.kind == Kind::Scene && !self.network.branches.global {
            return Some("a scene file whose network has no global branch".into());
        }
        let allowed = Heads::all_of(&self.network).of_kind(self.kind);
        if !self.heads.is_within(allowed) {
            return Some(format!("heads lists {:?}, but the file can hold only {allowed:?}", self.heads));
        }
        if let Some(shift) = &self.motion_log_variance_shift {
            let has_head = self.network.branches.relative && self.network.log_variance;
            if self.kind == Kind::Trunk || !has_head || !shift.iter().all(|v| v.abs() <= LARGEST_MOTION_SHIFT)
            {
                return Some(format!(
                    "motion_log_variance_shift {shift:?} in a {} file; numbers within {LARGEST_MOTION_SHIFT} of 0 expected, in a scene or \
                     complete file whose network has RCNN1 with log_variance",
                    self.kind
                ));
            }
        }
        if let Some(camera) = &self.camera {
            let focal = [camera.fx_px, camera.fy_px];
            let focal_is_good = focal.iter().all(|f| f.is_finite() && *f > 0.0);
            if camera.width_px == 0 || camera.height_px == 0 || !focal_is_good {
                return Some(format!("camera {camera:?}; positive sizes and focal lengths expected"));
            }
        }
        if let Some(transform) = &self.map_from_world {
            let norm = transform.rotation_xyzw.iter().map(|v| v * v).sum::<f64>().sqrt();
            let translation_is_finite = transform.translation_m.iter().all(|v| v.is_finite());
            let rotation_is_unit = (norm - 1.0).abs() <= 1e-6;
            if !translation_is_finite || !rotation_is_unit {
                return Some(format!(
                    "map_from_world {transform:?}; a finite translation and a unit quaternion expected"
                ));
            }
        }
        None
    }
}
