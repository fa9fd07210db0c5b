//! `Pipeline::step` with a real network: untrained weights, made-up frames.

use std::collections::HashMap;
use std::sync::Arc;

use grnet_frame::{Camera, CaptureTime, Distortion, Frame, PixelFormat, Pixels};
use grnet_geometry::{Covariance6, Pose, quaternion};
use grnet_model::candle_core::{Device, Tensor};
use grnet_model::preprocessing::Preprocessing;
use grnet_model::{
    CameraIntrinsics, Checkpoint, HeadTensors, LoadedModel, NetworkConfig, RigidTransform, WindowOutput,
    untrained,
};
use grnet_pipeline::preprocess::{InputSpec, Preprocessor};
use grnet_pipeline::{
    Estimate, Intrinsics, IntrinsicsError, IntrinsicsOptions, IntrinsicsPolicy, NoObserver, Pipeline,
    PipelineError, PipelineOptions, PreprocessError, Reason, Stage, StageObserver, Status, StepError,
};
use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};
use proptest::prelude::*;

const SIZE: (u32, u32) = (80, 60);
const PERIOD_NS: u64 = 40_000_000;

/// The layers of `grnet-small` on a smaller input, so that the tests stay quick.
fn config() -> NetworkConfig {
    NetworkConfig { input_height_px: 48, input_width_px: 64, width: 0.125, ..NetworkConfig::grnet_small() }
}

fn model() -> LoadedModel {
    LoadedModel::untrained(&config(), 11).unwrap()
}

fn pipeline() -> Pipeline {
    Pipeline::new(model(), PipelineOptions::default()).unwrap()
}

/// A frame of a scene that slides by; `sequence` also gives its time.
fn frame(sequence: u64) -> Frame {
    let byte = |x: u32, y: u32, c: u32| {
        let phase = f64::from(x) * 0.13 + f64::from(y * (c + 1)) * 0.05 + sequence as f64 * 0.3;
        (127.5 + 127.0 * phase.sin()) as u8
    };
    let rgb =
        (0..SIZE.1).flat_map(|y| (0..SIZE.0).flat_map(move |x| (0..3).map(move |c| byte(x, y, c)))).collect();
    Frame {
        pixels: Arc::new(Pixels::packed(PixelFormat::Rgb8, SIZE.0, SIZE.1, rgb).unwrap()),
        capture_time: CaptureTime::monotonic(1_000_000_000 + sequence * PERIOD_NS),
        sequence,
        camera: None,
    }
}

fn at_ns(sequence: u64, ns: u64) -> Frame {
    Frame { capture_time: CaptureTime::monotonic(ns), ..frame(sequence) }
}

fn step(pipeline: &mut Pipeline, sequence: u64) -> Estimate {
    pipeline.step(&frame(sequence), &mut NoObserver).unwrap()
}

/// Everything in an estimate, NaN included, as text that tells every bit of a double apart.
fn bits(estimate: &Estimate) -> String {
    format!("{estimate:?}")
}

fn head_pose(head: &HeadTensors, i: usize) -> Pose {
    let row = |tensor: &Tensor| -> Vec<f64> {
        let values = tensor.get(0).unwrap().get(i).unwrap().to_vec1::<f32>().unwrap();
        values.into_iter().map(f64::from).collect()
    };
    let (t, r) = (row(&head.translation), row(&head.rotation));
    let rotation = quaternion::from_6d(r.try_into().unwrap()).unwrap();
    Isometry3::from_parts(Translation3::new(t[0], t[1], t[2]), rotation)
}

fn assert_close(found: Option<Pose>, expected: &Pose) {
    let found = found.expect("a pose");
    let metres = (found.translation.vector - expected.translation.vector).norm();
    let radians = found.rotation.angle_to(&expected.rotation);
    assert!(metres < 1e-4 && radians < 1e-4, "{metres} m, {radians} rad");
}

/// What the network says of these frames as one window.
fn window_of(model: &LoadedModel, sequences: &[u64]) -> WindowOutput {
    let config = model.network.config();
    let size_px = (config.input_width_px as u32, config.input_height_px as u32);
    let spec =
        InputSpec { size_px, preprocessing: model.metadata.preprocessing.clone(), trained_camera: None };
    let mut preprocessor = Preprocessor::new(spec, IntrinsicsOptions::default(), None).unwrap();
    let mut images = Vec::new();
    for sequence in sequences {
        images.extend_from_slice(preprocessor.run(&frame(*sequence)).unwrap());
    }
    let shape = (1, sequences.len(), 3, config.input_height_px, config.input_width_px);
    model.network.window(&Tensor::from_vec(images, shape, &Device::Cpu).unwrap()).unwrap()
}

