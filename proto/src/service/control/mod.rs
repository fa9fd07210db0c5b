//! Requests to the daemon and its replies.
//!
//! One request-response service takes every request. Where requests that change the daemon's state belong to
//! another group, they have a second one of the same name behind a folder of that group. The event service is
//! always the first one's: whoever may ask for a change may also look.

mod client;
mod server;

use iceoryx2::{
    port::{listener::Listener, notifier::Notifier},
    prelude::{MessagingPattern, Service as Variant},
    service::{
        builder::request_response::{RequestResponseCreateError, RequestResponseOpenError},
        port_factory::request_response::PortFactory,
    },
};

use super::open::{Events, no_daemon, permission_attempt, schema_mismatch};
use crate::{
    ControlReply, ControlRequest, TransportError,
    names::service_name,
    node::{Attempt, On, retry},
    qos,
};

pub use client::ControlClient;
pub use server::{ControlServer, PendingRequest};

type Requests<S> = PortFactory<S, ControlRequest, (), ControlReply, ()>;

/// Evaluates `$body` with `$here` as the [`On`] of the place of all requests and `$there` as that of requests that
/// change the daemon's state, where it is another one.
macro_rules! on_desks {
    ($node:expr, $changes:expr, ($here:ident, $there:ident) => $body:expr) => {{
        let node: &$crate::Node = $node;
        match (node.variant(), $changes) {
            ($crate::node::Variant::Ipc(iox), _) => {
                let $here = &$crate::node::On { node, iox, config: iox.config() };
                let $there = None;
                $body
            }
            #[cfg(feature = "group-access")]
            ($crate::node::Variant::Files(iox), changes) => {
                let $here = &$crate::node::On { node, iox, config: iox.config() };
                let there = match changes {
                    Some($crate::node::Variant::Files(iox)) => {
                        Some($crate::node::On { node, iox, config: iox.config() })
                    }
                    _ => None,
                };
                let $there = there.as_ref();
                $body
            }
        }
    }};
}
use on_desks;

fn event_ports<S: Variant>(
    events: &Events<S>,
    service: &str,
) -> Result<(Listener<S>, Notifier<S>), TransportError> {
    let listener = events
        .listener_builder()
        .create()
        .map_err(|error| TransportError::internal("create the listener of", service, error))?;
    let notifier = events
        .notifier_builder()
        .default_event_id(qos::event(qos::EVENT_MESSAGE))
        .create()
        .map_err(|error| TransportError::internal("create the notifier of", service, error))?;
    Ok((listener, notifier))
}

fn open_requests<S: Variant>(on: &On<'_, S>, service: &str) -> Result<Requests<S>, TransportError> {
    retry("open", service, || {
        on.iox
            .service_builder(&service_name(service))
            .request_response::<ControlRequest, ControlReply>()
            .open()
            .map_err(|error| open_attempt(on, service, error))
    })
}

fn create_requests<S: Variant>(on: &On<'_, S>, service: &str) -> Result<Requests<S>, TransportError> {
    retry("create", service, || {
        let builder = || {
            on.iox
                .service_builder(&service_name(service))
                .request_response::<ControlRequest, ControlReply>()
                .max_servers(1)
                .max_clients(qos::MAX_CONTROL_CLIENTS)
                .max_nodes(qos::MAX_NODES)
                .max_active_requests_per_client(2)
                .max_response_buffer_size(2)
        };
        match builder().open() {
            Ok(requests) => Ok(requests),
            Err(RequestResponseOpenError::DoesNotExist) => builder()
                .create_with_attributes(&qos::attributes(on.node.access()))
                .map_err(|error| match error {
                    RequestResponseCreateError::InsufficientPermissions => permission_attempt(on.node, error),
                    _ => Attempt::Again(error.to_string()),
                }),
            Err(error) => Err(open_attempt(on, service, error)),
        }
    })
}

fn open_attempt<S: Variant>(on: &On<'_, S>, service: &str, error: RequestResponseOpenError) -> Attempt {
    use RequestResponseOpenError as E;
    Attempt::Failed(match error {
        E::DoesNotExist => no_daemon(on.node, service),
        E::IncompatibleRequestOrResponseType | E::IncompatibleAttributes | E::VersionMismatch => {
            schema_mismatch(
                on,
                service,
                MessagingPattern::RequestResponse,
                &[
                    (ControlRequest::TYPE_NAME, size_of::<ControlRequest>()),
                    (ControlReply::TYPE_NAME, size_of::<ControlReply>()),
                ],
            )
        }
        E::ExceedsMaxNumberOfNodes => {
            TransportError::TooManySubscribers { service: service.to_owned(), max: qos::MAX_CONTROL_CLIENTS }
        }
        E::InsufficientPermissions => return permission_attempt(on.node, error),
        E::IsMarkedForDestruction
        | E::ServiceInCorruptedState
        | E::HangsInCreation
        | E::UnableToCreateServiceTag
        | E::InternalFailure => {
            return Attempt::Again(error.to_string());
        }
        error => TransportError::Incompatible { service: service.to_owned(), problem: format!("{error:?}") },
    })
}
