//! The grnet camera-to-pose daemon.

use std::process::ExitCode;

fn main() -> ExitCode {
    grnetd::cli::main(std::env::args_os())
}
