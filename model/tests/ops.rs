//! The training operators against PyTorch's gradients (`golden/generate_ops.py`) and against central differences.

mod common;

use std::collections::BTreeMap;

use candle_core::{Device, Tensor, Var, backprop::GradStore};
use common::golden::Golden;
use common::{difference, uniform, values};
use grnet_model::candle_core;
use grnet_model::ops::{
    Activation, Adam, AdamError, AdamOptions, AdamParam, ScaleShift, StepReport, batch_norm,
    batch_norm_running, conv2d, max_pool_3x3_stride_2,
};

const SAMPLES: usize = 64;
/// Allowed difference relative to the root mean square.
const TOLERANCE: f64 = 1e-5;

fn input(name: &str, shape: &[usize], low: f64, high: f64) -> Var {
    let values = uniform(name, shape.iter().product(), low, high);
    Var::from_tensor(&Tensor::from_vec(values, shape, &Device::Cpu).unwrap()).unwrap()
}

/// The gradients of the sum of y times the case's upstream gradient.
fn backward(case: &str, y: &Tensor) -> GradStore {
    let upstream = input(&format!("{case}.upstream"), y.dims(), -1.0, 1.0).detach();
    (y * upstream).unwrap().sum_all().unwrap().backward().unwrap()
}

fn assert_tensors(case: &str, tensors: &[(&str, &Tensor)]) {
    let golden = Golden::open("ops");
    for (key, tensor) in tensors {
        golden.assert_samples(&format!("{case}.{key}"), &values(tensor), SAMPLES, TOLERANCE);
    }
}

/// The derivative along a direction by central differences and by the gradients.
fn assert_derivative(case: &str, inputs: &[&Var], run: impl Fn(&[Tensor]) -> Tensor) {
    let tensors: Vec<Tensor> = inputs.iter().map(|var| var.as_tensor().clone()).collect();
    let gradients = backward(case, &run(&tensors));
    let direction = |i: usize| input(&format!("{case}.direction.{i}"), tensors[i].dims(), -1.0, 1.0).detach();
    let moved = |step: f64| {
        let moved = |i: usize| (&tensors[i].detach() + (direction(i) * step).unwrap()).unwrap();
        let y = run(&(0..tensors.len()).map(moved).collect::<Vec<_>>());
        let upstream = uniform(&format!("{case}.upstream"), y.elem_count(), -1.0, 1.0);
        values(&y).iter().zip(upstream).map(|(y, u)| f64::from(*y) * f64::from(u)).sum::<f64>()
    };
    let step = 2e-3;
    let numeric = (moved(step) - moved(-step)) / (2.0 * step);
    let products = inputs.iter().enumerate().map(|(i, var)| {
        let gradient = values(gradients.get(var).unwrap());
        let direction = values(&direction(i));
        gradient.iter().zip(direction).map(|(g, d)| f64::from(*g) * f64::from(d)).sum::<f64>()
    });
    let analytic: f64 = products.sum();
    assert!(
        (numeric - analytic).abs() < 2e-3 * numeric.abs().max(1.0),
        "{case}: {numeric} by differences, {analytic}"
    );
}

#[test]
fn convolutions_and_their_gradients_equal_pytorch() {
    for kernel in [1, 3, 7] {
        for stride in [1, 2] {
            for (height, width) in [(15, 20), (7, 7), (5, 4)] {
                let case = format!("conv.{kernel}.{stride}.{height}x{width}");
                let x = input(&format!("{case}.x"), &[3, 4, height, width], -1.0, 1.0);
                let weight = input(&format!("{case}.weight"), &[6, 4, kernel, kernel], -1.0, 1.0);
                let y = conv2d(&x, &weight, stride).unwrap();
                let gradients = backward(&case, &y);
                let (dx, dweight) = (gradients.get(&x).unwrap(), gradients.get(&weight).unwrap());
                assert_tensors(&case, &[("y", &y), ("dx", dx), ("dweight", dweight)]);
                assert_derivative(&case, &[&x, &weight], |t| conv2d(&t[0], &t[1], stride).unwrap());
            }
        }
    }
}

