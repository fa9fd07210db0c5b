//! Windows rendered on the fly.

use std::collections::BTreeSet;
use std::sync::{Arc, LazyLock};

use grnet_frame::{CaptureTime, Frame, PixelFormat, Pixels};
use grnet_model::Preprocessing;
use grnet_pipeline::IntrinsicsOptions;
use grnet_pipeline::preprocess::{InputSpec, Preprocessor};
use grnet_train::data::{
    AugmentOptions, Loader, Mixed, RenderedOptions, RenderedWindows, WindowOptions, Windows,
};
use grnet_train::synth::{
    FrameKey, RenderTarget, Scene, SceneOptions, Sensor, SensorOptions, Volume, VolumeKind,
};

fn input() -> InputSpec {
    InputSpec { size_px: (48, 48), preprocessing: Preprocessing::default(), trained_camera: None }
}

fn options(k: usize) -> RenderedOptions {
    RenderedOptions {
        window: WindowOptions { k, strides: vec![2, 6], ..WindowOptions::default() },
        texel_mm: 30.0,
        size_px: (64, 48),
        ..RenderedOptions::default()
    }
}

fn windows(options: RenderedOptions) -> Arc<RenderedWindows> {
    Arc::new(RenderedWindows::new(input(), options).unwrap())
}

static SCENE: LazyLock<Scene> = LazyLock::new(|| Scene::build(SceneOptions { room: 1, texel_m: 0.03 }));

/// Every picture is that of its pose, seen by a sensor whose exposure alone is not known.
#[test]
fn pictures_belong_to_their_poses_also_when_the_camera_is_rotated() {
    let clean = RenderedOptions {
        noise: (0.0, 0.0),
        vignetting: (0.0, 0.0),
        augment: AugmentOptions { rotation_deg: 20.0, frame_rotation_deg: 5.0, ..AugmentOptions::default() },
        ..options(3)
    };
    let windows = windows(clean);
    let mut preprocessor = Preprocessor::new(input(), IntrinsicsOptions::default(), None).unwrap();
    let mut target = RenderTarget::new(windows.options().edge_samples);
    for index in 0..6 {
        let window = windows.window(index).unwrap();
        assert_eq!(windows.poses(index).unwrap(), window.world_from_camera);
        for (planes, pose) in window.images.chunks_exact(3 * 48 * 48).zip(&window.world_from_camera) {
            SCENE.render(pose, &windows.camera(), &mut target).unwrap();
            let mut rgb = Vec::new();
            let key = FrameKey { seed: 0, sequence: 0, index: 0 };
            Sensor { options: SensorOptions::clean() }.develop(&target, key, 1.0, &mut rgb);
            let frame = Frame {
                pixels: Arc::new(Pixels::packed(PixelFormat::Rgb8, 64, 48, rgb).unwrap()),
                capture_time: CaptureTime::recorded(0),
                sequence: 0,
                camera: None,
            };
            let expected = preprocessor.run(&frame).unwrap();
            let likeness = correlation(planes, expected);
            assert!(likeness > 0.98, "window {index}: {likeness}");
        }
        let other = &window.images[2 * 3 * 48 * 48..];
        assert!(correlation(&window.images[..3 * 48 * 48], other) < 0.97, "its frames differ");
    }
}

fn correlation(a: &[f32], b: &[f32]) -> f32 {
    let mean = |v: &[f32]| v.iter().sum::<f32>() / v.len() as f32;
    let (ma, mb) = (mean(a), mean(b));
    let dot = |p: &[f32], mp: f32, q: &[f32], mq: f32| -> f32 {
        p.iter().zip(q).map(|(p, q)| (p - mp) * (q - mq)).sum()
    };
    dot(a, ma, b, mb) / (dot(a, ma, a, ma) * dot(b, mb, b, mb)).sqrt()
}

#[test]
fn paths_are_smooth_jumps_are_not_and_both_stay_in_the_volume() {
    let volume = Volume::of(&SCENE, VolumeKind::Handheld);
    for (jump_share, kind) in [(0.0, "path"), (1.0, "jump")] {
        let windows = windows(RenderedOptions { jump_share, ..options(4) });
        let (mut longest, mut shortest) = (0.0f64, f64::INFINITY);
        for index in 0..60 {
            let window = windows.poses(index).unwrap();
            for pose in &window {
                for axis in 0..3 {
                    let off = pose.translation.vector[axis] - volume.centre_m[axis];
                    assert!(off.abs() < volume.half_m[axis] + 0.01);
                }
            }
            for pair in window.windows(2) {
                let step = (pair[1].translation.vector - pair[0].translation.vector).norm();
                (longest, shortest) = (longest.max(step), shortest.min(step));
            }
        }
        if jump_share == 0.0 {
            // At most 0.5 m/s for 6 frames at 30 Hz.
            assert!(longest < 0.1 && longest > 0.04, "{longest}");
        } else {
            assert!(longest > 0.12 && longest < 0.27, "{longest}");
        }
        assert!(windows.window(0).unwrap().name.contains(kind), "{}", windows.window(0).unwrap().name);
    }
}

