//! Samples delivered to a callback on a thread of its own.

use core::{
    ops::ControlFlow,
    sync::atomic::{AtomicBool, Ordering},
};
use std::{
    sync::{Arc, mpsc},
    thread::JoinHandle,
    time::Duration,
};

use crate::{ClientError, Connection, PoseSubscriber, Sample};

/// How long a stop can take to be noticed while no sample comes.
const NOTICE_STOP: Duration = Duration::from_millis(100);

/// A running callback; dropping it stops the thread and waits for it.
#[derive(Debug)]
pub struct Subscription {
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<Result<(), ClientError>>>,
}

/// Attaches to a running daemon and calls `callback` with every sample on a thread of its own, until it
/// breaks, the subscription is dropped, or receiving fails for good. Restarts of the daemon are survived.
///
/// # Errors
/// As for [`PoseSubscriber::open`].
pub fn subscribe(
    connection: &Connection,
    mut callback: impl FnMut(Sample) -> ControlFlow<()> + Send + 'static,
) -> Result<Subscription, ClientError> {
    let connection = connection.clone();
    let stop = Arc::new(AtomicBool::new(false));
    let stopped = Arc::clone(&stop);
    let (opened, is_open) = mpsc::channel();
    let thread = std::thread::spawn(move || {
        let mut subscriber = match PoseSubscriber::open(&connection) {
            Ok(subscriber) => {
                // The receiver waits for exactly this.
                let _ = opened.send(Ok(()));
                subscriber
            }
            Err(error) => {
                let _ = opened.send(Err(error));
                return Ok(());
            }
        };
        while !stopped.load(Ordering::Relaxed) {
            match subscriber.next_within(NOTICE_STOP) {
                Ok(sample) => {
                    if callback(sample).is_break() {
                        break;
                    }
                }
                Err(ClientError::Timeout { .. } | ClientError::NoDaemon(_)) => {}
                Err(error) => return Err(error),
            }
        }
        Ok(())
    });
    let subscription = Subscription { stop, thread: Some(thread) };
    match is_open.recv() {
        Ok(Ok(())) => Ok(subscription),
        Ok(Err(error)) => Err(error),
        // The thread is gone without a word: it panicked, and waiting for it passes the panic on.
        Err(_) => subscription.stop().map(|()| unreachable!("the thread ended before it opened anything")),
    }
}

impl Subscription {
    /// Stops the thread, waits for it, and gives what ended it.
    ///
    /// # Errors
    /// What made receiving fail for good, if that had happened.
    ///
    /// # Panics
    /// When the callback panicked.
    pub fn stop(mut self) -> Result<(), ClientError> {
        self.join()
    }

    /// Has the thread ended by itself?
    pub fn is_finished(&self) -> bool {
        self.thread.as_ref().is_none_or(JoinHandle::is_finished)
    }

    fn join(&mut self) -> Result<(), ClientError> {
        self.stop.store(true, Ordering::Relaxed);
        match self.thread.take().map(JoinHandle::join) {
            None => Ok(()),
            Some(Ok(result)) => result,
            Some(Err(panic)) => std::panic::resume_unwind(panic),
        }
    }
}

impl Drop for Subscription {
    fn drop(&mut self) {
        if std::thread::panicking() {
            return;
        }
        // Who wants to know calls `stop`.
        let _ = self.join();
    }
}
