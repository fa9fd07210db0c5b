//! Run folders and processes: kills, a full disk, two trainings in one folder, Ctrl-C.
//!
//! The other process is this test program, with one of the tests marked "a part": they do what their name says in the
//! folder that [`FOLDER`] names.

use std::collections::BTreeMap;
use std::fs;
use std::io::{BufRead, BufReader, Read};
use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::atomic::Ordering;
use std::time::Duration;

use grnet_train::run::{LogEntry, RunError, RunFolder, RunIdentity, State, StateTensor, stop_flag};
use rand::{Rng, SeedableRng};
use rustix::process::{Pid, Signal, kill_process};

const FOLDER: &str = "GRNET_TEST_FOLDER";
const KILLS: usize = 30;

fn identity() -> RunIdentity {
    RunIdentity {
        config_toml: "a = 1\n".into(),
        seed: 1,
        fingerprint: "f".into(),
        threads: 1,
        ..Default::default()
    }
}

/// A state whose every value follows from its step, of 400 kB: writing it takes a while.
fn state(step: u64) -> State {
    let tensor = StateTensor { shape: vec![100_000], values: vec![step as f32; 100_000] };
    State { step, stage: 0, tensors: BTreeMap::from([("w".into(), tensor)]), numbers: BTreeMap::new() }
}

fn entry(step: u64) -> LogEntry {
    LogEntry { step, stage: "s".into(), loss: Some(step as f64), ..LogEntry::default() }
}

/// None: somebody runs the parts by themselves.
fn folder() -> Option<PathBuf> {
    std::env::var_os(FOLDER).map(PathBuf::from)
}

fn part(name: &str, folder: &Path) -> Command {
    let mut command = Command::new(std::env::current_exe().unwrap());
    command.args(["--ignored", "--exact", "--nocapture", "--test-threads=1", name]).env(FOLDER, folder);
    command.stdout(Stdio::piped());
    command
}

/// Reads up to a line that begins with `start`, and gives what comes after it.
fn wait_for(out: &mut impl BufRead, start: &str) -> String {
    let mut line = String::new();
    loop {
        line.clear();
        assert_ne!(out.read_line(&mut line).unwrap(), 0, "the process ended without {start:?}");
        // The test harness writes the test's name without an end of line before it.
        if let Some((_, rest)) = line.trim_end().split_once(start) {
            return rest.to_owned();
        }
    }
}

fn signal(child: &Child, signal: Signal) {
    kill_process(Pid::from_child(child), signal).unwrap();
}

#[test]
#[ignore = "a part"]
fn part_trains_until_it_is_killed() {
    let Some(folder) = folder() else { return };
    let mut run = RunFolder::resume(&folder, &identity()).unwrap();
    let mut step = run.load_state().unwrap().map_or(0, |state| state.step);
    run.truncate_log(step).unwrap();
    loop {
        step += 1;
        run.log(&entry(step)).unwrap();
        run.save_state(&state(step)).unwrap();
        println!("saved {step}");
    }
}

#[test]
fn a_kill_at_any_moment_leaves_a_good_state_and_log() {
    let folder = tempfile::tempdir().unwrap();
    drop(RunFolder::create(folder.path(), &identity()).unwrap());
    let mut random = rand::rngs::StdRng::seed_from_u64(7);
    let mut reached = 0;
    for _ in 0..KILLS {
        let mut child = part("part_trains_until_it_is_killed", folder.path()).spawn().unwrap();
        let mut out = BufReader::new(child.stdout.take().unwrap());
        let mut saved: u64 = wait_for(&mut out, "saved ").parse().unwrap();
        assert!(saved > reached, "{saved} after {reached}");
        // Somewhere in the next saves.
        std::thread::sleep(Duration::from_micros(random.random_range(0..8000)));
        child.kill().unwrap();
        child.wait().unwrap();
        let mut rest = String::new();
        out.read_to_string(&mut rest).unwrap();
        let complete = rest.split_inclusive('\n').filter(|line| line.ends_with('\n'));
        if let Some(last) = complete.filter_map(|line| line.trim_end().strip_prefix("saved ")).next_back() {
            saved = last.parse().unwrap();
        }
        let run = RunFolder::resume(folder.path(), &identity()).unwrap();
        let found = run.load_state_with(|warning| panic!("{warning}")).unwrap().unwrap();
        assert!(found.step == saved || found.step == saved + 1, "{} after {saved}", found.step);
        assert_eq!(found, state(found.step));
        let logged: Vec<u64> = run.read_log().unwrap().iter().map(|entry| entry.step).collect();
        assert!(logged.len() as u64 >= found.step, "{} entries", logged.len());
        assert!(logged.iter().copied().eq(1..=logged.len() as u64), "{logged:?}");
        reached = found.step;
    }
}

#[test]
#[ignore = "a part"]
fn part_opens_the_folder() {
    let Some(folder) = folder() else { return };
    match RunFolder::resume(&folder, &identity()) {
        Ok(_) => println!("opened"),
        Err(error) => println!("refused {error}"),
    }
}

