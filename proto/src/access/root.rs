//! The folder of the transport.

use core::fmt;
use std::{
    os::unix::{ffi::OsStrExt, fs::MetadataExt},
    path::{Path, PathBuf},
    sync::Once,
    time::Duration,
};

use iceoryx2::prelude::{Config, FileName, LogLevel, SemanticString, set_log_level_from_env_or};

use super::{AccessMode, CREATION_TIMEOUT, GROUP_ROOT, Group, OWN_ROOT_REMEDY, Storage};
use crate::TransportError;

/// Where POSIX shared memory lives on Linux.
const SHARED_MEMORY: &str = "/dev/shm";

/// Below a root of files: what iceoryx2 keeps. The folder above it is the gate.
const FILES: &str = "iox";

/// Below a root of files: the gate of requests that change state, where their group is another one.
const CONTROL: &str = "control";

/// Unix socket names hold 107 bytes, of which iceoryx2 takes up to 46 for port id and suffix.
const MAX_ROOT_AND_PREFIX_BYTES: usize = 60;

/// Where the services of a daemon are, and which groups may use them.
///
/// The default is iceoryx2's own global configuration, where stock clients of the same user find the stream
/// without any setting; a client with the default looks wherever a daemon may be ([`find`](super::find)). A
/// root of one's own separates tests, or several daemons of several users; stock clients then need
/// `global.root-path` and `global.prefix` set to the same values.
#[derive(Debug, Clone, PartialEq)]
pub struct Root {
    folder: PathBuf,
    config: Config,
    own: bool,
    storage: Option<Storage>,
    group: Option<Group>,
    control: Control,
}

/// Who may ask for a change of the daemon's state.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum Control {
    /// Whoever may subscribe.
    Subscribers,
    /// Members of this group (daemon).
    Group(Group),
    /// Members of the group of the control folder, whichever that is (client).
    Apart,
}

impl Eq for Root {}

impl Default for Root {
    fn default() -> Self {
        Self::shared()
    }
}

impl Root {
    /// iceoryx2's own root: `/tmp/iceoryx2` unless its configuration file says otherwise.
    pub fn shared() -> Self {
        let config = stock_config();
        let folder = PathBuf::from(config.global.root_path().to_string());
        Self::with_config(folder, config, false)
    }

    /// A root of one's own: an absolute folder, and the prefix of the services' names (iceoryx2's `iox2_` when
    /// `None`).
    ///
    /// # Errors
    /// [`TransportError::UnusableRoot`] when the path is not absolute, path and prefix are longer than
    /// 60 bytes together, or the prefix is no file name.
    pub fn own(path: &Path, prefix: Option<&str>) -> Result<Self, TransportError> {
        let mut config = stock_config();
        let unusable = |problem: String| TransportError::UnusableRoot { path: path.to_owned(), problem };
        if !path.is_absolute() {
            return Err(unusable("it is not absolute; give the path from /".to_owned()));
        }
        if let Some(prefix) = prefix {
            let valid = !prefix.is_empty() && prefix.bytes().all(|b| b.is_ascii_alphanumeric() || b == b'_');
            config.global.prefix = FileName::new(prefix.as_bytes())
                .ok()
                .filter(|_| valid)
                .ok_or_else(|| unusable(format!("the prefix {prefix:?} is not made of a-z A-Z 0-9 _")))?;
        }
        set_root_path(&mut config, path)?;
        Ok(Self::with_config(path.to_owned(), config, true))
    }

    /// The root of a daemon: the configured one, else [`GROUP_ROOT`] for `group`, a folder of the user's own for
    /// `user` in the build with `group-access`, iceoryx2's own otherwise.
    ///
    /// # Errors
    /// As for [`own`](Self::own).
    pub fn for_daemon(
        access: AccessMode,
        path: Option<&Path>,
        prefix: Option<&str>,
    ) -> Result<Self, TransportError> {
        match (path, access.storage()) {
            (Some(path), _) => Self::own(path, prefix),
            (None, Storage::SharedMemory) => Ok(Self::shared()),
            (None, Storage::Files) if access == AccessMode::Group => Self::own(Path::new(GROUP_ROOT), prefix),
            (None, Storage::Files) => Self::own(&private_folder(), prefix),
        }
    }

    /// The same root with another limit, instead of [`CREATION_TIMEOUT`], to what a client that is half
    /// attached or may not attach costs a publication.
    #[must_use]
    pub fn with_creation_timeout(mut self, timeout: Duration) -> Self {
        self.config.global.creation_timeout = timeout;
        self
    }

