//! From the map of Res5 to the vector that the LSTM reads. The paper does not say how; DeepVO, which it follows,
//! flattens, and ResNet-50 averages. Both are here.

use candle_core::{Module, Result, Tensor};
use candle_nn::VarBuilder;

use crate::config::{NetworkConfig, SpatialPool};
use crate::ops::Operators;
use crate::resnet::{ConvBnElu, Training};

/// Global average pool, or a 1x1 reduction with all positions side by side.
#[derive(Debug, Clone)]
pub struct Pool {
    reduce: Option<ConvBnElu>,
    operators: Operators,
}

impl Pool {
    /// Keys of the flattening form, under the sub-network's prefix: `reduce.conv`, `reduce.bn`; the average has none.
    ///
    /// # Errors
    /// When a tensor is missing or of another shape.
    pub fn new(config: &NetworkConfig, vb: VarBuilder<'_>) -> Result<Self> {
        let reduce = match config.spatial_pool {
            SpatialPool::Average => None,
            SpatialPool::Flatten { channels } => {
                let (shape, vb) = ((4 * config.res5_planes(), channels, 1, 1), vb.pp("reduce"));
                Some(ConvBnElu::new(shape, vb.pp("conv"), vb.pp("bn"))?)
            }
        };
        Ok(Self { reduce, operators: Operators::Cpu })
    }

    pub(crate) fn train(&mut self, training: &Training) {
        self.operators = training.operators;
        if let Some(reduce) = &mut self.reduce {
            reduce.train(training);
        }
    }
}

impl Module for Pool {
    /// (N, C, h, w) -> (N, C) averaged, or (N, channels * h * w) flattened.
    fn forward(&self, map: &Tensor) -> Result<Tensor> {
        match &self.reduce {
            None => map.mean((2, 3)), // (N, C, h, w) -> (N, C)
            Some(reduce) => {
                let reduced = reduce.forward(&self.operators.enter(map)?)?;
                self.operators.leave(&reduced)?.flatten_from(1) // (N, channels, h, w) -> (N, channels * h * w)
            }
        }
    }
}
