//! A stored frame from a camera that stands elsewhere.

use grnet_geometry::Pose;

use super::Surface;
use crate::data::augment::Border;
use crate::data::image::{Lens, Rgb};

/// Draws views; holds buffers that are used again.
#[derive(Debug, Default)]
pub(crate) struct Artist {
    /// Inverse depth as the new camera sees it; 0: unknown.
    seen: Vec<f32>,
    image: Rgb,
}

impl Artist {
    /// `image`, whose depths are `surface` and which `stored` took, as `input` sees it from `stored_from_new`.
    pub fn draw(
        &mut self,
        (image, surface, stored): (&Rgb, &Surface, Lens),
        stored_from_new: &Pose,
        (input, (width, height)): (Lens, (usize, usize)),
        (border, mean): (Border, [f32; 3]),
    ) -> &Rgb {
        self.splat(surface, Map::new(stored, &stored_from_new.inverse(), input), (width, height));
        self.fill((width, height), surface);
        self.image.width = width;
        self.image.height = height;
        self.image.data.resize(3 * width * height, 0);
        let map = Map::new(input, stored_from_new, stored);
        for y in 0..height {
            for x in 0..width {
                let pixel = y * width + x;
                let (u, v, _) = map.at(x as f32, y as f32, self.seen[pixel]);
                let rgb = image.sample((u, v), border).unwrap_or(mean);
                for (byte, value) in self.image.data[pixel * 3..][..3].iter_mut().zip(rgb) {
                    *byte = (value + 0.5) as u8;
                }
            }
        }
        &self.image
    }

    /// Puts every point where the new camera sees it, over two by two pixels; the nearest wins.
    fn splat(&mut self, surface: &Surface, new: Map, (width, height): (usize, usize)) {
        self.seen.clear();
        self.seen.resize(width * height, 0.0);
        for (pixel, inverse_depth) in surface.inverse_depth.iter().enumerate() {
            let (x, y) = ((pixel % surface.width) as f32, (pixel / surface.width) as f32);
            let (u, v, nearness) = new.at(x, y, *inverse_depth);
            // Not behind the camera, nor so near that it fills the image.
            if !(nearness > 0.0 && nearness < 10.0 && u > -1.0 && v > -1.0) {
                continue;
            }
            let (left, top) = (u.floor(), v.floor());
            for (column, row) in [(left, top), (left + 1.0, top), (left, top + 1.0), (left + 1.0, top + 1.0)]
            {
                if column >= 0.0 && row >= 0.0 && (column as usize) < width && (row as usize) < height {
                    let seen = &mut self.seen[row as usize * width + column as usize];
                    *seen = seen.max(nearness);
                }
            }
        }
    }

    /// What no point fell on is background: the farther one of the nearest known pixels to the left and to the right.
    fn fill(&mut self, (width, height): (usize, usize), surface: &Surface) {
        let farthest = surface.inverse_depth.iter().copied().fold(f32::INFINITY, f32::min);
        let mut is_empty = vec![true; height];
        for (row, is_empty) in self.seen.chunks_exact_mut(width).zip(&mut is_empty) {
            let mut start = 0;
            while start < width {
                if row[start] > 0.0 {
                    (start, *is_empty) = (start + 1, false);
                    continue;
                }
                let length = row[start..].iter().take_while(|seen| **seen == 0.0).count();
                let left = (start > 0).then(|| row[start - 1]);
                let right = row.get(start + length).copied();
                let value = match (left, right) {
                    (Some(a), Some(b)) => a.min(b),
                    (Some(a), None) | (None, Some(a)) => a,
                    (None, None) => 0.0,
                };
                row[start..start + length].fill(value);
                start += length;
            }
        }
        // Rows that nothing fell on continue the nearest one that something did.
        for y in 0..height {
            if !is_empty[y] {
                continue;
            }
            let distance = |other: &usize| other.abs_diff(y);
            let nearest = (0..height).filter(|other| !is_empty[*other]).min_by_key(distance);
            match nearest {
                Some(from) => self.seen.copy_within(from * width..(from + 1) * width, y * width),
                None => self.seen[y * width..(y + 1) * width].fill(farthest),
            }
        }
    }
}

/// Pixels of one camera with their inverse depth, to pixels of another.
struct Map {
    turn: [f32; 9],
    shift: [f32; 3],
}

impl Map {
    fn new(from: Lens, to_from: &Pose, to: Lens) -> Self {
        let (ray, pixel) = (from.ray_from_pixel(), to.pixel_from_ray());
        let turn = pixel * to_from.rotation.to_rotation_matrix().matrix() * ray;
        let shift = pixel * to_from.translation.vector;
        Self {
            turn: std::array::from_fn(|i| turn[(i / 3, i % 3)] as f32),
            shift: std::array::from_fn(|i| shift[i] as f32),
        }
    }

    /// Column, row, and inverse depth there.
    fn at(&self, x: f32, y: f32, inverse_depth: f32) -> (f32, f32, f32) {
        let (t, s) = (&self.turn, &self.shift);
        let [u, v, w] = [0, 1, 2]
            .map(|row| t[3 * row] * x + t[3 * row + 1] * y + t[3 * row + 2] + s[row] * inverse_depth);
        let inverse = 1.0 / if w.abs() < 1e-6 { 1e-6 } else { w };
        (u * inverse, v * inverse, inverse_depth * inverse)
    }
}
