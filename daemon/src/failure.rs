//! How the daemon ends: exit codes (those of `sysexits.h`) and the error behind them.

use std::process::ExitCode;

use grnet_proto::TransportError;

/// What kind of failure ends the daemon.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// 69: something else is in the way (the name is taken, shared memory is full): a later start may work.
    Unavailable,
    /// 70: a defect, or something that should not happen.
    Internal,
    /// 77: missing rights.
    Permission,
    /// 78: configuration, checkpoint or recording; starting again changes nothing.
    Config,
}

impl Kind {
    /// The exit code.
    pub const fn code(self) -> u8 {
        match self {
            Self::Unavailable => 69,
            Self::Internal => 70,
            Self::Permission => 77,
            Self::Config => 78,
        }
    }
}

/// An error that ends the daemon, with its kind.
#[derive(Debug)]
pub struct Failure {
    /// Decides the exit code.
    pub kind: Kind,
    /// Printed once, with its whole chain.
    pub error: anyhow::Error,
}

impl Failure {
    /// A failure of a known kind.
    pub fn new(kind: Kind, error: impl Into<anyhow::Error>) -> Self {
        Self { kind, error: error.into() }
    }

    /// Something that should not happen.
    pub fn internal(message: impl Into<String>) -> Self {
        Self::new(Kind::Internal, anyhow::Error::msg(message.into()))
    }

    /// A configuration that cannot be run.
    pub fn config(error: impl Into<anyhow::Error>) -> Self {
        Self::new(Kind::Config, error)
    }

    /// The exit code.
    pub fn exit_code(&self) -> ExitCode {
        ExitCode::from(self.kind.code())
    }

    /// The error and its causes in one line; a cause that its parent already quotes is not repeated.
    pub fn chain(&self) -> String {
        let mut text = String::new();
        for cause in self.error.chain().map(ToString::to_string) {
            if text.is_empty() {
                text = cause;
            } else if !text.ends_with(&cause) {
                text = format!("{text}: {cause}");
            }
        }
        text
    }
}

impl From<TransportError> for Failure {
    fn from(error: TransportError) -> Self {
        use TransportError as E;
        let kind = match &error {
            E::PermissionDenied { .. } | E::WrongFolder { .. } | E::NotMember { .. } => Kind::Permission,
            E::AccessNotBuilt { .. } | E::UnusableRoot { .. } => Kind::Config,
            E::Internal { .. } => Kind::Internal,
            _ => Kind::Unavailable,
        };
        Self::new(kind, error)
    }
}

#[cfg(test)]
mod tests {
    use anyhow::Context as _;

    use super::*;

    #[test]
    fn the_chain_says_everything_once() {
        let io = std::io::Error::other("disk on fire");
        let error = Err::<(), _>(io).context("cannot read x").unwrap_err();
        assert_eq!(Failure::config(error).chain(), "cannot read x: disk on fire");
        let quoting = anyhow::Error::msg("inner").context("outer: inner");
        assert_eq!(Failure::config(quoting).chain(), "outer: inner");
    }

    #[test]
    fn transport_errors_have_their_codes() {
        let code = |error: TransportError| Failure::from(error).kind.code();
        assert_eq!(code(TransportError::AlreadyPublished { service: "s".into() }), 69);
        assert_eq!(code(TransportError::AccessNotBuilt { mode: "group" }), 78);
        let denied = TransportError::PermissionDenied { path: "/".into(), owner: 0, user: 1, remedy: "r" };
        assert_eq!(code(denied), 77);
    }
}
