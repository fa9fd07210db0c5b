//! The folders whose group and mode decide who may use what lies behind them. What lies behind is open to
//! everybody who got there, because clients of several users work on the same files.

use std::{
    fs::{self, DirBuilder, Permissions},
    io,
    os::unix::fs::{DirBuilderExt, MetadataExt, PermissionsExt},
    path::{Path, PathBuf},
};

use rustix::{
    fs::{CWD, Mode, OFlags, chown, openat},
    process::{Gid, getegid, geteuid},
};

use super::{
    AccessMode, Root,
    accounts::{Group, user, user_argument},
    root::Control,
};
use crate::TransportError;

/// Behind a gate: for whoever passed it.
const OPEN: u32 = 0o777;

/// Payload: written by its owner alone.
const READ_ONLY: u32 = 0o644;

/// Creates the folders of a daemon whose stream lies in files, or checks those that are there.
///
/// # Errors
/// [`TransportError::WrongFolder`] with what is wrong and the command that mends it.
pub(crate) fn open_gates(root: &Root, access: AccessMode) -> Result<(), TransportError> {
    let members = (access == AccessMode::Group)
        .then(|| root.group().cloned().unwrap_or_else(|| Group::of_id(getegid().as_raw())));
    open_gate(&root.path(), members.as_ref())?;
    if let Control::Group(group) = root.control() {
        open_gate(&root.control_folder(), Some(group))?;
    }
    Ok(())
}

/// Creates the folder of a stream that is for every local user, or checks that everybody gets there.
///
/// # Errors
/// [`TransportError::WrongFolder`] with what is wrong and the command that mends it.
pub(crate) fn open_to_everyone(root: &Root) -> Result<(), TransportError> {
    let folder = root.path();
    let place = |folder| Gate { folder, group: None, owner: geteuid().as_raw(), mode: OPEN };
    let all = place(&folder);
    if let Some(parent) = folder.parent() {
        fs::create_dir_all(parent).map_err(|error| all.not_created(error))?;
    }
    match fs::create_dir(&folder) {
        Ok(()) => fs::set_permissions(&folder, Permissions::from_mode(OPEN))
            .map_err(|error| all.wrong(format!("setting its mode failed ({error})")))?,
        Err(error) if error.kind() == io::ErrorKind::AlreadyExists => {}
        Err(error) => return Err(all.not_created(error)),
    }
    // Made by iceoryx2: by that of the ordinary build for one user.
    for part in [folder.clone(), folder.join("nodes"), folder.join("services")] {
        let Ok(metadata) = fs::metadata(&part) else { continue };
        if metadata.mode() & OPEN != OPEN {
            return Err(place(&part).is(&metadata));
        }
    }
    let closed = |path: &&Path| fs::metadata(path).is_ok_and(|metadata| metadata.mode() & 0o001 == 0);
    match folder.ancestors().skip(1).find(closed) {
        None => Ok(()),
        Some(path) => Err(TransportError::UnusableRoot {
            problem: format!(
                "{} above it is closed to other users; choose another publish.root",
                path.display()
            ),
            path: folder.clone(),
        }),
    }
}

/// Takes away the others' right to write to what this process publishes behind the gate `folder`.
///
/// # Errors
/// [`TransportError::Internal`] when the files cannot be found or changed.
pub(crate) fn protect_payload(root: &Root, folder: &Path) -> Result<(), TransportError> {
    let files = Root::behind(folder);
    let suffix = root.config().global.service.data_segment_suffix.to_string();
    let failed = |path: &Path, error: io::Error| {
        TransportError::internal("protect the payload in", &path.to_string_lossy(), error)
    };
    for entry in fs::read_dir(&files).map_err(|error| failed(&files, error))? {
        let path = entry.map_err(|error| failed(&files, error))?.path();
        if !path.as_os_str().to_string_lossy().ends_with(&suffix) {
            continue;
        }
        match protect(&path) {
            // Clients come and go beside this.
            Err(error) if error.kind() == io::ErrorKind::NotFound => {}
            done => done.map_err(|error| failed(&path, error))?,
        }
    }
    Ok(())
}

/// By descriptor: behind the gate, names may be moved by others. What is theirs is left alone.
fn protect(path: &Path) -> io::Result<()> {
    let flags = OFlags::RDONLY | OFlags::NOFOLLOW | OFlags::NONBLOCK | OFlags::CLOEXEC;
    let file = match openat(CWD, path, flags, Mode::empty()) {
        Ok(file) => fs::File::from(file),
        Err(rustix::io::Errno::LOOP | rustix::io::Errno::ACCESS) => return Ok(()),
        Err(error) => return Err(error.into()),
    };
    let metadata = file.metadata()?;
    if metadata.is_file() && metadata.uid() == geteuid().as_raw() && metadata.mode() & 0o022 != 0 {
        file.set_permissions(Permissions::from_mode(READ_ONLY))?;
    }
    Ok(())
}

