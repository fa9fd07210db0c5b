//! A transport root of one's own per test, and a daemon's publishers as a process that can be killed.
#![allow(dead_code)] // Every test binary uses another part.

use std::{
    path::{Path, PathBuf},
    process::{Child, Command, Stdio},
    time::{Duration, Instant},
};

use grnet_client::{CameraName, CaptureClock, Connection, PoseSample, Reason, Root, Status};
use grnet_proto::{
    Access, AccessMode, BootId, DaemonStatus, Health, Node, PosePublisher, Role, StatusPublisher, clock::Now,
};
use tempfile::TempDir;

/// Generous: the machine may be busy.
pub const SOON: Duration = Duration::from_secs(20);

pub struct Rig {
    pub folder: TempDir,
    pub connection: Connection,
    pub boot_id: BootId,
}

impl Rig {
    pub fn new() -> Self {
        let folder = tempfile::Builder::new().prefix("grnet").tempdir_in("/tmp").unwrap();
        let connection = connection(folder.path());
        Self { folder, connection, boot_id: BootId::random().unwrap() }
    }

    pub fn node(&self) -> Node {
        Node::open(AccessMode::User, &self.connection.root, Role::Daemon).unwrap()
    }

    pub fn publisher(&self) -> PosePublisher {
        PosePublisher::open(&self.node(), &self.connection.camera).unwrap()
    }

    pub fn sample(&self, sequence: u64) -> PoseSample {
        sample(self.boot_id, &self.connection.camera, sequence)
    }

    /// Starts a process that publishes as a daemon does, and waits until it does.
    pub fn daemon(&self) -> DaemonProcess {
        let ready = self.folder.path().join("ready");
        let _ = std::fs::remove_file(&ready);
        let child = Command::new(std::env::current_exe().unwrap())
            .args(["--ignored", "--exact", "daemon_process", "--nocapture"])
            .env("GRNET_TEST_FOLDER", self.folder.path())
            .stdout(Stdio::null())
            .stderr(Stdio::inherit())
            .spawn()
            .unwrap();
        let daemon = DaemonProcess { child };
        wait_until("the daemon process publishes", || ready.exists());
        daemon
    }
}

impl Drop for Rig {
    fn drop(&mut self) {
        // What killed processes left in shared memory can only be found through the folder.
        if let Ok(node) = Node::open(AccessMode::User, &self.connection.root, Role::Daemon) {
            node.cleanup_dead_nodes();
        }
    }
}

pub struct DaemonProcess {
    child: Child,
}

impl DaemonProcess {
    /// SIGKILL.
    pub fn kill(mut self) {
        self.child.kill().unwrap();
        self.child.wait().unwrap();
    }
}

impl Drop for DaemonProcess {
    fn drop(&mut self) {
        // Already gone after `kill`.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Body of the test that is the daemon process: publishes poses at 100 Hz and states at 10 Hz for ever.
pub fn publish_for_ever() {
    let folder = PathBuf::from(std::env::var_os("GRNET_TEST_FOLDER").expect("run by the other tests"));
    let connection = connection(&folder);
    let node = Node::open(AccessMode::User, &connection.root, Role::Daemon).unwrap();
    let mut poses = PosePublisher::open(&node, &connection.camera).unwrap();
    let mut states = StatusPublisher::open(&node, &connection.camera).unwrap();
    let boot_id = BootId::random().unwrap();
    for sequence in 0.. {
        poses.publish(&sample(boot_id, &connection.camera, sequence)).unwrap();
        if sequence % 10 == 0 {
            let mut status = DaemonStatus::unknown(boot_id, &connection.camera, Access::USER);
            status.health = Health::OK;
            status.uptime_ns = sequence * 10_000_000;
            status.publish_time_ns = Now::read().monotonic_ns;
            states.publish(&status).unwrap();
        }
        if sequence == 0 {
            std::fs::write(folder.join("ready"), "").unwrap();
        }
        std::thread::sleep(Duration::from_millis(10));
    }
}

/// A sample with an odometry pose and without a map pose.
pub fn sample(boot_id: BootId, camera: &CameraName, sequence: u64) -> PoseSample {
    let mut sample = PoseSample::unknown(boot_id, camera, Status::TRACKING, Reason::NO_SCENE);
    let now = Now::read();
    sample.sequence = sequence;
    sample.capture_clock = CaptureClock::MONOTONIC;
    sample.capture_time_ns = now.monotonic_ns - 1_000_000;
    sample.odom_from_base.translation_m = [sequence as f64, 0.5, 0.0];
    sample.odom_from_base.quaternion_xyzw = [0.0, 0.0, 0.0, 1.0];
    sample.stamp_publication(now, None);
    sample
}

pub fn wait_until(what: &str, mut done: impl FnMut() -> bool) {
    let start = Instant::now();
    while !done() {
        assert!(start.elapsed() < SOON, "waited in vain until {what}");
        std::thread::sleep(Duration::from_millis(5));
    }
}

/// One prefix serves all tests: iceoryx2 leaves one small file in shared memory per prefix, and all
/// other names there are unique.
fn connection(folder: &Path) -> Connection {
    let root = Root::own(folder, Some("grnet_test_")).unwrap();
    Connection { root, ..Connection::default() }
}