    /// The same root for members of `group` (the daemon's own group when `None`), with requests that change the
    /// daemon's state left to members of `control` when that is a group. For [`AccessMode::Group`] alone.
    #[must_use]
    pub fn with_groups(mut self, group: Option<Group>, control: Option<Group>) -> Self {
        self.group = group;
        self.control = control.map_or(Control::Subscribers, Control::Group);
        self
    }

    /// The folder.
    pub fn path(&self) -> PathBuf {
        self.folder.clone()
    }

    /// The prefix of the services' names.
    pub fn prefix(&self) -> String {
        self.config.global.prefix.to_string()
    }

    /// Was the root chosen by the caller (and is not iceoryx2's own)?
    pub fn is_own(&self) -> bool {
        self.own
    }

    /// The file system that holds the stream of a daemon with this access, for the free space on it. The folder
    /// itself may not exist yet.
    pub fn file_system(&self, access: AccessMode) -> PathBuf {
        match self.storage(access) {
            Storage::SharedMemory => SHARED_MEMORY.into(),
            Storage::Files => {
                let existing = self.folder.ancestors().find(|folder| folder.is_dir());
                existing.unwrap_or(Path::new("/")).to_owned()
            }
        }
    }

    /// Bytes that are free where the stream of a daemon with this access lies.
    ///
    /// # Errors
    /// [`TransportError::Internal`] when the file system cannot be asked.
    pub fn free_space(&self, access: AccessMode) -> Result<u64, TransportError> {
        let path = self.file_system(access);
        let space = rustix::fs::statvfs(&path).map_err(|error| {
            TransportError::internal("ask for the free space of", &path.to_string_lossy(), error)
        })?;
        Ok(space.f_bavail.saturating_mul(space.f_frsize))
    }

    /// Refuses when less than `needed_bytes` are free where the stream lies: its memory is not reserved, so that
    /// running out later would kill the process with SIGBUS.
    ///
    /// # Errors
    /// [`TransportError::NoSpace`] with the numbers; [`TransportError::Internal`] when the file system
    /// cannot be asked.
    pub fn require_space(&self, access: AccessMode, needed_bytes: u64) -> Result<(), TransportError> {
        let free_bytes = self.free_space(access)?;
        if free_bytes < needed_bytes {
            return Err(TransportError::NoSpace { path: self.file_system(access), free_bytes, needed_bytes });
        }
        Ok(())
    }

    /// The folder under which a user's own daemons of the build with `group-access` are looked for, in the order
    /// of preference.
    pub(super) fn private_folders() -> [PathBuf; 2] {
        let user = rustix::process::geteuid().as_raw();
        [format!("/run/user/{user}/grnet").into(), format!("/tmp/grnet-{user}").into()]
    }

    /// What a daemon's services are made of, as it announced; else as this build makes them.
    pub(crate) fn storage(&self, access: AccessMode) -> Storage {
        self.storage.unwrap_or(access.storage())
    }

    /// The same root with what a daemon announced there.
    pub(super) fn announced(mut self, storage: Storage, control_apart: bool) -> Self {
        self.storage = Some(storage);
        self.control = if control_apart { Control::Apart } else { Control::Subscribers };
        self
    }

    #[cfg(feature = "group-access")]
    pub(crate) fn group(&self) -> Option<&Group> {
        self.group.as_ref()
    }

    pub(crate) fn control(&self) -> &Control {
        &self.control
    }

    /// The folder whose group decides who may ask for changes.
    pub(crate) fn control_folder(&self) -> PathBuf {
        self.folder.join(CONTROL)
    }

    /// The folder of iceoryx2 behind the gate `folder`.
    pub(crate) fn behind(folder: &Path) -> PathBuf {
        folder.join(FILES)
    }

    /// iceoryx2's configuration of the services in shared memory.
    pub(crate) fn config(&self) -> &Config {
        &self.config
    }

    /// iceoryx2's configuration of the services in files behind the gate `folder`.
    ///
    /// # Errors
    /// [`TransportError::UnusableRoot`] when the path is too long.
    #[cfg(feature = "group-access")]
    pub(crate) fn config_behind(&self, folder: &Path) -> Result<Config, TransportError> {
        let mut config = self.config.clone();
        set_root_path(&mut config, &Self::behind(folder))?;
        Ok(config)
    }

    /// The part of the root that belongs to a user this process is not, if that is what is wrong.
    pub(crate) fn foreign_owner(&self) -> Option<TransportError> {
        let user = rustix::process::geteuid().as_raw();
        if user == 0 {
            return None;
        }
        let root = &self.folder;
        [root.clone(), root.join("nodes"), root.join("services")].into_iter().find_map(|path| {
            let owner = std::fs::metadata(&path).ok()?.uid();
            (owner != user).then_some(TransportError::PermissionDenied {
                path,
                owner,
                user,
                remedy: OWN_ROOT_REMEDY,
            })
        })
    }

