//! Baked surface colours with a mip pyramid.

use rayon::prelude::*;

use super::numeric::{Vec3, mix, rough_log2};

/// One unit of linear light in texel counts: leaves room for light sources of 8 times the diffuse white.
const UNIT: f32 = 8191.0;
/// Most probes along the long side of a pixel's footprint.
const MAX_PROBES: f32 = 4.0;

/// An image of linear light with a pyramid of box-filtered halvings.
#[derive(Debug, Clone)]
pub struct Texture {
    levels: Vec<Level>,
}

#[derive(Debug, Clone)]
struct Level {
    width: usize,
    height: usize,
    texels: Vec<[u16; 4]>,
}

impl Texture {
    /// Bakes `width` x `height` texels, each the mean of `subsamples`^2 values of `light(u, v)`, u and v in 0..1.
    pub fn bake(
        width: usize,
        height: usize,
        subsamples: usize,
        light: impl Fn(f32, f32) -> Vec3 + Sync,
    ) -> Self {
        let mut texels = vec![[0u16; 4]; width * height];
        let step = 1.0 / subsamples as f32;
        texels.par_chunks_mut(width).enumerate().for_each(|(y, row)| {
            for (x, texel) in row.iter_mut().enumerate() {
                let mut sum = [0.0; 3];
                for j in 0..subsamples {
                    for i in 0..subsamples {
                        let u = (x as f32 + (i as f32 + 0.5) * step) / width as f32;
                        let v = (y as f32 + (j as f32 + 0.5) * step) / height as f32;
                        let c = light(u, v);
                        sum = [sum[0] + c[0], sum[1] + c[1], sum[2] + c[2]];
                    }
                }
                *texel = pack(sum, step * step);
            }
        });
        let mut levels = vec![Level { width, height, texels }];
        while let Some(next) = levels.last().and_then(Level::halved) {
            levels.push(next);
        }
        Self { levels }
    }

    /// Mean light over a pixel's footprint around (`u`, `v`), both 0..1; `dx` and `dy` are the changes of (u, v)
    /// from this pixel to its right and lower neighbours.
    pub fn sample(&self, u: f32, v: f32, dx: [f32; 2], dy: [f32; 2]) -> Vec3 {
        let (w, h) = (self.levels[0].width as f32, self.levels[0].height as f32);
        let length = |d: [f32; 2]| ((d[0] * w) * (d[0] * w) + (d[1] * h) * (d[1] * h)).sqrt();
        let (a, b) = (length(dx), length(dy));
        let (long, short, axis) = if a > b { (a, b, dx) } else { (b, a, dy) };
        let short = short.max(long / MAX_PROBES).max(1e-6);
        let lod = rough_log2(short).max(0.0);
        let probes = (long / short + 0.5).floor().clamp(1.0, MAX_PROBES) as usize;
        if probes == 1 {
            return self.trilinear(u, v, lod);
        }
        let mut sum = [0.0; 3];
        for i in 0..probes {
            let offset = (i as f32 + 0.5) / probes as f32 - 0.5;
            let c = self.trilinear(u + axis[0] * offset, v + axis[1] * offset, lod);
            sum = [sum[0] + c[0], sum[1] + c[1], sum[2] + c[2]];
        }
        let share = 1.0 / probes as f32;
        [sum[0] * share, sum[1] * share, sum[2] * share]
    }

    fn trilinear(&self, u: f32, v: f32, lod: f32) -> Vec3 {
        let fine = (lod as usize).min(self.levels.len() - 1);
        let a = self.levels[fine].bilinear(u, v);
        let share = lod - fine as f32;
        if share < 0.02 || fine + 1 == self.levels.len() {
            return a;
        }
        mix(a, self.levels[fine + 1].bilinear(u, v), share.min(1.0))
    }
}

