//! The scores for people.

use std::fmt::Write as _;

use grnet_geometry::scores::{kitti::Mean, rpe::Delta};

use super::report::Report;

/// Renders the report as text.
pub(super) fn render(report: &Report) -> String {
    let mut out = String::new();
    // Writing to a String cannot fail.
    let mut line = |text: String| {
        let _ = writeln!(out, "{}", text.trim_end());
    };
    let alignment = format!("{:?}", report.alignment).to_lowercase();
    let scale =
        report.alignment_scale.filter(|s| *s != 1.0).map_or(String::new(), |s| format!(" (scale {s:.6})"));
    line(format!(
        "{} poses compared, {} missing, {:.2} m of ground truth, alignment {alignment}{scale}",
        report.poses, report.missing, report.path_length_m
    ));
    line(String::new());

    let mut row = |name: &str, value: Option<f64>, unit: &str, remark: String| {
        let value = value.map_or_else(|| "-".into(), |v| format!("{v:.6}"));
        line(format!("  {name:<22}{value:>14} {unit:<10}{remark}"));
    };
    let segments = format!("{} segments", report.segments);
    row("t_rel", report.t_rel_percent, "%", segments.clone());
    row("r_rel", report.r_rel_deg_per_100m, "deg/100 m", segments);
    for (name, rmse) in [
        ("ATE (no alignment)", report.ate_rmse_m.none),
        ("ATE (SE3)", report.ate_rmse_m.se3),
        ("ATE (Sim3)", report.ate_rmse_m.sim3),
    ] {
        row(name, rmse, "m", "RMSE".into());
    }
    let delta = match report.rpe.as_ref().map(|r| r.options.delta) {
        Some(Delta::Frames(n)) => format!("RMSE over {n} frame{}", if n == 1 { "" } else { "s" }),
        Some(Delta::Metres(m)) => format!("RMSE over {m} m"),
        None => String::new(),
    };
    row("RPE translation", report.rpe_trans_rmse_m, "m", delta.clone());
    row("RPE rotation", report.rpe_rot_rmse_deg, "deg", delta);
    row("median translation", report.median_translation_m, "m", String::new());
    row("median rotation", report.median_rotation_deg, "deg", String::new());
    for recall in &report.recalls {
        let name = format!("recall {} cm/{} deg", rounded(recall.translation_m * 100.0), recall.rotation_deg);
        row(&name, Some(recall.recall * 100.0), "%", String::new());
    }

    let head =
        |first: &str| format!("{first:>8}{:>10}{:>12}{:>18}", "segments", "t_rel (%)", "r_rel (deg/100 m)");
    let body =
        |m: &Mean| format!("{:>10}{:>12.4}{:>18.4}", m.segments, m.t_rel_percent, m.r_rel_deg_per_100m);
    if !report.per_length.is_empty() {
        line(format!("\n{}", head("m")));
        report.per_length.iter().for_each(|r| line(format!("{:>8}{}", r.length_m, body(&r.mean))));
    }
    if !report.per_speed.is_empty() {
        line(format!("\n{}", head("m/s")));
        report.per_speed.iter().for_each(|r| line(format!("{:>8}{}", r.speed_mps, body(&r.mean))));
    }
    if !report.notes.is_empty() {
        line(String::new());
        report.notes.iter().for_each(|n| line(format!("note: {n}")));
    }
    out
}

/// Hides the last digits that a change of unit leaves.
fn rounded(value: f64) -> f64 {
    (value * 1e6).round() / 1e6
}
