//! The shape of a convolution and its columns: the patches of a map side by side, so that a convolution is a matrix
//! product.

use std::ops::Range;

use candle_core::{Result, bail};

use super::scratch;

/// Columns of one product that keep the matrix kernels busy; smaller maps share a product.
const COLUMNS_PER_PRODUCT: usize = 256;

/// Sizes of a convolution with a square odd kernel and padding (kernel - 1) / 2.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Geometry {
    pub(super) images: usize,
    pub(super) inputs: usize,
    pub(super) height: usize,
    pub(super) width: usize,
    pub(super) outputs: usize,
    pub(super) kernel: usize,
    pub(super) stride: usize,
}

impl Geometry {
    /// Of images (N, inputs, H, W) and weights (outputs, inputs, k, k).
    pub(super) fn new(x: &[usize], weight: &[usize], stride: usize) -> Result<Self> {
        match (x, weight) {
            (&[images, inputs, height, width], &[outputs, weight_inputs, kernel, kernel_width])
                if inputs == weight_inputs
                    && kernel == kernel_width
                    && kernel % 2 == 1
                    && stride > 0
                    && !x.contains(&0)
                    && outputs > 0 =>
            {
                Ok(Self { images, inputs, height, width, outputs, kernel, stride })
            }
            _ => bail!(
                "no convolution of images {x:?} with weights {weight:?} and stride {stride}: (N, C, H, W) and \
                 (outputs, C, k, k) with an odd k fit, nothing of it empty"
            ),
        }
    }

    pub(super) fn out_height(&self) -> usize {
        self.height.div_ceil(self.stride)
    }

    pub(super) fn out_width(&self) -> usize {
        self.width.div_ceil(self.stride)
    }

    /// Pixels of an input map.
    pub(super) fn map(&self) -> usize {
        self.height * self.width
    }

    /// Pixels of an output map.
    pub(super) fn out_map(&self) -> usize {
        self.out_height() * self.out_width()
    }

    /// Numbers of one image.
    pub(super) fn image(&self) -> usize {
        self.inputs * self.map()
    }

    /// Numbers of one output image.
    pub(super) fn out_image(&self) -> usize {
        self.outputs * self.out_map()
    }

    /// Weights of one output channel: rows of the columns.
    pub(super) fn taps(&self) -> usize {
        self.inputs * self.kernel * self.kernel
    }

    /// The input maps are the columns as they are.
    pub(super) fn is_pointwise(&self) -> bool {
        self.kernel == 1 && self.stride == 1
    }

    /// How many images share one product: as evenly as possible, and of shapes alone.
    pub(super) fn images_per_product(&self) -> usize {
        let wanted = COLUMNS_PER_PRODUCT.div_ceil(self.out_map()).min(self.images);
        self.images.div_ceil(self.images.div_ceil(wanted))
    }

    /// Fills `columns`, rows `taps` of the columns of some images (side by side), each of `out_map` pixels.
    pub(super) fn columns(&self, images: &[f32], taps: Range<usize>, columns: &mut [f32]) {
        let (out_map, count) = (self.out_map(), images.len() / self.image());
        assert_eq!(columns.len(), taps.len() * count * out_map, "rows {taps:?} of {count} images");
        if self.kernel > 1 && self.stride > 1 {
            return self.strided_columns(images, taps, columns);
        }
        for (tap, row) in taps.zip(columns.chunks_exact_mut(count * out_map)) {
            for (image, target) in images.chunks_exact(self.image()).zip(row.chunks_exact_mut(out_map)) {
                self.gather(image, tap, target);
            }
        }
    }

    /// Channel and offsets (rows, columns) of a tap.
    fn tap(&self, tap: usize) -> (usize, isize, isize) {
        let (area, reach) = (self.kernel * self.kernel, (self.kernel / 2) as isize);
        let (channel, within) = (tap / area, tap % area);
        (channel, (within / self.kernel) as isize - reach, (within % self.kernel) as isize - reach)
    }

    /// The outputs along one side of length `out` whose input at `offset` lies inside `length`.
    fn inside(&self, offset: isize, length: usize, out: usize) -> Range<usize> {
        let first = if offset < 0 { offset.unsigned_abs().div_ceil(self.stride) } else { 0 };
        let beyond = (length as isize - offset).max(0) as usize; // outputs o with o * stride < length - offset
        let first = first.min(out);
        first..beyond.div_ceil(self.stride).clamp(first, out)
    }

