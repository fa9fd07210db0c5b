//! The training operators against PyTorch's gradients (`golden/generate_ops.py`) and against central differences: those of
//! the CPU, the portable ones there, and with feature `cuda` the portable ones on a GPU.

mod common;

use std::collections::BTreeMap;

use candle_core::{Tensor, Var, backprop::GradStore};
use common::golden::Golden;
use common::{Place, difference, places, uniform, values};
use grnet_model::candle_core;
use grnet_model::ops::{
    Activation, Adam, AdamError, AdamOptions, AdamParam, AdamState, ChannelMoments, ScaleShift, StepReport,
};

const SAMPLES: usize = 64;
/// Allowed difference relative to the root mean square.
const TOLERANCE: f64 = 1e-5;

fn input(name: &str, shape: &[usize], low: f64, high: f64) -> Var {
    Place::default().input(name, shape, low, high)
}

impl Place {
    fn input(&self, name: &str, shape: &[usize], low: f64, high: f64) -> Var {
        let values = uniform(name, shape.iter().product(), low, high);
        Var::from_tensor(&Tensor::from_vec(values, shape, &self.device).unwrap()).unwrap()
    }

    /// An operator of maps, (N, C, H, W) on both sides.
    fn maps(&self, x: &Tensor, run: impl FnOnce(&Tensor) -> Tensor) -> Tensor {
        self.operators.leave(&run(&self.operators.enter(x).unwrap())).unwrap()
    }

    fn conv2d(&self, x: &Tensor, weight: &Tensor, stride: usize) -> Tensor {
        self.maps(x, |x| self.operators.conv2d(x, weight, stride).unwrap())
    }

    /// With given moments, or those of the batch.
    fn batch_norm(
        &self,
        t: &[Tensor],
        running: Option<(&Tensor, &Tensor)>,
        activation: Activation,
    ) -> (Tensor, Option<ChannelMoments>) {
        let affine = ScaleShift { weight: &t[1], bias: &t[2] };
        let residual = t.get(3).map(|residual| self.operators.enter(residual).unwrap());
        let x = self.operators.enter(&t[0]).unwrap();
        let (y, moments) = match running {
            None => {
                let found = self.operators.batch_norm(&x, affine, residual.as_ref(), activation);
                let (y, moments) = found.unwrap();
                (y, Some(moments))
            }
            Some(given) => {
                let found =
                    self.operators.batch_norm_running(&x, affine, given, residual.as_ref(), activation);
                (found.unwrap(), None)
            }
        };
        (self.operators.leave(&y).unwrap(), moments)
    }
}