#[test]
fn streamed_poses_equal_those_of_the_window() {
    const FRAMES: usize = 8;
    for config in [NetworkConfig::grnet_small(), config()] {
        let config = NetworkConfig { keyframe_interval_ms: 0, ..config };
        let model = LoadedModel::untrained(&config, 5).unwrap();
        let window = window_of(&model, &(0..FRAMES as u64).collect::<Vec<_>>());
        let (relative, fused) = (window.relative.unwrap(), window.fused.unwrap());

        let options = PipelineOptions::default();
        let base_from_camera = options.base_from_camera;
        let mut pipeline = Pipeline::new(model, options).unwrap();
        let mut odom_from_base = Pose::identity();
        for i in 0..FRAMES {
            let estimate = step(&mut pipeline, i as u64);
            if i > 0 {
                let motion = base_from_camera * head_pose(&relative, i) * base_from_camera.inverse();
                odom_from_base *= motion;
                assert_close(estimate.previous_from_current.pose, &motion);
            }
            assert_close(estimate.odom_from_base.pose, &odom_from_base);
            let map_from_base = head_pose(&fused, i) * base_from_camera.inverse();
            assert_close(estimate.map_from_base.pose, &map_from_base);
        }
        assert!(odom_from_base.translation.vector.norm() > 1e-3, "something moved");
    }
}

#[test]
fn motion_is_measured_from_the_last_key_frame_and_key_frames_come_by_time() {
    let model = model();
    assert_eq!(model.network.config().keyframe_interval_ms, 110);
    // A frame every 40, 80 and 120 ms; some frames of a regular stream missing.
    let regular = |step: u64| (0..13).map(|i| i * step).collect::<Vec<_>>();
    let cases = [
        (regular(1), vec![0, 3, 6, 9, 12]),
        (regular(2), vec![0, 4, 8, 12, 16, 20, 24]),
        (regular(3), regular(3)),
        (vec![0, 1, 2, 6, 7, 8, 9, 10, 15], vec![0, 6, 9, 15]),
    ];
    for (sequences, keys) in cases {
        let mut pipeline = pipeline();
        let base_from_camera = PipelineOptions::default().base_from_camera;
        let mut odom_from_key = Pose::identity();
        let mut last = Pose::identity();
        for sequence in sequences {
            let estimate = step(&mut pipeline, sequence);
            let earlier: Vec<u64> = keys.iter().copied().filter(|key| *key < sequence).collect();
            let mut odom_from_base = Pose::identity();
            if !earlier.is_empty() {
                let relative = window_of(&model, &[&earlier[..], &[sequence]].concat()).relative.unwrap();
                let key_from_current = head_pose(&relative, earlier.len());
                odom_from_base =
                    odom_from_key * base_from_camera * key_from_current * base_from_camera.inverse();
                assert_close(estimate.previous_from_current.pose, &(last.inverse() * odom_from_base));
            }
            assert_close(estimate.odom_from_base.pose, &odom_from_base);
            last = odom_from_base;
            if keys.contains(&sequence) {
                odom_from_key = odom_from_base;
            }
        }
    }
}

#[test]
fn a_reset_of_the_odometry_makes_the_next_frame_a_key_frame() {
    let mut pipeline = pipeline();
    (0..5).for_each(|i| drop(step(&mut pipeline, i)));
    pipeline.reset_odometry();
    let model = model();
    let base_from_camera = PipelineOptions::default().base_from_camera;
    // Frame 3 was a key frame, 6 would have been the next one; now it is 5 and then 8.
    assert_close(step(&mut pipeline, 5).odom_from_base.pose, &Pose::identity());
    for sequence in 6..9 {
        let relative = window_of(&model, &[5, sequence]).relative.unwrap();
        let odom_from_base = base_from_camera * head_pose(&relative, 1) * base_from_camera.inverse();
        assert_close(step(&mut pipeline, sequence).odom_from_base.pose, &odom_from_base);
    }
}

