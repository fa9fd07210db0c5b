//! Source pixels to packed RGB.

use std::io::Cursor;

use grnet_frame::{PixelFormat, Pixels};
use image::codecs::jpeg::JpegDecoder;
use image::{ColorType, ImageDecoder};
use yuv::{YuvBiPlanarImage, YuvConversionMode, YuvPackedImage, YuvRange, YuvStandardMatrix};

/// A packed 8-bit RGB image whose buffer is used again for every frame.
#[derive(Debug, Clone, Default)]
pub(crate) struct RgbImage {
    pub(crate) width_px: u32,
    pub(crate) height_px: u32,
    /// `width_px * height_px * 3` bytes, R, G, B.
    pub(crate) data: Vec<u8>,
}

impl RgbImage {
    /// Sets the size; the content is whatever was there.
    pub(crate) fn resize(&mut self, width_px: u32, height_px: u32) {
        (self.width_px, self.height_px) = (width_px, height_px);
        self.data.resize(width_px as usize * height_px as usize * 3, 0);
    }
}

/// Why a frame's bytes could not be read as an image.
#[derive(Debug, thiserror::Error)]
pub enum DecodeError {
    /// The JPEG stream is broken or of an unknown kind.
    #[error("the JPEG ({length_bytes} bytes) cannot be decoded: {source}")]
    Jpeg {
        /// Bytes in the frame.
        length_bytes: usize,
        /// What the decoder found.
        source: image::ImageError,
    },
    /// The JPEG stops before its end.
    #[error("the JPEG ({length_bytes} bytes) is cut off: it has no end-of-image marker")]
    JpegTruncated {
        /// Bytes in the frame.
        length_bytes: usize,
    },
    /// The JPEG's own size is not the one that the source announced.
    #[error("the JPEG is {found_width_px}x{found_height_px}, the source announced {width_px}x{height_px}")]
    JpegSize {
        /// Width in the stream.
        found_width_px: u32,
        /// Height in the stream.
        found_height_px: u32,
        /// Width announced.
        width_px: u32,
        /// Height announced.
        height_px: u32,
    },
    /// The JPEG holds neither grey nor RGB.
    #[error("the JPEG decodes to {found:?}; grey or RGB expected")]
    JpegColour {
        /// What it decodes to.
        found: ColorType,
    },
    /// The converter refused the buffer.
    #[error("the {format} frame cannot be converted to RGB: {source}")]
    Yuv {
        /// The format.
        format: PixelFormat,
        /// What the converter found.
        source: yuv::YuvError,
    },
}

/// Converts frames to RGB: BT.601, limited range for YUYV and NV12 (what V4L2 means by default), grey
/// repeated over the three channels.
#[derive(Debug, Default)]
pub(crate) struct Decoder {
    /// For inputs that need rearranging: a grey JPEG, a JPEG without tables, a last row without padding.
    scratch: Vec<u8>,
}

impl Decoder {
    /// Writes the frame's pixels as packed RGB into `rgb`.
    pub(crate) fn decode(&mut self, pixels: &Pixels, rgb: &mut RgbImage) -> Result<(), DecodeError> {
        match pixels.format() {
            PixelFormat::Gray8 => {
                rgb.resize(pixels.width_px(), pixels.height_px());
                let row_bytes = rgb.width_px as usize * 3;
                for (y, row) in rgb.data.chunks_exact_mut(row_bytes).enumerate() {
                    repeat_grey(pixels.row(y), row);
                }
                Ok(())
            }
            PixelFormat::Rgb8 => {
                rgb.resize(pixels.width_px(), pixels.height_px());
                let row_bytes = rgb.width_px as usize * 3;
                for (y, row) in rgb.data.chunks_exact_mut(row_bytes).enumerate() {
                    row.copy_from_slice(pixels.row(y));
                }
                Ok(())
            }
            PixelFormat::Yuyv => self.yuyv(pixels, rgb),
            PixelFormat::Nv12 => self.nv12(pixels, rgb),
            PixelFormat::Jpeg => self.jpeg(pixels, rgb),
        }
    }

    fn yuyv(&mut self, pixels: &Pixels, rgb: &mut RgbImage) -> Result<(), DecodeError> {
        let (width, height) = (pixels.width_px(), pixels.height_px());
        rgb.resize(width, height);
        let (bytes, stride) = self.whole_rows(pixels, height as usize);
        let image = YuvPackedImage { yuy: bytes, yuy_stride: stride, width, height };
        yuv::yuyv422_to_rgb(&image, &mut rgb.data, width * 3, YuvRange::Limited, YuvStandardMatrix::Bt601)
            .map_err(|source| DecodeError::Yuv { format: PixelFormat::Yuyv, source })
    }

