//! curves.svg and curves.png: what a log tells, over the steps.

mod canvas;
mod chart;
mod content;
mod series;

use std::fs;
use std::path::Path;

use plotters::prelude::{IntoDrawingArea, SVGBackend};

use self::canvas::Picture;
use self::content::Content;
use super::error;
use super::{LogEntry, RunError, atomic};
use crate::report::svg::WIDTH;

/// Draws the entries into `folder`; both pictures show the same.
pub(super) fn write(entries: &[LogEntry], folder: &Path) -> Result<(), RunError> {
    let content = Content::of(entries);
    let size = (WIDTH, chart::height(&content));
    let (svg_path, png_path) = (folder.join("curves.svg"), folder.join("curves.png"));
    let failed = |path: &Path| {
        let path = path.to_owned();
        move |reason: String| RunError::Draw { path, reason }
    };

    let mut svg = String::new();
    let area = SVGBackend::with_string(&mut svg, size).into_drawing_area();
    chart::draw(&area, &content).map_err(|error| failed(&svg_path)(error.to_string()))?;
    drop(area);
    replace(&svg_path, svg.as_bytes())?;

    let mut picture = Picture::new(size).map_err(failed(&png_path))?;
    let area = picture.canvas().into_drawing_area();
    chart::draw(&area, &content).map_err(|error| failed(&png_path)(error.to_string()))?;
    drop(area);
    replace(&png_path, &picture.to_png().map_err(failed(&png_path))?)
}

/// Like [`atomic::replace`], without waiting for the disk: a lost picture is drawn again.
fn replace(path: &Path, bytes: &[u8]) -> Result<(), RunError> {
    let from = atomic::partial(path);
    fs::write(&from, bytes).map_err(error::write(&from, bytes.len() as u64))?;
    fs::rename(&from, path).map_err(error::io("replace", path))
}
