//! A transport root of one's own per test, so that tests disturb neither each other nor a daemon.
#![allow(dead_code)] // Every test binary uses another part.

use std::path::PathBuf;

use grnet_proto::{AccessMode, BootId, CameraName, Node, PoseSample, Reason, Role, Root, Status};
use tempfile::TempDir;

pub struct Rig {
    _folder: TempDir,
    pub path: PathBuf,
    pub root: Root,
    pub camera: CameraName,
    pub boot_id: BootId,
}

impl Rig {
    pub fn new() -> Self {
        // As a folder of one user's own must be where files are the services.
        let own = std::os::unix::fs::PermissionsExt::from_mode(0o700);
        let folder = tempfile::Builder::new().prefix("grnet").permissions(own).tempdir_in("/tmp").unwrap();
        let path = folder.path().to_owned();
        Self {
            root: root(&path),
            path,
            _folder: folder,
            camera: CameraName::default(),
            boot_id: BootId::random().unwrap(),
        }
    }

    pub fn daemon(&self) -> Node {
        Node::open(AccessMode::User, &self.root, Role::Daemon).unwrap()
    }

    pub fn client(&self) -> Node {
        Node::open(AccessMode::User, &self.root, Role::Client).unwrap()
    }

    pub fn sample(&self, sequence: u64) -> PoseSample {
        let mut sample = PoseSample::unknown(self.boot_id, &self.camera, Status::TRACKING, Reason::NONE);
        sample.sequence = sequence;
        sample
    }
}

/// The root in `path`. One prefix serves all tests: iceoryx2 leaves one small file in shared memory per
/// prefix, and all other names there are unique.
pub fn root(path: &std::path::Path) -> Root {
    Root::own(path, Some("grnet_test_")).unwrap()
}
