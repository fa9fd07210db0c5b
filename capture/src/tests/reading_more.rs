//! Made TUM, EuRoC, COLMAP and image recordings.

use std::time::Duration;

use grnet_frame::Distortion;

use super::made;
use crate::dataset::{Association, OpenOptions, Recording, Split, open_one};

fn places(recording: &Recording) -> Vec<Option<f64>> {
    let rounded = |x: f64| (x * 1e6).round() / 1e6;
    recording
        .frames
        .iter()
        .map(|frame| frame.world_from_camera.map(|pose| rounded(pose.translation.x)))
        .collect()
}

fn levels(recording: &Recording) -> Vec<u8> {
    let level =
        |frame: &crate::dataset::RecordedFrame| crate::decode::decode_file(&frame.path).unwrap().data()[0];
    recording.frames.iter().map(level).collect()
}

#[test]
fn tum_times_are_exact_and_poses_lie_between() {
    let folder = made::tum();
    let recording = folder.open_one(&OpenOptions::default()).unwrap();
    assert_eq!(recording.frames[1].time_ns, 1_000_045_000_000);
    // The truth ends at 0.13 s, before the last image at 0.165 s.
    assert_eq!(places(&recording), [Some(0.005), Some(0.045), Some(0.085), Some(0.125), None]);
    let nearest =
        OpenOptions { association: Association::Nearest(Duration::from_millis(40)), ..Default::default() };
    let nearest = folder.open_one(&nearest).unwrap();
    assert_eq!(places(&nearest)[4], Some(0.13));
    let strict =
        OpenOptions { association: Association::Nearest(Duration::from_millis(1)), ..Default::default() };
    assert_eq!(folder.open_one(&strict).unwrap().frames_without_pose(), 5);
    assert_eq!(recording.camera, None);
}

#[test]
fn tum_parts_may_be_missing_or_bad() {
    let folder = made::tum();
    let options = OpenOptions::default();
    folder.write("groundtruth.txt", "# only\n1000.0 0 0 0 0 0 0\n");
    let message = folder.refusal(&options);
    assert!(message.starts_with("groundtruth.txt, line 2: found 7 fields"), "{message}");
    std::fs::remove_file(folder.join("groundtruth.txt")).unwrap();
    assert_eq!(folder.open_one(&options).unwrap().notes, ["no ground truth"]);
    folder.write("camera-intrinsics.txt", "6 0 4\n0 7 3\n0 0 1\n");
    assert_eq!(folder.open_one(&options).unwrap().camera.unwrap().focal_px(), (6.0, 7.0));
    folder.write("rgb.txt", "# empty\n");
    assert!(folder.refusal(&options).starts_with("rgb.txt holds no frames"));
}

#[test]
fn euroc_poses_are_those_of_the_camera() {
    let folder = made::euroc();
    let recording = folder.open_one(&OpenOptions::default()).unwrap();
    assert_eq!(places(&recording), [0.0, 1.0, 2.0, 3.0].map(Some));
    assert!(recording.frames.iter().all(|frame| frame.world_from_camera.unwrap().translation.z == 0.5));
    let camera = recording.camera.unwrap();
    assert_eq!(
        (camera.focal_px(), camera.distortion()),
        ((10.0, 11.0), Distortion::Equidistant([1.0, 2.0, 3.0, 4.0]))
    );
    assert_eq!(recording.nominal_rate_hz, Some(20.0));
    assert_eq!(open_one(&folder.join("mav0"), &OpenOptions::default()).unwrap().frames, recording.frames);
    // cam1 has no sensor.yaml: the body's pose is not passed off as the camera's.
    let second = OpenOptions { camera_name: Some("cam1".into()), ..Default::default() };
    let second = folder.open_one(&second).unwrap();
    assert_eq!((second.frames_without_pose(), second.camera), (4, None));
    assert!(second.notes.iter().any(|note| note.contains("gives no T_BS")), "{:?}", second.notes);
    let third = OpenOptions { camera_name: Some("cam2".into()), ..Default::default() };
    assert!(folder.refusal(&third).ends_with("the camera asked for (available: cam0, cam1)"));
}

