//! Who may subscribe, and where the transport keeps its files.

mod accounts;
mod announce;
mod find;
#[cfg(feature = "group-access")]
mod gate;
mod root;

use core::{fmt, str::FromStr};
use std::time::Duration;

use crate::{Access, TransportError};

pub use accounts::{Group, UnknownGroup};
pub(crate) use announce::Announcement;
pub use find::find;
pub(crate) use find::{CHANGE, enter};
#[cfg(feature = "group-access")]
pub(crate) use gate::{open_gates, open_to_everyone, protect_payload};
pub(crate) use root::Control;
pub use root::Root;

/// How long the daemon waits, at most, for a client that is half attached or may not attach.
/// iceoryx2's default of a second would let one client of another user stall the stream.
pub const CREATION_TIMEOUT: Duration = Duration::from_millis(20);

/// Where a daemon with `access = "group"` keeps its files, and where clients look first.
pub const GROUP_ROOT: &str = "/run/grnet";

/// How a root of one's own is chosen, for error messages.
const OWN_ROOT_REMEDY: &str = "grnetd.toml: publish.root and publish.prefix; clients: --root and --prefix";

/// Who may subscribe to the stream.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum AccessMode {
    /// Programs of the daemon's own user. In the ordinary build these are iceoryx2's own services, which stock
    /// clients find; with the feature `group-access`, files in a folder of the user's own.
    #[default]
    User,
    /// Members of a group and root, by files in a folder of that group. Needs the feature `group-access`.
    Group,
    /// Every local user, by iceoryx2's own services. Needs the feature `group-access`.
    Everyone,
}

impl AccessMode {
    /// Every mode.
    pub const ALL: [Self; 3] = [Self::User, Self::Group, Self::Everyone];

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
            Self::Group | Self::Everyone if !cfg!(feature = "group-access") => {
                Err(TransportError::AccessNotBuilt { mode: self.name() })
            }
            _ => Ok(()),
        }
    }

    /// Where a daemon of this build keeps the stream in this mode. Shared memory of the build with the feature
    /// `group-access` is open to every local user, so that nothing but [`Everyone`](Self::Everyone) may lie there.
    pub(crate) const fn storage(self) -> Storage {
        match self {
            Self::Group => Storage::Files,
            Self::User if cfg!(feature = "group-access") => Storage::Files,
            Self::User | Self::Everyone => Storage::SharedMemory,
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
        Self::ALL
            .into_iter()
            .find(|mode| mode.name() == text)
            .ok_or_else(|| UnknownAccessMode(text.to_owned()))
    }
}

/// What the services are made of.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Storage {
    /// iceoryx2's own `ipc` services: POSIX shared memory.
    SharedMemory,
    /// Files under the root and nothing elsewhere, so that the mode of one folder decides.
    Files,
}

impl Storage {
    pub(crate) const fn name(self) -> &'static str {
        match self {
            Self::SharedMemory => "shared-memory",
            Self::Files => "files",
        }
    }

    pub(crate) fn from_name(name: &str) -> Option<Self> {
        [Self::SharedMemory, Self::Files].into_iter().find(|storage| storage.name() == name)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn modes_of_other_builds_are_refused() {
        assert!(AccessMode::User.check_built().is_ok());
        for mode in ["group", "everyone"] {
            let checked = mode.parse::<AccessMode>().unwrap().check_built();
            if cfg!(feature = "group-access") {
                checked.unwrap();
            } else {
                let error = checked.unwrap_err().to_string();
                assert!(error.contains(mode) && error.contains("not part of this build"), "{error}");
            }
        }
        assert!("all".parse::<AccessMode>().is_err());
    }

    #[test]
    fn only_what_is_meant_for_everyone_lies_in_memory_that_is_open_to_everyone() {
        let open = cfg!(feature = "group-access");
        for mode in AccessMode::ALL {
            let shared = mode.storage() == Storage::SharedMemory;
            assert!(!shared || !open || mode == AccessMode::Everyone, "{mode}");
        }
    }
}
