//! `grnet-train check`.

use std::path::PathBuf;

use clap::Args;
use indicatif::{ProgressBar, ProgressStyle};

use super::{CheckOptions, check};
use crate::dataset_args::DatasetArgs;

/// Say what is wrong with a data set: gaps, blur, jumps, wrong intrinsics, poses that do not fit the images' motion.
///
/// Exit code 1 when there are errors; warnings and notes leave it 0.
#[derive(Debug, Args)]
pub struct CheckArgs {
    /// Folder of the data set.
    #[arg(value_name = "DATA")]
    pub data: PathBuf,
    /// How the folder is read.
    #[command(flatten)]
    pub dataset: DatasetArgs,
    /// List of the training frames: how far are the test frames from them?
    #[arg(long, value_name = "FILE", requires = "test_list")]
    pub train_list: Option<PathBuf>,
    /// List of the test frames.
    #[arg(long, value_name = "FILE", requires = "train_list")]
    pub test_list: Option<PathBuf>,
    /// Print the report as JSON.
    #[arg(long)]
    pub json: bool,
}

/// Runs the command.
///
/// # Errors
/// When the data set cannot be opened, or has errors.
pub fn run(args: &CheckArgs) -> anyhow::Result<()> {
    let options = CheckOptions {
        open: args.dataset.open_options(),
        lists: args.train_list.clone().zip(args.test_list.clone()),
    };
    // Draws on a terminal only.
    let bar = ProgressBar::new_spinner().with_style(ProgressStyle::with_template("{pos} images  {per_sec}")?);
    let report = check(&args.data, &options, &|| bar.inc(1))?;
    bar.finish_and_clear();
    if args.json {
        println!("{}", serde_json::to_string_pretty(&report)?);
    } else {
        print!("{}", report.text());
    }
    anyhow::ensure!(report.errors == 0, "{} has errors: {}", args.data.display(), report.errors);
    Ok(())
}
