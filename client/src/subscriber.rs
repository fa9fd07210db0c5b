//! Receiving poses, over restarts of the daemon.

use std::time::{Duration, Instant};

use grnet_proto::{BootId, Node, PoseSample, PoseSubscription, TransportError, names};

use crate::{ClientError, Connection, Sample};

/// After this long without a sample the subscriber looks whether the daemon is alive.
const SUSPICION: Duration = Duration::from_millis(600);

/// After this long without a daemon the subscriber lets go of the services: as long as a client holds
/// them, a daemon of another version cannot create its own.
const GRACE: Duration = Duration::from_secs(3);

/// How often a subscriber that let go looks for a daemon; there is no event for "a service appeared".
const LOOK_AGAIN: Duration = Duration::from_millis(200);

/// Receives pose samples, and goes on by itself when the daemon restarts: the new one's samples carry
/// another [`boot_id`](Sample::boot_id).
///
/// Not `Send`: open it on the thread that receives.
#[derive(Debug)]
pub struct PoseSubscriber {
    // Ports before the node they were opened on: fields are dropped in this order.
    subscription: Option<PoseSubscription>,
    node: Node,
    connection: Connection,
    last: Option<(BootId, u64)>,
    lost: u64,
    skipped: u64,
    restarts: u64,
    quiet_since: Instant,
    checked: Instant,
    absent_since: Option<Instant>,
}

impl PoseSubscriber {
    /// Attaches to a running daemon.
    ///
    /// # Errors
    /// [`ClientError::NoDaemon`], [`ClientError::PermissionDenied`], [`ClientError::SchemaMismatch`],
    /// [`ClientError::TooManySubscribers`].
    pub fn open(connection: &Connection) -> Result<Self, ClientError> {
        let (node, subscription) = attach(connection)?;
        let now = Instant::now();
        Ok(Self {
            subscription: Some(subscription),
            node,
            connection: connection.clone(),
            last: None,
            lost: 0,
            skipped: 0,
            restarts: 0,
            quiet_since: now,
            checked: now,
            absent_since: None,
        })
    }

    /// The oldest sample that was not received yet, `None` when there is none. Never waits.
    ///
    /// # Errors
    /// [`ClientError::Internal`] when shared memory is corrupt.
    pub fn try_next(&mut self) -> Result<Option<Sample>, ClientError> {
        let Some(subscription) = &self.subscription else { return Ok(None) };
        while let Some(raw) = subscription.receive()? {
            if Self::account(&mut self.last, &mut self.lost, &mut self.restarts, &raw) {
                self.quiet_since = Instant::now();
                self.absent_since = None;
                return Ok(Some(Sample::new(raw)));
            }
        }
        Ok(None)
    }

    /// The oldest sample that was not received yet; waits for it until `timeout` has passed.
    ///
    /// # Errors
    /// [`ClientError::Timeout`] when a daemon is there and sent nothing, [`ClientError::NoDaemon`] when
    /// none is there; both can be followed by another call. [`ClientError::SchemaMismatch`] when the
    /// daemon came back as another version.
    pub fn next_within(&mut self, timeout: Duration) -> Result<Sample, ClientError> {
        let start = Instant::now();
        let deadline = start + timeout;
        loop {
            if let Some(sample) = self.try_next()? {
                return Ok(sample);
            }
            self.look_after_daemon()?;
            let remaining = deadline.saturating_duration_since(Instant::now());
            if remaining.is_zero() {
                return Err(self.nothing_came(timeout));
            }
            match &self.subscription {
                Some(subscription) => {
                    subscription.wait(remaining.min(SUSPICION))?;
                }
                None => std::thread::sleep(remaining.min(LOOK_AGAIN)),
            }
        }
    }

    /// The newest sample; older ones are skipped and counted by
    /// [`skipped_samples`](Self::skipped_samples). Waits until `timeout` when there is none.
    ///
    /// # Errors
    /// As for [`next_within`](Self::next_within).
    pub fn latest_within(&mut self, timeout: Duration) -> Result<Sample, ClientError> {
        let mut newest = self.next_within(timeout)?;
        while let Some(sample) = self.try_next()? {
            self.skipped += 1;
            newest = sample;
        }
        Ok(newest)
    }

