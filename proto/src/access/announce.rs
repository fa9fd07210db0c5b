//! The file beside the services that says how a running daemon shares its stream, for clients that cannot know:
//! who may subscribe, what the services are made of, and the versions that both sides have to have in common.
//! The daemon holds a lock on it, so that the file of one that was killed is known for what it is.

use core::fmt;
use std::{
    fs::{self, File, OpenOptions, Permissions},
    io::{self, Read as _, Write as _},
    os::unix::fs::{MetadataExt, OpenOptionsExt, PermissionsExt},
    path::{Path, PathBuf},
};

use rustix::fs::{FlockOperation, OFlags, flock};

use super::{AccessMode, Storage, root::Control};
use crate::{CameraName, ICEORYX2_VERSION, Node, PACKAGE_VERSION, SCHEMA_VERSION, TransportError, names};

/// The first line.
const MAGIC: &str = "# how grnetd shares its stream; for grnet-client";

/// More than any announcement has.
const MAX_BYTES: u64 = 4096;

/// A daemon's announcement: there from its first publication until it ends.
#[derive(Debug)]
pub(crate) struct Announcement {
    path: PathBuf,
    // Held locked.
    _file: File,
}

impl Announcement {
    /// Announces what is opened on `node` for `camera`. The camera's name must be ours already.
    ///
    /// # Errors
    /// [`TransportError::UnusableRoot`] when the file cannot be written.
    pub(crate) fn publish(node: &Node, camera: &CameraName) -> Result<Self, TransportError> {
        let (root, access) = (node.root(), node.access());
        let announced = Announced {
            versions: Versions::ours(),
            access,
            storage: root.storage(access),
            prefix: root.prefix(),
            control_apart: matches!(root.control(), Control::Group(_)),
            owner: rustix::process::geteuid().as_raw(),
        };
        let path = file(&root.path(), camera);
        let file = write(&path, &announced.to_string()).map_err(|error| TransportError::UnusableRoot {
            path: root.path(),
            problem: format!("{} cannot be written ({error})", path.display()),
        })?;
        Ok(Self { path, _file: file })
    }
}

impl Drop for Announcement {
    fn drop(&mut self) {
        // Without it clients see by the lock that nobody is there.
        let _ = fs::remove_file(&self.path);
    }
}

/// What a folder says about the daemon of a camera.
#[derive(Debug)]
pub(super) enum Found {
    /// A daemon is there.
    Running(Box<Announced>),
    /// There was one that was killed.
    Ended,
    /// Nothing tells of one.
    Nobody,
    /// This user may not look.
    Denied,
    /// Something is there that is no announcement.
    Unreadable(String),
}

/// What a daemon announced.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Announced {
    pub versions: Versions,
    pub access: AccessMode,
    pub storage: Storage,
    pub prefix: String,
    pub control_apart: bool,
    /// The user of the daemon: who owns the file.
    pub owner: u32,
}

/// What both sides have to have in common.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Versions {
    schema: String,
    iceoryx2: String,
    grnet: String,
}

impl Versions {
    fn ours() -> Self {
        Self {
            schema: SCHEMA_VERSION.to_string(),
            iceoryx2: ICEORYX2_VERSION.to_owned(),
            grnet: PACKAGE_VERSION.to_owned(),
        }
    }

    /// Refuses a daemon whose messages or whose transport this program cannot read.
    ///
    /// # Errors
    /// [`TransportError::SchemaMismatch`] with both sides' versions.
    pub(super) fn check(&self, camera: &CameraName) -> Result<(), TransportError> {
        let ours = Self::ours();
        let minor = |version: &str| version.splitn(3, '.').take(2).collect::<Vec<_>>().join(".");
        if self.schema == ours.schema && minor(&self.iceoryx2) == minor(&ours.iceoryx2) {
            return Ok(());
        }
        Err(TransportError::SchemaMismatch {
            service: names::pose(camera),
            found: self.to_string(),
            expected: ours.to_string(),
        })
    }
}

impl fmt::Display for Versions {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "schema {}, iceoryx2 {}, grnet {}", self.schema, self.iceoryx2, self.grnet)
    }
}

impl fmt::Display for Announced {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Versions { schema, iceoryx2, grnet } = &self.versions;
        writeln!(f, "{MAGIC}\nschema = {schema}\niceoryx2 = {iceoryx2}\ngrnet = {grnet}")?;
        writeln!(f, "access = {}\nstorage = {}", self.access, self.storage.name())?;
        writeln!(f, "prefix = {}\ncontrol_apart = {}", self.prefix, self.control_apart)
    }
}

/// What the folder `root` says about the daemon of `camera`.
pub(super) fn read(root: &Path, camera: &CameraName) -> Found {
    match open(&file(root, camera)) {
        Ok(Some((text, owner))) => parse(&text, owner)
            .map_or_else(Found::Unreadable, |announced| Found::Running(Box::new(announced))),
        Ok(None) => Found::Ended,
        Err(error) => match error.kind() {
            io::ErrorKind::NotFound | io::ErrorKind::NotADirectory => Found::Nobody,
            io::ErrorKind::PermissionDenied => Found::Denied,
            _ => Found::Unreadable(error.to_string()),
        },
    }
}