#[test]
fn colmap_images_are_inverted_and_in_natural_order() {
    let folder = made::colmap();
    let recording = folder.open_one(&OpenOptions::default()).unwrap();
    assert_eq!(places(&recording), [2.0, 9.0, 10.0].map(Some));
    assert_eq!(levels(&recording), [2, 9, 10]);
    let camera = recording.camera.unwrap();
    assert_eq!((camera.centre_px(), camera.size_px()), ((3.5, 2.5), (8, 6)));
    assert_eq!(open_one(&folder.join("sparse/0"), &OpenOptions::default()).unwrap().frames, recording.frames);
}

#[test]
fn each_colmap_camera_is_a_recording() {
    let folder = made::colmap();
    folder.write("sparse/0/cameras.txt", "1 PINHOLE 8 6 10 10 4 3\n3 PINHOLE 8 6 12 12 4 3\n");
    let line = |n: u8, camera: u8| format!("{n} 1 0 0 0 -{n} 0 0 {camera} im {n}.png\n\n");
    folder.write("sparse/0/images.txt", line(2, 3) + &line(9, 1) + &line(10, 3));
    let recordings = folder.open(&OpenOptions::default()).unwrap();
    let ids: Vec<&str> = recordings.iter().map(|recording| recording.id.as_str()).collect();
    assert_eq!(ids, ["camera-1", "camera-3"]);
    let one = OpenOptions { camera_name: Some("3".into()), ..Default::default() };
    assert_eq!(places(&folder.open_one(&one).unwrap()), [Some(2.0), Some(10.0)]);
    let none = OpenOptions { camera_name: Some("2".into()), ..Default::default() };
    assert!(folder.refusal(&none).contains("expected the number of a camera with images (1, 3)"));
    folder.write("sparse/0/images.txt", line(2, 7));
    assert!(
        folder
            .refusal(&OpenOptions::default())
            .contains("images.txt, line 1: found camera 7, expected a camera")
    );
}

#[test]
fn a_binary_colmap_model_says_how_to_convert_it() {
    let folder = made::images();
    folder.write("sparse/0/images.bin", "");
    assert!(folder.refusal(&OpenOptions::default()).contains("colmap model_converter --output_type TXT"));
}

#[test]
fn images_come_in_natural_order() {
    let folder = made::images();
    let recording = folder.open_one(&OpenOptions::default()).unwrap();
    assert_eq!(levels(&recording), (0..12).collect::<Vec<u8>>());
    assert_eq!((recording.image_size_px, recording.camera), (Some((8, 6)), None));
    folder.write("list.txt", "10\n2.png\n");
    let options = OpenOptions { split: Split::List("list.txt".into()), ..Default::default() };
    assert_eq!(levels(&folder.open_one(&options).unwrap()), [2, 10]);
}

#[test]
fn names_that_are_times_date_the_images() {
    let folder = made::Folder::new();
    for (level, name) in ["100.25.png", "100.5.png", "99.125.png"].iter().enumerate() {
        folder.colour(name, level as u8);
    }
    folder.write("truth.txt", "99.120 1 0 0 0 0 0 1\n99.130 2 0 0 0 0 0 1\n100.250 3 0 0 0 0 0 1\n");
    let options = OpenOptions { poses: Some("truth.txt".into()), ..Default::default() };
    let recording = folder.open_one(&options).unwrap();
    assert_eq!(levels(&recording), [2, 0, 1]);
    assert_eq!(recording.frames[0].time_ns, 99_125_000_000);
    assert_eq!(places(&recording), [Some(1.5), Some(3.0), None]);
}

#[test]
fn a_trajectory_goes_row_by_row_with_images_that_have_no_times() {
    let folder = made::images();
    let row = |n: u32| format!("{n}.25 {n} 0 0 0 0 0 1\n");
    folder.write("truth.txt", (0..12).map(row).collect::<String>());
    let options = OpenOptions { poses: Some("truth.txt".into()), ..Default::default() };
    let recording = folder.open_one(&options).unwrap();
    assert_eq!(places(&recording), (0..12).map(|n| Some(f64::from(n))).collect::<Vec<_>>());
    assert_eq!(recording.frames[3].time_ns, 3_250_000_000);
    folder.write("truth.txt", row(1));
    let message = folder.refusal(&options);
    assert!(message.contains("1 poses by time, but the 12 images have no times"), "{message}");
}

#[test]
fn an_unreadable_first_image_does_not_hide_the_size() {
    let folder = made::images();
    folder.write("0.png", "broken");
    assert_eq!(folder.open_one(&OpenOptions::default()).unwrap().image_size_px, Some((8, 6)));
}
