//! What is drawn for one window.

use nalgebra::{Quaternion, UnitQuaternion, Vector3};
use rand::Rng;
use rand_chacha::ChaCha8Rng;

use super::AugmentOptions;
use crate::synth::numeric::sin_cos;

/// Steps of the tone curves between two byte values.
pub(super) const STEPS_PER_BYTE: usize = 4;

/// Everything that happens to a window's frames.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Augmentation {
    /// `camera_from_rotated` of each frame; `None`: the camera stays as it is.
    pub rotations: Option<Vec<UnitQuaternion<f64>>>,
    /// `None`: the picture stays as it is.
    pub look: Option<Look>,
}

/// What happens to the picture.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Look {
    /// New values 0..255 of red, green and blue by old ones in steps of 1/[`STEPS_PER_BYTE`].
    pub curves: [Vec<f32>; 3],
    pub saturation: f32,
    /// Side (odd) and weights, row by row, of the blur.
    pub kernel: Option<(usize, Vec<f32>)>,
    /// Standard deviation of the noise in 0..255.
    pub noise: f32,
    pub frames: Vec<FrameLook>,
}

/// What happens to one frame.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct FrameLook {
    pub gain: f32,
    pub erased: Option<Erased>,
    pub noise_seed: u64,
}

/// A covered rectangle, in shares of the image.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Erased {
    /// Left, top, width, height.
    pub area: [f64; 4],
    /// 0..255.
    pub colour: [f32; 3],
}

impl Augmentation {
    /// Nothing happens.
    pub fn none() -> Self {
        Self { rotations: None, look: None }
    }

    /// Draws for a window of `k` frames.
    pub fn draw(options: &AugmentOptions, k: usize, rng: &mut ChaCha8Rng) -> Self {
        if rng.random::<f64>() < options.plain_share {
            return Self::none();
        }
        let rotations = options.rotates().then(|| {
            let all = rotation(options.rotation_deg, rng);
            (0..k).map(|_| all * rotation(options.frame_rotation_deg, rng)).collect()
        });
        let off = AugmentOptions {
            plain_share: options.plain_share,
            rotation_deg: options.rotation_deg,
            frame_rotation_deg: options.frame_rotation_deg,
            border: options.border,
            ..AugmentOptions::default()
        };
        let look = (*options != off).then(|| Look::draw(options, k, rng));
        Self { rotations, look }
    }
}

impl Look {
    fn draw(options: &AugmentOptions, k: usize, rng: &mut ChaCha8Rng) -> Self {
        let brightness = options.brightness * rng.random_range(-1.0..=1.0);
        let contrast = factor(options.contrast, rng);
        let gamma = factor(options.gamma, rng);
        let saturation = factor(options.saturation, rng) as f32;
        let gains = [0; 3].map(|_| factor(options.colour, rng));
        let last = 255 * STEPS_PER_BYTE;
        let tone: Vec<f64> = (0..=last)
            .map(|step| {
                let bent = libm::pow(step as f64 / last as f64, gamma);
                (bent - 0.5) * contrast + 0.5 + brightness
            })
            .collect();
        let curves = gains.map(|gain| tone.iter().map(|value| (value * gain * 255.0) as f32).collect());
        let noise = (options.noise * 255.0 * rng.random::<f64>()) as f32;
        let blurred = rng.random::<f64>() < options.blur_share;
        let (sigma_px, length_px) =
            (options.blur_px * rng.random::<f64>(), options.motion_blur_px * rng.random::<f64>());
        let turn = rng.random::<f64>() * std::f64::consts::PI;
        let kernel = (blurred && (options.blur_px > 0.0 || options.motion_blur_px > 0.0))
            .then(|| blur(sigma_px, length_px, turn));
        let frames = (0..k).map(|_| FrameLook::draw(options, rng)).collect();
        Self { curves, saturation, kernel, noise, frames }
    }
}

impl FrameLook {
    fn draw(options: &AugmentOptions, rng: &mut ChaCha8Rng) -> Self {
        let gain = factor(options.frame_gain, rng) as f32;
        let noise_seed = rng.random();
        let erases = rng.random::<f64>() < options.erase_share;
        let area = options.erase_area * rng.random::<f64>();
        let aspect = factor(1.0, rng).sqrt();
        let [width, height] = [area.sqrt() * aspect, area.sqrt() / aspect].map(|side| side.min(1.0));
        let (left, top) = (rng.random::<f64>() * (1.0 - width), rng.random::<f64>() * (1.0 - height));
        let colour = [0; 3].map(|_| rng.random_range(0.0..255.0));
        let erased = erases.then_some(Erased { area: [left, top, width, height], colour });
        Self { gain, erased, noise_seed }
    }
}

/// A factor between 1/(1 + most) and 1 + most, to either side equally often.
fn factor(most: f64, rng: &mut ChaCha8Rng) -> f64 {
    let x = most * rng.random_range(-1.0..=1.0);
    if x >= 0.0 { 1.0 + x } else { 1.0 / (1.0 - x) }
}

/// About any axis, by up to `most_deg`.
fn rotation(most_deg: f64, rng: &mut ChaCha8Rng) -> UnitQuaternion<f64> {
    let axis = loop {
        let axis = Vector3::from_fn(|_, _| rng.random_range(-1.0..1.0));
        let square: f64 = axis.norm_squared();
        if (0.01..=1.0).contains(&square) {
            break axis / square.sqrt();
        }
    };
    // The library's own sine differs between machines in the last bit.
    let (sin, cos) = sin_cos(rng.random::<f64>() * most_deg * (std::f64::consts::PI / 360.0));
    UnitQuaternion::new_normalize(Quaternion::from_parts(cos, axis * sin))
}

