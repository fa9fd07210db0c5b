//! The building blocks of ResNet-50 as the paper uses them (section "CNN-based feature extraction networks"): bottleneck
//! units of 1x1, 3x3 and 1x1 convolutions, "each of the convolutions followed by batch normalization, scale and ELUs".
//!
//! Readings where the paper is silent: the ELU of the last convolution stands after the residual addition, as the ReLU
//! of ResNet does; the stride sits on the 3x3 convolution (ResNet v1.5, the layout of public weights).

use candle_core::{Module, Result, Tensor};
use candle_nn::VarBuilder;

use crate::ops::{Activation, Operators, ScaleShift};
use crate::statistics::BatchStatistics;

/// Epsilon of every batch norm, PyTorch's default.
pub const BATCH_NORM_EPS: f64 = 1e-5;

/// Whether the first block of a stage needs a projection on its shortcut.
pub fn needs_downsample(inputs: usize, planes: usize, stride: usize) -> bool {
    inputs != 4 * planes || stride != 1
}

/// 2-D convolution without bias, square odd kernel, padding (kernel - 1) / 2.
#[derive(Debug, Clone)]
pub struct Convolution {
    weight: Tensor,
    stride: usize,
    training: Option<Operators>,
}

impl Convolution {
    /// Key: `weight`, shape (outputs, inputs, kernel, kernel).
    ///
    /// # Errors
    /// When the tensor is missing or of another shape.
    pub fn new(
        inputs: usize,
        outputs: usize,
        kernel: usize,
        stride: usize,
        vb: VarBuilder<'_>,
    ) -> Result<Self> {
        let weight = vb.get((outputs, inputs, kernel, kernel), "weight")?;
        Ok(Self { weight, stride, training: None })
    }

    /// Computes with the operators that have fast gradients.
    pub(crate) fn train(&mut self, training: &Training) {
        self.training = Some(training.operators);
    }
}

impl Module for Convolution {
    /// (N, inputs, H, W) -> (N, outputs, ceil(H / stride), ceil(W / stride)).
    fn forward(&self, x: &Tensor) -> Result<Tensor> {
        if let Some(operators) = self.training {
            return operators.conv2d(x, &self.weight, self.stride);
        }
        let (outputs, inputs, kernel, _) = self.weight.dims4()?;
        if kernel == 1 && self.stride == 1 {
            // One matrix product; candle's convolution copies its input and output element by element around the same
            // product.
            let (n, _, height, width) = x.dims4()?;
            let x = x.flatten_from(2)?; // (N, inputs, H * W)
            let weight = self.weight.reshape((outputs, inputs))?; // (outputs, inputs, 1, 1) -> matrix
            let y = if n == 1 {
                weight.matmul(&x.squeeze(0)?)? // (outputs, H * W)
            } else {
                weight.broadcast_left(n)?.matmul(&x)? // (N, outputs, H * W)
            };
            return y.reshape((n, outputs, height, width));
        }
        x.conv2d(&self.weight, (kernel - 1) / 2, self.stride, 1, 1)
    }
}

/// Batch norm with running statistics: y = weight (x - running_mean) / sqrt(running_var + eps) + bias per channel.
///
/// Never looks at the statistics of its input, but in training and where a collector of statistics was given.
#[derive(Debug, Clone)]
pub struct BatchNorm {
    weight: Tensor,
    bias: Tensor,
    running_mean: Tensor,
    running_var: Tensor,
    name: String,
    training: Option<Training>,
}

/// How the batch norms of a training network normalise.
#[derive(Debug, Clone)]
pub(crate) struct Training {
    /// Takes the statistics of batch norms whose weight is trained; none: all use their running statistics.
    pub(crate) statistics: Option<BatchStatistics>,
    /// What convolutions, batch norms and pools compute with.
    pub(crate) operators: Operators,
}

impl BatchNorm {
    /// Keys: `weight`, `bias`, `running_mean`, `running_var`, each of shape (channels).
    ///
    /// # Errors
    /// When a tensor is missing or of another shape.
    pub fn new(channels: usize, vb: VarBuilder<'_>) -> Result<Self> {
        Ok(Self {
            weight: vb.get(channels, "weight")?,
            bias: vb.get(channels, "bias")?,
            running_mean: vb.get(channels, "running_mean")?,
            running_var: vb.get(channels, "running_var")?,
            name: vb.prefix(),
            training: None,
        })
    }

    /// Computes with the operators that have fast gradients.
    pub(crate) fn train(&mut self, training: &Training) {
        self.training = Some(training.clone());
    }

