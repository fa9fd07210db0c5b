//! Between the training frames before and after, by frame number: no image is looked at.
//!
//! Where this beats a method, the split can be solved by knowing when a frame was taken, and says little about the method.

use grnet_geometry::se3;

use super::{BaselineError, Predictions, Task, View};

/// The training poses before and after each test frame, interpolated by frame number (straight line, constant turn);
/// at the ends of a sequence the one that there is, in a sequence without training frames nothing.
///
/// # Errors
/// When there are no training frames at all.
pub fn predict(task: &Task) -> Result<Predictions, BaselineError> {
    if task.train.is_empty() {
        return Err(BaselineError::NoTrainingFrames { baseline: "interpolation" });
    }
    Ok(task.test.iter().map(|view| between(task, view)).collect())
}

fn between(task: &Task, view: &View) -> Option<grnet_geometry::Pose> {
    let key = |v: &View| (v.sequence, v.index);
    let after = task.train.partition_point(|t| key(t) < key(view));
    let same = |t: &&View| t.sequence == view.sequence;
    let next = task.train.get(after).filter(same);
    let previous = after.checked_sub(1).map(|before| &task.train[before]).filter(same);
    match (previous, next) {
        (Some(a), Some(b)) => {
            let t = (view.index - a.index) as f64 / (b.index - a.index) as f64;
            Some(se3::interpolate(&a.world_from_camera?, &b.world_from_camera?, t))
        }
        (Some(only), None) | (None, Some(only)) => only.world_from_camera,
        (None, None) => None,
    }
}

#[cfg(test)]
mod tests {
    use super::super::task::tests::view;
    use super::*;

    #[test]
    fn straight_between_neighbours_of_the_same_sequence() {
        let train = vec![view(0, 10, 1.0, 0.0), view(0, 20, 2.0, 40.0), view(1, 0, 9.0, 0.0)];
        let test = [(0, 3), (0, 15), (0, 20), (0, 25), (2, 0)].map(|(s, i)| view(s, i, 7.0, 7.0));
        let found = predict(&Task::new(train, test.to_vec())).unwrap();
        let x: Vec<_> = found.iter().map(|pose| pose.map(|p| p.translation.vector.x)).collect();
        assert_eq!(x, [Some(1.0), Some(1.5), Some(2.0), Some(2.0), None]);
        assert!((found[1].unwrap().rotation.angle().to_degrees() - 20.0).abs() < 1e-9);
        assert!(predict(&Task::new(vec![], test.to_vec())).is_err());
    }
}
