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

/// Starts this program again with candle's own threads turned off, unless the environment says how many there shall be.
///
/// Every core has a copy of the network to compute already (see [`replicas`]). candle's threads would wait for each other in
/// busy loops on the same cores, and candle reads their number from the environment only, once.
///
/// # Errors
/// When the program cannot be started again.
pub fn one_thread_per_operator() -> anyhow::Result<()> {
    use std::os::unix::process::CommandExt as _;
    const VARIABLE: &str = "CANDLE_NUM_THREADS";
    if std::env::var_os(VARIABLE).is_some() {
        return Ok(());
    }
    let program = std::env::current_exe()?;
    let error =
        std::process::Command::new(&program).args(std::env::args_os().skip(1)).env(VARIABLE, "1").exec();
    Err(anyhow::Error::new(error)
        .context(format!("cannot start {} again with {VARIABLE}=1", program.display())))
}
