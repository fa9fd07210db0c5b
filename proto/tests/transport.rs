//! Publishing, subscribing and asking within one process.

mod common;

use std::time::{Duration, Instant};

use common::Rig;
use grnet_proto::{
    Access, Command, ControlClient, ControlReply, ControlRequest, ControlServer, DaemonStatus, Outcome,
    PosePublisher, PoseSubscription, StatusPublisher, StatusSubscription, TransportError, qos,
};

const SOON: Duration = Duration::from_secs(5);

fn drain(subscription: &PoseSubscription) -> Vec<u64> {
    std::iter::from_fn(|| subscription.receive().unwrap()).map(|sample| sample.sample).collect()
}

#[test]
fn samples_arrive_in_order_and_wake_the_subscriber() {
    let rig = Rig::new();
    let node = rig.daemon();
    let mut publisher = PosePublisher::open(&node, &rig.camera).unwrap();
    let client = rig.client();
    let subscription = PoseSubscription::open(&client, &rig.camera).unwrap();
    assert!(subscription.has_publisher());
    assert!(subscription.receive().unwrap().is_none());
    for sequence in 10..13 {
        let delivered = publisher.publish(&rig.sample(sequence)).unwrap();
        assert_eq!((delivered.sample, delivered.subscribers), (sequence - 9, 1));
    }
    assert!(subscription.wait(SOON).unwrap());
    let received: Vec<_> = std::iter::from_fn(|| subscription.receive().unwrap()).collect();
    assert_eq!(
        received.iter().map(|s| (s.sample, s.sequence)).collect::<Vec<_>>(),
        [(1, 10), (2, 11), (3, 12)]
    );
    assert!(received.iter().all(|s| s.boot_id == rig.boot_id && s.camera == "front"));
}

#[test]
fn a_wait_ends_at_its_timeout() {
    let rig = Rig::new();
    let node = rig.daemon();
    let publisher = PosePublisher::open(&node, &rig.camera).unwrap();
    let subscription = PoseSubscription::open(&node, &rig.camera).unwrap();
    // Attaching ports are events of their own.
    while subscription.wait(Duration::ZERO).unwrap() {}
    let start = Instant::now();
    assert!(!subscription.wait(Duration::from_millis(50)).unwrap());
    assert!(start.elapsed() >= Duration::from_millis(50));
    drop(publisher);
    assert!(subscription.wait(SOON).unwrap(), "a daemon that goes is an event");
    assert!(!subscription.has_publisher());
}

#[test]
fn a_late_joiner_gets_the_last_sample() {
    let rig = Rig::new();
    let node = rig.daemon();
    let mut publisher = PosePublisher::open(&node, &rig.camera).unwrap();
    for sequence in 0..5 {
        publisher.publish(&rig.sample(sequence)).unwrap();
    }
    let subscription = PoseSubscription::open(&rig.client(), &rig.camera).unwrap();
    assert_eq!(publisher.subscribers(), 1);
    publisher.update_connections().unwrap();
    assert_eq!(drain(&subscription), [5]);
}

#[test]
fn a_slow_subscriber_loses_the_oldest_and_can_tell() {
    let rig = Rig::new();
    let node = rig.daemon();
    let mut publisher = PosePublisher::open(&node, &rig.camera).unwrap();
    let slow = PoseSubscription::open(&rig.client(), &rig.camera).unwrap();
    let total = qos::SUBSCRIBER_BUFFER as u64 + 100;
    let start = Instant::now();
    for sequence in 0..total {
        publisher.publish(&rig.sample(sequence)).unwrap();
    }
    assert!(start.elapsed() < SOON, "the publisher waited for a slow subscriber");
    let received = drain(&slow);
    assert_eq!(received.len(), qos::SUBSCRIBER_BUFFER);
    assert_eq!(*received.last().unwrap(), total);
    assert!(received.windows(2).all(|pair| pair[1] == pair[0] + 1));
}

