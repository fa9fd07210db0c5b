//! A folder with a small recording, an untrained network, a configuration and a transport root of its own.
#![allow(dead_code)] // Every test binary uses another part.

use std::io::{BufRead as _, BufReader, Read as _};
use std::path::PathBuf;
use std::process::{Child, Command, Stdio};
use std::sync::mpsc::{Receiver, channel};
use std::time::{Duration, Instant};

use grnet_model::{Branches, Checkpoint, NetworkConfig, Preprocessing, SpatialPool, untrained};
use grnet_proto::{
    AccessMode, CameraName, ControlClient, Node, Role, Root, StatusSubscription, TransportError,
};
use image::{Rgb, RgbImage};
use rustix::process::{Pid, Signal};
use tempfile::TempDir;

/// Longest wait for something that a healthy daemon does soon.
const PATIENCE: Duration = Duration::from_secs(30);

pub struct Rig {
    folder: TempDir,
}

pub struct Ended {
    pub code: i32,
    pub stdout: String,
    pub stderr: String,
}

fn network() -> NetworkConfig {
    NetworkConfig {
        width: 0.0625,
        input_height_px: 64,
        input_width_px: 64,
        branches: Branches { relative: true, global: true, fusion: true },
        res5_channels: 128,
        spatial_pool: SpatialPool::Average,
        lstm_hidden: 16,
        fc1: 16,
        fc2: 16,
        fc3: 16,
        ..NetworkConfig::grnet_small()
    }
}

fn checkpoint(seed: u64) -> Checkpoint {
    untrained::checkpoint(&network(), seed, Preprocessing::default()).unwrap()
}

impl Rig {
    /// With a recording of so many frames.
    pub fn new(frames: u32) -> Self {
        // Socket names have little room: not below a long temporary folder.
        let folder = tempfile::Builder::new().prefix("g").tempdir_in("/tmp").unwrap();
        let rig = Self { folder };
        std::fs::create_dir(rig.path("frames")).unwrap();
        for frame in 0..frames {
            let image = RgbImage::from_fn(64, 48, |x, y| {
                Rgb([(x * 4 + frame * 8) as u8, (y * 5) as u8, ((x ^ y) + frame) as u8])
            });
            image.save(rig.path(&format!("frames/{frame:06}.png"))).unwrap();
        }
        if frames > 0 {
            checkpoint(1).save(rig.path("model.safetensors").as_ref()).unwrap();
        }
        rig.write("grnetd.toml", &rig.config_text());
        rig
    }

    pub fn config_text(&self) -> String {
        let root = self.root();
        format!(
            "[model]\ncheckpoint = \"model.safetensors\"\n[publish]\nroot = {root:?}\nprefix = \"t_\"\n\
             [log]\nlevel = \"info\"\n[source]\npath = \"frames\"\npace = \"max\"\n"
        )
    }

    pub fn config(&self) -> String {
        self.path("grnetd.toml")
    }

    pub fn path(&self, name: &str) -> String {
        self.folder.path().join(name).to_str().unwrap().to_owned()
    }

    pub fn root(&self) -> PathBuf {
        self.folder.path().join("r")
    }

    pub fn write(&self, name: &str, text: &str) {
        std::fs::write(self.path(name), text).unwrap();
    }

    /// A scene on the trunk of `trunk_seed` whose own weights are those of `scene_seed`.
    pub fn save_scene(&self, file: &str, trunk_seed: u64, scene_seed: u64, name: &str) {
        self.save_scene_of(&network(), file, trunk_seed, scene_seed, name);
    }

    /// The same with heads of another shape, which says that it belongs to that trunk nevertheless.
    pub fn save_misshapen_scene(&self, file: &str, trunk_seed: u64, name: &str) {
        self.save_scene_of(&NetworkConfig { lstm_hidden: 24, ..network() }, file, trunk_seed, 1, name);
    }

    fn save_scene_of(
        &self,
        network: &NetworkConfig,
        file: &str,
        trunk_seed: u64,
        scene_seed: u64,
        name: &str,
    ) {
        let (trunk, _) = checkpoint(trunk_seed).split().unwrap();
        let (_, scene) =
            untrained::checkpoint(network, scene_seed, Preprocessing::default()).unwrap().split().unwrap();
        let trunk_hash = trunk.content_hash().to_owned();
        let scene = scene
            .with_metadata(|metadata| {
                metadata.trunk_hash = Some(trunk_hash);
                metadata.scene = Some(grnet_model::SceneInfo { id: name.into(), name: name.into() });
            })
            .unwrap();
        scene.save(self.path(file).as_ref()).unwrap();
    }

