//! The data sets of a recipe, opened.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use grnet_capture::dataset::{self, Layout, OpenOptions, Split};
use grnet_frame::Camera;
use grnet_model::{CameraIntrinsics, NetworkConfig, Preprocessing};
use grnet_pipeline::preprocess::InputSpec;
use serde::Deserialize;

use super::TrainError;
use super::config::Recipe;
use super::normalisation::Normalisation;
use crate::data::{
    DataError, Mixed, RecordedOptions, RecordedWindows, RenderedOptions, RenderedWindows, Windows, statistics,
};
use crate::dataset_args::LayoutName;

/// Windows of which the spread of the poses is measured.
const SAMPLE: u64 = 400;

/// Where the windows of a data set come from: one of three tables.
#[derive(Debug, Clone, Deserialize)]
#[serde(rename_all = "lowercase", deny_unknown_fields)]
pub enum DataConfig {
    /// Rendered on the fly in synthetic rooms.
    Rendered(Box<RenderedOptions>),
    /// Cut from a recording.
    Recorded(Box<RecordedConfig>),
    /// Other data sets by name, each with its share.
    Mixed(BTreeMap<String, f64>),
}

/// A recording and which of its frames to learn from.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RecordedConfig {
    /// Folder of the recording; relative to the recipe.
    pub path: PathBuf,
    /// How the folder is laid out [default: found out].
    #[serde(default)]
    pub layout: Option<LayoutName>,
    /// The one sequence to take [default: all].
    #[serde(default)]
    pub sequence: Option<String>,
    /// The camera to take where there are several.
    #[serde(default)]
    pub camera: Option<String>,
    /// Ground truth of the camera instead of the layout's own; relative to the recipe.
    #[serde(default)]
    pub poses: Option<PathBuf>,
    /// Regular time stamps at this rate instead of the recorded ones.
    #[serde(default)]
    pub rate_hz: Option<f64>,
    /// List of the frames to take [default: the official training split, or all frames].
    #[serde(default)]
    pub list: Option<PathBuf>,
    /// Frames at one end of each sequence that are kept apart for validation.
    #[serde(default)]
    pub hold_out: usize,
    /// Which end: where the place goes on after the recording, its last frames are the ones to learn from.
    #[serde(default)]
    pub hold_out_at: HoldOutAt,
    /// Take the frames kept apart instead of the others.
    #[serde(default)]
    pub held_out: bool,
    /// Windows and augmentation.
    #[serde(default)]
    pub windows: RecordedOptions,
}

/// The end of a sequence.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum HoldOutAt {
    /// The first frames.
    Start,
    /// The last frames.
    #[default]
    End,
}

impl RecordedConfig {
    /// Leaves the frames that are asked for: those kept apart, or the others.
    fn choose<T>(&self, frames: &mut Vec<T>) {
        let kept = self.hold_out.min(frames.len());
        let (first, is_first_part) = match self.hold_out_at {
            HoldOutAt::Start => (kept, self.held_out),
            HoldOutAt::End => (frames.len() - kept, !self.held_out),
        };
        if is_first_part {
            frames.truncate(first);
        } else {
            frames.drain(..first);
        }
    }
}

/// Every data set of a recipe.
pub struct Sources {
    windows: BTreeMap<String, Arc<dyn Windows>>,
    normalisation: Normalisation,
    camera: Option<CameraIntrinsics>,
}

impl std::fmt::Debug for Sources {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Sources").field("names", &self.windows.keys()).finish_non_exhaustive()
    }
}

impl DataConfig {
    /// Makes relative paths start from the recipe's folder.
    pub fn resolve(&mut self, folder: &Path) {
        if let Self::Recorded(recorded) = self {
            recorded.path = folder.join(&recorded.path);
            recorded.poses = recorded.poses.take().map(|poses| folder.join(poses));
        }
    }
}

