//! Layouts, sequences, splits and ground truth of made 7-Scenes and KITTI recordings.

use std::path::PathBuf;

use grnet_frame::{Camera, Distortion};

use super::made::{self, Folder};
use crate::dataset::{DatasetError, InvalidPoses, Layout, OpenOptions, Recording, Split, open, open_one};

fn places(recording: &Recording) -> Vec<Option<f64>> {
    recording.frames.iter().map(|frame| frame.world_from_camera.map(|pose| pose.translation.x)).collect()
}

fn numbers(recording: &Recording) -> Vec<u64> {
    recording.frames.iter().map(|frame| frame.sequence).collect()
}

fn list(text: &str, folder: &Folder) -> OpenOptions {
    folder.write("list.txt", text);
    OpenOptions { split: Split::List("list.txt".into()), ..Default::default() }
}

#[test]
fn every_layout_is_found_out() {
    for (layout, folder) in made::all() {
        let found = folder.open(&OpenOptions::default()).unwrap();
        assert!(
            found.iter().all(|recording| recording.layout == layout && !recording.frames.is_empty()),
            "{layout}"
        );
        let named = folder.open(&OpenOptions { layout, ..Default::default() }).unwrap();
        assert_eq!(found, named);
    }
}

#[test]
fn an_unknown_folder_says_what_was_looked_for() {
    let folder = Folder::new();
    folder.write("readme.md", "");
    let message = folder.refusal(&OpenOptions::default());
    for part in
        ["FOLDER is no recording", "seq-XX", "sequences/XX", "rgb.txt", "mav0", "cameras.txt", "PNG or JPEG"]
    {
        assert!(message.contains(part), "{part}: {message}");
    }
    assert!(message.ends_with("found: readme.md"), "{message}");
    let nowhere = open(&folder.join("nowhere"), &OpenOptions::default()).unwrap_err().to_string();
    assert!(nowhere.contains("nowhere not found: the folder of a recording"), "{nowhere}");
    for layout in Layout::ALL {
        let error = folder.open(&OpenOptions { layout, ..Default::default() }).unwrap_err();
        assert!(
            matches!(error, DatasetError::Missing { .. } | DatasetError::Empty { .. }),
            "{layout}: {error}"
        );
    }
}

#[test]
fn seven_scenes_gives_sequences_with_camera_poses_at_thirty_hertz() {
    let folder = made::seven_scenes();
    let recordings = folder.open(&OpenOptions::default()).unwrap();
    let ids: Vec<&str> = recordings.iter().map(|recording| recording.id.as_str()).collect();
    assert_eq!(ids, ["seq-01", "seq-02"]);
    let second = &recordings[1];
    assert_eq!(places(second), (0..6).map(|n| Some(100.0 + f64::from(n))).collect::<Vec<_>>());
    assert_eq!(second.frames[5].time_ns, 166_666_667);
    assert!((second.nominal_rate_hz.unwrap() - 30.0).abs() < 1e-6);
    // The literature's 525 px, scaled from 640x480.
    assert_eq!(second.camera.unwrap().focal_px(), (525.0 / 80.0, 525.0 / 80.0));
    assert!(second.name.starts_with("7-Scenes ") && second.name.ends_with(" seq-02"));
    let several = folder.open_one(&OpenOptions::default()).unwrap_err().to_string();
    assert!(several.contains("holds 2 sequences (seq-01, seq-02)"), "{several}");
    let chosen = OpenOptions { sequence: Some("seq-02".into()), ..Default::default() };
    assert_eq!(&folder.open_one(&chosen).unwrap(), second);
    assert_eq!(&open_one(&folder.join("seq-02"), &OpenOptions::default()).unwrap(), second);
    let wrong = OpenOptions { sequence: Some("seq-03".into()), ..Default::default() };
    assert_eq!(folder.refusal(&wrong), "FOLDER has no sequence \"seq-03\" (available: seq-01, seq-02)");
}