/// The announcement that a killed daemon left has no lock, and is as good as none.
fn open(path: &Path) -> io::Result<Option<(String, u32)>> {
    // Whatever lies there must not make this program wait or follow.
    let flags = (OFlags::NOFOLLOW | OFlags::NONBLOCK).bits();
    let file = OpenOptions::new().read(true).custom_flags(i32::try_from(flags).unwrap_or(0)).open(path)?;
    let metadata = file.metadata()?;
    if !metadata.is_file() {
        return Err(io::Error::other("it is no regular file"));
    }
    match flock(&file, FlockOperation::NonBlockingLockShared) {
        Ok(()) => return Ok(None),
        Err(rustix::io::Errno::WOULDBLOCK) => {}
        Err(error) => return Err(error.into()),
    }
    let mut text = String::new();
    file.take(MAX_BYTES).read_to_string(&mut text)?;
    Ok(Some((text, metadata.uid())))
}

/// The versions come first: of another version, the rest may mean anything.
fn parse(text: &str, owner: u32) -> Result<Announced, String> {
    let value = |key: &str| {
        text.lines()
            .filter_map(|line| line.split_once('='))
            .find(|(name, _)| name.trim() == key)
            .map(|(_, value)| value.trim().to_owned())
            .ok_or_else(|| format!("it has no line `{key} = ...`"))
    };
    let versions = Versions {
        schema: value("schema")?,
        iceoryx2: value("iceoryx2")?,
        grnet: value("grnet").unwrap_or_else(|_| "unknown".to_owned()),
    };
    if versions.check(&CameraName::default()).is_err() {
        let (access, storage) = (AccessMode::User, Storage::SharedMemory);
        let prefix = String::new();
        return Ok(Announced { versions, access, storage, prefix, control_apart: false, owner });
    }
    let storage = value("storage")?;
    Ok(Announced {
        versions,
        access: value("access")?.parse().map_err(|error: super::UnknownAccessMode| error.to_string())?,
        storage: Storage::from_name(&storage).ok_or_else(|| format!("{storage:?} is no known storage"))?,
        prefix: value("prefix")?,
        control_apart: value("control_apart")? == "true",
        owner,
    })
}

/// All at once and locked: nobody sees half an announcement, or one without its lock.
fn write(path: &Path, text: &str) -> io::Result<File> {
    let draft = path.with_extension(format!("{}.draft", std::process::id()));
    let result = (|| {
        let mut file = OpenOptions::new().write(true).create(true).truncate(true).open(&draft)?;
        file.write_all(text.as_bytes())?;
        // Who may enter the folder may read it, whatever the umask.
        file.set_permissions(Permissions::from_mode(0o644))?;
        flock(&file, FlockOperation::NonBlockingLockExclusive)?;
        fs::rename(&draft, path)?;
        Ok(file)
    })();
    if result.is_err() {
        // The first error is the one that matters.
        let _ = fs::remove_file(&draft);
    }
    result
}

fn file(root: &Path, camera: &CameraName) -> PathBuf {
    root.join(format!("{camera}.grnet"))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn announced() -> Announced {
        Announced {
            versions: Versions::ours(),
            access: AccessMode::Group,
            storage: Storage::Files,
            prefix: "iox2_".to_owned(),
            control_apart: true,
            owner: 5,
        }
    }

    #[test]
    fn what_is_written_is_read() {
        assert_eq!(parse(&announced().to_string(), 5), Ok(announced()));
        assert!(parse("schema = 1", 5).unwrap_err().contains("iceoryx2"));
    }

    #[test]
    fn only_a_locked_announcement_is_a_daemon() {
        let folder = tempfile::tempdir().unwrap();
        let camera = CameraName::default();
        let path = file(folder.path(), &camera);
        assert!(matches!(read(folder.path(), &camera), Found::Nobody));
        let held = write(&path, &announced().to_string()).unwrap();
        let Found::Running(found) = read(folder.path(), &camera) else { panic!("it is locked") };
        assert_eq!(found.access, AccessMode::Group);
        drop(held);
        assert!(matches!(read(folder.path(), &camera), Found::Ended), "as after SIGKILL");
        fs::remove_file(&path).unwrap();
        fs::create_dir(&path).unwrap();
        assert!(matches!(read(folder.path(), &camera), Found::Unreadable(_)));
    }

    #[test]
    fn another_version_is_named_whatever_else_it_says() {
        for (schema, iceoryx2, fits) in [
            ("1", ICEORYX2_VERSION, true),
            ("1", "0.10.7", true),
            ("1", "0.11.0", false),
            ("2", "0.10.0", false),
        ] {
            let text = format!(
                "{MAGIC}\nschema = {schema}\niceoryx2 = {iceoryx2}\ngrnet = 7.7.7\naccess = user\nstorage = files\nprefix = p\ncontrol_apart = false\n"
            );
            let checked = parse(&text, 0).unwrap().versions.check(&CameraName::default());
            assert_eq!(checked.is_ok(), fits, "{schema} {iceoryx2}");
            if let Err(error) = checked {
                let text = error.to_string();
                assert!(text.contains(iceoryx2) && text.contains(ICEORYX2_VERSION), "{text}");
                assert!(text.contains("7.7.7") && text.contains(PACKAGE_VERSION), "{text}");
            }
        }
        let alien = "schema = 3\niceoryx2 = 2.0.0\naccess = some other way\n";
        assert!(parse(alien, 0).unwrap().versions.check(&CameraName::default()).is_err());
    }
}
