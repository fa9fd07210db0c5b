//! `step(frame) -> estimate`: one and the same code in the daemon, the evaluator and the tests.
//!
//! [`Pipeline::step`] reads as the data flows: decode / convert -> undistort -> resize / crop -> normalise ->
//! infer -> fuse. It owns no thread and no socket and reads no clock: time enters only with a
//! [`Frame`], so the same frames give the same estimates, bit by bit, on one instruction set.
//!
//! Frames, as REP-105 names them: `map` (the scene's, may jump), `odom` (where the odometry started,
//! continuous), `base` (the body), `camera` (optical axes). Covariances are [translation, rotation] about the
//! fixed axes of the parent frame.
#![forbid(unsafe_code)]
#![deny(missing_docs)]

mod estimate;
mod fuse;
mod infer;
mod info;
mod options;
pub mod preprocess;
mod time;

pub use estimate::{Estimate, NoObserver, PoseEstimate, Reason, Stage, StageObserver, Status};
pub use infer::InferError;
pub use info::PipelineInfo;
pub use options::{AfterRejections, InnovationGate, OptionsError, PipelineOptions, TimeOptions};
pub use preprocess::{
    DecodeError, Intrinsics, IntrinsicsError, IntrinsicsOptions, IntrinsicsPolicy, PreprocessError,
};
pub use time::StaleFrame;

use grnet_frame::{Camera, Frame};
use grnet_geometry::{Covariance6, Pose};
use grnet_model::LoadedModel;

use fuse::{Fuse, Stamp};
use infer::Infer;
use info::{input_spec, model_traits};
use preprocess::Preprocessor;
use time::{Arrival, TimeRule};

