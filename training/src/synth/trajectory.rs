//! Smooth paths of a hand-held camera.
//!
//! A path is a uniform cubic B-spline over (x, y, z, yaw, pitch, roll) plus a second, finer one for the tremor of
//! a hand. Such a spline stays in the hull of its control points and its derivative in the hull of their
//! differences, so limits on the steps between control points are limits on speed, held everywhere.

use nalgebra::Isometry3;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::SynthError;
use super::scene::Scene;
use super::volume::{Volume, pose_of};

/// Time between control points of the path and of the tremor, in seconds.
const KNOT_S: f64 = 0.5;
const TREMOR_KNOT_S: f64 = 0.125;
/// Half the range of the tremor, in metres and radians: adds at most 0.07 m/s and 4 degrees/s.
const TREMOR_M: f64 = 0.0025;
const TREMOR_RAD: f64 = 0.0014;
/// Time that the path goes on before its first and after its last frame, for shutters.
const RIM_S: f64 = 0.25;
/// Fastest and slowest leg, m/s.
const SPEED_MPS: (f64, f64) = (0.2, 0.42);
/// Largest rate of yaw, pitch and roll, rad/s: with the tremor 40 degrees/s together.
const RATE_RADPS: [f64; 3] = [0.45, 0.11, 0.05];
/// Steps tried before the search gives up, per control point.
const TRIES: u32 = 400;

/// Which path to take.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PathOptions {
    /// Seed of all sequences.
    pub seed: u64,
    /// Number of the sequence: each is another path through the same room.
    pub sequence: u32,
    /// Number of frames.
    pub frames: u32,
    /// Frames per second.
    pub rate_hz: f64,
}

/// A path through a room: at most 0.5 m/s and 40 degrees/s, never nearer to furniture than its volume allows.
#[derive(Debug, Clone)]
pub struct Trajectory {
    path: Vec<[f64; 6]>,
    tremor: Vec<[f64; 6]>,
    gains: Vec<[f64; 1]>,
    options: PathOptions,
}

impl Trajectory {
    /// Finds a path.
    ///
    /// # Errors
    /// [`SynthError::NoPath`] when the volume leaves no way through.
    pub fn generate(scene: &Scene, volume: &Volume, options: PathOptions) -> Result<Self, SynthError> {
        // Another room, another walk: equal seeds shall not give equal poses in different places.
        let room = scene.options().room;
        let mut rng = ChaCha8Rng::seed_from_u64(options.seed ^ room.wrapping_mul(0x9E37_79B9_7F4A_7C15));
        rng.set_stream(u64::from(options.sequence) + 1);
        let duration_s = f64::from(options.frames) / options.rate_hz + 2.0 * RIM_S;
        let count = |knot_s: f64| (duration_s / knot_s).ceil() as usize + 4;
        let path = find_path(scene, volume, options, count(KNOT_S), &mut rng)?;
        let tremor = (0..count(TREMOR_KNOT_S))
            .map(|_| {
                [TREMOR_M, TREMOR_M, TREMOR_M, TREMOR_RAD, TREMOR_RAD, TREMOR_RAD]
                    .map(|a| a * rng.random_range(-1.0..1.0))
            })
            .collect();
        let gains = (0..count(KNOT_S)).map(|_| [rng.random_range(0.8..1.25)]).collect();
        Ok(Self { path, tremor, gains, options })
    }

    /// `world_from_camera` at `time_s` after the first frame; defined 0.2 s beyond both ends.
    pub fn world_from_camera(&self, time_s: f64) -> Isometry3<f64> {
        let path = spline(&self.path, (time_s + RIM_S) / KNOT_S);
        let tremor = spline(&self.tremor, (time_s + RIM_S) / TREMOR_KNOT_S);
        pose_of(&std::array::from_fn(|k| path[k] + tremor[k]))
    }

    /// Exposure relative to the sensor's normal at `time_s`: drifts slowly within 0.8 and 1.25.
    pub fn gain(&self, time_s: f64) -> f32 {
        spline(&self.gains, (time_s + RIM_S) / KNOT_S)[0] as f32
    }

