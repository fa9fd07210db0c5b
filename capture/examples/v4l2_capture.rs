//! Captures from a V4L2 camera and holds what it gives to the contract: the instrument of `make test-vm`, and a first look
//! at a new camera.
//!
//! ```text
//! v4l2_capture list
//! v4l2_capture DEVICE [format=YUYV size=640x480 rate=30 frames=60 seconds=60 stall_ms=2000 control.gain=10 substitutes]
//! v4l2_capture DEVICE conformance [...]
//! ```
//!
//! One line goes out for every event, with the time since the event before; the last line sums up.

use std::error::Error;
use std::process::ExitCode;
use std::time::{Duration, Instant};

use grnet_capture::clock::monotonic_ns;
use grnet_capture::conformance::{Limits, check};
use grnet_capture::v4l2::{V4l2Options, V4l2Source, list_cameras};
use grnet_frame::{FrameSource, PixelFormat, Received, SourceError};

type Failure = Box<dyn Error>;

/// What the arguments ask for.
struct Asked {
    options: V4l2Options,
    frames: u64,
    limit: Duration,
    is_conformance: bool,
}

fn main() -> ExitCode {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let result = match arguments.first().map(String::as_str) {
        Some("list") => {
            list();
            Ok(())
        }
        Some(_) => parse(&arguments)
            .and_then(|asked| if asked.is_conformance { conform(&asked) } else { capture(&asked) }),
        None => {
            Err("usage: v4l2_capture list | DEVICE [conformance] [format=... size=WxH rate=... frames=N ...]"
                .into())
        }
    };
    match result {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            println!("error {error}");
            ExitCode::FAILURE
        }
    }
}

fn parse(arguments: &[String]) -> Result<Asked, Failure> {
    let options = V4l2Options::new(&arguments[0]);
    let mut asked = Asked { options, frames: 60, limit: Duration::from_secs(60), is_conformance: false };
    for argument in &arguments[1..] {
        let options = &mut asked.options;
        match argument.split_once('=') {
            None if argument == "conformance" => asked.is_conformance = true,
            None if argument == "substitutes" => options.accept_substitutes = true,
            Some(("format", value)) => options.format = Some(format(value)?),
            Some(("size", value)) => {
                let (width, height) = value.split_once('x').ok_or("size=WIDTHxHEIGHT")?;
                options.size_px = Some((width.parse()?, height.parse()?));
            }
            Some(("rate", value)) => options.rate_hz = Some(value.parse()?),
            Some(("buffers", value)) => options.buffers = value.parse()?,
            Some(("stall_ms", value)) => options.stall_timeout = Duration::from_millis(value.parse()?),
            Some(("frames", value)) => asked.frames = value.parse()?,
            Some(("seconds", value)) => asked.limit = Duration::from_secs(value.parse()?),
            Some((key, value)) if key.starts_with("control.") => {
                options.controls.insert(key["control.".len()..].to_owned(), value.parse()?);
            }
            _ => return Err(format!("what is '{argument}'?").into()),
        }
    }
    Ok(asked)
}

fn format(name: &str) -> Result<PixelFormat, Failure> {
    Ok(match name {
        "YUYV" => PixelFormat::Yuyv,
        "NV12" => PixelFormat::Nv12,
        "RGB24" => PixelFormat::Rgb8,
        "GREY" => PixelFormat::Gray8,
        "MJPG" => PixelFormat::Jpeg,
        other => return Err(format!("format {other} is not one of YUYV, NV12, RGB24, GREY, MJPG").into()),
    })
}

fn list() {
    for camera in list_cameras() {
        println!("{} {} ({}):", camera.device.display(), camera.card, camera.driver);
        for mode in &camera.modes {
            println!("  {mode}");
        }
        for control in &camera.controls {
            println!(
                "  {} {}..{} default {}",
                control.name, control.minimum, control.maximum, control.default
            );
        }
        if let Some(problem) = camera.problem {
            println!("  {problem}");
        }
    }
}

fn conform(asked: &Asked) -> Result<(), Failure> {
    let limits = Limits { frames: asked.frames, ..Limits::default() };
    let report = check(|| Box::new(V4l2Source::new(asked.options.clone())), &limits);
    println!("conforms frames={} bad={} dropped={}", report.frames, report.bad, report.dropped);
    Ok(())
}