    /// A row of the columns of one image, of a kernel of one pixel or one that moves by one.
    fn gather(&self, image: &[f32], tap: usize, target: &mut [f32]) {
        let (channel, down, right) = self.tap(tap);
        let map = &image[channel * self.map()..][..self.map()];
        let (out_width, width) = (self.out_width(), self.width);
        if self.stride > 1 {
            let source_rows = map.chunks_exact(width).step_by(self.stride);
            for (row, source) in target.chunks_exact_mut(out_width).zip(source_rows) {
                for (to, from) in row.iter_mut().zip(source.iter().step_by(self.stride)) {
                    *to = *from;
                }
            }
            return;
        }
        let rows = self.inside(down, self.height, self.out_height());
        let columns = self.inside(right, width, out_width);
        if rows.is_empty() || columns.is_empty() {
            target.fill(0.0);
            return;
        }
        target[..rows.start * out_width].fill(0.0);
        target[rows.end * out_width..].fill(0.0);
        // The map moved by one offset; what wraps around the sides is wiped out afterwards.
        let shift = down * width as isize + right;
        let (from, to) = (rows.start * width, rows.end * width);
        let from_shifted = (from as isize + shift).max(0) as usize;
        let to_shifted = ((to as isize + shift) as usize).min(map.len());
        let first = (from_shifted as isize - shift) as usize;
        target[first..first + (to_shifted - from_shifted)].copy_from_slice(&map[from_shifted..to_shifted]);
        for row in target[from..to].chunks_exact_mut(width) {
            row[..columns.start].fill(0.0);
            row[columns.end..].fill(0.0);
        }
    }

    /// [`Self::columns`] of a kernel that moves by more than a pixel. What a tap reads lies a stride apart: the map is sorted by that
    /// once, every `stride`th column beside the next, and each of the many taps copies whole rows.
    fn strided_columns(&self, images: &[f32], taps: Range<usize>, columns: &mut [f32]) {
        let (out_map, out_width, width) = (self.out_map(), self.out_width(), self.width);
        let (area, row_of_columns) = (self.kernel * self.kernel, columns.len() / taps.len().max(1));
        let sorted_width = width.div_ceil(self.stride);
        scratch::with(self.stride * self.height * sorted_width, |sorted| {
            let mut first = taps.start;
            while first < taps.end {
                let channel = first / area;
                let end = ((channel + 1) * area).min(taps.end);
                for (number, image) in images.chunks_exact(self.image()).enumerate() {
                    let map = &image[channel * self.map()..][..self.map()];
                    self.sort_by_phase(map, sorted);
                    for tap in first..end {
                        let start = (tap - taps.start) * row_of_columns + number * out_map;
                        let target = &mut columns[start..][..out_map];
                        let (_, down, right) = self.tap(tap);
                        let rows = self.inside(down, self.height, self.out_height());
                        let inside = self.inside(right, width, out_width);
                        if inside.is_empty() {
                            target.fill(0.0);
                            continue;
                        }
                        target[..rows.start * out_width].fill(0.0);
                        target[rows.end * out_width..].fill(0.0);
                        let stride = self.stride as isize;
                        let phase = right.rem_euclid(stride) as usize;
                        let from = (inside.start as isize + right.div_euclid(stride)).max(0) as usize;
                        for row in rows {
                            let target = &mut target[row * out_width..][..out_width];
                            let source_row = ((row * self.stride) as isize + down) as usize;
                            let source = &sorted[(source_row * self.stride + phase) * sorted_width..];
                            target[..inside.start].fill(0.0);
                            target[inside.end..].fill(0.0);
                            target[inside.clone()].copy_from_slice(&source[from..][..inside.len()]);
                        }
                    }
                }
                first = end;
            }
        });
    }

    /// Each row of a map as `stride` shorter ones: its columns 0, stride, 2 stride ..., then 1, stride + 1 ... .
    fn sort_by_phase(&self, map: &[f32], sorted: &mut [f32]) {
        let sorted_width = self.width.div_ceil(self.stride);
        for (row, sorted) in
            map.chunks_exact(self.width).zip(sorted.chunks_exact_mut(self.stride * sorted_width))
        {
            for (phase, sorted) in sorted.chunks_exact_mut(sorted_width).enumerate() {
                for (to, from) in sorted.iter_mut().zip(row.iter().skip(phase).step_by(self.stride)) {
                    *to = *from;
                }
            }
        }
    }

