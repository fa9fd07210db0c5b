//! The public recordings that developers keep beside the repository: by `GRNET_DATA`, or in `../shared/data`.

use std::collections::HashSet;
use std::path::{Path, PathBuf};
use std::time::Duration;

use grnet_frame::{FrameSource, PixelFormat, Received};

use crate::dataset::{OpenOptions, Recording, Split, open_one};
use crate::{FolderOptions, FolderSource, Pace};

/// The folder of a data set, or a message that the test is skipped.
fn data(name: &str) -> Option<PathBuf> {
    let beside = || Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared/data");
    let path = std::env::var_os("GRNET_DATA").map_or_else(beside, PathBuf::from).join(name);
    if !path.exists() {
        println!("skipped: no {} (set GRNET_DATA to the folder of the data sets)", path.display());
        return None;
    }
    Some(path)
}

fn red_kitchen(split: &str) -> Option<Recording> {
    let options = OpenOptions { split: Split::List(split.into()), ..Default::default() };
    Some(open_one(&data("redkitchen")?, &options).unwrap())
}

fn path_length_m(recording: &Recording) -> f64 {
    let places: Vec<_> = recording
        .frames
        .iter()
        .filter_map(|frame| Some(frame.world_from_camera?.translation.vector))
        .collect();
    places.windows(2).map(|pair| (pair[1] - pair[0]).norm()).sum()
}

#[test]
fn red_kitchen_has_nine_hundred_posed_frames() {
    let Some(path) = data("redkitchen") else { return };
    let recording = open_one(&path, &OpenOptions::default()).unwrap();
    assert_eq!(
        (recording.frames.len(), recording.frames_without_pose(), recording.invalid_poses),
        (900, 0, 0)
    );
    assert_eq!(
        (recording.image_size_px, recording.camera.unwrap().focal_px()),
        (Some((640, 480)), (525.0, 525.0))
    );
    let length_m = path_length_m(&recording);
    assert!((5.0..40.0).contains(&length_m), "{length_m} m");
    let first = recording.frames[0].world_from_camera.unwrap();
    assert!((first.translation.x - -0.340_456_34).abs() < 1e-7);
    let alone = open_one(&path.join("seq-01"), &OpenOptions::default()).unwrap();
    assert_eq!(alone.frames, recording.frames);
}

#[test]
fn red_kitchen_splits_are_disjoint() {
    for (split, sizes) in [("interleave", (540, 180)), ("returnsweep", (650, 250))] {
        let Some(train) = red_kitchen(&format!("{split}_train.txt")) else { return };
        let Some(test) = red_kitchen(&format!("{split}_test.txt")) else { return };
        assert_eq!((train.frames.len(), test.frames.len()), sizes, "{split}");
        let seen: HashSet<u64> = train.frames.iter().map(|frame| frame.sequence).collect();
        assert!(test.frames.iter().all(|frame| !seen.contains(&frame.sequence)), "{split}");
    }
}

#[test]
fn red_kitchen_plays() {
    let Some(path) = data("redkitchen") else { return };
    let recording = open_one(&path, &OpenOptions::default()).unwrap();
    let options = FolderOptions { pace: Pace::Max, start_at: 890, ..Default::default() };
    let mut source = FolderSource::with_options(recording, options).unwrap();
    let mut frames = 0;
    while let Received::Frame(frame) = source.next_frame(Duration::from_secs(20)).unwrap() {
        let pixels = &frame.pixels;
        let found = (pixels.format(), pixels.width_px(), pixels.height_px());
        assert_eq!(found, (PixelFormat::Rgb8, 640, 480));
        frames += 1;
    }
    assert_eq!(frames, 10);
}

#[test]
fn kitti_sequences_are_read() {
    let Some(path) = data("kitti") else { return };
    let chosen = |id: &str| OpenOptions { sequence: Some(id.into()), ..Default::default() };
    let six = open_one(&path, &chosen("06")).unwrap();
    assert_eq!((six.frames.len(), six.frames_without_pose()), (51, 0));
    assert_eq!(six.frames[1].time_ns, 104_498_900);
    let camera = six.camera.unwrap();
    assert_eq!((camera.focal_px(), camera.centre_px()), ((707.0912, 707.0912), (601.8873, 183.1104)));
    let length_m = path_length_m(&six);
    assert!((50.0..80.0).contains(&length_m), "{length_m} m in five seconds");
    let zero = open_one(&path, &chosen("00")).unwrap();
    assert_eq!((zero.frames.len(), zero.camera), (5, None));
    let mut source = FolderSource::new(zero, Pace::Max, false).unwrap();
    let Ok(Received::Frame(frame)) = source.next_frame(Duration::from_secs(20)) else { panic!("no frame") };
    assert_eq!(frame.pixels.format(), PixelFormat::Gray8);
}

#[test]
fn published_trajectories_serve_as_ground_truth() {
    let (Some(path), Some(trajectories)) = (data("kitti"), data("trajectories")) else { return };
    let with = |file: &str| OpenOptions {
        sequence: Some("06".into()),
        poses: Some(trajectories.join(file)),
        ..Default::default()
    };
    let own = open_one(&path, &OpenOptions { sequence: Some("06".into()), ..Default::default() }).unwrap();
    // 1101 rows for 51 images.
    let longer = open_one(&path, &with("kitti/gt/06.txt")).unwrap();
    assert_eq!(longer.frames, own.frames);
    // Rows with the frame number first, from 2.
    let indexed = open_one(&path, &with("kitti/methods/kitti-odom-eval_example_0/09.txt")).unwrap();
    assert_eq!(indexed.frames_without_pose(), 2);
    // Times of another day: no frame has a pose.
    let elsewhere = open_one(&path, &with("tum/freiburg1_xyz-groundtruth.txt")).unwrap();
    assert_eq!(elsewhere.frames_without_pose(), 51);
}
