//! `grnet-train train`.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use anyhow::Context as _;
use clap::Args;
use grnet_model::{Checkpoint, Heads};

use super::calibrate::{Calibration, Shown, calibrate, measure_motion};
use super::config::Recipe;
use super::export::{self, Facts};
use super::initial::{self, Initial};
use super::sources::Sources;
use super::trainer::{Outcome, Trainer};
use super::validate::Validator;
use crate::device::{DeviceArgs, DeviceName};
use crate::loss::Head;
use crate::run::{RunFolder, RunIdentity, stop_flag};

/// Train a network as a recipe says, all stages in a row.
#[derive(Debug, Args)]
pub struct TrainArgs {
    /// The recipe.
    #[arg(long, value_name = "FILE")]
    pub config: PathBuf,
    /// Folder of the run [default: runs/NAME-OF-THE-RECIPE].
    #[arg(long, value_name = "DIR")]
    pub out: Option<PathBuf>,
    /// Go on with the run in the folder; a finished one only writes its checkpoint again.
    #[arg(long)]
    pub resume: bool,
    /// Computing threads, instead of the recipe's.
    #[arg(long, value_parser = clap::value_parser!(u16).range(1..))]
    pub threads: Option<u16>,
    /// Where it computes.
    #[command(flatten)]
    pub device: DeviceArgs,
}

/// Runs the command.
///
/// # Errors
/// When the recipe, the data or the folder cannot be used, or the training fails; what was saved stays good.
pub fn run(args: &TrainArgs) -> anyhow::Result<()> {
    let (mut recipe, text) = Recipe::read(&args.config)?;
    recipe.threads = args.threads.map(usize::from).or(recipe.threads);
    let out = args.out.clone().unwrap_or_else(|| {
        let stem = args.config.file_stem().unwrap_or_else(|| args.config.as_os_str());
        Path::new("runs").join(stem)
    });
    let (origin, device) = (args.config.clone(), args.device);
    let run = Run { recipe, text, origin, out, resume: args.resume, device };
    if let Some(trained) = run.train()? {
        trained.save_complete(&run.out)?;
    }
    Ok(())
}

/// A recipe with the folder that it is run in.
#[derive(Debug)]
pub struct Run {
    /// The recipe.
    pub recipe: Recipe,
    /// Its text, as kept in the folder.
    pub text: String,
    /// Where it was read from.
    pub origin: PathBuf,
    /// Folder of the run.
    pub out: PathBuf,
    /// Whether a run there is gone on with.
    pub resume: bool,
    /// Where it computes, instead of where the recipe says.
    pub device: DeviceArgs,
}

/// What a finished training gives.
#[derive(Debug)]
pub struct Trained {
    /// The complete checkpoint.
    pub checkpoint: Checkpoint,
    calibration: BTreeMap<Head, Calibration>,
    motion: Option<Calibration>,
}

impl Run {
    /// Trains to the end; none when it was stopped before.
    ///
    /// # Errors
    /// As [`run`].
    pub fn train(&self) -> anyhow::Result<Option<Trained>> {
        let threads = match self.recipe.threads {
            Some(threads) => threads,
            None => std::thread::available_parallelism().context("cannot count the cores")?.get(),
        };
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build()?;
        pool.install(|| self.train_here(threads))
    }