/// The folder of POSIX shared memory shows what a client did not finish; files are waited for in the same way.
#[cfg(not(feature = "group-access"))]
#[test]
fn a_half_attached_client_holds_a_publication_up_by_the_configured_time_at_most() {
    use std::{fs::Permissions, os::unix::fs::PermissionsExt};

    const PREFIX: &str = "grnet_half_";
    let rig = Rig::new();
    let limit = Duration::from_millis(20);
    let root = grnet_proto::Root::own(&rig.path, Some(PREFIX)).unwrap().with_creation_timeout(limit);
    let open = |role| grnet_proto::Node::open(grnet_proto::AccessMode::User, &root, role).unwrap();
    let (daemon, client) = (open(grnet_proto::Role::Daemon), open(grnet_proto::Role::Client));
    let mut publisher = PosePublisher::open(&daemon, &rig.camera).unwrap();
    let whole = PoseSubscription::open(&client, &rig.camera).unwrap();
    publisher.publish(&rig.sample(0)).unwrap();

    let connections = || {
        let names = std::fs::read_dir("/dev/shm").unwrap().map(|entry| entry.unwrap().path());
        names
            .filter(|path| {
                let name = path.file_name().unwrap().to_string_lossy();
                name.starts_with(PREFIX) && name.ends_with(".connection")
            })
            .collect::<Vec<_>>()
    };
    let before = connections();
    let _half = PoseSubscription::open(&client, &rig.camera).unwrap();
    let halves: Vec<_> = connections().into_iter().filter(|path| !before.contains(path)).collect();
    assert_eq!(halves.len(), 1, "the client makes the connection: {before:?}");
    let set_mode = |mode| std::fs::set_permissions(&halves[0], Permissions::from_mode(mode)).unwrap();
    // As it is before the client has filled it in.
    set_mode(0o200);
    let start = Instant::now();
    publisher.publish(&rig.sample(1)).unwrap();
    let held_up = start.elapsed();
    set_mode(0o600);
    assert!(publisher.failed_connections() > 0);
    // iceoryx2 by itself would wait for a second.
    assert!(held_up >= limit && held_up < Duration::from_millis(900), "{held_up:?}");
    assert_eq!(drain(&whole), [1, 2]);
}

#[test]
fn the_seventeenth_subscriber_is_told_so() {
    let rig = Rig::new();
    let node = rig.daemon();
    let mut publisher = PosePublisher::open(&node, &rig.camera).unwrap();
    let client = rig.client();
    let mut subscriptions: Vec<_> =
        (0..qos::MAX_SUBSCRIBERS).map(|_| PoseSubscription::open(&client, &rig.camera).unwrap()).collect();
    let error = PoseSubscription::open(&client, &rig.camera).unwrap_err();
    assert_eq!(error, TransportError::TooManySubscribers { service: "grnet/front/pose".to_owned(), max: 16 });
    assert_eq!(publisher.publish(&rig.sample(1)).unwrap().subscribers, 16);
    subscriptions.pop();
    assert!(PoseSubscription::open(&client, &rig.camera).is_ok(), "a place that became free is given away");
}

#[test]
fn a_second_daemon_is_refused() {
    let rig = Rig::new();
    let node = rig.daemon();
    let first = PosePublisher::open(&node, &rig.camera).unwrap();
    let error = PosePublisher::open(&rig.daemon(), &rig.camera).unwrap_err();
    assert!(matches!(error, TransportError::AlreadyPublished { .. }), "{error}");
    drop(first);
    PosePublisher::open(&rig.daemon(), &rig.camera).unwrap();
}

#[test]
fn without_a_daemon_there_is_nothing_to_open() {
    let rig = Rig::new();
    let node = rig.client();
    for error in [
        PoseSubscription::open(&node, &rig.camera).unwrap_err(),
        StatusSubscription::open(&node, &rig.camera).unwrap_err(),
        ControlClient::open(&node, &rig.camera).unwrap_err(),
    ] {
        assert!(matches!(error, TransportError::NoDaemon { .. }), "{error}");
        assert!(error.to_string().contains("systemctl start grnetd"), "{error}");
    }
    // Other clients may keep the service alive: it is still nobody's.
    let daemon = rig.daemon();
    let publisher = PosePublisher::open(&daemon, &rig.camera).unwrap();
    let attached = PoseSubscription::open(&node, &rig.camera).unwrap();
    drop(publisher);
    let error = PoseSubscription::open(&rig.client(), &rig.camera).unwrap_err();
    assert!(matches!(error, TransportError::NoDaemon { .. }), "{error}");
    // And the attached one resumes with the next daemon.
    let mut publisher = PosePublisher::open(&rig.daemon(), &rig.camera).unwrap();
    publisher.publish(&rig.sample(1)).unwrap();
    assert_eq!(drain(&attached), [1]);
}

