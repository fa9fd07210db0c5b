//! What every layout reader hands over: files, numbers, times, and where poses and intrinsics come from.

use grnet_geometry::Pose;
use std::path::{Path, PathBuf};

use super::intrinsics::Intrinsics;
use super::pose_table::PoseTable;
use super::{DatasetError, Layout};
use crate::decode::is_image_name;

/// The sequences found in a folder.
#[derive(Debug)]
pub(crate) struct Set {
    pub layout: Layout,
    pub listings: Vec<Listing>,
    /// The folder in which split lists lie.
    pub root: PathBuf,
    /// Sequences of the same set that were not listed: lines of split lists about them are passed over.
    pub others: Vec<String>,
}

/// One sequence before its poses are read.
#[derive(Debug)]
pub(crate) struct Listing {
    pub id: String,
    pub name: String,
    pub frames: Vec<Listed>,
    pub poses: PoseOrigin,
    /// Poses of `poses` that were left out as impossible.
    pub invalid_poses: usize,
    pub intrinsics: Option<Intrinsics>,
    /// Rate where the frames have no times.
    pub default_rate_hz: f64,
    pub notes: Vec<String>,
}

/// One image before its pose is read.
#[derive(Debug, Clone)]
pub(crate) struct Listed {
    /// What split lists and pose lists call it.
    pub key: String,
    pub path: PathBuf,
    pub number: u64,
    pub time_ns: Option<u64>,
}

/// Where the true poses are.
#[derive(Debug)]
pub(crate) enum PoseOrigin {
    None,
    /// 7-Scenes: a `.pose.txt` beside each image.
    BesideImages,
    /// Poses `world_from_sensor` of something that the camera is mounted on.
    Table {
        table: PoseTable,
        sensor_from_camera: Pose,
    },
}

/// `a, b, c`, shortened when there are many.
pub(crate) fn names<'a>(names: impl Iterator<Item = &'a str>) -> String {
    let all: Vec<&str> = names.collect();
    let shown = all.iter().take(12).copied().collect::<Vec<_>>().join(", ");
    match all.len() {
        0 => "none".into(),
        n if n > 12 => format!("{shown}, ... {n} in all"),
        _ => shown,
    }
}

/// The folder's own name, also for `.` and the like.
pub(crate) fn folder_name(path: &Path) -> String {
    let full = path.canonicalize().unwrap_or_else(|_| path.to_path_buf());
    full.file_name().map_or_else(|| full.display().to_string(), |name| name.to_string_lossy().into_owned())
}

/// Names and paths in a folder, in natural order (`2` before `10`), hidden ones left out.
pub(crate) fn entries(folder: &Path) -> Result<Vec<(String, PathBuf)>, DatasetError> {
    let mut found = Vec::new();
    for entry in std::fs::read_dir(folder).map_err(DatasetError::read(folder))? {
        let entry = entry.map_err(DatasetError::read(folder))?;
        let name = entry.file_name().to_string_lossy().into_owned();
        if !name.starts_with('.') {
            found.push((name, entry.path()));
        }
    }
    found.sort_by(|(a, _), (b, _)| alphanumeric_sort::compare_str(a, b).then_with(|| a.cmp(b)));
    Ok(found)
}

/// The images in a folder, in natural order.
pub(crate) fn images(folder: &Path) -> Result<Vec<(String, PathBuf)>, DatasetError> {
    let mut found = entries(folder)?;
    found.retain(|(_, path)| is_image_name(path));
    Ok(found)
}

/// The images in a folder whose names hold a frame number, by number. Of a frame that is there as PNG and as
/// JPEG the PNG is taken.
pub(crate) fn numbered_images(
    folder: &Path,
    number_of: impl Fn(&str) -> Option<u64>,
) -> Result<Vec<(u64, PathBuf)>, DatasetError> {
    let mut found: Vec<_> = images(folder)?
        .into_iter()
        .filter_map(|(name, path)| {
            let stem = name.rsplit_once('.')?.0;
            let lossless = name.to_ascii_lowercase().ends_with(".png");
            Some((number_of(stem)?, !lossless, path))
        })
        .collect();
    found.sort();
    found.dedup_by_key(|(number, ..)| *number);
    Ok(found.into_iter().map(|(number, _, path)| (number, path)).collect())
}

/// A frame number of digits only, short enough to compute with.
pub(crate) fn frame_number(digits: &str) -> Option<u64> {
    let plain = !digits.is_empty() && digits.len() <= 15 && digits.bytes().all(|byte| byte.is_ascii_digit());
    if plain { digits.parse().ok() } else { None }
}