#[test]
fn the_same_frames_give_the_same_bits() {
    let run = || {
        let mut pipeline = pipeline();
        (0..6).map(|i| bits(&step(&mut pipeline, i))).collect::<Vec<_>>()
    };
    assert_eq!(run(), run());
}

#[test]
fn a_restarted_pipeline_gives_the_bits_of_a_new_one() {
    let mut old = pipeline();
    for i in 0..4 {
        step(&mut old, i);
    }
    old.on_source_lost();
    let mut new = pipeline();
    for i in 10..14 {
        let (old, new) = (step(&mut old, i), step(&mut new, i));
        assert_eq!((old.reset_epoch, new.reset_epoch), (1, 0));
        assert_eq!(bits(&Estimate { reset_epoch: 0, ..old }), bits(&new));
    }
}

#[test]
fn stages_are_announced_in_order() {
    #[derive(Default)]
    struct Seen(Vec<Stage>);
    impl StageObserver for Seen {
        fn enter(&mut self, stage: Stage) {
            self.0.push(stage);
        }
    }
    let mut seen = Seen::default();
    pipeline().step(&frame(0), &mut seen).unwrap();
    assert_eq!(seen.0, [Stage::Preprocess, Stage::Infer, Stage::Fuse]);
}

#[test]
fn an_untrained_model_is_degraded_from_the_first_frame_on() {
    let mut pipeline = pipeline();
    for i in 0..3 {
        let estimate = step(&mut pipeline, i);
        assert_eq!((estimate.status, estimate.reason), (Status::Degraded, Reason::UntrainedModel));
        assert!(estimate.map_from_base.pose.is_some() && !estimate.map_from_base.covariance.is_finite());
        assert!(estimate.innovation_ratio.is_nan());
        assert_eq!((estimate.sequence, estimate.capture_time), (i, frame(i).capture_time));
    }
    let notes = pipeline.info().notes.join("\n");
    assert!(notes.contains("not trained") && notes.contains("intrinsics"), "{notes}");
}

#[test]
fn a_frame_that_is_not_newer_is_refused_and_changes_nothing() {
    let (mut disturbed, mut calm) = (pipeline(), pipeline());
    for i in 0..5 {
        let (a, b) = (step(&mut disturbed, i), step(&mut calm, i));
        assert_eq!(bits(&a), bits(&b));
        let now_ns = frame(i).capture_time.ns;
        for ns in [now_ns, now_ns - 1, 0] {
            let error = disturbed.step(&at_ns(99, ns), &mut NoObserver).unwrap_err();
            assert!(
                matches!(error, StepError::StaleFrame(stale) if stale.behind_ns == now_ns - ns),
                "{error}"
            );
        }
    }
}

#[test]
fn a_gap_in_the_sequence_is_no_gap_in_the_motion() {
    let mut pipeline = pipeline();
    step(&mut pipeline, 0);
    let estimate = step(&mut pipeline, 7);
    assert!(estimate.previous_from_current.pose.is_some());
    assert_eq!(estimate.reset_epoch, 0);
    let dt_s = 7.0 * PERIOD_NS as f64 * 1e-9;
    let angle = estimate.previous_from_current.pose.unwrap().rotation.angle();
    assert!((estimate.angular_velocity_in_base_radps.unwrap().norm() * dt_s - angle).abs() < 1e-9);
}

#[test]
fn a_jump_ahead_or_another_clock_starts_the_odometry_anew() {
    let mut pipeline = pipeline();
    for i in 0..3 {
        step(&mut pipeline, i);
    }
    let later_ns = frame(2).capture_time.ns + 1_000_000_001;
    let jumped = pipeline.step(&at_ns(3, later_ns), &mut NoObserver).unwrap();
    let recorded = Frame { capture_time: CaptureTime::recorded(5), ..frame(4) };
    let other_clock = pipeline.step(&recorded, &mut NoObserver).unwrap();
    for (epoch, estimate) in [(1, jumped), (2, other_clock)] {
        assert_eq!(estimate.reset_epoch, epoch);
        assert_eq!(estimate.odom_from_base.pose, Some(Pose::identity()));
        assert_eq!(estimate.odom_from_base.covariance, Covariance6::zero());
        assert_eq!(estimate.previous_from_current.pose, None);
        assert_eq!(estimate.linear_velocity_in_base_mps, None);
        assert!(estimate.map_from_base.pose.is_some(), "the map is not touched");
    }
}

