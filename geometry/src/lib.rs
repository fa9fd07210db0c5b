//! Rigid-body poses, trajectories, alignment and scores.
//!
//! Pure mathematics on [`nalgebra`] in `f64`: no clock, no threads, and no files except the text formats of
//! [`trajectory`]. The conventions below hold in the whole workspace.
//!
//! * A [`Pose`] `a_from_b` maps points given in frame `b` to frame `a`: `point_in_a = a_from_b * point_in_b`.
//!   Adjacent names match when poses are composed: `world_from_camera * camera_from_body`.
//! * Camera axes: x right, y down, z forward. Metres and radians; degrees only in scores made for people.
//! * Quaternions are `(x, y, z, w)` with `w >= 0` wherever they leave the process ([`quaternion`]).
//! * Tangent vectors and covariances are ordered `[translation, rotation]` ([`se3::Tangent`],
//!   [`Covariance6`]).
//!
//! ```
//! use grnet_geometry::{nalgebra::Vector3, se3, Pose};
//!
//! let world_from_a = Pose::translation(1.0, 0.0, 0.0);
//! let world_from_b = Pose::new(Vector3::new(1.0, 2.0, 0.0), Vector3::new(0.0, 0.0, 0.1));
//! let a_from_b = se3::relative(&world_from_a, &world_from_b);
//! let composed = world_from_a * a_from_b;
//! assert!((composed.translation.vector - world_from_b.translation.vector).norm() < 1e-12);
//! ```
#![forbid(unsafe_code)]
#![deny(missing_docs)]

pub mod align;
pub mod covariance;
pub mod quaternion;
pub mod scores;
pub mod se3;
pub mod statistics;
pub mod trajectory;

pub use covariance::Covariance6;
pub use nalgebra;
pub use trajectory::{StampedPose, Trajectory};

/// A rigid transformation `a_from_b`: rotation and translation in metres.
pub type Pose = nalgebra::Isometry3<f64>;
