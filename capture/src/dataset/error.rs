//! What can be wrong with a recording on disk.

use std::path::{Path, PathBuf};

use super::Layout;

/// Why a recording could not be opened.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum DatasetError {
    /// A file or folder is there but cannot be read.
    #[error("cannot read {path}")]
    Read {
        /// The file or folder.
        path: PathBuf,
        /// What the system said.
        #[source]
        source: std::io::Error,
    },
    /// A file's content is not what its format says.
    #[error("{path}, line {line}: found {found}, expected {expected}")]
    Malformed {
        /// The file.
        path: PathBuf,
        /// The line, from 1.
        line: usize,
        /// What is there.
        found: String,
        /// What should be there.
        expected: String,
    },
    /// Something that the layout needs is not there.
    #[error("{path} not found: {expected}")]
    Missing {
        /// The file or folder looked for.
        path: PathBuf,
        /// What it should be, and what to do.
        expected: String,
    },
    /// No known layout fits the folder.
    #[error("{path} is no recording that is known; looked for:\n{looked_for}")]
    UnknownLayout {
        /// The folder.
        path: PathBuf,
        /// One line for each layout: what would have identified it.
        looked_for: String,
    },
    /// There is no sequence of this name.
    #[error("{path} has no sequence {sequence:?} (available: {available})")]
    NoSuchSequence {
        /// The recording's folder.
        path: PathBuf,
        /// The sequence asked for.
        sequence: String,
        /// Names of the sequences that are there.
        available: String,
    },
    /// One recording was asked for and several are there.
    #[error("{path} holds {count} sequences ({available}): choose one with the option `sequence`")]
    SeveralSequences {
        /// The recording's folder.
        path: PathBuf,
        /// How many.
        count: usize,
        /// Their names.
        available: String,
    },
    /// Frames do not follow each other in time and number.
    #[error("{name}: {image} does not follow the frame before it in time")]
    Order {
        /// The recording.
        name: String,
        /// The image out of order.
        image: PathBuf,
    },
    /// There are no images.
    #[error("{path} holds no frames: {expected}")]
    Empty {
        /// The folder or file.
        path: PathBuf,
        /// What was looked for.
        expected: String,
    },
    /// Intrinsics and images do not belong together.
    #[error(
        "{origin} gives intrinsics for {camera_width_px}x{camera_height_px}, but {image} is \
         {image_width_px}x{image_height_px}: give intrinsics for the stored images"
    )]
    CameraSize {
        /// Where the intrinsics come from.
        origin: String,
        /// Width they hold for.
        camera_width_px: u32,
        /// Height they hold for.
        camera_height_px: u32,
        /// The image compared with.
        image: PathBuf,
        /// Its width.
        image_width_px: u32,
        /// Its height.
        image_height_px: u32,
    },
    /// An option cannot be honoured for this recording.
    #[error("option `{option}`: {problem}")]
    Option {
        /// The option's name.
        option: &'static str,
        /// What is wrong and what to do.
        problem: String,
    },
    /// A pose is not a rigid motion and [`InvalidPoses::Refuse`](super::InvalidPoses::Refuse) is set.
    #[error("{path}, line {line}: {problem}")]
    InvalidPose {
        /// The pose's file.
        path: PathBuf,
        /// Its line, from 1.
        line: usize,
        /// What is wrong with it.
        problem: String,
    },
}

impl DatasetError {
    pub(crate) fn read(path: &Path) -> impl FnOnce(std::io::Error) -> Self + '_ {
        |source| Self::Read { path: path.to_path_buf(), source }
    }

    pub(crate) fn missing(path: &Path, expected: impl Into<String>) -> Self {
        Self::Missing { path: path.to_path_buf(), expected: expected.into() }
    }

    pub(crate) fn no_option(option: &'static str, layout: Layout, remedy: &str) -> Self {
        Self::Option { option, problem: format!("the {layout} layout has none; {remedy}") }
    }
}
