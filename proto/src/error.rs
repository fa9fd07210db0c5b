//! What can go wrong between daemon and clients.

use std::path::PathBuf;

/// A failure of the transport: what was tried, on what, what was found and what to do.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum TransportError {
    /// Nobody publishes this service.
    #[error(
        "no grnetd publishes {service} under {root}; start it (`systemctl start grnetd`, or `grnetd run --config FILE`), or name the camera it serves"
    )]
    NoDaemon {
        /// The service that was looked for.
        service: String,
        /// Where it was looked for.
        root: String,
    },

    /// Another daemon publishes this service.
    #[error(
        "another process already publishes {service}; one daemon serves one camera: stop the other one or choose another camera name"
    )]
    AlreadyPublished {
        /// The service.
        service: String,
    },

    /// The files of the transport belong to somebody else.
    #[error("{path} belongs to user {owner} and this program runs as user {user}, who may not use it; run as user {owner}, or give daemon and clients a root of their own ({remedy})", path = .path.display())]
    PermissionDenied {
        /// What could not be used.
        path: PathBuf,
        /// Numeric id of its owner.
        owner: u32,
        /// Numeric id of this process's effective user.
        user: u32,
        /// How a root of one's own is chosen.
        remedy: &'static str,
    },

    /// The folder that decides who may take part is closed to this user.
    #[error("{path} {problem}; {remedy}", path = .path.display())]
    NotMember {
        /// The folder.
        path: PathBuf,
        /// Whose it is, who this process is, and what it may not do.
        problem: String,
        /// What to do.
        remedy: String,
    },

    /// A folder that decides who may take part is missing, or not as it must be.
    #[error("{path} cannot decide who may take part: {problem}; `{remedy}`", path = .path.display())]
    WrongFolder {
        /// The folder.
        path: PathBuf,
        /// What is wrong, and whose it must be with which mode.
        problem: String,
        /// The command that mends it.
        remedy: String,
    },

    /// The daemon is there and shares in a way that this build of the client cannot join.
    #[error("the grnetd of {service} under {root} shares in a way that this build of the client cannot join: {reason}; use the client of the daemon's own package or build (feature `group-access`: {built})", root = .root.display(), built = built())]
    OtherBuild {
        /// The service.
        service: String,
        /// Where it was found.
        root: PathBuf,
        /// How the daemon shares, and what does not fit.
        reason: String,
    },

    /// The root folder of the transport cannot be used.
    #[error("cannot use {path} as the root of the shared-memory services: {problem}", path = .path.display())]
    UnusableRoot {
        /// The folder.
        path: PathBuf,
        /// What is wrong and what to do.
        problem: String,
    },

    /// The other side speaks another version.
    #[error(
        "{service} is of another version: found {found}, this program speaks {expected}; install the same grnet version for the daemon and all clients, and restart them"
    )]
    SchemaMismatch {
        /// The service.
        service: String,
        /// What the service is.
        found: String,
        /// What this build is.
        expected: String,
    },

    /// The service exists with other settings.
    #[error(
        "{service} exists with settings that do not fit ({problem}); it was created by a program that is no grnetd: stop that program and start grnetd first"
    )]
    Incompatible {
        /// The service.
        service: String,
        /// What does not fit.
        problem: String,
    },

    /// Every slot for subscribers is taken.
    #[error(
        "{service} already has {max} subscribers, which is all it admits; stop one of them (a killed one frees its place by itself)"
    )]
    TooManySubscribers {
        /// The service.
        service: String,
        /// How many there may be.
        max: usize,
    },

    /// Shared memory is too small.
    #[error("{path} has {free_bytes} bytes free and {needed_bytes} are needed; free shared memory or enlarge it (`mount -o remount,size=...`)", path = .path.display())]
    NoSpace {
        /// The file system of shared memory.
        path: PathBuf,
        /// What is free.
        free_bytes: u64,
        /// What the services need at most.
        needed_bytes: u64,
    },

    /// This build does not contain the access mode.
    #[error(
        "access = \"{mode}\" is not part of this build, which offers \"user\"; set access = \"user\", or use the packaged build (feature `group-access`)"
    )]
    AccessNotBuilt {
        /// The mode that was asked for.
        mode: &'static str,
    },

    /// No answer in time.
    #[error("{service} did not answer within {waited_ms} ms")]
    NoAnswer {
        /// The service.
        service: String,
        /// How long was waited.
        waited_ms: u128,
    },

    /// Something that should not happen.
    #[error("cannot {attempt} {subject}: {cause}")]
    Internal {
        /// What was tried.
        attempt: &'static str,
        /// On what.
        subject: String,
        /// What iceoryx2 or the system said.
        cause: String,
    },
}

impl TransportError {
    pub(crate) fn internal(attempt: &'static str, subject: &str, cause: impl core::fmt::Display) -> Self {
        Self::Internal { attempt, subject: subject.to_owned(), cause: cause.to_string() }
    }
}

fn built() -> &'static str {
    if cfg!(feature = "group-access") { "this client has it" } else { "this client was built without it" }
}
