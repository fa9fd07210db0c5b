//! The view of a rotated camera, out of a stored image.

use grnet_frame::Camera;
use grnet_model::ResizePolicy;
use nalgebra::{Matrix3, UnitQuaternion};

use super::Border;
use crate::data::image::{Rgb, kept};

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
        let [left, top, width, height] = kept(policy, camera.size_px(), input_px);
        let ((fx, fy), (cx, cy)) = (camera.focal_px(), camera.centre_px());
        let (sx, sy) = (f64::from(input_px.0) / width, f64::from(input_px.1) / height);
        // As `Camera::resized`, for a box that may begin between pixels.
        let (fx, fy) = (fx * sx, fy * sy);
        let (cx, cy) = ((cx + 0.5 - left) * sx - 0.5, (cy + 0.5 - top) * sy - 0.5);
        let ray_from_input = Matrix3::new(1.0 / fx, 0.0, -cx / fx, 0.0, 1.0 / fy, -cy / fy, 0.0, 0.0, 1.0);
        let stored = camera.resized(stored_px.0, stored_px.1);
        let ((fx, fy), (cx, cy)) = (stored.focal_px(), stored.centre_px());
        let stored_from_ray = Matrix3::new(fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0);
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
        let row_bytes = image.width * 3;
        let (last_x, last_y) = ((image.width - 1) as f32, (image.height - 1) as f32);
        // The left of two neighbours, also where the image is a single pixel wide.
        let (before_last_x, before_last_y) = (image.width.saturating_sub(2), image.height.saturating_sub(2));
        let (right, below) =
            (if image.width > 1 { 3 } else { 0 }, if image.height > 1 { row_bytes } else { 0 });
        for y in 0..height {
            let v = y as f32;
            let start = [h[1] * v + h[2], h[4] * v + h[5], h[7] * v + h[8]];
            for x in 0..width {
                let u = x as f32;
                let depth = h[6] * u + start[2];
                // Behind the camera there is nothing; with rotations below 60 degrees no pixel looks there.
                let inverse = 1.0 / depth.max(1e-3);
                let (sx, sy) = ((h[0] * u + start[0]) * inverse, (h[3] * u + start[1]) * inverse);
                let (cx, cy) = (sx.clamp(0.0, last_x), sy.clamp(0.0, last_y));
                let pixel = y * width + x;
                if self.border == Border::Mean && ((sx - cx).abs() > 0.5 || (sy - cy).abs() > 0.5) {
                    put(pixel, mean);
                    continue;
                }
                let (left, top) = ((cx as usize).min(before_last_x), (cy as usize).min(before_last_y));
                let (fx, fy) = (cx - left as f32, cy - top as f32);
                let at = top * row_bytes + left * 3;
                let (upper, lower) = (&image.data[at..][..3 + right], &image.data[at + below..][..3 + right]);
                put(
                    pixel,
                    [0, 1, 2].map(|c| {
                        let value = |row: &[u8], offset: usize| f32::from(row[offset + c]);
                        let (a, b) = (value(upper, 0), value(upper, right));
                        let (d, e) = (value(lower, 0), value(lower, right));
                        let (above, under) = (a + (b - a) * fx, d + (e - d) * fx);
                        above + (under - above) * fy
                    }),
                );
            }
        }
    }
}
