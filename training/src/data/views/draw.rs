//! What a camera sees that stands where no frame was taken, put together from frames of the recording.

use std::sync::Arc;

use grnet_geometry::Pose;
use nalgebra::Point3;

use super::Surface;
use crate::data::augment::Border;
use crate::data::image::{Lens, Rgb};

/// Pixels along each side of a view, evenly spaced, that are asked whether they are seen.
const GRID: usize = 8;
/// Pixels between those whose colours are compared.
const COMPARED: usize = 3;
/// Most that the brightness of a frame is changed by to fit that of the first one.
const MOST_GAIN: f32 = 1.5;
/// Pixels at the edges of a frame, where few neighbours see what it sees, whose depth is not used.
const EDGE: usize = 3;

/// A frame to draw from: its stored image and the lens that took it, its depths, and where the new camera stands as seen from it.
pub(super) struct Part<'a> {
    pub image: Arc<Rgb>,
    pub lens: Lens,
    pub surface: &'a Surface,
    pub own_from_new: Pose,
}

/// Draws views; holds buffers that are used again.
#[derive(Debug, Default)]
pub(crate) struct Artist {
    /// Inverse depth as the new camera sees it; 0: unknown.
    seen: Vec<f32>,
    /// Likewise, by the frame that is being added.
    added: Vec<f32>,
    /// Which part shows a pixel; where none does, the one beside it.
    shown_by: Vec<u8>,
    filled: Vec<f32>,
    image: Rgb,
}

impl Artist {
    /// Begins a view in which nothing is seen yet.
    pub(super) fn begin(&mut self, (width, height): (usize, usize)) {
        self.seen.clear();
        self.seen.resize(width * height, 0.0);
        self.shown_by.clear();
        self.shown_by.resize(width * height, 0);
        (self.image.width, self.image.height) = (width, height);
    }

    /// Shows by `part`, the `number`th of this view, what no part before it does.
    pub(super) fn add(&mut self, number: u8, part: &Part<'_>, input: Lens) {
        let new = Map::new(part.lens, &part.own_from_new.inverse(), input);
        self.splat(part.surface, new);
        for ((seen, shown_by), added) in self.seen.iter_mut().zip(&mut self.shown_by).zip(&self.added) {
            if *seen == 0.0 && *added > 0.0 {
                (*seen, *shown_by) = (*added, number);
            }
        }
    }

    /// Points that are not seen yet, out of a grid over the view, in the axes of the new camera, as far away as what is seen beside them.
    pub(super) fn missing(&mut self, surface: &Surface, input: Lens) -> Vec<Point3<f64>> {
        let (width, height) = (self.image.width, self.image.height);
        self.fill(surface);
        let ray = input.ray_from_pixel();
        let mut points = Vec::new();
        for (row, column) in (0..GRID * GRID).map(|i| (i / GRID, i % GRID)) {
            let (x, y) = ((2 * column + 1) * width / (2 * GRID), (2 * row + 1) * height / (2 * GRID));
            let pixel = y * width + x;
            if self.seen[pixel] == 0.0 {
                let depth = 1.0 / f64::from(self.filled[pixel]).max(1e-3);
                points.push(Point3::from(ray * nalgebra::Vector3::new(x as f64, y as f64, 1.0) * depth));
            }
        }
        points
    }

