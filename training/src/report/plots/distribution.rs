//! How errors are distributed: the share of frames below each error, and histograms.

use std::ops::Range;

use plotters::prelude::*;

use super::{Drawn, Plot};
use crate::evaluate::{Evaluation, FrameError, frame_errors};
use crate::report::ReportError;
use crate::report::svg::{self, Area, DrawError, Entry, FONT, FONT_PX, GRID, INK, WIDTH};

const PANEL_PX: u32 = 320;
/// Bins of a histogram in each decade of error.
const BINS_PER_DECADE: f64 = 8.0;

/// Part of a pose's error.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Part {
    Translation,
    Rotation,
}

impl Part {
    pub fn of(self, error: &FrameError) -> f64 {
        match self {
            Self::Translation => error.translation_m,
            Self::Rotation => error.rotation_deg,
        }
    }

    pub fn label(self) -> &'static str {
        match self {
            Self::Translation => "translation error (m)",
            Self::Rotation => "rotation error (deg)",
        }
    }

    /// Decades outside which nobody looks.
    fn limits(self) -> (i32, i32) {
        match self {
            Self::Translation => (-3, 3),
            Self::Rotation => (-2, 3),
        }
    }

    /// The usual thresholds of recall.
    fn thresholds(self) -> [f64; 2] {
        match self {
            Self::Translation => [0.05, 0.25],
            Self::Rotation => [5.0, 10.0],
        }
    }
}

/// Whole decades that hold the values, within reason; rotation ends at half a turn.
pub fn decades(values: impl Iterator<Item = f64>, part: Part) -> Range<f64> {
    let (lowest, highest) = part.limits();
    let (low, high) = super::extent(values.filter(|v| *v > 0.0)).unwrap_or((0.01, 1.0));
    let low = (low.log10().floor() as i32).clamp(lowest, highest - 1);
    let high = (high.log10().ceil() as i32).clamp(low + 1, highest);
    let end = 10f64.powi(high);
    10f64.powi(low)..if part == Part::Rotation { end.min(180.0) } else { end }
}

