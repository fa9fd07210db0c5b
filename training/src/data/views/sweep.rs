//! How alike a frame and its neighbours are if the scene were at each of many depths.

use std::sync::Arc;

use nalgebra::{Matrix3, Vector3};

use super::Station;
use crate::data::image::Rgb;

/// Planes parallel to the image, evenly spaced in inverse depth.
pub(super) const PLANES: usize = 48;
/// Pixels to each side that are compared.
const REACH: usize = 2;
/// Variance in grey levels squared below which a patch says nothing.
const FLAT: f32 = 4.0;
/// Neighbours at most.
const MOST: usize = 6;

/// Inverse depths, 1/m.
#[derive(Debug, Clone)]
pub(super) struct Planes {
    pub farthest: f32,
    pub step: f32,
}

impl Planes {
    pub fn between(near_m: f64, far_m: f64) -> Self {
        let (farthest, nearest) = (1.0 / far_m, 1.0 / near_m);
        Self { farthest: farthest as f32, step: ((nearest - farthest) / (PLANES - 1) as f64) as f32 }
    }

    pub fn at(&self, plane: f32) -> f32 {
        self.farthest + plane * self.step
    }
}

/// Luma 0..255.
pub(super) fn grey(image: &Rgb) -> Vec<f32> {
    let luma = |rgb: &[u8]| 0.299 * f32::from(rgb[0]) + 0.587 * f32::from(rgb[1]) + 0.114 * f32::from(rgb[2]);
    image.data.chunks_exact(3).map(luma).collect()
}

/// For each pixel and plane (pixel by pixel) 0 for alike to 2 for opposite: one minus the normalised cross-correlation of patches,
/// the mean of the better half of the neighbours, so that what some of them do not see is judged by the others.
pub(super) fn costs(
    reference: &(Station, Arc<Rgb>),
    others: &[(Station, Arc<Rgb>)],
    planes: &Planes,
) -> Vec<f32> {
    let (width, height) = (reference.1.width, reference.1.height);
    let size = width * height;
    let image = Plane { data: grey(&reference.1), width, height };
    let others: Vec<Seen> = others.iter().take(MOST).map(|other| Seen::new(&reference.0, other)).collect();
    let mut boxes = Boxes::new(width, height);
    let mean = boxes.mean(&image.data);
    let squares: Vec<f32> = image.data.iter().map(|v| v * v).collect();
    let mut spread = boxes.mean(&squares);
    for (spread, mean) in spread.iter_mut().zip(&mean) {
        *spread -= mean * mean;
    }
    let better = others.len().div_ceil(2).max(1);
    let mut all = vec![1.0; size * PLANES];
    let mut each = vec![vec![1.0; size]; others.len()];
    let (mut warped, mut is_seen) = (vec![0.0; size], vec![false; size]);
    for plane in 0..PLANES {
        let inverse_depth = planes.at(plane as f32);
        for (other, cost) in others.iter().zip(&mut each) {
            other.warp(inverse_depth, (width, height), &mut warped, &mut is_seen);
            boxes.correlate(&image.data, &mean, &spread, &warped, cost);
            for (cost, is_seen) in cost.iter_mut().zip(&is_seen) {
                if !is_seen {
                    *cost = 1.0;
                }
            }
        }
        if others.is_empty() {
            continue;
        }
        for pixel in 0..size {
            let mut values = [f32::INFINITY; MOST];
            for (value, cost) in values.iter_mut().zip(&each) {
                *value = cost[pixel];
            }
            values.sort_unstable_by(f32::total_cmp);
            all[pixel * PLANES + plane] = values[..better].iter().sum::<f32>() / better as f32;
        }
    }
    all
}

struct Plane {
    data: Vec<f32>,
    width: usize,
    height: usize,
}

/// A neighbour, and where pixels of the reference lie in it: `turn * pixel + shift * inverse depth`.
struct Seen {
    image: Plane,
    turn: Matrix3<f32>,
    shift: Vector3<f32>,
}

impl Seen {
    fn new(reference: &Station, (station, image): &(Station, Arc<Rgb>)) -> Self {
        let other_from_reference = station.world_from_camera.inv_mul(&reference.world_from_camera);
        let (other, own) = (station.lens.pixel_from_ray(), reference.lens.ray_from_pixel());
        let rotation = other_from_reference.rotation.to_rotation_matrix();
        Self {
            image: Plane { data: grey(image), width: image.width, height: image.height },
            turn: (other * rotation.matrix() * own).cast(),
            shift: (other * other_from_reference.translation.vector).cast(),
        }
    }

