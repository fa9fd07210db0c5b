//! The command line.

use std::ffi::OsString;
use std::path::PathBuf;
use std::process::ExitCode;

use clap::{Args, CommandFactory as _, Parser, Subcommand};
use grnet_config::Override;

use crate::failure::Failure;
use crate::run::Loaded;
use crate::{check, devices, logging, run, setup, supervisor};

/// Camera frames in, poses in shared memory out.
#[derive(Debug, Parser)]
#[command(name = "grnetd", version, arg_required_else_help = true, after_help = EXIT_CODES)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

const EXIT_CODES: &str = "Exit codes: 0 done, 2 usage, 69 something else is in the way (camera name in use, \
shared memory full), 70 internal error, 77 no permission, 78 configuration, checkpoint or recording cannot be used.";

#[derive(Debug, Subcommand)]
enum Command {
    /// Run until the recording ends or a signal comes.
    Run {
        #[command(flatten)]
        configuration: Configuration,
        /// Record every frame of the source into this folder, which has to be new or empty; see [record].
        #[arg(long, value_name = "DIR")]
        record: Option<PathBuf>,
    },
    /// Check the configuration to the end (weights, source, shared memory) and say what would run.
    Check(Configuration),
    /// List the cameras with formats, sizes, rates, controls and the configuration lines for each.
    Devices {
        /// One JSON array instead of text.
        #[arg(long)]
        json: bool,
    },
}

#[derive(Debug, Args)]
struct Configuration {
    /// The configuration; the packaged grnetd.toml explains every key.
    #[arg(long, value_name = "FILE", default_value = "/etc/grnet/grnetd.toml")]
    config: PathBuf,
    /// Set a key for this run, before what the file says; may be given several times.
    #[arg(long = "set", value_name = "SECTION.KEY=VALUE")]
    set: Vec<String>,
}

/// The command line, for those who describe it.
pub fn command() -> clap::Command {
    Cli::command()
}

/// Does what the arguments say; the result is the process's exit code.
pub fn main(arguments: impl IntoIterator<Item = OsString>) -> ExitCode {
    let cli = match Cli::try_parse_from(arguments) {
        Ok(cli) => cli,
        Err(error) => {
            // Nothing can be said to a closed stderr.
            let _ = error.print();
            return ExitCode::from(u8::try_from(error.exit_code()).unwrap_or(2));
        }
    };
    let result = match cli.command {
        Command::Run { configuration, record } => return run_daemon(&configuration, record),
        Command::Check(configuration) => {
            configuration.load().and_then(|loaded| check::check(&loaded, &mut std::io::stdout().lock()))
        }
        Command::Devices { json } => devices::devices(json, &mut std::io::stdout().lock()),
    };
    end(result, |failure| eprintln!("grnetd: error: {}", failure.chain()))
}

fn run_daemon(configuration: &Configuration, record: Option<PathBuf>) -> ExitCode {
    let started = configuration.load().and_then(|loaded| {
        let log = logging::start(&loaded.config.log)?;
        Ok((log, Loaded { record, ..loaded }))
    });
    let (log, loaded) = match started {
        Ok(started) => started,
        Err(failure) => return end(Err(failure), |failure| eprintln!("grnetd: error: {}", failure.chain())),
    };
    supervisor::install_panic_hook();
    end(run::run(loaded, &log), |failure| tracing::error!("{}", failure.chain()))
}

/// The one place where an error that ends the program is printed.
fn end(result: Result<(), Failure>, print: impl Fn(&Failure)) -> ExitCode {
    match result {
        Ok(()) => ExitCode::SUCCESS,
        Err(failure) => {
            print(&failure);
            failure.exit_code()
        }
    }
}

impl Configuration {
    fn load(&self) -> Result<Loaded, Failure> {
        let overrides: Vec<Override> = self
            .set
            .iter()
            .map(|text| Override::parse(text))
            .collect::<Result<_, _>>()
            .map_err(Failure::config)?;
        let (config, settings, notes) = setup::load_config(&self.config, &overrides)?;
        Ok(Loaded { config, settings, path: self.config.clone(), overrides, record: None, notes })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_command_line_is_well_formed() {
        Cli::command().debug_assert();
    }
}
