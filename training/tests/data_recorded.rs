//! Windows from recordings: the right frames, the right poses, and the picture that the robot would see.

#![allow(clippy::result_large_err)]

mod rooms;

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use grnet_capture::dataset::{self, OpenOptions, Recording, Split};
use grnet_capture::decode::decode_file;
use grnet_frame::{CaptureTime, Frame};
use grnet_model::{Preprocessing, ResizePolicy};
use grnet_pipeline::IntrinsicsOptions;
use grnet_pipeline::preprocess::{InputSpec, Preprocessor};
use grnet_train::data::{
    AugmentOptions, Border, DataError, Loader, RecordedOptions, RecordedWindows, WindowOptions, Windows,
    statistics,
};
use grnet_train::synth::{PathOptions, Scene, SceneOptions, Trajectory, Volume, VolumeKind};
use image::{Rgb, RgbImage};
use rooms::{input, room, seen};

fn plain(window: WindowOptions) -> RecordedOptions {
    RecordedOptions { window, augment: AugmentOptions::default(), ..RecordedOptions::default() }
}

/// A recording of 60 frames in which frame `n` is 4n red and stands at x = n.
fn numbered() -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    let sequence = folder.path().join("seq-01");
    std::fs::create_dir(&sequence).unwrap();
    for n in 0..60u32 {
        let image = RgbImage::from_pixel(16, 12, Rgb([n as u8 * 4, 9, 200]));
        image.save(sequence.join(format!("frame-{n:06}.color.png"))).unwrap();
        let pose = format!("1 0 0 {n}\n0 1 0 0\n0 0 1 0\n0 0 0 1\n");
        std::fs::write(sequence.join(format!("frame-{n:06}.pose.txt")), pose).unwrap();
    }
    folder
}

/// All frames but those of `left_out`.
fn without(folder: &Path, left_out: &[u32]) -> Vec<Recording> {
    let list = folder.join("train.txt");
    let lines = (0..60).filter(|n| !left_out.contains(n)).map(|n| format!("seq-01/frame-{n:06}\n"));
    std::fs::write(&list, lines.collect::<String>()).unwrap();
    let options = OpenOptions { split: Split::List(list), ..OpenOptions::default() };
    dataset::open(folder, &options).unwrap()
}

fn windows(folder: &Path, left_out: &[u32], window: WindowOptions) -> RecordedWindows {
    let input = input(8, 6, ResizePolicy::Stretch);
    RecordedWindows::new(folder, &without(folder, left_out), input, plain(window)).unwrap()
}

/// Frame numbers of a window by its pictures and by its poses, which must agree.
fn numbers(windows: &dyn Windows, index: u64) -> Vec<i64> {
    let window = windows.window(index).unwrap();
    let preprocessing = Preprocessing::default();
    let shown = window.images.chunks_exact(3 * 8 * 6).map(|planes| {
        let red = (f64::from(planes[0]) * preprocessing.std[0] + preprocessing.mean[0]) * 255.0;
        (red / 4.0).round() as i64
    });
    let shown: Vec<i64> = shown.collect();
    let stood: Vec<i64> = window.world_from_camera.iter().map(|pose| pose.translation.x as i64).collect();
    assert_eq!(shown, stood, "{}", window.name);
    assert_eq!(windows.poses(index).unwrap(), window.world_from_camera);
    let told: Vec<String> = stood.iter().map(i64::to_string).collect();
    assert!(window.name.ends_with(&format!("seq-01 frames {}", told.join(" "))), "{}", window.name);
    stood
}

