//! `grnet-train init`: an untrained checkpoint.

use std::path::PathBuf;

use anyhow::Context as _;
use clap::Args;
use grnet_capture::dataset::{self, OpenOptions};
use grnet_frame::Camera;
use grnet_model::metadata::{CameraIntrinsics, Distortion};
use grnet_model::{PRESETS, Preprocessing, untrained};

use crate::train::config::NetworkTable;

/// Write a checkpoint with drawn weights: it runs at full speed, its poses mean nothing and say so.
#[derive(Debug, Args)]
pub struct InitArgs {
    /// Network preset.
    #[arg(long, value_parser = PRESETS)]
    pub preset: String,
    /// Replace a field of the preset, as in `[network]` of a training configuration; may be given several times. To see what a
    /// network costs before it is trained.
    #[arg(long = "set", value_name = "FIELD=VALUE")]
    pub overrides: Vec<String>,
    /// Seed of the weights; the same seed gives the same file.
    #[arg(long, default_value_t = 0)]
    pub seed: u64,
    /// Checkpoint file to write.
    #[arg(long, value_name = "FILE")]
    pub out: PathBuf,
    /// Note the intrinsics of this recording's camera in the checkpoint.
    #[arg(long, value_name = "DATASET")]
    pub camera_from: Option<PathBuf>,
    /// Replace the file if it exists.
    #[arg(long)]
    pub force: bool,
}

/// Runs the command.
///
/// # Errors
/// When the file exists, the recording has no intrinsics or the checkpoint cannot be written.
pub fn run(args: &InitArgs) -> anyhow::Result<()> {
    if args.out.exists() && !args.force {
        anyhow::bail!("{} exists: choose another --out or pass --force to replace it", args.out.display());
    }
    let camera = args.camera_from.as_deref().map(camera_of).transpose()?;
    let config = NetworkTable::with_overrides(&args.preset, &args.overrides)
        .and_then(|table| table.config())
        .map_err(|problem| anyhow::anyhow!("no network from preset {}: {problem}", args.preset))?;
    let checkpoint = untrained::checkpoint(&config, args.seed, Preprocessing::default())?
        .with_metadata(|metadata| metadata.camera = camera.as_ref().map(intrinsics))?;
    checkpoint.save(&args.out)?;
    println!(
        "{}: {} with {:.2} M parameters, untrained (seed {}), content {}",
        args.out.display(),
        [std::slice::from_ref(&args.preset), &args.overrides].concat().join(" "),
        config.parameter_count() as f64 / 1e6,
        args.seed,
        &checkpoint.content_hash()[..12]
    );
    Ok(())
}

fn camera_of(recording: &std::path::Path) -> anyhow::Result<Camera> {
    let recordings = dataset::open(recording, &OpenOptions::default())
        .with_context(|| format!("cannot take the camera from {}", recording.display()))?;
    recordings[0].camera.with_context(|| {
        format!(
            "{} ({}) has no intrinsics: drop --camera-from or name another recording",
            recording.display(),
            recordings[0].name
        )
    })
}

pub(crate) fn intrinsics(camera: &Camera) -> CameraIntrinsics {
    let ((width_px, height_px), (fx_px, fy_px), (cx_px, cy_px)) =
        (camera.size_px(), camera.focal_px(), camera.centre_px());
    let distortion = match camera.distortion() {
        grnet_frame::Distortion::None => Distortion::None,
        grnet_frame::Distortion::PlumbBob(k) => Distortion::PlumbBob(k),
        grnet_frame::Distortion::Equidistant(k) => Distortion::Equidistant(k),
    };
    CameraIntrinsics { width_px, height_px, fx_px, fy_px, cx_px, cy_px, distortion }
}

#[cfg(test)]
mod tests {
    use super::*;
    use grnet_model::LoadedModel;

    fn args(out: PathBuf) -> InitArgs {
        InitArgs {
            preset: "grnet-small".into(),
            overrides: Vec::new(),
            seed: 5,
            out,
            camera_from: None,
            force: false,
        }
    }

    #[test]
    fn the_file_loads_as_an_untrained_model_and_is_the_same_again() {
        let folder = tempfile::tempdir().unwrap();
        let (first, second) = (folder.path().join("a.safetensors"), folder.path().join("b.safetensors"));
        run(&args(first.clone())).unwrap();
        run(&args(second.clone())).unwrap();
        assert!(std::fs::read(&first).unwrap() == std::fs::read(&second).unwrap());
        let model = LoadedModel::load(&first, None).unwrap();
        assert!(!model.trained && model.metadata.camera.is_none());
    }

    #[test]
    fn an_existing_file_is_kept_unless_forced() {
        let folder = tempfile::tempdir().unwrap();
        let out = folder.path().join("precious.safetensors");
        std::fs::write(&out, "weights of a week").unwrap();
        let error = run(&args(out.clone())).unwrap_err().to_string();
        assert!(error.contains("precious.safetensors exists") && error.contains("--force"), "{error}");
        assert_eq!(std::fs::read_to_string(&out).unwrap(), "weights of a week");
        run(&InitArgs { force: true, ..args(out.clone()) }).unwrap();
        assert!(LoadedModel::load(&out, None).is_ok());
    }

    #[test]
    fn fields_of_the_preset_are_replaced_and_a_bad_one_is_named() {
        let folder = tempfile::tempdir().unwrap();
        let out = folder.path().join("a.safetensors");
        let with = |overrides: &[&str]| InitArgs {
            overrides: overrides.iter().map(ToString::to_string).collect(),
            ..args(out.clone())
        };
        for (text, word) in [
            ("input_width_px", "FIELD=VALUE"),
            ("input_width_px=8", "32..=2048"),
            ("input_width_px=wide", "`input_width_px = \"wide\"`"),
            ("colour=blue", "colour"),
            ("width=[", "neither TOML nor a word"),
            ("width=", "neither TOML nor a word"),
        ] {
            let error = format!("{:#}", run(&with(&[text])).unwrap_err());
            assert!(error.contains("grnet-small") && error.contains(word), "{text}: {error}");
            assert!(!out.exists());
        }
        run(&with(&["input_width_px = 64", "input_height_px=48", "rotation=quaternion", "width=0.125"]))
            .unwrap();
        let network = LoadedModel::load(&out, None).unwrap().metadata.network;
        assert_eq!((network.input_width_px, network.input_height_px, network.width), (64, 48, 0.125));
        assert_eq!(network.rotation, grnet_model::Rotation::Quaternion);
        assert_eq!(network.lstm_hidden, 128, "what is not replaced is the preset's");
    }
}
