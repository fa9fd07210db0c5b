//! Undistortion, crop and resize in one pass: each byte of the network's input is a weighted sum of the source.
//!
//! The weights are those of undistorting the whole frame and resizing the view of it, multiplied out, so that the
//! result is the same but for the rounding in between. Only what the input shows is computed: a 640x480 frame has
//! six times as many pixels as an input of 224x224.

use grnet_model::Filter;

use super::decode::RgbImage;
use super::undistort::UndistortMap;
use super::view::View;

/// Sum of the weights of a pixel whose sources all lie inside the frame.
const ONE: f32 = 16384.0;

/// Weights are stored for so many columns, or a multiple: what the compiler multiplies at once.
const LANES: usize = 8;

/// Weights of the source pixels around each pixel of the view.
#[derive(Debug)]
pub(crate) struct Remap {
    source_px: (u32, u32),
    windows: Vec<Window>,
    /// Row by row of each window, `columns` each.
    weights: Vec<i16>,
    /// The source's red, green and blue.
    planes: [Vec<u8>; 3],
}

/// A rectangle of the source, inside of it.
#[derive(Debug, Clone, Copy)]
struct Window {
    /// Index of its upper left pixel.
    start: u32,
    rows: u16,
    /// A multiple of [`LANES`].
    columns: u16,
    /// Index of its first weight.
    weights: u32,
}

impl Remap {
    /// Composes the map with the resize of `view`; `None` for a source that is narrower than a window.
    pub(crate) fn new(map: &UndistortMap, view: &View, filter: Filter) -> Option<Self> {
        let [left, top, width, height] = view.source;
        let [_, _, columns, rows] = view.target;
        let (source_width, source_height) = map.size_px();
        let across = spans(left, width, columns, source_width, filter);
        let down = spans(top, height, rows, source_height, filter);
        let mut remap = Self {
            source_px: (source_width, source_height),
            windows: Vec::with_capacity(across.len() * down.len()),
            weights: Vec::new(),
            planes: Default::default(),
        };
        let mut taps = Vec::new();
        for y in &down {
            for x in &across {
                taps.clear();
                for (j, weight_y) in y.weighted() {
                    for (i, weight_x) in x.weighted() {
                        map.taps(i, j, |tap, weight| taps.push((tap, weight * weight_x * weight_y)));
                    }
                }
                remap.push(&taps)?;
            }
        }
        Some(remap)
    }

    /// Appends the window of a pixel that is the sum of `taps`, source (x, y) with its weight.
    fn push(&mut self, taps: &[((u32, u32), f32)]) -> Option<()> {
        let (width, _) = self.source_px;
        let weights = u32::try_from(self.weights.len()).ok()?;
        let bounds = |of: fn(&(u32, u32)) -> u32| {
            let all = || taps.iter().map(|(tap, _)| of(tap));
            all().min().zip(all().max())
        };
        let (Some((x_first, x_last)), Some((y_first, y_last))) = (bounds(|tap| tap.0), bounds(|tap| tap.1))
        else {
            self.windows.push(Window { start: 0, rows: 0, columns: LANES as u16, weights });
            return Some(());
        };
        let columns = (x_last - x_first + 1).next_multiple_of(LANES as u32);
        // A window at the right edge begins further left.
        let x_first = x_first.min(width.checked_sub(columns)?);
        let rows = y_last - y_first + 1;
        let mut dense = vec![0.0; (rows * columns) as usize];
        for ((x, y), weight) in taps {
            dense[((y - y_first) * columns + x - x_first) as usize] += weight;
        }
        self.weights.extend(dense.iter().map(|weight| (weight * ONE).round() as i16));
        self.windows.push(Window {
            start: y_first * width + x_first,
            rows: u16::try_from(rows).ok()?,
            columns: u16::try_from(columns).ok()?,
            weights,
        });
        Some(())
    }

