//! A recording played like a camera: a thread decodes ahead, waits until the frame is due, and leaves it in a
//! slot where a newer frame replaces it.

use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use grnet_frame::{CaptureTime, Received, SourceError};

use super::{Failed, Footage};
use crate::clock::monotonic_ns;

type Item = Result<grnet_frame::Frame, SourceError>;

/// The playing thread and its slot.
#[derive(Debug)]
pub(crate) struct Live {
    slot: Arc<Slot>,
    thread: Option<JoinHandle<()>>,
}

#[derive(Debug, Default)]
struct Slot {
    state: Mutex<State>,
    changed: Condvar,
}

#[derive(Debug, Default)]
struct State {
    newest: Option<Item>,
    dropped: u64,
    /// Nothing more will come.
    over: bool,
    /// The source is being closed.
    stop: bool,
    failed: bool,
}

impl Live {
    /// Starts playing at `factor` times the recorded pace.
    pub fn start(footage: impl Footage, factor: f64) -> std::io::Result<Self> {
        let slot = Arc::new(Slot::default());
        let theirs = Arc::clone(&slot);
        let thread = std::thread::Builder::new().name("frames-live".into()).spawn(move || {
            let guard = OverGuard(&theirs);
            play(footage, factor, &theirs);
            drop(guard);
        })?;
        Ok(Self { slot, thread: Some(thread) })
    }

    pub fn next(&mut self, timeout: Duration) -> Result<Received, Failed> {
        let deadline = Instant::now().checked_add(timeout);
        let mut state = self.slot.lock();
        loop {
            match state.newest.take() {
                Some(item) => return item.map(Received::Frame).map_err(Failed::Source),
                None if state.failed => return Err(Failed::Thread),
                None if state.over => return Ok(Received::End),
                None => {}
            }
            let left = deadline.map(|deadline| deadline.saturating_duration_since(Instant::now()));
            state = match left {
                Some(Duration::ZERO) => return Ok(Received::Timeout),
                Some(left) => self.slot.wait(state, left),
                None => self.slot.changed.wait(state).unwrap_or_else(PoisonError::into_inner),
            };
        }
    }

    pub fn dropped(&self) -> u64 {
        self.slot.lock().dropped
    }
}

impl Drop for Live {
    fn drop(&mut self) {
        self.slot.lock().stop = true;
        self.slot.changed.notify_all();
        if let Some(thread) = self.thread.take() {
            // A panic in it was already told by `failed`.
            let _ = thread.join();
        }
    }
}

impl Slot {
    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn wait<'a>(&self, state: MutexGuard<'a, State>, left: Duration) -> MutexGuard<'a, State> {
        self.changed.wait_timeout(state, left).unwrap_or_else(PoisonError::into_inner).0
    }

    /// Puts a frame where the consumer finds it; one that it has not taken is lost, as are the `skipped` ones
    /// before it, which are counted only now, so that the count never runs ahead of the frames.
    fn put(&self, item: Item, skipped: u64) {
        let mut state = self.lock();
        state.dropped += skipped;
        if state.newest.replace(item).is_some() {
            state.dropped += 1;
        }
        drop(state);
        self.changed.notify_all();
    }

    /// Waits until the time on `CLOCK_MONOTONIC`; false when the source is closed instead.
    fn wait_until(&self, due_ns: u64) -> bool {
        let mut state = self.lock();
        loop {
            if state.stop {
                return false;
            }
            let left_ns = due_ns.saturating_sub(monotonic_ns());
            if left_ns == 0 {
                return true;
            }
            state = self.wait(state, Duration::from_nanos(left_ns));
        }
    }
}

/// Tells the consumer that the thread is gone, however it ended.
struct OverGuard<'a>(&'a Slot);

impl Drop for OverGuard<'_> {
    fn drop(&mut self) {
        let mut state = self.0.lock();
        state.over = true;
        state.failed = std::thread::panicking();
        drop(state);
        self.0.changed.notify_all();
    }
}

fn play<F: Footage>(mut footage: F, factor: f64, slot: &Slot) {
    let mut start_ns = None;
    loop {
        let elapsed = |start_ns: u64| (monotonic_ns().saturating_sub(start_ns) as f64 * factor) as u64;
        let skipped = start_ns.map_or(0, |start_ns| footage.skip_to(elapsed(start_ns)));
        let Some(shot) = footage.next() else { return };
        // The recording starts when its first frame is ready.
        let start = start_ns.get_or_insert_with(monotonic_ns);
        let lag_ns = elapsed(*start).saturating_sub(shot.offset_ns);
        if lag_ns > F::MOST_LAG_NS {
            *start += (lag_ns as f64 / factor) as u64;
        }
        let due_ns = *start + (shot.offset_ns as f64 / factor) as u64;
        if !slot.wait_until(due_ns) {
            return;
        }
        slot.put(shot.frame.map(|frame| frame.at(CaptureTime::monotonic(due_ns))), skipped);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use grnet_frame::{Frame, PixelFormat, Pixels};

    fn frame(sequence: u64) -> Item {
        let pixels = Arc::new(Pixels::packed(PixelFormat::Gray8, 1, 1, vec![0]).unwrap());
        Ok(Frame { pixels, capture_time: CaptureTime::monotonic(sequence), sequence, camera: None })
    }

    #[test]
    fn replaced_and_skipped_frames_are_counted_with_the_frame_that_follows_them() {
        let slot = Arc::new(Slot::default());
        let mut live = Live { slot: Arc::clone(&slot), thread: None };
        let mut next = || match live.next(Duration::ZERO).unwrap() {
            Received::Frame(frame) => Some((frame.sequence, live.dropped())),
            _ => None,
        };
        slot.put(frame(0), 0);
        assert_eq!(next(), Some((0, 0)));
        slot.put(frame(1), 0);
        slot.put(frame(5), 3);
        assert_eq!(next(), Some((5, 4)));
        assert_eq!(next(), None);
    }

    #[test]
    fn a_thread_that_failed_is_told_after_its_last_frame() {
        let slot = Arc::new(Slot::default());
        let theirs = Arc::clone(&slot);
        let thread = std::thread::spawn(move || {
            let _guard = OverGuard(&theirs);
            theirs.put(frame(0), 0);
            panic!("as intended by the test");
        });
        let mut live = Live { slot, thread: Some(thread) };
        let patience = Duration::from_secs(20);
        assert!(matches!(live.next(patience), Ok(Received::Frame(_))));
        assert!(matches!(live.next(patience), Err(Failed::Thread)));
    }
}
