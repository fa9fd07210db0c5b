//! Starts the threads, watches over them, and ends them.

use std::cell::RefCell;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use crossbeam_channel::{Receiver, Sender, after, never, select, tick, unbounded};
use grnet_proto::clock::monotonic_ns;

use crate::activity::Activity;
use crate::failure::Failure;
use crate::service_manager::ServiceManager;
use crate::signals::{Request, SignalThread};
use crate::state::State;
use crate::stop::Stop;

/// How long threads may take to end; the promise is a stop within a second.
const GRACE: Duration = Duration::from_millis(800);

type Ended = (&'static str, Result<(), Failure>);

/// The threads of the daemon.
#[derive(Debug)]
pub struct Supervisor {
    stop: Stop,
    threads: Vec<(&'static str, JoinHandle<()>, Activity)>,
    ended_in: Sender<Ended>,
    ended: Receiver<Ended>,
    manager: Arc<ServiceManager>,
}

impl Supervisor {
    /// No threads yet.
    pub fn new(manager: Arc<ServiceManager>) -> Self {
        let (ended_in, ended) = unbounded();
        Self { stop: Stop::default(), threads: Vec::new(), ended_in, ended, manager }
    }

    /// The token that ends all threads.
    pub fn stop(&self) -> Stop {
        self.stop.clone()
    }

    /// Starts a thread whose panic is an error like any other.
    ///
    /// # Errors
    /// When the system admits no thread.
    pub fn start(
        &mut self,
        name: &'static str,
        activity: &Activity,
        body: impl FnOnce() -> Result<(), Failure> + Send + 'static,
    ) -> Result<(), Failure> {
        let ended = self.ended_in.clone();
        let finish = activity.clone();
        let thread = move || {
            // What the closure shares with other threads is atomics, channels and a mutex that survives poison.
            PANIC.set(Some(String::new()));
            let result = catch_unwind(AssertUnwindSafe(body)).unwrap_or_else(|_| {
                let panic = PANIC.take().unwrap_or_default();
                Err(Failure::internal(format!("thread {name} {panic}; this is a defect, please report it")))
            });
            finish.wait();
            // The supervisor outlives its threads, or gave up waiting.
            let _ = ended.send((name, result));
        };
        let handle = std::thread::Builder::new()
            .name(name.into())
            .spawn(thread)
            .map_err(|error| Failure::internal(format!("cannot start thread {name}: {error}")));
        match handle {
            Ok(handle) => {
                self.threads.push((name, handle, activity.clone()));
                Ok(())
            }
            Err(failure) => {
                self.stop.stop();
                Err(failure)
            }
        }
    }

    /// Waits for the end: the thread `last` has done everything, a thread fails, or a signal says so. Meanwhile the
    /// service manager's watchdog is fed as long as no thread is stuck. Then all threads are stopped and joined.
    ///
    /// # Errors
    /// The first error of any thread.
    pub fn supervise(
        mut self,
        last: &str,
        signals: &SignalThread,
        state: &State,
        reload: impl Fn(),
    ) -> Result<(), Failure> {
        let watchdog = self.manager.watchdog();
        let feed = watchdog.map_or_else(never, |period| tick(period / 4));
        let mut first_error = None;
        let mut running = self.threads.len();
        let why = loop {
            select! {
                recv(self.ended) -> ended => {
                    let (name, result) = ended.expect("a sender is kept in self");
                    running -= 1;
                    if let Err(failure) = result {
                        first_error = Some(failure);
                        break format!("thread {name} failed");
                    }
                    tracing::debug!(name, "thread ended");
                    if name == last {
                        break "the recording has ended".to_owned();
                    }
                }
                recv(signals.requests) -> request => match request {
                    Ok(Request::Reload) => reload(),
                    Ok(Request::Stop(signal)) => break signal.to_owned(),
                    Err(_) => {
                        first_error = Some(Failure::internal("the signal thread has ended"));
                        break "the signal thread has ended".to_owned();
                    }
                },
                recv(feed) -> _ => self.feed(watchdog.unwrap_or_default()),
            }
        };
        tracing::info!(why, "stopping");
        state.set_stopping();
        self.manager.stopping(&why);
        self.stop.stop();
        let deadline = after(GRACE);
        let begun = Instant::now();
        while running > 0 {
            select! {
                recv(self.ended) -> ended => {
                    running -= 1;
                    if let Ok((_, Err(failure))) = ended
                        && first_error.is_none()
                    {
                        first_error = Some(failure);
                    }
                }
                recv(deadline) -> _ => {
                    tracing::warn!(threads = self.unfinished(), waited = ?begun.elapsed(), "threads did not end in time");
                    return first_error.map_or(Ok(()), Err);
                }
            }
        }
        for (_, thread, _) in self.threads.drain(..) {
            // Panics were caught inside.
            let _ = thread.join();
        }
        first_error.map_or(Ok(()), Err)
    }

    /// Feeds the watchdog unless a piece of work takes suspiciously long.
    fn feed(&self, period: Duration) {
        let now_ns = monotonic_ns();
        let stuck = self.threads.iter().find(|(_, _, activity)| activity.busy_for(now_ns) > period / 2);
        match stuck {
            None => self.manager.alive(),
            Some((name, _, activity)) => {
                tracing::error!(thread = name, busy = ?activity.busy_for(now_ns), "a thread is stuck: the watchdog is not fed");
            }
        }
    }

    fn unfinished(&self) -> String {
        let names =
            self.threads.iter().filter(|(_, thread, _)| !thread.is_finished()).map(|(name, _, _)| *name);
        names.collect::<Vec<_>>().join(", ")
    }
}

impl Drop for Supervisor {
    fn drop(&mut self) {
        self.stop.stop();
    }
}

thread_local! {
    /// `Some` on supervised threads: their panics are reported once, as the thread's error.
    static PANIC: RefCell<Option<String>> = const { RefCell::new(None) };
}

/// Lets panics of supervised threads be reported by the supervisor, and those of others by the log.
pub fn install_panic_hook() {
    std::panic::set_hook(Box::new(|info| {
        let text = info.to_string().replace('\n', " ");
        PANIC.with_borrow_mut(|supervised| match supervised {
            Some(report) => *report = text,
            None => tracing::error!(thread = std::thread::current().name(), "{text}"),
        });
    }));
}

#[cfg(test)]
mod tests {
    use grnet_proto::{Access, BootId, CameraName};

    use super::*;
    use crate::failure::Kind;
    use crate::scenes::ModelIdentity;
    use crate::state::Identity;

    fn supervise(supervisor: Supervisor) -> Result<(), Failure> {
        let identity = Identity {
            boot_id: BootId::NONE,
            camera: CameraName::default(),
            access: Access::USER,
            source: "none".into(),
        };
        let model = ModelIdentity { model_hash: [0; 32], name: "m".into(), trained: true, scene: None };
        let signals = SignalThread::start().unwrap();
        supervisor.supervise("last", &signals, &State::new(identity, model), || {})
    }

    #[test]
    fn a_panic_is_an_error_that_ends_everybody() {
        install_panic_hook();
        let mut supervisor = Supervisor::new(Arc::default());
        let stop = supervisor.stop();
        supervisor
            .start("waits", &Activity::default(), move || {
                assert!(stop.wait(Duration::from_secs(60)));
                Ok(())
            })
            .unwrap();
        supervisor.start("panics", &Activity::default(), || panic!("two plus two is five")).unwrap();
        let failure = supervise(supervisor).unwrap_err();
        assert_eq!(failure.kind, Kind::Internal);
        let text = failure.chain();
        assert!(text.contains("thread panics") && text.contains("two plus two is five"), "{text}");
        assert!(text.contains("supervisor.rs:"), "{text}");
    }

    #[test]
    fn the_last_thread_ends_the_daemon_and_a_later_error_is_not_lost() {
        let mut supervisor = Supervisor::new(Arc::default());
        let stop = supervisor.stop();
        supervisor.start("last", &Activity::default(), || Ok(())).unwrap();
        supervisor
            .start("fails late", &Activity::default(), move || {
                stop.wait(Duration::from_secs(60));
                Err(Failure::config(anyhow::anyhow!("too late")))
            })
            .unwrap();
        assert_eq!(supervise(supervisor).unwrap_err().chain(), "too late");
    }

    #[test]
    fn a_thread_that_does_not_end_is_left_behind() {
        let mut supervisor = Supervisor::new(Arc::default());
        let (release, held) = crossbeam_channel::bounded::<()>(0);
        supervisor.start("last", &Activity::default(), || Ok(())).unwrap();
        supervisor
            .start("hangs", &Activity::default(), move || {
                assert!(held.recv().is_err());
                Ok(())
            })
            .unwrap();
        let begun = Instant::now();
        assert!(supervise(supervisor).is_ok());
        assert!(begun.elapsed() >= GRACE);
        drop(release);
    }
}
