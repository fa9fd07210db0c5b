//! Client library of the grnet pose stream.
//!
//! A [`PoseSubscriber`] receives [`Sample`]s from a running `grnetd`, in another process or in the same
//! one; [`StatusReader`] and [`ControlClient`] look after the daemon itself. None of them is `Send`:
//! open them on the thread that uses them, or let [`subscribe`] run a callback on a thread of its own.
//!
//! ```no_run
//! use std::time::Duration;
//! use grnet_client::{Connection, PoseSubscriber};
//!
//! # fn main() -> Result<(), grnet_client::ClientError> {
//! let mut poses = PoseSubscriber::open(&Connection::default())?;
//! loop {
//!     let sample = poses.next_within(Duration::from_secs(1))?;
//!     match sample.odom_from_base() {
//!         Some(odom_from_base) => println!("{}: {}", sample.status(), odom_from_base.translation),
//!         None => println!("{}: {}", sample.status(), sample.reason()),
//!     }
//! }
//! # }
//! ```
#![forbid(unsafe_code)]
#![deny(missing_docs)]

// The command's modules call the library by the name that its users do.
#[cfg(feature = "cli")]
extern crate self as grnet_client;

mod callback;
#[cfg(feature = "cli")]
#[doc(hidden)]
pub mod cli;
mod connection;
mod control;
mod error;
mod sample;
mod status;
mod subscriber;

pub use callback::{Subscription, subscribe};
pub use connection::Connection;
pub use control::ControlClient;
pub use error::ClientError;
pub use grnet_proto::{
    AccessMode, BootId, CameraName, CaptureClock, Command, ContentHash, ControlReply, ControlRequest,
    DaemonStatus, Health, Outcome, PoseSample, Provenance, Reason, Root, SourceState, StageLatency, Status,
    TransportError,
};
pub use sample::{CaptureTime, Sample};
pub use status::StatusReader;
pub use subscriber::{PoseSubscriber, Samples};
