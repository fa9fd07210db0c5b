//! Training: the stages of the paper (section "Training Strategy") over a run folder, and `grnet-train train`.
//!
//! * [`Recipe`]: what is trained, on what, for how long.
//! * [`Parameters`]: the weights as candle variables.
//! * [`Trainer`]: the loop; [`Objective`]: what it minimises; [`Schedule`]: how fast.
//! * [`export`]: from weights to the checkpoint that the daemon loads, with calibrated uncertainties.
//!
//! A run that is stopped at any moment, in whatever way, goes on from its last saved state and ends with the same weights, bit
//! for bit, as one that was never stopped: windows are a pure function of their number, operators do not depend on
//! scheduling, and a state holds everything else.

pub mod calibrate;
pub mod command;
pub mod config;
mod error;
pub mod export;
pub mod feed;
pub mod initial;
pub mod normalisation;
pub mod objective;
pub mod parameters;
pub mod replicas;
pub mod scene;
pub mod schedule;
pub mod sources;
mod state;
pub mod trainer;
pub mod validate;

pub use config::Recipe;
pub use error::{ConfigError, TrainError};
pub use objective::Objective;
pub use parameters::{Parameters, Part};
pub use schedule::Schedule;
pub use trainer::{Outcome, Trainer};

/// What training wants of candle and of the C library's memory allocation; both read it from the environment only, once.
///
/// * Every core has a copy of the network to compute already (see [`replicas`]): candle's own threads would wait for each other in busy
///   loops on the same cores.
/// * A step takes and gives back the same large blocks every time. By default glibc returns them to the kernel, which zeroes each
///   page of them again: a fifth of a step's time (`make bench-training`).
const ENVIRONMENT: [(&str, &str); 4] = [
    ("CANDLE_NUM_THREADS", "1"),
    ("MALLOC_MMAP_THRESHOLD_", "1073741824"),
    ("MALLOC_TRIM_THRESHOLD_", "4294967296"),
    ("MALLOC_TOP_PAD_", "67108864"),
];

/// Starts this program again in an environment that suits training; variables that are set already stay as they are.
///
/// # Errors
/// When the program cannot be started again.
pub fn restart_for_training() -> anyhow::Result<()> {
    use std::os::unix::process::CommandExt as _;
    let missing = ENVIRONMENT.iter().copied().filter(|(variable, _)| std::env::var_os(variable).is_none());
    let missing: Vec<_> = missing.collect();
    if missing.is_empty() {
        return Ok(());
    }
    let program = std::env::current_exe()?;
    let arguments = std::env::args_os().skip(1);
    let error = std::process::Command::new(&program).args(arguments).envs(missing).exec();
    Err(anyhow::Error::new(error)
        .context(format!("cannot start {} again in the environment of a training", program.display())))
}
