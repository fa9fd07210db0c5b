//! The frames of a video file, over all rounds.

use std::sync::Arc;

use grnet_frame::{Pixels, SourceError};

use super::process::{Invocation, Leash, Run};
use super::report::{Event, Stamp};
use crate::play::{Footage, Shot, Undated};

/// Assumed for a file that tells neither times nor a rate.
const DEFAULT_RATE_HZ: f64 = 30.0;

/// What is played.
#[derive(Debug)]
pub(super) struct Plan {
    pub name: String,
    pub invocation: Invocation,
    pub looped: bool,
    pub rate_hz: Option<f64>,
}

/// What the first frame has told.
#[derive(Debug)]
pub(super) struct Opened {
    pub size_px: (u32, u32),
    pub frame_rate_hz: Option<f64>,
    pub about: Vec<String>,
}

/// Reads frame after frame, and starts the program again for the next round.
#[derive(Debug)]
pub(super) struct VideoFootage {
    plan: Plan,
    leash: Leash,
    /// `None` between two rounds and at the end.
    run: Option<Run>,
    is_over: bool,
    size_px: (u32, u32),
    /// Between two frames, where the file does not say.
    interval_ns: u64,
    /// Of the next frame.
    sequence: u64,
    round: Round,
    /// Time of the first frame of all.
    start_ns: u64,
    /// Since then: when the last frame was taken.
    offset_ns: u64,
    spoilt: Option<String>,
    complaint: Option<String>,
}

/// How far a round has come.
#[derive(Debug, Clone, Copy)]
struct Round {
    /// When it began, since the start of the first.
    offset_ns: u64,
    /// Frames that were told, good or bad.
    frames: u64,
    /// Times of its first and its last frame on the file's clock.
    times_ns: Option<(u64, u64)>,
}

impl VideoFootage {
    /// Starts the program and waits until it has told of its first frame.
    pub fn open(plan: Plan, leash: Leash) -> Result<(Self, Opened), String> {
        let mut run = Run::start(&plan.invocation, &leash)?;
        loop {
            let first = run.known().iter().find_map(|event| match event {
                Event::Frame(stamp) => Some(*stamp),
                _ => None,
            });
            if let Some(Stamp { size_px, .. }) = first {
                let summary = run.summary();
                let rate_hz = plan.rate_hz.or(summary.frame_rate_hz).unwrap_or(DEFAULT_RATE_HZ);
                let footage = Self {
                    size_px,
                    interval_ns: (1e9 / rate_hz).round().max(1.0) as u64,
                    sequence: plan.invocation.start_at,
                    round: Round { offset_ns: 0, frames: 0, times_ns: None },
                    start_ns: 0,
                    offset_ns: 0,
                    spoilt: None,
                    complaint: None,
                    is_over: false,
                    run: Some(run),
                    plan,
                    leash,
                };
                let (frame_rate_hz, about) = (summary.frame_rate_hz, summary.about);
                return Ok((footage, Opened { size_px, frame_rate_hz, about }));
            }
            if !run.wait() {
                let start_at = plan.invocation.start_at;
                return Err(match run.finish() {
                    Some(reason) => format!("ffmpeg cannot read it as a video: {reason}"),
                    None if start_at > 0 => {
                        format!("it has no frame {start_at}; set first_frame to an earlier one")
                    }
                    None => "it has no frames".into(),
                });
            }
        }
    }

    /// Time of capture on the file's clock.
    fn time_ns(&self, stamp: &Stamp) -> u64 {
        let index = self.plan.invocation.start_at + self.round.frames;
        match (self.plan.rate_hz, stamp.time_ns, self.round.times_ns) {
            (Some(rate_hz), ..) => (index as f64 * (1e9 / rate_hz)).round() as u64,
            (None, Some(time_ns), _) => time_ns,
            (None, None, Some((_, last_ns))) => last_ns.saturating_add(self.interval_ns),
            (None, None, None) => index.saturating_mul(self.interval_ns),
        }
    }

    /// Enters a frame's time; an error when it lies before the last one's.
    fn enter(&mut self, stamp: &Stamp) -> Result<(), String> {
        let time_ns = self.time_ns(stamp);
        self.round.frames += 1;
        let (first_ns, last_ns) = self.round.times_ns.unwrap_or((time_ns, time_ns));
        if time_ns < last_ns {
            let (now, before) = (time_ns as f64 * 1e-9, last_ns as f64 * 1e-9);
            return Err(format!("its time is {now:.6} s, before that of its predecessor ({before:.6} s)"));
        }
        if self.round.times_ns.is_none() && self.round.offset_ns == 0 {
            self.start_ns = time_ns;
        }
        self.round.times_ns = Some((first_ns, time_ns));
        self.offset_ns = self.round.offset_ns.saturating_add(time_ns - first_ns);
        Ok(())
    }

