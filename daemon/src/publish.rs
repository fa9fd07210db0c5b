//! The publishing thread: owns the ports of the pose and status streams and does nothing else, because a client
//! that attaches, detaches or dies can cost a publication tens of milliseconds.

use std::sync::Arc;
use std::sync::atomic::Ordering::Relaxed;
use std::time::{Duration, Instant};

use crossbeam_channel::{Receiver, Sender, never, select, tick};
use grnet_proto::clock::Now;
use grnet_proto::{
    CameraName, Node, PosePublisher, PoseSample, Reason, Role, SourceState, Status, StatusPublisher,
    StatusSubscription, TransportError,
};

use crate::activity::Activity;
use crate::capture::Outage;
use crate::convert;
use crate::failure::{Failure, Kind};
use crate::feed::Feed;
use crate::repeats::Repeats;
use crate::service_manager::ServiceManager;
use crate::setup::Transport;
use crate::state::State;
use crate::stop::Stop;
use crate::worker::{Output, Processed};

/// How often is looked for the first subscribers; iceoryx2 has no event for a publisher to wait for.
const LOOK_FOR_SUBSCRIBERS: Duration = Duration::from_millis(10);

/// What the publishing thread works with.
#[derive(Debug)]
pub struct Publish {
    /// Who may subscribe, and where.
    pub transport: Transport,
    /// Between two heartbeats.
    pub heartbeat: Duration,
    /// Other times between heartbeats, from then on.
    pub heartbeats: Receiver<Duration>,
    /// `None` for a recording as fast as possible: its poses are stale when the next one comes.
    pub silence: Option<Duration>,
    /// The gate to the frames is opened when so many subscribers are there.
    pub wait_for_subscribers: usize,
    /// Gets one message when the ports are open: the name is ours.
    pub opened: Sender<()>,
    /// Gets one message when requests are answered: nobody is to be told READY before.
    pub controlled: Receiver<()>,
    /// Gets one message when frames may be read.
    pub gate: Sender<()>,
    /// Samples from the worker.
    pub output: Receiver<Output>,
    /// Outages from the capture thread.
    pub outages: Receiver<Outage>,
    /// What is counted and told.
    pub state: Arc<State>,
    /// Is told when the daemon waits for subscribers.
    pub manager: Arc<ServiceManager>,
    /// Ends the thread.
    pub stop: Stop,
    /// Shows progress.
    pub activity: Activity,
}

/// Publishes until the worker has ended and everything is out, or the stop comes.
///
/// # Errors
/// When the ports cannot be opened, or shared memory is corrupt.
pub fn run(publish: Publish) -> Result<(), Failure> {
    let Publish { transport, state, activity, stop, .. } = &publish;
    activity.work();
    let node = Node::open(transport.access, &transport.root, Role::Daemon)?;
    let camera = &state.identity.camera;
    let mut ports = Ports {
        pose: PosePublisher::open(&node, camera).map_err(|error| taken_by(error, &node, camera))?,
        status: StatusPublisher::open(&node, camera)?,
        state: Arc::clone(state),
        feed: Feed::new(publish.silence),
        failed: Repeats::default(),
        failed_before: 0,
        published_before: 0,
    };
    ports.heartbeat()?;
    tracing::info!(service = ports.pose.service(), root = %transport.root, "publishing");
    // Threads that have gone have told their error elsewhere.
    let _ = publish.opened.try_send(());
    activity.wait();
    select! {
        recv(publish.controlled) -> _ => {}
        recv(stop.channel()) -> _ => {}
    }
    ports.admit_subscribers(&publish)?;
    let _ = publish.gate.try_send(());

    let mut beat = tick(publish.heartbeat);
    let (mut outages, mut heartbeats) = (publish.outages.clone(), publish.heartbeats.clone());
    loop {
        activity.wait();
        select! {
            recv(publish.output) -> output => match output {
                Ok(output) => { activity.work(); ports.output(output)?; }
                Err(_) => break,
            },
            recv(outages) -> outage => match outage {
                Ok(outage) => { activity.work(); ports.outage(outage)?; }
                Err(_) => outages = never(),
            },
            recv(beat) -> _ => { activity.work(); ports.heartbeat()?; }
            recv(heartbeats) -> period => match period {
                Ok(period) => beat = tick(period),
                Err(_) => heartbeats = never(),
            },
            recv(stop.channel()) -> _ => break,
        }
    }
    activity.work();
    ports.end()?;
    activity.wait();
    Ok(())
}

struct Ports {
    pose: PosePublisher,
    status: StatusPublisher,
    state: Arc<State>,
    feed: Feed,
    failed: Repeats,
    failed_before: u64,
    published_before: u64,
}

impl Ports {
    /// Waits until the configured number of subscribers is attached.
    fn admit_subscribers(&mut self, publish: &Publish) -> Result<(), Failure> {
        let Publish { wait_for_subscribers, heartbeat, manager, stop, activity, .. } = publish;
        let (subscribers, heartbeat) = (*wait_for_subscribers, *heartbeat);
        if subscribers == 0 {
            return Ok(());
        }
        tracing::info!(subscribers, "waiting for subscribers before the first frame is read");
        manager.ready("waiting for subscribers");
        let (beat, look) = (tick(heartbeat), tick(LOOK_FOR_SUBSCRIBERS));
        while self.pose.subscribers() < subscribers {
            activity.wait();
            select! {
                recv(look) -> _ => {}
                recv(beat) -> _ => { activity.work(); self.heartbeat()?; }
                recv(stop.channel()) -> _ => return Ok(()),
            }
        }
        self.pose.update_connections()?;
        Ok(())
    }

