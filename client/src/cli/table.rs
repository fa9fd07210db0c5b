//! The table for people: one row a sample.

use std::iter;

use anstyle::{AnsiColor, Style};
use grnet_client::{Reason, Sample, Status};
use grnet_geometry::Pose;

use super::{human, reference::Deviation};

/// A column: what stands over it, and over a run of columns of the same group.
struct Column {
    group: &'static str,
    head: &'static str,
    width: usize,
}

const fn column(group: &'static str, head: &'static str, width: usize) -> Column {
    Column { group, head, width }
}

const FIRST: [Column; 3] = [column("time", "UTC", 12), column("frame", "", 8), column("status", "", 13)];
const MAP: [Column; 3] =
    [column("map from base", "x m", 8), column("map from base", "y m", 8), column("map from base", "z m", 8)];
const MAP_ANGLES: [Column; 3] = [
    column("map from base", "yaw deg", 7),
    column("map from base", "pitch", 7),
    column("map from base", "roll", 7),
];
const ODOM: [Column; 3] = [
    column("odom from base", "x m", 8),
    column("odom from base", "y m", 8),
    column("odom from base", "z m", 8),
];
const TRUTH: [Column; 3] =
    [column("ground truth", "x m", 8), column("ground truth", "y m", 8), column("ground truth", "z m", 8)];
const ERROR: [Column; 2] = [column("error", "m", 8), column("error", "deg", 7)];
const LAST: [Column; 2] = [column("latency", "ms", 8), column("dropped", "frames", 7)];

/// How the table looks.
#[derive(Debug, Clone, Copy)]
pub struct Table {
    /// Colour the status.
    pub colours: bool,
    /// Show ground truth and error in place of angles and odometry.
    pub reference: bool,
}

impl Table {
    /// Two lines: groups of columns, and heads with units.
    pub fn header(self) -> String {
        let bold = if self.colours { Style::new().bold() } else { Style::new() };
        let (mut groups, mut heads) = (String::new(), String::new());
        let columns: Vec<Column> = self.columns().collect();
        for run in columns.chunk_by(|a, b| a.group == b.group) {
            let width = run.iter().map(|column| column.width + 1).sum::<usize>() - 1;
            let group = run[0].group;
            match run.len() {
                1 if group == "time" || group == "status" => groups.push_str(&format!("{group:<width$} ")),
                1 => groups.push_str(&format!("{group:>width$} ")),
                _ => groups.push_str(&format!("{group:^width$} ")),
            }
            for Column { head, width, .. } in run {
                if group == "time" {
                    heads.push_str(&format!("{head:<width$} "));
                } else {
                    heads.push_str(&format!("{head:>width$} "));
                }
            }
        }
        format!("{bold}{}{bold:#}\n{bold}{}{bold:#}\n", groups.trim_end(), heads.trim_end())
    }

    /// One line without its line break.
    pub fn row(self, sample: &Sample, lost_samples: u64, deviation: Option<&Deviation>) -> String {
        let style = if self.colours { status_style(sample.status()) } else { Style::new() };
        let time = sample.publish_epoch_ns().map_or_else(|| "-".to_owned(), human::time_of_day);
        let sequence = sample.sequence().map_or_else(|| "-".to_owned(), |sequence| sequence.to_string());
        let status = format!(" {style}{:<12}{style:#}", sample.status());
        let map = sample.map_from_base();
        let latency_ms = f64::from(sample.latency().total_us) / 1e3;

        let mut cells = vec![time, sequence, status];
        cells.extend(position(map.as_ref()));
        if self.reference {
            cells.extend(position(deviation.map(|deviation| &deviation.map_from_base)));
            let (error_m, error_deg) = deviation.and_then(|deviation| deviation.error).unzip();
            cells.extend([number(error_m, 3), number(error_deg, 1)]);
        } else {
            let angles = map.map(|pose| pose.rotation.euler_angles());
            let angles = angles.map(|(roll, pitch, yaw)| [yaw, pitch, roll].map(f64::to_degrees));
            cells.extend((0..3).map(|i| number(angles.map(|angles| angles[i]), 1)));
            cells.extend(position(sample.odom_from_base().as_ref()));
        }
        cells.extend([number(Some(latency_ms), 1), sample.dropped_frames().to_string()]);

        let mut row = String::new();
        for (cell, Column { width, group, .. }) in cells.iter().zip(self.columns()) {
            // The status is padded already: the escapes of its colour would count as letters.
            match group {
                "status" => row.push_str(&format!("{cell} ")),
                "time" => row.push_str(&format!("{cell:<width$} ")),
                _ => row.push_str(&format!("{cell:>width$} ")),
            }
        }
        let mut row = row.trim_end().to_owned();
        if sample.reason() != Reason::NONE {
            row.push_str(&format!("  {}", sample.reason()));
        }
        if lost_samples > 0 {
            row.push_str(&format!("  ({lost_samples} lost here)"));
        }
        row
    }

