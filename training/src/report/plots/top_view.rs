//! Paths seen from above, both axes to the same scale.

use std::ops::Range;

use grnet_geometry::Pose;
use plotters::prelude::*;

use super::clip::clip;
use super::{Drawn, Plot, extent, lines, truth_entry};
use crate::evaluate::Evaluation;
use crate::report::ReportError;
use crate::report::svg::{self, FONT, FONT_PX, GRID, INK, WIDTH};

const AXIS_NAMES: [&str; 3] = ["x", "y", "z"];
const LEFT_PX: u32 = 68;
const BOTTOM_PX: u32 = 48;
const MARGIN_PX: u32 = 14;

pub fn draw(
    evaluation: &Evaluation,
    drawn: &[Drawn<'_>],
    sequence: usize,
    suffix: &str,
    of: &str,
) -> Result<Option<Plot>, ReportError> {
    let [across, along] = horizontal_axes(evaluation.data.vertical_axis());
    let point =
        |pose: Option<Pose>| pose.map(|p| (p.translation.vector[across], p.translation.vector[along]));
    let truth =
        lines(evaluation, sequence, |frame| point(evaluation.data.task.test[frame].world_from_camera));
    let estimates: Vec<_> =
        drawn.iter().map(|d| lines(evaluation, sequence, |frame| point(d.system.pose(frame)))).collect();
    let Some((x, y)) = bounds(&truth, &estimates) else { return Ok(None) };

    let mut entries = vec![truth_entry()];
    entries.extend(drawn.iter().map(Drawn::entry));
    let plot_width = WIDTH - LEFT_PX - 2 * MARGIN_PX;
    let (x, y, plot_height) = to_scale(x, y, plot_width);
    let height = plot_height + BOTTOM_PX + 2 * MARGIN_PX + svg::legend_height(&entries);
    let file = format!("top-view{suffix}");
    let text = svg::draw(&file, height, |area| {
        let area = svg::legend(area, &entries)?;
        let mut chart = ChartBuilder::on(&area)
            .margin(MARGIN_PX)
            .x_label_area_size(BOTTOM_PX)
            .y_label_area_size(LEFT_PX)
            .build_cartesian_2d(x.clone(), y.clone())?;
        chart
            .configure_mesh()
            .light_line_style(TRANSPARENT)
            .bold_line_style(GRID)
            .axis_style(INK)
            .label_style((FONT, FONT_PX).into_font().color(&INK))
            .x_label_formatter(&svg::tick)
            .y_label_formatter(&svg::tick)
            .x_desc(format!("{} (m)", AXIS_NAMES[across]))
            .y_desc(format!("{} (m)", AXIS_NAMES[along]))
            .draw()?;
        let all = std::iter::once((&truth, INK, 3))
            .chain(estimates.iter().zip(drawn).map(|(lines, d)| (lines, d.colour, d.width)));
        for (lines, colour, width) in all {
            for part in lines.iter().flat_map(|line| clip(line, &x, &y)) {
                match part.as_slice() {
                    [only] => chart.draw_series([Circle::new(*only, width, colour.filled())])?,
                    part => chart.draw_series(LineSeries::new(part.to_vec(), colour.stroke_width(width)))?,
                };
            }
        }
        if let Some(start) = truth.first().and_then(|line| line.first()) {
            chart.draw_series([Circle::new(*start, 6, INK.filled())])?;
        }
        Ok(())
    })?;
    let caption = format!(
        "Path in the plane of the world's {} and {} axes, to scale; the dot is where the truth begins. Lines break where \
         blocks do. Estimates that leave the surroundings of the true path are cut off.",
        AXIS_NAMES[across], AXIS_NAMES[along]
    );
    Ok(Some(Plot { file, title: format!("Top view{of}"), caption, svg: text }))
}

/// The two axes that are not vertical, in the order in which they make a map: x to the right.
fn horizontal_axes(vertical: usize) -> [usize; 2] {
    match vertical {
        0 => [1, 2],
        1 => [0, 2],
        _ => [0, 1],
    }
}

type Lines = Vec<Vec<(f64, f64)>>;

/// The true path, and of the estimates what is not further out than its own size.
fn bounds(truth: &Lines, estimates: &[Lines]) -> Option<(Range<f64>, Range<f64>)> {
    let points = || truth.iter().flatten();
    let (x, y) = (extent(points().map(|p| p.0))?, extent(points().map(|p| p.1))?);
    let reach = 0.5 * (x.1 - x.0).max(y.1 - y.0).max(0.2);
    let grow = |(low, high): (f64, f64), values: &dyn Fn(&(f64, f64)) -> f64| {
        let near = estimates.iter().flatten().flatten().map(values);
        let near = near.filter(|v| (low - reach..=high + reach).contains(v));
        let (l, h) = extent(near).unwrap_or((low, high));
        let (l, h) = (l.min(low), h.max(high));
        let margin = 0.04 * (h - l).max(0.1);
        l - margin..h + margin
    };
    Some((grow(x, &|p| p.0), grow(y, &|p| p.1)))
}

/// Ranges that give a metre the same length on both axes, and the height of the plot.
fn to_scale(x: Range<f64>, y: Range<f64>, width_px: u32) -> (Range<f64>, Range<f64>, u32) {
    let (dx, dy) = (x.end - x.start, y.end - y.start);
    let height_px = (f64::from(width_px) * dy / dx).clamp(220.0, 560.0).round() as u32;
    let metres_per_px = (dx / f64::from(width_px)).max(dy / f64::from(height_px));
    let widen = |range: Range<f64>, px: u32| {
        let (centre, half) = (0.5 * (range.start + range.end), 0.5 * metres_per_px * f64::from(px));
        centre - half..centre + half
    };
    (widen(x, width_px), widen(y, height_px), height_px)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_metre_is_as_long_across_as_along() {
        for (x, y) in [(0.0..10.0, 0.0..1.0), (0.0..1.0, 0.0..10.0), (-3.0..3.0, 5.0..8.0)] {
            let (wide_x, wide_y, height) = to_scale(x.clone(), y.clone(), 700);
            let per_px =
                ((wide_x.end - wide_x.start) / 700.0, (wide_y.end - wide_y.start) / f64::from(height));
            assert!((per_px.0 / per_px.1 - 1.0).abs() < 1e-9);
            assert!(wide_x.start <= x.start && wide_y.end >= y.end && (220..=560).contains(&height));
        }
    }

    #[test]
    fn wild_estimates_do_not_shrink_the_truth() {
        let truth = vec![vec![(0.0, 0.0), (4.0, 1.0)]];
        let (x, y) = bounds(&truth, &[vec![vec![(5.0, 0.5), (1e6, -1e6)]]]).unwrap();
        assert!(x.end > 5.0 && x.end < 6.0 && y.start > -1.0);
        assert!(bounds(&vec![], &[]).is_none());
    }
}
