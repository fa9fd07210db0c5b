//! What goes to stderr or to the journal, and how it looks.

mod journal;

use std::fmt;
use std::io::IsTerminal as _;
use std::path::Path;

use grnet_config::{LogConfig, LogFormat};
use tracing::{Event, Subscriber};
use tracing_subscriber::fmt::format::{Format, Writer};
use tracing_subscriber::fmt::{FmtContext, FormatEvent, FormatFields};
use tracing_subscriber::layer::SubscriberExt as _;
use tracing_subscriber::registry::LookupSpan;
use tracing_subscriber::util::SubscriberInitExt as _;
use tracing_subscriber::{EnvFilter, Layer as _, Registry, fmt as layer, reload};

use crate::failure::Failure;

/// Changes the level while the daemon runs.
#[derive(Debug, Clone)]
pub struct LogHandle {
    filter: reload::Handle<EnvFilter, Registry>,
}

/// Starts logging; once per process.
///
/// # Errors
/// When logging was started before, or the level is no filter.
pub fn start(config: &LogConfig) -> Result<LogHandle, Failure> {
    let (filter, handle) = reload::Layer::new(filter(&config.level)?);
    let human = || layer::layer().with_writer(std::io::stderr).with_ansi(std::io::stderr().is_terminal());
    let lines = match (format(config.format), journal()) {
        (LogFormat::Journald, Some(journal)) => journal.with_filter(filter).boxed(),
        (LogFormat::Json, _) => {
            layer::layer().json().flatten_event(true).with_writer(std::io::stderr).with_filter(filter).boxed()
        }
        (LogFormat::Journald, None) => {
            let journal = Lines(Format::default().without_time().with_level(false).with_ansi(false));
            human().with_ansi(false).event_format(journal).with_filter(filter).boxed()
        }
        (LogFormat::Auto | LogFormat::Human, _) => human().with_filter(filter).boxed(),
    };
    tracing_subscriber::registry()
        .with(lines)
        .try_init()
        .map_err(|error| Failure::internal(format!("cannot start logging: {error}")))?;
    Ok(LogHandle { filter: handle })
}

impl LogHandle {
    /// Applies another `log.level`.
    ///
    /// # Errors
    /// When it is no filter.
    pub fn set_level(&self, level: &str) -> Result<(), Failure> {
        let filter = filter(level)?;
        self.filter
            .reload(filter)
            .map_err(|error| Failure::internal(format!("cannot change the level: {error}")))
    }
}

fn filter(level: &str) -> Result<EnvFilter, Failure> {
    EnvFilter::builder()
        .parse(level)
        .map_err(|error| Failure::config(anyhow::anyhow!("log.level = {level:?} is no filter: {error}")))
}

fn format(configured: LogFormat) -> LogFormat {
    match configured {
        LogFormat::Auto if journal_reads_stderr() => LogFormat::Journald,
        LogFormat::Auto => LogFormat::Human,
        chosen => chosen,
    }
}

/// The journal in its own protocol, when it would get stderr anyhow.
fn journal() -> Option<journal::Journal> {
    // Without its socket it still reads stderr.
    journal_reads_stderr().then(|| journal::Journal::open(Path::new(journal::SOCKET)).ok())?
}

/// systemd names the device and inode of the journal's socket; stderr may have been redirected since.
fn journal_reads_stderr() -> bool {
    let Ok(stream) = std::env::var("JOURNAL_STREAM") else { return false };
    let Ok(stat) = rustix::fs::fstat(std::io::stderr()) else { return false };
    stream == format!("{}:{}", stat.st_dev, stat.st_ino)
}

/// Lines for whatever passes stderr on to the journal: the priority as `<6>` (sd-daemon(3)), no time, no level.
struct Lines(Format<layer::format::Full, ()>);

impl<S, N> FormatEvent<S, N> for Lines
where
    S: Subscriber + for<'a> LookupSpan<'a>,
    N: for<'a> FormatFields<'a> + 'static,
{
    fn format_event(
        &self,
        context: &FmtContext<'_, S, N>,
        mut writer: Writer<'_>,
        event: &Event<'_>,
    ) -> fmt::Result {
        write!(writer, "<{}>", journal::priority(event.metadata().level()))?;
        self.0.format_event(context, writer, event)
    }
}

#[cfg(test)]
mod tests {
    use std::io;
    use std::sync::{Arc, Mutex};

    use super::*;

    #[derive(Clone, Default)]
    struct Written(Arc<Mutex<Vec<u8>>>);

    impl io::Write for Written {
        fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
            self.0.lock().unwrap().extend_from_slice(bytes);
            Ok(bytes.len())
        }
        fn flush(&mut self) -> io::Result<()> {
            Ok(())
        }
    }

    #[test]
    fn the_journal_gets_priorities_and_no_time() {
        let lines = Written::default();
        let writer = lines.clone();
        let journal = Lines(Format::default().without_time().with_level(false).with_ansi(false));
        let layer = layer::layer().with_ansi(false).event_format(journal).with_writer(move || writer.clone());
        tracing::subscriber::with_default(tracing_subscriber::registry().with(layer), || {
            tracing::warn!(frames = 3, "dropped");
            tracing::info!("ready");
        });
        let text = String::from_utf8(lines.0.lock().unwrap().clone()).unwrap();
        let expected = "<4>grnetd::logging::tests: dropped frames=3\n<6>grnetd::logging::tests: ready\n";
        assert_eq!(text, expected);
    }

    #[test]
    fn every_level_that_the_configuration_admits_is_a_filter() {
        for level in ["off", "error", "info", "trace", "info,grnet_capture=debug"] {
            filter(level).unwrap();
        }
        assert_eq!(format(LogFormat::Json), LogFormat::Json);
    }
}
