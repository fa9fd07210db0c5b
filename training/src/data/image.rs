//! Frames to packed bytes at a size, by the code that runs on the robot.

use std::sync::Mutex;

use grnet_frame::{Camera, Frame};
use grnet_model::{Preprocessing, ResizePolicy};
use grnet_pipeline::preprocess::{InputSpec, PreprocessError, Preprocessor};
use grnet_pipeline::{IntrinsicsError, IntrinsicsOptions};
use nalgebra::Matrix3;

use super::{Border, DataError};

/// Packed 8-bit RGB.
#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct Rgb {
    pub width: usize,
    pub height: usize,
    pub data: Vec<u8>,
}

impl Rgb {
    /// The colour 0..255 between four pixels; `None` beyond a border that is not continued.
    #[inline]
    pub fn sample(&self, (x, y): (f32, f32), border: Border) -> Option<[f32; 3]> {
        let (last_x, last_y) = ((self.width - 1) as f32, (self.height - 1) as f32);
        let (cx, cy) = (x.clamp(0.0, last_x), y.clamp(0.0, last_y));
        if border == Border::Mean && ((x - cx).abs() > 0.5 || (y - cy).abs() > 0.5) {
            return None;
        }
        // The left of two neighbours, also where the image is a single pixel wide.
        let (left, top) = (
            (cx as usize).min(self.width.saturating_sub(2)),
            (cy as usize).min(self.height.saturating_sub(2)),
        );
        let row_bytes = self.width * 3;
        let (right, below) =
            (if self.width > 1 { 3 } else { 0 }, if self.height > 1 { row_bytes } else { 0 });
        let (fx, fy) = (cx - left as f32, cy - top as f32);
        let at = top * row_bytes + left * 3;
        let (upper, lower) = (&self.data[at..][..3 + right], &self.data[at + below..][..3 + right]);
        Some([0, 1, 2].map(|c| {
            let value = |row: &[u8], offset: usize| f32::from(row[offset + c]);
            let (a, b) = (value(upper, 0), value(upper, right));
            let (d, e) = (value(lower, 0), value(lower, right));
            let (above, under) = (a + (b - a) * fx, d + (e - d) * fx);
            above + (under - above) * fy
        }))
    }
}

/// Focal lengths and centre of a pinhole camera in pixels.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Lens {
    focal_px: (f64, f64),
    centre_px: (f64, f64),
}

impl Lens {
    /// Of the network's input, to which `policy` brings the images of `camera`.
    pub fn of_input(camera: &Camera, policy: ResizePolicy, input_px: (u32, u32)) -> Self {
        let [left, top, width, height] = kept(policy, camera.size_px(), input_px);
        let ((fx, fy), (cx, cy)) = (camera.focal_px(), camera.centre_px());
        let (sx, sy) = (f64::from(input_px.0) / width, f64::from(input_px.1) / height);
        // As `Camera::resized`, for a box that may begin between pixels.
        let centre_px = ((cx + 0.5 - left) * sx - 0.5, (cy + 0.5 - top) * sy - 0.5);
        Self { focal_px: (fx * sx, fy * sy), centre_px }
    }

    /// Of the whole image of `camera`, undistorted and stored at this size.
    pub fn of_stored(camera: &Camera, stored_px: (u32, u32)) -> Self {
        let stored = camera.resized(stored_px.0, stored_px.1);
        Self { focal_px: stored.focal_px(), centre_px: stored.centre_px() }
    }

    /// Pixels (column, row, 1) of directions (x, y, 1).
    pub fn pixel_from_ray(&self) -> Matrix3<f64> {
        let ((fx, fy), (cx, cy)) = (self.focal_px, self.centre_px);
        Matrix3::new(fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0)
    }

    /// Directions (x, y, 1) of pixels (column, row, 1).
    pub fn ray_from_pixel(&self) -> Matrix3<f64> {
        let ((fx, fy), (cx, cy)) = (self.focal_px, self.centre_px);
        Matrix3::new(1.0 / fx, 0.0, -cx / fx, 0.0, 1.0 / fy, -cy / fy, 0.0, 0.0, 1.0)
    }
}

/// The run-time preprocessing, stopped before the bytes become normalised floats.
#[derive(Debug)]
pub(crate) struct Resize(Preprocessor);

impl Resize {
    pub fn new(spec: &InputSpec) -> Result<Self, IntrinsicsError> {
        // With mean 0 and deviation 1/255 the normalised value is the byte itself.
        let preprocessing =
            Preprocessing { mean: [0.0; 3], std: [1.0 / 255.0; 3], ..spec.preprocessing.clone() };
        let spec = InputSpec { preprocessing, ..spec.clone() };
        Ok(Self(Preprocessor::new(spec, IntrinsicsOptions::default(), None)?))
    }

    /// The whole (undistorted) image at another size.
    pub fn whole(spec: &InputSpec, size_px: (u32, u32)) -> Result<Self, IntrinsicsError> {
        let preprocessing = Preprocessing { resize: ResizePolicy::Stretch, ..spec.preprocessing.clone() };
        Self::new(&InputSpec { size_px, preprocessing, trained_camera: None })
    }

    pub fn size_px(&self) -> (u32, u32) {
        self.0.spec().size_px
    }

    pub fn run(&mut self, frame: &Frame) -> Result<Rgb, PreprocessError> {
        let (width, height) = self.size_px();
        let (width, height) = (width as usize, height as usize);
        let planes = self.0.run(frame)?;
        let (red, rest) = planes.split_at(width * height);
        let (green, blue) = rest.split_at(width * height);
        let mut data = vec![0; width * height * 3];
        for (rgb, ((r, g), b)) in data.chunks_exact_mut(3).zip(red.iter().zip(green).zip(blue)) {
            rgb.copy_from_slice(&[*r as u8, *g as u8, *b as u8]);
        }
        Ok(Rgb { width, height, data })
    }
}

/// The left, top, width and height of the part of an image that the resize policy keeps.
pub(crate) fn kept(
    policy: ResizePolicy,
    (width, height): (u32, u32),
    (input_width, input_height): (u32, u32),
) -> [f64; 4] {
    let (width, height) = (f64::from(width), f64::from(height));
    match policy {
        ResizePolicy::Stretch => [0.0, 0.0, width, height],
        ResizePolicy::CropCentre => {
            let aspect = f64::from(input_width) / f64::from(input_height);
            let (w, h) = (width.min(height * aspect), height.min(width / aspect));
            [(width - w) / 2.0, (height - h) / 2.0, w, h]
        }
    }
}

/// Things that threads take, use and put back, so that there are no more of them than threads.
#[derive(Debug)]
pub(crate) struct Pool<T>(Mutex<Vec<T>>);

impl<T> Default for Pool<T> {
    fn default() -> Self {
        Self(Mutex::new(Vec::new()))
    }
}

impl<T> Pool<T> {
    /// Runs `work` on one that is free, or on one that `make` makes.
    pub fn with(
        &self,
        make: impl FnOnce() -> Result<T, DataError>,
        work: impl FnOnce(&mut T) -> Result<(), DataError>,
    ) -> Result<(), DataError> {
        let mut free = self.lock();
        let taken = free.pop();
        drop(free);
        let mut thing = taken.map_or_else(make, Ok)?;
        let result = work(&mut thing);
        self.lock().push(thing);
        result
    }

    fn lock(&self) -> std::sync::MutexGuard<'_, Vec<T>> {
        // A panic while something was taken out or put back leaves a good list.
        self.0.lock().unwrap_or_else(std::sync::PoisonError::into_inner)
    }
}