    fn frame(&mut self, stamp: Stamp) -> Shot {
        let entered = self.enter(&stamp);
        let spoilt = self.spoilt.take();
        let Some(pixels) = self.run.as_mut().and_then(|run| run.pixels(stamp.length_bytes())) else {
            return self.bad("it is cut off: the video ends in the middle of it".into());
        };
        if let Err(reason) = entered {
            return self.bad(reason);
        }
        if let Some(reason) = spoilt {
            return self.bad(reason);
        }
        if stamp.size_px != self.size_px {
            let ((width, height), (first_width, first_height)) = (stamp.size_px, self.size_px);
            return self.bad(format!(
                "found {width}x{height} pixels, expected {first_width}x{first_height} as in the rest of the video"
            ));
        }
        match Pixels::packed(stamp.format, stamp.size_px.0, stamp.size_px.1, pixels) {
            Ok(pixels) => {
                self.complaint = None;
                let sequence = self.number();
                self.shot(Ok(Undated { pixels: Arc::new(pixels), sequence, camera: None }))
            }
            Err(error) => self.bad(error.to_string()),
        }
    }

    fn bad(&mut self, reason: String) -> Shot {
        let sequence = self.number();
        self.complaint = None;
        self.shot(Err(SourceError::BadFrame { source_name: self.plan.name.clone(), sequence, reason }))
    }

    fn number(&mut self) -> u64 {
        self.sequence += 1;
        self.sequence - 1
    }

    fn shot(&self, frame: Result<Undated, SourceError>) -> Shot {
        let recorded_ns = self.start_ns.saturating_add(self.offset_ns);
        Shot { offset_ns: self.offset_ns, recorded_ns, frame }
    }

    /// The program has ended: what is left to be said about that.
    fn round_over(&mut self) -> Option<Shot> {
        let failed = self.run.take().and_then(Run::finish);
        if self.leash.is_over() {
            self.is_over = true;
            return None;
        }
        let Some((first_ns, last_ns)) = self.round.times_ns else {
            return Some(self.unusable("it gave no frame any more".into()));
        };
        self.is_over = !self.plan.looped;
        self.round = Round {
            offset_ns: self
                .round
                .offset_ns
                .saturating_add(last_ns - first_ns)
                .saturating_add(self.interval_ns),
            frames: 0,
            times_ns: None,
        };
        let complaint = self.complaint.take();
        failed.or(complaint).map(|reason| self.bad(format!("the video ends early: {reason}")))
    }

    fn unusable(&mut self, reason: String) -> Shot {
        self.is_over = true;
        let source_name = self.plan.name.clone();
        self.shot(Err(SourceError::Unusable { source_name, reason }))
    }
}

impl Footage for VideoFootage {
    const MOST_LAG_NS: u64 = 500_000_000;

    fn skip_to(&mut self, elapsed_ns: u64) -> u64 {
        let mut skipped = 0;
        while let Some(run) = &mut self.run {
            let mut known = run.known().iter();
            let (Some(Event::Frame(stamp)), Some(Event::Frame(next))) = (known.next(), known.next()) else {
                break;
            };
            let (stamp, next) = (*stamp, *next);
            let Some((first_ns, _)) = self.round.times_ns else { break };
            let ahead = Round { frames: self.round.frames + 1, ..self.round };
            let here = std::mem::replace(&mut self.round, ahead);
            let next_ns = self.time_ns(&next);
            self.round = here;
            let due_ns = self.round.offset_ns.saturating_add(next_ns.saturating_sub(first_ns));
            // A damaged frame, or one whose time falls, is told and not passed over.
            if due_ns > elapsed_ns || self.spoilt.is_some() || stamp.size_px != self.size_px {
                break;
            }
            if self.enter(&stamp).is_err() {
                self.round.frames -= 1;
                break;
            }
            if let Some(run) = &mut self.run {
                // Taken from the front that was looked at.
                let _ = run.event();
                run.pass(stamp.length_bytes());
            }
            self.sequence += 1;
            skipped += 1;
        }
        skipped
    }

    fn next(&mut self) -> Option<Shot> {
        loop {
            if self.is_over {
                return None;
            }
            let run = match &mut self.run {
                Some(run) => run,
                none => match Run::start(&self.plan.invocation, &self.leash) {
                    Ok(run) => none.insert(run),
                    Err(_) if self.leash.is_over() => return None,
                    Err(reason) => return Some(self.unusable(reason)),
                },
            };
            match run.event() {
                Some(Event::Frame(stamp)) => return Some(self.frame(stamp)),
                Some(Event::Lost(reason)) => return Some(self.bad(reason)),
                Some(Event::Spoilt(reason)) => self.spoilt = Some(reason),
                Some(Event::Complaint(reason)) => self.complaint = Some(reason),
                None => {
                    if let Some(shot) = self.round_over() {
                        return Some(shot);
                    }
                }
            }
        }
    }
}
