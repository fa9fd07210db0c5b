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
pub mod schedule;
pub mod sources;
pub mod scene;
mod state;
pub mod trainer;
pub mod validate;

pub use config::Recipe;
pub use error::{ConfigError, TrainError};
pub use objective::Objective;
pub use parameters::{Parameters, Part};
pub use schedule::Schedule;
pub use trainer::{Outcome, Trainer};
