//! Times training and streaming steps on an NVIDIA GPU: `gpu_step PRESET [operators|WINDOWS...]`; `scripts/bench-cuda` runs it
//! beside PyTorch.
//!
//! Each line is "what, PRESET, windows, precision, milliseconds (median of seven), frames/s, MiB of GPU memory in use". A training
//! step is forward, backward and Adam over windows of K frames, a streaming step one frame through `Network::step`.
//! `operators` times single operators instead, to see where a step's time goes.

use std::collections::{BTreeMap, HashMap};
use std::time::Instant;

use anyhow::{Context, Result};
use grnet_model::candle_core::{DType, Device, Tensor, Var};
use grnet_model::candle_nn::VarBuilder;
use grnet_model::ops::{Activation, Adam, AdamOptions, AdamParam, Operators, ScaleShift};
use grnet_model::{BatchStatistics, HeadTensors, Network, NetworkConfig, Preprocessing, device, untrained};

const ROUNDS: usize = 7;
const WARM_UP: usize = 2;

fn main() -> Result<()> {
    let mut arguments = std::env::args().skip(1);
    let preset = arguments.next().context("usage: gpu_step PRESET [operators|WINDOWS...]")?;
    let config = NetworkConfig::preset(&preset)?;
    let rest: Vec<String> = arguments.collect();
    let gpu = device::cuda(0)?;
    eprintln!("{}", device::describe(&gpu).context("not a GPU")?);
    if rest.first().is_some_and(|what| what == "operators") {
        return operators(&gpu);
    }
    let windows: Vec<usize> = match rest.as_slice() {
        [] => vec![1, 4, 8, 16],
        some => {
            some.iter().map(|n| n.parse().with_context(|| format!("{n:?} windows"))).collect::<Result<_>>()?
        }
    };
    let weights = untrained::checkpoint(&config, 7, Preprocessing::default())?.into_tensors(&Device::Cpu)?;
    for precision in ["f32", "tf32"] {
        device::allow_tf32(precision == "tf32");
        let stream = stream(&config, &weights, &gpu)?;
        report("stream", &preset, 1, precision, stream, 1, &gpu);
        for windows in &windows {
            let mut step = Step::new(&config, &weights, *windows, &gpu)?;
            let ms = time(&gpu, || step.run())?;
            report("train", &preset, *windows, precision, ms, windows * config.k, &gpu);
        }
    }
    Ok(())
}

fn report(what: &str, preset: &str, windows: usize, precision: &str, ms: f64, frames: usize, gpu: &Device) {
    let per_s = frames as f64 / ms * 1e3;
    let mib = device::used_mib(gpu).unwrap_or(0);
    println!("{what} {preset} {windows} {precision} {ms:.2} {per_s:.0} {mib}");
}

/// Median milliseconds of a piece of work.
fn time(gpu: &Device, mut work: impl FnMut() -> Result<()>) -> Result<f64> {
    let mut rounds = Vec::with_capacity(ROUNDS);
    for round in 0..WARM_UP + ROUNDS {
        gpu.synchronize()?;
        let start = Instant::now();
        work()?;
        gpu.synchronize()?;
        if round >= WARM_UP {
            rounds.push(start.elapsed().as_secs_f64() * 1e3);
        }
    }
    rounds.sort_by(f64::total_cmp);
    Ok(rounds[ROUNDS / 2])
}

fn noise(shape: &[usize], device: &Device) -> Result<Tensor> {
    let count: usize = shape.iter().product();
    let values = (0..count).map(|i| (i * 7919 % 2003) as f32 / 1001.0 - 1.0).collect::<Vec<_>>();
    Ok(Tensor::from_vec(values, shape, device)?)
}

type Weights = HashMap<String, Tensor>;

fn stream(config: &NetworkConfig, weights: &Weights, gpu: &Device) -> Result<f64> {
    let weights = weights.iter().map(|(name, tensor)| Ok((name.clone(), tensor.to_device(gpu)?)));
    let vb = VarBuilder::from_tensors(weights.collect::<Result<_>>()?, DType::F32, gpu);
    let network = Network::new(config, vb)?;
    let image = noise(&[1, 3, config.input_height_px, config.input_width_px], &Device::Cpu)?;
    let mut state = network.initial_state();
    time(gpu, || {
        network.step(&image.to_device(gpu)?, &mut state)?;
        Ok(())
    })
}

struct Step {
    network: Network,
    statistics: BatchStatistics,
    adam: Adam,
    images: Tensor,
}

impl Step {
    fn new(config: &NetworkConfig, weights: &Weights, windows: usize, gpu: &Device) -> Result<Self> {
        let learnt: HashMap<String, bool> =
            config.tensors().into_iter().map(|t| (t.name, t.learnt)).collect();
        let (mut tensors, mut params) = (HashMap::new(), BTreeMap::new());
        for (name, tensor) in weights {
            let (name, tensor) = (name.clone(), tensor.to_device(gpu)?);
            if learnt[&name] {
                let var = Var::from_tensor(&tensor)?;
                tensors.insert(name.clone(), var.as_tensor().clone());
                params.insert(name, AdamParam { var, lr_multiplier: 1.0 });
            } else {
                tensors.insert(name, tensor);
            }
        }
        let statistics = BatchStatistics::default();
        let vb = VarBuilder::from_tensors(tensors, DType::F32, gpu);
        let network = Network::for_training(config, vb, Some(statistics.clone()))?;
        let images =
            noise(&[windows, config.k, 3, config.input_height_px, config.input_width_px], &Device::Cpu)?;
        Ok(Self { network, statistics, adam: Adam::new(params, AdamOptions::default())?, images })
    }

