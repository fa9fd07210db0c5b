//! The `grnet-train` command.
#![forbid(unsafe_code)]

use std::process::ExitCode;

use clap::Parser as _;

fn main() -> ExitCode {
    match grnet_train::cli::Cli::parse().run() {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("grnet-train: {error:#}");
            ExitCode::FAILURE
        }
    }
}
