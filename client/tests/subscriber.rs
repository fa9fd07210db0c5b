//! The library against publishers in the same process and against processes that are killed.

mod common;

use std::{ops::ControlFlow, sync::mpsc, time::Duration};

use common::{Rig, SOON, wait_until};
use grnet_client::{ClientError, ControlClient, PoseSubscriber, StatusReader, subscribe};

const SHORT: Duration = Duration::from_millis(50);

#[test]
#[ignore = "the daemon process of the other tests"]
fn daemon_process() {
    common::publish_for_ever();
}

#[test]
fn samples_come_in_order_and_a_slow_subscriber_counts_what_it_lost() {
    let rig = Rig::new();
    let mut publisher = rig.publisher();
    let mut poses = PoseSubscriber::open(&rig.connection).unwrap();
    assert!(poses.try_next().unwrap().is_none());
    publisher.publish(&rig.sample(0)).unwrap();
    let first = poses.next_within(SOON).unwrap();
    assert_eq!(
        (first.sequence(), first.boot_id(), poses.boot_id()),
        (Some(0), rig.boot_id, Some(rig.boot_id))
    );
    assert_eq!(first.odom_from_base().unwrap().translation.vector.as_slice(), [0.0, 0.5, 0.0]);
    assert_eq!(first.map_from_base(), None);
    assert!(first.transport_latency_us() > 0.0);

    let buffer = grnet_proto::qos::SUBSCRIBER_BUFFER as u64;
    for sequence in 1..=buffer + 100 {
        publisher.publish(&rig.sample(sequence)).unwrap();
    }
    let sequences: Vec<_> =
        std::iter::from_fn(|| poses.try_next().unwrap()).map(|sample| sample.sequence().unwrap()).collect();
    assert_eq!(sequences, (101..=buffer + 100).collect::<Vec<_>>());
    assert_eq!((poses.lost_samples(), poses.restarts()), (100, 0));
}

#[test]
fn the_newest_sample_is_the_newest() {
    let rig = Rig::new();
    let mut publisher = rig.publisher();
    let mut poses = PoseSubscriber::open(&rig.connection).unwrap();
    for sequence in 0..10 {
        publisher.publish(&rig.sample(sequence)).unwrap();
    }
    assert_eq!(poses.latest_within(SOON).unwrap().sequence(), Some(9));
    assert_eq!((poses.skipped_samples(), poses.lost_samples()), (9, 0));
    assert!(matches!(poses.latest_within(SHORT), Err(ClientError::Timeout { .. })));
}

#[test]
fn the_iterator_gives_samples_and_says_when_none_came() {
    let rig = Rig::new();
    let mut publisher = rig.publisher();
    let mut poses = PoseSubscriber::open(&rig.connection).unwrap();
    for sequence in 0..3 {
        publisher.publish(&rig.sample(sequence)).unwrap();
    }
    let sequences: Vec<_> = poses.samples(SHORT).map_while(|sample| sample.ok()?.sequence()).collect();
    assert_eq!(sequences, [0, 1, 2]);
    publisher.publish(&rig.sample(3)).unwrap();
    assert_eq!(poses.samples(SOON).next().unwrap().unwrap().sequence(), Some(3));
}

#[test]
fn silence_and_absence_are_told_apart() {
    let rig = Rig::new();
    assert!(matches!(PoseSubscriber::open(&rig.connection), Err(ClientError::NoDaemon(_))));
    assert!(matches!(StatusReader::open(&rig.connection), Err(ClientError::NoDaemon(_))));
    assert!(matches!(ControlClient::open(&rig.connection, SHORT), Err(ClientError::NoDaemon(_))));
    let publisher = rig.publisher();
    let mut poses = PoseSubscriber::open(&rig.connection).unwrap();
    assert!(matches!(poses.next_within(SHORT), Err(ClientError::Timeout { .. })));
    assert!(poses.has_daemon());
    drop(publisher);
    assert!(matches!(poses.next_within(SHORT), Err(ClientError::NoDaemon(_))));
    assert!(!poses.has_daemon());
    // Both are passing states: the same subscriber goes on with the next daemon.
    let mut publisher = rig.publisher();
    publisher.publish(&rig.sample(5)).unwrap();
    assert_eq!(poses.next_within(SOON).unwrap().sequence(), Some(5));
}

#[test]
fn a_killed_daemon_is_missed_and_its_successor_found() {
    let rig = Rig::new();
    let daemon = rig.daemon();
    let mut poses = PoseSubscriber::open(&rig.connection).unwrap();
    let mut states = StatusReader::open(&rig.connection).unwrap();
    let first_boot = poses.next_within(SOON).unwrap().boot_id();
    assert_eq!(states.read(SOON).unwrap().boot_id, first_boot);
    daemon.kill();
    wait_until("the daemon is missed", || {
        matches!(poses.next_within(Duration::from_millis(700)), Err(ClientError::NoDaemon(_)))
    });

    let _daemon = rig.daemon();
    let sample = poses.next_within(SOON).unwrap();
    assert_ne!(sample.boot_id(), first_boot);
    assert_eq!(poses.restarts(), 1);
    wait_until("the status is the successor's", || states.read(SOON).unwrap().boot_id == sample.boot_id());
}

#[test]
fn a_subscriber_lets_go_when_no_daemon_comes_back_and_says_when_another_version_did() {
    use iceoryx2::prelude::{Config, NodeBuilder, SemanticString, ipc};

    let rig = Rig::new();
    let mut publisher = rig.publisher();
    let mut poses = PoseSubscriber::open(&rig.connection).unwrap();
    publisher.publish(&rig.sample(0)).unwrap();
    poses.next_within(SOON).unwrap();
    drop(publisher);

    let mut config = Config::global_config().clone();
    config
        .global
        .set_root_path(&SemanticString::new(rig.folder.path().as_os_str().as_encoded_bytes()).unwrap());
    config.global.prefix = SemanticString::new(rig.connection.root.prefix().as_bytes()).unwrap();
    let node = NodeBuilder::new().config(&config).create::<ipc::Service>().unwrap();
    // What a daemon with another type of message would do.
    let create =
        || node.service_builder(&"grnet/front/pose".try_into().unwrap()).publish_subscribe::<u64>().create();
    assert!(create().is_err(), "the subscriber still holds the service");
    let mut other_version = None;
    wait_until("the subscriber lets go", || {
        assert!(matches!(poses.next_within(Duration::from_millis(500)), Err(ClientError::NoDaemon(_))));
        other_version = create().ok();
        other_version.is_some()
    });
    let error = poses.next_within(SOON).unwrap_err();
    assert!(matches!(error, ClientError::SchemaMismatch(_)), "{error}");
}

#[test]
fn a_callback_gets_the_samples_on_a_thread_of_its_own() {
    let rig = Rig::new();
    assert!(matches!(
        subscribe(&rig.connection, |_| ControlFlow::Continue(())),
        Err(ClientError::NoDaemon(_))
    ));
    let mut publisher = rig.publisher();
    let (received, samples) = mpsc::channel();
    let subscription = subscribe(&rig.connection, move |sample| {
        received.send((std::thread::current().id(), sample.sequence())).unwrap();
        if sample.sequence() == Some(2) { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
    })
    .unwrap();
    for sequence in 0..3 {
        publisher.publish(&rig.sample(sequence)).unwrap();
        let (thread, got) = samples.recv_timeout(SOON).unwrap();
        assert_eq!(got, Some(sequence));
        assert_ne!(thread, std::thread::current().id());
    }
    wait_until("the callback's break ended the thread", || subscription.is_finished());
    subscription.stop().unwrap();
}
