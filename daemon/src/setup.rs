//! From the configuration to the parts that run. Everything that a configuration can get wrong fails here.

use std::path::Path;

use anyhow::Context as _;
use grnet_capture::dataset::{self, OpenOptions, calibration};
use grnet_capture::{FolderOptions, FolderSource, V4l2Options, V4l2Source, VideoOptions, VideoSource};
use grnet_config as config;
use grnet_config::{GrnetdConfig, Override, Settings};
use grnet_frame::{FrameSource, SourceError};
use grnet_pipeline::{
    AfterRejections, InnovationGate, IntrinsicsOptions, IntrinsicsPolicy, Pipeline, PipelineOptions,
    TimeOptions,
};
use grnet_proto::{AccessMode, CameraName, Group, Root, qos};

use crate::failure::Failure;
use crate::scenes::{ModelIdentity, Prepared};

/// Everything that the threads need, checked.
#[derive(Debug)]
pub struct Parts {
    /// The name under which poses are published.
    pub camera: CameraName,
    /// Who may subscribe, and where.
    pub transport: Transport,
    /// Where frames come from.
    pub source: Box<dyn FrameSource>,
    /// What a user should know about the source.
    pub source_notes: Vec<String>,
    /// Frame to estimate.
    pub pipeline: Pipeline,
    /// The weights in it.
    pub model: ModelIdentity,
}

/// Who may subscribe, and where the transport keeps its files. Ports are opened by the threads that use them.
#[derive(Debug, Clone)]
pub struct Transport {
    /// Who may subscribe.
    pub access: AccessMode,
    /// The folder and prefix.
    pub root: Root,
}

impl Parts {
    /// Checks the configuration to the end: transport, source, weights, intrinsics.
    ///
    /// # Errors
    /// The first thing that cannot be used.
    pub fn prepare(config: &GrnetdConfig) -> Result<Self, Failure> {
        let camera = camera(config)?;
        let transport = Transport::new(&config.publish)?;
        let (source, source_notes) = open_source(&config.source)?;
        let (pipeline, model) = load_pipeline(config)?;
        if let Some(camera) = source.info().camera
            && config.source.camera.is_none()
        {
            pipeline.check_camera(&camera).map_err(Failure::config)?;
        }
        Ok(Self { camera, transport, source, source_notes, pipeline, model })
    }
}

impl Transport {
    fn new(publish: &config::PublishConfig) -> Result<Self, Failure> {
        let access = match publish.access {
            config::Access::User => AccessMode::User,
            config::Access::Group => AccessMode::Group,
            config::Access::Everyone => AccessMode::Everyone,
        };
        access.check_built()?;
        let root = Root::for_daemon(access, publish.root.as_deref(), publish.prefix.as_deref())?;
        root.require_space(access, qos::shared_memory_needed_bytes())?;
        let group = |key: &'static str, name: &Option<String>| {
            let group = name.as_deref().map(str::parse::<Group>).transpose();
            group.context(key).map_err(Failure::config)
        };
        let root = root.with_groups(
            group("publish.group", &publish.group)?,
            group("publish.control_group", &publish.control_group)?,
        );
        Ok(Self { access, root: root.with_creation_timeout(publish.creation_timeout) })
    }
}

fn camera(config: &GrnetdConfig) -> Result<CameraName, Failure> {
    config.camera_name.parse().map_err(Failure::config)
}

fn load_pipeline(config: &GrnetdConfig) -> Result<(Pipeline, ModelIdentity), Failure> {
    let config::ModelConfig { checkpoint, scene, .. } = &config.model;
    let Prepared { model, identity } = Prepared::load(checkpoint, scene.as_deref())
        .context("the model cannot be loaded (model.checkpoint, model.scene)")
        .map_err(Failure::config)?;
    let pipeline = Pipeline::new(model, pipeline_options(config))
        .context("the pipeline cannot be built")
        .map_err(Failure::config)?;
    Ok((pipeline, identity))
}

