//! What serde reads: every key with its default, not yet checked. The one place of defaults.

use std::collections::BTreeMap;
use std::fmt;
use std::path::PathBuf;

use serde::de::value::MapAccessDeserializer;
use serde::de::{MapAccess, Visitor};
use serde::{Deserialize, Deserializer};

#[derive(Debug, Default, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub(crate) struct Raw {
    pub camera: RawCamera,
    pub source: RawSource,
    pub model: RawModel,
    pub frames: RawFrames,
    pub tracking: RawTracking,
    pub publish: RawPublish,
    pub record: RawRecord,
    pub realtime: crate::realtime::RawRealtime,
    pub log: RawLog,
}

#[derive(Debug, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub(crate) struct RawCamera {
    pub name: String,
}

impl Default for RawCamera {
    fn default() -> Self {
        Self { name: "front".into() }
    }
}

#[derive(Debug, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub(crate) struct RawSource {
    pub kind: RawKind,
    pub path: PathBuf,
    pub layout: RawLayout,
    pub sequence: Option<String>,
    pub dataset_camera: Option<String>,
    pub pace: RawPace,
    #[serde(rename = "loop")]
    pub looped: bool,
    pub first_frame: usize,
    pub frame_limit: Option<usize>,
    pub device: PathBuf,
    pub format: Option<RawPixelFormat>,
    pub size_px: Option<[u32; 2]>,
    pub controls: Option<BTreeMap<String, i64>>,
    pub accept_substitutes: bool,
    pub buffers: u32,
    pub stall_ms: u64,
    pub rate_hz: Option<f64>,
    pub time_offset_ms: f64,
    pub silence_ms: u64,
    pub calibration: Option<PathBuf>,
    pub calibration_camera: Option<String>,
    pub intrinsics: Option<RawIntrinsics>,
}

impl Default for RawSource {
    fn default() -> Self {
        Self {
            kind: RawKind::Folder,
            path: "/var/lib/grnet/recording".into(),
            layout: RawLayout::Auto,
            sequence: None,
            dataset_camera: None,
            pace: RawPace::Realtime,
            looped: false,
            first_frame: 0,
            frame_limit: None,
            device: "/dev/video0".into(),
            format: None,
            size_px: None,
            controls: None,
            accept_substitutes: false,
            buffers: 4,
            stall_ms: 2000,
            rate_hz: None,
            time_offset_ms: 0.0,
            silence_ms: 500,
            calibration: None,
            calibration_camera: None,
            intrinsics: None,
        }
    }
}

#[derive(Debug, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum RawKind {
    Folder,
    V4l2,
    Video,
}

/// As V4L2 calls them.
#[derive(Debug, Deserialize)]
#[serde(rename_all = "UPPERCASE")]
pub(crate) enum RawPixelFormat {
    Yuyv,
    Nv12,
    Rgb24,
    Grey,
    Mjpg,
}

#[derive(Debug, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum RawLayout {
    Auto,
    #[serde(rename = "7scenes")]
    SevenScenes,
    Kitti,
    Images,
}

/// `"realtime"`, `"max"` or a number.
#[derive(Debug)]
pub(crate) enum RawPace {
    Realtime,
    Max,
    Factor(f64),
}

impl<'de> Deserialize<'de> for RawPace {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct PaceVisitor;
        impl Visitor<'_> for PaceVisitor {
            type Value = RawPace;
            fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str("\"realtime\", \"max\" or a number")
            }
            fn visit_str<E: serde::de::Error>(self, text: &str) -> Result<RawPace, E> {
                match text {
                    "realtime" => Ok(RawPace::Realtime),
                    "max" => Ok(RawPace::Max),
                    other => Err(E::invalid_value(serde::de::Unexpected::Str(other), &self)),
                }
            }
            fn visit_f64<E: serde::de::Error>(self, factor: f64) -> Result<RawPace, E> {
                Ok(RawPace::Factor(factor))
            }
            fn visit_i64<E: serde::de::Error>(self, factor: i64) -> Result<RawPace, E> {
                Ok(RawPace::Factor(factor as f64))
            }
        }
        deserializer.deserialize_any(PaceVisitor)
    }
}

#[derive(Debug, Default, PartialEq, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub(crate) struct RawIntrinsics {
    pub width_px: Option<u16>,
    pub height_px: Option<u16>,
    pub fx_px: Option<f64>,
    pub fy_px: Option<f64>,
    pub cx_px: Option<f64>,
    pub cy_px: Option<f64>,
    pub distortion: Option<RawDistortion>,
    pub coefficients: Option<Vec<f64>>,
}

impl RawIntrinsics {
    /// Whether the section is there without a key, as in the commented example.
    pub(crate) fn is_empty(&self) -> bool {
        *self == Self::default()
    }
}

#[derive(Debug, PartialEq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum RawDistortion {
    None,
    PlumbBob,
    Equidistant,
}

