//! Opening a camera and agreeing with its driver on format, size, rate and controls.

use std::os::unix::ffi::OsStrExt as _;
use std::path::Path;
use std::{io, panic};

use grnet_frame::PixelFormat;
use v4l::capability::Flags;
use v4l::format::FieldOrder;
use v4l::video::Capture;
use v4l::video::capture::Parameters;
use v4l::{Device, Format, FourCC, Fraction};

use super::controls::{self, ControlError};
use super::{V4l2Options, modes};

/// The formats that can be used, with the FourCC under which V4L2 knows them; the cheapest to convert first.
pub(super) const FORMATS: [(PixelFormat, &[u8; 4]); 5] = [
    (PixelFormat::Yuyv, b"YUYV"),
    (PixelFormat::Nv12, b"NV12"),
    (PixelFormat::Rgb8, b"RGB3"),
    (PixelFormat::Gray8, b"GREY"),
    (PixelFormat::Jpeg, b"MJPG"),
];

/// What driver and configuration have agreed on.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Agreed {
    pub format: PixelFormat,
    pub width_px: u32,
    pub height_px: u32,
    pub stride_bytes: usize,
    pub rate_hz: Option<f64>,
}

/// Why a camera is not open.
#[derive(Debug)]
pub(super) enum OpenError {
    /// Not there, busy, no permission: may get better.
    Unavailable(String),
    /// What was asked cannot be had from it.
    Unfit(String),
}

pub(super) fn open(options: &V4l2Options) -> Result<(Device, Agreed), OpenError> {
    let path = &options.device;
    if path.as_os_str().as_bytes().contains(&0) {
        return Err(OpenError::Unfit("its name holds a zero byte".into()));
    }
    let device = Device::with_path(path).map_err(|e| OpenError::Unavailable(unavailable(path, &e)))?;
    let agreed = no_panic(path, || agree(&device, options))?;
    Ok((device, agreed))
}

/// Crate `v4l` panics on strings and enumerators of the driver that it does not know; a strange camera must not end us.
pub(super) fn no_panic<T>(path: &Path, f: impl FnOnce() -> Result<T, OpenError>) -> Result<T, OpenError> {
    panic::catch_unwind(panic::AssertUnwindSafe(f)).unwrap_or_else(|_| {
        Err(OpenError::Unfit(format!(
            "the driver of {} describes itself in a way that cannot be read",
            path.display()
        )))
    })
}

fn agree(device: &Device, options: &V4l2Options) -> Result<Agreed, OpenError> {
    let gone = |e: io::Error| OpenError::Unavailable(unavailable(&options.device, &e));
    let capabilities = device.query_caps().map_err(|e| match e.raw_os_error() {
        Some(ENOTTY) => OpenError::Unfit("it is no V4L2 device; run `grnetd devices`".into()),
        _ => gone(e),
    })?;
    if !capabilities.capabilities.contains(Flags::VIDEO_CAPTURE | Flags::STREAMING) {
        return Err(OpenError::Unfit(
            "it is no streaming single-plane video capture device (metadata and output nodes have names like it); run \
             `grnetd devices`"
                .into(),
        ));
    }
    let current = device.format().map_err(gone)?;
    let format = match options.format {
        Some(format) => format,
        None => preferred(device, current.fourcc).map_err(gone)?,
    };
    let (width, height) = options.size_px.unwrap_or((current.width, current.height));
    let asked = Format::new(width, height, fourcc(format));
    let refused = |got: String| {
        let offers = modes::text(device);
        OpenError::Unfit(format!(
            "it offers no {width}x{height} {format} ({got}; available: {offers}); set source.size_px and source.format to \
             one of these, or source.accept_substitutes = true"
        ))
    };
    let found = device.set_format(&asked).map_err(|e| match e.raw_os_error() {
        Some(EINVAL) => refused("the driver refuses it".into()),
        _ => gone(e),
    })?;
    let exact = (found.width, found.height) == (width, height) && pixel_format(found.fourcc) == Some(format);
    if !exact && !options.accept_substitutes {
        return Err(refused(format!(
            "the driver would give {}x{} {}",
            found.width, found.height, found.fourcc
        )));
    }
    let Some(found_format) = pixel_format(found.fourcc) else {
        return Err(refused(format!("the driver gives {}, which is not understood", found.fourcc)));
    };
    if !matches!(found.field_order, FieldOrder::Any | FieldOrder::Progressive | FieldOrder::Interlaced) {
        return Err(OpenError::Unfit(format!(
            "it gives single fields ({}), not whole images",
            found.field_order
        )));
    }
    let rate_hz = agree_rate(device, options, &found)?;
    controls::apply(device, &options.controls).map_err(|error| match error {
        ControlError::Refused(reason) => OpenError::Unfit(reason),
        ControlError::Device(error) => gone(error),
    })?;
    let least_stride = found_format.row_bytes(found.width).unwrap_or(0);
    Ok(Agreed {
        format: found_format,
        width_px: found.width,
        height_px: found.height,
        stride_bytes: (found.stride as usize).max(least_stride),
        rate_hz,
    })
}

