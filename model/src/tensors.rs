//! Stored tensors: the two element types of a checkpoint, their bytes and their hash.

use std::borrow::Cow;
use std::collections::BTreeMap;

use candle_core::{DType, Device, Tensor};
use half::f16;
use safetensors::Dtype;
use safetensors::tensor::View;
use sha2::{Digest, Sha256};

/// Values of one tensor, row-major.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Values {
    F32(Vec<f32>),
    F16(Vec<f16>),
}

/// One tensor of a checkpoint.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct StoredTensor {
    pub(crate) shape: Vec<usize>,
    pub(crate) values: Values,
}

pub(crate) type Tensors = BTreeMap<String, StoredTensor>;

impl StoredTensor {
    /// From the bytes of a file; none when the element type is neither F32 nor F16 or the length does not fit.
    pub(crate) fn from_bytes(dtype: Dtype, shape: &[usize], bytes: &[u8]) -> Option<Self> {
        let values = match dtype {
            Dtype::F32 => {
                let (words, rest) = bytes.as_chunks::<4>();
                rest.is_empty()
                    .then(|| Values::F32(words.iter().map(|w| f32::from_le_bytes(*w)).collect()))?
            }
            Dtype::F16 => {
                let (words, rest) = bytes.as_chunks::<2>();
                rest.is_empty()
                    .then(|| Values::F16(words.iter().map(|w| f16::from_le_bytes(*w)).collect()))?
            }
            _ => return None,
        };
        Some(Self { shape: shape.to_vec(), values })
    }

    /// From any float tensor, stored as f32.
    pub(crate) fn from_tensor(tensor: &Tensor) -> candle_core::Result<Self> {
        let values = tensor.to_dtype(DType::F32)?.flatten_all()?.to_vec1()?; // any shape -> row-major values
        Ok(Self { shape: tensor.dims().to_vec(), values: Values::F32(values) })
    }

    pub(crate) fn into_tensor(self, device: &Device) -> candle_core::Result<Tensor> {
        let values = match self.values {
            Values::F32(values) => values,
            Values::F16(values) => values.into_iter().map(f16::to_f32).collect(),
        };
        Tensor::from_vec(values, self.shape, device)
    }

    pub(crate) fn into_f16(self) -> Self {
        let values = match self.values {
            Values::F32(values) => Values::F16(values.into_iter().map(f16::from_f32).collect()),
            half => half,
        };
        Self { values, ..self }
    }

    pub(crate) fn into_f32(self) -> Self {
        let values = match self.values {
            Values::F16(values) => Values::F32(values.into_iter().map(f16::to_f32).collect()),
            single => single,
        };
        Self { values, ..self }
    }

    /// The first value that is not finite, or negative where `negative_allowed` is false.
    pub(crate) fn bad_value(&self, negative_allowed: bool) -> Option<f32> {
        let bad = |v: f32| !v.is_finite() || (v < 0.0 && !negative_allowed);
        match &self.values {
            Values::F32(values) => values.iter().copied().find(|v| bad(*v)),
            Values::F16(values) => values.iter().map(|v| v.to_f32()).find(|v| bad(*v)),
        }
    }

    pub(crate) fn dtype_name(&self) -> &'static str {
        match self.values {
            Values::F32(_) => "F32",
            Values::F16(_) => "F16",
        }
    }

    fn bytes(&self) -> Vec<u8> {
        match &self.values {
            Values::F32(values) => values.iter().flat_map(|v| v.to_le_bytes()).collect(),
            Values::F16(values) => values.iter().flat_map(|v| v.to_le_bytes()).collect(),
        }
    }
}

impl View for &StoredTensor {
    fn dtype(&self) -> Dtype {
        match self.values {
            Values::F32(_) => Dtype::F32,
            Values::F16(_) => Dtype::F16,
        }
    }

    fn shape(&self) -> &[usize] {
        &self.shape
    }

    fn data(&self) -> Cow<'_, [u8]> {
        Cow::Owned(self.bytes())
    }

    fn data_len(&self) -> usize {
        match &self.values {
            Values::F32(values) => 4 * values.len(),
            Values::F16(values) => 2 * values.len(),
        }
    }
}

/// SHA-256 over the tensors sorted by name: length of the name (u64), name, element type ("F32" or "F16"), number of
/// dimensions (u64), dimensions (u64 each), values; all numbers little-endian.
pub(crate) fn content_hash<'a>(tensors: impl Iterator<Item = (&'a String, &'a StoredTensor)>) -> [u8; 32] {
    let mut hash = Sha256::new();
    for (name, tensor) in tensors {
        hash.update((name.len() as u64).to_le_bytes());
        hash.update(name.as_bytes());
        hash.update(tensor.dtype_name().as_bytes());
        hash.update((tensor.shape.len() as u64).to_le_bytes());
        for side in &tensor.shape {
            hash.update((*side as u64).to_le_bytes());
        }
        hash.update(tensor.bytes());
    }
    hash.finalize().into()
}

pub(crate) fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}
