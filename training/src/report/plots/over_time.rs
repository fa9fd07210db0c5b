//! Errors over time, on a logarithmic scale: good and bad systems are both readable.

use plotters::prelude::*;

use super::clip::clip;
use super::distribution::{Part, decades};
use super::{Drawn, Plot, TimeAxis, lines};
use crate::evaluate::{Evaluation, frame_errors};
use crate::report::ReportError;
use crate::report::svg::{self, FONT, FONT_PX, GRID, INK};

const PANEL_PX: u32 = 210;

pub fn draw(
    evaluation: &Evaluation,
    drawn: &[Drawn<'_>],
    sequence: usize,
    suffix: &str,
    of: &str,
) -> Result<Option<Plot>, ReportError> {
    let errors: Vec<_> = drawn.iter().map(|d| frame_errors(&evaluation.data, d.system)).collect();
    let range = evaluation.data.test_range(sequence);
    let axis_of_time = TimeAxis::new(evaluation, sequence);
    let time = |frame| axis_of_time.of(frame);
    let x = axis_of_time.range();
    if errors.iter().all(|errors| errors[range.clone()].iter().all(Option::is_none)) {
        return Ok(None);
    }
    let entries: Vec<_> = drawn.iter().map(Drawn::entry).collect();
    let height = 2 * PANEL_PX + 46 + svg::legend_height(&entries);
    let file = format!("error-over-time{suffix}");
    let text = svg::draw(&file, height, |area| {
        let mut rest = svg::legend(area, &entries)?;
        for part in [Part::Translation, Part::Rotation] {
            let bottom = part == Part::Rotation;
            let (panel, below) = rest.split_vertically(PANEL_PX + if bottom { 46 } else { 0 });
            rest = below;
            let values = errors.iter().flat_map(|e| &e[range.clone()]).flatten().map(|e| part.of(e));
            let y = decades(values, part);
            let mut chart = ChartBuilder::on(&panel)
                .margin_right(14)
                .margin_top(8)
                .x_label_area_size(if bottom { 46 } else { 0 })
                .y_label_area_size(68)
                .build_cartesian_2d(x.clone(), y.clone().log_scale())?;
            let mut mesh = chart.configure_mesh();
            mesh.light_line_style(TRANSPARENT)
                .x_label_formatter(&svg::tick)
                .bold_line_style(GRID)
                .axis_style(INK)
                .label_style((FONT, FONT_PX).into_font().color(&INK))
                .y_label_formatter(&|v| format!("{v}"))
                .y_desc(part.label());
            if bottom {
                mesh.x_desc(axis_of_time.label());
            }
            mesh.draw()?;
            for at in axis_of_time.separators() {
                let line = [(at, y.start), (at, y.end)];
                chart.draw_series(DashedLineSeries::new(line, 2, 5, INK.mix(0.4).into()))?;
            }
            // Baselines first, so that models lie on top.
            let mut order: Vec<usize> = (0..drawn.len()).collect();
            order.sort_by_key(|n| drawn[*n].system.is_model());
            for n in order {
                let point = |frame: usize| {
                    let error = errors[n][frame].as_ref()?;
                    Some((time(frame), part.of(error).max(y.start)))
                };
                for piece in lines(evaluation, sequence, point).iter().flat_map(|line| clip(line, &x, &y)) {
                    let (colour, width) = (drawn[n].colour, drawn[n].width);
                    match piece.as_slice() {
                        [only] => chart.draw_series([Circle::new(*only, width, colour.filled())])?,
                        piece => {
                            chart.draw_series(LineSeries::new(piece.to_vec(), colour.stroke_width(width)))?
                        }
                    };
                }
            }
        }
        Ok(())
    })?;
    let caption =
        "Error of each frame, logarithmic. Lines break where blocks do and where a frame has no pose.";
    Ok(Some(Plot { file, title: format!("Error over time{of}"), caption: caption.into(), svg: text }))
}
