//! The daemon from start to end.

use std::path::PathBuf;
use std::sync::Arc;

use crossbeam_channel::{bounded, select, unbounded};
use grnet_capture::RecordingWriter;
use grnet_config::{GrnetdConfig, Override, Settings};
use grnet_frame::SourceKind;
use grnet_proto::BootId;

use crate::capture::{self, Capture};
use crate::control::{self, Control};
use crate::failure::Failure;
use crate::logging::LogHandle;
use crate::publish::{self, Publish};
use crate::realtime::{Part, Realtime};
use crate::record::{self, Record, Recorder};
use crate::reload::Reloader;
use crate::scenes::SceneLibrary;
use crate::service_manager::ServiceManager;
use crate::setup::Parts;
use crate::signals::{Request, SignalThread};
use crate::slot::{WhenFull, slot};
use crate::state::{Identity, State};
use crate::supervisor::Supervisor;
use crate::worker::{self, Worker};

/// Samples that may wait for the publisher: a hiccup of some tens of milliseconds at 30 frames/s.
const QUEUE: usize = 4;

/// The configuration with where it came from, so that it can be read again.
#[derive(Debug, Clone)]
pub struct Loaded {
    /// What is configured.
    pub config: GrnetdConfig,
    /// The same key by key.
    pub settings: Settings,
    /// The file.
    pub path: PathBuf,
    /// What goes before it.
    pub overrides: Vec<Override>,
    /// Record into this folder from the first frame on.
    pub record: Option<PathBuf>,
}

/// Runs until the recording ends, a signal comes or something fails.
///
/// # Errors
/// The first error of any part.
pub fn run(loaded: Loaded, log: &LogHandle) -> Result<(), Failure> {
    // Before there are other threads, which inherit.
    let (realtime, refusals) = Realtime::prepare(&loaded.config.realtime)?;
    let signals = SignalThread::start()?;
    let manager = Arc::new(ServiceManager::default());
    tracing::info!(version = grnet_proto::PACKAGE_VERSION, config = %loaded.path.display(), "starting");
    if !realtime.describe().is_empty() {
        tracing::info!(settings = realtime.describe(), refused = refusals.len(), "real-time");
        if let Some(advice) = realtime.advice() {
            tracing::warn!("{advice}");
        }
    }
    manager.status("loading the model");
    let Some(parts) = prepare(&loaded.config, &signals)? else { return Ok(()) };
    parts.log();
    let state = Arc::new(parts.state()?);
    for refusal in &refusals {
        tracing::warn!("{refusal}");
        state.report_error(refusal.to_string());
    }
    // The last thing that a bad configuration can get wrong: it leaves no empty folder behind.
    let recorder = Recorder::new(&loaded.config, &state.identity);
    let first = loaded.record.as_deref().map(|folder| recorder.begin(folder)).transpose();
    let recording = Recording { recorder, first: first.map_err(Failure::config)? };

    let host = Host { realtime, manager, log: log.clone() };
    let result = stream(parts, recording, loaded, Arc::clone(&state), host, &signals);
    tracing::info!("{}", state.summary());
    result
}

/// How frames are recorded, and the recording that begins with the first one.
struct Recording {
    recorder: Recorder,
    first: Option<RecordingWriter>,
}

/// What the daemon is to the system that it runs on.
struct Host {
    realtime: Realtime,
    manager: Arc<ServiceManager>,
    log: LogHandle,
}

