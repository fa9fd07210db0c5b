//! SIGHUP: what is applied while frames flow, what is named, and what changes nothing.

mod rig;

use std::os::unix::net::UnixDatagram;
use std::time::{Duration, Instant};

use grnet_proto::{DaemonStatus, StatusSubscription};
use rig::{Daemon, Rig};
use rustix::process::Signal;

/// Statuses until one is as wanted.
fn status_when(statuses: &StatusSubscription, wanted: impl Fn(&DaemonStatus) -> bool) -> DaemonStatus {
    let deadline = Instant::now() + Duration::from_secs(30);
    loop {
        while let Some(status) = statuses.receive().unwrap() {
            if wanted(&status) {
                return status;
            }
        }
        let left = deadline.saturating_duration_since(Instant::now());
        assert!(!left.is_zero(), "no such status within 30 s");
        statuses.wait(left).unwrap();
    }
}

fn start(rig: &Rig) -> (Daemon, StatusSubscription, grnet_proto::Node) {
    let mut daemon = Daemon::start(rig, &["--set", "source.loop=true"]);
    daemon.wait_for_line("ready");
    let node = rig.node_when_up();
    let statuses = rig.open_status(&node);
    (daemon, statuses, node)
}

#[test]
fn what_can_be_is_applied_and_the_rest_is_named_once() {
    let rig = Rig::new(4);
    let (mut daemon, statuses, _node) = start(&rig);
    let changed = rig
        .config_text()
        .replace("level = \"info\"", "level = \"debug\"")
        .replace("[publish]\n", "[publish]\nstatus_rate_hz = 40\ncreation_timeout_ms = 30\n")
        + "silence_ms = 700\n[tracking]\nlongest_gap_ms = 77\nmap_smoothing_ms = 300\n[record]\nformat = \"jpeg\"\n";
    rig.write("grnetd.toml", &changed);
    daemon.signal(Signal::HUP);
    let line = daemon.wait_for_line("the configuration was reloaded");
    for key in [
        "log.level",
        "tracking.longest_gap_ms",
        "tracking.map_smoothing_ms",
        "publish.status_rate_hz",
        "record.format",
    ] {
        assert!(line.contains(key), "{key}: {line}");
    }
    let line = daemon.wait_for_line("need a restart");
    assert!(line.contains("source.silence_ms, publish.creation_timeout_ms"), "{line}");
    // The new level holds: the second reload has nothing to apply, and what waits for a restart still does.
    daemon.signal(Signal::HUP);
    let line = daemon.wait_for_line("the configuration was reloaded");
    assert!(line.contains("changed=\"\""), "{line}");
    let line = daemon.wait_for_line("need a restart");
    assert!(line.contains("source.silence_ms, publish.creation_timeout_ms"), "{line}");
    // Forty statuses a second instead of two.
    let first = status_when(&statuses, |_| true);
    let tenth = status_when(&statuses, |status| status.sample >= first.sample + 10);
    let took_ns = tenth.publish_time_ns - first.publish_time_ns;
    assert!(took_ns < 10 * 500_000_000 / 2, "{took_ns} ns for {} statuses", tenth.sample - first.sample);
    assert_eq!(tenth.error_count, 0);
    daemon.signal(Signal::TERM);
    assert_eq!(daemon.wait().code, 0);
}

#[test]
fn a_bad_configuration_changes_nothing_and_is_the_last_error() {
    let rig = Rig::new(4);
    let (mut daemon, statuses, _node) = start(&rig);
    rig.write("grnetd.toml", &(rig.config_text() + "[log]\nlevle = 1\n"));
    daemon.signal(Signal::HUP);
    daemon.wait_for_line("the old one goes on");
    let status = status_when(&statuses, |status| status.error_count == 1);
    assert!(status.last_error.to_string().contains("not reloaded"), "{}", status.last_error);
    std::fs::remove_file(rig.config()).unwrap();
    daemon.signal(Signal::HUP);
    daemon.wait_for_line("cannot read the configuration");
    let frames = status_when(&statuses, |status| status.error_count == 2).processed_frames;
    status_when(&statuses, |status| status.processed_frames > frames);
    daemon.signal(Signal::TERM);
    assert_eq!(daemon.wait().code, 0);
}

