//! Which systems there are: the baselines by name, the outputs of a model.

use grnet_geometry::Covariance6;
use grnet_model::LoadedModel;
use grnet_model::metadata::{HeadState, Heads};
use grnet_pipeline::PoseEstimate;

use super::{Data, EvaluateError, Kind, Knowledge, ModelInfo, Played, System, play};
use crate::baselines::{self, Predictions, Progress};

/// The baselines that need no model, by name.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum BaselineName {
    /// The training pose nearest to the true one.
    NearestPose,
    /// Retrieval by 32x24 grey pixels.
    SmallImage,
    /// Retrieval by the features of each checkpoint's CNN1.
    Cnn1,
    /// Retrieval by VLAD of dense gradient descriptors.
    Vlad,
    /// Interpolation between training frames by frame number.
    Interpolation,
    /// Motion: none.
    ZeroMotion,
    /// Motion: that of the frames before, again.
    ConstantVelocity,
}

impl BaselineName {
    /// Whether it answers from training frames.
    pub fn needs_training(self) -> bool {
        !matches!(self, Self::ZeroMotion | Self::ConstantVelocity)
    }

    /// Whether it looks at every training and test image once.
    pub fn looks_at_images(self) -> bool {
        matches!(self, Self::SmallImage | Self::Cnn1 | Self::Vlad)
    }
}

/// Computes baselines; [`BaselineName::Cnn1`] belongs to a model and is left to [`add_model`].
///
/// # Errors
/// When a baseline has no training frames, or a training image cannot be read.
pub fn add_baselines(
    systems: &mut Vec<System>,
    data: &Data,
    names: &[BaselineName],
    gap: usize,
    progress: Progress<'_>,
) -> Result<(), EvaluateError> {
    let task = &data.task;
    for name in names {
        let mut add = |name: &str, knowledge, about: &str, poses: Option<Predictions>, motions| {
            systems.push(System { knowledge, poses, motions, ..System::new(name, Kind::Baseline, about) });
        };
        match name {
            BaselineName::NearestPose => add(
                "nearest training pose",
                Knowledge::Truth,
                "the training pose nearest to the true one (1 cm counts as 1 deg): no retrieval can do better",
                Some(baselines::nearest_pose::predict(task)?),
                None,
            ),
            BaselineName::SmallImage => add(
                "retrieval, small image",
                Knowledge::None,
                "pose of the training image most alike at 32x24 grey pixels",
                Some(baselines::small_image::predict(task, progress)?),
                None,
            ),
            BaselineName::Cnn1 => {}
            BaselineName::Vlad => add(
                "retrieval, VLAD",
                Knowledge::None,
                "pose of the training image most alike by VLAD of dense gradient descriptors",
                Some(baselines::vlad::predict(task, progress)?),
                None,
            ),
            BaselineName::Interpolation => add(
                "interpolated frame number",
                Knowledge::FrameNumbers,
                "between the training frames before and after; looks at no image, so where it is good the split is easy",
                Some(baselines::interpolation::predict(task)?),
                None,
            ),
            BaselineName::ZeroMotion => add(
                "zero motion",
                Knowledge::None,
                "the camera stands still",
                None,
                Some(baselines::motion::zero(task, gap)),
            ),
            BaselineName::ConstantVelocity => add(
                "constant velocity",
                Knowledge::Truth,
                "the true motion over the frames before, again; knows what no method may",
                None,
                Some(baselines::motion::constant_velocity(task, gap)),
            ),
        }
    }
    Ok(())
}

/// A model to be judged.
#[derive(Debug, Clone)]
pub struct NamedModel {
    /// What the report calls it.
    pub name: String,
    /// The files it is of.
    pub files: Vec<String>,
    /// The model.
    pub model: LoadedModel,
}

