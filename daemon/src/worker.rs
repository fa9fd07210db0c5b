//! The worker thread: preprocess, infer, fuse; and the changes of state that operators ask for, between frames.

use std::sync::Arc;
use std::sync::atomic::Ordering::Relaxed;
use std::time::Instant;

use crossbeam_channel::{Receiver, Sender, never, select};
use grnet_frame::{CaptureTime, Clock};
use grnet_geometry::{Covariance6, Pose};
use grnet_pipeline::{
    Estimate, InnovationGate, Pipeline, PreprocessError, Stage, StageObserver, StepError, TimeOptions,
};
use grnet_proto::clock::monotonic_ns;
use grnet_proto::{PoseSample, StageLatency, Status};

use crate::activity::Activity;
use crate::capture::Captured;
use crate::convert;
use crate::failure::{Failure, Kind};
use crate::repeats::Repeats;
use crate::scenes::{ModelIdentity, Prepared};
use crate::service_manager::ServiceManager;
use crate::state::State;
use crate::stop::Stop;

/// What the worker sends to the publisher, in order.
#[derive(Debug)]
pub enum Output {
    /// A frame became a sample.
    Sample(Box<Processed>),
    /// No more samples until `Resumed`.
    Paused,
    /// Samples follow again.
    Resumed,
}

/// A sample that only lacks what the publisher knows.
#[derive(Debug)]
pub struct Processed {
    /// The sample.
    pub sample: PoseSample,
    /// When it was done, ns on `CLOCK_MONOTONIC`.
    pub fused_at_ns: u64,
    /// As in [`Captured`].
    pub outages: u64,
}

/// A change of state between two frames, with the place for its answer.
#[derive(Debug)]
pub struct Order {
    /// What to do.
    pub what: Change,
    /// Gets the answer.
    pub reply: Sender<Result<String, String>>,
}

/// What can be changed between two frames.
#[derive(Debug)]
pub enum Change {
    /// Odometry starts anew.
    ResetOdometry,
    /// The base is there, known so well; NaN when not known.
    SetPose(Pose, Box<Covariance6>),
    /// Other rules for times, for the innovation gate and for the map pose.
    Tracking {
        /// When relative motion is believed.
        time: TimeOptions,
        /// When a global pose is believed.
        gate: Option<InnovationGate>,
        /// Time constant of the map pose's mean in seconds, 0 for none.
        map_smoothing_s: f64,
        /// Samples of a start.
        initializing_frames: u32,
    },
    /// Other weights.
    Swap(Box<Prepared>),
    /// Take no frames.
    Pause,
    /// Take frames.
    Resume,
}

/// What the worker works with.
#[derive(Debug)]
pub struct Worker {
    /// Frame to estimate.
    pub pipeline: Pipeline,
    /// The weights in it.
    pub model: ModelIdentity,
    /// Frames from the capture thread.
    pub frames: Receiver<Captured>,
    /// Orders from the control thread.
    pub orders: Receiver<Order>,
    /// Samples to the publisher.
    pub output: Sender<Output>,
    /// What is counted.
    pub state: Arc<State>,
    /// Is told about the first success.
    pub manager: Arc<ServiceManager>,
    /// Ends the thread.
    pub stop: Stop,
    /// Shows progress.
    pub activity: Activity,
}

/// Processes frames until there are no more or the stop comes.
///
/// # Errors
/// Before the first success: when the camera does not fit the model, or the network fails. Later such frames are
/// counted and left out.
pub fn run(worker: Worker) -> Result<(), Failure> {
    Run::new(worker).run()
}

struct Run {
    worker: Worker,
    losses: u64,
    is_paused: bool,
    last: Option<(Status, grnet_proto::Reason)>,
    refused: Repeats,
    bad: Repeats,
    failed: Repeats,
    degraded: Repeats,
}

enum Next {
    Frame(Box<Captured>),
    Order(Order),
    NoMoreOrders,
    End,
}

