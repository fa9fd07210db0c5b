//! How far a stage is: a bar for people, plain lines for the logs of a service.

use std::io::{self, IsTerminal, Write};
use std::time::{Duration, Instant};

use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};

/// Time between the lines on a pipe.
const LINE_EVERY: Duration = Duration::from_secs(10);
/// Speeds are measured over at least this time.
const SPEED_OVER: Duration = Duration::from_secs(5);

/// What one step did.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Update {
    /// Steps of the stage that are done.
    pub done: u64,
    /// Frames trained on in this step.
    pub frames: u64,
    /// The loss.
    pub loss: f64,
}

/// Shows loss, frames per second and time left of one stage.
pub struct Progress {
    stage: String,
    steps: u64,
    speed: Speed,
    display: Display,
}

enum Display {
    Bar(ProgressBar),
    Lines { out: Box<dyn Write + Send>, every: Duration, last: Option<Instant> },
}

impl Progress {
    /// A bar on the standard error stream when that is a terminal, else a line every ten seconds. `done` of the stage's
    /// `steps` were done before.
    pub fn new(stage: &str, steps: u64, done: u64) -> Self {
        let display = match io::stderr().is_terminal() {
            true => Display::Bar(bar(stage, steps, done)),
            false => Display::Lines { out: Box::new(io::stderr()), every: LINE_EVERY, last: None },
        };
        Self { stage: stage.into(), steps, speed: Speed::new(done, Instant::now()), display }
    }

    /// Lines to `out`, at most one in `every`.
    pub fn lines(stage: &str, steps: u64, done: u64, out: Box<dyn Write + Send>, every: Duration) -> Self {
        let display = Display::Lines { out, every, last: None };
        Self { stage: stage.into(), steps, speed: Speed::new(done, Instant::now()), display }
    }

    /// Tells of a step.
    pub fn step(&mut self, update: Update) {
        self.step_at(update, Instant::now());
    }

    /// Writes a line above the bar, or between the lines.
    pub fn say(&mut self, text: &str) {
        match &mut self.display {
            Display::Bar(bar) => bar.suspend(|| eprintln!("{text}")),
            Display::Lines { out, .. } => put(out, text),
        }
    }

    /// Ends the display; what it showed last stays.
    pub fn finish(self) {
        if let Display::Bar(bar) = self.display {
            bar.abandon();
        }
    }

    fn step_at(&mut self, update: Update, now: Instant) {
        self.speed.add(update, now);
        match &mut self.display {
            Display::Bar(bar) => {
                bar.set_position(update.done);
                bar.set_message(text(update.loss, &self.speed, self.steps));
            }
            Display::Lines { out, every, last } => {
                let due = last.is_none_or(|last| now.duration_since(last) >= *every);
                if due || update.done >= self.steps {
                    *last = Some(now);
                    let (done, steps) = (update.done, self.steps);
                    let share = 100.0 * done as f64 / steps.max(1) as f64;
                    let text = text(update.loss, &self.speed, steps);
                    put(out, &format!("{}: step {done}/{steps} ({share:.1} %), {text}", self.stage));
                }
            }
        }
    }
}

fn bar(stage: &str, steps: u64, done: u64) -> ProgressBar {
    // Redrawn at most this often per second, however fast the steps are.
    let bar = ProgressBar::with_draw_target(Some(steps), ProgressDrawTarget::stderr_with_hz(5));
    let style = ProgressStyle::with_template("{prefix} {wide_bar} {pos}/{len} {msg}");
    bar.set_style(style.unwrap_or_else(|_| ProgressStyle::default_bar()));
    bar.set_prefix(stage.to_owned());
    bar.set_position(done);
    bar
}

/// Progress is a courtesy: a reader that went away does not end a training.
fn put(out: &mut dyn Write, text: &str) {
    let _ = writeln!(out, "{text}").and_then(|()| out.flush());
}

fn text(loss: f64, speed: &Speed, steps: u64) -> String {
    let mut text = format!("loss {loss:.4}");
    if let Some(frames_per_s) = speed.frames_per_s() {
        text += &format!(", {frames_per_s:.1} frames/s");
    }
    if let Some(left) = speed.time_left(steps) {
        text += &format!(", {} left", duration(left));
    }
    text
}

/// A duration in two units at most.
fn duration(time: Duration) -> String {
    let seconds = time.as_secs_f64().round() as u64;
    match (seconds / 86_400, seconds / 3600 % 24, seconds / 60 % 60, seconds % 60) {
        (0, 0, 0, s) => format!("{s} s"),
        (0, 0, m, s) => format!("{m} min {s} s"),
        (0, h, m, _) => format!("{h} h {m} min"),
        (d, h, ..) => format!("{d} d {h} h"),
    }
}