#[test]
fn another_scene_is_taken_and_an_unfit_one_leaves_all_as_it_was() {
    let rig = Rig::new(8);
    rig.save_scene("kitchen.safetensors", 1, 2, "kitchen");
    rig.save_scene("stranger.safetensors", 9, 9, "stranger");
    let (mut daemon, statuses, _node) = start(&rig);
    let own = status_when(&statuses, |status| status.processed_frames > 0);
    let with_scene = |file: &str, level: &str| {
        rig.config_text()
            .replace("[publish]\n", &format!("scene = {file:?}\n[publish]\n"))
            .replace("level = \"info\"", &format!("level = {level:?}"))
    };
    rig.write("grnetd.toml", &with_scene("stranger.safetensors", "warn"));
    daemon.signal(Signal::HUP);
    let line = daemon.wait_for_line("the old one goes on");
    assert!(line.contains("stranger.safetensors"), "{line}");
    let status = status_when(&statuses, |status| status.error_count == 1);
    assert_eq!((status.model_hash, status.loaded_scenes().len()), (own.model_hash, 1));

    // The log's level did not change either: this line is INFO.
    rig.write("grnetd.toml", &with_scene("kitchen.safetensors", "info"));
    daemon.signal(Signal::HUP);
    let line = daemon.wait_for_line("the configuration was reloaded");
    assert!(line.contains("model.scene"), "{line}");
    let status = status_when(&statuses, |status| status.model_hash != own.model_hash);
    assert!(
        status.scene_in_use().is_some_and(|scene| scene.name == "kitchen"),
        "{:?}",
        status.scene_in_use()
    );
    assert_eq!(status.dropped_frames + status.bad_frames, 0);

    // Back to what the checkpoint brings along.
    rig.write("grnetd.toml", &rig.config_text());
    daemon.signal(Signal::HUP);
    let status = status_when(&statuses, |status| status.model_hash == own.model_hash);
    assert_eq!(status.scene_in_use(), own.scene_in_use());
    daemon.signal(Signal::TERM);
    assert_eq!(daemon.wait().code, 0);
}

/// systemd takes a READY before the daemon is up for the truth.
#[test]
fn a_reload_is_announced_after_ready_only() {
    let rig = Rig::new(4);
    let socket = UnixDatagram::bind(rig.path("notify")).unwrap();
    socket.set_read_timeout(Some(Duration::from_secs(30))).unwrap();
    let said = |until: &str| {
        let mut all = String::new();
        let mut message = [0; 4096];
        while !all.contains(until) {
            let length =
                socket.recv(&mut message).unwrap_or_else(|error| panic!("{error}, no {until} in {all}"));
            all += &format!("{}\n", std::str::from_utf8(&message[..length]).unwrap());
        }
        all
    };
    // Slow motion, and no frame before somebody listens: not ready until the first heartbeat of that wait.
    let environment = [("NOTIFY_SOCKET", rig.path("notify"))];
    let mut daemon = Daemon::start_with(&rig, &["--set", "source.loop=true"], &environment);
    daemon.wait_for_line("starting");
    daemon.signal(Signal::HUP);
    let start = said("READY=1");
    assert!(!start.contains("RELOADING=1"), "{start}");
    daemon.signal(Signal::HUP);
    let reload = said("READY=1");
    let began = reload.find("RELOADING=1\nMONOTONIC_USEC=").expect(&reload);
    assert!(reload.find("READY=1").unwrap() > began, "{reload}");
    daemon.signal(Signal::TERM);
    said("STOPPING=1");
    assert_eq!(daemon.wait().code, 0);
}
