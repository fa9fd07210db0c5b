//! The record thread: writes frames to disk, behind a queue of its own so that a slow disk never slows the poses.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering::Relaxed};
use std::time::{Duration, Instant};

use crossbeam_channel::{Receiver, Sender, TrySendError, bounded, never, select};
use grnet_capture::RecordingWriter;
use grnet_capture::record::{ImageFormat, Manifest, RecordError, RecordOptions, Written};
use grnet_config as config;
use grnet_config::GrnetdConfig;
use grnet_frame::{Frame, SourceKind};
use grnet_proto::Outcome;
use grnet_proto::clock::Now;

use crate::activity::Activity;
use crate::control::Answer;
use crate::failure::Failure;
use crate::repeats::Repeats;
use crate::slot::WhenFull;
use crate::state::{Identity, State};
use crate::stop::Stop;

/// How long frames that wait for the disk are still written when the daemon ends, which has to be quick.
const LAST_WORDS: Duration = Duration::from_millis(500);

/// What operators ask of the recorder.
#[derive(Debug)]
pub enum Ask {
    /// Begin a recording in this folder, or in one named by camera and time.
    Start(Option<PathBuf>),
    /// End it.
    Stop,
    /// Begin later recordings as this one does.
    Configure(Box<Recorder>),
}

/// A request with the place for its answer.
pub type Asked = (Ask, Sender<Answer>);

#[derive(Debug)]
enum Item {
    Frame(Frame),
    /// Answered when everything before it is on disk.
    Mark(Sender<()>),
}

#[derive(Debug, Default)]
struct Shared {
    is_on: AtomicBool,
    /// Frames that found the queue full, in this recording.
    queue_full: AtomicU64,
}

/// Where the capture thread leaves frames for the disk.
#[derive(Debug)]
pub struct Tap {
    items: Sender<Item>,
    when_full: WhenFull,
    shared: Arc<Shared>,
    stop: Stop,
}

/// The other end of a [`Tap`].
#[derive(Debug)]
pub struct Tapped {
    items: Receiver<Item>,
    shared: Arc<Shared>,
}

/// A queue to the disk. A live source leaves out what finds it full; an on-demand source waits, so that its
/// recording has every frame.
pub fn tap(kind: SourceKind, queue_frames: usize, is_on: bool, stop: Stop) -> (Tap, Tapped) {
    let (sender, items) = bounded(queue_frames);
    let shared = Arc::new(Shared { is_on: AtomicBool::new(is_on), ..Shared::default() });
    let tapped = Tapped { items, shared: Arc::clone(&shared) };
    (Tap { items: sender, when_full: WhenFull::from(kind), shared, stop }, tapped)
}

impl Tap {
    /// A frame, for the recording if there is one.
    pub fn offer(&self, frame: &Frame) {
        if !self.shared.is_on.load(Relaxed) {
            return;
        }
        // The pixels are shared, not copied.
        let item = Item::Frame(frame.clone());
        match self.when_full {
            WhenFull::NewestWins => {
                if let Err(TrySendError::Full(_)) = self.items.try_send(item) {
                    self.shared.queue_full.fetch_add(1, Relaxed);
                }
            }
            WhenFull::Block => self.send(item),
        }
    }

    /// Waits until every frame so far is on disk.
    pub fn drain(&self) {
        if self.shared.is_on.load(Relaxed) {
            let (done, written) = bounded(1);
            self.send(Item::Mark(done));
            select! {
                recv(written) -> _ => {}
                recv(self.stop.channel()) -> _ => {}
            }
        }
    }

    fn send(&self, item: Item) {
        select! {
            // Without a record thread the daemon is ending.
            send(self.items, item) -> _ => {}
            recv(self.stop.channel()) -> _ => {}
        }
    }
}

/// Begins recordings as the configuration says.
#[derive(Debug)]
pub struct Recorder {
    options: RecordOptions,
    folder: PathBuf,
    camera_name: String,
}

impl Recorder {
    /// For the source of this daemon.
    pub fn new(config: &GrnetdConfig, identity: &Identity) -> Self {
        let config::RecordConfig { folder, format, least_free_bytes, .. } = config.record.clone();
        let options = RecordOptions {
            format: match format {
                config::ImageFormat::Png => ImageFormat::Png,
                config::ImageFormat::Jpeg { quality } => ImageFormat::Jpeg { quality },
            },
            least_free_bytes,
            realtime_offset_ns: 0,
            camera: config.source.camera,
            generator: format!("grnetd {}", grnet_proto::PACKAGE_VERSION),
            source: identity.source.clone(),
        };
        Self { options, folder, camera_name: config.camera_name.clone() }
    }

