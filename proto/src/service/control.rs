//! Requests to the daemon and its replies.

use std::time::{Duration, Instant};

use iceoryx2::{
    active_request::ActiveRequest,
    port::{client::Client, listener::Listener, notifier::Notifier, server::Server},
    prelude::{MessagingPattern, PortFactory as _, ipc},
    service::{
        builder::request_response::{RequestResponseCreateError, RequestResponseOpenError},
        port_factory::{request_response::PortFactory, server::ServerCreateError},
    },
};

use super::{
    open::{Events, create_events, no_daemon, open_events, permission_attempt, schema_mismatch},
    subscription::wait,
};
use crate::{
    CameraName, ControlReply, ControlRequest, Node, TransportError, names,
    names::service_name,
    node::{Attempt, retry},
    qos,
};

type Service = PortFactory<ipc::Service, ControlRequest, (), ControlReply, ()>;

/// Receives requests: the daemon's side of `grnet/<camera>/control`.
///
/// Neither `Send` nor `Sync`: open it on the thread that answers.
#[derive(Debug)]
pub struct ControlServer {
    listener: Listener<ipc::Service>,
    notifier: Notifier<ipc::Service>,
    server: Server<ipc::Service, ControlRequest, (), ControlReply, ()>,
    _events: Events,
    _requests: Service,
    service: String,
}

/// A request that waits for its reply.
#[derive(Debug)]
pub struct PendingRequest<'server> {
    active: ActiveRequest<ipc::Service, ControlRequest, (), ControlReply, ()>,
    server: &'server ControlServer,
}

/// Sends requests: a client's side of `grnet/<camera>/control`.
///
/// Neither `Send` nor `Sync`: open it on the thread that asks.
#[derive(Debug)]
pub struct ControlClient {
    listener: Listener<ipc::Service>,
    notifier: Notifier<ipc::Service>,
    client: Client<ipc::Service, ControlRequest, (), ControlReply, ()>,
    _events: Events,
    requests: Service,
    service: String,
    next_request_id: u64,
}

impl ControlServer {
    /// Creates the control service of a camera.
    ///
    /// # Errors
    /// As for [`Publisher::open`](crate::Publisher::open).
    pub fn open(node: &Node, camera: &CameraName) -> Result<Self, TransportError> {
        let service = names::control(camera);
        let requests = create_requests(node, &service)?;
        let events = create_events(node, &service)?;
        let mut cleaned = false;
        let server = retry("create the server of", &service, || {
            requests.server_builder().create().map_err(|error| match error {
                ServerCreateError::ExceedsMaxSupportedServers if cleaned => {
                    Attempt::Failed(TransportError::AlreadyPublished { service: service.clone() })
                }
                // The place may be that of a daemon that was killed a moment ago.
                ServerCreateError::ExceedsMaxSupportedServers => {
                    node.cleanup_dead_nodes();
                    cleaned = true;
                    Attempt::Again(error.to_string())
                }
                _ => Attempt::Again(error.to_string()),
            })
        })?;
        let (listener, notifier) = event_ports(&events, &service)?;
        Ok(Self { listener, notifier, server, _events: events, _requests: requests, service })
    }

    /// The next request, `None` when there is none.
    ///
    /// # Errors
    /// [`TransportError::Internal`] when shared memory is corrupt.
    pub fn receive(&self) -> Result<Option<PendingRequest<'_>>, TransportError> {
        let active = self
            .server
            .receive()
            .map_err(|error| TransportError::internal("receive a request on", &self.service, error))?;
        Ok(active.map(|active| PendingRequest { active, server: self }))
    }

    /// Waits until something happens or `timeout` has passed; `true` when something happened. Call it
    /// when [`receive`](Self::receive) gave nothing. Stock clients may not notify: keep the timeout
    /// below the latency you owe them.
    ///
    /// # Errors
    /// [`TransportError::Internal`] when the event service is corrupt.
    pub fn wait(&self, timeout: Duration) -> Result<bool, TransportError> {
        wait(&self.listener, &self.service, timeout)
    }
}

impl PendingRequest<'_> {
    /// What is asked for. The memory is the client's: check every value.
    pub fn request(&self) -> ControlRequest {
        *self.active.payload()
    }

    /// Answers and wakes the client. A client that has gone away is no error.
    ///
    /// # Errors
    /// [`TransportError::Internal`] when shared memory is corrupt.
    pub fn reply(self, reply: &ControlReply) -> Result<(), TransportError> {
        let service = &self.server.service;
        let slot = self
            .active
            .loan_uninit()
            .map_err(|error| TransportError::internal("reply on", service, error))?;
        if self.active.is_connected() {
            slot.write_payload(*reply)
                .send()
                .map_err(|error| TransportError::internal("reply on", service, error))?;
        }
        notify(&self.server.notifier, service)
    }
}

