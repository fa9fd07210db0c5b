//! PNG and JPEG images to pixels.
//!
//! Grey images become `Gray8`, colour images `Rgb8`; 16-bit samples are scaled to 8 bits, an alpha channel is
//! dropped (not blended), palettes are expanded. Pixels stay as stored: an EXIF orientation is not applied,
//! as intrinsics hold for the stored image.

use std::io::Cursor;
use std::path::{Path, PathBuf};

use grnet_frame::{PixelFormat, Pixels, PixelsError};
use image::{DynamicImage, ImageError, ImageFormat, ImageReader, Limits};

/// Longest side of an image that is still decoded; a header that claims more is a corrupt one.
pub const MAX_SIDE_PX: u32 = 16_384;

/// Most memory that decoding one image may take.
const MAX_DECODE_BYTES: u64 = 1 << 30;

/// Bytes at the end of a JPEG in which its end marker must lie: some cameras pad their files.
const JPEG_TAIL_BYTES: usize = 4096;

/// Why an image could not be decoded.
#[derive(Debug, thiserror::Error)]
pub enum DecodeError {
    /// The file could not be read.
    #[error("cannot read {path}")]
    Read {
        /// The image file.
        path: PathBuf,
        /// What the system said.
        #[source]
        source: std::io::Error,
    },
    /// The bytes are neither PNG nor JPEG.
    #[error("found {found}, expected a PNG or JPEG image")]
    Format {
        /// What the first bytes look like.
        found: String,
    },
    /// A JPEG stops before its end-of-image marker.
    #[error("the JPEG is cut short: no end-of-image marker in its last bytes ({length_bytes} bytes in all)")]
    Truncated {
        /// Length found.
        length_bytes: usize,
    },
    /// The decoder refused the image.
    #[error("the image is corrupt: {0}")]
    Corrupt(#[from] ImageError),
    /// The decoder gave up in a way that it should not.
    #[error("the image decoder failed on these bytes")]
    Decoder,
    /// The decoder's pixels do not fit its stated size.
    #[error(transparent)]
    Pixels(#[from] PixelsError),
}

/// Decodes the image file at `path`.
///
/// # Errors
/// See [`DecodeError`]; it never panics, whatever the bytes.
pub fn decode_file(path: &Path) -> Result<Pixels, DecodeError> {
    let bytes =
        std::fs::read(path).map_err(|source| DecodeError::Read { path: path.to_path_buf(), source })?;
    decode_bytes(&bytes)
}

/// Decodes one PNG or JPEG image.
///
/// A JPEG without its end marker is refused: decoders fill the missing part with grey and call it a success.
///
/// # Errors
/// See [`DecodeError`]; it never panics, whatever the bytes.
pub fn decode_bytes(bytes: &[u8]) -> Result<Pixels, DecodeError> {
    let format = format_of(bytes)?;
    if format == ImageFormat::Jpeg {
        let tail = &bytes[bytes.len().saturating_sub(JPEG_TAIL_BYTES)..];
        if !tail.windows(2).any(|pair| pair == [0xff, 0xd9]) {
            return Err(DecodeError::Truncated { length_bytes: bytes.len() });
        }
    }
    // The decoders parse foreign bytes; a panic in one of them costs a frame, not the process.
    let decoded = std::panic::catch_unwind(|| {
        let mut reader = ImageReader::with_format(Cursor::new(bytes), format);
        reader.limits(limits());
        reader.decode()
    });
    to_pixels(decoded.map_err(|_| DecodeError::Decoder)??)
}

/// Width and height in pixels from the header of the image at `path`.
///
/// # Errors
/// When the file cannot be read or has no PNG or JPEG header.
pub fn size_px(path: &Path) -> Result<(u32, u32), DecodeError> {
    let io = |source| DecodeError::Read { path: path.to_path_buf(), source };
    let mut reader = ImageReader::open(path).map_err(io)?.with_guessed_format().map_err(io)?;
    reader.limits(limits());
    match reader.format() {
        Some(ImageFormat::Png | ImageFormat::Jpeg) => {}
        other => {
            return Err(DecodeError::Format {
                found: other.map_or_else(|| "an unknown format".into(), |f| format!("{f:?}")),
            });
        }
    }
    std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| reader.into_dimensions()))
        .map_err(|_| DecodeError::Decoder)?
        .map_err(DecodeError::Corrupt)
}

/// Whether the file name has an extension that [`decode_file`] reads.
pub fn is_image_name(path: &Path) -> bool {
    let extension = path.extension().and_then(|e| e.to_str()).unwrap_or_default();
    ["png", "jpg", "jpeg"].iter().any(|known| extension.eq_ignore_ascii_case(known))
}

fn limits() -> Limits {
    let mut limits = Limits::default();
    limits.max_image_width = Some(MAX_SIDE_PX);
    limits.max_image_height = Some(MAX_SIDE_PX);
    limits.max_alloc = Some(MAX_DECODE_BYTES);
    limits
}

