//! Files of a recording, and the folder that replaces its predecessor only when it is complete.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::{fs, io as std_io};

use image::codecs::jpeg::JpegEncoder;
use image::codecs::png::{CompressionType, FilterType, PngEncoder};
use image::{ExtendedColorType, ImageEncoder, ImageError};
use nalgebra::Isometry3;

use super::SynthError;
use super::manifest::{GENERATOR, Manifest};
use super::render::RenderTarget;
use super::writer::{ImageFormat, Recipe};

/// A folder in the making, beside its place.
#[derive(Debug)]
pub struct Staging {
    path: PathBuf,
    folder: PathBuf,
}

impl Staging {
    /// Makes sure that `folder` may be replaced, and creates its staging folder, clearing what a killed run left.
    pub fn create(folder: &Path) -> Result<Self, SynthError> {
        check_replaceable(folder)?;
        let path = staging_path(folder);
        if path.exists() {
            fs::remove_dir_all(&path).map_err(io("clear", &path))?;
        }
        fs::create_dir_all(&path).map_err(io("create", &path))?;
        Ok(Self { path, folder: folder.to_path_buf() })
    }

    /// Where to write.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Puts the finished folder in its place.
    pub fn publish(self) -> Result<(), SynthError> {
        // Looked at again: rendering takes minutes, and somebody may have put files there meanwhile.
        check_replaceable(&self.folder)?;
        if self.folder.exists() {
            fs::remove_dir_all(&self.folder).map_err(io("replace", &self.folder))?;
        }
        fs::rename(&self.path, &self.folder).map_err(io("move the finished recording to", &self.folder))
    }
}

/// Turns an I/O error into ours.
pub fn io<'a>(action: &'static str, path: &'a Path) -> impl FnOnce(std_io::Error) -> SynthError + 'a {
    move |source| SynthError::Io { action, path: path.to_path_buf(), source }
}

/// `.NAME.partial` beside the folder.
pub fn staging_path(folder: &Path) -> PathBuf {
    let name = folder.file_name().unwrap_or_else(|| "recording".as_ref()).to_string_lossy();
    folder.with_file_name(format!(".{name}.partial"))
}

/// `seq-01` for sequence 0.
pub fn sequence_name(sequence: u32) -> String {
    format!("seq-{:02}", sequence + 1)
}

/// Intrinsics, splits, manifest and README.
pub fn write_text(folder: &Path, recipe: &Recipe, manifest: &Manifest) -> Result<(), SynthError> {
    let ((fx, fy), (cx, cy)) = (recipe.camera.focal_px(), recipe.camera.centre_px());
    let rows = [[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]];
    put(&folder.join("camera-intrinsics.txt"), matrix(&rows).as_bytes())?;
    for (split, file) in [("train", "TrainSplit.txt"), ("test", "TestSplit.txt")] {
        let of_split = (0..recipe.sequences).filter(|s| recipe.split_of(*s) == split);
        let lines: String = of_split.map(|s| format!("sequence{}\n", s + 1)).collect();
        put(&folder.join(file), lines.as_bytes())?;
    }
    let mut json = serde_json::to_string_pretty(manifest).unwrap_or_default();
    json.push('\n');
    put(&folder.join("scene.json"), json.as_bytes())?;
    put(&folder.join("README.txt"), README.as_bytes())
}

/// Colour image, pose and, where asked for, depth of one frame; `stem` is the path up to `.color`.
pub fn write_frame(
    recipe: &Recipe,
    stem: &Path,
    rgb: &[u8],
    target: &RenderTarget,
    world_from_camera: &Isometry3<f64>,
) -> Result<(), SynthError> {
    let file = |suffix: &str| PathBuf::from(format!("{}.{suffix}", stem.display()));
    let (width, height) = recipe.camera.size_px();
    let colour = file(&format!("color.{}", recipe.extension()));
    let mut bytes = Vec::new();
    match recipe.format {
        ImageFormat::Jpg(quality) => JpegEncoder::new_with_quality(&mut bytes, quality).encode(
            rgb,
            width,
            height,
            ExtendedColorType::Rgb8,
        ),
        ImageFormat::Png => png(&mut bytes, rgb, width, height, ExtendedColorType::Rgb8),
    }
    .map_err(|source| SynthError::Encode { path: colour.clone(), source })?;
    put(&colour, &bytes)?;
    if recipe.depth {
        let path = file("depth.png");
        let depth: Vec<u8> =
            target.depth_m.iter().flat_map(|d| ((d * 1000.0 + 0.5) as u16).to_ne_bytes()).collect();
        bytes.clear();
        png(&mut bytes, &depth, width, height, ExtendedColorType::L16)
            .map_err(|source| SynthError::Encode { path: path.clone(), source })?;
        put(&path, &bytes)?;
    }
    let pose = world_from_camera.to_homogeneous();
    let rows: [[f64; 4]; 4] = std::array::from_fn(|i| std::array::from_fn(|j| pose[(i, j)]));
    put(&file("pose.txt"), matrix(&rows).as_bytes())
}

