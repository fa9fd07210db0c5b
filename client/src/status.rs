//! Reading the daemon's state.

use std::time::{Duration, Instant};

use grnet_proto::{DaemonStatus, Node, StatusSubscription, TransportError, names};

use crate::{ClientError, Connection};

/// Reads what the daemon says about itself, twice a second.
///
/// Not `Send`: open it on the thread that reads.
#[derive(Debug)]
pub struct StatusReader {
    // The port before the node it was opened on: fields are dropped in this order.
    subscription: StatusSubscription,
    node: Node,
    connection: Connection,
}

impl StatusReader {
    /// Attaches to a running daemon.
    ///
    /// # Errors
    /// As for [`PoseSubscriber::open`](crate::PoseSubscriber::open).
    pub fn open(connection: &Connection) -> Result<Self, ClientError> {
        let node = connection.node()?;
        let subscription = StatusSubscription::open(&node, &connection.camera)?;
        Ok(Self { subscription, node, connection: connection.clone() })
    }

    /// The newest status that was not read yet; waits for it until `timeout` has passed.
    ///
    /// # Errors
    /// [`ClientError::Timeout`] when a daemon is there and said nothing, [`ClientError::NoDaemon`] when
    /// it has gone.
    pub fn read(&mut self, timeout: Duration) -> Result<Box<DaemonStatus>, ClientError> {
        let deadline = Instant::now() + timeout;
        loop {
            let mut newest = None;
            while let Some(status) = self.subscription.receive()? {
                newest = Some(Box::new(status));
            }
            if let Some(status) = newest {
                return Ok(status);
            }
            let remaining = deadline.saturating_duration_since(Instant::now());
            if remaining.is_zero() {
                return Err(self.nothing_came(timeout));
            }
            self.subscription.wait(remaining)?;
        }
    }

    fn nothing_came(&self, waited: Duration) -> ClientError {
        let service = names::status(&self.connection.camera);
        self.node.cleanup_dead_nodes();
        if self.subscription.has_publisher() {
            ClientError::Timeout { service, expected: "status", waited }
        } else {
            ClientError::NoDaemon(TransportError::NoDaemon { service, root: self.node.root().to_string() })
        }
    }
}
