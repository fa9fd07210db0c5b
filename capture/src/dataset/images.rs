//! A plain folder of images in natural order of their names.
//!
//! Names that are times give the time stamps: decimals with a fraction are seconds (`1305031102.175304.png`),
//! whole numbers of sixteen digits or more are nanoseconds (`1403636579763555584.png`). Other names follow each
//! other at 30 Hz. `camera-intrinsics.txt` (a 3x3 matrix) and `groundtruth.txt` (any format that
//! [`OpenOptions::poses`] takes) are read where they are there. Subfolders are not entered.

use grnet_geometry::Pose;
use std::path::Path;

use super::intrinsics::read_matrix;
use super::listing::{Listed, Listing, PoseOrigin, Set, folder_name, images};
use super::pose::Invalid;
use super::pose_table::{PoseTable, key_of};
use super::text::parse_seconds_ns;
use super::{DatasetError, Layout, OpenOptions};

/// What identifies the layout.
pub(crate) const LOOKED_FOR: &str = "PNG or JPEG images";

const RATE_HZ: f64 = 30.0;

pub(crate) fn fits(path: &Path) -> bool {
    images(path).is_ok_and(|found| !found.is_empty())
}

pub(crate) fn list(path: &Path, options: &OpenOptions) -> Result<Set, DatasetError> {
    let found = images(path)?;
    if found.is_empty() {
        return Err(DatasetError::Empty {
            path: path.to_path_buf(),
            expected: format!("expected {LOOKED_FOR} (subfolders are not searched)"),
        });
    }
    let mut frames: Vec<Listed> = found
        .into_iter()
        .zip(0..)
        .map(|((name, path), number)| Listed { key: key_of(&name), path, number, time_ns: None })
        .collect();
    let stamps: Option<Vec<u64>> = frames.iter().map(|frame| stamp_of(&frame.path)).collect();
    let mut notes = Vec::new();
    match stamps {
        Some(stamps) => {
            for (frame, time_ns) in frames.iter_mut().zip(stamps) {
                frame.time_ns = Some(time_ns);
            }
            // Natural order is the order of numbers, but not that of fractions.
            frames.sort_by_key(|frame| frame.time_ns);
            frames.iter_mut().zip(0..).for_each(|(frame, number)| frame.number = number);
        }
        None => notes.push(format!("the names are no time stamps: frames are taken to come at {RATE_HZ} Hz")),
    }
    let mut invalid = Invalid::new(options.invalid_poses);
    let truth = path.join("groundtruth.txt");
    let poses = if options.poses.is_none() && truth.is_file() {
        let table = PoseTable::read_any(&truth, &mut invalid)?;
        PoseOrigin::Table { table, sensor_from_camera: Pose::identity() }
    } else {
        PoseOrigin::None
    };
    let id = folder_name(path);
    let listing = Listing {
        name: format!("images {id}"),
        id,
        frames,
        poses,
        invalid_poses: invalid.count,
        intrinsics: read_matrix(&path.join("camera-intrinsics.txt"))?,
        default_rate_hz: RATE_HZ,
        notes,
    };
    Ok(Set { layout: Layout::Images, listings: vec![listing], root: path.to_path_buf(), others: Vec::new() })
}

/// The time that a file name says, in nanoseconds.
pub(crate) fn stamp_of(path: &Path) -> Option<u64> {
    let stem = path.file_stem()?.to_str()?;
    match stem.split_once('.') {
        Some((whole, fraction)) if !whole.is_empty() && !fraction.is_empty() => parse_seconds_ns(stem),
        None if stem.len() >= 16 => stem.parse().ok(),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_that_are_times_are_known() {
        let stamp = |name: &str| stamp_of(Path::new(name));
        assert_eq!(stamp("1305031102.175304.png"), Some(1_305_031_102_175_304_000));
        assert_eq!(stamp("1403636579763555584.png"), Some(1_403_636_579_763_555_584));
        assert_eq!(
            (stamp("000001.png"), stamp("a.png"), stamp(".5.png"), stamp("1.x.png")),
            (None, None, None, None)
        );
    }
}
