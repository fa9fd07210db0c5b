//! One process per folder.

use std::fs::{File, TryLockError};
use std::io::{Read, Seek, Write};
use std::path::Path;

use super::RunError;
use super::error::io;

/// Name of the locked file.
pub(super) const LOCK: &str = "run.lock";

/// Held as long as this lives. The system lets go of it when the process ends, however it ends.
#[derive(Debug)]
pub(super) struct Lock(#[expect(dead_code, reason = "closing the file is what unlocks it")] File);

impl Lock {
    /// Takes the folder, or says who has it.
    pub(super) fn take(folder: &Path) -> Result<Self, RunError> {
        let path = folder.join(LOCK);
        let mut options = File::options();
        // What is in the file belongs to the holder, until the lock is ours.
        let mut file = options
            .read(true)
            .write(true)
            .create(true)
            .truncate(false)
            .open(&path)
            .map_err(io("create", &path))?;
        match file.try_lock() {
            Ok(()) => {}
            Err(TryLockError::WouldBlock) => {
                let mut text = String::new();
                // The number is a courtesy: without it the message is still right.
                let holder =
                    match file.read_to_string(&mut text).ok().and_then(|_| text.trim().parse::<u32>().ok()) {
                        Some(id) => format!("process {id}"),
                        None => "another process".into(),
                    };
                return Err(RunError::Busy { folder: folder.into(), holder });
            }
            Err(TryLockError::Error(error)) => return Err(io("lock", &path)(error)),
        }
        let id = format!("{}\n", std::process::id());
        file.set_len(0)
            .and_then(|()| file.rewind())
            .and_then(|()| file.write_all(id.as_bytes()))
            .map_err(super::error::write(&path, id.len() as u64))?;
        Ok(Self(file))
    }
}