    /// Computes the view of `source` (of the map's size) as packed RGB.
    pub(crate) fn apply(&mut self, source: &RgbImage, view: &mut Vec<u8>) {
        debug_assert_eq!((source.width_px, source.height_px), self.source_px);
        split(source, &mut self.planes);
        view.resize(self.windows.len() * 3, 0);
        let width = self.source_px.0 as usize;
        for (window, rgb) in self.windows.iter().zip(view.chunks_exact_mut(3)) {
            let sums = window.sums(&self.planes, width, &self.weights);
            for (byte, sum) in rgb.iter_mut().zip(sums) {
                *byte = ((sum + (1 << 13)) >> 14).clamp(0, 255) as u8;
            }
        }
    }
}

impl Window {
    /// The weighted sums of red, green and blue.
    fn sums(self, planes: &[Vec<u8>; 3], width: usize, weights: &[i16]) -> [i32; 3] {
        let columns = usize::from(self.columns);
        let weights = &weights[self.weights as usize..][..columns * usize::from(self.rows)];
        let mut sums = [0i32; 3];
        for (row, weights) in weights.chunks_exact(columns).enumerate() {
            let row_start = self.start as usize + row * width;
            for (chunk, weights) in weights.as_chunks::<LANES>().0.iter().enumerate() {
                let start = row_start + chunk * LANES;
                for (sum, plane) in sums.iter_mut().zip(planes) {
                    // A window lies inside the source, so that it always has its pixels.
                    if let Some(pixels) = plane.get(start..).and_then(|rest| rest.first_chunk()) {
                        *sum = sum.wrapping_add(dot(pixels, weights));
                    }
                }
            }
        }
        sums
    }
}

/// Arrays of known length, so that it becomes a few vector instructions; at most 255 * 2^14, so that nothing wraps.
#[inline]
fn dot(pixels: &[u8; LANES], weights: &[i16; LANES]) -> i32 {
    let products =
        pixels.iter().zip(weights).map(|(&pixel, &weight)| i32::from(pixel).wrapping_mul(weight.into()));
    products.fold(0, i32::wrapping_add)
}

/// Packed RGB to one plane for each colour.
fn split(source: &RgbImage, [red, green, blue]: &mut [Vec<u8>; 3]) {
    let pixels = source.data.len() / 3;
    for plane in [&mut *red, &mut *green, &mut *blue] {
        plane.resize(pixels, 0);
    }
    let planes = red.iter_mut().zip(green.iter_mut()).zip(blue.iter_mut());
    for (rgb, ((r, g), b)) in source.data.chunks_exact(3).zip(planes) {
        (*r, *g, *b) = (rgb[0], rgb[1], rgb[2]);
    }
}

/// The pixels along one axis that a resized pixel is the mean of.
struct Span {
    first: u32,
    /// They add up to one.
    weights: Vec<f32>,
}

impl Span {
    fn weighted(&self) -> impl Iterator<Item = (u32, f32)> {
        (self.first..).zip(self.weights.iter().copied()).filter(|(_, weight)| *weight != 0.0)
    }
}

