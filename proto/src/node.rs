//! A process's place in iceoryx2: everything else is opened on a node.

use std::time::{Duration, Instant};

use iceoryx2::{
    node::Node as IoxNode,
    prelude::{NodeBuilder, NodeName, SignalHandlingMode, ipc},
};

use crate::{AccessMode, Root, TransportError};

/// How long opening something is retried while another process is creating or removing it.
const RETRY_FOR: Duration = Duration::from_secs(2);

/// What this process is to the stream.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Role {
    /// Publishes; creates the root folder when it is missing.
    Daemon,
    /// Subscribes; a missing root folder means that there is no daemon.
    Client,
}

/// What a clean-up of dead processes did.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Cleanup {
    /// Dead nodes whose leftovers were removed.
    pub removed: u64,
    /// Dead nodes that could not be cleaned up: they belong to another user.
    pub failed: u64,
}

/// A process's place in the transport.
///
/// Neither `Send` nor `Sync`, like everything opened on it: every thread that publishes or subscribes
/// opens its own. Opening a node removes what killed processes left behind.
#[derive(Debug)]
pub struct Node {
    node: IoxNode<ipc::Service>,
    root: Root,
    access: AccessMode,
}

impl Node {
    /// Opens a node under `root`. Signals stay the program's own business, and iceoryx2 logs nothing
    /// unless `IOX2_LOG_LEVEL` asks for it: every failure comes back as an error.
    ///
    /// # Errors
    /// [`TransportError::AccessNotBuilt`], [`TransportError::PermissionDenied`] when the root belongs to
    /// another user, [`TransportError::NoDaemon`] for a client whose root does not exist,
    /// [`TransportError::UnusableRoot`].
    pub fn open(access: AccessMode, root: &Root, role: Role) -> Result<Self, TransportError> {
        access.check_built()?;
        prepare_root(root, role)?;
        let name = match role {
            Role::Daemon => "grnetd",
            Role::Client => "grnet-client",
        };
        let name = NodeName::new(name).expect("node names are short");
        let node = retry("open a node under", &root.to_string(), || {
            NodeBuilder::new()
                .name(&name)
                .config(root.config())
                .signal_handling_mode(SignalHandlingMode::Disabled)
                .create::<ipc::Service>()
                .map_err(|error| match root.foreign_owner() {
                    Some(foreign) => Attempt::Failed(foreign),
                    None => Attempt::Again(format!("{error:?}")),
                })
        })?;
        Ok(Self { node, root: root.clone(), access })
    }

    /// Where this node lives.
    pub fn root(&self) -> &Root {
        &self.root
    }

    /// Who may subscribe to what is opened on this node.
    pub fn access(&self) -> AccessMode {
        self.access
    }

    /// Removes what killed processes left behind: their slots become free and attached clients learn
    /// that a publisher died. It can take tens of milliseconds: keep it off the publishing thread.
    pub fn cleanup_dead_nodes(&self) -> Cleanup {
        let state = self.node.try_cleanup_dead_nodes();
        Cleanup { removed: state.cleanups, failed: state.failed_cleanups }
    }

    pub(crate) fn iox(&self) -> &IoxNode<ipc::Service> {
        &self.node
    }
}

/// One try of something that another process may be in the middle of changing.
pub(crate) enum Attempt {
    /// Worth trying again; the text says why it failed.
    Again(String),
    /// Pointless to try again.
    Failed(TransportError),
}

impl From<TransportError> for Attempt {
    fn from(error: TransportError) -> Self {
        Self::Failed(error)
    }
}

/// Tries until it works, fails for good, or two seconds have passed.
pub(crate) fn retry<T>(
    attempt: &'static str,
    subject: &str,
    mut tried: impl FnMut() -> Result<T, Attempt>,
) -> Result<T, TransportError> {
    let start = Instant::now();
    let mut pause = Duration::from_millis(2);
    loop {
        match tried() {
            Ok(value) => return Ok(value),
            Err(Attempt::Failed(error)) => return Err(error),
            Err(Attempt::Again(cause)) if start.elapsed() > RETRY_FOR => {
                return Err(TransportError::internal(attempt, subject, cause));
            }
            Err(Attempt::Again(_)) => {
                // There is no event for "the other process has finished".
                std::thread::sleep(pause);
                pause = (pause * 2).min(Duration::from_millis(100));
            }
        }
    }
}

fn prepare_root(root: &Root, role: Role) -> Result<(), TransportError> {
    let path = root.path();
    match role {
        Role::Client if root.is_own() && !path.is_dir() => {
            Err(TransportError::NoDaemon { service: "the pose stream".to_owned(), root: root.to_string() })
        }
        Role::Daemon if root.is_own() => {
            std::fs::create_dir_all(&path).map_err(|error| TransportError::UnusableRoot {
                path,
                problem: format!(
                    "creating it failed ({error}); create it for the daemon's user or choose another"
                ),
            })
        }
        _ => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;

    #[test]
    fn a_client_does_not_create_a_root() {
        let path = Path::new("/tmp/grnet-no-such-root");
        let error = Node::open(AccessMode::User, &Root::own(path, None).unwrap(), Role::Client).unwrap_err();
        assert!(matches!(error, TransportError::NoDaemon { .. }), "{error}");
        assert!(!path.exists());
    }

    #[test]
    fn a_root_that_cannot_be_created_is_named() {
        let root = Root::own(Path::new("/dev/null/root"), None).unwrap();
        let error = Node::open(AccessMode::User, &root, Role::Daemon).unwrap_err();
        assert!(matches!(error, TransportError::UnusableRoot { .. }), "{error}");
        assert!(error.to_string().contains("/dev/null/root"), "{error}");
    }

    #[test]
    fn an_access_mode_of_another_build_opens_nothing() {
        let error = Node::open(AccessMode::Group, &Root::shared(), Role::Daemon).unwrap_err();
        assert_eq!(error, TransportError::AccessNotBuilt { mode: "group" });
    }
}
