//! The layers that a [`NetworkConfig`] stands for, in running order: names, tensors, shapes, costs.
//!
//! One walk over the network serves the checkpoint reader (which tensors, which shapes), the initialiser, the
//! parameter and multiply-add counts and the printed layer table.

use crate::config::{NetworkConfig, SpatialPool};

/// A tensor that a checkpoint of the network holds.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TensorSpec {
    /// The key in the checkpoint, such as `cnn1.layer1.0.conv1.weight`.
    pub name: String,
    /// Its shape, as PyTorch has it.
    pub shape: Vec<usize>,
    /// Learnt by gradient descent; false for the running statistics of batch norm.
    pub learnt: bool,
}

/// What a layer computes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LayerKind {
    /// 2-D convolution without bias, square kernel, zero padding.
    Convolution {
        /// Input channels.
        inputs: usize,
        /// Output channels.
        outputs: usize,
        /// Kernel side in pixels.
        kernel: usize,
        /// Step in both directions.
        stride: usize,
    },
    /// Batch norm with scale and shift; the ELU behind it is part of the row.
    BatchNorm {
        /// Channels.
        channels: usize,
    },
    /// 3x3 max-pool, stride 2, padding 1.
    MaxPool,
    /// Global average pool.
    AveragePool,
    /// All positions of a map side by side.
    Flatten,
    /// One layer of the stacked LSTM.
    Lstm {
        /// Which of the stacked layers, from 0.
        layer: usize,
        /// Numbers read per step.
        inputs: usize,
        /// Hidden states.
        hidden: usize,
    },
    /// Fully connected, with bias.
    Linear {
        /// Numbers read.
        inputs: usize,
        /// Numbers written.
        outputs: usize,
    },
}

/// One row of the layer table.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Layer {
    /// Field path of the layer and prefix of its checkpoint keys.
    pub name: String,
    /// What it computes.
    pub kind: LayerKind,
    /// Output of one frame: (C, H, W) or (N).
    pub output: Vec<usize>,
}

impl Layer {
    /// The layer's tensors in a checkpoint.
    pub fn tensors(&self) -> Vec<TensorSpec> {
        let tensor = |suffix: &str, shape: &[usize], learnt| TensorSpec {
            name: format!("{}.{suffix}", self.name),
            shape: shape.to_vec(),
            learnt,
        };
        match self.kind {
            LayerKind::Convolution { inputs, outputs, kernel, .. } => {
                vec![tensor("weight", &[outputs, inputs, kernel, kernel], true)]
            }
            LayerKind::BatchNorm { channels } => vec![
                tensor("weight", &[channels], true),
                tensor("bias", &[channels], true),
                tensor("running_mean", &[channels], false),
                tensor("running_var", &[channels], false),
            ],
            LayerKind::MaxPool | LayerKind::AveragePool | LayerKind::Flatten => vec![],
            LayerKind::Lstm { layer, inputs, hidden } => vec![
                tensor(&format!("weight_ih_l{layer}"), &[4 * hidden, inputs], true),
                tensor(&format!("weight_hh_l{layer}"), &[4 * hidden, hidden], true),
                tensor(&format!("bias_ih_l{layer}"), &[4 * hidden], true),
                tensor(&format!("bias_hh_l{layer}"), &[4 * hidden], true),
            ],
            LayerKind::Linear { inputs, outputs } => {
                vec![tensor("weight", &[outputs, inputs], true), tensor("bias", &[outputs], true)]
            }
        }
    }

    /// Learnt numbers; running statistics do not count.
    pub fn parameters(&self) -> usize {
        let learnt = self.tensors().into_iter().filter(|t| t.learnt);
        learnt.map(|t| t.shape.iter().product::<usize>()).sum()
    }

    /// Multiply-adds of convolutions, LSTMs and fully connected layers for one frame; element-wise work is not counted.
    pub fn multiply_adds(&self) -> usize {
        match self.kind {
            LayerKind::Convolution { inputs, outputs, kernel, .. } => {
                // (C, H, W): every output position reads the whole kernel.
                inputs * outputs * kernel * kernel * self.output[1] * self.output[2]
            }
            LayerKind::Lstm { inputs, hidden, .. } => 4 * hidden * (inputs + hidden),
            LayerKind::Linear { inputs, outputs } => inputs * outputs,
            _ => 0,
        }
    }
}