#[test]
fn windows_stay_in_their_run_keep_their_stride_and_run_both_ways() {
    let folder = numbered();
    // Runs of 20, 12, 4 and 21 frames; the third is too short for a window, the second for a stride of 5.
    let left_out = [20, 33, 38];
    let options = WindowOptions { k: 4, strides: vec![1, 5], seed: 3, ..WindowOptions::default() };
    let windows = windows(folder.path(), &left_out, options);
    assert!(windows.describe().contains("57 training frames in 4 runs"), "{}", windows.describe());
    let (mut backwards, mut strides, mut starts) = (0, BTreeMap::new(), BTreeSet::new());
    for index in 0..4000 {
        let mut frames = numbers(&windows, index);
        if frames[0] > frames[3] {
            backwards += 1;
            frames.reverse();
        }
        let stride = frames[1] - frames[0];
        assert!(frames.windows(2).all(|pair| pair[1] - pair[0] == stride), "{frames:?}");
        assert!(left_out.iter().all(|gap| !(frames[0]..=frames[3]).contains(&i64::from(*gap))), "{frames:?}");
        let in_second = (21..33).contains(&frames[0]);
        let in_third = (34..38).contains(&frames[0]);
        assert!(stride == 1 || stride == if in_second { 3 } else { 5 } && !in_third, "{frames:?}");
        *strides.entry(stride).or_insert(0) += 1;
        starts.insert(frames[0]);
    }
    assert!((1850..2150).contains(&backwards), "{backwards}");
    // Half of all draws have stride 5; 12/57 of them are shortened to 3 and 4/57 to 1.
    assert!((1330..1550).contains(&strides[&5]) && (340..500).contains(&strides[&3]), "{strides:?}");
    let possible = (0..17).chain(21..30).chain([34]).chain(39..57);
    assert_eq!(starts, possible.collect(), "every start is drawn");
}

#[test]
fn uneven_windows_stay_in_their_run_too() {
    let folder = numbered();
    let left_out = [20, 33, 38];
    let window =
        WindowOptions { k: 4, strides: vec![1, 5], uneven: true, seed: 3, ..WindowOptions::default() };
    let windows = windows(folder.path(), &left_out, window);
    let mut seen = BTreeSet::new();
    for index in 0..2000 {
        let mut frames = numbers(&windows, index);
        if frames[0] > frames[3] {
            frames.reverse();
        }
        let steps: Vec<i64> = frames.windows(2).map(|pair| pair[1] - pair[0]).collect();
        // As in even windows no step is longer than what fits everywhere in the run.
        let longest = if (21..33).contains(&frames[0]) { 3 } else { 5 };
        assert!(steps.iter().all(|step| *step == 1 || *step == longest), "{frames:?}");
        assert!(left_out.iter().all(|gap| !(frames[0]..=frames[3]).contains(&i64::from(*gap))), "{frames:?}");
        seen.insert(steps);
    }
    assert!(seen.contains(&vec![1, 5, 1]) && seen.contains(&vec![5, 5, 1]), "{seen:?}");
}

#[test]
fn single_frames_and_fixed_order() {
    let folder = numbered();
    let options = WindowOptions { k: 1, ..WindowOptions::default() };
    let single = windows(folder.path(), &[7], options);
    let seen: BTreeSet<i64> = (0..2000).flat_map(|index| numbers(&single, index)).collect();
    assert_eq!(seen, (0..60).filter(|n| *n != 7).collect());
    let options = WindowOptions { k: 3, reverse_share: 0.0, ..WindowOptions::default() };
    let forwards = windows(folder.path(), &[], options.clone());
    assert!((0..200).map(|i| numbers(&forwards, i)).all(|frames| frames[0] < frames[2]));
    let options = WindowOptions { reverse_share: 1.0, ..options };
    let backwards = windows(folder.path(), &[], options);
    for index in 0..200 {
        let mut frames = numbers(&backwards, index);
        frames.reverse();
        assert_eq!(frames, numbers(&forwards, index), "the same window, played backwards");
    }
}

#[test]
fn frames_without_a_pose_end_a_run() {
    let folder = numbered();
    let pose = folder.path().join("seq-01/frame-000030.pose.txt");
    std::fs::write(pose, "nan nan nan nan\n".repeat(3) + "0 0 0 1\n").unwrap();
    let options = WindowOptions { k: 5, ..WindowOptions::default() };
    let windows = windows(folder.path(), &[], options.clone());
    for index in 0..500 {
        let frames = numbers(&windows, index);
        assert!(frames.iter().all(|n| *n < 30) || frames.iter().all(|n| *n > 30), "{frames:?}");
    }
    let every_other: Vec<u32> = (0..60).step_by(2).collect();
    let recordings = without(folder.path(), &every_other);
    let input = input(8, 6, ResizePolicy::Stretch);
    let error = RecordedWindows::new(folder.path(), &recordings, input, plain(options)).unwrap_err();
    let text = error.to_string();
    assert!(text.contains("no window of 5") && text.contains("30 training frames"), "{text}");
    assert!(text.contains("longest run of neighbours is 1 frames"), "{text}");
}

