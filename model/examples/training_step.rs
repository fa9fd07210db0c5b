//! Training steps on demand, to be timed beside another implementation: `training_step PRESET WINDOWS THREADS`.
//!
//! Every line on stdin asks for one step (forward, backward and Adam over `WINDOWS` windows of K frames); the answer is
//! a line "milliseconds of wall clock, of processor time, peak memory in KiB". `scripts/bench-training` drives it.
//!
//! As in `grnet-train`, each thread has a copy of the network that shares its weights and takes some of the windows, as far as there are
//! windows for all; the script holds candle's own threads to one (CANDLE_NUM_THREADS).

use std::collections::{BTreeMap, HashMap};
use std::io::{BufRead, Write};
use std::time::Instant;

use anyhow::{Context, Result};
use grnet_model::candle_core::backprop::GradStore;
use grnet_model::candle_core::{DType, Device, Tensor, Var};
use grnet_model::candle_nn::VarBuilder;
use grnet_model::ops::{Adam, AdamOptions, AdamParam};
use grnet_model::{BatchStatistics, HeadTensors, Network, NetworkConfig, Preprocessing, untrained};
use rayon::prelude::*;

fn main() -> Result<()> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [preset, windows, threads] = arguments.as_slice() else {
        anyhow::bail!("usage: training_step PRESET WINDOWS THREADS");
    };
    let threads = threads.parse().with_context(|| format!("{threads:?} is no number of threads"))?;
    rayon::ThreadPoolBuilder::new().num_threads(threads).build_global()?;
    let windows: usize = windows.parse().with_context(|| format!("{windows:?} is no number of windows"))?;
    let mut step = Step::new(&NetworkConfig::preset(preset)?, windows, threads)?;
    for line in std::io::stdin().lock().lines() {
        line?;
        let (wall, cpu) = (Instant::now(), processor_ms()?);
        step.run()?;
        let wall_ms = wall.elapsed().as_secs_f64() * 1e3;
        println!("{wall_ms:.2} {:.2} {}", processor_ms()? - cpu, peak_kib()?);
        std::io::stdout().flush()?;
    }
    Ok(())
}

struct Step {
    copies: Vec<(Network, BatchStatistics)>,
    variables: Vec<Var>,
    adam: Adam,
    images: Tensor,
}

impl Step {
    fn new(config: &NetworkConfig, windows: usize, threads: usize) -> Result<Self> {
        let learnt: HashMap<String, bool> =
            config.tensors().into_iter().map(|t| (t.name, t.learnt)).collect();
        let (mut tensors, mut params) = (HashMap::new(), BTreeMap::new());
        let checkpoint = untrained::checkpoint(config, 7, Preprocessing::default())?;
        for (name, tensor) in checkpoint.into_tensors(&Device::Cpu)? {
            if learnt[&name] {
                let var = Var::from_tensor(&tensor)?;
                tensors.insert(name.clone(), var.as_tensor().clone());
                params.insert(name, AdamParam { var, lr_multiplier: 1.0 });
            } else {
                tensors.insert(name, tensor);
            }
        }
        let copy = |_| {
            let statistics = BatchStatistics::default();
            let vb = VarBuilder::from_tensors(tensors.clone(), DType::F32, &Device::Cpu);
            Ok((Network::for_training(config, vb, Some(statistics.clone()))?, statistics))
        };
        let share = windows.div_ceil(threads.min(windows));
        let copies = (0..windows.div_ceil(share)).map(copy).collect::<Result<_>>()?;
        let shape = (windows, config.k, 3, config.input_height_px, config.input_width_px);
        let count = windows * config.k * 3 * config.input_height_px * config.input_width_px;
        let values = (0..count).map(|i| (i * 7919 % 2003) as f32 / 1001.0 - 1.0).collect::<Vec<_>>();
        let images = Tensor::from_vec(values, shape, &Device::Cpu)?;
        let variables = params.values().map(|param| param.var.clone()).collect();
        Ok(Self { copies, variables, adam: Adam::new(params, AdamOptions::default())?, images })
    }

    fn run(&mut self) -> Result<()> {
        let windows = self.images.dim(0)?;
        let share = windows.div_ceil(self.copies.len());
        let gradients = self.copies.par_iter().enumerate().map(|(index, (network, _))| {
            let count = share.min(windows - index * share);
            let loss = loss(network, &self.images.narrow(0, index * share, count)?)?;
            Ok((loss * (count as f64 / windows as f64))?.backward()?)
        });
        let mut gradients = gradients.collect::<Result<Vec<GradStore>>>()?;
        let mut sum = gradients.swap_remove(0);
        for var in &self.variables {
            let others = gradients.iter().filter_map(|other| other.get(var));
            if let Some(mut total) = sum.remove(var) {
                for other in others {
                    total = (total + other)?;
                }
                sum.insert(var, total);
            }
        }
        let report = self.adam.step(&sum, 1e-5, Some(10.0))?;
        anyhow::ensure!(report.applied, "the gradients are not finite");
        self.copies.iter().for_each(|(_, statistics)| drop(statistics.take()));
        Ok(())
    }
}

/// The mean square of every output stands for the loss.
fn loss(network: &Network, images: &Tensor) -> Result<Tensor> {
    let output = network.window(images)?;
    let heads = [&output.relative, &output.global, &output.fused].into_iter().flatten();
    let tensors = heads.flat_map(|HeadTensors { translation, rotation, log_variance }| {
        [Some(translation), Some(rotation), log_variance.as_ref()].into_iter().flatten()
    });
    let mut loss = Tensor::zeros((), DType::F32, &Device::Cpu)?;
    for tensor in tensors {
        loss = (loss + tensor.sqr()?.mean_all()?)?;
    }
    Ok(loss)
}

/// Processor time of this process so far.
fn processor_ms() -> Result<f64> {
    let stat = std::fs::read_to_string("/proc/self/stat")?;
    // Fields 14 and 15 of proc(5), counted behind the name in parentheses; a hundredth of a second each.
    let behind = stat.rsplit(')').next().context("/proc/self/stat has no name")?;
    let ticks = behind.split_whitespace().skip(11).take(2).map(str::parse::<f64>);
    Ok(10.0 * ticks.sum::<Result<f64, _>>()?)
}

/// Peak resident memory of this process so far.
fn peak_kib() -> Result<u64> {
    let status = std::fs::read_to_string("/proc/self/status")?;
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:")).context("no VmHWM")?;
    Ok(line.trim().trim_end_matches("kB").trim().parse()?)
}
