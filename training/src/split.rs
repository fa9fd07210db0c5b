//! `grnet-train split`: a complete checkpoint as the two files that a robot keeps apart.

use std::path::{Path, PathBuf};

use clap::Args;
use grnet_model::Checkpoint;

/// Write a complete checkpoint's trunk (motion, shared by all places) and its scene (one place) to files of their own.
#[derive(Debug, Args)]
pub struct SplitArgs {
    /// The complete checkpoint.
    #[arg(value_name = "CHECKPOINT")]
    pub checkpoint: PathBuf,
    /// Trunk file to write: runs by itself, odometry only.
    #[arg(long, value_name = "FILE", required_unless_present = "scene")]
    pub trunk: Option<PathBuf>,
    /// Scene file to write: belongs to that trunk and no other.
    #[arg(long, value_name = "FILE")]
    pub scene: Option<PathBuf>,
    /// Replace files that exist.
    #[arg(long)]
    pub force: bool,
}

/// Runs the command.
///
/// # Errors
/// When a file to write exists, the checkpoint is not complete, or a part cannot be written.
pub fn run(args: &SplitArgs) -> anyhow::Result<()> {
    let outputs = [&args.trunk, &args.scene];
    if let Some(taken) = outputs.into_iter().flatten().find(|path| path.exists() && !args.force) {
        anyhow::bail!("{} exists: choose another file or pass --force to replace it", taken.display());
    }
    let (trunk, scene) = Checkpoint::load(&args.checkpoint)?.split()?;
    for (what, part, path) in [("trunk", trunk, &args.trunk), ("scene", scene, &args.scene)] {
        let Some(path) = path else { continue };
        save(what, &part, path)?;
    }
    Ok(())
}

fn save(what: &str, part: &Checkpoint, path: &Path) -> anyhow::Result<()> {
    part.save(path)?;
    println!("{}: {what}, content {}", path.display(), &part.content_hash()[..12]);
    Ok(())
}

#[cfg(test)]
mod tests {
    use grnet_model::{Kind, LoadedModel, NetworkConfig, Preprocessing, untrained};

    use super::*;

    fn args(folder: &Path) -> SplitArgs {
        let file = |name: &str| folder.join(name);
        SplitArgs {
            checkpoint: file("whole.safetensors"),
            trunk: Some(file("trunk.safetensors")),
            scene: Some(file("scene.safetensors")),
            force: false,
        }
    }

    #[test]
    fn the_parts_make_up_the_whole_and_the_trunk_knows_no_place() {
        let folder = tempfile::tempdir().unwrap();
        let args = args(folder.path());
        let config = NetworkConfig::preset("grnet-small").unwrap();
        let whole = untrained::checkpoint(&config, 3, Preprocessing::default()).unwrap();
        whole.save(&args.checkpoint).unwrap();
        run(&args).unwrap();

        let (trunk, scene) = (args.trunk.clone().unwrap(), args.scene.clone().unwrap());
        let load = |path: &Path| Checkpoint::load(path).unwrap();
        assert_eq!(load(&trunk).metadata().kind, Kind::Trunk);
        assert!(load(&trunk).metadata().scene.is_none());
        let joined = Checkpoint::merge(load(&trunk), load(&scene)).unwrap();
        assert_eq!(joined.content_hash(), whole.content_hash());
        assert!(LoadedModel::load(&trunk, None).is_ok() && LoadedModel::load(&trunk, Some(&scene)).is_ok());

        let error = run(&args).unwrap_err().to_string();
        assert!(error.contains("trunk.safetensors exists") && error.contains("--force"), "{error}");
        run(&SplitArgs { force: true, ..args }).unwrap();
    }

    #[test]
    fn a_trunk_cannot_be_split_again() {
        let folder = tempfile::tempdir().unwrap();
        let first = args(folder.path());
        let config = NetworkConfig::preset("grnet-small").unwrap();
        untrained::checkpoint(&config, 3, Preprocessing::default()).unwrap().save(&first.checkpoint).unwrap();
        run(&first).unwrap();
        let again =
            SplitArgs { checkpoint: first.trunk.clone().unwrap(), force: true, ..args(folder.path()) };
        let error = run(&again).unwrap_err().to_string();
        assert!(error.contains("trunk") && error.contains("complete"), "{error}");
    }
}
