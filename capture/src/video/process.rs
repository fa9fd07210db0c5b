//! One run of the ffmpeg program: how it is called, what it gives, and that it never outlives its source.

use std::collections::VecDeque;
use std::fs::File;
use std::io::{self, BufReader, Read};
use std::os::unix::process::CommandExt as _;
use std::path::PathBuf;
use std::process::{Child, ChildStdout, Command, ExitStatus, Stdio};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use super::report::{Event, Parser, Summary};

/// Complaints that may wait to be read; a file of garbage makes more of them than anybody wants to know.
const MOST_WAITING: usize = 1000;

/// Kinds of files that hold a video themselves. Others name further files or addresses, such as playlists, and
/// ffmpeg would follow them.
const CONTAINERS: &str = "3g2,3gp,apng,asf,av1,avi,dirac,dv,flic,flv,gif,gxf,h261,h263,h264,hevc,ivf,live_flv,lvf,m4a,\
                          m4v,matroska,mj2,mjpeg,mjpeg_2000,mov,mp4,mpeg,mpegts,mpegvideo,mxf,nsv,nut,obu,ogg,rm,swf,vc1,\
                          vvc,webm,wtv,yuv4mpegpipe";

/// Longest line of ffmpeg that is looked at.
const MOST_LINE_BYTES: u64 = 4096;

/// What is to be decoded.
#[derive(Debug)]
pub(super) struct Invocation {
    pub program: PathBuf,
    pub file: File,
    pub start_at: u64,
    pub limit: Option<u64>,
}

impl Invocation {
    fn command(&self) -> io::Result<Command> {
        let cap = |index: u64| index.min(i64::MAX as u64);
        let end = self
            .limit
            .map(|limit| format!(":end_frame={}", cap(self.start_at.saturating_add(limit))))
            .unwrap_or_default();
        // Frames are numbered as decoded; showinfo tells each one's time and size just before it is written.
        let filters = format!(
            "trim=start_frame={}{end},scale=flags=bicubic+accurate_rnd+full_chroma_int,\
             format=pix_fmts=gray|rgb24,showinfo=checksum=0",
            cap(self.start_at)
        );
        let mut command = Command::new(&self.program);
        command
            .args(["-nostdin", "-hide_banner", "-nostats", "-loglevel", "repeat+level+info"])
            .args(["-protocol_whitelist", "file", "-format_whitelist", CONTAINERS, "-max_pixels", "67108864"])
            // A frame that is damaged is left out rather than made up; slices decode in step with the report.
            .args(["-err_detect", "explode+crccheck", "-fflags", "+discardcorrupt", "-thread_type", "slice"])
            // The file is opened here: its name cannot be taken for an option, a pattern or an address. ffmpeg opens
            // it again by this name, as it needs to go to and fro in it.
            .args(["-i", "file:/dev/stdin"])
            .args(["-map", "0:v:0", "-vf"])
            .arg(filters)
            .args(["-fps_mode", "passthrough", "-autoscale", "0", "-f", "rawvideo", "pipe:1"])
            .env_remove("FFREPORT")
            .env("AV_LOG_FORCE_NOCOLOR", "1")
            .stdin(self.file.try_clone()?)
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            // A key press on the terminal is for this process; it then ends ffmpeg.
            .process_group(0);
        Ok(command)
    }
}

/// Holds the running program; whoever has a copy can end it, and no other is started after that.
#[derive(Debug, Clone, Default)]
pub(super) struct Leash(Arc<Mutex<Leashed>>);

#[derive(Debug, Default)]
struct Leashed {
    child: Option<Child>,
    is_over: bool,
}

impl Leash {
    /// Ends the program, if one runs, and waits until it is gone.
    pub fn end(&self) {
        let mut leashed = self.lock();
        leashed.is_over = true;
        leashed.kill();
    }

    pub fn is_over(&self) -> bool {
        self.lock().is_over
    }

    fn lock(&self) -> MutexGuard<'_, Leashed> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Leashed {
    fn kill(&mut self) {
        if let Some(mut child) = self.child.take() {
            // Both fail only for a process that is gone already.
            let _ = child.kill();
            let _ = child.wait();
        }
    }
}

impl Drop for Leashed {
    fn drop(&mut self) {
        self.kill();
    }
}

/// The running program.
#[derive(Debug)]
pub(super) struct Run {
    leash: Leash,
    stdout: ChildStdout,
    events: Receiver<Event>,
    known: VecDeque<Event>,
    complaints: Arc<AtomicUsize>,
    summary: Arc<Mutex<Summary>>,
    /// The pipe has given less than a whole frame.
    is_cut: bool,
}