    /// The view, out of the parts that were added, in their order.
    pub(super) fn finish(
        &mut self,
        parts: &[Part<'_>],
        input: Lens,
        (border, mean): (Border, [f32; 3]),
    ) -> &Rgb {
        let maps: Vec<Map> =
            parts.iter().map(|part| Map::new(input, &part.own_from_new, part.lens)).collect();
        let gains: Vec<f32> = (0..parts.len()).map(|part| self.gain(parts, &maps, part)).collect();
        self.fill(parts[0].surface);
        let (width, height) = (self.image.width, self.image.height);
        self.image.data.resize(3 * width * height, 0);
        for y in 0..height {
            for x in 0..width {
                let pixel = y * width + x;
                let part = usize::from(self.shown_by[pixel]);
                let (u, v, _) = maps[part].at(x as f32, y as f32, self.filled[pixel]);
                let rgb = parts[part].image.sample((u, v), border).unwrap_or(mean);
                let bytes = self.image.data[pixel * 3..][..3].iter_mut();
                for (byte, value) in bytes.zip(rgb) {
                    *byte = (value * gains[part] + 0.5) as u8;
                }
            }
        }
        &self.image
    }

    /// What the colours of a part have to be multiplied by to be as bright as those of the first one: cameras change their exposure.
    fn gain(&self, parts: &[Part<'_>], maps: &[Map], part: usize) -> f32 {
        if part == 0 {
            return 1.0;
        }
        let (width, height) = (self.image.width, self.image.height);
        let (mut first, mut own) = (1.0f32, 1.0f32);
        for y in (0..height).step_by(COMPARED) {
            for x in (0..width).step_by(COMPARED) {
                let pixel = y * width + x;
                if self.seen[pixel] == 0.0 || self.shown_by[pixel] != 0 {
                    continue;
                }
                let grey = |part: usize| {
                    let (u, v, _) = maps[part].at(x as f32, y as f32, self.seen[pixel]);
                    parts[part].image.sample((u, v), Border::Mean).map(|rgb| rgb.iter().sum::<f32>())
                };
                if let (Some(in_first), Some(in_own)) = (grey(0), grey(part)) {
                    (first, own) = (first + in_first, own + in_own);
                }
            }
        }
        (first / own).clamp(1.0 / MOST_GAIN, MOST_GAIN)
    }

    /// Puts every point where the new camera sees it, over two by two pixels; the nearest wins.
    fn splat(&mut self, surface: &Surface, new: Map) {
        let (width, height) = (self.image.width, self.image.height);
        self.added.clear();
        self.added.resize(width * height, 0.0);
        splat(surface, &new, &mut self.added, (width, height));
    }

    /// What no point fell on is background: the farther one of the nearest known pixels to the left and to the right.
    fn fill(&mut self, surface: &Surface) {
        let (width, height) = (self.image.width, self.image.height);
        self.filled.clone_from(&self.seen);
        let farthest = surface.inverse_depth.iter().copied().fold(f32::INFINITY, f32::min);
        let mut is_empty = vec![true; height];
        let rows = self.filled.chunks_exact_mut(width).zip(self.shown_by.chunks_exact_mut(width));
        for ((row, shown_by), is_empty) in rows.zip(&mut is_empty) {
            let mut start = 0;
            while start < width {
                if row[start] > 0.0 {
                    (start, *is_empty) = (start + 1, false);
                    continue;
                }
                let length = row[start..].iter().take_while(|seen| **seen == 0.0).count();
                let left = (start > 0).then(|| (row[start - 1], shown_by[start - 1]));
                let right = row.get(start + length).map(|value| (*value, shown_by[start + length]));
                let (value, part) = match (left, right) {
                    (Some(a), Some(b)) => {
                        if a.0 <= b.0 {
                            a
                        } else {
                            b
                        }
                    }
                    (Some(a), None) | (None, Some(a)) => a,
                    (None, None) => (0.0, 0),
                };
                row[start..start + length].fill(value);
                shown_by[start..start + length].fill(part);
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
                Some(from) => {
                    let row = from * width..(from + 1) * width;
                    self.filled.copy_within(row.clone(), y * width);
                    self.shown_by.copy_within(row, y * width);
                }
                None => self.filled[y * width..(y + 1) * width].fill(farthest),
            }
        }
    }
}

/// Inverse depths as a camera elsewhere sees them, every point over two by two pixels; the nearest wins.
pub(super) fn splat(surface: &Surface, new: &Map, seen: &mut [f32], (width, height): (usize, usize)) {
    let (columns, rows) = (surface.width, surface.height);
    for y in EDGE..rows.saturating_sub(EDGE) {
        for x in EDGE..columns.saturating_sub(EDGE) {
            let (u, v, nearness) = new.at(x as f32, y as f32, surface.inverse_depth[y * columns + x]);
            // Not behind the camera, nor so near that it fills the image.
            if !(nearness > 0.0 && nearness < 10.0 && u > -1.0 && v > -1.0) {
                continue;
            }
            let (left, top) = (floor(u), floor(v));
            for row in [top, top + 1] {
                for column in [left, left + 1] {
                    // Below zero these are out of range, too.
                    let (column, row) = (column as usize, row as usize);
                    if column < width && row < height {
                        let seen = &mut seen[row * width + column];
                        *seen = seen.max(nearness);
                    }
                }
            }
        }
    }
}

/// Without the call of a function that `f32::floor` is on processors of the oldest kind.
fn floor(value: f32) -> isize {
    // Far outside every image the conversion saturates; one more still fits.
    let towards_zero = value.min(1e9) as isize;
    towards_zero - isize::from(towards_zero as f32 > value)
}

/// Pixels of one camera with their inverse depth, to pixels of another.
pub(super) struct Map {
    turn: [f32; 9],
    shift: [f32; 3],
}

impl Map {
    pub fn new(from: Lens, to_from: &Pose, to: Lens) -> Self {
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

#[cfg(test)]
mod tests {
    use grnet_frame::{Camera, Distortion};

    use super::*;

    const SIZE: (usize, usize) = (40, 30);

    fn lens() -> Lens {
        let camera = Camera::new((40, 30), (30.0, 30.0), (19.5, 14.5), Distortion::None).unwrap();
        Lens::of_stored(&camera, (40, 30))
    }

    /// A wall two metres away, of one grey, from a camera that stands so far to the left of the new one.
    fn part(surface: &Surface, left_m: f64, grey: u8) -> Part<'_> {
        let image = Rgb { width: SIZE.0, height: SIZE.1, data: vec![grey; 3 * SIZE.0 * SIZE.1] };
        Part {
            image: Arc::new(image),
            lens: lens(),
            surface,
            own_from_new: Pose::translation(left_m, 0.0, 0.0),
        }
    }

    fn wall() -> Surface {
        Surface { width: SIZE.0, height: SIZE.1, inverse_depth: vec![0.5; SIZE.0 * SIZE.1] }
    }

    #[test]
    fn what_one_frame_does_not_show_another_one_does_as_bright_as_the_first() {
        let surface = wall();
        let mut artist = Artist::default();
        artist.begin(SIZE);
        // 60 cm at two metres: nine columns at the right.
        let parts = [part(&surface, 0.6, 100), part(&surface, -0.2, 120)];
        artist.add(0, &parts[0], lens());
        let missing = artist.missing(&surface, lens());
        assert!(!missing.is_empty() && missing.iter().all(|point| (point.z - 2.0).abs() < 0.1));
        assert!(missing.iter().any(|point| point.x > 1.0 && point.y > 0.6), "{missing:?}");
        artist.add(1, &parts[1], lens());
        // Not the rows at the edges, which neither shows.
        let mut rows = artist.shown_by.chunks_exact(SIZE.0).skip(EDGE).take(SIZE.1 - 2 * EDGE);
        assert!(rows.all(|row| row[5] == 0 && row[35] == 1));
        let view = artist.finish(&parts, lens(), (Border::Edge, [0.0; 3]));
        assert!(view.data.iter().all(|value| value.abs_diff(100) <= 1), "{:?}", &view.data[..120]);
    }

    #[test]
    fn what_no_frame_shows_is_the_background_beside_it() {
        let surface = wall();
        let mut artist = Artist::default();
        artist.begin(SIZE);
        let parts = [part(&surface, 0.6, 100)];
        artist.add(0, &parts[0], lens());
        let view = artist.finish(&parts, lens(), (Border::Edge, [0.0; 3]));
        assert!(view.data.iter().all(|value| *value == 100));
    }
}
