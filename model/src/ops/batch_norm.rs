//! Batch norm with an optional residual and ELU in one operator, with its gradients; the arithmetic of the CPU is in
//! `batch_norm_cpu`.

use std::sync::{Arc, OnceLock};

use candle_core::{CpuStorage, CustomOp2, CustomOp3, Layout, Result, Shape, Tensor, bail};

use super::batch_norm_cpu::{Maps, backward, forward};
use super::values::{slice, tensor, with_values};
use crate::resnet::BATCH_NORM_EPS;

/// What stands behind the sum of the normalised input and the residual.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Activation {
    /// Nothing.
    None,
    /// ELU with alpha 1: y = x above 0, exp(x) - 1 below.
    Elu,
}

/// Learnt scale and shift of a batch norm, each of shape (C).
#[derive(Debug, Clone, Copy)]
pub struct ScaleShift<'a> {
    /// Scale.
    pub weight: &'a Tensor,
    /// Shift.
    pub bias: &'a Tensor,
}

/// Mean and variance of every channel, where the maps are.
#[derive(Debug, Clone)]
pub struct ChannelMoments {
    /// Mean, (C).
    pub mean: Tensor,
    /// Variance about the mean, divided by the number of values (biased), (C).
    pub variance: Tensor,
    /// Values per channel that it was computed from.
    pub count: usize,
}

impl ChannelMoments {
    /// The variance divided by the number of values less one, which PyTorch averages into its running variance.
    ///
    /// # Errors
    /// When memory runs out.
    pub fn unbiased_variance(&self) -> Result<Tensor> {
        let factor = self.count as f64 / (self.count as f64 - 1.0);
        if !self.variance.device().is_cpu() {
            return self.variance.affine(factor, 0.0);
        }
        let variance = self.variance.to_vec1::<f32>()?;
        let unbiased = variance.into_iter().map(|variance| (f64::from(variance) * factor) as f32).collect();
        tensor(unbiased, self.variance.dims())
    }
}

/// The numbers of [`ChannelMoments`].
#[derive(Debug, Clone)]
pub(super) struct Numbers {
    pub(super) mean: Vec<f32>,
    pub(super) variance: Vec<f32>,
}

/// y = activation(weight (x - mean) / sqrt(variance + eps) + bias + residual) with the moments of x itself over N, H
/// and W, and those moments. x and the residual are (N, C, H, W); the gradient of the moments is part of x's.
///
/// # Errors
/// When shapes do not fit, or there is only one value per channel.
pub fn batch_norm(
    x: &Tensor,
    affine: ScaleShift<'_>,
    residual: Option<&Tensor>,
    activation: Activation,
) -> Result<(Tensor, ChannelMoments)> {
    let maps = checked(x, affine, residual)?;
    if maps.images * maps.map < 2 {
        bail!(
            "batch norm of {:?} by its own statistics: one value per channel has no variance; use more images",
            x.dims()
        );
    }
    let computed = Arc::new(OnceLock::new());
    let moments = Moments::OfBatch(computed.clone());
    let y = apply(BatchNorm { maps, moments, activation }, x, affine, residual)?;
    match computed.get() {
        Some(Numbers { mean, variance }) => {
            let channels = [maps.channels];
            let (mean, variance) = (tensor(mean.clone(), &channels)?, tensor(variance.clone(), &channels)?);
            Ok((y, ChannelMoments { mean, variance, count: maps.images * maps.map }))
        }
        None => bail!("batch norm of {:?} computed no statistics", x.dims()),
    }
}

/// As [`batch_norm`] with given moments (`mean` and `variance` of shape (C)), which are constants: a frozen batch norm.
///
/// # Errors
/// When shapes do not fit.
pub fn batch_norm_running(
    x: &Tensor,
    affine: ScaleShift<'_>,
    mean: &Tensor,
    variance: &Tensor,
    residual: Option<&Tensor>,
    activation: Activation,
) -> Result<Tensor> {
    let maps = checked(x, affine, residual)?;
    if mean.dims() != [maps.channels] || variance.dims() != [maps.channels] {
        bail!(
            "batch norm of {:?} with a mean of {:?} and a variance of {:?}; ({}) fits",
            x.dims(),
            mean.dims(),
            variance.dims(),
            maps.channels
        );
    }
    let (mean, variance) = (mean.to_vec1()?, variance.to_vec1()?);
    let moments = Moments::Given(Numbers { mean, variance });
    apply(BatchNorm { maps, moments, activation }, x, affine, residual)
}

fn checked(x: &Tensor, affine: ScaleShift<'_>, residual: Option<&Tensor>) -> Result<Maps> {
    let (images, channels, height, width) = x.dims4()?;
    if affine.weight.dims() != [channels] || affine.bias.dims() != [channels] {
        bail!(
            "batch norm of {:?} with a weight of {:?} and a bias of {:?}; ({channels}) fits",
            x.dims(),
            affine.weight.dims(),
            affine.bias.dims()
        );
    }
    if residual.is_some_and(|residual| residual.dims() != x.dims()) || x.elem_count() == 0 {
        let residual = residual.map(Tensor::dims);
        bail!("batch norm of {:?} with a residual of {residual:?}: shapes differ or are empty", x.dims());
    }
    Ok(Maps { images, channels, map: height * width })
}

