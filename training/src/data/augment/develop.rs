//! Bytes to the network's numbers, by way of whatever was drawn.

use grnet_model::Preprocessing;
use rand::{RngCore, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::Warp;
use super::draw::{FrameLook, Look, STEPS_PER_BYTE};
use crate::data::image::Rgb;

/// Where a frame's pixels come from.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Source<'a> {
    /// The bytes that run-time preprocessing gives.
    Exact(&'a Rgb),
    /// A stored image seen by a rotated camera.
    Warped(&'a Rgb, &'a Warp),
}

/// The planes (3, height, width) of one frame.
#[derive(Debug)]
pub(crate) struct Canvas<'a> {
    pub planes: &'a mut [f32],
    pub width: usize,
    pub height: usize,
}

/// Turns frames into normalised planes.
#[derive(Debug, Clone)]
pub(crate) struct Developer {
    /// `(v / 255 - mean) / std` for each channel and byte, as the pipeline has it.
    table: [[f32; 256]; 3],
    /// The same for values between bytes: factor and offset.
    line: [(f32, f32); 3],
    mean: [f32; 3],
}

/// Buffers that are used again.
#[derive(Debug, Default)]
pub(crate) struct Scratch {
    padded: Vec<f32>,
    noise: Vec<u8>,
}

impl Developer {
    pub fn new(preprocessing: &Preprocessing) -> Self {
        let (mean, std) = (preprocessing.mean, preprocessing.std);
        let byte = |c: usize, byte: usize| ((byte as f64 / 255.0 - mean[c]) / std[c]) as f32;
        Self {
            table: std::array::from_fn(|c| std::array::from_fn(|b| byte(c, b))),
            line: std::array::from_fn(|c| ((1.0 / (255.0 * std[c])) as f32, (-mean[c] / std[c]) as f32)),
            mean: mean.map(|m| (m * 255.0) as f32),
        }
    }

    /// The mean colour, 0..255.
    pub fn mean(&self) -> [f32; 3] {
        self.mean
    }

    /// Writes frame number `frame` of a window into `canvas`.
    pub fn run(
        &self,
        source: Source<'_>,
        look: Option<&Look>,
        frame: usize,
        canvas: Canvas<'_>,
        scratch: &mut Scratch,
    ) {
        let Canvas { planes, width, height } = canvas;
        let size = width * height;
        let Some(look) = look else { return self.as_is(source, planes, (width, height)) };
        let of_frame = &look.frames[frame];
        let (red, rest) = planes.split_at_mut(size);
        let (green, blue) = rest.split_at_mut(size);
        let mut put = |pixel: usize, rgb: [f32; 3]| {
            let [r, g, b] = look.colour(rgb, of_frame.gain);
            (red[pixel], green[pixel], blue[pixel]) = (r, g, b);
        };
        match source {
            Source::Exact(image) => {
                for (pixel, rgb) in image.data.chunks_exact(3).enumerate() {
                    put(pixel, [f32::from(rgb[0]), f32::from(rgb[1]), f32::from(rgb[2])]);
                }
            }
            Source::Warped(image, warp) => warp.each(image, (width, height), self.mean, put),
        }
        if let Some((side, weights)) = &look.kernel {
            for plane in planes.chunks_exact_mut(size) {
                convolve(plane, (width, height), *side, weights, &mut scratch.padded);
            }
        }
        if look.noise > 0.0 {
            add_noise(planes, look.noise, of_frame.noise_seed, &mut scratch.noise);
        }
        erase(planes, (width, height), of_frame);
        for (plane, (factor, offset)) in planes.chunks_exact_mut(size).zip(self.line) {
            for value in plane {
                *value = value.clamp(0.0, 255.0) * factor + offset;
            }
        }
    }

