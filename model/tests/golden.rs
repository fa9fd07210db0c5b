//! The network against an independent PyTorch implementation (`golden/generate.py`): block by block and as a whole.

mod common;

use candle_core::{Device, Module, Tensor};
use candle_nn::VarBuilder;
use common::golden::Golden;
use common::{frame_for, network, uniform, values, weight};
use grnet_model::candle_core::{self, DType};
use grnet_model::candle_nn;
use grnet_model::lstm::Lstm;
use grnet_model::recurrence::Memory;
use grnet_model::resnet::{Bottleneck, ConvBnElu, max_pool_3x3_stride_2};
use grnet_model::{FrameRole, HeadTensors, NetworkConfig, Recurrence};

/// Largest difference allowed in a pose, in metres and in raw rotation outputs.
const POSE: f32 = 1e-4;

fn assert_head(golden: &Golden, prefix: &str, head: &HeadTensors) {
    golden.assert_close(&format!("{prefix}.translation"), &head.translation, POSE);
    golden.assert_close(&format!("{prefix}.rotation"), &head.rotation, POSE);
    let name = format!("{prefix}.log_variance");
    assert_eq!(head.log_variance.is_some(), golden.has(&name), "{name}");
    if let Some(log_variance) = &head.log_variance {
        golden.assert_close(&name, log_variance, POSE);
    }
}

fn assert_memory(golden: &Golden, prefix: &str, memory: &Memory, config: &NetworkConfig) {
    if config.recurrence == Recurrence::RerunLastK {
        assert!(memory.lstm_state().is_none() && memory.cached_frames() > 0);
        return;
    }
    let layers = memory.lstm_state().unwrap().layers();
    let all = |of: fn(&(Tensor, Tensor)) -> &Tensor| {
        layers.iter().flat_map(|layer| values(of(layer))).collect::<Vec<_>>()
    };
    golden.assert_summary(&format!("{prefix}.h"), &all(|l| &l.0), 1e-3);
    golden.assert_summary(&format!("{prefix}.c"), &all(|l| &l.1), 1e-3);
}

/// Streams the frames of a golden file; `reset_before` names frames before which the state is reset.
fn stream(name: &str, frames: usize, reset_before: &[usize]) -> NetworkConfig {
    let golden = Golden::open(name);
    let config = golden.config();
    let network = network(&config);
    let mut state = network.initial_state();
    for t in 0..frames {
        if reset_before.contains(&t) {
            state.reset();
        }
        let output = network.step_tensors(&frame_for(&config, t), &mut state, FrameRole::Key).unwrap();
        golden.assert_summary(&format!("{t}.features"), &values(&output.features), 1e-4);
        assert_memory(&golden, &format!("{t}.relative"), state.relative(), &config);
        assert_memory(&golden, &format!("{t}.global"), state.global(), &config);
        assert_head(&golden, &format!("{t}.relative"), &output.relative.unwrap());
        assert_head(&golden, &format!("{t}.global"), &output.global.unwrap());
        assert_head(&golden, &format!("{t}.fused"), &output.fused.unwrap());
    }
    assert!(!golden.has(&format!("{frames}.fused.translation")), "the golden file has more frames");
    config
}

#[test]
fn grnet_streams_as_pytorch_does() {
    assert_eq!(stream("grnet", 4, &[]), NetworkConfig::grnet());
}

#[test]
fn grnet_small_streams_as_pytorch_does_also_after_a_reset() {
    // The reference pairs neighbours; which frames are key frames is up to the caller.
    let neighbours = NetworkConfig { keyframe_interval_ms: 0, ..NetworkConfig::grnet_small() };
    assert_eq!(stream("grnet-small", 5, &[3]), neighbours);
}

#[test]
fn odd_sizes_and_1024_res5_channels_stream_as_in_pytorch() {
    let config = stream("odd", 3, &[]);
    assert_eq!((config.input_height_px, config.input_width_px, config.res5_channels), (75, 101, 1024));
}

#[test]
fn a_rerun_over_the_last_k_frames_streams_as_in_pytorch() {
    let config = stream("rerun", 6, &[]);
    assert_eq!((config.recurrence, config.k), (Recurrence::RerunLastK, 3));
}

/// Builds a block from formula weights whatever it asks for.
fn builder(prefix: &str, tensors: &[(&str, &[usize])]) -> VarBuilder<'static> {
    let made = tensors.iter().map(|(name, shape)| {
        let name = format!("{prefix}.{name}");
        (name.clone(), weight(&name, shape))
    });
    VarBuilder::from_tensors(made.collect(), DType::F32, &Device::Cpu).pp(prefix)
}

fn batch_norm(name: &str, channels: &'static [usize]) -> Vec<(String, &'static [usize])> {
    ["weight", "bias", "running_mean", "running_var"].map(|t| (format!("{name}.{t}"), channels)).to_vec()
}

