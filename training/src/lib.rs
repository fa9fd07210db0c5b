//! Training, evaluation and the synthetic scene.
#![forbid(unsafe_code)]
#![deny(missing_docs)]

pub mod baselines;
pub mod check;
pub mod dataset_args;
pub mod evaluate;
pub mod init;
pub mod join;
pub mod report;
pub mod score;
pub mod synth;
