//! Typed configuration of `grnetd`.
//!
//! A TOML file and `--set section.key=value` overrides go through one parser: text, then a table in which
//! every key is known ([`KEYS`]), then a serde struct with every default, then [`GrnetdConfig`], whose
//! values cannot be wrong. What is refused is refused by file, line, key and what is allowed.
//!
//! ```
//! use grnet_config::{GrnetdConfig, Pace};
//! let config = GrnetdConfig::parse("[source]\npace = 'max'", "example.toml".as_ref(), &[])?;
//! let grnet_config::SourceConfig { pace, .. } = config.source;
//! assert_eq!(pace, Pace::Max);
//! # Ok::<(), grnet_config::ConfigError>(())
//! ```
#![forbid(unsafe_code)]
#![deny(missing_docs)]

mod convert;
mod error;
mod keys;
mod layers;
mod raw;
mod realtime;
mod settings;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::Duration;

pub use error::{ConfigError, Origin};
pub use keys::{KEYS, Key};
pub use layers::Override;
use nalgebra::Isometry3;
pub use realtime::RealtimeConfig;
pub use settings::{EXAMPLE, Settings};

/// A rigid transform: the same type as `grnet_geometry::Pose`.
pub type Pose = Isometry3<f64>;

/// Everything that `grnetd` can be told. The default is what the packaged `grnetd.toml` says.
#[derive(Debug, Clone, PartialEq)]
pub struct GrnetdConfig {
    /// `camera.name`: the middle part of the service names `grnet/<camera>/pose`, ...
    pub camera_name: String,
    /// `[source]`: where frames come from.
    pub source: SourceConfig,
    /// `[model]`: which weights.
    pub model: ModelConfig,
    /// `[frames]`: constant transforms between coordinate frames.
    pub frames: FramesConfig,
    /// `[tracking]`: when an estimate is not believed.
    pub tracking: TrackingConfig,
    /// `[publish]`: how poses leave the daemon.
    pub publish: PublishConfig,
    /// `[record]`: how frames are written to disk.
    pub record: RecordConfig,
    /// `[realtime]`: what is asked of the scheduler.
    pub realtime: RealtimeConfig,
    /// `[log]`: what is written to stderr.
    pub log: LogConfig,
}

/// `[source]`.
#[derive(Debug, Clone, PartialEq)]
pub struct SourceConfig {
    /// What kind of source it is.
    pub kind: SourceKind,
    /// Folder of the recording, or video file.
    pub path: PathBuf,
    /// How the folder is laid out.
    pub layout: Layout,
    /// Which sequence of a dataset with several.
    pub sequence: Option<String>,
    /// Which camera of a dataset with several.
    pub dataset_camera: Option<String>,
    /// How fast a recording is played.
    pub pace: Pace,
    /// Whether a recording starts again at its end.
    pub looped: bool,
    /// Index of the first frame to be played.
    pub first_frame: usize,
    /// Number of frames to be played in each round.
    pub frame_limit: Option<usize>,
    /// The camera.
    pub v4l2: V4l2Config,
    /// Regular times at this rate instead of the recorded or assumed ones; the rate that a camera is asked for.
    pub rate_hz: Option<f64>,
    /// Added to every time of capture: the middle of the exposure and the transport delay.
    pub time_offset_ns: i64,
    /// How long a live source may be silent before it counts as lost.
    pub silence: Duration,
    /// A calibration file with the intrinsics that replace those of the recording; never beside `camera`.
    pub calibration: Option<PathBuf>,
    /// Which camera of a calibration file with several.
    pub calibration_camera: Option<String>,
    /// Intrinsics that replace those of the recording.
    pub camera: Option<grnet_frame::Camera>,
}

/// `source.kind`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SourceKind {
    /// A folder of images or a dataset.
    Folder,
    /// A V4L2 camera.
    V4l2,
    /// A video file.
    Video,
}

