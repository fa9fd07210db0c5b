//! What the daemon knows about itself, shared by its threads and told in every status message.

use std::collections::VecDeque;
use std::path::Path;
use std::sync::atomic::{AtomicU32, AtomicU64, Ordering::Relaxed};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use grnet_proto::clock::{Now, monotonic_ns};
use grnet_proto::{
    Access, BootId, CameraName, ContentHash, DaemonStatus, FixedText, Health, Provenance, Recording,
    SceneInfo, SourceState, StageLatency, Status,
};

use crate::latency::Latencies;
use crate::scenes::{ModelIdentity, SceneIdentity};

/// How far back the rates look.
const RATE_WINDOW_NS: u64 = 5_000_000_000;

/// Counters that threads increment.
#[derive(Debug, Default)]
pub struct Counters {
    /// Frames that the source delivered.
    pub captured: AtomicU64,
    /// Frames that became a sample.
    pub processed: AtomicU64,
    /// Frames that were corrupt, truncated or of the wrong size.
    pub bad: AtomicU64,
    /// Frames refused because of their time.
    pub refused: AtomicU64,
    /// Frames that the source itself lost.
    pub source_dropped: AtomicU64,
    /// Frames given up in the slot or because the source was lost before they were done.
    pub slot_dropped: Arc<AtomicU64>,
    /// Pose samples published.
    pub published: AtomicU64,
    /// Pose subscribers attached.
    pub subscribers: AtomicU32,
    /// Jumps of the odometry frame.
    pub reset_epoch: AtomicU32,
    /// Frames written to disk.
    pub recorded: AtomicU64,
    /// Frames that a recording lacks, for whatever reason.
    pub unrecorded: AtomicU64,
}

impl Counters {
    /// Good frames given up.
    pub fn dropped(&self) -> u64 {
        self.source_dropped.load(Relaxed) + self.slot_dropped.load(Relaxed)
    }

    /// Frames that did not become a sample, for whatever reason.
    pub fn missed(&self) -> u64 {
        self.dropped() + self.bad.load(Relaxed) + self.refused.load(Relaxed)
    }
}

/// What never changes while the daemon runs.
#[derive(Debug, Clone)]
pub struct Identity {
    /// This run.
    pub boot_id: BootId,
    /// The camera it serves.
    pub camera: CameraName,
    /// Who may subscribe.
    pub access: Access,
    /// The source as a log line calls it.
    pub source: String,
}

/// What the daemon knows about itself.
#[derive(Debug)]
pub struct State {
    /// What never changes.
    pub identity: Identity,
    /// What is counted.
    pub counters: Counters,
    started_ns: u64,
    inner: Mutex<Inner>,
}

#[derive(Debug)]
struct Inner {
    source: SourceState,
    last_status: Status,
    paused: bool,
    recording: Option<String>,
    stopping: bool,
    model: ModelIdentity,
    scenes: Vec<SceneIdentity>,
    active_scene: Option<usize>,
    latencies: Latencies,
    rates: VecDeque<(u64, u64, u64)>,
    errors: u64,
    last_error: Option<(u64, String)>,
}

impl State {
    /// A daemon that starts with this model.
    pub fn new(identity: Identity, model: ModelIdentity) -> Self {
        let inner = Inner {
            source: SourceState::OPENING,
            last_status: Status::INITIALIZING,
            paused: false,
            recording: None,
            stopping: false,
            model,
            scenes: Vec::new(),
            active_scene: None,
            latencies: Latencies::default(),
            rates: VecDeque::new(),
            errors: 0,
            last_error: None,
        };
        Self { identity, counters: Counters::default(), started_ns: monotonic_ns(), inner: Mutex::new(inner) }
    }

    /// What the source does now.
    pub fn set_source(&self, source: SourceState) {
        self.lock().source = source;
    }

    /// What the source did last.
    pub fn source(&self) -> SourceState {
        self.lock().source
    }

    /// An operator paused or resumed.
    pub fn set_paused(&self, paused: bool) {
        self.lock().paused = paused;
    }

    /// Frames are written into this folder, or nowhere any more.
    pub fn set_recording(&self, folder: Option<&Path>) {
        self.lock().recording = folder.map(|folder| folder.display().to_string());
    }