fn apply(op: BatchNorm, x: &Tensor, affine: ScaleShift<'_>, residual: Option<&Tensor>) -> Result<Tensor> {
    let x = x.contiguous()?;
    let affine = Tensor::stack(&[affine.weight, affine.bias], 0)?; // 2 x (C) -> (2, C): an operator has three inputs
    match residual {
        None => x.apply_op2(&affine, op),
        Some(residual) => x.apply_op3(&affine, &residual.contiguous()?, op),
    }
}

enum Moments {
    OfBatch(Arc<OnceLock<Numbers>>),
    Given(Numbers),
}

/// Inputs: x (N, C, H, W), weight and bias (2, C), on request a residual (N, C, H, W).
struct BatchNorm {
    maps: Maps,
    moments: Moments,
    activation: Activation,
}

impl BatchNorm {
    fn run(&self, x: &[f32], affine: &[f32], residual: Option<&[f32]>) -> CpuStorage {
        let y = match &self.moments {
            Moments::Given(moments) => {
                forward(self.maps, x, affine, Some(moments), BATCH_NORM_EPS, residual, self.activation).0
            }
            Moments::OfBatch(slot) => {
                let (y, moments) =
                    forward(self.maps, x, affine, None, BATCH_NORM_EPS, residual, self.activation);
                // candle runs an operator once; should it ever repeat one, the numbers are the same.
                slot.get_or_init(|| moments);
                y
            }
        };
        CpuStorage::F32(y)
    }

    fn gradients(
        &self,
        x: &Tensor,
        affine: &Tensor,
        residual: Option<&Tensor>,
        y: &Tensor,
        dy: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        let (moments, of_batch) = match &self.moments {
            Moments::Given(moments) => (moments, false),
            Moments::OfBatch(slot) => match slot.get() {
                Some(moments) => (moments, true),
                None => bail!("the gradient of a batch norm was asked for before its output"),
            },
        };
        let wants_residual = residual.is_some_and(Tensor::track_op);
        // Without an activation the residual's gradient is dy as it is.
        let separate = wants_residual && self.activation != Activation::None;
        let gradients = with_values([x, affine, y, dy], |[x, affine, y, dy]| {
            let inputs = super::batch_norm_cpu::Saved { x, affine, y, dy };
            backward(self.maps, inputs, moments, of_batch, BATCH_NORM_EPS, self.activation, separate)
        })?;
        let dresidual = match gradients.residual {
            Some(values) => Some(tensor(values, x.dims())?),
            None if wants_residual => Some(dy.clone()),
            None => None,
        };
        let dx = x.track_op().then(|| tensor(gradients.x, x.dims())).transpose()?;
        let daffine = affine.track_op().then(|| tensor(gradients.affine, affine.dims())).transpose()?;
        Ok((dx, daffine, dresidual))
    }
}

impl CustomOp2 for BatchNorm {
    fn name(&self) -> &'static str {
        "batch norm"
    }

    fn cpu_fwd(
        &self,
        x: &CpuStorage,
        x_layout: &Layout,
        affine: &CpuStorage,
        affine_layout: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let y = self.run(slice(x, x_layout)?, slice(affine, affine_layout)?, None);
        Ok((y, x_layout.shape().clone()))
    }

    fn bwd(
        &self,
        x: &Tensor,
        affine: &Tensor,
        y: &Tensor,
        dy: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>)> {
        let (dx, daffine, _) = self.gradients(x, affine, None, y, dy)?;
        Ok((dx, daffine))
    }
}

