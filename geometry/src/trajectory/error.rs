use std::path::PathBuf;

use thiserror::Error;

/// A trajectory file that could not be read or written.
#[derive(Debug, Error)]
pub enum TrajectoryError {
    /// The file cannot be opened, read or written.
    #[error("cannot {action} trajectory {}: {source}", path.display())]
    Io {
        /// "read" or "write".
        action: &'static str,
        /// The file.
        path: PathBuf,
        /// What the system says.
        source: std::io::Error,
    },
    /// A line is not what the format asks for.
    #[error("{}:{line}: found {found}, expected {expected}", path.display())]
    Line {
        /// The file.
        path: PathBuf,
        /// Line number, from 1.
        line: usize,
        /// What stands there.
        found: String,
        /// What the format asks for.
        expected: String,
    },
    /// The file holds no pose.
    #[error("{}: found no pose, expected lines of {expected}", path.display())]
    Empty {
        /// The file.
        path: PathBuf,
        /// The format's columns.
        expected: &'static str,
    },
}

/// A pose that is not later than the one before it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Error)]
#[error("pose {index} has time {found_ns} ns, expected later than the pose before it ({previous_ns} ns)")]
pub struct NotIncreasing {
    /// Index of the offending pose, from 0.
    pub index: usize,
    /// Time of the pose before it.
    pub previous_ns: i64,
    /// Its own time.
    pub found_ns: i64,
}

impl NotIncreasing {
    pub(super) fn check(index: usize, previous_ns: i64, found_ns: i64) -> Result<(), Self> {
        if found_ns > previous_ns { Ok(()) } else { Err(Self { index, previous_ns, found_ns }) }
    }
}

/// Shortens a line for a message.
pub(super) fn quoted(text: &str) -> String {
    const LONGEST: usize = 60;
    match text.char_indices().nth(LONGEST) {
        Some((end, _)) => format!("{:?}...", &text[..end]),
        None => format!("{text:?}"),
    }
}
