//! Why a configuration was refused.

use std::fmt;
use std::path::PathBuf;

/// Where a key or value stands.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Origin {
    /// In the file.
    File {
        /// The file.
        path: PathBuf,
        /// Line, from 1.
        line: usize,
        /// Column in characters, from 1.
        column: usize,
    },
    /// In an override given on the command line.
    Override {
        /// Its text, `section.key=value`.
        text: String,
    },
    /// Nowhere: the value is missing.
    Missing {
        /// The file.
        path: PathBuf,
    },
}

impl fmt::Display for Origin {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::File { path, line, column } => write!(f, "{}:{line}:{column}", path.display()),
            Self::Override { text } => write!(f, "override `{text}`"),
            Self::Missing { path } => write!(f, "{}", path.display()),
        }
    }
}

/// Why a configuration was refused.
#[derive(Debug, thiserror::Error)]
pub enum ConfigError {
    /// The file is not there or cannot be read.
    #[error("cannot read the configuration {}: {source}; give an existing file with --config", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// An override is not of the form `section.key=value`.
    #[error("override `{text}`: {problem}; write --set section.key=value, for example --set source.pace=max")]
    Override {
        /// The override.
        text: String,
        /// What is wrong with it.
        problem: String,
    },
    /// The text is not TOML.
    #[error("{origin}: not TOML: {problem}")]
    Syntax {
        /// Where.
        origin: Box<Origin>,
        /// What the parser said.
        problem: String,
    },
    /// A key that grnetd does not know.
    #[error("{origin}: unknown key `{key}`; {hint}")]
    UnknownKey {
        /// Where.
        origin: Box<Origin>,
        /// The key with its section.
        key: String,
        /// The nearest known keys.
        hint: String,
    },
    /// A value of the wrong type or out of range.
    #[error("{origin}: {key} = {found}: {problem}; allowed: {allowed}")]
    Value {
        /// Where.
        origin: Box<Origin>,
        /// The key with its section.
        key: String,
        /// The value as written.
        found: String,
        /// What is wrong with it.
        problem: String,
        /// What it may be.
        allowed: &'static str,
    },
}
