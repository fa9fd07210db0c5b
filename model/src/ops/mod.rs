//! Operators of the training network: candle custom operators with gradients of their own on the CPU (f32), where
//! candle's are slow (convolution, Adam), missing (max-pool with overlap) or take many passes over memory (batch norm,
//! residual and ELU). [`Operators`] picks them, or on other devices the same functions made of candle's own tensor
//! operations (`portable`).
//!
//! Work is cut by shapes and never by the number of threads, and every sum has a fixed order: on one machine the same
//! inputs give the same bits, on however many cores.

mod adam;
mod batch_norm;
mod batch_norm_cpu;
mod convolution;
mod convolution_cpu;
mod elu;
mod gemm;
mod geometry;
mod max_pool;
mod operators;
mod portable;
mod scratch;
mod values;

pub use adam::{Adam, AdamError, AdamMoments, AdamOptions, AdamParam, AdamState, StepReport};
pub use batch_norm::{Activation, ChannelMoments, ScaleShift, batch_norm, batch_norm_running};
pub use convolution::conv2d;
pub use max_pool::max_pool_3x3_stride_2;
pub use operators::Operators;
