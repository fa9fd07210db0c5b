//! Removing lens distortion with a precomputed map.

use grnet_frame::{Camera, Distortion};

use super::decode::RgbImage;

/// Where each pixel of the undistorted image comes from.
///
/// The undistorted image keeps the size, focal lengths and principal point of the camera; pixels that the
/// lens did not see are black. Interpolation is bilinear in steps of 1/256 pixel.
#[derive(Debug)]
pub(crate) struct UndistortMap {
    camera: Camera,
    taps: Vec<Tap>,
}

/// The upper left of the four source pixels, and the weights of the right and lower ones in 1/256.
#[derive(Debug, Clone, Copy)]
struct Tap {
    pixel: u32,
    right: u16,
    lower: u16,
}

const OUTSIDE: u32 = u32::MAX;

impl UndistortMap {
    /// Builds the map for a camera; `None` when there is nothing to undo.
    pub(crate) fn new(camera: &Camera) -> Option<Self> {
        let is_ideal = match camera.distortion() {
            Distortion::None => true,
            Distortion::PlumbBob(k) => k == [0.0; 5],
            // Without coefficients the equidistant model still is a fisheye.
            Distortion::Equidistant(_) => false,
        };
        if is_ideal {
            return None;
        }
        let ((width, height), (fx, fy), (cx, cy)) = (camera.size_px(), camera.focal_px(), camera.centre_px());
        let tap = |x: u32, y: u32| {
            let normalised = ((f64::from(x) - cx) / fx, (f64::from(y) - cy) / fy);
            let (source_x, source_y) = camera.pixel_from_normalised(normalised);
            Tap::new((source_x, source_y), (width, height))
        };
        let taps =
            (0..height).flat_map(|y| (0..width).map(move |x| (x, y))).map(|(x, y)| tap(x, y)).collect();
        Some(Self { camera: *camera, taps })
    }

    /// Size of the images before and after.
    pub(crate) fn size_px(&self) -> (u32, u32) {
        self.camera.size_px()
    }

    /// Tells of each source pixel (x, y) in which the undistorted pixel has a part, and of that part.
    pub(crate) fn taps(&self, x: u32, y: u32, mut each: impl FnMut((u32, u32), f32)) {
        let (width, _) = self.size_px();
        let Some(tap) = self.taps.get((y * width + x) as usize).filter(|tap| tap.pixel != OUTSIDE) else {
            return;
        };
        let (left, upper) = (tap.pixel % width, tap.pixel / width);
        let (right, lower) = (f32::from(tap.right) / 256.0, f32::from(tap.lower) / 256.0);
        for (dx, weight_x) in [(0, 1.0 - right), (1, right)] {
            for (dy, weight_y) in [(0, 1.0 - lower), (1, lower)] {
                if weight_x * weight_y > 0.0 {
                    each((left + dx, upper + dy), weight_x * weight_y);
                }
            }
        }
    }

    /// Undistorts `source` (of the camera's size) into `target`.
    pub(crate) fn apply(&self, source: &RgbImage, target: &mut RgbImage) {
        debug_assert_eq!((source.width_px, source.height_px), self.camera.size_px());
        target.resize(source.width_px, source.height_px);
        let row_bytes = source.width_px as usize * 3;
        for (tap, rgb) in self.taps.iter().zip(target.data.chunks_exact_mut(3)) {
            if tap.pixel == OUTSIDE {
                rgb.fill(0);
                continue;
            }
            let at = tap.pixel as usize * 3;
            let (right, lower) = (u32::from(tap.right), u32::from(tap.lower));
            // On the last column or row the weight is zero and the neighbour need not exist.
            let step_right = if right > 0 { 3 } else { 0 };
            let step_lower = if lower > 0 { row_bytes } else { 0 };
            for (channel, out) in rgb.iter_mut().enumerate() {
                let pixel = |offset: usize| u32::from(source.data[at + offset + channel]);
                let upper_row = pixel(0) * (256 - right) + pixel(step_right) * right;
                let lower_row = pixel(step_lower) * (256 - right) + pixel(step_lower + step_right) * right;
                *out = ((upper_row * (256 - lower) + lower_row * lower + 0x8000) >> 16) as u8;
            }
        }
    }
}

