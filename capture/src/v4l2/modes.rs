//! What a camera offers: formats, sizes, rates.

use std::fmt;

use grnet_frame::PixelFormat;
use v4l::frameinterval::FrameIntervalEnum;
use v4l::framesize::FrameSizeEnum;
use v4l::video::Capture;
use v4l::{Device, FourCC};

use super::device::FORMATS;

/// A format at a size, or at a range of sizes.
#[derive(Debug, Clone, PartialEq)]
pub struct Mode {
    /// Pixel format.
    pub format: PixelFormat,
    /// Width and height in pixels; of a range the smallest.
    pub size_px: (u32, u32),
    /// Of a range the largest.
    pub largest_px: Option<(u32, u32)>,
    /// Frames per second, where the driver lists them.
    pub rates_hz: Vec<f64>,
}

impl fmt::Display for Mode {
    /// `640x480 YUYV 15/30 Hz`.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (width, height) = self.size_px;
        write!(f, "{width}x{height}")?;
        if let Some((width, height)) = self.largest_px {
            write!(f, "..{width}x{height}")?;
        }
        write!(f, " {}{}", self.format, rates_text(&self.rates_hz))
    }
}

/// Every mode, in the formats that are understood.
pub(super) fn modes(device: &Device) -> Vec<Mode> {
    let mut modes = Vec::new();
    for (format, code) in FORMATS {
        let fourcc = FourCC::new(code);
        let Ok(sizes) = device.enum_framesizes(fourcc) else { continue };
        for size in sizes {
            modes.push(match size.size {
                FrameSizeEnum::Discrete(s) => {
                    let size_px = (s.width, s.height);
                    Mode { format, size_px, largest_px: None, rates_hz: rates_hz(device, fourcc, size_px) }
                }
                FrameSizeEnum::Stepwise(s) => Mode {
                    format,
                    size_px: (s.min_width, s.min_height),
                    largest_px: Some((s.max_width, s.max_height)),
                    rates_hz: Vec::new(),
                },
            });
        }
    }
    modes
}

/// All modes in one line.
pub(super) fn text(device: &Device) -> String {
    let modes: Vec<_> = modes(device).iter().map(Mode::to_string).collect();
    if modes.is_empty() { "none".into() } else { modes.join(", ") }
}

/// The rates that the driver lists for a format and size.
pub(super) fn rates_hz(device: &Device, fourcc: FourCC, (width_px, height_px): (u32, u32)) -> Vec<f64> {
    let intervals = device.enum_frameintervals(fourcc, width_px, height_px).unwrap_or_default();
    let rates = intervals.iter().filter_map(|interval| match &interval.interval {
        FrameIntervalEnum::Discrete(f) if f.numerator > 0 => {
            Some(f64::from(f.denominator) / f64::from(f.numerator))
        }
        _ => None,
    });
    rates.collect()
}

/// ` 15/30 Hz`, or nothing.
pub(super) fn rates_text(rates_hz: &[f64]) -> String {
    let rates: Vec<_> = rates_hz
        .iter()
        .map(|hz| format!("{hz:.4}").trim_end_matches('0').trim_end_matches('.').to_owned())
        .collect();
    if rates.is_empty() { String::new() } else { format!(" {} Hz", rates.join("/")) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn modes_read_as_they_are_written_in_the_configuration() {
        let mode = Mode {
            format: PixelFormat::Yuyv,
            size_px: (640, 480),
            largest_px: None,
            rates_hz: vec![12.5, 30000.0 / 1001.0],
        };
        assert_eq!(mode.to_string(), "640x480 YUYV 12.5/29.97 Hz");
        let range = Mode { largest_px: Some((1920, 1080)), rates_hz: Vec::new(), ..mode };
        assert_eq!(range.to_string(), "640x480..1920x1080 YUYV");
    }
}
