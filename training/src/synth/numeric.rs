//! Arithmetic that gives the same bits everywhere: only IEEE additions, products, quotients, square roots
//! and integer hashes, never the platform's mathematical library.

use std::f64::consts::{FRAC_PI_2, PI};

/// A point or direction, metres where it is a point.
pub type Vec3 = [f32; 3];

/// `a + b * s`.
pub fn along(a: Vec3, b: Vec3, s: f32) -> Vec3 {
    [a[0] + b[0] * s, a[1] + b[1] * s, a[2] + b[2] * s]
}

/// Component-wise difference.
pub fn sub(a: Vec3, b: Vec3) -> Vec3 {
    [a[0] - b[0], a[1] - b[1], a[2] - b[2]]
}

/// Scalar product.
pub fn dot(a: Vec3, b: Vec3) -> f32 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

/// Vector product.
pub fn cross(a: Vec3, b: Vec3) -> Vec3 {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

/// Colour times factor.
pub fn scaled(c: Vec3, s: f32) -> Vec3 {
    [c[0] * s, c[1] * s, c[2] * s]
}

/// Linear blend from `a` (t = 0) to `b` (t = 1).
pub fn mix(a: Vec3, b: Vec3, t: f32) -> Vec3 {
    [a[0] + (b[0] - a[0]) * t, a[1] + (b[1] - a[1]) * t, a[2] + (b[2] - a[2]) * t]
}

/// 0 below `lo`, 1 above `hi`, smooth between.
pub fn smoothstep(lo: f32, hi: f32, x: f32) -> f32 {
    let t = ((x - lo) / (hi - lo)).clamp(0.0, 1.0);
    t * t * (3.0 - 2.0 * t)
}

/// Distance to the next whole number, 0..0.5.
pub fn to_grid(x: f32) -> f32 {
    (x - (x + 0.5).floor()).abs()
}

/// A well-mixed 32-bit hash of three numbers.
pub fn hash(x: u32, y: u32, z: u32) -> u32 {
    let mut h = x.wrapping_mul(0x9E37_79B1) ^ y.wrapping_mul(0x85EB_CA77) ^ z.wrapping_mul(0xC2B2_AE3D);
    h = (h ^ (h >> 16)).wrapping_mul(0x7FEB_352D);
    h = (h ^ (h >> 15)).wrapping_mul(0x846C_A68B);
    h ^ (h >> 16)
}

/// A hash as a number in 0..1.
pub fn unit(h: u32) -> f32 {
    (h >> 8) as f32 * (1.0 / 16_777_216.0)
}

/// Number in 0..1 that belongs to the lattice cell (`i`, `j`).
pub fn cell(i: f32, j: f32, seed: u32) -> f32 {
    unit(hash(i as i32 as u32, j as i32 as u32, seed))
}

/// Smooth noise in 0..1 with features of size 1.
pub fn noise(x: f32, y: f32, seed: u32) -> f32 {
    let (i, j) = (x.floor(), y.floor());
    let (fx, fy) = (x - i, y - j);
    let (sx, sy) = (fx * fx * (3.0 - 2.0 * fx), fy * fy * (3.0 - 2.0 * fy));
    let a = cell(i, j, seed);
    let b = cell(i + 1.0, j, seed);
    let c = cell(i, j + 1.0, seed);
    let d = cell(i + 1.0, j + 1.0, seed);
    let (top, bottom) = (a + (b - a) * sx, c + (d - c) * sx);
    top + (bottom - top) * sy
}

/// Sum of `octaves` noises of halving size and strength, 0..1, mean 0.5.
pub fn fbm(x: f32, y: f32, seed: u32, octaves: u32) -> f32 {
    let (mut sum, mut total, mut amplitude, mut scale) = (0.0, 0.0, 1.0, 1.0);
    for octave in 0..octaves {
        sum += amplitude * noise(x * scale, y * scale, seed.wrapping_add(octave * 101));
        total += amplitude;
        amplitude *= 0.55;
        scale *= 2.03;
    }
    sum / total
}

/// Sine and cosine, within 1e-15 for |rad| < 1e4.
pub fn sin_cos(rad: f64) -> (f64, f64) {
    let quarter = (rad / FRAC_PI_2 + 0.5).floor();
    let x = rad - quarter * FRAC_PI_2;
    let x2 = x * x;
    let (mut sin, mut cos) = (1.0, 1.0);
    // Horner's scheme on both Taylor series; |x| <= pi/4 makes ten terms exact to the last bit or two.
    for k in (1..=10).rev() {
        let k = f64::from(k);
        sin = 1.0 - x2 / ((2.0 * k) * (2.0 * k + 1.0)) * sin;
        cos = 1.0 - x2 / ((2.0 * k - 1.0) * (2.0 * k)) * cos;
    }
    let sin = x * sin;
    match (quarter as i64).rem_euclid(4) {
        0 => (sin, cos),
        1 => (cos, -sin),
        2 => (-sin, -cos),
        _ => (-cos, sin),
    }
}

/// Sine of `turns` full turns.
pub fn wave(turns: f32) -> f32 {
    sin_cos(f64::from(turns) * 2.0 * PI).0 as f32
}

/// The sRGB transfer function: linear light 0..1 to code value 0..1.
pub fn srgb_encode(linear: f64) -> f64 {
    let x = linear.clamp(0.0, 1.0);
    if x <= 0.003_130_8 {
        return x * 12.92;
    }
    // x^(1/2.4) = ((x^5)^(1/3))^(1/4), the cube root by Newton's method.
    let x5 = x * x * x * x * x;
    let mut root = 1.0f64;
    for _ in 0..80 {
        root = (2.0 * root + x5 / (root * root)) / 3.0;
    }
    1.055 * root.sqrt().sqrt() - 0.055
}

/// Linear light of an sRGB code value (polynomial fit, for choosing colours only).
pub fn linear(code: f32) -> f32 {
    code * (code * (code * 0.305_306 + 0.682_171_1) + 0.012_522_9)
}

/// A colour by hue (turns), saturation and value as a colour picker shows it, in linear light.
pub fn hsv(hue: f32, saturation: f32, value: f32) -> Vec3 {
    let channel = |offset: f32| {
        let h = (hue + offset) * 6.0;
        let k = h - (h / 6.0).floor() * 6.0;
        let ramp = k.min(4.0 - k).clamp(0.0, 1.0);
        linear(value * (1.0 - saturation * ramp))
    };
    [channel(5.0 / 6.0), channel(3.0 / 6.0), channel(1.0 / 6.0)]
}

/// log2 of a positive number, exact at powers of two and within 0.09 between; for choosing a mip level.
pub fn rough_log2(x: f32) -> f32 {
    let bits = x.to_bits();
    let mantissa = f32::from_bits((bits & 0x007F_FFFF) | 0x3F80_0000);
    ((bits >> 23) as i32 - 127) as f32 + (mantissa - 1.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sine_and_cosine_agree_with_the_library() {
        for i in -4000..4000 {
            let x = f64::from(i) * 0.0173;
            let (sin, cos) = sin_cos(x);
            assert!((sin - x.sin()).abs() < 1e-14 && (cos - x.cos()).abs() < 1e-14, "at {x}: {sin} {cos}");
        }
    }

    #[test]
    fn srgb_agrees_with_the_standard() {
        for i in 0..=1000 {
            let x = f64::from(i) / 1000.0;
            let expected = if x <= 0.003_130_8 { 12.92 * x } else { 1.055 * x.powf(1.0 / 2.4) - 0.055 };
            assert!((srgb_encode(x) - expected).abs() < 1e-12, "at {x}");
        }
    }

    #[test]
    fn pure_hues_are_where_a_colour_picker_has_them() {
        let near = |c: Vec3, e: Vec3| (0..3).all(|i| (c[i] - e[i]).abs() < 1e-3);
        assert!(near(hsv(0.0, 1.0, 1.0), [1.0, 0.0, 0.0]));
        assert!(near(hsv(1.0 / 3.0, 1.0, 1.0), [0.0, 1.0, 0.0]));
        assert!(near(hsv(2.0 / 3.0, 1.0, 1.0), [0.0, 0.0, 1.0]));
        assert!(near(hsv(0.4, 0.0, 1.0), [1.0, 1.0, 1.0]));
    }

    #[test]
    fn noise_fills_its_range_evenly_and_is_continuous() {
        let values: Vec<f32> = (0..20_000).map(|i| noise(i as f32 * 0.37, i as f32 * 0.11, 5)).collect();
        let mean = values.iter().sum::<f32>() / values.len() as f32;
        assert!((mean - 0.5).abs() < 0.02, "{mean}");
        assert!(values.iter().all(|v| (0.0..=1.0).contains(v)));
        for i in 0..1000 {
            let x = i as f32 * 0.013;
            assert!((noise(x, 3.3, 1) - noise(x + 1e-3, 3.3, 1)).abs() < 5e-3);
        }
    }
}