/// The gradients of the sum of y times the case's upstream gradient.
fn backward(case: &str, y: &Tensor) -> GradStore {
    let upstream = input(&format!("{case}.upstream"), y.dims(), -1.0, 1.0).to_device(y.device()).unwrap();
    (y * upstream.detach()).unwrap().sum_all().unwrap().backward().unwrap()
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
    let direction = |i: usize| {
        let direction = input(&format!("{case}.direction.{i}"), tensors[i].dims(), -1.0, 1.0).detach();
        direction.to_device(tensors[i].device()).unwrap()
    };
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

fn convolutions_equal_pytorch(place: &Place) {
    for kernel in [1, 3, 7] {
        for stride in [1, 2] {
            for (height, width) in [(15, 20), (7, 7), (5, 4)] {
                let case = format!("conv.{kernel}.{stride}.{height}x{width}");
                let x = place.input(&format!("{case}.x"), &[3, 4, height, width], -1.0, 1.0);
                let weight = place.input(&format!("{case}.weight"), &[6, 4, kernel, kernel], -1.0, 1.0);
                let y = place.conv2d(&x, &weight, stride);
                let gradients = backward(&case, &y);
                let (dx, dweight) = (gradients.get(&x).unwrap(), gradients.get(&weight).unwrap());
                assert_tensors(&case, &[("y", &y), ("dx", dx), ("dweight", dweight)]);
                assert_derivative(&case, &[&x, &weight], |t| place.conv2d(&t[0], &t[1], stride));
            }
        }
    }
}

#[test]
fn convolutions_and_their_gradients_equal_pytorch() {
    places().iter().for_each(convolutions_equal_pytorch);
}

/// Enough channels and images that every piece of the work occurs: several products, cut channels, cut taps.
fn large_convolutions(place: &Place) {
    for (n, inputs, outputs, side, kernel, stride) in [
        (1, 96, 80, 6, 3, 1),
        (40, 24, 72, 5, 3, 1),
        (3, 96, 80, 9, 3, 2),
        (40, 200, 8, 4, 1, 1),
        (9, 70, 6, 20, 1, 2),
    ] {
        let case = format!("large.{n}.{inputs}.{outputs}.{side}.{kernel}.{stride}");
        let x = place.input(&format!("{case}.x"), &[n, inputs, side, side], -0.1, 0.1);
        let weight = place.input(&format!("{case}.weight"), &[outputs, inputs, kernel, kernel], -0.1, 0.1);
        let ours = place.conv2d(&x, &weight, stride);
        let theirs = x.conv2d(&weight, kernel / 2, stride, 1, 1).unwrap();
        assert!(difference(&values(&ours), &values(&theirs)) < 1e-4, "{case}");
        assert_derivative(&case, &[&x, &weight], |t| place.conv2d(&t[0], &t[1], stride));
    }
}

#[test]
fn large_convolutions_have_the_derivatives_of_central_differences() {
    places().iter().for_each(large_convolutions);
}

#[test]
fn only_tracked_inputs_of_a_convolution_get_a_gradient() {
    for place in places() {
        only_tracked(&place);
    }
}

fn only_tracked(place: &Place) {
    let conv2d = |x: &Tensor, weight: &Tensor| place.conv2d(x, weight, 1);
    let (x, weight) =
        (place.input("x", &[2, 3, 5, 5], -1.0, 1.0), place.input("w", &[4, 3, 3, 3], -1.0, 1.0));
    let image_only = conv2d(&x, &weight.detach()).backward().unwrap();
    assert!(image_only.get(&x).is_some() && image_only.get(&weight).is_none());
    let weights_only = conv2d(&x.detach(), &weight).backward().unwrap();
    assert!(weights_only.get(&x).is_none() && weights_only.get(&weight).is_some());
    // A view that is not contiguous, and weights that are computed from a variable.
    let turned = x.transpose(2, 3).unwrap();
    let scaled = (weight.as_tensor() * 2.0).unwrap();
    let gradients = conv2d(&turned, &scaled).backward().unwrap();
    let straight = conv2d(&turned.contiguous().unwrap(), &weight).backward().unwrap();
    let (double, single) = (values(gradients.get(&weight).unwrap()), values(straight.get(&weight).unwrap()));
    let expected: Vec<f32> = single.iter().map(|g| 2.0 * g).collect();
    assert!(difference(&double, &expected) < 1e-4);
}

fn batch_norms_equal_pytorch(place: &Place) {
    for mode in ["batch", "running"] {
        for with_residual in [false, true] {
            for (activation, label) in [(Activation::None, "none"), (Activation::Elu, "elu")] {
                let case = format!("bn.{mode}.{}.{label}", if with_residual { "residual" } else { "plain" });
                let shape = [3, 5, 7, 6];
                let made = |key: &str, shape: &[usize], low, high| {
                    place.input(&format!("{case}.{key}"), shape, low, high)
                };
                let x = made("x", &shape, -1.0, 3.0);
                let (weight, bias) = (made("weight", &[5], -1.0, 1.0), made("bias", &[5], -1.0, 1.0));
                let residual = with_residual.then(|| made("residual", &shape, -1.0, 1.0));
                let (mean, var) = (made("mean", &[5], -1.0, 1.0), made("var", &[5], 0.3, 1.0));
                let running: Option<(&Tensor, &Tensor)> = (mode == "running").then_some((&mean, &var));
                let run = |t: &[Tensor]| place.batch_norm(t, running, activation);
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
                    let (mean, var) = (values(&moments.mean), values(&moments.unbiased_variance().unwrap()));
                    golden.assert_samples(&format!("{case}.mean"), &mean, SAMPLES, TOLERANCE);
                    golden.assert_samples(&format!("{case}.var"), &var, SAMPLES, TOLERANCE);
                }
                assert_derivative(&case, &inputs, |t| run(t).0);
            }
        }
    }
}

#[test]
fn batch_norms_and_their_gradients_equal_pytorch() {
    places().iter().for_each(batch_norms_equal_pytorch);
}

fn max_pools_equal_pytorch(place: &Place) {
    for (height, width) in [(7, 10), (8, 8), (1, 2), (9, 3)] {
        let case = format!("pool.{height}x{width}");
        let x = place.input(&format!("{case}.x"), &[2, 3, height, width], -2.0, -0.5);
        let y = place.maps(&x, |x| place.operators.max_pool_3x3_stride_2(x).unwrap());
        let gradients = backward(&case, &y);
        assert_tensors(&case, &[("y", &y), ("dx", gradients.get(&x).unwrap())]);
    }
}

#[test]
fn max_pools_of_negative_maps_and_their_gradients_equal_pytorch() {
    places().iter().for_each(max_pools_equal_pytorch);
}

#[test]
fn the_first_of_equal_maxima_gets_the_gradient() {
    for place in places() {
        let x = Var::zeros((1, 1, 3, 3), candle_core::DType::F32, &place.device).unwrap();
        let y = place.maps(&x, |x| place.operators.max_pool_3x3_stride_2(x).unwrap());
        let gradient = y.backward().unwrap().remove(&x).unwrap();
        assert_eq!(values(&gradient), [1.0, 1.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0]);
    }
}

struct Case {
    place: Place,
    adam: Adam,
    vars: BTreeMap<&'static str, Var>,
}

