//! Gradient descriptors on a dense grid, the "dense SIFT" of DenseVLAD (Torii et al., "24/7 Place Recognition by View
//! Synthesis", CVPR 2015): no detector that could miss a blurred image.

use std::path::Path;

use image::imageops::{FilterType, resize, thumbnail};
use imageproc::hog::{HogOptions, hog};

use super::retrieval::normalise;
use super::{ImageError, picture};

/// Numbers of one descriptor: 4x4 cells of 8 directions.
pub const LENGTH: usize = 128;

/// Width that an image is brought to; 320 px keep the structures of a room and cost 1/4 of VGA.
const WIDTH_PX: u32 = 320;
/// Side of a cell. With 16 cells a descriptor covers 32x32 px, a tenth of the image's width.
const CELL_PX: usize = 8;
const CELLS: usize = 4;
/// Descriptors start on every second cell.
const STRIDE: usize = 2;
const DIRECTIONS: usize = 8;
/// Lowe's limit on a single entry, against strong lights.
const CLIP: f32 = 0.2;

/// Descriptors of an image in rows from the top left, [`LENGTH`] numbers each, of unit norm; flat patches have none.
pub fn describe(path: &Path) -> Result<Vec<f32>, ImageError> {
    let grey = picture::read_grey(path)?;
    let (width, height) = grey.dimensions();
    // Both sides in whole strides, at least one descriptor high.
    let grid = (CELL_PX * STRIDE) as u32;
    let rows = f64::from(WIDTH_PX) * f64::from(height) / f64::from(width) / f64::from(grid);
    let to_height = (rows.round() as u32).clamp((CELLS / STRIDE) as u32, 1024) * grid;
    let scaled = if width >= WIDTH_PX && height >= to_height {
        thumbnail(&grey, WIDTH_PX, to_height)
    } else {
        resize(&grey, WIDTH_PX, to_height, FilterType::Triangle)
    };
    let options = HogOptions::new(DIRECTIONS, true, CELL_PX, CELLS, STRIDE);
    let mut values = hog(&scaled, options).map_err(|found| ImageError::Format {
        found: format!("{width}x{height}: {found}; an image of moderate shape"),
    })?;
    for descriptor in values.chunks_exact_mut(LENGTH) {
        root(descriptor);
    }
    let flat = |descriptor: &&[f32]| descriptor.iter().any(|v| *v > 0.0);
    Ok(values.chunks_exact(LENGTH).filter(flat).flatten().copied().collect())
}

/// Lowe's normalisation, then the square root of the shares (Arandjelovic and Zisserman, "Three things everyone should
/// know to improve object retrieval", CVPR 2012): Euclidean distance becomes Hellinger's, and the norm 1.
fn root(descriptor: &mut [f32]) {
    normalise(descriptor);
    let mut sum = 0.0;
    for value in descriptor.iter_mut() {
        *value = value.clamp(0.0, CLIP);
        sum += *value;
    }
    if sum > 0.0 {
        descriptor.iter_mut().for_each(|value| *value = (*value / sum).sqrt());
    }
}

#[cfg(test)]
mod tests {
    use super::super::retrieval::dot;
    use super::*;

    #[test]
    fn descriptors_are_unit_vectors_and_flat_patches_have_none() {
        let folder = tempfile::tempdir().unwrap();
        let count = |width, height, grey: &dyn Fn(u32, u32) -> u8| {
            let path = folder.path().join("image.png");
            image::GrayImage::from_fn(width, height, |x, y| image::Luma([grey(x, y)])).save(&path).unwrap();
            let descriptors = describe(&path).unwrap();
            for descriptor in descriptors.chunks(LENGTH) {
                assert!((dot(descriptor, descriptor) - 1.0).abs() < 1e-4);
            }
            descriptors.len() / LENGTH
        };
        let checks = |x: u32, y: u32| if (x / 9 + y / 7).is_multiple_of(2) { 220 } else { 30 };
        assert_eq!(count(640, 480, &checks), 19 * 14);
        // Wide, small and nearly square images give a grid as well.
        assert_eq!(count(1242, 375, &checks), 19 * 5);
        assert!(count(48, 40, &checks) > 100);
        assert_eq!(count(640, 480, &|_, _| 128), 0);
        assert!(count(640, 480, &|x, _| if x < 320 { 0 } else { 255 }) < 19 * 14 / 4);
    }
}
