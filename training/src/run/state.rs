//! The state of a training between two steps, and its file.
//!
//! The file is a safetensors file of F32 tensors. Its metadata holds one JSON text under [`METADATA_KEY`]: step, stage,
//! numbers, and a SHA-256 over all of it, so that a file that was cut off or has a flipped bit is never trained on.

use std::borrow::Cow;
use std::collections::{BTreeMap, HashMap};
use std::fs;
use std::io::ErrorKind;
use std::path::Path;

use safetensors::tensor::View;
use safetensors::{Dtype, SafeTensors};
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use super::RunError;
use super::error::io;

/// Key of the metadata text.
const METADATA_KEY: &str = "grnet.run_state";
/// Version of the file's layout.
const SCHEMA: u32 = 1;

/// Everything that a bit-exact resume needs.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct State {
    /// Steps done, over all stages.
    pub step: u64,
    /// Number of the stage that the next step belongs to.
    pub stage: usize,
    /// Weights, running statistics, moments of the optimiser (`adam.m.<name>`, `adam.v.<name>`), averages...
    pub tensors: BTreeMap<String, StateTensor>,
    /// Counters and positions of random streams. Finite numbers come back bit by bit; JSON knows no others.
    pub numbers: BTreeMap<String, serde_json::Value>,
}

/// One tensor of a state; its values come back bit by bit, NaN included.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct StateTensor {
    /// Lengths of the dimensions.
    pub shape: Vec<usize>,
    /// Row-major.
    pub values: Vec<f32>,
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Metadata {
    schema: u32,
    step: u64,
    stage: usize,
    numbers: BTreeMap<String, serde_json::Value>,
    sha256: String,
}

impl State {
    /// The bytes of the state's file.
    pub(super) fn to_bytes(&self, path: &Path) -> Result<Vec<u8>, RunError> {
        for (name, tensor) in &self.tensors {
            let (expected, found) = (tensor.shape.iter().product(), tensor.values.len());
            if expected != found {
                let (name, shape) = (name.clone(), tensor.shape.clone());
                return Err(RunError::Shape { step: self.step, name, shape, expected, found });
            }
        }
        let encode = |reason: String| RunError::Encode { path: path.into(), reason };
        let metadata = Metadata {
            schema: SCHEMA,
            step: self.step,
            stage: self.stage,
            numbers: self.numbers.clone(),
            sha256: self.hash(),
        };
        let json = serde_json::to_string(&metadata).map_err(|error| encode(error.to_string()))?;
        let header = HashMap::from([(METADATA_KEY.to_owned(), json)]);
        safetensors::serialize(&self.tensors, Some(header)).map_err(|error| encode(error.to_string()))
    }

    /// Reads a state's file; none when there is no such file.
    pub(super) fn read(path: &Path) -> Result<Option<Self>, RunError> {
        let bytes = match fs::read(path) {
            Ok(bytes) => bytes,
            Err(error) if error.kind() == ErrorKind::NotFound => return Ok(None),
            Err(error) => return Err(io("read", path)(error)),
        };
        let damaged = |reason: String| RunError::DamagedState { path: path.into(), reason };
        Self::from_bytes(&bytes).map(Some).map_err(damaged)
    }

    fn from_bytes(bytes: &[u8]) -> Result<Self, String> {
        let file = SafeTensors::deserialize(bytes).map_err(|error| error.to_string())?;
        let (_, header) = SafeTensors::read_metadata(bytes).map_err(|error| error.to_string())?;
        let json = header.metadata().as_ref().and_then(|texts| texts.get(METADATA_KEY));
        let json = json.ok_or_else(|| format!("its metadata has no {METADATA_KEY}"))?;
        let metadata: Metadata =
            serde_json::from_str(json).map_err(|error| format!("{METADATA_KEY} in its metadata: {error}"))?;
        if metadata.schema != SCHEMA {
            return Err(format!("its schema is {}, this program reads {SCHEMA}", metadata.schema));
        }
        let mut tensors = BTreeMap::new();
        for (name, view) in file.iter() {
            if view.dtype() != Dtype::F32 {
                return Err(format!("tensor {name} is {:?}, F32 expected", view.dtype()));
            }
            let (words, _) = view.data().as_chunks::<4>();
            let values = words.iter().map(|word| f32::from_le_bytes(*word)).collect();
            tensors.insert(name.to_owned(), StateTensor { shape: view.shape().to_vec(), values });
        }
        let state = Self { step: metadata.step, stage: metadata.stage, tensors, numbers: metadata.numbers };
        match state.hash() {
            hash if hash == metadata.sha256 => Ok(state),
            hash => Err(format!("its content has the hash {hash}, {} was written", metadata.sha256)),
        }
    }

    /// SHA-256 over step and stage (u64 each), the numbers' JSON text, then for each tensor sorted by name: name, number
    /// of dimensions (u64), dimensions (u64 each), values. Texts go with their length (u64); all is little-endian.
    fn hash(&self) -> String {
        let mut hash = Sha256::new();
        let text = |hash: &mut Sha256, text: &str| {
            hash.update((text.len() as u64).to_le_bytes());
            hash.update(text);
        };
        hash.update(self.step.to_le_bytes());
        hash.update((self.stage as u64).to_le_bytes());
        // Text keys and JSON values always have a JSON text.
        text(&mut hash, &serde_json::json!(self.numbers).to_string());
        for (name, tensor) in &self.tensors {
            text(&mut hash, name);
            hash.update((tensor.shape.len() as u64).to_le_bytes());
            for length in &tensor.shape {
                hash.update((*length as u64).to_le_bytes());
            }
            // In pieces, so that no second copy of a large tensor is made.
            for values in tensor.values.chunks(1 << 14) {
                hash.update(bytes_of(values));
            }
        }
        hash.finalize().iter().map(|byte| format!("{byte:02x}")).collect()
    }
}

impl View for &StateTensor {
    fn dtype(&self) -> Dtype {
        Dtype::F32
    }

    fn shape(&self) -> &[usize] {
        &self.shape
    }

    fn data(&self) -> Cow<'_, [u8]> {
        Cow::Owned(bytes_of(&self.values))
    }

    fn data_len(&self) -> usize {
        self.values.len() * size_of::<f32>()
    }
}

fn bytes_of(values: &[f32]) -> Vec<u8> {
    let mut bytes = vec![0; size_of_val(values)];
    for (word, value) in bytes.as_chunks_mut::<4>().0.iter_mut().zip(values) {
        *word = value.to_le_bytes();
    }
    bytes
}
