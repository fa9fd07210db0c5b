//! Frames that show what a frame does not.

use grnet_geometry::Pose;
use nalgebra::Point3;

use super::Station;

/// A frame turned farther away from the new camera than this sees something else.
const MOST_TURN_RAD: f64 = 1.0;
/// Part of the width and the height of a frame, at its edges, that does not count.
const MARGIN: f64 = 0.02;

/// The frame that sees most of `points` (axes of the new camera) from near where the new camera stands; none if none sees a quarter of
/// them.
pub(super) fn best(
    points: &[Point3<f64>],
    world_from_new: &Pose,
    stations: &[Station],
    is_used: impl Fn(usize) -> bool,
) -> Option<usize> {
    let depth = points.iter().map(|point| point.z).sum::<f64>() / points.len().max(1) as f64;
    let least = (points.len() as f64 / 4.0).max(1.0);
    let mut found: Option<(usize, f64)> = None;
    for (index, station) in stations.iter().enumerate() {
        let own_from_new = station.world_from_camera.inv_mul(world_from_new);
        let distance = own_from_new.translation.vector.norm() / depth;
        // Without an inverse function, which differs between machines.
        let turn = 2.0 * (2.0 * (1.0 - own_from_new.rotation.w.abs()).max(0.0)).sqrt();
        if turn > MOST_TURN_RAD || is_used(index) {
            continue;
        }
        let price = 1.0 + 3.0 * distance + turn;
        // Not even all of them would make it the best.
        if found.is_some_and(|(_, score)| points.len() as f64 / price <= score) {
            continue;
        }
        let pixel = station.lens.pixel_from_ray() * own_from_new.rotation.to_rotation_matrix().matrix();
        let shift = station.lens.pixel_from_ray() * own_from_new.translation.vector;
        let (width, height) = (f64::from(station.size_px.0), f64::from(station.size_px.1));
        let is_seen = |point: &&Point3<f64>| {
            let seen = pixel * point.coords + shift;
            let (u, v) = (seen.x / seen.z, seen.y / seen.z);
            let is_inside = |at: f64, side: f64| (MARGIN * side..(1.0 - MARGIN) * side).contains(&at);
            seen.z > 0.0 && is_inside(u, width) && is_inside(v, height)
        };
        let count = points.iter().filter(is_seen).count() as f64;
        let score = count / price;
        if count >= least && found.is_none_or(|(_, best)| score > best) {
            found = Some((index, score));
        }
    }
    found.map(|(index, _)| index)
}

#[cfg(test)]
mod tests {
    use grnet_frame::{Camera, Distortion};
    use nalgebra::{Translation3, UnitQuaternion, Vector3};

    use super::*;
    use crate::data::image::Lens;

    fn station(x_m: f64, yaw_rad: f64) -> Station {
        let camera = Camera::new((80, 60), (60.0, 60.0), (39.5, 29.5), Distortion::None).unwrap();
        let rotation = UnitQuaternion::from_scaled_axis(Vector3::y() * yaw_rad);
        let world_from_camera = Pose::from_parts(Translation3::new(x_m, 0.0, 0.0), rotation);
        Station { world_from_camera, lens: Lens::of_stored(&camera, (80, 60)), size_px: (80, 60) }
    }

    #[test]
    fn the_nearest_frame_that_sees_what_is_missing_is_taken() {
        let points = [-0.4, 0.0, 0.4].map(|y| Point3::new(1.7, y, 2.0));
        let chosen = |stations: &[Station], used: &[usize]| {
            best(&points, &Pose::identity(), stations, |index| used.contains(&index))
        };
        // Straight ahead; turned to the points; the same from farther away; turned away.
        let stations = [station(0.0, 0.0), station(0.1, 0.3), station(0.6, 0.3), station(0.1, -0.3)];
        assert_eq!(chosen(&stations, &[]), Some(1));
        assert_eq!(chosen(&stations, &[1]), Some(2));
        assert_eq!(chosen(&stations, &[1, 2]), None);
        // The same camera, but of a recording whose images end before the points.
        let narrow = Station { size_px: (30, 60), ..station(0.1, 0.3) };
        assert_eq!(chosen(&[narrow, station(0.6, 0.3)], &[]), Some(1));
    }
}