impl Sources {
    /// Opens the data sets that stages and validation name.
    ///
    /// # Errors
    /// When a recording cannot be opened or gives no window.
    pub fn open(
        recipe: &Recipe,
        network: &NetworkConfig,
        preprocessing: &Preprocessing,
    ) -> Result<Self, TrainError> {
        let mut opening = Opening::new(recipe, network, preprocessing);
        let named = recipe.stages.iter().map(|stage| &stage.data);
        let names: BTreeSet<&String> = named.chain(recipe.validation.iter().map(|v| &v.data)).collect();
        for name in names {
            opening.open(name, &mut Vec::new())?;
        }
        let Opening { windows, cameras, .. } = opening;
        // The last stage is the one that knows the place best; what it saw fixes the frame of the world.
        let last = recipe.stages.last().map(|stage| &stage.data).ok_or(TrainError::NoLoss)?;
        let poses = statistics::sample(windows[last].as_ref(), SAMPLE)?;
        let camera = cameras.get(last).copied().flatten().as_ref().map(crate::init::intrinsics);
        Ok(Self { windows, normalisation: Normalisation::of(&poses), camera })
    }

    /// Windows like those of the validation from all frames of its recording; none without a validation.
    ///
    /// # Errors
    /// As [`Sources::open`].
    pub fn of_whole_recording(
        recipe: &Recipe,
        network: &NetworkConfig,
        preprocessing: &Preprocessing,
    ) -> Result<Option<Arc<dyn Windows>>, TrainError> {
        let Some(validation) = &recipe.validation else { return Ok(None) };
        let mut recipe = recipe.clone();
        if let Some(DataConfig::Recorded(recorded)) = recipe.data.get_mut(&validation.data) {
            (recorded.hold_out, recorded.held_out) = (0, false);
        }
        let mut opening = Opening::new(&recipe, network, preprocessing);
        opening.open(&validation.data, &mut Vec::new())?;
        Ok(opening.windows.remove(&validation.data))
    }

    /// The windows of a data set.
    ///
    /// # Errors
    /// When there is no such data set.
    pub fn windows(&self, name: &str) -> Result<Arc<dyn Windows>, TrainError> {
        let found = self.windows.get(name);
        found.cloned().ok_or_else(|| TrainError::State { what: format!("the data set \"{name}\"") })
    }

    /// Where the poses lie and how far they spread.
    pub fn normalisation(&self) -> &Normalisation {
        &self.normalisation
    }

    /// The camera of the last stage's images.
    pub fn camera(&self) -> Option<CameraIntrinsics> {
        self.camera
    }

    /// Hash of all that determines the windows.
    pub fn fingerprint(&self) -> String {
        use sha2::{Digest as _, Sha256};
        let mut hash = Sha256::new();
        for (name, windows) in &self.windows {
            hash.update(format!("{name}\0{}\0", windows.fingerprint()));
        }
        hash.finalize().iter().map(|byte| format!("{byte:02x}")).collect()
    }

    /// A line for each data set.
    pub fn describe(&self) -> Vec<String> {
        self.windows.iter().map(|(name, windows)| format!("{name}: {}", windows.describe())).collect()
    }
}

struct Opening<'a> {
    recipe: &'a Recipe,
    size_px: (u32, u32),
    preprocessing: &'a Preprocessing,
    windows: BTreeMap<String, Arc<dyn Windows>>,
    cameras: BTreeMap<String, Option<Camera>>,
    recordings: Vec<Arc<RecordedWindows>>,
}

impl<'a> Opening<'a> {
    fn new(recipe: &'a Recipe, network: &NetworkConfig, preprocessing: &'a Preprocessing) -> Self {
        Self {
            recipe,
            size_px: (network.input_width_px as u32, network.input_height_px as u32),
            preprocessing,
            windows: BTreeMap::new(),
            cameras: BTreeMap::new(),
            recordings: Vec::new(),
        }
    }

