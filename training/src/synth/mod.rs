//! The synthetic place: textured rooms, a hand-held camera's paths through them, a sensor, and the
//! `grnet-train synth` command that writes them as a 7-Scenes recording.
//!
//! Everything follows from seeds. Geometry, textures, light, paths and noise use IEEE arithmetic, integer
//! hashes and ChaCha only, never the platform's mathematical library, and no result depends on the number of
//! threads: one generator version gives the same pixels on every machine. A test pins the hash of a frame;
//! whoever changes the pixels raises [`GENERATOR_VERSION`]. Encoded files are also the same as long as the
//! locked version of the `image` crate is.
//!
//! Frames: the world has its origin on the floor in the middle of the room, z up, metres; the camera has x
//! right, y down, z forward; poses are `world_from_camera`; pixel centres lie at integer coordinates.
//!
//! To train on frames made on the fly, build a [`Scene`] once and call [`Scene::render`] and
//! [`Sensor::develop`] from every worker with a [`RenderTarget`] of its own; poses come from a
//! [`Trajectory`] or from [`Volume::random_pose`].

pub mod command;
mod error;
mod furniture;
mod geometry;
mod light;
mod manifest;
mod material;
pub(crate) mod numeric;
mod output;
mod picture;
mod render;
mod room;
mod scene;
mod sensor;
mod texture;
mod trajectory;
mod volume;
mod writer;

pub use error::SynthError;
pub use geometry::Geometry;
pub use render::RenderTarget;
pub use scene::{Landmark, Scene, SceneOptions};
pub use sensor::{FrameKey, Sensor, SensorOptions};
pub use trajectory::{PathOptions, Trajectory};
pub(crate) use volume::pose_of;
pub use volume::{Volume, VolumeKind};
pub use writer::{ImageFormat, Recipe, Shutter, write};

/// Raised whenever the same seeds give other pixels or poses.
pub const GENERATOR_VERSION: u32 = 1;