    /// Begins a recording whose clock is that of this moment.
    ///
    /// # Errors
    /// See [`RecordError`].
    pub fn begin(&self, folder: &Path) -> Result<RecordingWriter, RecordError> {
        let realtime_offset_ns = Now::read().realtime_offset_ns;
        RecordingWriter::create(folder, RecordOptions { realtime_offset_ns, ..self.options.clone() })
    }

    /// A folder named by camera and time of day (UTC).
    fn new_folder(&self) -> PathBuf {
        let now = Now::read();
        let since_1970_ns = now.monotonic_ns.saturating_add_signed(now.realtime_offset_ns);
        self.folder.join(format!("{}-{}", self.camera_name, utc(since_1970_ns / 1_000_000_000)))
    }
}

/// What the record thread works with.
#[derive(Debug)]
pub struct Record {
    /// Begins recordings.
    pub recorder: Recorder,
    /// The one that is on from the start.
    pub first: Option<RecordingWriter>,
    /// Frames.
    pub tapped: Tapped,
    /// Requests from the control thread.
    pub asked: Receiver<Asked>,
    /// What is told.
    pub state: Arc<State>,
    /// Ends the thread.
    pub stop: Stop,
    /// Never shows work: a disk that hangs is no reason to restart the daemon, whose poses go on.
    pub activity: Activity,
}

/// Records what is asked for until the stop comes.
///
/// # Errors
/// None: a recording that cannot go on is told, and the daemon goes on.
pub fn run(record: Record) -> Result<(), Failure> {
    let Record { recorder, first, tapped, asked, state, stop, .. } = record;
    let mut thread = Thread {
        recorder,
        tapped,
        state,
        writer: None,
        full: Repeats::default(),
        bad: Repeats::default(),
        told: 0,
    };
    if let Some(writer) = first {
        thread.begun(writer);
    }
    loop {
        select! {
            recv(thread.tapped.items) -> item => match item {
                Ok(item) => thread.take(item),
                // The source is gone; requests are answered until the stop.
                Err(_) => thread.tapped.items = never(),
            },
            recv(asked) -> request => match request {
                Ok(request) => thread.answer(request),
                Err(_) => break,
            },
            recv(stop.channel()) -> _ => break,
        }
    }
    thread.end("the daemon ended", Some(LAST_WORDS));
    Ok(())
}

struct Thread {
    recorder: Recorder,
    tapped: Tapped,
    state: Arc<State>,
    writer: Option<RecordingWriter>,
    full: Repeats,
    bad: Repeats,
    /// Frames left out that the counters of the state know of.
    told: u64,
}

impl Thread {
    fn begun(&mut self, writer: RecordingWriter) {
        tracing::info!(folder = %writer.folder().display(), "recording");
        self.tapped.shared.queue_full.store(0, Relaxed);
        self.told = 0;
        self.state.set_recording(Some(writer.folder()));
        self.writer = Some(writer);
        self.tapped.shared.is_on.store(true, Relaxed);
    }

    fn answer(&mut self, (ask, reply): Asked) {
        let answer = match (ask, &self.writer) {
            (Ask::Configure(recorder), _) => {
                self.recorder = *recorder;
                (Outcome::DONE, "the next recording is configured".to_owned())
            }
            (Ask::Start(_), Some(writer)) => (
                Outcome::REFUSED,
                format!("a recording is on in {}: stop it first", writer.folder().display()),
            ),
            (Ask::Start(folder), None) => self.start(folder),
            (Ask::Stop, None) => (Outcome::REFUSED, "nothing is recorded".to_owned()),
            (Ask::Stop, Some(_)) => match self.end("stopped by request", None) {
                Some(done) => (Outcome::DONE, done),
                None => (Outcome::FAILED, "the recording failed before: see the last error".to_owned()),
            },
        };
        // Whoever asked may have gone.
        let _ = reply.send(answer);
    }

    fn start(&mut self, folder: Option<PathBuf>) -> Answer {
        // Frames that came after the end of the recording before.
        while let Ok(item) = self.tapped.items.try_recv() {
            self.take(item);
        }
        let folder = folder.unwrap_or_else(|| self.recorder.new_folder());
        match self.recorder.begin(&folder) {
            Ok(writer) => {
                self.begun(writer);
                (Outcome::DONE, format!("recording into {}", folder.display()))
            }
            Err(error) => (Outcome::FAILED, Failure::config(error).chain()),
        }
    }

    fn take(&mut self, item: Item) {
        match item {
            Item::Frame(frame) => self.write(&frame),
            Item::Mark(done) => {
                // Whoever waits may have been stopped.
                let _ = done.send(());
            }
        }
    }

