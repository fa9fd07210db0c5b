//! The report folder of an evaluation.
//!
//! | file | what |
//! |---|---|
//! | `index.html` | everything on one self-contained page |
//! | `report.md` | the tables as Markdown |
//! | `scores.json` | the figures for programs: [`Summary`] |
//! | `plots/*.svg` | the plots one by one |
//! | `trajectories/<system>/<sequence>.tum` | predicted poses, time by time |
//! | `trajectories/<system>/<sequence>.kitti` | the same row by row; `<sequence>.truth.kitti` holds the true poses of the same frames, for tools that pair rows |
//! | `trajectories/truth/<sequence>.tum` | the true poses of all test frames |

mod html;
mod markdown;
mod plots;
pub(crate) mod svg;
mod table;
mod trajectories;
mod verdict;

use std::path::{Path, PathBuf};

use crate::evaluate::{Evaluation, Summary};

pub use markdown::terminal_table;

/// Name of the file by which a report's folder is known.
pub const SCORES_FILE: &str = "scores.json";

/// Why a report could not be written.
#[derive(Debug, thiserror::Error)]
pub enum ReportError {
    /// A file or folder cannot be written.
    #[error("cannot write {path}")]
    Write {
        /// The file or folder.
        path: PathBuf,
        /// What the system says.
        #[source]
        source: std::io::Error,
    },
    /// The folder holds something else.
    #[error(
        "{path} is not empty and holds no report ({SCORES_FILE} is missing): give a new folder with --out"
    )]
    Occupied {
        /// The folder.
        path: PathBuf,
    },
    /// A plot cannot be drawn.
    #[error("cannot draw the plot {name}: {reason}")]
    Plot {
        /// Name of the plot.
        name: String,
        /// What the drawing library says.
        reason: String,
    },
    /// A trajectory cannot be written.
    #[error("cannot write a trajectory")]
    Trajectory(#[from] grnet_geometry::trajectory::TrajectoryError),
    /// The figures cannot be written as JSON.
    #[error("cannot write the figures as JSON")]
    Json(#[from] serde_json::Error),
    /// The page cannot be put together.
    #[error("cannot put the page together")]
    Page(#[from] minijinja::Error),
}

impl ReportError {
    fn write(path: &Path) -> impl FnOnce(std::io::Error) -> Self + '_ {
        |source| Self::Write { path: path.to_path_buf(), source }
    }
}

/// Refuses a folder with anything but an earlier report in it, before hours of computing.
///
/// # Errors
/// [`ReportError::Occupied`], or when the folder cannot be read.
pub fn check_folder(folder: &Path) -> Result<(), ReportError> {
    if !folder.exists() || folder.join(SCORES_FILE).is_file() {
        return Ok(());
    }
    let mut entries = std::fs::read_dir(folder).map_err(ReportError::write(folder))?;
    match entries.next() {
        None => Ok(()),
        Some(_) => Err(ReportError::Occupied { path: folder.to_path_buf() }),
    }
}

/// Writes the whole report; plots and trajectories of an earlier one are removed.
///
/// # Errors
/// See [`ReportError`].
pub fn write(evaluation: &Evaluation, folder: &Path) -> Result<(), ReportError> {
    check_folder(folder)?;
    for part in ["plots", "trajectories"] {
        let path = folder.join(part);
        if path.exists() {
            std::fs::remove_dir_all(&path).map_err(ReportError::write(&path))?;
        }
        std::fs::create_dir_all(&path).map_err(ReportError::write(&path))?;
    }
    let plots = plots::draw(evaluation)?;
    for plot in &plots {
        write_file(&folder.join("plots").join(format!("{}.svg", plot.file)), &svg::standalone(&plot.svg))?;
    }
    trajectories::write(evaluation, &folder.join("trajectories"))?;
    write_file(&folder.join("report.md"), &markdown::page(&evaluation.summary, &plots))?;
    write_file(&folder.join("index.html"), &html::page(&evaluation.summary, &plots)?)?;
    // Last: a folder with scores is a complete report.
    write_file(&folder.join(SCORES_FILE), &json(&evaluation.summary)?)
}

fn json(summary: &Summary) -> Result<String, ReportError> {
    let mut text = serde_json::to_string_pretty(summary)?;
    text.push('\n');
    Ok(text)
}

fn write_file(path: &Path, text: &str) -> Result<(), ReportError> {
    std::fs::write(path, text).map_err(ReportError::write(path))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::evaluate::{ModelInfo, SCHEMA, System, drive, drive_system, score};
    use grnet_geometry::{Covariance6, Pose};

    /// A trained model that is 2 % too long on a drive of 250 m, with covariances, and one that found nothing.
    fn evaluation() -> Evaluation {
        let data = drive(&(0..251).collect::<Vec<_>>());
        let long = |n: usize, truth: Pose| {
            Some(Pose::translation(0.1 * (n as f64 * 0.05).sin(), 0.0, 1.02 * truth.translation.z))
        };
        let mut found = drive_system(&data, long);
        found.covariances =
            (0..251).map(|n| Covariance6::from_diagonal([0.5 + 0.01 * f64::from(n); 6])).collect();
        let lost = drive_system(&data, |_, _| None);
        let named = |system: System, name: &str| System {
            name: name.into(),
            slug: crate::evaluate::slug(name),
            model: Some(0),
            ..system
        };
        let systems = vec![named(found, "model fused"), named(lost, "lost <&> global")];
        let summary = Summary {
            schema: SCHEMA,
            generator: "test".into(),
            sequences: vec!["drive".into()],
            train_frames: 0,
            test_frames: 251,
            judged_frames: 251,
            test_blocks: 1,
            path_m: 250.0,
            gap_frames: 10,
            notes: Vec::new(),
            models: vec![ModelInfo {
                name: "model".into(),
                files: vec!["model.safetensors".into()],
                model_hash: "00".into(),
                trained: true,
                scene: None,
                input_px: (64, 48),
                parameters: 1_000_000,
                failed_frames: 3,
                odometry_restarts: 0,
                notes: vec!["no estimate: frame 7".into()],
            }],
            systems: systems.iter().map(|system| score(&data, system, 10)).collect(),
        };
        Evaluation { data, systems, summary }
    }

    #[test]
    fn drift_and_calibration_are_drawn_where_there_are_any() {
        let folder = tempfile::tempdir().unwrap();
        write(&evaluation(), folder.path()).unwrap();
        for plot in ["kitti", "calibration", "top-view", "axes", "error-over-time", "shares", "histogram"] {
            let svg = std::fs::read_to_string(folder.path().join(format!("plots/{plot}.svg"))).unwrap();
            assert!(svg.starts_with("<svg") && svg.contains("model fused"), "{plot}");
        }
        let read = |name: &str| std::fs::read_to_string(folder.path().join(name)).unwrap();
        let (page, markdown) = (read("index.html"), read("report.md"));
        for text in [&page, &markdown] {
            assert!(
                text.contains("t_rel")
                    && text.contains("mean NEES")
                    && text.contains("no estimate for 3 frames")
            );
        }
        assert!(page.contains("lost &lt;&amp;&gt; global") && !page.contains("lost <"));
        // Who found nothing has no trajectory, no median and a recall of zero.
        assert!(!folder.path().join("trajectories/lost-global").exists());
        let scores: Summary = serde_json::from_str(&read(SCORES_FILE)).unwrap();
        assert_eq!(scores, evaluation().summary);
        assert_eq!(scores.systems[1].overall.median_translation_m, None);
        assert_eq!(scores.systems[1].overall.recall_25cm_10deg, Some(0.0));
        let t_rel = scores.systems[0].overall.kitti.as_ref().unwrap().t_rel_percent;
        assert!((2.0..2.3).contains(&t_rel), "{t_rel}");
    }

    #[test]
    fn only_an_earlier_report_is_replaced() {
        let folder = tempfile::tempdir().unwrap();
        assert!(check_folder(&folder.path().join("new")).is_ok());
        assert!(check_folder(folder.path()).is_ok());
        std::fs::write(folder.path().join("notes.txt"), "").unwrap();
        assert!(matches!(check_folder(folder.path()), Err(ReportError::Occupied { .. })));
        std::fs::write(folder.path().join(SCORES_FILE), "{}").unwrap();
        assert!(check_folder(folder.path()).is_ok());
    }
}