    /// The reverse of [`Self::columns`] for one image: adds rows `taps` to `maps`, the input channels of those taps.
    pub(super) fn scatter(&self, columns: &[f32], taps: Range<usize>, maps: &mut [f32]) {
        let (out_width, width) = (self.out_width(), self.width);
        let first_channel = taps.start / (self.kernel * self.kernel);
        for (tap, row) in taps.zip(columns.chunks_exact(self.out_map())) {
            let (channel, down, right) = self.tap(tap);
            let map = &mut maps[(channel - first_channel) * self.map()..][..self.map()];
            let inside = self.inside(right, width, out_width);
            for out_row in self.inside(down, self.height, self.out_height()) {
                let source = &row[out_row * out_width..][..out_width];
                let target = &mut map[((out_row * self.stride) as isize + down) as usize * width..][..width];
                for column in inside.clone() {
                    target[((column * self.stride) as isize + right) as usize] += source[column];
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn geometry(height: usize, width: usize, kernel: usize, stride: usize) -> Geometry {
        Geometry::new(&[2, 3, height, width], &[4, 3, kernel, kernel], stride).unwrap()
    }

    /// The pixel under a tap, zero outside.
    fn pixel(g: &Geometry, image: &[f32], tap: usize, row: usize, column: usize) -> f32 {
        let (area, reach) = (g.kernel * g.kernel, g.kernel / 2);
        let (channel, ky, kx) = (tap / area, tap % area / g.kernel, tap % g.kernel);
        let (y, x) = (row * g.stride + ky, column * g.stride + kx);
        if y < reach || x < reach || y - reach >= g.height || x - reach >= g.width {
            return 0.0;
        }
        image[(channel * g.height + y - reach) * g.width + x - reach]
    }

    #[test]
    fn columns_hold_the_pixel_under_every_tap_and_scatter_is_their_transpose() {
        for (height, width) in [(15, 20), (7, 7), (5, 4), (1, 1), (2, 3), (1, 6)] {
            for (kernel, stride) in [(1, 1), (1, 2), (3, 1), (3, 2), (7, 1), (7, 2), (5, 3)] {
                let g = geometry(height, width, kernel, stride);
                let images: Vec<f32> = (0..2 * g.image()).map(|i| 1.0 + i as f32).collect();
                let mut columns = vec![f32::NAN; g.taps() * 2 * g.out_map()];
                g.columns(&images, 0..g.taps(), &mut columns);
                for (i, found) in columns.iter().enumerate() {
                    let (tap, at) = (i / (2 * g.out_map()), i % (2 * g.out_map()));
                    let (image, at) = (at / g.out_map(), at % g.out_map());
                    let image = &images[image * g.image()..][..g.image()];
                    let expected = pixel(&g, image, tap, at / g.out_width(), at % g.out_width());
                    assert_eq!(*found, expected, "{g:?} tap {tap} at {at}");
                }
                // <columns(x), v> = <x, scatter(v)>
                let one = Geometry { images: 1, ..g };
                let v: Vec<f32> = (0..g.taps() * g.out_map()).map(|i| (i * 31 % 17) as f32 - 8.0).collect();
                let mut columns = vec![f32::NAN; v.len()];
                one.columns(&images[..g.image()], 0..g.taps(), &mut columns);
                let mut back = vec![0.0; g.image()];
                one.scatter(&v, 0..g.taps(), &mut back);
                let dot = |a: &[f32], b: &[f32]| {
                    a.iter().zip(b).map(|(a, b)| f64::from(*a) * f64::from(*b)).sum::<f64>()
                };
                assert_eq!(dot(&columns, &v), dot(&images[..g.image()], &back), "{g:?}");
            }
        }
    }

    #[test]
    fn images_share_a_product_evenly() {
        let per = |images, side| {
            Geometry::new(&[images, 1, side, side], &[1, 1, 1, 1], 1).unwrap().images_per_product()
        };
        assert_eq!((per(40, 56), per(5, 7), per(7, 7), per(40, 4), per(1, 4)), (1, 5, 4, 14, 1));
    }

    #[test]
    fn shapes_that_do_not_fit_are_refused() {
        for (x, weight, stride) in [
            (&[2, 3, 4, 4][..], &[4, 2, 3, 3][..], 1),
            (&[2, 3, 4, 4], &[4, 3, 2, 2], 1),
            (&[2, 3, 4, 4], &[4, 3, 3, 1], 1),
            (&[2, 3, 4, 4], &[4, 3, 3, 3], 0),
            (&[0, 3, 4, 4], &[4, 3, 3, 3], 1),
            (&[3, 4, 4], &[4, 3, 3, 3], 1),
        ] {
            let error = Geometry::new(x, weight, stride).unwrap_err().to_string();
            assert!(error.contains(&format!("{weight:?}")), "{error}");
        }
    }
}
