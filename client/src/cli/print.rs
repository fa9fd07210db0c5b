//! The text forms of a sample.

use std::io::IsTerminal as _;

use grnet_client::Sample;
use grnet_geometry::{
    Pose, quaternion,
    trajectory::{KittiPose, StampedPose, tum},
};

use super::{
    Format, Which, human, json,
    reference::{Deviation, Reference},
    table::Table,
};

/// Turns samples into text.
pub struct Printer {
    format: Format,
    which: Which,
    table: Table,
    reference: Option<Reference>,
    rows: u64,
}

/// Rows after which a terminal shows the table's header again.
const ROWS_PER_HEADER: u64 = 30;

const CSV_HEADER: &str = "capture_time_s,sequence,sample,status,reason,x_m,y_m,z_m,qx,qy,qz,qw,latency_ms,dropped_frames,reset_epoch";

impl Printer {
    pub fn new(format: Format, which: Which, reference: Option<Reference>) -> Self {
        let table = Table { colours: human::colours(), reference: reference.is_some() };
        Self { format, which, table, reference, rows: 0 }
    }

    /// Takes a sample, printed or not, into the comparison with the reference.
    pub fn compare(&mut self, sample: &Sample) {
        let deviation = self.deviation(sample);
        if let (Some(reference), Some(deviation)) = (&mut self.reference, deviation) {
            reference.count(&deviation);
        }
    }

    /// What the comparison with the reference came to.
    pub fn summary(&mut self) -> Option<String> {
        self.reference.as_mut()?.summary()
    }

    fn deviation(&self, sample: &Sample) -> Option<Deviation> {
        self.reference.as_ref()?.compare(sample, self.pose(sample))
    }

    /// Can the format show this sample? tum and kitti have no way to say "not known".
    pub fn shows(&self, sample: &Sample) -> bool {
        match self.format {
            Format::Table | Format::Json | Format::Csv => true,
            Format::Tum => self.pose(sample).is_some() && sample.capture_epoch_ns().is_some(),
            Format::Kitti => self.pose(sample).is_some(),
        }
    }

    /// The sample as text with its line break, and before it the header where one is due.
    pub fn text(&mut self, sample: &Sample, lost_samples: u64) -> String {
        let mut text = self.header();
        match self.format {
            Format::Table => {
                text.push_str(&self.table.row(sample, lost_samples, self.deviation(sample).as_ref()));
            }
            Format::Json => {
                let mut value = json::sample(sample, lost_samples);
                if self.reference.is_some() {
                    value["reference"] = json::deviation(self.deviation(sample).as_ref());
                }
                text.push_str(&value.to_string());
            }
            Format::Csv => self.csv(&mut text, sample),
            Format::Tum => {
                if let (Some(world_from_camera), Some(time_ns)) =
                    (self.pose(sample), sample.capture_epoch_ns())
                {
                    text.push_str(&tum::format_line(&StampedPose { time_ns, world_from_camera }));
                }
            }
            Format::Kitti => {
                if let Some(pose) = self.pose(sample) {
                    let matrix = KittiPose::new(0, &pose).matrix.transpose();
                    let numbers: Vec<_> = matrix.iter().map(f64::to_string).collect();
                    text.push_str(&numbers.join(" "));
                }
            }
        }
        text.push('\n');
        self.rows += 1;
        text
    }

    fn pose(&self, sample: &Sample) -> Option<Pose> {
        match self.which {
            Which::Map => sample.map_from_base(),
            Which::Odom => sample.odom_from_base(),
            Which::Network => sample.network_map_from_base(),
        }
    }

    fn header(&self) -> String {
        match self.format {
            // Only a terminal scrolls the header out of sight.
            Format::Table
                if self.rows == 0
                    || (self.rows.is_multiple_of(ROWS_PER_HEADER) && std::io::stdout().is_terminal()) =>
            {
                self.table.header()
            }
            Format::Csv if self.rows == 0 => format!("{CSV_HEADER}\n"),
            _ => String::new(),
        }
    }

