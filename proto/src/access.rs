//! Who may subscribe, and where the transport keeps its files.

use core::{fmt, str::FromStr};
use std::{
    os::unix::{ffi::OsStrExt, fs::MetadataExt},
    path::{Path, PathBuf},
    sync::Once,
    time::Duration,
};

use iceoryx2::prelude::{Config, FileName, LogLevel, SemanticString, set_log_level_from_env_or};

use crate::{Access, TransportError};

/// How long the daemon waits, at most, for a client that is half attached or may not attach.
/// iceoryx2's default of a second would let one client of another user stall the stream.
pub const CREATION_TIMEOUT: Duration = Duration::from_millis(20);

/// How a root of one's own is chosen, for error messages.
pub(crate) const OWN_ROOT_REMEDY: &str =
    "grnetd.toml: publish.root and publish.prefix; clients: --root and --prefix";

/// Where POSIX shared memory lives on Linux.
const SHARED_MEMORY: &str = "/dev/shm";

/// Unix socket names hold 107 bytes, of which iceoryx2 takes up to 46 for port id and suffix.
const MAX_ROOT_AND_PREFIX_BYTES: usize = 60;

/// Who may subscribe to the stream.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum AccessMode {
    /// Programs of the daemon's own user and root: iceoryx2's own services, which stock clients find.
    #[default]
    User,
    /// Members of a group and root; another build of the transport.
    Group,
    /// Every local user; another build of the transport.
    Everyone,
}

impl AccessMode {
    /// The mode's name in configuration files.
    pub const fn name(self) -> &'static str {
        match self {
            Self::User => "user",
            Self::Group => "group",
            Self::Everyone => "everyone",
        }
    }

    /// The mode as messages carry it.
    pub const fn wire(self) -> Access {
        match self {
            Self::User => Access::USER,
            Self::Group => Access::GROUP,
            Self::Everyone => Access::EVERYONE,
        }
    }

    /// Can this build honour the mode?
    ///
    /// # Errors
    /// [`TransportError::AccessNotBuilt`], which names what this build offers.
    pub const fn check_built(self) -> Result<(), TransportError> {
        match self {
            Self::User => Ok(()),
            Self::Group | Self::Everyone => Err(TransportError::AccessNotBuilt { mode: self.name() }),
        }
    }
}

impl fmt::Display for AccessMode {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(self.name())
    }
}

/// Not the name of an access mode.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{0:?} is no access mode; known are \"user\", \"group\" and \"everyone\"")]
pub struct UnknownAccessMode(String);

impl FromStr for AccessMode {
    type Err = UnknownAccessMode;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        [Self::User, Self::Group, Self::Everyone]
            .into_iter()
            .find(|mode| mode.name() == text)
            .ok_or_else(|| UnknownAccessMode(text.to_owned()))
    }
}

/// Where iceoryx2 keeps its files.
///
/// The default is iceoryx2's own global configuration, so that stock clients of the same user find the
/// stream without any setting. A root of one's own separates tests, or several daemons of several
/// users; stock clients then need `global.root-path` and `global.prefix` set to the same values.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Root {
    config: Config,
    own: bool,
}

impl Default for Root {
    fn default() -> Self {
        Self::shared()
    }
}

impl Root {
    /// iceoryx2's own root: `/tmp/iceoryx2` unless its configuration file says otherwise.
    pub fn shared() -> Self {
        Self::with_config(stock_config(), false)
    }

