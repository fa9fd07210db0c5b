//! Frames to packed bytes at a size, by the code that runs on the robot.

use std::sync::Mutex;

use grnet_frame::Frame;
use grnet_model::{Preprocessing, ResizePolicy};
use grnet_pipeline::preprocess::{InputSpec, PreprocessError, Preprocessor};
use grnet_pipeline::{IntrinsicsError, IntrinsicsOptions};

use super::DataError;

/// Packed 8-bit RGB.
#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct Rgb {
    pub width: usize,
    pub height: usize,
    pub data: Vec<u8>,
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
