//! Who may do what with a stream: real users, the real programs, the real folders.
#![forbid(unsafe_code)]

mod rig;

use std::collections::BTreeSet;
use std::fs;
use std::os::unix::fs::{MetadataExt, PermissionsExt};
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Instant;

use grnet_tests::{DEADLINE, Process};
use rig::{ADMIN, ADMINS, Build, DAEMON, FOREIGNER, MEMBER, MEMBERS, ROOT, Rig, User, as_user};
use serde_json::Value;

/// Samples that `user` receives.
fn samples(rig: &Rig, user: User, count: usize) -> Vec<Value> {
    let count_text = count.to_string();
    let mut tail = rig.client(user, &["tail", "--json", "--wait", "60", "--count", &count_text]);
    let samples = (0..count).map(|_| tail.json()).collect();
    let (_, status, stderr) = tail.finish();
    assert!(status.success(), "{stderr}");
    samples
}

/// The exit code and the one line of a client that gets nothing.
fn refusal(process: Process) -> (Option<i32>, String) {
    let (out, status, stderr) = process.finish();
    assert_eq!((out.len(), stderr.lines().count()), (0, 1), "{out:?} {stderr}");
    (status.code(), stderr)
}

fn assert_has(text: &str, parts: &[&str]) {
    for part in parts {
        assert!(text.contains(part), "{part:?} is missing: {text}");
    }
}

/// Everything that a process has open or mapped outside the system's folders.
fn touched(pid: u32) -> BTreeSet<String> {
    let maps = fs::read_to_string(format!("/proc/{pid}/maps")).unwrap();
    let mapped = maps.lines().filter_map(|line| line.find('/').map(|start| line[start..].to_owned()));
    let opened = fs::read_dir(format!("/proc/{pid}/fd")).unwrap().flatten();
    let opened =
        opened.filter_map(|entry| fs::read_link(entry.path()).ok()?.into_os_string().into_string().ok());
    mapped.chain(opened).filter(|path| path.starts_with('/')).collect()
}

/// Files, sockets and pipes below a folder.
fn things_below(folder: &Path) -> Vec<PathBuf> {
    let mut found = Vec::new();
    for entry in fs::read_dir(folder).unwrap().map(Result::unwrap) {
        if entry.file_type().unwrap().is_dir() {
            found.extend(things_below(&entry.path()));
        } else {
            found.push(entry.path());
        }
    }
    found
}

#[test]
fn members_and_root_see_the_stream_and_others_do_not() {
    let rig = Rig::new();
    let mut daemon = rig.daemon(&[]);
    for user in [MEMBER, ADMIN, ROOT, DAEMON] {
        assert_eq!(samples(&rig, user, 3).len(), 3);
    }
    let status = rig.client(MEMBER, &["status", "--json"]).json();
    assert_eq!(status["access"], "group");

    for arguments in [&["tail"][..], &["status"]] {
        let (code, error) = refusal(rig.client(FOREIGNER, arguments));
        assert_eq!(code, Some(77), "{error}");
        let stream = rig.stream();
        assert_has(&error, &[&stream.to_string_lossy(), "user 64100", "group 64100", "mode 2750"]);
        assert_has(&error, &["runs as user 64103", "usermod -aG 64100 64103"]);
    }
    let list = as_user(FOREIGNER).arg("ls").arg(rig.stream()).output().unwrap();
    assert!(!list.status.success(), "{list:?}");

    let touched = touched(daemon.id());
    let stream = rig.stream().join("iox");
    assert!(touched.iter().any(|path| path.starts_with(&*stream.to_string_lossy())), "{touched:#?}");
    let elsewhere: Vec<_> = touched
        .iter()
        .filter(|path| path.starts_with("/dev/shm") || path.starts_with("/tmp"))
        .filter(|path| !path.starts_with(&*rig.path("").to_string_lossy()))
        .collect();
    assert!(elsewhere.is_empty(), "{elsewhere:#?}");

    daemon.signal(rustix::process::Signal::TERM);
    assert!(daemon.wait().0.success());
    // iceoryx2 keeps one file of 16 bytes, whatever came and went.
    let left = things_below(&rig.stream());
    let kept =
        left.iter().filter(|path| path.extension().is_some_and(|extension| extension == "global_mgmt"));
    assert_eq!((left.len(), kept.count()), (1, 1), "{left:#?}");
}

