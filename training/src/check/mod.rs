//! What is wrong with a data set, before a network learns it.
//!
//! | module | looks for |
//! |---|---|
//! | [`images`] | images that cannot be read, differ in size, repeat, are blurred, too dark or too bright |
//! | [`times`] | gaps and repeated time stamps |
//! | [`poses`] | missing and impossible poses, jumps, too little motion |
//! | [`motion`] | poses and intrinsics that do not fit how corners move through the images: wrong focal length, poses that are early or late, inverted, or of other axes |
//! | [`coverage`] | test frames that are far from every training frame |

pub mod command;
pub mod coverage;
mod epipolar;
mod finding;
mod flow;
pub mod images;
pub mod motion;
mod pairs;
pub mod poses;
pub mod times;

use std::path::Path;

use grnet_capture::dataset::{self, DatasetError, InvalidPoses, OpenOptions, Recording, Split};

pub use finding::{CheckReport, Finding, Severity};

/// What to look at beside the frames themselves.
#[derive(Debug, Clone, Default)]
pub struct CheckOptions {
    /// How to open the data set; its `split` is not looked at.
    pub open: OpenOptions,
    /// Lists of training and test frames, to compare their places.
    pub lists: Option<(std::path::PathBuf, std::path::PathBuf)>,
}

/// Looks at every sequence of the data set at `path`; `progress` is called once for each image.
///
/// # Errors
/// When the data set cannot be opened at all.
pub fn check(
    path: &Path,
    options: &CheckOptions,
    progress: &(dyn Fn() + Sync),
) -> Result<CheckReport, DatasetError> {
    let recordings = dataset::open(path, &options.open)?;
    let mut findings = Vec::new();
    let mut frames = 0;
    for recording in &recordings {
        frames += recording.frames.len();
        let mut found = times::check(recording);
        let looks = images::look(recording, progress);
        found.extend(images::check(recording, &looks));
        found.extend(poses::check(recording, first_invalid(path, recording, options).as_deref()));
        found.extend(motion::check(recording));
        findings.extend(found.into_iter().map(|finding| (recording.id.clone(), finding)));
    }
    if let Some((train, test)) = &options.lists {
        let open = |list: &std::path::PathBuf| {
            dataset::open(path, &OpenOptions { split: Split::List(list.clone()), ..options.open.clone() })
        };
        let found = coverage::check(&open(train)?, &open(test)?);
        findings.extend(found.into_iter().map(|finding| (String::new(), finding)));
    }
    let sequences = recordings.into_iter().map(|recording| recording.id).collect();
    Ok(CheckReport::new(path, sequences, frames, findings))
}

/// File, line and fault of the first pose that is no rigid motion.
fn first_invalid(path: &Path, recording: &Recording, options: &CheckOptions) -> Option<String> {
    if recording.invalid_poses == 0 {
        return None;
    }
    let sequence = Some(recording.id.clone());
    let strict = OpenOptions { invalid_poses: InvalidPoses::Refuse, sequence, ..options.open.clone() };
    dataset::open(path, &strict).err().map(|error| error.to_string())
}
