//! Ports of daemon and clients on the services of a camera.

mod control;
mod open;
mod publisher;
mod subscription;

use core::fmt::Debug;

use iceoryx2::prelude::ZeroCopySend;

use crate::{CameraName, DaemonStatus, PoseSample, SCHEMA_VERSION, names};

pub use control::{ControlClient, ControlServer, PendingRequest};
pub use publisher::{Delivered, Publisher};
pub use subscription::Subscription;

/// Publishes poses: the daemon's side of `grnet/<camera>/pose`.
pub type PosePublisher = Publisher<PoseSample>;
/// Publishes the daemon's state: the daemon's side of `grnet/<camera>/status`.
pub type StatusPublisher = Publisher<DaemonStatus>;
/// Receives poses: a client's side of `grnet/<camera>/pose`.
pub type PoseSubscription = Subscription<PoseSample>;
/// Receives the daemon's state: a client's side of `grnet/<camera>/status`.
pub type StatusSubscription = Subscription<DaemonStatus>;

/// A message that is published; implemented by [`PoseSample`] and [`DaemonStatus`].
pub trait Message: ZeroCopySend + Debug + Copy + sealed::Sealed + 'static {
    /// The type name with its version.
    const TYPE_NAME: &'static str;

    /// Whoever publishes this is the daemon, and tells clients how it shares.
    const ANNOUNCES: bool = false;

    /// The service that carries the message.
    fn service_name(camera: &CameraName) -> String;

    /// Sets what the publisher knows best: the schema version and the count of publications.
    fn stamp(&mut self, sample: u64);
}

mod sealed {
    /// Keeps [`super::Message`] to the messages of this crate.
    pub trait Sealed {}
    impl Sealed for crate::PoseSample {}
    impl Sealed for crate::DaemonStatus {}
}

impl Message for PoseSample {
    const TYPE_NAME: &'static str = Self::TYPE_NAME;
    const ANNOUNCES: bool = true;

    fn service_name(camera: &CameraName) -> String {
        names::pose(camera)
    }

    fn stamp(&mut self, sample: u64) {
        self.schema_version = SCHEMA_VERSION;
        self.sample = sample;
    }
}

impl Message for DaemonStatus {
    const TYPE_NAME: &'static str = Self::TYPE_NAME;

    fn service_name(camera: &CameraName) -> String {
        names::status(camera)
    }

    fn stamp(&mut self, sample: u64) {
        self.schema_version = SCHEMA_VERSION;
        self.sample = sample;
    }
}
