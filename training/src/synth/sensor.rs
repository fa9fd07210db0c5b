//! From light to bytes: exposure, vignetting, blur, noise and the sRGB curve.

use std::sync::LazyLock;

use super::numeric::{Vec3, hash, srgb_encode, unit};
use super::render::RenderTarget;

/// Code values by linear light.
static CURVE: LazyLock<Vec<u8>> = LazyLock::new(|| {
    (0..=CURVE_STEPS).map(|i| (srgb_encode(i as f64 / CURVE_STEPS as f64) * 255.0 + 0.5) as u8).collect()
});
const CURVE_STEPS: usize = 8192;
/// Exposure at gain 1: mean light on a white wall comes out at this share of the sensor's range.
const EXPOSURE: f32 = 0.62;
/// Electrons of a full pixel.
const FULL_WELL: f32 = 7000.0;
/// Standard deviation of the read noise, in electrons.
const READ_NOISE: f32 = 9.0;

/// How the sensor spoils the picture.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct SensorOptions {
    /// Strength of shot and read noise: 1 is a webcam, 0 none.
    pub noise: f32,
    /// Share of light that the corners lose.
    pub vignetting: f32,
    /// Share of light that a pixel gives to each of its neighbours left, right, above and below.
    pub blur: f32,
    /// Whether exposure drifts and white balance differs between sequences.
    pub vary_exposure: bool,
}

impl Default for SensorOptions {
    fn default() -> Self {
        Self { noise: 1.0, vignetting: 0.22, blur: 0.07, vary_exposure: true }
    }
}

impl SensorOptions {
    /// An ideal sensor.
    pub fn clean() -> Self {
        Self { noise: 0.0, vignetting: 0.0, blur: 0.0, vary_exposure: false }
    }
}

/// Which frame's noise to take: equal keys give equal noise.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct FrameKey {
    /// Seed of the recording.
    pub seed: u64,
    /// Number of the sequence.
    pub sequence: u32,
    /// Number of the frame within it.
    pub index: u32,
}

/// A sensor.
#[derive(Debug, Clone, Copy, Default)]
pub struct Sensor {
    /// Its faults.
    pub options: SensorOptions,
}

impl Sensor {
    /// Develops a rendered view to packed 8-bit sRGB, row by row, at `gain` times the normal exposure (ignored
    /// without [`SensorOptions::vary_exposure`]). `rgb` is cleared first and can be used again.
    pub fn develop(&self, target: &RenderTarget, key: FrameKey, gain: f32, rgb: &mut Vec<u8>) {
        let options = self.options;
        let (width, height) = target.size_px();
        let recording = hash(key.seed as u32, (key.seed >> 32) as u32, key.sequence);
        let frame = hash(recording, key.index, 0x5EED);
        let mut exposure = [EXPOSURE; 3];
        if options.vary_exposure {
            let balance = |n: u32| 1.0 + 0.05 * (unit(hash(recording, n, 0xBA1)) - 0.5);
            exposure = [EXPOSURE * gain * balance(0), EXPOSURE * gain, EXPOSURE * gain * balance(1)];
        }
        let (cx, cy) = ((width as f32 - 1.0) / 2.0, (height as f32 - 1.0) / 2.0);
        let corner = 1.0 / (cx * cx + cy * cy).max(1.0);
        rgb.clear();
        rgb.reserve(width * height * 3);
        for y in 0..height {
            for x in 0..width {
                let (dx, dy) = (x as f32 - cx, y as f32 - cy);
                let lens = 1.0 - options.vignetting * (dx * dx + dy * dy) * corner;
                let light = spread(target, x, y, options.blur);
                let pixel = (y * width + x) as u32;
                for k in 0..3 {
                    let signal = light[k] * exposure[k] * lens;
                    let spoilt = noisy(signal, options.noise, hash(frame, pixel, k as u32));
                    let step = (spoilt.clamp(0.0, 1.0) * CURVE_STEPS as f32 + 0.5) as usize;
                    rgb.push(CURVE[step]);
                }
            }
        }
    }
}

/// Light of a pixel and, by the lens' blur, of its neighbours.
fn spread(target: &RenderTarget, x: usize, y: usize, share: f32) -> Vec3 {
    let (width, height) = target.size_px();
    let own = target.radiance[y * width + x];
    if share <= 0.0 {
        return own;
    }
    let at = |x: usize, y: usize| target.radiance[y * width + x];
    let neighbours = [
        at(x.saturating_sub(1), y),
        at((x + 1).min(width - 1), y),
        at(x, y.saturating_sub(1)),
        at(x, (y + 1).min(height - 1)),
    ];
    [0, 1, 2].map(|k| {
        let around: f32 = neighbours.iter().map(|c| c[k]).sum();
        own[k] * (1.0 - 4.0 * share) + around * share
    })
}

/// Signal with shot and read noise of nearly normal distribution: the sum of four even bytes.
fn noisy(signal: f32, strength: f32, bits: u32) -> f32 {
    if strength <= 0.0 {
        return signal;
    }
    let sum: u32 = bits.to_le_bytes().iter().map(|b| u32::from(*b)).sum();
    let normal = (sum as f32 - 510.0) * (1.0 / 147.8);
    let electrons = signal.clamp(0.0, 1.5) * FULL_WELL;
    signal + strength * normal * (electrons + READ_NOISE * READ_NOISE).sqrt() * (1.0 / FULL_WELL)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn noise_has_the_spread_of_shot_and_read_noise() {
        let n = 40_000;
        for signal in [0.0f32, 0.2, 0.8] {
            let values: Vec<f32> = (0..n).map(|i| noisy(signal, 1.0, hash(i, 3, 1)) - signal).collect();
            let mean = values.iter().sum::<f32>() / n as f32;
            let variance = values.iter().map(|v| (v - mean) * (v - mean)).sum::<f32>() / n as f32;
            let expected = (signal * FULL_WELL + READ_NOISE * READ_NOISE).sqrt() / FULL_WELL;
            assert!(mean.abs() < 0.05 * expected, "mean {mean} at {signal}");
            assert!((variance.sqrt() / expected - 1.0).abs() < 0.03, "spread at {signal}");
        }
    }
}
