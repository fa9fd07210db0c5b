//! Unix signals as messages.

use std::thread::JoinHandle;

use crossbeam_channel::{Receiver, unbounded};
use signal_hook::consts::signal::{SIGHUP, SIGINT, SIGTERM};
use signal_hook::iterator::{Handle, Signals};

use crate::failure::Failure;

/// What a signal asks for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Request {
    /// SIGTERM or SIGINT: end.
    Stop(&'static str),
    /// SIGHUP: read the configuration again.
    Reload,
}

/// A thread that turns signals into messages; ends when dropped.
///
/// SIGSTOP and SIGCONT need nothing: threads go on where they were, and waits are started again.
#[derive(Debug)]
pub struct SignalThread {
    /// The messages.
    pub requests: Receiver<Request>,
    handle: Handle,
    thread: Option<JoinHandle<()>>,
}

impl SignalThread {
    /// Takes the signals over.
    ///
    /// # Errors
    /// When the system admits no handler or thread.
    pub fn start() -> Result<Self, Failure> {
        let failed = |error| Failure::internal(format!("cannot take over the signals: {error}"));
        let mut signals = Signals::new([SIGTERM, SIGINT, SIGHUP]).map_err(failed)?;
        let handle = signals.handle();
        let (sender, requests) = unbounded();
        let listen = move || {
            for signal in signals.forever() {
                let request = match signal {
                    SIGTERM => Request::Stop("SIGTERM"),
                    SIGINT => Request::Stop("SIGINT"),
                    _ => Request::Reload,
                };
                if sender.send(request).is_err() {
                    return;
                }
            }
        };
        let thread = std::thread::Builder::new().name("signals".into()).spawn(listen).map_err(failed)?;
        Ok(Self { requests, handle, thread: Some(thread) })
    }
}

impl Drop for SignalThread {
    fn drop(&mut self) {
        self.handle.close();
        if let Some(thread) = self.thread.take() {
            // It cannot panic: it only forwards.
            let _ = thread.join();
        }
    }
}
