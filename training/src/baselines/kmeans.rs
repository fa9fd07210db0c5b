//! Lloyd's k-means on unit vectors of equal length.

use rand::SeedableRng as _;
use rand::seq::index::sample;
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;

use super::retrieval::dot;

const ROUNDS: usize = 15;

/// Centres of `points`, `length` numbers each; at most as many as there are points.
///
/// The same seed and points give the same centres, however many threads there are.
pub fn centres(points: &[&[f32]], count: usize, seed: u64) -> Vec<Vec<f32>> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let first = sample(&mut rng, points.len(), count.min(points.len()));
    let mut centres: Vec<Vec<f32>> = first.iter().map(|i| points[i].to_vec()).collect();
    for _ in 0..ROUNDS {
        let search = Search::new(&centres);
        let nearest: Vec<usize> = points.par_iter().map(|point| search.nearest(point)).collect();
        let mut sums: Vec<Vec<f32>> = centres.iter().map(|centre| vec![0.0; centre.len()]).collect();
        let mut members = vec![0usize; centres.len()];
        for (point, &cluster) in points.iter().zip(&nearest) {
            members[cluster] += 1;
            sums[cluster].iter_mut().zip(*point).for_each(|(sum, x)| *sum += x);
        }
        for (cluster, sum) in sums.into_iter().enumerate() {
            // A centre that lost all its points stays where it is.
            if members[cluster] > 0 {
                let n = members[cluster] as f32;
                centres[cluster] = sum.into_iter().map(|x| x / n).collect();
            }
        }
    }
    centres
}

/// Finds the centre nearest to a point.
#[derive(Debug)]
pub struct Search<'a> {
    centres: &'a [Vec<f32>],
    half_squared_norms: Vec<f32>,
}

impl<'a> Search<'a> {
    /// A search among `centres`, of which there must be one at least.
    pub fn new(centres: &'a [Vec<f32>]) -> Self {
        Self { half_squared_norms: centres.iter().map(|c| 0.5 * dot(c, c)).collect(), centres }
    }

    /// Index of the nearest centre by Euclidean distance: |x - c|^2 = |x|^2 - 2 (x c - |c|^2 / 2).
    pub fn nearest(&self, point: &[f32]) -> usize {
        let mut best = (0, f32::NEG_INFINITY);
        for (index, (centre, half)) in self.centres.iter().zip(&self.half_squared_norms).enumerate() {
            let closeness = dot(centre, point) - half;
            if closeness > best.1 {
                best = (index, closeness);
            }
        }
        best.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn separate_groups_are_found() {
        let offsets = [-0.1, 0.0, 0.1];
        let points: Vec<[f32; 2]> =
            offsets.iter().flat_map(|d| [[5.0 + d, 0.0], [0.0, 5.0 + d], [-5.0 + d, 0.0]]).collect();
        let views: Vec<&[f32]> = points.iter().map(|p| p.as_slice()).collect();
        // A start with two centres in one group can stay there; some of a few seeds must not.
        let found = (0..8).any(|seed| {
            let mut centres = centres(&views, 3, seed);
            centres.sort_by(|a, b| a[0].total_cmp(&b[0]));
            let expected = [[-5.0, 0.0], [0.0, 5.0], [5.0, 0.0]];
            centres
                .iter()
                .zip(expected)
                .all(|(c, e)| (c[0] - e[0]).abs() < 1e-5 && (c[1] - e[1]).abs() < 1e-5)
        });
        assert!(found);
        assert_eq!(centres(&views, 3, 1), centres(&views, 3, 1));
        assert_eq!(centres(&views[..2], 64, 0).len(), 2);
        let far = [vec![1.0, 0.0], vec![100.0, 0.0]];
        assert_eq!(Search::new(&far).nearest(&[2.0, 0.0]), 0);
    }
}