    fn csv(&self, text: &mut String, sample: &Sample) {
        let raw = sample.raw();
        let seconds = sample
            .capture_epoch_ns()
            .map(|ns| format!("{}.{:09}", ns.div_euclid(1_000_000_000), ns.rem_euclid(1_000_000_000)));
        let sequence = sample.sequence().map(|sequence| sequence.to_string());
        text.push_str(&format!(
            "{},{},{},{},{}",
            seconds.unwrap_or_default(),
            sequence.unwrap_or_default(),
            raw.sample,
            raw.status,
            raw.reason
        ));
        match self.pose(sample) {
            Some(pose) => {
                let numbers = pose.translation.vector.iter().copied().chain(quaternion::xyzw(&pose.rotation));
                numbers.for_each(|number| text.push_str(&format!(",{number}")));
            }
            // Empty fields: a number would look like a pose.
            None => text.push_str(&",".repeat(7)),
        }
        let latency_ms = Some(f64::from(sample.latency().total_us) / 1e3).filter(|ms| ms.is_finite());
        let latency_ms = latency_ms.map(|ms| format!("{ms:.3}")).unwrap_or_default();
        text.push_str(&format!(",{latency_ms},{},{}", raw.dropped_frames, raw.reset_epoch));
    }
}

#[cfg(test)]
mod tests {
    use grnet_client::{BootId, CaptureClock, PoseSample, Reason, Status};

    use super::*;

    fn valid() -> PoseSample {
        let mut raw =
            PoseSample::unknown(BootId([1; 16]), &"front".parse().unwrap(), Status::TRACKING, Reason::NONE);
        raw.sequence = 7;
        raw.capture_clock = CaptureClock::MONOTONIC;
        raw.capture_time_ns = 1_500_000_000;
        raw.publish_time_ns = 1_520_000_000;
        raw.realtime_offset_ns = 1_700_000_000_000_000_000;
        raw.latency.total_us = 20_000.0;
        raw.odom_from_base.translation_m = [1.0, -2.5, 0.0];
        raw.odom_from_base.quaternion_xyzw = [0.0, 0.0, 0.6, 0.8];
        raw
    }

    fn print(format: Format, which: Which, raw: PoseSample) -> (bool, String) {
        let sample = Sample::new(raw);
        let mut printer = Printer { rows: 1, ..Printer::new(format, which, None) };
        (printer.shows(&sample), printer.text(&sample, 0))
    }

    #[test]
    fn tum_has_epoch_time_for_a_camera_and_recorded_time_for_a_recording() {
        let (shown, text) = print(Format::Tum, Which::Odom, valid());
        assert!(shown);
        assert_eq!(text, "1700000001.500000000 1 -2.5 0 0 0 0.6 0.8\n");
        let recorded = PoseSample { capture_clock: CaptureClock::RECORDED, ..valid() };
        assert!(print(Format::Tum, Which::Odom, recorded).1.starts_with("1.500000000 1 "));
    }

    #[test]
    fn kitti_is_a_matrix_by_rows() {
        let (shown, text) = print(Format::Kitti, Which::Odom, valid());
        let numbers: Vec<f64> = text.split_whitespace().map(|n| n.parse().unwrap()).collect();
        let expected = [0.28, -0.96, 0.0, 1.0, 0.96, 0.28, 0.0, -2.5, 0.0, 0.0, 1.0, 0.0];
        assert!(shown && numbers.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-12), "{text}");
        assert_eq!(numbers.len(), 12);
    }

    #[test]
    fn an_unknown_pose_is_never_printed_as_numbers() {
        for format in [Format::Tum, Format::Kitti] {
            assert!(!print(format, Which::Map, valid()).0);
        }
        let (_, csv) = print(Format::Csv, Which::Map, valid());
        assert_eq!(csv, "1700000001.500000000,7,0,TRACKING,NONE,,,,,,,,20.000,0,0\n");
        assert_eq!(csv.matches(',').count(), CSV_HEADER.matches(',').count());
        let (_, csv) = print(Format::Csv, Which::Odom, valid());
        assert!(csv.contains(",1,-2.5,0,0,0,0.6,0.8,"), "{csv}");
    }
}
