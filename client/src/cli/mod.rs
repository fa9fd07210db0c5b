//! The command's arguments, and what its subcommands share.

mod control;
mod exit;
mod human;
mod json;
mod print;
mod reference;
mod status;
mod table;
mod tail;

use std::{path::PathBuf, process::ExitCode, time::Duration};

use anyhow::Context as _;
use clap::{Args, CommandFactory as _, Parser, Subcommand, ValueEnum};
use grnet_client::{CameraName, Connection, Root};

const EXIT_CODES: &str = "\
Exit codes: 0 done; 2 usage, or a request that makes no sense to the daemon; 69 no daemon; 70 internal error; 75
timed out, no place left, or a request refused for now, while a daemon is there; 77 no permission; 78 bad
configuration, versions that do not fit, or a request that the daemon tried and that failed.";

/// Watch the pose stream of grnetd and ask the daemon how it is.
#[derive(Debug, Parser)]
#[command(name = "grnet-client", version, after_help = EXIT_CODES)]
struct Cli {
    #[command(subcommand)]
    command: Command,

    #[command(flatten)]
    connection: ConnectionArgs,
}

/// Which daemon to talk to.
#[derive(Debug, Args)]
struct ConnectionArgs {
    /// Camera whose daemon to talk to
    #[arg(long, global = true, value_name = "NAME", default_value = CameraName::DEFAULT, env = "GRNET_CAMERA")]
    camera: CameraName,

    /// Folder of the daemon's services, where grnetd.toml sets publish.root
    #[arg(long, global = true, value_name = "FOLDER", env = "GRNET_ROOT")]
    root: Option<PathBuf>,

    /// Prefix of the daemon's names in shared memory, where grnetd.toml sets publish.prefix
    #[arg(long, global = true, value_name = "PREFIX", env = "GRNET_PREFIX", requires = "root")]
    prefix: Option<String>,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Print poses as they are published; goes on when the daemon restarts
    Tail(TailArgs),
    /// Print the daemon's state
    Status(StatusArgs),
    /// Ask the daemon for something: another scene, a pose, a recording, a pause
    Control(control::ControlArgs),
}

/// What `tail` prints, and how much of it.
#[derive(Debug, Args)]
pub struct TailArgs {
    /// Same as --format json
    #[arg(long, conflicts_with = "format")]
    json: bool,

    /// How to print
    #[arg(long, value_enum, default_value_t = Format::Table)]
    format: Format,

    /// Which pose tum, kitti and csv print
    #[arg(long, value_enum, default_value_t = Which::Map)]
    pose: Which,

    /// Print at most this many samples per second
    #[arg(long, value_name = "HZ", value_parser = positive)]
    rate: Option<f64>,

    /// Stop after this many printed samples
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    count: Option<u64>,

    /// Give up when nothing printable came for this long
    #[arg(long, value_name = "SECONDS", value_parser = seconds)]
    timeout: Option<Duration>,

    /// Print the newest sample and skip older ones that are still waiting
    #[arg(long)]
    latest: bool,

    /// Wait this long for a daemon that is not there yet
    #[arg(long, value_name = "SECONDS", value_parser = seconds)]
    wait: Option<Duration>,

    /// Show ground truth beside the map pose: a KITTI trajectory of the base, one row per frame of the source
    #[arg(long, value_name = "FILE")]
    reference: Option<PathBuf>,

    /// Stop when the daemon says that it stops or that its recording is over
    #[arg(long)]
    until_end: bool,
}

/// How `status` prints.
#[derive(Debug, Args)]
pub struct StatusArgs {
    /// Print one JSON object
    #[arg(long)]
    json: bool,

    /// Give up when the daemon says nothing for this long
    #[arg(long, value_name = "SECONDS", value_parser = seconds, default_value = "3")]
    timeout: Duration,
}

/// A text form of the stream.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Format {
    /// Aligned columns for people
    Table,
    /// One JSON object per line
    Json,
    /// time tx ty tz qx qy qz qw
    Tum,
    /// 3x4 matrix, row by row
    Kitti,
    /// Comma-separated values with a header
    Csv,
}

/// One of the poses of a sample.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Which {
    /// Fused pose in the scene's map
    Map,
    /// Integrated motion
    Odom,
    /// The network's map pose before landmarks
    Network,
}

/// The command line, for those who describe it.
pub fn command() -> clap::Command {
    Cli::command()
}

/// Runs the command that the arguments name.
pub fn main() -> ExitCode {
    let cli = Cli::parse();
    let run = || {
        let connection = cli.connection.connection()?;
        let stop = || exit::stop_on_signals().context("cannot watch for signals");
        match &cli.command {
            Command::Tail(args) => tail::run(&connection, args, &*stop()?),
            Command::Status(args) => status::run(&connection, args, &*stop()?),
            // An answer is waited for in one piece: a signal ends the process as it always does.
            Command::Control(args) => control::run(&connection, args),
        }
    };
    exit::code(run())
}

impl ConnectionArgs {
    fn connection(&self) -> anyhow::Result<Connection> {
        let root = match &self.root {
            Some(path) => Root::own(path, self.prefix.as_deref()).map_err(grnet_client::ClientError::from)?,
            None => Root::shared(),
        };
        Ok(Connection { camera: self.camera.clone(), root })
    }
}

impl TailArgs {
    fn format(&self) -> Format {
        if self.json { Format::Json } else { self.format }
    }
}

fn positive(text: &str) -> Result<f64, String> {
    let number: f64 = text.parse().map_err(|_| format!("{text:?} is no number"))?;
    if number.is_finite() && number > 0.0 { Ok(number) } else { Err("it must be greater than 0".to_owned()) }
}

fn seconds(text: &str) -> Result<Duration, String> {
    Duration::try_from_secs_f64(positive(text)?).map_err(|error| error.to_string())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_arguments_are_consistent() {
        Cli::command().debug_assert();
    }

    #[test]
    fn numbers_must_make_sense() {
        assert_eq!(seconds("0.25"), Ok(Duration::from_millis(250)));
        for text in ["0", "-1", "nan", "inf", "soon", "1e300"] {
            assert!(seconds(text).is_err(), "{text}");
        }
    }
}