    /// The mean square of every output stands for the loss.
    fn run(&mut self) -> Result<()> {
        let gpu = self.network.device().clone();
        let output = self.network.window(&self.images.to_device(&gpu)?)?;
        let heads = [&output.relative, &output.global, &output.fused].into_iter().flatten();
        let tensors = heads.flat_map(|HeadTensors { translation, rotation, log_variance }| {
            [Some(translation), Some(rotation), log_variance.as_ref()].into_iter().flatten()
        });
        let mut loss = Tensor::zeros((), DType::F32, &gpu)?;
        for tensor in tensors {
            loss = (loss + tensor.sqr()?.mean_all()?)?;
        }
        let report = self.adam.step(&loss.backward()?, 1e-5, Some(10.0))?;
        anyhow::ensure!(report.applied, "the gradients are not finite");
        self.statistics.take();
        Ok(())
    }
}

/// Convolutions and batch norms of ResNet-50's stages for 40 images, forward, and forward with backward.
fn operators(gpu: &Device) -> Result<()> {
    const IMAGES: usize = 40;
    for (channels, outputs, kernel, stride, side) in [
        (3, 64, 7, 2, 224),
        (64, 64, 3, 1, 56),
        (64, 256, 1, 1, 56),
        (256, 64, 1, 1, 56),
        (128, 128, 3, 2, 56),
        (128, 128, 3, 1, 28),
        (256, 256, 3, 1, 14),
        (256, 1024, 1, 1, 14),
        (512, 512, 3, 1, 7),
    ] {
        let x = Var::from_tensor(&noise(&[channels, IMAGES, side, side], gpu)?)?;
        let weight = Var::from_tensor(&noise(&[outputs, channels, kernel, kernel], gpu)?)?;
        for precision in ["f32", "tf32"] {
            device::allow_tf32(precision == "tf32");
            let forward = || Operators::Portable.conv2d(&x, &weight, stride);
            let y_ms = time(gpu, || Ok(forward().map(drop)?))?;
            let both_ms = time(gpu, || Ok(forward()?.backward().map(drop)?))?;
            println!(
                "conv {kernel}x{kernel}/{stride} {channels}->{outputs} {side}px {precision} {y_ms:.3} {both_ms:.3}"
            );
        }
    }
    device::allow_tf32(false);
    for (channels, side) in [(64, 112), (256, 56), (512, 28), (1024, 14), (2048, 7)] {
        let x = Var::from_tensor(&noise(&[channels, IMAGES, side, side], gpu)?)?;
        let residual = Var::from_tensor(&noise(&[channels, IMAGES, side, side], gpu)?)?;
        let (weight, bias) = (Var::ones(channels, DType::F32, gpu)?, Var::zeros(channels, DType::F32, gpu)?);
        let affine = ScaleShift { weight: &weight, bias: &bias };
        let forward = || Operators::Portable.batch_norm(&x, affine, Some(&residual), Activation::Elu);
        let y_ms = time(gpu, || Ok(forward().map(drop)?))?;
        let both_ms = time(gpu, || Ok(forward()?.0.backward().map(drop)?))?;
        // The passes that it is made of: a sum of rows in two ways, and element by element.
        let rows = x.as_detached_tensor().reshape((channels * IMAGES, side * side))?;
        let sum_ms = time(gpu, || Ok(rows.sum(1).map(drop)?))?;
        let ones = Tensor::ones((side * side, 1), DType::F32, gpu)?;
        let product_ms = time(gpu, || Ok(rows.matmul(&ones).map(drop)?))?;
        let flat = rows.reshape((channels, ()))?;
        let column = Tensor::ones((channels, 1), DType::F32, gpu)?;
        let add_ms = time(gpu, || Ok((&flat + &flat).map(drop)?))?;
        let broadcast_ms = time(gpu, || Ok(flat.broadcast_mul(&column).map(drop)?))?;
        println!(
            "bn {channels} {side}px {y_ms:.3} {both_ms:.3} sum {sum_ms:.3} product {product_ms:.3} add {add_ms:.3} \
             broadcast {broadcast_ms:.3}"
        );
    }
    let x = Var::from_tensor(&noise(&[64, IMAGES, 112, 112], gpu)?)?;
    let forward = || Operators::Portable.max_pool_3x3_stride_2(&x);
    let y_ms = time(gpu, || Ok(forward().map(drop)?))?;
    let both_ms = time(gpu, || Ok(forward()?.backward().map(drop)?))?;
    println!("max-pool 64 112px {y_ms:.3} {both_ms:.3}");
    let small = Tensor::ones(64, DType::F32, gpu)?;
    let launches = time(gpu, || {
        for _ in 0..1000 {
            small.affine(1.0, 1.0)?;
        }
        Ok(())
    })?;
    println!("a small operation: {launches:.2} us");
    Ok(())
}
