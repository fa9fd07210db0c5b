//! Events for the journal in its own protocol (<https://systemd.io/JOURNAL_NATIVE_PROTOCOL>): the line that people
//! read as MESSAGE, and every field of the event once more as a field of the journal, so that
//! `journalctl GRNETD_CAMERA=front` or `-o json` find it.

use std::fmt::{self, Write as _};
use std::io;
use std::os::unix::net::UnixDatagram;
use std::path::{Path, PathBuf};
use std::time::Duration;

use tracing::field::{Field, Visit};
use tracing::{Event, Level, Metadata, Subscriber};
use tracing_subscriber::Layer;
use tracing_subscriber::layer::Context;

/// Where journald listens.
pub const SOCKET: &str = "/run/systemd/journal/socket";

/// What an event's own fields begin with in the journal.
const PREFIX: &str = "GRNETD_";

/// A datagram that is longer may be refused by the kernel; a message is then cut to this and goes without fields.
const LONGEST_MESSAGE: usize = 4096;

/// A journal that does not read must not stop the poses.
const LONGEST_WAIT: Duration = Duration::from_millis(100);

/// Sends events to the journal.
#[derive(Debug)]
pub struct Journal {
    socket: UnixDatagram,
    path: PathBuf,
}

impl Journal {
    /// A line to the journal that listens on `path`.
    ///
    /// # Errors
    /// When nobody listens there.
    pub fn open(path: &Path) -> io::Result<Self> {
        let socket = UnixDatagram::unbound()?;
        socket.set_write_timeout(Some(LONGEST_WAIT))?;
        // Discarded by journald; fails when it is not there.
        socket.send_to(&[], path)?;
        Ok(Self { socket, path: path.to_owned() })
    }

    /// A lost line is nothing that could be logged.
    fn send(&self, metadata: &Metadata<'_>, said: &Said) {
        let whole = entry(metadata, &said.line(metadata), &said.fields);
        if self.socket.send_to(&whole, &self.path).is_err() {
            let mut line = said.line(metadata);
            let end = (0..=LONGEST_MESSAGE.min(line.len())).rev().find(|&end| line.is_char_boundary(end));
            line.truncate(end.unwrap_or_default());
            let _ = self.socket.send_to(&entry(metadata, &line, &[]), &self.path);
        }
    }
}

impl<S: Subscriber> Layer<S> for Journal {
    fn on_event(&self, event: &Event<'_>, _: Context<'_, S>) {
        let mut said = Said::default();
        event.record(&mut said);
        self.send(event.metadata(), &said);
    }
}

/// The priorities of syslog and the journal.
pub fn priority(level: &Level) -> u8 {
    match *level {
        Level::ERROR => 3,
        Level::WARN => 4,
        Level::INFO => 6,
        Level::DEBUG | Level::TRACE => 7,
    }
}

fn entry(metadata: &Metadata<'_>, line: &str, fields: &[(&'static str, String)]) -> Vec<u8> {
    let mut bytes = Vec::with_capacity(256 + line.len());
    put(&mut bytes, "MESSAGE", line);
    put(&mut bytes, "PRIORITY", &priority(metadata.level()).to_string());
    put(&mut bytes, "SYSLOG_IDENTIFIER", "grnetd");
    put(&mut bytes, "TARGET", metadata.target());
    if let Some(file) = metadata.file() {
        put(&mut bytes, "CODE_FILE", file);
    }
    if let Some(line) = metadata.line() {
        put(&mut bytes, "CODE_LINE", &line.to_string());
    }
    for (name, value) in fields {
        put(&mut bytes, &journal_name(name), value);
    }
    bytes
}

/// `NAME`, a newline, the length and the value: the form that takes any value.
fn put(bytes: &mut Vec<u8>, name: &str, value: &str) {
    bytes.extend_from_slice(name.as_bytes());
    bytes.push(b'\n');
    bytes.extend_from_slice(&(value.len() as u64).to_le_bytes());
    bytes.extend_from_slice(value.as_bytes());
    bytes.push(b'\n');
}