fn block(
    prefix: &str,
    convolutions: &[(&str, &'static [usize])],
    norms: &[(&str, &'static [usize])],
) -> VarBuilder<'static> {
    let mut tensors: Vec<(String, &[usize])> =
        convolutions.iter().map(|(name, shape)| (format!("{name}.weight"), *shape)).collect();
    for (name, channels) in norms {
        tensors.extend(batch_norm(name, channels));
    }
    let tensors: Vec<_> = tensors.iter().map(|(name, shape)| (name.as_str(), *shape)).collect();
    builder(prefix, &tensors)
}

fn input(name: &str, shape: &[usize], low: f64, high: f64) -> Tensor {
    Tensor::from_vec(uniform(name, shape.iter().product(), low, high), shape, &Device::Cpu).unwrap()
}

#[test]
fn convolution_batch_norm_and_elu() {
    let vb = block("conv3x3", &[("conv", &[16, 8, 3, 3])], &[("bn", &[16])]);
    let layer = ConvBnElu::new((8, 16, 3, 2), vb.pp("conv"), vb.pp("bn")).unwrap();
    let y = layer.forward(&input("block.input", &[2, 8, 9, 6], -1.0, 1.0)).unwrap();
    assert_eq!(y.dims(), [2, 16, 5, 3]);
    Golden::open("blocks").assert_close("conv_bn_elu", &y, 1e-5);
}

#[test]
fn bottleneck_with_stride_and_projection() {
    let convolutions: [(&str, &[usize]); 4] = [
        ("conv1", &[8, 8, 1, 1]),
        ("conv2", &[8, 8, 3, 3]),
        ("conv3", &[32, 8, 1, 1]),
        ("downsample.0", &[32, 8, 1, 1]),
    ];
    let norms: [(&str, &[usize]); 4] =
        [("bn1", &[8]), ("bn2", &[8]), ("bn3", &[32]), ("downsample.1", &[32])];
    let block = Bottleneck::new(8, 8, 2, block("stride2", &convolutions, &norms)).unwrap();
    let y = block.forward(&input("block.input", &[2, 8, 9, 6], -1.0, 1.0)).unwrap();
    assert_eq!(y.dims(), [2, 32, 5, 3]);
    Golden::open("blocks").assert_close("bottleneck_stride_2", &y, 1e-5);
}

#[test]
fn bottleneck_with_identity_shortcut() {
    let convolutions: [(&str, &[usize]); 3] =
        [("conv1", &[8, 32, 1, 1]), ("conv2", &[8, 8, 3, 3]), ("conv3", &[32, 8, 1, 1])];
    let norms: [(&str, &[usize]); 3] = [("bn1", &[8]), ("bn2", &[8]), ("bn3", &[32])];
    let block = Bottleneck::new(32, 8, 1, block("identity", &convolutions, &norms)).unwrap();
    let y = block.forward(&input("block.wide", &[2, 32, 5, 4], -1.0, 1.0)).unwrap();
    Golden::open("blocks").assert_close("bottleneck_identity", &y, 1e-5);
}

#[test]
fn max_pool_of_an_odd_map() {
    let x = input("block.pool", &[2, 3, 7, 10], -2.0, 0.5).elu(1.0).unwrap();
    let y = max_pool_3x3_stride_2(&x).unwrap();
    assert_eq!(y.dims(), [2, 3, 4, 5]);
    Golden::open("blocks").assert_close("max_pool", &y, 1e-6);
}

#[test]
fn stacked_lstm_over_a_sequence() {
    let tensors: [(&str, &[usize]); 8] = [
        ("weight_ih_l0", &[28, 12]),
        ("weight_hh_l0", &[28, 7]),
        ("bias_ih_l0", &[28]),
        ("bias_hh_l0", &[28]),
        ("weight_ih_l1", &[28, 7]),
        ("weight_hh_l1", &[28, 7]),
        ("bias_ih_l1", &[28]),
        ("bias_hh_l1", &[28]),
    ];
    let lstm = Lstm::new(12, 7, 2, builder("block.lstm", &tensors)).unwrap();
    let zero = lstm.zero_state(2, &Device::Cpu).unwrap();
    let x = input("block.sequence", &[2, 5, 12], -1.0, 1.0);
    let (y, state) = lstm.forward(&x, &zero).unwrap();
    let golden = Golden::open("blocks");
    golden.assert_close("lstm", &y, 1e-6);
    let stack = |of: fn(&(Tensor, Tensor)) -> &Tensor| {
        let layers: Vec<_> = state.layers().iter().map(of).collect();
        Tensor::stack(&layers, 0).unwrap() // 2 x (B, hidden) -> (2, B, hidden)
    };
    golden.assert_close("lstm.h", &stack(|l| &l.0), 1e-6);
    golden.assert_close("lstm.c", &stack(|l| &l.1), 1e-6);
}
