//! The contract of [`FrameSource`] as a test suite: [`check`] holds any source to it.
//!
//! ```
//! # use std::time::Duration;
//! # use grnet_frame::{FrameSource, Received, SourceError, SourceInfo, SourceKind};
//! # #[derive(Debug)] struct Nothing;
//! # impl FrameSource for Nothing {
//! #     fn info(&self) -> SourceInfo {
//! #         SourceInfo { name: "nothing".into(), kind: SourceKind::OnDemand, nominal_rate_hz: None, length: Some(0), camera: None }
//! #     }
//! #     fn next_frame(&mut self, _: Duration) -> Result<Received, SourceError> { Ok(Received::End) }
//! #     fn dropped_frames(&self) -> u64 { 0 }
//! # }
//! use grnet_capture::conformance::{Limits, check};
//! let report = check(|| Box::new(Nothing), &Limits::default());
//! assert_eq!(report.frames, 0);
//! ```

use std::time::{Duration, Instant};

use grnet_frame::{Clock, Frame, FrameSource, Received, SourceError, SourceInfo, SourceKind};

/// How far a source is followed.
#[derive(Debug, Clone, PartialEq)]
pub struct Limits {
    /// Frames after which an endless source (a camera, a loop) is left.
    pub frames: u64,
    /// The longest wait for one frame; when it is over the source counts as stuck.
    pub patience: Duration,
    /// How much later than its timeout a call may return: the time to read one frame on a busy machine.
    pub grace: Duration,
}

impl Default for Limits {
    fn default() -> Self {
        Self { frames: 100, patience: Duration::from_secs(20), grace: Duration::from_secs(2) }
    }
}

/// What one run of a source gave.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Report {
    /// Good frames.
    pub frames: u64,
    /// Frames that were unusable.
    pub bad: u64,
    /// Frames that the source lost.
    pub dropped: u64,
    /// Whether it came to its end.
    pub ended: bool,
}

/// Holds a source to the contract of [`FrameSource`]; `open` gives a fresh one at every call.
///
/// Checked are: plausible and constant information; frame numbers that grow strictly, whose gaps the
/// counters explain; times on one clock that never fall; intrinsics that fit the pixels; timeouts that are kept,
/// down to zero; a next frame after a bad one; an end that stays; for a source of known length, that every frame
/// was delivered, bad or dropped; for [`SourceKind::OnDemand`], that nothing is dropped and that two runs
/// give the same frames bit by bit; and that a source can be closed in the middle.
///
/// # Panics
/// When the source breaks the contract; the message says how.
pub fn check(mut open: impl FnMut() -> Box<dyn FrameSource>, limits: &Limits) -> Report {
    closes_in_the_middle(&mut *open(), limits);
    drop_unused(open());
    zero_timeouts_are_enough(&mut *open(), limits);
    let mut source = open();
    let (report, frames) = run(&mut *source, limits);
    if source.info().kind == SourceKind::OnDemand {
        assert_eq!(report.dropped, 0, "{source:?}: an on-demand source drops nothing");
        let (again, frames_again) = run(&mut *open(), limits);
        assert_eq!(report, again, "{source:?}: two runs of an on-demand source count the same");
        for (first, second) in frames.iter().zip(&frames_again) {
            assert!(
                first == second,
                "frame {} differs between two runs: {first:?}, {second:?}",
                first.sequence
            );
        }
    }
    report
}

