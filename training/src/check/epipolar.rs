//! Whether poses fit the motion of corners: the epipolar constraint (Hartley and Zisserman, *Multiple View Geometry*,
//! 2nd edition, section 9.6 for `E = [t]x R`, section 11.4.3 for the Sampson distance).

use grnet_capture::dataset::Pose;
use grnet_frame::Camera;
use grnet_geometry::se3::hat;
use grnet_geometry::statistics::median;
use nalgebra::{Vector2, Vector3};

use super::flow::Point;

/// Corners of one frame followed to another; ideal normalised image coordinates under the given intrinsics.
#[derive(Debug, Clone)]
pub struct Pair {
    /// Index of the first frame in the recording.
    pub first: usize,
    /// Index of the second frame.
    pub second: usize,
    /// Where each corner is in both.
    pub tracks: Vec<(Vector2<f64>, Vector2<f64>)>,
}

/// Sampson distances of every track of a pair, in pixels of a camera with focal length `focal_px`, when the second
/// camera moved by `first_from_second` and the true focal length is `scale` times the one the tracks were normalised
/// with.
pub fn distances(pair: &Pair, first_from_second: &Pose, focal_px: f64, scale: f64) -> Vec<f64> {
    let second_from_first = first_from_second.inverse();
    let t = second_from_first.translation.vector;
    let r = second_from_first.rotation.to_rotation_matrix().into_inner();
    // Without a baseline there is no epipolar line: the point itself has to fit.
    if t.norm() < 1e-9 {
        let miss = |(a, b): &(Vector2<f64>, Vector2<f64>)| {
            let seen = r * homogeneous(&(a / scale));
            let ahead = (seen.z > 1e-6).then(|| seen.xy() / seen.z - b / scale);
            ahead.map_or(f64::INFINITY, |miss| miss.norm()) * focal_px * scale
        };
        return pair.tracks.iter().map(miss).collect();
    }
    let e = hat(&t.normalize()) * r;
    let e_t = e.transpose();
    let sampson = |(a, b): &(Vector2<f64>, Vector2<f64>)| {
        let (a, b) = (homogeneous(&(a / scale)), homogeneous(&(b / scale)));
        let (line_b, line_a) = (e * a, e_t * b);
        let norm = (line_a.xy().norm_squared() + line_b.xy().norm_squared()).sqrt();
        (b.dot(&line_b)).abs() / norm * focal_px * scale
    };
    // At an epipole both lines vanish: nothing can be said.
    pair.tracks.iter().map(sampson).filter(|distance| distance.is_finite()).collect()
}

/// How well motions fit.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Fit {
    /// The middle distance of the middle pair, in pixels: what is told.
    pub middle_px: f64,
    /// Mean of `d^2 / (d^2 + 1)` (Geman and McClure) over the pairs: what is minimised, as it is smooth and does not
    /// mind tracks that went astray.
    pub cost: f64,
}

/// The fit over all pairs; every pair counts the same, however many corners it has. `first_from_second` may say that a
/// pair has no motion to judge by.
pub fn fit(
    pairs: &[Pair],
    focal_px: f64,
    scale: f64,
    first_from_second: impl Fn(&Pair) -> Option<Pose>,
) -> Option<Fit> {
    let (mut middles, mut costs) = (Vec::new(), Vec::new());
    for pair in pairs {
        let Some(motion) = first_from_second(pair) else { continue };
        let distances = distances(pair, &motion, focal_px, scale);
        if let Some(middle) = median(&distances) {
            middles.push(middle);
            // Of a finite distance only: an infinite one costs all.
            let cost = |d: &f64| if d.is_finite() { d * d / (d * d + 1.0) } else { 1.0 };
            costs.push(distances.iter().map(cost).sum::<f64>() / distances.len() as f64);
        }
    }
    Some(Fit { middle_px: median(&middles)?, cost: costs.iter().sum::<f64>() / costs.len() as f64 })
}

fn homogeneous(point: &Vector2<f64>) -> Vector3<f64> {
    Vector3::new(point.x, point.y, 1.0)
}

