//! KITTI odometry: rectified images, no distortion, poses of the left grey camera (camera 0).
//!
//! `sequences/06/image_0/000000.png`, `times.txt` (seconds), `calib.txt` (rows `P0:` .. `P3:` of the 3x4
//! projection matrices; also without labels, in that order) and `poses/06.txt`. For images of another camera
//! than 0 the poses are moved by that camera's place in the rig: P_i = K [I | t], so the camera sits at
//! -t = -K^-1 p_4 in camera 0. `times.txt` must cover every image; ground truth may be shorter (frames without
//! pose) or longer (surplus ignored), and there is none for sequences 11 to 21.

use grnet_geometry::Pose;
use std::path::{Path, PathBuf};

use grnet_frame::Distortion;

use super::intrinsics::Intrinsics;
use super::listing::{
    Listed, Listing, PoseOrigin, Set, entries, folder_name, frame_number, names, numbered_images,
};
use super::pose::Invalid;
use super::pose_table::PoseTable;
use super::text::{TextFile, quoted};
use super::{DatasetError, Layout, OpenOptions};

/// What identifies the layout.
pub(crate) const LOOKED_FOR: &str =
    "sequences/XX/image_0 (or image_1, image_2, image_3), or a sequence folder with image_0 to image_3";

/// In order of preference: the left cameras first.
const CAMERAS: [&str; 4] = ["image_0", "image_2", "image_1", "image_3"];

/// The recordings' rate, where `times.txt` is missing.
const RATE_HZ: f64 = 10.0;

pub(crate) fn fits(path: &Path) -> bool {
    sequence_folders(path).is_ok_and(|found| !found.is_empty())
}

pub(crate) fn list(path: &Path, options: &OpenOptions) -> Result<Set, DatasetError> {
    let camera = options.camera_name.as_deref().map(camera_folder).transpose()?;
    let folders = sequence_folders(path)?;
    if folders.is_empty() {
        return Err(DatasetError::missing(
            path,
            format!("no KITTI sequences in it; looked for {LOOKED_FOR}"),
        ));
    }
    let mut listings = Vec::new();
    for (id, folder) in &folders {
        if options.sequence.as_ref().is_none_or(|chosen| chosen == id) {
            listings.push(listing(folder, id, camera, options)?);
        }
    }
    if listings.is_empty() {
        return Err(DatasetError::NoSuchSequence {
            path: path.to_path_buf(),
            sequence: options.sequence.clone().unwrap_or_default(),
            available: names(folders.iter().map(|(id, _)| id.as_str())),
        });
    }
    let others = folders.into_iter().map(|(id, _)| id);
    let others = others.filter(|id| listings.iter().all(|listing| listing.id != *id)).collect();
    Ok(Set { layout: Layout::Kitti, listings, root: path.to_path_buf(), others })
}

/// `image_2` from `image_2` or `2`.
fn camera_folder(name: &str) -> Result<&'static str, DatasetError> {
    let known = CAMERAS.iter().find(|known| name == **known || known.strip_prefix("image_") == Some(name));
    known.copied().ok_or_else(|| DatasetError::Option {
        option: "camera_name",
        problem: format!("found {}, expected image_0, image_1, image_2 or image_3", quoted(name)),
    })
}

fn sequence_folders(path: &Path) -> Result<Vec<(String, PathBuf)>, DatasetError> {
    let has_images = |folder: &Path| CAMERAS.iter().any(|camera| folder.join(camera).is_dir());
    if has_images(path) {
        return Ok(vec![(folder_name(path), path.to_path_buf())]);
    }
    let inner = path.join("sequences");
    let mut found = entries(if inner.is_dir() { &inner } else { path })?;
    found.retain(|(_, folder)| has_images(folder));
    Ok(found)
}

fn listing(
    folder: &Path,
    id: &str,
    camera: Option<&'static str>,
    options: &OpenOptions,
) -> Result<Listing, DatasetError> {
    let there: Vec<&str> = CAMERAS.iter().copied().filter(|camera| folder.join(camera).is_dir()).collect();
    let camera = match camera {
        Some(camera) if there.contains(&camera) => camera,
        Some(camera) => {
            let expected = format!("the images of the camera asked for (available: {})", there.join(", "));
            return Err(DatasetError::missing(&folder.join(camera), expected));
        }
        None => there[0],
    };
    let images = folder.join(camera);
    let numbered = numbered_images(&images, frame_number)?;
    let Some(&(last, _)) = numbered.last() else {
        return Err(DatasetError::Empty {
            path: images,
            expected: "expected 000000.png, 000001.png, ...".into(),
        });
    };
    let times = TextFile::read_if_present(&folder.join("times.txt"))?
        .map(|file| parse_times(&file, last))
        .transpose()?;
    let mut notes = Vec::new();
    if times.is_none() {
        notes.push(format!("no times.txt: frames are taken to be {RATE_HZ} Hz apart"));
    }
    let frames = numbered
        .into_iter()
        .map(|(number, path)| Listed {
            key: format!("{id}/{camera}/{number:06}"),
            path,
            number,
            time_ns: times.as_ref().map(|times| times[number as usize]),
        })
        .collect();
    let index = camera.bytes().last().map_or(0, |digit| usize::from(digit - b'0'));
    let calibration = TextFile::read_if_present(&folder.join("calib.txt"))?
        .map(|file| parse_calibration(&file, index))
        .transpose()?;
    let (intrinsics, offset) = calibration.unzip();
    if offset.is_none() && index != 0 {
        notes.push(format!("no calib.txt: poses are those of camera 0, not of {camera}"));
    }
    let mut invalid = Invalid::new(options.invalid_poses);
    let poses = match pose_file(folder, id).filter(|_| options.poses.is_none()) {
        Some(path) => PoseOrigin::Table {
            table: PoseTable::parse_kitti(&TextFile::read(&path)?, &mut invalid)?,
            sensor_from_camera: offset.unwrap_or_else(Pose::identity),
        },
        None => PoseOrigin::None,
    };
    let name = format!("KITTI {id} {camera}");
    Ok(Listing {
        id: id.to_string(),
        name,
        frames,
        poses,
        invalid_poses: invalid.count,
        intrinsics,
        default_rate_hz: RATE_HZ,
        notes,
    })
}