/// Capitals, digits and `_`, at most 64: other names are dropped by the journal.
fn journal_name(field: &str) -> String {
    let plain = |c: char| if c.is_ascii_alphanumeric() { c.to_ascii_uppercase() } else { '_' };
    PREFIX.chars().chain(field.chars().map(plain)).take(64).collect()
}

/// What an event says.
#[derive(Debug, Default)]
struct Said {
    message: String,
    fields: Vec<(&'static str, String)>,
    /// The fields as they stand in the line: texts in quotes.
    shown: String,
}

impl Said {
    /// As the lines on a terminal, without time and level.
    fn line(&self, metadata: &Metadata<'_>) -> String {
        format!("{}: {}{}", metadata.target(), self.message, self.shown)
    }

    fn add(&mut self, field: &Field, value: String, shown: impl fmt::Display) {
        if field.name() == "message" {
            self.message = value;
        } else {
            // Writing to a String cannot fail.
            let _ = write!(self.shown, " {}={shown}", field.name());
            self.fields.push((field.name(), value));
        }
    }
}

impl Visit for Said {
    fn record_str(&mut self, field: &Field, value: &str) {
        self.add(field, value.to_owned(), format_args!("{value:?}"));
    }

    fn record_debug(&mut self, field: &Field, value: &dyn fmt::Debug) {
        let text = format!("{value:?}");
        self.add(field, text.clone(), text);
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use tracing_subscriber::layer::SubscriberExt as _;

    use super::*;

    fn parse(mut bytes: &[u8]) -> BTreeMap<String, String> {
        let mut fields = BTreeMap::new();
        while !bytes.is_empty() {
            let end = bytes.iter().position(|byte| *byte == b'\n').unwrap();
            let (name, rest) = (&bytes[..end], &bytes[end + 1..]);
            let length = u64::from_le_bytes(rest[..8].try_into().unwrap()) as usize;
            let value = &rest[8..8 + length];
            assert_eq!(rest[8 + length], b'\n');
            let text = |bytes: &[u8]| String::from_utf8(bytes.to_vec()).unwrap();
            fields.insert(text(name), text(value));
            bytes = &rest[9 + length..];
        }
        fields
    }

    #[test]
    fn the_journal_gets_the_line_and_every_field() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("socket");
        assert!(Journal::open(&path).is_err(), "nobody listens yet");
        let journald = UnixDatagram::bind(&path).unwrap();
        let journal = Journal::open(&path).unwrap();
        let mut buffer = vec![0; 1 << 20];
        assert_eq!(journald.recv(&mut buffer).unwrap(), 0, "the greeting");
        let huge = "x".repeat(4 << 20);
        tracing::subscriber::with_default(tracing_subscriber::registry().with(journal), || {
            tracing::warn!(frames = 3, camera = "front", error = %"two\nlines", "dropped");
            tracing::info!("{huge}");
        });
        let length = journald.recv(&mut buffer).unwrap();
        let entry = parse(&buffer[..length]);
        let field = |name: &str| entry.get(name).map(String::as_str);
        let line = "grnetd::logging::journal::tests: dropped frames=3 camera=\"front\" error=two\nlines";
        assert_eq!(field("MESSAGE"), Some(line));
        assert_eq!((field("PRIORITY"), field("SYSLOG_IDENTIFIER")), (Some("4"), Some("grnetd")));
        assert_eq!((field("GRNETD_FRAMES"), field("GRNETD_CAMERA")), (Some("3"), Some("front")));
        assert_eq!(field("GRNETD_ERROR"), Some("two\nlines"));
        assert!(field("CODE_FILE").is_some_and(|file| file.ends_with("journal.rs")));

        let length = journald.recv(&mut buffer).unwrap();
        let cut = parse(&buffer[..length]);
        assert_eq!(cut["MESSAGE"].len(), LONGEST_MESSAGE);
    }

    #[test]
    fn names_are_what_the_journal_admits() {
        assert_eq!(journal_name("rate_hz"), "GRNETD_RATE_HZ");
        assert_eq!(journal_name("log.target"), "GRNETD_LOG_TARGET");
        assert_eq!(journal_name(&"a".repeat(100)).len(), 64);
    }
}