#[test]
fn a_reset_of_the_odometry_leaves_the_global_memory_alone() {
    let (mut reset, mut calm) = (pipeline(), pipeline());
    for i in 0..4 {
        step(&mut reset, i);
        step(&mut calm, i);
    }
    reset.reset_odometry();
    let (estimate, expected) = (step(&mut reset, 4), step(&mut calm, 4));
    assert_eq!((estimate.reset_epoch, estimate.odom_from_base.pose), (1, Some(Pose::identity())));
    assert_eq!(estimate.previous_from_current.pose, None);
    assert!(expected.previous_from_current.pose.is_some());
}

fn with(edit: impl FnOnce(&mut grnet_model::CheckpointMetadata)) -> LoadedModel {
    let checkpoint = untrained::checkpoint(&config(), 11, Preprocessing::default()).unwrap();
    LoadedModel::from_checkpoint(checkpoint.with_metadata(edit).unwrap(), &Device::Cpu).unwrap()
}

#[test]
fn without_a_scene_there_is_odometry_and_no_map() {
    let checkpoint = untrained::checkpoint(&config(), 11, Preprocessing::default()).unwrap();
    let (trunk, _) = checkpoint.split().unwrap();
    let trunk = LoadedModel::from_checkpoint(trunk, &Device::Cpu).unwrap();
    let mut pipeline =
        Pipeline::new(LoadedModel { trained: true, ..trunk }, PipelineOptions::default()).unwrap();
    let first = step(&mut pipeline, 0);
    assert_eq!((first.status, first.reason), (Status::Initializing, Reason::None));
    let estimate = step(&mut pipeline, 1);
    assert_eq!((estimate.status, estimate.reason), (Status::Tracking, Reason::NoScene));
    assert!(estimate.odom_from_base.pose.is_some() && estimate.map_from_base.pose.is_none());
    let here = Isometry3::translation(1.0, 2.0, 3.0);
    pipeline.set_pose(here, Covariance6::nan()).unwrap();
    let estimate = step(&mut pipeline, 2);
    let expected = here * estimate.previous_from_current.pose.unwrap();
    assert_eq!(estimate.map_from_base.pose, Some(expected));
    pipeline.reset_map();
    assert_eq!(step(&mut pipeline, 3).map_from_base.pose, None);
    assert!(pipeline.set_pose(Isometry3::translation(f64::NAN, 0.0, 0.0), Covariance6::nan()).is_err());
}

#[test]
fn a_model_without_a_live_head_is_refused() {
    let dead = with(|metadata| metadata.heads = grnet_model::Heads::default());
    assert!(matches!(Pipeline::new(dead, PipelineOptions::default()), Err(PipelineError::NoLiveHead)));
}

#[test]
fn the_scene_says_where_its_world_lies_in_the_map() {
    let q = UnitQuaternion::from_euler_angles(0.0, 0.0, 1.0);
    let scene = || {
        with(|metadata| {
            metadata.map_from_world =
                Some(RigidTransform { translation_m: [1.0, 2.0, 3.0], rotation_xyzw: quaternion::xyzw(&q) });
        })
    };
    let plain = step(&mut pipeline(), 0).map_from_base.pose.unwrap();
    let map_from_world = Isometry3::from_parts(Translation3::new(1.0, 2.0, 3.0), q);
    let stored = step(&mut Pipeline::new(scene(), PipelineOptions::default()).unwrap(), 0);
    assert_close(stored.map_from_base.pose, &(map_from_world * plain));
    let elsewhere = Isometry3::new(Vector3::new(-4.0, 0.0, 0.0), Vector3::zeros());
    let options = PipelineOptions { map_from_world: Some(elsewhere), ..PipelineOptions::default() };
    let configured = step(&mut Pipeline::new(scene(), options).unwrap(), 0);
    assert_close(configured.map_from_base.pose, &(elsewhere * plain));
}

fn camera(focal_px: f64) -> Camera {
    Camera::new(SIZE, (focal_px, focal_px), (39.5, 29.5), Distortion::None).unwrap()
}

