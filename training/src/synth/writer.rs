//! Writes recordings in the 7-Scenes layout, the whole folder at once.

use std::fs;
use std::path::{Path, PathBuf};

use grnet_frame::Camera;
use nalgebra::Isometry3;
use rayon::prelude::*;

use super::manifest::Manifest;
use super::numeric::along;
use super::output::{self, io};
use super::render::RenderTarget;
use super::scene::{Scene, SceneOptions};
use super::sensor::{FrameKey, Sensor, SensorOptions};
use super::trajectory::{PathOptions, Trajectory};
use super::volume::{Volume, VolumeKind};
use super::{SynthError, output::Staging};

/// Views that are averaged for motion blur.
const BLUR_VIEWS: u32 = 6;

/// File format of the colour images.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "lowercase")]
pub enum ImageFormat {
    /// Lossless.
    Png,
    /// JPEG of this quality, 1 to 100.
    Jpg(u8),
}

/// Timing of the exposure around a frame's time stamp, which is the middle of the exposure of the middle row.
#[derive(Debug, Clone, Copy, PartialEq, Default, serde::Serialize)]
pub struct Shutter {
    /// Length of the exposure in milliseconds; 0: no motion blur.
    pub exposure_ms: f64,
    /// Time from the first to the last row in milliseconds; 0: all rows at once.
    pub readout_ms: f64,
}

/// Everything that a recording follows from.
#[derive(Debug, Clone)]
pub struct Recipe {
    /// The place.
    pub scene: SceneOptions,
    /// Where the camera goes.
    pub volume: VolumeKind,
    /// Seed of paths and noise.
    pub seed: u64,
    /// Number of passes, `seq-01` and on.
    pub sequences: u32,
    /// How many of them, the last ones, go to TestSplit.txt.
    pub test_sequences: u32,
    /// Frames of each pass.
    pub frames: u32,
    /// Frames per second.
    pub rate_hz: f64,
    /// Intrinsics, without distortion.
    pub camera: Camera,
    /// Colour image format.
    pub format: ImageFormat,
    /// Whether to write 16-bit depth images in millimetres too.
    pub depth: bool,
    /// Rays per pixel on silhouettes.
    pub edge_samples: usize,
    /// The sensor's faults.
    pub sensor: SensorOptions,
    /// Motion blur and rolling shutter.
    pub shutter: Shutter,
}

/// Renders a recording into `folder`, which appears when it is complete; `progress` is called after every frame.
///
/// # Errors
/// When the recipe makes no sense, the folder holds anything that this function did not write, or writing fails.
pub fn write(recipe: &Recipe, folder: &Path, progress: &(dyn Fn() + Sync)) -> Result<(), SynthError> {
    recipe.check()?;
    let staging = Staging::create(folder)?;
    let scene = Scene::build(recipe.scene);
    let volume = Volume::of(&scene, recipe.volume);
    let paths = (0..recipe.sequences).map(|sequence| {
        let options =
            PathOptions { seed: recipe.seed, sequence, frames: recipe.frames, rate_hz: recipe.rate_hz };
        Trajectory::generate(&scene, &volume, options)
    });
    let paths = paths.collect::<Result<Vec<_>, _>>()?;
    output::write_text(staging.path(), recipe, &Manifest::new(recipe, &scene))?;
    for sequence in 0..recipe.sequences {
        let folder = staging.path().join(output::sequence_name(sequence));
        fs::create_dir(&folder).map_err(io("create", &folder))?;
    }
    let jobs: Vec<(u32, u32)> =
        (0..recipe.sequences).flat_map(|s| (0..recipe.frames).map(move |f| (s, f))).collect();
    jobs.into_par_iter().try_for_each_init(
        || (RenderTarget::new(recipe.edge_samples), RenderTarget::new(recipe.edge_samples), Vec::new()),
        |(target, extra, rgb), (sequence, index)| {
            let path = &paths[sequence as usize];
            recipe.expose(&scene, path, index, target, extra)?;
            let key = FrameKey { seed: recipe.seed, sequence, index };
            Sensor { options: recipe.sensor }.develop(target, key, path.gain(path.time_s(index)), rgb);
            let stem = staging.path().join(output::sequence_name(sequence)).join(format!("frame-{index:06}"));
            output::write_frame(recipe, &stem, rgb, target, &path.world_from_camera(path.time_s(index)))?;
            progress();
            Ok(())
        },
    )?;
    staging.publish()
}

