//! Where frames come from: cameras and recordings behind [`FrameSource`](grnet_frame::FrameSource).
//!
//! | module | what it does |
//! |---|---|
//! | [`dataset`] | reads the folders of 7-Scenes, KITTI odometry, TUM RGB-D, EuRoC/ASL, COLMAP and plain images into [`dataset::Recording`]s: paths, times, intrinsics, true poses |
//! | [`folder`] | [`FolderSource`] plays a recording: at real-time pace like a camera, by a factor, or as fast as possible |
//! | [`decode`] | PNG and JPEG files and buffers to [`Pixels`](grnet_frame::Pixels) |
//! | [`clock`] | `CLOCK_MONOTONIC`, the clock of every live source |
//! | `conformance` | the contract of `FrameSource` as a test suite (feature `conformance`) |
//!
//! A source of another kind (a device, a video, a robot log) is a module beside [`folder`]: it implements
//! `FrameSource`, stamps its frames with [`clock::monotonic_ns`] when it is live, decodes through
//! [`decode`], and its tests call `conformance::check`.
#![forbid(unsafe_code)]
#![deny(missing_docs)]

pub mod clock;
#[cfg(any(test, feature = "conformance"))]
pub mod conformance;
pub mod dataset;
pub mod decode;
pub mod folder;

pub use folder::{FolderOptions, FolderSource, Pace};

#[cfg(test)]
mod tests;