#[test]
fn other_intrinsics_are_refused_or_converted_and_always_told() {
    let trained_at = |focal_px| {
        with(|metadata| {
            metadata.camera = Some(CameraIntrinsics {
                width_px: SIZE.0,
                height_px: SIZE.1,
                fx_px: focal_px,
                fy_px: focal_px,
                cx_px: 39.5,
                cy_px: 29.5,
                distortion: grnet_model::metadata::Distortion::None,
            });
        })
    };
    let configured =
        |focal_px| PipelineOptions { camera: Some(camera(focal_px)), ..PipelineOptions::default() };
    assert!(matches!(
        Pipeline::new(trained_at(60.0), configured(70.0)),
        Err(PipelineError::Intrinsics(IntrinsicsError::Mismatch { .. }))
    ));
    let mut pipeline = Pipeline::new(trained_at(60.0), PipelineOptions::default()).unwrap();
    assert!(pipeline.check_camera(&camera(70.0)).is_err());
    let wrong = Frame { camera: Some(camera(70.0)), ..frame(0) };
    let error = pipeline.step(&wrong, &mut NoObserver).unwrap_err();
    assert!(
        matches!(&error, StepError::Preprocess { source: PreprocessError::Intrinsics(_), .. }),
        "{error}"
    );
    let right = Frame { camera: Some(camera(60.1)), ..frame(0) };
    pipeline.step(&right, &mut NoObserver).unwrap();
    assert!(
        matches!(pipeline.info().intrinsics, Intrinsics::Matching { displacement_px } if displacement_px < 0.1)
    );

    let mut options = configured(50.0);
    options.intrinsics.policy = IntrinsicsPolicy::Convert;
    let pipeline = Pipeline::new(trained_at(60.0), options).unwrap();
    assert_eq!(pipeline.info().intrinsics, Intrinsics::Converted { covered: 1.0 });
    assert!(pipeline.info().notes.iter().any(|note| note.contains("converted")));
}

/// The same trunk with another global branch.
fn with_another_scene() -> LoadedModel {
    let of = |seed| untrained::checkpoint(&config(), seed, Preprocessing::default()).unwrap();
    let metadata = of(11).metadata().clone();
    let mut tensors: HashMap<String, Tensor> = of(11).into_tensors(&Device::Cpu).unwrap();
    let scene = of(12).into_tensors(&Device::Cpu).unwrap();
    tensors.extend(scene.into_iter().filter(|(name, _)| grnet_model::Kind::Scene.holds(name)));
    LoadedModel::from_checkpoint(Checkpoint::new(metadata, &tensors).unwrap(), &Device::Cpu).unwrap()
}

#[test]
fn another_scene_on_the_same_trunk_leaves_the_odometry_going() {
    let (mut swapped, mut calm) = (pipeline(), pipeline());
    for i in 0..3 {
        step(&mut swapped, i);
        step(&mut calm, i);
    }
    swapped.swap_model(with_another_scene()).unwrap();
    let (a, b) = (step(&mut swapped, 3), step(&mut calm, 3));
    assert_eq!((&a.odom_from_base.pose, a.reset_epoch), (&b.odom_from_base.pose, 0));
    assert_eq!(a.previous_from_current.pose, b.previous_from_current.pose);
    assert_ne!(a.map_from_base.pose, b.map_from_base.pose);
    assert_eq!(swapped.info().model_hash, with_another_scene().model_hash);
}

#[test]
fn another_trunk_starts_the_odometry_anew() {
    let mut pipeline = pipeline();
    for i in 0..3 {
        step(&mut pipeline, i);
    }
    let other = LoadedModel::untrained(&NetworkConfig::grnet_small(), 12).unwrap();
    let mut fresh = Pipeline::new(other.clone(), PipelineOptions::default()).unwrap();
    pipeline.swap_model(other).unwrap();
    let estimate = step(&mut pipeline, 3);
    assert_eq!(estimate.reset_epoch, 1);
    assert_eq!(bits(&Estimate { reset_epoch: 0, ..estimate }), bits(&step(&mut fresh, 3)));
}

