//! Adam's moments on a device, laid flat: many parameters in few operations.

use std::collections::BTreeMap;

use candle_core::backprop::GradStore;
use candle_core::{DType, Device, Result, Tensor, bail};

use crate::ops::{AdamMoments, AdamOptions, AdamParam, StepReport};

/// Numbers that one sum takes: a GPU computes each sum on one of its cores.
const CHUNK: usize = 4096;

/// Parameters with both moments of each.
#[derive(Debug)]
pub(in crate::ops) struct FlatMoments {
    params: BTreeMap<String, AdamParam>,
    device: Device,
    groups: Vec<Group>,
}

/// Parameters of one rate that had the same updates, their moments one behind the other.
#[derive(Debug)]
struct Group {
    names: Vec<String>,
    lr_multiplier: f64,
    first: Tensor,
    second: Tensor,
    steps: u64,
}

impl FlatMoments {
    /// Moments of zero.
    pub(in crate::ops) fn new(params: BTreeMap<String, AdamParam>, device: &Device) -> Result<Self> {
        let mut moments = Self { params, device: device.clone(), groups: Vec::new() };
        let zeros = |param: &AdamParam| {
            let zeros = vec![0.0; param.var.elem_count()];
            AdamMoments { first: zeros.clone(), second: zeros, steps: 0 }
        };
        let all = moments.params.iter().map(|(name, param)| (name.clone(), zeros(param))).collect();
        moments.restore(&all)?;
        Ok(moments)
    }

    /// Names of the parameters with the number of their elements.
    pub(in crate::ops) fn lengths(&self) -> impl Iterator<Item = (&String, usize)> {
        self.params.iter().map(|(name, param)| (name, param.var.elem_count()))
    }

    /// A copy on the host.
    pub(in crate::ops) fn state(&self) -> Result<BTreeMap<String, AdamMoments>> {
        let mut state = BTreeMap::new();
        for group in &self.groups {
            let (first, second) = (group.first.to_vec1::<f32>()?, group.second.to_vec1::<f32>()?);
            let mut from = 0;
            for name in &group.names {
                let to = from + self.length(name);
                let (first, second) = (first[from..to].to_vec(), second[from..to].to_vec());
                state.insert(name.clone(), AdamMoments { first, second, steps: group.steps });
                from = to;
            }
        }
        Ok(state)
    }

    /// Takes over moments of exactly these parameters.
    pub(in crate::ops) fn restore(&mut self, state: &BTreeMap<String, AdamMoments>) -> Result<()> {
        let mut alike: BTreeMap<(u64, u64), Vec<&String>> = BTreeMap::new();
        for (name, param) in &self.params {
            let key = (param.lr_multiplier.to_bits(), state[name].steps);
            alike.entry(key).or_default().push(name);
        }
        let groups = alike.into_iter().map(|((multiplier, steps), names)| {
            let flat = |pick: fn(&AdamMoments) -> &Vec<f32>| {
                let values: Vec<f32> = names.iter().flat_map(|name| pick(&state[*name])).copied().collect();
                let length = values.len();
                Tensor::from_vec(values, length, &self.device)
            };
            Ok(Group {
                lr_multiplier: f64::from_bits(multiplier),
                first: flat(|moments| &moments.first)?,
                second: flat(|moments| &moments.second)?,
                names: names.into_iter().cloned().collect(),
                steps,
            })
        });
        self.groups = groups.collect::<Result<_>>()?;
        Ok(())
    }

