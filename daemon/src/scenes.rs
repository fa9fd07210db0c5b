//! Which weights run, and which other scenes could.

use std::path::{Path, PathBuf};

use grnet_model::candle_core::Device;
use grnet_model::{Checkpoint, CheckpointError, Kind, LoadedModel};
use grnet_proto::MAX_SCENES;

/// What tells a scene apart from others.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SceneIdentity {
    /// Its name in the checkpoint, or the file's name.
    pub name: String,
    /// SHA-256 of its weights.
    pub hash: [u8; 32],
}

/// What samples and status say about the weights in use.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ModelIdentity {
    /// SHA-256 of all weights.
    pub model_hash: [u8; 32],
    /// The checkpoint's file name.
    pub name: String,
    /// Whether they were trained.
    pub trained: bool,
    /// The scene, where there is one.
    pub scene: Option<SceneIdentity>,
}

/// A model ready to be put into the pipeline.
#[derive(Debug)]
pub struct Prepared {
    /// The network.
    pub model: LoadedModel,
    /// What it is.
    pub identity: ModelIdentity,
}

impl Prepared {
    /// Loads a checkpoint, with a scene's weights in place of its own where one is given. Takes seconds for large
    /// networks: never on the worker's thread.
    ///
    /// # Errors
    /// See [`CheckpointError`].
    pub fn load(checkpoint: &Path, scene: Option<&Path>) -> Result<Self, CheckpointError> {
        let base = Checkpoint::load(checkpoint)?;
        let (whole, scene) = match scene {
            Some(path) => {
                let scene = Checkpoint::load(path)?;
                let identity = identity(&scene, path);
                (Checkpoint::merge(base, scene)?, Some(identity))
            }
            None => {
                let scene = own_scene(&base, checkpoint)?;
                (base, scene)
            }
        };
        let model = LoadedModel::from_checkpoint(whole, &Device::Cpu)?;
        let name = file_name(checkpoint);
        let identity = ModelIdentity { model_hash: model.model_hash, name, trained: model.trained, scene };
        Ok(Self { model, identity })
    }
}

/// The scene that a complete checkpoint brings along, when a head of it is alive.
fn own_scene(base: &Checkpoint, path: &Path) -> Result<Option<SceneIdentity>, CheckpointError> {
    let metadata = base.metadata();
    let alive = metadata.heads.global.pose || metadata.heads.fused.pose;
    if metadata.kind != Kind::Complete || !alive {
        return Ok(None);
    }
    let (_, scene) = base.clone().split()?;
    Ok(Some(identity(&scene, path)))
}

fn identity(scene: &Checkpoint, path: &Path) -> SceneIdentity {
    let stem = || path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
    let named = scene.metadata().scene.as_ref().map(|scene| scene.name.clone());
    SceneIdentity { name: named.unwrap_or_else(stem), hash: from_hex(scene.content_hash()) }
}

fn file_name(path: &Path) -> String {
    path.file_name().unwrap_or_default().to_string_lossy().into_owned()
}

fn from_hex(hex: &str) -> [u8; 32] {
    let mut bytes = [0; 32];
    for (byte, digits) in bytes.iter_mut().zip(hex.as_bytes().chunks(2)) {
        *byte =
            std::str::from_utf8(digits).ok().and_then(|text| u8::from_str_radix(text, 16).ok()).unwrap_or(0);
    }
    bytes
}

/// Why a request about scenes was not done.
#[derive(Debug, thiserror::Error)]
pub enum SceneError {
    /// It makes no sense.
    #[error("{0}")]
    Invalid(String),
    /// It makes sense, but not now.
    #[error("{0}")]
    Refused(String),
    /// It was tried and failed.
    #[error("{0}")]
    Failed(String),
}

/// The scenes that were loaded. Their weights stay on disk until they are selected: a scene shares its memory
/// with nobody, and one place is enough at a time.
#[derive(Debug)]
pub struct SceneLibrary {
    checkpoint: PathBuf,
    scenes: Vec<Scene>,
    active: Option<usize>,
}

#[derive(Debug, Clone)]
struct Scene {
    identity: SceneIdentity,
    /// `None`: the checkpoint's own.
    path: Option<PathBuf>,
}

impl SceneLibrary {
    /// The library at the start: the scene in use, if any.
    pub fn new(checkpoint: &Path, scene: Option<&Path>, in_use: &ModelIdentity) -> Self {
        let first = in_use.scene.clone().map(|identity| Scene { identity, path: scene.map(Path::to_owned) });
        let scenes: Vec<Scene> = first.into_iter().collect();
        let active = (!scenes.is_empty()).then_some(0);
        Self { checkpoint: checkpoint.to_owned(), scenes, active }
    }

    /// The loaded scenes, and the index of the one in use.
    pub fn list(&self) -> (Vec<SceneIdentity>, Option<usize>) {
        (self.scenes.iter().map(|scene| scene.identity.clone()).collect(), self.active)
    }