/// Why a pipeline could not be built, or a model not be put into it.
#[derive(Debug, thiserror::Error)]
pub enum PipelineError {
    /// An option cannot be used.
    #[error("pipeline option {0}")]
    Options(#[from] OptionsError),
    /// The configured camera does not fit the model.
    #[error("the configured camera cannot be used with this model: {0}")]
    Intrinsics(#[from] IntrinsicsError),
    /// The checkpoint's own camera or transform is unusable.
    #[error("the checkpoint's {what} cannot be used: {reason}")]
    Checkpoint {
        /// Which part of the metadata.
        what: &'static str,
        /// What is wrong with it.
        reason: String,
    },
    /// No head of the model gives a pose.
    #[error("the model has no trained pose head: neither odometry nor a map pose could be computed")]
    NoLiveHead,
}

/// Why a frame gave no estimate. Poses and the network's state are as if the frame had never come; only where the
/// network itself failed on a frame that jumped in time has the odometry been restarted already.
#[derive(Debug, thiserror::Error)]
pub enum StepError {
    /// The frame is not newer than the last one.
    #[error(transparent)]
    StaleFrame(#[from] StaleFrame),
    /// The frame's bytes or intrinsics cannot be used.
    #[error("frame {sequence} cannot be used: {source}")]
    Preprocess {
        /// The frame's sequence number.
        sequence: u64,
        /// What is wrong with it.
        source: PreprocessError,
    },
    /// The network failed.
    #[error("frame {sequence} cannot be processed")]
    Infer {
        /// The frame's sequence number.
        sequence: u64,
        /// What the network says.
        source: InferError,
    },
}

/// Turns frames into estimates.
#[derive(Debug)]
pub struct Pipeline {
    options: PipelineOptions,
    time: TimeRule,
    preprocessor: Preprocessor,
    infer: Infer,
    fuse: Fuse,
}

impl Pipeline {
    /// A pipeline at its start.
    ///
    /// # Errors
    /// See [`PipelineError`]. A camera that comes only with the frames is checked by
    /// [`Pipeline::check_camera`] or at the first frame.
    pub fn new(model: LoadedModel, options: PipelineOptions) -> Result<Self, PipelineError> {
        options.validate()?;
        let traits = model_traits(&model, &options)?;
        Ok(Self {
            time: TimeRule::new(options.time),
            preprocessor: Preprocessor::new(input_spec(&model)?, options.intrinsics, options.camera)?,
            infer: Infer::new(model),
            fuse: Fuse::new(traits, options.base_from_camera, options.rules()),
            options,
        })
    }

    /// Processes one frame.
    ///
    /// A gap in the sequence numbers is fine: the motion is then that since the last processed frame. A time of
    /// capture that jumps ahead ([`TimeOptions::longest_gap_ns`]) or that is on another clock starts the odometry
    /// anew, and so does an output that is not finite (the estimate is then LOST).
    ///
    /// # Errors
    /// See [`StepError`]; the caller counts them and goes on with the next frame.
    pub fn step(&mut self, frame: &Frame, observer: &mut dyn StageObserver) -> Result<Estimate, StepError> {
        let sequence = frame.sequence;
        let arrival = self.time.judge(sequence, frame.capture_time)?;

        observer.enter(Stage::Preprocess);
        let input =
            self.preprocessor.run(frame).map_err(|source| StepError::Preprocess { sequence, source })?;

        observer.enter(Stage::Infer);
        if let Arrival::Jumped(reason) = arrival {
            self.infer.reset();
            self.fuse.restart(reason);
        }
        let dt_s = match arrival {
            Arrival::After { dt_s } => Some(dt_s),
            Arrival::First | Arrival::Jumped(_) => None,
        };
        let outputs = self
            .infer
            .run(input, dt_s.unwrap_or(0.0))
            .map_err(|source| StepError::Infer { sequence, source })?;
        self.time.accept(frame.capture_time);

        observer.enter(Stage::Fuse);
        let estimate = self.fuse.fuse(Stamp { sequence, capture_time: frame.capture_time, dt_s }, &outputs);
        if estimate.reason == Reason::NonFiniteOutput {
            self.infer.reset();
        }
        Ok(estimate)
    }

    /// Checks the intrinsics that a source says its frames will have.
    ///
    /// # Errors
    /// When the first such frame would be refused.
    pub fn check_camera(&self, camera: &Camera) -> Result<Intrinsics, IntrinsicsError> {
        self.preprocessor.check_camera(camera)
    }

    /// Starts the odometry anew at the next frame, which is paired with itself: its `previous_from_current` is
    /// unknown, its `odom_from_base` the identity, `reset_epoch` has grown.
    ///
    /// The map is untouched. What RCNN2 remembers stays; a map pose that follows odometry goes on from where it
    /// was, as if the body stood still for the one frame whose motion is not measured.
    pub fn reset_odometry(&mut self) {
        self.infer.reset_relative();
        self.fuse.restart_odometry(Reason::OdometryReset);
    }

    /// The source was lost: its next frame may show another place at any time on any clock.
    ///
    /// Odometry starts anew; a map pose that follows odometry is not known any more; with a scene the next
    /// global pose is taken unseen.
    pub fn on_source_lost(&mut self) {
        self.infer.reset();
        self.time.forget();
        self.fuse.restart(Reason::SourceReturned);
    }

    /// Forgets the map pose: with a scene the next global pose is taken unseen, without one `map_from_base` is
    /// not known until [`Pipeline::set_pose`].
    pub fn reset_map(&mut self) {
        self.infer.reset_global();
        self.fuse.reset_map();
    }

    /// Says where the body is now: at the last processed frame, or at the next one where there was none since
    /// the start or the last restart.
    ///
    /// From there `map_from_base` follows odometry: without a scene until further notice, with a scene until the
    /// next global pose is accepted. That is at once when `covariance` is unknown (NaN); with a known covariance
    /// the global pose has to pass the innovation gate against the pose set here. The network itself cannot be
    /// told where it is.
    ///
    /// # Errors
    /// When the pose is not finite.
    pub fn set_pose(&mut self, map_from_base: Pose, covariance: Covariance6) -> Result<(), OptionsError> {
        options::check_pose("map_from_base", &map_from_base)?;
        self.fuse.place(map_from_base, covariance);
        Ok(())
    }

    /// Puts other rules in place for what comes: times, gate, smoothing of the map pose in seconds, and how long a start is
    /// INITIALIZING. Poses go on.
    ///
    /// # Errors
    /// When a number is out of range; the old rules stay in place then.
    pub fn set_tracking(
        &mut self,
        time: TimeOptions,
        gate: Option<InnovationGate>,
        map_smoothing_s: f64,
        initializing_frames: u32,
    ) -> Result<(), OptionsError> {
        let options =
            PipelineOptions { time, gate, map_smoothing_s, initializing_frames, ..self.options.clone() };
        options.validate()?;
        self.time.set_options(time);
        self.fuse.set_rules(options.rules());
        self.options = options;
        Ok(())
    }

    /// Puts another model in place between two frames: another scene on the same trunk leaves the odometry going,
    /// another trunk starts it anew. The map pose is forgotten, for it belongs to the scene that left.
    ///
    /// # Errors
    /// As [`Pipeline::new`]; the old model stays in place then.
    pub fn swap_model(&mut self, model: LoadedModel) -> Result<(), PipelineError> {
        let traits = model_traits(&model, &self.options)?;
        let preprocessor =
            Preprocessor::new(input_spec(&model)?, self.options.intrinsics, self.options.camera)?;
        let motion_goes_on = self.infer.swap(model);
        if preprocessor.spec() != self.preprocessor.spec() {
            self.preprocessor = preprocessor;
        }
        if !motion_goes_on {
            self.fuse.restart(Reason::ModelSwapped);
        }
        self.fuse.set_traits(traits);
        Ok(())
    }

    /// What the pipeline is made of and what is known about its camera.
    pub fn info(&self) -> PipelineInfo {
        PipelineInfo::new(
            self.infer.model(),
            &self.options,
            self.preprocessor.intrinsics(),
            self.fuse.reset_epoch(),
        )
    }
}
