//! The daemon's side of a stream.

use core::{
    fmt::Debug,
    sync::atomic::{AtomicU64, Ordering},
};
use std::sync::Arc;

use iceoryx2::{
    port::{
        DegradationAction, SendError,
        notifier::{Notifier, NotifierNotifyError},
        publisher::{Publisher as IoxPublisher, PublisherCreateError},
        update_connections::{ConnectionFailure, UpdateConnections as _},
    },
    prelude::{EventActivation, PortFactory as _, Service},
};

use super::{
    Message,
    open::{Events, Stream, create_events, create_stream},
};
use crate::{
    CameraName, Node, TransportError,
    access::Announcement,
    node::{Attempt, On, on_variant, retry},
    qos,
};

/// What became of a publication.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Delivered {
    /// The number the message got: counts the publications of this publisher, from 1.
    pub sample: u64,
    /// Subscribers that have it.
    pub subscribers: usize,
}

/// Publishes one kind of message for one camera; at most one per camera and machine.
///
/// Neither `Send` nor `Sync`: open it on the thread that publishes, and give that thread nothing else
/// to do, because clients that attach, detach or die can cost a publication tens of milliseconds.
#[derive(Debug)]
pub struct Publisher<M: Message> {
    // What tells of the daemon goes before what it tells of: fields are dropped in this order.
    _announcement: Option<Announcement>,
    ports: Box<dyn Ports<M>>,
    service: String,
    published: u64,
    failed_connections: Arc<AtomicU64>,
}

impl<M: Message> Publisher<M> {
    /// Creates the services of the stream, or takes over those that attached clients kept alive over
    /// a restart of the daemon. The publisher of poses announces the daemon to its clients.
    ///
    /// # Errors
    /// [`TransportError::AlreadyPublished`], [`TransportError::NoSpace`],
    /// [`TransportError::SchemaMismatch`] when a client of another version keeps the old service alive,
    /// [`TransportError::Incompatible`], [`TransportError::PermissionDenied`].
    pub fn open(node: &Node, camera: &CameraName) -> Result<Self, TransportError> {
        let service = M::service_name(camera);
        node.root().require_space(node.access(), qos::shared_memory_needed_bytes())?;
        let failed_connections = Arc::new(AtomicU64::new(0));
        let ports = on_variant!(node, on => open::<_, M>(on, &service, &failed_connections)?);
        node.protect_payload(&node.root().path())?;
        let announcement = M::ANNOUNCES.then(|| Announcement::publish(node, camera)).transpose()?;
        Ok(Self { _announcement: announcement, ports, service, published: 0, failed_connections })
    }

    /// Publishes the message with its schema version and number stamped, and wakes the subscribers.
    /// Never blocks on a slow subscriber: it loses its oldest messages.
    ///
    /// # Errors
    /// [`TransportError::Internal`] when shared memory is corrupt.
    pub fn publish(&mut self, message: &M) -> Result<Delivered, TransportError> {
        let sample = self.published + 1;
        let mut message = *message;
        message.stamp(sample);
        let subscribers = match self.ports.send(message) {
            Ok(subscribers) => subscribers,
            // The message is out; what failed is the connection to somebody who just left.
            Err(SendError::UnableToDeliver | SendError::ConnectionError(_)) => {
                self.failed_connections.fetch_add(1, Ordering::Relaxed);
                self.subscribers()
            }
            Err(error) => return Err(TransportError::internal("publish on", &self.service, error)),
        };
        self.published = sample;
        self.notify()?;
        Ok(Delivered { sample, subscribers })
    }

    /// Wakes the subscribers without a message.
    ///
    /// # Errors
    /// [`TransportError::Internal`] when the event service is corrupt.
    pub fn notify(&self) -> Result<(), TransportError> {
        self.ports.notify(&self.service)
    }

    /// Gives subscribers that have just attached the last message. Publishing does it too; call this
    /// at 2 Hz or more while nothing is published.
    ///
    /// # Errors
    /// [`TransportError::Internal`] when a connection cannot be made.
    pub fn update_connections(&self) -> Result<(), TransportError> {
        self.ports
            .update_connections()
            .map_err(|error| TransportError::internal("connect the subscribers of", &self.service, error))
    }

