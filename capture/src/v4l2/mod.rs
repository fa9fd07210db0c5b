//! V4L2 cameras behind [`FrameSource`].
//!
//! A camera that is missing, pulled out or stalled is [`SourceError::Lost`] and every further call tries to get it back;
//! a camera that cannot do what is asked is [`SourceError::Unusable`], unless it once could: then another camera may have
//! taken its name, and the right one may come back. Time stamps are the driver's (`CLOCK_MONOTONIC`;
//! the kernel allows them to lie slightly in the future), sequence numbers too: a gap in them is counted as dropped.
//!
//! Handwritten `unsafe` lives in `stream.rs` and `controls.rs` and nowhere else in this crate.

mod controls;
mod device;
mod list;
mod modes;
mod options;
mod stream;
mod watch;

use std::fmt;
use std::time::{Duration, Instant};

use grnet_frame::{
    CaptureTime, Frame, FrameSource, PixelFormat, Pixels, Received, SourceError, SourceInfo, SourceKind,
};
use v4l::Device;

use self::device::{Agreed, ENODEV, OpenError};
use self::stream::{Filled, Stream};
use self::watch::NodeWatch;
use crate::clock::monotonic_ns;

pub use self::controls::ControlInfo;
pub use self::list::{CameraInfo, list_cameras};
pub use self::modes::Mode;
pub use self::options::V4l2Options;

/// A V4L2 camera.
pub struct V4l2Source {
    options: V4l2Options,
    watch: NodeWatch,
    state: State,
    counter: Counter,
    dropped_frames: u64,
    /// What was agreed at the last opening.
    agreed: Option<Agreed>,
}

enum State {
    Closed,
    /// The device stays open as long as its stream: closing it would end the stream.
    Open {
        stream: Stream,
        last_frame: Instant,
        _device: Device,
    },
}

impl fmt::Debug for V4l2Source {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let open = matches!(self.state, State::Open { .. });
        f.debug_struct("V4l2Source")
            .field("device", &self.options.device)
            .field("open", &open)
            .finish_non_exhaustive()
    }
}

impl V4l2Source {
    /// A source that opens its camera at the first call of [`FrameSource::next_frame`].
    pub fn new(options: V4l2Options) -> Self {
        let watch = NodeWatch::new(&options.device);
        Self {
            options,
            watch,
            state: State::Closed,
            counter: Counter::default(),
            dropped_frames: 0,
            agreed: None,
        }
    }

    /// Opens the camera, agrees on everything that is asked and closes it again: what `grnetd check` does.
    ///
    /// # Errors
    /// [`SourceError::Lost`] when it is not there or busy, [`SourceError::Unusable`] when it cannot do what is asked.
    pub fn probe(options: &V4l2Options) -> Result<String, SourceError> {
        let source = Self::new(options.clone());
        let (_, agreed) = source.open_device()?;
        Ok(agreed.describe())
    }

    fn name(&self) -> String {
        self.options.device.display().to_string()
    }

    fn lost(&self, reason: impl Into<String>) -> SourceError {
        SourceError::Lost { source_name: self.name(), reason: reason.into() }
    }

    fn source_error(&self, error: OpenError) -> SourceError {
        match error {
            OpenError::Unavailable(reason) => self.lost(reason),
            OpenError::Unfit(reason) if self.agreed.is_some() => self.lost(reason),
            OpenError::Unfit(reason) => SourceError::Unusable { source_name: self.name(), reason },
        }
    }

    fn open_device(&self) -> Result<(Device, Agreed), SourceError> {
        let (device, agreed) = device::open(&self.options).map_err(|e| self.source_error(e))?;
        if let Some(camera) =
            self.options.camera.filter(|c| c.size_px() != (agreed.width_px, agreed.height_px))
        {
            let (w, h) = camera.size_px();
            return Err(self.source_error(OpenError::Unfit(format!(
                "it gives {}x{} and source.intrinsics are for {w}x{h}; set source.size_px to that size, or calibrate at the \
                 size that is captured",
                agreed.width_px, agreed.height_px
            ))));
        }
        Ok((device, agreed))
    }

    fn open(&mut self) -> Result<(), SourceError> {
        let (device, agreed) = self.open_device()?;
        let stream = Stream::start(&device, self.options.buffers).map_err(|e| {
            self.lost(format!("its stream does not start: {}", device::unavailable(&self.options.device, &e)))
        })?;
        self.counter.reopened();
        self.agreed = Some(agreed);
        self.state = State::Open { stream, last_frame: Instant::now(), _device: device };
        Ok(())
    }
}

impl V4l2Source {
    /// Opens the camera, and waits for one that is not there, at most for `timeout`.
    fn get_back(&mut self, timeout: Duration) -> Result<(), SourceError> {
        let Err(error) = self.open() else { return Ok(()) };
        if !matches!(error, SourceError::Lost { .. }) || timeout.is_zero() {
            return Err(error);
        }
        // Absent: wake when the node comes. Present but busy or not yet permitted: look again soon.
        if self.options.device.exists() {
            self.watch.sleep(timeout.min(Duration::from_millis(200)));
            return Err(error);
        }
        if self.watch.wait(timeout) { self.open() } else { Err(error) }
    }
}

impl FrameSource for V4l2Source {
    fn info(&self) -> SourceInfo {
        SourceInfo {
            name: self.name(),
            kind: SourceKind::Live,
            // What the driver has said, once it was asked.
            nominal_rate_hz: self.agreed.and_then(|agreed| agreed.rate_hz),
            length: None,
            camera: self.options.camera,
        }
    }