fn any_pixels() -> impl Strategy<Value = Pixels> {
    let format = prop::sample::select(vec![
        PixelFormat::Gray8,
        PixelFormat::Rgb8,
        PixelFormat::Yuyv,
        PixelFormat::Nv12,
        PixelFormat::Jpeg,
    ]);
    let side = prop_oneof![1u32..6, 1u32..70];
    let bytes = prop::collection::vec(any::<u8>(), 1..20_000);
    (format, side.clone(), side, 0usize..9, bytes).prop_filter_map(
        "a size that the format allows",
        |(format, width, height, padding, mut bytes)| {
            let stride = format.row_bytes(width).map_or(0, |row| row + padding);
            if stride > 0 {
                let seed = bytes.len();
                let fill = (0..).map(|i: usize| (i * seed) as u8);
                let rows = height as usize * 2;
                bytes.extend(fill.take((stride * rows).saturating_sub(seed)));
            }
            Pixels::strided(format, width, height, stride, bytes).ok()
        },
    )
}

/// A JPEG of 24x16 with some bytes overwritten and perhaps its end missing.
fn spoilt_jpeg(changes: &[(usize, u8)], keep: usize) -> Vec<u8> {
    let mut bytes = Vec::new();
    let rgb: Vec<u8> = (0..24 * 16 * 3).map(|i| (i * 7) as u8).collect();
    image::codecs::jpeg::JpegEncoder::new(&mut bytes)
        .encode(&rgb, 24, 16, image::ExtendedColorType::Rgb8)
        .unwrap();
    for (at, value) in changes {
        let at = at % bytes.len();
        bytes[at] = *value;
    }
    bytes.truncate(keep.clamp(1, bytes.len()));
    bytes
}

fn spec() -> InputSpec {
    InputSpec { size_px: (64, 48), preprocessing: Preprocessing::default(), trained_camera: None }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 400, ..ProptestConfig::default() })]

    #[test]
    fn no_bytes_make_the_preprocessor_panic(
        frames in prop::collection::vec(any_pixels(), 1..4),
        focal_px in prop::option::of(1.0..200.0f64),
        k in -2.0..2.0f64,
    ) {
        let mut preprocessor = Preprocessor::new(spec(), IntrinsicsOptions::default(), None).unwrap();
        for pixels in frames {
            let camera = focal_px.map(|f| {
                let size = (pixels.width_px(), pixels.height_px());
                Camera::new(size, (f, f), (3.0, 4.0), Distortion::PlumbBob([k, k, k, -k, k])).unwrap()
            });
            let is_raw = pixels.format() != PixelFormat::Jpeg;
            let frame = Frame { pixels: Arc::new(pixels), camera, ..frame(0) };
            match preprocessor.run(&frame) {
                Ok(input) => prop_assert!(input.len() == 3 * 64 * 48 && input.iter().all(|v| v.is_finite())),
                Err(error) => prop_assert!(!is_raw, "{error}"),
            }
        }
    }

    #[test]
    fn no_spoilt_jpeg_makes_the_preprocessor_panic(
        changes in prop::collection::vec((any::<usize>(), any::<u8>()), 0..12),
        keep in prop_oneof![Just(usize::MAX), 0usize..900],
    ) {
        let pixels = Pixels::packed(PixelFormat::Jpeg, 24, 16, spoilt_jpeg(&changes, keep)).unwrap();
        let mut preprocessor = Preprocessor::new(spec(), IntrinsicsOptions::default(), None).unwrap();
        let frame = Frame { pixels: Arc::new(pixels), ..frame(0) };
        if let Ok(input) = preprocessor.run(&frame) {
            prop_assert!(input.iter().all(|v| v.is_finite()));
        }
    }
}

#[test]
fn after_a_corrupt_frame_the_next_good_one_goes_on_where_the_last_good_one_was() {
    let (mut disturbed, mut calm) = (pipeline(), pipeline());
    for i in 0..4 {
        let corrupt = Pixels::packed(PixelFormat::Jpeg, 24, 16, vec![0xff, 0xd8, 0xff, 0xe0, 0]).unwrap();
        let corrupt = Frame { pixels: Arc::new(corrupt), ..at_ns(77, frame(i).capture_time.ns - 1) };
        let error = disturbed.step(&corrupt, &mut NoObserver).unwrap_err();
        assert!(error.to_string().starts_with("frame 77 cannot be used: the JPEG (5 bytes)"), "{error}");
        assert_eq!(bits(&step(&mut disturbed, i)), bits(&step(&mut calm, i)));
    }
}
