//! The pose of the training image whose descriptor is most alike.

use std::path::Path;

use rayon::prelude::*;

use super::{BaselineError, ImageError, Predictions, Progress, Task};

/// For every test frame the pose of the training frame with the most similar descriptor (largest inner product of unit
/// vectors); a test image that cannot be read has none.
///
/// # Errors
/// When there are no training frames, or a training image cannot be described.
pub fn predict(
    baseline: &'static str,
    task: &Task,
    describe: impl Fn(&Path) -> Result<Vec<f32>, ImageError> + Sync,
    progress: Progress<'_>,
) -> Result<Predictions, BaselineError> {
    if task.train.is_empty() {
        return Err(BaselineError::NoTrainingFrames { baseline });
    }
    let train = describe_training(task, &describe, progress)?;
    let test = task.test.par_iter().map(|view| {
        let query = describe(&view.image).ok();
        progress();
        let best = most_similar(&train, &query?)?;
        task.train[best].world_from_camera
    });
    Ok(test.collect())
}

/// Describes every training image.
pub(super) fn describe_training<D: Send>(
    task: &Task,
    describe: impl Fn(&Path) -> Result<D, ImageError> + Sync,
    progress: Progress<'_>,
) -> Result<Vec<D>, BaselineError> {
    let one = |path: &Path| {
        let described = describe(path)
            .map_err(|source| BaselineError::TrainingImage { path: path.to_path_buf(), source });
        progress();
        described
    };
    task.train.par_iter().map(|view| one(&view.image)).collect()
}

/// Index of the descriptor with the largest inner product; the first of equals, `None` of an empty list.
pub fn most_similar(descriptors: &[Vec<f32>], query: &[f32]) -> Option<usize> {
    let mut best = None;
    for (index, descriptor) in descriptors.iter().enumerate() {
        let similarity = dot(descriptor, query);
        if best.is_none_or(|(_, highest)| similarity > highest) {
            best = Some((index, similarity));
        }
    }
    best.map(|(index, _)| index)
}

/// Inner product, in sixteen partial sums so that the compiler can use wide registers.
pub fn dot(a: &[f32], b: &[f32]) -> f32 {
    let mut sums = [0.0; 16];
    let (a_chunks, b_chunks) = (a.chunks_exact(16), b.chunks_exact(16));
    let rest: f32 = a_chunks.remainder().iter().zip(b_chunks.remainder()).map(|(x, y)| x * y).sum();
    for (x, y) in a_chunks.zip(b_chunks) {
        for (sum, (x, y)) in sums.iter_mut().zip(x.iter().zip(y)) {
            *sum += x * y;
        }
    }
    sums.iter().sum::<f32>() + rest
}

/// Divides by the Euclidean norm; a zero vector stays zero.
pub fn normalise(vector: &mut [f32]) {
    let norm = dot(vector, vector).sqrt();
    if norm > 0.0 {
        vector.iter_mut().for_each(|x| *x /= norm);
    }
}

#[cfg(test)]
mod tests {
    use super::super::task::tests::view;
    use super::*;

    #[test]
    fn the_most_similar_wins_and_unreadable_queries_have_no_pose() {
        let task = Task::new(
            vec![view(0, 0, 1.0, 0.0), view(0, 1, 2.0, 0.0)],
            vec![view(0, 7, 0.0, 0.0), view(0, 8, 0.0, 0.0)],
        );
        let describe = |path: &Path| match path.to_str().unwrap() {
            "no-such-image-0-0.png" => Ok(vec![1.0, 0.0]),
            "no-such-image-0-1.png" => Ok(vec![0.0, 1.0]),
            "no-such-image-0-7.png" => Ok(vec![0.6, 0.8]),
            other => Err(ImageError::Network(format!("cannot see {other}"))),
        };
        let seen = std::sync::atomic::AtomicUsize::new(0);
        let progress = || {
            seen.fetch_add(1, std::sync::atomic::Ordering::Relaxed);
        };
        let found = predict("test", &task, describe, &progress).unwrap();
        assert_eq!(found[0].unwrap().translation.vector.x, 2.0);
        assert_eq!((found[1], seen.into_inner()), (None, 4));
        let swapped = Task::new(task.test.clone(), task.train.clone());
        let error = predict("test", &swapped, describe, &|| ()).unwrap_err();
        assert!(error.to_string().contains("no-such-image-0-8.png"), "{error}");
    }

    #[test]
    fn inner_products_of_any_length() {
        let a: Vec<f32> = (0..37).map(|i| i as f32).collect();
        assert_eq!(dot(&a, &a), (0..37).map(|i| (i * i) as f32).sum::<f32>());
        let mut unit = vec![3.0, 4.0];
        normalise(&mut unit);
        assert_eq!(unit, [0.6, 0.8]);
        let mut zero = vec![0.0; 3];
        normalise(&mut zero);
        assert_eq!(zero, [0.0; 3]);
    }
}