fn agree_rate(device: &Device, options: &V4l2Options, got: &Format) -> Result<Option<f64>, OpenError> {
    let rate = |p: &Parameters| {
        let Fraction { numerator, denominator } = p.interval;
        (numerator > 0 && denominator > 0).then(|| f64::from(denominator) / f64::from(numerator))
    };
    let Some(wanted_hz) = options.rate_hz else {
        return Ok(device.params().ok().as_ref().and_then(rate));
    };
    // Milliseconds would miss 29.97: the interval is given in units of 1/(1000 rate) s.
    let interval = Fraction::new(1000, (wanted_hz * 1000.0).round() as u32);
    let found = device.set_params(&Parameters::new(interval)).map_err(|e| match e.raw_os_error() {
        Some(EINVAL | ENOTTY) => {
            OpenError::Unfit(format!("it does not let the frame rate be set ({e}); leave out source.rate_hz"))
        }
        _ => OpenError::Unavailable(unavailable(&options.device, &e)),
    })?;
    let found_hz = rate(&found);
    let close = found_hz.is_some_and(|hz| (hz - wanted_hz).abs() <= 0.01 * wanted_hz);
    if !close && !options.accept_substitutes {
        let found = found_hz.map_or("an unknown rate".into(), |hz| format!("{hz:.2} Hz"));
        let offers = modes::rates_text(&modes::rates_hz(device, got.fourcc, (got.width, got.height)));
        return Err(OpenError::Unfit(format!(
            "it gives {found} where {wanted_hz} Hz was asked (available at this size:{offers}); set source.rate_hz to one of these, or \
             source.accept_substitutes = true"
        )));
    }
    Ok(found_hz)
}

/// The current format when it is understood, else the first that the driver offers and we prefer.
fn preferred(device: &Device, current: FourCC) -> io::Result<PixelFormat> {
    if let Some(format) = pixel_format(current) {
        return Ok(format);
    }
    let offered = device.enum_formats()?;
    let known = FORMATS.iter().find(|(_, code)| offered.iter().any(|d| d.fourcc == FourCC::new(code)));
    Ok(known.map_or(PixelFormat::Yuyv, |(format, _)| *format))
}

fn fourcc(format: PixelFormat) -> FourCC {
    let (_, code) = FORMATS.iter().find(|(f, _)| *f == format).expect("FORMATS lists every pixel format");
    FourCC::new(code)
}

fn pixel_format(code: FourCC) -> Option<PixelFormat> {
    // UVC cameras differ in whether they call motion JPEG `MJPG` or `JPEG`.
    if &code.repr == b"JPEG" {
        return Some(PixelFormat::Jpeg);
    }
    FORMATS.iter().find(|(_, c)| **c == code.repr).map(|(f, _)| *f)
}

/// Nothing behind the file answers V4L2 requests, or this one.
const ENOTTY: i32 = 25;
const EINVAL: i32 = 22;
const EBUSY: i32 = 16;
/// Pulled out while it was open.
pub(super) const ENODEV: i32 = 19;

pub(super) fn unavailable(path: &Path, error: &io::Error) -> String {
    match error.kind() {
        io::ErrorKind::NotFound => "no such device (unplugged, or another name: run `grnetd devices`)".into(),
        io::ErrorKind::PermissionDenied => {
            format!(
                "no permission to open it: let this user into the group that owns {} (video)",
                path.display()
            )
        }
        _ if error.raw_os_error() == Some(EBUSY) => {
            "another program streams from it; end that program (`fuser` shows it)".into()
        }
        _ => error.to_string(),
    }
}
