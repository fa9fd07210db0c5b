//! `grnet-train evaluate`.

use std::collections::HashSet;
use std::io::IsTerminal as _;
use std::path::{Path, PathBuf};

use anyhow::Context as _;
use clap::Args;
use grnet_model::LoadedModel;
use indicatif::{ProgressBar, ProgressStyle};

use super::{
    BaselineName, Data, DataOptions, EvaluateError, Evaluation, NamedModel, SCHEMA, Summary, add_baselines,
    add_model, methods,
    score::{path_m, score},
};
use crate::dataset_args::DatasetArgs;
use crate::device::{DeviceArgs, DeviceName};
use crate::report;

/// Judge checkpoints on a recording with ground truth, beside what they have to beat.
#[derive(Debug, Args)]
pub struct EvaluateArgs {
    /// Checkpoint or trunk; give several to compare them, none for the baselines alone.
    #[arg(long, value_name = "FILE", num_args = 1..)]
    pub checkpoint: Vec<PathBuf>,
    /// Scene to be put on the checkpoint's trunk; several are judged one by one. Needs exactly one checkpoint.
    #[arg(long, value_name = "FILE", num_args = 1..)]
    pub scene: Vec<PathBuf>,
    /// Folder of the recording.
    #[arg(long, value_name = "DIR")]
    pub data: PathBuf,
    /// How the folder is read.
    #[command(flatten)]
    pub dataset: DatasetArgs,
    /// List of the frames that retrieval answers from [default: the official training split, if any].
    #[arg(long, value_name = "FILE")]
    pub train_list: Option<PathBuf>,
    /// List of the frames to be judged on [default: the official test split, or all frames].
    #[arg(long, value_name = "FILE")]
    pub test_list: Option<PathBuf>,
    /// Frames between the two ends of a relative motion.
    #[arg(long, value_name = "N", default_value_t = 10, value_parser = clap::value_parser!(u16).range(1..))]
    pub gap: u16,
    /// Time constant in milliseconds of the published poses, as the daemon's tracking.map_smoothing_ms.
    #[arg(long, value_name = "MS", default_value_t = 0, value_parser = clap::value_parser!(u32).range(..=60_000))]
    pub map_smoothing_ms: u32,
    /// Baselines to compute [default: all that the recording allows].
    #[arg(long, value_enum, value_delimiter = ',', value_name = "NAME", conflicts_with = "no_baselines")]
    pub baselines: Vec<BaselineName>,
    /// Compute no baseline.
    #[arg(long)]
    pub no_baselines: bool,
    /// Where the networks compute.
    #[command(flatten)]
    pub device: DeviceArgs,
    /// Folder of the report; what an earlier report left there is replaced.
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
}

/// Runs the command: evaluates, writes the report, prints the table.
///
/// # Errors
/// When the recording or a checkpoint cannot be read, they do not fit, or the report cannot be written.
pub fn run(args: &EvaluateArgs) -> anyhow::Result<()> {
    report::check_folder(&args.out)?;
    let evaluation = args.evaluate()?;
    report::write(&evaluation, &args.out)?;
    println!("{}", report::terminal_table(&evaluation.summary));
    println!("report: {}", args.out.join("index.html").display());
    Ok(())
}

impl EvaluateArgs {
    /// Opens everything, plays every model, scores every system.
    ///
    /// # Errors
    /// When the recording or a checkpoint cannot be read, or they do not fit.
    pub fn evaluate(&self) -> anyhow::Result<Evaluation> {
        let data = Data::open(&self.data, &self.data_options())?;
        let models = self.load_models()?;
        let names = self.baseline_names(&data)?;
        let cnn1 = names.contains(&BaselineName::Cnn1);
        let gap = usize::from(self.gap);

        let looks = names.iter().filter(|n| n.looks_at_images() && **n != BaselineName::Cnn1).count();
        let images = looks * (data.task.train.len() + data.task.test.len());
        let frames: usize = models.iter().map(|m| methods::model_frames(&m.model, &data, cnn1)).sum();
        let bar = progress_bar(images + frames)?;
        let progress = || bar.inc(1);

        let (mut systems, mut infos) = (Vec::new(), Vec::new());
        let map_smoothing_s = f64::from(self.map_smoothing_ms) * 1e-3;
        for named in &models {
            bar.set_message(named.name.clone());
            add_model(&mut systems, &mut infos, &data, named, map_smoothing_s, cnn1, &progress)?;
        }
        bar.set_message("baselines");
        add_baselines(&mut systems, &data, &names, gap, &progress)?;
        bar.finish_and_clear();

        // Models first, in the order given; then what they have to beat.
        systems.sort_by_key(|system| !system.is_model());
        let summary = Summary {
            schema: SCHEMA,
            generator: concat!("grnet-train ", env!("CARGO_PKG_VERSION")).into(),
            sequences: data.tested_sequences().iter().map(|s| data.recordings[*s].name.clone()).collect(),
            train_frames: data.task.train.len(),
            test_frames: data.task.test.len(),
            judged_frames: data.task.test.iter().filter(|view| view.world_from_camera.is_some()).count(),
            test_blocks: data.task.blocks().len(),
            path_m: path_m(&data),
            gap_frames: gap,
            notes: data.notes.clone(),
            models: infos,
            systems: systems.iter().map(|system| score(&data, system, gap)).collect(),
        };
        Ok(Evaluation { data, systems, summary })
    }

