//! Streams against windows, resets, live heads and refused inputs.

mod common;

use common::{difference, frame_for, network, tiny, values};
use grnet_model::candle_core::{DType, Device, Tensor};
use grnet_model::candle_nn::VarBuilder;
use grnet_model::rcnn1::Rcnn1;
use grnet_model::rcnn2::Rcnn2;
use grnet_model::{
    Branches, FrameRole, HeadState, HeadTensors, Heads, ModelError, Network, NetworkConfig, Recurrence,
    SpatialPool, StepOutput, StreamState,
};

const SAME: f32 = 1e-5;

fn frames(config: &NetworkConfig, order: &[usize]) -> Vec<Tensor> {
    order.iter().map(|t| frame_for(config, *t)).collect()
}

fn run(network: &Network, state: &mut StreamState, frames: &[Tensor]) -> Vec<StepOutput> {
    frames.iter().map(|frame| network.step(frame, state).unwrap()).collect()
}

/// (B, T, n) of a window against T single frames of one of its rows.
fn assert_row_equals(window: &HeadTensors, row: usize, frame: usize, step: &grnet_model::HeadOutput) {
    let of = |tensor: &Tensor| values(&tensor.get(row).unwrap().get(frame).unwrap());
    let step_translation: Vec<f32> = step.translation_m.iter().map(|v| *v as f32).collect();
    let step_rotation: Vec<f32> = step.rotation_raw.iter().map(|v| *v as f32).collect();
    assert!(difference(&of(&window.translation), &step_translation) < SAME);
    assert!(difference(&of(&window.rotation), &step_rotation) < SAME);
    let step_variance: Vec<f32> = step.log_variance.unwrap().iter().map(|v| *v as f32).collect();
    assert!(difference(&of(window.log_variance.as_ref().unwrap()), &step_variance) < SAME);
}

fn assert_window_equals_stream(config: &NetworkConfig, length: usize) {
    let network = network(config);
    // Two windows in one batch: a mix-up of batch and time would show.
    let orders: Vec<Vec<usize>> = vec![(0..length).collect(), (0..length).map(|t| 7 + 2 * t).collect()];
    let window = |order: &[usize]| Tensor::stack(&frames(config, order), 1).unwrap(); // T x (1, 3, H, W) -> (1, T, 3, H, W)
    let batch = Tensor::cat(&[window(&orders[0]), window(&orders[1])], 0).unwrap();
    let output = network.window(&batch).unwrap();
    for (row, order) in orders.iter().enumerate() {
        let steps = run(&network, &mut network.initial_state(), &frames(config, order));
        for (frame, step) in steps.iter().enumerate() {
            assert_row_equals(output.relative.as_ref().unwrap(), row, frame, step.relative.as_ref().unwrap());
            assert_row_equals(output.global.as_ref().unwrap(), row, frame, step.global.as_ref().unwrap());
            assert_row_equals(output.fused.as_ref().unwrap(), row, frame, step.fused.as_ref().unwrap());
        }
    }
}

#[test]
fn windows_equal_streams_with_carried_state() {
    for length in [1, 2, 5] {
        assert_window_equals_stream(&tiny(), length);
    }
}

#[test]
fn windows_equal_streams_with_reruns_also_beyond_k() {
    let config = NetworkConfig { recurrence: Recurrence::RerunLastK, k: 3, ..tiny() };
    for length in [1, 3, 6] {
        assert_window_equals_stream(&config, length);
    }
}

#[test]
fn windows_equal_streams_for_other_shapes() {
    let config = NetworkConfig {
        input_height_px: 33,
        input_width_px: 70,
        res5_channels: 1024,
        spatial_pool: SpatialPool::Average,
        lstm_layers: 3,
        ..tiny()
    };
    assert_window_equals_stream(&config, 3);
}

#[test]
fn carry_and_rerun_part_after_k_frames_and_not_before() {
    let carry = NetworkConfig { recurrence: Recurrence::Carry, ..tiny() };
    let rerun = NetworkConfig { recurrence: Recurrence::RerunLastK, ..carry.clone() };
    let stream = |config: &NetworkConfig| {
        let network = network(config);
        run(&network, &mut network.initial_state(), &frames(config, &[0, 1, 2, 3]))
    };
    let (carried, rerun) = (stream(&carry), stream(&rerun));
    let global = |output: &StepOutput| output.global.as_ref().unwrap().translation_m.map(|v| v as f32);
    assert_eq!(carry.k, 3);
    for t in 0..3 {
        assert!(difference(&global(&carried[t]), &global(&rerun[t])) < SAME, "frame {t}");
    }
    assert!(difference(&global(&carried[3]), &global(&rerun[3])) > 10.0 * SAME);
}

