//! A robot's users by number, a daemon of one of them, and programs that the others run. Numbers need no entry in
//! the machine's tables, and no file of the machine is changed.

use std::fs::{self, Permissions};
use std::os::unix::fs::{PermissionsExt, chown};
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Instant;

use grnet_tests::{DEADLINE, Process, program, shared_files};
use tempfile::TempDir;

/// A user with one own group and further ones.
#[derive(Debug, Clone, Copy)]
pub struct User {
    pub id: u32,
    pub group: u32,
    pub further: &'static [u32],
}

/// The group whose members may subscribe.
pub const MEMBERS: u32 = 64_100;
/// The group whose members may ask for changes.
pub const ADMINS: u32 = 64_110;
/// Runs the daemon, as the unit has it.
pub const DAEMON: User = User { id: 64_100, group: MEMBERS, further: &[ADMINS] };
pub const MEMBER: User = User { id: 64_101, group: 64_101, further: &[MEMBERS] };
pub const ADMIN: User = User { id: 64_102, group: 64_102, further: &[MEMBERS, ADMINS] };
pub const FOREIGNER: User = User { id: 64_103, group: 64_103, further: &[] };
pub const ROOT: User = User { id: 0, group: 0, further: &[] };

/// Which build a program is of.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Build {
    /// As `cargo build` makes it.
    Ordinary,
    /// With the feature `group-access`, as packaged.
    Packaged,
}

/// A machine's worth of files that every user may read, and a folder for the stream.
pub struct Rig {
    folder: TempDir,
    recording: PathBuf,
    checkpoint: PathBuf,
}

impl Rig {
    /// With a stream folder as the unit makes it.
    pub fn new() -> Self {
        let rig = Self::without_stream_folder();
        fs::create_dir(rig.stream()).unwrap();
        rig.give(&rig.stream(), DAEMON.id, MEMBERS, 0o2750);
        rig
    }

    /// # Panics
    /// When it does not run as root: nobody else can run programs as other users.
    pub fn without_stream_folder() -> Self {
        assert!(
            rustix::process::geteuid().is_root(),
            "the tests of access run programs as several users, which only root can: run them as root, or leave out \
             `make test-access`"
        );
        let shared = shared_files();
        let own = Permissions::from_mode(0o755);
        // Short: the names of Unix sockets are made from it.
        let folder = tempfile::Builder::new()
            .prefix("grnet-")
            .rand_bytes(5)
            .permissions(own)
            .tempdir_in("/tmp")
            .unwrap();
        Self {
            recording: shown(&folder, &shared.join("recording/seq-01")),
            checkpoint: shown(&folder, &shared.join("model.safetensors")),
            folder,
        }
    }

    pub fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    /// The folder that decides who may take part.
    pub fn stream(&self) -> PathBuf {
        self.path("run")
    }

    pub fn give(&self, path: &Path, user: u32, group: u32, mode: u32) {
        chown(path, Some(user), Some(group)).unwrap();
        fs::set_permissions(path, Permissions::from_mode(mode)).unwrap();
    }

    /// `grnetd COMMAND` as `user`.
    pub fn grnetd(&self, command: &str, build: Build, user: User, settings: &[&str]) -> Process {
        let config = self.path("grnetd.toml");
        let text = format!(
            "[source]\npath = {:?}\nloop = true\n[model]\ncheckpoint = {:?}\n[publish]\nroot = {:?}\n[frames]\n\
             base_from_camera = \"identity\"\n",
            self.recording,
            self.checkpoint,
            self.stream(),
        );
        fs::write(&config, text).unwrap();
        let mut process = self.run(user, build, "grnetd");
        process.arg(command).arg("--config").arg(&config);
        for setting in settings {
            process.args(["--set", setting]);
        }
        Process::start(process)
    }

    /// The packaged daemon with access by group, publishing.
    pub fn daemon(&self, settings: &[&str]) -> Process {
        let mut daemon =
            self.grnetd("run", Build::Packaged, DAEMON, &[&["publish.access=\"group\""], settings].concat());
        daemon.stderr_line_with("publishing");
        daemon
    }

    /// The packaged `grnet-client` as `user`.
    pub fn client(&self, user: User, arguments: &[&str]) -> Process {
        let mut client = self.run(user, Build::Packaged, "grnet-client");
        client.args(arguments).arg("--root").arg(self.stream());
        Process::start(client)
    }

    /// A request by the library as `user`: exit code, standard output, standard error.
    pub fn ask(&self, user: User, command: &str) -> (Option<i32>, String, String) {
        let deadline = Instant::now() + DEADLINE;
        loop {
            let mut ask = self.run(user, Build::Packaged, "ask");
            ask.arg(command).arg(self.stream());
            let (out, status, err) = Process::start(ask).finish();
            // Requests are answered a moment after the first sample is there.
            if status.code() != Some(69) || Instant::now() > deadline {
                return (status.code(), out.join("\n"), err);
            }
        }
    }

    /// One of the rig's programs as `user`.
    pub fn run(&self, user: User, build: Build, name: &str) -> Command {
        let mut command = as_user(user);
        command.arg(shown(&self.folder, &built(build, name)));
        command
    }
}

/// Whatever follows runs as `user`, in the rig's folder of nobody.
pub fn as_user(user: User) -> Command {
    let mut command = Command::new("setpriv");
    command.arg(format!("--reuid={}", user.id)).arg(format!("--regid={}", user.group));
    if user.further.is_empty() {
        command.arg("--clear-groups");
    } else {
        let groups = user.further.iter().map(ToString::to_string).collect::<Vec<_>>().join(",");
        command.arg(format!("--groups={groups}"));
    }
    // Closed for files that nobody gives other permissions: what the stream needs open, it opens itself.
    command.args(["--no-new-privs", "--", "sh", "-c", "umask 077; exec \"$0\" \"$@\""]).current_dir("/");
    command
}

/// The file or folder where every user can read it: itself, or a copy where the workspace is closed to them.
fn shown(folder: &TempDir, path: &Path) -> PathBuf {
    let open = |path: &Path| fs::metadata(path).unwrap().permissions().mode() & 0o001 != 0;
    if path.ancestors().skip(1).all(open) {
        return path.to_owned();
    }
    let place = folder.path().join("copies").join(path.parent().and_then(Path::file_name).unwrap());
    let copy = place.join(path.file_name().unwrap());
    if !copy.exists() {
        fs::create_dir_all(&place).unwrap();
        for arguments in [["cp", "-r"], ["chmod", "-R"]] {
            let mut command = Command::new(arguments[0]);
            command.arg(arguments[1]);
            match arguments[0] {
                "cp" => command.arg(path).arg(&place),
                _ => command.arg("a+rX").arg(folder.path().join("copies")),
            };
            assert!(command.status().unwrap().success(), "{command:?}");
        }
    }
    copy
}

/// Where `make test-access` puts the programs of a build.
fn built(build: Build, name: &str) -> PathBuf {
    let ordinary = program("grnetd");
    match build {
        Build::Ordinary => ordinary.with_file_name(name),
        Build::Packaged => {
            let path = ordinary.parent().unwrap().join("group-access").join(name);
            assert!(path.is_file(), "{} is missing: `make test-access` builds it", path.display());
            path
        }
    }
}
