//! Why a training stops.

use std::path::PathBuf;

use grnet_model::{CheckpointError, ModelError};

use crate::data::DataError;
use crate::evaluate::EvaluateError;
use crate::import::ImportError;
use crate::loss::Head;
use crate::run::RunError;

/// A recipe that cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum ConfigError {
    /// The file cannot be read.
    #[error("cannot read the recipe {path}")]
    Read {
        /// The recipe.
        path: PathBuf,
        /// What the system says.
        #[source]
        source: std::io::Error,
    },
    /// The file is no recipe.
    #[error("{path} is not a recipe")]
    Parse {
        /// The recipe.
        path: PathBuf,
        /// Line, key and what is allowed there.
        #[source]
        source: Box<toml::de::Error>,
    },
    /// A value cannot be used.
    #[error("{path}: {key}: {problem}")]
    Value {
        /// The recipe.
        path: PathBuf,
        /// The key.
        key: String,
        /// What was found, what is allowed.
        problem: String,
    },
}

/// Why a training stopped; what was saved before stays good.
#[derive(Debug, thiserror::Error)]
pub enum TrainError {
    /// The recipe cannot be used.
    #[error(transparent)]
    Config(Box<ConfigError>),
    /// Training data cannot be read.
    #[error("cannot get training windows")]
    Data(#[source] Box<DataError>),
    /// The recording cannot be opened.
    #[error(transparent)]
    Evaluate(Box<EvaluateError>),
    /// The run folder cannot be used.
    #[error(transparent)]
    Run(Box<RunError>),
    /// A checkpoint cannot be read or written.
    #[error(transparent)]
    Checkpoint(Box<CheckpointError>),
    /// The network cannot be built or run.
    #[error(transparent)]
    Model(Box<ModelError>),
    /// Foreign weights cannot be taken over.
    #[error(transparent)]
    Import(Box<ImportError>),
    /// A tensor operation failed.
    #[error("a tensor operation failed")]
    Tensor(#[from] candle_core::Error),
    /// A tensor that the network does not have.
    #[error("there is no tensor {tensor} in this network")]
    UnknownTensor {
        /// Its name.
        tensor: String,
    },
    /// A loss asks for a head that the network did not give.
    #[error("the network gave no {head} pose; is that branch part of it?")]
    MissingHead {
        /// The head.
        head: Head,
    },
    /// Every weight is zero.
    #[error("the stage weighs no head: there is nothing to minimise")]
    NoLoss,
    /// The loss or its gradient is not finite.
    #[error(
        "stage {stage}, step {step}: the {what} is not finite ({parts}); the batch is kept in {batch}, the last good state in the run folder; \
         lower learning_rate, or look at that batch"
    )]
    NotFinite {
        /// Name of the stage.
        stage: String,
        /// Step over all stages.
        step: u64,
        /// `loss` or `gradient`.
        what: &'static str,
        /// The terms.
        parts: String,
        /// Where the batch was saved.
        batch: PathBuf,
    },
    /// A saved state does not fit.
    #[error("the saved state of the run lacks {what}; start the run anew in another folder")]
    State {
        /// What it lacks.
        what: String,
    },
    /// Saved moments do not fit.
    #[error("the saved state of the run does not fit its parameters")]
    Adam(#[from] grnet_model::ops::AdamError),
    /// Threads cannot be started.
    #[error("cannot start the computing threads")]
    Threads(#[from] rayon::ThreadPoolBuildError),
}

/// The errors of the parts are large and rare: kept behind a pointer.
macro_rules! boxed {
    ($($variant:ident: $error:ty),* $(,)?) => {$(
        impl From<$error> for TrainError {
            fn from(error: $error) -> Self {
                Self::$variant(Box::new(error))
            }
        }
    )*};
}

boxed!(
    Config: ConfigError,
    Data: DataError,
    Evaluate: EvaluateError,
    Run: RunError,
    Checkpoint: CheckpointError,
    Model: ModelError,
    Import: ImportError,
);