fn capture(asked: &Asked) -> Result<(), Failure> {
    let mut source = V4l2Source::new(asked.options.clone());
    let begin = Instant::now();
    let mut last_event = begin;
    let mut seen = Seen::default();
    let mut is_lost = true;
    while seen.frames < asked.frames {
        if begin.elapsed() > asked.limit {
            return Err(
                format!("only {} of {} frames in {:?}", seen.frames, asked.frames, asked.limit).into()
            );
        }
        match source.next_frame(Duration::from_millis(100)) {
            Ok(Received::Frame(frame)) => {
                if std::mem::take(&mut is_lost) {
                    let pixels = &frame.pixels;
                    let rate = source.info().nominal_rate_hz.unwrap_or(f64::NAN);
                    println!(
                        "frames arrive sequence={} {}x{} {} stride={} bytes={} rate={rate:.3} after_ms={} at_ns={}",
                        frame.sequence,
                        pixels.width_px(),
                        pixels.height_px(),
                        pixels.format(),
                        pixels.stride_bytes(),
                        pixels.data().len(),
                        last_event.elapsed().as_millis(),
                        monotonic_ns()
                    );
                    last_event = Instant::now();
                }
                seen.frame(frame.capture_time.ns, frame.sequence, frame.pixels.data())?;
            }
            Ok(Received::Timeout) => {}
            Ok(Received::End) => return Err("a camera has no end".into()),
            Err(SourceError::BadFrame { sequence, .. }) => {
                seen.bad += 1;
                seen.number(sequence)?;
            }
            Err(error @ SourceError::Lost { .. }) => {
                if !std::mem::replace(&mut is_lost, true) || seen.frames == 0 {
                    println!("{error} at_ns={}", monotonic_ns());
                    last_event = Instant::now();
                }
                std::thread::sleep(Duration::from_millis(20));
            }
            Err(error) => return Err(error.into()),
        }
    }
    let fps = seen.rate_hz();
    let cpu_ms = cpu_ms().unwrap_or(f64::NAN) / seen.frames as f64;
    let Seen { frames, bad, skipped, oldest_ms, changed, age_sum_ms, youngest_ms, .. } = seen;
    let late_ms = age_sum_ms / frames as f64 - youngest_ms;
    println!(
        "done frames={frames} bad={bad} dropped={} skipped={skipped} oldest_ms={oldest_ms:.1} changed={changed} \
         fps={fps:.2} late_ms={late_ms:.2} ahead_ms={:.2} cpu_ms={cpu_ms:.2}",
        source.dropped_frames(),
        -youngest_ms
    );
    Ok(())
}

/// Processor time of this process so far; the kernel counts in hundredths of a second.
fn cpu_ms() -> Option<f64> {
    let text = std::fs::read_to_string("/proc/self/stat").ok()?;
    let fields: Vec<&str> = text.rsplit_once(')')?.1.split_whitespace().collect();
    let ticks = |index: usize| fields.get(index)?.parse::<f64>().ok();
    Some((ticks(11)? + ticks(12)?) * 10.0)
}

/// What must hold from frame to frame.
#[derive(Default)]
struct Seen {
    frames: u64,
    bad: u64,
    skipped: u64,
    last_number: Option<u64>,
    last_ns: u64,
    /// Largest distance between the time of capture and now.
    oldest_ms: f64,
    age_sum_ms: f64,
    /// Least distance from the time of capture to now; negative for a stamp that lies ahead.
    youngest_ms: f64,
    first_ns: Option<u64>,
    last_sum: u64,
    /// Frames whose pixels differ from those of the frame before.
    changed: u64,
}

impl Seen {
    /// Frames per second between the first and the last.
    fn rate_hz(&self) -> f64 {
        let span_ns = self.first_ns.map_or(0, |first_ns| self.last_ns - first_ns);
        self.frames.saturating_sub(1) as f64 * 1e9 / span_ns.max(1) as f64
    }

    fn number(&mut self, sequence: u64) -> Result<(), Failure> {
        if let Some(last) = self.last_number.replace(sequence) {
            let step = sequence.checked_sub(last).filter(|step| *step > 0);
            self.skipped += step.ok_or_else(|| format!("frame {sequence} after {last}"))? - 1;
        }
        Ok(())
    }

    fn frame(&mut self, ns: u64, sequence: u64, data: &[u8]) -> Result<(), Failure> {
        self.number(sequence)?;
        if ns <= self.last_ns {
            return Err(format!("frame {sequence}: its time fell from {} to {ns}", self.last_ns).into());
        }
        self.last_ns = ns;
        let age_ms = (monotonic_ns() as i128 - i128::from(ns)) as f64 / 1e6;
        self.oldest_ms = self.oldest_ms.max(age_ms.abs());
        self.age_sum_ms += age_ms;
        self.youngest_ms = if self.first_ns.is_none() { age_ms } else { self.youngest_ms.min(age_ms) };
        self.first_ns.get_or_insert(ns);
        let sum =
            data.iter().step_by(7).fold(0u64, |sum, &byte| sum.wrapping_mul(31).wrapping_add(byte.into()));
        self.changed += u64::from(sum != self.last_sum);
        self.last_sum = sum;
        self.frames += 1;
        Ok(())
    }
}