    /// A root of one's own: an absolute folder, and the prefix of the names in shared memory
    /// (iceoryx2's `iox2_` when `None`).
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
        let length = path.as_os_str().len() + config.global.prefix.len();
        if length > MAX_ROOT_AND_PREFIX_BYTES {
            return Err(unusable(format!(
                "path and prefix have {length} bytes together and {MAX_ROOT_AND_PREFIX_BYTES} is the most that the names of Unix sockets leave; choose a shorter one"
            )));
        }
        let root_path = iceoryx2::prelude::Path::new(path.as_os_str().as_bytes())
            .map_err(|error| unusable(format!("iceoryx2 does not accept it ({error:?})")))?;
        config.global.set_root_path(&root_path);
        Ok(Self::with_config(config, true))
    }

    /// The same root with another limit, instead of [`CREATION_TIMEOUT`], to what a client that is half
    /// attached or may not attach costs a publication.
    #[must_use]
    pub fn with_creation_timeout(mut self, timeout: Duration) -> Self {
        self.config.global.creation_timeout = timeout;
        self
    }

    /// The folder.
    pub fn path(&self) -> PathBuf {
        PathBuf::from(self.config.global.root_path().to_string())
    }

    /// The prefix of the names in shared memory.
    pub fn prefix(&self) -> String {
        self.config.global.prefix.to_string()
    }

    /// Was the root chosen by the caller (and is not iceoryx2's own)?
    pub fn is_own(&self) -> bool {
        self.own
    }

    /// iceoryx2's configuration of every node under this root.
    pub(crate) fn config(&self) -> &Config {
        &self.config
    }

    /// The part of the root that belongs to a user this process is not, if that is what is wrong.
    pub(crate) fn foreign_owner(&self) -> Option<TransportError> {
        let user = rustix::process::geteuid().as_raw();
        if user == 0 {
            return None;
        }
        let root = self.path();
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

    fn with_config(mut config: Config, own: bool) -> Self {
        config.global.creation_timeout = CREATION_TIMEOUT;
        Self { config, own }
    }
}

impl fmt::Display for Root {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} (prefix {})", self.path().display(), self.prefix())
    }
}

/// The configuration of stock clients. Every way into iceoryx2 leads through here, so that it is told
/// to keep quiet before it says its first word: its failures come back as errors.
fn stock_config() -> Config {
    static LOG_LEVEL: Once = Once::new();
    LOG_LEVEL.call_once(|| set_log_level_from_env_or(LogLevel::Fatal));
    Config::global_config().clone()
}

/// Refuses when the file system of shared memory has less than `needed_bytes` free: shared memory is
/// not reserved, so that running out later would kill the process with SIGBUS.
///
/// # Errors
/// [`TransportError::NoSpace`] with the numbers; [`TransportError::Internal`] when the file system
/// cannot be asked.
pub fn require_shared_memory(needed_bytes: u64) -> Result<(), TransportError> {
    let free_bytes = free_shared_memory()?;
    if free_bytes < needed_bytes {
        return Err(TransportError::NoSpace { path: SHARED_MEMORY.into(), free_bytes, needed_bytes });
    }
    Ok(())
}

/// Bytes that are free in the file system of shared memory.
///
/// # Errors
/// [`TransportError::Internal`] when the file system cannot be asked.
pub fn free_shared_memory() -> Result<u64, TransportError> {
    let space = rustix::fs::statvfs(SHARED_MEMORY)
        .map_err(|error| TransportError::internal("ask for the free space of", SHARED_MEMORY, error))?;
    Ok(space.f_bavail.saturating_mul(space.f_frsize))
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
    fn missing_space_is_refused_with_the_numbers() {
        let error = require_shared_memory(u64::MAX).unwrap_err();
        let TransportError::NoSpace { free_bytes, .. } = error else { panic!("{error}") };
        assert!(error.to_string().contains(&free_bytes.to_string()), "{error}");
        assert!(error.to_string().contains(&u64::MAX.to_string()), "{error}");
        require_shared_memory(1).unwrap();
    }

    #[test]
    fn modes_of_other_builds_are_refused() {
        assert!(AccessMode::User.check_built().is_ok());
        for mode in ["group", "everyone"] {
            let error = mode.parse::<AccessMode>().unwrap().check_built().unwrap_err().to_string();
            assert!(error.contains(mode) && error.contains("not part of this build"), "{error}");
        }
        assert!("all".parse::<AccessMode>().is_err());
    }
}
