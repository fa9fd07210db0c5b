//! The folder: who may use it, and the state in it.

use std::fs;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};

use super::error::io;
use super::identity::{RunIdentity, RunRecord};
use super::lock::{LOCK, Lock};
use super::log::{Log, LogEntry};
use super::{RunError, State, atomic, curves, log};

const CONFIG: &str = "config.toml";
const RECORD: &str = "run.json";
const LOG: &str = "log.jsonl";
const STATE: &str = "state.safetensors";
const PREVIOUS: &str = "state.previous.safetensors";

/// A folder that holds one training run; see the [module](super) for its files. No other process can open it meanwhile.
#[derive(Debug)]
pub struct RunFolder {
    path: PathBuf,
    record: RunRecord,
    log: Log,
    _lock: Lock,
}

impl RunFolder {
    /// Starts a run in a new or empty folder.
    ///
    /// # Errors
    /// When the folder holds a run or anything else, another process has it, or it cannot be written.
    pub fn create(path: &Path, identity: &RunIdentity) -> Result<Self, RunError> {
        // Looked at first, so that a refusal leaves no trace.
        refuse_used(path, identity)?;
        fs::create_dir_all(path).map_err(io("create", path))?;
        let lock = Lock::take(path)?;
        refuse_used(path, identity)?;
        atomic::replace(&path.join(CONFIG), identity.config_toml.as_bytes())?;
        let record = RunRecord::of(identity);
        let file = path.join(RECORD);
        let text = serde_json::to_string_pretty(&record)
            .map_err(|error| RunError::Encode { path: file.clone(), reason: error.to_string() })?;
        let log = Log::open(&path.join(LOG))?;
        // Last: this file is what makes the folder a run.
        atomic::replace(&file, (text + "\n").as_bytes())?;
        Ok(Self { path: path.into(), record, log, _lock: lock })
    }

    /// Opens the run in a folder to go on with it.
    ///
    /// # Errors
    /// When there is no run, another process has it, or a run of `identity` would not end with the same weights.
    pub fn resume(path: &Path, identity: &RunIdentity) -> Result<Self, RunError> {
        let file = path.join(RECORD);
        if RunRecord::read(&file)?.is_none() {
            return Err(RunError::NoRun { folder: path.into() });
        }
        let lock = Lock::take(path)?;
        // Again, now that nobody else writes it.
        let record = RunRecord::read(&file)?.ok_or_else(|| RunError::NoRun { folder: path.into() })?;
        let config = Self::config_of(path)?;
        let differences = record.differences(&config, identity);
        if !differences.is_empty() {
            return Err(RunError::Differs { folder: path.into(), differences });
        }
        let log = Log::open(&path.join(LOG))?;
        Ok(Self { path: path.into(), record, log, _lock: lock })
    }

    /// The configuration of the run in a folder, for who resumes it without giving one.
    ///
    /// # Errors
    /// When there is no run, or the file cannot be read.
    pub fn config_of(path: &Path) -> Result<String, RunError> {
        if RunRecord::read(&path.join(RECORD))?.is_none() {
            return Err(RunError::NoRun { folder: path.into() });
        }
        let config = path.join(CONFIG);
        fs::read_to_string(&config).map_err(io("read", &config))
    }

    /// The folder.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// What run.json says.
    pub fn record(&self) -> &RunRecord {
        &self.record
    }

    /// The last state that was saved; none before the first. A damaged file is passed over for the one before it, with a
    /// warning on the standard error stream.
    ///
    /// # Errors
    /// When neither of the two files can be used.
    pub fn load_state(&self) -> Result<Option<State>, RunError> {
        self.load_state_with(|warning| eprintln!("warning: {warning}"))
    }

