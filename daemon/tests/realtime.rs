//! `[realtime]` as the kernel has it, and what is said when it refuses.

mod rig;

use std::collections::BTreeMap;
use std::process::{Command, Stdio};

use rig::{Daemon, Rig};
use rustix::process::Signal;

/// A program that takes the rights away which no limit holds for, and then the limits.
const POWERLESS: &[&str] = &["prlimit", "--rtprio=0", "--memlock=65536", "--nice=0"];

fn succeeds(words: &[&str]) -> bool {
    Command::new(words[0])
        .args(&words[1..])
        .stderr(Stdio::null())
        .status()
        .is_ok_and(|status| status.success())
}

/// Root keeps what its limits forbid, unless the capabilities go as well.
fn powerless() -> Vec<&'static str> {
    let drop = ["setpriv", "--bounding-set=-sys_nice,-ipc_lock", "--inh-caps=-sys_nice,-ipc_lock"];
    let words: Vec<_> = if rustix::process::geteuid().is_root() { drop.to_vec() } else { Vec::new() };
    words.into_iter().chain(POWERLESS.iter().copied()).collect()
}

/// Name of each thread: (policy, real-time priority, nice, CPUs allowed).
fn threads(pid: u32) -> BTreeMap<String, (u32, u32, i32, String)> {
    let mut threads = BTreeMap::new();
    for task in std::fs::read_dir(format!("/proc/{pid}/task")).unwrap() {
        let task = task.unwrap().path();
        let read = |name: &str| std::fs::read_to_string(task.join(name)).unwrap();
        let stat = read("stat");
        // Behind the name in brackets, which may hold anything, field 3 of proc(5) comes first.
        let fields: Vec<&str> = stat.rsplit_once(") ").unwrap().1.split(' ').collect();
        let field = |number: usize| fields[number - 3];
        let status = read("status");
        let cpus = status
            .lines()
            .find_map(|line| line.strip_prefix("Cpus_allowed_list:"))
            .unwrap()
            .trim()
            .to_owned();
        let numbers =
            (field(41).parse().unwrap(), field(40).parse().unwrap(), field(19).parse().unwrap(), cpus);
        threads.insert(read("comm").trim().to_owned(), numbers);
    }
    threads
}

fn locked_kib(pid: u32) -> u64 {
    let status = std::fs::read_to_string(format!("/proc/{pid}/status")).unwrap();
    let line = status.lines().find_map(|line| line.strip_prefix("VmLck:")).unwrap();
    line.trim().trim_end_matches(" kB").trim().parse().unwrap()
}

/// By its limit, or by the capability CAP_IPC_LOCK.
fn may_lock_memory() -> bool {
    let status = std::fs::read_to_string("/proc/self/status").unwrap();
    let capabilities = status.lines().find_map(|line| line.strip_prefix("CapEff:")).unwrap().trim();
    let may = u64::from_str_radix(capabilities, 16).unwrap() & 1 << 14 != 0;
    may || rustix::process::getrlimit(rustix::process::Resource::Memlock).current.is_none()
}

fn first_cpu() -> String {
    let status = std::fs::read_to_string("/proc/self/status").unwrap();
    let list =
        status.lines().find_map(|line| line.strip_prefix("Cpus_allowed_list:")).unwrap().trim().to_owned();
    list.split([',', '-']).next().unwrap().to_owned()
}

const ASKED: &str =
    "[realtime]\ncapture_priority = 12\nworker_priority = 11\npublish_priority = 13\nlock_memory = true\n";

