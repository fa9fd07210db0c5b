//! Recordings of the synthetic place on disk.

use std::fs;
use std::path::Path;

use grnet_capture::dataset::{self, OpenOptions, Split};
use grnet_frame::{Camera, Distortion};
use grnet_train::synth::{
    ImageFormat, PathOptions, Recipe, Scene, SceneOptions, SensorOptions, Shutter, SynthError, Trajectory,
    Volume, VolumeKind, write,
};

fn recipe() -> Recipe {
    Recipe {
        scene: SceneOptions { room: 4, texel_m: 0.05 },
        volume: VolumeKind::Handheld,
        seed: 9,
        sequences: 3,
        test_sequences: 1,
        frames: 5,
        rate_hz: 30.0,
        camera: Camera::new((64, 48), (52.5, 52.5), (31.5, 23.5), Distortion::None).unwrap(),
        format: ImageFormat::Png,
        depth: true,
        edge_samples: 4,
        sensor: SensorOptions::default(),
        shutter: Shutter::default(),
    }
}

fn write_quietly(recipe: &Recipe, folder: &Path) -> Result<(), SynthError> {
    write(recipe, folder, &|| {})
}

/// All files below a folder with their contents.
fn contents(folder: &Path) -> Vec<(String, Vec<u8>)> {
    let mut files = Vec::new();
    let mut open = vec![folder.to_path_buf()];
    while let Some(next) = open.pop() {
        for entry in fs::read_dir(&next).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                open.push(path);
            } else {
                let name = path.strip_prefix(folder).unwrap().display().to_string();
                files.push((name, fs::read(&path).unwrap()));
            }
        }
    }
    files.sort();
    files
}

#[test]
fn the_dataset_reader_gets_back_exactly_what_was_rendered() {
    let root = tempfile::tempdir().unwrap();
    let folder = root.path().join("room");
    let recipe = recipe();
    write_quietly(&recipe, &folder).unwrap();
    let recordings = dataset::open(&folder, &OpenOptions::default()).unwrap();
    assert_eq!(recordings.iter().map(|r| r.id.as_str()).collect::<Vec<_>>(), ["seq-01", "seq-02", "seq-03"]);
    let scene = Scene::build(recipe.scene);
    let volume = Volume::of(&scene, recipe.volume);
    for (sequence, recording) in (0..).zip(&recordings) {
        assert_eq!(recording.camera, Some(recipe.camera));
        assert_eq!(
            (recording.frames.len(), recording.frames_without_pose(), recording.invalid_poses),
            (5, 0, 0)
        );
        let options = PathOptions { seed: 9, sequence, frames: 5, rate_hz: 30.0 };
        let path = Trajectory::generate(&scene, &volume, options).unwrap();
        for (index, frame) in (0..).zip(&recording.frames) {
            let (read, rendered) =
                (frame.world_from_camera.unwrap(), path.world_from_camera(path.time_s(index)));
            assert_eq!(read.translation.vector.as_slice(), rendered.translation.vector.as_slice());
            assert!(read.rotation.angle_to(&rendered.rotation) < 1e-7);
            let image = image::open(&frame.path).unwrap();
            assert_eq!((image.width(), image.height()), (64, 48));
        }
    }
    for (split, expected) in [(Split::Train, vec!["seq-01", "seq-02"]), (Split::Test, vec!["seq-03"])] {
        let chosen = dataset::open(&folder, &OpenOptions { split, ..Default::default() }).unwrap();
        assert_eq!(chosen.iter().map(|r| r.id.as_str()).collect::<Vec<_>>(), expected);
    }
    let manifest: serde_json::Value =
        serde_json::from_slice(&fs::read(folder.join("scene.json")).unwrap()).unwrap();
    assert_eq!(
        (&manifest["room"], &manifest["seed"], &manifest["rate_hz"]),
        (&4.into(), &9.into(), &30.0.into())
    );
    let depth = image::open(folder.join("seq-01/frame-000000.depth.png")).unwrap().into_luma16();
    assert!(depth.pixels().all(|p| (300..9000).contains(&p.0[0])));
}

