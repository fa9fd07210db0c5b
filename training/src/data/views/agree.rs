//! What frames that see the same surface agree on.

use super::draw::{Map, splat};
use super::{Station, Surface};

/// For each pixel the median of the frame's own depth and those that its neighbours see there, if they are two or more.
pub(super) fn median(own: (&Station, &Surface), others: &[(&Station, &Surface)]) -> Surface {
    let (station, surface) = own;
    let (width, height) = (surface.width, surface.height);
    let seen: Vec<Vec<f32>> = others
        .iter()
        .map(|(other, theirs)| {
            let own_from_other = station.world_from_camera.inv_mul(&other.world_from_camera);
            let mut seen = vec![0.0; width * height];
            splat(theirs, &Map::new(other.lens, &own_from_other, station.lens), &mut seen, (width, height));
            seen
        })
        .collect();
    let mut values = Vec::with_capacity(1 + seen.len());
    let agreed = surface.inverse_depth.iter().enumerate().map(|(pixel, own)| {
        values.clear();
        values.push(*own);
        values.extend(seen.iter().map(|seen| seen[pixel]).filter(|seen| *seen > 0.0));
        if values.len() < 3 {
            return *own;
        }
        values.sort_unstable_by(f32::total_cmp);
        let middle = values.len() / 2;
        if values.len() % 2 == 1 { values[middle] } else { 0.5 * (values[middle - 1] + values[middle]) }
    });
    Surface { width, height, inverse_depth: agreed.collect() }
}

#[cfg(test)]
mod tests {
    use grnet_frame::{Camera, Distortion};
    use grnet_geometry::Pose;

    use super::*;
    use crate::data::image::Lens;

    #[test]
    fn what_two_neighbours_see_otherwise_is_mended_and_what_one_does_is_not() {
        let camera = Camera::new((40, 30), (30.0, 30.0), (19.5, 14.5), Distortion::None).unwrap();
        let station = |x_m: f64| Station {
            world_from_camera: Pose::translation(x_m, 0.0, 0.0),
            lens: Lens::of_stored(&camera, (40, 30)),
            size_px: (40, 30),
        };
        let stations = [station(0.0), station(-0.1), station(0.1)];
        let wall = Surface { width: 40, height: 30, inverse_depth: vec![0.5; 40 * 30] };
        let mut own = wall.clone();
        own.inverse_depth[15 * 40 + 20] = 2.0;
        let others = [(&stations[1], &wall), (&stations[2], &wall)];
        let agreed = median((&stations[0], &own), &others);
        assert!(agreed.inverse_depth.iter().all(|value| (value - 0.5).abs() < 1e-6));
        assert_eq!(median((&stations[0], &own), &others[..1]), own);
    }
}