#[test]
fn the_first_frame_is_paired_with_itself() {
    let config = tiny();
    let network = network(&config);
    let image = frame_for(&config, 0);
    // With reruns of one frame nothing but the pair is remembered: a frame shown twice gives the same relative pose.
    let single = NetworkConfig { recurrence: Recurrence::RerunLastK, k: 1, ..config.clone() };
    let memoryless = common::network(&single);
    let twice = run(&memoryless, &mut memoryless.initial_state(), &[image.clone(), image.clone()]);
    assert_eq!(twice[0].relative, twice[1].relative);
    let other = run(&memoryless, &mut memoryless.initial_state(), &[frame_for(&config, 1), image.clone()]);
    assert_ne!(other[1].relative, twice[0].relative, "the previous frame must matter");
    let mut state = network.initial_state();
    let features = network.step_tensors(&image, &mut state, FrameRole::Key).unwrap().features;
    assert_eq!(values(state.key_features().unwrap()), values(&features));
}

/// Streams `order`; every `interval`-th frame is a key frame.
fn run_with_keys(
    network: &Network,
    state: &mut StreamState,
    order: &[usize],
    interval: usize,
) -> Vec<StepOutput> {
    let role = |t: usize| if t.is_multiple_of(interval) { FrameRole::Key } else { FrameRole::Passing };
    let images = frames(network.config(), order);
    images.iter().enumerate().map(|(t, image)| network.step_as(image, state, role(t)).unwrap()).collect()
}

#[test]
fn passing_frames_are_measured_from_the_key_frame_and_forgotten() {
    const INTERVAL: usize = 3;
    for recurrence in [Recurrence::Carry, Recurrence::RerunLastK] {
        let config = NetworkConfig { recurrence, ..tiny() };
        let network = network(&config);
        let order: Vec<usize> = (0..11).collect();
        let steps = run_with_keys(&network, &mut network.initial_state(), &order, INTERVAL);
        for (t, step) in steps.iter().enumerate() {
            assert_eq!(step.is_key, t.is_multiple_of(INTERVAL));
            // RCNN1 saw the key frames before this one and this one; RCNN2 every frame.
            let seen: Vec<usize> = (0..t).step_by(INTERVAL).chain([t]).collect();
            let window = |order: &[usize]| {
                let images = Tensor::stack(&frames(&config, order), 1).unwrap(); // T x (1, 3, H, W) -> (1, T, 3, H, W)
                network.window(&images).unwrap()
            };
            let relative = window(&seen).relative.unwrap();
            assert_row_equals(&relative, 0, seen.len() - 1, step.relative.as_ref().unwrap());
            let global = window(&order[..=t]).global.unwrap();
            assert_row_equals(&global, 0, t, step.global.as_ref().unwrap());
        }
    }
}

#[test]
fn the_fused_pose_of_a_passing_frame_reads_both_memories() {
    let config = NetworkConfig { recurrence: Recurrence::RerunLastK, ..tiny() };
    let network = network(&config);
    let order: Vec<usize> = (0..6).collect();
    let steps = run_with_keys(&network, &mut network.initial_state(), &order, 4);
    // By hand, for frame 5: RCNN1 has the pairs 0 0, 0 4 and 4 5, RCNN2 the last K = 3 frames.
    assert_eq!(config.k, 3);
    let vb = VarBuilder::from_tensors(common::weights(&config), DType::F32, &Device::Cpu);
    let features =
        |order: &[usize]| network.features(&Tensor::cat(&frames(&config, order), 0).unwrap()).unwrap();
    let rcnn1 = Rcnn1::new(&config, vb.pp("rcnn1")).unwrap();
    let pairs = rcnn1.pooled(&features(&[0, 0, 4]), &features(&[0, 4, 5])).unwrap(); // (3, F)
    let fc1 = rcnn1.window(&pairs.unsqueeze(0).unwrap()).unwrap(); // (3, fc1)
    let rcnn2 = Rcnn2::new(&config, vb.pp("rcnn2")).unwrap();
    let fc2 = rcnn2.window(&rcnn2.pooled(&features(&[3, 4, 5])).unwrap().unsqueeze(0).unwrap()).unwrap(); // (3, fc2)
    let fcfl = grnet_model::fcfl::Fcfl::new(&config, vb.pp("fcfl")).unwrap();
    let fused = fcfl.forward(&fc1, &fc2).unwrap(); // (3, n)
    let window = |tensor: &Tensor| tensor.unsqueeze(0).unwrap(); // (3, n) -> (1, 3, n)
    let fused = HeadTensors {
        translation: window(&fused.translation),
        rotation: window(&fused.rotation),
        log_variance: fused.log_variance.as_ref().map(window),
    };
    assert_row_equals(&fused, 0, 2, steps[5].fused.as_ref().unwrap());
}

#[test]
fn after_a_reset_the_next_frame_is_a_key_frame_whatever_is_asked() {
    let config = tiny();
    let network = network(&config);
    let mut state = network.initial_state();
    let image = frame_for(&config, 0);
    for reset in [StreamState::reset, StreamState::reset_relative] {
        reset(&mut state);
        assert!(network.step_as(&image, &mut state, FrameRole::Passing).unwrap().is_key);
        assert!(!network.step_as(&image, &mut state, FrameRole::Passing).unwrap().is_key);
    }
}