#[test]
fn official_splits_choose_sequences() {
    let folder = made::seven_scenes();
    for (split, id) in [(Split::Train, "seq-01"), (Split::Test, "seq-02")] {
        let options = OpenOptions { split, ..Default::default() };
        assert_eq!(folder.open_one(&options).unwrap().id, id);
        assert_eq!(open_one(&folder.join(id), &options).unwrap().id, id);
    }
    let test = OpenOptions { split: Split::Test, ..Default::default() };
    let none = open(&folder.join("seq-01"), &test).unwrap_err().to_string();
    assert!(none.contains("its 1 lines choose none of"), "{none}");
    std::fs::remove_file(folder.join("TestSplit.txt")).unwrap();
    assert!(folder.refusal(&test).starts_with("TestSplit.txt not found"));
}

#[test]
fn lists_choose_frames_in_blocks() {
    let folder = made::seven_scenes();
    let lines =
        "seq-02/frame-000005\nseq-01/frame-000001\nseq-01/frame-000002.color.png\nseq-01/frame-000004\n";
    let options = list(lines, &folder);
    let recordings = folder.open(&options).unwrap();
    assert_eq!(recordings.iter().map(numbers).collect::<Vec<_>>(), [vec![1, 2, 4], vec![5]]);
    let blocks: Vec<usize> = recordings[0].blocks().map(<[_]>::len).collect();
    assert_eq!(blocks, [2, 1]);
    assert_eq!(recordings[0].frames[2].time_ns, 133_333_333, "gaps stay");
    // One sequence opened alone passes over the lines of the others.
    let alone = open_one(&folder.join("seq-02"), &options).unwrap();
    assert_eq!(numbers(&alone), [5]);
}

#[test]
fn bad_lists_are_named_by_line() {
    let folder = made::seven_scenes();
    for (text, message) in [
        (
            "seq-01\nseq-01/frame-000009\n",
            "list.txt, line 2: found \"seq-01/frame-000009\", expected a sequence (seq-01, seq-02)",
        ),
        ("\nsequence3\n", "list.txt, line 2: found \"sequence3\", expected a sequence"),
        (
            "seq-01/frame-000001\nseq-01/frame-000001\n",
            "list.txt, line 2: found \"seq-01/frame-000001\" again",
        ),
        ("sequence1\nseq-01/frame-000001\n", "list.txt, line 2: found \"seq-01/frame-000001\" again"),
        ("# nothing\n", "list.txt holds no frames: its 0 lines choose none"),
    ] {
        let found = folder.refusal(&list(text, &folder));
        assert!(found.starts_with(message), "{found}");
    }
    let absent = OpenOptions { split: Split::List("absent.txt".into()), ..Default::default() };
    assert_eq!(folder.refusal(&absent), "cannot read absent.txt");
}

#[test]
fn impossible_and_missing_poses_are_defined() {
    let folder = made::seven_scenes();
    folder.write("seq-01/frame-000002.pose.txt", "nan nan nan nan\n".repeat(4));
    folder.write("seq-01/frame-000004.pose.txt", "1 0 0 -inf\n0 1 0 -inf\n0 0 1 -inf\n0 0 0 1\n");
    std::fs::remove_file(folder.join("seq-01/frame-000003.pose.txt")).unwrap();
    let options = OpenOptions { sequence: Some("seq-01".into()), ..Default::default() };
    let recording = folder.open_one(&options).unwrap();
    assert_eq!(places(&recording), [Some(0.0), Some(1.0), None, None, None, Some(5.0)]);
    assert_eq!((recording.invalid_poses, recording.frames_without_pose()), (2, 3));
    assert!(
        recording.notes.contains(&"3 of 6 frames have no ground truth".to_string()),
        "{:?}",
        recording.notes
    );
    let strict = OpenOptions { invalid_poses: InvalidPoses::Refuse, ..options.clone() };
    assert_eq!(
        folder.refusal(&strict),
        "seq-01/frame-000002.pose.txt, line 1: the pose holds NaN, which is no finite number"
    );
    folder.write("seq-01/frame-000002.pose.txt", "1 0 0 0\n0 1 0\n");
    let message = folder.refusal(&options);
    assert!(message.starts_with("seq-01/frame-000002.pose.txt, line 2: found 3 fields"), "{message}");
}

