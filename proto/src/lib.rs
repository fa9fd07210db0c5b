//! Messages, service names and quality of service of the grnet pose stream.
//!
//! This crate knows [iceoryx2](https://docs.rs/iceoryx2) and nothing of the pipeline. The daemon opens
//! a [`Node`] and on it a [`PosePublisher`], a [`StatusPublisher`] and a [`ControlServer`]; clients open
//! [`PoseSubscription`], [`StatusSubscription`] and [`ControlClient`], mostly through `grnet-client`.
//!
//! Nodes and ports are neither `Send` nor `Sync`: create them on the thread that uses them, one node
//! per thread.
//!
//! ```
//! use std::time::Duration;
//! use grnet_proto::{AccessMode, BootId, CameraName, Node, PosePublisher, PoseSample, PoseSubscription};
//! use grnet_proto::{Reason, Role, Root, Status};
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! # let folder = tempfile::tempdir_in("/tmp")?;
//! # let root = Root::own(folder.path(), Some("doc_"))?;
//! # /*
//! let root = Root::shared();
//! # */
//! let camera: CameraName = "front".parse()?;
//!
//! let node = Node::open(AccessMode::User, &root, Role::Daemon)?;
//! let mut publisher = PosePublisher::open(&node, &camera)?;
//! let subscription = PoseSubscription::open(&node, &camera)?;
//!
//! let sample = PoseSample::unknown(BootId::random()?, &camera, Status::INITIALIZING, Reason::STARTING);
//! publisher.publish(&sample)?;
//!
//! subscription.wait(Duration::from_secs(1))?;
//! let received = subscription.receive()?.expect("it was published before");
//! assert_eq!(received.sample, 1);
//! # Ok(())
//! # }
//! ```
#![forbid(unsafe_code)]
#![deny(missing_docs)]

pub mod access;
pub mod clock;
mod error;
#[cfg(feature = "group-access")]
mod files;
pub mod message;
pub mod names;
mod node;
pub mod python;
pub mod qos;
mod service;

pub use access::{AccessMode, Group, Root};
pub use error::TransportError;
pub use message::{
    Access, BootId, CaptureClock, Command, ContentHash, ControlReply, ControlRequest, DaemonStatus,
    FixedText, Health, LatencyPercentiles, MAX_SCENES, Outcome, PoseSample, PoseWithCovariance, Provenance,
    Reason, Recording, SCHEMA_VERSION, SceneInfo, SourceState, StageLatency, StagePercentiles, Status,
    UNKNOWN_U64,
};
pub use names::{CameraName, CameraNameError};
pub use node::{Cleanup, Node, Role};
pub use service::{
    ControlClient, ControlServer, Delivered, Message, PendingRequest, PosePublisher, PoseSubscription,
    Publisher, StatusPublisher, StatusSubscription, Subscription,
};

/// Version of this package, as it stands in service attributes and status messages.
pub const PACKAGE_VERSION: &str = env!("CARGO_PKG_VERSION");

/// Version of the transport. Services of another minor version cannot be read.
pub const ICEORYX2_VERSION: &str = "0.10.0";

#[cfg(test)]
mod tests {
    #[test]
    fn the_transport_is_the_one_that_is_named() {
        let manifest = include_str!("../../Cargo.toml");
        let pinned = format!("iceoryx2 = \"={}\"", super::ICEORYX2_VERSION);
        assert!(manifest.lines().any(|line| line == pinned), "{pinned}");
    }
}