impl ControlClient {
    /// Attaches to the control service of a camera.
    ///
    /// # Errors
    /// [`TransportError::NoDaemon`], [`TransportError::SchemaMismatch`],
    /// [`TransportError::PermissionDenied`], [`TransportError::TooManySubscribers`].
    pub fn open(node: &Node, camera: &CameraName) -> Result<Self, TransportError> {
        let service = names::control(camera);
        let requests = open_requests(node, &service)?;
        if requests.dynamic_config().number_of_servers() == 0 {
            return Err(no_daemon(node, &service));
        }
        let events = open_events(node, &service)?;
        let client = requests.client_builder().create().map_err(|error| {
            use iceoryx2::service::port_factory::client::ClientCreateError as E;
            match error {
                E::ExceedsMaxSupportedClients => TransportError::TooManySubscribers {
                    service: service.clone(),
                    max: qos::MAX_CONTROL_CLIENTS,
                },
                _ => TransportError::internal("create the client of", &service, error),
            }
        })?;
        let (listener, notifier) = event_ports(&events, &service)?;
        Ok(Self { listener, notifier, client, _events: events, requests, service, next_request_id: 1 })
    }

    /// Whether somebody answers. A daemon that was killed counts until its leftovers are cleared away.
    pub fn has_server(&self) -> bool {
        self.requests.dynamic_config().number_of_servers() > 0
    }

    /// Asks and waits for the answer. The request's id is chosen here.
    ///
    /// # Errors
    /// [`TransportError::NoAnswer`] when the daemon does not answer in time,
    /// [`TransportError::NoDaemon`] when nobody is there to ask.
    pub fn call(
        &mut self,
        request: &ControlRequest,
        timeout: Duration,
    ) -> Result<ControlReply, TransportError> {
        let deadline = Instant::now() + timeout;
        let request_id = self.next_request_id;
        self.next_request_id += 1;
        let pending = self
            .client
            .send_copy(ControlRequest { request_id, ..*request })
            .map_err(|error| TransportError::internal("send a request on", &self.service, error))?;
        notify(&self.notifier, &self.service)?;
        loop {
            let reply = pending
                .receive()
                .map_err(|error| TransportError::internal("receive a reply on", &self.service, error))?;
            if let Some(reply) = reply {
                return Ok(*reply.payload());
            }
            let remaining = deadline.saturating_duration_since(Instant::now());
            if remaining.is_zero() {
                return Err(TransportError::NoAnswer {
                    service: self.service.clone(),
                    waited_ms: timeout.as_millis(),
                });
            }
            wait(&self.listener, &self.service, remaining)?;
        }
    }
}

fn event_ports(
    events: &Events,
    service: &str,
) -> Result<(Listener<ipc::Service>, Notifier<ipc::Service>), TransportError> {
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

fn notify(notifier: &Notifier<ipc::Service>, service: &str) -> Result<(), TransportError> {
    use iceoryx2::port::notifier::NotifierNotifyError as E;
    match notifier.notify() {
        Ok(_) | Err(E::MissedDeadline | E::UnableToAcquireElapsedTime) => Ok(()),
        Err(error) => Err(TransportError::internal("notify", service, error)),
    }
}

fn open_requests(node: &Node, service: &str) -> Result<Service, TransportError> {
    retry("open", service, || {
        node.iox()
            .service_builder(&service_name(service))
            .request_response::<ControlRequest, ControlReply>()
            .open()
            .map_err(|error| open_attempt(node, service, error))
    })
}

fn create_requests(node: &Node, service: &str) -> Result<Service, TransportError> {
    retry("create", service, || {
        let builder = || {
            node.iox()
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
                .create_with_attributes(&qos::attributes(node.access()))
                .map_err(|error| match error {
                    RequestResponseCreateError::InsufficientPermissions => permission_attempt(node, error),
                    _ => Attempt::Again(error.to_string()),
                }),
            Err(error) => Err(open_attempt(node, service, error)),
        }
    })
}

fn open_attempt(node: &Node, service: &str, error: RequestResponseOpenError) -> Attempt {
    use RequestResponseOpenError as E;
    Attempt::Failed(match error {
        E::DoesNotExist => no_daemon(node, service),
        E::IncompatibleRequestOrResponseType | E::IncompatibleAttributes | E::VersionMismatch => {
            schema_mismatch(
                node,
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
        E::InsufficientPermissions => return permission_attempt(node, error),
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
