//! Which daemon a client talks to.

use grnet_proto::{AccessMode, CameraName, Node, Role, Root};

use crate::ClientError;

/// Which daemon a client talks to; the default is camera `front` of this user's daemon.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Connection {
    /// The camera.
    pub camera: CameraName,
    /// Where the daemon keeps its services.
    pub root: Root,
    /// Who may subscribe, as the daemon is configured.
    pub access: AccessMode,
}

impl Connection {
    /// The daemon of this user that serves `camera`.
    pub fn to(camera: CameraName) -> Self {
        Self { camera, ..Self::default() }
    }

    pub(crate) fn node(&self) -> Result<Node, ClientError> {
        Ok(Node::open(self.access, &self.root, Role::Client)?)
    }
}