/// `poses/06.txt` beside `sequences`, or `poses.txt` in the sequence.
fn pose_file(folder: &Path, id: &str) -> Option<PathBuf> {
    let full = folder.canonicalize().ok()?;
    let beside = full.parent()?.parent().map(|root| root.join("poses").join(format!("{id}.txt")));
    [beside, Some(full.join("poses.txt"))].into_iter().flatten().find(|path| path.is_file())
}

/// Times by frame number, at least up to `last`.
fn parse_times(file: &TextFile, last: u64) -> Result<Vec<u64>, DatasetError> {
    let expected = "seconds since the first frame";
    let mut times = Vec::new();
    for line in file.data_lines() {
        let time_ns = line.seconds_ns(line.text, expected)?;
        if times.last().is_some_and(|before| time_ns < *before) {
            return Err(line.error(format!("{}, less than the line above", quoted(line.text)), expected));
        }
        times.push(time_ns);
    }
    if (times.len() as u64) <= last {
        let expected = format!("a time for each image up to number {last}");
        return Err(file.end().error(format!("the end after {} times", times.len()), expected));
    }
    Ok(times)
}

/// Intrinsics of camera `index`, and its place `camera_0_from_camera`.
fn parse_calibration(file: &TextFile, index: usize) -> Result<(Intrinsics, Pose), DatasetError> {
    let expected = "`P0:` to `P3:`, each with the twelve numbers of a 3x4 projection matrix";
    for (row, line) in file.data_lines().enumerate() {
        let fields = line.fields();
        // Labelled rows may come in any order and among others (Tr:), bare ones are P0 to P3.
        let (label, numbers) = match fields[0].strip_suffix(':') {
            Some(label) => (label.to_string(), &fields[1..]),
            None => (format!("P{row}"), &fields[..]),
        };
        if label != format!("P{index}") {
            continue;
        }
        let p: [f64; 12] = line.numbers(numbers, expected)?;
        let bare = p[1] == 0.0 && p[4] == 0.0 && p[8..11] == [0.0, 0.0, 1.0];
        if !bare || !p.iter().all(|v| v.is_finite()) || p[0] <= 0.0 || p[5] <= 0.0 {
            return Err(
                line.error(quoted(line.text), "a rectified projection K [I | t] with positive focal lengths")
            );
        }
        // K^-1 p_4: the translation of camera_from_camera_0.
        let z = p[11];
        let (x, y) = ((p[3] - p[2] * z) / p[0], (p[7] - p[6] * z) / p[5]);
        let intrinsics = Intrinsics {
            focal_px: (p[0], p[5]),
            centre_px: Some((p[2], p[6])),
            distortion: Distortion::None,
            size_px: None,
            scalable: false,
            origin: file.path().display().to_string(),
        };
        return Ok((intrinsics, Pose::translation(-x, -y, -z)));
    }
    Err(file.end().error(format!("no row P{index}"), expected))
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn file(text: &str) -> TextFile {
        TextFile::from_bytes(Path::new("calib.txt"), text.into()).unwrap()
    }

    const P0: &str = "700 0 600 0 0 700 180 0 0 0 1 0";
    const P1: &str = "700 0 600 -378 0 700 180 0 0 0 1 0";

    #[test]
    fn the_right_camera_sits_a_baseline_to_the_right() {
        for text in [format!("{P0}\n{P1}\n"), format!("Tr: 1 2\nP1: {P1}\nP0: {P0}\n")] {
            let (intrinsics, offset) = parse_calibration(&file(&text), 1).unwrap();
            assert_eq!((intrinsics.focal_px, intrinsics.centre_px), ((700.0, 700.0), Some((600.0, 180.0))));
            assert!((offset.translation.vector - nalgebra::Vector3::new(0.54, 0.0, 0.0)).norm() < 1e-12);
        }
    }

    #[test]
    fn bad_files_are_named_by_line() {
        let calibration = |text: &str| parse_calibration(&file(text), 0).unwrap_err().to_string();
        assert!(calibration("P1: 1\n").starts_with("calib.txt, line 2: found no row P0"));
        assert!(calibration("\nP0: 1 2\n").starts_with("calib.txt, line 2: found 2 fields"));
        assert!(calibration("P0: -7 0 6 0 0 7 1 0 0 0 1 0\n").contains("positive focal lengths"));
        let times = |text: &str| parse_times(&file(text), 2).unwrap_err().to_string();
        assert!(times("0\n1\n").starts_with("calib.txt, line 3: found the end after 2 times"));
        assert!(times("0\n2\n1\n").starts_with("calib.txt, line 3: found \"1\", less than"));
        assert!(times("0\nx\n").starts_with("calib.txt, line 2: found \"x\""));
    }

    proptest! {
        #[test]
        fn any_text_parses_or_is_named(text in "([-P0-9.e: \\n]|\\PC){0,200}", index in 0usize..4) {
            for error in [
                parse_calibration(&file(&text), index).err(),
                parse_times(&file(&text), 3).err(),
            ].into_iter().flatten() {
                prop_assert!(error.to_string().starts_with("calib.txt, line "), "{}", error);
            }
        }
    }
}
