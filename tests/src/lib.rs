//! What the end-to-end tests share: built programs, a small recording, daemons and clients as processes.
//!
//! Nothing here links the product: the tests know it as its users do, by its programs and its stream.
#![forbid(unsafe_code)]

mod process;
mod rig;

pub use process::{DEADLINE, Process, signal};
pub use rig::{Rig, data_folder, program, shared_files, venv_python};
