//! Streams through `Pipeline::step` against windows through the network, with and without key frames.

mod common;

use common::{assert_close, config, frame, model, pipeline, step};
use grnet_geometry::{Pose, quaternion};
use grnet_model::candle_core::{Device, Tensor};
use grnet_model::{HeadTensors, LoadedModel, NetworkConfig, WindowOutput};
use grnet_pipeline::preprocess::{InputSpec, Preprocessor};
use grnet_pipeline::{IntrinsicsOptions, Pipeline, PipelineOptions};
use nalgebra::{Isometry3, Translation3};

fn head_pose(head: &HeadTensors, i: usize) -> Pose {
    let row = |tensor: &Tensor| -> Vec<f64> {
        let values = tensor.get(0).unwrap().get(i).unwrap().to_vec1::<f32>().unwrap();
        values.into_iter().map(f64::from).collect()
    };
    let (t, r) = (row(&head.translation), row(&head.rotation));
    let rotation = quaternion::from_6d(r.try_into().unwrap()).unwrap();
    Isometry3::from_parts(Translation3::new(t[0], t[1], t[2]), rotation)
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
    for i in 0..5 {
        step(&mut pipeline, i);
    }
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