/// How the resizer weights `length` pixels from `start` into `count`: a triangle of twice, or a box of once, the width
/// of a resized pixel, at least of a source pixel.
fn spans(start: f64, length: f64, count: u32, source: u32, filter: Filter) -> Vec<Span> {
    // To the last bit as `fast_image_resize` does it: where a pixel lies on the edge of a box, that decides.
    let scale = ((start + length) - start) / f64::from(count);
    let stretch = scale.max(1.0);
    let per_stretch = 1.0 / stretch;
    let (half, weight): (f64, fn(f64) -> f64) = match filter {
        Filter::Bilinear => (1.0, |x| (1.0 - x.abs()).max(0.0)),
        Filter::Area => (0.5, |x| if x > -0.5 && x <= 0.5 { 1.0 } else { 0.0 }),
    };
    (0..count)
        .map(|index| {
            let centre = start + (f64::from(index) + 0.5) * scale;
            let reach = half * stretch;
            let first = (centre - reach).floor().clamp(0.0, f64::from(source - 1)) as u32;
            let end = (centre + reach).ceil().clamp(f64::from(first + 1), f64::from(source)) as u32;
            let weights: Vec<f64> =
                (first..end).map(|pixel| weight((f64::from(pixel) - (centre - 0.5)) * per_stretch)).collect();
            let sum: f64 = weights.iter().sum();
            Span { first, weights: weights.into_iter().map(|weight| (weight / sum) as f32).collect() }
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use grnet_frame::{Camera, Distortion};
    use grnet_model::ResizePolicy;
    use proptest::prelude::*;

    use super::super::{IntrinsicsOptions, resize};
    use super::*;

    fn picture((width, height): (u32, u32)) -> RgbImage {
        let mut image = RgbImage::default();
        image.resize(width, height);
        for (index, byte) in image.data.iter_mut().enumerate() {
            let (x, y) = (index / 3 % width as usize, index / 3 / width as usize);
            *byte = ((x * 37 + y * 91 + index % 3 * 53 + x * y) % 256) as u8;
        }
        image
    }

    /// Undistorts and resizes one after the other, and at once.
    fn both(
        camera: &Camera,
        input_px: (u32, u32),
        policy: ResizePolicy,
        filter: Filter,
    ) -> (Vec<u8>, Vec<u8>) {
        let options = IntrinsicsOptions::default();
        let view = View::plan(camera.size_px(), Some(camera), None, input_px, policy, &options).unwrap();
        let source = picture(camera.size_px());
        let map = UndistortMap::new(camera).unwrap();
        let (mut straight, mut expected, mut found) = (RgbImage::default(), Vec::new(), Vec::new());
        map.apply(&source, &mut straight);
        resize(&mut Default::default(), filter, &straight, &view, &mut expected).unwrap();
        Remap::new(&map, &view, filter).unwrap().apply(&source, &mut found);
        (expected, found)
    }

    fn worst((expected, found): (Vec<u8>, Vec<u8>)) -> u8 {
        assert_eq!(expected.len(), found.len());
        expected.iter().zip(&found).map(|(a, b)| a.abs_diff(*b)).max().unwrap()
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(24))]
        #[test]
        fn it_equals_undistorting_and_then_resizing(
            width in 40u32..200, height in 40u32..150, to_width in 8u32..120, to_height in 8u32..120,
            focal in 0.5f64..1.5, k in -0.3f64..0.3, fisheye: bool, area: bool, stretch: bool,
        ) {
            let distortion = match fisheye {
                true => Distortion::Equidistant([k * 0.1, 0.01, 0.0, 0.0]),
                false => Distortion::PlumbBob([k, -0.1 * k, 0.002, -0.001, 0.0]),
            };
            let (w, h) = (f64::from(width), f64::from(height));
            let camera =
                Camera::new((width, height), (focal * w, focal * w), (w / 2.0 - 1.0, h / 2.0 + 1.0), distortion).unwrap();
            let policy = if stretch { ResizePolicy::Stretch } else { ResizePolicy::CropCentre };
            let filter = if area { Filter::Area } else { Filter::Bilinear };
            // Three roundings to a byte in one way, one in the other.
            let worst = worst(both(&camera, (to_width, to_height), policy, filter));
            prop_assert!(worst <= 2, "{worst} grey levels");
        }
    }

    #[test]
    fn a_source_that_is_narrower_than_a_window_is_left_to_the_two_steps() {
        let camera = Camera::new((6, 6), (6.0, 6.0), (2.5, 2.5), Distortion::Equidistant([0.0; 4])).unwrap();
        let options = IntrinsicsOptions::default();
        let view = View::plan((6, 6), Some(&camera), None, (4, 4), ResizePolicy::Stretch, &options).unwrap();
        assert!(Remap::new(&UndistortMap::new(&camera).unwrap(), &view, Filter::Bilinear).is_none());
    }
}
