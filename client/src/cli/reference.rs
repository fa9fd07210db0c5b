//! Ground truth beside the live poses: how far off is the stream?

use std::path::Path;

use grnet_client::Sample;
use grnet_geometry::{
    Pose,
    trajectory::{KittiPoses, TrajectoryError, kitti},
};

/// Why a reference cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum ReferenceError {
    /// It is no KITTI trajectory.
    #[error("the reference cannot be read")]
    Trajectory(#[from] TrajectoryError),
    /// It has no row.
    #[error("{0} holds no pose to compare with")]
    Empty(String),
}

/// Reference poses by frame number.
#[derive(Debug)]
pub struct Reference {
    poses: KittiPoses,
    errors_m: Vec<f64>,
    errors_deg: Vec<f64>,
}

/// The reference pose of one sample, and how far the sample is from it.
#[derive(Debug, Clone, PartialEq)]
pub struct Deviation {
    /// Where the base was.
    pub map_from_base: Pose,
    /// Distance in metres and angle in degrees, where the sample has a pose.
    pub error: Option<(f64, f64)>,
}

impl Reference {
    /// Reads a KITTI trajectory: one row a frame, or rows that start with their frame number.
    ///
    /// # Errors
    /// When the file is no such trajectory or empty.
    pub fn read(path: &Path) -> Result<Self, ReferenceError> {
        let poses = kitti::read(path)?;
        if poses.is_empty() {
            return Err(ReferenceError::Empty(path.display().to_string()));
        }
        Ok(Self { poses, errors_m: Vec::new(), errors_deg: Vec::new() })
    }

    /// The sample's frame in the reference; a recording that is played in a loop starts again there too.
    pub fn compare(&self, sample: &Sample, estimate: Option<Pose>) -> Option<Deviation> {
        let frame = sample.sequence()?;
        let frame = if self.poses.is_indexed() { frame } else { frame % self.poses.len() as u64 };
        let row = self.poses.frame(frame)?;
        let map_from_base = row.world_from_camera;
        let error = estimate.map(|estimate| {
            let distance_m = (estimate.translation.vector - map_from_base.translation.vector).norm();
            (distance_m, estimate.rotation.angle_to(&map_from_base.rotation).to_degrees())
        });
        Some(Deviation { map_from_base, error })
    }

    /// Takes a deviation into the summary.
    pub fn count(&mut self, deviation: &Deviation) {
        if let Some((error_m, error_deg)) = deviation.error {
            self.errors_m.push(error_m);
            self.errors_deg.push(error_deg);
        }
    }

    /// Medians over everything counted; `None` when no sample had both poses.
    pub fn summary(&mut self) -> Option<String> {
        let (count, metres, degrees) =
            (self.errors_m.len(), median(&mut self.errors_m)?, median(&mut self.errors_deg)?);
        Some(format!("against the reference: median {metres:.3} m, {degrees:.1} deg over {count} samples"))
    }
}

fn median(values: &mut [f64]) -> Option<f64> {
    values.sort_by(f64::total_cmp);
    let (low, high) = (values.get(values.len().saturating_sub(1) / 2)?, values.get(values.len() / 2)?);
    Some((low + high) / 2.0)
}

#[cfg(test)]
mod tests {
    use grnet_client::{PoseSample, Reason, Status};
    use grnet_proto::BootId;

    use super::*;

    fn sample(sequence: u64) -> Sample {
        let camera = "front".parse().unwrap();
        let mut raw = PoseSample::unknown(BootId([1; 16]), &camera, Status::TRACKING, Reason::NONE);
        raw.sequence = sequence;
        Sample::new(raw)
    }

    #[test]
    fn frames_meet_their_rows_also_in_a_loop() {
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), "1 0 0 0 0 1 0 0 0 0 1 0\n1 0 0 3 0 1 0 4 0 0 1 0\n").unwrap();
        let mut reference = Reference::read(file.path()).unwrap();
        for sequence in [1, 3] {
            let deviation = reference.compare(&sample(sequence), Some(Pose::identity())).unwrap();
            assert_eq!(deviation.error, Some((5.0, 0.0)));
            reference.count(&deviation);
        }
        let unknown = reference.compare(&sample(0), None).unwrap();
        assert_eq!(unknown.error, None);
        reference.count(&unknown);
        assert_eq!(
            reference.summary().unwrap(),
            "against the reference: median 5.000 m, 0.0 deg over 2 samples"
        );
        assert_eq!(reference.compare(&sample(u64::MAX), None), None, "a sample without a frame");
    }

    #[test]
    fn files_that_cannot_be_compared_with_are_refused() {
        let file = tempfile::NamedTempFile::new().unwrap();
        assert!(Reference::read(file.path()).is_err());
        std::fs::write(file.path(), "1 2 3\n").unwrap();
        let error = anyhow::Error::new(Reference::read(file.path()).unwrap_err());
        assert!(format!("{error:#}").contains(&file.path().display().to_string()), "{error:#}");
    }
}