#[test]
fn without_augmentation_the_picture_is_what_the_robot_sees() {
    let (folder, _) = room(10, 2.0);
    let recordings = dataset::open(folder.path(), &OpenOptions::default()).unwrap();
    for resize in [ResizePolicy::Stretch, ResizePolicy::CropCentre] {
        let input = input(56, 48, resize);
        let window = WindowOptions { k: 2, ..WindowOptions::default() };
        let windows = RecordedWindows::new(folder.path(), &recordings, input.clone(), plain(window)).unwrap();
        let mut preprocessor = Preprocessor::new(input, IntrinsicsOptions::default(), None).unwrap();
        for index in 0..8 {
            let made = windows.window(index).unwrap();
            for (planes, pose) in made.images.chunks_exact(3 * 56 * 48).zip(&made.world_from_camera) {
                let recorded =
                    recordings[0].frames.iter().find(|f| f.world_from_camera.as_ref() == Some(pose));
                let frame = Frame {
                    pixels: Arc::new(decode_file(&recorded.unwrap().path).unwrap()),
                    capture_time: CaptureTime::recorded(0),
                    sequence: 0,
                    camera: recordings[0].camera,
                };
                assert_eq!(planes, preprocessor.run(&frame).unwrap());
            }
        }
    }
}

/// Mean absolute difference over the pixels that are not the fill colour, and how many those are.
fn difference(found: &[f32], expected: &[f32]) -> (f32, usize) {
    let size = found.len() / 3;
    let inside: Vec<usize> = (0..size).filter(|p| (0..3).any(|c| found[c * size + p].abs() > 1e-5)).collect();
    let sum: f32 = inside
        .iter()
        .flat_map(|p| (0..3).map(move |c| c * size + p))
        .map(|i| (found[i] - expected[i]).abs())
        .sum();
    (sum / (3 * inside.len()) as f32, inside.len())
}

/// The rotated picture is that of the rotated camera: rendered there, the room looks the same; rendered at the opposite
/// rotation it does not.
#[test]
fn a_rotated_picture_is_what_the_camera_sees_at_the_corrected_pose() {
    let (folder, scene) = room(10, 2.0);
    let recordings = dataset::open(folder.path(), &OpenOptions::default()).unwrap();
    for (resize, size) in [(ResizePolicy::Stretch, (96, 96)), (ResizePolicy::CropCentre, (96, 80))] {
        let input = input(size.0, size.1, resize);
        let options = RecordedOptions {
            window: WindowOptions { k: 2, strides: vec![1], ..WindowOptions::default() },
            augment: AugmentOptions {
                rotation_deg: 12.0,
                frame_rotation_deg: 3.0,
                border: Border::Mean,
                ..AugmentOptions::default()
            },
            work_scale: 2.0,
            ..RecordedOptions::default()
        };
        let windows =
            RecordedWindows::new(folder.path(), &recordings, input.clone(), options.clone()).unwrap();
        let unrotated = RecordedOptions { augment: AugmentOptions::default(), ..options };
        let unrotated = RecordedWindows::new(folder.path(), &recordings, input.clone(), unrotated).unwrap();
        let pixels = (size.0 * size.1) as usize;
        let mut turned_apart = 0.0f64;
        for index in 0..12 {
            let made = windows.window(index).unwrap();
            let before = unrotated.poses(index).unwrap();
            for (planes, (after, before)) in
                made.images.chunks_exact(3 * pixels).zip(made.world_from_camera.iter().zip(&before))
            {
                let turn = before.rotation.inverse() * after.rotation;
                assert!((after.translation.vector - before.translation.vector).norm() < 1e-12);
                if turn.angle() < 0.03 {
                    continue;
                }
                let (same, inside) = difference(planes, &seen(&scene, after, &input));
                let inverse = before * turn.inverse();
                let (opposite, _) = difference(planes, &seen(&scene, &inverse, &input));
                let (unturned, _) = difference(planes, &seen(&scene, before, &input));
                assert!(inside * 3 > pixels, "{inside} of {pixels} pixels are inside");
                assert!(same < 0.08, "{resize:?} window {index}: differs by {same}");
                assert!(
                    same * 4.0 < opposite && same * 3.0 < unturned,
                    "{resize:?} window {index}: {same} at the pose, {opposite} opposite, {unturned} before"
                );
            }
            let turn = |i: usize| before[i].rotation.inverse() * made.world_from_camera[i].rotation;
            turned_apart = turned_apart.max(turn(0).angle_to(&turn(1)).to_degrees());
        }
        assert!((1.0..=6.0).contains(&turned_apart), "{turned_apart}");
    }
}

