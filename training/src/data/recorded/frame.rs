//! The frames that windows are cut from.

use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::{Arc, OnceLock};

use grnet_frame::{Camera, Distortion};
use grnet_geometry::Pose;
use grnet_pipeline::preprocess::InputSpec;

use super::RecordedOptions;
use crate::data::DataError;
use crate::data::fingerprint::Fingerprint;
use crate::data::image::Rgb;

#[derive(Debug)]
pub(super) struct TrainingFrame {
    pub path: PathBuf,
    /// Which recording, and which frame of it; neighbours differ by 1.
    pub place: (usize, u64),
    pub world_from_camera: Pose,
    pub camera: Option<Camera>,
    pub is_cached: bool,
    pub cache: OnceLock<Stored>,
}

/// A frame as augmentation needs it.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Stored {
    /// At the network's input size, where windows may stay as they are.
    pub exact: Option<Arc<Rgb>>,
    /// The whole image, where the camera may be turned or moved.
    pub whole: Option<Arc<Rgb>>,
}

impl TrainingFrame {
    pub fn new(path: &Path, place: (usize, u64), world_from_camera: Pose, camera: Option<Camera>) -> Self {
        let (path, is_cached, cache) = (path.to_path_buf(), false, OnceLock::new());
        Self { path, place, world_from_camera, camera, is_cached, cache }
    }
}

/// Runs of neighbours.
pub(super) fn runs(frames: &[TrainingFrame]) -> Vec<Range<usize>> {
    let neighbours = |a: &TrainingFrame, b: &TrainingFrame| (a.place.0, a.place.1 + 1) == b.place;
    let mut start = 0;
    let ranges = frames.chunk_by(neighbours).map(|run| {
        let range = start..start + run.len();
        start = range.end;
        range
    });
    ranges.collect()
}

/// The camera with another focal length; its centre and distortion stay, or it looks straight ahead.
pub(super) fn with_focal(
    camera: Option<Camera>,
    image_px: Option<(u32, u32)>,
    focal_px: Option<f64>,
) -> Result<Option<Camera>, DataError> {
    let Some(focal_px) = focal_px else { return Ok(camera) };
    let Some(size_px) = camera.map(|camera| camera.size_px()).or(image_px) else { return Ok(None) };
    let middle = (f64::from(size_px.0 - 1) / 2.0, f64::from(size_px.1 - 1) / 2.0);
    let (centre_px, distortion) =
        camera.map_or((middle, Distortion::None), |camera| (camera.centre_px(), camera.distortion()));
    Camera::new(size_px, (focal_px, focal_px), centre_px, distortion)
        .map(Some)
        .map_err(|_| DataError::option("focal_px", focal_px, "a positive number of pixels"))
}

pub(super) fn fingerprint(
    root: &Path,
    frames: &[TrainingFrame],
    input: &InputSpec,
    options: &RecordedOptions,
) -> Result<String, DataError> {
    let mut hash = Fingerprint::default();
    hash.text("recorded windows 1");
    if options.views.is_some() {
        hash.text("drawn from several frames");
    }
    // The size of the cache changes no window.
    hash.options(&RecordedOptions { cache_mib: 0, ..options.clone() });
    hash.input(input);
    for frame in frames {
        let path = frame.path.strip_prefix(root).unwrap_or(&frame.path);
        hash.text(&path.to_string_lossy());
        hash.numbers(&[frame.place.0 as f64, frame.place.1 as f64]);
        hash.pose(&frame.world_from_camera);
        hash.camera(frame.camera.as_ref());
        hash.file(&frame.path)?;
    }
    Ok(hash.finish())
}
