//! Commands and their arguments.

use clap::{Parser, Subcommand};

use grnet_train::synth;

/// Trains and evaluates grnet's networks, and makes synthetic recordings to do so.
#[derive(Debug, Parser)]
#[command(name = "grnet-train", version, arg_required_else_help = true)]
pub struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Render a recording of a synthetic room in the 7-Scenes layout.
    Synth(synth::command::SynthArgs),
}

impl Cli {
    /// Runs the chosen command.
    pub fn run(self) -> anyhow::Result<()> {
        match self.command {
            Command::Synth(args) => synth::command::run(&args),
        }
    }
}