    /// Batch norm, then the residual added, then the activation: (N, channels, H, W) -> the same shape.
    ///
    /// # Errors
    /// When shapes do not fit.
    pub fn forward_with(
        &self,
        x: &Tensor,
        residual: Option<&Tensor>,
        activation: Activation,
    ) -> Result<Tensor> {
        if let Some(training) = &self.training {
            return self.forward_trained(x, residual, activation, training);
        }
        let mut y = self.forward_inference(x)?;
        if let Some(residual) = residual {
            y = (y + residual)?;
        }
        match activation {
            Activation::None => Ok(y),
            Activation::Elu => y.elu(1.0),
        }
    }

    fn forward_trained(
        &self,
        x: &Tensor,
        residual: Option<&Tensor>,
        activation: Activation,
        training: &Training,
    ) -> Result<Tensor> {
        let affine = ScaleShift { weight: &self.weight, bias: &self.bias };
        match &training.statistics {
            Some(statistics) if self.weight.track_op() => {
                let (y, moments) = training.operators.batch_norm(x, affine, residual, activation)?;
                statistics.record(&self.name, &moments)?;
                Ok(y)
            }
            _ => {
                let running = (&self.running_mean, &self.running_var);
                training.operators.batch_norm_running(x, affine, running, residual, activation)
            }
        }
    }

    fn forward_inference(&self, x: &Tensor) -> Result<Tensor> {
        // Scale and shift first: two passes over the map instead of four.
        let scale = (&self.weight / (&self.running_var + BATCH_NORM_EPS)?.sqrt()?)?;
        let shift = (&self.bias - (&self.running_mean * &scale)?)?;
        let per_channel = (1, scale.dim(0)?, 1, 1);
        x.broadcast_mul(&scale.reshape(per_channel)?)?.broadcast_add(&shift.reshape(per_channel)?)
    }
}

impl Module for BatchNorm {
    /// (N, channels, H, W) -> the same shape.
    fn forward(&self, x: &Tensor) -> Result<Tensor> {
        self.forward_with(x, None, Activation::None)
    }
}

/// Convolution, batch norm, ELU.
#[derive(Debug, Clone)]
pub struct ConvBnElu {
    conv: Convolution,
    bn: BatchNorm,
}

impl ConvBnElu {
    /// Keys under the two prefixes that `conv` and `bn` carry.
    ///
    /// # Errors
    /// When a tensor is missing or of another shape.
    pub fn new(
        (inputs, outputs, kernel, stride): (usize, usize, usize, usize),
        conv: VarBuilder<'_>,
        bn: VarBuilder<'_>,
    ) -> Result<Self> {
        Ok(Self {
            conv: Convolution::new(inputs, outputs, kernel, stride, conv)?,
            bn: BatchNorm::new(outputs, bn)?,
        })
    }

    pub(crate) fn train(&mut self, training: &Training) {
        self.conv.train(training);
        self.bn.train(training);
    }
}

impl Module for ConvBnElu {
    /// (N, inputs, H, W) -> (N, outputs, ceil(H / stride), ceil(W / stride)).
    fn forward(&self, x: &Tensor) -> Result<Tensor> {
        self.bn.forward_with(&self.conv.forward(x)?, None, Activation::Elu)
    }
}

/// Bottleneck unit: 1x1 to `planes`, 3x3 with the stride, 1x1 to 4 `planes`, added to the (projected) input.
#[derive(Debug, Clone)]
pub struct Bottleneck {
    conv1: ConvBnElu,
    conv2: ConvBnElu,
    conv3: Convolution,
    bn3: BatchNorm,
    downsample: Option<(Convolution, BatchNorm)>,
}

impl Bottleneck {
    /// Keys: `conv1`, `bn1`, `conv2`, `bn2`, `conv3`, `bn3` and, where the shape changes, `downsample.0`, `downsample.1`.
    ///
    /// # Errors
    /// When a tensor is missing or of another shape.
    pub fn new(inputs: usize, planes: usize, stride: usize, vb: VarBuilder<'_>) -> Result<Self> {
        let outputs = 4 * planes;
        let downsample = if needs_downsample(inputs, planes, stride) {
            let vb = vb.pp("downsample");
            let conv = Convolution::new(inputs, outputs, 1, stride, vb.pp("0"))?;
            Some((conv, BatchNorm::new(outputs, vb.pp("1"))?))
        } else {
            None
        };
        Ok(Self {
            conv1: ConvBnElu::new((inputs, planes, 1, 1), vb.pp("conv1"), vb.pp("bn1"))?,
            conv2: ConvBnElu::new((planes, planes, 3, stride), vb.pp("conv2"), vb.pp("bn2"))?,
            conv3: Convolution::new(planes, outputs, 1, 1, vb.pp("conv3"))?,
            bn3: BatchNorm::new(outputs, vb.pp("bn3"))?,
            downsample,
        })
    }

