//! Commands and their arguments.

use clap::{CommandFactory as _, Parser, Subcommand};

use crate::{check, evaluate, init, join, score, split, synth, train};

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
    /// Write a checkpoint with drawn weights.
    Init(init::InitArgs),
    Train(train::command::TrainArgs),
    Scene(train::scene::SceneArgs),
    Score(score::ScoreArgs),
    Evaluate(evaluate::command::EvaluateArgs),
    Join(join::command::JoinArgs),
    Check(check::command::CheckArgs),
    Split(split::SplitArgs),
}

/// The command line, for those who describe it.
pub fn command() -> clap::Command {
    Cli::command()
}

impl Cli {
    /// Runs the chosen command.
    ///
    /// # Errors
    /// Whatever ends it before it is done.
    pub fn run(self) -> anyhow::Result<()> {
        match self.command {
            Command::Synth(args) => synth::command::run(&args),
            Command::Init(args) => init::run(&args),
            Command::Train(args) => {
                train::restart_for_training()?;
                train::command::run(&args)
            }
            Command::Scene(args) => {
                train::restart_for_training()?;
                train::scene::run(&args)
            }
            Command::Score(args) => score::run(&args),
            Command::Evaluate(args) => evaluate::command::run(&args),
            Command::Join(args) => join::command::run(&args),
            Command::Check(args) => check::command::run(&args),
            Command::Split(args) => split::run(&args),
        }
    }
}