    /// Subscribers that are attached now.
    pub fn subscribers(&self) -> usize {
        self.ports.subscribers()
    }

    /// Connections to subscribers that failed: they belong to another user or died half attached.
    pub fn failed_connections(&self) -> u64 {
        self.failed_connections.load(Ordering::Relaxed)
    }

    /// The name of the service.
    pub fn service(&self) -> &str {
        &self.service
    }
}

/// The ports of a publisher, whatever the services are made of.
trait Ports<M>: Debug {
    fn send(&self, message: M) -> Result<usize, SendError>;
    fn notify(&self, service: &str) -> Result<(), TransportError>;
    fn update_connections(&self) -> Result<(), ConnectionFailure>;
    fn subscribers(&self) -> usize;
}

#[derive(Debug)]
struct PortsOn<S: Service, M: Message> {
    // Ports before the services they belong to: fields are dropped in this order.
    notifier: Notifier<S>,
    publisher: IoxPublisher<S, M, ()>,
    stream: Stream<S, M>,
    _events: Events<S>,
}

impl<S: Service, M: Message> Ports<M> for PortsOn<S, M> {
    fn send(&self, message: M) -> Result<usize, SendError> {
        self.publisher.loan_uninit()?.write_payload(message).send()
    }

    fn notify(&self, service: &str) -> Result<(), TransportError> {
        notify(&self.notifier, service)
    }

    fn update_connections(&self) -> Result<(), ConnectionFailure> {
        self.publisher.update_connections()
    }

    fn subscribers(&self) -> usize {
        self.stream.dynamic_config().number_of_subscribers()
    }
}

fn open<S: Service + 'static, M: Message>(
    on: &On<'_, S>,
    service: &str,
    failed_connections: &Arc<AtomicU64>,
) -> Result<Box<dyn Ports<M>>, TransportError> {
    let stream = create_stream::<S, M>(on, service)?;
    let events = create_events(on, service)?;
    let publisher = open_publisher(on.node, &stream, service, failed_connections)?;
    let notifier = events
        .notifier_builder()
        .default_event_id(qos::event(qos::EVENT_MESSAGE))
        .create()
        .map_err(|error| TransportError::internal("create the notifier of", service, error))?;
    Ok(Box::new(PortsOn { notifier, publisher, stream, _events: events }))
}

fn open_publisher<S: Service, M: Message>(
    node: &Node,
    stream: &Stream<S, M>,
    service: &str,
    failed_connections: &Arc<AtomicU64>,
) -> Result<IoxPublisher<S, M, ()>, TransportError> {
    let mut cleaned = false;
    retry("create the publisher of", service, || {
        let failed_connections = Arc::clone(failed_connections);
        let result = stream
            .publisher_builder()
            .max_loaned_samples(1)
            .set_degradation_handler(move |_, _| {
                failed_connections.fetch_add(1, Ordering::Relaxed);
                DegradationAction::Ignore
            })
            .create();
        result.map_err(|error| match error {
            PublisherCreateError::ExceedsMaxSupportedPublishers if cleaned => {
                Attempt::Failed(TransportError::AlreadyPublished { service: service.to_owned() })
            }
            // The place may be that of a daemon that was killed a moment ago.
            PublisherCreateError::ExceedsMaxSupportedPublishers => {
                node.cleanup_dead_nodes();
                cleaned = true;
                Attempt::Again(error.to_string())
            }
            _ => Attempt::Again(error.to_string()),
        })
    })
}

/// Wakes whoever waits on the events of `service`.
pub(super) fn notify<S: Service>(notifier: &Notifier<S>, service: &str) -> Result<(), TransportError> {
    use NotifierNotifyError as E;
    match notifier.notify() {
        // Both come after the notification was delivered.
        Ok(_) | Err(E::MissedDeadline | E::UnableToAcquireElapsedTime) => Ok(()),
        Err(error) => Err(TransportError::internal("notify", service, error)),
    }
}

/// Nobody looks at which event it was: all of them mean "look again".
pub(super) fn ignore(_: EventActivation) {}