    fn columns(self) -> impl Iterator<Item = Column> {
        let reference = self.reference.then(|| TRUTH.into_iter().chain(ERROR));
        let own = (!self.reference).then(|| MAP_ANGLES.into_iter().chain(ODOM));
        let middle = reference.into_iter().flatten().chain(own.into_iter().flatten());
        iter::empty().chain(FIRST).chain(MAP).chain(middle).chain(LAST)
    }
}

fn position(pose: Option<&Pose>) -> [String; 3] {
    [0, 1, 2].map(|axis| number(pose.map(|pose| pose.translation.vector[axis]), 3))
}

/// A number, or a dash: an unknown number never looks like one.
fn number(value: Option<f64>, decimals: usize) -> String {
    value
        .filter(|value| value.is_finite())
        .map_or_else(|| "-".to_owned(), |value| format!("{value:.decimals$}"))
}

fn status_style(status: Status) -> Style {
    let colour = match status {
        Status::TRACKING => AnsiColor::Green,
        Status::INITIALIZING => AnsiColor::Cyan,
        Status::DEGRADED => AnsiColor::Yellow,
        _ => AnsiColor::Red,
    };
    Style::new().fg_color(Some(colour.into()))
}

#[cfg(test)]
mod tests {
    use grnet_client::{BootId, CaptureClock, PoseSample};

    use super::*;

    fn sample(with_map: bool) -> Sample {
        let camera = "front".parse().unwrap();
        let mut raw = PoseSample::unknown(BootId([1; 16]), &camera, Status::TRACKING, Reason::NONE);
        raw.sequence = 7;
        raw.capture_clock = CaptureClock::MONOTONIC;
        raw.publish_time_ns = 1_520_000_000;
        raw.realtime_offset_ns = 1_700_000_000_000_000_000;
        raw.latency.total_us = 20_000.0;
        raw.odom_from_base.translation_m = [1.0, -2.5, 0.0];
        raw.odom_from_base.quaternion_xyzw = [0.0, 0.0, 0.6, 0.8];
        if with_map {
            raw.map_from_base = raw.odom_from_base;
        }
        Sample::new(raw)
    }

    fn cells(row: &str) -> Vec<&str> {
        row.split_whitespace().collect()
    }

    #[test]
    fn what_is_not_known_is_a_dash() {
        let table = Table { colours: false, reference: false };
        let row = table.row(&sample(false), 0, None);
        let expected = "22:13:21.520 7 TRACKING - - - - - - 1.000 -2.500 0.000 20.0 0";
        assert_eq!(cells(&row), cells(expected));
        let row = Table { reference: true, ..table }.row(&sample(true), 2, None);
        assert_eq!(
            cells(&row),
            cells("22:13:21.520 7 TRACKING 1.000 -2.500 0.000 - - - - - 20.0 0 (2 lost here)")
        );
    }

    #[test]
    fn ground_truth_and_error_stand_beside_the_pose() {
        let deviation =
            Deviation { map_from_base: Pose::translation(1.0, 2.0, 3.0), error: Some((0.25, 1.5)) };
        let row = Table { colours: false, reference: true }.row(&sample(true), 0, Some(&deviation));
        let expected = "22:13:21.520 7 TRACKING 1.000 -2.500 0.000 1.000 2.000 3.000 0.250 1.5 20.0 0";
        assert_eq!(cells(&row), cells(expected));
    }

    #[test]
    fn the_columns_stand_under_their_heads_with_and_without_colours() {
        for reference in [false, true] {
            let table = Table { colours: false, reference };
            let header = table.header();
            let heads = header.lines().nth(1).unwrap();
            let row = table.row(&sample(true), 0, None);
            assert_eq!(heads.len(), row.len(), "\n{header}{row}");
            let coloured = Table { colours: true, ..table }.row(&sample(true), 0, None);
            let style = status_style(Status::TRACKING);
            let escapes = format!("{style}{style:#}").len();
            assert_eq!(coloured.len(), row.len() + escapes);
        }
    }
}
