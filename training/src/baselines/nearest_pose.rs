//! The training pose nearest to the true one: no retrieval can do better than this oracle.

use grnet_geometry::{Pose, se3};
use rayon::prelude::*;

use super::{BaselineError, Predictions, Task};

/// Distance at which 1 cm counts as much as 1 degree, the ratio of the usual 5 cm / 5 deg threshold.
///
/// Position alone would choose images that look the other way, rotation alone images from the other end of the room.
pub fn distance(a: &Pose, b: &Pose) -> f64 {
    let translation_m = (a.translation.vector - b.translation.vector).norm();
    let rotation_deg = se3::angle_rad(&a.rotation.rotation_to(&b.rotation)).to_degrees();
    translation_m / 0.05 + rotation_deg / 5.0
}

/// For every test frame with a true pose the nearest training pose by [`distance`].
///
/// # Errors
/// When there are no training frames.
pub fn predict(task: &Task) -> Result<Predictions, BaselineError> {
    let train: Vec<Pose> = task.train_poses().map(|(_, pose)| pose).collect();
    if train.is_empty() {
        return Err(BaselineError::NoTrainingFrames { baseline: "nearest pose" });
    }
    let nearest =
        |truth: &Pose| train.iter().min_by(|a, b| distance(a, truth).total_cmp(&distance(b, truth))).copied();
    Ok(task.test.par_iter().map(|view| nearest(view.world_from_camera.as_ref()?)).collect())
}

#[cfg(test)]
mod tests {
    use super::super::task::tests::view;
    use super::*;

    #[test]
    fn rotation_and_translation_both_count() {
        let train = vec![view(0, 0, 0.00, 20.0), view(0, 1, 0.10, 2.0), view(0, 2, 0.50, 0.0)];
        let mut test = vec![view(0, 9, 0.0, 0.0), view(0, 10, 0.49, 0.0), view(0, 11, 0.0, 20.0)];
        test[1].world_from_camera.as_mut().unwrap().translation.vector.y = 0.01;
        let task = Task::new(train, test);
        let x: Vec<f64> =
            predict(&task).unwrap().into_iter().map(|pose| pose.unwrap().translation.vector.x).collect();
        assert_eq!(x, [0.10, 0.50, 0.00]);
    }

    #[test]
    fn without_truth_there_is_no_oracle_and_without_training_an_error() {
        let mut unknown = view(0, 3, 0.0, 0.0);
        unknown.world_from_camera = None;
        let task = Task::new(vec![view(0, 0, 0.0, 0.0)], vec![unknown.clone()]);
        assert_eq!(predict(&task).unwrap(), [None]);
        let error = predict(&Task::new(vec![], vec![unknown])).unwrap_err();
        assert!(error.to_string().contains("--train-list"), "{error}");
    }
}
