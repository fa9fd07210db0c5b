//! What the batch norms of a training network saw in a batch, for the running averages.

use std::sync::{Arc, Mutex, PoisonError};

use candle_core::{Result, Tensor};

use crate::ops::ChannelMoments;

/// Statistics of one batch norm over one batch.
#[derive(Debug, Clone)]
pub struct LayerStatistics {
    /// The layer, such as `cnn1.layer1.0.bn1`; its averages are `<layer>.running_mean` and `<layer>.running_var`.
    pub layer: String,
    /// Mean of every channel, (C).
    pub mean: Tensor,
    /// Unbiased variance of every channel, which is what PyTorch averages, (C).
    pub variance: Tensor,
}

/// Collects the statistics of a forward pass; clones share one list.
#[derive(Debug, Clone, Default)]
pub struct BatchStatistics {
    collected: Arc<Mutex<Vec<LayerStatistics>>>,
}

impl BatchStatistics {
    /// What was collected since the last call, in the order of the forward passes; the list is empty afterwards.
    pub fn take(&self) -> Vec<LayerStatistics> {
        std::mem::take(&mut self.collected.lock().unwrap_or_else(PoisonError::into_inner))
    }

    pub(crate) fn record(&self, layer: &str, moments: &ChannelMoments) -> Result<()> {
        let statistics = LayerStatistics {
            layer: layer.to_owned(),
            mean: moments.mean.clone(),
            variance: moments.unbiased_variance()?,
        };
        self.collected.lock().unwrap_or_else(PoisonError::into_inner).push(statistics);
        Ok(())
    }
}