    fn as_is(&self, source: Source<'_>, planes: &mut [f32], (width, height): (usize, usize)) {
        let size = width * height;
        let (red, rest) = planes.split_at_mut(size);
        let (green, blue) = rest.split_at_mut(size);
        match source {
            Source::Exact(image) => {
                let planes = red.iter_mut().zip(green).zip(blue);
                for (rgb, ((r, g), b)) in image.data.chunks_exact(3).zip(planes) {
                    *r = self.table[0][usize::from(rgb[0])];
                    *g = self.table[1][usize::from(rgb[1])];
                    *b = self.table[2][usize::from(rgb[2])];
                }
            }
            Source::Warped(image, warp) => warp.each(image, (width, height), self.mean, |pixel, rgb| {
                let [r, g, b] = [0, 1, 2].map(|c| rgb[c] * self.line[c].0 + self.line[c].1);
                (red[pixel], green[pixel], blue[pixel]) = (r, g, b);
            }),
        }
    }
}

impl Look {
    fn colour(&self, rgb: [f32; 3], gain: f32) -> [f32; 3] {
        let bent = [0, 1, 2].map(|c: usize| {
            let step = (rgb[c] * STEPS_PER_BYTE as f32 + 0.5) as usize;
            self.curves[c][step.min(255 * STEPS_PER_BYTE)] * gain
        });
        let luma = 0.299 * bent[0] + 0.587 * bent[1] + 0.114 * bent[2];
        bent.map(|v| (luma + (v - luma) * self.saturation).clamp(0.0, 255.0))
    }
}

/// Correlates a plane with a square kernel, the edge repeated.
fn convolve(
    plane: &mut [f32],
    (width, height): (usize, usize),
    side: usize,
    weights: &[f32],
    padded: &mut Vec<f32>,
) {
    let reach = side / 2;
    let row_length = width + 2 * reach;
    padded.clear();
    for y in 0..height + 2 * reach {
        let row = &plane[y.saturating_sub(reach).min(height - 1) * width..][..width];
        padded.extend(std::iter::repeat_n(row[0], reach));
        padded.extend_from_slice(row);
        padded.extend(std::iter::repeat_n(row[width - 1], reach));
    }
    let taps: Vec<(usize, f32)> = (0..side * side)
        .filter(|i| weights[*i] > 1e-4)
        .map(|i| (i / side * row_length + i % side, weights[i]))
        .collect();
    let total: f32 = taps.iter().map(|(_, weight)| weight).sum();
    for (y, row) in plane.chunks_exact_mut(width).enumerate() {
        row.fill(0.0);
        for (offset, weight) in &taps {
            let weight = weight / total;
            for (sum, value) in row.iter_mut().zip(&padded[y * row_length + offset..][..width]) {
                *sum += weight * value;
            }
        }
    }
}

/// Noise of nearly normal distribution: the sum of four even bytes.
fn add_noise(planes: &mut [f32], deviation: f32, seed: u64, bytes: &mut Vec<u8>) {
    /// Deviation of the sum of four even bytes: sqrt(4 (256^2 - 1) / 12).
    const SPREAD: f32 = 147.8;
    bytes.resize(planes.len() * 4, 0);
    ChaCha8Rng::seed_from_u64(seed).fill_bytes(bytes);
    let scale = deviation / SPREAD;
    for (value, four) in planes.iter_mut().zip(bytes.chunks_exact(4)) {
        let sum: u32 = four.iter().map(|byte| u32::from(*byte)).sum();
        *value += (sum as f32 - 510.0) * scale;
    }
}

fn erase(planes: &mut [f32], (width, height): (usize, usize), frame: &FrameLook) {
    let Some(erased) = &frame.erased else { return };
    let [left, top, wide, high] = erased.area;
    let span = |start: f64, length: f64, of: usize| {
        let at = |share: f64| ((share * of as f64 + 0.5) as usize).min(of);
        at(start)..at(start + length)
    };
    let (columns, rows) = (span(left, wide, width), span(top, high, height));
    for (plane, colour) in planes.chunks_exact_mut(width * height).zip(erased.colour) {
        for row in plane.chunks_exact_mut(width).skip(rows.start).take(rows.len()) {
            row[columns.clone()].fill(colour);
        }
    }
}
