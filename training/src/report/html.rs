//! The page.

use minijinja::{AutoEscape, Environment, context};
use serde::Serialize;

use super::ReportError;
use super::markdown::facts;
use super::plots::Plot;
use super::svg;
use super::table::{Table, table};
use super::verdict::verdicts;
use crate::evaluate::Summary;

const TEMPLATE: &str = include_str!("index.html");

#[derive(Serialize)]
struct Figure {
    title: String,
    caption: String,
    svg: String,
}

#[derive(Serialize)]
struct Part {
    name: String,
    table: Table,
}

#[derive(Serialize)]
struct Calibrated {
    name: String,
    count: usize,
    nees: String,
    coverage: Vec<String>,
}

/// `index.html`: no other file is needed to look at it.
pub fn page(summary: &Summary, plots: &[Plot]) -> Result<String, ReportError> {
    let mut environment = Environment::new();
    environment.set_auto_escape_callback(|_| AutoEscape::Html);
    environment.add_template("index.html", TEMPLATE)?;
    let figures: Vec<Figure> = plots
        .iter()
        .map(|plot| Figure {
            title: plot.title.clone(),
            caption: plot.caption.clone(),
            svg: svg::inline(&plot.svg, &plot.title),
        })
        .collect();
    let sequences: Vec<Part> = match summary.sequences.as_slice() {
        [_] => Vec::new(),
        names => {
            let part =
                |(n, name): (usize, &String)| Part { name: name.clone(), table: table(summary, Some(n)) };
            names.iter().enumerate().map(part).collect()
        }
    };
    let calibrations: Vec<Calibrated> = summary
        .systems
        .iter()
        .filter_map(|system| {
            let calibration = system.overall.calibration.as_ref()?;
            Some(Calibrated {
                name: system.system.name.clone(),
                count: calibration.count,
                nees: format!("{:.2}", calibration.nees_mean),
                coverage: calibration.coverage.iter().map(|c| format!("{:.1}", 100.0 * c.measured)).collect(),
            })
        })
        .collect();
    Ok(environment.get_template("index.html")?.render(context! {
        summary,
        facts => facts(summary),
        verdicts => verdicts(summary),
        table => table(summary, None),
        sequences,
        calibrations,
        figures,
    })?)
}
