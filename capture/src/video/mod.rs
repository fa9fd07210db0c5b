//! Plays a video file through the ffmpeg program, with the file's own frame times.
//!
//! ffmpeg decodes into a pipe and tells the time of each frame before it writes it; nothing is guessed from a frame
//! rate, so that files of a variable rate are played as they were filmed. It reads the one file and never a network,
//! stands still while nobody takes frames, and ends with the source: also when this process is killed, as its pipe
//! is then closed.

mod footage;
mod process;
mod report;
#[cfg(test)]
mod tests;

use std::fs::File;
use std::path::{Path, PathBuf};
use std::time::Duration;

use grnet_frame::{FrameSource, Received, SourceError, SourceInfo};

use crate::play::{Pace, Player};
use footage::{Plan, VideoFootage};
use process::{Invocation, Leash};

/// What part of a video is played, and how.
#[derive(Debug, Clone, PartialEq)]
pub struct VideoOptions {
    /// How fast.
    pub pace: Pace,
    /// Start again after the last frame, for ever.
    pub looped: bool,
    /// Index of the first frame to be played.
    pub start_at: u64,
    /// Number of frames to be played, in each round; `None`: all to the end.
    pub limit: Option<u64>,
    /// Regular times at this rate instead of the file's own.
    pub rate_hz: Option<f64>,
    /// The program: a path, or a name that is looked for in `PATH`.
    pub ffmpeg: PathBuf,
}

impl Default for VideoOptions {
    fn default() -> Self {
        Self {
            pace: Pace::Realtime,
            looped: false,
            start_at: 0,
            limit: None,
            rate_hz: None,
            ffmpeg: "ffmpeg".into(),
        }
    }
}

/// A video file being played.
///
/// Paces, loops and the numbering of frames are those of [`FolderSource`](crate::FolderSource); frames are
/// `Gray8` where the file is grey, else `Rgb8`, and upright: turned as the file's rotation says. Times of capture
/// start near zero on the recording's clock. Differences to a folder:
///
/// * A frame cannot be reached without decoding those before it: when ffmpeg is more than half a second late at
///   real-time pace, the recording waits for it instead of dropping everything.
/// * A loop starts the program anew, which at real-time pace costs some frames, counted as dropped.
/// * How many frames there are shows at the end only.
///
/// What ffmpeg cannot decode is a [`SourceError::BadFrame`], as is an end in the middle of the file.
///
/// ```no_run
/// use std::time::Duration;
/// use grnet_capture::{VideoOptions, VideoSource};
/// use grnet_frame::{FrameSource, Received};
///
/// let mut source = VideoSource::open("hall.mp4".as_ref(), &VideoOptions::default())?;
/// while let Received::Frame(frame) = source.next_frame(Duration::from_secs(1))? {
///     println!("{} at {} ns", frame.sequence, frame.capture_time.ns);
/// }
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Debug)]
pub struct VideoSource {
    info: SourceInfo,
    pace: Pace,
    size_px: (u32, u32),
    notes: Vec<String>,
    leash: Leash,
    waiting: Option<VideoFootage>,
    player: Option<Player>,
}

impl VideoSource {
    /// Starts ffmpeg on the file and waits for its first frame.
    ///
    /// # Errors
    /// [`SourceError::Unusable`]: the options are wrong, the file cannot be read or is no video, it has no such
    /// frame, or the program is missing.
    pub fn open(path: &Path, options: &VideoOptions) -> Result<Self, SourceError> {
        let name = path.display().to_string();
        let unusable = |reason| SourceError::Unusable { source_name: name.clone(), reason };
        options.pace.check().map_err(unusable)?;
        if let Some(rate_hz) = options.rate_hz.filter(|rate_hz| !(rate_hz.is_finite() && *rate_hz > 0.0)) {
            return Err(unusable(format!("found a rate of {rate_hz} frames/s, expected a positive number")));
        }
        if options.limit == Some(0) {
            return Err(unusable("nothing to play: the limit is 0 frames".into()));
        }
        let file = readable_file(path).map_err(unusable)?;
        let leash = Leash::default();
        let plan = Plan {
            name: name.clone(),
            invocation: Invocation {
                program: options.ffmpeg.clone(),
                file,
                start_at: options.start_at,
                limit: options.limit,
            },
            looped: options.looped,
            rate_hz: options.rate_hz,
        };
        let (footage, opened) = VideoFootage::open(plan, leash.clone()).map_err(unusable)?;
        let info = SourceInfo {
            name: name.clone(),
            kind: options.pace.kind(),
            nominal_rate_hz: options
                .rate_hz
                .or(opened.frame_rate_hz)
                .map(|rate_hz| rate_hz * options.pace.factor()),
            length: None,
            camera: None,
        };
        Ok(Self {
            info,
            pace: options.pace,
            size_px: opened.size_px,
            notes: opened.about,
            leash,
            waiting: Some(footage),
            player: None,
        })
    }

    /// Width and height of the frames, in pixels, upright.
    pub fn size_px(&self) -> (u32, u32) {
        self.size_px
    }

    /// What ffmpeg says about the file: length, codec, rotation.
    pub fn notes(&self) -> &[String] {
        &self.notes
    }
}

/// The file, or why it cannot be read.
fn readable_file(path: &Path) -> Result<File, String> {
    let cannot =
        |error: std::io::Error| format!("the file cannot be read: {error}; check the path and its rights");
    let about = std::fs::metadata(path).map_err(cannot)?;
    if about.is_dir() {
        return Err("it is a folder; give a video file, or play it as a folder of images".into());
    }
    if !about.is_file() {
        return Err("it is no regular file; give a video file".into());
    }
    File::open(path).map_err(cannot)
}

impl FrameSource for VideoSource {
    /// In `nominal_rate_hz` the rate on the clock of the frames' times; `length` is never known.
    fn info(&self) -> SourceInfo {
        self.info.clone()
    }

    fn next_frame(&mut self, timeout: Duration) -> Result<Received, SourceError> {
        if let Some(footage) = self.waiting.take() {
            self.player = Some(Player::start(footage, self.pace, &self.info.name)?);
        }
        match &mut self.player {
            Some(player) => player.next(timeout, &self.info.name),
            None => Err(SourceError::Unusable {
                source_name: self.info.name.clone(),
                reason: "its reading thread could not be started; open it again".into(),
            }),
        }
    }

    fn dropped_frames(&self) -> u64 {
        self.player.as_ref().map_or(0, Player::dropped)
    }
}

impl Drop for VideoSource {
    fn drop(&mut self) {
        // The reading thread may wait for ffmpeg, and is joined after this.
        self.leash.end();
    }
}
