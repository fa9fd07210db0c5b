//! Which daemon a client talks to.

use grnet_proto::{CameraName, Node, Role, Root, access::find};

use crate::ClientError;

/// Which daemon a client talks to; the default is camera `front`, wherever its daemon runs.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Connection {
    /// The camera.
    pub camera: CameraName,
    /// Where the daemon keeps its services. With the default a client looks under `/run/grnet`, in this user's own
    /// folders and under iceoryx2's own root. How the daemon shares its stream is found out there.
    pub root: Root,
}

impl Connection {
    /// The daemon that serves `camera`.
    pub fn to(camera: CameraName) -> Self {
        Self { camera, ..Self::default() }
    }

    pub(crate) fn node(&self) -> Result<Node, ClientError> {
        let (access, root) = find(&self.camera, &self.root)?;
        Ok(Node::open(access, &root, Role::Client)?)
    }
}
