//! Image files as grey pictures.

use std::path::Path;

use grnet_capture::decode;
use grnet_frame::PixelFormat;
use image::GrayImage;

use super::ImageError;

/// Reads an image file as grey, luma of ITU-R BT.601.
pub fn read_grey(path: &Path) -> Result<GrayImage, ImageError> {
    let pixels = decode::decode_file(path)?;
    let (width, height) = (pixels.width_px(), pixels.height_px());
    let rows = (0..height as usize).map(|y| pixels.row(y));
    let data: Vec<u8> = match pixels.format() {
        PixelFormat::Gray8 => rows.flatten().copied().collect(),
        PixelFormat::Rgb8 => rows.flat_map(|row| row.chunks_exact(3)).map(luma).collect(),
        other => return Err(ImageError::Format { found: format!("{other:?}") }),
    };
    GrayImage::from_raw(width, height, data)
        .ok_or_else(|| ImageError::Format { found: format!("fewer than {width}x{height}") })
}

fn luma(rgb: &[u8]) -> u8 {
    let [r, g, b] = [rgb[0], rgb[1], rgb[2]].map(u32::from);
    ((299 * r + 587 * g + 114 * b + 500) / 1000) as u8
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn colours_weigh_as_the_eye_sees_them() {
        assert_eq!(
            [[255, 255, 255], [255, 0, 0], [0, 255, 0], [0, 0, 255]].map(|c| luma(&c)),
            [255, 76, 150, 29]
        );
    }

    #[test]
    fn files_are_read_and_missing_ones_named() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.png");
        image::RgbImage::from_fn(3, 2, |x, _| image::Rgb([0, (x * 100) as u8, 0])).save(&path).unwrap();
        let grey = read_grey(&path).unwrap();
        assert_eq!(
            (grey.dimensions(), grey.get_pixel(1, 1).0, grey.get_pixel(2, 0).0),
            ((3, 2), [59], [117])
        );
        let error = read_grey(&folder.path().join("b.png")).unwrap_err().to_string();
        assert!(error.contains("b.png"), "{error}");
    }
}