    /// Time of frame `index` after the first, in seconds.
    pub fn time_s(&self, index: u32) -> f64 {
        f64::from(index) / self.options.rate_hz
    }

    /// What it was made from.
    pub fn options(&self) -> PathOptions {
        self.options
    }
}

fn find_path(
    scene: &Scene,
    volume: &Volume,
    options: PathOptions,
    count: usize,
    rng: &mut ChaCha8Rng,
) -> Result<Vec<[f64; 6]>, SynthError> {
    let mut path: Vec<[f64; 6]> = Vec::with_capacity(count);
    let mut goal = volume.draw(rng, TREMOR_RAD);
    let (mut speed, mut failures, mut tries) = (0.3, 0, 0);
    let budget = TRIES * count as u32;
    while path.len() < count {
        tries += 1;
        if tries > budget {
            let (room, volume) = (scene.options().room, volume.kind.name());
            return Err(SynthError::NoPath {
                room,
                volume,
                seed: options.seed,
                sequence: options.sequence,
                tries,
            });
        }
        let next = path.last().map_or(goal, |last| step(last, &goal, speed));
        path.push(next);
        if way_is_free(scene, volume, &path) {
            failures = 0;
            let left: f64 = (0..3).map(|k| (goal[k] - next[k]) * (goal[k] - next[k])).sum();
            if left > 0.02 {
                continue;
            }
        } else {
            path.pop();
            failures += 1;
            if failures % 30 == 0 {
                // A dead end: go back a few seconds and leave it another way.
                path.truncate(path.len().saturating_sub(failures / 5));
            }
        }
        let last_yaw = path.last().map(|p| p[3]);
        goal = volume.draw(rng, TREMOR_RAD);
        if let (None, Some(yaw)) = (volume.yaw_rad, last_yaw) {
            goal[3] += yaw;
        }
        speed = rng.random_range(SPEED_MPS.0..SPEED_MPS.1);
    }
    Ok(path)
}

/// The next control point on the way from `last` to `goal`, within the limits of speed.
fn step(last: &[f64; 6], goal: &[f64; 6], speed_mps: f64) -> [f64; 6] {
    let to: [f64; 6] = std::array::from_fn(|k| goal[k] - last[k]);
    let distance = (to[0] * to[0] + to[1] * to[1] + to[2] * to[2]).sqrt();
    let share = (speed_mps * KNOT_S / distance.max(1e-9)).min(1.0);
    std::array::from_fn(|k| match k {
        0..3 => last[k] + to[k] * share,
        _ => {
            let most = RATE_RADPS[k - 3] * KNOT_S;
            last[k] + to[k].clamp(-most, most)
        }
    })
}

/// Whether the newest stretch of the spline keeps clear of everything.
fn way_is_free(scene: &Scene, volume: &Volume, path: &[[f64; 6]]) -> bool {
    // The tremor and the gaps between samples (2 cm at most) may take this much of the clearance.
    const SLACK_M: f64 = 0.03;
    let strict = Volume {
        clearance_m: volume.clearance_m + SLACK_M,
        view_m: volume.view_m + SLACK_M,
        ..volume.clone()
    };
    let Some(last) = path.last() else { return true };
    if path.len() < 4 {
        return strict.allows(scene, last);
    }
    let start = (path.len() - 4) as f64;
    (0..=10).all(|i| strict.allows(scene, &spline(path, start + f64::from(i) / 10.0 * 0.999_999)))
}

/// Uniform cubic B-spline at `s` knots after its start.
fn spline<const N: usize>(knots: &[[f64; N]], s: f64) -> [f64; N] {
    let i = (s.max(0.0) as usize).min(knots.len() - 4);
    let t = s - i as f64;
    let (t2, t3) = (t * t, t * t * t);
    let weights = [
        (1.0 - 3.0 * t + 3.0 * t2 - t3) / 6.0,
        (4.0 - 6.0 * t2 + 3.0 * t3) / 6.0,
        (1.0 + 3.0 * t + 3.0 * t2 - 3.0 * t3) / 6.0,
        t3 / 6.0,
    ];
    std::array::from_fn(|k| (0..4).map(|j| weights[j] * knots[i + j][k]).sum())
}
