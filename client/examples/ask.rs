//! Asks a running daemon for something, as a program of one's own would:
//!
//! ```text
//! cargo run -p grnet-client --example ask -- status
//! cargo run -p grnet-client --example ask -- reset-odometry /run/grnet
//! ```
//!
//! Exit codes are those of `grnet-client`: 0 done, 69 no daemon, 77 no permission, 70 anything else.

use std::{path::Path, process::ExitCode, time::Duration};

use grnet_client::{ClientError, Command, Connection, ControlClient, ControlReply, Root};

fn main() -> ExitCode {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let command = arguments
        .first()
        .and_then(|name| Command::ALL.iter().find(|(_, known)| known == name).map(|(command, _)| *command));
    let Some(command) = command else {
        eprintln!("usage: ask COMMAND [FOLDER], with a command such as status or reset-odometry");
        return ExitCode::from(2);
    };
    match ask(command, arguments.get(1).map(Path::new)) {
        Ok(reply) => {
            println!("{}: {} (reset epoch {})", reply.outcome, reply.message, reply.status.reset_epoch);
            ExitCode::SUCCESS
        }
        Err(error) => {
            eprintln!("ask: {error}");
            ExitCode::from(match error {
                ClientError::NoDaemon(_) => 69,
                ClientError::PermissionDenied(_) => 77,
                _ => 70,
            })
        }
    }
}

fn ask(command: Command, folder: Option<&Path>) -> Result<Box<ControlReply>, ClientError> {
    let root = folder.map(|folder| Root::own(folder, None)).transpose()?.unwrap_or_default();
    let connection = Connection { root, ..Connection::default() };
    ControlClient::open(&connection, Duration::from_secs(10))?.command(command)
}
