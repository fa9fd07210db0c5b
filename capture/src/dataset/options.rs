//! How a recording is to be opened.

use std::fmt;
use std::path::PathBuf;
use std::time::Duration;

use grnet_frame::Camera;

use super::DatasetError;

/// How a recording's folder is laid out.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
#[non_exhaustive]
pub enum Layout {
    /// Found out from what is in the folder.
    #[default]
    Auto,
    /// Microsoft 7-Scenes (also 12-Scenes): `seq-01/frame-000000.color.png` and `.pose.txt`.
    SevenScenes,
    /// KITTI odometry: `sequences/06/image_0/000000.png`, `times.txt`, `calib.txt`, `poses/06.txt`.
    Kitti,
    /// EuRoC MAV / ASL: `mav0/cam0/data.csv`, `sensor.yaml`, `state_groundtruth_estimate0/data.csv`.
    Euroc,
    /// TUM RGB-D: `rgb.txt`, `groundtruth.txt`.
    Tum,
    /// COLMAP text model: `cameras.txt`, `images.txt`.
    Colmap,
    /// A folder of PNG or JPEG images in natural order of their names.
    Images,
}

impl Layout {
    /// Every layout that can be read, in the order in which they are looked for.
    pub const ALL: [Self; 6] =
        [Self::SevenScenes, Self::Kitti, Self::Euroc, Self::Tum, Self::Colmap, Self::Images];
}

impl fmt::Display for Layout {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Auto => "automatic",
            Self::SevenScenes => "7-Scenes",
            Self::Kitti => "KITTI",
            Self::Euroc => "EuRoC",
            Self::Tum => "TUM RGB-D",
            Self::Colmap => "COLMAP",
            Self::Images => "images",
        })
    }
}

/// Which frames of a dataset to take.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub enum Split {
    /// All of them.
    #[default]
    All,
    /// Those of `TrainSplit.txt` (7-Scenes).
    Train,
    /// Those of `TestSplit.txt` (7-Scenes).
    Test,
    /// Those that a text file lists, one a line: a sequence (`seq-01`, `sequence1`) or a frame
    /// (`seq-01/frame-000005`, or for other layouts the image's path below the folder without its extension).
    /// A relative path that does not exist is looked for in the recording's folder.
    List(PathBuf),
}

/// How ground truth with times of its own is carried to the frames.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Association {
    /// The pose nearest in time, if it is at most this far away.
    Nearest(Duration),
    /// Between the pose before and the pose after, if each is at most this far away (straight line, and
    /// the shortest rotation at constant speed).
    Interpolate(Duration),
}

impl Default for Association {
    /// Interpolation over at most 20 ms on either side: the gap that TUM's own `associate.py` allows.
    fn default() -> Self {
        Self::Interpolate(Duration::from_millis(20))
    }
}

/// What to do about a ground-truth pose that is no rigid motion (7-Scenes and TUM have such frames).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum InvalidPoses {
    /// The frame stays, without a pose; [`Recording::invalid_poses`](super::Recording::invalid_poses) counts it.
    #[default]
    Forget,
    /// The recording is refused with the pose's file and line.
    Refuse,
}

/// How to open a recording; the default takes everything and finds out the layout.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct OpenOptions {
    /// The layout.
    pub layout: Layout,
    /// The one sequence to take, by [`Recording::id`](super::Recording::id).
    pub sequence: Option<String>,
    /// The part of the frames to take.
    pub split: Split,
    /// The camera to take where a layout has several: `image_2` (KITTI), `cam1` (EuRoC), `2` (COLMAP camera id).
    pub camera_name: Option<String>,
    /// Intrinsics of the stored images instead of what the recording says.
    pub camera: Option<Camera>,
    /// Regular time stamps at this rate, by frame number, instead of the recorded or assumed ones.
    pub rate_hz: Option<f64>,
    /// Ground truth from this file instead of the layout's own; found out from its first data line:
    /// * TUM trajectory: `time_s tx ty tz qx qy qz qw`, by time (or row by row, when the images have no
    ///   times and are as many),
    /// * EuRoC/ASL: `time_ns, px, py, pz, qw, qx, qy, qz, ...`, by time,
    /// * KITTI: twelve numbers of [R | t] a row, by frame number (thirteen: the number first),
    /// * camera_from_world list, as the pseudo ground truth of 7-Scenes: `image qw qx qy qz tx ty tz [focal_px]`,
    ///   by name.
    ///
    /// It must hold poses of the camera that took the images.
    pub poses: Option<PathBuf>,
    /// How ground truth with its own times is carried over.
    pub association: Association,
    /// What to do about impossible poses.
    pub invalid_poses: InvalidPoses,
}

impl OpenOptions {
    pub(crate) fn check(&self) -> Result<(), DatasetError> {
        match self.rate_hz {
            Some(rate) if !(rate.is_finite() && rate > 0.0) => Err(DatasetError::Option {
                option: "rate_hz",
                problem: format!("found {rate}, expected a positive number of frames per second"),
            }),
            _ => Ok(()),
        }
    }
}