#[test]
fn windows_are_a_function_of_seed_and_index() {
    let bits = |windows: Arc<dyn Windows>, threads| -> Vec<Vec<u32>> {
        let mut loader = Loader::start(windows, 2, 5, threads, 2);
        let batch = |_| {
            let values: Vec<f32> = loader.next().unwrap().images.flatten_all().unwrap().to_vec1().unwrap();
            values.into_iter().map(f32::to_bits).collect()
        };
        (0..4).map(batch).collect()
    };
    let one = windows(options(2));
    let first = bits(one.clone(), 0);
    assert_eq!(first, bits(one, 2));
    assert_eq!(first, bits(windows(options(2)), 1));
    let mut other = options(2);
    other.window.seed = 1;
    assert_ne!(first, bits(windows(other), 0));
    assert!((0..4).all(|i| (0..i).all(|j| first[i] != first[j])), "indices differ");
}

#[test]
fn single_frames_and_several_rooms() {
    let rooms = RenderedOptions { rooms: vec![1, 2], texel_mm: 100.0, ..options(1) };
    let windows = windows(rooms);
    let names: BTreeSet<String> = (0..20)
        .map(|index| {
            let window = windows.window(index).unwrap();
            assert_eq!((window.world_from_camera.len(), window.images.len()), (1, 3 * 48 * 48));
            window.name.split(' ').take(2).collect::<Vec<_>>().join(" ")
        })
        .collect();
    assert_eq!(names, ["room 1", "room 2"].map(String::from).into());
}

#[test]
fn the_fingerprint_follows_the_options() {
    let coarse = || RenderedOptions { texel_mm: 100.0, ..options(2) };
    let of = |options| windows(options).fingerprint();
    let mut seeded = coarse();
    seeded.window.seed = 4;
    let all: BTreeSet<String> = [
        of(coarse()),
        of(seeded),
        of(RenderedOptions { rooms: vec![2], ..coarse() }),
        of(RenderedOptions { noise: (0.0, 0.0), ..coarse() }),
    ]
    .into();
    assert_eq!(all.len(), 4);
    assert!(all.contains(&of(coarse())));
}

#[test]
fn senseless_options_are_named() {
    let problem = |change: &dyn Fn(&mut RenderedOptions)| {
        let mut options = options(2);
        change(&mut options);
        RenderedWindows::new(input(), options).unwrap_err().to_string()
    };
    assert!(problem(&|o| o.rooms.clear()).contains("`rooms`"));
    assert!(problem(&|o| o.noise = (1.0, 0.5)).contains("the least first"));
    assert!(problem(&|o| o.texel_mm = f64::NAN).contains("`texel_mm`"));
    assert!(problem(&|o| o.window.k = 0).contains("`k`"));
    assert!(problem(&|o| o.augment.rotation_deg = -1.0).contains("`rotation_deg`"));
    let parsed: RenderedOptions = serde_json::from_str(r#"{"rooms": [3], "window": {"k": 2}}"#).unwrap();
    assert_eq!((parsed.rooms, parsed.window.k, parsed.window.seed), (vec![3], 2, 0));
    assert!(serde_json::from_str::<RenderedOptions>(r#"{"room": 3}"#).is_err());
}

#[test]
fn rendered_and_other_windows_mix() {
    let near = windows(RenderedOptions { texel_mm: 100.0, ..options(2) });
    let far = windows(RenderedOptions { texel_mm: 100.0, rooms: vec![2], ..options(2) });
    let sources: Vec<(Arc<dyn Windows>, f64)> = vec![(near, 1.0), (far, 1.0)];
    let mixed = Mixed::new(sources, 0).unwrap();
    let names: BTreeSet<String> = (0..12)
        .map(|index| mixed.window(index).unwrap().name.split(' ').nth(1).unwrap().to_string())
        .collect();
    assert_eq!(names, ["1", "2"].map(String::from).into());
}