/// The keys of `[source]` that hold for `kind = "v4l2"`. Whatever is `None` is left as the driver has it.
#[derive(Debug, Clone, PartialEq)]
pub struct V4l2Config {
    /// Device node, or a stable link to it.
    pub device: PathBuf,
    /// Pixel format.
    pub format: Option<grnet_frame::PixelFormat>,
    /// Image size (width, height) in pixels.
    pub size_px: Option<(u32, u32)>,
    /// Camera controls by name.
    pub controls: BTreeMap<String, i64>,
    /// Whether what the driver puts in place of a format, size or rate is taken.
    pub accept_substitutes: bool,
    /// Buffers in the driver's queue.
    pub buffers: u32,
    /// No frame for so long: the stream is opened anew.
    pub stall: Duration,
}

/// `source.layout`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Layout {
    /// Found out from the files that are there.
    Auto,
    /// Microsoft 7-Scenes.
    SevenScenes,
    /// KITTI odometry.
    Kitti,
    /// A plain folder of images.
    Images,
}

/// `source.pace`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Pace {
    /// As recorded; late frames are dropped, as with a camera.
    Realtime,
    /// Faster or slower than recorded by this factor; late frames are dropped.
    Factor(f64),
    /// As fast as the network goes; no frame is dropped.
    Max,
}

/// `[model]`.
#[derive(Debug, Clone, PartialEq)]
pub struct ModelConfig {
    /// A complete checkpoint, or a trunk when `scene` is given.
    pub checkpoint: PathBuf,
    /// Weights of one scene that belong to the trunk.
    pub scene: Option<PathBuf>,
    /// What to do when the camera's intrinsics differ from those of the training.
    pub intrinsics: IntrinsicsPolicy,
    /// Displacement of an image corner that counts as equal, as a share of the input's width.
    pub intrinsics_tolerance: f64,
    /// Share of the network's input that a converted frame has to fill.
    pub least_coverage: f64,
    /// Whether frames with known distortion are undistorted.
    pub undistort: bool,
}

/// `model.intrinsics`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum IntrinsicsPolicy {
    /// The camera is refused.
    Refuse,
    /// Frames are cropped and resized to the intrinsics of the training.
    Convert,
}

/// `[frames]`.
#[derive(Debug, Clone, PartialEq)]
pub struct FramesConfig {
    /// Where the camera (x right, y down, z forward) sits on the robot (x forward, y left, z up).
    pub base_from_camera: Pose,
    /// Replaces the `map_from_world` of the scene's checkpoint.
    pub map_from_world: Option<Pose>,
}

/// `[tracking]`.
#[derive(Debug, Clone, PartialEq)]
pub struct TrackingConfig {
    /// Longest time between two frames over which a relative motion is believed.
    pub longest_gap: Duration,
    /// Frames in a row with growing times, all before the last accepted one, after which the clock is taken to
    /// have been set back; `None`: never.
    pub refused_before_restart: Option<u32>,
    /// Samples that are marked INITIALIZING after a start or a restart.
    pub initializing_frames: u32,
    /// When a global pose is not believed; `None`: every one is.
    pub gate: Option<GateConfig>,
    /// Time constant of the mean that the map pose is of accepted global poses; zero: each is published as it is.
    pub map_smoothing: Duration,
}

/// The keys of `[tracking]` that hold while `gate` is on.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct GateConfig {
    /// Rejections in a row that are ridden out on odometry.
    pub rejections_allowed: u32,
    /// What follows when there are more.
    pub after_rejections: AfterRejections,
    /// Global poses that have to agree before LOST ends.
    pub agreements_to_recover: u32,
}

/// `tracking.after_rejections`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum AfterRejections {
    /// The map pose jumps to the network's and says so.
    Reinitialise,
    /// The map pose is LOST until global poses agree again.
    Lost,
}