#[derive(Debug, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub(crate) struct RawModel {
    pub checkpoint: PathBuf,
    pub scene: Option<PathBuf>,
    pub intrinsics: RawIntrinsicsPolicy,
    pub intrinsics_tolerance: f64,
    pub least_coverage: f64,
    pub undistort: bool,
}

#[derive(Debug, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum RawIntrinsicsPolicy {
    Refuse,
    Convert,
}

impl Default for RawModel {
    fn default() -> Self {
        Self {
            checkpoint: "/var/lib/grnet/model.safetensors".into(),
            scene: None,
            intrinsics: RawIntrinsicsPolicy::Refuse,
            intrinsics_tolerance: 0.01,
            least_coverage: 0.5,
            undistort: true,
        }
    }
}

#[derive(Debug, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub(crate) struct RawFrames {
    pub base_from_camera: RawMounting,
    pub map_from_world: Option<RawTransform>,
}

impl Default for RawFrames {
    fn default() -> Self {
        Self { base_from_camera: RawMounting::OpticalToBody, map_from_world: None }
    }
}

/// A preset's name or a transform.
#[derive(Debug)]
pub(crate) enum RawMounting {
    OpticalToBody,
    Identity,
    Transform(RawTransform),
}

impl<'de> Deserialize<'de> for RawMounting {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct MountingVisitor;
        impl<'de> Visitor<'de> for MountingVisitor {
            type Value = RawMounting;
            fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str("a preset or a table")
            }
            fn visit_str<E: serde::de::Error>(self, text: &str) -> Result<RawMounting, E> {
                match text {
                    "optical_to_body" => Ok(RawMounting::OpticalToBody),
                    "identity" => Ok(RawMounting::Identity),
                    other => Err(E::invalid_value(serde::de::Unexpected::Str(other), &self)),
                }
            }
            fn visit_map<A: MapAccess<'de>>(self, map: A) -> Result<RawMounting, A::Error> {
                RawTransform::deserialize(MapAccessDeserializer::new(map)).map(RawMounting::Transform)
            }
        }
        deserializer.deserialize_any(MountingVisitor)
    }
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct RawTransform {
    pub translation_m: [f64; 3],
    pub quaternion_xyzw: [f64; 4],
}

#[derive(Debug, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub(crate) struct RawTracking {
    pub longest_gap_ms: u64,
    pub refused_before_restart: u32,
    pub initializing_frames: u32,
    pub gate: bool,
    pub rejections_allowed: u32,
    pub after_rejections: RawAfterRejections,
    pub agreements_to_recover: u32,
    pub map_smoothing_ms: u64,
}

#[derive(Debug, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum RawAfterRejections {
    Reinitialise,
    Lost,
}

impl Default for RawTracking {
    fn default() -> Self {
        Self {
            longest_gap_ms: 1000,
            refused_before_restart: 30,
            initializing_frames: 1,
            gate: true,
            rejections_allowed: 10,
            after_rejections: RawAfterRejections::Reinitialise,
            agreements_to_recover: 3,
            map_smoothing_ms: 0,
        }
    }
}

#[derive(Debug, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub(crate) struct RawPublish {
    pub access: RawAccess,
    pub group: Option<String>,
    pub control_group: Option<String>,
    pub root: Option<PathBuf>,
    pub prefix: Option<String>,
    pub creation_timeout_ms: u64,
    pub status_rate_hz: f64,
    pub wait_for_subscribers: usize,
}

impl Default for RawPublish {
    fn default() -> Self {
        Self {
            access: RawAccess::User,
            group: None,
            control_group: None,
            root: None,
            prefix: None,
            creation_timeout_ms: 20,
            status_rate_hz: 2.0,
            wait_for_subscribers: 0,
        }
    }
}

#[derive(Debug, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum RawAccess {
    User,
    Group,
    Everyone,
}

#[derive(Debug, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub(crate) struct RawRecord {
    pub folder: PathBuf,
    pub format: RawImageFormat,
    pub jpeg_quality: u8,
    pub queue_frames: usize,
    pub least_free_mib: u64,
}

impl Default for RawRecord {
    fn default() -> Self {
        Self {
            folder: "/var/lib/grnet/recordings".into(),
            format: RawImageFormat::Png,
            jpeg_quality: 95,
            queue_frames: 32,
            least_free_mib: 512,
        }
    }
}

#[derive(Debug, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum RawImageFormat {
    Png,
    Jpeg,
}

#[derive(Debug, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub(crate) struct RawLog {
    pub level: String,
    pub format: RawLogFormat,
}

impl Default for RawLog {
    fn default() -> Self {
        Self { level: "info".into(), format: RawLogFormat::Auto }
    }
}

#[derive(Debug, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum RawLogFormat {
    Auto,
    Human,
    Journald,
    Json,
}