    pub fn camera(&self) -> CameraName {
        CameraName::default()
    }

    /// Runs the program to its end.
    pub fn run(&self, arguments: &[&str]) -> Ended {
        let output = Command::new(env!("CARGO_BIN_EXE_grnetd")).args(arguments).output().unwrap();
        Ended {
            code: output.status.code().unwrap(),
            stdout: String::from_utf8(output.stdout).unwrap(),
            stderr: String::from_utf8(output.stderr).unwrap(),
        }
    }

    /// A client's node, once the daemon's pose service is there.
    pub fn node_when_up(&self) -> Node {
        let root = Root::own(&self.root(), Some("t_")).unwrap();
        until_there(|| {
            let node = Node::open(AccessMode::User, &root, Role::Client)?;
            StatusSubscription::open(&node, &self.camera()).map(|_| node)
        })
    }

    pub fn open_status(&self, node: &Node) -> StatusSubscription {
        until_there(|| StatusSubscription::open(node, &self.camera()))
    }

    pub fn open_control(&self, node: &Node) -> ControlClient {
        until_there(|| ControlClient::open(node, &self.camera()))
    }
}

/// A service that does not exist yet has no event to wait for.
fn until_there<T>(mut open: impl FnMut() -> Result<T, TransportError>) -> T {
    let deadline = Instant::now() + PATIENCE;
    loop {
        match open() {
            Ok(there) => return there,
            Err(TransportError::NoDaemon { .. }) if Instant::now() < deadline => {
                std::thread::sleep(Duration::from_millis(5));
            }
            Err(error) => panic!("{error}"),
        }
    }
}

/// `grnetd run`, ended when dropped.
pub struct Daemon {
    child: Child,
    lines: Receiver<String>,
    stderr: String,
}

impl Daemon {
    pub fn start(rig: &Rig, arguments: &[&str]) -> Self {
        Self::start_with(rig, arguments, &[])
    }

    pub fn start_with(rig: &Rig, arguments: &[&str], environment: &[(&str, String)]) -> Self {
        Self::start_as(&[], rig, arguments, environment)
    }

    /// Started by another program, which the daemon then replaces.
    pub fn start_as(wrapper: &[&str], rig: &Rig, arguments: &[&str], environment: &[(&str, String)]) -> Self {
        let words: Vec<&str> = wrapper.iter().copied().chain([env!("CARGO_BIN_EXE_grnetd")]).collect();
        let mut child = Command::new(words[0])
            .args(&words[1..])
            .args(["run", "--config", &rig.config()])
            .args(arguments)
            .envs(environment.iter().map(|(name, value)| (name, value)))
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        let (sender, lines) = channel();
        let stderr = BufReader::new(child.stderr.take().unwrap());
        std::thread::spawn(move || {
            for line in stderr.lines().map_while(Result::ok) {
                if sender.send(line).is_err() {
                    return;
                }
            }
        });
        Self { child, lines, stderr: String::new() }
    }

    pub fn id(&self) -> u32 {
        self.child.id()
    }

    pub fn signal(&self, signal: Signal) {
        rustix::process::kill_process(Pid::from_child(&self.child), signal).unwrap();
    }

    /// Waits until a line of the log contains `text`, and gives it.
    pub fn wait_for_line(&mut self, text: &str) -> String {
        loop {
            let line = self.lines.recv_timeout(PATIENCE);
            let line = line.unwrap_or_else(|_| panic!("no line with {text:?} in:\n{}", self.stderr));
            self.stderr += &format!("{line}\n");
            if line.contains(text) {
                return line;
            }
        }
    }

    pub fn wait(&mut self) -> Ended {
        // The log ends when the process ends.
        while let Ok(line) = self.lines.recv_timeout(PATIENCE) {
            self.stderr += &format!("{line}\n");
        }
        let code = self.child.wait().unwrap().code().unwrap_or(-1);
        let mut stdout = String::new();
        self.child.stdout.take().unwrap().read_to_string(&mut stdout).unwrap();
        Ended { code, stdout, stderr: std::mem::take(&mut self.stderr) }
    }
}

impl Drop for Daemon {
    /// Ends it in its own way, so that nothing is left in shared memory.
    fn drop(&mut self) {
        if self.child.try_wait().is_ok_and(|ended| ended.is_none()) {
            self.signal(Signal::CONT);
            self.signal(Signal::TERM);
            // The log ends when the process ends; one that does not end is killed.
            while self.lines.recv_timeout(PATIENCE).is_ok() {}
            let _ = self.child.kill();
            let _ = self.child.wait();
        }
    }
}
