//! Training, evaluation and the synthetic scene.
#![forbid(unsafe_code)]
#![deny(missing_docs)]

pub mod synth;