fn format_of(bytes: &[u8]) -> Result<ImageFormat, DecodeError> {
    match image::guess_format(bytes) {
        Ok(format @ (ImageFormat::Png | ImageFormat::Jpeg)) => Ok(format),
        Ok(other) => Err(DecodeError::Format { found: format!("{other:?}") }),
        Err(_) if bytes.is_empty() => Err(DecodeError::Format { found: "an empty file".into() }),
        Err(_) => {
            let head: Vec<String> = bytes.iter().take(8).map(|b| format!("{b:02x}")).collect();
            Err(DecodeError::Format { found: format!("bytes {}", head.join(" ")) })
        }
    }
}

fn to_pixels(image: DynamicImage) -> Result<Pixels, DecodeError> {
    let (width_px, height_px) = (image.width(), image.height());
    let (format, data) = if image.color().has_color() {
        (PixelFormat::Rgb8, image.into_rgb8().into_raw())
    } else {
        (PixelFormat::Gray8, image.into_luma8().into_raw())
    };
    Ok(Pixels::packed(format, width_px, height_px, data)?)
}

#[cfg(test)]
mod tests {
    use super::*;
    use image::{GrayImage, ImageBuffer, Luma, LumaA, Rgb, RgbImage, Rgba};
    use proptest::prelude::*;

    fn encoded(image: &DynamicImage, format: ImageFormat) -> Vec<u8> {
        let mut bytes = Cursor::new(Vec::new());
        image.write_to(&mut bytes, format).unwrap();
        bytes.into_inner()
    }

    fn photo() -> DynamicImage {
        RgbImage::from_fn(64, 48, |x, y| Rgb([(x * 4) as u8, (y * 5) as u8, (x * y) as u8])).into()
    }

    #[test]
    fn depth_alpha_and_grey_become_eight_bit_grey_or_colour() {
        let grey16: DynamicImage = ImageBuffer::from_pixel(2, 1, Luma([0x8080u16])).into();
        let grey_alpha: DynamicImage = ImageBuffer::from_pixel(2, 1, LumaA([7u8, 1])).into();
        let colour16: DynamicImage = ImageBuffer::from_pixel(2, 1, Rgb([0xffffu16, 0, 0x4040])).into();
        let alpha: DynamicImage = ImageBuffer::from_pixel(2, 1, Rgba([1u8, 2, 3, 0])).into();
        let grey: DynamicImage = GrayImage::from_pixel(2, 1, Luma([9])).into();
        for (image, format, data) in [
            (grey16, PixelFormat::Gray8, vec![0x80, 0x80]),
            (grey_alpha, PixelFormat::Gray8, vec![7, 7]),
            (colour16, PixelFormat::Rgb8, vec![255, 0, 0x40, 255, 0, 0x40]),
            (alpha, PixelFormat::Rgb8, vec![1, 2, 3, 1, 2, 3]),
            (grey, PixelFormat::Gray8, vec![9, 9]),
        ] {
            let pixels = decode_bytes(&encoded(&image, ImageFormat::Png)).unwrap();
            assert_eq!((pixels.format(), pixels.data()), (format, &data[..]), "{:?}", image.color());
        }
    }

    #[test]
    fn a_cut_image_is_refused_unless_every_pixel_is_there() {
        for format in [ImageFormat::Png, ImageFormat::Jpeg] {
            let bytes = encoded(&photo(), format);
            let whole = decode_bytes(&bytes).unwrap();
            // The end chunk of a PNG and the checksum before it say nothing about pixels.
            let needed = bytes.len() - if format == ImageFormat::Png { 24 } else { 2 };
            for length in 0..bytes.len() {
                match decode_bytes(&bytes[..length]) {
                    Ok(pixels) => assert!(pixels == whole && length > needed, "{format:?} cut to {length}"),
                    Err(_) => assert!(length < bytes.len()),
                }
            }
        }
    }

    #[test]
    fn a_padded_jpeg_is_read() {
        let mut bytes = encoded(&photo(), ImageFormat::Jpeg);
        bytes.extend([0; 100]);
        assert_eq!(decode_bytes(&bytes).unwrap().width_px(), 64);
    }

    #[test]
    fn other_formats_are_named() {
        assert_eq!(
            decode_bytes(b"GIF89a......").unwrap_err().to_string(),
            "found Gif, expected a PNG or JPEG image"
        );
        assert_eq!(
            decode_bytes(b"").unwrap_err().to_string(),
            "found an empty file, expected a PNG or JPEG image"
        );
        assert!(decode_bytes(b"hello").unwrap_err().to_string().contains("68 65 6c 6c 6f"));
    }

    #[test]
    fn a_header_that_claims_a_giant_is_refused_before_memory_is_taken() {
        let mut bytes = encoded(&photo(), ImageFormat::Png);
        bytes[16..20].copy_from_slice(&u32::MAX.to_be_bytes()[..]);
        assert!(decode_bytes(&bytes).is_err());
    }

    proptest! {
        #[test]
        fn any_damage_is_an_error_or_an_image(position in 0usize..3000, value: u8, png: bool) {
            let mut bytes = encoded(&photo(), if png { ImageFormat::Png } else { ImageFormat::Jpeg });
            let position = position % bytes.len();
            bytes[position] = value;
            if let Ok(pixels) = decode_bytes(&bytes) {
                prop_assert!(pixels.width_px() > 0);
            }
        }
    }
}
