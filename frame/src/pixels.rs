//! Pixel buffers and their formats.

use std::fmt;

/// How the bytes of a [`Pixels`] buffer are to be read.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum PixelFormat {
    /// 8-bit luminance, one byte a pixel (V4L2 `GREY`).
    Gray8,
    /// 8-bit R, G, B, three bytes a pixel (V4L2 `RGB3`).
    Rgb8,
    /// 4:2:2 packed Y0 U Y1 V, two bytes a pixel (V4L2 `YUYV`).
    Yuyv,
    /// 4:2:0 luminance plane followed by an interleaved U, V plane (V4L2 `NV12`).
    Nv12,
    /// One JPEG image (V4L2 `MJPG`, ROS `CompressedImage`); has no stride.
    Jpeg,
}

impl PixelFormat {
    /// Bytes in one row of the first plane without padding; `None` for a compressed format.
    pub const fn row_bytes(self, width_px: u32) -> Option<usize> {
        match self {
            Self::Gray8 | Self::Nv12 => Some(width_px as usize),
            Self::Rgb8 => Some(width_px as usize * 3),
            Self::Yuyv => Some(width_px as usize * 2),
            Self::Jpeg => None,
        }
    }

    /// Rows of `stride` bytes in the whole buffer: NV12 has half as many again for its colour plane.
    const fn rows(self, height_px: u32) -> usize {
        match self {
            Self::Nv12 => height_px as usize + height_px as usize / 2,
            _ => height_px as usize,
        }
    }
}

impl fmt::Display for PixelFormat {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Gray8 => "GREY",
            Self::Rgb8 => "RGB24",
            Self::Yuyv => "YUYV",
            Self::Nv12 => "NV12",
            Self::Jpeg => "MJPG",
        })
    }
}

/// Why a pixel buffer was refused.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum PixelsError {
    /// Width or height is zero.
    #[error("a {width_px}x{height_px} {format} frame has no pixels")]
    Empty {
        /// Width in pixels.
        width_px: u32,
        /// Height in pixels.
        height_px: u32,
        /// Format asked for.
        format: PixelFormat,
    },
    /// YUYV needs an even width, NV12 an even width and height.
    #[error(
        "a {format} frame cannot be {width_px}x{height_px}: chroma is shared by pixel pairs, the size must be even"
    )]
    OddSize {
        /// Width in pixels.
        width_px: u32,
        /// Height in pixels.
        height_px: u32,
        /// Format asked for.
        format: PixelFormat,
    },
    /// The row stride is smaller than a row.
    #[error(
        "a stride of {stride_bytes} bytes is less than the {row_bytes} bytes of a {width_px} px {format} row"
    )]
    Stride {
        /// Width in pixels.
        width_px: u32,
        /// Stride given.
        stride_bytes: usize,
        /// Bytes a row needs.
        row_bytes: usize,
        /// Format asked for.
        format: PixelFormat,
    },
    /// The buffer does not hold the whole image.
    #[error("a {width_px}x{height_px} {format} frame needs {expected_bytes} bytes, found {found_bytes}")]
    Length {
        /// Width in pixels.
        width_px: u32,
        /// Height in pixels.
        height_px: u32,
        /// Format asked for.
        format: PixelFormat,
        /// Bytes needed.
        expected_bytes: usize,
        /// Bytes given.
        found_bytes: usize,
    },
}

/// A pixel buffer that is known to hold a whole image of its format and size.
#[derive(Clone, PartialEq, Eq)]
pub struct Pixels {
    format: PixelFormat,
    width_px: u32,
    height_px: u32,
    stride_bytes: usize,
    data: Vec<u8>,
}

impl Pixels {
    /// Takes a buffer whose rows follow each other without padding.
    ///
    /// # Errors
    /// See [`PixelsError`]; a JPEG's content is not looked at, only its stated size.
    pub fn packed(
        format: PixelFormat,
        width_px: u32,
        height_px: u32,
        data: Vec<u8>,
    ) -> Result<Self, PixelsError> {
        let stride_bytes = format.row_bytes(width_px).unwrap_or(0);
        Self::strided(format, width_px, height_px, stride_bytes, data)
    }

