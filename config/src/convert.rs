//! From what serde read to values that cannot be wrong.

use std::path::{Path, PathBuf};
use std::time::Duration;

use grnet_frame::{Camera, Distortion, PixelFormat};
use nalgebra::{Quaternion, Translation3, UnitQuaternion};

use crate::raw::*;
use crate::*;

/// A value that its key does not allow.
#[derive(Debug)]
pub(crate) struct Invalid {
    pub key: &'static str,
    pub problem: String,
}

pub(crate) type Checked<T> = Result<T, Invalid>;

pub(crate) fn config(raw: Raw) -> Checked<GrnetdConfig> {
    Ok(GrnetdConfig {
        camera_name: camera_name(raw.camera.name)?,
        source: source(raw.source)?,
        model: model(raw.model)?,
        frames: FramesConfig {
            base_from_camera: match raw.frames.base_from_camera {
                RawMounting::OpticalToBody => optical_to_body(),
                RawMounting::Identity => Pose::identity(),
                RawMounting::Transform(raw) => transform("frames.base_from_camera", raw)?,
            },
            map_from_world: raw
                .frames
                .map_from_world
                .map(|raw| transform("frames.map_from_world", raw))
                .transpose()?,
        },
        tracking: tracking(raw.tracking)?,
        publish: publish(raw.publish)?,
        record: record(raw.record)?,
        realtime: crate::realtime::realtime(raw.realtime)?,
        log: log(raw.log)?,
    })
}

/// The rotation from optical axes (x right, y down, z forward) to body axes (x forward, y left, z up), REP-103.
fn optical_to_body() -> Pose {
    // Each of the three axes maps to another, so the rotation is by 120 degrees about a diagonal:
    // the quaternion's parts are exactly a half.
    let rotation = UnitQuaternion::new_unchecked(Quaternion::new(0.5, -0.5, 0.5, -0.5));
    Pose::from_parts(Translation3::identity(), rotation)
}

fn source(raw: RawSource) -> Checked<SourceConfig> {
    match raw.kind {
        RawKind::Folder => {}
        RawKind::V4l2 => no_recording(&raw)?,
        RawKind::Video => no_dataset(&raw)?,
    }
    let camera = raw.intrinsics.filter(|raw| !raw.is_empty()).map(intrinsics).transpose()?;
    if raw.calibration.is_some() && camera.is_some() {
        let problem = "[source.intrinsics] is there as well: give one of the two".into();
        return Err(Invalid { key: "source.calibration", problem });
    }
    if raw.calibration.is_none() && raw.calibration_camera.is_some() {
        let problem = "it chooses from source.calibration, and there is none".into();
        return Err(Invalid { key: "source.calibration_camera", problem });
    }
    Ok(SourceConfig {
        kind: match raw.kind {
            RawKind::Folder => SourceKind::Folder,
            RawKind::V4l2 => SourceKind::V4l2,
            RawKind::Video => SourceKind::Video,
        },
        v4l2: V4l2Config {
            device: path("source.device", raw.device)?,
            format: raw.format.map(|format| match format {
                RawPixelFormat::Yuyv => PixelFormat::Yuyv,
                RawPixelFormat::Nv12 => PixelFormat::Nv12,
                RawPixelFormat::Rgb24 => PixelFormat::Rgb8,
                RawPixelFormat::Grey => PixelFormat::Gray8,
                RawPixelFormat::Mjpg => PixelFormat::Jpeg,
            }),
            size_px: raw
                .size_px
                .map(|size| {
                    let [width, height] = size;
                    for side in size {
                        within("source.size_px", side, 1, 16_384)?;
                    }
                    Ok::<_, Invalid>((width, height))
                })
                .transpose()?,
            controls: raw.controls.unwrap_or_default(),
            accept_substitutes: raw.accept_substitutes,
            buffers: within("source.buffers", raw.buffers, 2, 32)?,
            stall: Duration::from_millis(within("source.stall_ms", raw.stall_ms, 100, 60_000)?),
        },
        path: path("source.path", raw.path)?,
        layout: match raw.layout {
            RawLayout::Auto => Layout::Auto,
            RawLayout::SevenScenes => Layout::SevenScenes,
            RawLayout::Kitti => Layout::Kitti,
            RawLayout::Images => Layout::Images,
        },
        sequence: raw.sequence.map(|name| not_empty("source.sequence", name)).transpose()?,
        dataset_camera: raw
            .dataset_camera
            .map(|name| not_empty("source.dataset_camera", name))
            .transpose()?,
        pace: match raw.pace {
            RawPace::Realtime => Pace::Realtime,
            RawPace::Max => Pace::Max,
            RawPace::Factor(factor) => {
                Pace::Factor(within("source.pace", factor, f64::MIN_POSITIVE, 1000.0)?)
            }
        },
        looped: raw.looped,
        first_frame: raw.first_frame,
        frame_limit: raw
            .frame_limit
            .map(|limit| within("source.frame_limit", limit, 1, usize::MAX))
            .transpose()?,
        rate_hz: raw
            .rate_hz
            .map(|rate| within("source.rate_hz", rate, f64::MIN_POSITIVE, 1000.0))
            .transpose()?,
        time_offset_ns: {
            let offset_ms = within("source.time_offset_ms", raw.time_offset_ms, -1000.0, 1000.0)?;
            (offset_ms * 1e6).round() as i64
        },
        silence: Duration::from_millis(within("source.silence_ms", raw.silence_ms, 50, 60_000)?),
        calibration: raw.calibration.map(|file| path("source.calibration", file)).transpose()?,
        calibration_camera: raw
            .calibration_camera
            .map(|name| not_empty("source.calibration_camera", name))
            .transpose()?,
        camera,
    })
}

