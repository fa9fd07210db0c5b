//! The plots of a report.

mod axes;
mod calibration;
mod clip;
mod distribution;
mod kitti;
mod over_time;
mod top_view;

use std::ops::Range;

use plotters::style::RGBColor;

use super::ReportError;
use super::svg::{Entry, INK, colour_of};
use crate::evaluate::{Evaluation, Kind, System};

/// Sequences that are drawn one by one; of more, the first.
const SEQUENCES_DRAWN: usize = 12;

/// A plot and what is written beside it.
#[derive(Debug, Clone)]
pub struct Plot {
    /// File name without extension.
    pub file: String,
    /// Heading.
    pub title: String,
    /// What is seen, for readers.
    pub caption: String,
    /// In stand-in colours; see [`super::svg`].
    pub svg: String,
}

/// A system as it is drawn.
#[derive(Debug, Clone, Copy)]
pub struct Drawn<'a> {
    pub system: &'a System,
    pub colour: RGBColor,
    pub width: u32,
}

impl Drawn<'_> {
    fn entry(&self) -> Entry {
        Entry { label: self.system.name.clone(), colour: self.colour, width: self.width }
    }
}

/// Draws every plot for which there is something to show.
pub fn draw(evaluation: &Evaluation) -> Result<Vec<Plot>, ReportError> {
    let paths = paths(evaluation);
    let compared = compared(evaluation);
    let mut plots = Vec::new();
    let tested = evaluation.data.tested_sequences();
    let several = tested.len() > 1;
    plots.extend(distribution::shares(evaluation, &compared)?);
    for &sequence in tested.iter().take(SEQUENCES_DRAWN) {
        let recording = &evaluation.data.recordings[sequence];
        let (suffix, of) = match several {
            true => (format!("-{}", crate::evaluate::slug(&recording.id)), format!(", {}", recording.name)),
            false => (String::new(), String::new()),
        };
        plots.extend(top_view::draw(evaluation, &paths, sequence, &suffix, &of)?);
        plots.extend(axes::draw(evaluation, &paths, sequence, &suffix, &of)?);
        plots.extend(over_time::draw(evaluation, &compared, sequence, &suffix, &of)?);
    }
    plots.extend(distribution::histogram(evaluation, &compared)?);
    plots.extend(kitti::draw(evaluation)?);
    plots.extend(calibration::draw(evaluation)?);
    Ok(plots)
}

fn all(evaluation: &Evaluation) -> impl Iterator<Item = Drawn<'_>> {
    evaluation.systems.iter().enumerate().map(|(n, system)| {
        let width = if system.is_model() { 2 } else { 1 };
        Drawn { system, colour: colour_of(n).0, width }
    })
}

fn has_poses(evaluation: &Evaluation, system: &System) -> bool {
    system.valid(&evaluation.data.task) > 0
}

/// Systems whose paths are drawn: those of models; without a model, the baselines. Retrieval jumps from frame to frame
/// and would hide them.
fn paths(evaluation: &Evaluation) -> Vec<Drawn<'_>> {
    let models = evaluation.systems.iter().any(|system| system.is_model());
    let chosen =
        |drawn: &Drawn<'_>| has_poses(evaluation, drawn.system) && (drawn.system.is_model() || !models);
    all(evaluation).filter(chosen).collect()
}

/// Systems whose errors are drawn: those of models, and the baselines that answer from training frames.
fn compared(evaluation: &Evaluation) -> Vec<Drawn<'_>> {
    let crowded = evaluation.systems.iter().filter(|system| system.is_model()).count() > 4;
    let chosen = |drawn: &Drawn<'_>| {
        // Of many models the outputs that decide; the table has the rest.
        let minor = crowded && matches!(drawn.system.kind, Kind::Global | Kind::Published);
        has_poses(evaluation, drawn.system) && !minor
    };
    all(evaluation).filter(chosen).collect()
}

fn truth_entry() -> Entry {
    Entry { label: "ground truth".into(), colour: INK, width: 2 }
}

/// The horizontal axis of what is drawn over time: seconds, or the number of the test frame where blocks would leave
/// most of a time axis empty.
struct TimeAxis<'a> {
    evaluation: &'a Evaluation,
    start: usize,
    end: usize,
    /// First frames of the blocks after the first.
    breaks: Vec<usize>,
}

impl<'a> TimeAxis<'a> {
    fn new(evaluation: &'a Evaluation, sequence: usize) -> Self {
        let range = evaluation.data.test_range(sequence);
        let starts = evaluation.data.task.blocks().into_iter().map(|block| block.start);
        let breaks = starts.filter(|start| *start > range.start && *start < range.end).collect();
        Self { evaluation, start: range.start, end: range.end, breaks }
    }

    fn of(&self, frame: usize) -> f64 {
        let test = &self.evaluation.data.task.test;
        match self.breaks.is_empty() {
            true => (test[frame].time_ns as f64 - test[self.start].time_ns as f64) * 1e-9,
            false => (frame - self.start) as f64,
        }
    }

    fn range(&self) -> Range<f64> {
        0.0..(self.start..self.end).map(|frame| self.of(frame)).fold(1e-3, f64::max)
    }

    fn label(&self) -> &'static str {
        if self.breaks.is_empty() {
            "time since the first test frame (s)"
        } else {
            "test frame, blocks side by side"
        }
    }

    /// Where one block ends and the next begins.
    fn separators(&self) -> impl Iterator<Item = f64> + '_ {
        self.breaks.iter().map(|frame| self.of(*frame) - 0.5)
    }
}

/// The values of a sequence's test frames as lines that end where a block ends or a value is missing.
fn lines(
    evaluation: &Evaluation,
    sequence: usize,
    value: impl Fn(usize) -> Option<(f64, f64)>,
) -> Vec<Vec<(f64, f64)>> {
    let range = evaluation.data.test_range(sequence);
    let mut lines: Vec<Vec<(f64, f64)>> = Vec::new();
    for block in evaluation.data.task.blocks().into_iter().filter(|block| range.contains(&block.start)) {
        let mut line = Vec::new();
        for frame in block {
            match value(frame) {
                Some(point) => line.push(point),
                None => lines.push(std::mem::take(&mut line)),
            }
        }
        lines.push(line);
    }
    lines.retain(|line| !line.is_empty());
    lines
}

/// Smallest and largest of the values; `None` of none.
fn extent(values: impl Iterator<Item = f64>) -> Option<(f64, f64)> {
    values.filter(|v| v.is_finite()).fold(None, |extent, v| match extent {
        None => Some((v, v)),
        Some((low, high)) => Some((v.min(low), v.max(high))),
    })
}
