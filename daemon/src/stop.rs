//! The one way in which threads are told to end.

use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use crossbeam_channel::{Receiver, RecvTimeoutError, Sender, bounded};

/// Nothing can be sent: the channel only ever becomes disconnected.
#[derive(Debug)]
pub enum Never {}

/// A token that every thread holds; once stopped it stays stopped.
///
/// [`Stop::channel`] becomes ready (disconnected) at the stop, so that it can stand in any `select!`.
#[derive(Debug, Clone)]
pub struct Stop {
    sender: Arc<Mutex<Option<Sender<Never>>>>,
    receiver: Receiver<Never>,
}

impl Default for Stop {
    fn default() -> Self {
        let (sender, receiver) = bounded(0);
        Self { sender: Arc::new(Mutex::new(Some(sender))), receiver }
    }
}

impl Stop {
    /// Tells everybody to end.
    pub fn stop(&self) {
        self.sender.lock().unwrap_or_else(PoisonError::into_inner).take();
    }

    /// Whether everybody was told to end.
    pub fn is_stopped(&self) -> bool {
        self.wait(Duration::ZERO)
    }

    /// Waits for the stop, at most for `timeout`; whether it came.
    pub fn wait(&self, timeout: Duration) -> bool {
        matches!(self.receiver.recv_timeout(timeout), Err(RecvTimeoutError::Disconnected))
    }

    /// Ready from the stop on.
    pub fn channel(&self) -> &Receiver<Never> {
        &self.receiver
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_stop_ends_a_wait_and_stays() {
        let stop = Stop::default();
        assert!(!stop.is_stopped());
        let waiting = std::thread::spawn({
            let stop = stop.clone();
            move || stop.wait(Duration::from_secs(60))
        });
        stop.stop();
        assert!(waiting.join().unwrap());
        stop.stop();
        assert!(stop.is_stopped());
    }
}