/// Keys that say how a recording is played mean nothing to a camera: refused rather than ignored.
fn no_recording(raw: &RawSource) -> Checked<()> {
    let set = [
        ("source.sequence", raw.sequence.is_some()),
        ("source.dataset_camera", raw.dataset_camera.is_some()),
        ("source.pace", !matches!(raw.pace, RawPace::Realtime)),
        ("source.loop", raw.looped),
        ("source.first_frame", raw.first_frame != 0),
        ("source.frame_limit", raw.frame_limit.is_some()),
    ];
    refuse_set(&set, "it is for a recording, and source.kind is \"v4l2\"")
}

/// A video is one sequence of one camera.
fn no_dataset(raw: &RawSource) -> Checked<()> {
    let set = [
        ("source.layout", !matches!(raw.layout, RawLayout::Auto)),
        ("source.sequence", raw.sequence.is_some()),
        ("source.dataset_camera", raw.dataset_camera.is_some()),
    ];
    refuse_set(&set, "it is for a folder, and source.kind is \"video\"")
}

fn refuse_set(set: &[(&'static str, bool)], problem: &str) -> Checked<()> {
    match set.iter().find(|(_, is_set)| *is_set) {
        Some((key, _)) => Err(Invalid { key, problem: problem.into() }),
        None => Ok(()),
    }
}

fn intrinsics(raw: RawIntrinsics) -> Checked<Camera> {
    fn need<T>(key: &'static str, value: Option<T>) -> Checked<T> {
        value.ok_or_else(|| Invalid { key, problem: "[source.intrinsics] must be complete or absent".into() })
    }
    let at_least_one = |key, value: Option<u16>| within(key, need(key, value)?, 1, u16::MAX);
    let positive = |key, value| within(key, need(key, value)?, f64::MIN_POSITIVE, f64::MAX);
    let finite = |key, value| within(key, need(key, value)?, f64::MIN, f64::MAX);
    let coefficients = need("source.intrinsics.coefficients", raw.coefficients)?;
    let wrong_count = |model: &str, expected: usize| Invalid {
        key: "source.intrinsics.coefficients",
        problem: format!("{} given, {model} has {expected}", coefficients.len()),
    };
    let distortion = match need("source.intrinsics.distortion", raw.distortion)? {
        RawDistortion::None if coefficients.is_empty() => Distortion::None,
        RawDistortion::None => return Err(wrong_count("none", 0)),
        RawDistortion::PlumbBob => {
            Distortion::PlumbBob(coefficients.as_slice().try_into().map_err(|_| wrong_count("plumb_bob", 5))?)
        }
        RawDistortion::Equidistant => Distortion::Equidistant(
            coefficients.as_slice().try_into().map_err(|_| wrong_count("equidistant", 4))?,
        ),
    };
    Camera::new(
        (
            at_least_one("source.intrinsics.width_px", raw.width_px)?.into(),
            at_least_one("source.intrinsics.height_px", raw.height_px)?.into(),
        ),
        (positive("source.intrinsics.fx_px", raw.fx_px)?, positive("source.intrinsics.fy_px", raw.fy_px)?),
        (finite("source.intrinsics.cx_px", raw.cx_px)?, finite("source.intrinsics.cy_px", raw.cy_px)?),
        distortion,
    )
    .map_err(|error| Invalid { key: "source.intrinsics.coefficients", problem: error.to_string() })
}

fn model(raw: RawModel) -> Checked<ModelConfig> {
    Ok(ModelConfig {
        checkpoint: path("model.checkpoint", raw.checkpoint)?,
        scene: raw.scene.map(|scene| path("model.scene", scene)).transpose()?,
        intrinsics: match raw.intrinsics {
            RawIntrinsicsPolicy::Refuse => IntrinsicsPolicy::Refuse,
            RawIntrinsicsPolicy::Convert => IntrinsicsPolicy::Convert,
        },
        intrinsics_tolerance: within("model.intrinsics_tolerance", raw.intrinsics_tolerance, 0.0, 1.0)?,
        least_coverage: within("model.least_coverage", raw.least_coverage, 0.0, 1.0)?,
        undistort: raw.undistort,
    })
}

fn tracking(raw: RawTracking) -> Checked<TrackingConfig> {
    let gate = GateConfig {
        rejections_allowed: within("tracking.rejections_allowed", raw.rejections_allowed, 0, 100_000)?,
        after_rejections: match raw.after_rejections {
            RawAfterRejections::Reinitialise => AfterRejections::Reinitialise,
            RawAfterRejections::Lost => AfterRejections::Lost,
        },
        agreements_to_recover: within("tracking.agreements_to_recover", raw.agreements_to_recover, 1, 1000)?,
    };
    let refused = within("tracking.refused_before_restart", raw.refused_before_restart, 0, 100_000)?;
    Ok(TrackingConfig {
        longest_gap: Duration::from_millis(within(
            "tracking.longest_gap_ms",
            raw.longest_gap_ms,
            10,
            60_000,
        )?),
        refused_before_restart: (refused > 0).then_some(refused),
        initializing_frames: within("tracking.initializing_frames", raw.initializing_frames, 1, 1000)?,
        gate: raw.gate.then_some(gate),
        map_smoothing: Duration::from_millis(within(
            "tracking.map_smoothing_ms",
            raw.map_smoothing_ms,
            0,
            60_000,
        )?),
    })
}

fn publish(raw: RawPublish) -> Checked<PublishConfig> {
    let root = raw.root.map(|root| path("publish.root", root)).transpose()?;
    let refuse = |key, problem: &str| Err(Invalid { key, problem: problem.into() });
    if root.as_ref().is_some_and(|root| root.is_relative()) {
        return refuse("publish.root", "it is relative, and a client may run in another folder");
    }
    if let Some(prefix) = &raw.prefix {
        if root.is_none() {
            return refuse(
                "publish.prefix",
                "it needs publish.root: iceoryx2's own folder keeps its own prefix",
            );
        }
        let plain = prefix.chars().all(|c| c.is_ascii_alphanumeric() || c == '_');
        if !plain || !(1..=24).contains(&prefix.len()) {
            return refuse("publish.prefix", "it is no such name");
        }
    }
    for (key, name) in [("publish.group", &raw.group), ("publish.control_group", &raw.control_group)] {
        let Some(name) = name else { continue };
        if !matches!(raw.access, RawAccess::Group) {
            return refuse(key, "it needs publish.access = \"group\"");
        }
        let plain = name.chars().all(|c| c.is_ascii_alphanumeric() || matches!(c, '_' | '-' | '.'));
        if !plain || !(1..=32).contains(&name.len()) {
            return refuse(key, "it is no such name");
        }
    }
    let bytes = root.as_ref().map_or(0, |root| root.as_os_str().len());
    if bytes + raw.prefix.as_ref().map_or("iox2_".len(), String::len) > 60 {
        return refuse("publish.root", "socket names below it would become too long");
    }
    Ok(PublishConfig {
        access: match raw.access {
            RawAccess::User => Access::User,
            RawAccess::Group => Access::Group,
            RawAccess::Everyone => Access::Everyone,
        },
        group: raw.group,
        control_group: raw.control_group,
        root,
        prefix: raw.prefix,
        creation_timeout: Duration::from_millis(within(
            "publish.creation_timeout_ms",
            raw.creation_timeout_ms,
            1,
            1000,
        )?),
        status_rate_hz: within("publish.status_rate_hz", raw.status_rate_hz, 2.0, 50.0)?,
        wait_for_subscribers: within("publish.wait_for_subscribers", raw.wait_for_subscribers, 0, 16)?,
    })
}

fn record(raw: RawRecord) -> Checked<RecordConfig> {
    let quality = within("record.jpeg_quality", raw.jpeg_quality, 1, 100)?;
    Ok(RecordConfig {
        folder: path("record.folder", raw.folder)?,
        format: match raw.format {
            RawImageFormat::Png => ImageFormat::Png,
            RawImageFormat::Jpeg => ImageFormat::Jpeg { quality },
        },
        queue_frames: within("record.queue_frames", raw.queue_frames, 1, 1000)?,
        least_free_bytes: within("record.least_free_mib", raw.least_free_mib, 0, 1_000_000)? << 20,
    })
}

fn log(raw: RawLog) -> Checked<LogConfig> {
    const LEVELS: [&str; 6] = ["off", "error", "warn", "info", "debug", "trace"];
    let level = not_empty("log.level", raw.level)?;
    for directive in level.split(',') {
        let (target, level) = directive.split_once('=').unwrap_or(("grnet", directive));
        let plain =
            !target.is_empty() && target.chars().all(|c| c.is_ascii_alphanumeric() || matches!(c, '_' | ':'));
        if !plain || !LEVELS.contains(&level) {
            return Err(Invalid {
                key: "log.level",
                problem: format!("`{directive}` is neither a level nor `target=level`"),
            });
        }
    }
    Ok(LogConfig {
        level,
        format: match raw.format {
            RawLogFormat::Auto => LogFormat::Auto,
            RawLogFormat::Human => LogFormat::Human,
            RawLogFormat::Journald => LogFormat::Journald,
            RawLogFormat::Json => LogFormat::Json,
        },
    })
}

fn transform(key: &'static str, raw: RawTransform) -> Checked<Pose> {
    let RawTransform { translation_m: [x, y, z], quaternion_xyzw: [i, j, k, w] } = raw;
    let quaternion = Quaternion::new(w, i, j, k);
    let norm = quaternion.norm();
    // The tolerance takes what was rounded to three decimals and refuses a wrong order of numbers or a typo.
    if !(norm - 1.0).abs().le(&2e-3) {
        return Err(Invalid { key, problem: format!("the quaternion has length {norm}") });
    }
    if ![x, y, z].iter().all(|value| value.is_finite()) {
        return Err(Invalid { key, problem: "the translation is not finite".into() });
    }
    Ok(Pose::from_parts(Translation3::new(x, y, z), UnitQuaternion::from_quaternion(quaternion)))
}

pub(crate) fn within<T: PartialOrd>(key: &'static str, value: T, least: T, most: T) -> Checked<T> {
    if value >= least && value <= most {
        Ok(value)
    } else {
        Err(Invalid { key, problem: "out of range".into() })
    }
}

fn not_empty(key: &'static str, text: String) -> Checked<String> {
    if text.is_empty() { Err(Invalid { key, problem: "it is empty".into() }) } else { Ok(text) }
}

fn path(key: &'static str, path: PathBuf) -> Checked<PathBuf> {
    if path == Path::new("") { Err(Invalid { key, problem: "it is empty".into() }) } else { Ok(path) }
}

/// A name that becomes part of service names; the rule is that of `grnet_proto::CameraName`.
fn camera_name(name: String) -> Checked<String> {
    let key = "camera.name";
    let name = not_empty(key, name)?;
    if let Some(bad) = name.chars().find(|c| !(c.is_ascii_alphanumeric() || matches!(c, '_' | '-' | '.'))) {
        return Err(Invalid { key, problem: format!("`{bad}` cannot be part of it") });
    }
    if name.starts_with(['-', '.']) {
        return Err(Invalid { key, problem: "it starts with punctuation".into() });
    }
    if name.len() > 31 {
        return Err(Invalid { key, problem: format!("it has {} characters", name.len()) });
    }
    Ok(name)
}