#[test]
fn writing_again_gives_the_same_bytes_and_replaces_the_old_recording() {
    let root = tempfile::tempdir().unwrap();
    let (first, second) = (root.path().join("a"), root.path().join("b"));
    let jpg = Recipe { format: ImageFormat::Jpg(90), frames: 3, sequences: 2, ..recipe() };
    write_quietly(&jpg, &first).unwrap();
    write_quietly(&Recipe { frames: 4, ..jpg.clone() }, &second).unwrap();
    write_quietly(&jpg, &second).unwrap();
    assert_eq!(contents(&first), contents(&second), "the fourth frame is gone, the others are the same");
    assert!(!Recipe::staging_folder(&second).exists());
}

#[test]
fn a_foreign_folder_is_never_touched() {
    let root = tempfile::tempdir().unwrap();
    let folder = root.path().join("holiday");
    fs::create_dir(&folder).unwrap();
    write_quietly(&Recipe { frames: 1, ..recipe() }, &folder).expect("an empty folder may be filled");
    for foreign in ["notes.txt", "seq-01/mine.txt"] {
        fs::write(folder.join(foreign), "mine").unwrap();
        let before = contents(&folder);
        let error = write_quietly(&recipe(), &folder).unwrap_err().to_string();
        let name = foreign.rsplit('/').next().unwrap();
        assert!(error.contains(name) && error.contains("choose an empty or new folder"), "{error}");
        assert_eq!(contents(&folder), before);
        fs::remove_file(folder.join(foreign)).unwrap();
    }
    fs::write(folder.join("scene.json"), "{\"generator\": \"somebody else\"}").unwrap();
    assert!(matches!(write_quietly(&recipe(), &folder), Err(SynthError::NotOurs { .. })));
}

#[test]
fn what_a_killed_run_left_is_cleared() {
    let root = tempfile::tempdir().unwrap();
    let folder = root.path().join("room");
    let staging = Recipe::staging_folder(&folder);
    fs::create_dir_all(staging.join("seq-01")).unwrap();
    fs::write(staging.join("seq-01/frame-000000.color.png"), "half a fr").unwrap();
    write_quietly(&Recipe { frames: 1, ..recipe() }, &folder).unwrap();
    assert!(!staging.exists() && folder.join("seq-01/frame-000000.pose.txt").exists());
}

#[test]
fn motion_blur_smears_the_picture_but_not_the_pose() {
    let root = tempfile::tempdir().unwrap();
    let (sharp, blurred) = (root.path().join("sharp"), root.path().join("blurred"));
    let recipe =
        Recipe { sensor: SensorOptions::clean(), sequences: 1, test_sequences: 0, frames: 2, ..recipe() };
    write_quietly(&recipe, &sharp).unwrap();
    let shutter = Shutter { exposure_ms: 30.0, readout_ms: 20.0 };
    write_quietly(&Recipe { shutter, ..recipe }, &blurred).unwrap();
    let read = |folder: &Path, file: &str| fs::read(folder.join("seq-01").join(file)).unwrap();
    assert_eq!(read(&sharp, "frame-000001.pose.txt"), read(&blurred, "frame-000001.pose.txt"));
    assert_ne!(read(&sharp, "frame-000001.color.png"), read(&blurred, "frame-000001.color.png"));
}

#[test]
fn nonsense_is_refused_by_name_before_anything_is_written() {
    let root = tempfile::tempdir().unwrap();
    let folder = root.path().join("room");
    let refused = |recipe: Recipe, expected: &str| {
        let error = write_quietly(&recipe, &folder).unwrap_err().to_string();
        assert!(error.contains(expected), "{error}");
        assert!(!folder.exists() && !Recipe::staging_folder(&folder).exists());
    };
    refused(Recipe { sequences: 0, ..recipe() }, "sequences 0: 1 to 99 expected");
    refused(Recipe { test_sequences: 4, ..recipe() }, "test sequences 4");
    refused(Recipe { frames: 0, ..recipe() }, "frames 0");
    refused(Recipe { rate_hz: f64::NAN, ..recipe() }, "rate NaN");
    refused(Recipe { format: ImageFormat::Jpg(0), ..recipe() }, "JPEG quality 0: 1 to 100 expected");
    refused(Recipe { scene: SceneOptions { room: 1, texel_m: f32::NAN }, ..recipe() }, "texel size");
    refused(Recipe { shutter: Shutter { exposure_ms: -1.0, readout_ms: 0.0 }, ..recipe() }, "exposure -1 ms");
    let file = root.path().join("file");
    fs::write(&file, "a file").unwrap();
    let error = write_quietly(&recipe(), &file).unwrap_err().to_string();
    assert!(error.contains("cannot list") && error.contains("file"), "{error}");
}
