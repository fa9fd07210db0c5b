//! KITTI's segment errors by length.

use plotters::prelude::*;

use super::{Plot, all};
use crate::evaluate::Evaluation;
use crate::report::ReportError;
use crate::report::svg::{self, Entry, FONT, FONT_PX, GRID, INK, WIDTH};

const PANEL_PX: u32 = 300;

pub fn draw(evaluation: &Evaluation) -> Result<Option<Plot>, ReportError> {
    let scored: Vec<_> = all(evaluation)
        .zip(&evaluation.summary.systems)
        .filter_map(|(drawn, scores)| Some((drawn, scores.overall.kitti.as_ref()?)))
        .collect();
    if scored.is_empty() {
        return Ok(None);
    }
    let entries: Vec<Entry> = scored.iter().map(|(drawn, _)| drawn.entry()).collect();
    let height = PANEL_PX + svg::legend_height(&entries);
    let text = svg::draw("kitti", height, |area| {
        let rest = svg::legend(area, &entries)?;
        let (left, right) = rest.split_horizontally(WIDTH / 2);
        for (panel, translation, label) in [(left, true, "t_rel (%)"), (right, false, "r_rel (deg/100 m)")] {
            let lines: Vec<Vec<(f64, f64)>> = scored
                .iter()
                .map(|(_, kitti)| {
                    let rows = kitti.per_length.iter();
                    let value = |mean: &grnet_geometry::scores::kitti::Mean| {
                        if translation { mean.t_rel_percent } else { mean.r_rel_deg_per_100m }
                    };
                    rows.map(|row| (f64::from(row.length_m), value(&row.mean))).collect()
                })
                .collect();
            let top = lines.iter().flatten().map(|point| point.1).fold(0.0, f64::max);
            let mut chart = ChartBuilder::on(&panel)
                .margin_right(14)
                .margin_top(8)
                .x_label_area_size(46)
                .y_label_area_size(68)
                .build_cartesian_2d(50.0..850.0, 0.0..(1.1 * top).max(1e-3))?;
            chart
                .configure_mesh()
                .light_line_style(TRANSPARENT)
                .bold_line_style(GRID)
                .axis_style(INK)
                .label_style((FONT, FONT_PX).into_font().color(&INK))
                .x_label_formatter(&svg::tick)
                .y_label_formatter(&svg::tick)
                .x_desc("length of the segment (m)")
                .y_desc(label)
                .draw()?;
            for ((drawn, _), line) in scored.iter().zip(&lines) {
                let style = drawn.colour.stroke_width(drawn.width);
                chart.draw_series(LineSeries::new(line.iter().copied(), style))?;
                chart.draw_series(line.iter().map(|point| Circle::new(*point, 4, drawn.colour.filled())))?;
            }
        }
        Ok(())
    })?;
    let caption = "Error of the motion over segments of 100 to 800 m within blocks, as the KITTI development kit computes it.";
    Ok(Some(Plot {
        file: "kitti".into(),
        title: "Drift by length".into(),
        caption: caption.into(),
        svg: text,
    }))
}
