//! CNN1, the shared feature extractor (section "CNN-based feature extraction networks (CNN1)"): "the first four residual
//! blocks of the ResNet-50 (named from Res 1 to Res 4)", run once per frame.
//!
//! Reading: Res 1 is ResNet's conv1 with its max-pool; Res 2 to Res 4 are `layer1` to `layer3` of public weights.

use candle_core::{Module, Result, Tensor};
use candle_nn::VarBuilder;

use crate::config::NetworkConfig;
use crate::ops::Operators;
use crate::resnet::{ConvBnElu, Stage, Training, max_pool_3x3_stride_2};

/// Planes, units and stride of Res2, Res3 and Res4.
pub fn stages(config: &NetworkConfig) -> [(usize, usize, usize); 3] {
    let [res2, res3, res4] = config.cnn1_planes();
    [(res2, 3, 1), (res3, 4, 2), (res4, 6, 2)]
}

/// Image -> features.
#[derive(Debug, Clone)]
pub struct Cnn1 {
    conv1: ConvBnElu,
    layer1: Stage,
    layer2: Stage,
    layer3: Stage,
    training: Option<Operators>,
}

impl Cnn1 {
    /// Keys: `conv1`, `bn1`, `layer1`, `layer2`, `layer3`.
    ///
    /// # Errors
    /// When a tensor is missing or of another shape.
    pub fn new(config: &NetworkConfig, vb: VarBuilder<'_>) -> Result<Self> {
        let stem = config.channels(64);
        let [res2, res3, res4] = stages(config);
        let stage =
            |inputs, (planes, blocks, stride), name| Stage::new(inputs, planes, blocks, stride, vb.pp(name));
        Ok(Self {
            conv1: ConvBnElu::new((3, stem, 7, 2), vb.pp("conv1"), vb.pp("bn1"))?,
            layer1: stage(stem, res2, "layer1")?,
            layer2: stage(4 * res2.0, res3, "layer2")?,
            layer3: stage(4 * res3.0, res4, "layer3")?,
            training: None,
        })
    }

    pub(crate) fn train(&mut self, training: &Training) {
        self.training = Some(training.operators);
        self.conv1.train(training);
        for stage in [&mut self.layer1, &mut self.layer2, &mut self.layer3] {
            stage.train(training);
        }
    }
}

impl Module for Cnn1 {
    /// (N, 3, 224, 224) -> (N, 1024, 14, 14) at width 1; see [`NetworkConfig::features_shape`].
    fn forward(&self, image: &Tensor) -> Result<Tensor> {
        // The portable operators have N and C exchanged from here to the last stage.
        let image = self.training.map_or_else(|| Ok(image.clone()), |operators| operators.enter(image))?;
        let x = self.conv1.forward(&image)?; // (N, 64, 112, 112)
        let x = match self.training {
            Some(operators) => operators.max_pool_3x3_stride_2(&x),
            None => max_pool_3x3_stride_2(&x),
        }?; // (N, 64, 56, 56)
        let x = self.layer1.forward(&x)?; // (N, 256, 56, 56)
        let x = self.layer2.forward(&x)?; // (N, 512, 28, 28)
        let x = self.layer3.forward(&x)?; // (N, 1024, 14, 14)
        self.training.map_or_else(|| Ok(x.clone()), |operators| operators.leave(&x))
    }
}