    fn data_options(&self) -> DataOptions {
        DataOptions {
            open: self.dataset.open_options(),
            train_list: self.train_list.clone(),
            test_list: self.test_list.clone(),
        }
    }

    /// The baselines asked for; by default those that the recording allows.
    fn baseline_names(&self, data: &Data) -> anyhow::Result<Vec<BaselineName>> {
        use clap::ValueEnum as _;
        if self.no_baselines {
            return Ok(Vec::new());
        }
        let no_training = data.task.train.is_empty();
        if self.baselines.is_empty() {
            let all = BaselineName::value_variants().iter().copied();
            return Ok(all.filter(|name| !(no_training && name.needs_training())).collect());
        }
        if self.baselines.contains(&BaselineName::Cnn1) && self.checkpoint.is_empty() {
            anyhow::bail!("--baselines cnn1 needs a network to look with: give --checkpoint");
        }
        let mut names = self.baselines.clone();
        names.dedup();
        if let Some(name) = names.iter().find(|name| no_training && name.needs_training()) {
            let name = name.to_possible_value().map_or_else(String::new, |value| value.get_name().to_owned());
            anyhow::bail!("--baselines {name} needs training frames with a pose: give --train-list");
        }
        Ok(names)
    }

    fn load_models(&self) -> anyhow::Result<Vec<NamedModel>> {
        if !self.scene.is_empty() && self.checkpoint.len() != 1 {
            anyhow::bail!(
                "--scene puts a scene on one checkpoint, found {} checkpoints: give exactly one --checkpoint",
                self.checkpoint.len()
            );
        }
        let scenes: Vec<Option<&Path>> = match self.scene.as_slice() {
            [] => vec![None],
            scenes => scenes.iter().map(|scene| Some(scene.as_path())).collect(),
        };
        let (_, device) = self.device.open(DeviceName::Cpu, false)?;
        let mut taken = HashSet::new();
        let mut models = Vec::new();
        for checkpoint in &self.checkpoint {
            for scene in &scenes {
                let model = LoadedModel::load_on(checkpoint, *scene, &device);
                let model = model.map_err(|source| EvaluateError::Checkpoint {
                    path: scene.unwrap_or(checkpoint).to_path_buf(),
                    source: Box::new(source),
                })?;
                let shown = scene.filter(|_| scenes.len() > 1).unwrap_or(checkpoint);
                let name = unique(&mut taken, shown);
                let files = [Some(checkpoint.as_path()), *scene].into_iter().flatten();
                models.push(NamedModel {
                    name,
                    files: files.map(|file| file.display().to_string()).collect(),
                    model,
                });
            }
        }
        Ok(models)
    }
}

/// The file's name without its extension; a number is added when it is taken.
fn unique(taken: &mut HashSet<String>, file: &Path) -> String {
    let stem = file.file_stem().map_or_else(|| "model".into(), |stem| stem.to_string_lossy().into_owned());
    let numbered = (2..).map(|n| format!("{stem} ({n})"));
    let name =
        std::iter::once(stem.clone()).chain(numbered).find(|name| !taken.contains(name)).unwrap_or(stem);
    taken.insert(name.clone());
    name
}

/// Draws on a terminal only.
fn progress_bar(steps: usize) -> anyhow::Result<ProgressBar> {
    let style = ProgressStyle::with_template("{msg} {bar:30} {pos}/{len} frames  {per_sec}  {eta} left")
        .context("cannot draw a progress bar")?;
    let bar = ProgressBar::new(steps as u64).with_style(style);
    if !std::io::stderr().is_terminal() {
        bar.set_draw_target(indicatif::ProgressDrawTarget::hidden());
    }
    Ok(bar)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn equal_file_names_get_numbers() {
        let mut taken = HashSet::new();
        let names = ["a/last.safetensors", "b/last.safetensors", "c/best.safetensors"];
        let names = names.map(|file| unique(&mut taken, Path::new(file)));
        assert_eq!(names, ["last", "last (2)", "best"]);
    }
}
