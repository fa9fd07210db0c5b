//! Quality of service: what every service keeps, admits and promises. Shared by daemon and clients.

use iceoryx2::prelude::{AttributeSpecifier, EventId};
use iceoryx2::service::attribute::{AttributeKey, AttributeValue};

use crate::{ControlReply, ControlRequest, DaemonStatus, PoseSample, SCHEMA_VERSION, access::AccessMode};

/// A client that joins late gets the last message.
pub const HISTORY: usize = 1;

/// Messages a subscriber may be behind before the oldest are overwritten (2 s at 30 Hz).
pub const SUBSCRIBER_BUFFER: usize = 64;

/// Messages a subscriber may hold on to at once.
pub const BORROWED_SAMPLES: usize = 2;

/// Subscribers of one service.
pub const MAX_SUBSCRIBERS: usize = 16;

/// Publishers of one service: the daemon.
pub const MAX_PUBLISHERS: usize = 1;

/// Control clients that may be attached at once.
pub const MAX_CONTROL_CLIENTS: usize = 16;

/// Nodes of one service: every subscriber, the daemon, and room for tools that only look.
pub const MAX_NODES: usize = 40;

/// Listeners of an event service: every subscriber, and tools.
pub const MAX_LISTENERS: usize = 32;

/// Events: something was published, a request came, or a reply came.
pub(crate) const EVENT_MESSAGE: usize = 0;
/// A publisher (daemon) attached.
pub(crate) const EVENT_ATTACHED: usize = 1;
/// A publisher (daemon) detached.
pub(crate) const EVENT_DETACHED: usize = 2;
/// A publisher (daemon) was found dead.
pub(crate) const EVENT_DEAD: usize = 3;
/// The largest event id, with room for later ones.
pub(crate) const EVENT_MAX: usize = 15;

/// Attribute that holds the version of the messages.
pub const ATTRIBUTE_SCHEMA: &str = "grnet.schema";
/// Attribute that holds the version of the package that created the service.
pub const ATTRIBUTE_VERSION: &str = "grnet.version";
/// Attribute that holds the access mode.
pub const ATTRIBUTE_ACCESS: &str = "grnet.access";

/// Shared memory that all services of one camera take at most, in bytes.
pub const fn shared_memory_needed_bytes() -> u64 {
    // Header of a chunk, bookkeeping of a connection and of a service: generous upper bounds.
    const CHUNK: usize = 128;
    const CONNECTION: usize = 8 * 1024;
    const SERVICE: usize = 64 * 1024;
    let chunks = MAX_SUBSCRIBERS * (SUBSCRIBER_BUFFER + BORROWED_SAMPLES) + HISTORY + 2;
    let streams = chunks * (size_of::<PoseSample>() + size_of::<DaemonStatus>() + 2 * CHUNK);
    let control =
        MAX_CONTROL_CLIENTS * 4 * (size_of::<ControlRequest>() + size_of::<ControlReply>() + 2 * CHUNK);
    (streams + control + 3 * MAX_SUBSCRIBERS * CONNECTION + 6 * SERVICE) as u64
}

/// The attributes with which the daemon creates a service.
pub(crate) fn attributes(access: AccessMode) -> AttributeSpecifier {
    [
        (ATTRIBUTE_SCHEMA, SCHEMA_VERSION.to_string()),
        (ATTRIBUTE_VERSION, crate::PACKAGE_VERSION.to_owned()),
        (ATTRIBUTE_ACCESS, access.name().to_owned()),
    ]
    .into_iter()
    .fold(AttributeSpecifier::new(), |attributes, (key, value)| {
        let value = AttributeValue::try_from(value.as_str()).expect("attribute values are short");
        attributes
            .define(&attribute_key(key), &value)
            .expect("there are fewer attributes than iceoryx2 admits")
    })
}

pub(crate) fn attribute_key(key: &str) -> AttributeKey {
    AttributeKey::try_from(key).expect("attribute keys are short")
}

pub(crate) fn event(id: usize) -> EventId {
    EventId::new(id)
}

#[cfg(test)]
mod tests {
    #[test]
    fn the_services_fit_into_a_small_machine() {
        let needed = super::shared_memory_needed_bytes();
        assert!((1 << 20..32 << 20).contains(&needed), "{needed}");
    }
}
