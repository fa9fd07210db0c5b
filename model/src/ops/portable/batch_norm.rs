//! Batch norm with an optional residual and ELU.
//!
//! ```text
//! x' = (x - mean) / std      y = ELU(weight x' + bias + residual)      g = dy min(y + 1, 1)
//! dbias = sum(g)      dweight = sum(g x')      dx = weight / std (g - mean(g) - x' mean(g x'))
//! ```
//!
//! Nothing is copied to the host: the moments stay tensors.

use candle_core::{Result, Tensor};

use super::given::{Gradient, attach2, attach3};
use crate::ops::{Activation, ChannelMoments, ScaleShift};
use crate::resnet::BATCH_NORM_EPS;

/// As the function of the same name of [`crate::ops`], of maps (C, N, H, W).
pub(in crate::ops) fn batch_norm(
    x: &Tensor,
    affine: ScaleShift<'_>,
    residual: Option<&Tensor>,
    activation: Activation,
) -> Result<(Tensor, ChannelMoments)> {
    let (channels, images, height, width) = x.dims4()?;
    let count = images * height * width;
    let rows = x.detach().contiguous()?.reshape((channels, count))?;
    let mean = (row_sums(&rows, images)? / count as f64)?;
    let centred = rows.broadcast_sub(&mean)?;
    let variance = (row_sums(&centred.sqr()?, images)? / count as f64)?;
    let inverse_std = (&variance + BATCH_NORM_EPS)?.sqrt()?.recip()?;
    let scale = (column(affine.weight)? * &inverse_std)?;
    let y = centred.broadcast_mul(&scale)?.broadcast_add(&column(affine.bias)?)?;
    let moments = ChannelMoments { mean: mean.flatten_all()?, variance: variance.flatten_all()?, count };
    let op = BatchNorm { mean, inverse_std, of_batch: true, activation };
    Ok((op.finish(x, y, affine, residual)?, moments))
}

/// As the function of the same name of [`crate::ops`], of maps (C, N, H, W).
pub(in crate::ops) fn batch_norm_running(
    x: &Tensor,
    affine: ScaleShift<'_>,
    mean: &Tensor,
    variance: &Tensor,
    residual: Option<&Tensor>,
    activation: Activation,
) -> Result<Tensor> {
    let (mean, variance) = (column(mean)?, column(variance)?);
    let inverse_std = (variance + BATCH_NORM_EPS)?.sqrt()?.recip()?;
    let scale = (column(affine.weight)? * &inverse_std)?;
    let shift = (column(affine.bias)? - (&mean * &scale)?)?;
    let rows = x.detach().contiguous()?.reshape((x.dim(0)?, ()))?;
    let y = rows.broadcast_mul(&scale)?.broadcast_add(&shift)?;
    BatchNorm { mean, inverse_std, of_batch: false, activation }.finish(x, y, affine, residual)
}

/// Inputs: x (C, N, H, W), weight and bias (2, C), on request a residual (C, N, H, W).
struct BatchNorm {
    /// (C, 1).
    mean: Tensor,
    /// (C, 1).
    inverse_std: Tensor,
    /// Whether the moments are those of x, so that they move with it.
    of_batch: bool,
    activation: Activation,
}

impl BatchNorm {
    /// Residual and activation on the normalised rows, and the node of the graph.
    fn finish(
        self,
        x: &Tensor,
        rows: Tensor,
        affine: ScaleShift<'_>,
        residual: Option<&Tensor>,
    ) -> Result<Tensor> {
        let mut y = rows.reshape(x.shape())?;
        if let Some(residual) = residual {
            y = (y + residual.detach().contiguous()?)?;
        }
        if self.activation == Activation::Elu {
            y = y.elu(1.0)?;
        }
        let affine = Tensor::stack(&[affine.weight, affine.bias], 0)?; // 2 x (C) -> (2, C)
        match residual {
            None => attach2(x, &affine, y, self),
            Some(residual) => attach3([x, &affine, residual], y, self),
        }
    }

