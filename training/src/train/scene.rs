//! `grnet-train scene`: another place for a trunk that is there already.

use std::path::PathBuf;

use anyhow::Context as _;
use clap::Args;
use grnet_model::{Checkpoint, Storage};

use super::command::Run;
use super::config::{Init, Recipe, Scene};
use super::parameters::Part;
use super::sources::DataConfig;
use crate::device::DeviceArgs;

/// The recipe that is used when none is given.
pub const DEFAULT_RECIPE: &str = include_str!("../../recipes/scene.toml");

/// Learn a place on an existing trunk: RCNN2, then FCFL, with CNN1 and RCNN1 frozen. Writes a scene file that the daemon loads
/// beside that trunk.
#[derive(Debug, Args)]
pub struct SceneArgs {
    /// The trunk, or a complete checkpoint whose trunk is taken.
    #[arg(long, value_name = "FILE")]
    pub trunk: PathBuf,
    /// Recording of the place with ground truth, any layout that `grnet-train evaluate` reads.
    #[arg(long, value_name = "DIR", required_unless_present = "config")]
    pub data: Option<PathBuf>,
    /// List of the frames to learn from [default: the official training split, or all frames].
    #[arg(long, value_name = "FILE", requires = "data")]
    pub list: Option<PathBuf>,
    /// A recipe of your own: its stages may train rcnn2 and fcfl only.
    #[arg(long, value_name = "FILE", conflicts_with = "data")]
    pub config: Option<PathBuf>,
    /// Name of the place [default: the recipe's, or the scene file's name].
    #[arg(long, value_name = "NAME")]
    pub name: Option<String>,
    /// Scene file to write.
    #[arg(long, value_name = "FILE")]
    pub out: PathBuf,
    /// Folder of the run [default: runs/scene-NAME].
    #[arg(long, value_name = "DIR")]
    pub run: Option<PathBuf>,
    /// Go on with the run in that folder.
    #[arg(long)]
    pub resume: bool,
    /// Where it computes.
    #[command(flatten)]
    pub device: DeviceArgs,
}

/// Runs the command.
///
/// # Errors
/// When trunk, recording or recipe cannot be used, or the training fails.
pub fn run(args: &SceneArgs) -> anyhow::Result<()> {
    let stem = args.out.file_stem().map(|stem| stem.to_string_lossy().into_owned());
    let (mut recipe, text, origin) = match &args.config {
        Some(path) => {
            let (recipe, text) = Recipe::read(path)?;
            (recipe, text, path.clone())
        }
        None => {
            let origin = PathBuf::from("the built-in recipe of scenes");
            (Recipe::parse(DEFAULT_RECIPE, &origin)?, DEFAULT_RECIPE.to_owned(), origin)
        }
    };
    if let Some(path) = &args.data {
        for data in recipe.data.values_mut() {
            if let DataConfig::Recorded(recorded) = data {
                (recorded.path, recorded.list) = (path.clone(), args.list.clone());
            }
        }
    }
    let frozen = |part: &Part| matches!(part, Part::Cnn1 | Part::Rcnn1);
    if let Some(stage) = recipe.stages.iter().find(|stage| stage.train.iter().any(frozen)) {
        anyhow::bail!(
            "{}: stage \"{}\" trains cnn1 or rcnn1, which would change the trunk; a scene trains rcnn2 and fcfl only \
             (grnet-train train makes a trunk and scene of their own)",
            origin.display(),
            stage.name
        );
    }
    let trunk = Checkpoint::load(&args.trunk)?;
    let half_precision = trunk.storage() == Storage::F16;
    recipe.network = None;
    recipe.half_precision = half_precision;
    recipe.init = Some(Init {
        checkpoint: Some(args.trunk.clone()),
        parts: Some(vec![Part::Cnn1, Part::Rcnn1]),
        resnet50: None,
    });
    let name = args.name.clone().or(stem).context("the scene file needs a name")?;
    if args.name.is_some() || recipe.scene.is_none() {
        recipe.scene = Some(Scene { id: name.clone(), name: None });
    }
    let out = args.run.clone().unwrap_or_else(|| PathBuf::from("runs").join(format!("scene-{name}")));
    let run = Run { recipe, text, origin, out, resume: args.resume, device: args.device };
    let Some(trained) = run.train()? else { return Ok(()) };
    let (made, scene) = trained.checkpoint.clone().split()?;
    // The frozen part was stored as it came, so that the scene belongs to the very trunk that is on the robot.
    let wanted = match trunk.metadata().kind {
        grnet_model::Kind::Complete => trunk.split()?.0,
        _ => trunk,
    };
    anyhow::ensure!(
        made.content_hash() == wanted.content_hash(),
        "the trunk changed while the scene was trained; this should not happen, please report it"
    );
    scene.save(&args.out)?;
    println!(
        "{}: scene \"{name}\" for trunk {}, content {}",
        args.out.display(),
        &wanted.content_hash()[..12],
        &scene.content_hash()[..12]
    );
    trained.print_calibration();
    Ok(())
}
