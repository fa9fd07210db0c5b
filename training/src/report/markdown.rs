//! The report as Markdown, and the table for a terminal.

use std::fmt::Write as _;

use super::plots::Plot;
use super::table::{Row, Table, table};
use super::verdict::verdicts;
use crate::evaluate::Summary;

/// `report.md`.
pub fn page(summary: &Summary, plots: &[Plot]) -> String {
    let mut text = String::from("# Evaluation\n\n");
    for line in facts(summary) {
        let _ = writeln!(text, "* {line}");
    }
    let verdicts = verdicts(summary);
    if !verdicts.is_empty() {
        text.push_str("\n## Result\n\n");
    }
    for verdict in verdicts {
        let _ = writeln!(text, "* {}", verdict.text);
    }
    text.push_str("\n## Scores\n\n");
    text.push_str(&markdown_table(&table(summary, None)));
    text.push_str(
        "\nBold: the best trained method or retrieval that is told nothing about the test frames; knowing a block's start \
         is fair for RPE, drift and motion. †: told true poses of the test frames. ‡: told the true pose of each block's \
         first frame. §: sees no image. Medians are over valid frames, recalls over all judged frames.\n",
    );
    if summary.sequences.len() > 1 {
        for (n, sequence) in summary.sequences.iter().enumerate() {
            let _ = write!(text, "\n### {sequence}\n\n{}", markdown_table(&table(summary, Some(n))));
        }
    }
    text.push_str(&calibration(summary));
    text.push_str("\n## Methods\n\n");
    for system in &summary.systems {
        let _ = writeln!(text, "* **{}**: {}", system.system.name, system.system.about);
    }
    if !summary.models.is_empty() {
        text.push_str("\n## Models\n\n");
    }
    for model in &summary.models {
        let state = if model.trained { "trained" } else { "untrained" };
        let (width, height) = model.input_px;
        let parameters = model.parameters as f64 / 1e6;
        let _ = writeln!(
            text,
            "* **{}** ({state}, {width}x{height} px, {parameters:.2} M parameters, sha256 {}): {}",
            model.name,
            model.model_hash,
            model.files.join(" + ")
        );
        for note in &model.notes {
            let _ = writeln!(text, "  * {note}");
        }
    }
    text.push_str("\n## Plots\n");
    for plot in plots {
        let _ = write!(text, "\n![{}](plots/{}.svg)\n\n{}\n", plot.title, plot.file, plot.caption);
    }
    text
}

/// What was judged, one sentence each.
pub fn facts(summary: &Summary) -> Vec<String> {
    let blocks = match summary.test_blocks {
        1 => "one block".to_owned(),
        count => format!("{count} blocks"),
    };
    let mut facts = vec![
        format!("Tested on {}", summary.sequences.join(", ")),
        format!(
            "{} test frames in {}, {} with a true pose, {:.1} m of path; state is reset at the start of each block",
            summary.test_frames, blocks, summary.judged_frames, summary.path_m
        ),
    ];
    facts.push(match summary.train_frames {
        0 => "No training frames: retrieval cannot be judged".to_owned(),
        frames => format!("{frames} training frames for retrieval"),
    });
    if summary.systems.iter().all(|system| system.overall.motion.is_none()) {
        facts.push(format!(
            "No block holds a pair of frames {} apart: motion cannot be judged over this gap; choose a shorter --gap",
            summary.gap_frames
        ));
    }
    facts.extend(summary.notes.iter().cloned());
    facts
}

/// Name, medians and recalls for a terminal.
pub fn terminal_table(summary: &Summary) -> String {
    let table = table(summary, None);
    let header = std::iter::once("method".to_owned())
        .chain(table.columns.iter().map(|column| format!("{} {}", column.name, column.unit)));
    let mut lines: Vec<Vec<String>> = vec![header.take(6).collect()];
    for row in &table.rows {
        let cells = row.cells.iter().map(|cell| cell.text.clone());
        lines.push(std::iter::once(marked(row)).chain(cells).take(6).collect());
    }
    let widths: Vec<usize> = (0..lines[0].len())
        .map(|column| lines.iter().map(|line| line[column].chars().count()).max().unwrap_or(0))
        .collect();
    let mut text = String::new();
    for line in lines {
        for (column, (cell, width)) in line.iter().zip(&widths).enumerate() {
            let _ =
                if column == 0 { write!(text, "{cell:<width$}") } else { write!(text, "  {cell:>width$}") };
        }
        text.push('\n');
    }
    text
}

fn markdown_table(table: &Table) -> String {
    let mut text = String::from("| method |");
    for column in &table.columns {
        let _ = write!(text, " {} ({}) |", column.name, column.unit);
    }
    text.push_str("\n|---|");
    text.push_str(&"---:|".repeat(table.columns.len()));
    text.push('\n');
    for row in &table.rows {
        let _ = write!(text, "| {} |", marked(row));
        for cell in &row.cells {
            let _ = if cell.best {
                write!(text, " **{}** |", cell.text)
            } else {
                write!(text, " {} |", cell.text)
            };
        }
        text.push('\n');
    }
    text
}

fn marked(row: &Row) -> String {
    let untrained = if row.untrained && row.is_model { " (untrained)" } else { "" };
    let told = if row.knows_numbers {
        " §"
    } else if row.knows_truth {
        " †"
    } else if row.knows_start {
        " ‡"
    } else {
        ""
    };
    format!("{}{untrained}{told}", row.name)
}

fn calibration(summary: &Summary) -> String {
    let mut text = String::new();
    for system in &summary.systems {
        let Some(calibration) = &system.overall.calibration else { continue };
        if text.is_empty() {
            text.push_str("\n## Covariances\n\n| system | frames | mean NEES (6) | within 68 % | within 95 % | within 99.7 % |\n|---|---:|---:|---:|---:|---:|\n");
        }
        let [a, b, c] = calibration.coverage.map(|coverage| 100.0 * coverage.measured);
        let _ = writeln!(
            text,
            "| {} | {} | {:.2} | {a:.1} % | {b:.1} % | {c:.1} % |",
            system.system.name, calibration.count, calibration.nees_mean
        );
    }
    text
}