/// `[publish]`.
#[derive(Debug, Clone, PartialEq)]
pub struct PublishConfig {
    /// Who may subscribe.
    pub access: Access,
    /// Whose members may subscribe, by name or number; the daemon's own group when `None`. With [`Access::Group`] alone.
    pub group: Option<String>,
    /// Whose members may ask for changes of the daemon's state; whoever may subscribe when `None`. With
    /// [`Access::Group`] alone.
    pub control_group: Option<String>,
    /// Folder of the stream's files instead of the one that follows from the access.
    pub root: Option<PathBuf>,
    /// Prefix of the iceoryx2 file names instead of iceoryx2's own.
    pub prefix: Option<String>,
    /// The longest that a client which is just attaching may hold up a publication.
    pub creation_timeout: Duration,
    /// Publications of `DaemonStatus`, and of an invalid sample while no pose is known, per second.
    pub status_rate_hz: f64,
    /// Frames are not read before this many pose subscribers are attached.
    pub wait_for_subscribers: usize,
}

impl PublishConfig {
    /// Time between two heartbeats.
    pub fn heartbeat(&self) -> Duration {
        Duration::from_secs_f64(1.0 / self.status_rate_hz)
    }
}

/// `publish.access`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Access {
    /// Processes of the same Unix user.
    User,
    /// Members of a group, and root.
    Group,
    /// Every local user.
    Everyone,
}

/// `[record]`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RecordConfig {
    /// Where a recording that is asked for without a folder gets one of its own.
    pub folder: PathBuf,
    /// Format of images that do not come as JPEG.
    pub format: ImageFormat,
    /// Frames that may wait for the disk.
    pub queue_frames: usize,
    /// A recording ends before the file system has fewer free bytes than this.
    pub least_free_bytes: u64,
}

/// `record.format`, with `record.jpeg_quality`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ImageFormat {
    /// Without loss.
    Png,
    /// Small.
    Jpeg {
        /// 1 to 100.
        quality: u8,
    },
}

/// `[log]`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LogConfig {
    /// A level, or a list of `target=level` directives.
    pub level: String,
    /// How lines look.
    pub format: LogFormat,
}

/// `log.format`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LogFormat {
    /// `Journald` when the journal reads stderr, else `Human`.
    Auto,
    /// With the time of day, coloured on a terminal.
    Human,
    /// Without the time, with the priority prefix that the journal understands.
    Journald,
    /// One JSON object a line.
    Json,
}

impl GrnetdConfig {
    /// Reads the file at `path`, applies `overrides` in order and checks everything.
    ///
    /// Relative paths in the file are relative to the file's folder; in an override to the working directory.
    ///
    /// # Errors
    /// See [`ConfigError`]: the file cannot be read, is not TOML, or has an unknown key or a wrong value.
    pub fn load(path: &Path, overrides: &[Override]) -> Result<Self, ConfigError> {
        let text = std::fs::read_to_string(path)
            .map_err(|source| ConfigError::Read { path: path.to_owned(), source })?;
        Self::parse(&text, path, overrides)
    }

    /// As [`GrnetdConfig::load`], with the value of every key for a later comparison.
    ///
    /// # Errors
    /// See [`ConfigError`].
    pub fn load_with_settings(path: &Path, overrides: &[Override]) -> Result<(Self, Settings), ConfigError> {
        let text = std::fs::read_to_string(path)
            .map_err(|source| ConfigError::Read { path: path.to_owned(), source })?;
        Ok((Self::parse(&text, path, overrides)?, Settings::parse(&text, path, overrides)?))
    }

    /// As [`GrnetdConfig::load`], for a text that stands in the file `path`.
    ///
    /// # Errors
    /// See [`ConfigError`].
    pub fn parse(text: &str, path: &Path, overrides: &[Override]) -> Result<Self, ConfigError> {
        layers::Layers::new(text, path, overrides)?.config()
    }
}

impl Default for GrnetdConfig {
    fn default() -> Self {
        convert::config(raw::Raw::default()).expect("a unit test holds that the defaults are valid")
    }
}