impl Level {
    fn bilinear(&self, u: f32, v: f32) -> Vec3 {
        let x = (u * self.width as f32 - 0.5).clamp(0.0, (self.width - 1) as f32);
        let y = (v * self.height as f32 - 0.5).clamp(0.0, (self.height - 1) as f32);
        let (x0, y0) = (x as usize, y as usize);
        let (x1, y1) = ((x0 + 1).min(self.width - 1), (y0 + 1).min(self.height - 1));
        let (fx, fy) = (x - x0 as f32, y - y0 as f32);
        let row0 = &self.texels[y0 * self.width..][..self.width];
        let row1 = &self.texels[y1 * self.width..][..self.width];
        let (a, b, c, d) = (row0[x0], row0[x1], row1[x0], row1[x1]);
        let weights = [(1.0 - fx) * (1.0 - fy), fx * (1.0 - fy), (1.0 - fx) * fy, fx * fy];
        let channel = |k: usize| {
            (f32::from(a[k]) * weights[0]
                + f32::from(b[k]) * weights[1]
                + f32::from(c[k]) * weights[2]
                + f32::from(d[k]) * weights[3])
                * (1.0 / UNIT)
        };
        [channel(0), channel(1), channel(2)]
    }

    fn halved(&self) -> Option<Self> {
        if self.width == 1 && self.height == 1 {
            return None;
        }
        let (width, height) = (self.width.div_ceil(2), self.height.div_ceil(2));
        let mut texels = Vec::with_capacity(width * height);
        for y in 0..height {
            let rows = [2 * y, (2 * y + 1).min(self.height - 1)];
            for x in 0..width {
                let columns = [2 * x, (2 * x + 1).min(self.width - 1)];
                let mut sum = [2u32; 3];
                for row in rows {
                    for column in columns {
                        let texel = self.texels[row * self.width + column];
                        for (s, t) in sum.iter_mut().zip(texel) {
                            *s += u32::from(t);
                        }
                    }
                }
                texels.push([(sum[0] / 4) as u16, (sum[1] / 4) as u16, (sum[2] / 4) as u16, 0]);
            }
        }
        Some(Self { width, height, texels })
    }
}

fn pack(sum: Vec3, share: f32) -> [u16; 4] {
    // `as` saturates, so light beyond the range stays at its end.
    let count = |x: f32| (x * share * UNIT + 0.5) as u16;
    [count(sum[0]), count(sum[1]), count(sum[2]), 0]
}

#[cfg(test)]
mod tests {
    use super::*;

    const TINY: [f32; 2] = [1e-5, 0.0];

    #[test]
    fn a_close_look_interpolates_the_finest_level() {
        let texture = Texture::bake(32, 16, 1, |u, v| [u, v, 0.25]);
        for (u, v) in [(0.3, 0.6), (0.71, 0.13)] {
            let c = texture.sample(u, v, TINY, [0.0, 1e-5]);
            assert!((c[0] - u).abs() < 1e-3 && (c[1] - v).abs() < 1e-3 && (c[2] - 0.25).abs() < 1e-3);
        }
    }

    #[test]
    fn a_far_look_at_a_checkerboard_is_its_mean() {
        let texture = Texture::bake(64, 64, 1, |u, v| {
            let odd = ((u * 64.0) as i32 + (v * 64.0) as i32) % 2 == 1;
            if odd { [1.0; 3] } else { [0.0; 3] }
        });
        for i in 0..20 {
            let c = texture.sample(0.2 + i as f32 * 0.03, 0.5, [0.04, 0.0], [0.0, 0.04]);
            assert!((c[0] - 0.5).abs() < 0.01, "{c:?}");
        }
    }

    #[test]
    fn a_grazing_look_keeps_detail_across_its_short_side() {
        // Stripes along u: a footprint that is long in u and short in v must still resolve them.
        let texture =
            Texture::bake(64, 64, 1, |_, v| if (v * 8.0) as i32 % 2 == 1 { [1.0; 3] } else { [0.0; 3] });
        let (long, short) = ([4.0 / 64.0, 0.0], [0.0, 1.0 / 64.0]);
        let dark = texture.sample(0.5, 1.0 / 16.0, long, short)[0];
        let bright = texture.sample(0.5, 3.0 / 16.0, long, short)[0];
        assert!(dark < 0.05 && bright > 0.95, "{dark} {bright}");
    }

    #[test]
    fn light_sources_saturate_instead_of_wrapping() {
        let texture = Texture::bake(4, 4, 1, |_, _| [100.0; 3]);
        assert!(texture.sample(0.5, 0.5, TINY, TINY)[0] > 7.9);
    }
}
