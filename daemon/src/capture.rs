//! The capture thread: asks the source for frames and says at once when there are none.

use std::sync::Arc;
use std::sync::atomic::Ordering::Relaxed;
use std::time::{Duration, Instant};

use crossbeam_channel::{Receiver, Sender, select};
use grnet_frame::{CaptureTime, Frame, FrameSource, Received, SourceError, SourceKind};
use grnet_proto::SourceState;

use crate::activity::Activity;
use crate::failure::Failure;
use crate::record::Tap;
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
    /// Frames to the disk, while a recording is on.
    pub tap: Tap,
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
                    self.capture.tap.drain();
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
        let Capture { state, time_offset_ns, frames, stop, manager, tap, .. } = &self.capture;
        state.counters.captured.fetch_add(1, Relaxed);
        let CaptureTime { ns, clock } = frame.capture_time;
        frame.capture_time = CaptureTime { ns: ns.saturating_add_signed(*time_offset_ns), clock };
        self.is_loss = false;
        let is_back = std::mem::take(&mut self.is_out);
        if is_back || state.source() == SourceState::OPENING {
            tracing::info!(source = self.name, sequence = frame.sequence, "frames arrive");
            state.set_source(SourceState::STREAMING);
        }
        if is_back {
            manager.status("publishing poses");
        }
        tap.offer(&frame);
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

#[cfg(test)]
mod tests {
    use std::collections::VecDeque;

    use crossbeam_channel::{bounded, unbounded};
    use grnet_frame::{PixelFormat, Pixels, SourceInfo};
    use grnet_proto::{Access, BootId, CameraName};

    use super::*;
    use crate::failure::Kind;
    use crate::record::tap;
    use crate::scenes::ModelIdentity;
    use crate::slot::{WhenFull, slot};
    use crate::state::Identity;

    #[derive(Debug, Clone, Copy)]
    enum Step {
        Frame(u64),
        Timeout,
        Bad,
        Lost,
        Unusable,
        /// The source's own count of drops from now on.
        Dropped(u64),
    }

    #[derive(Debug)]
    struct Script {
        kind: SourceKind,
        steps: VecDeque<Step>,
        dropped: u64,
    }

    impl FrameSource for Script {
        fn info(&self) -> SourceInfo {
            let name = "script".into();
            SourceInfo { name, kind: self.kind, nominal_rate_hz: None, length: None, camera: None }
        }

        fn next_frame(&mut self, timeout: Duration) -> Result<Received, SourceError> {
            let (source_name, reason) = ("script".to_owned(), "as told".to_owned());
            match self.steps.pop_front() {
                None => Ok(Received::End),
                Some(Step::Frame(sequence)) => {
                    let pixels = Pixels::packed(PixelFormat::Gray8, 1, 1, vec![0]).unwrap();
                    let capture_time = CaptureTime::monotonic(sequence * 1000);
                    Ok(Received::Frame(Frame { pixels: pixels.into(), capture_time, sequence, camera: None }))
                }
                Some(Step::Timeout) => {
                    std::thread::sleep(timeout / 20);
                    Ok(Received::Timeout)
                }
                Some(Step::Bad) => Err(SourceError::BadFrame { source_name, sequence: 0, reason }),
                Some(Step::Lost) => Err(SourceError::Lost { source_name, reason }),
                Some(Step::Unusable) => Err(SourceError::Unusable { source_name, reason }),
                Some(Step::Dropped(count)) => {
                    self.dropped = count;
                    Ok(Received::Timeout)
                }
            }
        }

        fn dropped_frames(&self) -> u64 {
            self.dropped
        }
    }

    struct Outcome {
        /// (sequence, ns, losses, outages) of every frame.
        frames: Vec<(u64, u64, u64, u64)>,
        outages: Vec<Outage>,
        state: Arc<State>,
        is_ready: bool,
        result: Result<(), Failure>,
    }

