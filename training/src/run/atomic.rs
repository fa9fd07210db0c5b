//! Files that are there as a whole or not at all.

use std::fs::{self, File};
use std::io::Write;
use std::path::{Path, PathBuf};

use super::RunError;
use super::error::{io, write};

/// Ending of files that are being written; one that a killed process left behind means nothing.
pub(super) const PARTIAL: &str = "partial";

/// Where the content of `path` is put together.
pub(super) fn partial(path: &Path) -> PathBuf {
    let mut name = path.as_os_str().to_owned();
    name.push(".");
    name.push(PARTIAL);
    name.into()
}

/// Replaces `path` by a file of these bytes. Readers see the old or the new content; after a loss of power too.
pub(super) fn replace(path: &Path, bytes: &[u8]) -> Result<(), RunError> {
    let from = stage(path, bytes)?;
    fs::rename(&from, path).map_err(io("replace", path))?;
    sync_folder_of(path)
}

/// Writes the bytes to the disk beside `path`, to be renamed; leaves nothing behind when that fails.
pub(super) fn stage(path: &Path, bytes: &[u8]) -> Result<PathBuf, RunError> {
    let from = partial(path);
    let written = File::create(&from).and_then(|mut file| {
        file.write_all(bytes)?;
        file.sync_all()
    });
    if let Err(error) = written {
        // The room is wanted back; that the file may be gone already, or stay, changes nothing about the error.
        let _ = fs::remove_file(&from);
        return Err(write(path, bytes.len() as u64)(error));
    }
    Ok(from)
}

/// Makes renames in the folder of `path` last.
pub(super) fn sync_folder_of(path: &Path) -> Result<(), RunError> {
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    File::open(folder).and_then(|folder| folder.sync_all()).map_err(io("flush the folder of", path))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn files_are_replaced_and_nothing_stays_beside_them() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.json");
        replace(&path, b"old").unwrap();
        replace(&path, b"new").unwrap();
        assert_eq!(fs::read(&path).unwrap(), b"new");
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1);
    }

    #[test]
    fn what_cannot_be_written_is_named() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("gone/a.json");
        let error = replace(&path, b"x").unwrap_err();
        assert!(
            matches!(&error, RunError::Io { action: "write", path: named, .. } if *named == path),
            "{error}"
        );
    }
}
