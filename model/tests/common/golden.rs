//! Golden files, by name and by metric.

use std::path::PathBuf;

use grnet_model::NetworkConfig;
use grnet_model::candle_core::Tensor;
use safetensors::SafeTensors;

use super::{difference, values};

/// A file of `tests/golden`.
pub struct Golden(Vec<u8>);

impl Golden {
    pub fn open(name: &str) -> Self {
        let path = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("tests/golden").join(name);
        Self(std::fs::read(path.with_extension("safetensors")).unwrap())
    }

    pub fn config(&self) -> NetworkConfig {
        let (_, header) = SafeTensors::read_metadata(&self.0).unwrap();
        serde_json::from_str(&header.metadata().as_ref().unwrap()["config"]).unwrap()
    }

    pub fn has(&self, name: &str) -> bool {
        SafeTensors::deserialize(&self.0).unwrap().names().contains(&name)
    }

    pub fn f32s(&self, name: &str) -> Vec<f32> {
        let file = SafeTensors::deserialize(&self.0).unwrap();
        let bytes = file.tensor(name).unwrap_or_else(|e| panic!("{name}: {e}")).data();
        bytes.as_chunks::<4>().0.iter().map(|w| f32::from_le_bytes(*w)).collect()
    }

    pub fn f64s(&self, name: &str) -> Vec<f64> {
        let file = SafeTensors::deserialize(&self.0).unwrap();
        let bytes = file.tensor(name).unwrap_or_else(|e| panic!("{name}: {e}")).data();
        bytes.as_chunks::<8>().0.iter().map(|w| f64::from_le_bytes(*w)).collect()
    }

    pub fn norm(&self, name: &str) -> f64 {
        self.f64s(&format!("{name}.norm"))[0]
    }

    /// Every n-th value and the norm; the allowed difference is relative to the root mean square.
    pub fn assert_summary(&self, name: &str, ours: &[f32], relative: f64) {
        self.assert_samples(name, ours, 256, relative);
    }

    /// As [`Self::assert_summary`] for another number of samples.
    pub fn assert_samples(&self, name: &str, ours: &[f32], samples: usize, relative: f64) {
        let theirs = self.f32s(&format!("{name}.sample"));
        let step = (ours.len() / samples).max(1);
        let sampled: Vec<f32> = ours.iter().copied().step_by(step).collect();
        let norm = self.norm(name);
        let allowed = relative * norm / (ours.len() as f64).sqrt();
        let found = difference(&sampled, &theirs);
        assert!(f64::from(found) < allowed, "{name} differs by {found}, {allowed} allowed");
        let our_norm = ours.iter().map(|v| f64::from(*v).powi(2)).sum::<f64>().sqrt();
        assert!((our_norm - norm).abs() < relative * norm, "norm of {name}: {our_norm}, {norm} expected");
    }

    pub fn assert_close(&self, name: &str, ours: &Tensor, allowed: f32) {
        let found = difference(&values(ours), &self.f32s(name));
        assert!(found < allowed, "{name} differs by {found}, {allowed} allowed");
    }
}
