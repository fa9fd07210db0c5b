//! `grnet-client status`.

use std::{
    io::{self, Write as _},
    sync::atomic::{AtomicBool, Ordering},
    time::{Duration, Instant},
};

use anstyle::{AnsiColor, Style};
use grnet_client::{ClientError, Connection, DaemonStatus, Health, Provenance, StatusReader};

use super::{StatusArgs, human, json};

/// How long a signal can take to be noticed while the daemon says nothing.
const NOTICE_SIGNAL: Duration = Duration::from_millis(100);

/// Prints the daemon's state once.
pub fn run(connection: &Connection, args: &StatusArgs, stop: &AtomicBool) -> anyhow::Result<()> {
    let mut reader = StatusReader::open(connection)?;
    let start = Instant::now();
    let status = loop {
        let remaining = args.timeout.saturating_sub(start.elapsed());
        match reader.read(remaining.min(NOTICE_SIGNAL)) {
            Ok(status) => break status,
            Err(ClientError::Timeout { .. } | ClientError::NoDaemon(_))
                if start.elapsed() < args.timeout && !stop.load(Ordering::Relaxed) => {}
            Err(ClientError::Timeout { service, expected, .. }) => {
                return Err(ClientError::Timeout { service, expected, waited: start.elapsed() }.into());
            }
            Err(error) => return Err(error.into()),
        }
    };
    let text =
        if args.json { format!("{}\n", json::status(&status)) } else { report(&status, human::colours()) };
    let mut out = io::stdout().lock();
    out.write_all(text.as_bytes())?;
    Ok(out.flush()?)
}

/// The daemon's state in lines for people.
pub fn report(status: &DaemonStatus, colours: bool) -> String {
    let style = if colours { health_style(status.health) } else { Style::new() };
    let mut text = String::new();
    let mut line = |name: &str, value: String| text.push_str(&format!("{name:<11}{value}\n"));
    line(
        "grnetd",
        format!(
            "{} on camera {}: {style}{}{style:#}, up {}",
            status.version,
            status.camera,
            status.health,
            human::duration(status.uptime_ns)
        ),
    );
    line(
        "process",
        format!(
            "pid {}, boot {}, access {}, {} pose subscribers",
            status.pid, status.boot_id, status.access, status.subscribers
        ),
    );
    line(
        "source",
        format!("{}, {}, {}", said(&status.source), status.source_state, human::rate(status.capture_rate_hz)),
    );
    let provenance = match status.provenance {
        Provenance::UNTRAINED => "UNTRAINED: its poses mean nothing".to_owned(),
        other => other.to_string(),
    };
    line("model", format!("{} ({}), {provenance}", said(&status.model), status.model_hash.short()));
    let scenes: Vec<_> = status
        .loaded_scenes()
        .iter()
        .map(|scene| {
            let active = status.scene_in_use() == Some(scene);
            format!("{}{}", scene.name, if active { " (in use)" } else { "" })
        })
        .collect();
    line("scenes", if scenes.is_empty() { "none: odometry only".to_owned() } else { scenes.join(", ") });
    line(
        "frames",
        format!(
            "{} captured, {} processed, {} dropped, {} bad, {} refused",
            status.captured_frames,
            status.processed_frames,
            status.dropped_frames,
            status.bad_frames,
            status.refused_frames
        ),
    );
    line(
        "samples",
        format!(
            "{} published, {}, reset epoch {}",
            status.published_samples,
            human::rate(status.publish_rate_hz),
            status.reset_epoch
        ),
    );
    if !status.recording_path.is_empty() {
        line("recording", status.recording_path.to_string());
    }
    if status.error_count > 0 {
        let age = status.publish_time_ns.saturating_sub(status.last_error_time_ns);
        let count = status.error_count;
        line("last error", format!("{} ({} ago, {count} in all)", status.last_error, human::duration(age)));
    }
    line("latency ms", format!("{:>9} {:>9} {:>9} {:>9}", "median", "90 %", "99 %", "max"));
    for (name, stage) in status.latency.stages() {
        let cells = [stage.p50_us, stage.p90_us, stage.p99_us, stage.max_us].map(human::milliseconds);
        line("", format!("{:>9} {:>9} {:>9} {:>9}  {name}", cells[0], cells[1], cells[2], cells[3]));
    }
    text
}

/// The text, or a word for its absence.
fn said(text: &impl ToString) -> String {
    Some(text.to_string()).filter(|text| !text.is_empty()).unwrap_or_else(|| "unknown".to_owned())
}

fn health_style(health: Health) -> Style {
    let colour = match health {
        Health::OK => AnsiColor::Green,
        Health::STARTING => AnsiColor::Cyan,
        Health::DEGRADED | Health::PAUSED | Health::STOPPING => AnsiColor::Yellow,
        _ => AnsiColor::Red,
    };
    Style::new().fg_color(Some(colour.into()))
}