/// Speed over the last few seconds: that of an hour ago, or of a slow first step, says nothing about the next.
struct Speed {
    /// Where the measured stretch begins, and the one after it.
    marks: [Mark; 2],
    now: Mark,
}

#[derive(Clone, Copy)]
struct Mark {
    at: Instant,
    done: u64,
    frames: u64,
}

impl Speed {
    fn new(done: u64, at: Instant) -> Self {
        let mark = Mark { at, done, frames: 0 };
        Self { marks: [mark; 2], now: mark }
    }

    fn add(&mut self, update: Update, at: Instant) {
        self.now = Mark { at, done: update.done, frames: self.now.frames + update.frames };
        if at.duration_since(self.marks[1].at) >= SPEED_OVER {
            self.marks = [self.marks[1], self.now];
        }
    }

    fn elapsed_s(&self) -> Option<f64> {
        Some(self.now.at.duration_since(self.marks[0].at).as_secs_f64()).filter(|s| *s > 0.0)
    }

    fn frames_per_s(&self) -> Option<f64> {
        Some((self.now.frames - self.marks[0].frames) as f64 / self.elapsed_s()?)
    }

    fn time_left(&self, steps: u64) -> Option<Duration> {
        let done = self.now.done.checked_sub(self.marks[0].done).filter(|done| *done > 0)?;
        let step_s = self.elapsed_s()? / done as f64;
        Duration::try_from_secs_f64(step_s * steps.saturating_sub(self.now.done) as f64).ok()
    }
}

#[cfg(test)]
mod tests {
    use std::sync::{Arc, Mutex};

    use super::*;

    #[derive(Clone, Default)]
    struct Pipe(Arc<Mutex<Vec<u8>>>);

    impl Write for Pipe {
        fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
            self.0.lock().unwrap().write(bytes)
        }

        fn flush(&mut self) -> io::Result<()> {
            Ok(())
        }
    }

    #[test]
    fn a_pipe_gets_plain_lines_now_and_then() {
        let pipe = Pipe::default();
        let mut progress = Progress::lines("stage 1", 100, 20, Box::new(pipe.clone()), LINE_EVERY);
        let start = progress.speed.now.at;
        // Two steps of four frames per second, from step 20 of 100.
        for n in 1..=80 {
            let update = Update { done: 20 + n, frames: 4, loss: 1.0 / n as f64 };
            progress.step_at(update, start + Duration::from_millis(500 * n));
        }
        progress.say("done");
        progress.finish();
        let text = String::from_utf8(pipe.0.lock().unwrap().clone()).unwrap();
        let expected = [
            "stage 1: step 21/100 (21.0 %), loss 1.0000, 8.0 frames/s, 40 s left",
            "stage 1: step 41/100 (41.0 %), loss 0.0476, 8.0 frames/s, 30 s left",
            "stage 1: step 61/100 (61.0 %), loss 0.0244, 8.0 frames/s, 20 s left",
            "stage 1: step 81/100 (81.0 %), loss 0.0164, 8.0 frames/s, 10 s left",
            "stage 1: step 100/100 (100.0 %), loss 0.0125, 8.0 frames/s, 0 s left",
            "done",
        ];
        assert_eq!(text.lines().collect::<Vec<_>>(), expected);
        assert!(!text.contains('\r') && !text.contains('\u{1b}'), "{text:?}");
    }

    #[test]
    fn odd_numbers_are_shown_as_they_are() {
        let pipe = Pipe::default();
        let mut progress = Progress::lines("s", 0, 0, Box::new(pipe.clone()), Duration::ZERO);
        let start = progress.speed.now.at;
        progress.step_at(Update { done: 5, frames: 0, loss: f64::NAN }, start);
        let text = String::from_utf8(pipe.0.lock().unwrap().clone()).unwrap();
        assert_eq!(text, "s: step 5/0 (500.0 %), loss NaN\n");
    }

    #[test]
    fn the_speed_is_that_of_the_last_seconds() {
        let start = Instant::now();
        let mut speed = Speed::new(0, start);
        speed.add(Update { done: 1, frames: 10, loss: 0.0 }, start + Duration::from_secs(100));
        for n in 1..=20 {
            let at = start + Duration::from_secs(100 + n);
            speed.add(Update { done: 1 + n, frames: 10, loss: 0.0 }, at);
        }
        assert_eq!(speed.frames_per_s(), Some(10.0));
        assert_eq!(speed.time_left(31), Some(Duration::from_secs(10)));
    }

    #[test]
    fn durations_are_short() {
        let text = |s| duration(Duration::from_secs(s));
        assert_eq!(
            [text(59), text(61), text(7300), text(200_000)],
            ["59 s", "1 min 1 s", "2 h 1 min", "2 d 7 h"]
        );
    }
}
