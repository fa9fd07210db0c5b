//! A recording played as fast as it is asked for: a thread decodes a few frames ahead, in order; it waits when
//! the consumer is slower, and nothing is ever lost.

use std::sync::mpsc::{Receiver, RecvTimeoutError, sync_channel};
use std::thread::JoinHandle;
use std::time::Duration;

use grnet_frame::{CaptureTime, Frame, Received, SourceError};

use super::{Failed, Footage};

/// Frames decoded ahead.
const PREFETCH: usize = 4;

/// The reading thread and its queue.
#[derive(Debug)]
pub(crate) struct OnDemand {
    queue: Option<Receiver<Result<Frame, SourceError>>>,
    thread: Option<JoinHandle<()>>,
}

impl OnDemand {
    pub fn start(mut footage: impl Footage) -> std::io::Result<Self> {
        let (sender, queue) = sync_channel(PREFETCH);
        let thread = std::thread::Builder::new().name("frames-read".into()).spawn(move || {
            while let Some(shot) = footage.next() {
                let time = CaptureTime::recorded(shot.recorded_ns);
                if sender.send(shot.frame.map(|frame| frame.at(time))).is_err() {
                    return;
                }
            }
        })?;
        Ok(Self { queue: Some(queue), thread: Some(thread) })
    }

    pub fn next(&mut self, timeout: Duration) -> Result<Received, Failed> {
        let Some(queue) = &self.queue else { return Ok(Received::End) };
        match queue.recv_timeout(timeout) {
            Ok(item) => item.map(Received::Frame).map_err(Failed::Source),
            Err(RecvTimeoutError::Timeout) => Ok(Received::Timeout),
            Err(RecvTimeoutError::Disconnected) => match self.join() {
                Ok(()) => Ok(Received::End),
                Err(()) => Err(Failed::Thread),
            },
        }
    }

    /// Ends the thread, which stops at its next frame because nobody listens; an error when it panicked.
    fn join(&mut self) -> Result<(), ()> {
        self.queue = None;
        self.thread.take().map_or(Ok(()), |thread| thread.join().map_err(|_| ()))
    }
}

impl Drop for OnDemand {
    fn drop(&mut self) {
        // A panic in the thread was already told by `Failed::Thread`, or concerns nobody any more.
        let _ = self.join();
    }
}
