//! Gives a recording the true poses that somebody else measured: motion capture, another SLAM system, COLMAP.
//!
//! A pose reaches a frame by time ([`by_time`], interpolated) or by the image's name ([`by_name`]). Then, in this
//! order: the trajectory is scaled, the tracked body's pose becomes the camera's, the whole is moved onto a metric
//! reference, or turned so that z points up.

mod associate;
pub mod command;
mod transform;
mod write;

use std::path::PathBuf;

use grnet_capture::dataset::{DatasetError, Pose};
use grnet_geometry::align::AlignmentError;
use grnet_geometry::trajectory::{Trajectory, TrajectoryError};
use nalgebra::Vector3;
use serde::Serialize;

pub use associate::{Matched, by_name, by_time};
pub use transform::apply;
pub use write::{Target, target, write};

/// Fewest frames with a pose that make a join believable.
pub const LEAST_MATCHES: usize = 3;

/// What is done to the poses of a trajectory.
#[derive(Debug, Clone)]
pub struct Transform {
    /// Where its scale comes from.
    pub scale: Scale,
    /// Pose of the camera in the tracked body, metres.
    pub body_from_camera: Pose,
    /// How the world is turned.
    pub gravity: Option<Gravity>,
}

impl Default for Transform {
    fn default() -> Self {
        Self { scale: Scale::Factor(1.0), body_from_camera: Pose::identity(), gravity: None }
    }
}

/// Where the scale of a trajectory comes from.
#[derive(Debug, Clone)]
pub enum Scale {
    /// Known: metres per unit of the trajectory.
    Factor(f64),
    /// The distance between the camera's places at two frames was measured.
    Between {
        /// Number of the first frame.
        first: u64,
        /// Number of the second frame.
        second: u64,
        /// Metres between them.
        distance_m: f64,
    },
    /// A metric trajectory of the same drive; the result lies in its world.
    Reference {
        /// The trajectory.
        trajectory: Trajectory,
        /// Added to its times.
        time_offset_ns: i64,
        /// Longest time between two of its poses that is interpolated over.
        max_gap_ns: i64,
    },
}

/// How to find out where up is.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Gravity {
    /// Cameras are held upright on the average: their y axis points down.
    Camera,
    /// This direction of the trajectory's world points down.
    Down(Vector3<f64>),
}

/// What a join did, for its user.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct JoinReport {
    /// Frames of the recording.
    pub frames: usize,
    /// Those that got a pose.
    pub with_pose: usize,
    /// Frames before the first or after the last pose.
    pub outside: usize,
    /// Frames in a gap of the trajectory that is too long to interpolate over.
    pub in_gaps: usize,
    /// Frames whose name the trajectory does not have.
    pub unnamed: usize,
    /// Longest time between two poses that was interpolated over, seconds.
    pub largest_gap_s: Option<f64>,
    /// Metres per unit of the trajectory.
    pub scale: f64,
    /// Distances between the joined positions and the reference.
    pub reference: Option<Residuals>,
    /// By how much the world was turned to have z up, degrees.
    pub turned_deg: Option<f64>,
    /// Length of the camera's path, metres.
    pub path_m: f64,
    /// Frames at the two ends of a run without a pose are listed by their numbers.
    pub without_pose: Vec<(u64, u64)>,
}

/// Distances after an alignment.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Residuals {
    /// Positions compared.
    pub pairs: usize,
    /// Root of the mean square, metres.
    pub rms_m: f64,
    /// The largest, metres.
    pub max_m: f64,
}

/// Why a trajectory could not be joined to a recording.
#[derive(Debug, thiserror::Error)]
pub enum JoinError {
    /// The recording or the COLMAP model cannot be opened.
    #[error(transparent)]
    Dataset(#[from] DatasetError),
    /// The trajectory cannot be read.
    #[error(transparent)]
    Trajectory(#[from] TrajectoryError),
    /// They do not overlap in time.
    #[error(
        "the frames cover {:.3} to {:.3} s and the trajectory {:.3} to {:.3} s: they have no time in common; check \
         the clocks, or give --time-offset (from start to start it would be {:.3})",
        frames.0, frames.1, trajectory.0, trajectory.1, frames.0 - trajectory.0
    )]
    NoOverlap {
        /// First and last frame, seconds.
        frames: (f64, f64),
        /// First and last pose with the offset, seconds.
        trajectory: (f64, f64),
    },
    /// No image has a name of the model.
    #[error(
        "no image has a name that the model knows: the recording has names such as {recording:?}, the model such as \
         {model:?}; run COLMAP on the images of this recording, under their names"
    )]
    NoNames {
        /// A name of the recording.
        recording: String,
        /// A name of the model.
        model: String,
    },
    /// Two images have one name.
    #[error("{what} has two images {name:?}: names must be unique to join by them")]
    TwoOfOneName {
        /// Which list.
        what: &'static str,
        /// The name.
        name: String,
    },
    /// Too few frames got a pose.
    #[error(
        "{found} of {frames} frames would get a pose, at least {LEAST_MATCHES} are needed: {outside} frames lie outside \
         the trajectory's time and {in_gaps} in its gaps; see --max-gap and --time-offset"
    )]
    TooFew {
        /// Frames with a pose.
        found: usize,
        /// All frames.
        frames: usize,
        /// Outside of the trajectory.
        outside: usize,
        /// In its gaps.
        in_gaps: usize,
    },
    /// An option makes no sense here.
    #[error("{option}: {problem}")]
    Option {
        /// The option.
        option: &'static str,
        /// What is wrong, and what to do.
        problem: String,
    },
    /// The reference does not determine a scale.
    #[error("--reference: {0}")]
    Alignment(#[from] AlignmentError),
    /// The frames' times do not grow.
    #[error("frames {first} and {second} have the same time: poses by time need times that grow")]
    SameTime {
        /// Number of the first.
        first: u64,
        /// Number of the second.
        second: u64,
    },
    /// The ground truth is there already.
    #[error("{path} exists: pass --force to replace it, or --out to write elsewhere")]
    Exists {
        /// The file.
        path: PathBuf,
    },
    /// The ground truth could not be written.
    #[error("cannot write {path}: {source}")]
    Write {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
}
