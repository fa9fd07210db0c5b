//! Public ResNet-50 weights as a start: CNN1 and the two Res5 from ImageNet, everything else as drawn.
//!
//! Files are safetensors with the keys of torchvision's `resnet50`; timm's `resnet50` has the same. The bare names may
//! stand behind `model.`, `module.` or `backbone.`; a classifier and batch counters may be there and are left out. Variants
//! of another shape (`resnet50d`, ResNeXt, wide, deeper) are refused.
//!
//! | in the file | here |
//! |---|---|
//! | `conv1`, `bn1`, `layer1` .. `layer3` | CNN1, the same names behind `cnn1.` |
//! | `layer4` | `rcnn2.res5` |
//! | `layer4` | `rcnn1.res5`; it reads two frames, so the weights that read its input (`0.conv1`, `0.downsample.0`) are tiled along their inputs and halved: on two equal frames it gives what `layer4` gives on one |
//!
//! What to expect: these weights were trained with ReLU, and here stands ELU. Positive values pass both unchanged; where ReLU
//! gives 0, ELU gives a number down to -1, so the features of an imported, untrained network are close to but not those of
//! the public one, and its batch-norm statistics are off accordingly. Fine-tuning takes care of both within the first few
//! hundred steps as long as batch norm is trained; do not freeze it at the imported statistics. The weights expect
//! [`grnet_model::Preprocessing::default`], the mean and deviation of ImageNet, and the stride on the 3x3 convolution
//! (ResNet "v1.5"), as both libraries have them.

mod error;
mod hub;
mod source;

use std::collections::BTreeMap;
use std::path::Path;

use candle_core::{Device, Tensor};
use grnet_model::{NetworkConfig, TensorSpec};

pub use error::ImportError;
pub use hub::resolve;

use source::SourceTensor;

/// The tensors of a network that a ResNet-50 file gives, by checkpoint key, in f32 on the CPU: those of CNN1 and of the Res5
/// of every branch the network has.
///
/// # Errors
/// When the network is not of ResNet-50's size (width 1, 2048 channels in Res5), or the file cannot be read or holds
/// something else.
pub fn resnet50(path: &Path, config: &NetworkConfig) -> Result<BTreeMap<String, Tensor>, ImportError> {
    if config.width != 1.0 {
        let found = config.width.to_string();
        return Err(ImportError::Network { field: "width", found, needed: "1" });
    }
    if config.res5_channels != 2048 {
        let found = config.res5_channels.to_string();
        return Err(ImportError::Network { field: "res5_channels", found, needed: "2048" });
    }
    of_any_width(path, config)
}

/// As [`resnet50`] for a file of the network's own width.
fn of_any_width(path: &Path, config: &NetworkConfig) -> Result<BTreeMap<String, Tensor>, ImportError> {
    let mut wanted = BTreeMap::new();
    let mut targets = Vec::new();
    for spec in config.tensors() {
        let Some(origin) = Origin::of(&spec) else { continue };
        wanted.insert(origin.name.clone(), origin.shape.clone());
        targets.push((spec, origin));
    }
    let source = source::read(path, &wanted)?;
    let tensor = |(spec, origin): (TensorSpec, Origin)| {
        let tensor = origin.take(&source[&origin.name], &spec);
        let tensor = tensor.map_err(|source| ImportError::Tensor { path: path.to_owned(), source })?;
        Ok((spec.name, tensor))
    };
    targets.into_iter().map(tensor).collect()
}

/// Where a tensor of the network comes from.
struct Origin {
    /// Name in the file.
    name: String,
    /// Shape in the file.
    shape: Vec<usize>,
    /// Reads the features of two frames side by side.
    reads_two_frames: bool,
}

impl Origin {
    fn of(spec: &TensorSpec) -> Option<Self> {
        let (part, name) = spec.name.split_once('.')?;
        let name = match (part, name.split_once('.')) {
            ("cnn1", _) => name.to_owned(),
            ("rcnn1" | "rcnn2", Some(("res5", rest))) => format!("layer4.{rest}"),
            _ => return None,
        };
        let reads_two_frames = part == "rcnn1"
            && matches!(name.as_str(), "layer4.0.conv1.weight" | "layer4.0.downsample.0.weight");
        let mut shape = spec.shape.clone();
        if reads_two_frames {
            shape[1] /= 2; // (outputs, 2 C, 1, 1) -> (outputs, C, 1, 1)
        }
        Some(Self { name, shape, reads_two_frames })
    }

    fn take(&self, source: &SourceTensor, spec: &TensorSpec) -> candle_core::Result<Tensor> {
        let tensor = Tensor::from_slice(&source.values, source.shape.as_slice(), &Device::Cpu)?;
        let tensor = if self.reads_two_frames {
            let half = (tensor * 0.5)?;
            Tensor::cat(&[&half, &half], 1)? // 2 x (outputs, C, 1, 1) -> (outputs, 2 C, 1, 1)
        } else {
            tensor
        };
        debug_assert_eq!(tensor.dims(), spec.shape);
        Ok(tensor)
    }
}

#[cfg(test)]
mod tests;