    /// The daemon is ending.
    pub fn set_stopping(&self) {
        self.lock().stopping = true;
    }

    /// Other weights are in use.
    pub fn set_model(&self, model: ModelIdentity) {
        self.lock().model = model;
    }

    /// The weights in use.
    pub fn model(&self) -> ModelIdentity {
        self.lock().model.clone()
    }

    /// The loaded scenes and which one is in use.
    pub fn set_scenes(&self, (scenes, active): (Vec<SceneIdentity>, Option<usize>)) {
        let mut inner = self.lock();
        (inner.scenes, inner.active_scene) = (scenes, active);
    }

    /// An error that an operator should see.
    pub fn report_error(&self, text: impl Into<String>) {
        let mut inner = self.lock();
        inner.errors += 1;
        inner.last_error = Some((monotonic_ns(), text.into()));
    }

    /// A sample with a frame went out.
    pub fn record(&self, status: Status, latency: &StageLatency) {
        let mut inner = self.lock();
        inner.last_status = status;
        inner.latencies.record(latency);
    }

    /// The status message of this moment.
    pub fn status(&self, now: Now) -> DaemonStatus {
        let Identity { boot_id, camera, access, source } = &self.identity;
        let counters = &self.counters;
        let mut inner = self.lock();
        let mut status = DaemonStatus::unknown(*boot_id, camera, *access);
        status.publish_time_ns = now.monotonic_ns;
        status.realtime_offset_ns = now.realtime_offset_ns;
        status.uptime_ns = now.monotonic_ns.saturating_sub(self.started_ns);
        status.health = inner.health(counters.processed.load(Relaxed));
        status.source_state = inner.source;
        status.source = FixedText::new(source);
        status.recording = if inner.recording.is_some() { Recording::ON } else { Recording::OFF };
        status.recording_path = FixedText::new(inner.recording.as_deref().unwrap_or_default());
        status.provenance = if inner.model.trained { Provenance::TRAINED } else { Provenance::UNTRAINED };
        status.model_hash = ContentHash(inner.model.model_hash);
        status.model = FixedText::new(&inner.model.name);
        status.subscribers = counters.subscribers.load(Relaxed);
        status.captured_frames = counters.captured.load(Relaxed);
        status.processed_frames = counters.processed.load(Relaxed);
        status.published_samples = counters.published.load(Relaxed);
        status.dropped_frames = counters.dropped();
        status.bad_frames = counters.bad.load(Relaxed);
        status.refused_frames = counters.refused.load(Relaxed);
        status.reset_epoch = counters.reset_epoch.load(Relaxed);
        let counted = (now.monotonic_ns, status.captured_frames, status.processed_frames);
        (status.capture_rate_hz, status.publish_rate_hz) = inner.rates(counted);
        status.latency = inner.latencies.recent(now.monotonic_ns);
        for (entry, scene) in status.scenes.iter_mut().zip(&inner.scenes) {
            *entry = SceneInfo { name: FixedText::new(&scene.name), hash: ContentHash(scene.hash) };
        }
        status.active_scene = inner.active_scene.map_or(u32::MAX, |index| index as u32);
        status.error_count = inner.errors;
        if let Some((time_ns, text)) = &inner.last_error {
            (status.last_error_time_ns, status.last_error) = (*time_ns, FixedText::new(text));
        }
        status
    }

    /// One line about the whole run.
    pub fn summary(&self) -> String {
        let counters = &self.counters;
        let mut text = format!(
            "{} frames processed of {} captured, {} dropped, {} bad, {} refused, {} samples published",
            counters.processed.load(Relaxed),
            counters.captured.load(Relaxed),
            counters.dropped(),
            counters.bad.load(Relaxed),
            counters.refused.load(Relaxed),
            counters.published.load(Relaxed),
        );
        let (recorded, unrecorded) = (counters.recorded.load(Relaxed), counters.unrecorded.load(Relaxed));
        if recorded + unrecorded > 0 {
            text += &format!("; {recorded} frames recorded, {unrecorded} left out of the recording");
        }
        for (stage, percentiles) in self.lock().latencies.whole().stages() {
            if percentiles.p50_us.is_finite() {
                let ms = |us: f32| us / 1e3;
                text += &format!(
                    "; {stage} p50 {:.2} ms p99 {:.2} ms",
                    ms(percentiles.p50_us),
                    ms(percentiles.p99_us)
                );
            }
        }
        text
    }

