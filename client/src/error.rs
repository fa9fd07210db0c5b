//! What a client can meet.

use std::time::Duration;

use grnet_proto::{ControlReply, TransportError};

/// Why a client did not get what it asked for. Every message says what to do.
#[derive(Debug, Clone, thiserror::Error)]
#[non_exhaustive]
pub enum ClientError {
    /// Nobody publishes.
    #[error("{0}")]
    NoDaemon(TransportError),
    /// This user may not subscribe, or not ask for what was asked.
    #[error("{0}")]
    PermissionDenied(TransportError),
    /// Daemon and client are of different versions.
    #[error("{0}")]
    SchemaMismatch(TransportError),
    /// The root that was configured cannot be used, or this build cannot join the daemon that is there.
    #[error("{0}")]
    BadConfiguration(TransportError),
    /// Every slot for subscribers is taken.
    #[error("{0}")]
    TooManySubscribers(TransportError),
    /// A daemon is there and gave nothing in time.
    #[error(
        "{service} gave no {expected} for {waited:?} although a daemon is there; see `grnet-client status`"
    )]
    Timeout {
        /// The service.
        service: String,
        /// What was waited for.
        expected: &'static str,
        /// How long was waited.
        waited: Duration,
    },
    /// The daemon refused or failed a request.
    #[error("the daemon answered {}: {}", .0.outcome, .0.message)]
    Refused(Box<ControlReply>),
    /// The request cannot be put into a message.
    #[error("{0:?} has {len} bytes, and a request carries at most 1024 without NUL", len = .0.len())]
    TooLong(String),
    /// Something that should not happen.
    #[error("{0}")]
    Internal(TransportError),
}

impl From<TransportError> for ClientError {
    fn from(error: TransportError) -> Self {
        match error {
            TransportError::NoDaemon { .. } => Self::NoDaemon(error),
            TransportError::PermissionDenied { .. } | TransportError::NotMember { .. } => {
                Self::PermissionDenied(error)
            }
            TransportError::SchemaMismatch { .. } | TransportError::Incompatible { .. } => {
                Self::SchemaMismatch(error)
            }
            TransportError::UnusableRoot { .. }
            | TransportError::AccessNotBuilt { .. }
            | TransportError::OtherBuild { .. } => Self::BadConfiguration(error),
            TransportError::TooManySubscribers { .. } => Self::TooManySubscribers(error),
            TransportError::NoAnswer { service, waited_ms } => Self::Timeout {
                service,
                expected: "answer",
                waited: Duration::from_millis(u64::try_from(waited_ms).unwrap_or(u64::MAX)),
            },
            _ => Self::Internal(error),
        }
    }
}
