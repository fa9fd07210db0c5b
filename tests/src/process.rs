//! A child process whose output can be waited for.

use std::io::{BufRead as _, BufReader, Read};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::mpsc::{Receiver, RecvTimeoutError, channel};
use std::time::{Duration, Instant};

use rustix::process::{Pid, Signal, kill_process};
use serde_json::Value;

/// No event of a test takes this long unless something is broken.
pub const DEADLINE: Duration = Duration::from_secs(60);

/// A running program; it is killed when the test ends before it does.
#[derive(Debug)]
pub struct Process {
    child: Child,
    name: String,
    stdout: Receiver<String>,
    stderr: Receiver<String>,
    seen: Vec<String>,
}

impl Process {
    /// Starts `command` with its output piped to the test.
    pub fn start(mut command: Command) -> Self {
        let name = format!("{command:?}");
        let mut child = command
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap_or_else(|error| panic!("{name}: {error}"));
        let stdout = lines(child.stdout.take().unwrap());
        let stderr = lines(child.stderr.take().unwrap());
        Self { child, name, stdout, stderr, seen: Vec::new() }
    }

    /// The next line on standard output; panics with everything seen when none comes.
    pub fn line(&mut self) -> String {
        match self.stdout.recv_timeout(DEADLINE) {
            Ok(line) => {
                self.seen.push(line.clone());
                line
            }
            Err(error) => self.fail(&format!("no line on stdout ({error})")),
        }
    }

    /// The next line on standard output as JSON.
    pub fn json(&mut self) -> Value {
        let line = self.line();
        serde_json::from_str(&line).unwrap_or_else(|error| self.fail(&format!("not JSON ({error}): {line}")))
    }

    /// Waits for a line on standard error that contains `text`, and gives it.
    pub fn stderr_line_with(&mut self, text: &str) -> String {
        let deadline = Instant::now() + DEADLINE;
        loop {
            match self.stderr.recv_timeout(deadline.saturating_duration_since(Instant::now())) {
                Ok(line) => {
                    self.seen.push(line.clone());
                    if line.contains(text) {
                        return line;
                    }
                }
                Err(error) => self.fail(&format!("no line with '{text}' on stderr ({error})")),
            }
        }
    }

    /// Lines on standard output until it closes, then the exit status and standard error.
    pub fn finish(mut self) -> (Vec<String>, ExitStatus, String) {
        let mut out = Vec::new();
        let deadline = Instant::now() + DEADLINE;
        loop {
            match self.stdout.recv_timeout(deadline.saturating_duration_since(Instant::now())) {
                Ok(line) => out.push(line),
                Err(RecvTimeoutError::Disconnected) => break,
                Err(RecvTimeoutError::Timeout) => self.fail("standard output stays open"),
            }
        }
        let mut err = std::mem::take(&mut self.seen);
        while let Ok(line) = self.stderr.recv_timeout(deadline.saturating_duration_since(Instant::now())) {
            err.push(line);
        }
        let status = self.child.wait().unwrap();
        (out, status, err.join("\n"))
    }

    /// Sends a signal.
    pub fn signal(&self, which: Signal) {
        signal(self.child.id(), which);
    }

    /// Kills it as the kernel would, and waits until it is gone.
    pub fn kill(&mut self) {
        self.signal(Signal::KILL);
        self.child.wait().unwrap();
    }

    /// The process id.
    pub fn id(&self) -> u32 {
        self.child.id()
    }

    /// Waits until it has ended, and says how long that took.
    pub fn wait(&mut self) -> (ExitStatus, Duration) {
        let started = Instant::now();
        let deadline = started + DEADLINE;
        loop {
            if let Some(status) = self.child.try_wait().unwrap() {
                return (status, started.elapsed());
            }
            if Instant::now() > deadline {
                self.fail("it does not end");
            }
            // A process has no event to wait for without a signal handler of our own.
            std::thread::sleep(Duration::from_millis(5));
        }
    }

    fn fail(&mut self, what: &str) -> ! {
        let _ = self.child.kill();
        let _ = self.child.wait();
        let stderr: Vec<String> = self.stderr.iter().collect();
        panic!("{}: {what}\nseen:\n{}\nstderr:\n{}", self.name, self.seen.join("\n"), stderr.join("\n"));
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        // Asked first, so that shared memory is given back; a process that was stopped or hangs is killed.
        if matches!(self.child.try_wait(), Ok(None)) {
            self.signal(Signal::CONT);
            self.signal(Signal::TERM);
            let deadline = Instant::now() + Duration::from_secs(2);
            while matches!(self.child.try_wait(), Ok(None)) && Instant::now() < deadline {
                std::thread::sleep(Duration::from_millis(5));
            }
        }
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Sends a signal to a process by its id.
pub fn signal(id: u32, which: Signal) {
    let pid = Pid::from_raw(i32::try_from(id).unwrap()).unwrap();
    kill_process(pid, which).unwrap();
}

fn lines(stream: impl Read + Send + 'static) -> Receiver<String> {
    let (sender, receiver) = channel();
    std::thread::spawn(move || {
        for line in BufReader::new(stream).lines().map_while(Result::ok) {
            if sender.send(line).is_err() {
                break;
            }
        }
    });
    receiver
}
