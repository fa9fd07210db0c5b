//! What a pipeline is made of, and the checkpoint's metadata in the types of the pipeline.

use grnet_frame::{Camera, Distortion};
use grnet_geometry::{Pose, quaternion};
use grnet_model::metadata::Distortion as TrainedDistortion;
use grnet_model::{CameraIntrinsics, Heads, LoadedModel, RigidTransform, SceneInfo};
use nalgebra::{Isometry3, Translation3, Vector3};

use crate::fuse::ModelTraits;
use crate::preprocess::{InputSpec, Intrinsics};
use crate::{PipelineError, PipelineOptions};

/// What a pipeline is made of and what is known about its camera.
#[derive(Debug, Clone, PartialEq)]
pub struct PipelineInfo {
    /// SHA-256 over the weights in use.
    pub model_hash: [u8; 32],
    /// Whether the weights were trained.
    pub is_trained: bool,
    /// The place that the model knows; `None` without a scene, and for a scene without a name.
    pub scene: Option<SceneInfo>,
    /// Which heads give numbers.
    pub heads: Heads,
    /// Width and height of the network's input in pixels.
    pub input_px: (u32, u32),
    /// What is known about the intrinsics of the frames seen last.
    pub intrinsics: Intrinsics,
    /// Counts every jump of the odometry frame.
    pub reset_epoch: u32,
    /// Where the camera sits on the body.
    pub base_from_camera: Pose,
    /// From the training's world frame to the map.
    pub map_from_world: Pose,
    /// What an operator should know: one sentence each.
    pub notes: Vec<String>,
}

impl PipelineInfo {
    pub(crate) fn new(
        model: &LoadedModel,
        options: &PipelineOptions,
        intrinsics: Intrinsics,
        reset_epoch: u32,
    ) -> Self {
        let heads = model.network.live_heads();
        let config = model.network.config();
        Self {
            model_hash: model.model_hash,
            is_trained: model.trained,
            scene: model.metadata.scene.clone(),
            heads,
            input_px: (config.input_width_px as u32, config.input_height_px as u32),
            intrinsics,
            reset_epoch,
            base_from_camera: options.base_from_camera,
            // Checked when the model was put in place.
            map_from_world: map_from_world(model, options).unwrap_or_else(|_| Pose::identity()),
            notes: notes(model, heads, intrinsics, options.map_smoothing_s),
        }
    }
}

fn notes(model: &LoadedModel, heads: Heads, intrinsics: Intrinsics, map_smoothing_s: f64) -> Vec<String> {
    let mut notes = Vec::new();
    let mut note = |condition: bool, text: &str| {
        if condition {
            notes.push(text.to_owned());
        }
    };
    note(!model.trained, "the model is not trained: its poses mean nothing");
    note(!heads.global.pose && !heads.fused.pose, "no scene: map_from_base is not known");
    note(!heads.relative.pose, "no relative head: odom_from_base is not known");
    let motion = heads.relative.log_variance;
    let place = if heads.fused.pose { heads.fused.log_variance } else { heads.global.log_variance };
    note(
        heads.relative.pose && !motion,
        "the covariance of the motion is not known: its head is not trained",
    );
    let has_place = heads.fused.pose || heads.global.pose;
    note(has_place && !place, "the covariance of the map pose is not known: its head is not trained");
    note(
        map_smoothing_s > 0.0 && has_place && !(heads.relative.pose && (motion || !place)),
        "map poses are not smoothed: that needs a relative head, with a covariance where the map pose has one",
    );
    note(
        has_place && !(motion && place),
        "global poses are not checked against the motion: covariances are missing",
    );
    match intrinsics {
        Intrinsics::NotSeen | Intrinsics::Matching { .. } => {}
        Intrinsics::UnknownForFrame => {
            note(true, "the camera's intrinsics are not known and were not compared with the training's");
        }
        Intrinsics::UnknownForModel => {
            note(true, "the checkpoint names no intrinsics: the camera was not compared with the training's");
        }
        Intrinsics::Unknown => {
            note(
                true,
                "neither the camera's nor the training's intrinsics are known: they were not compared",
            );
        }
        Intrinsics::Converted { covered } => notes.push(format!(
            "frames are converted to the training's intrinsics and fill {:.0} % of the input",
            covered * 100.0
        )),
    }
    notes
}

/// What the network expects of its input.
pub(crate) fn input_spec(model: &LoadedModel) -> Result<InputSpec, PipelineError> {
    let config = model.network.config();
    Ok(InputSpec {
        size_px: (config.input_width_px as u32, config.input_height_px as u32),
        preprocessing: model.metadata.preprocessing.clone(),
        trained_camera: model.metadata.camera.as_ref().map(camera).transpose()?,
    })
}

/// What of the model matters to the fusion.
pub(crate) fn model_traits(
    model: &LoadedModel,
    options: &PipelineOptions,
) -> Result<ModelTraits, PipelineError> {
    let heads = model.network.live_heads();
    let traits = ModelTraits {
        is_trained: model.trained,
        has_odometry: heads.relative.pose,
        has_scene: heads.global.pose || heads.fused.pose,
        keyframe_interval_s: f64::from(model.network.config().keyframe_interval_ms) * 1e-3,
        map_from_world: map_from_world(model, options)?,
    };
    if traits.has_odometry || traits.has_scene { Ok(traits) } else { Err(PipelineError::NoLiveHead) }
}

fn map_from_world(model: &LoadedModel, options: &PipelineOptions) -> Result<Pose, PipelineError> {
    match (options.map_from_world, &model.metadata.map_from_world) {
        (Some(configured), _) => Ok(configured),
        (None, Some(stored)) => transform(stored),
        (None, None) => Ok(Pose::identity()),
    }
}

fn transform(stored: &RigidTransform) -> Result<Pose, PipelineError> {
    let rotation = quaternion::from_xyzw(stored.rotation_xyzw)
        .map_err(|error| PipelineError::Checkpoint { what: "map_from_world", reason: error.to_string() })?;
    Ok(Isometry3::from_parts(Translation3::from(Vector3::from(stored.translation_m)), rotation))
}

fn camera(stored: &CameraIntrinsics) -> Result<Camera, PipelineError> {
    let distortion = match stored.distortion {
        TrainedDistortion::None => Distortion::None,
        TrainedDistortion::PlumbBob(k) => Distortion::PlumbBob(k),
        TrainedDistortion::Equidistant(k) => Distortion::Equidistant(k),
    };
    Camera::new(
        (stored.width_px, stored.height_px),
        (stored.fx_px, stored.fy_px),
        (stored.cx_px, stored.cy_px),
        distortion,
    )
    .map_err(|error| PipelineError::Checkpoint { what: "camera", reason: error.to_string() })
}
