//! Follows corners from one image to another: FAST corners (Rosten and Drummond, 2006) and the pyramidal tracker of
//! Lucas and Kanade (Bouguet, "Pyramidal implementation of the Lucas Kanade feature tracker", 2000).

use image::GrayImage;
use imageproc::corners::corners_fast9;

/// Half the side of the window that is compared.
const RADIUS: i32 = 7;

/// The coarsest level has at least this many pixels on its shorter side.
const COARSEST_PX: usize = 40;

const MOST_LEVELS: usize = 5;
const STEPS: usize = 12;

/// Largest distance between a corner and where the tracker finds it when it goes there and back.
const MOST_RETURN_PX: f64 = 0.5;

/// Largest mean difference of grey values between the windows of a track.
const MOST_DIFFERENCE: f64 = 20.0;

/// Columns and rows of the grid in each of whose cells the best corners are taken.
const CELLS: (u32, u32) = (12, 9);
const CORNERS_A_CELL: usize = 2;

/// A grey image at halving sizes, the finest first.
#[derive(Debug, Clone)]
pub struct Pyramid {
    levels: Vec<Level>,
}

#[derive(Debug, Clone)]
struct Level {
    width: usize,
    height: usize,
    data: Vec<f32>,
}

/// A pixel position.
pub type Point = (f64, f64);

impl Pyramid {
    /// Of an image.
    pub fn new(image: &GrayImage) -> Self {
        let (width, height) = (image.width() as usize, image.height() as usize);
        let data = image.as_raw().iter().map(|value| f32::from(*value)).collect();
        let mut levels = vec![Level { width, height, data }.smoothed()];
        while levels.len() < MOST_LEVELS {
            let last = &levels[levels.len() - 1];
            if last.width.min(last.height) / 2 < COARSEST_PX {
                break;
            }
            let half = last.halved();
            levels.push(half);
        }
        Self { levels }
    }

    /// Where `points` of this image are in `other`; `None` where the way there and back does not close.
    pub fn follow(&self, other: &Self, points: &[Point]) -> Vec<Option<Point>> {
        let there_and_back = |&start: &Point| {
            let there = self.track(other, start)?;
            let back = other.track(self, there)?;
            ((back.0 - start.0).hypot(back.1 - start.1) < MOST_RETURN_PX).then_some(there)
        };
        points.iter().map(there_and_back).collect()
    }

    fn track(&self, other: &Self, start: Point) -> Option<Point> {
        let mut flow = (0.0, 0.0);
        let coarsest = self.levels.len().min(other.levels.len()) - 1;
        for level in (0..=coarsest).rev() {
            let scale = f64::from(1u32 << level);
            let at = (start.0 / scale, start.1 / scale);
            let finest = level == 0;
            match self.levels[level].step(&other.levels[level], at, flow, finest) {
                Some(found) => flow = found,
                // A window that leaves a coarse image may fit into the finer one.
                None if finest => return None,
                None => {}
            }
            if !finest {
                flow = (flow.0 * 2.0, flow.1 * 2.0);
            }
        }
        Some((start.0 + flow.0, start.1 + flow.1))
    }
}

impl Level {
    /// 3x3 binomial filter: gradients of single pixels are noise.
    fn smoothed(&self) -> Self {
        let (w, h) = (self.width, self.height);
        let mut rows = self.data.clone();
        for y in 0..h {
            for x in 1..w.saturating_sub(1) {
                let i = y * w + x;
                rows[i] = 0.25 * self.data[i - 1] + 0.5 * self.data[i] + 0.25 * self.data[i + 1];
            }
        }
        let mut data = rows.clone();
        for y in 1..h.saturating_sub(1) {
            for x in 0..w {
                let i = y * w + x;
                data[i] = 0.25 * rows[i - w] + 0.5 * rows[i] + 0.25 * rows[i + w];
            }
        }
        Self { width: w, height: h, data }
    }

    /// Every second pixel of the smoothed image: pixel (x, y) here is (2x, 2y) there.
    fn halved(&self) -> Self {
        let smooth = self.smoothed();
        let (width, height) = (self.width.div_ceil(2), self.height.div_ceil(2));
        let data = (0..width * height).map(|i| smooth.data[2 * (i / width) * self.width + 2 * (i % width)]);
        Self { width, height, data: data.collect() }
    }

    /// Whether a window with its gradients lies inside.
    fn holds(&self, (x, y): Point) -> bool {
        let margin = f64::from(RADIUS + 2);
        x >= margin && y >= margin && x < self.width as f64 - margin && y < self.height as f64 - margin
    }

    fn sample(&self, x: f64, y: f64) -> f32 {
        let (left, top) = (x.floor(), y.floor());
        let (fx, fy) = ((x - left) as f32, (y - top) as f32);
        let i = top as usize * self.width + left as usize;
        let row = |i: usize| self.data[i] + (self.data[i + 1] - self.data[i]) * fx;
        let (upper, lower) = (row(i), row(i + self.width));
        upper + (lower - upper) * fy
    }