    fn output(&mut self, output: Output) -> Result<(), Failure> {
        match output {
            Output::Sample(processed) => self.processed(*processed),
            Output::Paused => {
                self.feed.pause();
                self.absent()
            }
            Output::Resumed => {
                self.feed.resume();
                self.absent()
            }
        }
    }

    fn processed(&mut self, processed: Processed) -> Result<(), Failure> {
        let Processed { mut sample, fused_at_ns, outages } = processed;
        if !self.feed.admits(outages, step_time(&sample), Instant::now()) {
            self.state.counters.slot_dropped.fetch_add(1, Relaxed);
            return Ok(());
        }
        sample.dropped_frames = self.state.counters.missed();
        sample.stamp_publication(Now::read(), Some(fused_at_ns));
        self.send(&sample)?;
        self.state.record(sample.status, &sample.latency);
        Ok(())
    }

    fn outage(&mut self, Outage(number): Outage) -> Result<(), Failure> {
        if self.feed.outage(number) { self.absent() } else { Ok(()) }
    }

    /// The status; an invalid sample again where there is no pose; otherwise, when no sample went out since the
    /// last heartbeat, the last one to whoever is new: nobody else would wake a client that waits for its first.
    fn heartbeat(&mut self) -> Result<(), Failure> {
        let published = self.state.counters.published.load(Relaxed);
        if self.feed.has_no_pose(Instant::now()) {
            self.absent()?;
        } else if published == self.published_before {
            self.pose.update_connections()?;
            self.pose.notify()?;
        }
        self.published_before = published;
        self.publish_status()
    }

    fn publish_status(&mut self) -> Result<(), Failure> {
        self.state.counters.subscribers.store(self.pose.subscribers() as u32, Relaxed);
        self.status.publish(&self.state.status(Now::read()))?;
        let failed = self.pose.failed_connections() + self.status.failed_connections();
        if failed > self.failed_before {
            self.failed_before = failed;
            if let Some(times) = self.failed.happened(Instant::now()) {
                tracing::warn!(
                    failed,
                    times,
                    "clients cannot be reached: of another user, or died while attaching"
                );
            }
        }
        Ok(())
    }

    fn absent(&mut self) -> Result<(), Failure> {
        let (status, reason) = self.feed.absence();
        self.send_absent(status, reason)
    }

    fn send_absent(&mut self, status: Status, reason: Reason) -> Result<(), Failure> {
        let identity = &self.state.identity;
        let mut sample =
            convert::absent(identity.boot_id, &identity.camera, &self.state.model(), status, reason);
        sample.reset_epoch = self.state.counters.reset_epoch.load(Relaxed);
        sample.dropped_frames = self.state.counters.missed();
        sample.stamp_publication(Now::read(), None);
        self.send(&sample)
    }

    fn send(&mut self, sample: &PoseSample) -> Result<(), Failure> {
        let delivered = self.pose.publish(sample)?;
        self.state.counters.published.store(delivered.sample, Relaxed);
        Ok(())
    }

    /// The last words: nobody who joins later may take the last pose for a fresh one.
    fn end(&mut self) -> Result<(), Failure> {
        let reason = match self.state.source() {
            SourceState::ENDED => Reason::SOURCE_ENDED,
            _ => Reason::STOPPING,
        };
        self.state.set_stopping();
        self.send_absent(Status::SOURCE_LOST, reason)?;
        self.publish_status()
    }
}

/// How long the worker had the frame.
fn step_time(sample: &PoseSample) -> Duration {
    let latency = &sample.latency;
    let took_us = latency.preprocess_us + latency.infer_us + latency.fuse_us;
    Duration::try_from_secs_f32(took_us / 1e6).unwrap_or_default()
}

/// Adds the process id of the daemon that has the name to the error that says so.
fn taken_by(error: TransportError, node: &Node, camera: &CameraName) -> Failure {
    let TransportError::AlreadyPublished { .. } = &error else { return error.into() };
    let holder = StatusSubscription::open(node, camera).ok().and_then(|status| {
        // A status follows within one heartbeat of the other daemon.
        let deadline = Instant::now() + Duration::from_secs(1);
        loop {
            match status.receive() {
                Ok(Some(status)) => return Some(status.pid),
                Ok(None) => {}
                Err(_) => return None,
            }
            let left = deadline.saturating_duration_since(Instant::now());
            if left.is_zero() || status.wait(left).is_err() {
                return None;
            }
        }
    });
    let holder =
        holder.map_or("another process".to_owned(), |pid| format!("the grnetd with process id {pid}"));
    let text = format!("the camera name {camera} (camera.name) is in use by {holder}");
    Failure::new(Kind::Unavailable, anyhow::Error::new(error).context(text))
}
