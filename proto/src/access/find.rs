//! A client's search for the daemon of a camera.

use std::{
    io,
    os::unix::fs::MetadataExt,
    path::{Path, PathBuf},
};

use super::{
    AccessMode, GROUP_ROOT, OWN_ROOT_REMEDY, Root, Storage,
    accounts::{Group, user, user_argument},
    announce::{self, Announced, Found},
};
use crate::{CameraName, TransportError, names};

const SUBSCRIBE: &str = "subscribe to its stream";
/// For the folder of requests that change the daemon's state.
pub(crate) const CHANGE: &str = "change what the daemon does";

/// Finds the running daemon of `camera`, and how it shares its stream: under `root` when that is one of the
/// caller's own, else under `/run/grnet`, in this user's own folders and under iceoryx2's own root, in this order.
///
/// # Errors
/// [`TransportError::NoDaemon`] with the roots that were looked at, [`TransportError::NotMember`] when the only
/// root where one may be is closed to this user, [`TransportError::SchemaMismatch`] for a daemon of another
/// version, [`TransportError::OtherBuild`] for one that this build cannot join.
pub fn find(camera: &CameraName, root: &Root) -> Result<(AccessMode, Root), TransportError> {
    if root.is_own() {
        let folder = root.path();
        return match announce::read(&folder, camera) {
            // The services themselves say what is missing.
            Found::Nobody => Ok((AccessMode::User, root.clone())),
            _ => find_among(camera, root, &[folder]),
        };
    }
    let [login, temporary] = Root::private_folders();
    find_among(camera, root, &[GROUP_ROOT.into(), login, temporary, root.path()])
}

fn find_among(
    camera: &CameraName,
    root: &Root,
    folders: &[PathBuf],
) -> Result<(AccessMode, Root), TransportError> {
    let mut obstacle = None;
    for folder in folders {
        match announce::read(folder, camera) {
            Found::Running(announced) => return joinable(camera, root, folder, &announced),
            Found::Nobody | Found::Ended => {}
            Found::Denied => {
                obstacle = obstacle.or_else(|| Some(closed(folder, SUBSCRIBE, None)));
            }
            Found::Unreadable(problem) => {
                let path = folder.clone();
                let problem = format!("the announcement of camera {camera} there cannot be read: {problem}");
                obstacle = obstacle.or(Some(TransportError::UnusableRoot { path, problem }));
            }
        }
    }
    Err(obstacle.unwrap_or_else(|| TransportError::NoDaemon {
        service: names::pose(camera),
        root: folders.iter().map(|folder| folder.display().to_string()).collect::<Vec<_>>().join(", "),
    }))
}

/// Can a client of this build and this user join that daemon without harm to either?
fn joinable(
    camera: &CameraName,
    root: &Root,
    folder: &Path,
    announced: &Announced,
) -> Result<(AccessMode, Root), TransportError> {
    announced.versions.check(camera)?;
    let other_build = |reason: String| TransportError::OtherBuild {
        service: names::pose(camera),
        access: announced.access.name(),
        root: folder.to_owned(),
        reason,
    };
    let ours = cfg!(feature = "group-access");
    let stranger = announced.owner != rustix::process::geteuid().as_raw();
    match (announced.storage, announced.access) {
        (Storage::Files, _) if !ours => {
            return Err(other_build("this build reads shared memory only".to_owned()));
        }
        (Storage::SharedMemory, AccessMode::Everyone) if !ours && stranger => {
            return Err(other_build(format!(
                "what this build would share with user {} is closed to every other user",
                user(announced.owner)
            )));
        }
        (Storage::SharedMemory, AccessMode::User) if ours => {
            return Err(other_build(
                "what this build would add to its shared memory is open to every local user".to_owned(),
            ));
        }
        (Storage::SharedMemory, AccessMode::User) if stranger => {
            return Err(closed(folder, SUBSCRIBE, Some(AccessMode::User)));
        }
        _ => {}
    }
    let found = Root::own(folder, Some(&announced.prefix))?
        .with_creation_timeout(root.config().global.creation_timeout)
        .announced(announced.storage, announced.control_apart);
    Ok((announced.access, found))
}

/// May this user use what lies behind the gate `folder`?
///
/// # Errors
/// [`TransportError::NotMember`], or [`TransportError::NoDaemon`] when there is nothing.
pub(crate) fn enter(folder: &Path, purpose: &'static str) -> Result<(), TransportError> {
    match std::fs::read_dir(Root::behind(folder)) {
        Ok(_) => Ok(()),
        Err(error) if error.kind() == io::ErrorKind::PermissionDenied => Err(closed(folder, purpose, None)),
        Err(_) => Err(TransportError::NoDaemon {
            service: "the pose stream".to_owned(),
            root: folder.display().to_string(),
        }),
    }
}

/// What keeps this user out of `folder`; `access` is how its daemon shares, where that is known.
fn closed(folder: &Path, purpose: &'static str, access: Option<AccessMode>) -> TransportError {
    let me = rustix::process::geteuid().as_raw();
    // The innermost part of the path that can be seen is the one that is closed.
    let seen = folder.ancestors().find_map(|path| Some((path, std::fs::symlink_metadata(path).ok()?)));
    let Some((path, metadata)) = seen else {
        return TransportError::internal("look at", &folder.to_string_lossy(), "no part of it can be seen");
    };
    let (owner, group) = (user(metadata.uid()), Group::of_id(metadata.gid()));
    let mode = metadata.mode() & 0o7777;
    // iceoryx2's own folders look alike, and their group decides nothing.
    let by_group = access.map_or_else(
        || purpose == CHANGE || mode & 0o2000 != 0 || folder == Path::new(GROUP_ROOT),
        |access| access == AccessMode::Group,
    );
    let remedy = if by_group {
        let (group, me) = (group.argument(), user_argument(me));
        format!("`sudo usermod -aG {group} {me}` and a new login make a member")
    } else {
        format!("run as user {owner}, or give daemon and clients a root of their own ({OWN_ROOT_REMEDY})")
    };
    TransportError::NotMember {
        path: path.to_owned(),
        purpose,
        owner,
        group: group.to_string(),
        mode,
        user: user(me),
        remedy,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_root_that_was_looked_at_is_named() {
        let folder = tempfile::tempdir().unwrap();
        let (a, b) = (folder.path().join("a"), folder.path().join("b"));
        let error = find_among(&CameraName::default(), &Root::shared(), &[a.clone(), b.clone()]).unwrap_err();
        let TransportError::NoDaemon { root, .. } = &error else { panic!("{error}") };
        assert_eq!(*root, format!("{}, {}", a.display(), b.display()));
    }

    #[test]
    fn a_closed_folder_is_named_with_its_owner_group_mode_and_remedy() {
        let error = closed(Path::new("/"), CHANGE, None).to_string();
        for part in ["/ belongs to user root (0) and group root (0)", "mode 0755", "usermod -aG root"] {
            assert!(error.contains(part), "{error}");
        }
        let error = closed(Path::new("/"), SUBSCRIBE, None).to_string();
        assert!(error.contains("run as user root (0)"), "{error}");
    }
}
