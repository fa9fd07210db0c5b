//! Retrieval by VLAD (Jegou et al., "Aggregating local descriptors into a compact image representation", CVPR 2010) of
//! dense gradient descriptors, as Sattler et al. (CVPR 2019) use to judge pose regression.

use std::path::Path;

use rand::{Rng as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;

use super::dense::{self, LENGTH};
use super::kmeans::{self, Search};
use super::retrieval::{describe_training, most_similar, normalise};
use super::{BaselineError, Predictions, Progress, Task};

const CLUSTERS: usize = 32;
/// Training images for each cluster. The residuals of a cluster that a single image fills cancel: they sum to zero
/// about their own mean, and say nothing about that image.
const IMAGES_PER_CLUSTER: usize = 4;
/// Descriptors that the clusters are learnt from.
const SAMPLES: usize = 20_000;
const SEED: u64 = 0;

/// Retrieval by VLAD; the clusters are those of the training images.
///
/// # Errors
/// When there are no training frames, a training image cannot be read, or none of them shows any structure.
pub fn predict(task: &Task, progress: Progress<'_>) -> Result<Predictions, BaselineError> {
    if task.train.is_empty() {
        return Err(BaselineError::NoTrainingFrames { baseline: "VLAD" });
    }
    let descriptors = describe_training(task, dense::describe, progress)?;
    let centres =
        vocabulary(&descriptors).ok_or(BaselineError::NoDescriptors { images: descriptors.len() })?;
    let search = Search::new(&centres);
    let train: Vec<Vec<f32>> = descriptors.par_iter().map(|d| aggregate(d, &centres, &search)).collect();
    let one = |path: &Path| {
        let query = dense::describe(path).ok();
        progress();
        most_similar(&train, &aggregate(&query?, &centres, &search))
    };
    let test = task.test.par_iter().map(|view| task.train[one(&view.image)?].world_from_camera);
    Ok(test.collect())
}

/// Cluster centres of a random part of the descriptors; `None` when there are none.
fn vocabulary(images: &[Vec<f32>]) -> Option<Vec<Vec<f32>>> {
    let all: Vec<&[f32]> = images.iter().flat_map(|image| image.chunks_exact(LENGTH)).collect();
    if all.is_empty() {
        return None;
    }
    let mut rng = ChaCha8Rng::seed_from_u64(SEED);
    let chosen: Vec<&[f32]> = if all.len() <= SAMPLES {
        all
    } else {
        (0..SAMPLES).map(|_| all[rng.random_range(0..all.len())]).collect()
    };
    let clusters = (images.len() / IMAGES_PER_CLUSTER).clamp(1, CLUSTERS);
    Some(kmeans::centres(&chosen, clusters, SEED))
}

/// Sums of the residuals of each cluster, each normalised (Arandjelovic and Zisserman, "All about VLAD", CVPR 2013), then
/// the whole.
fn aggregate(descriptors: &[f32], centres: &[Vec<f32>], search: &Search<'_>) -> Vec<f32> {
    let mut vlad = vec![0.0; centres.len() * LENGTH];
    for descriptor in descriptors.chunks_exact(LENGTH) {
        let cluster = search.nearest(descriptor);
        let sums = &mut vlad[cluster * LENGTH..][..LENGTH];
        for (sum, (x, centre)) in sums.iter_mut().zip(descriptor.iter().zip(&centres[cluster])) {
            *sum += x - centre;
        }
    }
    vlad.chunks_exact_mut(LENGTH).for_each(normalise);
    normalise(&mut vlad);
    vlad
}

#[cfg(test)]
mod tests {
    use super::super::task::tests::view;
    use super::super::{Task, View};
    use super::*;

    /// A wall of random discs of many sizes and greys, seen from a camera shifted by `shift_px`.
    fn wall(path: &Path, seed: u64, shift_px: u32) {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut disc = || {
            let (x, y, r) = (rng.random_range(0..360), rng.random_range(0..240), rng.random_range(5..50));
            (x, y, r, rng.random_range(20..=235))
        };
        let discs: Vec<(u32, u32, u32, u8)> = (0..150).map(|_| disc()).collect();
        let grey = |x: u32, y: u32| {
            // The disc painted last covers the others.
            let covers = |(cx, cy, r, _): &&(u32, u32, u32, u8)| {
                cx.abs_diff(x + shift_px).pow(2) + cy.abs_diff(y).pow(2) < r * r
            };
            discs.iter().rev().find(covers).map_or(128, |disc| disc.3)
        };
        image::GrayImage::from_fn(320, 240, |x, y| image::Luma([grey(x, y)])).save(path).unwrap();
    }

    #[test]
    fn walls_are_recognised_and_blank_ones_refused() {
        let folder = tempfile::tempdir().unwrap();
        let at = |index: u64, seed: u64, shift_px: u32| {
            let image = folder.path().join(format!("{index}.png"));
            wall(&image, seed, shift_px);
            View { image, ..view(0, index, seed as f64, 0.0) }
        };
        let train = (0..24).map(|seed| at(seed, seed, 0)).collect();
        // Shifted by the distance of two descriptors.
        let seeds = [3, 8, 14, 23];
        let test = seeds.iter().map(|seed| at(100 + seed, *seed, 16)).collect();
        let task = Task::new(train, test);
        let found = predict(&task, &|| ()).unwrap();
        let recognised: Vec<u64> =
            found.iter().map(|pose| pose.unwrap().translation.vector.x as u64).collect();
        assert_eq!(recognised, seeds);
        assert_eq!(found, predict(&task, &|| ()).unwrap());

        let blank = folder.path().join("blank.png");
        image::GrayImage::new(64, 64).save(&blank).unwrap();
        let task = Task::new(vec![View { image: blank, ..view(0, 0, 0.0, 0.0) }], vec![]);
        let error = predict(&task, &|| ()).unwrap_err();
        assert!(matches!(error, BaselineError::NoDescriptors { images: 1 }), "{error}");
    }
}
