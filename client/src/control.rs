//! Asking the daemon for something.

use std::time::Duration;

use grnet_geometry::{Pose, quaternion};
use grnet_proto::{Command, ControlReply, ControlRequest, Node, Outcome, TransportError, names};

use crate::{ClientError, Connection};

/// Sends requests to the daemon and waits for its answers.
///
/// Every method gives the daemon's reply when it did what was asked, and [`ClientError::Refused`] with
/// the reply otherwise. Not `Send`: open it on the thread that asks.
#[derive(Debug)]
pub struct ControlClient {
    // The port before the node it was opened on: fields are dropped in this order.
    client: grnet_proto::ControlClient,
    node: Node,
    connection: Connection,
    timeout: Duration,
}

impl ControlClient {
    /// Attaches to a running daemon; `timeout` holds for every request.
    ///
    /// # Errors
    /// As for [`PoseSubscriber::open`](crate::PoseSubscriber::open).
    pub fn open(connection: &Connection, timeout: Duration) -> Result<Self, ClientError> {
        let node = connection.node()?;
        // A daemon that was killed would be waited for.
        node.cleanup_dead_nodes();
        let client = grnet_proto::ControlClient::open(&node, &connection.camera)?;
        Ok(Self { client, node, connection: connection.clone(), timeout })
    }

    /// Restarts odometry at identity.
    ///
    /// # Errors
    /// [`ClientError::Refused`], [`ClientError::Timeout`].
    pub fn reset_odometry(&mut self) -> Result<Box<ControlReply>, ClientError> {
        self.command(Command::RESET_ODOMETRY)
    }

    /// Tells the daemon where the base is in the map.
    ///
    /// # Errors
    /// [`ClientError::Refused`], [`ClientError::Timeout`].
    pub fn set_pose(&mut self, map_from_base: &Pose) -> Result<Box<ControlReply>, ClientError> {
        let translation_m = map_from_base.translation.vector.into();
        self.call(&ControlRequest::set_pose(translation_m, quaternion::xyzw(&map_from_base.rotation)))
    }

    /// Tells the daemon where the base is in the map, and how well that is known: standard deviations along and
    /// about each axis. With a scene the network's pose has then to agree; without them it wins at once.
    ///
    /// # Errors
    /// [`ClientError::Refused`], [`ClientError::Timeout`].
    pub fn set_uncertain_pose(
        &mut self,
        map_from_base: &Pose,
        translation_stddev_m: f64,
        rotation_stddev_rad: f64,
    ) -> Result<Box<ControlReply>, ClientError> {
        let translation_m = map_from_base.translation.vector.into();
        let request = ControlRequest::set_pose(translation_m, quaternion::xyzw(&map_from_base.rotation));
        self.call(&request.with_stddev(translation_stddev_m, rotation_stddev_rad))
    }

    /// Loads a scene from a file of the daemon's machine; the old one stays when that fails.
    ///
    /// # Errors
    /// [`ClientError::Refused`] with the reason, [`ClientError::Timeout`], [`ClientError::TooLong`].
    pub fn load_scene(&mut self, absolute_path: &str) -> Result<Box<ControlReply>, ClientError> {
        self.command_with(Command::LOAD_SCENE, absolute_path)
    }

    /// Any request that needs no argument.
    ///
    /// # Errors
    /// [`ClientError::Refused`], [`ClientError::Timeout`].
    pub fn command(&mut self, command: Command) -> Result<Box<ControlReply>, ClientError> {
        self.call(&ControlRequest::new(command))
    }

    /// Any request that needs a name or a path.
    ///
    /// # Errors
    /// [`ClientError::Refused`], [`ClientError::Timeout`], [`ClientError::TooLong`].
    pub fn command_with(&mut self, command: Command, text: &str) -> Result<Box<ControlReply>, ClientError> {
        let request =
            ControlRequest::with_text(command, text).ok_or_else(|| ClientError::TooLong(text.to_owned()))?;
        self.call(&request)
    }

    fn call(&mut self, request: &ControlRequest) -> Result<Box<ControlReply>, ClientError> {
        let answer = self.client.call(request, self.timeout);
        if matches!(answer, Err(TransportError::NoAnswer { .. })) {
            self.node.cleanup_dead_nodes();
            if !self.client.has_server() {
                return Err(ClientError::NoDaemon(TransportError::NoDaemon {
                    service: names::control(&self.connection.camera),
                    root: self.connection.root.to_string(),
                }));
            }
        }
        let reply = Box::new(answer?);
        if reply.outcome == Outcome::DONE { Ok(reply) } else { Err(ClientError::Refused(reply)) }
    }
}