#[test]
fn the_payload_is_read_only_for_members() {
    let rig = Rig::new();
    let _daemon = rig.daemon(&[]);
    // Everything is open when requests are answered.
    let (code, _, error) = rig.ask(MEMBER, "status");
    assert_eq!(code, Some(0), "{error}");
    let payload: Vec<_> = things_below(&rig.stream())
        .into_iter()
        .filter(|path| path.extension().is_some_and(|extension| extension == "data"))
        .filter(|path| fs::metadata(path).unwrap().uid() == DAEMON.id)
        .collect();
    assert!(payload.len() >= 3, "poses, states and replies: {payload:#?}");
    for path in &payload {
        assert_eq!(fs::metadata(path).unwrap().permissions().mode() & 0o777, 0o644, "{}", path.display());
        let may = |how: &str| {
            let script = format!("{how} {:?}", path.display());
            as_user(MEMBER).args(["sh", "-c", &script]).output().unwrap().status.success()
        };
        assert!(may("cat >/dev/null <"), "reading {}", path.display());
        assert!(!may(": >>"), "writing {}", path.display());
        assert!(!may("chmod 666"), "opening {}", path.display());
    }
    assert_eq!(samples(&rig, MEMBER, 3).len(), 3);
}

#[test]
fn changes_belong_to_their_own_group() {
    let rig = Rig::new();
    let daemon = rig.daemon(&["publish.control_group=\"64110\""]);
    assert_eq!(samples(&rig, MEMBER, 1).len(), 1);
    let control = rig.stream().join("control");
    let metadata = fs::metadata(&control).unwrap();
    assert_eq!((metadata.uid(), metadata.gid(), metadata.mode() & 0o777), (DAEMON.id, ADMINS, 0o750));

    for user in [MEMBER, ADMIN, ROOT] {
        let (code, answer, error) = rig.ask(user, "status");
        assert_eq!(code, Some(0), "{error}");
        assert_has(&answer, &["DONE", "reset epoch 0"]);
    }
    for command in ["reset-odometry", "pause", "stop-recording"] {
        let (code, answer, error) = rig.ask(MEMBER, command);
        assert_eq!((code, &*answer, error.lines().count()), (Some(77), "", 1), "{error}");
        assert_has(
            &error,
            &[&control.to_string_lossy(), "group 64110", "user 64101", "usermod -aG 64110 64101"],
        );
    }
    let resets = |user: User, epoch: u64| {
        let (code, answer, error) = rig.ask(user, "reset-odometry");
        assert_eq!(code, Some(0), "{error}");
        assert_has(&answer, &["DONE"]);
        let mut tail = rig.client(MEMBER, &["tail", "--json"]);
        while tail.json()["reset_epoch"] != epoch {}
    };
    resets(ADMIN, 1);
    resets(ROOT, 2);
    assert_eq!(rig.ask(FOREIGNER, "status").0, Some(77));
    drop(daemon);

    let _daemon = rig.daemon(&[]);
    // Without a group of their own they are for every member.
    resets(MEMBER, 1);
}

#[test]
fn a_killed_daemon_is_followed_by_the_next_one() {
    let rig = Rig::new();
    let mut daemon = rig.daemon(&[]);
    let mut tail = rig.client(MEMBER, &["tail", "--json", "--wait", "60"]);
    let before = tail.json()["boot_id"].clone();
    let inode = fs::metadata(rig.stream()).unwrap().ino();
    for _ in 0..3 {
        daemon.kill();
        daemon = rig.daemon(&[]);
    }
    let boot = samples(&rig, MEMBER, 1)[0]["boot_id"].clone();
    assert_ne!(boot, before);
    while tail.json()["boot_id"] != boot {}
    assert_eq!(fs::metadata(rig.stream()).unwrap().ino(), inode, "the folder is kept");
    daemon.kill();
    let (code, error) = refusal(rig.client(ROOT, &["tail"]));
    assert_eq!(code, Some(69), "{error}");
    assert_has(&error, &[&rig.stream().to_string_lossy()]);
}

#[test]
fn what_killed_members_leave_is_cleared_away_by_the_daemon() {
    let rig = Rig::new();
    let mut daemon = rig.daemon(&[]);
    let theirs = |user: User| {
        things_below(&rig.stream())
            .iter()
            .filter(|path| fs::metadata(path).is_ok_and(|m| m.uid() == user.id))
            .count()
    };
    for user in [MEMBER, ROOT] {
        let mut tail = rig.client(user, &["tail", "--json"]);
        tail.json();
        assert!(theirs(user) > 0);
        tail.kill();
        daemon.stderr_line_with("cleared away");
        // The publisher lets go of the connection with its next sample.
        let deadline = Instant::now() + DEADLINE;
        while theirs(user) > 0 {
            assert!(Instant::now() < deadline, "{:#?}", things_below(&rig.stream()));
        }
    }
    assert_eq!(samples(&rig, MEMBER, 3).len(), 3);
}

