//! What the figures say, in a sentence for each model.

use serde::Serialize;

use crate::evaluate::{Kind, Knowledge, Summary, SystemScores};

/// One sentence and whether it is good news.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Verdict {
    pub tone: Tone,
    pub text: String,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Tone {
    Good,
    Mixed,
    Bad,
    Neutral,
}

/// Compares every model with retrieval and with standing still.
pub fn verdicts(summary: &Summary) -> Vec<Verdict> {
    let mut verdicts = Vec::new();
    for (index, model) in summary.models.iter().enumerate() {
        if !model.trained {
            let text =
                format!("{} was never trained: its figures only show what chance gives here.", model.name);
            verdicts.push(Verdict { tone: Tone::Neutral, text });
            continue;
        }
        let of =
            |kind| summary.systems.iter().find(|s| s.system.model == Some(index) && s.system.kind == kind);
        if let Some(system) = of(Kind::Fused).or_else(|| of(Kind::Global)) {
            verdicts.extend(against_retrieval(system, summary));
        }
        if let Some(system) = of(Kind::Odometry) {
            verdicts.extend(against_standing_still(system, summary));
        }
        if model.failed_frames > 0 {
            let text =
                format!("{} gave no estimate for {} frames; see its notes.", model.name, model.failed_frames);
            verdicts.push(Verdict { tone: Tone::Bad, text });
        }
    }
    verdicts
}

fn against_retrieval(system: &SystemScores, summary: &Summary) -> Option<Verdict> {
    let medians = |s: &SystemScores| Some((s.overall.median_translation_m?, s.overall.median_rotation_deg?));
    let name = &system.system.name;
    let Some((metres, degrees)) = medians(system) else {
        return Some(Verdict {
            tone: Tone::Bad,
            text: format!("{name} has no valid pose on any judged frame."),
        });
    };
    let retrieval = summary.systems.iter().filter(|s| {
        s.system.kind == Kind::Baseline
            && s.system.knowledge == Knowledge::None
            && s.system.name.starts_with("retrieval")
    });
    let figures = retrieval.filter_map(|s| Some((s, medians(s)?)));
    let (best, (their_metres, their_degrees)) =
        figures.min_by(|a, b| (a.1.0 / 0.05 + a.1.1 / 5.0).total_cmp(&(b.1.0 / 0.05 + b.1.1 / 5.0)))?;
    let (tone, verb) = match (metres < their_metres, degrees < their_degrees) {
        (true, true) => (Tone::Good, "beats the best retrieval"),
        (false, false) => (Tone::Bad, "does not beat retrieval"),
        (true, false) => (Tone::Mixed, "beats retrieval in position only"),
        (false, true) => (Tone::Mixed, "beats retrieval in rotation only"),
    };
    let text = format!(
        "{name} {verb}: median {metres:.3} m / {degrees:.2} deg against {their_metres:.3} m / {their_degrees:.2} deg of {}.",
        best.system.name
    );
    Some(Verdict { tone, text })
}

fn against_standing_still(system: &SystemScores, summary: &Summary) -> Option<Verdict> {
    let (ours, gap) = (system.overall.motion?, summary.gap_frames);
    let still = summary.systems.iter().find(|s| s.system.name == "zero motion")?.overall.motion?;
    let (tone, verb) = match (
        ours.median_translation_m < still.median_translation_m,
        ours.median_rotation_deg < still.median_rotation_deg,
    ) {
        (true, true) => (Tone::Good, "measures motion better than standing still"),
        (false, false) => (Tone::Bad, "measures motion no better than standing still"),
        _ => (Tone::Mixed, "measures motion better than standing still in one part only"),
    };
    let text = format!(
        "{} {verb}: {:.4} m / {:.2} deg against {:.4} m / {:.2} deg over {gap} frames.",
        system.system.name,
        ours.median_translation_m,
        ours.median_rotation_deg,
        still.median_translation_m,
        still.median_rotation_deg
    );
    Some(Verdict { tone, text })
}
