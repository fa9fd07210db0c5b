//! What is drawn: panels of lines, and the stages behind them.

use std::collections::BTreeMap;
use std::ops::Range;

use super::series::{Axis, Point, is_drawable, pieces, smoothed};
use crate::run::{LogEntry, LogKind};

/// Endings of the names of values that are drawn as errors, with the panel's label.
const ERRORS: [(&str, &str); 2] =
    [("translation_m", "translation error (m)"), ("rotation_deg", "rotation error (deg)")];

/// Everything that a picture shows.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Content {
    pub(super) steps: Range<f64>,
    pub(super) stages: Vec<Stage>,
    pub(super) panels: Vec<Panel>,
}

/// A stretch of steps.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Stage {
    pub(super) name: String,
    pub(super) steps: Range<f64>,
}

#[derive(Debug, Clone, PartialEq)]
pub(super) struct Panel {
    pub(super) label: &'static str,
    pub(super) axis: Axis,
    pub(super) lines: Vec<Line>,
    /// Steps whose value was not finite.
    pub(super) not_finite: Vec<f64>,
}

#[derive(Debug, Clone, PartialEq)]
pub(super) struct Line {
    /// In the legend.
    pub(super) label: String,
    pub(super) held_out: bool,
    pub(super) raw: Vec<Vec<Point>>,
    /// Empty when the values are too few to be smoothed.
    pub(super) smooth: Vec<Vec<Point>>,
}

impl Content {
    pub(super) fn of(entries: &[LogEntry]) -> Self {
        let told: Vec<&LogEntry> = entries.iter().filter(|entry| entry.kind != LogKind::Event).collect();
        let last = told.iter().map(|entry| entry.step).max().unwrap_or(0) as f64;
        let first = told.iter().map(|entry| entry.step).min().unwrap_or(0) as f64;
        // Never empty, also where 1 is less than the distance of two numbers.
        let steps = first..last.max(first + 1.0).max(first * 1.000_001);
        let mut panels = vec![
            panel("loss", false, true, collect(&told, |entry| named(entry.loss))),
            panel(
                "learning rate",
                true,
                false,
                collect(&told, |entry| named(entry.lr.filter(|_| entry.kind == LogKind::Train))),
            ),
        ];
        for (ending, label) in ERRORS {
            let values = collect(&told, |entry| {
                let of = |(name, value): (&String, &f64)| Some((prefix(name, ending)?, *value));
                entry.values.iter().filter_map(of).collect()
            });
            panels.push(panel(label, true, true, values));
        }
        panels.retain(|panel| !(panel.lines.is_empty() && panel.not_finite.is_empty()));
        let stages = stages(&told, steps.end);
        Self { steps, stages, panels }
    }
}

/// Points by what they are of, whether held out and a name; and by stage, since each has a loss of its own: no line and
/// no mean runs from one to the next.
type Values = BTreeMap<(bool, String), Vec<Vec<Point>>>;

fn collect(entries: &[&LogEntry], values: impl Fn(&LogEntry) -> Vec<(String, f64)>) -> Values {
    let mut found = Values::new();
    for stage in entries.chunk_by(|a, b| a.stage == b.stage) {
        let mut parts: BTreeMap<(bool, String), Vec<Point>> = BTreeMap::new();
        for entry in stage {
            for (name, value) in values(entry) {
                let points = parts.entry((entry.kind == LogKind::Valid, name)).or_default();
                points.push((entry.step as f64, value));
            }
        }
        for (of, points) in parts {
            found.entry(of).or_default().push(points);
        }
    }
    found
}

fn named(value: Option<f64>) -> Vec<(String, f64)> {
    value.map(|value| (String::new(), value)).into_iter().collect()
}

/// `fused` of `fused.translation_m`; none of names that end otherwise.
fn prefix(name: &str, ending: &str) -> Option<String> {
    let prefix = name.strip_suffix(ending)?;
    Some(prefix.trim_end_matches(['.', '_', '/', ' ']).to_owned())
}