impl Run {
    fn new(worker: Worker) -> Self {
        Self {
            worker,
            losses: 0,
            is_paused: false,
            last: None,
            refused: Repeats::default(),
            bad: Repeats::default(),
            failed: Repeats::default(),
            degraded: Repeats::default(),
        }
    }

    fn run(mut self) -> Result<(), Failure> {
        loop {
            self.worker.activity.wait();
            let next = self.next();
            self.worker.activity.work();
            match next {
                Next::Frame(captured) => self.process(*captured)?,
                Next::Order(Order { what, reply }) => {
                    // Whoever asked may have gone.
                    let _ = reply.send(self.change(what));
                }
                Next::NoMoreOrders => self.worker.orders = never(),
                Next::End => {
                    self.worker.activity.wait();
                    return Ok(());
                }
            }
        }
    }

    /// While paused the slot is left alone: a recording waits in it, a camera goes on replacing its frame.
    fn next(&self) -> Next {
        let Worker { frames, orders, stop, .. } = &self.worker;
        let nothing = never();
        let frames = if self.is_paused { &nothing } else { frames };
        select! {
            recv(frames) -> frame => frame.map_or(Next::End, |frame| Next::Frame(Box::new(frame))),
            recv(orders) -> order => order.map_or(Next::NoMoreOrders, Next::Order),
            recv(stop.channel()) -> _ => Next::End,
        }
    }

    fn process(&mut self, Captured { frame, losses, outages }: Captured) -> Result<(), Failure> {
        if losses != self.losses {
            self.losses = losses;
            self.worker.pipeline.on_source_lost();
        }
        let mut stopwatch = Stopwatch::start(frame.capture_time, self.worker.activity.clone());
        let estimate = match self.worker.pipeline.step(&frame, &mut stopwatch) {
            Ok(estimate) => estimate,
            Err(error) => return self.failed_step(error),
        };
        let (latency, fused_at_ns) = stopwatch.stop();
        self.note(&estimate);

        let state = &self.worker.state;
        state.counters.processed.fetch_add(1, Relaxed);
        state.counters.reset_epoch.store(estimate.reset_epoch, Relaxed);
        let identity = &state.identity;
        let mut sample =
            convert::pose_sample(identity.boot_id, &identity.camera, &self.worker.model, &estimate);
        sample.latency = latency;
        self.note_status(&sample);
        self.send(Output::Sample(Box::new(Processed { sample, fused_at_ns, outages })));
        self.worker.manager.ready("publishing poses");
        Ok(())
    }

    fn failed_step(&mut self, error: StepError) -> Result<(), Failure> {
        let counters = &self.worker.state.counters;
        let now = Instant::now();
        let (line, what) = match &error {
            StepError::StaleFrame(_) => {
                counters.refused.fetch_add(1, Relaxed);
                (self.refused.happened(now), "frames were refused because of their time")
            }
            StepError::Preprocess { source: PreprocessError::Intrinsics(_), .. }
                if !self.worker.manager.is_ready() =>
            {
                return Err(Failure::config(error));
            }
            StepError::Preprocess { .. } => {
                counters.bad.fetch_add(1, Relaxed);
                (self.bad.happened(now), "frames were left out")
            }
            StepError::Infer { .. } if !self.worker.manager.is_ready() => {
                return Err(Failure::new(Kind::Internal, error));
            }
            StepError::Infer { .. } => {
                counters.bad.fetch_add(1, Relaxed);
                (self.failed.happened(now), "the network failed on frames")
            }
        };
        if let Some(times) = line {
            let error = Failure::config(error).chain();
            tracing::warn!(error, times, "{what}");
            self.worker.state.report_error(error);
        }
        Ok(())
    }