/// Enough channels and images that every piece of the work occurs: several products, cut channels, cut taps.
#[test]
fn large_convolutions_have_the_derivatives_of_central_differences() {
    for (n, inputs, outputs, side, kernel, stride) in [
        (1, 96, 80, 6, 3, 1),
        (40, 24, 72, 5, 3, 1),
        (3, 96, 80, 9, 3, 2),
        (40, 200, 8, 4, 1, 1),
        (9, 70, 6, 20, 1, 2),
    ] {
        let case = format!("large.{n}.{inputs}.{outputs}.{side}.{kernel}.{stride}");
        let x = input(&format!("{case}.x"), &[n, inputs, side, side], -0.1, 0.1);
        let weight = input(&format!("{case}.weight"), &[outputs, inputs, kernel, kernel], -0.1, 0.1);
        let ours = conv2d(&x, &weight, stride).unwrap();
        let theirs = x.conv2d(&weight, kernel / 2, stride, 1, 1).unwrap();
        assert!(difference(&values(&ours), &values(&theirs)) < 1e-4, "{case}");
        assert_derivative(&case, &[&x, &weight], |t| conv2d(&t[0], &t[1], stride).unwrap());
    }
}

#[test]
fn only_tracked_inputs_of_a_convolution_get_a_gradient() {
    let (x, weight) = (input("x", &[2, 3, 5, 5], -1.0, 1.0), input("w", &[4, 3, 3, 3], -1.0, 1.0));
    let image_only = conv2d(&x, &weight.detach(), 1).unwrap().backward().unwrap();
    assert!(image_only.get(&x).is_some() && image_only.get(&weight).is_none());
    let weights_only = conv2d(&x.detach(), &weight, 1).unwrap().backward().unwrap();
    assert!(weights_only.get(&x).is_none() && weights_only.get(&weight).is_some());
    // A view that is not contiguous, and weights that are computed from a variable.
    let turned = x.transpose(2, 3).unwrap();
    let scaled = (weight.as_tensor() * 2.0).unwrap();
    let gradients = conv2d(&turned, &scaled, 1).unwrap().backward().unwrap();
    let straight = conv2d(&turned.contiguous().unwrap(), &weight, 1).unwrap().backward().unwrap();
    let (double, single) = (values(gradients.get(&weight).unwrap()), values(straight.get(&weight).unwrap()));
    let expected: Vec<f32> = single.iter().map(|g| 2.0 * g).collect();
    assert!(difference(&double, &expected) < 1e-4);
}

#[test]
fn batch_norms_and_their_gradients_equal_pytorch() {
    for mode in ["batch", "running"] {
        for with_residual in [false, true] {
            for (activation, label) in [(Activation::None, "none"), (Activation::Elu, "elu")] {
                let case = format!("bn.{mode}.{}.{label}", if with_residual { "residual" } else { "plain" });
                let shape = [3, 5, 7, 6];
                let made =
                    |key: &str, shape: &[usize], low, high| input(&format!("{case}.{key}"), shape, low, high);
                let x = made("x", &shape, -1.0, 3.0);
                let (weight, bias) = (made("weight", &[5], -1.0, 1.0), made("bias", &[5], -1.0, 1.0));
                let residual = with_residual.then(|| made("residual", &shape, -1.0, 1.0));
                let run = |t: &[Tensor]| {
                    let affine = ScaleShift { weight: &t[1], bias: &t[2] };
                    if mode == "batch" {
                        let (y, moments) = batch_norm(&t[0], affine, t.get(3), activation).unwrap();
                        return (y, Some(moments));
                    }
                    let (mean, var) = (made("mean", &[5], -1.0, 1.0), made("var", &[5], 0.3, 1.0));
                    (batch_norm_running(&t[0], affine, &mean, &var, t.get(3), activation).unwrap(), None)
                };
                let mut inputs = vec![&x, &weight, &bias];
                inputs.extend(&residual);
                let (y, moments) = run(&inputs.iter().map(|v| v.as_tensor().clone()).collect::<Vec<_>>());
                let gradients = backward(&case, &y);
                let names = ["dx", "dweight", "dbias", "dresidual"];
                let mut tensors = vec![("y", &y)];
                tensors.extend(names.into_iter().zip(inputs.iter().map(|v| gradients.get(v).unwrap())));
                assert_tensors(&case, &tensors);
                assert_eq!(moments.is_some(), mode == "batch");
                if let Some(moments) = moments {
                    let golden = Golden::open("ops");
                    let var = moments.unbiased_variance();
                    golden.assert_samples(&format!("{case}.mean"), &moments.mean, SAMPLES, TOLERANCE);
                    golden.assert_samples(&format!("{case}.var"), &var, SAMPLES, TOLERANCE);
                }
                assert_derivative(&case, &inputs, |t| run(t).0);
            }
        }
    }
}

#[test]
fn max_pools_of_negative_maps_and_their_gradients_equal_pytorch() {
    for (height, width) in [(7, 10), (8, 8), (1, 2), (9, 3)] {
        let case = format!("pool.{height}x{width}");
        let x = input(&format!("{case}.x"), &[2, 3, height, width], -2.0, -0.5);
        let y = max_pool_3x3_stride_2(&x).unwrap();
        let gradients = backward(&case, &y);
        assert_tensors(&case, &[("y", &y), ("dx", gradients.get(&x).unwrap())]);
    }
}