/// The options of the pipeline.
pub fn pipeline_options(config: &GrnetdConfig) -> PipelineOptions {
    let config::ModelConfig { intrinsics, intrinsics_tolerance, least_coverage, undistort, .. } =
        config.model;
    let tracking = &config.tracking;
    PipelineOptions {
        base_from_camera: config.frames.base_from_camera,
        map_from_world: config.frames.map_from_world,
        camera: config.source.camera,
        intrinsics: IntrinsicsOptions {
            policy: match intrinsics {
                config::IntrinsicsPolicy::Refuse => IntrinsicsPolicy::Refuse,
                config::IntrinsicsPolicy::Convert => IntrinsicsPolicy::Convert,
            },
            tolerance: intrinsics_tolerance,
            least_coverage,
            undistort,
        },
        time: TimeOptions {
            longest_gap_ns: tracking.longest_gap.as_nanos() as u64,
            refused_before_restart: tracking.refused_before_restart,
        },
        gate: tracking.gate.map(|gate| InnovationGate {
            rejections_allowed: gate.rejections_allowed,
            then: match gate.after_rejections {
                config::AfterRejections::Reinitialise => AfterRejections::Reinitialise,
                config::AfterRejections::Lost => AfterRejections::Lost,
            },
            agreements_to_recover: gate.agreements_to_recover,
        }),
        map_smoothing_s: tracking.map_smoothing.as_secs_f64(),
        initializing_frames: tracking.initializing_frames,
    }
}

fn open_source(source: &config::SourceConfig) -> Result<(Box<dyn FrameSource>, Vec<String>), Failure> {
    match source.kind {
        config::SourceKind::Folder => open_folder(source),
        config::SourceKind::V4l2 => open_camera(source),
        config::SourceKind::Video => open_video(source),
    }
}

/// What a configuration asks of a camera.
fn camera_options(source: &config::SourceConfig) -> V4l2Options {
    let config::V4l2Config { device, format, size_px, controls, accept_substitutes, buffers, stall } =
        source.v4l2.clone();
    V4l2Options {
        device,
        format,
        size_px,
        rate_hz: source.rate_hz,
        controls,
        accept_substitutes,
        buffers,
        stall_timeout: stall,
        camera: source.camera,
    }
}

/// A camera that cannot do what is asked fails here; one that is not there, or busy, is waited for.
fn open_camera(source: &config::SourceConfig) -> Result<(Box<dyn FrameSource>, Vec<String>), Failure> {
    let options = camera_options(source);
    let note = match V4l2Source::probe(&options) {
        Ok(agreed) => format!("the camera gives {agreed}"),
        Err(error @ SourceError::Lost { .. }) => format!("{error}; it is waited for"),
        Err(error) => return Err(Failure::config(error)),
    };
    Ok((Box::new(V4l2Source::new(options)), vec![note]))
}

fn open_folder(source: &config::SourceConfig) -> Result<(Box<dyn FrameSource>, Vec<String>), Failure> {
    let options = OpenOptions {
        layout: layout(source.layout),
        sequence: source.sequence.clone(),
        camera_name: source.dataset_camera.clone(),
        rate_hz: source.rate_hz,
        ..OpenOptions::default()
    };
    let recording = dataset::open_one(&source.path, &options)
        .context("the recording cannot be opened (source.path, source.layout, source.sequence)")
        .map_err(Failure::config)?;
    if let Some(stored_px) = recording.image_size_px {
        check_size(source, stored_px, &recording.name)?;
    }
    let notes = recording.notes.clone();
    let options = FolderOptions {
        pace: pace(source.pace),
        looped: source.looped,
        start_at: source.first_frame,
        limit: source.frame_limit,
    };
    let source = FolderSource::with_options(recording, options)
        .context("the recording cannot be played (source.first_frame, source.frame_limit, source.pace)")
        .map_err(Failure::config)?;
    Ok((Box::new(source), notes))
}

