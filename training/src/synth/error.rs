//! Why a scene could not be rendered or written.

use std::path::PathBuf;

/// What went wrong, on what, and what to do.
#[derive(Debug, thiserror::Error)]
pub enum SynthError {
    /// The ray caster knows ideal pinholes only.
    #[error("the synthetic camera cannot render lens distortion: pass `camera.undistorted()`")]
    Distorted,
    /// No path was found inside the volume.
    #[error(
        "room {room} has no {volume} path for sequence {sequence} of seed {seed} ({tries} tries): choose another --room or --seed"
    )]
    NoPath {
        /// The room's number.
        room: u64,
        /// The volume's name.
        volume: &'static str,
        /// Seed of the paths.
        seed: u64,
        /// Number of the sequence.
        sequence: u32,
        /// How many steps were tried.
        tries: u32,
    },
    /// A number in the recipe makes no sense.
    #[error("cannot write a recording with {name} {found}: {expected} expected")]
    Recipe {
        /// Which number.
        name: &'static str,
        /// What was asked for.
        found: String,
        /// What it must be.
        expected: &'static str,
    },
    /// The output folder holds things that are not ours to delete.
    #[error(
        "will not write the recording to {}: it holds {}, which `grnet-train synth` did not write; choose an empty or new folder",
        folder.display(),
        found.display()
    )]
    NotOurs {
        /// The folder asked for.
        folder: PathBuf,
        /// One thing found there.
        found: PathBuf,
    },
    /// A file or folder could not be written or read.
    #[error("cannot {action} {}", path.display())]
    Io {
        /// What was tried: `write`, `create`...
        action: &'static str,
        /// On what.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// An image could not be encoded.
    #[error("cannot encode {}", path.display())]
    Encode {
        /// The image file.
        path: PathBuf,
        /// What the encoder said.
        source: image::ImageError,
    },
}
