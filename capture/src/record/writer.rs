//! The folder that grows frame by frame.

use std::fs::{self, File, OpenOptions};
use std::io::Write as _;
use std::path::{Path, PathBuf};

use grnet_frame::{Clock, Frame};

use super::encode::{Encoded, encode};
use super::manifest::{self, Manifest};
use super::{RecordError, RecordOptions};

/// Frames between two looks at the free space.
const LOOK_EVERY: u64 = 16;

/// What became of a frame.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Written {
    /// It is in the recording.
    Frame,
    /// It was left out: its time is not later than that of the frame before.
    NotLater,
    /// It was left out: no image could be made of it, for this reason.
    Unusable(String),
}

/// A recording in the making.
#[derive(Debug)]
pub struct RecordingWriter {
    folder: PathBuf,
    options: RecordOptions,
    list: File,
    numbers: File,
    manifest: Manifest,
    last_ns: Option<u64>,
    has_camera: bool,
}

impl RecordingWriter {
    /// Begins a recording in `folder`, which has to be new or empty.
    ///
    /// # Errors
    /// See [`RecordError`].
    pub fn create(folder: &Path, options: RecordOptions) -> Result<Self, RecordError> {
        fs::create_dir_all(folder).map_err(RecordError::io("create the folder", folder))?;
        let mut entries = fs::read_dir(folder).map_err(RecordError::io("look into", folder))?;
        if let Some(entry) = entries.next() {
            let entry = entry.map_err(RecordError::io("look into", folder))?;
            let found = entry.file_name().to_string_lossy().into_owned();
            return Err(RecordError::NotEmpty { folder: folder.to_path_buf(), found });
        }
        require_space(folder, options.least_free_bytes)?;
        let images = folder.join("rgb");
        fs::create_dir(&images).map_err(RecordError::io("create the folder", &images))?;
        let manifest = Manifest {
            generator: options.generator.clone(),
            source: options.source.clone(),
            clock: None,
            realtime_offset_ns: options.realtime_offset_ns,
            size_px: None,
            complete: false,
            ended: None,
            frames: 0,
            left_out_queue_full: 0,
            left_out_not_later: 0,
            left_out_unusable: 0,
        };
        put(folder, "README.txt", manifest::README.as_bytes())?;
        put(folder, "recording.json", manifest.json().as_bytes())?;
        let mut numbers = grow(&folder.join("frames.csv"))?;
        append(&mut numbers, &folder.join("frames.csv"), "sequence,capture_time_ns,image\n")?;
        // The file that makes it a recording comes last.
        let mut list = grow(&folder.join("rgb.txt"))?;
        append(&mut list, &folder.join("rgb.txt"), "# time_s image\n")?;
        let has_camera = false;
        Ok(Self { folder: folder.to_path_buf(), options, list, numbers, manifest, last_ns: None, has_camera })
    }

    /// The folder.
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    /// What was written and left out so far.
    pub fn manifest(&self) -> &Manifest {
        &self.manifest
    }

    /// Adds a frame.
    ///
    /// # Errors
    /// [`RecordError`] when the recording cannot go on: the disk is full, or the folder is gone.
    pub fn write(&mut self, frame: &Frame) -> Result<Written, RecordError> {
        let time = frame.capture_time;
        let stamp_ns = match time.clock {
            Clock::Monotonic => time.ns.saturating_add_signed(self.options.realtime_offset_ns),
            Clock::Recorded => time.ns,
        };
        if self.last_ns.is_some_and(|last_ns| stamp_ns <= last_ns) {
            self.manifest.left_out_not_later += 1;
            return Ok(Written::NotLater);
        }
        let Encoded { bytes, extension } = match encode(&frame.pixels, self.options.format) {
            Ok(encoded) => encoded,
            Err(error) => {
                self.manifest.left_out_unusable += 1;
                return Ok(Written::Unusable(error.to_string()));
            }
        };
        if self.manifest.frames.is_multiple_of(LOOK_EVERY) {
            require_space(&self.folder, self.options.least_free_bytes)?;
        }
        self.describe(frame)?;
        let stamp = format!("{}.{:09}", stamp_ns / 1_000_000_000, stamp_ns % 1_000_000_000);
        let image = format!("rgb/{stamp}.{extension}");
        put(&self.folder, &image, &bytes)?;
        let line = format!("{},{},{image}\n", frame.sequence, time.ns);
        append(&mut self.numbers, &self.folder.join("frames.csv"), &line)?;
        append(&mut self.list, &self.folder.join("rgb.txt"), &format!("{stamp} {image}\n"))?;
        self.last_ns = Some(stamp_ns);
        self.manifest.frames += 1;
        Ok(Written::Frame)
    }