fn open_video(source: &config::SourceConfig) -> Result<(Box<dyn FrameSource>, Vec<String>), Failure> {
    let options = VideoOptions {
        pace: pace(source.pace),
        looped: source.looped,
        start_at: source.first_frame as u64,
        limit: source.frame_limit.map(|limit| limit as u64),
        rate_hz: source.rate_hz,
        ..VideoOptions::default()
    };
    let video = VideoSource::open(&source.path, &options)
        .context("the video cannot be played (source.path, source.first_frame, source.frame_limit)")
        .map_err(Failure::config)?;
    check_size(source, video.size_px(), &source.path.display())?;
    let (width, height) = video.size_px();
    let mut notes = vec![format!("the video gives upright frames of {width}x{height}")];
    notes.extend(video.notes().iter().map(|note| format!("ffmpeg: {note}")));
    Ok((Box::new(video), notes))
}

/// Intrinsics hold for one image size: the stored one.
fn check_size(
    source: &config::SourceConfig,
    stored_px: (u32, u32),
    name: &dyn std::fmt::Display,
) -> Result<(), Failure> {
    let Some(camera) = source.camera.filter(|camera| camera.size_px() != stored_px) else { return Ok(()) };
    let ((width, height), (stored_width, stored_height)) = (camera.size_px(), stored_px);
    let origin = match &source.calibration {
        Some(file) => format!("the calibration {} is", file.display()),
        None => "source.intrinsics are".to_owned(),
    };
    Err(Failure::config(anyhow::anyhow!(
        "{origin} for {width}x{height} images, those of {name} are {stored_width}x{stored_height}: give the \
         intrinsics at that size"
    )))
}

fn pace(pace: config::Pace) -> grnet_capture::Pace {
    match pace {
        config::Pace::Realtime => grnet_capture::Pace::Realtime,
        config::Pace::Factor(factor) => grnet_capture::Pace::Factor(factor),
        config::Pace::Max => grnet_capture::Pace::Max,
    }
}

/// Reads the configuration, and puts the intrinsics of `source.calibration` where those of `[source.intrinsics]` would
/// be; beside it what in that file is not used.
///
/// # Errors
/// When one of the files cannot be read or used.
pub fn load_config(
    path: &Path,
    overrides: &[Override],
) -> Result<(GrnetdConfig, Settings, Vec<String>), Failure> {
    let (mut config, settings) =
        GrnetdConfig::load_with_settings(path, overrides).map_err(Failure::config)?;
    let source = &mut config.source;
    let Some(file) = &source.calibration else { return Ok((config, settings, Vec::new())) };
    let read = calibration::read(file, source.calibration_camera.as_deref())
        .context("the calibration cannot be used (source.calibration, source.calibration_camera)")
        .map_err(Failure::config)?;
    source.camera = Some(read.camera);
    Ok((config, settings, read.notes))
}

fn layout(layout: config::Layout) -> dataset::Layout {
    match layout {
        config::Layout::Auto => dataset::Layout::Auto,
        config::Layout::SevenScenes => dataset::Layout::SevenScenes,
        config::Layout::Kitti => dataset::Layout::Kitti,
        config::Layout::Images => dataset::Layout::Images,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_defaults_of_the_configuration_are_those_of_the_pipeline() {
        assert_eq!(pipeline_options(&GrnetdConfig::default()), PipelineOptions::default());
    }

    #[test]
    fn the_defaults_of_the_configuration_are_those_of_the_camera_source() {
        let source = GrnetdConfig::default().source;
        assert_eq!(camera_options(&source), V4l2Options::new(&source.v4l2.device));
    }

    #[test]
    fn an_absent_camera_is_waited_for_and_a_file_is_refused() {
        let mut source = GrnetdConfig::default().source;
        source.kind = config::SourceKind::V4l2;
        source.v4l2.device = "/dev/grnet-test-no-such-camera".into();
        let (_, notes) = open_source(&source).unwrap();
        assert!(notes[0].ends_with("it is waited for"), "{notes:?}");
        source.v4l2.device = "/dev/null".into();
        let failure = open_source(&source).unwrap_err();
        assert!(failure.chain().contains("no V4L2 device"), "{}", failure.chain());
    }

    #[test]
    fn the_default_camera_is_the_one_that_clients_ask_for() {
        assert_eq!(camera(&GrnetdConfig::default()).unwrap(), CameraName::default());
    }
}