    fn lock(&self) -> MutexGuard<'_, Inner> {
        // Plain data: a panic elsewhere leaves nothing half done that matters.
        self.inner.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Inner {
    fn health(&self, processed: u64) -> Health {
        if self.stopping {
            Health::STOPPING
        } else if self.paused {
            Health::PAUSED
        } else if self.source == SourceState::LOST {
            Health::WAITING_FOR_SOURCE
        } else if processed == 0 {
            Health::STARTING
        } else if !self.model.trained || self.last_status != Status::TRACKING {
            Health::DEGRADED
        } else {
            Health::OK
        }
    }

    /// Frames captured and processed per second over the window that ends now.
    fn rates(&mut self, now: (u64, u64, u64)) -> (f64, f64) {
        self.rates.push_back(now);
        while self.rates.len() > 2 && now.0.saturating_sub(self.rates[1].0) >= RATE_WINDOW_NS {
            self.rates.pop_front();
        }
        let first = self.rates[0];
        let seconds = now.0.saturating_sub(first.0) as f64 / 1e9;
        if seconds < 0.1 || now.1 == 0 {
            return (f64::NAN, f64::NAN);
        }
        (now.1.saturating_sub(first.1) as f64 / seconds, now.2.saturating_sub(first.2) as f64 / seconds)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn state(trained: bool) -> State {
        let identity = Identity {
            boot_id: BootId([1; 16]),
            camera: CameraName::default(),
            access: Access::USER,
            source: "a folder".into(),
        };
        let model = ModelIdentity { model_hash: [2; 32], name: "m".into(), trained, scene: None };
        State::new(identity, model)
    }

    fn at(state: &State, ns: u64) -> DaemonStatus {
        state.status(Now { monotonic_ns: ns, realtime_offset_ns: 0 })
    }

    #[test]
    fn health_follows_what_happens() {
        let state = state(true);
        assert_eq!(at(&state, 1).health, Health::STARTING);
        state.counters.processed.store(1, Relaxed);
        state.record(Status::TRACKING, &StageLatency::UNKNOWN);
        assert_eq!(at(&state, 1).health, Health::OK);
        state.record(Status::LOST, &StageLatency::UNKNOWN);
        assert_eq!(at(&state, 1).health, Health::DEGRADED);
        state.set_source(SourceState::LOST);
        assert_eq!(at(&state, 1).health, Health::WAITING_FOR_SOURCE);
        state.set_paused(true);
        assert_eq!(at(&state, 1).health, Health::PAUSED);
        state.set_stopping();
        assert_eq!(at(&state, 1).health, Health::STOPPING);
    }

    #[test]
    fn rates_are_those_of_the_last_seconds() {
        let state = state(false);
        for second in 0..20 {
            state.counters.captured.fetch_add(if second < 10 { 30 } else { 15 }, Relaxed);
            at(&state, second * 1_000_000_000);
        }
        let rate_hz = at(&state, 19_000_000_000).capture_rate_hz;
        assert!((rate_hz - 15.0).abs() < 1e-9, "{rate_hz}");
    }

    #[test]
    fn errors_and_counts_reach_the_status() {
        let state = state(false);
        state.report_error("the cable fell out");
        state.counters.bad.store(2, Relaxed);
        state.counters.slot_dropped.store(3, Relaxed);
        state.counters.source_dropped.store(4, Relaxed);
        let status = at(&state, 1);
        assert_eq!((status.error_count, status.last_error.to_string().as_str()), (1, "the cable fell out"));
        assert_eq!((status.bad_frames, status.dropped_frames, state.counters.missed()), (2, 7, 9));
        assert_eq!(status.provenance, Provenance::UNTRAINED);
        assert!(status.source == "a folder" && status.active_scene == u32::MAX);
    }
}
