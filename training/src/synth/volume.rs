//! Where a camera may be and where it may look.

use std::f64::consts::PI;

use nalgebra::{Isometry3, Matrix3, Rotation3, Translation3, UnitQuaternion};
use rand::Rng;
use rand_chacha::ChaCha8Rng;

use super::numeric::sin_cos;
use super::scene::Scene;

/// The two volumes that the experiments compare.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum VolumeKind {
    /// 1.5 x 1.5 x 0.4 m and yaw +-40 degrees, as in 7-Scenes.
    Handheld,
    /// The whole room and any yaw.
    Room,
}

/// Limits of a camera's place and view in a room.
#[derive(Debug, Clone, PartialEq)]
pub struct Volume {
    /// Which of the two.
    pub kind: VolumeKind,
    /// Middle of the box of places, metres, in the world.
    pub centre_m: [f64; 3],
    /// Half its extent in x, y and z.
    pub half_m: [f64; 3],
    /// Middle and half width of the range of yaw; `None`: any.
    pub yaw_rad: Option<(f64, f64)>,
    /// Lowest and highest pitch, up positive.
    pub pitch_rad: (f64, f64),
    /// Largest roll to either side.
    pub roll_rad: f64,
    /// Least distance from walls and furniture.
    pub clearance_m: f64,
    /// Least distance of what the image's middle shows.
    pub view_m: f64,
}

impl VolumeKind {
    /// Its name on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Self::Handheld => "handheld",
            Self::Room => "room",
        }
    }
}

impl Volume {
    /// The volume of this kind in a room; the hand-held one looks towards most of the room's pictures.
    pub fn of(scene: &Scene, kind: VolumeKind) -> Self {
        let degrees = PI / 180.0;
        match kind {
            VolumeKind::Handheld => Self {
                kind,
                centre_m: [0.0, 0.0, 1.45],
                half_m: [0.75, 0.75, 0.2],
                yaw_rad: Some((picture_side(scene), 40.0 * degrees)),
                pitch_rad: (-24.0 * degrees, 8.0 * degrees),
                roll_rad: 5.0 * degrees,
                clearance_m: 0.3,
                view_m: 0.7,
            },
            VolumeKind::Room => {
                let [w, d, _] = scene.size_m().map(f64::from);
                Self {
                    kind,
                    centre_m: [0.0, 0.0, 1.4],
                    half_m: [w / 2.0 - 0.4, d / 2.0 - 0.4, 0.3],
                    yaw_rad: None,
                    pitch_rad: (-26.0 * degrees, 10.0 * degrees),
                    roll_rad: 5.0 * degrees,
                    clearance_m: 0.35,
                    view_m: 0.8,
                }
            }
        }
    }

    /// Whether the camera has room at (x, y, z, yaw, pitch, roll) and something to see.
    pub fn allows(&self, scene: &Scene, place: &[f64; 6]) -> bool {
        let p = [place[0] as f32, place[1] as f32, place[2] as f32];
        if f64::from(scene.geometry().clearance_m(p)) < self.clearance_m {
            return false;
        }
        let forward = pose_of(place).rotation.to_rotation_matrix() * nalgebra::Vector3::z();
        let ahead = scene.geometry().trace_all(p, [forward.x as f32, forward.y as f32, forward.z as f32]);
        f64::from(ahead.t) >= self.view_m
    }

    /// An allowed `world_from_camera`, evenly spread over the volume.
    pub fn random_pose(&self, scene: &Scene, rng: &mut ChaCha8Rng) -> Isometry3<f64> {
        loop {
            let place = self.draw(rng, 0.0);
            if self.allows(scene, &place) {
                return pose_of(&place);
            }
        }
    }

    /// A place and view at random, allowed or not, `margin_rad` inside the range of angles; without a limit
    /// the yaw lies within half a turn of 0.
    pub(crate) fn draw(&self, rng: &mut ChaCha8Rng, margin_rad: f64) -> [f64; 6] {
        let (yaw, spread) = self.yaw_rad.map_or((0.0, PI), |(yaw, spread)| (yaw, spread - margin_rad));
        let around =
            |rng: &mut ChaCha8Rng, centre: f64, half: f64| centre + half * rng.random_range(-1.0..1.0);
        let (low, high) = (self.pitch_rad.0 + margin_rad, self.pitch_rad.1 - margin_rad);
        [
            around(rng, self.centre_m[0], self.half_m[0]),
            around(rng, self.centre_m[1], self.half_m[1]),
            around(rng, self.centre_m[2], self.half_m[2]),
            around(rng, yaw, spread),
            around(rng, (low + high) / 2.0, (high - low) / 2.0),
            around(rng, 0.0, self.roll_rad - margin_rad),
        ]
    }
}

/// `world_from_camera` of (x, y, z, yaw, pitch, roll): yaw about the world's z from its x axis, pitch upwards,
/// roll clockwise about the optical axis.
pub(crate) fn pose_of(place: &[f64; 6]) -> Isometry3<f64> {
    let [x, y, z, yaw, pitch, roll] = *place;
    let ((sy, cy), (sp, cp), (sr, cr)) = (sin_cos(yaw), sin_cos(pitch), sin_cos(roll));
    let forward = nalgebra::Vector3::new(cy * cp, sy * cp, sp);
    let level = nalgebra::Vector3::new(sy, -cy, 0.0);
    let down = forward.cross(&level);
    let (right, down) = (level * cr + down * sr, down * cr - level * sr);
    let rotation = Rotation3::from_matrix_unchecked(Matrix3::from_columns(&[right, down, forward]));
    let turned = UnitQuaternion::new_normalize(UnitQuaternion::from_rotation_matrix(&rotation).into_inner());
    Isometry3::from_parts(Translation3::new(x, y, z), turned)
}

/// The one of eight directions with most pictures within 45 degrees of it.
fn picture_side(scene: &Scene) -> f64 {
    let count = |k: i32| {
        let (sin, cos) = sin_cos(f64::from(k) * PI / 4.0);
        let ahead = |p: &[f64; 3]| {
            let along = p[0] * cos + p[1] * sin;
            along > (p[1] * cos - p[0] * sin).abs()
        };
        scene.landmarks().iter().filter(|l| ahead(&l.point_in_world)).count()
    };
    let best = (0..8).rev().max_by_key(|k| count(*k)).unwrap_or(0);
    f64::from(best) * PI / 4.0
}
