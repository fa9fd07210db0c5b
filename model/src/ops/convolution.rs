//! 2-D convolution with its gradients; the arithmetic of the CPU is in `convolution_cpu`.

use candle_core::{CpuStorage, CustomOp2, Layout, Result, Shape, Tensor};

use super::convolution_cpu::{forward, input_gradient, weight_gradient};
use super::gemm::Matrix;
use super::geometry::Geometry;
use super::values::{slice, tensor, with_values};

/// Convolution without bias, square odd kernel, padding (k - 1) / 2:
/// x (N, C, H, W) and weight (outputs, C, k, k) -> (N, outputs, ceil(H / stride), ceil(W / stride)).
///
/// Only tracked inputs get a gradient: none is computed for images, nor for weights that are not trained.
///
/// # Errors
/// When the shapes do not fit.
pub fn conv2d(x: &Tensor, weight: &Tensor, stride: usize) -> Result<Tensor> {
    let geometry = Geometry::new(x.dims(), weight.dims(), stride)?;
    x.contiguous()?.apply_op2(&weight.contiguous()?, Convolution { geometry })
}

struct Convolution {
    geometry: Geometry,
}

impl CustomOp2 for Convolution {
    fn name(&self) -> &'static str {
        "convolution"
    }

    fn cpu_fwd(
        &self,
        x: &CpuStorage,
        x_layout: &Layout,
        weight: &CpuStorage,
        weight_layout: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let g = &self.geometry;
        let weight = Matrix::packed(slice(weight, weight_layout)?, g.outputs, g.taps());
        let y = forward(g, weight, slice(x, x_layout)?);
        Ok((CpuStorage::F32(y), (g.images, g.outputs, g.out_height(), g.out_width()).into()))
    }

    fn bwd(
        &self,
        x: &Tensor,
        weight: &Tensor,
        _y: &Tensor,
        dy: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>)> {
        let g = &self.geometry;
        let dx = x.track_op().then(|| {
            let dx = with_values([weight, dy], |[weight, dy]| input_gradient(g, weight, dy))?;
            tensor(dx, x.dims())
        });
        let dw = weight.track_op().then(|| {
            let dw = with_values([x, dy], |[x, dy]| weight_gradient(g, x, dy))?;
            tensor(dw, weight.dims())
        });
        Ok((dx.transpose()?, dw.transpose()?))
    }
}