/// Side and weights of a Gaussian-like blur along a line.
fn blur(sigma_px: f64, length_px: f64, turn_rad: f64) -> (usize, Vec<f32>) {
    // [a, 1 - 2a, a] has the variance 2a; two of them make five taps of the variance sigma^2.
    let a = sigma_px * sigma_px / 4.0;
    let three = [a, 1.0 - 2.0 * a, a];
    let mut five = [0.0; 5];
    for (i, x) in three.iter().enumerate() {
        for (j, y) in three.iter().enumerate() {
            five[i + j] += x * y;
        }
    }
    let reach = 3 + (length_px / 2.0).ceil() as usize;
    let side = 2 * reach + 1;
    let mut weights = vec![0.0f64; side * side];
    let (sin, cos) = sin_cos(turn_rad);
    const POINTS: usize = 9;
    for point in 0..POINTS {
        let along = (point as f64 / (POINTS - 1) as f64 - 0.5) * length_px;
        let (x, y) = (reach as f64 + along * cos, reach as f64 + along * sin);
        let (left, top) = (x.floor(), y.floor());
        for (corner_y, share_y) in [(top, 1.0 - (y - top)), (top + 1.0, y - top)] {
            for (corner_x, share_x) in [(left, 1.0 - (x - left)), (left + 1.0, x - left)] {
                for (dy, wy) in five.iter().enumerate() {
                    for (dx, wx) in five.iter().enumerate() {
                        let (column, row) = (corner_x as usize + dx - 2, corner_y as usize + dy - 2);
                        if column < side && row < side {
                            weights[row * side + column] += share_x * share_y * wx * wy / POINTS as f64;
                        }
                    }
                }
            }
        }
    }
    let sum: f64 = weights.iter().sum();
    (side, weights.into_iter().map(|w| (w / sum) as f32).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::data::window::{Purpose, generator};

    fn draw(options: &AugmentOptions, index: u64) -> Augmentation {
        Augmentation::draw(options, 4, &mut generator(1, Purpose::Augment, index))
    }

    #[test]
    fn nothing_is_drawn_from_options_that_are_off() {
        assert_eq!(draw(&AugmentOptions::default(), 0), Augmentation::none());
        let turning = AugmentOptions { rotation_deg: 5.0, ..AugmentOptions::default() };
        let drawn = draw(&turning, 0);
        assert!(drawn.look.is_none());
        let rotations = drawn.rotations.unwrap();
        assert!(rotations.iter().all(|r| *r == rotations[0]), "one rotation for the window");
    }

    #[test]
    fn rotations_have_their_range_in_every_direction() {
        let options =
            AugmentOptions { rotation_deg: 10.0, frame_rotation_deg: 2.0, ..AugmentOptions::default() };
        let (mut largest, mut apart, mut sum) = (0.0f64, 0.0f64, Vector3::zeros());
        for index in 0..2000 {
            let rotations = draw(&options, index).rotations.unwrap();
            largest = largest.max(rotations[0].angle().to_degrees());
            apart = apart.max(rotations[0].angle_to(&rotations[3]).to_degrees());
            sum += rotations[0].scaled_axis();
        }
        assert!((10.0..=12.0).contains(&largest) && (3.0..=4.0).contains(&apart), "{largest} {apart}");
        assert!((sum / 2000.0).norm().to_degrees() < 0.5, "no direction is preferred");
    }

    #[test]
    fn a_blur_has_the_spread_asked_for_and_keeps_the_light() {
        for (sigma, length, turn) in [(0.8, 0.0, 0.3), (0.0, 3.0, 0.0), (0.5, 2.0, 1.0)] {
            let (side, weights) = blur(sigma, length, turn);
            let mean = (side - 1) as f64 / 2.0;
            let moment = |along: (f64, f64)| -> f64 {
                let at = |i: usize| {
                    let (x, y) = ((i % side) as f64 - mean, (i / side) as f64 - mean);
                    (x * along.0 + y * along.1).powi(2)
                };
                weights.iter().enumerate().map(|(i, w)| f64::from(*w) * at(i)).sum()
            };
            let sum: f64 = weights.iter().map(|w| f64::from(*w)).sum();
            assert!((sum - 1.0).abs() < 1e-6);
            // Nine even points on a line of length l have the variance l^2 / 12 * 10/8, linear splatting adds up to 1/4.
            let (along, across) = (moment((turn.cos(), turn.sin())), moment((-turn.sin(), turn.cos())));
            let line = length * length / 12.0 * 1.25;
            assert!((-1e-6..0.26).contains(&(along - sigma * sigma - line)), "{along}");
            assert!((-1e-6..0.26).contains(&(across - sigma * sigma)), "{across}");
        }
    }

    #[test]
    fn some_windows_stay_plain() {
        let options = AugmentOptions { plain_share: 0.25, ..AugmentOptions::recorded() };
        let plain = (0..2000).filter(|i| draw(&options, *i) == Augmentation::none()).count();
        assert!((420..580).contains(&plain), "{plain}");
    }
}
