//! Microsoft 7-Scenes (and 12-Scenes, which names its files alike).
//!
//! `seq-01/frame-000000.color.png` with `frame-000000.pose.txt`, the 4x4 matrix `world_from_camera` of the
//! depth camera in metres (the colour camera sits a constant 2.6 cm and 0.6 deg beside it; the pseudo ground
//! truth by [`OpenOptions::poses`](super::OpenOptions::poses) holds poses of the colour camera). There are no
//! time stamps; the Kinect ran at 30 Hz. The official files give no intrinsics of the colour camera: 525 px at
//! 640x480 is what the literature uses, and a `camera-intrinsics.txt` with 585 px is the depth camera's.

use grnet_geometry::Pose;
use std::path::{Path, PathBuf};

use grnet_frame::Distortion;

use super::intrinsics::{Intrinsics, read_matrix};
use super::listing::{
    Listed, Listing, PoseOrigin, Set, entries, folder_name, frame_number, names, numbered_images,
};
use super::pose::{Invalid, from_rows};
use super::text::{TextFile, quoted};
use super::{DatasetError, Layout};

/// What identifies the layout.
pub(crate) const LOOKED_FOR: &str = "seq-XX folders, or frame-XXXXXX.color.png (or .jpg) images";

const RATE_HZ: f64 = 30.0;
const COLOUR_FOCAL_PX: f64 = 525.0;
const DEPTH_FOCAL_PX: f64 = 585.0;

pub(crate) fn fits(path: &Path) -> bool {
    frames(path, "").is_ok_and(|found| !found.is_empty())
        || sequence_folders(path).is_ok_and(|found| !found.is_empty())
}

pub(crate) fn list(path: &Path) -> Result<Set, DatasetError> {
    let folders = sequence_folders(path)?;
    if folders.is_empty() {
        let id = folder_name(path);
        let root = path.parent().filter(|p| p.is_dir()).map_or_else(|| path.join(".."), PathBuf::from);
        let listing = listing(path, &id, &root)?;
        let mut others: Vec<String> = (0..100).map(|number| format!("seq-{number:02}")).collect();
        others.retain(|other| *other != id);
        return Ok(Set { layout: Layout::SevenScenes, listings: vec![listing], root, others });
    }
    let listings: Result<_, _> = folders.iter().map(|(id, folder)| listing(folder, id, path)).collect();
    Ok(Set { layout: Layout::SevenScenes, listings: listings?, root: path.to_path_buf(), others: Vec::new() })
}

/// Reads `frame-XXXXXX.pose.txt` beside an image; `None` when there is no such file.
pub(crate) fn pose_beside(image: &Path, invalid: &mut Invalid) -> Result<Option<Pose>, DatasetError> {
    let name = image.file_name().and_then(|name| name.to_str()).unwrap_or_default();
    let stem = name.split_once(".color.").map_or(name, |(stem, _)| stem);
    let path = image.with_file_name(format!("{stem}.pose.txt"));
    match TextFile::read_if_present(&path)? {
        Some(file) => parse_pose(&file, invalid),
        None => Ok(None),
    }
}

fn parse_pose(file: &TextFile, invalid: &mut Invalid) -> Result<Option<Pose>, DatasetError> {
    let expected = "four rows of four numbers: the matrix world_from_camera";
    let mut lines = file.data_lines();
    let mut matrix = [0.0; 16];
    for row in matrix.chunks_exact_mut(4) {
        let line = lines.next().unwrap_or_else(|| file.end());
        if line.text.is_empty() {
            return Err(line.unexpected(expected));
        }
        row.copy_from_slice(&line.numbers::<4>(&line.fields(), expected)?);
    }
    if let Some(line) = lines.next() {
        return Err(line.unexpected("the end of the file after four rows"));
    }
    let first = file.data_lines().next().unwrap_or_else(|| file.end());
    let rows: [f64; 12] = std::array::from_fn(|index| matrix[index]);
    let last_row = &matrix[12..];
    let pose = from_rows(&rows).and_then(|pose| {
        let homogeneous =
            last_row.iter().zip([0.0, 0.0, 0.0, 1.0]).all(|(found, want)| (found - want).abs() < 1e-6);
        if homogeneous { Ok(pose) } else { Err(format!("the last row is {last_row:?}, not 0 0 0 1")) }
    });
    invalid.judge(&first, pose)
}

fn sequence_folders(path: &Path) -> Result<Vec<(String, PathBuf)>, DatasetError> {
    let mut found = entries(path)?;
    found.retain(|(name, path)| name.strip_prefix("seq-").and_then(frame_number).is_some() && path.is_dir());
    Ok(found)
}

fn frames(folder: &Path, id: &str) -> Result<Vec<Listed>, DatasetError> {
    let numbered =
        numbered_images(folder, |stem| frame_number(stem.strip_prefix("frame-")?.strip_suffix(".color")?))?;
    Ok(numbered
        .into_iter()
        .map(|(number, path)| {
            let name = path.file_name().and_then(|name| name.to_str()).unwrap_or_default();
            let stem = name.split_once(".color").map_or(name, |(stem, _)| stem);
            Listed { key: format!("{id}/{stem}"), path, number, time_ns: None }
        })
        .collect())
}

