//! `grnet-train synth`.

use std::path::PathBuf;
use std::time::Instant;

use anyhow::Context as _;
use clap::Args;
use grnet_frame::{Camera, Distortion};
use indicatif::{ProgressBar, ProgressStyle};

use super::{ImageFormat, Recipe, SceneOptions, SensorOptions, Shutter, VolumeKind, write};

/// Render a recording of a synthetic room in the 7-Scenes layout.
#[derive(Debug, Args)]
pub struct SynthArgs {
    /// Folder to write; must be new, empty or an earlier recording of this command.
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// Number of the room: each is another place.
    #[arg(long, default_value_t = 1)]
    pub room: u64,
    /// Seed of the camera's paths and of the noise.
    #[arg(long, default_value_t = 0)]
    pub seed: u64,
    /// Where the camera goes.
    #[arg(long, value_enum, default_value_t = VolumeKind::Handheld)]
    pub volume: VolumeKind,
    /// Number of passes, none of which repeats another.
    #[arg(long, default_value_t = 4)]
    pub sequences: u32,
    /// How many of the passes, the last ones, are for testing [default: 1, or 0 of a single pass].
    #[arg(long)]
    pub test_sequences: Option<u32>,
    /// Frames of each pass.
    #[arg(long, default_value_t = 500)]
    pub frames: u32,
    /// Frames per second.
    #[arg(long, value_name = "HZ", default_value_t = 30.0)]
    pub fps: f64,
    /// Image size.
    #[arg(long, value_name = "WxH", default_value = "640x480", value_parser = parse_size)]
    pub size: (u32, u32),
    /// Focal length in pixels [default: 525 at a width of 640, in proportion to the width].
    #[arg(long, value_name = "PX")]
    pub focal: Option<f64>,
    /// Image format.
    #[arg(long, value_enum, default_value_t = FormatName::Jpg)]
    pub format: FormatName,
    /// JPEG quality, 1 to 100 [default: 92].
    #[arg(long)]
    pub quality: Option<u8>,
    /// Also write 16-bit depth images in millimetres.
    #[arg(long)]
    pub depth: bool,
    /// Rays per pixel on silhouettes.
    #[arg(long, value_name = "N", default_value_t = 4, value_parser = clap::value_parser!(u16).range(1..=64))]
    pub samples: u16,
    /// Strength of the sensor's noise: 1 is a webcam.
    #[arg(long, default_value_t = 1.0, conflicts_with = "clean")]
    pub noise: f32,
    /// An ideal sensor: no noise, vignetting, blur or change of exposure.
    #[arg(long)]
    pub clean: bool,
    /// Length of the exposure in milliseconds: motion blur.
    #[arg(long, value_name = "MS", default_value_t = 0.0)]
    pub exposure_ms: f64,
    /// Time from the first to the last row in milliseconds: rolling shutter.
    #[arg(long, value_name = "MS", default_value_t = 0.0)]
    pub readout_ms: f64,
    /// Size of a texel in millimetres: larger builds the room sooner, enough for small images.
    #[arg(long, value_name = "MM", default_value_t = 4.0)]
    pub texel_mm: f32,
    /// Worker threads [default: one per core]; the recording does not depend on it.
    #[arg(long, value_parser = clap::value_parser!(u16).range(1..))]
    pub threads: Option<u16>,
}

/// Image formats by name.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum FormatName {
    /// Lossless.
    Png,
    /// Small.
    Jpg,
}

/// Runs the command.
///
/// # Errors
/// When the arguments contradict each other or the recording cannot be written.
pub fn run(args: &SynthArgs) -> anyhow::Result<()> {
    let recipe = args.recipe()?;
    let threads = args.threads.map_or(0, usize::from);
    let pool = rayon::ThreadPoolBuilder::new()
        .num_threads(threads)
        .build()
        .context("cannot start the worker threads")?;
    let total = u64::from(recipe.sequences) * u64::from(recipe.frames);
    let style = ProgressStyle::with_template("{bar:30} {pos}/{len} frames  {per_sec}  {eta} left")?;
    // Draws on a terminal only.
    let bar = ProgressBar::new(total).with_style(style);
    bar.tick();
    let start = Instant::now();
    pool.install(|| write(&recipe, &args.out, &|| bar.inc(1)))?;
    bar.finish_and_clear();
    let seconds = start.elapsed().as_secs_f64();
    let (width, height) = args.size;
    println!(
        "room {}: {} x {} {} frames of {width}x{height} in {}: {seconds:.1} s, {:.1} frames/s",
        recipe.scene.room,
        recipe.sequences,
        recipe.frames,
        recipe.volume.name(),
        args.out.display(),
        total as f64 / seconds
    );
    Ok(())
}

impl SynthArgs {
    /// The recording that the arguments ask for.
    ///
    /// # Errors
    /// When they contradict each other.
    pub fn recipe(&self) -> anyhow::Result<Recipe> {
        let format = match (self.format, self.quality) {
            (FormatName::Png, None) => ImageFormat::Png,
            (FormatName::Jpg, quality) => ImageFormat::Jpg(quality.unwrap_or(92)),
            (FormatName::Png, Some(_)) => {
                anyhow::bail!("--quality is for JPEG: PNG is lossless; drop it or use --format jpg")
            }
        };
        let (width, height) = self.size;
        let focal = self.focal.unwrap_or(525.0 / 640.0 * f64::from(width));
        let centre = ((f64::from(width) - 1.0) / 2.0, (f64::from(height) - 1.0) / 2.0);
        Ok(Recipe {
            scene: SceneOptions { room: self.room, texel_m: self.texel_mm / 1000.0 },
            volume: self.volume,
            seed: self.seed,
            sequences: self.sequences,
            test_sequences: self.test_sequences.unwrap_or(u32::from(self.sequences > 1)),
            frames: self.frames,
            rate_hz: self.fps,
            camera: Camera::new((width, height), (focal, focal), centre, Distortion::None)?,
            format,
            depth: self.depth,
            edge_samples: usize::from(self.samples),
            sensor: if self.clean {
                SensorOptions::clean()
            } else {
                SensorOptions { noise: self.noise, ..Default::default() }
            },
            shutter: Shutter { exposure_ms: self.exposure_ms, readout_ms: self.readout_ms },
        })
    }
}

fn parse_size(text: &str) -> Result<(u32, u32), String> {
    let parsed = text.split_once('x').and_then(|(w, h)| Some((w.parse().ok()?, h.parse().ok()?)));
    match parsed {
        Some((w, h)) if (8..=8192).contains(&w) && (8..=8192).contains(&h) => Ok((w, h)),
        _ => Err(format!("`{text}` is not a size such as 640x480 (8 to 8192 pixels each)")),
    }
}