    fn with_config(folder: PathBuf, mut config: Config, own: bool) -> Self {
        config.global.creation_timeout = CREATION_TIMEOUT;
        Self { folder, config, own, storage: None, group: None, control: Control::Subscribers }
    }
}

impl fmt::Display for Root {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} (prefix {})", self.folder.display(), self.prefix())
    }
}

/// The folder of a user's own daemon in the build with `group-access`: gone with the login where the machine has
/// such folders.
fn private_folder() -> PathBuf {
    let [preferred, fallback] = Root::private_folders();
    let user = rustix::process::geteuid().as_raw();
    let usable = preferred.parent().and_then(|login| std::fs::metadata(login).ok());
    if usable.is_some_and(|login| login.is_dir() && login.uid() == user) { preferred } else { fallback }
}

fn set_root_path(config: &mut Config, path: &Path) -> Result<(), TransportError> {
    let unusable = |problem: String| TransportError::UnusableRoot { path: path.to_owned(), problem };
    let length = path.as_os_str().len() + config.global.prefix.len();
    if length > MAX_ROOT_AND_PREFIX_BYTES {
        return Err(unusable(format!(
            "path and prefix have {length} bytes together and {MAX_ROOT_AND_PREFIX_BYTES} is the most that the names of Unix sockets leave; choose a shorter one"
        )));
    }
    let root_path = iceoryx2::prelude::Path::new(path.as_os_str().as_bytes())
        .map_err(|error| unusable(format!("iceoryx2 does not accept it ({error:?})")))?;
    config.global.set_root_path(&root_path);
    Ok(())
}

/// The configuration of stock clients. Every way into iceoryx2 leads through here, so that it is told
/// to keep quiet before it says its first word: its failures come back as errors.
fn stock_config() -> Config {
    static LOG_LEVEL: Once = Once::new();
    LOG_LEVEL.call_once(|| set_log_level_from_env_or(LogLevel::Fatal));
    Config::global_config().clone()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_shared_root_is_the_one_of_stock_clients() {
        let (root, stock) = (Root::shared(), Config::global_config());
        assert_eq!(root.config().global.root_path(), stock.global.root_path());
        assert_eq!(root.config().global.prefix, stock.global.prefix);
        assert_eq!(root.config().global.creation_timeout, CREATION_TIMEOUT);
        assert!(!root.is_own());
        let patient = root.with_creation_timeout(Duration::from_millis(50));
        assert_eq!(patient.config().global.creation_timeout, Duration::from_millis(50));
    }

    #[test]
    fn a_root_of_ones_own_is_checked() {
        let root = Root::own(Path::new("/run/robot"), Some("grnet_")).unwrap();
        assert_eq!(root.to_string(), "/run/robot (prefix grnet_)");
        for (path, prefix) in [
            ("relative", None),
            ("/x", Some("a/b")),
            ("/x", Some("")),
            (&*format!("/{}", "x".repeat(60)), None),
        ] {
            assert!(matches!(Root::own(Path::new(path), prefix), Err(TransportError::UnusableRoot { .. })));
        }
    }

    #[test]
    fn a_daemons_root_follows_from_its_access() {
        let of = |access| Root::for_daemon(access, None, None).unwrap();
        assert_eq!(of(AccessMode::Group).path(), Path::new(GROUP_ROOT));
        assert!(!of(AccessMode::Everyone).is_own());
        assert_eq!(of(AccessMode::User).is_own(), cfg!(feature = "group-access"));
        let chosen = Root::for_daemon(AccessMode::Group, Some(Path::new("/run/robot")), None).unwrap();
        assert_eq!(chosen.path(), Path::new("/run/robot"));
    }

    #[test]
    fn space_is_asked_for_where_the_stream_lies() {
        let root = Root::own(Path::new("/proc/self/not-there/yet"), None).unwrap();
        assert_eq!(root.file_system(AccessMode::Group), Path::new("/proc/self"));
        assert_eq!(root.file_system(AccessMode::Everyone), Path::new("/dev/shm"));
        // /proc has no space at all.
        let error = root.require_space(AccessMode::Group, 1).unwrap_err();
        assert!(error.to_string().contains("/proc/self has 0 bytes free and 1 are needed"), "{error}");
    }

    #[test]
    fn missing_space_is_refused_with_the_numbers() {
        let error = Root::shared().require_space(AccessMode::Everyone, u64::MAX).unwrap_err();
        let TransportError::NoSpace { free_bytes, .. } = error else { panic!("{error}") };
        assert!(error.to_string().contains(&free_bytes.to_string()), "{error}");
        assert!(error.to_string().contains(&u64::MAX.to_string()), "{error}");
        Root::shared().require_space(AccessMode::Everyone, 1).unwrap();
    }
}
