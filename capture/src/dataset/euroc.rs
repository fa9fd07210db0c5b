//! EuRoC MAV / ASL (also TUM-VI): `mav0/cam0/data.csv` (`time_ns,name`) with images in `mav0/cam0/data`,
//! `mav0/cam0/sensor.yaml` (intrinsics, distortion, `T_BS`), and the state of the body in
//! `mav0/state_groundtruth_estimate0/data.csv` or `mav0/mocap0/data.csv`.
//!
//! `T_BS` is `body_from_camera`: the true pose of the camera is `world_from_body * body_from_camera`. Without
//! it the frames have no pose, as the body's would be mistaken for the camera's.

use std::path::{Path, PathBuf};

use super::listing::{Listed, Listing, PoseOrigin, Set, entries, folder_name, names};
use super::pose::Invalid;
use super::pose_table::{PoseTable, key_of};
use super::sensor_yaml::{Sensor, parse_sensor};
use super::text::{TextFile, quoted};
use super::{DatasetError, Layout, OpenOptions};

/// What identifies the layout.
pub(crate) const LOOKED_FOR: &str = "mav0/cam0/data.csv, or cam0/data.csv";

const RATE_HZ: f64 = 20.0;
const GROUND_TRUTH: [&str; 2] = ["state_groundtruth_estimate0", "mocap0"];

pub(crate) fn fits(path: &Path) -> bool {
    cameras(&mav_folder(path)).is_ok_and(|cameras| !cameras.is_empty())
}

pub(crate) fn list(path: &Path, options: &OpenOptions) -> Result<Set, DatasetError> {
    let mav = mav_folder(path);
    let available = cameras(&mav)?;
    let camera = match &options.camera_name {
        Some(name) if available.contains(name) => name.clone(),
        Some(name) => {
            let all = names(available.iter().map(String::as_str));
            let expected = format!("the camera asked for (available: {all})");
            return Err(DatasetError::missing(&mav.join(name), expected));
        }
        None => available.first().cloned().ok_or_else(|| {
            DatasetError::missing(&mav.join("cam0/data.csv"), "the images of the EuRoC layout")
        })?,
    };
    let folder = mav.join(&camera);
    let data = folder.join("data.csv");
    let frames: Vec<Listed> = parse_list(&TextFile::read(&data)?)?
        .into_iter()
        .zip(0..)
        .map(|((time_ns, name), number)| Listed {
            key: format!("{camera}/{}", key_of(&name)),
            path: folder.join("data").join(&name),
            number,
            time_ns: Some(time_ns),
        })
        .collect();
    if frames.is_empty() {
        return Err(DatasetError::Empty { path: data, expected: "expected lines `time_ns,name`".into() });
    }
    let sensor = TextFile::read_if_present(&folder.join("sensor.yaml"))?
        .map(|file| parse_sensor(&file))
        .transpose()?
        .unwrap_or_default();
    let mut notes = Vec::new();
    let mut invalid = Invalid::new(options.invalid_poses);
    let poses = match options.poses {
        Some(_) => PoseOrigin::None,
        None => poses(&mav, &sensor, &mut invalid, &mut notes)?,
    };
    let id = match folder_name(path) {
        own if own == "mav0" => folder_name(&path.join("..")),
        own => own,
    };
    let listing = Listing {
        name: format!("EuRoC {id} {camera}"),
        id,
        frames,
        poses,
        invalid_poses: invalid.count,
        intrinsics: sensor.intrinsics,
        default_rate_hz: RATE_HZ,
        notes,
    };
    Ok(Set { layout: Layout::Euroc, listings: vec![listing], root: path.to_path_buf(), others: Vec::new() })
}

fn poses(
    mav: &Path,
    sensor: &Sensor,
    invalid: &mut Invalid,
    notes: &mut Vec<String>,
) -> Result<PoseOrigin, DatasetError> {
    let files = GROUND_TRUTH.map(|folder| mav.join(folder).join("data.csv"));
    let Some(file) = files.iter().find(|file| file.is_file()) else {
        return Ok(PoseOrigin::None);
    };
    let Some(body_from_camera) = sensor.body_from_camera else {
        notes.push(format!("{} is not used: sensor.yaml gives no T_BS", file.display()));
        return Ok(PoseOrigin::None);
    };
    let table = PoseTable::parse_asl(&TextFile::read(file)?, invalid)?;
    Ok(PoseOrigin::Table { table, sensor_from_camera: body_from_camera })
}

fn mav_folder(path: &Path) -> PathBuf {
    let inner = path.join("mav0");
    if inner.is_dir() { inner } else { path.to_path_buf() }
}

/// `cam0`, `cam1`, ... that have a list of images.
fn cameras(mav: &Path) -> Result<Vec<String>, DatasetError> {
    let found = entries(mav)?.into_iter();
    let found = found.filter(|(name, path)| name.starts_with("cam") && path.join("data.csv").is_file());
    Ok(found.map(|(name, _)| name).collect())
}

/// Times in nanoseconds and image names.
fn parse_list(file: &TextFile) -> Result<Vec<(u64, String)>, DatasetError> {
    let expected = "`time_ns,name`";
    let mut images: Vec<(u64, String)> = Vec::new();
    for line in file.data_lines() {
        let fields = line.comma_fields();
        let [time, name] = fields[..] else { return Err(line.unexpected(expected)) };
        let time_ns = line.integer(time, expected)?;
        if name.is_empty() {
            return Err(line.unexpected(expected));
        }
        if images.last().is_some_and(|(before_ns, _)| time_ns < *before_ns) {
            let found = format!("a time before the line above in {}", quoted(line.text));
            return Err(line.error(found, "times in growing order"));
        }
        images.push((time_ns, name.to_string()));
    }
    Ok(images)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn parse(text: &str) -> Result<Vec<(u64, String)>, DatasetError> {
        parse_list(&TextFile::from_bytes(Path::new("data.csv"), text.into()).unwrap())
    }

    #[test]
    fn a_list_has_nanoseconds_and_names() {
        let images =
            parse("#timestamp [ns],filename\r\n1403636579763555584,1403636579763555584.png\r\n").unwrap();
        assert_eq!(images, [(1_403_636_579_763_555_584, "1403636579763555584.png".to_string())]);
    }

    #[test]
    fn bad_lines_are_named() {
        for (text, start) in [
            ("1\n", "data.csv, line 1: found \"1\", expected `time_ns,name`"),
            ("#\n1.5,a.png\n", "data.csv, line 2: found \"1.5\""),
            ("2,a.png\n1,b.png\n", "data.csv, line 2: found a time before the line above"),
            ("2,\n", "data.csv, line 1: found \"2,\""),
        ] {
            let error = parse(text).unwrap_err().to_string();
            assert!(error.starts_with(start), "{error}");
        }
    }

    proptest! {
        #[test]
        fn any_text_parses_or_is_named(text in "([-0-9.,e \\n]|\\PC){0,200}") {
            if let Err(error) = parse(&text) {
                prop_assert!(error.to_string().starts_with("data.csv, line "), "{}", error);
            }
        }
    }
}