    pub(crate) fn train(&mut self, training: &Training) {
        self.conv1.train(training);
        self.conv2.train(training);
        self.conv3.train(training);
        self.bn3.train(training);
        if let Some((conv, bn)) = &mut self.downsample {
            conv.train(training);
            bn.train(training);
        }
    }
}

impl Module for Bottleneck {
    /// (N, inputs, H, W) -> (N, 4 planes, ceil(H / stride), ceil(W / stride)).
    fn forward(&self, x: &Tensor) -> Result<Tensor> {
        let y = self.conv2.forward(&self.conv1.forward(x)?)?;
        let y = self.conv3.forward(&y)?;
        let shortcut = match &self.downsample {
            Some((conv, bn)) => bn.forward(&conv.forward(x)?)?,
            None => x.clone(),
        };
        self.bn3.forward_with(&y, Some(&shortcut), Activation::Elu)
    }
}

/// Several bottleneck units in a row: one of Res2..Res5.
#[derive(Debug, Clone)]
pub struct Stage {
    blocks: Vec<Bottleneck>,
}

impl Stage {
    /// Keys: `0`, `1`, ... for the units; the first one carries the stride and the change of channels.
    ///
    /// # Errors
    /// When a tensor is missing or of another shape.
    pub fn new(
        inputs: usize,
        planes: usize,
        blocks: usize,
        stride: usize,
        vb: VarBuilder<'_>,
    ) -> Result<Self> {
        let block = |i: usize| match i {
            0 => Bottleneck::new(inputs, planes, stride, vb.pp(0)),
            _ => Bottleneck::new(4 * planes, planes, 1, vb.pp(i)),
        };
        Ok(Self { blocks: (0..blocks).map(block).collect::<Result<_>>()? })
    }

    pub(crate) fn train(&mut self, training: &Training) {
        self.blocks.iter_mut().for_each(|block| block.train(training));
    }
}

impl Module for Stage {
    /// (N, inputs, H, W) -> (N, 4 planes, ceil(H / stride), ceil(W / stride)).
    fn forward(&self, x: &Tensor) -> Result<Tensor> {
        self.blocks.iter().try_fold(x.clone(), |x, block| block.forward(&x))
    }
}

/// The stem's 3x3 max-pool, stride 2, padding 1: (N, C, H, W) -> (N, C, ceil(H / 2), ceil(W / 2)).
///
/// # Errors
/// When the input is not a map of four dimensions.
pub fn max_pool_3x3_stride_2(x: &Tensor) -> Result<Tensor> {
    // candle's pool takes no padding. A border that repeats the edge pixel gives the same maximum as one of minus
    // infinity, because every window that reaches the border also holds that edge pixel; zeros would not, since an ELU
    // can be negative.
    let x = x.pad_with_same(2, 1, 1)?.pad_with_same(3, 1, 1)?; // (N, C, H + 2, W + 2)
    x.max_pool2d_with_stride(3, 2)
}

#[cfg(test)]
mod tests {
    use super::*;
    use candle_core::{DType, Device};

    #[test]
    fn max_pool_of_negative_values_ignores_the_border() {
        let x =
            Tensor::from_vec((0..15).map(|i| -1.0 - i as f32).collect(), (1, 1, 3, 5), &Device::Cpu).unwrap();
        let y = max_pool_3x3_stride_2(&x).unwrap();
        assert_eq!(y.dims(), [1, 1, 2, 3]);
        // Rows 0..=1 and 1..=2, columns 0..=1, 1..=3, 3..=4 of -1 - (5 row + column).
        let expected = [[-1.0, -2.0, -4.0], [-6.0, -7.0, -9.0]];
        assert_eq!(y.squeeze(0).unwrap().squeeze(0).unwrap().to_vec2::<f32>().unwrap(), expected);
    }

    #[test]
    fn pointwise_convolution_equals_candles_own() {
        let tensor = |shape: &[usize], seed: usize| {
            let n: usize = shape.iter().product();
            let values = (0..n).map(|i| ((i * 7919 + seed) % 1013) as f32 / 506.0 - 1.0).collect::<Vec<_>>();
            Tensor::from_vec(values, shape, &Device::Cpu).unwrap()
        };
        for n in [1, 3] {
            let x = tensor(&[n, 6, 5, 7], 1);
            let weight = tensor(&[4, 6, 1, 1], 2);
            let ours = Convolution { weight: weight.clone(), stride: 1, training: None }.forward(&x).unwrap();
            let theirs = x.conv2d(&weight, 0, 1, 1, 1).unwrap();
            let difference = (ours - theirs).unwrap().abs().unwrap().max_all().unwrap();
            assert!(difference.to_dtype(DType::F32).unwrap().to_scalar::<f32>().unwrap() < 1e-5);
        }
    }
}
