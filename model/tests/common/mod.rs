//! Helpers of the integration tests: weights and images from a formula, a tiny network.
#![allow(dead_code, reason = "each test binary uses its own part")]

pub mod golden;

use std::collections::HashMap;

use grnet_model::candle_core::{DType, Device, Tensor};
use grnet_model::candle_nn::VarBuilder;
use grnet_model::ops::Operators;
use grnet_model::{Network, NetworkConfig, SpatialPool};

/// A device, and the operators that a training uses there.
#[derive(Debug, Clone)]
pub struct Place {
    pub operators: Operators,
    pub device: Device,
}

impl Default for Place {
    fn default() -> Self {
        Self { operators: Operators::Cpu, device: Device::Cpu }
    }
}

impl Place {
    /// The first NVIDIA GPU.
    #[cfg(feature = "cuda")]
    pub fn gpu() -> Self {
        Self { operators: Operators::Portable, device: grnet_model::device::cuda(0).unwrap() }
    }
}

/// What every machine has.
pub fn places() -> [Place; 2] {
    [Place::default(), Place { operators: Operators::Portable, ..Place::default() }]
}

/// `count` numbers in [low, high): FNV-1a of the name, then SplitMix64 by index, 53 bits, rounded to f32.
///
/// `golden/generate.py` computes the same numbers.
pub fn uniform(name: &str, count: usize, low: f64, high: f64) -> Vec<f32> {
    let seed = name
        .bytes()
        .fold(0xcbf2_9ce4_8422_2325_u64, |hash, byte| (hash ^ u64::from(byte)).wrapping_mul(0x100_0000_01b3));
    let value = |i: u64| {
        let mut z = seed.wrapping_add((i + 1).wrapping_mul(0x9e37_79b9_7f4a_7c15));
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^= z >> 31;
        let unit = (z >> 11) as f64 * 2.0_f64.powi(-53);
        (low + unit * (high - low)) as f32
    };
    (0..count as u64).map(value).collect()
}

/// The weight of that name and shape: He-uniform convolutions, PyTorch's bounds elsewhere, lively batch norms.
pub fn weight(name: &str, shape: &[usize]) -> Tensor {
    let suffix = name.rsplit('.').next().unwrap();
    let (low, high) = match shape {
        [_, inputs, kernel, _] => plus_minus((6.0 / (inputs * kernel * kernel) as f64).sqrt()),
        [gates, ..] if name.contains(".lstm.") => plus_minus(1.0 / ((gates / 4) as f64).sqrt()),
        [_, inputs] => plus_minus(1.0 / (*inputs as f64).sqrt()),
        _ if suffix == "running_var" => (0.6, 1.4),
        _ if suffix == "weight" => (0.4, 0.8),
        _ => plus_minus(0.2),
    };
    let values = uniform(name, shape.iter().product(), low, high);
    Tensor::from_vec(values, shape, &Device::Cpu).unwrap()
}

fn plus_minus(bound: f64) -> (f64, f64) {
    (-bound, bound)
}

/// Image number t, (1, 3, height, width): noise of changing strength and brightness.
pub fn frame(t: usize, height: usize, width: usize) -> Tensor {
    let strength = [1.0, 0.3, 1.8, 0.8][t % 4];
    let offset = 0.2 * t as f64 - 0.3;
    let values = uniform(&format!("image.{t}"), 3 * height * width, offset - strength, offset + strength);
    Tensor::from_vec(values, (1, 3, height, width), &Device::Cpu).unwrap()
}

/// Image number t in the size that the network reads.
pub fn frame_for(config: &NetworkConfig, t: usize) -> Tensor {
    frame(t, config.input_height_px, config.input_width_px)
}

/// Every tensor of the network, by the formula.
pub fn weights(config: &NetworkConfig) -> HashMap<String, Tensor> {
    config.tensors().into_iter().map(|t| (t.name.clone(), weight(&t.name, &t.shape))).collect()
}

/// The network with weights by the formula.
pub fn network(config: &NetworkConfig) -> Network {
    let vb = VarBuilder::from_tensors(weights(config), DType::F32, &Device::Cpu);
    Network::new(config, vb).unwrap()
}

/// A network that runs in a few milliseconds.
pub fn tiny() -> NetworkConfig {
    NetworkConfig {
        width: 0.125,
        input_height_px: 40,
        input_width_px: 56,
        k: 3,
        spatial_pool: SpatialPool::Flatten { channels: 4 },
        lstm_hidden: 12,
        fc1: 10,
        fc2: 14,
        fc3: 16,
        ..NetworkConfig::grnet_small()
    }
}

/// Row-major values of a tensor.
pub fn values(tensor: &Tensor) -> Vec<f32> {
    tensor.flatten_all().unwrap().to_vec1().unwrap()
}

/// Largest absolute difference.
pub fn difference(a: &[f32], b: &[f32]) -> f32 {
    assert_eq!(a.len(), b.len());
    a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max)
}
