//! Checkpoints: safetensors files with the network's tensors and our metadata in the header.
//!
//! Nothing of a file is trusted: the metadata must parse and agree with itself, the tensors must be exactly those of
//! the network in the metadata, every weight finite, and the content hash right.

use std::collections::{BTreeSet, HashMap};
use std::io::Write as _;
use std::path::{Path, PathBuf};

use candle_core::{Device, Tensor};
use candle_nn::VarBuilder;
use safetensors::SafeTensors;

use crate::checkpoint_error::CheckpointError;
use crate::metadata::{CheckpointMetadata, SCHEMA};
use crate::tensors::{StoredTensor, Tensors, content_hash, hex};

/// Key of our entry in the safetensors metadata.
const METADATA_KEY: &str = "grnet";

/// How many tensors an error lists of each sort.
const LISTED: usize = 8;

/// Element type of the stored weights; they are f32 once loaded.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Storage {
    /// Single precision, exact.
    F32,
    /// Half precision: half the size.
    F16,
}

/// Weights and what is said about them, as stored: checked, hashed, not yet a network.
#[derive(Debug, Clone, PartialEq)]
pub struct Checkpoint {
    pub(crate) metadata: CheckpointMetadata,
    pub(crate) tensors: Tensors,
    pub(crate) origin: PathBuf,
}

impl Checkpoint {
    /// Weights that are not in a file yet, such as those of a training; stored as f32.
    ///
    /// The content hash of `metadata` is filled in.
    ///
    /// # Errors
    /// When the metadata contradicts itself, a tensor is missing, surplus, misshapen or not finite.
    pub fn new(
        metadata: CheckpointMetadata,
        tensors: &HashMap<String, Tensor>,
    ) -> Result<Self, CheckpointError> {
        let stored = |(name, tensor): (&String, &Tensor)| {
            StoredTensor::from_tensor(tensor)
                .map(|stored| (name.clone(), stored))
                .map_err(|source| CheckpointError::Convert { tensor: name.clone(), source })
        };
        let tensors = tensors.iter().map(stored).collect::<Result<_, _>>()?;
        Self::from_parts(metadata, tensors, PathBuf::from("a checkpoint in memory"))
    }

    /// Reads and checks a file.
    ///
    /// # Errors
    /// When the file cannot be read, is truncated, foreign, of another schema, damaged (content hash), or its tensors are
    /// not those of its network; the message names the file and the tensors.
    pub fn load(path: &Path) -> Result<Self, CheckpointError> {
        let io = |source| CheckpointError::Io { action: "read checkpoint", path: path.into(), source };
        // A device or a pipe could be read for ever.
        if !std::fs::metadata(path).map_err(io)?.is_file() {
            let source = std::io::Error::new(std::io::ErrorKind::InvalidInput, "not a regular file");
            return Err(io(source));
        }
        Self::from_bytes(&std::fs::read(path).map_err(io)?, path)
    }

    /// Checks the bytes of a file; `origin` is what errors name.
    ///
    /// # Errors
    /// As [`Checkpoint::load`].
    pub fn from_bytes(bytes: &[u8], origin: &Path) -> Result<Self, CheckpointError> {
        let path = || origin.to_path_buf();
        let not_safetensors = |source| CheckpointError::NotSafetensors { path: path(), source };
        let file = SafeTensors::deserialize(bytes).map_err(not_safetensors)?;
        let (_, header) = SafeTensors::read_metadata(bytes).map_err(not_safetensors)?;
        let Some(json) = header.metadata().as_ref().and_then(|entries| entries.get(METADATA_KEY)) else {
            let example = file.names().into_iter().min().unwrap_or_default().to_owned();
            return Err(CheckpointError::Foreign { path: path(), tensors: file.len(), example });
        };
        let metadata = parse_metadata(json, origin)?;
        let claimed_hash = metadata.content_hash.clone();
        let mut tensors = Tensors::new();
        for (name, view) in file.iter() {
            let Some(tensor) = StoredTensor::from_bytes(view.dtype(), view.shape(), view.data()) else {
                let problems = format!("{name} is of type {:?}; F32 or F16 expected", view.dtype());
                return Err(CheckpointError::Tensors { path: path(), kind: metadata.kind, problems });
            };
            tensors.insert(name.to_owned(), tensor);
        }
        let checkpoint = Self::from_parts(metadata, tensors, path())?;
        if checkpoint.metadata.content_hash != claimed_hash {
            return Err(CheckpointError::Hash {
                path: path(),
                expected: claimed_hash,
                found: checkpoint.metadata.content_hash,
            });
        }
        Ok(checkpoint)
    }