    /// Ends the recording, and says what is in it: `why` it ended, and how many frames found the queue full.
    ///
    /// # Errors
    /// [`RecordError::Io`] when the last files cannot be written; the frames are there nevertheless.
    pub fn finish(mut self, why: &str, queue_full: u64) -> Result<Manifest, RecordError> {
        self.manifest.complete = true;
        self.manifest.ended = Some(why.to_owned());
        self.manifest.left_out_queue_full = queue_full;
        put(&self.folder, "recording.json", self.manifest.json().as_bytes())?;
        let list = self.folder.join("rgb.txt");
        self.list.sync_all().map_err(RecordError::io("write", &list))?;
        Ok(self.manifest)
    }

    /// What only a frame knows: clock, size and camera.
    fn describe(&mut self, frame: &Frame) -> Result<(), RecordError> {
        let size_px = (frame.pixels.width_px(), frame.pixels.height_px());
        if self.manifest.size_px.is_none() {
            let clock = match frame.capture_time.clock {
                Clock::Monotonic => "realtime",
                Clock::Recorded => "recorded",
            };
            self.manifest.clock = Some(clock.to_owned());
            self.manifest.size_px = Some(size_px);
            put(&self.folder, "recording.json", self.manifest.json().as_bytes())?;
        }
        let camera = self.options.camera.or(frame.camera).filter(|camera| camera.size_px() == size_px);
        if let Some(camera) = camera.filter(|_| !self.has_camera) {
            put(&self.folder, "camera-intrinsics.txt", manifest::matrix(&camera).as_bytes())?;
            if let Some(text) = manifest::distortion(&camera) {
                put(&self.folder, "camera-distortion.txt", text.as_bytes())?;
            }
            self.has_camera = true;
        }
        Ok(())
    }
}

/// Writes a file of the folder so that under its name it is always whole.
fn put(folder: &Path, name: &str, bytes: &[u8]) -> Result<(), RecordError> {
    let path = folder.join(name);
    let partial = path.with_file_name(".partial");
    fs::write(&partial, bytes).map_err(RecordError::io("write", &path))?;
    fs::rename(&partial, &path).map_err(RecordError::io("write", &path))
}

fn grow(path: &Path) -> Result<File, RecordError> {
    OpenOptions::new().create(true).append(true).open(path).map_err(RecordError::io("create", path))
}

/// One call of the system for one line: a killed process leaves it whole or not at all.
fn append(file: &mut File, path: &Path, line: &str) -> Result<(), RecordError> {
    file.write_all(line.as_bytes()).map_err(RecordError::io("write", path))
}

fn require_space(folder: &Path, least_bytes: u64) -> Result<(), RecordError> {
    let found = rustix::fs::statvfs(folder)
        .map_err(|error| RecordError::io("ask for the free space of", folder)(error.into()))?;
    let free_bytes = found.f_bavail.saturating_mul(found.f_frsize);
    if free_bytes < least_bytes {
        let mib = |bytes: u64| bytes >> 20;
        return Err(RecordError::Full {
            folder: folder.to_path_buf(),
            free_mib: mib(free_bytes),
            least_mib: mib(least_bytes),
        });
    }
    Ok(())
}
