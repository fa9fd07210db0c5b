//! Views of a recording from where its camera never was.

#![allow(clippy::result_large_err)]

mod rooms;

use std::sync::Arc;

use grnet_capture::dataset::{self, OpenOptions, Recording};
use grnet_model::ResizePolicy;
use grnet_train::data::{
    AugmentOptions, DataError, Loader, RecordedOptions, RecordedWindows, ViewOptions, WindowOptions, Windows,
};
use nalgebra::{Isometry3, Translation3};
use rooms::{input, room, seen};

/// Windows of two frames, every one of them seen from elsewhere.
fn options(views: ViewOptions) -> RecordedOptions {
    RecordedOptions {
        window: WindowOptions { k: 2, strides: vec![2], ..WindowOptions::default() },
        // By next to nothing: a plain window would stay where it is.
        augment: AugmentOptions { rotation_deg: 1e-6, ..AugmentOptions::default() },
        views: Some(views),
        ..RecordedOptions::default()
    }
}

fn windows(folder: &tempfile::TempDir, options: RecordedOptions) -> RecordedWindows {
    let recordings = dataset::open(folder.path(), &OpenOptions::default()).unwrap();
    let input = input(96, 96, ResizePolicy::Stretch);
    RecordedWindows::new(folder.path(), &recordings, input, options).unwrap()
}

fn difference(a: &[f32], b: &[f32]) -> f32 {
    a.iter().zip(b).map(|(a, b)| (a - b).abs()).sum::<f32>() / a.len() as f32
}

/// Rendered at the pose that a view claims, the room looks like the view; seen from where the frame was taken, or moved to the
/// other side, it does not.
#[test]
fn a_view_is_what_the_camera_sees_at_the_moved_pose() {
    let (folder, scene) = room(48, 10.0);
    let views = ViewOptions { share: 1.0, shift_m: 0.15, frame_shift_m: 0.02, ..ViewOptions::default() };
    let moved = windows(&folder, options(views));
    let unmoved = windows(&folder, RecordedOptions { views: None, ..options(views) });
    let input = input(96, 96, ResizePolicy::Stretch);
    let (mut same, mut before, mut opposite, mut count) = (0.0, 0.0, 0.0, 0);
    let mut apart = 0.0f64;
    for index in 0..16 {
        let window = moved.window(index).unwrap();
        let from = unmoved.poses(index).unwrap();
        for (i, planes) in window.images.chunks_exact(3 * 96 * 96).enumerate() {
            let to = &window.world_from_camera[i];
            let shift = from[i].inv_mul(to);
            assert!(shift.rotation.angle() < 1e-6);
            let most = 0.15 * 3f64.sqrt() + 0.02 * 3f64.sqrt();
            assert!(shift.translation.vector.norm() < most);
            if shift.translation.vector.norm() < 0.08 {
                continue;
            }
            let back = from[i] * Isometry3::from(Translation3::from(-shift.translation.vector));
            same += difference(planes, &seen(&scene, to, &input));
            before += difference(planes, &seen(&scene, &from[i], &input));
            opposite += difference(planes, &seen(&scene, &back, &input));
            count += 1;
        }
        let shift = |i: usize| window.world_from_camera[i].translation.vector - from[i].translation.vector;
        apart = apart.max((shift(0) - shift(1)).norm());
    }
    let told =
        format!("{same} at the pose, {before} before, {opposite} on the other side, of {count} frames");
    println!("{told}, frames moved apart by up to {apart:.3} m");
    assert!(count >= 12 && same * 5.0 < before && same * 6.0 < opposite, "{told}");
    assert!((0.01..0.07).contains(&apart), "frames moved apart by {apart} m");
}

/// A turned frame ends at its edge; a view goes on with what other frames saw there.
#[test]
fn what_lies_beside_a_frame_is_drawn_from_others() {
    let (folder, scene) = room(80, 10.0);
    let turned = AugmentOptions { rotation_deg: 15.0, ..AugmentOptions::default() };
    let views = ViewOptions { share: 1.0, shift_m: 0.0, frame_shift_m: 0.0, ..ViewOptions::default() };
    let options = RecordedOptions { augment: turned, ..options(views) };
    let by_others = windows(&folder, options.clone());
    let alone = windows(&folder, RecordedOptions { views: None, ..options });
    let input = input(96, 96, ResizePolicy::Stretch);
    let (mut with, mut without) = (0.0, 0.0);
    for index in 0..16 {
        let (view, cut) = (by_others.window(index).unwrap(), alone.window(index).unwrap());
        assert_eq!(view.world_from_camera, cut.world_from_camera);
        for (i, pose) in view.world_from_camera.iter().enumerate() {
            let truth = seen(&scene, pose, &input);
            let pixels = i * truth.len()..(i + 1) * truth.len();
            for ((view, cut), truth) in
                view.images[pixels.clone()].iter().zip(&cut.images[pixels]).zip(&truth)
            {
                if (cut - truth).abs() > 0.5 {
                    with += (view - truth).abs();
                    without += (cut - truth).abs();
                }
            }
        }
    }
    println!("{with} by others, {without} alone");
    assert!(with * 1.8 < without, "{with} by others, {without} alone");
}