    /// Writes the file in one step: a reader sees the old file or the new one, also after a loss of power.
    ///
    /// # Errors
    /// When the folder cannot be written to; the old file is then untouched.
    pub fn save(&self, path: &Path) -> Result<(), CheckpointError> {
        let folder = match path.parent() {
            Some(parent) if parent != Path::new("") => parent,
            _ => Path::new("."),
        };
        let io = |action| move |source| CheckpointError::Io { action, path: path.into(), source };
        let mut builder = tempfile::Builder::new();
        #[cfg(unix)]
        {
            // The umask still applies; a temporary file's own default would hide the weights from everybody else.
            use std::os::unix::fs::PermissionsExt;
            builder.permissions(std::fs::Permissions::from_mode(0o666));
        }
        let mut file = builder
            .prefix(".checkpoint-")
            .tempfile_in(folder)
            .map_err(io("create a temporary file beside"))?;
        let json = serde_json::to_string(&self.metadata)
            .map_err(|source| CheckpointError::Metadata { path: path.into(), source })?;
        let header = HashMap::from([(METADATA_KEY.to_owned(), json)]);
        // In memory first: the library's own way to a file neither flushes to the disk nor respects the umask.
        let bytes = safetensors::serialize(self.tensors.iter(), Some(header))
            .map_err(|source| CheckpointError::Write { path: path.into(), source })?;
        file.write_all(&bytes).map_err(io("write"))?;
        file.as_file().sync_all().map_err(io("flush"))?;
        file.persist(path).map_err(|error| io("replace")(error.error))?;
        std::fs::File::open(folder).and_then(|folder| folder.sync_all()).map_err(io("flush the folder of"))
    }

    /// What the checkpoint says about its weights.
    pub fn metadata(&self) -> &CheckpointMetadata {
        &self.metadata
    }

    /// SHA-256 over the tensors sorted by name: length of the name (u64), name, element type ("F32" or "F16"), number of
    /// dimensions (u64), dimensions (u64 each), values; all numbers little-endian. Hexadecimal.
    pub fn content_hash(&self) -> &str {
        &self.metadata.content_hash
    }

    /// The same weights with other metadata, such as a camera, a scene or trained heads.
    ///
    /// # Errors
    /// When the new metadata contradicts itself or the tensors.
    pub fn with_metadata(self, edit: impl FnOnce(&mut CheckpointMetadata)) -> Result<Self, CheckpointError> {
        let Self { mut metadata, tensors, origin } = self;
        edit(&mut metadata);
        Self::from_parts(metadata, tensors, origin)
    }

    /// The same weights in another element type; the content hash changes with it.
    ///
    /// A scene stays bound to the trunk it names, so convert a complete checkpoint before splitting it.
    ///
    /// # Errors
    /// When a weight does not fit half precision.
    pub fn with_storage(self, storage: Storage) -> Result<Self, CheckpointError> {
        let convert = match storage {
            Storage::F32 => StoredTensor::into_f32,
            Storage::F16 => StoredTensor::into_f16,
        };
        let tensors = self.tensors.into_iter().map(|(name, tensor)| (name, convert(tensor))).collect();
        Self::from_parts(self.metadata, tensors, self.origin)
    }

    /// Element type of the weights; single precision where a file mixes both.
    pub fn storage(&self) -> Storage {
        let half = self.tensors.values().all(|tensor| tensor.dtype_name() == "F16");
        if half && !self.tensors.is_empty() { Storage::F16 } else { Storage::F32 }
    }

    /// The weights as f32 tensors on a device, by name.
    ///
    /// # Errors
    /// When the device has no memory left.
    pub fn into_tensors(self, device: &Device) -> Result<HashMap<String, Tensor>, CheckpointError> {
        let tensors = self.tensors.into_iter().map(|(name, stored)| match stored.into_tensor(device) {
            Ok(tensor) => Ok((name, tensor)),
            Err(source) => Err(CheckpointError::Convert { tensor: name, source }),
        });
        tensors.collect()
    }

