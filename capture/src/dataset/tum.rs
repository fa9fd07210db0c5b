//! TUM RGB-D: `rgb.txt` (`time_s path`) and, optionally, `groundtruth.txt` (`time_s tx ty tz qx qy qz qw`).
//!
//! The ground truth is the pose of the colour camera. The folder holds no intrinsics; those that its authors
//! publish for the three cameras are taken by the `freiburg1`, `freiburg2` or `freiburg3` in its name.

use grnet_geometry::Pose;
use std::path::Path;

use grnet_frame::Distortion;

use super::intrinsics::{Intrinsics, read_matrix};
use super::listing::{Listed, Listing, PoseOrigin, Set, folder_name};
use super::pose::Invalid;
use super::pose_table::{PoseTable, key_of};
use super::text::{TextFile, quoted};
use super::{DatasetError, Layout, OpenOptions};

/// What identifies the layout.
pub(crate) const LOOKED_FOR: &str = "rgb.txt";

const RATE_HZ: f64 = 30.0;

pub(crate) fn fits(path: &Path) -> bool {
    path.join("rgb.txt").is_file()
}

pub(crate) fn list(path: &Path, options: &OpenOptions) -> Result<Set, DatasetError> {
    let list = path.join("rgb.txt");
    let file = TextFile::read_if_present(&list)?
        .ok_or_else(|| DatasetError::missing(&list, "the list of images of the TUM RGB-D layout"))?;
    let frames: Vec<Listed> = parse_list(&file)?
        .into_iter()
        .zip(0..)
        .map(|((time_ns, name), number)| Listed {
            key: key_of(&name),
            path: path.join(&name),
            number,
            time_ns: Some(time_ns),
        })
        .collect();
    if frames.is_empty() {
        return Err(DatasetError::Empty { path: list, expected: "expected lines `time_s path`".into() });
    }
    let id = folder_name(path);
    let mut notes = Vec::new();
    let intrinsics = match read_matrix(&path.join("camera-intrinsics.txt"))? {
        Some(own) => Some(own),
        None => {
            published(&id).inspect(|found| notes.push(format!("intrinsics are those of {}", found.origin)))
        }
    };
    let mut invalid = Invalid::new(options.invalid_poses);
    let truth = path.join("groundtruth.txt");
    let poses = match TextFile::read_if_present(&truth)?.filter(|_| options.poses.is_none()) {
        Some(file) => PoseOrigin::Table {
            table: PoseTable::parse_tum(&file, &mut invalid)?,
            sensor_from_camera: Pose::identity(),
        },
        None => PoseOrigin::None,
    };
    let listing = Listing {
        name: format!("TUM {id}"),
        id,
        frames,
        poses,
        invalid_poses: invalid.count,
        intrinsics,
        default_rate_hz: RATE_HZ,
        notes,
    };
    Ok(Set { layout: Layout::Tum, listings: vec![listing], root: path.to_path_buf(), others: Vec::new() })
}

/// Times in nanoseconds and image names, which may hold spaces.
pub(crate) fn parse_list(file: &TextFile) -> Result<Vec<(u64, String)>, DatasetError> {
    let expected = "`time_s path`";
    let mut images: Vec<(u64, String)> = Vec::new();
    for line in file.data_lines() {
        let Some((time, name)) = line.text.split_once(char::is_whitespace) else {
            return Err(line.unexpected(expected));
        };
        let time_ns = line.seconds_ns(time, expected)?;
        if images.last().is_some_and(|(before_ns, _)| time_ns < *before_ns) {
            let found = format!("a time before the line above in {}", quoted(line.text));
            return Err(line.error(found, "times in growing order"));
        }
        images.push((time_ns, name.trim_start().to_string()));
    }
    Ok(images)
}

/// Calibration that the dataset's authors publish for the colour cameras, undistorted neither in the images.
fn published(folder: &str) -> Option<Intrinsics> {
    let (camera, focal_px, centre_px, distortion) = [
        ("freiburg1", (517.3, 516.5), (318.6, 255.3), [0.2624, -0.9531, -0.0054, 0.0026, 1.1633]),
        ("freiburg2", (520.9, 521.0), (325.1, 249.7), [0.2312, -0.7849, -0.0033, -0.0001, 0.9172]),
        ("freiburg3", (535.4, 539.2), (320.1, 247.6), [0.0; 5]),
    ]
    .into_iter()
    .find(|(camera, ..)| folder.contains(camera))?;
    Some(Intrinsics {
        focal_px,
        centre_px: Some(centre_px),
        distortion: if distortion == [0.0; 5] { Distortion::None } else { Distortion::PlumbBob(distortion) },
        size_px: Some((640, 480)),
        scalable: true,
        origin: format!("TUM {camera} as published"),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn parse(text: &str) -> Result<Vec<(u64, String)>, DatasetError> {
        parse_list(&TextFile::from_bytes(Path::new("rgb.txt"), text.into()).unwrap())
    }

    #[test]
    fn a_list_keeps_exact_times_and_names_with_spaces() {
        let images =
            parse("# colour\n1305031102.175304 rgb/a b.png\n1305031102.211214\trgb/c.png\n").unwrap();
        let want = [(1_305_031_102_175_304_000, "rgb/a b.png"), (1_305_031_102_211_214_000, "rgb/c.png")];
        assert_eq!(images, want.map(|(time_ns, name)| (time_ns, name.to_string())));
    }

    #[test]
    fn bad_lines_are_named() {
        for (text, start) in [
            ("1.5\n", "rgb.txt, line 1: found \"1.5\", expected `time_s path`"),
            ("1 a.png\nx b.png\n", "rgb.txt, line 2: found \"x\""),
            ("2 a.png\n1 b.png\n", "rgb.txt, line 2: found a time before the line above"),
        ] {
            let error = parse(text).unwrap_err().to_string();
            assert!(error.starts_with(start), "{error}");
        }
    }

    #[test]
    fn published_intrinsics_are_found_by_name() {
        let found = published("rgbd_dataset_freiburg2_desk").unwrap();
        assert_eq!((found.focal_px, found.size_px), ((520.9, 521.0), Some((640, 480))));
        assert!(matches!(published("freiburg3_x").unwrap().distortion, Distortion::None));
        assert!(published("office").is_none());
    }

    proptest! {
        #[test]
        fn any_text_parses_or_is_named(text in "([-0-9.e \\n]|\\PC){0,200}") {
            if let Err(error) = parse(&text) {
                prop_assert!(error.to_string().starts_with("rgb.txt, line "), "{}", error);
            }
        }
    }
}
