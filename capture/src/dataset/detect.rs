//! Which layout a folder has.

use std::path::Path;

use super::listing::{Set, names};
use super::{DatasetError, Layout, OpenOptions, colmap, euroc, images, kitti, seven_scenes, tum};

/// The first layout that fits, or an error that says what was looked for.
pub(crate) fn layout(path: &Path) -> Result<Layout, DatasetError> {
    if let Some(found) = Layout::ALL.into_iter().find(|layout| fits(*layout, path)) {
        return Ok(found);
    }
    let mut looked_for: Vec<String> =
        Layout::ALL.into_iter().map(|layout| format!("  {layout}: {}", what(layout))).collect();
    let there = super::listing::entries(path)?;
    looked_for.push(format!("found: {}", names(there.iter().map(|(name, _)| name.as_str()))));
    Err(DatasetError::UnknownLayout { path: path.to_path_buf(), looked_for: looked_for.join("\n") })
}

/// The sequences in a folder of the given layout.
pub(crate) fn list(layout: Layout, path: &Path, options: &OpenOptions) -> Result<Set, DatasetError> {
    let single_camera = |set: Result<Set, DatasetError>| match &options.camera_name {
        Some(_) => Err(DatasetError::no_option("camera_name", layout, "leave it out")),
        None => set,
    };
    match layout {
        Layout::Auto => list(self::layout(path)?, path, options),
        Layout::SevenScenes => single_camera(seven_scenes::list(path)),
        Layout::Kitti => kitti::list(path, options),
        Layout::Euroc => euroc::list(path, options),
        Layout::Tum => single_camera(tum::list(path, options)),
        Layout::Colmap => colmap::list(path, options),
        Layout::Images => single_camera(images::list(path, options)),
    }
}

fn fits(layout: Layout, path: &Path) -> bool {
    match layout {
        Layout::Auto => false,
        Layout::SevenScenes => seven_scenes::fits(path),
        Layout::Kitti => kitti::fits(path),
        Layout::Euroc => euroc::fits(path),
        Layout::Tum => tum::fits(path),
        Layout::Colmap => colmap::fits(path),
        Layout::Images => images::fits(path),
    }
}

fn what(layout: Layout) -> &'static str {
    match layout {
        Layout::Auto => "",
        Layout::SevenScenes => seven_scenes::LOOKED_FOR,
        Layout::Kitti => kitti::LOOKED_FOR,
        Layout::Euroc => euroc::LOOKED_FOR,
        Layout::Tum => tum::LOOKED_FOR,
        Layout::Colmap => colmap::LOOKED_FOR,
        Layout::Images => images::LOOKED_FOR,
    }
}
