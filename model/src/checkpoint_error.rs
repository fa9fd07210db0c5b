//! Why a checkpoint could not be read, written or put together.

use std::path::PathBuf;

use crate::metadata::Kind;
use crate::network::ModelError;

/// Why a checkpoint could not be read, written or put together.
#[derive(Debug, thiserror::Error)]
pub enum CheckpointError {
    /// The file system refused.
    #[error("cannot {action} {}", path.display())]
    Io {
        /// What was tried.
        action: &'static str,
        /// On which file.
        path: PathBuf,
        /// What the system says.
        #[source]
        source: std::io::Error,
    },
    /// Not a safetensors file, or one that was cut off.
    #[error("{} is no complete safetensors file", path.display())]
    NotSafetensors {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        #[source]
        source: safetensors::SafeTensorError,
    },
    /// The file could not be written as safetensors.
    #[error("cannot write {}", path.display())]
    Write {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        #[source]
        source: safetensors::SafeTensorError,
    },
    /// A safetensors file of somebody else.
    #[error(
        "{} is a safetensors file without the `grnet` entry in its metadata: not written by grnet-train \
         ({tensors} tensors, such as {example:?})",
        path.display()
    )]
    Foreign {
        /// The file.
        path: PathBuf,
        /// How many tensors it holds.
        tensors: usize,
        /// The name of one of them.
        example: String,
    },
    /// The metadata is of another version.
    #[error("{} has metadata of schema {found}; this version reads schema {known}", path.display())]
    Schema {
        /// The file.
        path: PathBuf,
        /// What stands under `schema`.
        found: String,
        /// The schema that can be read.
        known: u32,
    },
    /// The metadata is not what its schema says.
    #[error("the `grnet` metadata of {} cannot be read", path.display())]
    Metadata {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        #[source]
        source: serde_json::Error,
    },
    /// The metadata contradicts itself or holds a value out of range.
    #[error("the `grnet` metadata of {} is not usable: {problem}", path.display())]
    Inconsistent {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        problem: String,
    },
    /// The tensors are not those of the network in the metadata.
    #[error("{} does not hold the tensors of its {kind} network: {problems}", path.display())]
    Tensors {
        /// The file.
        path: PathBuf,
        /// What the file claims to be.
        kind: Kind,
        /// Missing, surplus and misshapen tensors by name, found against expected.
        problems: String,
    },
    /// A weight is NaN or infinite, or a variance negative.
    #[error("tensor {tensor} of {} holds {found}; {expected} expected", path.display())]
    Value {
        /// The file.
        path: PathBuf,
        /// The tensor's name.
        tensor: String,
        /// The value.
        found: f32,
        /// What it must be.
        expected: &'static str,
    },
    /// The tensors are not those that were saved.
    #[error(
        "{} is damaged: its tensors hash to {found}, its metadata says {expected}; copy the file again",
        path.display()
    )]
    Hash {
        /// The file.
        path: PathBuf,
        /// The hash in the metadata.
        expected: String,
        /// The hash of the tensors.
        found: String,
    },
    /// A file of another kind than needed.
    #[error("{} is a {found} file where {needed} is needed", path.display())]
    Kind {
        /// The file.
        path: PathBuf,
        /// Its kind.
        found: Kind,
        /// What is needed.
        needed: &'static str,
    },
    /// A scene was given with a trunk that it was not trained on.
    #[error(
        "scene {} belongs to trunk {wanted}, but the trunk of {} is {found}; use the trunk that the scene was trained on",
        scene.display(), trunk.display()
    )]
    TrunkMismatch {
        /// The scene's file.
        scene: PathBuf,
        /// The trunk's file.
        trunk: PathBuf,
        /// The hash that the scene wants.
        wanted: String,
        /// The hash of the trunk.
        found: String,
    },
    /// Trunk and scene agree by hash but not in what they say about themselves.
    #[error("scene {} and trunk {} differ in {what}", scene.display(), trunk.display())]
    PartsDiffer {
        /// The scene's file.
        scene: PathBuf,
        /// The trunk's file.
        trunk: PathBuf,
        /// In which part of the metadata, with both values.
        what: String,
    },
    /// The file alone has nothing to run.
    #[error("{} is a trunk without RCNN1: nothing to run without a scene file", path.display())]
    NothingToRun {
        /// The file.
        path: PathBuf,
    },
    /// A tensor operation failed while weights were converted.
    #[error("cannot convert tensor {tensor}")]
    Convert {
        /// The tensor's name.
        tensor: String,
        /// What candle says.
        #[source]
        source: candle_core::Error,
    },
    /// The network could not be built.
    #[error(transparent)]
    Model(#[from] ModelError),
}