struct Case {
    adam: Adam,
    vars: BTreeMap<&'static str, Var>,
}

impl Case {
    fn new() -> Self {
        let shapes: [(&str, &[usize], f64); 3] = [("a", &[7], 1.0), ("b", &[4, 3], 0.5), ("c", &[2], 2.0)];
        let vars: BTreeMap<_, _> = shapes
            .iter()
            .map(|(name, shape, _)| (*name, input(&format!("adam.{name}"), shape, -1.0, 1.0)))
            .collect();
        let param = |(name, _, lr_multiplier): &(&'static str, _, f64)| {
            (name.to_string(), AdamParam { var: vars[name].clone(), lr_multiplier: *lr_multiplier })
        };
        let params = shapes.iter().map(param).collect();
        Self { adam: Adam::new(params, AdamOptions::default()).unwrap(), vars }
    }

    /// Step number `step` of the golden file.
    fn step(&mut self, step: usize) -> StepReport {
        let size = if step < 2 { 0.1 } else { 10.0 };
        let mut gradients = GradStore::default();
        for (name, var) in self.vars.iter().filter(|(name, _)| **name != "c" || step > 0) {
            gradients.insert(var, input(&format!("adam.{name}.{step}"), var.dims(), -size, size).detach());
        }
        self.adam.step(&gradients, 0.1 / (1.0 + step as f64), Some(1.0)).unwrap()
    }

    fn values(&self) -> Vec<Vec<f32>> {
        self.vars.values().map(|var| values(var)).collect()
    }
}

#[test]
fn adam_moves_as_pytorchs_with_clipping_and_a_parameter_that_is_skipped() {
    let golden = Golden::open("ops");
    let norms = golden.f64s("adam.norms");
    let mut case = Case::new();
    for (step, norm) in norms.iter().enumerate() {
        let report = case.step(step);
        assert!(
            report.applied && (report.grad_norm - norm).abs() < 1e-6 * norm,
            "{report:?}, {norm} expected"
        );
        for (name, var) in &case.vars {
            golden.assert_close(&format!("adam.{step}.{name}"), var, 1e-6);
        }
    }
    assert_eq!((norms.len(), case.adam.steps()), (6, 6));
}

#[test]
fn a_restored_adam_goes_on_to_the_bit() {
    let mut straight = Case::new();
    for step in 0..6 {
        straight.step(step);
    }
    let mut first = Case::new();
    for step in 0..3 {
        first.step(step);
    }
    let state = first.adam.state();
    let mut second = Case::new();
    for (name, var) in &second.vars {
        var.set(&first.vars[name].copy().unwrap()).unwrap();
    }
    second.adam.restore(state.clone()).unwrap();
    assert_eq!(second.adam.state(), state);
    for step in 3..6 {
        second.step(step);
    }
    assert_eq!(second.values(), straight.values());
    assert_eq!(second.adam.state(), straight.adam.state());
}

#[test]
fn gradients_that_are_not_finite_change_nothing() {
    let mut case = Case::new();
    case.step(0);
    let (before, state) = (case.values(), case.adam.state());
    for bad in [f32::NAN, f32::INFINITY] {
        let mut gradients = GradStore::default();
        gradients.insert(&case.vars["c"], Tensor::new(&[1.0, bad], &Device::Cpu).unwrap());
        let report = case.adam.step(&gradients, 0.1, Some(1.0)).unwrap();
        assert!(!report.applied && !report.grad_norm.is_finite());
        assert_eq!((case.values(), case.adam.state()), (before.clone(), state.clone()));
    }
}

#[test]
fn moments_of_other_parameters_are_refused() {
    let mut case = Case::new();
    case.step(0);
    let state = case.adam.state();
    let mut renamed = state.clone();
    let moments = renamed.moments.remove("c").unwrap();
    renamed.moments.insert("d".into(), moments);
    assert!(matches!(case.adam.restore(renamed), Err(AdamError::Names { name, .. }) if name == "d"));
    let mut fewer = state.clone();
    fewer.moments.remove("b");
    assert!(matches!(case.adam.restore(fewer), Err(AdamError::Names { name, .. }) if name == "b"));
    let mut shorter = state.clone();
    shorter.moments.get_mut("a").unwrap().second.pop();
    assert!(matches!(case.adam.restore(shorter), Err(AdamError::Size { second: 6, expected: 7, .. })));
    assert_eq!(case.adam.state(), state, "a refused state changes nothing");
}