    /// One update; the host waits for the device once, for the norm.
    pub(in crate::ops) fn step(
        &mut self,
        options: &AdamOptions,
        grads: &GradStore,
        lr: f64,
        max_norm: Option<f64>,
    ) -> Result<StepReport> {
        self.split_by(grads)?;
        let (mut flat, mut squares) = (Vec::new(), Vec::new());
        for group in &self.groups {
            let mut parts = Vec::with_capacity(group.names.len());
            for name in &group.names {
                let var = &self.params[name].var;
                let Some(gradient) = grads.get(var) else { continue };
                if gradient.dims() != var.dims() {
                    bail!(
                        "the gradient of `{name}` is {:?}, the parameter {:?}",
                        gradient.dims(),
                        var.dims()
                    );
                }
                parts.push(gradient.detach().contiguous()?.flatten_all()?);
            }
            if parts.is_empty() {
                flat.push(None);
                continue;
            }
            let gradient = Tensor::cat(&parts, 0)?;
            squares.push(sum_of_squares(&gradient)?);
            flat.push(Some(gradient));
        }
        let grad_norm = match squares.as_slice() {
            [] => 0.0,
            squares => {
                let squares = Tensor::stack(squares, 0)?.to_vec1::<f32>()?;
                squares.into_iter().map(f64::from).sum::<f64>().sqrt()
            }
        };
        if !grad_norm.is_finite() {
            return Ok(StepReport { grad_norm, applied: false });
        }
        let scale = max_norm.map_or(1.0, |max_norm| (max_norm / (grad_norm + 1e-6)).min(1.0));
        for (group, gradient) in self.groups.iter_mut().zip(flat) {
            let Some(gradient) = gradient else { continue };
            let change = group.update(options, &gradient, lr, scale)?;
            let mut from = 0;
            for name in &group.names {
                let var = &self.params[name].var;
                let length = var.elem_count();
                let change = change.narrow(0, from, length)?.reshape(var.shape())?;
                var.set(&(var.as_detached_tensor() - change)?)?;
                from += length;
            }
        }
        Ok(StepReport { grad_norm, applied: true })
    }

    /// Parts the groups of which some parameters have a gradient and some have none.
    fn split_by(&mut self, grads: &GradStore) -> Result<()> {
        let has = |name: &String| grads.get(&self.params[name].var).is_some();
        let mut groups = Vec::with_capacity(self.groups.len());
        for group in std::mem::take(&mut self.groups) {
            let with = group.names.iter().filter(|name| has(name)).count();
            if with == 0 || with == group.names.len() {
                groups.push(group);
                continue;
            }
            for wanted in [true, false] {
                let (mut names, mut first, mut second, mut from) = (vec![], vec![], vec![], 0);
                for name in &group.names {
                    let length = self.length(name);
                    if has(name) == wanted {
                        names.push(name.clone());
                        first.push(group.first.narrow(0, from, length)?);
                        second.push(group.second.narrow(0, from, length)?);
                    }
                    from += length;
                }
                let (first, second) = (Tensor::cat(&first, 0)?, Tensor::cat(&second, 0)?);
                groups.push(Group { names, first, second, ..group });
            }
        }
        self.groups = groups;
        Ok(())
    }

    fn length(&self, name: &String) -> usize {
        self.params[name].var.elem_count()
    }
}

impl Group {
    /// Moves the moments on; what the parameters have to be lowered by.
    fn update(&mut self, options: &AdamOptions, gradient: &Tensor, lr: f64, scale: f64) -> Result<Tensor> {
        let AdamOptions { beta1, beta2, eps } = *options;
        self.steps += 1;
        let t = self.steps as f64;
        let part = gradient.affine((1.0 - beta1) * scale, 0.0)?;
        self.first = (self.first.affine(beta1, 0.0)? + part)?;
        let part = gradient.sqr()?.affine((1.0 - beta2) * scale * scale, 0.0)?;
        self.second = (self.second.affine(beta2, 0.0)? + part)?;
        let inverse_root = (1.0 - beta2.powf(t)).sqrt().recip();
        let below = self.second.sqrt()?.affine(inverse_root, eps)?;
        let step = lr * self.lr_multiplier / (1.0 - beta1.powf(t));
        self.first.affine(step, 0.0)? / below
    }
}

/// Of a vector, as a scalar.
fn sum_of_squares(vector: &Tensor) -> Result<Tensor> {
    let squares = vector.sqr()?;
    let length = squares.dim(0)?;
    let (rows, rest) = (length / CHUNK, length % CHUNK);
    let mut sums = Vec::with_capacity(2);
    if rows > 0 {
        sums.push(squares.narrow(0, 0, rows * CHUNK)?.reshape((rows, CHUNK))?.sum(1)?);
    }
    if rest > 0 {
        sums.push(squares.narrow(0, rows * CHUNK, rest)?.sum_keepdim(0)?);
    }
    if sums.is_empty() {
        return Tensor::zeros((), DType::F32, vector.device());
    }
    Tensor::cat(&sums, 0)?.sum(0)
}