fn png(
    to: &mut Vec<u8>,
    data: &[u8],
    width: u32,
    height: u32,
    kind: ExtendedColorType,
) -> Result<(), ImageError> {
    PngEncoder::new_with_quality(to, CompressionType::Fast, FilterType::Sub)
        .write_image(data, width, height, kind)
}

/// Rows of numbers with 17 digits after the first: every f64 comes back exactly.
fn matrix<const N: usize>(rows: &[[f64; N]]) -> String {
    let mut text = String::new();
    for row in rows {
        let cells: Vec<String> = row.iter().map(|x| format!("{x:.17e}")).collect();
        let _ = writeln!(text, "{}", cells.join("\t"));
    }
    text
}

fn put(path: &Path, bytes: &[u8]) -> Result<(), SynthError> {
    fs::write(path, bytes).map_err(io("write", path))
}

/// Errors unless `folder` is new, empty, or holds nothing but a recording of ours.
fn check_replaceable(folder: &Path) -> Result<(), SynthError> {
    let not_ours = |found: PathBuf| SynthError::NotOurs { folder: folder.to_path_buf(), found };
    if !folder.exists() {
        return Ok(());
    }
    let top = entries(folder)?;
    if top.is_empty() {
        return Ok(());
    }
    let manifest = fs::read_to_string(folder.join("scene.json")).unwrap_or_default();
    let manifest: serde_json::Value = serde_json::from_str(&manifest).unwrap_or_default();
    if manifest["generator"] != GENERATOR {
        return Err(not_ours(top[0].clone()));
    }
    const OURS: [&str; 5] =
        ["scene.json", "README.txt", "camera-intrinsics.txt", "TrainSplit.txt", "TestSplit.txt"];
    for path in top {
        let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        if name.starts_with("seq-") && path.is_dir() {
            let foreign = entries(&path)?.into_iter().find(|p| {
                let name = p.file_name().unwrap_or_default().to_string_lossy().into_owned();
                let ends = [".color.png", ".color.jpg", ".depth.png", ".pose.txt"];
                !(name.starts_with("frame-") && ends.iter().any(|end| name.ends_with(end)))
            });
            if let Some(found) = foreign {
                return Err(not_ours(found));
            }
        } else if !OURS.contains(&name.as_str()) {
            return Err(not_ours(path));
        }
    }
    Ok(())
}

fn entries(folder: &Path) -> Result<Vec<PathBuf>, SynthError> {
    let list = fs::read_dir(folder).map_err(io("list", folder))?;
    let mut paths =
        list.map(|e| e.map(|e| e.path())).collect::<Result<Vec<_>, _>>().map_err(io("list", folder))?;
    paths.sort();
    Ok(paths)
}

const README: &str = "\
A synthetic recording in the layout of Microsoft 7-Scenes, written by `grnet-train synth`.

seq-XX/frame-XXXXXX.color.*    colour image, sRGB
seq-XX/frame-XXXXXX.depth.png  depth along the optical axis in millimetres (only with --depth)
seq-XX/frame-XXXXXX.pose.txt   world_from_camera, 4x4, metres; camera x right, y down, z forward; world z up
camera-intrinsics.txt          pinhole matrix in pixels, pixel centres at integers
TrainSplit.txt, TestSplit.txt  which sequences are for training and for testing
scene.json                     seeds, generator version, frame rate, camera, corners of the pictures

The whole folder follows from the values in scene.json; running the command again replaces it.
";
