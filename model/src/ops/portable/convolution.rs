//! Convolution and its gradients as matrix products over all images.

use candle_core::{Result, Tensor};

use super::given::{Gradient, attach2};
use super::taps::Taps;
use crate::ops::geometry::Geometry;

/// x (C, N, H, W) and weight (outputs, C, k, k) -> (outputs, N, ceil(H / stride), ceil(W / stride)).
pub(in crate::ops) fn conv2d(x: &Tensor, weight: &Tensor, stride: usize) -> Result<Tensor> {
    let (channels, images, height, width) = x.dims4()?;
    let g = Geometry::new(&[images, channels, height, width], weight.dims(), stride)?;
    let convolution = Convolution { g, taps: Taps { kernel: g.kernel, stride, height, width } };
    let y = convolution.forward(&x.detach().contiguous()?, &weight.detach())?;
    attach2(x, weight, y, convolution)
}

struct Convolution {
    g: Geometry,
    taps: Taps,
}

impl Convolution {
    fn forward(&self, x: &Tensor, weight: &Tensor) -> Result<Tensor> {
        let g = &self.g;
        let y = self.by_tap(weight)?.matmul(&self.columns(x)?)?; // (outputs, k k C) (k k C, N rows columns)
        y.reshape((g.outputs, g.images, g.out_height(), g.out_width()))
    }

    /// (C, N, H, W) -> (k k C, N rows columns): what each tap sees, one under the other.
    fn columns(&self, x: &Tensor) -> Result<Tensor> {
        let g = &self.g;
        if g.is_pointwise() {
            return x.reshape((g.inputs, g.images * g.map()));
        }
        let padded = self.taps.pad(&x.reshape((g.inputs * g.images, g.height, g.width))?, 0.0)?;
        let views = (0..self.taps.count()).map(|tap| self.taps.view(&padded, tap));
        let columns = Tensor::cat(&views.collect::<Result<Vec<_>>>()?, 0)?; // (k k C N, rows, columns)
        columns.contiguous()?.reshape((g.taps(), g.images * g.out_map()))
    }

    /// (outputs, C, k, k) -> (outputs, k k C).
    fn by_tap(&self, weight: &Tensor) -> Result<Tensor> {
        let g = &self.g;
        let weight = weight.reshape((g.outputs, g.inputs, self.taps.count()))?;
        weight.transpose(1, 2)?.contiguous()?.reshape((g.outputs, g.taps()))
    }

    fn input_gradient(&self, weight: &Tensor, dy: &Tensor) -> Result<Tensor> {
        let g = &self.g;
        if g.stride > 1 || g.is_pointwise() {
            let dy = dy.reshape((g.outputs, g.images * g.out_map()))?;
            let columns = self.by_tap(weight)?.t()?.matmul(&dy)?; // (k k C, outputs) (outputs, N rows columns)
            if g.is_pointwise() {
                return columns.reshape((g.inputs, g.images, g.height, g.width));
            }
            let tap = |tap| {
                let rows = columns.narrow(0, tap * g.inputs, g.inputs)?;
                rows.reshape((g.inputs * g.images, g.out_height(), g.out_width()))
            };
            let by_tap = (0..self.taps.count()).map(tap).collect::<Result<Vec<_>>>()?;
            return self.taps.scatter(&by_tap)?.reshape((g.inputs, g.images, g.height, g.width));
        }
        // The convolution of dy with the kernels turned round and the channels exchanged; the taps are turned instead.
        let padded = self.taps.pad(&dy.reshape((g.outputs * g.images, g.height, g.width))?, 0.0)?;
        let views = (0..self.taps.count()).rev().map(|tap| self.taps.view(&padded, tap));
        let columns = Tensor::cat(&views.collect::<Result<Vec<_>>>()?, 0)?; // (k k outputs N, H, W)
        let columns = columns.contiguous()?.reshape((self.taps.count() * g.outputs, g.images * g.map()))?;
        let weight = weight.reshape((g.outputs, g.inputs, self.taps.count()))?;
        let weight = weight.permute((1, 2, 0))?.contiguous()?; // (C, k k, outputs)
        let dx = weight.reshape((g.inputs, ()))?.matmul(&columns)?;
        dx.reshape((g.inputs, g.images, g.height, g.width))
    }

    fn weight_gradient(&self, x: &Tensor, dy: &Tensor) -> Result<Tensor> {
        let g = &self.g;
        let dy = dy.reshape((g.outputs, g.images * g.out_map()))?;
        let dw = dy.matmul(&self.columns(x)?.t()?)?; // (outputs, N rows columns) (N rows columns, k k C)
        let dw = dw.reshape((g.outputs, self.taps.count(), g.inputs))?.transpose(1, 2)?.contiguous()?;
        dw.reshape((g.outputs, g.inputs, g.kernel, g.kernel))
    }
}

impl Gradient<2> for Convolution {
    const NAME: &'static str = "portable convolution";

    fn gradient(&self, [x, weight]: [&Tensor; 2], _: &Tensor, dy: &Tensor) -> Result<[Option<Tensor>; 2]> {
        let dx = x.track_op().then(|| self.input_gradient(&weight.detach(), dy)).transpose()?;
        let dw =
            weight.track_op().then(|| self.weight_gradient(&x.detach().contiguous()?, dy)).transpose()?;
        Ok([dx, dw])
    }
}
