//! A model's answers to the test frames, frame by frame as the daemon gives them.

use std::time::Duration;

use grnet_capture::dataset::Recording;
use grnet_capture::{FolderSource, Pace};
use grnet_frame::{FrameSource as _, Received, SourceError};
use grnet_geometry::{Covariance6, Pose};
use grnet_model::LoadedModel;
use grnet_pipeline::{Estimate, NoObserver, Pipeline, PipelineOptions, PoseEstimate, TimeOptions};

use super::{Data, EvaluateError};

/// How many refused frames are described one by one.
const PROBLEMS_NAMED: usize = 5;

/// What the pipeline said about every test frame.
#[derive(Debug, Clone)]
pub struct Played {
    /// The network's pose in the world, before any gate.
    pub network: Vec<PoseEstimate>,
    /// The published pose in the world, gated and smoothed.
    pub published: Vec<PoseEstimate>,
    /// Integrated motion since the block's first frame with a true pose, starting at that pose. After a restart of the
    /// odometry within a block nothing ties it to the world any more: unknown.
    pub odometry: Vec<PoseEstimate>,
    /// Restarts of the odometry within blocks.
    pub restarts: usize,
    /// Frames without any estimate: unreadable images, refused frames.
    pub failed: usize,
    /// The first few of them in words, and what the pipeline notes about the model.
    pub notes: Vec<String>,
}

/// Runs a model over the test frames, the published poses being means with the time constant `map_smoothing_s`; `progress`
/// is called after each frame.
///
/// # Errors
/// When the model does not fit the recording's camera, or the frames cannot be played.
pub fn play(
    name: &str,
    model: &LoadedModel,
    data: &Data,
    map_smoothing_s: f64,
    progress: &dyn Fn(),
) -> Result<Played, EvaluateError> {
    let frames = data.task.test.len();
    let unknown = || vec![PoseEstimate::unknown(); frames];
    let mut played = Played {
        network: unknown(),
        published: unknown(),
        odometry: unknown(),
        restarts: 0,
        failed: 0,
        notes: Vec::new(),
    };
    for sequence in data.tested_sequences() {
        let recording = &data.recordings[sequence];
        let refused = |source| EvaluateError::Pipeline {
            model: name.into(),
            recording: recording.name.clone(),
            source: Box::new(source),
        };
        let options = PipelineOptions { map_smoothing_s, ..options(recording) };
        let mut pipeline = Pipeline::new(model.clone(), options).map_err(refused)?;
        if let Some(camera) = &recording.camera {
            pipeline.check_camera(camera).map_err(|error| refused(error.into()))?;
        }
        let range = data.test_range(sequence);
        for block in data.task.blocks().into_iter().filter(|block| range.contains(&block.start)) {
            pipeline.on_source_lost();
            play_block(&mut pipeline, data, block, &mut played, progress)?;
        }
        played.notes.extend(pipeline.info().notes);
    }
    played.notes.sort();
    played.notes.dedup();
    Ok(played)
}

/// Body axes are the camera's, the map is the world; everything else is the daemon's default.
fn options(recording: &Recording) -> PipelineOptions {
    let time = TimeOptions::default();
    // Recordings of a few frames per second are no interrupted ones.
    let slow_ns = recording.nominal_rate_hz.map_or(0, |rate_hz| (2.5e9 / rate_hz) as u64);
    PipelineOptions {
        base_from_camera: Pose::identity(),
        map_from_world: Some(Pose::identity()),
        time: TimeOptions { longest_gap_ns: time.longest_gap_ns.max(slow_ns), ..time },
        ..PipelineOptions::default()
    }
}

fn play_block(
    pipeline: &mut Pipeline,
    data: &Data,
    block: std::ops::Range<usize>,
    played: &mut Played,
    progress: &dyn Fn(),
) -> Result<(), EvaluateError> {
    let mut source = FolderSource::new(block_recording(data, &block), Pace::Max, false)?;
    let mut odometry = Odometry::default();
    loop {
        let frame = match source.next_frame(Duration::from_secs(1)) {
            Ok(Received::Frame(frame)) => frame,
            Ok(Received::Timeout) => continue,
            Ok(Received::End) => return Ok(()),
            Err(error @ SourceError::BadFrame { .. }) => {
                played.failure(&error.to_string());
                progress();
                continue;
            }
            Err(error) => return Err(error.into()),
        };
        let index = block.start + frame.sequence as usize;
        match pipeline.step(&frame, &mut NoObserver) {
            Ok(estimate) => {
                played.network[index] = estimate.network_map_from_base;
                played.published[index] = estimate.map_from_base;
                let truth = data.task.test[index].world_from_camera;
                played.odometry[index] = odometry.place(&estimate, truth, &mut played.restarts);
            }
            Err(error) => played.failure(&chain(&error)),
        }
        progress();
    }
}

/// The block's frames as a recording of their own, so that no other frame can be shown.
fn block_recording(data: &Data, block: &std::ops::Range<usize>) -> Recording {
    let sequence = data.task.test[block.start].sequence;
    let recording = &data.recordings[sequence];
    let indices = data.task.test[block.clone()].iter().map(|view| view.index as usize);
    let frames = indices.map(|index| recording.frames[index].clone()).collect();
    Recording {
        name: recording.name.clone(),
        id: recording.id.clone(),
        layout: recording.layout,
        frames,
        camera: recording.camera,
        image_size_px: recording.image_size_px,
        nominal_rate_hz: recording.nominal_rate_hz,
        invalid_poses: 0,
        notes: Vec::new(),
    }
}

impl Played {
    fn failure(&mut self, what: &str) {
        self.failed += 1;
        if self.failed <= PROBLEMS_NAMED {
            self.notes.push(format!("no estimate: {what}"));
        }
    }
}

/// Where the odometry frame lies in the world, as long as it is one and the same.
#[derive(Debug, Default)]
struct Odometry {
    epoch: Option<u32>,
    world_from_odom: Option<Pose>,
    lost: bool,
}

impl Odometry {
    fn place(&mut self, estimate: &Estimate, truth: Option<Pose>, restarts: &mut usize) -> PoseEstimate {
        let Some(odom_from_camera) = estimate.odom_from_base.pose else { return PoseEstimate::unknown() };
        if self.epoch.replace(estimate.reset_epoch).is_some_and(|epoch| epoch != estimate.reset_epoch) {
            *restarts += 1;
            self.lost = true;
        }
        if self.lost {
            return PoseEstimate::unknown();
        }
        if self.world_from_odom.is_none() {
            self.world_from_odom =
                truth.map(|world_from_camera| world_from_camera * odom_from_camera.inverse());
        }
        let Some(world_from_odom) = self.world_from_odom else { return PoseEstimate::unknown() };
        let covariance: Covariance6 = estimate.odom_from_base.covariance.with_parent_moved(&world_from_odom);
        PoseEstimate::known(world_from_odom * odom_from_camera, covariance)
    }
}

fn chain(error: &dyn std::error::Error) -> String {
    let mut text = error.to_string();
    let mut source = error.source();
    while let Some(inner) = source {
        let inner_text = inner.to_string();
        if !text.ends_with(&inner_text) {
            text = format!("{text}: {inner_text}");
        }
        source = inner.source();
    }
    text
}
