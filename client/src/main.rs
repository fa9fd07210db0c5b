//! The `grnet-client` command: watch the pose stream and ask the daemon how it is.
#![forbid(unsafe_code)]

use std::process::ExitCode;

fn main() -> ExitCode {
    grnet_client::cli::main()
}
