//! The view of a rotated camera, out of a stored image.

use grnet_frame::Camera;
use grnet_model::ResizePolicy;
use nalgebra::UnitQuaternion;

use super::Border;
use crate::data::image::{Lens, Rgb};

/// From pixels of the network's input to pixels of a stored image.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Warp {
    /// `K_source R K^-1`, row by row.
    homography: [f32; 9],
    border: Border,
}

impl Warp {
    /// The view of `camera` after `camera_from_rotated`, brought to the network's input by `policy`, out of the whole
    /// image of `camera` at `stored_px`.
    pub fn new(
        camera: &Camera,
        camera_from_rotated: &UnitQuaternion<f64>,
        policy: ResizePolicy,
        input_px: (u32, u32),
        stored_px: (u32, u32),
        border: Border,
    ) -> Self {
        let ray_from_input = Lens::of_input(camera, policy, input_px).ray_from_pixel();
        let stored_from_ray = Lens::of_stored(camera, stored_px).pixel_from_ray();
        let rotation = camera_from_rotated.to_rotation_matrix();
        let all = stored_from_ray * rotation.matrix() * ray_from_input;
        Self { homography: std::array::from_fn(|i| all[(i / 3, i % 3)] as f32), border }
    }

    /// Calls `put(pixel, [r, g, b])` with values 0..255, interpolated, for every pixel of an image of this size, row
    /// by row.
    pub fn each(
        &self,
        image: &Rgb,
        (width, height): (usize, usize),
        mean: [f32; 3],
        mut put: impl FnMut(usize, [f32; 3]),
    ) {
        let h = &self.homography;
        for y in 0..height {
            let v = y as f32;
            let start = [h[1] * v + h[2], h[4] * v + h[5], h[7] * v + h[8]];
            for x in 0..width {
                let u = x as f32;
                let depth = h[6] * u + start[2];
                // Behind the camera there is nothing; with rotations below 60 degrees no pixel looks there.
                let inverse = 1.0 / depth.max(1e-3);
                let at = ((h[0] * u + start[0]) * inverse, (h[3] * u + start[1]) * inverse);
                put(y * width + x, image.sample(at, self.border).unwrap_or(mean));
            }
        }
    }
}
