//! Several sources with weights.

use std::sync::Arc;

use grnet_geometry::Pose;

use super::DataError;
use super::fingerprint::Fingerprint;
use super::window::{Purpose, Window, Windows, check_weights, draw_weighted, generator};

/// Draws each window from one of several sources.
pub struct Mixed {
    sources: Vec<Arc<dyn Windows>>,
    weights: Vec<f64>,
    seed: u64,
}

impl Mixed {
    /// Windows of each source as often as its weight says, relative to the others.
    ///
    /// # Errors
    /// When there is no source, a weight makes no sense, or the sources differ in K or in the size of their images.
    pub fn new(sources: Vec<(Arc<dyn Windows>, f64)>, seed: u64) -> Result<Self, DataError> {
        let (sources, weights): (Vec<_>, Vec<_>) = sources.into_iter().unzip();
        let Some(first) = sources.first() else {
            return Err(DataError::option("sources", "none", "at least one"));
        };
        check_weights("weights", &weights, sources.len())?;
        let shape = |source: &Arc<dyn Windows>| (source.k(), source.size_px());
        if let Some(other) = sources.iter().find(|source| shape(source) != shape(first)) {
            let told = |source: &Arc<dyn Windows>| {
                let size = source.size_px().map_or("square".into(), |(w, h)| format!("{w}x{h}"));
                format!("windows of {} {size} images ({})", source.k(), source.describe())
            };
            return Err(DataError::option("sources", told(other), told(first)));
        }
        Ok(Self { sources, weights, seed })
    }

    fn source(&self, index: u64) -> &Arc<dyn Windows> {
        &self.sources[draw_weighted(&self.weights, &mut generator(self.seed, Purpose::Mix, index))]
    }
}

impl Windows for Mixed {
    fn k(&self) -> usize {
        self.sources[0].k()
    }

    fn window(&self, index: u64) -> Result<Window, DataError> {
        self.source(index).window(index)
    }

    fn poses(&self, index: u64) -> Result<Vec<Pose>, DataError> {
        self.source(index).poses(index)
    }

    fn size_px(&self) -> Option<(u32, u32)> {
        self.sources[0].size_px()
    }

    fn fingerprint(&self) -> String {
        let mut hash = Fingerprint::default();
        hash.text("mixed windows 1");
        hash.bytes(&self.seed.to_le_bytes());
        hash.numbers(&self.weights);
        for source in &self.sources {
            hash.text(&source.fingerprint());
        }
        hash.finish()
    }

    fn describe(&self) -> String {
        let total: f64 = self.weights.iter().sum();
        let share = |weight: &f64| format!("{:.0} %", weight / total * 100.0);
        let parts = self.sources.iter().zip(&self.weights);
        let parts: Vec<String> =
            parts.map(|(source, weight)| format!("{} {}", share(weight), source.describe())).collect();
        parts.join(" + ")
    }
}

#[cfg(test)]
mod tests {
    use super::super::window::tests::Counting;
    use super::*;

    fn counting(k: usize, tag: f32) -> Arc<dyn Windows> {
        Arc::new(Counting { k, tag, ..Counting::default() })
    }

    #[test]
    fn sources_come_as_often_as_their_weights_say_and_always_the_same() {
        let mixed = Mixed::new(vec![(counting(2, 1.0), 1.0), (counting(2, 2.0), 3.0)], 5).unwrap();
        let tags: Vec<f32> = (0..4000).map(|i| mixed.window(i).unwrap().images[1]).collect();
        let first = tags.iter().filter(|tag| **tag == 1.0).count();
        assert!((900..1100).contains(&first), "{first}");
        let again: Vec<f32> = (0..4000).map(|i| mixed.window(i).unwrap().images[1]).collect();
        assert_eq!(tags, again);
        assert_eq!(mixed.window(17).unwrap().images[0], 17.0, "the index is passed on");
        assert!(mixed.describe().starts_with("25 % "), "{}", mixed.describe());
    }

    #[test]
    fn unequal_sources_are_refused() {
        let error = Mixed::new(vec![(counting(2, 1.0), 1.0), (counting(3, 1.0), 1.0)], 0).err().unwrap();
        assert!(error.to_string().contains("windows of 3"), "{error}");
        assert!(Mixed::new(vec![], 0).is_err());
        assert!(Mixed::new(vec![(counting(2, 1.0), -1.0)], 0).is_err());
    }

    #[test]
    fn the_fingerprint_follows_sources_weights_and_seed() {
        let of = |tag, weight, seed| {
            let sources = vec![(counting(2, tag), weight), (counting(2, 2.0), 1.0)];
            Mixed::new(sources, seed).unwrap().fingerprint()
        };
        let all = [of(1.0, 1.0, 0), of(3.0, 1.0, 0), of(1.0, 2.0, 0), of(1.0, 1.0, 1)];
        assert!((0..4).all(|i| (0..i).all(|j| all[i] != all[j])));
        assert_eq!(of(1.0, 1.0, 0), all[0]);
    }
}