impl Case {
    fn new(place: &Place) -> Self {
        let shapes: [(&str, &[usize], f64); 3] = [("a", &[7], 1.0), ("b", &[4, 3], 0.5), ("c", &[2], 2.0)];
        let vars: BTreeMap<_, _> = shapes
            .iter()
            .map(|(name, shape, _)| (*name, place.input(&format!("adam.{name}"), shape, -1.0, 1.0)))
            .collect();
        let param = |(name, _, lr_multiplier): &(&'static str, _, f64)| {
            (name.to_string(), AdamParam { var: vars[name].clone(), lr_multiplier: *lr_multiplier })
        };
        let params = shapes.iter().map(param).collect();
        let adam = Adam::with_operators(params, AdamOptions::default(), place.operators).unwrap();
        Self { place: place.clone(), adam, vars }
    }

    /// Step number `step` of the golden file.
    fn step(&mut self, step: usize) -> StepReport {
        let size = if step < 2 { 0.1 } else { 10.0 };
        let mut gradients = GradStore::default();
        for (name, var) in self.vars.iter().filter(|(name, _)| **name != "c" || step > 0) {
            let gradient = self.place.input(&format!("adam.{name}.{step}"), var.dims(), -size, size);
            gradients.insert(var, gradient.detach());
        }
        self.adam.step(&gradients, 0.1 / (1.0 + step as f64), Some(1.0)).unwrap()
    }

    fn state(&self) -> AdamState {
        self.adam.state().unwrap()
    }

    fn values(&self) -> Vec<Vec<f32>> {
        self.vars.values().map(|var| values(var)).collect()
    }
}

fn adam_equals_pytorch(place: &Place) {
    let golden = Golden::open("ops");
    let norms = golden.f64s("adam.norms");
    let mut case = Case::new(place);
    for (step, norm) in norms.iter().enumerate() {
        let report = case.step(step);
        assert!(
            report.applied && (report.grad_norm - norm).abs() < 2e-6 * norm,
            "{report:?}, {norm} expected"
        );
        for (name, var) in &case.vars {
            golden.assert_close(&format!("adam.{step}.{name}"), var, 1e-6);
        }
    }
    assert_eq!((norms.len(), case.adam.steps()), (6, 6));
}

#[test]
fn adam_moves_as_pytorchs_with_clipping_and_a_parameter_that_is_skipped() {
    places().iter().for_each(adam_equals_pytorch);
}

fn restored_adam(place: &Place) {
    let mut straight = Case::new(place);
    for step in 0..6 {
        straight.step(step);
    }
    let mut first = Case::new(place);
    for step in 0..3 {
        first.step(step);
    }
    let state = first.state();
    let mut second = Case::new(place);
    for (name, var) in &second.vars {
        var.set(&first.vars[name].copy().unwrap()).unwrap();
    }
    second.adam.restore(state.clone()).unwrap();
    assert_eq!(second.state(), state);
    for step in 3..6 {
        second.step(step);
    }
    assert_eq!(second.values(), straight.values());
    assert_eq!(second.state(), straight.state());
}

#[test]
fn a_restored_adam_goes_on_to_the_bit() {
    places().iter().for_each(restored_adam);
}

fn gradients_that_are_not_finite(place: &Place) {
    let mut case = Case::new(place);
    case.step(0);
    let (before, state) = (case.values(), case.state());
    for bad in [f32::NAN, f32::INFINITY] {
        let mut gradients = GradStore::default();
        gradients.insert(&case.vars["c"], Tensor::new(&[1.0, bad], &place.device).unwrap());
        let report = case.adam.step(&gradients, 0.1, Some(1.0)).unwrap();
        assert!(!report.applied && !report.grad_norm.is_finite());
        assert_eq!((case.values(), case.state()), (before.clone(), state.clone()));
    }
}

#[test]
fn gradients_that_are_not_finite_change_nothing() {
    places().iter().for_each(gradients_that_are_not_finite);
}

#[test]
fn moments_of_other_parameters_are_refused() {
    for place in places() {
        moments_of_others(&place);
    }
}

fn moments_of_others(place: &Place) {
    let mut case = Case::new(place);
    case.step(0);
    let state = case.state();
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
    assert_eq!(case.state(), state, "a refused state changes nothing");
}

#[cfg(feature = "cuda")]
mod on_a_gpu {
    use super::*;

    #[test]
    #[ignore = "needs an NVIDIA GPU"]
    fn the_operators_equal_pytorch() {
        let gpu = Place::gpu();
        convolutions_equal_pytorch(&gpu);
        large_convolutions(&gpu);
        only_tracked(&gpu);
        batch_norms_equal_pytorch(&gpu);
        max_pools_equal_pytorch(&gpu);
    }

    #[test]
    #[ignore = "needs an NVIDIA GPU"]
    fn adam_equals_pytorchs_and_comes_back() {
        let gpu = Place::gpu();
        adam_equals_pytorch(&gpu);
        restored_adam(&gpu);
        gradients_that_are_not_finite(&gpu);
        moments_of_others(&gpu);
    }
}
