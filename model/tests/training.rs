//! The network made for training: outputs, gradients and batch statistics against PyTorch
//! (`golden/generate_ops.py`), and the same bits on any number of threads.

mod common;

use std::collections::{BTreeMap, HashMap};

use candle_core::{DType, Device, Tensor, Var, backprop::GradStore};
use candle_nn::VarBuilder;
use common::golden::Golden;
use common::{Place, difference, frame_for, network, places, tiny, uniform, values, weights};
use grnet_model::{
    BatchStatistics, HeadTensors, LayerStatistics, ModelError, Network, NetworkConfig, WindowOutput,
    candle_core, candle_nn,
};

/// Allowed difference of a gradient relative to its root mean square.
const GRADIENT: f64 = 2e-3;
/// Allowed difference of a pose.
const POSE: f32 = 1e-4;

struct Case {
    network: Network,
    statistics: BatchStatistics,
    vars: BTreeMap<String, Var>,
}

impl Case {
    fn new(config: &NetworkConfig, trained: impl Fn(&str) -> bool, place: &Place) -> Self {
        let learnt: HashMap<String, bool> =
            config.tensors().into_iter().map(|t| (t.name, t.learnt)).collect();
        let (mut tensors, mut vars) = (HashMap::new(), BTreeMap::new());
        for (name, tensor) in weights(config) {
            let tensor = tensor.to_device(&place.device).unwrap();
            if learnt[&name] && trained(&name) {
                let var = Var::from_tensor(&tensor).unwrap();
                tensors.insert(name.clone(), var.as_tensor().clone());
                vars.insert(name, var);
            } else {
                tensors.insert(name, tensor);
            }
        }
        let statistics = BatchStatistics::default();
        let vb = VarBuilder::from_tensors(tensors, DType::F32, &place.device);
        let network = Network::for_training_with(config, vb, Some(statistics.clone()), place.operators);
        let network = network.unwrap();
        Self { network, statistics, vars }
    }
}

/// Frames 0 to 5 as (2, 3, 3, H, W).
fn images(config: &NetworkConfig) -> Tensor {
    let frames: Vec<Tensor> = (0..6).map(|t| frame_for(config, t)).collect();
    let (height, width) = (config.input_height_px, config.input_width_px);
    Tensor::cat(&frames, 0).unwrap().reshape((2, 3, 3, height, width)).unwrap() // 6 x (1, 3, H, W)
}

fn outputs(output: &WindowOutput) -> Vec<(String, &Tensor)> {
    let heads = [("relative", &output.relative), ("global", &output.global), ("fused", &output.fused)];
    let mut all = Vec::new();
    for (name, head) in heads {
        let Some(HeadTensors { translation, rotation, log_variance }) = head else { continue };
        all.push((format!("{name}.translation"), translation));
        all.push((format!("{name}.rotation"), rotation));
        all.extend(log_variance.as_ref().map(|t| (format!("{name}.log_variance"), t)));
    }
    all
}

/// The sum of all outputs times their upstream gradients.
fn loss(output: &WindowOutput) -> Tensor {
    let terms = outputs(output).into_iter().map(|(name, y)| {
        let upstream = uniform(&format!("{name}.upstream"), y.elem_count(), -1.0, 1.0);
        let upstream = Tensor::from_vec(upstream, y.shape(), y.device()).unwrap();
        (y * upstream).unwrap().sum_all().unwrap()
    });
    terms.reduce(|a, b| (a + b).unwrap()).unwrap()
}

