//! Which arithmetic a training network uses.

use candle_core::{Device, Result, Tensor};

use super::{Activation, ChannelMoments, ScaleShift, portable};

/// Where the operators of a training network come from.
///
/// Those of the CPU take maps as (N, C, H, W), the portable ones as (C, N, H, W): a network brings its maps there with
/// [`Operators::enter`] and back with [`Operators::leave`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Operators {
    /// Hand-written, for the CPU only.
    #[default]
    Cpu,
    /// Tensor operations of any device.
    Portable,
}

impl Operators {
    /// The hand-written ones where they run.
    pub fn for_device(device: &Device) -> Self {
        if device.is_cpu() { Self::Cpu } else { Self::Portable }
    }

    /// (N, C, H, W) -> the order that these operators take.
    ///
    /// # Errors
    /// When it is no map, or memory runs out.
    pub fn enter(self, x: &Tensor) -> Result<Tensor> {
        match self {
            Self::Cpu => Ok(x.clone()),
            Self::Portable => portable::enter(x),
        }
    }

    /// The order that these operators take -> (N, C, H, W).
    ///
    /// # Errors
    /// As [`Operators::enter`].
    pub fn leave(self, x: &Tensor) -> Result<Tensor> {
        match self {
            Self::Cpu => Ok(x.clone()),
            Self::Portable => portable::leave(x),
        }
    }

    /// As [`super::conv2d`].
    ///
    /// # Errors
    /// When the shapes do not fit.
    pub fn conv2d(self, x: &Tensor, weight: &Tensor, stride: usize) -> Result<Tensor> {
        match self {
            Self::Cpu => super::conv2d(x, weight, stride),
            Self::Portable => portable::conv2d(x, weight, stride),
        }
    }

    /// As [`super::batch_norm`].
    ///
    /// # Errors
    /// When shapes do not fit, or there is only one value per channel.
    pub fn batch_norm(
        self,
        x: &Tensor,
        affine: ScaleShift<'_>,
        residual: Option<&Tensor>,
        activation: Activation,
    ) -> Result<(Tensor, ChannelMoments)> {
        match self {
            Self::Cpu => super::batch_norm(x, affine, residual, activation),
            Self::Portable => portable::batch_norm(x, affine, residual, activation),
        }
    }

    /// As [`super::batch_norm_running`].
    ///
    /// # Errors
    /// When shapes do not fit.
    pub fn batch_norm_running(
        self,
        x: &Tensor,
        affine: ScaleShift<'_>,
        (mean, variance): (&Tensor, &Tensor),
        residual: Option<&Tensor>,
        activation: Activation,
    ) -> Result<Tensor> {
        match self {
            Self::Cpu => super::batch_norm_running(x, affine, mean, variance, residual, activation),
            Self::Portable => portable::batch_norm_running(x, affine, mean, variance, residual, activation),
        }
    }

    /// As [`super::max_pool_3x3_stride_2`].
    ///
    /// # Errors
    /// When the input is no map, or empty.
    pub fn max_pool_3x3_stride_2(self, x: &Tensor) -> Result<Tensor> {
        match self {
            Self::Cpu => super::max_pool_3x3_stride_2(x),
            Self::Portable => portable::max_pool_3x3_stride_2(x),
        }
    }
}