#[test]
fn folders_that_are_not_as_they_must_be_are_refused_with_the_command_that_mends_them() {
    let rig = Rig::without_stream_folder();
    let group = "publish.access=\"group\"";
    let stream = rig.stream();
    let mends = |error: &str| {
        let install = format!("sudo install -d -o 64100 -g 64100 -m 2750 {}", stream.display());
        assert_has(error, &[&install]);
    };
    let ended = |settings: &[&str]| {
        let (_, status, error) = rig.grnetd("run", Build::Packaged, DAEMON, settings).finish();
        (status.code(), error)
    };

    let (code, error) = ended(&[group]);
    assert_eq!(code, Some(77), "{error}");
    assert_has(&error, &["does not exist", "Permission denied"]);
    mends(&error);
    fs::create_dir(&stream).unwrap();
    let cases = [(0, MEMBERS, 0o2750), (DAEMON.id, MEMBER.group, 0o2750), (DAEMON.id, MEMBERS, 0o2775)];
    for (owner, owning_group, mode) in cases {
        rig.give(&stream, owner, owning_group, mode);
        let (code, error) = ended(&[group]);
        assert_eq!(code, Some(77), "{error}");
        let owner = if owner == 0 { "root (0)".to_owned() } else { owner.to_string() };
        assert_has(&error, &[&format!("a folder of user {owner}, group {owning_group}, mode {mode:04o}")]);
        mends(&error);
    }
    rig.give(&stream, DAEMON.id, MEMBERS, 0o2750);
    let (code, error) = ended(&[group, "publish.control_group=\"64999\""]);
    assert_eq!(code, Some(77), "{error}");
    assert_has(&error, &["giving it to group 64999 failed", "no member", "SupplementaryGroups=64999"]);
    let install = format!("sudo install -d -o 64100 -g 64999 -m 2750 {}", stream.join("control").display());
    assert_has(&error, &[&install]);

    let (code, error) = ended(&[group, "publish.control_group=\"no-such-group\""]);
    assert_eq!(code, Some(78), "{error}");
    assert_has(&error, &["publish.control_group", "groupadd --system no-such-group"]);

    let check = rig.grnetd("check", Build::Packaged, DAEMON, &[group]);
    let (out, status, error) = check.finish();
    assert!(status.success(), "{error}");
    let memory = out.iter().find(|line| line.starts_with("shared memory")).unwrap();
    assert_has(memory, &["MiB free in", &*stream.to_string_lossy()]);
}

#[test]
fn builds_that_cannot_join_say_so() {
    let rig = Rig::new();
    let ordinary = |user: User| {
        let mut client = rig.run(user, Build::Ordinary, "grnet-client");
        client.arg("tail").arg("--root").arg(rig.stream());
        Process::start(client)
    };
    let daemon = rig.daemon(&[]);
    let (code, error) = refusal(ordinary(MEMBER));
    assert_eq!(code, Some(78), "{error}");
    assert_has(&error, &["access = \"group\"", "built without it", "group-access"]);
    drop(daemon);

    for access in ["group", "everyone"] {
        let setting = format!("publish.access={access:?}");
        let (_, status, error) = rig.grnetd("run", Build::Ordinary, DAEMON, &[&setting]).finish();
        assert_eq!(status.code(), Some(78), "{error}");
        assert_has(&error, &["not part of this build", "packaged build"]);
    }
    let mut user = rig.grnetd("run", Build::Ordinary, DAEMON, &[]);
    user.stderr_line_with("publishing");
    let (code, error) = refusal(rig.client(DAEMON, &["tail"]));
    assert_eq!(code, Some(78), "{error}");
    assert_has(&error, &["access = \"user\"", "open to every local user"]);
    let (code, error) = refusal(ordinary(ROOT));
    assert_eq!(code, Some(77), "{error}");
    assert_has(&error, &["run as user 64100"]);
}

#[test]
fn access_by_user_is_closed_to_others_in_the_packaged_build_too() {
    let rig = Rig::without_stream_folder();
    fs::create_dir(rig.stream()).unwrap();
    rig.give(&rig.stream(), DAEMON.id, MEMBERS, 0o700);
    let mut daemon = rig.grnetd("run", Build::Packaged, DAEMON, &["publish.access=\"user\""]);
    daemon.stderr_line_with("publishing");
    assert_eq!(samples(&rig, DAEMON, 2).len(), 2);
    let (code, error) = refusal(rig.client(MEMBER, &["tail"]));
    assert_eq!(code, Some(77), "{error}");
    assert_has(&error, &["mode 0700", "run as user 64100"]);
    let touched = touched(daemon.id());
    assert!(!touched.iter().any(|path| path.starts_with("/dev/shm")), "{touched:#?}");
}