impl Tap {
    fn new((x, y): (f64, f64), (width, height): (u32, u32)) -> Self {
        // Steps of 1/256 px; half a pixel outside the outermost centres still is inside the image.
        let (x, y) = ((x * 256.0).round(), (y * 256.0).round());
        let (last_x, last_y) = (f64::from(width - 1) * 256.0, f64::from(height - 1) * 256.0);
        let inside = (-128.0..=last_x + 128.0).contains(&x) && (-128.0..=last_y + 128.0).contains(&y);
        if !inside {
            return Self { pixel: OUTSIDE, right: 0, lower: 0 };
        }
        let (x, y) = (x.clamp(0.0, last_x) as u32, y.clamp(0.0, last_y) as u32);
        Self { pixel: (y >> 8) * width + (x >> 8), right: (x & 255) as u16, lower: (y & 255) as u16 }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZE: (u32, u32) = (160, 120);

    fn camera(distortion: Distortion) -> Camera {
        Camera::new(SIZE, (140.0, 138.0), (81.0, 58.5), distortion).unwrap()
    }

    /// A smooth scene, seen at ideal normalised coordinates.
    fn scene(x: f64, y: f64) -> [f64; 3] {
        [128.0 + 90.0 * (5.0 * x).sin(), 128.0 + 90.0 * (6.0 * y).cos(), 128.0 + 100.0 * x * y]
    }

    fn ideal(camera: &Camera, x: u32, y: u32) -> (f64, f64) {
        let ((fx, fy), (cx, cy)) = (camera.focal_px(), camera.centre_px());
        ((f64::from(x) - cx) / fx, (f64::from(y) - cy) / fy)
    }

    /// The ideal coordinates that the lens maps to `distorted`, by fixed-point iteration.
    fn invert(camera: &Camera, distorted: (f64, f64)) -> (f64, f64) {
        let mut guess = distorted;
        for _ in 0..200 {
            let (x, y) = camera.distort(guess);
            guess = (guess.0 + distorted.0 - x, guess.1 + distorted.1 - y);
        }
        guess
    }

    fn photograph(camera: &Camera) -> RgbImage {
        let mut image = RgbImage::default();
        image.resize(SIZE.0, SIZE.1);
        for y in 0..SIZE.1 {
            for x in 0..SIZE.0 {
                let (u, v) = invert(camera, ideal(camera, x, y));
                let rgb = scene(u, v).map(|c| c.round().clamp(0.0, 255.0) as u8);
                image.data[(y * SIZE.0 + x) as usize * 3..][..3].copy_from_slice(&rgb);
            }
        }
        image
    }

    #[test]
    fn what_a_lens_distorted_is_straight_again() {
        for distortion in [
            Distortion::PlumbBob([-0.28, 0.07, 0.0012, -0.0008, 0.003]),
            Distortion::PlumbBob([0.12, -0.02, 0.0, 0.0, 0.0]),
            Distortion::Equidistant([-0.01, 0.004, -0.002, 0.0003]),
        ] {
            let camera = camera(distortion);
            let map = UndistortMap::new(&camera).unwrap();
            let mut straight = RgbImage::default();
            map.apply(&photograph(&camera), &mut straight);
            let mut inside = 0;
            for y in 0..SIZE.1 {
                for x in 0..SIZE.0 {
                    let found = &straight.data[(y * SIZE.0 + x) as usize * 3..][..3];
                    if found == [0; 3] {
                        continue;
                    }
                    inside += 1;
                    let (u, v) = ideal(&camera, x, y);
                    for (found, expected) in found.iter().zip(scene(u, v)) {
                        let error = (f64::from(*found) - expected).abs();
                        assert!(error < 4.0, "{distortion:?} at {x},{y}: {found} for {expected}");
                    }
                }
            }
            assert!(inside > SIZE.0 * SIZE.1 * 3 / 4, "{distortion:?}: {inside} pixels inside");
        }
    }

    #[test]
    fn an_ideal_camera_needs_no_map() {
        assert!(UndistortMap::new(&camera(Distortion::None)).is_none());
        assert!(UndistortMap::new(&camera(Distortion::PlumbBob([0.0; 5]))).is_none());
        assert!(UndistortMap::new(&camera(Distortion::Equidistant([0.0; 4]))).is_some());
    }

    #[test]
    fn the_last_row_and_column_are_read_without_their_missing_neighbours() {
        let tap = Tap::new((159.4, 119.0), SIZE);
        assert_eq!((tap.pixel, tap.right, tap.lower), (119 * 160 + 159, 0, 0));
        assert_eq!(Tap::new((159.6, 119.0), SIZE).pixel, OUTSIDE);
        assert_eq!(Tap::new((f64::NAN, 0.0), SIZE).pixel, OUTSIDE);
    }
}