    fn nv12(&mut self, pixels: &Pixels, rgb: &mut RgbImage) -> Result<(), DecodeError> {
        let (width, height) = (pixels.width_px(), pixels.height_px());
        rgb.resize(width, height);
        let (bytes, stride) = self.whole_rows(pixels, height as usize * 3 / 2);
        let (y_plane, uv_plane) = bytes.split_at(stride as usize * height as usize);
        let image =
            YuvBiPlanarImage { y_plane, y_stride: stride, uv_plane, uv_stride: stride, width, height };
        let (range, matrix) = (YuvRange::Limited, YuvStandardMatrix::Bt601);
        yuv::yuv_nv12_to_rgb(&image, &mut rgb.data, width * 3, range, matrix, YuvConversionMode::Balanced)
            .map_err(|source| DecodeError::Yuv { format: PixelFormat::Nv12, source })
    }

    /// The bytes of exactly `rows` rows and their stride. The converter leaves out a last row that lacks
    /// its padding, so such a buffer is packed first.
    fn whole_rows<'a>(&'a mut self, pixels: &'a Pixels, rows: usize) -> (&'a [u8], u32) {
        let stride = pixels.stride_bytes();
        if let (Some(bytes), Ok(stride)) = (pixels.data().get(..stride * rows), u32::try_from(stride)) {
            return (bytes, stride);
        }
        self.scratch.clear();
        (0..rows).for_each(|y| self.scratch.extend_from_slice(pixels.row(y)));
        let row_bytes = self.scratch.len() / rows;
        (&self.scratch, u32::try_from(row_bytes).unwrap_or(u32::MAX))
    }

    fn jpeg(&mut self, pixels: &Pixels, rgb: &mut RgbImage) -> Result<(), DecodeError> {
        let length_bytes = pixels.data().len();
        let broken = |source| DecodeError::Jpeg { length_bytes, source };
        let layout = JpegLayout::of(pixels.data());
        let with_tables;
        let data = if layout.has_huffman_tables {
            pixels.data()
        } else {
            with_tables = [&SOI[..], &AVI1, pixels.data().get(2..).unwrap_or(&[])].concat();
            &with_tables
        };
        let decoder = JpegDecoder::new(Cursor::new(data)).map_err(broken)?;
        let (found_width_px, found_height_px) = decoder.dimensions();
        let (width_px, height_px) = (pixels.width_px(), pixels.height_px());
        // Before any memory is asked for: a broken header may announce 65535 x 65535.
        if (found_width_px, found_height_px) != (width_px, height_px) {
            return Err(DecodeError::JpegSize { found_width_px, found_height_px, width_px, height_px });
        }
        // The decoder itself would fill what is missing with grey.
        if !layout.has_end(pixels.data()) {
            return Err(DecodeError::JpegTruncated { length_bytes });
        }
        rgb.resize(width_px, height_px);
        match decoder.color_type() {
            ColorType::Rgb8 => decoder.read_image(&mut rgb.data).map_err(broken),
            ColorType::L8 => {
                self.scratch.resize(width_px as usize * height_px as usize, 0);
                decoder.read_image(&mut self.scratch).map_err(broken)?;
                repeat_grey(&self.scratch, &mut rgb.data);
                Ok(())
            }
            found => Err(DecodeError::JpegColour { found }),
        }
    }
}

const SOI: [u8; 2] = [0xff, 0xd8];

/// An APP0 segment "AVI1", by which the decoder knows motion JPEG and takes the standard Huffman tables.
/// Many USB cameras leave out both the tables and this segment.
const AVI1: [u8; 18] = [0xff, 0xe0, 0, 16, b'A', b'V', b'I', b'1', 0, 0, 0, 0, 0, 0, 0, 0, 0, 0];

/// What the segments before the first scan tell.
struct JpegLayout {
    /// True also for bytes that are no JPEG at all, whose fault the decoder names better.
    has_huffman_tables: bool,
    /// Where the coded pixels begin.
    scan: usize,
}

impl JpegLayout {
    fn of(data: &[u8]) -> Self {
        const DHT: u8 = 0xc4;
        const SOS: u8 = 0xda;
        let mut has_huffman_tables = false;
        let mut at = 2;
        while let Some(&[0xff, marker, high, low]) = data.get(at..at + 4) {
            match marker {
                DHT => has_huffman_tables = true,
                SOS => return Self { has_huffman_tables, scan: at },
                _ => {}
            }
            at += 2 + usize::from(u16::from_be_bytes([high, low]));
        }
        Self { has_huffman_tables: true, scan: 0 }
    }