    /// The weights as f32 tensors on a device, ready for [`crate::Network::new`].
    ///
    /// # Errors
    /// When the device has no memory left.
    pub fn into_var_builder(self, device: &Device) -> Result<VarBuilder<'static>, CheckpointError> {
        let tensors = self.into_tensors(device)?;
        Ok(VarBuilder::from_tensors(tensors, candle_core::DType::F32, device))
    }

    /// Checks metadata and tensors against each other and fills in the hash.
    pub(crate) fn from_parts(
        mut metadata: CheckpointMetadata,
        tensors: Tensors,
        origin: PathBuf,
    ) -> Result<Self, CheckpointError> {
        if let Some(problem) = metadata.problem() {
            return Err(CheckpointError::Inconsistent { path: origin, problem });
        }
        if let Some(problems) = tensor_problems(&metadata, &tensors) {
            return Err(CheckpointError::Tensors { path: origin, kind: metadata.kind, problems });
        }
        for (name, tensor) in &tensors {
            let is_variance = name.ends_with(".running_var");
            if let Some(found) = tensor.bad_value(!is_variance) {
                let expected = if is_variance { "finite numbers, none negative," } else { "finite numbers" };
                return Err(CheckpointError::Value { path: origin, tensor: name.clone(), found, expected });
            }
        }
        metadata.content_hash = hex(&content_hash(tensors.iter()));
        Ok(Self { metadata, tensors, origin })
    }
}

fn parse_metadata(json: &str, origin: &Path) -> Result<CheckpointMetadata, CheckpointError> {
    let unreadable = |source| CheckpointError::Metadata { path: origin.into(), source };
    let value: serde_json::Value = serde_json::from_str(json).map_err(unreadable)?;
    // The version first: fields that it does not know would hide it.
    let schema = value.get("schema");
    if schema.and_then(serde_json::Value::as_u64) != Some(SCHEMA.into()) {
        let found = schema.map_or_else(|| "(none)".to_owned(), ToString::to_string);
        return Err(CheckpointError::Schema { path: origin.into(), found, known: SCHEMA });
    }
    // From the text again, so that a field given twice is refused and messages carry line and column.
    serde_json::from_str(json).map_err(unreadable)
}

/// Missing, surplus and misshapen tensors, if any.
fn tensor_problems(metadata: &CheckpointMetadata, tensors: &Tensors) -> Option<String> {
    let expected = metadata.network.tensors();
    let expected: Vec<_> = expected.iter().filter(|spec| metadata.kind.holds(&spec.name)).collect();
    let names: BTreeSet<_> = expected.iter().map(|spec| spec.name.as_str()).collect();
    let missing: Vec<_> = expected
        .iter()
        .filter(|spec| !tensors.contains_key(&spec.name))
        .map(|spec| format!("{} {:?}", spec.name, spec.shape))
        .collect();
    let surplus: Vec<_> = tensors
        .iter()
        .filter(|(name, _)| !names.contains(name.as_str()))
        .map(|(name, tensor)| format!("{name} {:?}", tensor.shape))
        .collect();
    let misshapen: Vec<_> = expected
        .iter()
        .filter_map(|spec| {
            let found = &tensors.get(&spec.name)?.shape;
            (*found != spec.shape).then(|| format!("{} is {found:?}, {:?} expected", spec.name, spec.shape))
        })
        .collect();
    let sorts = [("missing", missing), ("not of this network", surplus), ("of another shape", misshapen)];
    let problems: Vec<_> =
        sorts.iter().filter(|(_, list)| !list.is_empty()).map(|(sort, list)| listing(sort, list)).collect();
    (!problems.is_empty()).then(|| problems.join("; "))
}

fn listing(sort: &str, list: &[String]) -> String {
    let shown = list.iter().take(LISTED).map(String::as_str).collect::<Vec<_>>().join(", ");
    match list.len().saturating_sub(LISTED) {
        0 => format!("{} {sort}: {shown}", list.len()),
        more => format!("{} {sort}: {shown} and {more} more", list.len()),
    }
}
