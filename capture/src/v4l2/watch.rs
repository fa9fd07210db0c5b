//! Waiting for a device node to appear, without the udev socket (a sandbox without network has none).

use std::os::fd::OwnedFd;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::fs::inotify;

/// Even a missed event costs no more than this.
const LONGEST_WAIT: Duration = Duration::from_millis(250);

/// Tells when something may have changed about a device node.
#[derive(Debug)]
pub(super) struct NodeWatch {
    node: PathBuf,
    inotify: Option<OwnedFd>,
}

impl NodeWatch {
    /// Watches `/dev` and the folder of `node` (a by-id link lives in a folder that may come and go).
    pub fn new(node: &Path) -> Self {
        let flags = inotify::CreateFlags::CLOEXEC | inotify::CreateFlags::NONBLOCK;
        let inotify = inotify::init(flags).ok();
        if let Some(fd) = &inotify {
            let events = inotify::WatchFlags::CREATE
                | inotify::WatchFlags::MOVED_TO
                | inotify::WatchFlags::ATTRIB
                | inotify::WatchFlags::DELETE;
            // Without a watch the wait below still ends after LONGEST_WAIT.
            let _ = inotify::add_watch(fd, "/dev", events);
            if let Some(folder) = node.parent().filter(|p| p.is_dir()) {
                let _ = inotify::add_watch(fd, folder, events);
            }
        }
        Self { node: node.to_owned(), inotify }
    }

    /// Waits until the node may be usable, at most for `timeout`; says whether it exists.
    pub fn wait(&self, timeout: Duration) -> bool {
        let deadline = Instant::now() + timeout;
        loop {
            if self.node.exists() {
                return true;
            }
            let left = deadline.saturating_duration_since(Instant::now()).min(LONGEST_WAIT);
            if left.is_zero() {
                return false;
            }
            self.sleep(left);
        }
    }

    /// Waits for any event around the node, at most for `timeout`.
    pub fn sleep(&self, timeout: Duration) {
        let Some(fd) = &self.inotify else {
            std::thread::sleep(timeout);
            return;
        };
        let timeout =
            Timespec { tv_sec: timeout.as_secs().cast_signed(), tv_nsec: i64::from(timeout.subsec_nanos()) };
        if matches!(poll(&mut [PollFd::new(fd, PollFlags::IN)], Some(&timeout)), Ok(n) if n > 0) {
            // The events themselves do not matter: the node is looked at afterwards.
            let mut drain = [0; 4096];
            while matches!(rustix::io::read(fd, &mut drain), Ok(n) if n > 0) {}
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_node_that_appears_ends_the_wait() {
        let dir = tempfile::tempdir().unwrap();
        let node = dir.path().join("video0");
        let watch = NodeWatch::new(&node);
        assert!(!watch.wait(Duration::from_millis(20)));
        let writer = std::thread::spawn({
            let node = node.clone();
            move || std::fs::write(node, "").unwrap()
        });
        assert!(watch.wait(Duration::from_secs(20)));
        writer.join().unwrap();
    }
}