/// Share of all judged frames below each error.
pub fn shares(evaluation: &Evaluation, drawn: &[Drawn<'_>]) -> Result<Option<Plot>, ReportError> {
    let judged = evaluation.summary.judged_frames as f64;
    let curve = |errors: &[f64], x: &Range<f64>| {
        let mut line = vec![(x.start, 0.0)];
        for (n, error) in errors.iter().enumerate().filter(|(_, error)| **error <= x.end) {
            let error = error.max(x.start);
            // A step: up at the error itself.
            line.push((error, 100.0 * n as f64 / judged));
            line.push((error, 100.0 * (n + 1) as f64 / judged));
        }
        let reached = line.last().map_or(0.0, |point| point.1);
        line.push((x.end, reached));
        line
    };
    let caption = "Share of all judged frames whose error is below the value; frames without a pose never count. Dashed: \
                   5 cm and 25 cm, 5 deg and 10 deg.";
    panels(
        evaluation,
        drawn,
        ("shares", "Share of frames below an error", caption),
        "frames (%)",
        Some(100.0),
        &curve,
    )
}

/// Share of the valid frames in each of some bins, of equal width on a logarithmic scale.
pub fn histogram(evaluation: &Evaluation, drawn: &[Drawn<'_>]) -> Result<Option<Plot>, ReportError> {
    let curve = |errors: &[f64], x: &Range<f64>| {
        let first = (x.start.log10() * BINS_PER_DECADE).round() as i32;
        let last = (x.end.log10() * BINS_PER_DECADE).ceil() as i32;
        let mut counts = vec![0usize; (last - first).max(1) as usize];
        for error in errors {
            let bin = (error.max(x.start).log10() * BINS_PER_DECADE).floor() as i32 - first;
            counts[(bin.max(0) as usize).min((last - first - 1).max(0) as usize)] += 1;
        }
        let edge = |n: usize| 10f64.powf(f64::from(first + n as i32) / BINS_PER_DECADE).min(x.end);
        let steps = counts.iter().enumerate().flat_map(|(n, count)| {
            let share = 100.0 * *count as f64 / errors.len() as f64;
            [(edge(n), share), (edge(n + 1), share)]
        });
        std::iter::once((x.start, 0.0)).chain(steps).chain([(x.end, 0.0)]).collect()
    };
    let caption = "Share of the valid frames in each bin; eight bins to a decade of error.";
    panels(evaluation, drawn, ("histogram", "Histogram of errors", caption), "valid frames (%)", None, &curve)
}

type Curve<'a> = &'a dyn Fn(&[f64], &Range<f64>) -> Vec<(f64, f64)>;

fn panels(
    evaluation: &Evaluation,
    drawn: &[Drawn<'_>],
    (file, title, caption): (&str, &str, &str),
    y_label: &str,
    top: Option<f64>,
    curve: Curve<'_>,
) -> Result<Option<Plot>, ReportError> {
    if drawn.is_empty() {
        return Ok(None);
    }
    let errors: Vec<Vec<FrameError>> = drawn
        .iter()
        .map(|d| frame_errors(&evaluation.data, d.system).into_iter().flatten().collect())
        .collect();
    let entries: Vec<Entry> = drawn.iter().map(Drawn::entry).collect();
    let height = PANEL_PX + svg::legend_height(&entries);
    let text = svg::draw(file, height, |area| {
        let rest = svg::legend(area, &entries)?;
        let (left, right) = rest.split_horizontally(WIDTH / 2 + 12);
        for (panel, part, label) in [(left, Part::Translation, y_label), (right, Part::Rotation, "")] {
            draw_panel(&panel, drawn, &errors, part, label, top, curve)?;
        }
        Ok(())
    })?;
    Ok(Some(Plot { file: file.into(), title: title.into(), caption: caption.into(), svg: text }))
}

fn draw_panel(
    panel: &Area<'_>,
    drawn: &[Drawn<'_>],
    errors: &[Vec<FrameError>],
    part: Part,
    y_label: &str,
    top: Option<f64>,
    curve: Curve<'_>,
) -> Result<(), DrawError> {
    let x = decades(errors.iter().flatten().map(|error| part.of(error)), part);
    let curves: Vec<Vec<(f64, f64)>> = errors
        .iter()
        .map(|errors| {
            let mut values: Vec<f64> = errors.iter().map(|error| part.of(error)).collect();
            values.sort_unstable_by(f64::total_cmp);
            curve(&values, &x)
        })
        .collect();
    let highest = curves.iter().flatten().map(|point| point.1).fold(1.0, f64::max);
    let top = top.unwrap_or(1.08 * highest);
    let mut chart = ChartBuilder::on(panel)
        .margin_right(14)
        .margin_top(8)
        .x_label_area_size(46)
        .y_label_area_size(if y_label.is_empty() { 44 } else { 68 })
        .build_cartesian_2d(x.clone().log_scale(), 0.0..top)?;
    chart
        .configure_mesh()
        .light_line_style(TRANSPARENT)
        .bold_line_style(GRID)
        .axis_style(INK)
        .label_style((FONT, FONT_PX).into_font().color(&INK))
        .x_label_formatter(&|v| format!("{v}"))
        .y_label_formatter(&|v| format!("{v:.0}"))
        .x_desc(part.label())
        .y_desc(y_label)
        .draw()?;
    for threshold in part.thresholds().into_iter().filter(|t| x.contains(t)) {
        let line = [(threshold, 0.0), (threshold, top)];
        chart.draw_series(DashedLineSeries::new(line, 4, 4, INK.mix(0.6).into()))?;
    }
    let mut order: Vec<usize> = (0..drawn.len()).collect();
    order.sort_by_key(|n| drawn[*n].system.is_model());
    for n in order {
        let style = drawn[n].colour.stroke_width(drawn[n].width);
        chart.draw_series(LineSeries::new(curves[n].iter().copied(), style))?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ranges_are_whole_decades_within_reason() {
        assert_eq!(decades([0.02, 0.5].into_iter(), Part::Translation), 0.01..1.0);
        assert_eq!(decades([1e-9, 1e9].into_iter(), Part::Translation), 0.001..1000.0);
        assert_eq!(decades([0.5, 170.0].into_iter(), Part::Rotation), 0.1..180.0);
        assert_eq!(decades([1.0].into_iter(), Part::Rotation), 1.0..10.0);
        assert_eq!(decades([].into_iter(), Part::Rotation), 0.01..1.0);
    }
}