fn listing(folder: &Path, id: &str, root: &Path) -> Result<Listing, DatasetError> {
    let frames = frames(folder, id)?;
    if frames.is_empty() {
        let there = entries(folder)?;
        let there = names(there.iter().map(|(name, _)| name.as_str()));
        return Err(DatasetError::Empty {
            path: folder.to_path_buf(),
            expected: format!(
                "expected frame-XXXXXX.color.png or .jpg, found {there} (unpack the zip files first)"
            ),
        });
    }
    let mut notes = Vec::new();
    let mut intrinsics = match read_matrix(&folder.join("camera-intrinsics.txt"))? {
        Some(own) => Some(own),
        None => read_matrix(&root.join("camera-intrinsics.txt"))?,
    };
    if let Some(depth) = intrinsics.take_if(|k| k.focal_px == (DEPTH_FOCAL_PX, DEPTH_FOCAL_PX)) {
        notes.push(format!(
            "{} holds the depth camera's focal length of {DEPTH_FOCAL_PX} px, which is not the colour camera's",
            depth.origin
        ));
    }
    let intrinsics = intrinsics.unwrap_or_else(|| {
        notes.push(format!(
            "intrinsics are the {COLOUR_FOCAL_PX} px at 640x480 that the literature uses for the colour camera"
        ));
        Intrinsics {
            focal_px: (COLOUR_FOCAL_PX, COLOUR_FOCAL_PX),
            centre_px: Some((320.0, 240.0)),
            distortion: Distortion::None,
            size_px: Some((640, 480)),
            scalable: true,
            origin: "7-Scenes".into(),
        }
    });
    Ok(Listing {
        id: id.to_string(),
        name: format!("7-Scenes {} {id}", folder_name(root)),
        frames,
        poses: PoseOrigin::BesideImages,
        invalid_poses: 0,
        intrinsics: Some(intrinsics),
        default_rate_hz: RATE_HZ,
        notes,
    })
}

/// Whether a line of a split names the sequence `id`: `seq-01`, or `sequence1` as in TrainSplit.txt.
pub(crate) fn names_sequence(line: &str, id: &str) -> bool {
    let number = |name: &str, prefix| name.strip_prefix(prefix).and_then(frame_number);
    line == id || (number(line, "sequence").is_some() && number(line, "sequence") == number(id, "seq-"))
}

/// The official list of a split.
pub(crate) fn split_file(root: &Path, name: &str) -> Result<TextFile, DatasetError> {
    let path = root.join(name);
    TextFile::read_if_present(&path)?.ok_or_else(|| {
        DatasetError::missing(
            &path,
            format!("the official {} of 7-Scenes; or give a list of your own", quoted(name)),
        )
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dataset::InvalidPoses;
    use proptest::prelude::*;

    fn parse(text: &str, policy: InvalidPoses) -> Result<Option<Pose>, DatasetError> {
        let file = TextFile::from_bytes(Path::new("p.txt"), text.into()).unwrap();
        parse_pose(&file, &mut Invalid::new(policy))
    }

    #[test]
    fn a_matrix_is_camera_to_world() {
        let pose = parse("0 -1 0 1\n1 0 0 2\n0 0 1 3\n0 0 0 1\n", InvalidPoses::Refuse).unwrap().unwrap();
        let point = pose * nalgebra::Point3::new(1.0, 0.0, 0.0);
        assert!((point - nalgebra::Point3::new(1.0, 3.0, 3.0)).norm() < 1e-12);
    }

    #[test]
    fn lost_tracking_gives_no_pose() {
        for text in [
            "nan nan nan nan\nnan nan nan nan\nnan nan nan nan\nnan nan nan nan\n",
            "-1.#IND -1.#IND -1.#IND -1.#IND\n-1.#IND 0 0 0\n0 0 0 0\n0 0 0 1\n",
            "1 0 0 -inf\n0 1 0 -inf\n0 0 1 -inf\n0 0 0 1\n",
            "0 0 0 0\n0 0 0 0\n0 0 0 0\n0 0 0 1\n",
            "1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 0\n",
        ] {
            assert_eq!(parse(text, InvalidPoses::Forget).unwrap(), None);
            let error = parse(text, InvalidPoses::Refuse).unwrap_err().to_string();
            assert!(error.starts_with("p.txt, line 1: "), "{error}");
        }
    }

    #[test]
    fn bad_text_is_named_by_line() {
        for (text, start) in [
            ("", "p.txt, line 1: found the end of the file"),
            ("1 0 0 0\n0 1 0\n", "p.txt, line 2: found 3 fields"),
            ("1 0 0 0\n0 1 0 zero\n", "p.txt, line 2: found \"zero\""),
            ("1 0 0 0\n0 1 0 0\n0 0 1 0\n", "p.txt, line 4: found the end of the file"),
            ("1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\nx\n", "p.txt, line 5: found \"x\""),
        ] {
            let error = parse(text, InvalidPoses::Forget).unwrap_err().to_string();
            assert!(error.starts_with(start), "{error}");
        }
    }

    #[test]
    fn sequences_are_known_by_both_names() {
        assert!(names_sequence("sequence1", "seq-01") && names_sequence("seq-01", "seq-01"));
        assert!(!names_sequence("sequence1", "seq-11") && !names_sequence("sequenceX", "seqX"));
    }

    proptest! {
        #[test]
        fn any_text_gives_a_pose_or_an_error_with_a_line(text in "([-0-9.enaif \\n]|\\PC){0,200}") {
            if let Err(error) = parse(&text, InvalidPoses::Refuse) {
                prop_assert!(error.to_string().starts_with("p.txt, line "), "{}", error);
            }
        }
    }
}
