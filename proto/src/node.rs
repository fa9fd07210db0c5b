//! A process's place in iceoryx2: everything else is opened on a node.

use core::cell::OnceCell;
use std::{
    path::Path,
    time::{Duration, Instant},
};

use iceoryx2::{
    node::Node as IoxNode,
    prelude::{Config, NodeBuilder, NodeName, Service, SignalHandlingMode, ipc},
};

use crate::{
    AccessMode, Root, TransportError,
    access::{CHANGE, Control, Storage, enter},
};
#[cfg(feature = "group-access")]
use crate::{
    access::{open_gates, open_to_everyone, protect_payload},
    files,
};

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
    node: Variant,
    control: OnceCell<Variant>,
    root: Root,
    access: AccessMode,
    role: Role,
}

/// iceoryx2's node, of the services that the root is made of.
#[derive(Debug)]
pub(crate) enum Variant {
    /// In shared memory.
    Ipc(IoxNode<ipc::Service>),
    /// In files.
    #[cfg(feature = "group-access")]
    Files(IoxNode<files::Service>),
}

/// A node whose kind of services is known: what ports are opened on.
#[derive(Debug)]
pub(crate) struct On<'node, S: Service> {
    /// The whole node, for its root and its errors.
    pub node: &'node Node,
    /// iceoryx2's part of it.
    pub iox: &'node IoxNode<S>,
    /// iceoryx2's configuration of it.
    pub config: &'node Config,
}

/// Evaluates `$body` with `$on` as the [`On`] of the variant of `$node`: ports are generic over the kind of services.
macro_rules! on_variant {
    ($node:expr, $on:ident => $body:expr) => {{
        let node: &$crate::Node = $node;
        match node.variant() {
            $crate::node::Variant::Ipc(iox) => {
                let $on = &$crate::node::On { node, iox, config: iox.config() };
                $body
            }
            #[cfg(feature = "group-access")]
            $crate::node::Variant::Files(iox) => {
                let $on = &$crate::node::On { node, iox, config: iox.config() };
                $body
            }
        }
    }};
}
pub(crate) use on_variant;

impl Node {
    /// Opens a node under `root`. Signals stay the program's own business, and iceoryx2 logs nothing
    /// unless `IOX2_LOG_LEVEL` asks for it: every failure comes back as an error.
    ///
    /// # Errors
    /// [`TransportError::AccessNotBuilt`], [`TransportError::PermissionDenied`] when the root belongs to
    /// another user, [`TransportError::NotMember`], [`TransportError::WrongFolder`], [`TransportError::NoDaemon`]
    /// for a client whose root does not exist, [`TransportError::UnusableRoot`].
    pub fn open(access: AccessMode, root: &Root, role: Role) -> Result<Self, TransportError> {
        // What a client found, it can join.
        if role == Role::Daemon {
            access.check_built()?;
        }
        let node = match root.storage(access) {
            Storage::SharedMemory => {
                #[cfg(feature = "group-access")]
                if access == AccessMode::Everyone && role == Role::Daemon {
                    open_to_everyone(root)?;
                }
                prepare_root(root, role)?;
                let foreign = || root.foreign_owner();
                Variant::Ipc(create(root, role, root.config(), foreign)?)
            }
            Storage::Files => {
                prepare_files(access, root, role)?;
                open_files(root, role, &root.path())?
            }
        };
        Ok(Self { node, control: OnceCell::new(), root: root.clone(), access, role })
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
        [Some(&self.node), self.control.get()].into_iter().flatten().fold(Cleanup::default(), |sum, node| {
            let state = match node {
                Variant::Ipc(node) => node.try_cleanup_dead_nodes(),
                #[cfg(feature = "group-access")]
                Variant::Files(node) => node.try_cleanup_dead_nodes(),
            };
            Cleanup { removed: sum.removed + state.cleanups, failed: sum.failed + state.failed_cleanups }
        })
    }

    /// Leaves clients of another user the right to read what this process publishes behind the gate `folder`, and
    /// no right to write it.
    ///
    /// # Errors
    /// [`TransportError::Internal`] when the files cannot be changed.
    #[cfg_attr(not(feature = "group-access"), expect(clippy::unused_self, clippy::unnecessary_wraps))]
    pub(crate) fn protect_payload(&self, folder: &Path) -> Result<(), TransportError> {
        #[cfg(feature = "group-access")]
        if self.access == AccessMode::Group {
            return protect_payload(&self.root, folder);
        }
        let _ = folder;
        Ok(())
    }

    pub(crate) fn variant(&self) -> &Variant {
        &self.node
    }

    /// The place of requests that change the daemon's state, where it is another one than that of all requests.
    ///
    /// # Errors
    /// [`TransportError::NotMember`] for a client that may not change anything.
    pub(crate) fn control_variant(&self) -> Result<Option<&Variant>, TransportError> {
        if *self.root.control() == Control::Subscribers {
            return Ok(None);
        }
        if let Some(node) = self.control.get() {
            return Ok(Some(node));
        }
        let folder = self.root.control_folder();
        if self.role == Role::Client {
            enter(&folder, CHANGE)?;
        }
        let node = open_files(&self.root, self.role, &folder)?;
        Ok(Some(self.control.get_or_init(|| node)))
    }
}

/// iceoryx2's node behind the gate `folder`.
#[cfg(feature = "group-access")]
fn open_files(root: &Root, role: Role, folder: &Path) -> Result<Variant, TransportError> {
    // Who passed the gate may use what is behind it, whoever it belongs to.
    Ok(Variant::Files(create(root, role, &root.config_behind(folder)?, || None)?))
}

#[cfg(not(feature = "group-access"))]
fn open_files(_: &Root, _: Role, _: &Path) -> Result<Variant, TransportError> {
    Err(TransportError::AccessNotBuilt { mode: AccessMode::Group.name() })
}

fn create<S: Service>(
    root: &Root,
    role: Role,
    config: &Config,
    foreign_owner: impl Fn() -> Option<TransportError>,
) -> Result<IoxNode<S>, TransportError> {
    let name = match role {
        Role::Daemon => "grnetd",
        Role::Client => "grnet-client",
    };
    let name = NodeName::new(name).expect("node names are short");
    retry("open a node under", &root.to_string(), || {
        NodeBuilder::new()
            .name(&name)
            .config(config)
            .signal_handling_mode(SignalHandlingMode::Disabled)
            .create::<S>()
            .map_err(|error| match foreign_owner() {
                Some(foreign) => Attempt::Failed(foreign),
                None => Attempt::Again(format!("{error:?}")),
            })
    })
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

fn prepare_files(access: AccessMode, root: &Root, role: Role) -> Result<(), TransportError> {
    match role {
        Role::Client => enter(&root.path(), "subscribe to its stream"),
        #[cfg(feature = "group-access")]
        Role::Daemon => open_gates(root, access),
        #[cfg(not(feature = "group-access"))]
        Role::Daemon => access.check_built(),
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
        assert!(
            matches!(error, TransportError::UnusableRoot { .. } | TransportError::WrongFolder { .. }),
            "{error}"
        );
        assert!(error.to_string().contains("/dev/null/root"), "{error}");
    }

    #[cfg(not(feature = "group-access"))]
    #[test]
    fn an_access_mode_of_another_build_opens_nothing() {
        let error = Node::open(AccessMode::Group, &Root::shared(), Role::Daemon).unwrap_err();
        assert_eq!(error, TransportError::AccessNotBuilt { mode: "group" });
    }
}