impl Run {
    /// Starts the program.
    ///
    /// # Errors
    /// When there is none, in words, or when the leash is over.
    pub fn start(invocation: &Invocation, leash: &Leash) -> Result<Self, String> {
        let mut leashed = leash.lock();
        if leashed.is_over {
            return Err("it is being closed".into());
        }
        leashed.kill();
        let program = invocation.program.display();
        let mut child = invocation.command().and_then(|mut command| command.spawn()).map_err(|error| match error.kind() {
            io::ErrorKind::NotFound => format!(
                "videos are read through the program ffmpeg, and {program} is not there: install it (Debian: apt \
                 install ffmpeg), or play a folder of images"
            ),
            _ => format!("the program {program} cannot be started: {error}"),
        })?;
        let (stdout, stderr) = (child.stdout.take(), child.stderr.take());
        leashed.child = Some(child);
        let (Some(stdout), Some(stderr)) = (stdout, stderr) else {
            return Err(format!("the program {program} has no pipes"));
        };
        let (sender, events) = channel();
        let complaints = Arc::new(AtomicUsize::new(0));
        let summary = Arc::new(Mutex::new(Summary::default()));
        let theirs = (Arc::clone(&complaints), Arc::clone(&summary));
        std::thread::Builder::new()
            .name("video-report".into())
            .spawn(move || listen(stderr, &sender, &theirs.0, &theirs.1))
            .map_err(|error| format!("cannot start its thread: {error}"))?;
        let known = VecDeque::new();
        Ok(Self { leash: leash.clone(), stdout, events, known, complaints, summary, is_cut: false })
    }

    /// The next thing that the program tells; `None` when it has ended.
    pub fn event(&mut self) -> Option<Event> {
        if self.is_cut {
            return None;
        }
        let event = self.known.pop_front().or_else(|| self.events.recv().ok())?;
        if !matches!(event, Event::Frame(_)) {
            self.complaints.fetch_sub(1, Ordering::Relaxed);
        }
        Some(event)
    }

    /// What the program has told already and nobody has taken.
    pub fn known(&mut self) -> &VecDeque<Event> {
        self.known.extend(self.events.try_iter());
        &self.known
    }

    /// Waits until something more is known; false when the program has ended.
    pub fn wait(&mut self) -> bool {
        let event = self.events.recv();
        let is_more = event.is_ok();
        self.known.extend(event);
        is_more
    }

    /// The pixels of the frame that was told last.
    pub fn pixels(&mut self, length_bytes: usize) -> Option<Vec<u8>> {
        let mut pixels = vec![0; length_bytes];
        self.is_cut = self.stdout.read_exact(&mut pixels).is_err();
        (!self.is_cut).then_some(pixels)
    }

    /// Passes over the pixels of the frame that was told last.
    pub fn pass(&mut self, length_bytes: usize) {
        let passed = io::copy(&mut Read::by_ref(&mut self.stdout).take(length_bytes as u64), &mut io::sink());
        self.is_cut = passed.ok() != Some(length_bytes as u64);
    }

    /// What was told about the file so far.
    pub fn summary(&self) -> Summary {
        self.summary.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// Waits for the end; what went wrong, if something did.
    pub fn finish(self) -> Option<String> {
        let Self { leash, stdout, is_cut, summary, .. } = self;
        // Nobody reads any more: it must not wait for that.
        drop(stdout);
        let child = leash.lock().child.take();
        let status = child.and_then(|mut child| child.wait().ok());
        let last = summary.lock().unwrap_or_else(PoisonError::into_inner).last_error();
        match (is_cut, status.as_ref().is_some_and(ExitStatus::success)) {
            (false, true) => None,
            (true, _) => Some(last.unwrap_or_else(|| "ffmpeg stopped in the middle of a frame".into())),
            (false, false) => Some(last.unwrap_or_else(|| match status {
                Some(status) => format!("ffmpeg ended with {status}"),
                None => "ffmpeg was ended".into(),
            })),
        }
    }
}

/// Reads what the program says until it closes its end.
fn listen(stderr: impl Read, events: &Sender<Event>, complaints: &AtomicUsize, summary: &Mutex<Summary>) {
    let mut lines = Lines(BufReader::new(stderr));
    let mut parser = Parser::default();
    while let Some(line) = lines.next() {
        let event = {
            let mut summary = summary.lock().unwrap_or_else(PoisonError::into_inner);
            parser.line(&line, &mut summary)
        };
        match event {
            Some(event @ Event::Frame(_)) => {
                // Nobody listens any more: read on, so that the program does not wait.
                let _ = events.send(event);
            }
            Some(event) => {
                if complaints.fetch_add(1, Ordering::Relaxed) < MOST_WAITING {
                    let _ = events.send(event);
                } else {
                    complaints.fetch_sub(1, Ordering::Relaxed);
                }
            }
            None => {}
        }
    }
}

/// Lines that need not be UTF-8; a longer one than is reasonable comes in pieces.
struct Lines<R>(BufReader<R>);

impl<R: Read> Lines<R> {
    fn next(&mut self) -> Option<String> {
        use std::io::BufRead as _;
        let mut line = Vec::new();
        let read = Read::by_ref(&mut self.0).take(MOST_LINE_BYTES).read_until(b'\n', &mut line).ok()?;
        (read > 0).then(|| String::from_utf8_lossy(&line).trim_end().to_owned())
    }
}