fn against_pytorch(place: &Place, name: &str, trained: fn(&str) -> bool, gradients_expected: usize) {
    let golden = Golden::open(name);
    let config = golden.config();
    let case = Case::new(&config, trained, place);
    let images = images(&config).to_device(&place.device).unwrap();
    let output = case.network.window(&images).unwrap();
    for (name, y) in outputs(&output) {
        golden.assert_close(&name, y, POSE);
    }
    let gradients = loss(&output).backward().unwrap();
    let mut compared = 0;
    for (name, var) in &case.vars {
        let gradient = gradients.get(var).unwrap_or_else(|| panic!("{name} has no gradient"));
        let name = format!("{name}.gradient");
        if golden.has(&format!("{name}.sample")) {
            golden.assert_summary(&name, &values(gradient), GRADIENT);
            compared += 1;
        }
    }
    assert_eq!(compared, gradients_expected);
    let norms: Vec<String> = config.layers().into_iter().map(|layer| layer.name).collect();
    let statistics = case.statistics.take();
    let expected: Vec<&str> = norms
        .iter()
        .map(String::as_str)
        .filter(|name| case.vars.contains_key(&format!("{name}.bias")) && learns_statistics(&config, name))
        .collect();
    let mut found: Vec<&str> = statistics.iter().map(|s| s.layer.as_str()).collect();
    assert_eq!(found.first().copied(), expected.first().copied(), "the order of the forward pass");
    found.sort_by_key(|name| norms.iter().position(|layer| layer == name));
    assert_eq!(found, expected);
    for LayerStatistics { layer, mean, variance } in &statistics {
        if golden.has(&format!("{layer}.mean.sample")) {
            golden.assert_summary(&format!("{layer}.mean"), &values(mean), 1e-4);
            golden.assert_summary(&format!("{layer}.var"), &values(variance), 1e-4);
        }
    }
    assert!(case.statistics.take().is_empty());
}

fn learns_statistics(config: &NetworkConfig, layer: &str) -> bool {
    config.tensors().iter().any(|t| t.name == format!("{layer}.running_mean"))
}

#[test]
fn a_network_trained_as_a_whole_has_pytorchs_gradients() {
    for place in places() {
        against_pytorch(&place, "training-all", |_| true, 12);
    }
}

#[test]
fn with_cnn1_frozen_the_rest_has_pytorchs_gradients() {
    for place in places() {
        against_pytorch(&place, "training-frozen-cnn1", |name| !name.starts_with("cnn1."), 7);
    }
}

#[cfg(feature = "cuda")]
#[test]
#[ignore = "needs an NVIDIA GPU"]
fn on_a_gpu_it_has_pytorchs_gradients() {
    let gpu = Place::gpu();
    against_pytorch(&gpu, "training-all", |_| true, 12);
    against_pytorch(&gpu, "training-frozen-cnn1", |name| !name.starts_with("cnn1."), 7);
}

#[test]
fn without_a_collector_the_training_network_is_the_network() {
    let config = tiny();
    for place in places() {
        let vb = VarBuilder::from_tensors(weights(&config), DType::F32, &Device::Cpu);
        let training = Network::for_training_with(&config, vb, None, place.operators).unwrap();
        let (ours, plain) = (training.window(&images(&config)), network(&config).window(&images(&config)));
        let (ours, plain) = (ours.unwrap(), plain.unwrap());
        for ((name, a), (_, b)) in outputs(&ours).into_iter().zip(outputs(&plain)) {
            assert!(difference(&values(a), &values(b)) < 2e-5, "{name}");
        }
    }
}

#[test]
fn features_go_in_where_images_would() {
    let config = tiny();
    places().iter().for_each(|place| features_instead_of_images(&config, place));
}

fn features_instead_of_images(config: &NetworkConfig, place: &Place) {
    let trained = |name: &str| name.starts_with("rcnn2") || name.starts_with("fcfl");
    let case = Case::new(config, trained, place);
    let images = images(config);
    let features = case.network.features(&images.flatten(0, 1).unwrap()).unwrap();
    assert!(!features.track_op(), "a frozen CNN1 leaves no graph behind");
    let from_features = case.network.window_from_features(&features, 2, 3).unwrap();
    let whole = case.network.window(&images).unwrap();
    for ((name, a), (_, b)) in outputs(&from_features).into_iter().zip(outputs(&whole)) {
        assert_eq!(values(a), values(b), "{name}");
    }
    let gradients = loss(&from_features).backward().unwrap();
    assert!(case.vars.values().all(|var| gradients.get(var).is_some()));
    let error = case.network.window_from_features(&features, 3, 3).unwrap_err();
    assert!(matches!(&error, ModelError::Features { expected, .. } if expected[0] == 9), "{error}");
    let error = case.network.features(&images).unwrap_err();
    assert!(matches!(&error, ModelError::Images { found, .. } if found.len() == 5), "{error}");
}

