//! The daemon's side of a stream.

use core::sync::atomic::{AtomicU64, Ordering};
use std::sync::Arc;

use iceoryx2::{
    port::{
        DegradationAction, SendError,
        notifier::{Notifier, NotifierNotifyError},
        publisher::{Publisher as IoxPublisher, PublisherCreateError},
        update_connections::UpdateConnections as _,
    },
    prelude::{EventActivation, ipc},
};

use super::{
    Message,
    open::{Events, Stream, create_events, create_stream},
};
use crate::{
    CameraName, Node, TransportError,
    access::require_shared_memory,
    node::{Attempt, retry},
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
    // Ports before the services they belong to: fields are dropped in this order.
    notifier: Notifier<ipc::Service>,
    publisher: IoxPublisher<ipc::Service, M, ()>,
    stream: Stream<M>,
    _events: Events,
    service: String,
    published: u64,
    failed_connections: Arc<AtomicU64>,
}

impl<M: Message> Publisher<M> {
    /// Creates the services of the stream, or takes over those that attached clients kept alive over
    /// a restart of the daemon.
    ///
    /// # Errors
    /// [`TransportError::AlreadyPublished`], [`TransportError::NoSpace`],
    /// [`TransportError::SchemaMismatch`] when a client of another version keeps the old service alive,
    /// [`TransportError::Incompatible`], [`TransportError::PermissionDenied`].
    pub fn open(node: &Node, camera: &CameraName) -> Result<Self, TransportError> {
        let service = M::service_name(camera);
        require_shared_memory(qos::shared_memory_needed_bytes())?;
        let stream = create_stream::<M>(node, &service)?;
        let events = create_events(node, &service)?;
        let failed_connections = Arc::new(AtomicU64::new(0));
        let publisher = open_publisher(node, &stream, &service, &failed_connections)?;
        let notifier = events
            .notifier_builder()
            .default_event_id(qos::event(qos::EVENT_MESSAGE))
            .create()
            .map_err(|error| TransportError::internal("create the notifier of", &service, error))?;
        Ok(Self { notifier, publisher, stream, _events: events, service, published: 0, failed_connections })
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
        let slot = self
            .publisher
            .loan_uninit()
            .map_err(|error| TransportError::internal("publish on", &self.service, error))?;
        let subscribers = match slot.write_payload(message).send() {
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
        match self.notifier.notify() {
            // Both come after the notification was delivered.
            Ok(_)
            | Err(NotifierNotifyError::MissedDeadline | NotifierNotifyError::UnableToAcquireElapsedTime) => {
                Ok(())
            }
            Err(error) => Err(TransportError::internal("notify", &self.service, error)),
        }
    }

    /// Gives subscribers that have just attached the last message. Publishing does it too; call this
    /// at 2 Hz or more while nothing is published.
    ///
    /// # Errors
    /// [`TransportError::Internal`] when a connection cannot be made.
    pub fn update_connections(&self) -> Result<(), TransportError> {
        self.publisher
            .update_connections()
            .map_err(|error| TransportError::internal("connect the subscribers of", &self.service, error))
    }

    /// Subscribers that are attached now.
    pub fn subscribers(&self) -> usize {
        use iceoryx2::prelude::PortFactory as _;
        self.stream.dynamic_config().number_of_subscribers()
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

fn open_publisher<M: Message>(
    node: &Node,
    stream: &Stream<M>,
    service: &str,
    failed_connections: &Arc<AtomicU64>,
) -> Result<IoxPublisher<ipc::Service, M, ()>, TransportError> {
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

/// Nobody looks at which event it was: all of them mean "look again".
pub(super) fn ignore(_: EventActivation) {}
