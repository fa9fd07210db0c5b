//! Where frames come from: cameras and recordings behind [`FrameSource`](grnet_frame::FrameSource).
//!
//! | module | what it does |
//! |---|---|
//! | [`dataset`] | reads the folders of 7-Scenes, KITTI odometry, TUM RGB-D, EuRoC/ASL, COLMAP and plain images into [`dataset::Recording`]s: paths, times, intrinsics, true poses |
//! | [`folder`] | [`FolderSource`] plays a recording: at real-time pace like a camera, by a factor, or as fast as possible |
//! | [`video`] | [`VideoSource`] plays a video file through the ffmpeg program, at the same paces |
//! | [`record`] | [`RecordingWriter`] writes frames to a folder that [`dataset`] reads |
//! | [`v4l2`] | [`V4l2Source`] captures from a V4L2 camera; lists cameras; survives unplugging |
//! | [`decode`] | PNG and JPEG files and buffers to [`Pixels`](grnet_frame::Pixels) |
//! | [`clock`] | `CLOCK_MONOTONIC`, the clock of every live source |
//! | `conformance` | the contract of `FrameSource` as a test suite (feature `conformance`) |
//!
//! A source of another kind (a device, a robot log) is a module beside [`folder`]: it implements
//! `FrameSource`, stamps its frames with [`clock::monotonic_ns`] when it is live, decodes through
//! [`decode`], and its tests call `conformance::check`.
// Two files allow it: v4l2/stream.rs and v4l2/controls.rs.
#![deny(unsafe_code)]
#![deny(missing_docs)]

pub mod clock;
#[cfg(any(test, feature = "conformance"))]
pub mod conformance;
pub mod dataset;
pub mod decode;
pub mod folder;
mod play;
pub mod record;
pub mod v4l2;
pub mod video;

pub use folder::{FolderOptions, FolderSource};
pub use play::Pace;
pub use record::RecordingWriter;
pub use v4l2::{V4l2Options, V4l2Source};
pub use video::{VideoOptions, VideoSource};

#[cfg(test)]
mod tests;