/// Bits of the outputs, of every gradient and of the statistics.
fn bits(threads: usize) -> BTreeMap<String, Vec<u32>> {
    let bits = |values: &[f32]| values.iter().map(|v| v.to_bits()).collect::<Vec<_>>();
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
    pool.install(|| {
        let config = NetworkConfig { width: 0.25, ..tiny() };
        let case = Case::new(&config, |_| true, &Place::default());
        let output = case.network.window(&images(&config)).unwrap();
        let gradients: GradStore = loss(&output).backward().unwrap();
        let mut all: BTreeMap<String, Vec<u32>> =
            outputs(&output).into_iter().map(|(name, y)| (name, bits(&values(y)))).collect();
        all.extend(
            case.vars.iter().map(|(name, var)| (name.clone(), bits(&values(gradients.get(var).unwrap())))),
        );
        all.extend(
            case.statistics.take().into_iter().map(|s| (format!("{}.mean", s.layer), bits(&values(&s.mean)))),
        );
        all
    })
}

#[test]
fn one_thread_and_several_give_the_same_bits() {
    let one = bits(1);
    for threads in [2, 3] {
        let several = bits(threads);
        for (name, expected) in &one {
            assert_eq!(&several[name], expected, "{name} with {threads} threads");
        }
    }
}

/// A few steps of a small network on the CPU and on a GPU: the weights stay together.
#[cfg(feature = "cuda")]
#[test]
#[ignore = "needs an NVIDIA GPU"]
fn steps_on_a_gpu_are_those_of_the_cpu() {
    use grnet_model::ops::{Adam, AdamOptions, AdamParam};
    let config = NetworkConfig { width: 0.25, ..tiny() };
    let train = |place: &Place| {
        let case = Case::new(&config, |_| true, place);
        let param =
            |(name, var): (&String, &Var)| (name.clone(), AdamParam { var: var.clone(), lr_multiplier: 1.0 });
        let params = case.vars.iter().map(param).collect();
        let mut adam = Adam::with_operators(params, AdamOptions::default(), place.operators).unwrap();
        let images = images(&config).to_device(&place.device).unwrap();
        let mut losses = Vec::new();
        for _ in 0..5 {
            let loss = loss(&case.network.window(&images).unwrap());
            losses.push(loss.to_scalar::<f32>().unwrap());
            assert!(adam.step(&loss.backward().unwrap(), 1e-4, Some(5.0)).unwrap().applied);
        }
        losses
    };
    let (cpu, gpu) = (train(&Place::default()), train(&Place::gpu()));
    assert!(cpu[4] < cpu[0], "{cpu:?}");
    for (step, (a, b)) in cpu.iter().zip(&gpu).enumerate() {
        assert!((a - b).abs() < 1e-3 * (1.0 + a.abs()), "step {step}: {cpu:?} {gpu:?}");
    }
}

/// The whole network at its real size.
#[cfg(feature = "cuda")]
#[test]
#[ignore = "needs an NVIDIA GPU"]
fn the_whole_network_gives_the_same_poses_on_a_gpu() {
    let config = NetworkConfig::grnet();
    let images =
        Tensor::cat(&[frame_for(&config, 0), frame_for(&config, 1)], 0).unwrap().unsqueeze(0).unwrap();
    let on = |device: &Device, training: bool| {
        let weights = weights(&config).into_iter().map(|(n, t)| (n, t.to_device(device).unwrap())).collect();
        let vb = VarBuilder::from_tensors(weights, DType::F32, device);
        let network = match training {
            true => Network::for_training(&config, vb, None).unwrap(),
            false => Network::new(&config, vb).unwrap(),
        };
        let output = network.window(&images.to_device(device).unwrap()).unwrap();
        outputs(&output).into_iter().map(|(name, y)| (name, values(y))).collect::<Vec<_>>()
    };
    let expected = on(&Device::Cpu, true);
    for training in [true, false] {
        for ((name, a), (_, b)) in expected.iter().zip(on(&Place::gpu().device, training)) {
            assert!(difference(a, &b) < 1e-5, "{name}: {}", difference(a, &b));
        }
    }
}
