//! COLMAP text models: `cameras.txt` and `images.txt` beside the images, or in `sparse/0` or `sparse` of a
//! project whose images lie in `images`.
//!
//! `images.txt` holds `camera_from_world` (quaternion w, x, y, z). COLMAP counts pixels from the corner of the
//! image (the first pixel's centre is at 0.5), grnet from the centre of its first pixel: half a pixel is taken
//! off the principal point. Each camera gives a recording of its own, as intrinsics and sizes differ.

use grnet_geometry::Pose;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use super::colmap_camera::parse_cameras;
use super::images::stamp_of;
use super::listing::{Listed, Listing, PoseOrigin, Set, folder_name, names};
use super::pose::{Invalid, from_quaternion};
use super::pose_table::{PoseTable, key_of};
use super::text::{Line, TextFile, quoted};
use super::{DatasetError, Layout, OpenOptions};

/// What identifies the layout.
pub(crate) const LOOKED_FOR: &str = "cameras.txt and images.txt, here or in sparse/0 or sparse";

const RATE_HZ: f64 = 30.0;

pub(crate) fn fits(path: &Path) -> bool {
    model_folder(path).is_some() || binary_model(path).is_some()
}

pub(crate) fn list(path: &Path, options: &OpenOptions) -> Result<Set, DatasetError> {
    let Some(model) = model_folder(path) else {
        return Err(match binary_model(path) {
            Some(binary) => DatasetError::missing(
                &binary.join("images.txt"),
                "the model is there in binary form only: convert it with `colmap model_converter --output_type TXT`",
            ),
            None => DatasetError::missing(&path.join("images.txt"), format!("looked for {LOOKED_FOR}")),
        });
    };
    let cameras = parse_cameras(&TextFile::read(&model.join("cameras.txt"))?)?;
    let file = TextFile::read(&model.join("images.txt"))?;
    let mut by_camera: BTreeMap<u64, Vec<(ColmapImage, usize)>> = BTreeMap::new();
    let mut seen = std::collections::HashMap::new();
    for (image, line) in parse_images(&file)? {
        let at = Line { path: file.path(), number: line, text: "" };
        if !cameras.contains_key(&image.camera) {
            return Err(at.error(format!("camera {}", image.camera), "a camera that cameras.txt lists"));
        }
        if let Some(before) = seen.insert(image.name.clone(), line) {
            let found = format!("{} again, as in line {before}", quoted(&image.name));
            return Err(at.error(found, "each image once"));
        }
        by_camera.entry(image.camera).or_default().push((image, line));
    }
    if let Some(wanted) = &options.camera_name {
        let id = wanted.parse::<u64>().ok().filter(|id| by_camera.contains_key(id));
        let available: Vec<String> = by_camera.keys().map(u64::to_string).collect();
        let id = id.ok_or_else(|| DatasetError::Option {
            option: "camera_name",
            problem: format!(
                "found {}, expected the number of a camera with images ({})",
                quoted(wanted),
                names(available.iter().map(String::as_str))
            ),
        })?;
        by_camera.retain(|camera, _| *camera == id);
    }
    if by_camera.is_empty() {
        return Err(DatasetError::Empty {
            path: file.path().to_path_buf(),
            expected: "it lists no images".into(),
        });
    }
    let root = images_folder(path, &model);
    let single = by_camera.len() == 1;
    let listings: Result<_, _> = by_camera
        .into_iter()
        .map(|(camera, images)| {
            let project = folder_name(path);
            let id = if single { project.clone() } else { format!("camera-{camera}") };
            let name = if single { format!("COLMAP {id}") } else { format!("COLMAP {project} {id}") };
            let mut listing = listing(images, &root, &file, options)?;
            listing.intrinsics = cameras.get(&camera).cloned();
            Ok(Listing { id, name, ..listing })
        })
        .collect();
    Ok(Set { layout: Layout::Colmap, listings: listings?, root: path.to_path_buf(), others: Vec::new() })
}

/// One image line of `images.txt`.
struct ColmapImage {
    name: String,
    camera: u64,
    /// `world_from_camera`, or what is wrong with it.
    pose: Result<Pose, String>,
}

fn listing(
    mut images: Vec<(ColmapImage, usize)>,
    root: &Path,
    file: &TextFile,
    options: &OpenOptions,
) -> Result<Listing, DatasetError> {
    images.sort_by(|(a, _), (b, _)| {
        alphanumeric_sort::compare_str(&a.name, &b.name).then_with(|| a.name.cmp(&b.name))
    });
    let mut invalid = Invalid::new(options.invalid_poses);
    let mut by_name = std::collections::HashMap::new();
    let mut frames = Vec::new();
    let stamps: Option<Vec<u64>> = images.iter().map(|(image, _)| stamp_of(Path::new(&image.name))).collect();
    for (index, (image, number)) in images.into_iter().enumerate() {
        let at = Line { path: file.path(), number, text: "" };
        if let (Some(pose), None) = (invalid.judge(&at, image.pose)?, &options.poses) {
            by_name.insert(key_of(&image.name), (pose, None));
        }
        frames.push(Listed {
            key: key_of(&image.name),
            path: root.join(&image.name),
            number: index as u64,
            time_ns: stamps.as_ref().map(|stamps| stamps[index]),
        });
    }
    if stamps.is_some() {
        frames.sort_by_key(|frame| frame.time_ns);
        frames.iter_mut().zip(0..).for_each(|(frame, number)| frame.number = number);
    }
    Ok(Listing {
        id: String::new(),
        name: String::new(),
        frames,
        poses: PoseOrigin::Table { table: PoseTable::Named(by_name), sensor_from_camera: Pose::identity() },
        invalid_poses: invalid.count,
        intrinsics: None,
        default_rate_hz: RATE_HZ,
        notes: Vec::new(),
    })
}

