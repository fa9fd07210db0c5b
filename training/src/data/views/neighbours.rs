//! Frames that see the scene of a frame from beside it.

use super::Station;

/// Wanted distances across the line of sight, for each metre of the nearest depth: near ones are alike, far ones measure well.
const DISTANCES: [f64; 3] = [0.12, 0.24, 0.4];
/// Least distance across, likewise.
const LEAST: f64 = 0.06;
/// Farther away in all, likewise, too little is seen by both.
const FARTHEST: f64 = 1.0;
/// And turned further, too.
const MOST_TURN_RAD: f64 = 0.44;

/// At most six frames, before and after it in the recording.
pub(super) fn of(frame: usize, stations: &[Station], near_m: f64) -> Vec<usize> {
    let own = &stations[frame].world_from_camera;
    // Distance across, turn.
    let seen = |other: &Station| {
        let pose = own.inv_mul(&other.world_from_camera);
        let offset = pose.translation.vector;
        let across = (offset.x * offset.x + offset.y * offset.y).sqrt();
        // The cosine of half the turn is the scalar part: no inverse function, which differs between machines.
        let half_cosine = pose.rotation.w.abs();
        let turn = 2.0 * (2.0 * (1.0 - half_cosine).max(0.0)).sqrt();
        let is_near = across >= LEAST * near_m && offset.norm() <= FARTHEST * near_m && turn <= MOST_TURN_RAD;
        is_near.then_some((across, turn))
    };
    let candidates: Vec<(usize, f64, f64)> = stations
        .iter()
        .enumerate()
        .filter_map(|(index, other)| seen(other).map(|(across, turn)| (index, across, turn)))
        .collect();
    let mut found = Vec::new();
    for wanted in DISTANCES.map(|distance| distance * near_m) {
        for is_after in [false, true] {
            let unlike = |across: f64, turn: f64| (across / wanted).max(wanted / across) + 3.0 * turn;
            let best = candidates
                .iter()
                .filter(|(index, ..)| (*index > frame) == is_after)
                .min_by(|a, b| unlike(a.1, a.2).total_cmp(&unlike(b.1, b.2)));
            if let Some((index, ..)) = best
                && !found.contains(index)
            {
                found.push(*index);
            }
        }
    }
    found
}

#[cfg(test)]
mod tests {
    use grnet_frame::{Camera, Distortion};
    use grnet_geometry::Pose;
    use nalgebra::{Translation3, UnitQuaternion, Vector3};

    use super::*;
    use crate::data::image::Lens;

    fn station(x_m: f64, z_m: f64, yaw_rad: f64) -> Station {
        let camera = Camera::new((8, 6), (6.0, 6.0), (3.5, 2.5), Distortion::None).unwrap();
        let rotation = UnitQuaternion::from_scaled_axis(Vector3::y() * yaw_rad);
        let world_from_camera = Pose::from_parts(Translation3::new(x_m, 0.0, z_m), rotation);
        Station { world_from_camera, lens: Lens::of_stored(&camera, (8, 6)), size_px: (8, 6) }
    }

    #[test]
    fn frames_beside_it_are_taken_and_no_others() {
        // Along x, a centimetre each; then one far ahead, one far aside, one turned away.
        let mut stations: Vec<Station> = (0..41).map(|i| station(f64::from(i) / 100.0, 0.0, 0.0)).collect();
        stations.extend([station(0.2, 0.4, 0.0), station(1.5, 0.0, 0.0), station(0.3, 0.0, 0.6)]);
        let found = of(20, &stations, 0.5);
        assert_eq!(found, [14, 26, 8, 32, 0, 40]);
        assert!(of(42, &stations, 0.5).is_empty(), "nobody is near the one far aside");
    }

    #[test]
    fn standing_still_shows_no_depth() {
        let stations: Vec<Station> = (0..20).map(|i| station(0.0, 0.0, f64::from(i) / 50.0)).collect();
        assert!(of(10, &stations, 0.5).is_empty());
    }
}
