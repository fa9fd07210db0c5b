//! A safetensors file with the keys of torchvision's `resnet50` (timm's `resnet50` has the same), read and checked.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use half::{bf16, f16};
use safetensors::{Dtype, SafeTensors, tensor::TensorView};

use super::error::ImportError;

/// What training frameworks put before every key.
const PREFIXES: [&str; 6] = ["", "model.", "module.", "backbone.", "module.model.", "model.backbone."];

/// Problems named in an error before it only counts them.
const MAX_PROBLEMS: usize = 6;

/// A tensor in f32, row-major.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct SourceTensor {
    pub(super) shape: Vec<usize>,
    pub(super) values: Vec<f32>,
}

/// Reads the tensors of the wanted names and shapes; all of the network's must be there and nothing else but a classifier
/// (`fc`) of any size and counters.
pub(super) fn read(
    path: &Path,
    wanted: &BTreeMap<String, Vec<usize>>,
) -> Result<BTreeMap<String, SourceTensor>, ImportError> {
    let bytes = std::fs::read(path).map_err(|source| ImportError::Io { path: path.to_owned(), source })?;
    // A zip archive or a bare pickle of protocol 2 and up: torch.save.
    if bytes.starts_with(b"PK\x03\x04") || matches!(bytes[..], [0x80, 2..=5, ..]) {
        return Err(ImportError::Pickle { path: path.to_owned() });
    }
    let file = SafeTensors::deserialize(&bytes)
        .map_err(|source| ImportError::NotSafetensors { path: path.to_owned(), source })?;
    let names: BTreeSet<&str> = file.names().into_iter().collect();
    let prefix = PREFIXES.into_iter().find(|p| names.contains(format!("{p}conv1.weight").as_str()));
    let views: BTreeMap<&str, TensorView<'_>> = file
        .iter()
        .filter_map(|(name, view)| Some((name.strip_prefix(prefix.unwrap_or_default())?, view)))
        .collect();
    if let Some(problems) = problems(&views, &names, prefix, wanted) {
        return Err(ImportError::Layout { path: path.to_owned(), problems });
    }
    let tensor = |name: &String| Ok((name.clone(), decode(path, name, &views[name.as_str()])?));
    wanted.keys().map(tensor).collect()
}

/// Why these are not the tensors of a plain ResNet-50, if they are not.
fn problems(
    views: &BTreeMap<&str, TensorView<'_>>,
    names: &BTreeSet<&str>,
    prefix: Option<&str>,
    wanted: &BTreeMap<String, Vec<usize>>,
) -> Option<String> {
    let mut problems = Vec::new();
    let outside = names.len() - views.len();
    if outside > 0 {
        problems.push(format!("{outside} tensors do not begin with {:?}", prefix.unwrap_or_default()));
    }
    for (name, shape) in wanted {
        match views.get(name.as_str()) {
            None => problems.push(format!("{name} is missing")),
            Some(view) if view.shape() != shape => {
                problems.push(format!("{name} has shape {:?}, expected {shape:?}", view.shape()));
            }
            Some(_) => {}
        }
    }
    let known = |name: &str| {
        wanted.contains_key(name)
            || matches!(name, "fc.weight" | "fc.bias")
            || name
                .strip_suffix(".num_batches_tracked")
                .is_some_and(|bn| wanted.contains_key(&format!("{bn}.running_mean")))
    };
    let surplus = views.keys().filter(|name| !known(name)).map(|name| format!("{name} is surplus"));
    problems.extend(surplus);
    if problems.is_empty() {
        return None;
    }
    let ends_with = |end: &str| names.iter().any(|name| name.ends_with(end));
    let hint = if ends_with("conv1.0.weight") {
        "; a deep stem, as in timm's resnet50d, is another network"
    } else if names.iter().any(|name| name.contains("layer3.6.")) {
        "; a third stage of more than six units is a deeper ResNet"
    } else if names.iter().any(|name| name.contains("layer4.0.")) && !ends_with("layer4.0.conv3.weight") {
        "; units of two convolutions are those of ResNet-18 and 34"
    } else {
        ""
    };
    let more = problems.len().saturating_sub(MAX_PROBLEMS);
    problems.truncate(MAX_PROBLEMS);
    let more = if more > 0 { format!(", and {more} more") } else { String::new() };
    Some(format!("{}{more}{hint}", problems.join(", ")))
}

fn decode(path: &Path, name: &str, view: &TensorView<'_>) -> Result<SourceTensor, ImportError> {
    let bytes = view.data();
    let halves = || bytes.as_chunks::<2>().0.iter().copied();
    let values: Vec<f32> = match view.dtype() {
        Dtype::F32 => bytes.as_chunks::<4>().0.iter().map(|word| f32::from_le_bytes(*word)).collect(),
        Dtype::F16 => halves().map(|word| f16::from_le_bytes(word).to_f32()).collect(),
        Dtype::BF16 => halves().map(|word| bf16::from_le_bytes(word).to_f32()).collect(),
        other => {
            return Err(ImportError::ElementType {
                path: path.to_owned(),
                tensor: name.to_owned(),
                found: format!("{other:?}"),
            });
        }
    };
    let variance = name.ends_with(".running_var");
    let bad = |v: &f32| !v.is_finite() || (variance && *v < 0.0);
    if let Some(found) = values.iter().copied().find(bad) {
        let expected = if variance { "finite numbers of at least 0" } else { "finite numbers" };
        let path: PathBuf = path.to_owned();
        return Err(ImportError::Value { path, tensor: name.to_owned(), found, expected });
    }
    Ok(SourceTensor { shape: view.shape().to_vec(), values })
}
