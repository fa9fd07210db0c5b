//! A client's side of requests.

use core::fmt::Debug;
use std::time::{Duration, Instant};

use iceoryx2::{
    port::{client::Client, listener::Listener, notifier::Notifier},
    prelude::{PortFactory as _, Service as Variant},
    service::port_factory::client::ClientCreateError,
};

use super::{Requests, event_ports, on_desks, open_requests};
use crate::{
    CameraName, ControlReply, ControlRequest, Node, TransportError, names,
    node::On,
    qos,
    service::{
        open::{Events, no_daemon, open_events},
        publisher::notify,
        subscription::wait,
    },
};

/// Sends requests: a client's side of `grnet/<camera>/control`.
///
/// Neither `Send` nor `Sync`: open it on the thread that asks.
#[derive(Debug)]
pub struct ControlClient {
    ports: Box<dyn Ports>,
    /// Why this user may not ask for changes.
    forbidden: Option<TransportError>,
    service: String,
    next_request_id: u64,
}

impl ControlClient {
    /// Attaches to the control service of a camera.
    ///
    /// # Errors
    /// [`TransportError::NoDaemon`], [`TransportError::SchemaMismatch`],
    /// [`TransportError::PermissionDenied`], [`TransportError::TooManySubscribers`].
    pub fn open(node: &Node, camera: &CameraName) -> Result<Self, TransportError> {
        let service = names::control(camera);
        let (changes, forbidden) = match node.control_variant() {
            Ok(changes) => (changes, None),
            // Whoever may not ask for changes may still ask for the status.
            Err(error @ TransportError::NotMember { .. }) => (None, Some(error)),
            Err(error) => return Err(error),
        };
        let ports = on_desks!(node, changes, (here, there) => open(here, there, &service)?);
        Ok(Self { ports, forbidden, service, next_request_id: 1 })
    }

    /// Whether somebody answers. A daemon that was killed counts until its leftovers are cleared away.
    pub fn has_server(&self) -> bool {
        self.ports.servers() > 0
    }

    /// Asks and waits for the answer. The request's id is chosen here.
    ///
    /// # Errors
    /// [`TransportError::NoAnswer`] when the daemon does not answer in time, [`TransportError::NotMember`] for a
    /// request that would change the daemon's state where this user may not do that.
    pub fn call(
        &mut self,
        request: &ControlRequest,
        timeout: Duration,
    ) -> Result<ControlReply, TransportError> {
        if let Some(forbidden) = &self.forbidden
            && request.command.changes_state()
        {
            return Err(forbidden.clone());
        }
        let request_id = self.next_request_id;
        self.next_request_id += 1;
        self.ports.call(ControlRequest { request_id, ..*request }, &self.service, timeout)
    }
}

/// The ports of a client, whatever the services are made of.
trait Ports: Debug {
    fn call(
        &self,
        request: ControlRequest,
        service: &str,
        timeout: Duration,
    ) -> Result<ControlReply, TransportError>;

    fn servers(&self) -> usize;
}

#[derive(Debug)]
struct PortsOn<S: Variant> {
    // Ports before the services they belong to: fields are dropped in this order.
    listener: Listener<S>,
    notifier: Notifier<S>,
    here: Desk<S>,
    there: Option<Desk<S>>,
    _events: Events<S>,
}

/// Where requests are handed in.
#[derive(Debug)]
struct Desk<S: Variant> {
    client: Client<S, ControlRequest, (), ControlReply, ()>,
    requests: Requests<S>,
}

impl<S: Variant> Ports for PortsOn<S> {
    fn call(
        &self,
        request: ControlRequest,
        service: &str,
        timeout: Duration,
    ) -> Result<ControlReply, TransportError> {
        let deadline = Instant::now() + timeout;
        let desk = self.there.as_ref().filter(|_| request.command.changes_state()).unwrap_or(&self.here);
        let pending = desk
            .client
            .send_copy(request)
            .map_err(|error| TransportError::internal("send a request on", service, error))?;
        notify(&self.notifier, service)?;
        loop {
            let reply = pending
                .receive()
                .map_err(|error| TransportError::internal("receive a reply on", service, error))?;
            if let Some(reply) = reply {
                return Ok(*reply.payload());
            }
            let remaining = deadline.saturating_duration_since(Instant::now());
            if remaining.is_zero() {
                return Err(TransportError::NoAnswer {
                    service: service.to_owned(),
                    waited_ms: timeout.as_millis(),
                });
            }
            wait(&self.listener, service, remaining)?;
        }
    }

    fn servers(&self) -> usize {
        self.here.requests.dynamic_config().number_of_servers()
    }
}

fn open<S: Variant + 'static>(
    here: &On<'_, S>,
    there: Option<&On<'_, S>>,
    service: &str,
) -> Result<Box<dyn Ports>, TransportError> {
    let here_desk = Desk::open(here, service)?;
    let there = there.map(|there| Desk::open(there, service)).transpose()?;
    let events = open_events(here, service)?;
    let (listener, notifier) = event_ports(&events, service)?;
    Ok(Box::new(PortsOn { listener, notifier, here: here_desk, there, _events: events }))
}

impl<S: Variant> Desk<S> {
    fn open(on: &On<'_, S>, service: &str) -> Result<Self, TransportError> {
        let requests = open_requests(on, service)?;
        if requests.dynamic_config().number_of_servers() == 0 {
            return Err(no_daemon(on.node, service));
        }
        let client = requests.client_builder().create().map_err(|error| match error {
            ClientCreateError::ExceedsMaxSupportedClients => TransportError::TooManySubscribers {
                service: service.to_owned(),
                max: qos::MAX_CONTROL_CLIENTS,
            },
            _ => TransportError::internal("create the client of", service, error),
        })?;
        Ok(Self { client, requests })
    }
}
