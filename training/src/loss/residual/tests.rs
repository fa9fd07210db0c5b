//! Residuals and their gradients in f64, where central differences are sharp.

use nalgebra::Vector6;
use proptest::prelude::*;

use super::super::pairs;
use super::*;

const FRAMES: usize = 5;

fn motions(relative: bool) -> Vec<Motion> {
    let pairs = pairs(FRAMES).into_iter();
    match relative {
        true => pairs.map(|(i, j)| Motion::Chain(i, j)).collect(),
        false => pairs.map(|(i, j)| Motion::Between(i, j)).chain((0..FRAMES).map(Motion::Absolute)).collect(),
    }
}

fn pose(size: f64) -> impl Strategy<Value = Pose> {
    prop::array::uniform6(-size..size).prop_map(|v| se3::exp(&se3::Tangent(Vector6::from(v))))
}

fn row(pose: &Pose, six: bool, length: f64) -> Vec<f64> {
    let translation = pose.translation.vector.iter().copied();
    let raw = match six {
        true => quaternion::to_6d(&pose.rotation).to_vec(),
        false => quaternion::xyzw(&pose.rotation).to_vec(),
    };
    translation.chain(raw.into_iter().map(|v| v * length)).collect()
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn gradients_are_central_differences(
        frames in prop::collection::vec(pose(1.0), 2 * FRAMES),
        truth in prop::collection::vec(pose(1.0), 2 * 12),
        (six, relative, log) in any::<(bool, bool, bool)>(),
        length in 0.5..2.0f64,
        weights in prop::collection::vec(-1.0..1.0f64, 2 * 12 * 7),
    ) {
        let motions = motions(relative);
        let space = if log { Space::Log } else { Space::Quaternion };
        let truths = truth[..2 * motions.len()].to_vec();
        let residuals = Residuals { space, frames: FRAMES, motions, truths };
        let rows: Vec<f64> = frames.iter().flat_map(|p| row(p, six, length)).collect();
        let row_length = if six { 9 } else { 7 };
        let values = residuals.values(&rows, row_length);
        // The logarithm jumps at half turns and so does the sign of a quaternion.
        let size = space.size();
        let near = |r: &[f64]| Vector3::new(r[3], r[4], r[5]).norm() < if log { 3.0 } else { 1.3 };
        prop_assume!(values.chunks(size).all(near));
        let weights = &weights[..values.len()];
        let ours = residuals.pull_back(&rows, row_length, weights);
        for i in 0..rows.len() {
            let moved = |step: f64| -> f64 {
                let mut rows = rows.clone();
                rows[i] += step;
                residuals.values(&rows, row_length).iter().zip(weights).map(|(v, w)| v * w).sum()
            };
            let numeric = (moved(1e-5) - moved(-1e-5)) / 2e-5;
            prop_assert!((ours[i] - numeric).abs() < 1e-5 * (1.0 + numeric.abs()), "number {i}: {} {numeric}", ours[i]);
        }
    }

    #[test]
    fn the_logarithm_is_the_repositorys(predicted in pose(3.0), truth in pose(3.0)) {
        let residuals = Residuals { space: Space::Log, frames: 1, motions: vec![Motion::Absolute(0)], truths: vec![truth] };
        let values = residuals.values(&row(&predicted, true, 1.0), 9);
        // Exp(residual) leads from the truth to the prediction.
        let back = truth.rotation * se3::so3_exp(&Vector3::new(values[3], values[4], values[5]));
        prop_assert!(back.angle_to(&predicted.rotation) < 1e-9);
        let length = Vector3::new(values[3], values[4], values[5]).norm();
        prop_assert!((length - truth.rotation.angle_to(&predicted.rotation)).abs() < 1e-9);
    }
}

#[test]
fn a_computed_quaternion_takes_the_sign_of_the_truth() {
    // Beyond the half turn the canonical quaternion has the other sign; the nearer one is compared. Both axes, because
    // reading a matrix prefers one of the two signs.
    for axis in [1.0, -1.0] {
        let turned = |angle: f64| Pose::new(Vector3::zeros(), Vector3::new(0.0, axis * angle, 0.0));
        let residuals = Residuals {
            space: Space::Quaternion,
            frames: 1,
            motions: vec![Motion::Absolute(0)],
            truths: vec![turned(3.1)],
        };
        let values = residuals.values(&row(&turned(3.2), true, 2.0), 9);
        let expected = 2.0 * (0.05_f64 / 2.0).sin();
        assert!((Vector4::from_column_slice(&values[3..]).norm() - expected).abs() < 1e-12, "{values:?}");
    }
}
