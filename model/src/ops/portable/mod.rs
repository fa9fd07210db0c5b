//! The operators in candle's own tensor operations, for devices that are not the CPU.
//!
//! candle's gradients are of no use there: those of a convolution and of a max-pool are slow or refused, those of a batch
//! norm take some thirty passes over memory. Here the values are computed outside the graph, and one node of the graph
//! carries a gradient that is made of few and large operations: matrix products, and passes over contiguous memory.
//!
//! Maps are kept channel first, (C, N, H, W): a convolution is then one matrix product for all images, and a channel's
//! statistics are sums over contiguous rows. [`enter`] and [`leave`] stand at the borders of a network.
//!
//! All of this runs on the CPU as well, where tests compare it with the CPU's operators.

mod batch_norm;
mod convolution;
mod given;
mod max_pool;
mod moments;
mod taps;

use candle_core::{Result, Tensor};

pub(super) use batch_norm::{batch_norm, batch_norm_running};
pub(super) use convolution::conv2d;
pub(super) use max_pool::max_pool_3x3_stride_2;
pub(super) use moments::FlatMoments;

/// (N, C, H, W) -> (C, N, H, W).
pub(super) fn enter(x: &Tensor) -> Result<Tensor> {
    x.transpose(0, 1)?.contiguous()
}

/// (C, N, H, W) -> (N, C, H, W).
pub(super) fn leave(x: &Tensor) -> Result<Tensor> {
    x.transpose(0, 1)?.contiguous()
}