/// Plays a model and adds its outputs; with `cnn1` also retrieval by its CNN1's features. `map_smoothing_s` is the time
/// constant of the published poses ([`PipelineOptions::map_smoothing_s`](grnet_pipeline::PipelineOptions)).
///
/// A model with fusion is played a second time with the fused head off: the pipeline then gives RCNN2's own pose.
///
/// # Errors
/// As [`play`]; when a training image cannot be described.
pub fn add_model(
    systems: &mut Vec<System>,
    models: &mut Vec<ModelInfo>,
    data: &Data,
    NamedModel { name, files, model }: &NamedModel,
    map_smoothing_s: f64,
    cnn1: bool,
    progress: Progress<'_>,
) -> Result<(), EvaluateError> {
    let heads = model.network.live_heads();
    let played = play(name, model, data, map_smoothing_s, progress)?;
    let index = models.len();
    let mut add = |output: &str, kind, knowledge, about: &str, estimates: &[PoseEstimate]| {
        let system = System::new(&format!("{name} {output}"), kind, about);
        systems.push(System { knowledge, model: Some(index), ..with_estimates(system, estimates) });
    };
    if heads.fused.pose {
        add("fused", Kind::Fused, Knowledge::None, "absolute pose of FCFL, before any gate", &played.network);
    }
    if heads.global.pose {
        let about = "absolute pose of RCNN2 alone";
        if heads.fused.pose {
            let global = play(name, &without_fusion(model, heads), data, 0.0, progress)?;
            add("global", Kind::Global, Knowledge::None, about, &global.network);
        } else {
            add("global", Kind::Global, Knowledge::None, about, &played.network);
        }
    }
    if (heads.fused.pose || heads.global.pose) && differ(&played) {
        let mut about = "what the daemon publishes: the network's pose, gated by the odometry".to_owned();
        if map_smoothing_s > 0.0 {
            about += &format!(" and averaged along it over {:.0} ms", map_smoothing_s * 1e3);
        }
        add("published", Kind::Published, Knowledge::None, &about, &played.published);
    }
    if heads.relative.pose {
        let about = "integrated motion of RCNN1 from the true pose of each block's first frame";
        add("odometry", Kind::Odometry, Knowledge::FirstPose, about, &played.odometry);
    }
    if cnn1 && !data.task.train.is_empty() {
        let about =
            "pose of the training image most alike by the averaged features of this checkpoint's CNN1";
        let system = System::new(&format!("retrieval, CNN1 of {name}"), Kind::Baseline, about);
        let poses = Some(baselines::cnn1::predict(model, &data.task, progress)?);
        systems.push(System { poses, model: Some(index), ..system });
    }
    models.push(info(name, files.clone(), model, &played));
    Ok(())
}

/// Number of frames that [`add_model`] plays or describes.
pub fn model_frames(model: &LoadedModel, data: &Data, cnn1: bool) -> usize {
    let heads = model.network.live_heads();
    let passes = if heads.fused.pose && heads.global.pose { 2 } else { 1 };
    let described =
        if cnn1 && !data.task.train.is_empty() { data.task.train.len() + data.task.test.len() } else { 0 };
    passes * data.task.test.len() + described
}

fn with_estimates(system: System, estimates: &[PoseEstimate]) -> System {
    let covariances: Vec<Covariance6> = estimates.iter().map(|estimate| estimate.covariance).collect();
    let any = covariances.iter().any(|c| c.is_finite() && c.matrix().iter().any(|v| *v != 0.0));
    System {
        poses: Some(estimates.iter().map(|estimate| estimate.pose).collect()),
        covariances: if any { covariances } else { Vec::new() },
        ..system
    }
}

fn without_fusion(model: &LoadedModel, heads: Heads) -> LoadedModel {
    let heads = Heads { fused: HeadState::default(), ..heads };
    let mut model = model.clone();
    model.network = model.network.with_live_heads(heads);
    model.metadata.heads = heads;
    model
}

/// Whether the gate or the mean changed anything.
fn differ(played: &Played) -> bool {
    played.network.iter().zip(&played.published).any(|(network, published)| network.pose != published.pose)
}

fn info(name: &str, files: Vec<String>, model: &LoadedModel, played: &Played) -> ModelInfo {
    let config = model.network.config();
    ModelInfo {
        name: name.into(),
        files,
        model_hash: model.model_hash.iter().map(|byte| format!("{byte:02x}")).collect(),
        trained: model.trained,
        scene: model.metadata.scene.as_ref().map(|scene| scene.name.clone()),
        input_px: (config.input_width_px, config.input_height_px),
        parameters: config.parameter_count(),
        failed_frames: played.failed,
        odometry_restarts: played.restarts,
        notes: played.notes.clone(),
    }
}