    /// Opens a data set and those that it is mixed from; `above` are the mixtures that led here.
    fn open(&mut self, name: &str, above: &mut Vec<String>) -> Result<(), TrainError> {
        if self.windows.contains_key(name) {
            return Ok(());
        }
        let option = |found: String, expected: &'static str| DataError::option("data", found, expected);
        let Some(config) = self.recipe.data.get(name) else {
            return Err(option(format!("\"{name}\""), "the name of a data set of the recipe").into());
        };
        if above.iter().any(|n| n == name) {
            return Err(
                option(format!("\"{name}\" mixed into itself"), "data sets that are not mixtures").into()
            );
        }
        let (windows, camera): (Arc<dyn Windows>, Option<Camera>) = match config {
            DataConfig::Rendered(options) => {
                let windows = RenderedWindows::new(self.input(None), RenderedOptions::clone(options))?;
                let camera = windows.camera();
                (Arc::new(windows), Some(camera))
            }
            DataConfig::Recorded(config) => {
                let (mut windows, camera) = self.recorded(config)?;
                for other in &self.recordings {
                    windows.share_depths(other);
                }
                let windows = Arc::new(windows);
                self.recordings.push(windows.clone());
                (windows, camera)
            }
            DataConfig::Mixed(shares) => {
                above.push(name.to_owned());
                let (mut sources, mut camera) = (Vec::new(), None);
                for (part, share) in shares {
                    self.open(part, above)?;
                    sources.push((self.windows[part].clone(), *share));
                    camera = camera.or(self.cameras[part]);
                }
                above.pop();
                (Arc::new(Mixed::new(sources, self.recipe.seed)?), camera)
            }
        };
        self.windows.insert(name.to_owned(), windows);
        self.cameras.insert(name.to_owned(), camera);
        Ok(())
    }

    /// The windows, and the camera as frames of this recording will carry it at run time.
    fn recorded(&self, config: &RecordedConfig) -> Result<(RecordedWindows, Option<Camera>), TrainError> {
        let official = config.path.join("TrainSplit.txt").is_file();
        let split = match &config.list {
            Some(list) => Split::List(list.clone()),
            None if official => Split::Train,
            None => Split::All,
        };
        let options = OpenOptions {
            layout: config.layout.map_or(Layout::Auto, Into::into),
            sequence: config.sequence.clone(),
            camera_name: config.camera.clone(),
            poses: config.poses.clone(),
            rate_hz: config.rate_hz,
            split,
            ..OpenOptions::default()
        };
        let mut recordings =
            dataset::open(&config.path, &options).map_err(crate::evaluate::EvaluateError::from)?;
        for recording in &mut recordings {
            config.choose(&mut recording.frames);
        }
        let camera = recordings.iter().find_map(|recording| recording.camera);
        let windows =
            RecordedWindows::new(&config.path, &recordings, self.input(None), config.windows.clone())?;
        Ok((windows, camera))
    }

    fn input(&self, trained_camera: Option<Camera>) -> InputSpec {
        InputSpec { size_px: self.size_px, preprocessing: self.preprocessing.clone(), trained_camera }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn chosen(text: &str) -> Vec<u32> {
        let config: RecordedConfig = toml::from_str(&format!("path = \"x\"\n{text}")).unwrap();
        let mut frames = (0..5).collect();
        config.choose(&mut frames);
        frames
    }

    #[test]
    fn both_ends_of_a_sequence_can_be_kept_apart() {
        assert_eq!(chosen(""), [0, 1, 2, 3, 4]);
        assert_eq!(chosen("hold_out = 2"), [0, 1, 2]);
        assert_eq!(chosen("hold_out = 2\nheld_out = true"), [3, 4]);
        assert_eq!(chosen("hold_out = 2\nhold_out_at = \"start\""), [2, 3, 4]);
        assert_eq!(chosen("hold_out = 2\nhold_out_at = \"start\"\nheld_out = true"), [0, 1]);
        assert!(chosen("hold_out = 9").is_empty());
        assert_eq!(chosen("hold_out = 9\nheld_out = true"), [0, 1, 2, 3, 4]);
    }
}