impl Recipe {
    /// Renders frame `index` with the shutter's effects; depth and faces are those of the frame's time stamp.
    fn expose(
        &self,
        scene: &Scene,
        path: &Trajectory,
        index: u32,
        target: &mut RenderTarget,
        extra: &mut RenderTarget,
    ) -> Result<(), SynthError> {
        let time_s = path.time_s(index);
        self.view(scene, path, time_s, target)?;
        if self.shutter.exposure_ms <= 0.0 {
            return Ok(());
        }
        target.radiance.fill([0.0; 3]);
        for k in 0..BLUR_VIEWS {
            let share = (f64::from(k) + 0.5) / f64::from(BLUR_VIEWS) - 0.5;
            self.view(scene, path, time_s + share * self.shutter.exposure_ms / 1e3, extra)?;
            for (sum, light) in target.radiance.iter_mut().zip(&extra.radiance) {
                *sum = along(*sum, *light, 1.0 / BLUR_VIEWS as f32);
            }
        }
        Ok(())
    }

    fn view(
        &self,
        scene: &Scene,
        path: &Trajectory,
        time_s: f64,
        target: &mut RenderTarget,
    ) -> Result<(), SynthError> {
        if self.shutter.readout_ms <= 0.0 {
            return scene.render(&path.world_from_camera(time_s), &self.camera, target);
        }
        let rows = f64::from(self.camera.size_px().1);
        let pose = |row: usize| -> Isometry3<f64> {
            let share = (row as f64 + 0.5) / rows - 0.5;
            path.world_from_camera(time_s + share * self.shutter.readout_ms / 1e3)
        };
        scene.render_rolling(&pose, &self.camera, target)
    }

    fn check(&self) -> Result<(), SynthError> {
        let wrong = |name, found: String, expected| Err(SynthError::Recipe { name, found, expected });
        if self.sequences == 0 || self.sequences > 99 {
            return wrong("sequences", self.sequences.to_string(), "1 to 99");
        }
        if self.test_sequences > self.sequences {
            return wrong(
                "test sequences",
                self.test_sequences.to_string(),
                "at most the number of sequences",
            );
        }
        if self.frames == 0 || self.frames > 1_000_000 {
            return wrong("frames", self.frames.to_string(), "1 to 1000000");
        }
        if !(self.rate_hz.is_finite() && self.rate_hz >= 1.0 && self.rate_hz <= 1000.0) {
            return wrong("rate", self.rate_hz.to_string(), "1 to 1000 frames per second");
        }
        if let ImageFormat::Jpg(quality) = self.format
            && !(1..=100).contains(&quality)
        {
            return wrong("JPEG quality", quality.to_string(), "1 to 100");
        }
        if !(self.scene.texel_m >= 0.001 && self.scene.texel_m <= 0.1) {
            return wrong("texel size", format!("{} m", self.scene.texel_m), "1 to 100 mm");
        }
        for (name, ms) in [("exposure", self.shutter.exposure_ms), ("readout", self.shutter.readout_ms)] {
            if !(0.0..=200.0).contains(&ms) {
                return wrong(name, format!("{ms} ms"), "0 to 200 ms");
            }
        }
        if !(0.0..=20.0).contains(&self.sensor.noise) {
            return wrong("noise", self.sensor.noise.to_string(), "0 to 20");
        }
        Ok(())
    }

    /// Extension of the colour images.
    pub fn extension(&self) -> &'static str {
        match self.format {
            ImageFormat::Png => "png",
            ImageFormat::Jpg(_) => "jpg",
        }
    }

    /// `(name, file)` of the split that a sequence belongs to.
    pub fn split_of(&self, sequence: u32) -> &'static str {
        if sequence < self.sequences - self.test_sequences { "train" } else { "test" }
    }

    /// Where a folder would be written while it is incomplete.
    pub fn staging_folder(folder: &Path) -> PathBuf {
        output::staging_path(folder)
    }
}
