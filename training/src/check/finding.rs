//! What was found, for people and for programs.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use serde::Serialize;

/// Frame numbers that a line of text names.
const NAMED: usize = 8;

/// How bad a finding is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Severity {
    /// Worth knowing.
    Note,
    /// Costs accuracy.
    Warning,
    /// What is learnt from this will be wrong.
    Error,
}

/// One thing that was found.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Finding {
    /// How bad it is.
    pub severity: Severity,
    /// Which kind of finding it is; a stable name.
    pub kind: &'static str,
    /// What was measured.
    pub found: String,
    /// What to do; empty where nothing is to be done.
    pub advice: &'static str,
    /// Numbers of the frames concerned; empty when it is about all of them.
    pub frames: Vec<u64>,
}

impl Finding {
    /// About the whole recording.
    pub fn new(severity: Severity, kind: &'static str, found: String, advice: &'static str) -> Self {
        Self { severity, kind, found, advice, frames: Vec::new() }
    }

    /// About these frames.
    pub fn on(self, frames: Vec<u64>) -> Self {
        Self { frames, ..self }
    }
}

/// A warning, or an error when it concerns more than `share` of all frames.
pub(super) fn by_share(count: usize, all: usize, share: f64) -> Severity {
    if count as f64 > share * all as f64 { Severity::Error } else { Severity::Warning }
}

/// Everything that was found in a data set.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct CheckReport {
    /// The data set.
    pub data: PathBuf,
    /// Its sequences.
    pub sequences: Vec<String>,
    /// All frames.
    pub frames: usize,
    /// Findings with severity [`Severity::Error`].
    pub errors: usize,
    /// Findings with severity [`Severity::Warning`].
    pub warnings: usize,
    /// The worst first.
    pub findings: Vec<Found>,
}

/// A finding with its sequence.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Found {
    /// The sequence; empty when it is about several.
    pub sequence: String,
    /// What was found in it.
    #[serde(flatten)]
    pub finding: Finding,
}

impl CheckReport {
    /// Sorts the findings and counts them.
    pub fn new(data: &Path, sequences: Vec<String>, frames: usize, findings: Vec<(String, Finding)>) -> Self {
        let count = |severity| findings.iter().filter(|(_, finding)| finding.severity == severity).count();
        let (errors, warnings) = (count(Severity::Error), count(Severity::Warning));
        let mut findings: Vec<Found> =
            findings.into_iter().map(|(sequence, finding)| Found { sequence, finding }).collect();
        findings.sort_by_key(|found| std::cmp::Reverse(found.finding.severity));
        Self { data: data.to_path_buf(), sequences, frames, errors, warnings, findings }
    }

    /// The findings of one kind.
    pub fn of_kind(&self, kind: &str) -> Vec<&Finding> {
        self.findings.iter().map(|found| &found.finding).filter(|finding| finding.kind == kind).collect()
    }

    /// For people.
    pub fn text(&self) -> String {
        let mut text = String::new();
        for Found { sequence, finding } in &self.findings {
            let severity = match finding.severity {
                Severity::Error => "ERROR  ",
                Severity::Warning => "warning",
                Severity::Note => "note   ",
            };
            let place = if self.sequences.len() > 1 && !sequence.is_empty() {
                format!(" [{sequence}]")
            } else {
                String::new()
            };
            // Writing to a String cannot fail.
            let _ = writeln!(text, "{severity} {}{place}: {}", finding.kind, finding.found);
            if !finding.frames.is_empty() {
                let _ = writeln!(text, "        frames {}", runs(&finding.frames));
            }
            if !finding.advice.is_empty() {
                let _ = writeln!(text, "        -> {}", finding.advice);
            }
        }
        let _ = writeln!(
            text,
            "{}: {} frames in {} sequences, {} errors, {} warnings",
            self.data.display(),
            self.frames,
            self.sequences.len(),
            self.errors,
            self.warnings
        );
        text
    }
}

/// `3, 7-12, ...`.
fn runs(frames: &[u64]) -> String {
    let mut runs: Vec<(u64, u64)> = Vec::new();
    for &frame in frames {
        match runs.last_mut() {
            Some((_, last)) if *last + 1 == frame => *last = frame,
            _ => runs.push((frame, frame)),
        }
    }
    let name = |(first, last): &(u64, u64)| {
        if first == last { first.to_string() } else { format!("{first}-{last}") }
    };
    let mut names: Vec<String> = runs.iter().take(NAMED).map(name).collect();
    if runs.len() > NAMED {
        names.push(format!("... ({} frames in {} runs)", frames.len(), runs.len()));
    }
    names.join(", ")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_worst_comes_first_and_frames_are_shortened() {
        let frames = [1, 2, 3, 9].into_iter().chain((20..60).step_by(3)).collect();
        let note = Finding::new(Severity::Note, "a-note", "it is so".into(), "").on(frames);
        let error = Finding::new(Severity::Error, "an-error", "it is bad".into(), "mend it");
        let found = vec![("s".to_owned(), note), ("s".to_owned(), error)];
        let report = CheckReport::new(Path::new("data"), vec!["s".into()], 60, found);
        assert_eq!((report.errors, report.warnings), (1, 0));
        let text = report.text();
        assert!(text.starts_with("ERROR   an-error: it is bad\n        -> mend it\nnote"), "{text}");
        assert!(text.contains("frames 1-3, 9, 20,") && text.contains("... (18 frames in 16 runs)"), "{text}");
        let json = serde_json::to_value(&report).unwrap();
        assert_eq!(json["findings"][0]["severity"], "error");
        assert_eq!(json["findings"][1]["frames"][3], 9);
    }
}