    /// Takes a buffer whose rows start `stride_bytes` apart (ignored for a compressed format).
    ///
    /// # Errors
    /// See [`PixelsError`]. The last row may lack its padding.
    pub fn strided(
        format: PixelFormat,
        width_px: u32,
        height_px: u32,
        stride_bytes: usize,
        data: Vec<u8>,
    ) -> Result<Self, PixelsError> {
        if width_px == 0 || height_px == 0 || data.is_empty() {
            return Err(PixelsError::Empty { width_px, height_px, format });
        }
        let odd_width = width_px % 2 == 1 && matches!(format, PixelFormat::Yuyv | PixelFormat::Nv12);
        let odd_height = height_px % 2 == 1 && format == PixelFormat::Nv12;
        if odd_width || odd_height {
            return Err(PixelsError::OddSize { width_px, height_px, format });
        }
        let Some(row_bytes) = format.row_bytes(width_px) else {
            return Ok(Self { format, width_px, height_px, stride_bytes: 0, data });
        };
        if stride_bytes < row_bytes {
            return Err(PixelsError::Stride { width_px, stride_bytes, row_bytes, format });
        }
        let expected_bytes = stride_bytes * (format.rows(height_px) - 1) + row_bytes;
        if data.len() < expected_bytes {
            let found_bytes = data.len();
            return Err(PixelsError::Length { width_px, height_px, format, expected_bytes, found_bytes });
        }
        Ok(Self { format, width_px, height_px, stride_bytes, data })
    }

    /// The format of the bytes.
    pub fn format(&self) -> PixelFormat {
        self.format
    }

    /// Width in pixels.
    pub fn width_px(&self) -> u32 {
        self.width_px
    }

    /// Height in pixels.
    pub fn height_px(&self) -> u32 {
        self.height_px
    }

    /// Bytes from the start of one row to the next; 0 for a compressed format.
    pub fn stride_bytes(&self) -> usize {
        self.stride_bytes
    }

    /// All bytes, padding included.
    pub fn data(&self) -> &[u8] {
        &self.data
    }

    /// Row `y` of the first plane without its padding; the rows of NV12's colour plane follow at `y >= height`.
    ///
    /// # Panics
    /// For a compressed format, and when `y` lies outside the buffer.
    pub fn row(&self, y: usize) -> &[u8] {
        let row_bytes = self.format.row_bytes(self.width_px).expect("a compressed frame has no rows");
        &self.data[y * self.stride_bytes..][..row_bytes]
    }
}

impl fmt::Debug for Pixels {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Pixels({}x{} {}, {} bytes)", self.width_px, self.height_px, self.format, self.data.len())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_padded_image_gives_unpadded_rows() {
        let pixels = Pixels::strided(PixelFormat::Gray8, 2, 2, 3, vec![1, 2, 0, 3, 4]).unwrap();
        assert_eq!((pixels.row(0), pixels.row(1)), (&[1, 2][..], &[3, 4][..]));
    }

    #[test]
    fn nv12_holds_its_colour_plane() {
        let pixels = Pixels::packed(PixelFormat::Nv12, 2, 2, vec![1, 2, 3, 4, 5, 6]).unwrap();
        assert_eq!(pixels.row(2), &[5, 6]);
        let error = Pixels::packed(PixelFormat::Nv12, 2, 2, vec![1, 2, 3, 4]).unwrap_err();
        assert_eq!(error.to_string(), "a 2x2 NV12 frame needs 6 bytes, found 4");
    }

    #[test]
    fn impossible_buffers_are_refused() {
        assert!(matches!(Pixels::packed(PixelFormat::Rgb8, 0, 4, vec![]), Err(PixelsError::Empty { .. })));
        assert!(matches!(
            Pixels::packed(PixelFormat::Yuyv, 3, 2, vec![0; 12]),
            Err(PixelsError::OddSize { .. })
        ));
        assert!(matches!(
            Pixels::strided(PixelFormat::Rgb8, 4, 2, 11, vec![0; 24]),
            Err(PixelsError::Stride { .. })
        ));
        assert!(matches!(
            Pixels::packed(PixelFormat::Rgb8, 4, 2, vec![0; 23]),
            Err(PixelsError::Length { .. })
        ));
    }

    #[test]
    fn a_jpeg_has_any_length() {
        assert_eq!(Pixels::packed(PixelFormat::Jpeg, 640, 480, vec![0xff]).unwrap().stride_bytes(), 0);
    }
}
