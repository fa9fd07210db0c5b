//! The capture thread: asks the source for frames and says at once when there are none.

use std::sync::Arc;
use std::sync::atomic::Ordering::Relaxed;
use std::time::{Duration, Instant};

use crossbeam_channel::{Receiver, Sender, select};
use grnet_frame::{CaptureTime, Frame, FrameSource, Received, SourceError, SourceKind};
use grnet_proto::SourceState;

use crate::activity::Activity;
use crate::failure::Failure;
use crate::repeats::Repeats;
use crate::service_manager::ServiceManager;
use crate::slot::{Sent, SlotSender};
use crate::state::State;
use crate::stop::Stop;

/// Longest wait for a frame before the stop is looked at.
const WAIT: Duration = Duration::from_millis(100);

/// Between two tries to get a lost source back; "poses within a second of its return" needs it short.
const FIRST_PAUSE: Duration = Duration::from_millis(20);
const LONGEST_PAUSE: Duration = Duration::from_millis(250);

/// A frame with what happened to the source before it.
#[derive(Debug)]
pub struct Captured {
    /// The frame.
    pub frame: Frame,
    /// How often the source was lost before: when it grows, motion since the frame before is not known.
    pub losses: u64,
    /// How often there were no frames before, losses included: older results are not published any more.
    pub outages: u64,
}

/// The source gives no frames: the number of this outage, from 1.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Outage(pub u64);

/// What the capture thread works with.
#[derive(Debug)]
pub struct Capture {
    /// Where frames come from.
    pub source: Box<dyn FrameSource>,
    /// Added to every time of capture, ns.
    pub time_offset_ns: i64,
    /// How long a live source may be silent.
    pub silence: Duration,
    /// Gets one message when frames may be read.
    pub gate: Receiver<()>,
    /// Frames to the worker.
    pub frames: SlotSender<Captured>,
    /// Outages to the publisher.
    pub outages: Sender<Outage>,
    /// What is counted.
    pub state: Arc<State>,
    /// Is told when the daemon waits for its source.
    pub manager: Arc<ServiceManager>,
    /// Ends the thread.
    pub stop: Stop,
    /// Shows progress.
    pub activity: Activity,
}

/// Reads frames until the recording ends or the stop comes.
///
/// # Errors
/// When the source can never give a frame as configured.
pub fn run(capture: Capture) -> Result<(), Failure> {
    select! {
        recv(capture.gate) -> opened => if opened.is_err() {
            return Ok(());
        },
        recv(capture.stop.channel()) -> _ => return Ok(()),
    }
    Watch::new(capture).run()
}

struct Watch {
    capture: Capture,
    is_live: bool,
    name: String,
    last_good: Instant,
    /// Frames are missing, and everybody knows.
    is_out: bool,
    /// In this outage the source said that it is lost.
    is_loss: bool,
    losses: u64,
    outages: u64,
    pause: Duration,
    dropped_before: u64,
    bad: Repeats,
    lost: Repeats,
}

impl Watch {
    fn new(capture: Capture) -> Self {
        let info = capture.source.info();
        Self {
            is_live: info.kind == SourceKind::Live,
            name: info.name,
            capture,
            last_good: Instant::now(),
            is_out: false,
            is_loss: false,
            losses: 0,
            outages: 0,
            pause: FIRST_PAUSE,
            dropped_before: 0,
            bad: Repeats::default(),
            lost: Repeats::default(),
        }
    }

    fn run(mut self) -> Result<(), Failure> {
        while !self.capture.stop.is_stopped() {
            self.capture.activity.work();
            let received = self.capture.source.next_frame(WAIT);
            self.capture.activity.wait();
            self.count_drops();
            match received {
                Ok(Received::Frame(frame)) => {
                    if self.good(frame) == Sent::Stopped {
                        return Ok(());
                    }
                }
                Ok(Received::Timeout) => {}
                Ok(Received::End) => {
                    tracing::info!(source = self.name, "the recording has ended");
                    self.capture.state.set_source(SourceState::ENDED);
                    return Ok(());
                }
                Err(error @ SourceError::BadFrame { .. }) => self.bad_frame(&error),
                Err(error @ SourceError::Lost { .. }) => self.lost(&error),
                Err(error @ SourceError::Unusable { .. }) => return Err(Failure::config(error)),
            }
            self.notice_silence();
        }
        Ok(())
    }

    fn good(&mut self, mut frame: Frame) -> Sent {
        let Capture { state, time_offset_ns, frames, stop, .. } = &self.capture;
        state.counters.captured.fetch_add(1, Relaxed);
        let CaptureTime { ns, clock } = frame.capture_time;
        frame.capture_time = CaptureTime { ns: ns.saturating_add_signed(*time_offset_ns), clock };
        self.is_loss = false;
        if std::mem::take(&mut self.is_out) || state.source() == SourceState::OPENING {
            tracing::info!(source = self.name, sequence = frame.sequence, "frames arrive");
            state.set_source(SourceState::STREAMING);
        }
        let sent = frames.send(Captured { frame, losses: self.losses, outages: self.outages }, stop);
        self.last_good = Instant::now();
        self.pause = FIRST_PAUSE;
        sent
    }

    fn bad_frame(&mut self, error: &SourceError) {
        self.capture.state.counters.bad.fetch_add(1, Relaxed);
        if let Some(times) = self.bad.happened(Instant::now()) {
            tracing::warn!(%error, times, "bad frames were left out");
            self.capture.state.report_error(error.to_string());
        }
    }

    fn lost(&mut self, error: &SourceError) {
        if let Some(times) = self.lost.happened(Instant::now()) {
            tracing::warn!(%error, times, "the source is lost; trying to get it back");
            self.capture.state.report_error(error.to_string());
        }
        // Silence may become a loss, but one outage is at most one loss.
        if !std::mem::replace(&mut self.is_loss, true) {
            self.losses += 1;
        }
        if !self.is_out {
            self.begin_outage("waiting for the camera");
        }
        self.capture.stop.wait(self.pause);
        self.pause = (self.pause * 2).min(LONGEST_PAUSE);
    }

    /// A live source without a good frame for too long is as good as lost for whoever wants poses.
    fn notice_silence(&mut self) {
        if self.is_live && !self.is_out && self.last_good.elapsed() >= self.capture.silence {
            tracing::warn!(source = self.name, silence = ?self.capture.silence, "the source gives no frames");
            self.begin_outage("waiting for frames");
        }
    }

    fn begin_outage(&mut self, why: &str) {
        self.is_out = true;
        self.outages += 1;
        self.capture.state.set_source(SourceState::LOST);
        // The publisher only goes away when everything ends.
        let _ = self.capture.outages.send(Outage(self.outages));
        if self.capture.manager.is_ready() {
            self.capture.manager.status(why);
        } else {
            self.capture.manager.ready(why);
        }
    }

    /// The source counts since it was opened: a smaller number than before means that it was opened again.
    fn count_drops(&mut self) {
        let dropped = self.capture.source.dropped_frames();
        let new = dropped.checked_sub(self.dropped_before).unwrap_or(dropped);
        self.dropped_before = dropped;
        self.capture.state.counters.source_dropped.fetch_add(new, Relaxed);
    }
}