/// Image lines with their line numbers. Every second line lists the image's points and may be empty.
fn parse_images(file: &TextFile) -> Result<Vec<(ColmapImage, usize)>, DatasetError> {
    let expected = "`image_id qw qx qy qz tx ty tz camera_id name`, each followed by a line of points \
                    `x y point3d_id ...` that may be empty";
    let mut images = Vec::new();
    let mut lines = file.lines().filter(|line| !line.text.starts_with('#'));
    while let Some(line) = lines.next() {
        if line.text.is_empty() {
            continue;
        }
        let fields = line.fields();
        if fields.len() < 10 {
            return Err(line.error(format!("{} fields in {}", fields.len(), quoted(line.text)), expected));
        }
        line.integer(fields[0], expected)?;
        let [qw, qx, qy, qz, tx, ty, tz] = line.numbers(&fields[1..8], expected)?;
        let camera = line.integer(fields[8], expected)?;
        let pose = from_quaternion([tx, ty, tz], [qx, qy, qz, qw]);
        let image = ColmapImage { name: rest_after(line.text, 9), camera, pose: pose.map(|p| p.inverse()) };
        images.push((image, line.number));
        if let Some(points) = lines.next() {
            let count = points.fields().len();
            if count % 3 != 0 {
                return Err(points.error(format!("{count} fields in {}", quoted(points.text)), expected));
            }
        }
    }
    Ok(images)
}

/// What follows the first `skip` fields: a name that may hold spaces.
fn rest_after(text: &str, skip: usize) -> String {
    let mut rest = text;
    for _ in 0..skip {
        rest = rest.split_once(char::is_whitespace).map_or("", |(_, after)| after.trim_start());
    }
    rest.to_string()
}

fn model_folder(path: &Path) -> Option<PathBuf> {
    let text = |folder: &PathBuf| folder.join("cameras.txt").is_file() && folder.join("images.txt").is_file();
    candidates(path).into_iter().find(text)
}

fn binary_model(path: &Path) -> Option<PathBuf> {
    candidates(path).into_iter().find(|folder| folder.join("images.bin").is_file())
}

fn candidates(path: &Path) -> [PathBuf; 3] {
    [path.to_path_buf(), path.join("sparse/0"), path.join("sparse")]
}

/// The folder that image names are relative to.
fn images_folder(path: &Path, model: &Path) -> PathBuf {
    let full = model.canonicalize().unwrap_or_else(|_| model.to_path_buf());
    let mut above = vec![path.to_path_buf()];
    above.extend(full.ancestors().take(3).map(Path::to_path_buf));
    let named = above.into_iter().map(|folder| folder.join("images")).find(|folder| folder.is_dir());
    named.unwrap_or_else(|| path.to_path_buf())
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn parse(text: &str) -> Result<Vec<(ColmapImage, usize)>, DatasetError> {
        parse_images(&TextFile::from_bytes(Path::new("images.txt"), text.into()).unwrap())
    }

    #[test]
    fn images_hold_the_inverse_pose_and_names_with_spaces() {
        let images =
            parse("# list\n1 1 0 0 0 1 2 3 7 a b.png\n\n2 1 0 0 0 0 0 0 7 c.png\n1 2 -1 3 4 5\n").unwrap();
        let (first, line) = &images[0];
        assert_eq!((first.name.as_str(), first.camera, *line), ("a b.png", 7, 2));
        let pose = first.pose.as_ref().unwrap();
        assert_eq!(pose.translation.vector.as_slice(), [-1.0, -2.0, -3.0]);
        assert_eq!(images[1].0.name, "c.png");
    }

    #[test]
    fn bad_lines_are_named() {
        for (text, start) in [
            ("1 1 0 0\n", "images.txt, line 1: found 4 fields"),
            ("x 1 0 0 0 1 2 3 7 a.png\n", "images.txt, line 1: found \"x\""),
            ("1 1 0 0 0 1 2 z 7 a.png\n", "images.txt, line 1: found \"z\""),
            // A file whose empty lines of points were lost.
            ("1 1 0 0 0 1 2 3 7 a.png\n2 1 0 0 0 1 2 3 7 b.png\n", "images.txt, line 2: found 10 fields"),
        ] {
            let error = parse(text).err().unwrap().to_string();
            assert!(error.starts_with(start), "{error}");
        }
    }

    proptest! {
        #[test]
        fn any_text_parses_or_is_named(text in "([-0-9.e \\n]|\\PC){0,200}") {
            if let Err(error) = parse(&text) {
                prop_assert!(error.to_string().starts_with("images.txt, line "), "{}", error);
            }
        }
    }
}
