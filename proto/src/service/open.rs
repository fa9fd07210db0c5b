//! Opening and creating services, and saying what is wrong when that fails.

use core::fmt::Debug;

use iceoryx2::{
    prelude::{MessagingPattern, Service},
    service::{
        builder::{
            event::{EventCreateError, EventOpenError},
            publish_subscribe::{PublishSubscribeCreateError, PublishSubscribeOpenError},
        },
        port_factory::{event, publish_subscribe},
        static_config::messaging_pattern::MessagingPattern as Pattern,
    },
};

use super::Message;
use crate::{
    ICEORYX2_VERSION, Node, SCHEMA_VERSION, TransportError,
    access::Storage,
    names::service_name,
    node::{Attempt, On, retry},
    qos,
};

/// The publish-subscribe service that carries `M`.
pub(super) type Stream<S, M> = publish_subscribe::PortFactory<S, M, ()>;
/// The event service of the same name.
pub(super) type Events<S> = event::PortFactory<S>;

/// Opens the stream for a client: it must exist.
pub(super) fn open_stream<S: Service, M: Message>(
    on: &On<'_, S>,
    service: &str,
) -> Result<Stream<S, M>, TransportError> {
    retry("open", service, || {
        on.iox
            .service_builder(&service_name(service))
            .publish_subscribe::<M>()
            .open()
            .map_err(|error| stream_open_attempt::<S, M>(on, service, error))
    })
}

/// Opens or creates the stream for the daemon.
pub(super) fn create_stream<S: Service, M: Message>(
    on: &On<'_, S>,
    service: &str,
) -> Result<Stream<S, M>, TransportError> {
    retry("create", service, || {
        let builder = || {
            on.iox
                .service_builder(&service_name(service))
                .publish_subscribe::<M>()
                .history_size(qos::HISTORY)
                .enable_safe_overflow(true)
                .subscriber_max_buffer_size(qos::SUBSCRIBER_BUFFER)
                .subscriber_max_borrowed_samples(qos::BORROWED_SAMPLES)
                .max_subscribers(qos::MAX_SUBSCRIBERS)
                .max_publishers(qos::MAX_PUBLISHERS)
                .max_nodes(qos::MAX_NODES)
        };
        match builder().open() {
            Ok(stream) => Ok(stream),
            Err(PublishSubscribeOpenError::DoesNotExist) => builder()
                .create_with_attributes(&qos::attributes(on.node.access()))
                .map_err(|error| match error {
                    PublishSubscribeCreateError::InsufficientPermissions => {
                        permission_attempt(on.node, error)
                    }
                    _ => Attempt::Again(error.to_string()),
                }),
            Err(error) => Err(stream_open_attempt::<S, M>(on, service, error)),
        }
    })
}

/// Opens the event service for a client.
pub(super) fn open_events<S: Service>(on: &On<'_, S>, service: &str) -> Result<Events<S>, TransportError> {
    retry("open the events of", service, || {
        on.iox
            .service_builder(&service_name(service))
            .event()
            .open()
            .map_err(|error| event_open_attempt(on, service, error))
    })
}

/// Opens or creates the event service for the daemon.
pub(super) fn create_events<S: Service>(on: &On<'_, S>, service: &str) -> Result<Events<S>, TransportError> {
    retry("create the events of", service, || {
        let builder = || {
            on.iox
                .service_builder(&service_name(service))
                .event()
                .max_listeners(qos::MAX_LISTENERS)
                // Control clients notify too.
                .max_notifiers(qos::MAX_CONTROL_CLIENTS + 1)
                .max_nodes(qos::MAX_NODES)
                .event_id_max_value(qos::EVENT_MAX)
        };
        match builder().open() {
            Ok(events) => Ok(events),
            Err(EventOpenError::DoesNotExist) => builder()
                .notifier_created_event(qos::event(qos::EVENT_ATTACHED))
                .notifier_dropped_event(qos::event(qos::EVENT_DETACHED))
                .notifier_dead_event(qos::event(qos::EVENT_DEAD))
                .create_with_attributes(&qos::attributes(on.node.access()))
                .map_err(|error| match error {
                    EventCreateError::InsufficientPermissions => permission_attempt(on.node, error),
                    _ => Attempt::Again(error.to_string()),
                }),
            Err(error) => Err(event_open_attempt(on, service, error)),
        }
    })
}

/// Nobody publishes this.
pub(super) fn no_daemon(node: &Node, service: &str) -> TransportError {
    TransportError::NoDaemon { service: service.to_owned(), root: node.root().to_string() }
}