impl CustomOp3 for BatchNorm {
    fn name(&self) -> &'static str {
        "batch norm with residual"
    }

    fn cpu_fwd(
        &self,
        x: &CpuStorage,
        x_layout: &Layout,
        affine: &CpuStorage,
        affine_layout: &Layout,
        residual: &CpuStorage,
        residual_layout: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let residual = slice(residual, residual_layout)?;
        let y = self.run(slice(x, x_layout)?, slice(affine, affine_layout)?, Some(residual));
        Ok((y, x_layout.shape().clone()))
    }

    fn bwd(
        &self,
        x: &Tensor,
        affine: &Tensor,
        residual: &Tensor,
        y: &Tensor,
        dy: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        self.gradients(x, affine, Some(residual), y, dy)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use candle_core::{Device, Var};

    fn numbers(shape: &[usize], seed: usize) -> Var {
        let count: usize = shape.iter().product();
        let values =
            (0..count).map(|i| ((i * 7919 + seed * 31) % 1013) as f32 / 506.0 - 0.9).collect::<Vec<_>>();
        Var::from_tensor(&Tensor::from_vec(values, shape, &Device::Cpu).unwrap()).unwrap()
    }

    fn difference(a: &Tensor, b: &Tensor) -> f32 {
        (a - b).unwrap().abs().unwrap().flatten_all().unwrap().max(0).unwrap().to_scalar().unwrap()
    }

    /// The fused operator and candle's own operators give the same outputs and gradients.
    #[test]
    fn the_fused_operator_equals_plain_operators() {
        let shape = [3, 5, 4, 7];
        let (x, residual, upstream) = (numbers(&shape, 1), numbers(&shape, 2), numbers(&shape, 3));
        let (weight, bias) = (numbers(&[5], 4), numbers(&[5], 5));
        let affine = ScaleShift { weight: &weight, bias: &bias };
        let (mean, variance) = (numbers(&[5], 6).detach(), numbers(&[5], 7).sqr().unwrap().detach());
        for activation in [Activation::None, Activation::Elu] {
            for residual in [None, Some(residual.as_tensor())] {
                let (fused, moments) = batch_norm(&x, affine, residual, activation).unwrap();
                let (plain, plain_moments) = plain::batch_norm(&x, affine, residual, activation).unwrap();
                for (a, b) in [(moments.mean, plain_moments.mean), (moments.variance, plain_moments.variance)]
                {
                    assert!(difference(&a, &b) < 1e-6);
                }
                assert_eq!((moments.count, plain_moments.count), (84, 84));
                let running = batch_norm_running(&x, affine, &mean, &variance, residual, activation).unwrap();
                let plain_running =
                    plain::batch_norm_running(&x, affine, &mean, &variance, residual, activation).unwrap();
                for (fused, plain) in [(fused, plain), (running, plain_running)] {
                    assert!(difference(&fused, &plain) < 2e-5);
                    let gradients = |y: &Tensor| (y * upstream.as_tensor()).unwrap().backward().unwrap();
                    let (ours, theirs) = (gradients(&fused), gradients(&plain));
                    for var in
                        [Some(x.as_tensor()), Some(&weight), Some(&bias), residual].into_iter().flatten()
                    {
                        let (a, b) = (ours.get(var).unwrap(), theirs.get(var).unwrap());
                        assert!(difference(a, b) < 1e-3, "{activation:?}");
                    }
                }
            }
        }
    }

    #[test]
    fn one_value_per_channel_and_foreign_shapes_are_refused() {
        let (weight, bias) = (numbers(&[5], 1), numbers(&[5], 2));
        let affine = ScaleShift { weight: &weight, bias: &bias };
        let error = batch_norm(&numbers(&[1, 5, 1, 1], 1), affine, None, Activation::Elu).unwrap_err();
        assert!(error.to_string().contains("[1, 5, 1, 1]"), "{error}");
        let error = batch_norm(&numbers(&[2, 4, 3, 3], 1), affine, None, Activation::Elu).unwrap_err();
        assert!(error.to_string().contains("[2, 4, 3, 3]"), "{error}");
        let (x, other) = (numbers(&[2, 5, 3, 3], 1), numbers(&[2, 5, 3, 4], 1));
        let error = batch_norm(&x, affine, Some(&other), Activation::Elu).unwrap_err();
        assert!(error.to_string().contains("[2, 5, 3, 4]"), "{error}");
    }

    /// The same in candle's own operators.
    mod plain {
        use super::*;

        pub(super) fn batch_norm(
            x: &Tensor,
            affine: ScaleShift<'_>,
            residual: Option<&Tensor>,
            activation: Activation,
        ) -> Result<(Tensor, ChannelMoments)> {
            let (images, _, height, width) = x.dims4()?;
            let mean = x.mean_keepdim((0, 2, 3))?; // (N, C, H, W) -> (1, C, 1, 1)
            let centred = x.broadcast_sub(&mean)?;
            let variance = centred.sqr()?.mean_keepdim((0, 2, 3))?; // (N, C, H, W) -> (1, C, 1, 1)
            let y = finish(&centred, &variance, affine, residual, activation)?;
            let (mean, variance) = (mean.flatten_all()?, variance.flatten_all()?);
            Ok((y, ChannelMoments { mean, variance, count: images * height * width }))
        }

        pub(super) fn batch_norm_running(
            x: &Tensor,
            affine: ScaleShift<'_>,
            mean: &Tensor,
            variance: &Tensor,
            residual: Option<&Tensor>,
            activation: Activation,
        ) -> Result<Tensor> {
            let (mean, variance) = (mean.detach(), variance.detach());
            finish(
                &x.broadcast_sub(&per_channel(&mean)?)?,
                &per_channel(&variance)?,
                affine,
                residual,
                activation,
            )
        }

        fn finish(
            centred: &Tensor,
            variance: &Tensor,
            affine: ScaleShift<'_>,
            residual: Option<&Tensor>,
            activation: Activation,
        ) -> Result<Tensor> {
            let scale = (per_channel(affine.weight)? / (variance + BATCH_NORM_EPS)?.sqrt()?)?;
            let mut y = centred.broadcast_mul(&scale)?.broadcast_add(&per_channel(affine.bias)?)?;
            if let Some(residual) = residual {
                y = (y + residual)?;
            }
            match activation {
                Activation::None => Ok(y),
                Activation::Elu => y.elu(1.0),
            }
        }

        /// (C) -> (1, C, 1, 1).
        fn per_channel(t: &Tensor) -> Result<Tensor> {
            t.reshape((1, t.dim(0)?, 1, 1))
        }
    }
}
