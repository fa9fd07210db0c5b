//! Records for systemd's journal in its own protocol, so that fields can be searched for:
//! `journalctl -u grnetd GRNET_THREAD=capture`.
//!
//! A record is one datagram of `NAME=value` lines; a value with line breaks is `NAME`, its length as little-endian u64,
//! and its bytes (<https://systemd.io/JOURNAL_NATIVE_PROTOCOL>).

use std::fmt::{self, Write as _};
use std::io;
use std::os::unix::net::UnixDatagram;
use std::path::Path;

use tracing::field::{Field, Visit};
use tracing::{Event, Level, Subscriber};
use tracing_subscriber::Layer;
use tracing_subscriber::layer::Context;

/// Where the journal listens.
pub const SOCKET: &str = "/run/systemd/journal/socket";

/// What our own fields begin with; journalctl knows them as `GRNET_SILENCE` and so on.
const PREFIX: &str = "GRNET_";

/// Sends every event to the journal: the text that people read, and each field by itself.
#[derive(Debug)]
pub struct JournalLayer {
    socket: UnixDatagram,
    identifier: &'static str,
}

impl JournalLayer {
    /// A layer on the journal's socket.
    ///
    /// # Errors
    /// When nobody listens there.
    pub fn connect(path: &Path, identifier: &'static str) -> io::Result<Self> {
        let socket = UnixDatagram::unbound()?;
        socket.connect(path)?;
        Ok(Self { socket, identifier })
    }
}

impl<S: Subscriber> Layer<S> for JournalLayer {
    fn on_event(&self, event: &Event<'_>, _: Context<'_, S>) {
        let metadata = event.metadata();
        let mut record = Record::default();
        event.record(&mut record);
        let Record { message, fields, mut bytes } = record;
        let text = format!("{}: {message}{fields}", metadata.target());
        put(&mut bytes, "MESSAGE", &text);
        put(&mut bytes, "PRIORITY", priority(metadata.level()));
        put(&mut bytes, "SYSLOG_IDENTIFIER", self.identifier);
        put(&mut bytes, "TARGET", metadata.target());
        if let (Some(file), Some(line)) = (metadata.file(), metadata.line()) {
            put(&mut bytes, "CODE_FILE", file);
            put(&mut bytes, "CODE_LINE", &line.to_string());
        }
        if self.socket.send(&bytes).is_err() {
            // The journal is being restarted, or the record is larger than a datagram: its other ear is stderr.
            eprintln!("<{}>{text}", priority(metadata.level()));
        }
    }
}

/// The priority of syslog(3).
pub fn priority(level: &Level) -> &'static str {
    match *level {
        Level::ERROR => "3",
        Level::WARN => "4",
        Level::INFO => "6",
        Level::DEBUG | Level::TRACE => "7",
    }
}

/// An event on its way to a record.
#[derive(Default)]
struct Record {
    message: String,
    /// ` name=value` of each field, for people.
    fields: String,
    /// The same as lines of the protocol.
    bytes: Vec<u8>,
}

impl Record {
    fn add(&mut self, field: &Field, value: String) {
        if field.name() == "message" {
            self.message = value;
            return;
        }
        let name: String = field.name().to_uppercase();
        let name: String = name.chars().map(|c| if c.is_ascii_alphanumeric() { c } else { '_' }).collect();
        put(&mut self.bytes, &format!("{PREFIX}{name}"), &value);
        // Writing to a string cannot fail.
        let _ = write!(self.fields, " {}={value}", field.name());
    }
}

impl Visit for Record {
    fn record_str(&mut self, field: &Field, value: &str) {
        self.add(field, value.to_owned());
    }

    fn record_debug(&mut self, field: &Field, value: &dyn fmt::Debug) {
        self.add(field, format!("{value:?}"));
    }

    fn record_error(&mut self, field: &Field, value: &(dyn std::error::Error + 'static)) {
        self.add(field, value.to_string());
    }
}

fn put(bytes: &mut Vec<u8>, name: &str, value: &str) {
    bytes.extend_from_slice(name.as_bytes());
    if value.contains('\n') {
        bytes.push(b'\n');
        bytes.extend_from_slice(&(value.len() as u64).to_le_bytes());
    } else {
        bytes.push(b'=');
    }
    bytes.extend_from_slice(value.as_bytes());
    bytes.push(b'\n');
}

#[cfg(test)]
mod tests {
    use tracing_subscriber::layer::SubscriberExt as _;

    use super::*;

    /// What the journal gets when `log` runs.
    fn records(log: impl FnOnce()) -> Vec<Vec<u8>> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("socket");
        let journal = UnixDatagram::bind(&path).unwrap();
        journal.set_nonblocking(true).unwrap();
        let layer = JournalLayer::connect(&path, "grnetd").unwrap();
        tracing::subscriber::with_default(tracing_subscriber::registry().with(layer), log);
        let mut buffer = vec![0; 1 << 16];
        std::iter::from_fn(|| journal.recv(&mut buffer).ok().map(|length| buffer[..length].to_vec()))
            .collect()
    }

    fn lines(record: &[u8]) -> Vec<String> {
        String::from_utf8(record.to_vec()).unwrap().lines().map(str::to_owned).collect()
    }

    #[test]
    fn an_event_is_a_text_for_people_and_fields_for_searching() {
        let records = records(|| {
            tracing::warn!(frames = 3, source = "cam", waited_ms = 1.5, "dropped");
            tracing::error!(error = %io::Error::other("gone"), "no camera");
        });
        let [first, second] = records.as_slice() else { panic!("{} records", records.len()) };
        let first = lines(first);
        for line in [
            "MESSAGE=grnetd::journal::tests: dropped frames=3 source=cam waited_ms=1.5",
            "PRIORITY=4",
            "SYSLOG_IDENTIFIER=grnetd",
            "TARGET=grnetd::journal::tests",
            "GRNET_FRAMES=3",
            "GRNET_SOURCE=cam",
            "GRNET_WAITED_MS=1.5",
        ] {
            assert!(first.iter().any(|found| found == line), "{line} is not in {first:#?}");
        }
        assert!(first.iter().any(|line| line.starts_with("CODE_LINE=")), "{first:#?}");
        let second = lines(second);
        assert!(second.iter().any(|line| line == "GRNET_ERROR=gone"), "{second:#?}");
        assert!(second.iter().any(|line| line == "PRIORITY=3"), "{second:#?}");
    }

    #[test]
    fn a_value_with_line_breaks_cannot_forge_a_field() {
        let records = records(|| tracing::info!("first\nPRIORITY=0"));
        let text = "grnetd::journal::tests: first\nPRIORITY=0";
        let mut expected = b"MESSAGE\n".to_vec();
        expected.extend_from_slice(&(text.len() as u64).to_le_bytes());
        expected.extend_from_slice(text.as_bytes());
        expected.push(b'\n');
        assert!(records[0].windows(expected.len()).any(|window| window == expected), "{:?}", records[0]);
    }

    #[test]
    fn nobody_listening_is_an_error() {
        assert!(JournalLayer::connect(Path::new("/nowhere/socket"), "grnetd").is_err());
    }
}
