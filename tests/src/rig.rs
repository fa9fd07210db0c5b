//! Programs, files and a stream of one's own for each test.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use rustix::fs::{FlockOperation, flock};
use tempfile::TempDir;

use crate::Process;

/// Frames of the recording that [`shared_files`] renders.
const FRAMES: &str = "90";

/// A stream of its own: nothing of it is seen by other tests or by a daemon of the user.
#[derive(Debug)]
pub struct Rig {
    folder: TempDir,
    recording: PathBuf,
    checkpoint: PathBuf,
}

impl Rig {
    /// A rig over the shared recording and its untrained network.
    pub fn new() -> Self {
        let shared = shared_files();
        // Short: the names of Unix sockets are made from it.
        let folder = tempfile::Builder::new().prefix("grnet-").rand_bytes(5).tempdir_in("/tmp").unwrap();
        Self {
            folder,
            recording: shared.join("recording/seq-01"),
            checkpoint: shared.join("model.safetensors"),
        }
    }

    /// The same with another recording.
    pub fn with_recording(recording: &Path) -> Self {
        Self { recording: recording.to_owned(), ..Self::new() }
    }

    /// The same with other weights.
    pub fn with_checkpoint(self, checkpoint: &Path) -> Self {
        Self { checkpoint: checkpoint.to_owned(), ..self }
    }

    /// A folder that ends with the test.
    pub fn folder(&self) -> &Path {
        self.folder.path()
    }

    /// The recording that the daemon plays.
    pub fn recording(&self) -> &Path {
        &self.recording
    }

    /// `grnetd run` on this rig, with further `key=value` settings.
    pub fn daemon(&self, settings: &[&str]) -> Process {
        self.daemon_with(&[], settings)
    }

    /// The same with further arguments.
    pub fn daemon_with(&self, arguments: &[&str], settings: &[&str]) -> Process {
        let config = self.folder().join("grnetd.toml");
        let text = format!(
            "[source]\npath = {:?}\n[model]\ncheckpoint = {:?}\n[publish]\nroot = {:?}\nprefix = \"e2e_\"\n[frames]\n\
             base_from_camera = \"identity\"\n",
            self.recording,
            self.checkpoint,
            self.transport_root()
        );
        fs::write(&config, text).unwrap();
        let mut command = Command::new(program("grnetd"));
        command.arg("run").arg("--config").arg(&config).args(arguments);
        for setting in settings {
            command.arg("--set").arg(setting);
        }
        Process::start(command)
    }

    /// `grnet-client tail` with these further arguments on this rig's stream; waits for a daemon that is starting.
    pub fn tail(&self, arguments: &[&str]) -> Process {
        self.client(&[&["tail", "--wait", "60"], arguments].concat())
    }

    /// `grnet-client` with these arguments on this rig's stream.
    pub fn client(&self, arguments: &[&str]) -> Process {
        let mut command = Command::new(program("grnet-client"));
        command.args(arguments).arg("--root").arg(self.transport_root()).args(["--prefix", "e2e_"]);
        Process::start(command)
    }

    /// Where iceoryx2 keeps this rig's files.
    pub fn transport_root(&self) -> PathBuf {
        self.folder().join("iox")
    }
}

impl Default for Rig {
    fn default() -> Self {
        Self::new()
    }
}

/// A program of the workspace, built by `make test` before the tests run.
///
/// # Panics
/// When it is not there.
pub fn program(name: &str) -> PathBuf {
    // target/<profile>/deps/<test> -> target/<profile>/<program>
    let test = std::env::current_exe().unwrap();
    let path = test.parent().and_then(Path::parent).unwrap().join(name);
    assert!(
        path.is_file(),
        "{} is not built: run `cargo build --workspace --bins`, as `make test` does",
        path.display()
    );
    path
}

/// `recording/` (7-Scenes layout, one pass) and `model.safetensors` (untrained grnet-small), made once for all tests.
pub fn shared_files() -> PathBuf {
    let profile = program("grnet-train").parent().unwrap().to_owned();
    let folder = profile.join("end-to-end");
    fs::create_dir_all(&folder).unwrap();
    let lock = fs::File::create(folder.join("lock")).unwrap();
    // Tests are processes of their own: one makes the files, the others wait.
    flock(&lock, FlockOperation::LockExclusive).unwrap();
    let train = program("grnet-train");
    let newest = fs::metadata(&train).and_then(|m| m.modified()).unwrap();
    let done = folder.join("done");
    if fs::metadata(&done).and_then(|m| m.modified()).is_ok_and(|made| made > newest) {
        return folder;
    }
    let run = |arguments: &[&str]| {
        let output = Command::new(&train).args(arguments).current_dir(&folder).output().unwrap();
        assert!(output.status.success(), "{arguments:?}: {}", String::from_utf8_lossy(&output.stderr));
    };
    let _ = fs::remove_dir_all(folder.join("recording"));
    let _ = fs::remove_file(folder.join("model.safetensors"));
    run(&[
        "synth",
        "--out",
        "recording",
        "--sequences",
        "1",
        "--frames",
        FRAMES,
        "--size",
        "160x120",
        "--texel-mm",
        "16",
    ]);
    run(&["init", "--preset", "grnet-small", "--seed", "1", "--out", "model.safetensors"]);
    fs::write(&done, "").unwrap();
    folder
}

/// Real recordings, where there are any: `GRNET_DATA`, else `../shared/data` beside the workspace.
pub fn data_folder() -> Option<PathBuf> {
    let workspace = Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap();
    let folder =
        std::env::var_os("GRNET_DATA").map_or_else(|| workspace.join("../shared/data"), PathBuf::from);
    folder.is_dir().then_some(folder)
}

/// The Python of the environment that `make test` prepares.
///
/// # Panics
/// When it is not there.
pub fn venv_python() -> PathBuf {
    let target = program("grnetd").parent().and_then(Path::parent).unwrap().to_owned();
    let python = target.join("venv/bin/python");
    assert!(python.is_file(), "{} is missing: run `make test`, which prepares it", python.display());
    python
}