// Strangers find the services in shared memory alone.
#[cfg(not(feature = "group-access"))]
#[test]
fn a_foreign_type_under_our_name_is_named() {
    use iceoryx2::prelude::{AttributeSpecifier, NodeBuilder, ipc};
    use iceoryx2::service::attribute::{AttributeKey, AttributeValue};

    let rig = Rig::new();
    let mut config = iceoryx2::prelude::Config::global_config().clone();
    config.global.set_root_path(
        &iceoryx2::prelude::SemanticString::new(rig.path.as_os_str().as_encoded_bytes()).unwrap(),
    );
    config.global.prefix = iceoryx2::prelude::SemanticString::new(rig.root.prefix().as_bytes()).unwrap();
    let node = NodeBuilder::new().config(&config).create::<ipc::Service>().unwrap();
    let attributes = AttributeSpecifier::new()
        .define(
            &AttributeKey::try_from(qos::ATTRIBUTE_SCHEMA).unwrap(),
            &AttributeValue::try_from("9").unwrap(),
        )
        .unwrap()
        .define(
            &AttributeKey::try_from(qos::ATTRIBUTE_VERSION).unwrap(),
            &AttributeValue::try_from("7.7.7").unwrap(),
        )
        .unwrap();
    let _foreign = node
        .service_builder(&"grnet/front/pose".try_into().unwrap())
        .publish_subscribe::<u64>()
        .create_with_attributes(&attributes)
        .unwrap();
    for error in [
        PoseSubscription::open(&rig.client(), &rig.camera).unwrap_err(),
        PosePublisher::open(&rig.daemon(), &rig.camera).unwrap_err(),
    ] {
        let TransportError::SchemaMismatch { found, expected, .. } = &error else { panic!("{error}") };
        assert!(
            found.contains("u64 of 8 bytes") && found.contains("schema 9") && found.contains("7.7.7"),
            "{found}"
        );
        assert!(
            expected.contains("grnet.PoseSample.v1 of 1280 bytes") && expected.contains("schema 1"),
            "{expected}"
        );
    }
}

// Strangers find the services in shared memory alone.
#[cfg(not(feature = "group-access"))]
#[test]
fn a_service_of_a_stranger_with_other_settings_is_named() {
    let rig = Rig::new();
    let mut config = iceoryx2::prelude::Config::global_config().clone();
    config.global.set_root_path(
        &iceoryx2::prelude::SemanticString::new(rig.path.as_os_str().as_encoded_bytes()).unwrap(),
    );
    config.global.prefix = iceoryx2::prelude::SemanticString::new(rig.root.prefix().as_bytes()).unwrap();
    let node = iceoryx2::prelude::NodeBuilder::new()
        .config(&config)
        .create::<iceoryx2::prelude::ipc::Service>()
        .unwrap();
    // A stock client that creates what it does not find.
    let _foreign = node
        .service_builder(&"grnet/front/pose".try_into().unwrap())
        .publish_subscribe::<grnet_proto::PoseSample>()
        .open_or_create()
        .unwrap();
    let error = PosePublisher::open(&rig.daemon(), &rig.camera).unwrap_err();
    assert!(matches!(error, TransportError::Incompatible { .. }), "{error}");
    let error = PoseSubscription::open(&rig.client(), &rig.camera).unwrap_err();
    assert!(matches!(error, TransportError::NoDaemon { .. }), "{error}");
}