    fn next_frame(&mut self, timeout: Duration) -> Result<Received, SourceError> {
        let deadline = Instant::now() + timeout;
        if matches!(self.state, State::Closed) {
            self.get_back(timeout)?;
        }
        let (State::Open { stream, last_frame, .. }, Some(agreed)) = (&mut self.state, self.agreed) else {
            unreachable!("opened above")
        };
        let left = deadline.saturating_duration_since(Instant::now());
        let camera = self.options.camera;
        let read = stream.next(left, |filled| (filled.sequence, frame(&filled, &agreed)));
        match read {
            Ok(None) if last_frame.elapsed() > self.options.stall_timeout => {
                self.state = State::Closed;
                let stall_timeout = self.options.stall_timeout;
                Err(self
                    .lost(format!("no frame for {} ms: the stream has stalled", stall_timeout.as_millis())))
            }
            Ok(None) => Ok(Received::Timeout),
            Ok(Some((driver_sequence, result))) => {
                *last_frame = Instant::now();
                let (sequence, skipped) = self.counter.next(driver_sequence);
                self.dropped_frames += skipped;
                match result {
                    Ok((pixels, capture_time)) => {
                        Ok(Received::Frame(Frame { pixels: pixels.into(), capture_time, sequence, camera }))
                    }
                    Err(reason) => Err(SourceError::BadFrame { source_name: self.name(), sequence, reason }),
                }
            }
            Err(error) => {
                self.state = State::Closed;
                Err(self.lost(match error.raw_os_error() {
                    Some(ENODEV) => "unplugged".to_owned(),
                    _ => format!("streaming failed: {error}"),
                }))
            }
        }
    }

    fn dropped_frames(&self) -> u64 {
        self.dropped_frames
    }
}

impl Agreed {
    fn describe(&self) -> String {
        let rate = self.rate_hz.map_or(String::new(), |hz| format!(" at {hz:.2} Hz"));
        format!("{}x{} {}{rate}", self.width_px, self.height_px, self.format)
    }
}

fn frame(filled: &Filled<'_>, agreed: &Agreed) -> Result<(Pixels, CaptureTime), String> {
    if filled.corrupt {
        return Err("the driver flagged its data as corrupt".into());
    }
    if agreed.format == PixelFormat::Jpeg && !filled.bytes.starts_with(&[0xff, 0xd8]) {
        return Err(format!("{} bytes that do not start like a JPEG", filled.bytes.len()));
    }
    let stamp_ns = filled.monotonic_ns.unwrap_or_else(monotonic_ns);
    let capture_time = CaptureTime::monotonic(stamp_ns);
    let data = filled.bytes.to_vec();
    let pixels = Pixels::strided(agreed.format, agreed.width_px, agreed.height_px, agreed.stride_bytes, data);
    Ok((pixels.map_err(|e| e.to_string())?, capture_time))
}

/// Extends the driver's 32-bit counter, which restarts with every stream, to one that always grows.
#[derive(Debug, Default)]
struct Counter {
    next: u64,
    last_driver: Option<u32>,
}

impl Counter {
    fn reopened(&mut self) {
        self.last_driver = None;
    }

    /// The sequence number of this frame and how many the driver skipped before it.
    fn next(&mut self, driver: u32) -> (u64, u64) {
        // A counter that does not grow belongs to a driver that has none: count the frames themselves.
        let skipped = match self.last_driver.map(|last| driver.wrapping_sub(last)) {
            Some(step @ 1..=0x7fff_ffff) => u64::from(step - 1),
            _ => 0,
        };
        self.last_driver = Some(driver);
        let sequence = self.next + skipped;
        self.next = sequence + 1;
        (sequence, skipped)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_counter_grows_over_gaps_wraps_and_reopening() {
        let mut counter = Counter::default();
        assert_eq!(counter.next(7), (0, 0));
        assert_eq!(counter.next(10), (3, 2));
        counter.reopened();
        assert_eq!(counter.next(0), (4, 0));
        counter.last_driver = Some(u32::MAX);
        assert_eq!(counter.next(1), (6, 1));
        assert_eq!(counter.next(1), (7, 0), "a driver that does not count");
    }

    #[test]
    fn a_missing_camera_is_lost_with_the_remedy_and_does_not_outlast_the_timeout() {
        let mut source = V4l2Source::new(V4l2Options::new("/dev/grnet-test-no-such-camera"));
        let error = source.next_frame(Duration::from_millis(10)).unwrap_err();
        assert!(matches!(error, SourceError::Lost { .. }));
        assert!(error.to_string().contains("grnetd devices"), "{error}");
    }

    #[test]
    fn a_file_that_is_no_camera_is_an_error_of_its_own() {
        let file = tempfile::NamedTempFile::new().unwrap();
        let error = V4l2Source::probe(&V4l2Options::new(file.path())).unwrap_err();
        assert!(error.to_string().contains(&file.path().display().to_string()), "{error}");
    }

    #[test]
    fn corrupt_and_short_buffers_are_refused_with_the_reason() {
        let agreed =
            Agreed { format: PixelFormat::Gray8, width_px: 4, height_px: 2, stride_bytes: 4, rate_hz: None };
        let filled = |bytes, corrupt| Filled { bytes, sequence: 0, monotonic_ns: Some(1_000), corrupt };
        let (pixels, time) = frame(&filled(&[1; 8], false), &agreed).unwrap();
        assert_eq!((pixels.data().len(), time), (8, CaptureTime::monotonic(1_000)));
        assert!(frame(&filled(&[1; 8], true), &agreed).unwrap_err().contains("corrupt"));
        assert!(frame(&filled(&[1; 7], false), &agreed).unwrap_err().contains("needs 8 bytes, found 7"));
        let jpeg = Agreed { format: PixelFormat::Jpeg, ..agreed };
        assert!(frame(&filled(&[1; 7], false), &jpeg).unwrap_err().contains("JPEG"));
    }
}