#[test]
fn threads_are_scheduled_as_configured() {
    let rig = Rig::new(4);
    let cpu = first_cpu();
    let rest = format!("nice = 3\ncpus = [{cpu}]\nworker_cpus = [{cpu}]\n");
    rig.write("grnetd.toml", &(rig.config_text() + ASKED + &rest));
    let mut daemon = Daemon::start(&rig, &["--set", "source.loop=true"]);
    daemon.wait_for_line("ready");
    let threads = threads(daemon.id());
    for (name, (_, _, nice, cpus)) in &threads {
        assert_eq!((nice, cpus), (&3, &cpu), "{name}");
    }
    // Some containers keep real-time scheduling from root, too: it is then refused by name.
    let fifo = succeeds(&["chrt", "--fifo", "10", "true"]);
    for (name, priority) in
        [("capture", 12), ("worker", 11), ("publish", 13), ("helper-0", 11), ("control", 0)]
    {
        let (policy, got, ..) = threads[name];
        assert_eq!((policy, got), if fifo && priority > 0 { (1, priority) } else { (0, 0) }, "{name}");
    }
    let memory = may_lock_memory();
    assert_eq!(locked_kib(daemon.id()) > 10_000, memory);
    daemon.signal(Signal::TERM);
    let ended = daemon.wait();
    assert_eq!(ended.code, 0, "{}", ended.stderr);
    assert_eq!(ended.stderr.contains("was refused"), !(fifo && memory), "{}", ended.stderr);
}

#[test]
fn a_refusal_is_said_and_the_daemon_goes_on_without() {
    let rig = Rig::new(4);
    rig.write("grnetd.toml", &(rig.config_text() + ASKED + "nice = -5\ncpus = [1023]\n"));
    let mut daemon = Daemon::start_as(&powerless(), &rig, &["--set", "source.loop=true"], &[]);
    daemon.wait_for_line("ready");
    assert_eq!(threads(daemon.id())["worker"].0, 0);
    assert_eq!(locked_kib(daemon.id()), 0);
    let node = rig.node_when_up();
    let statuses = rig.open_status(&node);
    let status = loop {
        if let Some(status) = statuses.receive().unwrap() {
            break status;
        }
        statuses.wait(std::time::Duration::from_secs(1)).unwrap();
    };
    assert_eq!(status.error_count, 6, "{}", status.last_error);
    drop((statuses, node));
    daemon.signal(Signal::TERM);
    let ended = daemon.wait();
    assert_eq!(ended.code, 0, "{}", ended.stderr);
    for said in [
        "realtime.capture_priority = 12 (SCHED_FIFO) was refused",
        "realtime.worker_priority = 11",
        "realtime.publish_priority = 13",
        "LimitRTPRIO=12",
        "RLIMIT_RTPRIO is 0",
        "LimitMEMLOCK=infinity",
        "RLIMIT_MEMLOCK is 65536",
        "LimitNICE=-5",
        "realtime.cpus = [1023]",
    ] {
        assert!(ended.stderr.contains(said), "{said}: {}", ended.stderr);
    }
}

#[test]
fn a_required_setting_that_is_refused_ends_the_start_with_77() {
    let rig = Rig::new(4);
    rig.write("grnetd.toml", &(rig.config_text() + ASKED + "required = true\n"));
    let ended = Daemon::start_as(&powerless(), &rig, &[], &[]).wait();
    assert_eq!(ended.code, 77, "{}", ended.stderr);
    assert!(ended.stderr.contains("LimitRTPRIO=") && !ended.stderr.contains("ready"), "{}", ended.stderr);
    assert!(!rig.root().join("services").exists());

    let words = powerless();
    let check = |text: &str| {
        rig.write("grnetd.toml", &(rig.config_text() + ASKED + text));
        let mut command = Command::new(words[0]);
        command.args(&words[1..]).arg(env!("CARGO_BIN_EXE_grnetd")).args([
            "check",
            "--config",
            &rig.config(),
        ]);
        let output = command.output().unwrap();
        let text = [output.stdout, output.stderr].map(|bytes| String::from_utf8(bytes).unwrap()).concat();
        (output.status.code(), text)
    };
    let (code, text) = check("required = true\n");
    assert!(code == Some(77) && text.contains("LimitRTPRIO="), "{text}");
    let (code, text) = check("");
    assert_eq!(code, Some(0), "{text}");
    assert!(
        text.contains("worker at SCHED_FIFO 11") && text.contains("REFUSED: realtime.lock_memory"),
        "{text}"
    );
}