#[test]
fn the_pseudo_ground_truth_is_the_inverse_and_brings_its_focal_length() {
    let folder = made::seven_scenes();
    let line = |number: u32, focal_px: f64| {
        format!("seq-01/frame-{number:06}.color.png 1 0 0 0 -{number}.5 0 0 {focal_px}\n")
    };
    folder.write("pgt.txt", line(1, 7.0) + &line(2, 7.0) + &line(4, 9.0));
    let options = OpenOptions { poses: Some("pgt.txt".into()), ..Default::default() };
    let recordings = folder.open(&options).unwrap();
    assert_eq!(places(&recordings[0]), [None, Some(1.5), Some(2.5), None, Some(4.5), None]);
    assert_eq!(recordings[1].frames_without_pose(), 6);
    let camera = recordings[0].camera.unwrap();
    assert_eq!((camera.focal_px(), camera.centre_px()), ((7.0, 7.0), (3.5, 2.5)));
    let own: Vec<Option<f64>> =
        recordings[0].frames.iter().map(|frame| frame.camera.map(|camera| camera.focal_px().0)).collect();
    assert_eq!(own, [None, None, None, None, Some(9.0), None]);
    folder.write("pgt.txt", "1 0 0 0 0 0 0 1\n");
    assert!(folder.refusal(&options).contains("holds one trajectory, but 2 sequences are open"));
}

#[test]
fn intrinsics_come_from_the_file_unless_they_are_the_depth_cameras() {
    let folder = made::seven_scenes();
    let options = OpenOptions { sequence: Some("seq-01".into()), ..Default::default() };
    folder.write("camera-intrinsics.txt", "6 0 4\n0 7 3\n0 0 1\n");
    assert_eq!(folder.open_one(&options).unwrap().camera.unwrap().focal_px(), (6.0, 7.0));
    folder.write("camera-intrinsics.txt", "585 0 320\n0 585 240\n0 0 1\n");
    let recording = folder.open_one(&options).unwrap();
    assert_eq!(recording.camera.unwrap().focal_px(), (6.5625, 6.5625));
    assert!(recording.notes.iter().any(|note| note.contains("depth camera")), "{:?}", recording.notes);
    let camera = Camera::new(made::SIZE_PX, (5.0, 5.0), (4.0, 3.0), Distortion::None).unwrap();
    let own = OpenOptions { camera: Some(camera), ..options.clone() };
    assert_eq!(folder.open_one(&own).unwrap().camera, Some(camera));
    let wrong = OpenOptions { camera: Some(camera.resized(16, 12)), ..options };
    assert!(
        folder.refusal(&wrong).starts_with("the option `camera` gives intrinsics for 16x12, but seq-01/")
    );
}

#[test]
fn a_sequence_without_images_says_what_is_there() {
    let folder = made::seven_scenes();
    folder.write("seq-03/frame-000000.depth.png", "");
    let message = folder.refusal(&OpenOptions::default());
    assert!(
        message.starts_with("seq-03 holds no frames") && message.contains("found frame-000000.depth.png"),
        "{message}"
    );
}

#[test]
fn kitti_is_read_from_root_sequences_and_sequence() {
    let folder = made::kitti();
    let options = OpenOptions::default();
    let root = folder.open_one(&options).unwrap();
    assert_eq!((root.id.as_str(), root.name.as_str()), ("03", "KITTI 03 image_0"));
    assert_eq!(places(&root), [0.0, 1.0, 2.0, 3.0, 4.0].map(Some));
    assert_eq!(root.frames[3].time_ns, 300_000_000);
    assert_eq!(root.nominal_rate_hz, Some(10.0));
    assert_eq!(root.camera.unwrap().focal_px(), (10.0, 10.0));
    for inner in ["sequences", "sequences/03"] {
        assert_eq!(open_one(&folder.join(inner), &options).unwrap().frames.len(), 5, "{inner}");
        assert_eq!(places(&open_one(&folder.join(inner), &options).unwrap()), places(&root), "{inner}");
    }
}

