//! The daemon as journald sees it: a datagram for each line, with its fields.

mod rig;

use std::os::unix::net::UnixDatagram;
use std::process::{Command, Stdio};
use std::time::Duration;

use rig::{Daemon, Rig};

/// Puts the test's socket where journald's is, for this process alone, and names stderr as systemd does.
const IN_PLACE_OF_JOURNALD: &str = "
    mount -t tmpfs tmpfs /run && mkdir -p /run/systemd/journal && touch /run/systemd/journal/socket
    mount --bind \"$0\" /run/systemd/journal/socket || exit 99
    export JOURNAL_STREAM=$(stat --dereference --format=%d:%i /proc/self/fd/2)
    exec \"$@\"";

#[test]
fn the_journal_gets_every_line_with_its_fields_and_stderr_nothing() {
    let own_mounts = ["--mount", "mount", "-t", "tmpfs", "tmpfs", "/run"];
    let may = Command::new("unshare").args(own_mounts).stderr(Stdio::null()).status();
    if !may.is_ok_and(|status| status.success()) {
        println!(
            "SKIPPED: this container admits no mount namespace, and journald's socket has a fixed place"
        );
        return;
    }
    let rig = Rig::new(3);
    let path = rig.path("journal");
    let journald = UnixDatagram::bind(&path).unwrap();
    journald.set_read_timeout(Some(Duration::from_secs(30))).unwrap();
    let reader = std::thread::spawn(move || {
        let (mut entries, mut buffer) = (Vec::new(), vec![0; 1 << 16]);
        loop {
            let length = journald.recv(&mut buffer).expect("an entry within 30 s");
            let text = String::from_utf8_lossy(&buffer[..length]).into_owned();
            let is_last = text.contains("frames processed of");
            entries.push(text);
            if is_last {
                return entries;
            }
        }
    });
    let wrapper = ["unshare", "--mount", "sh", "-c", IN_PLACE_OF_JOURNALD, &path];
    let ended = Daemon::start_as(&wrapper, &rig, &[], &[]).wait();
    assert_eq!((ended.code, ended.stderr.as_str()), (0, ""));
    let entries = reader.join().unwrap();
    // Name, newline, eight bytes of length, value.
    let has = |entry: &str, name: &str, value: &str| {
        entry.split_once(&format!("{name}\n")).is_some_and(|(_, rest)| {
            rest.get(8..).is_some_and(|rest| rest.starts_with(&format!("{value}\n")))
        })
    };
    let ready = entries.iter().find(|entry| entry.contains("ready why=")).expect("a line about READY");
    assert!(has(ready, "MESSAGE", "grnetd::service_manager: ready why=\"publishing poses\""), "{ready}");
    assert!(has(ready, "PRIORITY", "6") && has(ready, "SYSLOG_IDENTIFIER", "grnetd"), "{ready}");
    assert!(has(ready, "GRNETD_WHY", "publishing poses"), "{ready}");
}
