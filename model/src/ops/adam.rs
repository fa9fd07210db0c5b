//! Adam (Kingma & Ba, "Adam: A Method for Stochastic Optimization", algorithm 1, with PyTorch's place of epsilon) in one
//! pass over memory, with moments that can be saved and restored to the bit:
//!
//! ```text
//! m = beta1 m + (1 - beta1) g          w = w - lr / (1 - beta1^t) m / (sqrt(v / (1 - beta2^t)) + eps)
//! v = beta2 v + (1 - beta2) g^2
//! ```
//!
//! That is the CPU's; on other devices the moments lie there, and the norm is summed in f32.

use std::cell::RefCell;
use std::collections::BTreeMap;

use candle_core::backprop::GradStore;
use candle_core::{CpuStorage, DType, Device, InplaceOp2, Layout, Result, Tensor, Var, bail};
use rayon::prelude::*;

use super::Operators;
use super::portable::FlatMoments;
use super::values::{slice, with_values};

/// Numbers of one task.
const CHUNK: usize = 1 << 14;

/// Constants of Adam.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AdamOptions {
    /// Decay of the first moment.
    pub beta1: f64,
    /// Decay of the second moment.
    pub beta2: f64,
    /// Added to the root of the second moment.
    pub eps: f64,
}

impl Default for AdamOptions {
    /// The paper's and PyTorch's: 0.9, 0.999, 1e-8.
    fn default() -> Self {
        Self { beta1: 0.9, beta2: 0.999, eps: 1e-8 }
    }
}

/// A variable to be trained.
#[derive(Debug, Clone)]
pub struct AdamParam {
    /// The variable, f32 and contiguous.
    pub var: Var,
    /// Multiplies the learning rate of this variable.
    pub lr_multiplier: f64,
}

/// Both moments of one parameter, in the order of its elements.
#[derive(Debug, Clone, PartialEq)]
pub struct AdamMoments {
    /// Running mean of the gradient.
    pub first: Vec<f32>,
    /// Running mean of the squared gradient.
    pub second: Vec<f32>,
    /// Updates that this parameter had.
    pub steps: u64,
}

/// All that Adam remembers: put back, it goes on as if it had never stopped.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct AdamState {
    /// By name of the parameter.
    pub moments: BTreeMap<String, AdamMoments>,
    /// Updates applied.
    pub steps: u64,
}

/// What a step did.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StepReport {
    /// Euclidean norm of all gradients before clipping.
    pub grad_norm: f64,
    /// Whether the parameters moved; they do not when the norm is not finite.
    pub applied: bool,
}

/// Moments that do not belong to these parameters.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum AdamError {
    /// A parameter without moments, or moments without a parameter.
    #[error(
        "cannot restore Adam's moments: `{name}` is {found}; the saved state is of another set of parameters"
    )]
    Names {
        /// The parameter.
        name: String,
        /// Where it is missing.
        found: &'static str,
    },
    /// Moments of another size.
    #[error(
        "cannot restore Adam's moments of `{name}`: {first} and {second} numbers for a parameter of {expected}"
    )]
    Size {
        /// The parameter.
        name: String,
        /// Numbers in the first moment.
        first: usize,
        /// Numbers in the second moment.
        second: usize,
        /// Numbers of the parameter.
        expected: usize,
    },
    /// The moments could not be copied to the device.
    #[error("cannot restore Adam's moments: {reason}")]
    Device {
        /// What candle says.
        reason: String,
    },
}

/// Adam over named variables of one device.
#[derive(Debug)]
pub struct Adam {
    moments: Moments,
    options: AdamOptions,
    steps: u64,
}

#[derive(Debug)]
enum Moments {
    Cpu(BTreeMap<String, (AdamParam, AdamMoments)>),
    Portable(FlatMoments),
}

impl Adam {
    /// Moments of zero for every parameter.
    ///
    /// # Errors
    /// When a variable is not f32, not contiguous or not where the others are.
    pub fn new(params: BTreeMap<String, AdamParam>, options: AdamOptions) -> Result<Self> {
        let device = params.values().next().map_or(Device::Cpu, |param| param.var.device().clone());
        Self::with_operators(params, options, Operators::for_device(&device))
    }