#[test]
fn poses_of_another_kitti_camera_are_moved_by_its_baseline() {
    let folder = made::kitti();
    for name in ["2", "image_2"] {
        let options = OpenOptions { camera_name: Some(name.into()), ..Default::default() };
        let colour = folder.open_one(&options).unwrap();
        // P2 has -1.0 = -fx * baseline, so the camera sits 0.1 to the right of camera 0.
        assert_eq!(places(&colour), [0.1, 1.1, 2.1, 3.1, 4.1].map(Some));
    }
    let wrong = OpenOptions { camera_name: Some("3".into()), ..Default::default() };
    assert_eq!(
        folder.refusal(&wrong),
        "sequences/03/image_3 not found: the images of the camera asked for (available: image_0, image_2)"
    );
    let nonsense = OpenOptions { camera_name: Some("left".into()), ..Default::default() };
    assert!(
        folder.refusal(&nonsense).contains("found \"left\", expected image_0, image_1, image_2 or image_3")
    );
}

#[test]
fn kitti_ground_truth_may_be_short_long_or_absent_but_times_must_cover() {
    let folder = made::kitti();
    let open = || folder.open_one(&OpenOptions::default()).unwrap();
    folder.write("poses/03.txt", made::row_at(0.0) + &made::row_at(1.0));
    assert_eq!(places(&open()), [Some(0.0), Some(1.0), None, None, None]);
    folder.write("poses/03.txt", made::row_at(7.0).repeat(9));
    assert_eq!(open().frames_without_pose(), 0);
    std::fs::remove_file(folder.join("poses/03.txt")).unwrap();
    assert!(open().notes.contains(&"no ground truth".to_string()));
    folder.write("sequences/03/times.txt", "0\n0.1\n");
    assert_eq!(
        folder.refusal(&OpenOptions::default()),
        "sequences/03/times.txt, line 3: found the end after 2 times, expected a time for each image up to number 4"
    );
    std::fs::remove_file(folder.join("sequences/03/times.txt")).unwrap();
    assert_eq!(open().frames[2].time_ns, 200_000_000);
    let rate = OpenOptions { rate_hz: Some(4.0), ..Default::default() };
    assert_eq!(folder.open_one(&rate).unwrap().frames[2].time_ns, 500_000_000);
}

#[test]
fn kitti_lists_pass_over_sequences_that_were_not_chosen() {
    let folder = made::kitti();
    folder.grey("sequences/04/image_0/000000.png", 1);
    let lines = "03/image_0/000001\n04/image_0/000000\n";
    let mut options = list(lines, &folder);
    assert_eq!(folder.open(&options).unwrap().len(), 2);
    options.sequence = Some("03".into());
    assert_eq!(numbers(&folder.open_one(&options).unwrap()), [1]);
    options.sequence = Some("05".into());
    assert!(folder.refusal(&options).contains("no sequence \"05\" (available: 03, 04)"));
}

#[test]
fn options_that_a_layout_lacks_are_refused() {
    let folder = made::images();
    let train = OpenOptions { split: Split::Train, ..Default::default() };
    assert_eq!(
        folder.refusal(&train),
        "option `split`: the images layout has none; give a list file instead"
    );
    let camera = OpenOptions { camera_name: Some("cam0".into()), ..Default::default() };
    assert_eq!(folder.refusal(&camera), "option `camera_name`: the images layout has none; leave it out");
    for rate_hz in [0.0, -1.0, f64::NAN, f64::INFINITY] {
        let options = OpenOptions { rate_hz: Some(rate_hz), ..Default::default() };
        assert!(folder.refusal(&options).starts_with("option `rate_hz`: found "));
    }
    let poses = OpenOptions { poses: Some(PathBuf::from("absent.txt")), ..Default::default() };
    assert_eq!(folder.refusal(&poses), "cannot read absent.txt");
}
