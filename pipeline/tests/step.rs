//! `Pipeline::step` with a real network: untrained weights, made-up frames.

mod common;

use std::collections::HashMap;
use std::sync::Arc;

use common::{PERIOD_NS, SIZE, assert_close, at_ns, config, frame, model, pipeline, step};
use grnet_frame::{Camera, CaptureTime, Distortion, Frame, PixelFormat, Pixels};
use grnet_geometry::{Covariance6, Pose, quaternion};
use grnet_model::candle_core::{Device, Tensor};
use grnet_model::preprocessing::Preprocessing;
use grnet_model::{
    Branches, CameraIntrinsics, Checkpoint, LoadedModel, NetworkConfig, RigidTransform, untrained,
};
use grnet_pipeline::preprocess::{InputSpec, Preprocessor};
use grnet_pipeline::{
    Estimate, Intrinsics, IntrinsicsError, IntrinsicsOptions, IntrinsicsPolicy, NoObserver, Pipeline,
    PipelineError, PipelineOptions, PreprocessError, Reason, Stage, StageObserver, Status, StepError,
};
use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};
use proptest::prelude::*;

/// Everything in an estimate, NaN included, as text that tells every bit of a double apart.
fn bits(estimate: &Estimate) -> String {
    format!("{estimate:?}")
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
fn map_poses_are_averaged_on_request_until_the_rules_change() {
    let options = PipelineOptions { map_smoothing_s: 2.0, ..PipelineOptions::default() };
    let mut pipeline = Pipeline::new(model(), options.clone()).unwrap();
    let first = step(&mut pipeline, 0);
    assert_eq!(first.map_from_base.pose, first.network_map_from_base.pose);
    let second = step(&mut pipeline, 1);
    let [begin, network] = [&first, &second].map(|estimate| estimate.network_map_from_base.pose.unwrap());
    let continued = begin * second.previous_from_current.pose.unwrap();
    let mean = second.map_from_base.pose.unwrap();
    let middle = (continued.translation.vector + network.translation.vector) / 2.0;
    assert!((mean.translation.vector - middle).norm() < 1e-9 && mean != network);

    assert!(pipeline.set_tracking(options.time, options.gate, f64::NAN, 1).is_err(), "no number");
    let third = step(&mut pipeline, 2);
    assert_ne!(third.map_from_base.pose, third.network_map_from_base.pose);
    pipeline.set_tracking(options.time, options.gate, 0.0, 1).unwrap();
    let fourth = step(&mut pipeline, 3);
    assert_eq!(fourth.map_from_base.pose, fourth.network_map_from_base.pose);
    assert_eq!(fourth.reset_epoch, 0);
}

#[test]
fn smoothing_that_cannot_be_is_said() {
    let without_motion =
        NetworkConfig { branches: Branches { relative: false, global: true, fusion: false }, ..config() };
    let model = LoadedModel::untrained(&without_motion, 1).unwrap();
    let notes = |map_smoothing_s| {
        let options = PipelineOptions { map_smoothing_s, ..PipelineOptions::default() };
        Pipeline::new(model.clone(), options).unwrap().info().notes.join("\n")
    };
    assert!(notes(1.0).contains("map poses are not smoothed"), "{}", notes(1.0));
    assert!(!notes(0.0).contains("smoothed"), "{}", notes(0.0));
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
fn another_trunk_or_other_key_frames_start_the_odometry_anew() {
    let trunk = LoadedModel::untrained(&NetworkConfig::grnet_small(), 12).unwrap();
    let neighbours = with(|metadata| metadata.network.keyframe_interval_ms = 0);
    for other in [trunk, neighbours] {
        let mut pipeline = pipeline();
        for i in 0..3 {
            step(&mut pipeline, i);
        }
        let mut fresh = Pipeline::new(other.clone(), PipelineOptions::default()).unwrap();
        pipeline.swap_model(other).unwrap();
        let estimate = step(&mut pipeline, 3);
        assert_eq!(estimate.reset_epoch, 1);
        assert_eq!(bits(&Estimate { reset_epoch: 0, ..estimate }), bits(&step(&mut fresh, 3)));
    }
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