    /// Reads the scene file at `path`, proves that it fits the trunk, and remembers it.
    ///
    /// # Errors
    /// When it cannot be used; the library is then as before.
    pub fn load(&mut self, path: &Path) -> Result<String, SceneError> {
        if !path.is_absolute() {
            return Err(SceneError::Invalid(format!("{} is not an absolute path", path.display())));
        }
        if self.scenes.len() == MAX_SCENES {
            return Err(SceneError::Refused(format!("{MAX_SCENES} scenes are loaded: unload one first")));
        }
        let prepared = self.prepare(Some(path))?;
        let Some(identity) = prepared.identity.scene else {
            return Err(SceneError::Failed(format!("{} holds no scene", path.display())));
        };
        let name = identity.name.clone();
        match self.scenes.iter().find(|scene| scene.identity.name == name) {
            Some(known) if known.identity.hash == identity.hash => {
                return Ok(format!("scene {name} was loaded before"));
            }
            Some(_) => {
                return Err(SceneError::Refused(format!("another scene {name} is loaded: unload it first")));
            }
            None => {}
        }
        self.scenes.push(Scene { identity, path: Some(path.to_owned()) });
        Ok(format!("scene {name} is loaded; select it to use it"))
    }

    /// Loads the weights of the scene `name`, to be put into the pipeline; then call [`SceneLibrary::selected`].
    ///
    /// # Errors
    /// When there is no such scene, or its file is not what it was.
    pub fn prepare_selected(&self, name: &str) -> Result<Prepared, SceneError> {
        let scene = &self.scenes[self.index(name)?];
        let prepared = self.prepare(scene.path.as_deref())?;
        if prepared.identity.scene.as_ref() != Some(&scene.identity) {
            return Err(SceneError::Failed(format!(
                "the file of scene {name} has changed since it was loaded: unload and load it again"
            )));
        }
        Ok(prepared)
    }

    /// Whether the scene `name` is in use.
    pub fn is_active(&self, name: &str) -> bool {
        self.active.is_some_and(|index| self.scenes[index].identity.name == name)
    }

    /// The scene `name` runs now.
    pub fn selected(&mut self, name: &str) {
        self.active = self.index(name).ok();
    }

    /// Loads what a configuration with this `model.scene` runs; then call [`SceneLibrary::configured`].
    ///
    /// # Errors
    /// When it cannot be used, or has the name of another loaded scene.
    pub fn prepare_configured(&self, path: Option<&Path>) -> Result<Prepared, SceneError> {
        let prepared = self.prepare(path)?;
        let Some(identity) = &prepared.identity.scene else {
            return match path {
                Some(path) => Err(SceneError::Failed(format!("{} holds no scene", path.display()))),
                None => Ok(prepared),
            };
        };
        let is_new = !self.scenes.iter().any(|scene| scene.identity == *identity);
        if is_new && self.scenes.len() == MAX_SCENES {
            return Err(SceneError::Refused(format!("{MAX_SCENES} scenes are loaded: unload one first")));
        }
        if is_new && self.scenes.iter().any(|scene| scene.identity.name == identity.name) {
            let name = &identity.name;
            return Err(SceneError::Refused(format!("another scene {name} is loaded: unload it first")));
        }
        Ok(prepared)
    }

    /// What [`SceneLibrary::prepare_configured`] gave for `path` runs now.
    pub fn configured(&mut self, path: Option<&Path>, in_use: &ModelIdentity) {
        if let Some(identity) = &in_use.scene
            && !self.scenes.iter().any(|scene| scene.identity == *identity)
        {
            self.scenes.push(Scene { identity: identity.clone(), path: path.map(Path::to_owned) });
        }
        self.active = self.scenes.iter().position(|scene| Some(&scene.identity) == in_use.scene.as_ref());
    }

    /// Loads what runs once the scene `name` is gone: `None` when it is not in use. Then call
    /// [`SceneLibrary::remove`].
    ///
    /// # Errors
    /// When there is no such scene, or it is the checkpoint's own.
    pub fn prepare_without(&self, name: &str) -> Result<Option<Prepared>, SceneError> {
        let index = self.index(name)?;
        if self.scenes[index].path.is_none() {
            return Err(SceneError::Refused(format!(
                "scene {name} is part of the checkpoint {} and cannot be unloaded",
                self.checkpoint.display()
            )));
        }
        if self.active == Some(index) { self.prepare(None).map(Some) } else { Ok(None) }
    }

    /// Forgets the scene `name`; `in_use` is what runs now.
    pub fn remove(&mut self, name: &str, in_use: &ModelIdentity) {
        self.scenes.retain(|scene| scene.identity.name != name);
        self.configured(None, in_use);
    }

    fn index(&self, name: &str) -> Result<usize, SceneError> {
        self.scenes.iter().position(|scene| scene.identity.name == name).ok_or_else(|| {
            let loaded: Vec<&str> = self.scenes.iter().map(|scene| scene.identity.name.as_str()).collect();
            let loaded = if loaded.is_empty() { "none".to_owned() } else { loaded.join(", ") };
            SceneError::Refused(format!("no scene {name:?} is loaded (loaded: {loaded})"))
        })
    }

    fn prepare(&self, scene: Option<&Path>) -> Result<Prepared, SceneError> {
        Prepared::load(&self.checkpoint, scene)
            .map_err(|error| SceneError::Failed(crate::failure::Failure::config(error).chain()))
    }
}
