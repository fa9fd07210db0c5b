//! Retrieval by the image itself, 32x24 grey pixels.

use std::path::Path;

use super::retrieval::{self, normalise};
use super::{BaselineError, ImageError, Predictions, Progress, Task, picture};

const WIDTH_PX: u32 = 32;
const HEIGHT_PX: u32 = 24;

/// Retrieval by [`describe`].
///
/// # Errors
/// When there are no training frames, or a training image cannot be read.
pub fn predict(task: &Task, progress: Progress<'_>) -> Result<Predictions, BaselineError> {
    retrieval::predict("small image", task, describe, progress)
}

/// The image averaged to 32x24 grey pixels, brightness and contrast removed: inner products are normalised
/// cross-correlations.
///
/// # Errors
/// When the image cannot be read.
pub fn describe(path: &Path) -> Result<Vec<f32>, ImageError> {
    let small = image::imageops::thumbnail(&picture::read_grey(path)?, WIDTH_PX, HEIGHT_PX);
    let mut values: Vec<f32> = small.into_raw().into_iter().map(f32::from).collect();
    let mean = values.iter().sum::<f32>() / values.len() as f32;
    values.iter_mut().for_each(|v| *v -= mean);
    normalise(&mut values);
    Ok(values)
}

#[cfg(test)]
mod tests {
    use super::super::retrieval::dot;
    use super::*;

    #[test]
    fn brightness_and_contrast_do_not_matter_but_content_does() {
        let folder = tempfile::tempdir().unwrap();
        let write = |name: &str, grey: &dyn Fn(u32, u32) -> u8| {
            let path = folder.path().join(name);
            image::GrayImage::from_fn(64, 48, |x, y| image::Luma([grey(x, y)])).save(&path).unwrap();
            describe(&path).unwrap()
        };
        let ramp = write("ramp.png", &|x, _| (x * 2) as u8);
        let brighter = write("brighter.png", &|x, _| (x + 100) as u8);
        let across = write("across.png", &|_, y| (y * 4) as u8);
        assert_eq!(ramp.len(), 768);
        assert!((dot(&ramp, &brighter) - 1.0).abs() < 1e-3);
        assert!(dot(&ramp, &across).abs() < 1e-3);
    }
}