#[test]
fn views_are_the_same_whatever_the_threads_the_cache_and_who_found_the_depth() {
    let (folder, _) = room(40, 10.0);
    let of = |cache_mib, seed| {
        let mut options = options(ViewOptions { share: 0.5, ..ViewOptions::default() });
        options.window.seed = seed;
        windows(&folder, RecordedOptions { augment: AugmentOptions::recorded(), cache_mib, ..options })
    };
    let bytes = |windows: RecordedWindows, threads| -> Vec<Vec<u32>> {
        let mut loader = Loader::start(Arc::new(windows), 4, 0, threads, 3);
        let batch = |_| {
            let values: Vec<f32> = loader.next().unwrap().images.flatten_all().unwrap().to_vec1().unwrap();
            values.into_iter().map(f32::to_bits).collect()
        };
        (0..3).map(batch).collect()
    };
    let one = bytes(of(512, 1), 0);
    assert_eq!(one, bytes(of(0, 1), 3), "threads, and no cache");
    assert_ne!(one, bytes(of(512, 2), 0), "another seed");
    let other = of(512, 2);
    other.window(0).unwrap();
    let mut sharing = of(512, 1);
    sharing.share_depths(&other);
    assert_eq!(one, bytes(sharing, 0), "depths of another data set");
    let (poses, window) = (of(512, 1).poses(5).unwrap(), of(512, 1).window(5).unwrap());
    assert_eq!(poses, window.world_from_camera);
    let plain = windows(&folder, RecordedOptions { views: None, ..options(ViewOptions::default()) });
    assert_ne!(plain.fingerprint(), windows(&folder, options(ViewOptions::default())).fingerprint());
}

/// A camera that only turned has seen no depth: its frames stay where they are.
#[test]
fn frames_that_nobody_saw_from_beside_stay() {
    let (folder, _) = room(40, 10.0);
    let mut recordings = dataset::open(folder.path(), &OpenOptions::default()).unwrap();
    for frame in &mut recordings[0].frames {
        if let Some(pose) = &mut frame.world_from_camera {
            pose.translation = Translation3::identity();
        }
    }
    let views = ViewOptions { share: 1.0, ..ViewOptions::default() };
    let of = |recordings: &[Recording], options| {
        let input = input(96, 96, ResizePolicy::Stretch);
        RecordedWindows::new(folder.path(), recordings, input, options).unwrap()
    };
    let (moved, unmoved) = (options(views), RecordedOptions { views: None, ..options(views) });
    let (moved, unmoved) = (of(&recordings, moved), of(&recordings, unmoved));
    for index in 0..8 {
        assert_eq!(moved.window(index).unwrap(), unmoved.window(index).unwrap());
    }
}

#[test]
fn senseless_views_are_named() {
    let (folder, _) = room(10, 10.0);
    let recordings = dataset::open(folder.path(), &OpenOptions::default()).unwrap();
    let problem = |side: u32, recordings: &[Recording], change: &dyn Fn(&mut ViewOptions)| {
        let mut views = ViewOptions::default();
        change(&mut views);
        let input = input(side, side, ResizePolicy::Stretch);
        RecordedWindows::new(folder.path(), recordings, input, options(views)).unwrap_err()
    };
    let told = |side, change: &dyn Fn(&mut ViewOptions)| problem(side, &recordings, change).to_string();
    assert!(told(96, &|v| v.share = 1.5).contains("`views.share`"));
    assert!(told(96, &|v| v.shift_m = -0.1).contains("`views.shift_m`"));
    assert!(told(96, &|v| v.frame_shift_m = f64::NAN).contains("`views.frame_shift_m`"));
    assert!(told(96, &|v| v.depth_m = (2.0, 1.0)).contains("found [2, 1], expected two depths"));
    assert!(told(8, &|_| ()).contains("`views`"), "too small an image");
    let mut blind = recordings.clone();
    blind[0].camera = None;
    assert!(matches!(problem(96, &blind, &|_| ()), DataError::NoIntrinsics { .. }));
}