/// Reads a source to its end, or to the limit, as fast as it gives frames.
fn run(source: &mut dyn FrameSource, limits: &Limits) -> (Report, Vec<Frame>) {
    let info = source.info();
    assert!(!info.name.is_empty(), "a source has a name");
    assert!(info.nominal_rate_hz.is_none_or(|rate_hz| rate_hz.is_finite() && rate_hz > 0.0), "{info:?}");
    let mut report = Report::default();
    let mut frames: Vec<Frame> = Vec::new();
    let mut last_number = None;
    while report.frames + report.bad < limits.frames {
        match next(source, limits) {
            Ok(Received::Frame(frame)) => {
                check_frame(&frame, frames.last(), &info.kind);
                follows(&mut last_number, frame.sequence, source, &report);
                report.frames += 1;
                frames.push(frame);
            }
            Ok(Received::End) => {
                report.ended = true;
                break;
            }
            Ok(Received::Timeout) => panic!("{}: no frame within {:?}", info.name, limits.patience),
            Err(SourceError::BadFrame { sequence, reason, .. }) => {
                assert!(!reason.is_empty(), "frame {sequence} is bad without a reason");
                follows(&mut last_number, sequence, source, &report);
                report.bad += 1;
            }
            Err(error) => panic!("{}: {error}", info.name),
        }
    }
    report.dropped = source.dropped_frames();
    if report.ended {
        for _ in 0..3 {
            let after = source.next_frame(Duration::ZERO);
            assert!(matches!(after, Ok(Received::End)), "{}: {after:?} after the end", info.name);
        }
        if let Some(length) = info.length {
            let counted = report.frames + report.bad + report.dropped;
            assert_eq!(counted, length, "{}: {report:?} do not add up to its length", info.name);
        }
    } else {
        let whole = info.length.is_some_and(|length| length < limits.frames);
        assert!(!whole, "{}: more frames than its length {:?}", info.name, info.length);
    }
    // A camera learns its rate when it is opened.
    let rate_hz = source.info().nominal_rate_hz;
    let completed = SourceInfo { nominal_rate_hz: info.nominal_rate_hz.or(rate_hz), ..info };
    assert_eq!(source.info(), completed, "information stays the same");
    (report, frames)
}

/// One call with the longest timeout, which must be kept.
fn next(source: &mut dyn FrameSource, limits: &Limits) -> Result<Received, SourceError> {
    let begin = Instant::now();
    let received = source.next_frame(limits.patience);
    let took = begin.elapsed();
    assert!(took <= limits.patience + limits.grace, "a call with {:?} took {took:?}", limits.patience);
    received
}

fn check_frame(frame: &Frame, previous: Option<&Frame>, kind: &SourceKind) {
    let number = frame.sequence;
    if *kind == SourceKind::Live {
        let clock = frame.capture_time.clock;
        assert_eq!(clock, Clock::Monotonic, "frame {number}: a live source stamps on the machine's clock");
    }
    if let Some(camera) = &frame.camera {
        let size_px = (frame.pixels.width_px(), frame.pixels.height_px());
        assert_eq!(camera.size_px(), size_px, "frame {number}: intrinsics are for the pixels' size");
    }
    if let Some(previous) = previous {
        let (before, now) = (previous.capture_time, frame.capture_time);
        assert_eq!(before.clock, now.clock, "frame {number}: one clock");
        assert!(now.since(before) >= 0, "frame {number}: time fell by {} ns", before.since(now));
    }
}

/// Numbers grow strictly, and what they skip was counted as dropped.
fn follows(last: &mut Option<u64>, number: u64, source: &dyn FrameSource, report: &Report) {
    if let Some(last) = *last {
        assert!(number > last, "frame {number} after frame {last}");
        let skipped = number - last - 1;
        let dropped = source.dropped_frames();
        assert!(skipped <= dropped, "frame {number} after {last}, but only {dropped} dropped ({report:?})");
    }
    *last = Some(number);
}

fn closes_in_the_middle(source: &mut dyn FrameSource, limits: &Limits) {
    if let Ok(Received::Timeout) = next(source, limits) {
        panic!("{source:?}: no first frame within {:?}", limits.patience);
    }
}

/// Closing a source that was never asked for a frame must not hang.
fn drop_unused(source: Box<dyn FrameSource>) {
    drop(source);
}