impl NetworkConfig {
    /// Every layer in running order.
    pub fn layers(&self) -> Vec<Layer> {
        let mut walk = Walk { config: self, layers: Vec::new() };
        let (features, height, width) = walk.cnn1();
        if self.branches.relative {
            walk.rcnn("rcnn1", "fc1", self.fc1, (2 * features, height, width));
        }
        if self.branches.global {
            walk.rcnn("rcnn2", "fc2", self.fc2, (features, height, width));
        }
        if self.branches.fusion {
            walk.linear("fcfl.fc3", self.fc1 + self.fc2, self.fc3);
            walk.heads("fcfl", self.fc3);
        }
        walk.layers
    }

    /// Every tensor of a complete checkpoint, in running order.
    pub fn tensors(&self) -> Vec<TensorSpec> {
        self.layers().iter().flat_map(Layer::tensors).collect()
    }

    /// Learnt numbers of the whole network: 85.7 million for [`NetworkConfig::grnet`].
    pub fn parameter_count(&self) -> usize {
        self.layers().iter().map(Layer::parameters).sum()
    }

    /// Multiply-adds of one streamed frame: 5146 million for [`NetworkConfig::grnet`].
    ///
    /// With [`crate::Recurrence::RerunLastK`] the recurrent part is counted once per re-run frame, all K of them.
    pub fn multiply_adds_per_frame(&self) -> usize {
        let reruns = match self.recurrence {
            crate::config::Recurrence::Carry => 1,
            crate::config::Recurrence::RerunLastK => self.k,
        };
        let cost = |layer: &Layer| match layer.kind {
            LayerKind::Lstm { .. } => reruns * layer.multiply_adds(),
            _ => layer.multiply_adds(),
        };
        self.layers().iter().map(cost).sum()
    }
}

type MapShape = (usize, usize, usize);

struct Walk<'a> {
    config: &'a NetworkConfig,
    layers: Vec<Layer>,
}