#[test]
fn another_version_is_named_before_anything_is_opened() {
    let rig = Rig::new();
    let announcement = rig.stream().join("front.grnet");
    fs::write(&announcement, "schema = 7\niceoryx2 = 0.11.3\ngrnet = 9.9.9\n").unwrap();
    fs::set_permissions(&announcement, fs::Permissions::from_mode(0o644)).unwrap();
    let held = fs::File::open(&announcement).unwrap();
    rustix::fs::flock(&held, rustix::fs::FlockOperation::LockExclusive).unwrap();
    for build in [Build::Packaged, Build::Ordinary] {
        let mut client = rig.run(MEMBER, build, "grnet-client");
        client.arg("tail").arg("--root").arg(rig.stream());
        let (code, error) = refusal(Process::start(client));
        assert_eq!(code, Some(78), "{error}");
        assert_has(&error, &["schema 7", "0.11.3", "9.9.9", "schema 1", "0.10.0"]);
    }
    drop(held);
    let (code, error) = refusal(rig.client(MEMBER, &["tail"]));
    assert_eq!(code, Some(69), "nobody holds it: {error}");
}

/// A stock Python subscriber that runs as `user`.
fn python(rig: &Rig, user: User) -> Command {
    // The environment's packages with the machine's Python: the environment itself may be closed to others.
    let site = rig.path("python");
    if !site.exists() {
        let venv = grnet_tests::venv_python();
        let find = "import iceoryx2, flatbuffers\nfor m in iceoryx2, flatbuffers: print(m.__path__[0])";
        let packages = Command::new(venv).args(["-c", find]).output().unwrap();
        let packages = String::from_utf8(packages.stdout).unwrap();
        fs::create_dir(&site).unwrap();
        let scripts = Path::new(env!("CARGO_MANIFEST_DIR")).join("python");
        let scripts = ["pose_tail.py", "grnet_messages.py"].map(|name| scripts.join(name));
        for from in packages.lines().map(PathBuf::from).chain(scripts) {
            assert!(Command::new("cp").arg("-r").arg(from).arg(&site).status().unwrap().success());
        }
        assert!(Command::new("chmod").args(["-R", "a+rX"]).arg(&site).status().unwrap().success());
    }
    let mut command = as_user(user);
    command.args(["env", "PYTHONDONTWRITEBYTECODE=1"]).arg(format!("PYTHONPATH={}", site.display()));
    command.arg("/usr/bin/python3").arg(site.join("pose_tail.py"));
    command.args(["--prefix", "iox2_", "--root"]).arg(rig.stream());
    command
}

#[test]
fn everyone_is_every_local_user() {
    let rig = Rig::without_stream_folder();
    let everyone = "publish.access=\"everyone\"";
    fs::create_dir(rig.stream()).unwrap();
    rig.give(&rig.stream(), DAEMON.id, MEMBERS, 0o755);
    let (_, status, error) = rig.grnetd("run", Build::Packaged, DAEMON, &[everyone]).finish();
    assert_eq!(status.code(), Some(77), "{error}");
    assert_has(&error, &["mode 0755", "-m 0777"]);
    rig.give(&rig.stream(), DAEMON.id, MEMBERS, 0o777);
    let mut daemon = rig.grnetd("run", Build::Packaged, DAEMON, &[everyone]);
    daemon.stderr_line_with("publishing");
    for user in [FOREIGNER, MEMBER, ROOT, DAEMON] {
        assert_eq!(samples(&rig, user, 3).len(), 3);
    }
    assert_eq!(rig.client(FOREIGNER, &["status", "--json"]).json()["access"], "everyone");
    let stock = |user: User| {
        let mut command = python(&rig, user);
        command.args(["--count", "3", "--timeout", "5"]);
        Process::start(command).finish()
    };
    let (out, status, error) = stock(DAEMON);
    assert!(status.success() && out.len() >= 3, "{out:?} {error}");
    // What a stock client adds to the shared memory is closed to the daemon of another user.
    let (out, status, error) = stock(FOREIGNER);
    assert_eq!((out.len(), status.code()), (0, Some(75)), "{error}");
    assert_eq!(samples(&rig, FOREIGNER, 3).len(), 3);
}

#[test]
fn a_client_that_may_not_attach_cannot_stop_the_stream() {
    let rig = Rig::without_stream_folder();
    fs::create_dir(rig.stream()).unwrap();
    rig.give(&rig.stream(), DAEMON.id, MEMBERS, 0o755);
    let mut daemon = rig.grnetd("run", Build::Ordinary, DAEMON, &["publish.access=\"user\""]);
    daemon.stderr_line_with("publishing");
    // Root may open everything, and what it opens is closed to the daemon.
    let mut command = python(&rig, ROOT);
    command.args(["--count", "1", "--timeout", "30"]);
    let _foreign = Process::start(command);
    daemon.stderr_line_with("clients cannot be reached");
    let mut tail = rig.run(DAEMON, Build::Ordinary, "grnet-client");
    tail.args(["tail", "--json", "--count", "40", "--root"]).arg(rig.stream());
    let mut tail = Process::start(tail);
    for _ in 0..40 {
        tail.json();
    }
}