/// A consumer that only polls gets frames too, and no call waits.
fn zero_timeouts_are_enough(source: &mut dyn FrameSource, limits: &Limits) {
    let begin = Instant::now();
    loop {
        let call = Instant::now();
        let received = source.next_frame(Duration::ZERO);
        assert!(call.elapsed() <= limits.grace, "a call without timeout took {:?}", call.elapsed());
        match received {
            Ok(Received::Timeout) => {
                assert!(begin.elapsed() < limits.patience, "{source:?}: polling gives no frame");
                std::thread::yield_now();
            }
            Ok(Received::Frame(_) | Received::End) | Err(SourceError::BadFrame { .. }) => return,
            Err(error) => panic!("{error}"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use grnet_frame::{CaptureTime, PixelFormat, Pixels};
    use std::sync::Arc;

    /// A source whose faults are chosen.
    #[derive(Debug, Clone)]
    struct Made {
        steps: Vec<Step>,
        position: usize,
        length: u64,
        dropped: u64,
        after_end: bool,
        level: u8,
    }

    #[derive(Debug, Clone, Copy)]
    enum Step {
        Good { sequence: u64, ns: u64 },
        Bad(u64),
    }

    const fn good(sequence: u64, ns: u64) -> Step {
        Step::Good { sequence, ns }
    }

    fn made(steps: &[Step]) -> Made {
        let length = steps.len() as u64;
        Made { steps: steps.to_vec(), position: 0, length, dropped: 0, after_end: false, level: 0 }
    }

    impl FrameSource for Made {
        fn info(&self) -> SourceInfo {
            SourceInfo {
                name: "made".into(),
                kind: SourceKind::OnDemand,
                nominal_rate_hz: None,
                length: Some(self.length),
                camera: None,
            }
        }

        fn next_frame(&mut self, _: Duration) -> Result<Received, SourceError> {
            let step = self.steps.get(self.position).copied();
            self.position += 1;
            match step {
                Some(Step::Good { sequence, ns }) => Ok(Received::Frame(Frame {
                    pixels: Arc::new(Pixels::packed(PixelFormat::Gray8, 1, 1, vec![self.level]).unwrap()),
                    capture_time: CaptureTime::recorded(ns),
                    sequence,
                    camera: None,
                })),
                Some(Step::Bad(sequence)) => Err(SourceError::BadFrame {
                    source_name: "made".into(),
                    sequence,
                    reason: "broken".into(),
                }),
                None if self.after_end && self.position > self.steps.len() + 1 => Ok(Received::Timeout),
                None => Ok(Received::End),
            }
        }

        fn dropped_frames(&self) -> u64 {
            self.dropped
        }
    }

    fn verdict(source: Made) -> Result<Report, String> {
        let mut level = 0;
        let open = || -> Box<dyn FrameSource> {
            level += source.level;
            Box::new(Made { level, ..source.clone() })
        };
        std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| check(open, &Limits::default())))
            .map_err(|panic| panic.downcast_ref::<String>().cloned().unwrap_or_default())
    }

    #[test]
    fn a_good_source_passes() {
        let report = verdict(made(&[good(0, 5), Step::Bad(1), good(2, 5), good(3, 9)])).unwrap();
        assert_eq!(report, Report { frames: 3, bad: 1, dropped: 0, ended: true });
    }

    #[test]
    fn every_breach_is_found() {
        let two = made(&[good(0, 5), good(1, 6)]);
        for (source, message) in [
            (made(&[good(1, 5), good(1, 6)]), "frame 1 after frame 1"),
            (made(&[good(1, 5), Step::Bad(0)]), "frame 0 after frame 1"),
            (made(&[good(0, 5), good(1, 4)]), "time fell by 1 ns"),
            (made(&[good(0, 5), good(2, 6)]), "but only 0 dropped"),
            (Made { length: 3, ..two.clone() }, "do not add up"),
            (Made { dropped: 1, length: 3, ..two.clone() }, "drops nothing"),
            (Made { after_end: true, ..two.clone() }, "after the end"),
            (Made { level: 1, ..two }, "differs between two runs"),
        ] {
            let found = verdict(source).unwrap_err();
            assert!(found.contains(message), "{message}: {found}");
        }
    }
}
