//! Training, evaluation and the synthetic scene.
#![forbid(unsafe_code)]
#![deny(missing_docs)]

pub mod baselines;
pub mod check;
pub mod cli;
pub mod data;
pub mod dataset_args;
pub mod device;
pub mod evaluate;
pub mod import;
pub mod init;
pub mod join;
pub mod loss;
pub mod report;
pub mod run;
pub mod score;
pub mod split;
pub mod synth;
pub mod train;
