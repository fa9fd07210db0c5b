//! Frames to the bytes of image files.

use std::io::Cursor;

use grnet_frame::{PixelFormat, Pixels};
use image::codecs::jpeg::JpegEncoder;
use image::codecs::png::{CompressionType, FilterType, PngEncoder};
use image::{ExtendedColorType, ImageEncoder as _, ImageError};
use yuv::{YuvBiPlanarImage, YuvConversionMode, YuvPackedImage, YuvRange, YuvStandardMatrix};

use super::ImageFormat;

/// Why a frame became no image.
#[derive(Debug, thiserror::Error)]
pub(super) enum EncodeError {
    #[error("the {format} frame cannot be converted to RGB: {source}")]
    Yuv { format: PixelFormat, source: yuv::YuvError },
    #[error("the image cannot be encoded: {0}")]
    Image(#[from] ImageError),
}

/// The bytes of an image file, and how its name ends.
#[derive(Debug)]
pub(super) struct Encoded {
    pub bytes: Vec<u8>,
    pub extension: &'static str,
}

/// JPEG as it came; everything else in the chosen format. YUYV and NV12 become RGB exactly as they do on their way
/// to the network: BT.601, limited range.
pub(super) fn encode(pixels: &Pixels, format: ImageFormat) -> Result<Encoded, EncodeError> {
    let (width, height) = (pixels.width_px(), pixels.height_px());
    let rows = |count: usize| -> Vec<u8> { (0..count).flat_map(|y| pixels.row(y)).copied().collect() };
    let (data, kind) = match pixels.format() {
        PixelFormat::Jpeg => return Ok(Encoded { bytes: with_tables(pixels.data())?, extension: "jpg" }),
        PixelFormat::Gray8 => (rows(height as usize), ExtendedColorType::L8),
        PixelFormat::Rgb8 => (rows(height as usize), ExtendedColorType::Rgb8),
        PixelFormat::Yuyv | PixelFormat::Nv12 => (to_rgb(pixels, rows)?, ExtendedColorType::Rgb8),
    };
    let mut bytes = Vec::new();
    let extension = match format {
        ImageFormat::Png => {
            PngEncoder::new_with_quality(&mut bytes, CompressionType::Fast, FilterType::Adaptive)
                .write_image(&data, width, height, kind)?;
            "png"
        }
        ImageFormat::Jpeg { quality } => {
            JpegEncoder::new_with_quality(&mut bytes, quality).encode(&data, width, height, kind)?;
            "jpg"
        }
    };
    Ok(Encoded { bytes, extension })
}

fn to_rgb(pixels: &Pixels, rows: impl Fn(usize) -> Vec<u8>) -> Result<Vec<u8>, EncodeError> {
    let (width, height) = (pixels.width_px(), pixels.height_px());
    let mut rgb = vec![0; width as usize * height as usize * 3];
    let (range, matrix) = (YuvRange::Limited, YuvStandardMatrix::Bt601);
    let converted = if pixels.format() == PixelFormat::Yuyv {
        let data = rows(height as usize);
        let image = YuvPackedImage { yuy: &data, yuy_stride: width * 2, width, height };
        yuv::yuyv422_to_rgb(&image, &mut rgb, width * 3, range, matrix)
    } else {
        let data = rows(height as usize * 3 / 2);
        let (y_plane, uv_plane) = data.split_at(width as usize * height as usize);
        let image = YuvBiPlanarImage { y_plane, y_stride: width, uv_plane, uv_stride: width, width, height };
        yuv::yuv_nv12_to_rgb(&image, &mut rgb, width * 3, range, matrix, YuvConversionMode::Balanced)
    };
    converted.map_err(|source| EncodeError::Yuv { format: pixels.format(), source })?;
    Ok(rgb)
}

const DHT: u8 = 0xc4;
const SOS: u8 = 0xda;

/// Many cameras leave out the Huffman tables, and mean those of the standard; a file needs them. The coded pixels
/// stay as they are.
fn with_tables(jpeg: &[u8]) -> Result<Vec<u8>, ImageError> {
    let segments = segments(jpeg);
    // Without a scan it is no JPEG that tables would help.
    if segments.iter().any(|(marker, _)| *marker == DHT) || !segments.iter().any(|(m, _)| *m == SOS) {
        return Ok(jpeg.to_vec());
    }
    Ok([&jpeg[..2], &standard_tables()?, &jpeg[2..]].concat())
}

/// The tables of the standard's annex K, which the encoder writes into every colour image.
fn standard_tables() -> Result<Vec<u8>, ImageError> {
    let mut any = Vec::new();
    JpegEncoder::new(Cursor::new(&mut any)).encode(&[0; 3], 1, 1, ExtendedColorType::Rgb8)?;
    Ok(segments(&any).iter().filter(|(m, _)| *m == DHT).flat_map(|(_, bytes)| bytes.to_vec()).collect())
}

/// Markers with their bytes, to the first scan.
fn segments(jpeg: &[u8]) -> Vec<(u8, &[u8])> {
    let mut found = Vec::new();
    let mut at = 2;
    while let Some(&[0xff, marker, high, low]) = jpeg.get(at..at + 4) {
        let end = at + 2 + usize::from(u16::from_be_bytes([high, low]));
        let Some(bytes) = jpeg.get(at..end) else { break };
        found.push((marker, bytes));
        if marker == SOS {
            break;
        }
        at = end;
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::decode::decode_bytes;

    const PNG: ImageFormat = ImageFormat::Png;

    fn noise(count: usize) -> Vec<u8> {
        (0..count as u32).map(|i| (i.wrapping_mul(2_654_435_761) >> 24) as u8).collect()
    }

    #[test]
    fn grey_and_colour_come_back_without_loss_whatever_their_stride() {
        for (format, stride) in [(PixelFormat::Gray8, 11), (PixelFormat::Rgb8, 32)] {
            let pixels = Pixels::strided(format, 10, 6, stride, noise(stride * 6)).unwrap();
            let encoded = encode(&pixels, PNG).unwrap();
            let back = decode_bytes(&encoded.bytes).unwrap();
            assert_eq!((encoded.extension, back.format()), ("png", format));
            assert!((0..6).all(|y| back.row(y) == pixels.row(y)));
        }
    }

    #[test]
    fn yuv_frames_become_the_colours_that_they_mean() {
        // BT.601, limited range: white, and the green of Y 145, U 54, V 34.
        let yuyv = Pixels::packed(PixelFormat::Yuyv, 2, 1, vec![235, 128, 235, 128]).unwrap();
        let nv12 = Pixels::packed(PixelFormat::Nv12, 2, 2, vec![145, 145, 145, 145, 54, 34]).unwrap();
        for (pixels, colour) in [(yuyv, [255u8, 255, 255]), (nv12, [0, 255, 1])] {
            let back = decode_bytes(&encode(&pixels, PNG).unwrap().bytes).unwrap();
            for (found, wanted) in back.data().iter().zip(colour.iter().cycle()) {
                assert!(found.abs_diff(*wanted) <= 2, "{:?} {:?}", pixels.format(), back.data());
            }
        }
    }

    #[test]
    fn a_jpeg_is_written_as_it_came_and_one_without_tables_gets_the_standard_ones() {
        let rgb = Pixels::packed(PixelFormat::Rgb8, 16, 16, noise(768)).unwrap();
        let jpeg = encode(&rgb, ImageFormat::Jpeg { quality: 95 }).unwrap();
        assert_eq!(jpeg.extension, "jpg");
        let frame = |bytes: &[u8]| Pixels::packed(PixelFormat::Jpeg, 16, 16, bytes.to_vec()).unwrap();
        assert_eq!(encode(&frame(&jpeg.bytes), PNG).unwrap().bytes, jpeg.bytes);

        let tables = standard_tables().unwrap();
        let without: Vec<u8> = {
            let at = jpeg.bytes.windows(2).position(|pair| pair == [0xff, DHT]).unwrap();
            assert_eq!(jpeg.bytes[at..at + tables.len()], tables);
            [&jpeg.bytes[..at], &jpeg.bytes[at + tables.len()..]].concat()
        };
        let repaired = encode(&frame(&without), PNG).unwrap().bytes;
        assert_eq!(repaired.len(), jpeg.bytes.len());
        assert!(decode_bytes(&repaired).unwrap() == decode_bytes(&jpeg.bytes).unwrap());
        // What is no JPEG at all is kept for whoever looks into it.
        assert_eq!(encode(&frame(b"no image"), PNG).unwrap().bytes, b"no image");
    }
}
