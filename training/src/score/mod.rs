//! `grnet-train score`: scores of any system's trajectory, equal to the public tools.

mod input;
mod report;
mod seven_scenes;
mod table;

use std::{
    io::{self, Write as _},
    path::{Path, PathBuf},
};

use anyhow::Context as _;
use clap::{Args, Subcommand, ValueEnum};
use grnet_geometry::align::Alignment;

/// Score a trajectory of any system against ground truth, with the figures of the public tools.
///
/// t_rel and r_rel as the KITTI devkit and kitti-odom-eval, ATE and RPE as evo, medians and recall as the
/// 7-Scenes literature. A figure that is not defined is null (a dash in the table), with the reason among the notes.
#[derive(Debug, Args)]
pub struct ScoreArgs {
    #[command(subcommand)]
    format: Format,
}

#[derive(Debug, Subcommand)]
enum Format {
    /// KITTI odometry: two files of 3x4 matrices, one pose a line.
    ///
    /// EST has 12 columns, or 13 with the frame number in front where frames are missing. With frame numbers both
    /// trajectories are first moved so that the first common frame is the origin (as kitti-odom-eval does); without,
    /// they are compared as they stand (as evo does). t_rel and r_rel are the same either way.
    Kitti(KittiArgs),
    /// TUM: two files of lines `t x y z qx qy qz qw`, paired by time.
    ///
    /// Every pose of the shorter file is paired with the nearest in time of the longer one, as evo does.
    Tum(TumArgs),
    /// 7-Scenes: a folder with frame-XXXXXX.pose.txt, paired by frame number.
    ///
    /// EST is a folder with frame-XXXXXX.pose.txt; or a file of KITTI rows (13 columns: the first is the frame number;
    /// 12 columns: line by line from frame 0); or a TUM file (see --tum-time). A pose with NaN or infinite numbers
    /// counts as missing.
    #[command(name = "7scenes")]
    SevenScenes(SevenScenesArgs),
}

#[derive(Debug, Args)]
struct KittiArgs {
    /// Ground truth: every frame from the first to the last.
    #[arg(value_name = "GT")]
    ground_truth: PathBuf,
    /// Estimate.
    #[arg(value_name = "EST")]
    estimate: PathBuf,
    #[command(flatten)]
    common: CommonArgs,
}

#[derive(Debug, Args)]
struct TumArgs {
    /// Ground truth.
    #[arg(value_name = "GT")]
    ground_truth: PathBuf,
    /// Estimate.
    #[arg(value_name = "EST")]
    estimate: PathBuf,
    /// Largest difference in time of a pair.
    #[arg(long, value_name = "SECONDS", default_value_t = 0.01, value_parser = positive)]
    max_difference: f64,
    /// Added to the times of EST.
    #[arg(long, value_name = "SECONDS", default_value_t = 0.0, value_parser = seconds, allow_negative_numbers = true)]
    offset: f64,
    /// Use every pose once; without it a pose of the longer file may serve two of the shorter, as in evo.
    #[arg(long)]
    one_to_one: bool,
    #[command(flatten)]
    common: CommonArgs,
}

#[derive(Debug, Args)]
struct SevenScenesArgs {
    /// Folder of one sequence, with frame-XXXXXX.pose.txt.
    #[arg(value_name = "GT_DIR")]
    ground_truth: PathBuf,
    /// Estimate: a folder or a file.
    #[arg(value_name = "EST")]
    estimate: PathBuf,
    /// Score only the frames that this file lists: one a line, a number or a name such as
    /// seq-01/frame-000123.color.png.
    #[arg(long, value_name = "FILE")]
    frames: Option<PathBuf>,
    /// What the first column of a TUM file means. `auto`: frame numbers if all are whole, else seconds.
    #[arg(long, value_enum, default_value_t = TumTime::Auto)]
    tum_time: TumTime,
    /// Frame rate for times in seconds, from 0 s at frame 0.
    #[arg(long, value_name = "HZ", default_value_t = 30.0, value_parser = positive)]
    rate: f64,
    #[command(flatten)]
    common: CommonArgs,
}

#[derive(Debug, Clone, Args)]
struct CommonArgs {
    /// Move EST onto GT before everything but the ATE, which is given under each alignment. With `scale`, t_rel and r_rel
    /// of KITTI files use kitti-odom-eval's scale, all else evo's.
    #[arg(long, value_enum, default_value_t = Align::None)]
    align: Align,
    /// Distance of the poses that the RPE compares.
    #[arg(long, value_name = "FRAMES", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..))]
    rpe_delta: u32,
    /// Start an RPE pair at every pose instead of where the one before ended.
    #[arg(long)]
    rpe_all_pairs: bool,
    /// Further thresholds of recall, such as 0.25,10 (repeatable).
    #[arg(long, value_name = "METRES,DEGREES", value_parser = thresholds)]
    recall: Vec<(f64, f64)>,
    /// Print one JSON object.
    #[arg(long)]
    json: bool,
}

impl Format {
    /// Estimate and ground truth.
    fn files(&self) -> (&Path, &Path) {
        match self {
            Format::Kitti(a) => (&a.estimate, &a.ground_truth),
            Format::Tum(a) => (&a.estimate, &a.ground_truth),
            Format::SevenScenes(a) => (&a.estimate, &a.ground_truth),
        }
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Align {
    None,
    Se3,
    Sim3,
    Scale,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum TumTime {
    Auto,
    Frames,
    Seconds,
}

impl From<Align> for Alignment {
    fn from(align: Align) -> Self {
        match align {
            Align::None => Alignment::None,
            Align::Se3 => Alignment::Se3,
            Align::Sim3 => Alignment::Sim3,
            Align::Scale => Alignment::Scale,
        }
    }
}

/// Runs the command and prints to standard output.
///
/// # Errors
/// When a file cannot be read, with file, line, what was found and what was expected, or the two trajectories have
/// nothing in common.
pub fn run(args: &ScoreArgs) -> anyhow::Result<()> {
    let (input, common) = match &args.format {
        Format::Kitti(a) => (input::kitti(&a.ground_truth, &a.estimate)?, &a.common),
        Format::Tum(a) => (input::tum(a)?, &a.common),
        Format::SevenScenes(a) => (seven_scenes::read(a)?, &a.common),
    };
    let report = report::Report::of(&input, common).with_context(|| {
        let (estimate, ground_truth) = args.format.files();
        format!("cannot score {} against {}", estimate.display(), ground_truth.display())
    })?;
    let text = if common.json {
        serde_json::to_string_pretty(&report).context("cannot write the scores as JSON")? + "\n"
    } else {
        table::render(&report)
    };
    match io::stdout().lock().write_all(text.as_bytes()) {
        // The reader of a pipe may have seen enough.
        Err(e) if e.kind() == io::ErrorKind::BrokenPipe => Ok(()),
        other => other.context("cannot write to standard output"),
    }
}

fn seconds(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        // The largest that nanoseconds in 64 bits can hold, rounded down.
        Ok(s) if s.abs() <= 9e9 => Ok(s),
        _ => Err("expected a number of seconds up to 9e9".into()),
    }
}

fn positive(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(v) if v.is_finite() && v > 0.0 => Ok(v),
        _ => Err("expected a finite number above 0".into()),
    }
}

fn thresholds(text: &str) -> Result<(f64, f64), String> {
    let (m, deg) = text.split_once(',').ok_or("expected METRES,DEGREES, for example 0.25,10")?;
    Ok((positive(m.trim())?, positive(deg.trim())?))
}