    /// As [`Adam::new`] with the arithmetic of these operators.
    ///
    /// # Errors
    /// As [`Adam::new`]; also for [`Operators::Cpu`] elsewhere.
    pub fn with_operators(
        params: BTreeMap<String, AdamParam>,
        options: AdamOptions,
        operators: Operators,
    ) -> Result<Self> {
        let device = match (operators, params.values().next()) {
            (Operators::Portable, Some(param)) => param.var.device().clone(),
            _ => Device::Cpu,
        };
        for (name, AdamParam { var, .. }) in &params {
            let tensor = var.as_tensor();
            if !tensor.device().same_device(&device)
                || tensor.dtype() != DType::F32
                || !tensor.is_contiguous()
            {
                bail!("Adam trains contiguous f32 variables on {device:?}; `{name}` is {tensor:?}")
            }
        }
        let moments = match operators {
            Operators::Cpu => {
                let with_moments = |(name, param): (String, AdamParam)| {
                    let zeros = vec![0.0; param.var.elem_count()];
                    let moments = AdamMoments { first: zeros.clone(), second: zeros, steps: 0 };
                    (name, (param, moments))
                };
                Moments::Cpu(params.into_iter().map(with_moments).collect())
            }
            Operators::Portable => Moments::Portable(FlatMoments::new(params, &device)?),
        };
        Ok(Self { moments, options, steps: 0 })
    }

    /// One update with learning rate `lr`. Gradients whose joint norm exceeds `max_norm` are scaled down to it.
    ///
    /// A parameter without a gradient stays as it is, and so do its moments. A norm that is not finite is reported
    /// and nothing is applied.
    ///
    /// # Errors
    /// When a gradient has another shape than its parameter.
    pub fn step(&mut self, grads: &GradStore, lr: f64, max_norm: Option<f64>) -> Result<StepReport> {
        let options = self.options;
        let report = match &mut self.moments {
            Moments::Cpu(params) => step_on_cpu(params, &options, grads, lr, max_norm)?,
            Moments::Portable(moments) => moments.step(&options, grads, lr, max_norm)?,
        };
        self.steps += u64::from(report.applied);
        Ok(report)
    }

    /// Updates applied so far.
    pub fn steps(&self) -> u64 {
        self.steps
    }

    /// A copy of everything that [`Adam::restore`] needs.
    ///
    /// # Errors
    /// When the moments cannot be copied from their device.
    pub fn state(&self) -> Result<AdamState> {
        let moments = match &self.moments {
            Moments::Cpu(params) => {
                params.iter().map(|(name, (_, moments))| (name.clone(), moments.clone())).collect()
            }
            Moments::Portable(moments) => moments.state()?,
        };
        Ok(AdamState { moments, steps: self.steps })
    }

    /// Names of the parameters with the number of their elements.
    pub fn lengths(&self) -> BTreeMap<String, usize> {
        match &self.moments {
            Moments::Cpu(params) => {
                params.iter().map(|(name, (_, moments))| (name.clone(), moments.first.len())).collect()
            }
            Moments::Portable(moments) => {
                moments.lengths().map(|(name, length)| (name.clone(), length)).collect()
            }
        }
    }

    /// Puts a saved state back, to the bit.
    ///
    /// # Errors
    /// When the state is of other parameters; nothing is changed then.
    pub fn restore(&mut self, state: AdamState) -> std::result::Result<(), AdamError> {
        let missing = |name: &String, found| AdamError::Names { name: name.clone(), found };
        let lengths = self.lengths();
        if let Some(name) = state.moments.keys().find(|name| !lengths.contains_key(*name)) {
            return Err(missing(name, "not trained here"));
        }
        for (name, expected) in &lengths {
            let Some(saved) = state.moments.get(name) else {
                return Err(missing(name, "not in the saved state"));
            };
            let (first, second, expected) = (saved.first.len(), saved.second.len(), *expected);
            if first != expected || second != expected {
                return Err(AdamError::Size { name: name.clone(), first, second, expected });
            }
        }
        match &mut self.moments {
            Moments::Cpu(params) => {
                for (name, moments) in state.moments {
                    if let Some((_, own)) = params.get_mut(&name) {
                        *own = moments;
                    }
                }
            }
            Moments::Portable(moments) => moments
                .restore(&state.moments)
                .map_err(|error| AdamError::Device { reason: error.to_string() })?,
        }
        self.steps = state.steps;
        Ok(())
    }
}

