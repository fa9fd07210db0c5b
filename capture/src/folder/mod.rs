//! Plays a [`Recording`] as a [`FrameSource`].

mod reader;
mod schedule;

use std::sync::Arc;
use std::time::Duration;

use grnet_frame::{FrameSource, Received, SourceError, SourceInfo};

use crate::dataset::{RecordedFrame, Recording};
use crate::play::{Pace, Player};
use reader::Reader;
use schedule::Schedule;

/// What part of a recording is played, and how.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FolderOptions {
    /// How fast.
    pub pace: Pace,
    /// Start again after the last frame, for ever.
    pub looped: bool,
    /// Index of the first frame to be played.
    pub start_at: usize,
    /// Number of frames to be played, in each round; `None`: all to the end.
    pub limit: Option<usize>,
}

impl Default for FolderOptions {
    fn default() -> Self {
        Self { pace: Pace::Realtime, looped: false, start_at: 0, limit: None }
    }
}

/// A recording being played.
///
/// * [`Pace::Max`] is [`SourceKind::OnDemand`](grnet_frame::SourceKind::OnDemand): frames carry the recorded times, a few are decoded ahead by a
///   thread, none is dropped.
/// * [`Pace::Realtime`] and [`Pace::Factor`] are [`SourceKind::Live`](grnet_frame::SourceKind::Live) and behave like a camera: the first call
///   of `next_frame` starts the recording (once its first frame is decoded), frames come when they are due,
///   each is stamped with its due moment on `CLOCK_MONOTONIC`, and one that is not fetched before the next is
///   due is replaced by it and counted as dropped. A thread decodes ahead, so that decoding delays nothing; when
///   it cannot keep up it skips to the newest frame that is due and counts those between.
///
/// The sequence number of a frame is its index in the recording and grows on when looping; so does time, with
/// one frame interval between rounds. An image that cannot be decoded, or whose size differs from the
/// recording's, is a [`SourceError::BadFrame`]; the next follows. Every frame ends as exactly one of delivered,
/// bad, or dropped. Dropping the source stops its thread.
///
/// ```no_run
/// use std::time::Duration;
/// use grnet_capture::{FolderSource, Pace, dataset};
/// use grnet_frame::{FrameSource, Received};
///
/// let recording = dataset::open_one("recordings/hall".as_ref(), &Default::default())?;
/// let mut source = FolderSource::new(recording, Pace::Max, false)?;
/// while let Received::Frame(frame) = source.next_frame(Duration::from_secs(1))? {
///     println!("{} at {} ns", frame.sequence, frame.capture_time.ns);
/// }
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Debug)]
pub struct FolderSource {
    info: SourceInfo,
    schedule: Schedule,
    size_px: Option<(u32, u32)>,
    pace: Pace,
    player: Option<Player>,
}

impl FolderSource {
    /// Plays the whole recording.
    ///
    /// # Errors
    /// See [`FolderSource::with_options`].
    pub fn new(recording: Recording, pace: Pace, looped: bool) -> Result<Self, SourceError> {
        Self::with_options(recording, FolderOptions { pace, looped, ..FolderOptions::default() })
    }

    /// Plays a recording as the options say.
    ///
    /// # Errors
    /// [`SourceError::Unusable`] when no frame is left to be played, when a factor is no positive number, or
    /// when the recording's times fall.
    pub fn with_options(recording: Recording, options: FolderOptions) -> Result<Self, SourceError> {
        let unusable = |reason: String| SourceError::Unusable { source_name: recording.name.clone(), reason };
        options.pace.check().map_err(&unusable)?;
        let count = recording.frames.len();
        let available = count.saturating_sub(options.start_at);
        let length = options.limit.unwrap_or(available).min(available);
        if length == 0 {
            return Err(unusable(format!(
                "nothing to play: start_at is {}, limit is {:?}, and the recording has {count} frames",
                options.start_at, options.limit
            )));
        }
        if let Some(pair) = recording.frames.windows(2).find(|pair| pair[1].time_ns < pair[0].time_ns) {
            return Err(unusable(format!(
                "the time of {} lies before its predecessor's",
                pair[1].path.display()
            )));
        }
        let frames: Arc<[RecordedFrame]> =
            recording.frames.into_iter().skip(options.start_at).take(length).collect();
        // A single frame without a known rate is looped at 1 Hz.
        let interval_ns = (1e9 / recording.nominal_rate_hz.unwrap_or(1.0)).round().max(1.0) as u64;
        let schedule = Schedule {
            name: recording.name.clone(),
            period_ns: (frames[length - 1].time_ns - frames[0].time_ns).saturating_add(interval_ns),
            frames,
            camera: recording.camera,
            start_at: options.start_at as u64,
            looped: options.looped,
        };
        let info = SourceInfo {
            name: recording.name,
            kind: options.pace.kind(),
            nominal_rate_hz: recording.nominal_rate_hz.map(|rate_hz| rate_hz * options.pace.factor()),
            length: schedule.length(),
            camera: recording.camera,
        };
        let size_px = recording.camera.map(|camera| camera.size_px()).or(recording.image_size_px);
        Ok(Self { info, schedule, size_px, pace: options.pace, player: None })
    }

    /// The recorded frame, with its true pose, behind a sequence number that this source has given.
    pub fn recorded_frame(&self, sequence: u64) -> Option<&RecordedFrame> {
        let step = sequence.checked_sub(self.schedule.start_at)?;
        self.schedule.step(step).map(|step| step.frame)
    }
}

impl FrameSource for FolderSource {
    /// In `nominal_rate_hz` the rate on the clock of the frames' times: for [`Pace::Max`] the recorded one.
    fn info(&self) -> SourceInfo {
        self.info.clone()
    }

    fn next_frame(&mut self, timeout: Duration) -> Result<Received, SourceError> {
        let player = match &mut self.player {
            Some(player) => player,
            // A thread that could not be started now may be started by a later call.
            waiting => {
                let reader = Reader { schedule: self.schedule.clone(), size_px: self.size_px, step: 0 };
                waiting.insert(Player::start(reader, self.pace, &self.info.name)?)
            }
        };
        player.next(timeout, &self.info.name)
    }

    fn dropped_frames(&self) -> u64 {
        self.player.as_ref().map_or(0, Player::dropped)
    }
}