    /// Whether the coded pixels end with the end-of-image marker, which cannot occur inside them. Cameras pad
    /// behind it.
    fn has_end(&self, data: &[u8]) -> bool {
        data[self.scan..].windows(2).rev().any(|bytes| bytes == [0xff, 0xd9])
    }
}

fn repeat_grey(grey: &[u8], rgb: &mut [u8]) {
    for (rgb, grey) in rgb.chunks_exact_mut(3).zip(grey) {
        rgb.fill(*grey);
    }
}

#[cfg(test)]
mod tests {
    use image::ExtendedColorType;
    use image::codecs::jpeg::JpegEncoder;

    use super::*;

    fn decode(pixels: &Pixels) -> Result<RgbImage, DecodeError> {
        let mut rgb = RgbImage::default();
        Decoder::default().decode(pixels, &mut rgb)?;
        Ok(rgb)
    }

    /// BT.601, limited range, in floating point (ITU-R BT.601-7, section 2.5).
    fn reference(y: u8, u: u8, v: u8) -> [f64; 3] {
        let y = (f64::from(y) - 16.0) * 255.0 / 219.0;
        let (cb, cr) = ((f64::from(u) - 128.0) * 255.0 / 224.0, (f64::from(v) - 128.0) * 255.0 / 224.0);
        let (kr, kb) = (0.299, 0.114);
        let r = y + 2.0 * (1.0 - kr) * cr;
        let b = y + 2.0 * (1.0 - kb) * cb;
        let g = (y - kr * r - kb * b) / (1.0 - kr - kb);
        [r, g, b].map(|x| x.clamp(0.0, 255.0))
    }

    /// The converter's coefficients for YUYV have six fractional bits: 255/219 becomes 75/64, 1.6 grey levels too
    /// much at white; chroma adds up to 0.3 and the last rounding 0.5.
    const YUYV_WITHIN: f64 = 2.5;

    fn assert_near(found: &[u8], expected: [f64; 3], within: f64, at: &str) {
        for (found, expected) in found.iter().zip(expected) {
            assert!((f64::from(*found) - expected).abs() <= within, "{at}: {found} for {expected}");
        }
    }

    /// Luminance and chroma that differ at every pixel pair.
    fn yuv_at(x: usize, y: usize) -> (u8, u8, u8) {
        let (pair, line) = (x / 2, y / 2);
        (
            (16 + (x * 7 + y * 13) % 220) as u8,
            (90 + (pair * 11 + line * 5) % 80) as u8,
            (80 + pair * 3 % 90) as u8,
        )
    }

    #[test]
    fn grey_and_rgb_honour_the_stride() {
        let grey = Pixels::strided(PixelFormat::Gray8, 2, 2, 4, vec![1, 2, 99, 99, 3, 4]).unwrap();
        assert_eq!(decode(&grey).unwrap().data, [1, 1, 1, 2, 2, 2, 3, 3, 3, 4, 4, 4]);
        let rgb = Pixels::strided(PixelFormat::Rgb8, 1, 2, 5, vec![1, 2, 3, 99, 99, 4, 5, 6]).unwrap();
        assert_eq!(decode(&rgb).unwrap().data, [1, 2, 3, 4, 5, 6]);
    }

    #[test]
    fn yuyv_is_bt601_at_every_width_and_stride() {
        for (width, padding) in [(2usize, 0usize), (6, 0), (64, 0), (70, 10), (640, 64)] {
            let (height, stride) = (5usize, width * 2 + padding);
            let mut data = vec![0xAA; stride * (height - 1) + width * 2];
            for y in 0..height {
                for x in (0..width).step_by(2) {
                    let ((y0, u, v), (y1, ..)) = (yuv_at(x, y & !1), yuv_at(x + 1, y & !1));
                    data[y * stride + x * 2..][..4].copy_from_slice(&[y0, u, y1, v]);
                }
            }
            let pixels =
                Pixels::strided(PixelFormat::Yuyv, width as u32, height as u32, stride, data).unwrap();
            let rgb = decode(&pixels).unwrap();
            for y in 0..height {
                for x in 0..width {
                    let (luma, u, v) = yuv_at(x, y & !1);
                    let at = format!("width {width} pixel {x},{y}");
                    assert_near(
                        &rgb.data[(y * width + x) * 3..][..3],
                        reference(luma, u, v),
                        YUYV_WITHIN,
                        &at,
                    );
                }
            }
        }
    }

