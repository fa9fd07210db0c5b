//! A place for one frame between the capture thread and the worker.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use crossbeam_channel::{Receiver, Sender, TryRecvError, TrySendError, bounded, select};
use grnet_frame::SourceKind;

use crate::stop::Stop;

/// What happens when the place is taken.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum WhenFull {
    /// The newer frame replaces the older one, which is counted as dropped: a camera cannot wait.
    NewestWins,
    /// The sender waits: a recording can, and nothing is lost.
    Block,
}

impl From<SourceKind> for WhenFull {
    fn from(kind: SourceKind) -> Self {
        match kind {
            SourceKind::Live => Self::NewestWins,
            SourceKind::OnDemand => Self::Block,
        }
    }
}

/// The capture thread's end.
#[derive(Debug)]
pub struct SlotSender<T> {
    sender: Sender<T>,
    // Taking the old frame out needs the other end as well.
    taker: Receiver<T>,
    when_full: WhenFull,
    dropped: Arc<AtomicU64>,
}

/// What became of a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Sent {
    /// It is in the slot.
    Stored,
    /// The stop came first; it is gone.
    Stopped,
}

/// A slot of one, empty. The worker's end is a plain channel: it disconnects when the sender is dropped and
/// the last frame is taken. Drops are added to `dropped`.
pub fn slot<T>(when_full: WhenFull, dropped: Arc<AtomicU64>) -> (SlotSender<T>, Receiver<T>) {
    let (sender, receiver) = bounded(1);
    (SlotSender { sender, taker: receiver.clone(), when_full, dropped }, receiver)
}

impl<T> SlotSender<T> {
    /// Puts a frame in, by the slot's policy.
    pub fn send(&self, frame: T, stop: &Stop) -> Sent {
        match self.when_full {
            WhenFull::NewestWins => self.replace(frame),
            WhenFull::Block => select! {
                // This end holds a receiver: the channel cannot be disconnected.
                send(self.sender, frame) -> _ => Sent::Stored,
                recv(stop.channel()) -> _ => Sent::Stopped,
            },
        }
    }

    fn replace(&self, mut frame: T) -> Sent {
        loop {
            match self.sender.try_send(frame) {
                Ok(()) | Err(TrySendError::Disconnected(_)) => return Sent::Stored,
                Err(TrySendError::Full(newer)) => {
                    frame = newer;
                    match self.taker.try_recv() {
                        Ok(_) => {
                            self.dropped.fetch_add(1, Ordering::Relaxed);
                        }
                        // The worker took it in between.
                        Err(TryRecvError::Empty | TryRecvError::Disconnected) => {}
                    }
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use std::thread;

    use super::*;

    fn counter() -> Arc<AtomicU64> {
        Arc::default()
    }

    #[test]
    fn the_newest_wins_and_drops_are_counted() {
        let dropped = counter();
        let (sender, receiver) = slot(WhenFull::NewestWins, dropped.clone());
        for frame in 0..5 {
            assert_eq!(sender.send(frame, &Stop::default()), Sent::Stored);
        }
        assert_eq!((receiver.recv(), dropped.load(Ordering::Relaxed)), (Ok(4), 4));
        drop(sender);
        assert!(receiver.recv().is_err());
    }

    #[test]
    fn with_a_worker_every_frame_is_taken_or_counted() {
        let dropped = counter();
        let (sender, receiver) = slot(WhenFull::NewestWins, dropped.clone());
        let worker = thread::spawn(move || receiver.iter().collect::<Vec<u64>>());
        for frame in 0..10_000 {
            sender.send(frame, &Stop::default());
        }
        drop(sender);
        let taken = worker.join().unwrap();
        assert_eq!(taken.len() as u64 + dropped.load(Ordering::Relaxed), 10_000);
        assert!(taken.is_sorted() && taken.last() == Some(&9_999));
    }

    #[test]
    fn blocking_loses_nothing() {
        let dropped = counter();
        let (sender, receiver) = slot(WhenFull::Block, dropped.clone());
        let worker = thread::spawn(move || receiver.iter().collect::<Vec<u64>>());
        for frame in 0..10_000 {
            assert_eq!(sender.send(frame, &Stop::default()), Sent::Stored);
        }
        drop(sender);
        assert_eq!(worker.join().unwrap(), (0..10_000).collect::<Vec<u64>>());
        assert_eq!(dropped.load(Ordering::Relaxed), 0);
    }

    #[test]
    fn a_stop_ends_a_blocked_send() {
        let stop = Stop::default();
        let (sender, _receiver) = slot(WhenFull::Block, counter());
        sender.send(1, &stop);
        let blocked = thread::spawn({
            let stop = stop.clone();
            move || sender.send(2, &stop)
        });
        stop.stop();
        assert_eq!(blocked.join().unwrap(), Sent::Stopped);
    }

    #[test]
    fn the_policy_follows_the_source() {
        assert_eq!(WhenFull::from(SourceKind::Live), WhenFull::NewestWins);
        assert_eq!(WhenFull::from(SourceKind::OnDemand), WhenFull::Block);
    }
}