    /// Gradient of what the activation is applied to.
    fn before_activation(&self, y: &Tensor, dy: &Tensor) -> Result<Tensor> {
        match self.activation {
            Activation::None => Ok(dy.clone()),
            Activation::Elu => {
                // min(y, 0) + 1: 1 above zero, exp(x) = y + 1 below.
                let y = y.detach().contiguous()?;
                let slope = (&y - y.relu()?)?.affine(1.0, 1.0)?;
                dy * slope
            }
        }
    }

    /// Gradients of x and of weight and bias; `g` is (C, N, H, W).
    fn gradients(&self, x: &Tensor, affine: &Tensor, g: &Tensor) -> Result<[Option<Tensor>; 2]> {
        let (channels, images, height, width) = x.dims4()?;
        let count = images * height * width;
        let rows = x.detach().contiguous()?.reshape((channels, count))?;
        let g = g.reshape((channels, count))?;
        let scale = (column(&affine.detach().get(0)?)? * &self.inverse_std)?;
        let wants_affine = affine.track_op();
        if !(wants_affine || self.of_batch) {
            return Ok([Some(g.broadcast_mul(&scale)?.reshape(x.shape())?), None]);
        }
        let dbias = row_sums(&g, images)?;
        let products = row_sums(&(&g * &rows)?, images)?;
        let dweight = ((products - (&self.mean * &dbias)?)? * &self.inverse_std)?; // sum(g x'), (C, 1)
        let dx = if !x.track_op() {
            None
        } else if self.of_batch {
            // scale (g + a x + b) with a = -dweight / (count std), b = -dbias / count - a mean
            let a = (&dweight * &self.inverse_std)?.affine(-1.0 / count as f64, 0.0)?;
            let b = (dbias.affine(-1.0 / count as f64, 0.0)? - (&a * &self.mean)?)?;
            let inner = (g + rows.broadcast_mul(&a)?)?.broadcast_add(&b)?;
            Some(inner.broadcast_mul(&scale)?.reshape(x.shape())?)
        } else {
            Some(g.broadcast_mul(&scale)?.reshape(x.shape())?)
        };
        let daffine = match wants_affine {
            true => Some(Tensor::cat(&[dweight, dbias], 1)?.t()?.contiguous()?), // 2 x (C, 1) -> (2, C)
            false => None,
        };
        Ok([dx, daffine])
    }
}

impl Gradient<2> for BatchNorm {
    const NAME: &'static str = "portable batch norm";

    fn gradient(&self, [x, affine]: [&Tensor; 2], y: &Tensor, dy: &Tensor) -> Result<[Option<Tensor>; 2]> {
        self.gradients(x, affine, &self.before_activation(y, dy)?)
    }
}

impl Gradient<3> for BatchNorm {
    const NAME: &'static str = "portable batch norm with residual";

    fn gradient(
        &self,
        [x, affine, residual]: [&Tensor; 3],
        y: &Tensor,
        dy: &Tensor,
    ) -> Result<[Option<Tensor>; 3]> {
        let g = self.before_activation(y, dy)?;
        let [dx, daffine] = self.gradients(x, affine, &g)?;
        Ok([dx, daffine, residual.track_op().then_some(g)])
    }
}

/// (C) -> (C, 1), outside the graph.
fn column(t: &Tensor) -> Result<Tensor> {
    t.detach().contiguous()?.reshape((t.dim(0)?, 1))
}

/// Sums of the rows of (C, N * map) -> (C, 1), image by image first: candle sums each row on one core of the GPU, and long
/// rows would leave the others idle.
fn row_sums(rows: &Tensor, images: usize) -> Result<Tensor> {
    let (channels, count) = rows.dims2()?;
    let by_image = rows.reshape((channels * images, count / images))?.sum(1)?; // (C * N)
    by_image.reshape((channels, images))?.sum_keepdim(1)
}