    #[test]
    fn nv12_is_bt601_at_every_width_and_stride() {
        for (width, padding) in [(2usize, 0usize), (6, 2), (64, 0), (640, 64)] {
            let (height, stride) = (4usize, width + padding);
            let mut data = vec![0xAA; stride * (height * 3 / 2 - 1) + width];
            for y in 0..height {
                for x in 0..width {
                    let (luma, u, v) = yuv_at(x, y);
                    data[y * stride + x] = luma;
                    data[(height + y / 2) * stride + x] = if x % 2 == 0 { u } else { v };
                }
            }
            let pixels =
                Pixels::strided(PixelFormat::Nv12, width as u32, height as u32, stride, data).unwrap();
            let rgb = decode(&pixels).unwrap();
            for y in 0..height {
                for x in 0..width {
                    let (luma, u, v) = yuv_at(x, y);
                    let at = format!("width {width} pixel {x},{y}");
                    assert_near(&rgb.data[(y * width + x) * 3..][..3], reference(luma, u, v), 2.0, &at);
                }
            }
        }
    }

    fn jpeg(width: u32, height: u32, colour: ExtendedColorType, data: &[u8]) -> Vec<u8> {
        let mut bytes = Vec::new();
        JpegEncoder::new_with_quality(&mut bytes, 100).encode(data, width, height, colour).unwrap();
        bytes
    }

    #[test]
    fn jpeg_gives_the_pixels_back() {
        let data: Vec<u8> = (0..16 * 16).flat_map(|i| [i as u8, (i / 2) as u8, 40]).collect();
        let bytes = jpeg(16, 16, ExtendedColorType::Rgb8, &data);
        let rgb = decode(&Pixels::packed(PixelFormat::Jpeg, 16, 16, bytes).unwrap()).unwrap();
        let mean = |a: &[u8], b: &[u8]| {
            a.iter().zip(b).map(|(a, b)| f64::from(a.abs_diff(*b))).sum::<f64>() / a.len() as f64
        };
        assert!(mean(&rgb.data, &data) < 3.0, "{}", mean(&rgb.data, &data));
        let grey: Vec<u8> = (0..64).map(|i| i * 4).collect();
        let bytes = jpeg(8, 8, ExtendedColorType::L8, &grey);
        let rgb = decode(&Pixels::packed(PixelFormat::Jpeg, 8, 8, bytes).unwrap()).unwrap();
        assert!(rgb.data.chunks(3).zip(&grey).all(|(rgb, grey)| rgb.iter().all(|x| x.abs_diff(*grey) < 4)));
    }

    #[test]
    fn motion_jpeg_without_huffman_tables_is_read() {
        let data: Vec<u8> = (0..32 * 16).flat_map(|i| [(i / 4) as u8, 90, 120]).collect();
        let bytes = jpeg(32, 16, ExtendedColorType::Rgb8, &data);
        let mut bare = bytes[..2].to_vec();
        let mut at = 2;
        while bytes[at + 1] != 0xda {
            let end = at + 2 + usize::from(u16::from_be_bytes([bytes[at + 2], bytes[at + 3]]));
            if bytes[at + 1] != 0xc4 {
                bare.extend_from_slice(&bytes[at..end]);
            }
            at = end;
        }
        bare.extend_from_slice(&bytes[at..]);
        assert!(bare.len() < bytes.len() - 400, "the tables were there to be taken out");
        let whole = decode(&Pixels::packed(PixelFormat::Jpeg, 32, 16, bytes).unwrap()).unwrap();
        let found = decode(&Pixels::packed(PixelFormat::Jpeg, 32, 16, bare).unwrap()).unwrap();
        assert_eq!(found.data, whole.data);
    }

    #[test]
    fn a_broken_or_foreign_jpeg_is_refused_by_name() {
        let bytes = jpeg(8, 8, ExtendedColorType::L8, &[7; 64]);
        let wrong = Pixels::packed(PixelFormat::Jpeg, 640, 480, bytes.clone()).unwrap();
        let error = decode(&wrong).unwrap_err();
        assert_eq!(error.to_string(), "the JPEG is 8x8, the source announced 640x480");
        for cut in [1, 2, 3, 20, 100, bytes.len() / 2] {
            let pixels = Pixels::packed(PixelFormat::Jpeg, 8, 8, bytes[..cut].to_vec()).unwrap();
            assert!(decode(&pixels).is_err(), "cut at {cut}");
        }
        let cut = Pixels::packed(PixelFormat::Jpeg, 8, 8, bytes[..bytes.len() - 2].to_vec()).unwrap();
        assert!(matches!(decode(&cut), Err(DecodeError::JpegTruncated { .. })));
        let padded = [bytes, vec![0; 300]].concat();
        assert!(decode(&Pixels::packed(PixelFormat::Jpeg, 8, 8, padded).unwrap()).is_ok());
    }
}