/// capture -> slot of one -> worker: preprocess -> infer -> fuse -> queue -> publish -> iceoryx2.
/// Beside it, while a recording is on: capture -> queue -> record -> disk.
fn stream(
    parts: Parts,
    recording: Recording,
    loaded: Loaded,
    state: Arc<State>,
    host: Host,
    signals: &SignalThread,
) -> Result<(), Failure> {
    let Parts { transport, source, pipeline, model, .. } = parts;
    let Host { realtime, manager, log } = host;
    let GrnetdConfig { publish, source: source_config, model: files, record: recording_config, .. } =
        loaded.config.clone();
    let kind = source.info().kind;
    let mut threads = Supervisor::new(Arc::clone(&manager));
    let stop = || threads.stop();
    let (slot_in, slot_out) = slot(WhenFull::from(kind), Arc::clone(&state.counters.slot_dropped));
    let (queue_in, queue_out) = bounded(QUEUE);
    let (outages_in, outages_out) = unbounded();
    let (orders_in, orders_out) = bounded(1);
    let (opened_in, opened_out) = bounded(1);
    let (controlled_in, controlled_out) = bounded(1);
    let (gate_in, gate_out) = bounded(1);
    let (asked_in, asked_out) = bounded(1);
    let (reloads_in, reloads_out) = unbounded();
    let (heartbeats_in, heartbeats_out) = unbounded();
    let (tap, tapped) = record::tap(kind, recording_config.queue_frames, recording.first.is_some(), stop());

    let capture = Capture {
        source,
        time_offset_ns: source_config.time_offset_ns,
        silence: source_config.silence,
        gate: gate_out,
        frames: slot_in,
        tap,
        outages: outages_in,
        state: Arc::clone(&state),
        manager: Arc::clone(&manager),
        stop: stop(),
        activity: Default::default(),
    };
    let worker = Worker {
        pipeline,
        model: model.clone(),
        frames: slot_out,
        orders: orders_out,
        output: queue_in,
        state: Arc::clone(&state),
        manager: Arc::clone(&manager),
        stop: stop(),
        activity: Default::default(),
    };
    let control = Control {
        transport: transport.clone(),
        opened: opened_out,
        controlled: controlled_in,
        scenes: SceneLibrary::new(&files.checkpoint, files.scene.as_deref(), &model),
        orders: orders_in,
        reloads: reloads_out,
        reloader: Reloader { loaded, log, heartbeats: heartbeats_in, manager: Arc::clone(&manager) },
        recorder: asked_in,
        state: Arc::clone(&state),
        stop: stop(),
        activity: Default::default(),
    };
    let record = Record {
        recorder: recording.recorder,
        first: recording.first,
        tapped,
        asked: asked_out,
        state: Arc::clone(&state),
        stop: stop(),
        activity: Default::default(),
    };
    let publish = Publish {
        transport,
        heartbeat: publish.heartbeat(),
        heartbeats: heartbeats_out,
        silence: (kind == SourceKind::Live).then_some(source_config.silence),
        wait_for_subscribers: publish.wait_for_subscribers,
        opened: opened_in,
        controlled: controlled_out,
        gate: gate_in,
        output: queue_out,
        outages: outages_out,
        state: Arc::clone(&state),
        manager: Arc::clone(&manager),
        stop: stop(),
        activity: Default::default(),
    };

    let enter = |part| {
        let realtime = realtime.clone();
        move || realtime.enter(part)
    };
    let (as_publish, as_worker, as_capture) =
        (enter(Part::Publish), enter(Part::Worker), enter(Part::Capture));
    // Who publishes first: a name that is taken ends the daemon before a frame is read.
    threads.start("publish", &publish.activity.clone(), move || {
        as_publish()?;
        publish::run(publish)
    })?;
    threads.start("control", &control.activity.clone(), move || control::run(control))?;
    threads.start("worker", &worker.activity.clone(), move || {
        as_worker()?;
        worker::run(worker)
    })?;
    threads.start("record", &record.activity.clone(), move || record::run(record))?;
    threads.start("capture", &capture.activity.clone(), move || {
        as_capture()?;
        capture::run(capture)
    })?;
    threads.supervise("publish", signals, &state, || {
        // Without a control thread the daemon is ending.
        let _ = reloads_in.send(());
    })
}

/// Loads everything on a thread of its own, so that a signal ends the daemon also while a large model is read.
fn prepare(config: &GrnetdConfig, signals: &SignalThread) -> Result<Option<Parts>, Failure> {
    let (done, prepared) = bounded(1);
    let config = config.clone();
    let load = move || {
        // Nobody waits any more when a signal came first.
        let _ = done.send(Parts::prepare(&config));
    };
    std::thread::Builder::new()
        .name("load".into())
        .spawn(load)
        .map_err(|error| Failure::internal(format!("cannot start a thread: {error}")))?;
    loop {
        select! {
            recv(prepared) -> parts => {
                return parts.unwrap_or_else(|_| Err(Failure::internal("loading panicked"))).map(Some);
            }
            recv(signals.requests) -> request => match request {
                Ok(Request::Reload) => tracing::info!("SIGHUP while starting: the configuration was just read"),
                Ok(Request::Stop(signal)) => {
                    tracing::info!(signal, "stopped while starting");
                    return Ok(None);
                }
                Err(_) => return Err(Failure::internal("the signal thread has ended")),
            }
        }
    }
}

impl Parts {
    fn log(&self) {
        let info = self.source.info();
        // Intervals are whole nanoseconds; the digits that this costs tell nobody anything.
        let rate_hz = info.nominal_rate_hz.map(|hz| (hz * 100.0).round() / 100.0);
        tracing::info!(source = info.name, kind = ?info.kind, rate_hz, "source");
        for note in &self.source_notes {
            tracing::info!(note, "source");
        }
        let pipeline = self.pipeline.info();
        let scene = self.model.scene.as_ref().map_or("none", |scene| &scene.name);
        tracing::info!(model = self.model.name, trained = self.model.trained, scene, "model");
        for note in &pipeline.notes {
            tracing::warn!(note, "model");
        }
    }

    fn state(&self) -> Result<State, Failure> {
        let boot_id = BootId::random()
            .map_err(|error| Failure::internal(format!("the kernel gives no random bits: {error}")))?;
        let identity = Identity {
            boot_id,
            camera: self.camera.clone(),
            access: self.transport.access.wire(),
            source: self.source.info().name,
        };
        Ok(State::new(identity, self.model.clone()))
    }
}
