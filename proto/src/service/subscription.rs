//! A client's side of a stream.

use core::{
    fmt::Debug,
    sync::atomic::{AtomicU64, Ordering},
};
use std::{
    sync::Arc,
    time::{Duration, Instant},
};

use iceoryx2::{
    port::{
        DegradationAction, ReceiveError,
        listener::{Listener, ListenerCreateError},
        subscriber::{Subscriber, SubscriberCreateError},
    },
    prelude::{PortFactory as _, Service},
};

use super::{
    Message,
    open::{Events, Stream, no_daemon, open_events, open_stream},
    publisher::ignore,
};
use crate::{
    CameraName, Node, TransportError,
    node::{Attempt, On, on_variant, retry},
    qos,
};

/// Receives one kind of message of one camera. A subscription stays attached when the daemon stops or
/// is killed, and resumes when it comes back.
///
/// Neither `Send` nor `Sync`: open it on the thread that receives.
#[derive(Debug)]
pub struct Subscription<M: Message> {
    ports: Box<dyn Ports<M>>,
    service: String,
    failed_connections: Arc<AtomicU64>,
}

impl<M: Message> Subscription<M> {
    /// Attaches to the stream; the last message follows with the daemon's next publication or heartbeat.
    ///
    /// # Errors
    /// [`TransportError::NoDaemon`] when nobody publishes, [`TransportError::TooManySubscribers`],
    /// [`TransportError::SchemaMismatch`], [`TransportError::PermissionDenied`].
    pub fn open(node: &Node, camera: &CameraName) -> Result<Self, TransportError> {
        let service = M::service_name(camera);
        let failed_connections = Arc::new(AtomicU64::new(0));
        let ports = on_variant!(node, on => open::<_, M>(on, &service, &failed_connections)?);
        Ok(Self { ports, service, failed_connections })
    }

    /// The oldest message that was not received yet, `None` when there is none. It is a copy: what
    /// the daemon does with its memory afterwards does not matter.
    ///
    /// # Errors
    /// [`TransportError::Internal`] when shared memory is corrupt.
    pub fn receive(&self) -> Result<Option<M>, TransportError> {
        match self.ports.receive() {
            Ok(sample) => Ok(sample),
            // The publisher died while it was connecting; its successor will connect.
            Err(ReceiveError::ConnectionFailure(_)) => {
                self.failed_connections.fetch_add(1, Ordering::Relaxed);
                Ok(None)
            }
            Err(error) => Err(TransportError::internal("receive from", &self.service, error)),
        }
    }

    /// Waits until something happens (a message, a daemon that comes or goes) or `timeout` has passed;
    /// `true` when something happened. Call it when [`receive`](Self::receive) gave nothing.
    ///
    /// # Errors
    /// [`TransportError::Internal`] when the event service is corrupt.
    pub fn wait(&self, timeout: Duration) -> Result<bool, TransportError> {
        self.ports.wait(&self.service, timeout)
    }

    /// Is there a daemon? One that was killed counts until somebody cleaned up: see
    /// [`Node::cleanup_dead_nodes`].
    pub fn has_publisher(&self) -> bool {
        self.ports.publishers() > 0
    }

    /// Connections to publishers that failed.
    pub fn failed_connections(&self) -> u64 {
        self.failed_connections.load(Ordering::Relaxed)
    }

    /// The name of the service.
    pub fn service(&self) -> &str {
        &self.service
    }
}

/// The ports of a subscription, whatever the services are made of.
trait Ports<M>: Debug {
    fn receive(&self) -> Result<Option<M>, ReceiveError>;
    fn wait(&self, service: &str, timeout: Duration) -> Result<bool, TransportError>;
    fn publishers(&self) -> usize;
}

#[derive(Debug)]
struct PortsOn<S: Service, M: Message> {
    // Ports before the services they belong to: fields are dropped in this order.
    listener: Listener<S>,
    subscriber: Subscriber<S, M, ()>,
    stream: Stream<S, M>,
    _events: Events<S>,
}

impl<S: Service, M: Message> Ports<M> for PortsOn<S, M> {
    fn receive(&self) -> Result<Option<M>, ReceiveError> {
        Ok(self.subscriber.receive()?.map(|sample| *sample.payload()))
    }

    fn wait(&self, service: &str, timeout: Duration) -> Result<bool, TransportError> {
        wait(&self.listener, service, timeout)
    }

    fn publishers(&self) -> usize {
        self.stream.dynamic_config().number_of_publishers()
    }
}

fn open<S: Service + 'static, M: Message>(
    on: &On<'_, S>,
    service: &str,
    failed_connections: &Arc<AtomicU64>,
) -> Result<Box<dyn Ports<M>>, TransportError> {
    let stream = open_stream::<S, M>(on, service)?;
    if stream.dynamic_config().number_of_publishers() == 0 {
        // Only other clients keep the service alive.
        return Err(no_daemon(on.node, service));
    }
    let events = open_events(on, service)?;
    let subscriber = open_subscriber(on.node, &stream, service, failed_connections)?;
    let listener = events.listener_builder().create().map_err(|error| match error {
        ListenerCreateError::ExceedsMaxSupportedListeners => {
            TransportError::TooManySubscribers { service: service.to_owned(), max: qos::MAX_LISTENERS }
        }
        _ => TransportError::internal("create the listener of", service, error),
    })?;
    Ok(Box::new(PortsOn { listener, subscriber, stream, _events: events }))
}

/// Waits for any event; a signal (`SIGCONT` and the like) does not end the wait early.
pub(super) fn wait<S: Service>(
    listener: &Listener<S>,
    service: &str,
    timeout: Duration,
) -> Result<bool, TransportError> {
    let deadline = Instant::now() + timeout;
    loop {
        let remaining = deadline.saturating_duration_since(Instant::now());
        let activations = if remaining.is_zero() {
            listener.try_wait(ignore)
        } else {
            listener.timed_wait(ignore, remaining)
        };
        match activations {
            Ok(0) if remaining.is_zero() => return Ok(false),
            Ok(0) => {}
            Ok(_) => return Ok(true),
            Err(iceoryx2::port::listener::ListenerWaitError::InterruptSignal) => {
                if remaining.is_zero() {
                    return Ok(false);
                }
            }
            Err(error) => return Err(TransportError::internal("wait for", service, error)),
        }
    }
}

fn open_subscriber<S: Service, M: Message>(
    node: &Node,
    stream: &Stream<S, M>,
    service: &str,
    failed_connections: &Arc<AtomicU64>,
) -> Result<Subscriber<S, M, ()>, TransportError> {
    let mut cleaned = false;
    retry("create the subscriber of", service, || {
        let failed_connections = Arc::clone(failed_connections);
        let result = stream
            .subscriber_builder()
            .set_degradation_handler(move |_, _| {
                failed_connections.fetch_add(1, Ordering::Relaxed);
                DegradationAction::Ignore
            })
            .create();
        result.map_err(|error| match error {
            SubscriberCreateError::ExceedsMaxSupportedSubscribers if cleaned => {
                Attempt::Failed(TransportError::TooManySubscribers {
                    service: service.to_owned(),
                    max: stream.static_config().max_subscribers(),
                })
            }
            // A place may be that of a client that was killed.
            SubscriberCreateError::ExceedsMaxSupportedSubscribers => {
                node.cleanup_dead_nodes();
                cleaned = true;
                Attempt::Again(error.to_string())
            }
            _ => Attempt::Again(error.to_string()),
        })
    })
}
