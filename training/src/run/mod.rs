//! One training run on the disk: what it follows from, what it did, and where it goes on after a kill.
//!
//! | file | what it is |
//! |---|---|
//! | `config.toml` | the configuration as it was given, byte by byte |
//! | `run.json` | seed, fingerprint of the data set, threads and all else that must be equal to resume; the program's version, the start. Its presence makes the folder a run |
//! | `log.jsonl` | one [`LogEntry`] per line; NaN and infinities are the texts `"NaN"`, `"inf"`, `"-inf"` |
//! | `curves.svg`, `curves.png` | loss, learning rate and errors over the steps, drawn from the log |
//! | `state.safetensors` | the last [`State`], with a hash of its content |
//! | `state.previous.safetensors` | the state before it, used when the last one is damaged |
//! | `bad-batch-N.safetensors`, `.json` | the batch of step N, whose loss was not finite |
//! | `run.lock` | locked while a process trains; holds its number |
//! | `*.partial` | what a killed process was writing; of no meaning |
//!
//! The trainer adds its checkpoints. States, checkpoints and pictures are written beside their place and renamed, so that a
//! kill or a loss of power at any moment leaves complete files only.

mod atomic;
mod bad_batch;
mod curves;
mod difference;
mod error;
mod folder;
mod identity;
mod lock;
mod log;
mod number;
mod progress;
mod state;
mod stop;

pub use error::RunError;
pub use folder::RunFolder;
pub use identity::{RunIdentity, RunRecord};
pub use log::{LogEntry, LogKind, read_log};
pub use progress::{Progress, Update};
pub use state::{State, StateTensor};
pub use stop::stop_flag;
