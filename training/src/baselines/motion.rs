//! Relative motion that needs no image: none, or that of the frames before again.

use grnet_geometry::se3;

use super::{Predictions, Task};

/// The camera stands still: `previous_from_current` is the identity, for every test frame whose block reaches `gap`
/// frames back.
pub fn zero(task: &Task, gap: usize) -> Predictions {
    let mut motions = vec![None; task.test.len()];
    for (_, current) in task.pairs(gap) {
        motions[current] = Some(grnet_geometry::Pose::identity());
    }
    motions
}

/// The camera goes on as it truly did over the last `gap` frames: the motion of frame `i` from frame `i - gap` is that
/// of `i - gap` from `i - 2 gap`, for every test frame whose block reaches that far back.
///
/// It knows true poses of test frames, which no method may, and is hard to beat on smooth paths.
pub fn constant_velocity(task: &Task, gap: usize) -> Predictions {
    let mut motions = vec![None; task.test.len()];
    for (earlier, current) in task.pairs(2 * gap) {
        let pose = |i: usize| task.test[i].world_from_camera.as_ref();
        motions[current] = pose(earlier).zip(pose(earlier + gap)).map(|(a, b)| se3::relative(a, b));
    }
    motions
}

#[cfg(test)]
mod tests {
    use super::super::task::tests::view;
    use super::*;

    #[test]
    fn motion_stays_within_its_block() {
        let positions = [0.0, 1.0, 2.0, 4.0, 7.0];
        let mut test: Vec<_> = (0..5).map(|i| view(0, i, positions[i as usize], 0.0)).collect();
        test.push(view(0, 9, 50.0, 0.0));
        let task = Task::new(vec![], test);
        let x = |motions: Predictions| -> Vec<_> {
            motions.into_iter().map(|pose| pose.map(|p| p.translation.vector.x)).collect()
        };
        assert_eq!(x(zero(&task, 2)), [None, None, Some(0.0), Some(0.0), Some(0.0), None]);
        assert_eq!(x(constant_velocity(&task, 1)), [None, None, Some(1.0), Some(1.0), Some(2.0), None]);
        assert_eq!(x(constant_velocity(&task, 2)), [None, None, None, None, Some(2.0), None]);
    }

    #[test]
    fn motion_is_seen_from_the_earlier_camera() {
        // Each step: 1 m along the camera's own x axis, then a quarter turn.
        let mut pose = grnet_geometry::Pose::identity();
        let step = grnet_geometry::Pose::new(
            nalgebra::Vector3::x(),
            nalgebra::Vector3::y() * std::f64::consts::FRAC_PI_2,
        );
        let mut test = Vec::new();
        for i in 0..4 {
            test.push(super::super::View { world_from_camera: Some(pose), ..view(0, i, 0.0, 0.0) });
            pose *= step;
        }
        for motion in constant_velocity(&Task::new(vec![], test), 1).into_iter().flatten() {
            assert!((motion.to_homogeneous() - step.to_homogeneous()).amax() < 1e-12);
        }
    }
}
