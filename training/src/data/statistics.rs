//! Poses without images.

use grnet_geometry::Pose;

use super::{DataError, Windows};

/// The poses of windows 0 to `count`, to learn means and scales of the targets from.
///
/// # Errors
/// As [`Windows::poses`].
pub fn sample(windows: &dyn Windows, count: u64) -> Result<Vec<Vec<Pose>>, DataError> {
    (0..count).map(|index| windows.poses(index)).collect()
}
