//! The motions that a loss compares with the truth, computed from the poses of a window, and their gradients.
//!
//! Gradients are taken about the fixed axes of the parent frame: `t + d_t`, `Exp(d_theta) R`.

use grnet_geometry::{Pose, se3};
use nalgebra::{UnitQuaternion, Vector3};

/// Which motion, from the K outputs `P_0 ... P_{K-1}` of one window.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Motion {
    /// `P_i`: an output as it stands.
    Absolute(usize),
    /// `P_i^-1 P_j`: from two absolute poses.
    Between(usize, usize),
    /// `P_{i+1} P_{i+2} ... P_j`: from the motions of the single steps, where `P_t` is camera_{t-1}_from_camera_t.
    Chain(usize, usize),
}

/// Derivative of a number with respect to a pose.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Gradient {
    pub(super) translation: Vector3<f64>,
    pub(super) rotation: Vector3<f64>,
}

impl Gradient {
    pub(super) const ZERO: Self =
        Self { translation: Vector3::new(0.0, 0.0, 0.0), rotation: Vector3::new(0.0, 0.0, 0.0) };

    fn add(&mut self, other: &Self) {
        self.translation += other.translation;
        self.rotation += other.rotation;
    }

    fn turned(&self, by: &UnitQuaternion<f64>) -> Self {
        Self { translation: by * self.translation, rotation: by * self.rotation }
    }
}

impl Motion {
    /// The motion.
    pub(super) fn of(self, frames: &[Pose]) -> Pose {
        match self {
            Self::Absolute(i) => frames[i],
            Self::Between(i, j) => se3::relative(&frames[i], &frames[j]),
            Self::Chain(i, j) => {
                frames[i + 1..=j].iter().fold(Pose::identity(), |motion, step| motion * step)
            }
        }
    }

    /// The frame whose output is the motion as it stands, without composition.
    pub(super) fn direct(self) -> Option<usize> {
        match self {
            Self::Absolute(i) => Some(i),
            Self::Chain(i, j) if j == i + 1 => Some(j),
            Self::Between(..) | Self::Chain(..) => None,
        }
    }

    /// Adds to `into`, one entry a frame, what the derivative with respect to the motion means for each frame.
    pub(super) fn pull_back(self, frames: &[Pose], gradient: &Gradient, into: &mut [Gradient]) {
        match self {
            Self::Absolute(i) => into[i].add(gradient),
            // t = R_i^T (t_j - t_i), R = R_i^T R_j:
            // d_t = R_i^T (d_t_j - d_t_i + (t_j - t_i) x d_theta_i), d_theta = R_i^T (d_theta_j - d_theta_i)
            Self::Between(i, j) => {
                let turned = gradient.turned(&frames[i].rotation);
                let lever = frames[j].translation.vector - frames[i].translation.vector;
                into[j].add(&turned);
                into[i].add(&Gradient {
                    translation: -turned.translation,
                    rotation: -turned.rotation - lever.cross(&turned.translation),
                });
            }
            Self::Chain(i, j) => {
                let mut gradient = *gradient;
                let prefixes: Vec<Pose> = frames[i + 1..=j]
                    .iter()
                    .scan(Pose::identity(), |motion, step| {
                        *motion *= step;
                        Some(*motion)
                    })
                    .collect();
                // T_m = T_{m-1} P_m: d_t = d_t_{m-1} + R_{m-1} d_t_m - (R_{m-1} t_m) x ... d_theta_{m-1},
                // d_theta = d_theta_{m-1} + R_{m-1} d_theta_m
                for m in (i + 2..=j).rev() {
                    let before = &prefixes[m - i - 2];
                    into[m].add(&gradient.turned(&before.rotation.inverse()));
                    let lever = before.rotation * frames[m].translation.vector;
                    gradient.rotation += lever.cross(&gradient.translation);
                }
                into[i + 1].add(&gradient);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use grnet_geometry::covariance::perturb;
    use grnet_geometry::se3::Tangent;
    use nalgebra::Vector6;
    use proptest::prelude::*;

    fn pose() -> impl Strategy<Value = Pose> {
        prop::array::uniform6(-2.0..2.0f64).prop_map(|v| se3::exp(&Tangent(Vector6::from(v))))
    }

    fn motion() -> impl Strategy<Value = Motion> {
        (0..3_usize, 0..4_usize, 1..5_usize).prop_map(|(kind, i, span): (usize, usize, usize)| {
            let j = (i + span).min(4);
            [Motion::Absolute(i), Motion::Between(i, j), Motion::Chain(i, j)][kind]
        })
    }

    proptest! {
        #[test]
        fn a_chain_of_steps_is_the_motion_between_the_ends(frames in prop::collection::vec(pose(), 5)) {
            let steps: Vec<Pose> = (0..5)
                .map(|t| if t == 0 { frames[0] } else { se3::relative(&frames[t - 1], &frames[t]) })
                .collect();
            for (i, j) in super::super::pairs(5) {
                let (chain, between) = (Motion::Chain(i, j).of(&steps), Motion::Between(i, j).of(&frames));
                let error = grnet_geometry::covariance::error(&chain, &between);
                prop_assert!(error.0.norm() < 1e-12, "{i} {j}: {error:?}");
                // camera_i_from_camera_j of the repository.
                let expected = frames[i].inverse() * frames[j];
                prop_assert!(grnet_geometry::covariance::error(&chain, &expected).0.norm() < 1e-12);
            }
        }

        #[test]
        fn gradients_are_central_differences(
            frames in prop::collection::vec(pose(), 5),
            motion in motion(),
            weights in prop::array::uniform6(-1.0..1.0f64),
        ) {
            let weights = Tangent(Vector6::from(weights));
            let here = motion.of(&frames);
            let mut gradients = [Gradient::ZERO; 5];
            let gradient = Gradient { translation: weights.translation(), rotation: weights.rotation() };
            motion.pull_back(&frames, &gradient, &mut gradients);
            for frame in 0..5 {
                for axis in 0..6 {
                    let moved = |step: f64| {
                        let mut frames = frames.clone();
                        let mut error = Vector6::zeros();
                        error[axis] = step;
                        frames[frame] = perturb(&frames[frame], &Tangent(error));
                        weights.0.dot(&grnet_geometry::covariance::error(&here, &motion.of(&frames)).0)
                    };
                    let numeric = (moved(1e-5) - moved(-1e-5)) / 2e-5;
                    let g = &gradients[frame];
                    let ours = if axis < 3 { g.translation[axis] } else { g.rotation[axis - 3] };
                    prop_assert!((ours - numeric).abs() < 1e-6, "{motion:?} frame {frame} axis {axis}: {ours} {numeric}");
                }
            }
        }
    }

    #[test]
    fn a_quarter_turn_then_a_step_by_hand() {
        // One metre along x, turned to the left by 90 degrees about z; then one metre along the new x.
        let step =
            Pose::new(Vector3::new(1.0, 0.0, 0.0), Vector3::new(0.0, 0.0, std::f64::consts::FRAC_PI_2));
        let motion = Motion::Chain(0, 2).of(&[Pose::identity(), step, step]);
        assert!((motion.translation.vector - Vector3::new(1.0, 1.0, 0.0)).norm() < 1e-15);
        assert!((motion.rotation.angle() - std::f64::consts::PI).abs() < 1e-12);
    }
}