/// `lengths`: the values are never negative. `noisy`: those of training are smoothed.
fn panel(label: &'static str, lengths: bool, noisy: bool, values: Values) -> Panel {
    let points = || values.values().flatten().flatten();
    let axis = Axis::of(points().map(|(_, value)| *value), lengths);
    let not_finite = points().filter(|(_, value)| !is_drawable(*value)).map(|(step, _)| *step).collect();
    let line = |((held_out, name), stages): ((bool, String), Vec<Vec<Point>>)| {
        let word = if held_out { "held out" } else { "training" };
        let label = if name.is_empty() { word.to_owned() } else { format!("{word}, {name}") };
        let raw = stages.iter().flat_map(|points| pieces(points)).collect();
        let noisy = noisy && !held_out;
        let smooth = stages.iter().filter(|_| noisy).map(|points| smoothed(points));
        Line { label, held_out, raw, smooth: smooth.filter(|line| !line.is_empty()).collect() }
    };
    let lines = values.into_iter().map(line).filter(|line| !line.raw.is_empty()).collect();
    Panel { label, axis, lines, not_finite }
}

/// The stages in the order of the log; each reaches to the beginning of the next.
fn stages(entries: &[&LogEntry], end: f64) -> Vec<Stage> {
    let chunks: Vec<_> = entries.chunk_by(|a, b| a.stage == b.stage).collect();
    let start = |chunk: &[&LogEntry]| chunk.first().map_or(end, |entry| entry.step as f64);
    let stage = |(n, chunk): (usize, &&[&LogEntry])| {
        let until = chunks.get(n + 1).map_or(end, |next| start(next));
        Stage { name: chunk[0].stage.clone(), steps: start(chunk)..until }
    };
    chunks.iter().enumerate().map(stage).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn entry(step: u64, stage: &str, kind: LogKind, loss: f64) -> LogEntry {
        LogEntry { step, stage: stage.into(), kind, loss: Some(loss), ..LogEntry::default() }
    }

    #[test]
    fn stages_and_kinds_have_lines_of_their_own() {
        let mut entries = vec![
            entry(0, "one", LogKind::Train, 4.0),
            entry(10, "one", LogKind::Train, f64::NAN),
            entry(20, "one", LogKind::Train, 2.0),
            entry(20, "one", LogKind::Valid, 3.0),
            entry(20, "", LogKind::Event, 0.0),
            entry(30, "two", LogKind::Train, 7.0),
        ];
        entries[3].values.insert("fused.rotation_deg".into(), 0.0);
        entries[3].values.insert("translation_m".into(), 0.5);
        entries[3].values.insert("scale".into(), 1.0);
        let content = Content::of(&entries);
        let stage = |name: &str, steps| Stage { name: name.into(), steps };
        assert_eq!(content.stages, [stage("one", 0.0..30.0), stage("two", 30.0..30.0)]);
        let labels: Vec<_> = content.panels.iter().map(|panel| panel.label).collect();
        assert_eq!(labels, ["loss", "translation error (m)", "rotation error (deg)"]);
        let loss = &content.panels[0];
        assert_eq!(loss.not_finite, [10.0]);
        let raw: Vec<_> = loss.lines.iter().map(|line| (line.label.as_str(), line.raw.clone())).collect();
        let training = vec![vec![(0.0, 4.0)], vec![(20.0, 2.0)], vec![(30.0, 7.0)]];
        assert_eq!(raw, [("training", training), ("held out", vec![vec![(20.0, 3.0)]])]);
        assert_eq!(content.panels[2].lines[0].label, "held out, fused");
    }

    #[test]
    fn nothing_logged_is_nothing_drawn() {
        assert_eq!(Content::of(&[]), Content { steps: 0.0..1.0, stages: vec![], panels: vec![] });
        let late = Content::of(&[entry(u64::MAX, "x", LogKind::Train, 1.0)]);
        assert!(late.steps.start < late.steps.end);
    }
}