/// Ideal normalised image coordinates of a pixel, by Newton's method on the lens distortion.
pub fn normalised(camera: &Camera, (u, v): Point) -> Option<Vector2<f64>> {
    let ((fx, fy), (cx, cy)) = (camera.focal_px(), camera.centre_px());
    let wanted = Vector2::new((u - cx) / fx, (v - cy) / fy);
    let distort = |p: &Vector2<f64>| {
        let (x, y) = camera.distort((p.x, p.y));
        Vector2::new(x, y)
    };
    let mut point = wanted;
    for _ in 0..20 {
        let miss = distort(&point) - wanted;
        if miss.norm() < 1e-9 {
            return Some(point);
        }
        let h = 1e-6;
        let dx = (distort(&(point + Vector2::new(h, 0.0))) - distort(&point)) / h;
        let dy = (distort(&(point + Vector2::new(0.0, h))) - distort(&point)) / h;
        let step = nalgebra::Matrix2::from_columns(&[dx, dy]).try_inverse()? * miss;
        // A long step would leave the range in which the distortion grows.
        point -= step * (0.5 / step.norm().max(0.5));
    }
    None
}

#[cfg(test)]
mod tests {
    use grnet_frame::Distortion;

    use super::*;

    #[test]
    fn distortion_is_taken_off() {
        for distortion in [
            Distortion::None,
            Distortion::PlumbBob([-0.28, 0.07, 2e-4, 2e-5, 0.0]),
            Distortion::Equidistant([-0.01, 0.02, -0.01, 0.001]),
        ] {
            let camera = Camera::new((640, 480), (460.0, 455.0), (320.0, 240.0), distortion).unwrap();
            for ideal in [(0.0, 0.0), (0.3, -0.2), (-0.55, 0.4)] {
                let found = normalised(&camera, camera.pixel_from_normalised(ideal)).unwrap();
                assert!((found - Vector2::new(ideal.0, ideal.1)).norm() < 1e-6, "{distortion:?} {ideal:?}");
            }
        }
    }

    /// Points in a room seen from two places.
    fn pair(first_from_second: &Pose) -> Pair {
        let tracks = (0..60).map(|i| {
            let angle = f64::from(i) * 2.4;
            let point =
                nalgebra::Point3::new(angle.cos(), (angle * 1.7).sin(), 2.5 + (angle * 0.3).sin() * 1.5);
            let second = first_from_second.inverse() * point;
            let project = |p: &nalgebra::Point3<f64>| Vector2::new(p.x / p.z, p.y / p.z);
            (project(&point), project(&second))
        });
        Pair { first: 0, second: 1, tracks: tracks.collect() }
    }

    #[test]
    fn the_true_motion_fits_and_others_do_not() {
        let motion = Pose::new(Vector3::new(0.2, 0.05, 0.1), Vector3::new(0.02, -0.1, 0.03));
        let pairs = [pair(&motion)];
        let score = |motion: Pose, scale| {
            let fit = fit(&pairs, 500.0, scale, |_| Some(motion)).unwrap();
            assert!((0.0..=1.0).contains(&fit.cost));
            fit.middle_px
        };
        assert!(score(motion, 1.0) < 1e-9);
        assert!(score(motion.inverse(), 1.0) > 5.0);
        assert!(score(motion, 1.1) > 1e-3);
        assert!(score(Pose::identity(), 1.0) > 20.0);
        let turned = Pose::from_parts(motion.translation, nalgebra::UnitQuaternion::identity());
        assert!(score(turned, 1.0) > 1.0, "{}", score(turned, 1.0));
    }

    #[test]
    fn without_a_baseline_the_rotation_alone_is_judged() {
        let motion = Pose::new(Vector3::zeros(), Vector3::new(0.0, 0.1, 0.0));
        let pairs = [pair(&motion)];
        assert!(fit(&pairs, 500.0, 1.0, |_| Some(motion)).unwrap().middle_px < 1e-9);
        assert!(fit(&pairs, 500.0, 1.0, |_| Some(Pose::identity())).unwrap().middle_px > 20.0);
    }
}