    /// What it sees of a plane at this inverse depth, from where the reference stands.
    fn warp(
        &self,
        inverse_depth: f32,
        (width, height): (usize, usize),
        warped: &mut [f32],
        is_seen: &mut [bool],
    ) {
        let (last_x, last_y) = ((self.image.width - 1) as f32, (self.image.height - 1) as f32);
        let shift = self.shift * inverse_depth;
        let t = &self.turn;
        for y in 0..height {
            let v = y as f32;
            let start = [0, 1, 2].map(|row| t[(row, 1)] * v + t[(row, 2)] + shift[row]);
            let row = y * width..(y + 1) * width;
            let pixels = warped[row.clone()].iter_mut().zip(&mut is_seen[row]);
            for (x, (value, seen)) in pixels.enumerate() {
                let u = x as f32;
                let inverse = 1.0 / (t[(2, 0)] * u + start[2]).max(1e-6);
                let (sx, sy) = ((t[(0, 0)] * u + start[0]) * inverse, (t[(1, 0)] * u + start[1]) * inverse);
                let (cx, cy) = (sx.clamp(0.0, last_x), sy.clamp(0.0, last_y));
                *seen = (sx - cx).abs() <= 0.5 && (sy - cy).abs() <= 0.5;
                let (left, top) =
                    ((cx as usize).min(self.image.width - 2), (cy as usize).min(self.image.height - 2));
                let (fx, fy) = (cx - left as f32, cy - top as f32);
                let at = top * self.image.width + left;
                let (upper, lower) =
                    (&self.image.data[at..at + 2], &self.image.data[at + self.image.width..][..2]);
                let above = upper[0] + (upper[1] - upper[0]) * fx;
                let below = lower[0] + (lower[1] - lower[0]) * fx;
                *value = above + (below - above) * fy;
            }
        }
    }
}

/// Means over patches, the edge repeated.
struct Boxes {
    width: usize,
    height: usize,
    padded: Vec<f32>,
    rows: Vec<f32>,
    products: [Vec<f32>; 3],
    means: [Vec<f32>; 3],
}

impl Boxes {
    fn new(width: usize, height: usize) -> Self {
        let size = width * height;
        let buffer = || [0; 3].map(|_| vec![0.0; size]);
        let (padded, rows) = (vec![0.0; width + 2 * REACH], vec![0.0; size]);
        Self { width, height, padded, rows, products: buffer(), means: buffer() }
    }

    fn mean(&mut self, data: &[f32]) -> Vec<f32> {
        let mut out = vec![0.0; data.len()];
        Self::blur((self.width, self.height), data, &mut self.padded, &mut self.rows, &mut out);
        out
    }

    fn blur(
        (width, height): (usize, usize),
        data: &[f32],
        padded: &mut [f32],
        rows: &mut [f32],
        out: &mut [f32],
    ) {
        const SIDE: usize = 2 * REACH + 1;
        for (row, sums) in data.chunks_exact(width).zip(rows.chunks_exact_mut(width)) {
            padded[..REACH].fill(row[0]);
            padded[REACH..REACH + width].copy_from_slice(row);
            padded[REACH + width..].fill(row[width - 1]);
            sums.copy_from_slice(&padded[..width]);
            for tap in 1..SIDE {
                for (sum, value) in sums.iter_mut().zip(&padded[tap..]) {
                    *sum += value;
                }
            }
        }
        for (y, means) in out.chunks_exact_mut(width).enumerate() {
            means.fill(0.0);
            for tap in 0..SIDE {
                let from = (y + tap).saturating_sub(REACH).min(height - 1);
                for (mean, sum) in means.iter_mut().zip(&rows[from * width..][..width]) {
                    *mean += sum;
                }
            }
            for mean in means {
                *mean *= 1.0 / (SIDE * SIDE) as f32;
            }
        }
    }

    /// One minus the correlation of the patches of `a`, whose means and variances are known, and of `b`.
    fn correlate(&mut self, a: &[f32], mean_a: &[f32], spread_a: &[f32], b: &[f32], cost: &mut [f32]) {
        let [_, squares, cross] = &mut self.products;
        for (((square, cross), a), b) in squares.iter_mut().zip(cross).zip(a).zip(b) {
            (*square, *cross) = (b * b, a * b);
        }
        let size = (self.width, self.height);
        let [mean_b, square_b, cross_ab] = &mut self.means;
        Self::blur(size, b, &mut self.padded, &mut self.rows, mean_b);
        Self::blur(size, &self.products[1], &mut self.padded, &mut self.rows, square_b);
        Self::blur(size, &self.products[2], &mut self.padded, &mut self.rows, cross_ab);
        let means = mean_a.iter().zip(spread_a).zip(mean_b).zip(square_b).zip(cross_ab);
        for (cost, ((((mean_a, spread_a), mean_b), square_b), cross_ab)) in cost.iter_mut().zip(means) {
            let spread_b = (*square_b - *mean_b * *mean_b).max(0.0);
            let together = *cross_ab - mean_a * *mean_b;
            *cost = 1.0 - together / ((spread_a.max(0.0) + FLAT) * (spread_b + FLAT)).sqrt();
        }
    }
}
