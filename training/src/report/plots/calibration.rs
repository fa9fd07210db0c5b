//! Whether covariances mean what they say.

use grnet_geometry::scores::calibration::chi_square_6_cdf;
use plotters::prelude::*;

use super::{Plot, all};
use crate::evaluate::{Evaluation, sorted_nees};
use crate::report::ReportError;
use crate::report::svg::{self, Entry, FONT, FONT_PX, GRID, INK, WIDTH};

const PLOT_PX: u32 = 400;

pub fn draw(evaluation: &Evaluation) -> Result<Option<Plot>, ReportError> {
    let scored: Vec<_> = all(evaluation)
        .map(|drawn| (drawn, sorted_nees(&evaluation.data, drawn.system)))
        .filter(|(_, nees)| !nees.is_empty())
        .collect();
    if scored.is_empty() {
        return Ok(None);
    }
    let entries: Vec<Entry> = scored.iter().map(|(drawn, _)| drawn.entry()).collect();
    let height = PLOT_PX + svg::legend_height(&entries);
    let text = svg::draw("calibration", height, |area| {
        let rest = svg::legend(area, &entries)?;
        // Square: a calibrated covariance runs along the diagonal.
        let side = (WIDTH - PLOT_PX - 60) / 2;
        let square = rest.margin(0, 0, side as i32, side as i32);
        let mut chart = ChartBuilder::on(&square)
            .margin_right(14)
            .margin_top(8)
            .x_label_area_size(46)
            .y_label_area_size(60)
            .build_cartesian_2d(0.0..100.0, 0.0..100.0)?;
        chart
            .configure_mesh()
            .light_line_style(TRANSPARENT)
            .bold_line_style(GRID)
            .axis_style(INK)
            .label_style((FONT, FONT_PX).into_font().color(&INK))
            .x_label_formatter(&|v| format!("{v:.0}"))
            .y_label_formatter(&|v| format!("{v:.0}"))
            .x_desc("promised confidence (%)")
            .y_desc("frames inside (%)")
            .draw()?;
        chart.draw_series(DashedLineSeries::new([(0.0, 0.0), (100.0, 100.0)], 5, 5, INK.mix(0.6).into()))?;
        for (drawn, nees) in &scored {
            let n = nees.len() as f64;
            let steps = nees
                .iter()
                .enumerate()
                .map(|(i, v)| (100.0 * chi_square_6_cdf(*v), 100.0 * (i + 1) as f64 / n));
            let line = std::iter::once((0.0, 0.0)).chain(steps).chain([(100.0, 100.0)]);
            chart.draw_series(LineSeries::new(line, drawn.colour.stroke_width(drawn.width)))?;
        }
        Ok(())
    })?;
    let caption = "Share of frames inside the ellipsoid of each confidence. On the dashed diagonal covariances mean what they \
                   say; below it they promise too much, above it too little.";
    Ok(Some(Plot {
        file: "calibration".into(),
        title: "Calibration of the covariances".into(),
        caption: caption.into(),
        svg: text,
    }))
}
