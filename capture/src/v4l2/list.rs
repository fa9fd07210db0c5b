//! Which cameras there are and what they offer: `grnetd devices`.

use std::fs;
use std::path::{Path, PathBuf};

use v4l::Device;
use v4l::capability::Flags;

use super::controls::{self, ControlInfo};
use super::device::{OpenError, no_panic};
use super::modes::{Mode, modes};

/// A V4L2 capture device.
#[derive(Debug, Clone, PartialEq)]
pub struct CameraInfo {
    /// `/dev/video0`.
    pub device: PathBuf,
    /// Names that stay the same over reboots: links under `/dev/v4l/by-id` and `by-path`.
    pub stable_names: Vec<PathBuf>,
    /// Card name as the driver gives it.
    pub card: String,
    /// Driver name: `uvcvideo`.
    pub driver: String,
    /// Formats, sizes and rates, in the formats that are understood.
    pub modes: Vec<Mode>,
    /// Controls that take one number.
    pub controls: Vec<ControlInfo>,
    /// Why it could not be asked, in place of the above.
    pub problem: Option<String>,
}

impl CameraInfo {
    /// The mode to start with: near 640x480 and 30 frames per second.
    pub fn suggested(&self) -> Option<&Mode> {
        let distance = |mode: &&Mode| {
            let fastest_hz = mode.rates_hz.iter().copied().fold(0.0, f64::max);
            let area = f64::from(mode.size_px.0) * f64::from(mode.size_px.1);
            let size = (area / (640.0 * 480.0)).ln().abs();
            // A rate that is too low by half weighs as much as a wrong size by two.
            size + (30.0 / fastest_hz.clamp(1.0, 30.0)).ln()
        };
        self.modes.iter().min_by(|a, b| distance(a).total_cmp(&distance(b)))
    }
}

/// Every V4L2 node that captures video, in the order of their numbers.
pub fn list_cameras() -> Vec<CameraInfo> {
    let Ok(entries) = fs::read_dir("/dev") else { return Vec::new() };
    let is_video = |path: &PathBuf| {
        let number = path.file_name().and_then(|name| name.to_str()?.strip_prefix("video"));
        number.is_some_and(|number| !number.is_empty() && number.bytes().all(|b| b.is_ascii_digit()))
    };
    let mut paths: Vec<PathBuf> = entries.flatten().map(|e| e.path()).filter(is_video).collect();
    paths.sort_by(|a, b| alphanumeric_sort::compare_path(a, b));
    paths.iter().filter_map(|path| describe(path)).collect()
}

/// `None` for nodes that do not capture.
fn describe(path: &Path) -> Option<CameraInfo> {
    let mut info = CameraInfo {
        device: path.to_owned(),
        stable_names: stable_names(path),
        card: String::new(),
        driver: String::new(),
        modes: Vec::new(),
        controls: Vec::new(),
        problem: None,
    };
    let device = match Device::with_path(path) {
        Ok(device) => device,
        Err(error) => {
            info.problem = Some(error.to_string());
            return Some(info);
        }
    };
    let asked = no_panic(path, || {
        let caps = device.query_caps().map_err(|e| OpenError::Unavailable(e.to_string()))?;
        Ok((caps, modes(&device)))
    });
    match asked {
        Ok((caps, modes)) => {
            if !caps.capabilities.contains(Flags::VIDEO_CAPTURE | Flags::STREAMING) {
                return None;
            }
            info = CameraInfo { card: caps.card, driver: caps.driver, modes, ..info };
            info.controls = controls::list(&device);
        }
        Err(OpenError::Unavailable(reason) | OpenError::Unfit(reason)) => info.problem = Some(reason),
    }
    Some(info)
}

fn stable_names(device: &Path) -> Vec<PathBuf> {
    let mut names = Vec::new();
    for folder in ["/dev/v4l/by-id", "/dev/v4l/by-path"] {
        let Ok(entries) = fs::read_dir(folder) else { continue };
        let links = entries.flatten().map(|e| e.path());
        names.extend(links.filter(|link| fs::canonicalize(link).is_ok_and(|target| target == device)));
    }
    names.sort();
    names
}

#[cfg(test)]
mod tests {
    use super::*;
    use grnet_frame::PixelFormat;

    #[test]
    fn a_common_size_at_a_good_rate_is_suggested() {
        let mode = |width, height, rate_hz| Mode {
            format: PixelFormat::Yuyv,
            size_px: (width, height),
            largest_px: None,
            rates_hz: vec![1.0, rate_hz],
        };
        let mut camera = CameraInfo {
            device: "/dev/video0".into(),
            stable_names: Vec::new(),
            card: String::new(),
            driver: String::new(),
            modes: vec![mode(160, 120, 60.0), mode(640, 480, 30.0), mode(1920, 1080, 5.0)],
            controls: Vec::new(),
            problem: None,
        };
        assert_eq!(camera.suggested().unwrap().size_px, (640, 480));
        camera.modes.clear();
        assert_eq!(camera.suggested(), None);
    }
}
