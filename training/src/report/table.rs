//! The table of all systems, the same for every output format.

use serde::Serialize;

use crate::evaluate::{Kind, Knowledge, Scores, Summary, SystemScores};

/// A table whose cells are already text.
#[derive(Debug, Serialize)]
pub struct Table {
    pub columns: Vec<Column>,
    pub rows: Vec<Row>,
}

#[derive(Debug, Clone, Serialize)]
pub struct Column {
    /// First line of the heading.
    pub name: &'static str,
    /// Second line: unit or condition.
    pub unit: String,
}

#[derive(Debug, Serialize)]
pub struct Row {
    pub name: String,
    pub about: String,
    pub is_model: bool,
    pub untrained: bool,
    /// Told something that no method may know.
    pub knows_truth: bool,
    /// Told where each block begins.
    pub knows_start: bool,
    /// Told between which training frames each frame was taken.
    pub knows_numbers: bool,
    pub colour: Option<String>,
    pub cells: Vec<Cell>,
}

#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Cell {
    pub text: String,
    /// The best of those that are told nothing.
    pub best: bool,
}

struct Figure {
    name: &'static str,
    unit: String,
    value: fn(&Scores) -> Option<f64>,
    text: fn(f64) -> String,
    higher_is_better: bool,
    /// Judges places, for which being told a block's start is an advantage; the others judge motion.
    of_place: bool,
}

/// The table over all frames, or over one sequence by its number.
pub fn table(summary: &Summary, sequence: Option<usize>) -> Table {
    let scores = |system: &SystemScores| match sequence {
        None => Some(system.overall.clone()),
        Some(n) => system.by_sequence.get(n).map(|of| of.scores.clone()),
    };
    let all: Vec<(&SystemScores, Scores)> =
        summary.systems.iter().filter_map(|system| Some((system, scores(system)?))).collect();
    // A column that nobody has a figure in says nothing.
    let figures: Vec<Figure> = figures(summary.gap_frames)
        .into_iter()
        .filter(|figure| all.iter().any(|(_, scores)| (figure.value)(scores).is_some()))
        .collect();
    let best: Vec<Option<f64>> = figures.iter().map(|figure| best(figure, &all, summary)).collect();
    let rows = all.iter().enumerate().map(|(n, (system, scores))| {
        let cells = figures.iter().zip(&best).map(|(figure, best)| match (figure.value)(scores) {
            None => Cell { text: "–".into(), best: false },
            Some(value) => Cell {
                text: (figure.text)(value),
                best: competes(figure, system, summary) && Some(value) == *best,
            },
        });
        let valid = match system.system.kind {
            Kind::Baseline if scores.valid == 0 => "–".into(),
            _ => format!("{} / {}", scores.valid, scores.frames),
        };
        let valid = Cell { text: valid, best: false };
        let info = &system.system;
        Row {
            name: info.name.clone(),
            about: info.about.clone(),
            is_model: info.kind != Kind::Baseline,
            untrained: info.model.is_some_and(|model| !summary.models[model].trained),
            knows_truth: info.knowledge == Knowledge::Truth,
            knows_start: info.knowledge == Knowledge::FirstPose,
            knows_numbers: info.knowledge == Knowledge::FrameNumbers,
            colour: (scores.valid > 0).then(|| super::svg::colour_of(n).1.to_owned()),
            cells: std::iter::once(valid).chain(cells).collect(),
        }
    });
    let valid = Column { name: "valid", unit: "of frames".into() };
    let columns = figures.iter().map(|figure| Column { name: figure.name, unit: figure.unit.clone() });
    let columns = std::iter::once(valid).chain(columns).collect();
    Table { rows: rows.collect(), columns }
}

fn competes(figure: &Figure, system: &SystemScores, summary: &Summary) -> bool {
    let untrained = system.system.kind != Kind::Baseline
        && system.system.model.is_some_and(|model| !summary.models[model].trained);
    let fair = match system.system.knowledge {
        Knowledge::None => true,
        Knowledge::FirstPose => !figure.of_place,
        Knowledge::FrameNumbers | Knowledge::Truth => false,
    };
    fair && !untrained
}

fn best(figure: &Figure, all: &[(&SystemScores, Scores)], summary: &Summary) -> Option<f64> {
    let competitors = all.iter().filter(|(system, _)| competes(figure, system, summary));
    let values = competitors.filter_map(|(_, scores)| (figure.value)(scores));
    if figure.higher_is_better { values.reduce(f64::max) } else { values.reduce(f64::min) }
}

fn figures(gap: usize) -> Vec<Figure> {
    let metres = |v: f64| if v < 10.0 { format!("{v:.3}") } else { format!("{v:.1}") };
    let degrees = |v: f64| if v < 10.0 { format!("{v:.2}") } else { format!("{v:.1}") };
    let percent = |v: f64| format!("{:.1}", 100.0 * v);
    let figure = |name: &'static str, unit: &str, value, text, higher_is_better| Figure {
        name,
        unit: unit.to_owned(),
        value,
        text,
        higher_is_better,
        of_place: ["median", "recall %", "ATE"].contains(&name),
    };
    let over_gap = |unit: &str| format!("{unit}, {gap} frames");
    vec![
        figure("median", "m", |s| s.median_translation_m, metres, false),
        figure("median", "deg", |s| s.median_rotation_deg, degrees, false),
        figure("recall %", "5 cm, 5 deg", |s| s.recall_5cm_5deg, percent, true),
        figure("recall %", "25 cm, 10 deg", |s| s.recall_25cm_10deg, percent, true),
        figure("ATE", "m, as is", |s| s.ate.none_m, metres, false),
        figure("ATE", "m, SE(3)", |s| s.ate.se3_m, metres, false),
        figure("ATE", "m, Sim(3)", |s| s.ate.sim3_m, metres, false),
        figure("RPE", "m, 1 frame", |s| s.rpe_translation_m, |v| format!("{v:.4}"), false),
        figure("RPE", "deg, 1 frame", |s| s.rpe_rotation_deg, |v| format!("{v:.3}"), false),
        figure("t_rel", "%", |s| s.kitti.as_ref().map(|k| k.t_rel_percent), degrees, false),
        figure("r_rel", "deg/100 m", |s| s.kitti.as_ref().map(|k| k.r_rel_deg_per_100m), degrees, false),
        figure("drift", "%, 1 to 8 m", |s| s.drift.map(|d| d.t_rel_percent), degrees, false),
        figure("drift", "deg/m, 1 to 8 m", |s| s.drift.map(|d| d.r_rel_deg_per_m), degrees, false),
        figure(
            "motion",
            &over_gap("m"),
            |s| s.motion.map(|m| m.median_translation_m),
            |v| format!("{v:.4}"),
            false,
        ),
        figure("motion", &over_gap("deg"), |s| s.motion.map(|m| m.median_rotation_deg), degrees, false),
    ]
}
