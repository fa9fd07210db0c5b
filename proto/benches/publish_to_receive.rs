//! From `publish` to the sample in the hands of a subscriber on another thread, beside a Unix datagram
//! of the same size: the round trip of a ping-pong, halved.

use std::{
    hint::black_box,
    os::unix::{fs::PermissionsExt, net::UnixDatagram},
    time::{Duration, Instant},
};

use criterion::{BenchmarkId, Criterion, Throughput, criterion_group, criterion_main};
use grnet_proto::{
    AccessMode, BootId, CameraName, Message, Node, PoseSample, Publisher, Reason, Role, Root, Status,
    Subscription,
};

/// How the services are made: iceoryx2's own shared memory, and files where this build has them.
const KINDS: &[(&str, AccessMode)] = &[
    #[cfg(not(feature = "group-access"))]
    ("ipc", AccessMode::User),
    #[cfg(feature = "group-access")]
    ("ipc", AccessMode::Everyone),
    #[cfg(feature = "group-access")]
    ("files", AccessMode::User),
];

/// Answers every ping with a pong until told to stop.
const STOP: u64 = u64::MAX - 1;

fn sample() -> PoseSample {
    let camera = CameraName::default();
    PoseSample::unknown(BootId([1; 16]), &camera, Status::TRACKING, Reason::NONE)
}

fn blocking_receive<M: Message>(subscription: &Subscription<M>) -> M {
    loop {
        if let Some(message) = subscription.receive().unwrap() {
            return message;
        }
        subscription.wait(Duration::from_secs(1)).unwrap();
    }
}

fn polling_receive<M: Message>(subscription: &Subscription<M>) -> M {
    loop {
        if let Some(message) = subscription.receive().unwrap() {
            return message;
        }
        std::hint::spin_loop();
    }
}

/// A folder on the file system of shared memory, as `/run` is on one; as open as the access asks for.
fn folder(access: AccessMode) -> tempfile::TempDir {
    let folder = tempfile::Builder::new().prefix("grnet").tempdir_in("/dev/shm").unwrap();
    let mode = if access == AccessMode::Everyone { 0o777 } else { 0o700 };
    std::fs::set_permissions(folder.path(), PermissionsExt::from_mode(mode)).unwrap();
    folder
}

/// Half the time of `iterations` round trips between two cameras' pose streams.
fn ping_pong(
    access: AccessMode,
    iterations: u64,
    receive: fn(&Subscription<PoseSample>) -> PoseSample,
) -> Duration {
    let folder = folder(access);
    let root = Root::own(folder.path(), Some("bench_")).unwrap();
    let (ping, pong): (CameraName, CameraName) = ("ping".parse().unwrap(), "pong".parse().unwrap());
    let node = Node::open(access, &root, Role::Daemon).unwrap();
    let mut pings = Publisher::<PoseSample>::open(&node, &ping).unwrap();
    std::thread::scope(|scope| {
        let (root, ping, pong) = (&root, &ping, &pong);
        let (ready, is_ready) = std::sync::mpsc::channel();
        scope.spawn(move || {
            let node = Node::open(access, root, Role::Daemon).unwrap();
            let mut pongs = Publisher::<PoseSample>::open(&node, pong).unwrap();
            let pings = Subscription::open(&node, ping).unwrap();
            ready.send(()).unwrap();
            loop {
                let sample = receive(&pings);
                if sample.sequence == STOP {
                    return;
                }
                pongs.publish(&sample).unwrap();
            }
        });
        is_ready.recv().unwrap();
        let pongs = Subscription::open(&node, pong).unwrap();
        let sample = sample();
        let start = Instant::now();
        for _ in 0..iterations {
            pings.publish(black_box(&sample)).unwrap();
            black_box(receive(&pongs));
        }
        let elapsed = start.elapsed();
        pings.publish(&PoseSample { sequence: STOP, ..sample }).unwrap();
        elapsed / 2
    })
}

fn datagram_ping_pong(iterations: u64, size: usize) -> Duration {
    let (near, far) = UnixDatagram::pair().unwrap();
    std::thread::scope(|scope| {
        scope.spawn(move || {
            let mut buffer = vec![0; size];
            while far.recv(&mut buffer).unwrap() == size {
                far.send(&buffer).unwrap();
            }
        });
        let mut buffer = vec![1; size];
        let start = Instant::now();
        for _ in 0..iterations {
            near.send(black_box(&buffer)).unwrap();
            near.recv(&mut buffer).unwrap();
        }
        let elapsed = start.elapsed();
        near.send(&[0]).unwrap();
        elapsed / 2
    })
}

fn publish_to_receive(criterion: &mut Criterion) {
    let size = size_of::<PoseSample>();
    let mut group = criterion.benchmark_group("publish_to_receive");
    group.throughput(Throughput::Elements(1));
    for (kind, access) in KINDS {
        group.bench_function(BenchmarkId::new("woken", kind), |b| {
            b.iter_custom(|n| ping_pong(*access, n, blocking_receive))
        });
        group.bench_function(BenchmarkId::new("polling", kind), |b| {
            b.iter_custom(|n| ping_pong(*access, n, polling_receive))
        });
    }
    for size in [256, size] {
        group.bench_function(BenchmarkId::new("unix_datagram", size), |b| {
            b.iter_custom(|n| datagram_ping_pong(n, size));
        });
    }
    group.finish();
}

/// What publishing costs the daemon, with no and with all subscribers attached.
fn publish(criterion: &mut Criterion) {
    let mut group = criterion.benchmark_group("publish");
    for (kind, access) in KINDS {
        let folder = folder(*access);
        let root = Root::own(folder.path(), Some("bench_")).unwrap();
        let camera = CameraName::default();
        let node = Node::open(*access, &root, Role::Daemon).unwrap();
        let mut publisher = Publisher::<PoseSample>::open(&node, &camera).unwrap();
        let sample = sample();
        let mut subscriptions = Vec::new();
        for subscribers in [0, 1, 16] {
            while subscriptions.len() < subscribers {
                subscriptions.push(Subscription::<PoseSample>::open(&node, &camera).unwrap());
            }
            group.bench_function(BenchmarkId::new(*kind, subscribers), |b| {
                b.iter(|| publisher.publish(black_box(&sample)).unwrap());
            });
        }
    }
    group.finish();
}

criterion_group! {
    name = benches;
    config = Criterion::default().sample_size(30).warm_up_time(Duration::from_secs(1)).measurement_time(Duration::from_secs(4));
    targets = publish_to_receive, publish
}
criterion_main!(benches);