#[test]
fn two_processes_never_train_in_one_folder() {
    let folder = tempfile::tempdir().unwrap();
    let run = RunFolder::create(folder.path(), &identity()).unwrap();
    let answer = |start: &str| {
        let mut child = part("part_opens_the_folder", folder.path()).spawn().unwrap();
        let mut out = BufReader::new(child.stdout.take().unwrap());
        let answer = wait_for(&mut out, start);
        // To its end, as the harness goes on to print.
        out.read_to_string(&mut String::new()).unwrap();
        child.wait().unwrap();
        answer
    };
    let refusal = answer("refused ");
    assert!(refusal.contains(&format!("process {} is training", std::process::id())), "{refusal}");
    drop(run);
    answer("opened");
}

#[test]
fn a_full_disk_spares_the_state_that_is_there() {
    let folder = tempfile::tempdir().unwrap();
    let run = RunFolder::create(folder.path(), &identity()).unwrap();
    run.save_state(&state(1)).unwrap();
    run.save_state(&state(2)).unwrap();
    // Whatever is written there finds no room.
    symlink("/dev/full", folder.path().join("state.safetensors.partial")).unwrap();
    let error = run.save_state(&state(3)).unwrap_err();
    let RunError::NoSpace { needed_bytes, .. } = &error else { panic!("{error}") };
    assert!((400_000..401_000).contains(needed_bytes), "{needed_bytes}");
    let text = error.to_string();
    assert!(text.contains("state.safetensors") && text.contains(&needed_bytes.to_string()), "{text}");
    assert!(text.contains("are free") && text.contains("--resume"), "{text}");
    assert_eq!(run.load_state().unwrap().unwrap(), state(2));
    assert!(!folder.path().join("state.safetensors.partial").exists());
    run.save_state(&state(3)).unwrap();
    assert_eq!(run.load_state().unwrap().unwrap(), state(3));
}

#[test]
#[ignore = "a part"]
fn part_writes_until_there_is_no_room() {
    let Some(folder) = folder() else { return };
    let mut run = RunFolder::resume(&folder, &identity()).unwrap();
    let state = run.save_state(&state(9)).unwrap_err();
    println!("state {state}");
    let failed = (1..).find_map(|step| Some((step, run.log(&entry(step)).err()?)));
    let (step, error) = failed.unwrap();
    println!("log {step} {error}");
}

#[test]
fn a_limit_of_size_is_told_and_the_log_ends_with_a_whole_line() {
    let folder = tempfile::tempdir().unwrap();
    let run = RunFolder::create(folder.path(), &identity()).unwrap();
    run.save_state(&state(1)).unwrap();
    drop(run);
    let part = part("part_writes_until_there_is_no_room", folder.path());
    // 16 blocks of 512 bytes; without the signal, writes fail instead of killing.
    let mut shell = Command::new("sh");
    shell.args(["-c", "trap '' XFSZ; ulimit -f 16; exec \"$@\"", "sh"]);
    shell.arg(part.get_program()).args(part.get_args()).env(FOLDER, folder.path()).stdout(Stdio::piped());
    let mut child = shell.spawn().unwrap();
    let mut out = BufReader::new(child.stdout.take().unwrap());
    let state_error = wait_for(&mut out, "state ");
    assert!(
        state_error.starts_with("no room for") && state_error.contains("bytes are to be written"),
        "{state_error}"
    );
    let log_error = wait_for(&mut out, "log ");
    let (step, log_error) = log_error.split_once(' ').unwrap();
    assert!(log_error.starts_with("no room for") && log_error.contains("log.jsonl"), "{log_error}");
    out.read_to_string(&mut String::new()).unwrap();
    assert!(child.wait().unwrap().success());
    let text = fs::read_to_string(folder.path().join("log.jsonl")).unwrap();
    assert!(text.ends_with("}\n"), "{text}");
    let run = RunFolder::resume(folder.path(), &identity()).unwrap();
    assert_eq!(run.read_log().unwrap().len() as u64, step.parse::<u64>().unwrap() - 1);
    assert_eq!(run.load_state().unwrap().unwrap(), state(1));
}

#[test]
#[ignore = "a part"]
fn part_waits_for_signals() {
    let Some(_) = folder() else { return };
    let stop = stop_flag();
    println!("ready");
    while !stop.load(Ordering::Relaxed) {
        std::thread::sleep(Duration::from_millis(1));
    }
    println!("asked");
    loop {
        std::thread::park();
    }
}

#[test]
fn the_first_signal_asks_and_the_second_ends() {
    for (first, second, code) in
        [(Signal::INT, Signal::INT, 130), (Signal::TERM, Signal::TERM, 143), (Signal::INT, Signal::TERM, 143)]
    {
        let folder = tempfile::tempdir().unwrap();
        let mut child = part("part_waits_for_signals", folder.path()).spawn().unwrap();
        let mut out = BufReader::new(child.stdout.take().unwrap());
        wait_for(&mut out, "ready");
        signal(&child, first);
        wait_for(&mut out, "asked");
        signal(&child, second);
        assert_eq!(child.wait().unwrap().code(), Some(code));
    }
}
