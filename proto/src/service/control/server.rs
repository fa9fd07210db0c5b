//! The daemon's side of requests.

use core::fmt::Debug;
use std::time::Duration;

use iceoryx2::{
    active_request::ActiveRequest,
    port::{ReceiveError, listener::Listener, notifier::Notifier, server::Server},
    prelude::Service as Variant,
    service::port_factory::server::ServerCreateError,
};

use super::{Requests, create_requests, event_ports, on_desks};
use crate::{
    CameraName, ControlReply, ControlRequest, Node, TransportError, names,
    node::{Attempt, On, retry},
    service::{
        open::{Events, create_events},
        publisher::notify,
        subscription::wait,
    },
};

/// Receives requests: the daemon's side of `grnet/<camera>/control`.
///
/// Neither `Send` nor `Sync`: open it on the thread that answers.
#[derive(Debug)]
pub struct ControlServer {
    ports: Box<dyn Ports>,
    service: String,
}

/// A request that waits for its reply.
#[derive(Debug)]
pub struct PendingRequest<'server> {
    active: Box<dyn Active>,
    may_change_state: bool,
    server: &'server ControlServer,
}

impl ControlServer {
    /// Creates the control service of a camera; two where requests that change the daemon's state belong to another
    /// group than the others.
    ///
    /// # Errors
    /// As for [`Publisher::open`](crate::Publisher::open).
    pub fn open(node: &Node, camera: &CameraName) -> Result<Self, TransportError> {
        let service = names::control(camera);
        let changes = node.control_variant()?;
        let ports = on_desks!(node, changes, (here, there) => open(here, there, &service)?);
        node.protect_payload(&node.root().path())?;
        if changes.is_some() {
            node.protect_payload(&node.root().control_folder())?;
        }
        Ok(Self { ports, service })
    }

    /// The next request, `None` when there is none.
    ///
    /// # Errors
    /// [`TransportError::Internal`] when shared memory is corrupt.
    pub fn receive(&self) -> Result<Option<PendingRequest<'_>>, TransportError> {
        let received = self
            .ports
            .receive()
            .map_err(|error| TransportError::internal("receive a request on", &self.service, error))?;
        Ok(received.map(|(active, may_change_state)| PendingRequest {
            active,
            may_change_state,
            server: self,
        }))
    }

    /// Waits until something happens or `timeout` has passed; `true` when something happened. Call it
    /// when [`receive`](Self::receive) gave nothing. Stock clients may not notify: keep the timeout
    /// below the latency you owe them.
    ///
    /// # Errors
    /// [`TransportError::Internal`] when the event service is corrupt.
    pub fn wait(&self, timeout: Duration) -> Result<bool, TransportError> {
        self.ports.wait(&self.service, timeout)
    }
}

impl PendingRequest<'_> {
    /// What is asked for. The memory is the client's: check every value.
    pub fn request(&self) -> ControlRequest {
        self.active.request()
    }

    /// Did it come by a way that only those have who may change the daemon's state? Others may ask for the status.
    pub fn may_change_state(&self) -> bool {
        self.may_change_state
    }

    /// Answers and wakes the client. A client that has gone away is no error.
    ///
    /// # Errors
    /// [`TransportError::Internal`] when shared memory is corrupt.
    pub fn reply(self, reply: &ControlReply) -> Result<(), TransportError> {
        let ControlServer { ports, service } = self.server;
        self.active.reply(reply).map_err(|error| TransportError::internal("reply on", service, error))?;
        ports.notify(service)
    }
}

type Received = Option<(Box<dyn Active>, bool)>;

/// The ports of a server, whatever the services are made of.
trait Ports: Debug {
    fn receive(&self) -> Result<Received, ReceiveError>;
    fn wait(&self, service: &str, timeout: Duration) -> Result<bool, TransportError>;
    fn notify(&self, service: &str) -> Result<(), TransportError>;
}

/// A request in shared memory.
trait Active: Debug {
    fn request(&self) -> ControlRequest;
    fn reply(&self, reply: &ControlReply) -> Result<(), String>;
}

#[derive(Debug)]
struct PortsOn<S: Variant> {
    // Ports before the services they belong to: fields are dropped in this order.
    listener: Listener<S>,
    notifier: Notifier<S>,
    desks: Vec<Desk<S>>,
    _events: Events<S>,
}

/// Where requests come in.
#[derive(Debug)]
struct Desk<S: Variant> {
    server: Server<S, ControlRequest, (), ControlReply, ()>,
    _requests: Requests<S>,
    may_change_state: bool,
}

impl<S: Variant + 'static> Ports for PortsOn<S> {
    fn receive(&self) -> Result<Received, ReceiveError> {
        for desk in &self.desks {
            if let Some(active) = desk.server.receive()? {
                return Ok(Some((Box::new(active), desk.may_change_state)));
            }
        }
        Ok(None)
    }

    fn wait(&self, service: &str, timeout: Duration) -> Result<bool, TransportError> {
        wait(&self.listener, service, timeout)
    }

    fn notify(&self, service: &str) -> Result<(), TransportError> {
        notify(&self.notifier, service)
    }
}

impl<S: Variant> Active for ActiveRequest<S, ControlRequest, (), ControlReply, ()> {
    fn request(&self) -> ControlRequest {
        *self.payload()
    }

    fn reply(&self, reply: &ControlReply) -> Result<(), String> {
        let slot = self.loan_uninit().map_err(|error| error.to_string())?;
        if self.is_connected() {
            slot.write_payload(*reply).send().map_err(|error| error.to_string())?;
        }
        Ok(())
    }
}

fn open<S: Variant + 'static>(
    here: &On<'_, S>,
    there: Option<&On<'_, S>>,
    service: &str,
) -> Result<Box<dyn Ports>, TransportError> {
    let mut desks = vec![Desk::open(here, service, there.is_none())?];
    if let Some(there) = there {
        desks.push(Desk::open(there, service, true)?);
    }
    let events = create_events(here, service)?;
    let (listener, notifier) = event_ports(&events, service)?;
    Ok(Box::new(PortsOn { listener, notifier, desks, _events: events }))
}

impl<S: Variant> Desk<S> {
    fn open(on: &On<'_, S>, service: &str, may_change_state: bool) -> Result<Self, TransportError> {
        let requests = create_requests(on, service)?;
        let mut cleaned = false;
        let server = retry("create the server of", service, || {
            requests.server_builder().create().map_err(|error| match error {
                ServerCreateError::ExceedsMaxSupportedServers if cleaned => {
                    Attempt::Failed(TransportError::AlreadyPublished { service: service.to_owned() })
                }
                // The place may be that of a daemon that was killed a moment ago.
                ServerCreateError::ExceedsMaxSupportedServers => {
                    on.node.cleanup_dead_nodes();
                    cleaned = true;
                    Attempt::Again(error.to_string())
                }
                _ => Attempt::Again(error.to_string()),
            })
        })?;
        Ok(Self { server, _requests: requests, may_change_state })
    }
}