    fn play(kind: SourceKind, steps: &[Step]) -> Outcome {
        let identity = Identity {
            boot_id: BootId::NONE,
            camera: CameraName::default(),
            access: Access::USER,
            source: "script".into(),
        };
        let model = ModelIdentity { model_hash: [0; 32], name: "m".into(), trained: true, scene: None };
        let state = Arc::new(State::new(identity, model));
        let (frames, taken) = slot(WhenFull::Block, Arc::default());
        let (gate, opened) = bounded(1);
        gate.send(()).unwrap();
        let (outages, announced) = unbounded();
        let manager = Arc::new(ServiceManager::default());
        let worker = std::thread::spawn(move || {
            let describe = |c: Captured| (c.frame.sequence, c.frame.capture_time.ns, c.losses, c.outages);
            taken.iter().map(describe).collect::<Vec<_>>()
        });
        let result = run(Capture {
            source: Box::new(Script { kind, steps: steps.iter().copied().collect(), dropped: 0 }),
            time_offset_ns: -7,
            silence: Duration::from_millis(2),
            gate: opened,
            frames,
            tap: tap(kind, 1, false, Stop::default()).0,
            outages,
            state: Arc::clone(&state),
            manager: Arc::clone(&manager),
            stop: Stop::default(),
            activity: Activity::default(),
        });
        let (frames, outages) = (worker.join().unwrap(), announced.iter().collect());
        Outcome { frames, outages, state, is_ready: manager.is_ready(), result }
    }

    #[test]
    fn a_loss_is_announced_once_and_later_frames_carry_it() {
        use Step::{Frame, Lost};
        let outcome = play(SourceKind::OnDemand, &[Frame(1), Lost, Lost, Frame(2), Frame(3), Lost, Frame(4)]);
        assert_eq!(outcome.frames, [(1, 993, 0, 0), (2, 1993, 1, 1), (3, 2993, 1, 1), (4, 3993, 2, 2)]);
        assert_eq!(outcome.outages, [Outage(1), Outage(2)]);
        assert!(outcome.is_ready && outcome.result.is_ok());
        assert_eq!(outcome.state.source(), SourceState::ENDED);
        assert_eq!(outcome.state.counters.captured.load(Relaxed), 4);
    }

    #[test]
    fn silence_is_an_outage_and_no_loss_until_the_source_says_so() {
        use Step::{Frame, Lost, Timeout};
        let steps = [Frame(1), Timeout, Timeout, Frame(2), Timeout, Timeout, Lost, Frame(3)];
        let outcome = play(SourceKind::Live, &steps);
        assert_eq!(outcome.frames, [(1, 993, 0, 0), (2, 1993, 0, 1), (3, 2993, 1, 2)]);
        assert_eq!(outcome.outages, [Outage(1), Outage(2)]);
    }

    #[test]
    fn a_slow_disk_is_no_silence() {
        use Step::{Frame, Timeout};
        let outcome = play(SourceKind::OnDemand, &[Frame(1), Timeout, Timeout, Frame(2)]);
        assert!(outcome.outages.is_empty() && !outcome.is_ready);
        assert_eq!(outcome.frames.len(), 2);
    }

    #[test]
    fn a_bad_frame_is_counted_and_the_next_one_is_used() {
        let outcome = play(SourceKind::OnDemand, &[Step::Bad, Step::Frame(1), Step::Bad, Step::Frame(2)]);
        assert_eq!((outcome.frames.len(), outcome.state.counters.bad.load(Relaxed)), (2, 2));
        assert!(outcome.result.is_ok());
    }

    #[test]
    fn a_source_that_can_never_work_ends_the_daemon_as_a_bad_configuration() {
        let outcome = play(SourceKind::Live, &[Step::Unusable, Step::Frame(1)]);
        assert_eq!(outcome.result.unwrap_err().kind, Kind::Config);
        assert!(outcome.frames.is_empty());
    }

    #[test]
    fn drops_are_summed_over_a_reopened_source() {
        use Step::Dropped;
        let outcome = play(SourceKind::OnDemand, &[Dropped(2), Dropped(3), Dropped(1), Dropped(1)]);
        assert_eq!(outcome.state.counters.source_dropped.load(Relaxed), 4);
    }
}