#[test]
fn status_reaches_its_subscribers() {
    let rig = Rig::new();
    let node = rig.daemon();
    let mut publisher = StatusPublisher::open(&node, &rig.camera).unwrap();
    let subscription = StatusSubscription::open(&rig.client(), &rig.camera).unwrap();
    publisher.publish(&DaemonStatus::unknown(rig.boot_id, &rig.camera, Access::USER)).unwrap();
    assert!(subscription.wait(SOON).unwrap());
    let status = subscription.receive().unwrap().unwrap();
    assert_eq!((status.sample, status.boot_id, status.pid), (1, rig.boot_id, std::process::id()));
}

#[test]
fn a_request_gets_its_reply() {
    let rig = Rig::new();
    std::thread::scope(|scope| {
        let (ready, is_ready) = std::sync::mpsc::channel();
        let rig = &rig;
        scope.spawn(move || {
            let node = rig.daemon();
            let server = ControlServer::open(&node, &rig.camera).unwrap();
            ready.send(()).unwrap();
            let mut answered = 0;
            while answered < 2 {
                while let Some(pending) = server.receive().unwrap() {
                    let request = pending.request();
                    let status = DaemonStatus::unknown(rig.boot_id, &rig.camera, Access::USER);
                    pending
                        .reply(&ControlReply::new(&request, Outcome::DONE, &request.text.to_string(), status))
                        .unwrap();
                    answered += 1;
                }
                server.wait(SOON).unwrap();
            }
        });
        is_ready.recv().unwrap();
        let node = rig.client();
        let mut client = ControlClient::open(&node, &rig.camera).unwrap();
        for text in ["kitchen", "cellar"] {
            let request = ControlRequest::with_text(Command::SELECT_SCENE, text).unwrap();
            let reply = client.call(&request, SOON).unwrap();
            assert_eq!((reply.outcome, reply.boot_id), (Outcome::DONE, rig.boot_id));
            assert!(reply.message == text, "{}", reply.message);
        }
    });
}

#[test]
fn a_daemon_that_does_not_answer_is_an_error_in_time() {
    let rig = Rig::new();
    let node = rig.daemon();
    let _silent = ControlServer::open(&node, &rig.camera).unwrap();
    let mut client = ControlClient::open(&node, &rig.camera).unwrap();
    let start = Instant::now();
    let error = client.call(&ControlRequest::new(Command::STATUS), Duration::from_millis(100)).unwrap_err();
    assert_eq!(error, TransportError::NoAnswer { service: "grnet/front/control".to_owned(), waited_ms: 100 });
    assert!(start.elapsed() < SOON);
}

// Strangers find the services in shared memory alone.
#[cfg(not(feature = "group-access"))]
#[test]
fn the_access_mode_is_readable_on_the_service() {
    use iceoryx2::prelude::{MessagingPattern, Service, ipc};
    let rig = Rig::new();
    let node = rig.daemon();
    let _publisher = PosePublisher::open(&node, &rig.camera).unwrap();
    let mut config = iceoryx2::prelude::Config::global_config().clone();
    config.global.set_root_path(
        &iceoryx2::prelude::SemanticString::new(rig.path.as_os_str().as_encoded_bytes()).unwrap(),
    );
    config.global.prefix = iceoryx2::prelude::SemanticString::new(rig.root.prefix().as_bytes()).unwrap();
    for pattern in [MessagingPattern::PublishSubscribe, MessagingPattern::Event] {
        let details = ipc::Service::details(&"grnet/front/pose".try_into().unwrap(), &config, pattern)
            .unwrap()
            .unwrap();
        let attributes = details.static_details.attributes();
        let value = |key: &str| {
            let key = iceoryx2::service::attribute::AttributeKey::try_from(key).unwrap();
            attributes.key_value(&key, 0).unwrap().to_string()
        };
        assert_eq!(value(qos::ATTRIBUTE_ACCESS), "user");
        assert_eq!(value(qos::ATTRIBUTE_SCHEMA), "1");
        assert_eq!(value(qos::ATTRIBUTE_VERSION), env!("CARGO_PKG_VERSION"));
    }
}