#[test]
fn a_rotation_by_almost_nothing_changes_almost_nothing() {
    let (folder, _) = room(10, 2.0);
    let recordings = dataset::open(folder.path(), &OpenOptions::default()).unwrap();
    for resize in [ResizePolicy::Stretch, ResizePolicy::CropCentre] {
        let input = input(96, 80, resize);
        let of = |augment| {
            let window = WindowOptions { k: 1, ..WindowOptions::default() };
            let options = RecordedOptions { window, augment, work_scale: 1.0, ..RecordedOptions::default() };
            RecordedWindows::new(folder.path(), &recordings, input.clone(), options).unwrap()
        };
        let exact = of(AugmentOptions::default());
        let turned = of(AugmentOptions { rotation_deg: 1e-6, ..AugmentOptions::default() });
        for index in 0..5 {
            let (a, b) = (exact.window(index).unwrap().images, turned.window(index).unwrap().images);
            let mean = a.iter().zip(&b).map(|(a, b)| (a - b).abs()).sum::<f32>() / a.len() as f32;
            // A byte is 0.017; the crop that begins between pixels is sampled once more.
            let most = if resize == ResizePolicy::Stretch { 1e-3 } else { 0.05 };
            assert!(mean < most, "{resize:?}: {mean}");
        }
    }
}

#[test]
fn broken_images_are_errors_in_their_place() {
    let folder = numbered();
    let path = folder.path().join("seq-01/frame-000030.color.png");
    std::fs::write(&path, b"\x89PNG\r\n\x1a\n nothing more").unwrap();
    let options = WindowOptions { k: 4, strides: vec![1], ..WindowOptions::default() };
    let windows: Arc<dyn Windows> = Arc::new(windows(folder.path(), &[], options));
    let direct: Vec<_> = (0..120).map(|index| windows.window(index)).collect();
    let mut loader = Loader::start(windows, 1, 0, 3, 6);
    for (index, direct) in direct.iter().enumerate() {
        match (loader.next(), direct) {
            (Ok(batch), Ok(window)) => {
                assert_eq!(batch.index, index as u64);
                assert_eq!(batch.images.flatten_all().unwrap().to_vec1::<f32>().unwrap(), window.images);
            }
            (Err(found), Err(expected)) => {
                assert_eq!(found.to_string(), expected.to_string());
                assert!(found.to_string().contains("frame-000030.color.png"), "{found}");
                assert!(matches!(found, DataError::Frame { .. }));
            }
            (found, _) => panic!("batch {index}: {found:?}"),
        }
    }
    let broken = direct.iter().filter(|window| window.is_err()).count();
    assert!((1..30).contains(&broken), "{broken}");
}

#[test]
fn augmented_windows_are_the_same_whatever_the_threads_and_the_cache() {
    let (folder, _) = room(10, 2.0);
    let recordings = dataset::open(folder.path(), &OpenOptions::default()).unwrap();
    let of = |cache_mib, seed| {
        let window = WindowOptions { k: 3, strides: vec![1, 2], seed, ..WindowOptions::default() };
        let augment = AugmentOptions { erase_share: 0.5, ..AugmentOptions::recorded() };
        let options = RecordedOptions { window, augment, cache_mib, ..RecordedOptions::default() };
        let input = input(48, 48, ResizePolicy::Stretch);
        Arc::new(RecordedWindows::new(folder.path(), &recordings, input, options).unwrap())
    };
    let bytes = |windows: Arc<RecordedWindows>, threads| -> Vec<Vec<u32>> {
        let mut loader = Loader::start(windows, 4, 0, threads, 3);
        let batch = |_| {
            let values: Vec<f32> = loader.next().unwrap().images.flatten_all().unwrap().to_vec1().unwrap();
            values.into_iter().map(f32::to_bits).collect()
        };
        (0..6).map(batch).collect()
    };
    let one = bytes(of(512, 1), 0);
    assert_eq!(one, bytes(of(512, 1), 3));
    assert_eq!(one, bytes(of(0, 1), 2), "without a cache");
    assert_ne!(one, bytes(of(512, 2), 0), "another seed");
    assert!(one.iter().flatten().all(|bits| f32::from_bits(*bits).is_finite()));
    let poses = statistics::sample(&*of(0, 1), 24).unwrap();
    let window = of(512, 1).window(23).unwrap();
    assert_eq!(poses[23], window.world_from_camera);
}

