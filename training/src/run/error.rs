//! Why a run could not be kept on the disk.

use std::io::{Error, ErrorKind};
use std::path::{Path, PathBuf};

/// What went wrong with a run folder, on what, and what to do.
#[derive(Debug, thiserror::Error)]
pub enum RunError {
    /// A new run was asked for where one is.
    #[error("{} already holds a run: add --resume to go on with it, or choose another folder", folder.display())]
    HoldsRun {
        /// The folder asked for.
        folder: PathBuf,
    },
    /// The folder holds things that no run wrote.
    #[error(
        "will not start a run in {}: it holds {}, which no run wrote; choose an empty or new folder",
        folder.display(),
        found.display()
    )]
    NotOurs {
        /// The folder asked for.
        folder: PathBuf,
        /// One thing found there.
        found: PathBuf,
    },
    /// There is nothing to resume.
    #[error("cannot resume in {}: it holds no run.json; leave --resume out to start a new run", folder.display())]
    NoRun {
        /// The folder asked for.
        folder: PathBuf,
    },
    /// Another process trains there.
    #[error(
        "cannot use {}: {holder} is training in it; wait for its end or choose another folder",
        folder.display()
    )]
    Busy {
        /// The folder asked for.
        folder: PathBuf,
        /// Who holds the lock, as far as it is known.
        holder: String,
    },
    /// The run in the folder is another one than what is to be resumed.
    #[error("cannot resume {}, since it would not end with the same weights:\n{}", folder.display(), differences.join("\n"))]
    Differs {
        /// The folder asked for.
        folder: PathBuf,
        /// What differs, and what to do about each.
        differences: Vec<String>,
    },
    /// run.json cannot be understood.
    #[error("cannot read {}: {reason}", path.display())]
    Record {
        /// The run.json.
        path: PathBuf,
        /// What is wrong with it.
        reason: String,
    },
    /// A state file is damaged.
    #[error("{} is damaged: {reason}", path.display())]
    DamagedState {
        /// The file.
        path: PathBuf,
        /// What was found.
        reason: String,
    },
    /// Neither the last state nor the one before it can be used.
    #[error(
        "no state of {} can be loaded: {}; restore one of them from a copy, or start a new run",
        folder.display(),
        problems.join("; ")
    )]
    NoGoodState {
        /// The run's folder.
        folder: PathBuf,
        /// What is wrong with the files that are there.
        problems: Vec<String>,
    },
    /// The state given to be saved contradicts itself.
    #[error(
        "cannot save the state of step {step}: tensor {name} has {found} values, but its shape {shape:?} asks for {expected}"
    )]
    Shape {
        /// Step of the state.
        step: u64,
        /// The tensor.
        name: String,
        /// Its shape.
        shape: Vec<usize>,
        /// Number of values that the shape asks for.
        expected: usize,
        /// Number of values that are there.
        found: usize,
    },
    /// A line of the log is not an entry.
    #[error("{}:{line} is not an entry of a log: {reason}; delete the line or restore the file", path.display())]
    Log {
        /// The log.
        path: PathBuf,
        /// Line, from 1.
        line: usize,
        /// What is wrong with it.
        reason: String,
    },
    /// The disk, a quota or a limit leaves no room.
    #[error(
        "no room for {}: {needed_bytes} bytes are to be written{free}; make room, then go on with --resume",
        path.display()
    )]
    NoSpace {
        /// The file.
        path: PathBuf,
        /// Its size.
        needed_bytes: u64,
        /// What the file system says of its free space.
        free: String,
        /// What the system said.
        source: Error,
    },
    /// A file or folder could not be read or written.
    #[error("cannot {action} {}", path.display())]
    Io {
        /// What was tried: `write`, `create`...
        action: &'static str,
        /// On what.
        path: PathBuf,
        /// What the system said.
        source: Error,
    },
    /// Something could not be put into its file format.
    #[error("cannot encode {}: {reason}", path.display())]
    Encode {
        /// The file.
        path: PathBuf,
        /// What the encoder said.
        reason: String,
    },
    /// Curves could not be drawn.
    #[error("cannot draw {}: {reason}", path.display())]
    Draw {
        /// The picture.
        path: PathBuf,
        /// What the library said.
        reason: String,
    },
}

/// For `map_err`: a failed `action` on `path`.
pub(super) fn io(action: &'static str, path: &Path) -> impl FnOnce(Error) -> RunError {
    move |source| RunError::Io { action, path: path.into(), source }
}

/// For `map_err`: writing `needed_bytes` to `path` failed, maybe for want of room.
pub(super) fn write(path: &Path, needed_bytes: u64) -> impl FnOnce(Error) -> RunError {
    move |source| match source.kind() {
        ErrorKind::StorageFull | ErrorKind::QuotaExceeded | ErrorKind::FileTooLarge => {
            RunError::NoSpace { path: path.into(), needed_bytes, free: free(path), source }
        }
        _ => RunError::Io { action: "write", path: path.into(), source },
    }
}

/// Free space of the file system of `path`, in words; nothing when it cannot be asked.
fn free(path: &Path) -> String {
    let folder = path.parent().unwrap_or(path);
    match rustix::fs::statvfs(folder) {
        Ok(found) => format!(", {} are free", found.f_bavail.saturating_mul(found.f_frsize)),
        Err(_) => String::new(),
    }
}