fn step_on_cpu(
    params: &mut BTreeMap<String, (AdamParam, AdamMoments)>,
    options: &AdamOptions,
    grads: &GradStore,
    lr: f64,
    max_norm: Option<f64>,
) -> Result<StepReport> {
    let mut updates = Vec::with_capacity(params.len());
    for (name, (param, moments)) in params {
        let Some(gradient) = grads.get(&param.var) else { continue };
        if gradient.dims() != param.var.dims() {
            bail!("the gradient of `{name}` is {:?}, the parameter {:?}", gradient.dims(), param.var.dims());
        }
        updates.push((&*param, moments, gradient.contiguous()?));
    }
    let squares = updates.par_iter().map(|(_, _, gradient)| sum_of_squares(gradient));
    // Collected first: a parallel sum would add in any order.
    let grad_norm = squares.collect::<Result<Vec<f64>>>()?.iter().sum::<f64>().sqrt();
    if !grad_norm.is_finite() {
        return Ok(StepReport { grad_norm, applied: false });
    }
    let scale = match max_norm {
        // PyTorch's clip_grad_norm_ adds this to the norm as well.
        Some(max_norm) => (max_norm / (grad_norm + 1e-6)).min(1.0),
        None => 1.0,
    };
    updates.into_par_iter().try_for_each(|(param, moments, gradient)| {
        moments.steps += 1;
        let t = moments.steps as f64;
        let update = Update {
            beta1: options.beta1 as f32,
            beta2: options.beta2 as f32,
            one_minus_beta1: (1.0 - options.beta1) as f32,
            one_minus_beta2: (1.0 - options.beta2) as f32,
            step: (lr * param.lr_multiplier / (1.0 - options.beta1.powf(t))) as f32,
            inverse_root: (1.0 - options.beta2.powf(t)).sqrt().recip() as f32,
            eps: options.eps as f32,
            scale: scale as f32,
        };
        param.var.inplace_op2(&gradient, &InPlace { update, moments: RefCell::new(moments) })
    })?;
    Ok(StepReport { grad_norm, applied: true })
}

/// In double precision and in order.
fn sum_of_squares(gradient: &Tensor) -> Result<f64> {
    with_values([gradient], |[gradient]| {
        let chunks = gradient.par_chunks(CHUNK).map(|chunk| {
            pulp::Arch::new().dispatch(|| {
                let (groups, rest) = chunk.as_chunks::<8>();
                let mut lanes = [0.0_f64; 8];
                for group in groups {
                    for (lane, value) in lanes.iter_mut().zip(group) {
                        *lane += f64::from(*value) * f64::from(*value);
                    }
                }
                lanes.iter().sum::<f64>() + rest.iter().map(|v| f64::from(*v) * f64::from(*v)).sum::<f64>()
            })
        });
        chunks.collect::<Vec<f64>>().iter().sum()
    })
}

/// The numbers of one update.
#[derive(Clone, Copy)]
struct Update {
    beta1: f32,
    beta2: f32,
    one_minus_beta1: f32,
    one_minus_beta2: f32,
    /// lr / (1 - beta1^t).
    step: f32,
    /// 1 / sqrt(1 - beta2^t).
    inverse_root: f32,
    eps: f32,
    /// Clipping: multiplies the gradient.
    scale: f32,
}

impl Update {
    #[inline(always)]
    fn apply(&self, weights: &mut [f32], gradient: &[f32], first: &mut [f32], second: &mut [f32]) {
        let moments = first.iter_mut().zip(second);
        for ((w, g), (m, v)) in weights.iter_mut().zip(gradient).zip(moments) {
            let g = g * self.scale;
            *m = self.beta1 * *m + self.one_minus_beta1 * g;
            *v = self.beta2 * *v + self.one_minus_beta2 * g * g;
            *w -= self.step * *m / (v.sqrt() * self.inverse_root + self.eps);
        }
    }
}

struct InPlace<'a> {
    update: Update,
    moments: RefCell<&'a mut AdamMoments>,
}

impl InplaceOp2 for InPlace<'_> {
    fn name(&self) -> &'static str {
        "adam"
    }

    fn cpu_fwd(
        &self,
        weights: &mut CpuStorage,
        weights_layout: &Layout,
        gradient: &CpuStorage,
        gradient_layout: &Layout,
    ) -> Result<()> {
        let (CpuStorage::F32(weights), Some((start, end))) = (weights, weights_layout.contiguous_offsets())
        else {
            bail!("Adam trains contiguous f32 variables: {weights_layout:?}")
        };
        let update = self.update;
        let mut moments = self.moments.borrow_mut();
        let moments = &mut **moments;
        let weights = weights[start..end].par_chunks_mut(CHUNK);
        let gradient = slice(gradient, gradient_layout)?.par_chunks(CHUNK);
        let first = moments.first.par_chunks_mut(CHUNK);
        let second = moments.second.par_chunks_mut(CHUNK);
        weights.zip(gradient).zip(first.zip(second)).for_each(|((weights, gradient), (first, second))| {
            pulp::Arch::new().dispatch(|| update.apply(weights, gradient, first, second));
        });
        Ok(())
    }
}
