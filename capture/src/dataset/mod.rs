//! Recordings on disk: images, times of capture, intrinsics and true poses.
//!
//! [`open`] reads a folder in one of the layouts of [`Layout`] into [`Recording`]s, one for each sequence
//! (and camera); [`open_one`] insists on a single one. Nothing is decoded here: a missing or corrupt image
//! shows when it is played ([`crate::FolderSource`]), where it costs one frame.
//!
//! The recording's folder may be the dataset's root or one sequence of it. Ground truth in another file (a TUM
//! trajectory, the pseudo ground truth of 7-Scenes, ...) is given by [`OpenOptions::poses`].
//!
//! ```no_run
//! use grnet_capture::dataset::{self, OpenOptions, Split};
//! let options = OpenOptions { split: Split::List("interleave_train.txt".into()), ..Default::default() };
//! for recording in dataset::open("data/redkitchen".as_ref(), &options)? {
//!     println!("{}: {} frames in {} blocks", recording.name, recording.frames.len(), recording.blocks().count());
//! }
//! # Ok::<(), dataset::DatasetError>(())
//! ```
//!
//! # What is defined for incomplete recordings
//!
//! | what | then |
//! |---|---|
//! | no ground truth at all, or none for some frames | those frames have no pose; a note says how many |
//! | more ground truth than images | the surplus is ignored |
//! | a pose that is no rigid motion (NaN, infinity, a matrix that is no rotation) | [`InvalidPoses`]: forgotten and counted, or an error |
//! | no intrinsics | [`Recording::camera`] is `None`, or the dataset's published figures where there are any |
//! | no time stamps | regular ones at the layout's rate or [`OpenOptions::rate_hz`], by frame number, so that gaps stay |
//! | time stamps that fall | an error with file and line |
//! | any text that does not parse | an error with file, line, what was found and what was expected |

mod assemble;
pub mod calibration;
mod colmap;
mod colmap_camera;
mod detect;
mod error;
mod euroc;
mod images;
mod intrinsics;
mod kitti;
mod listing;
mod options;
mod pose;
mod pose_table;
mod sensor_yaml;
mod seven_scenes;
mod split;
mod text;
mod tum;
mod yaml;

use std::path::{Path, PathBuf};

use grnet_frame::Camera;

pub use error::DatasetError;
pub use grnet_geometry::Pose;
pub use options::{Association, InvalidPoses, Layout, OpenOptions, Split};

/// One image of a recording.
#[derive(Debug, Clone, PartialEq)]
pub struct RecordedFrame {
    /// The image file; not looked at until it is played.
    pub path: PathBuf,
    /// Time of capture in nanoseconds on the recording's own clock.
    pub time_ns: u64,
    /// The dataset's own frame number, or the index in its list where it has none; grows strictly.
    pub sequence: u64,
    /// True pose of the camera that took the image (x right, y down, z forward), metres, where known.
    pub world_from_camera: Option<Pose>,
    /// Intrinsics of this frame where they differ from [`Recording::camera`].
    pub camera: Option<Camera>,
}

/// The frames of one camera in one sequence.
#[derive(Debug, Clone, PartialEq)]
pub struct Recording {
    /// What a log line should call it: `7-Scenes redkitchen seq-01`.
    pub name: String,
    /// The sequence's name in the dataset: `seq-01`, `06`; what [`OpenOptions::sequence`] chooses by.
    pub id: String,
    /// The layout that was read; never [`Layout::Auto`].
    pub layout: Layout,
    /// In order of capture; never empty.
    pub frames: Vec<RecordedFrame>,
    /// Intrinsics of the stored images, where known.
    pub camera: Option<Camera>,
    /// Width and height in pixels of the stored images, from the first one whose header could be read.
    pub image_size_px: Option<(u32, u32)>,
    /// Frames per second: the middle one of all intervals; `None` for a single frame.
    pub nominal_rate_hz: Option<f64>,
    /// Ground-truth poses that were forgotten because they are no rigid motions.
    pub invalid_poses: usize,
    /// What a user should know: assumed intrinsics, frames without a pose.
    pub notes: Vec<String>,
}

impl Recording {
    /// Number of frames without a true pose.
    pub fn frames_without_pose(&self) -> usize {
        self.frames.iter().filter(|frame| frame.world_from_camera.is_none()).count()
    }

    /// Runs of consecutive frame numbers: a split into blocks has one run for each block, on whose first
    /// frame recurrent state is to be reset.
    pub fn blocks(&self) -> impl Iterator<Item = &[RecordedFrame]> {
        self.frames.chunk_by(|a, b| a.sequence + 1 == b.sequence)
    }
}

/// Opens every sequence of the recording at `path` that the options choose.
///
/// The result is never empty, and the order of sequences and frames depends on nothing but their names and
/// times.
///
/// # Errors
/// See [`DatasetError`].
pub fn open(path: &Path, options: &OpenOptions) -> Result<Vec<Recording>, DatasetError> {
    options.check()?;
    if !path.is_dir() {
        let expected = "the folder of a recording; check the path".to_string();
        return Err(DatasetError::missing(path, expected));
    }
    let layout = match options.layout {
        Layout::Auto => detect::layout(path)?,
        layout => layout,
    };
    let set = detect::list(layout, path, options)?;
    assemble::recordings(path, set, options)
}

/// Opens the one sequence that the options choose.
///
/// # Errors
/// See [`DatasetError`]; [`DatasetError::SeveralSequences`] names what there is to choose from.
pub fn open_one(path: &Path, options: &OpenOptions) -> Result<Recording, DatasetError> {
    let mut recordings = open(path, options)?;
    if recordings.len() > 1 {
        return Err(DatasetError::SeveralSequences {
            path: path.to_path_buf(),
            count: recordings.len(),
            available: listing::names(recordings.iter().map(|recording| recording.id.as_str())),
        });
    }
    Ok(recordings.remove(0))
}