    fn change(&mut self, what: Change) -> Result<String, String> {
        let Worker { pipeline, state, .. } = &mut self.worker;
        let done = match what {
            Change::ResetOdometry => {
                pipeline.reset_odometry();
                "odometry starts anew at the next frame".to_owned()
            }
            Change::SetPose(map_from_base, covariance) => {
                pipeline.set_pose(map_from_base, *covariance).map_err(|error| error.to_string())?;
                "map_from_base was set".to_owned()
            }
            Change::Tracking { time, gate, map_smoothing_s, initializing_frames } => {
                pipeline
                    .set_tracking(time, gate, map_smoothing_s, initializing_frames)
                    .map_err(|error| error.to_string())?;
                "other tracking rules".to_owned()
            }
            Change::Swap(prepared) => {
                let Prepared { model, identity } = *prepared;
                pipeline.swap_model(model).map_err(|error| Failure::config(error).chain())?;
                let scene = identity.scene.as_ref().map_or("none", |scene| &scene.name).to_owned();
                state.set_model(identity.clone());
                self.worker.model = identity;
                format!("scene in use: {scene}")
            }
            Change::Pause => {
                self.is_paused = true;
                state.set_paused(true);
                self.send(Output::Paused);
                "paused".to_owned()
            }
            Change::Resume => {
                self.is_paused = false;
                state.set_paused(false);
                self.send(Output::Resumed);
                "resumed".to_owned()
            }
        };
        tracing::debug!(done, "control");
        Ok(done)
    }

    /// Waits while the queue is full: the publisher never takes long, and the slot keeps the newest frame.
    fn send(&self, output: Output) {
        self.worker.activity.wait();
        select! {
            send(self.worker.output, output) -> _ => {}
            recv(self.worker.stop.channel()) -> _ => {}
        }
    }

    fn note(&self, estimate: &Estimate) {
        tracing::trace!(
            sequence = estimate.sequence,
            status = ?estimate.status,
            reason = %estimate.reason,
            "frame"
        );
    }

    fn note_status(&mut self, sample: &PoseSample) {
        let now = (sample.status, sample.reason);
        if self.last.replace(now) == Some(now) {
            return;
        }
        let PoseSample { status, reason, sequence, .. } = sample;
        if matches!(*status, Status::TRACKING | Status::INITIALIZING) {
            tracing::debug!(%status, %reason, sequence, "status");
        } else if let Some(times) = self.degraded.happened(Instant::now()) {
            tracing::warn!(%status, %reason, sequence, times, "poses are not what they should be");
        }
    }
}

/// Measures the stages of one step, and shows each as progress.
struct Stopwatch {
    latency: StageLatency,
    stage: Option<(Stage, u64)>,
    activity: Activity,
}

impl Stopwatch {
    fn start(capture_time: CaptureTime, activity: Activity) -> Self {
        let now_ns = monotonic_ns();
        let wait_us = match capture_time.clock {
            // A driver's time stamp may lie a little in the future.
            Clock::Monotonic => (now_ns as f64 - capture_time.ns as f64) / 1e3,
            Clock::Recorded => f64::NAN,
        };
        let latency = StageLatency { wait_us: wait_us as f32, ..StageLatency::UNKNOWN };
        Self { latency, stage: None, activity }
    }

    fn stop(mut self) -> (StageLatency, u64) {
        let now_ns = monotonic_ns();
        self.close(now_ns);
        (self.latency, now_ns)
    }

    fn close(&mut self, now_ns: u64) {
        let Some((stage, began_ns)) = self.stage.take() else { return };
        let took_us = (now_ns - began_ns) as f32 / 1e3;
        match stage {
            Stage::Preprocess => self.latency.preprocess_us = took_us,
            Stage::Infer => self.latency.infer_us = took_us,
            Stage::Fuse => self.latency.fuse_us = took_us,
        }
    }
}

impl StageObserver for Stopwatch {
    fn enter(&mut self, stage: Stage) {
        let now_ns = monotonic_ns();
        self.close(now_ns);
        self.stage = Some((stage, now_ns));
        self.activity.work();
    }
}
