//! The log: one JSON object per line.

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io::{ErrorKind, Write};
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use super::error::{io, write};
use super::{RunError, atomic, number};

/// What an entry tells of.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum LogKind {
    /// Steps of training.
    #[default]
    Train,
    /// A pass over held-out frames.
    Valid,
    /// Something that happened: a stage began, the run was resumed...
    Event,
}

/// One line of the log. Numbers that JSON does not know are written as `"NaN"`, `"inf"` and `"-inf"`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LogEntry {
    /// Steps done, over all stages.
    pub step: u64,
    /// Name of the stage.
    pub stage: String,
    /// What is told.
    pub kind: LogKind,
    /// Passes over the training frames in this stage.
    #[serde(default, with = "number::option", skip_serializing_if = "Option::is_none")]
    pub epoch: Option<f64>,
    /// The loss.
    #[serde(default, with = "number::option", skip_serializing_if = "Option::is_none")]
    pub loss: Option<f64>,
    /// Learning rate.
    #[serde(default, with = "number::option", skip_serializing_if = "Option::is_none")]
    pub lr: Option<f64>,
    /// Norm of the gradient before it was clipped.
    #[serde(default, with = "number::option", skip_serializing_if = "Option::is_none")]
    pub grad_norm: Option<f64>,
    /// Frames trained on per second.
    #[serde(default, with = "number::option", skip_serializing_if = "Option::is_none")]
    pub frames_per_s: Option<f64>,
    /// Time since the run began, without what passed between a stop and a resume, in seconds.
    #[serde(default, with = "number::option", skip_serializing_if = "Option::is_none")]
    pub elapsed_s: Option<f64>,
    /// More numbers by name. Those that end in `translation_m` and `rotation_deg` are drawn as errors.
    #[serde(default, with = "number::map", skip_serializing_if = "BTreeMap::is_empty")]
    pub values: BTreeMap<String, f64>,
    /// Words for people.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub message: Option<String>,
}

/// The entries of a log. A last line that a killed process did not complete is left out.
///
/// # Errors
/// When the file cannot be read or another line is not an entry.
pub fn read_log(path: &Path) -> Result<Vec<LogEntry>, RunError> {
    let bytes = fs::read(path).map_err(io("read", path))?;
    let complete = &bytes[..length_complete(&bytes)];
    let mut entries = Vec::new();
    for (n, line) in complete.split_inclusive(|byte| *byte == b'\n').enumerate() {
        let entry = serde_json::from_slice(line);
        let wrong = |error: serde_json::Error| RunError::Log {
            path: path.into(),
            line: n + 1,
            reason: error.to_string(),
        };
        entries.push(entry.map_err(wrong)?);
    }
    Ok(entries)
}

/// A log that is written to.
#[derive(Debug)]
pub(super) struct Log {
    path: PathBuf,
    file: File,
    length_bytes: u64,
}

impl Log {
    /// Opens the log to append to it, without a torn last line.
    pub(super) fn open(path: &Path) -> Result<Self, RunError> {
        let bytes = match fs::read(path) {
            Ok(bytes) => bytes,
            Err(error) if error.kind() == ErrorKind::NotFound => Vec::new(),
            Err(error) => return Err(io("read", path)(error)),
        };
        let file = File::options().append(true).create(true).open(path).map_err(io("open", path))?;
        let length_bytes = length_complete(&bytes) as u64;
        if length_bytes < bytes.len() as u64 {
            file.set_len(length_bytes).map_err(io("cut the torn last line off", path))?;
        }
        Ok(Self { path: path.into(), file, length_bytes })
    }

    pub(super) fn append(&mut self, entry: &LogEntry) -> Result<(), RunError> {
        let line = line_of(entry, &self.path)?;
        if let Err(error) = self.file.write_all(&line) {
            // Half a line would spoil the next one; when it cannot be cut off, `open` will do it.
            let _ = self.file.set_len(self.length_bytes);
            return Err(write(&self.path, line.len() as u64)(error));
        }
        self.length_bytes += line.len() as u64;
        Ok(())
    }

    pub(super) fn truncate(&mut self, after_step: u64) -> Result<(), RunError> {
        let entries = read_log(&self.path)?;
        if entries.iter().all(|entry| entry.step <= after_step) {
            return Ok(());
        }
        let mut bytes = Vec::new();
        for entry in entries.iter().filter(|entry| entry.step <= after_step) {
            bytes.extend(line_of(entry, &self.path)?);
        }
        atomic::replace(&self.path, &bytes)?;
        *self = Self::open(&self.path)?;
        Ok(())
    }

    /// Brings all entries to the disk.
    pub(super) fn sync(&self) -> Result<(), RunError> {
        self.file.sync_data().map_err(io("flush", &self.path))
    }
}

fn line_of(entry: &LogEntry, path: &Path) -> Result<Vec<u8>, RunError> {
    let encode = |error: serde_json::Error| RunError::Encode { path: path.into(), reason: error.to_string() };
    let mut line = serde_json::to_vec(entry).map_err(encode)?;
    line.push(b'\n');
    Ok(line)
}

/// Bytes up to the end of the last complete line.
fn length_complete(bytes: &[u8]) -> usize {
    bytes.iter().rposition(|byte| *byte == b'\n').map_or(0, |last| last + 1)
}
