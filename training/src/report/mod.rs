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
mod svg;
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