#[test]
fn a_reset_forgets_everything() {
    let config = tiny();
    let network = network(&config);
    let fresh = run(&network, &mut network.initial_state(), &frames(&config, &[2, 3]));
    let mut state = network.initial_state();
    run(&network, &mut state, &frames(&config, &[0, 1]));
    state.reset();
    assert_eq!(run(&network, &mut state, &frames(&config, &[2, 3])), fresh);
}

#[test]
fn branches_are_reset_one_by_one() {
    for recurrence in [Recurrence::Carry, Recurrence::RerunLastK] {
        let config = NetworkConfig { recurrence, ..tiny() };
        let network = network(&config);
        let fresh = run(&network, &mut network.initial_state(), &frames(&config, &[2])).remove(0);
        let mut state = network.initial_state();
        run(&network, &mut state, &frames(&config, &[0, 1]));
        let after = |reset: fn(&mut StreamState)| {
            let mut state = state.clone();
            reset(&mut state);
            run(&network, &mut state, &frames(&config, &[2])).remove(0)
        };
        let unreset = after(|_| {});
        let relative = after(StreamState::reset_relative);
        assert_eq!((&relative.relative, &relative.global), (&fresh.relative, &unreset.global));
        let global = after(StreamState::reset_global);
        assert_eq!((&global.relative, &global.global), (&unreset.relative, &fresh.global));
        assert_ne!(unreset.relative, fresh.relative);
        assert_ne!(unreset.global, fresh.global);
    }
}

#[test]
fn single_branches_give_their_own_outputs_unchanged() {
    let config = tiny();
    let both = network(&config);
    let order = [0, 1, 2];
    let whole = run(&both, &mut both.initial_state(), &frames(&config, &order));
    for (relative, global) in [(true, false), (false, true), (true, true)] {
        let part = NetworkConfig { branches: Branches { relative, global, fusion: false }, ..config.clone() };
        let part = network(&part);
        let outputs = run(&part, &mut part.initial_state(), &frames(&config, &order));
        for (output, whole) in outputs.iter().zip(&whole) {
            assert_eq!(output.relative, whole.relative.clone().filter(|_| relative));
            assert_eq!(output.global, whole.global.clone().filter(|_| global));
            assert_eq!(output.fused, None);
        }
    }
}

#[test]
fn heads_that_are_not_live_give_nothing() {
    let config = tiny();
    let live = Heads {
        relative: HeadState { pose: true, log_variance: false },
        global: HeadState::default(),
        fused: HeadState { pose: true, log_variance: true },
    };
    let all = network(&config);
    let some = all.clone().with_live_heads(live);
    let expected = run(&all, &mut all.initial_state(), &frames(&config, &[0])).remove(0);
    let output = run(&some, &mut some.initial_state(), &frames(&config, &[0])).remove(0);
    assert_eq!(output.global, None);
    assert_eq!(output.fused, expected.fused);
    let relative = output.relative.unwrap();
    assert_eq!(relative.translation_m, expected.relative.unwrap().translation_m);
    assert_eq!(relative.log_variance, None);
    let window = some.window(&frame_for(&config, 0).unsqueeze(0).unwrap()).unwrap();
    assert!(window.global.is_none() && window.relative.unwrap().log_variance.is_none());
}

#[test]
fn wrong_images_are_refused_and_leave_the_state_alone() {
    let config = tiny();
    let network = network(&config);
    let mut state = network.initial_state();
    network.step(&frame_for(&config, 0), &mut state).unwrap();
    let mut untouched = state.clone();
    let zeros = |shape: &[usize], dtype| Tensor::zeros(shape, dtype, &Device::Cpu).unwrap();
    for image in [
        zeros(&[1, 3, 56, 40], DType::F32),
        zeros(&[2, 3, 40, 56], DType::F32),
        zeros(&[1, 1, 40, 56], DType::F32),
        zeros(&[3, 40, 56], DType::F32),
        zeros(&[1, 3, 40, 56], DType::F64),
    ] {
        let error = network.step(&image, &mut state).unwrap_err();
        assert!(matches!(error, ModelError::Images { .. }));
        assert!(error.to_string().contains("(1, 3, 40, 56)"), "{error}");
    }
    let next = frame_for(&config, 1);
    assert_eq!(network.step(&next, &mut state).unwrap(), network.step(&next, &mut untouched).unwrap());
    for window in [zeros(&[1, 3, 40, 56], DType::F32), zeros(&[1, 0, 3, 40, 56], DType::F32)] {
        let error = network.window(&window).unwrap_err();
        assert!(error.to_string().contains("(B, T, 3, 40, 56)"), "{error}");
    }
}
