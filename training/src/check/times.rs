//! Gaps and repeated time stamps.

use grnet_capture::dataset::Recording;
use grnet_geometry::statistics::median;

use super::finding::{Finding, Severity};

/// An interval this many times the middle one is a gap.
const GAP: f64 = 1.8;

/// Looks at the times of capture.
pub fn check(recording: &Recording) -> Vec<Finding> {
    let frames = &recording.frames;
    let seconds = |pair: &[grnet_capture::dataset::RecordedFrame]| {
        pair[1].time_ns.saturating_sub(pair[0].time_ns) as f64 * 1e-9
    };
    let intervals_s: Vec<f64> = frames.windows(2).map(seconds).collect();
    let mut findings = Vec::new();

    let after = |chosen: &dyn Fn(f64) -> bool| -> Vec<u64> {
        let pairs = intervals_s.iter().zip(&frames[1..]);
        pairs.filter(|(interval_s, _)| chosen(**interval_s)).map(|(_, frame)| frame.sequence).collect()
    };
    let repeated = after(&|interval_s| interval_s == 0.0);
    if !repeated.is_empty() {
        let found = format!("{} frames have the time of the frame before", repeated.len());
        let advice = "give regular times with --rate, or mend the list of images";
        findings.push(Finding::new(Severity::Error, "repeated-time", found, advice).on(repeated));
    }
    let Some(middle_s) = median(&intervals_s).filter(|middle_s| *middle_s > 0.0) else { return findings };
    let gaps = after(&|interval_s| interval_s > GAP * middle_s);
    if !gaps.is_empty() {
        let longest_s = intervals_s.iter().copied().fold(0.0, f64::max);
        let missing: f64 =
            intervals_s.iter().filter(|s| **s > GAP * middle_s).map(|s| s / middle_s - 1.0).sum();
        let share = missing / (missing + frames.len() as f64);
        let found = format!(
            "{} gaps, the longest of {longest_s:.3} s where frames come every {middle_s:.3} s; about {missing:.0} \
             frames ({:.1} %) are missing",
            gaps.len(),
            100.0 * share
        );
        let severity = if share > 0.01 { Severity::Warning } else { Severity::Note };
        let advice =
            "windows over a gap hold a motion of another length; record to a faster disk or at a lower rate";
        findings.push(Finding::new(severity, "time-gap", found, advice).on(gaps));
    }
    findings
}