impl Walk<'_> {
    fn push(&mut self, name: String, kind: LayerKind, output: &[usize]) {
        self.layers.push(Layer { name, kind, output: output.to_vec() });
    }

    /// Convolution with padding (kernel - 1) / 2 and the batch norm behind it.
    fn conv_bn(&mut self, conv: String, bn: String, input: MapShape, conv_shape: MapShape) -> MapShape {
        let (inputs, height, width) = input;
        let (outputs, kernel, stride) = conv_shape;
        // With that padding and an odd kernel the side is ceil(side / stride).
        let output = (outputs, height.div_ceil(stride), width.div_ceil(stride));
        let dims = [output.0, output.1, output.2];
        self.push(conv, LayerKind::Convolution { inputs, outputs, kernel, stride }, &dims);
        self.push(bn, LayerKind::BatchNorm { channels: outputs }, &dims);
        output
    }

    fn cnn1(&mut self) -> MapShape {
        let config = self.config;
        let image = (3, config.input_height_px, config.input_width_px);
        let (channels, height, width) =
            self.conv_bn("cnn1.conv1".into(), "cnn1.bn1".into(), image, (config.channels(64), 7, 2));
        let mut map = (channels, height.div_ceil(2), width.div_ceil(2));
        self.push("cnn1.max_pool".into(), LayerKind::MaxPool, &[map.0, map.1, map.2]);
        for (layer, (planes, blocks, stride)) in crate::cnn1::stages(config).into_iter().enumerate() {
            map = self.stage(&format!("cnn1.layer{}", layer + 1), map, planes, blocks, stride);
        }
        map
    }

    /// One stage of bottleneck blocks (Res2..Res5).
    fn stage(
        &mut self,
        name: &str,
        input: MapShape,
        planes: usize,
        blocks: usize,
        stride: usize,
    ) -> MapShape {
        let mut map = input;
        for block in 0..blocks {
            let at = |layer: &str| format!("{name}.{block}.{layer}");
            let stride = if block == 0 { stride } else { 1 };
            let block_input = map;
            map = self.conv_bn(at("conv1"), at("bn1"), map, (planes, 1, 1));
            map = self.conv_bn(at("conv2"), at("bn2"), map, (planes, 3, stride));
            map = self.conv_bn(at("conv3"), at("bn3"), map, (4 * planes, 1, 1));
            if block == 0 && crate::resnet::needs_downsample(block_input.0, planes, stride) {
                let shape = (4 * planes, 1, stride);
                self.conv_bn(at("downsample.0"), at("downsample.1"), block_input, shape);
            }
        }
        map
    }

    fn rcnn(&mut self, name: &str, fc: &str, fc_size: usize, input: MapShape) {
        let config = self.config;
        let stage = (config.res5_planes(), 3, 2);
        let map = self.stage(&format!("{name}.res5"), input, stage.0, stage.1, stage.2);
        let pooled = config.pooled_features();
        match config.spatial_pool {
            SpatialPool::Average => {
                self.push(format!("{name}.pool"), LayerKind::AveragePool, &[pooled]);
            }
            SpatialPool::Flatten { channels } => {
                let (conv, bn) = (format!("{name}.reduce.conv"), format!("{name}.reduce.bn"));
                self.conv_bn(conv, bn, map, (channels, 1, 1));
                self.push(format!("{name}.flatten"), LayerKind::Flatten, &[pooled]);
            }
        }
        let hidden = config.lstm_hidden;
        for layer in 0..config.lstm_layers {
            let inputs = if layer == 0 { pooled } else { hidden };
            self.push(format!("{name}.lstm"), LayerKind::Lstm { layer, inputs, hidden }, &[hidden]);
        }
        self.linear(&format!("{name}.{fc}"), hidden, fc_size);
        self.heads(name, fc_size);
    }

    fn linear(&mut self, name: &str, inputs: usize, outputs: usize) {
        self.push(name.into(), LayerKind::Linear { inputs, outputs }, &[outputs]);
    }

    fn heads(&mut self, name: &str, inputs: usize) {
        self.linear(&format!("{name}.fc4"), inputs, 3);
        self.linear(&format!("{name}.fc5"), inputs, self.config.rotation.outputs());
        if self.config.log_variance {
            self.linear(&format!("{name}.log_variance"), inputs, 6);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn millions(n: usize) -> f64 {
        n as f64 / 1e6
    }

    #[test]
    fn grnet_has_the_papers_size() {
        let config = NetworkConfig::grnet();
        assert_eq!((millions(config.parameter_count()) * 10.0).round(), 857.0);
        assert_eq!(millions(config.multiply_adds_per_frame()).round(), 5146.0);
        // The log-variance heads are ours; the number holds without them as well.
        let paper = NetworkConfig { log_variance: false, ..config };
        assert_eq!((millions(paper.parameter_count()) * 10.0).round(), 857.0);
        assert_eq!(millions(paper.multiply_adds_per_frame()).round(), 5146.0);
    }

    #[test]
    fn cost_by_part_matches_the_specification() {
        let layers = NetworkConfig::grnet().layers();
        let cost = |prefix: &str| {
            let of_part = layers.iter().filter(|l| l.name.starts_with(prefix));
            millions(of_part.map(Layer::multiply_adds).sum::<usize>()).round()
        };
        assert_eq!(cost("cnn1."), 3278.0);
        assert_eq!(cost("rcnn1.res5"), 1015.0);
        assert_eq!(cost("rcnn2.res5"), 809.0);
        assert_eq!(cost("rcnn1.lstm") + cost("rcnn2.lstm"), 40.0);
    }

    #[test]
    fn names_are_unique() {
        let mut names: Vec<_> = NetworkConfig::grnet_small().tensors().into_iter().map(|t| t.name).collect();
        let count = names.len();
        names.sort();
        names.dedup();
        assert_eq!(names.len(), count);
    }

    #[test]
    fn a_rerun_costs_the_recurrent_part_k_times() {
        let carry = NetworkConfig::grnet();
        let rerun = NetworkConfig { recurrence: crate::Recurrence::RerunLastK, ..carry.clone() };
        let lstm = 2 * 4 * 1000 * (2048 + 1000 + 2000);
        assert_eq!(rerun.multiply_adds_per_frame() - carry.multiply_adds_per_frame(), 4 * lstm);
    }
}