    /// The samples as an iterator that never ends by itself: an item is an error when nothing came
    /// within `timeout`, and the next item may be a sample again.
    pub fn samples(&mut self, timeout: Duration) -> Samples<'_> {
        Samples { subscriber: self, timeout }
    }

    /// Samples that were published while this subscriber was attached and that it never saw, because
    /// it was too slow.
    pub fn lost_samples(&self) -> u64 {
        self.lost
    }

    /// Samples that [`latest_within`](Self::latest_within) passed over.
    pub fn skipped_samples(&self) -> u64 {
        self.skipped
    }

    /// How often the daemon was seen to restart.
    pub fn restarts(&self) -> u64 {
        self.restarts
    }

    /// Is a daemon there now?
    pub fn has_daemon(&self) -> bool {
        self.subscription.as_ref().is_some_and(PoseSubscription::has_publisher)
    }

    /// The run of the daemon that the last sample came from.
    pub fn boot_id(&self) -> Option<BootId> {
        self.last.map(|(boot_id, _)| boot_id)
    }

    /// Keeps count; `false` for a sample that was received before (a history delivered twice).
    fn account(
        last: &mut Option<(BootId, u64)>,
        lost: &mut u64,
        restarts: &mut u64,
        raw: &PoseSample,
    ) -> bool {
        match *last {
            Some((boot_id, sample)) if boot_id == raw.boot_id => {
                if raw.sample <= sample {
                    return false;
                }
                *lost += raw.sample - sample - 1;
            }
            Some(_) => *restarts += 1,
            None => {}
        }
        *last = Some((raw.boot_id, raw.sample));
        true
    }

    /// When nothing has come for a while: frees what a killed daemon left, so that its absence shows;
    /// lets go of the services when nobody comes back; attaches again when somebody did.
    fn look_after_daemon(&mut self) -> Result<(), ClientError> {
        let now = Instant::now();
        let pause = if self.subscription.is_some() { SUSPICION } else { LOOK_AGAIN };
        if now.duration_since(self.quiet_since) < SUSPICION || now.duration_since(self.checked) < pause {
            return Ok(());
        }
        self.checked = now;
        if self.subscription.is_none() {
            return match attach(&self.connection) {
                Ok((node, subscription)) => {
                    // The daemon may share in another way than the one that went.
                    self.node = node;
                    self.subscription = Some(subscription);
                    self.absent_since = None;
                    self.quiet_since = now;
                    Ok(())
                }
                Err(ClientError::NoDaemon(_)) => Ok(()),
                Err(error) => Err(error),
            };
        }
        self.node.cleanup_dead_nodes();
        if self.has_daemon() {
            self.absent_since = None;
        } else if now.duration_since(*self.absent_since.get_or_insert(now)) > GRACE {
            self.subscription = None;
        }
        Ok(())
    }

    fn nothing_came(&self, waited: Duration) -> ClientError {
        let service = names::pose(&self.connection.camera);
        if self.has_daemon() {
            ClientError::Timeout { service, expected: "sample", waited }
        } else {
            ClientError::NoDaemon(TransportError::NoDaemon { service, root: self.node.root().to_string() })
        }
    }
}

fn attach(connection: &Connection) -> Result<(Node, PoseSubscription), ClientError> {
    let node = connection.node()?;
    let subscription = PoseSubscription::open(&node, &connection.camera)?;
    Ok((node, subscription))
}

/// The samples of a [`PoseSubscriber`]; see [`PoseSubscriber::samples`].
#[derive(Debug)]
pub struct Samples<'subscriber> {
    subscriber: &'subscriber mut PoseSubscriber,
    timeout: Duration,
}

impl Iterator for Samples<'_> {
    type Item = Result<Sample, ClientError>;

    fn next(&mut self) -> Option<Self::Item> {
        Some(self.subscriber.next_within(self.timeout))
    }
}

#[cfg(test)]
mod tests {
    use grnet_proto::{Reason, Status};

    use super::*;

    #[test]
    fn gaps_repeats_and_restarts_are_told_apart() {
        let (mut last, mut lost, mut restarts) = (None, 0, 0);
        let mut feed = |boot: u8, sample: u64| {
            let mut raw = PoseSample::unknown(
                BootId([boot; 16]),
                &"front".parse().unwrap(),
                Status::LOST,
                Reason::NONE,
            );
            raw.sample = sample;
            let fresh = PoseSubscriber::account(&mut last, &mut lost, &mut restarts, &raw);
            (fresh, lost, restarts)
        };
        assert_eq!(feed(1, 40), (true, 0, 0), "what went before the first sample is not lost");
        assert_eq!(feed(1, 41), (true, 0, 0));
        assert_eq!(feed(1, 41), (false, 0, 0), "the history came twice");
        assert_eq!(feed(1, 45), (true, 3, 0));
        assert_eq!(feed(2, 7), (true, 3, 1), "another boot starts its own count");
        assert_eq!(feed(2, 9), (true, 4, 1));
    }
}