    fn write(&mut self, frame: &Frame) {
        let Some(writer) = &mut self.writer else { return };
        match writer.write(frame) {
            Ok(Written::Frame) => {
                self.state.counters.recorded.fetch_add(1, Relaxed);
            }
            Ok(Written::NotLater) => self.left_out("its time is not later than that of the frame before"),
            Ok(Written::Unusable(why)) => self.left_out(&why),
            Err(error) => return self.failed(&error),
        }
        let queue_full = self.tapped.shared.queue_full.load(Relaxed);
        self.tell_full(queue_full);
    }

    fn left_out(&mut self, why: &str) {
        self.state.counters.unrecorded.fetch_add(1, Relaxed);
        if let Some(times) = self.bad.happened(Instant::now()) {
            tracing::warn!(why, times, "frames were left out of the recording");
        }
    }

    fn tell_full(&mut self, queue_full: u64) {
        let new = queue_full - self.told;
        if new == 0 {
            return;
        }
        self.told = queue_full;
        self.state.counters.unrecorded.fetch_add(new, Relaxed);
        if self.full.happened(Instant::now()).is_some() {
            tracing::warn!(
                so_far = queue_full,
                "the disk is too slow: frames are left out of the recording; record.format = \"jpeg\" writes less, \
                 record.queue_frames rides out longer delays"
            );
        }
    }

    /// The disk is full or gone: the recording ends, the daemon does not.
    fn failed(&mut self, error: &RecordError) {
        self.tapped.shared.is_on.store(false, Relaxed);
        self.state.set_recording(None);
        self.state.counters.unrecorded.fetch_add(1, Relaxed);
        let queue_full = self.tapped.shared.queue_full.load(Relaxed);
        self.tell_full(queue_full);
        tracing::error!(%error, "the recording has ended: it cannot go on");
        self.state.report_error(format!("the recording has ended: {error}"));
        if let Some(writer) = self.writer.take() {
            let folder = writer.folder().display().to_string();
            match writer.finish(&error.to_string(), queue_full) {
                Ok(manifest) => tracing::info!("{}", summary(&folder, &manifest)),
                // The error before said why already, and the frames are there.
                Err(error) => tracing::debug!(%error, "the recording has no proper end"),
            }
        }
    }

    /// Writes what waits, for at most `limit`, and ends the recording; `None` when there is none, or no more.
    fn end(&mut self, why: &str, limit: Option<Duration>) -> Option<String> {
        self.tapped.shared.is_on.store(false, Relaxed);
        let begun = Instant::now();
        let mut too_late = 0;
        while let Ok(item) = self.tapped.items.try_recv() {
            if limit.is_some_and(|limit| begun.elapsed() > limit) && matches!(item, Item::Frame(_)) {
                too_late += 1;
            } else {
                self.take(item);
            }
        }
        let writer = self.writer.take()?;
        self.state.set_recording(None);
        let queue_full = self.tapped.shared.queue_full.load(Relaxed) + too_late;
        self.tell_full(queue_full);
        let folder = writer.folder().display().to_string();
        match writer.finish(why, queue_full) {
            Ok(manifest) => {
                let text = summary(&folder, &manifest);
                if manifest.left_out() > 0 {
                    tracing::warn!("{text}")
                } else {
                    tracing::info!("{text}")
                }
                Some(text)
            }
            Err(error) => {
                tracing::error!(%error, "the recording has no proper end");
                self.state.report_error(error.to_string());
                None
            }
        }
    }
}

fn summary(folder: &str, manifest: &Manifest) -> String {
    format!(
        "{} frames recorded in {folder}, {} left out ({} found the queue full, {} not later than the frame before, {} \
         no image)",
        manifest.frames,
        manifest.left_out(),
        manifest.left_out_queue_full,
        manifest.left_out_not_later,
        manifest.left_out_unusable
    )
}

/// `20261125T204441Z` for seconds since 1970; the date by Howard Hinnant's `civil_from_days`.
fn utc(seconds: u64) -> String {
    let (days, second) = (seconds / 86_400 + 719_468, seconds % 86_400);
    let (era, day_of_era) = (days / 146_097, days % 146_097);
    let year_of_era = (day_of_era - day_of_era / 1460 + day_of_era / 36_524 - day_of_era / 146_096) / 365;
    let day_of_year = day_of_era - (365 * year_of_era + year_of_era / 4 - year_of_era / 100);
    // Months from March.
    let month = (5 * day_of_year + 2) / 153;
    let day = day_of_year - (153 * month + 2) / 5 + 1;
    let (month, year) = (if month < 10 { month + 3 } else { month - 9 }, era * 400 + year_of_era);
    let year = year + u64::from(month <= 2);
    let (hour, minute) = (second / 3600, second / 60 % 60);
    format!("{year:04}{month:02}{day:02}T{hour:02}{minute:02}{:02}Z", second % 60)
}

#[cfg(test)]
mod tests;