#[test]
fn the_fingerprint_follows_files_poses_and_options_and_nothing_else() {
    let folder = numbered();
    let of = |folder: &Path, change: &dyn Fn(&mut RecordedOptions, &mut InputSpec)| {
        let (mut options, mut input) = (plain(WindowOptions::default()), input(8, 6, ResizePolicy::Stretch));
        change(&mut options, &mut input);
        RecordedWindows::new(folder, &without(folder, &[]), input, options).unwrap().fingerprint()
    };
    let same = of(folder.path(), &|_, _| {});
    assert_eq!(same, of(folder.path(), &|options, _| options.cache_mib = 1));
    let moved = numbered();
    assert_eq!(same, of(moved.path(), &|_, _| {}), "the same recording elsewhere");
    let different = [
        of(folder.path(), &|options, _| options.window.seed = 1),
        of(folder.path(), &|options, _| options.augment.noise = 0.1),
        of(folder.path(), &|options, _| options.focal_px = Some(20.0)),
        of(folder.path(), &|_, input| input.size_px = (6, 8)),
        of(folder.path(), &|_, input| input.preprocessing.mean[0] = 0.5),
        {
            let path: PathBuf = moved.path().join("seq-01/frame-000007.color.png");
            RgbImage::from_pixel(16, 12, Rgb([29, 9, 200])).save(&path).unwrap();
            of(moved.path(), &|_, _| {})
        },
        {
            let path = folder.path().join("seq-01/frame-000007.pose.txt");
            std::fs::write(path, "1 0 0 7.000001\n0 1 0 0\n0 0 1 0\n0 0 0 1\n").unwrap();
            of(folder.path(), &|_, _| {})
        },
    ];
    let all: BTreeSet<&String> = different.iter().chain([&same]).collect();
    assert_eq!(all.len(), different.len() + 1, "{different:?}");
}

#[test]
fn rotations_need_intrinsics_and_take_the_given_focal_length() {
    let folder = numbered();
    let mut recordings = dataset::open(folder.path(), &OpenOptions::default()).unwrap();
    let focal = |focal_px, recordings: &[Recording]| {
        let options = RecordedOptions { focal_px, ..RecordedOptions::default() };
        RecordedWindows::new(folder.path(), recordings, input(8, 6, ResizePolicy::Stretch), options)
    };
    // The reader knows the dataset's published 525 px at a width of 640.
    assert_eq!(focal(None, &recordings).unwrap().camera().unwrap().focal_px(), (525.0 / 40.0, 525.0 / 40.0));
    assert_eq!(focal(Some(20.0), &recordings).unwrap().camera().unwrap().focal_px(), (20.0, 20.0));
    assert!(focal(Some(-1.0), &recordings).unwrap_err().to_string().contains("`focal_px`"));
    recordings[0].camera = None;
    assert!(matches!(focal(None, &recordings).unwrap_err(), DataError::NoIntrinsics { .. }));
    let camera = focal(Some(20.0), &recordings).unwrap().camera().unwrap();
    assert_eq!((camera.size_px(), camera.centre_px()), ((16, 12), (7.5, 5.5)));
}

/// The paths of recordings and of training never share a sequence, so they differ from the start.
#[test]
fn training_paths_are_none_that_a_recording_can_have() {
    use grnet_train::data::rendered::FIRST_SEQUENCE;
    let scene = Scene::build(SceneOptions { room: 1, texel_m: 0.1 });
    let volume = Volume::of(&scene, VolumeKind::Handheld);
    let start = |sequence| {
        let options = PathOptions { seed: 9, sequence, frames: 30, rate_hz: 30.0 };
        Trajectory::generate(&scene, &volume, options).unwrap().world_from_camera(0.0).translation.vector
    };
    let training = start(FIRST_SEQUENCE);
    assert!((0..99).all(|sequence| (start(sequence) - training).norm() > 1e-6));
}
