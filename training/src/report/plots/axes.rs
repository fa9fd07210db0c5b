//! Position over time, axis by axis.

use plotters::prelude::*;

use super::clip::clip;
use super::{Drawn, Plot, TimeAxis, extent, lines, truth_entry};
use crate::evaluate::Evaluation;
use crate::report::ReportError;
use crate::report::svg::{self, FONT, FONT_PX, GRID, INK};

const PANEL_PX: u32 = 150;

pub fn draw(
    evaluation: &Evaluation,
    drawn: &[Drawn<'_>],
    sequence: usize,
    suffix: &str,
    of: &str,
) -> Result<Option<Plot>, ReportError> {
    let axis_of_time = TimeAxis::new(evaluation, sequence);
    let time = |frame| axis_of_time.of(frame);
    let range = evaluation.data.test_range(sequence);
    let x = axis_of_time.range();
    let truth_of = |frame: usize| evaluation.data.task.test[frame].world_from_camera;
    if range.clone().all(|frame| truth_of(frame).is_none()) {
        return Ok(None);
    }
    let mut entries = vec![truth_entry()];
    entries.extend(drawn.iter().map(Drawn::entry));
    let height = 3 * PANEL_PX + 46 + svg::legend_height(&entries);
    let file = format!("axes{suffix}");
    let text = svg::draw(&file, height, |area| {
        let mut rest = svg::legend(area, &entries)?;
        for (axis, name) in ["x (m)", "y (m)", "z (m)"].into_iter().enumerate() {
            let bottom = axis == 2;
            let panel_height = if bottom { PANEL_PX + 46 } else { PANEL_PX };
            let (panel, below) = rest.split_vertically(panel_height);
            rest = below;
            let value = |pose: grnet_geometry::Pose| pose.translation.vector[axis];
            let Some((low, high)) = extent(range.clone().filter_map(truth_of).map(value)) else { continue };
            // Room for errors of half the movement; what is wilder is cut off.
            let margin = 0.5 * (high - low).max(0.1);
            let y = low - margin..high + margin;
            let mut chart = ChartBuilder::on(&panel)
                .margin_right(14)
                .margin_top(8)
                .x_label_area_size(if bottom { 46 } else { 0 })
                .y_label_area_size(68)
                .build_cartesian_2d(x.clone(), y.clone())?;
            let mut mesh = chart.configure_mesh();
            mesh.light_line_style(TRANSPARENT)
                .x_label_formatter(&svg::tick)
                .bold_line_style(GRID)
                .axis_style(INK)
                .y_labels(5)
                .y_label_formatter(&svg::tick)
                .label_style((FONT, FONT_PX).into_font().color(&INK))
                .y_desc(name);
            if bottom {
                mesh.x_desc(axis_of_time.label());
            }
            mesh.draw()?;
            for at in axis_of_time.separators() {
                let line = [(at, y.start), (at, y.end)];
                chart.draw_series(DashedLineSeries::new(line, 2, 5, INK.mix(0.4).into()))?;
            }
            let at = |frame: usize, pose: Option<grnet_geometry::Pose>| Some((time(frame), value(pose?)));
            let truth = lines(evaluation, sequence, |frame| at(frame, truth_of(frame)));
            let estimates = drawn.iter().map(|d| {
                (lines(evaluation, sequence, |frame| at(frame, d.system.pose(frame))), d.colour, d.width)
            });
            for (lines, colour, width) in std::iter::once((truth, INK, 2)).chain(estimates) {
                for part in lines.iter().flat_map(|line| clip(line, &x, &y)) {
                    match part.as_slice() {
                        [only] => chart.draw_series([Circle::new(*only, width, colour.filled())])?,
                        part => {
                            chart.draw_series(LineSeries::new(part.to_vec(), colour.stroke_width(width)))?
                        }
                    };
                }
            }
        }
        Ok(())
    })?;
    let caption = "Position along the world's axes. Each panel spans the true movement and half as much above and below; \
                   what leaves it is cut off.";
    Ok(Some(Plot { file, title: format!("Axes over time{of}"), caption: caption.into(), svg: text }))
}