/// The service is of another version; says which.
pub(super) fn schema_mismatch<S: Service>(
    on: &On<'_, S>,
    service: &str,
    pattern: MessagingPattern,
    expected: &[(&str, usize)],
) -> TransportError {
    let found = match S::details(&service_name(service), on.config, pattern) {
        Ok(Some(details)) => {
            let attributes = details.static_details.attributes();
            let attribute = |key: &str| {
                attributes
                    .key_value(&qos::attribute_key(key), 0)
                    .map_or_else(|| "unknown".to_owned(), |value| value.to_string())
            };
            let types = match details.static_details.messaging_pattern() {
                Pattern::PublishSubscribe(config) => vec![config.message_type_details().payload],
                Pattern::RequestResponse(config) => {
                    vec![
                        config.request_message_type_details().payload,
                        config.response_message_type_details().payload,
                    ]
                }
                _ => Vec::new(),
            };
            let types = types.iter().map(|detail| (detail.type_name().to_string(), detail.size()));
            format!(
                "{} (schema {}, grnet {})",
                describe(types),
                attribute(qos::ATTRIBUTE_SCHEMA),
                attribute(qos::ATTRIBUTE_VERSION)
            )
        }
        Ok(None) => "a service that has just ended".to_owned(),
        Err(error) => format!("a service that iceoryx2 {ICEORYX2_VERSION} cannot read ({error})"),
    };
    let expected = expected.iter().map(|(name, size)| ((*name).to_owned(), *size));
    TransportError::SchemaMismatch {
        service: service.to_owned(),
        found,
        expected: format!(
            "{} (schema {SCHEMA_VERSION}, grnet {}, iceoryx2 {ICEORYX2_VERSION})",
            describe(expected),
            crate::PACKAGE_VERSION
        ),
    }
}

/// The process lacks a right; says on what if the root tells.
pub(super) fn permission_attempt(node: &Node, error: impl Debug) -> Attempt {
    let root = node.root();
    match root.storage(node.access()) {
        // Behind a gate that was passed: the other side is about to open what it has just made.
        Storage::Files => Attempt::Again(format!("{error:?}")),
        Storage::SharedMemory => {
            Attempt::Failed(root.foreign_owner().unwrap_or_else(|| TransportError::UnusableRoot {
                path: root.path(),
                problem: format!(
                    "this user lacks the right to use the service files there ({error:?}); run as the daemon's user"
                ),
            }))
        }
    }
}

fn describe(types: impl Iterator<Item = (String, usize)>) -> String {
    types.map(|(name, size)| format!("{name} of {size} bytes")).collect::<Vec<_>>().join(" and ")
}

fn stream_open_attempt<S: Service, M: Message>(
    on: &On<'_, S>,
    service: &str,
    error: PublishSubscribeOpenError,
) -> Attempt {
    use PublishSubscribeOpenError as E;
    Attempt::Failed(match error {
        E::DoesNotExist => no_daemon(on.node, service),
        E::IncompatibleTypes | E::IncompatibleAttributes | E::VersionMismatch => schema_mismatch(
            on,
            service,
            MessagingPattern::PublishSubscribe,
            &[(M::TYPE_NAME, size_of::<M>())],
        ),
        E::ExceedsMaxNumberOfNodes => {
            TransportError::TooManySubscribers { service: service.to_owned(), max: qos::MAX_SUBSCRIBERS }
        }
        E::InsufficientPermissions => return permission_attempt(on.node, error),
        E::IncompatibleMessagingPattern
        | E::DoesNotSupportRequestedMinBufferSize
        | E::DoesNotSupportRequestedMinHistorySize
        | E::DoesNotSupportRequestedMinSubscriberBorrowedSamples
        | E::DoesNotSupportRequestedAmountOfPublishers
        | E::DoesNotSupportRequestedAmountOfSubscribers
        | E::DoesNotSupportRequestedAmountOfNodes
        | E::IncompatibleOverflowBehavior => {
            TransportError::Incompatible { service: service.to_owned(), problem: format!("{error:?}") }
        }
        _ => return Attempt::Again(error.to_string()),
    })
}

fn event_open_attempt<S: Service>(on: &On<'_, S>, service: &str, error: EventOpenError) -> Attempt {
    use EventOpenError as E;
    Attempt::Failed(match error {
        E::DoesNotExist => no_daemon(on.node, service),
        E::IncompatibleAttributes | E::VersionMismatch => {
            schema_mismatch(on, service, MessagingPattern::Event, &[])
        }
        E::ExceedsMaxNumberOfNodes => {
            TransportError::TooManySubscribers { service: service.to_owned(), max: qos::MAX_SUBSCRIBERS }
        }
        E::InsufficientPermissions => return permission_attempt(on.node, error),
        E::IncompatibleMessagingPattern
        | E::DoesNotSupportRequestedAmountOfNotifiers
        | E::DoesNotSupportRequestedAmountOfListeners
        | E::DoesNotSupportRequestedMaxEventId
        | E::DoesNotSupportRequestedAmountOfNodes => {
            TransportError::Incompatible { service: service.to_owned(), problem: format!("{error:?}") }
        }
        _ => return Attempt::Again(error.to_string()),
    })
}
