//! How the command ends.

use std::{
    io::{self, Write as _},
    process::ExitCode,
    sync::{Arc, atomic::AtomicBool},
};

use grnet_client::ClientError;
use signal_hook::{
    consts::{SIGINT, SIGTERM},
    flag,
};

use super::control::{self, UsageError};
use super::reference::ReferenceError;

const USAGE: u8 = 2;
const INTERNAL: u8 = 70;
const BAD_FILE: u8 = 78;

/// A flag that SIGINT and SIGTERM set; a second one ends the process at once.
pub fn stop_on_signals() -> io::Result<Arc<AtomicBool>> {
    let stop = Arc::new(AtomicBool::new(false));
    for signal in [SIGINT, SIGTERM] {
        flag::register_conditional_default(signal, Arc::clone(&stop))?;
        flag::register(signal, Arc::clone(&stop))?;
    }
    Ok(stop)
}

/// The exit code that `result` stands for; an error is printed on one line. A reader that has gone
/// away (`| head`) is no error.
pub fn code(result: anyhow::Result<()>) -> ExitCode {
    let Err(error) = result else { return ExitCode::SUCCESS };
    if error.chain().any(is_broken_pipe) {
        return ExitCode::SUCCESS;
    }
    // Standard error may be closed as well; the exit code still tells.
    let _ = writeln!(io::stderr(), "grnet-client: {error:#}");
    ExitCode::from(if error.is::<ReferenceError>() {
        BAD_FILE
    } else if error.is::<UsageError>() {
        USAGE
    } else {
        error.downcast_ref().map_or(INTERNAL, client_code)
    })
}

fn client_code(error: &ClientError) -> u8 {
    match error {
        ClientError::NoDaemon(_) => 69,
        ClientError::Refused(reply) => control::code(reply),
        ClientError::TooLong(_) => USAGE,
        ClientError::Timeout { .. } | ClientError::TooManySubscribers(_) => 75,
        ClientError::PermissionDenied(_) => 77,
        ClientError::BadConfiguration(_) | ClientError::SchemaMismatch(_) => 78,
        _ => INTERNAL,
    }
}

fn is_broken_pipe(error: &(dyn std::error::Error + 'static)) -> bool {
    error.downcast_ref::<io::Error>().is_some_and(|error| error.kind() == io::ErrorKind::BrokenPipe)
}