/// For members of `group`, or for this user alone.
fn open_gate(folder: &Path, group: Option<&Group>) -> Result<(), TransportError> {
    let mode = if group.is_some() { 0o2750 } else { 0o700 };
    let gate = Gate { folder, group, owner: geteuid().as_raw(), mode };
    match fs::symlink_metadata(folder) {
        Ok(_) => {}
        Err(error) if error.kind() == io::ErrorKind::NotFound => gate.create()?,
        Err(error) => return Err(gate.wrong(format!("it cannot be looked at ({error})"))),
    }
    gate.check()?;
    gate.open_behind()
}

struct Gate<'a> {
    folder: &'a Path,
    group: Option<&'a Group>,
    owner: u32,
    mode: u32,
}

impl Gate<'_> {
    /// Made aside and moved into place: nobody sees it half made.
    fn create(&self) -> Result<(), TransportError> {
        let parent = self.folder.parent().unwrap_or(Path::new("/"));
        fs::create_dir_all(parent).map_err(|error| self.not_created(error))?;
        let draft = self.draft();
        DirBuilder::new().mode(0o700).create(&draft).map_err(|error| self.not_created(error))?;
        let moved = || fs::rename(&draft, self.folder).map_err(|error| self.not_created(error));
        let result = self.appoint(&draft).and_then(|()| moved());
        if result.is_err() {
            // The first error is the one that matters.
            let _ = fs::remove_dir(&draft);
        }
        // Another daemon that starts now may have been quicker; the check comes next.
        if self.folder.is_dir() { Ok(()) } else { result }
    }

    fn appoint(&self, folder: &Path) -> Result<(), TransportError> {
        let Some(group) = self.group else { return Ok(()) };
        chown(folder, None, Some(Gid::from_raw(group.id()))).map_err(|error| {
            self.wrong(format!(
                "giving it to group {group} failed ({error}): user {} is no member (systemd: SupplementaryGroups={}), or the sandbox forbids it",
                user(self.owner),
                group.argument()
            ))
        })?;
        // A sandbox may forbid the bit, which only says what the folder is for.
        fs::set_permissions(folder, Permissions::from_mode(0o2750))
            .or_else(|_| fs::set_permissions(folder, Permissions::from_mode(0o750)))
            .map_err(|error| self.wrong(format!("setting its mode failed ({error})")))
    }

    fn check(&self) -> Result<(), TransportError> {
        let metadata = fs::symlink_metadata(self.folder)
            .map_err(|error| self.wrong(format!("it cannot be looked at ({error})")))?;
        let right = metadata.is_dir()
            && metadata.uid() == self.owner
            && metadata.mode() & 0o777 == self.mode & 0o777
            && self.group.is_none_or(|wanted| wanted.id() == metadata.gid());
        if right { Ok(()) } else { Err(self.is(&metadata)) }
    }

    fn open_behind(&self) -> Result<(), TransportError> {
        let folder = Root::behind(self.folder);
        let failed = |error: io::Error| TransportError::UnusableRoot {
            path: folder.clone(),
            problem: format!("it cannot be made ready ({error}); remove it and start again"),
        };
        match DirBuilder::new().mode(0o700).create(&folder) {
            Err(error) if error.kind() != io::ErrorKind::AlreadyExists => return Err(failed(error)),
            _ => {}
        }
        let metadata = fs::symlink_metadata(&folder).map_err(failed)?;
        if !metadata.is_dir() {
            return Err(failed(io::Error::other("it is no folder")));
        }
        if metadata.mode() & 0o777 != OPEN {
            fs::set_permissions(&folder, Permissions::from_mode(OPEN)).map_err(failed)?;
        }
        Ok(())
    }

    fn draft(&self) -> PathBuf {
        let name = self.folder.file_name().unwrap_or_default().to_string_lossy();
        self.folder.with_file_name(format!(".{name}.{}.draft", std::process::id()))
    }

    fn not_created(&self, error: io::Error) -> TransportError {
        self.wrong(format!("it does not exist and creating it failed ({error})"))
    }

    fn is(&self, metadata: &fs::Metadata) -> TransportError {
        let kind = if metadata.is_dir() { "a folder" } else { "no folder" };
        let (user, group) = (user(metadata.uid()), Group::of_id(metadata.gid()));
        self.wrong(format!(
            "it is {kind} of user {user}, group {group}, mode {:04o}",
            metadata.mode() & 0o7777
        ))
    }

    fn wrong(&self, found: String) -> TransportError {
        let owner = user_argument(self.owner);
        let group = self.group.map_or_else(|| getegid().as_raw().to_string(), Group::argument);
        let wanted = self.group.map_or_else(String::new, |group| format!(", group {group}"));
        TransportError::WrongFolder {
            path: self.folder.to_owned(),
            problem: format!(
                "{found}, and it must be a folder of user {}{wanted}, mode {:04o}",
                user(self.owner),
                self.mode
            ),
            remedy: format!(
                "sudo install -d -o {owner} -g {group} -m {:04o} {}",
                self.mode,
                self.folder.display()
            ),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn root(folder: &Path) -> Root {
        Root::own(folder, None).unwrap()
    }

    fn mode(path: &Path) -> u32 {
        fs::metadata(path).unwrap().mode() & 0o777
    }

    #[test]
    fn gates_are_made_and_kept() {
        let folder = tempfile::tempdir_in("/tmp").unwrap();
        let path = folder.path().join("stream");
        for _ in 0..2 {
            open_gates(&root(&path), AccessMode::Group).unwrap();
            assert_eq!((mode(&path), mode(&path.join("iox"))), (0o750, 0o777));
        }
        let own = folder.path().join("own");
        open_gates(&root(&own), AccessMode::User).unwrap();
        assert_eq!(mode(&own), 0o700);
    }

    #[test]
    fn a_gate_that_stands_open_is_refused_with_the_command_that_closes_it() {
        let folder = tempfile::tempdir_in("/tmp").unwrap();
        let path = folder.path().join("stream");
        for (open, access) in
            [(0o755, AccessMode::Group), (0o770, AccessMode::Group), (0o750, AccessMode::User)]
        {
            let _ = fs::create_dir(&path);
            fs::set_permissions(&path, Permissions::from_mode(open)).unwrap();
            let error = open_gates(&root(&path), access).unwrap_err().to_string();
            assert!(error.contains(&format!("mode {open:04o}")), "{error}");
            assert!(error.contains("sudo install -d -o "), "{error}");
            assert!(error.contains(&*path.to_string_lossy()), "{error}");
        }
        fs::remove_dir(&path).unwrap();
        std::os::unix::fs::symlink("/tmp", &path).unwrap();
        let error = open_gates(&root(&path), AccessMode::Group).unwrap_err().to_string();
        assert!(error.contains("it is no folder"), "{error}");
    }

    #[test]
    fn a_stream_for_everyone_is_within_everyones_reach() {
        let folder = tempfile::tempdir_in("/tmp").unwrap();
        fs::set_permissions(folder.path(), Permissions::from_mode(0o755)).unwrap();
        let path = folder.path().join("stream");
        open_to_everyone(&root(&path)).unwrap();
        assert_eq!(mode(&path), 0o777);
        fs::create_dir(path.join("nodes")).unwrap();
        fs::set_permissions(path.join("nodes"), Permissions::from_mode(0o750)).unwrap();
        let error = open_to_everyone(&root(&path)).unwrap_err().to_string();
        assert!(
            error.contains("nodes") && error.contains("mode 0750") && error.contains("-m 0777"),
            "{error}"
        );
        fs::remove_dir(path.join("nodes")).unwrap();
        fs::set_permissions(folder.path(), Permissions::from_mode(0o750)).unwrap();
        let error = open_to_everyone(&root(&path)).unwrap_err().to_string();
        assert!(error.contains("above it is closed to other users"), "{error}");
    }

    #[test]
    fn payload_of_this_process_becomes_read_only_for_others() {
        let folder = tempfile::tempdir_in("/tmp").unwrap();
        let path = folder.path().join("stream");
        open_gates(&root(&path), AccessMode::Group).unwrap();
        let iox = path.join("iox");
        for name in ["iox2_a.data", "iox2_a.connection"] {
            fs::write(iox.join(name), "x").unwrap();
            fs::set_permissions(iox.join(name), Permissions::from_mode(0o666)).unwrap();
        }
        std::os::unix::fs::symlink("/dev/null", iox.join("iox2_link.data")).unwrap();
        protect_payload(&root(&path), &path).unwrap();
        assert_eq!(mode(&iox.join("iox2_a.data")), 0o644);
        assert_eq!(mode(&iox.join("iox2_a.connection")), 0o666);
        assert_eq!(mode(Path::new("/dev/null")), 0o666);
    }
}
