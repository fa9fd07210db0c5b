//! What systemd is told. Without `NOTIFY_SOCKET` nothing is said and nothing fails.

use std::sync::Once;
use std::time::Duration;

use sd_notify::NotifyState;

/// The daemon's line to the service manager.
#[derive(Debug)]
pub struct ServiceManager {
    ready: Once,
    watchdog: Option<Duration>,
}

impl Default for ServiceManager {
    fn default() -> Self {
        Self { ready: Once::new(), watchdog: sd_notify::watchdog_enabled() }
    }
}

impl ServiceManager {
    /// The service is up; only the first call counts. `why` is shown by `systemctl status`.
    pub fn ready(&self, why: &str) {
        self.ready.call_once(|| {
            tracing::info!(why, "ready");
            self.tell(&[NotifyState::Ready, NotifyState::Status(why)]);
        });
    }

    /// Whether READY was said.
    pub fn is_ready(&self) -> bool {
        self.ready.is_completed()
    }

    /// What `systemctl status` shows.
    pub fn status(&self, text: &str) {
        self.tell(&[NotifyState::Status(text)]);
    }

    /// The configuration is being read again; [`ServiceManager::reloaded`] must follow. Before READY nothing is
    /// said: it would be taken for READY.
    pub fn reloading(&self) {
        if !self.is_ready() {
            return;
        }
        match NotifyState::monotonic_usec_now() {
            Ok(now) => self.tell(&[NotifyState::Reloading, now]),
            Err(error) => tracing::debug!(%error, "cannot read the clock for the service manager"),
        }
    }

    /// The configuration was read again.
    pub fn reloaded(&self) {
        if !self.is_ready() {
            return;
        }
        self.tell(&[NotifyState::Ready]);
    }

    /// The daemon is ending.
    pub fn stopping(&self, why: &str) {
        self.tell(&[NotifyState::Stopping, NotifyState::Status(why)]);
    }

    /// How long the service manager waits for a sign of life, when it watches.
    pub fn watchdog(&self) -> Option<Duration> {
        self.watchdog
    }

    /// A sign of life.
    pub fn alive(&self) {
        self.tell(&[NotifyState::Watchdog]);
    }

    fn tell(&self, state: &[NotifyState<'_>]) {
        if let Err(error) = sd_notify::notify(state) {
            tracing::debug!(%error, "cannot reach the service manager");
        }
    }
}
