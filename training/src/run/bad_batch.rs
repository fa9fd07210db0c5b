//! The batch that made a loss not finite, kept for whoever looks for the reason.

use std::collections::BTreeMap;
use std::path::PathBuf;

use candle_core::{DType, Tensor};
use serde::Serialize;

use super::number::Number;
use super::{RunError, RunFolder, atomic};

/// What bad-batch-N.json says; the tensors are in the safetensors file beside it.
#[derive(Serialize)]
struct Description<'a> {
    step: u64,
    names: &'a [String],
    values: BTreeMap<&'a str, Number>,
    tensors: BTreeMap<&'a str, Summary>,
}

#[derive(Serialize)]
struct Summary {
    shape: Vec<usize>,
    not_finite: usize,
    /// Of the finite values.
    smallest: Option<f64>,
    largest: Option<f64>,
}

impl RunFolder {
    /// Writes `bad-batch-<step>.safetensors` (`images` and the other tensors, by name) and a JSON file of the same name
    /// with the frames' names, `values` (parts of the loss, norm of the gradient...) and what is wrong with each tensor.
    /// Gives back the path of the former.
    ///
    /// # Errors
    /// When a tensor cannot be read from its device or a file cannot be written.
    pub fn save_bad_batch(
        &self,
        step: u64,
        names: &[String],
        images: &Tensor,
        others: &[(&str, &Tensor)],
        values: &BTreeMap<String, f64>,
    ) -> Result<PathBuf, RunError> {
        let path = self.path().join(format!("bad-batch-{step:08}.safetensors"));
        let encode = |reason: String| RunError::Encode { path: path.clone(), reason };
        let tensors: BTreeMap<&str, &Tensor> = others.iter().copied().chain([("images", images)]).collect();
        let mut summaries = BTreeMap::new();
        for (name, tensor) in &tensors {
            summaries
                .insert(*name, summary(tensor).map_err(|error| encode(format!("tensor {name}: {error}")))?);
        }
        let values = values.iter().map(|(name, value)| (name.as_str(), Number(*value))).collect();
        let description = Description { step, names, values, tensors: summaries };
        let json = serde_json::to_string_pretty(&description).map_err(|error| encode(error.to_string()))?;
        let bytes = safetensors::serialize(tensors, None).map_err(|error| encode(error.to_string()))?;
        atomic::replace(&path, &bytes)?;
        atomic::replace(&path.with_extension("json"), (json + "\n").as_bytes())?;
        Ok(path)
    }
}

fn summary(tensor: &Tensor) -> candle_core::Result<Summary> {
    let values: Vec<f64> = tensor.to_dtype(DType::F64)?.flatten_all()?.to_vec1()?; // any shape -> row-major values
    let finite = || values.iter().copied().filter(|value| value.is_finite());
    Ok(Summary {
        shape: tensor.dims().to_vec(),
        not_finite: values.len() - finite().count(),
        smallest: finite().reduce(f64::min),
        largest: finite().reduce(f64::max),
    })
}