    /// [`Self::load_state`] with a warning that goes to `warn`.
    ///
    /// # Errors
    /// When neither of the two files can be used.
    pub fn load_state_with(&self, warn: impl FnOnce(String)) -> Result<Option<State>, RunError> {
        let (newest, previous) = (self.path.join(STATE), self.path.join(PREVIOUS));
        let newest = match State::read(&newest) {
            Ok(Some(state)) => return Ok(Some(state)),
            // Killed between the two renames of `save_state`, or before the first save.
            Ok(None) => None,
            Err(error) => Some(error),
        };
        match (newest, State::read(&previous)) {
            (newest, Ok(Some(state))) => {
                if let Some(error) = newest {
                    warn(format!("{error}; going on from step {} ({PREVIOUS})", state.step));
                }
                Ok(Some(state))
            }
            (None, Ok(None)) => Ok(None),
            (newest, previous) => {
                let problems = [newest, previous.err()].into_iter().flatten().map(|error| error.to_string());
                Err(RunError::NoGoodState { folder: self.path.clone(), problems: problems.collect() })
            }
        }
    }

    /// Saves the state; the one before it is kept. Whenever the process is killed or the power fails, one good state is
    /// there. What is to be logged of a step is logged before, so that a resumed run does not tell it twice.
    ///
    /// # Errors
    /// When it cannot be written: the states that were there still load.
    pub fn save_state(&self, state: &State) -> Result<(), RunError> {
        let newest = self.path.join(STATE);
        let bytes = state.to_bytes(&newest)?;
        // The log up to a state must not be lost when the state is not.
        self.log.sync()?;
        let staged = atomic::stage(&newest, &bytes)?;
        match fs::rename(&newest, self.path.join(PREVIOUS)) {
            Ok(()) => {}
            Err(error) if error.kind() == ErrorKind::NotFound => {}
            Err(error) => return Err(io("keep", &newest)(error)),
        }
        fs::rename(&staged, &newest).map_err(io("replace", &newest))?;
        atomic::sync_folder_of(&newest)
    }

    /// Appends an entry to the log.
    ///
    /// # Errors
    /// When it cannot be written; the log then ends with the entry before it.
    pub fn log(&mut self, entry: &LogEntry) -> Result<(), RunError> {
        self.log.append(entry)
    }

    /// Cuts off what was logged after a step, for a run that goes on from there.
    ///
    /// # Errors
    /// When the log has a line that is not an entry, or cannot be replaced.
    pub fn truncate_log(&mut self, after_step: u64) -> Result<(), RunError> {
        self.log.truncate(after_step)
    }

    /// All entries of the log.
    ///
    /// # Errors
    /// When the log cannot be read or has a line that is not an entry.
    pub fn read_log(&self) -> Result<Vec<LogEntry>, RunError> {
        log::read_log(&self.path.join(LOG))
    }

    /// Draws curves.svg and curves.png from the log.
    ///
    /// # Errors
    /// When the log cannot be read or a picture cannot be written.
    pub fn draw_curves(&self) -> Result<(), RunError> {
        curves::write(&self.read_log()?, &self.path)
    }
}

/// Refuses a folder that holds more than what a start that was killed leaves behind.
fn refuse_used(folder: &Path, identity: &RunIdentity) -> Result<(), RunError> {
    let entries = match fs::read_dir(folder) {
        Ok(entries) => entries,
        Err(error) if error.kind() == ErrorKind::NotFound => return Ok(()),
        Err(error) => return Err(io("read", folder)(error)),
    };
    let mut foreign = None;
    for entry in entries {
        let path = entry.map_err(io("read", folder))?.path();
        let name = path.file_name().and_then(|name| name.to_str()).unwrap_or_default();
        let ours = match name {
            RECORD => return Err(RunError::HoldsRun { folder: folder.into() }),
            LOCK => true,
            CONFIG => fs::read(&path).map_err(io("read", &path))? == identity.config_toml.as_bytes(),
            LOG => fs::metadata(&path).map_err(io("read", &path))?.len() == 0,
            name => [CONFIG, RECORD].iter().any(|file| atomic::partial(Path::new(file)) == Path::new(name)),
        };
        if !ours {
            foreign = Some(path);
        }
    }
    match foreign {
        Some(found) => Err(RunError::NotOurs { folder: folder.into(), found }),
        None => Ok(()),
    }
}