    /// Improves a flow; `None` when the window leaves an image, has no structure, or does not look alike.
    fn step(&self, other: &Self, at: Point, start: Point, judged: bool) -> Option<Point> {
        if !self.holds(at) {
            return None;
        }
        let side = (2 * RADIUS + 1) as usize;
        let mut window = Vec::with_capacity(side * side);
        let (mut xx, mut xy, mut yy) = (0.0, 0.0, 0.0);
        for dy in -RADIUS..=RADIUS {
            for dx in -RADIUS..=RADIUS {
                let (x, y) = (at.0 + f64::from(dx), at.1 + f64::from(dy));
                let gx = f64::from(self.sample(x + 1.0, y) - self.sample(x - 1.0, y)) / 2.0;
                let gy = f64::from(self.sample(x, y + 1.0) - self.sample(x, y - 1.0)) / 2.0;
                (xx, xy, yy) = (xx + gx * gx, xy + gx * gy, yy + gy * gy);
                window.push((f64::from(dx), f64::from(dy), gx, gy, self.sample(x, y)));
            }
        }
        let (determinant, trace) = (xx * yy - xy * xy, xx + yy);
        let smaller = (trace - (trace * trace - 4.0 * determinant).max(0.0).sqrt()) / 2.0;
        if smaller < window.len() as f64 {
            return None;
        }
        let mut flow = start;
        for _ in 0..STEPS {
            let to = (at.0 + flow.0, at.1 + flow.1);
            if !other.holds(to) {
                return None;
            }
            let (mut bx, mut by) = (0.0, 0.0);
            for (dx, dy, gx, gy, value) in &window {
                let difference = f64::from(value - other.sample(to.0 + dx, to.1 + dy));
                (bx, by) = (bx + difference * gx, by + difference * gy);
            }
            let move_by = ((yy * bx - xy * by) / determinant, (xx * by - xy * bx) / determinant);
            flow = (flow.0 + move_by.0, flow.1 + move_by.1);
            if move_by.0.hypot(move_by.1) < 0.02 {
                break;
            }
        }
        let to = (at.0 + flow.0, at.1 + flow.1);
        if !other.holds(to) {
            return None;
        }
        let difference = |(dx, dy, _, _, value): &(f64, f64, f64, f64, f32)| {
            f64::from((value - other.sample(to.0 + dx, to.1 + dy)).abs())
        };
        let mean = window.iter().map(difference).sum::<f64>() / window.len() as f64;
        (!judged || mean < MOST_DIFFERENCE).then_some(flow)
    }
}

/// Corners spread over the image.
pub fn corners(image: &GrayImage) -> Vec<Point> {
    let mut found = corners_fast9(image, 20);
    if found.len() < 100 {
        found = corners_fast9(image, 8);
    }
    found.sort_by(|a, b| b.score.total_cmp(&a.score).then((a.y, a.x).cmp(&(b.y, b.x))));
    let mut taken = vec![0; (CELLS.0 * CELLS.1) as usize];
    found.retain(|corner| {
        let cell = corner.y * CELLS.1 / image.height() * CELLS.0 + corner.x * CELLS.0 / image.width();
        taken[cell as usize] += 1;
        taken[cell as usize] <= CORNERS_A_CELL
    });
    found.iter().map(|corner| (f64::from(corner.x), f64::from(corner.y))).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A smooth picture without repetition, seen from (`dx`, `dy`).
    fn picture(dx: f64, dy: f64) -> GrayImage {
        GrayImage::from_fn(240, 180, |x, y| {
            let (x, y) = (f64::from(x) + dx, f64::from(y) + dy);
            let waves =
                (x * 0.21 + 3.0 * (y * 0.05).sin()).sin() * (y * 0.19 + 2.0 * (x * 0.033).cos()).cos();
            // Blobs with sharp rims are what corners are found at.
            let blob = if (x * 0.11).sin() * (y * 0.13 + x * 0.01).sin() > 0.35 { 70.0 } else { 0.0 };
            image::Luma([(90.0 + 40.0 * waves + blob) as u8])
        })
    }

    #[test]
    fn corners_are_found_where_they_move_to() {
        let (a, b) = (picture(0.0, 0.0), picture(13.0, -6.0));
        let points = corners(&a);
        assert!(points.len() > 30, "{} corners", points.len());
        let followed = Pyramid::new(&a).follow(&Pyramid::new(&b), &points);
        let pairs: Vec<_> = points.iter().zip(&followed).filter_map(|(p, q)| Some((*p, (*q)?))).collect();
        assert!(pairs.len() * 2 > points.len(), "{} of {} corners", pairs.len(), points.len());
        for (from, to) in pairs {
            let error = (to.0 - from.0 + 13.0).hypot(to.1 - from.1 - 6.0);
            assert!(error < 0.6, "{from:?} went to {to:?}");
        }
    }

    #[test]
    fn another_picture_is_not_followed() {
        let a = picture(0.0, 0.0);
        let flat = GrayImage::from_pixel(240, 180, image::Luma([128]));
        let followed = Pyramid::new(&a).follow(&Pyramid::new(&flat), &corners(&a));
        assert!(followed.iter().all(Option::is_none));
        assert!(corners(&flat).is_empty());
    }
}