    fn train_here(&self, threads: usize) -> anyhow::Result<Option<Trained>> {
        let recipe = &self.recipe;
        let (name, device) = self.device.open(recipe.device, recipe.tf32)?;
        let (network, preprocessing, checkpoint) = initial::plan(recipe, &self.origin)?;
        let sources = Sources::open(recipe, &network, &preprocessing)?;
        for line in sources.describe() {
            eprintln!("{line}");
        }
        let start =
            initial::weights(recipe, &network, &preprocessing, checkpoint, sources.normalisation(), &device)?;
        let identity = RunIdentity {
            config_toml: self.text.clone(),
            seed: recipe.seed,
            fingerprint: sources.fingerprint(),
            threads,
            details: self.details(name, start.source.as_deref()),
        };
        let folder = match self.resume {
            true => RunFolder::resume(&self.out, &identity)?,
            false => RunFolder::create(&self.out, &identity)?,
        };
        let Initial { parameters, metadata, heads, .. } = start;
        let mut trainer = Trainer::new(recipe, &sources, parameters, folder, device.clone())?;
        if trainer.run(&stop_flag())? == Outcome::Stopped {
            eprintln!("the run is saved in {}; go on with --resume", self.out.display());
            return Ok(None);
        }
        let trained = export::trained_heads(heads, &recipe.stages);
        let steps = trainer.steps();
        let (mut parameters, validator) = trainer.into_parts();
        let newly = newly(trained, heads, recipe);
        let calibration = match &validator {
            Some(validator) => {
                let shown = Shown::of(&recipe.stages, &sources)?;
                calibrate(&mut parameters, validator, &shown, newly, &device)?
            }
            None => BTreeMap::new(),
        };
        let is_trunk_frozen =
            trained.relative.log_variance && !newly.relative.pose && network.branches.global;
        let place = is_trunk_frozen.then(|| Sources::of_whole_recording(recipe, &network, &preprocessing));
        let motion = match place.transpose()?.flatten() {
            Some(windows) => measure_motion(&parameters, &Validator::of(windows)?, &device)?,
            None => None,
        };
        let facts = Facts {
            heads: export::only_calibrated(trained, &calibration, heads),
            camera: sources.camera(),
            fingerprint: sources.fingerprint(),
            steps,
            calibration: calibration.clone(),
            motion: motion.clone(),
        };
        let checkpoint = export::checkpoint(&parameters, recipe, &facts, &metadata)?;
        Ok(Some(Trained { checkpoint, calibration, motion }))
    }

    /// What decides about the weights beside recipe, data and threads.
    fn details(&self, device: DeviceName, source: Option<&str>) -> BTreeMap<String, String> {
        let mut details = BTreeMap::new();
        details.extend(source.map(|hash| ("initial weights".to_owned(), hash.to_owned())));
        if device != DeviceName::Cpu {
            let precision = if self.device.tf32 || self.recipe.tf32 { " with TF32" } else { "" };
            details.insert("device".to_owned(), format!("{device}{precision}"));
        }
        details
    }
}

/// The heads that this run trained: those of a frozen trunk keep their own calibration.
fn newly(trained: Heads, before: Heads, recipe: &Recipe) -> Heads {
    let off = grnet_model::HeadState::default();
    let weighed = recipe.heads();
    let pick = |head, now, was| if weighed.contains(&head) || now != was { now } else { off };
    Heads {
        relative: pick(Head::Relative, trained.relative, before.relative),
        global: pick(Head::Global, trained.global, before.global),
        fused: pick(Head::Fused, trained.fused, before.fused),
    }
}

impl Trained {
    /// Writes `model.safetensors`, and where there is a place, `trunk.safetensors` and `scene.safetensors` beside it.
    ///
    /// # Errors
    /// When a file cannot be written.
    pub fn save_complete(&self, folder: &Path) -> anyhow::Result<()> {
        let model = folder.join("model.safetensors");
        self.checkpoint.save(&model)?;
        println!("{}: content {}", model.display(), &self.checkpoint.content_hash()[..12]);
        if self.checkpoint.metadata().network.branches.global {
            let (trunk, scene) = self.checkpoint.clone().split()?;
            for (part, name) in [(trunk, "trunk.safetensors"), (scene, "scene.safetensors")] {
                part.save(&folder.join(name))?;
                println!("{}: content {}", folder.join(name).display(), &part.content_hash()[..12]);
            }
        }
        self.print_calibration();
        Ok(())
    }

    /// Prints what the calibration found.
    pub fn print_calibration(&self) {
        for (head, found) in &self.calibration {
            let [one, two, three] = found.within_sigmas.map(|share| 100.0 * share);
            let [before, after] = found.nees;
            println!(
                "uncertainty of the {head} pose: NEES {before:.1} before, {after:.1} after calibration (6 is right); within 1, 2, 3 \
                 sigmas {one:.0} %, {two:.0} %, {three:.1} % (68, 95, 99.7 are right)"
            );
            if let Some([before, after]) = found.training_nees {
                println!("  on windows as in the training: NEES {before:.1} before, {after:.1} after");
            }
        }
        if let Some(Calibration { nees: [before, after], within_sigmas: [.., three], .. }) = &self.motion {
            println!(
                "uncertainty of the trunk's motion in this place: NEES {before:.1} as the trunk says, {after:.1} as the scene \
                 corrects it (6 is right); within 3 sigmas {:.1} % (99.7 is right)",
                100.0 * three
            );
        }
    }
}
