//! From the poses of a tracked body in any world and scale to those of the camera in a metric one.

use grnet_capture::dataset::{Pose, RecordedFrame};
use grnet_geometry::align::Alignment;
use nalgebra::{Translation3, UnitQuaternion, Vector3};

use super::associate::{At, Matched, at, time_ns};
use super::{Gravity, JoinError, JoinReport, LEAST_MATCHES, Residuals, Scale, Transform};

/// Turns matched poses into `world_from_camera`.
///
/// # Errors
/// When a scale cannot be found as asked, or up cannot.
pub fn apply(
    frames: &[RecordedFrame],
    matched: &Matched,
    transform: &Transform,
) -> Result<(Vec<Option<Pose>>, JoinReport), JoinError> {
    let mut poses = matched.poses.clone();
    let mut report = report(frames, matched);
    let has_lever = transform.body_from_camera.translation.vector.norm() > 0.0;
    if has_lever && !matches!(transform.scale, Scale::Factor(_)) {
        return Err(JoinError::Option {
            option: "--body-from-camera",
            problem: "the camera's place on the body is in metres, and the trajectory's scale is not known before the \
                      body's poses are the camera's: give --scale"
                .into(),
        });
    }
    report.scale = match &transform.scale {
        Scale::Factor(factor) => *factor,
        Scale::Between { first, second, distance_m } => {
            distance_m / distance(frames, &poses, *first, *second)?
        }
        Scale::Reference { .. } => 1.0,
    };
    for pose in poses.iter_mut().flatten() {
        let scaled = Translation3::from(pose.translation.vector * report.scale);
        *pose = Pose::from_parts(scaled, pose.rotation) * transform.body_from_camera;
    }
    if let Scale::Reference { .. } = &transform.scale {
        (report.scale, report.reference) = onto_reference(frames, &mut poses, &transform.scale)?;
    }
    if let Some(gravity) = transform.gravity {
        report.turned_deg = Some(upright(&mut poses, gravity)?);
    }
    let path: Vec<Vector3<f64>> = poses.iter().flatten().map(|pose| pose.translation.vector).collect();
    report.path_m = path.windows(2).map(|pair| (pair[1] - pair[0]).norm()).sum();
    Ok((poses, report))
}

fn report(frames: &[RecordedFrame], matched: &Matched) -> JoinReport {
    let mut without_pose: Vec<(u64, u64)> = Vec::new();
    let mut is_open = false;
    for (frame, pose) in frames.iter().zip(&matched.poses) {
        match without_pose.last_mut() {
            Some(run) if is_open && pose.is_none() => run.1 = frame.sequence,
            _ if pose.is_none() => without_pose.push((frame.sequence, frame.sequence)),
            _ => {}
        }
        is_open = pose.is_none();
    }
    JoinReport {
        frames: frames.len(),
        with_pose: matched.poses.iter().flatten().count(),
        outside: matched.outside,
        in_gaps: matched.in_gaps,
        unnamed: matched.unnamed,
        largest_gap_s: matched.largest_gap_ns.map(|ns| ns as f64 * 1e-9),
        scale: 1.0,
        reference: None,
        turned_deg: None,
        path_m: 0.0,
        without_pose,
    }
}

/// Distance between two frames in units of the trajectory.
fn distance(
    frames: &[RecordedFrame],
    poses: &[Option<Pose>],
    first: u64,
    second: u64,
) -> Result<f64, JoinError> {
    let fail = |problem| JoinError::Option { option: "--scale-between", problem };
    let place = |number: u64| {
        let index = frames.iter().position(|frame| frame.sequence == number);
        let pose = index.and_then(|index| poses[index]);
        pose.map(|pose| pose.translation.vector)
            .ok_or_else(|| fail(format!("frame {number} is not there or has no pose")))
    };
    let units = (place(second)? - place(first)?).norm();
    if units > 0.0 {
        Ok(units)
    } else {
        Err(fail(format!("frames {first} and {second} are at one place: choose frames that are far apart")))
    }
}

/// Moves the poses onto the reference by a similarity; its scale and what remains.
fn onto_reference(
    frames: &[RecordedFrame],
    poses: &mut [Option<Pose>],
    scale: &Scale,
) -> Result<(f64, Option<Residuals>), JoinError> {
    let Scale::Reference { trajectory, time_offset_ns, max_gap_ns } = scale else { return Ok((1.0, None)) };
    let (mut from, mut to) = (Vec::new(), Vec::new());
    for (frame, pose) in frames.iter().zip(&*poses) {
        let time_ns = time_ns(frame).saturating_sub(*time_offset_ns);
        if let (Some(pose), At::Pose(reference, _)) = (pose, at(trajectory, time_ns, *max_gap_ns)) {
            from.push(*pose);
            to.push(reference);
        }
    }
    if from.len() < LEAST_MATCHES {
        return Err(JoinError::Option {
            option: "--reference",
            problem: format!(
                "{} frames have a pose of both trajectories, at least {LEAST_MATCHES} are needed; see \
                 --reference-time-offset and --max-gap",
                from.len()
            ),
        });
    }
    let similarity = Alignment::Sim3.solve(&from, &to)?;
    let square = |(from, to): (&Pose, &Pose)| {
        (similarity.apply_point(&from.translation.vector) - to.translation.vector).norm_squared()
    };
    let squares: Vec<f64> = from.iter().zip(&to).map(square).collect();
    for pose in poses.iter_mut().flatten() {
        *pose = similarity.apply(pose);
    }
    let residuals = Residuals {
        pairs: squares.len(),
        rms_m: (squares.iter().sum::<f64>() / squares.len() as f64).sqrt(),
        max_m: squares.iter().fold(0.0, |max: f64, square| max.max(*square)).sqrt(),
    };
    Ok((similarity.scale, Some(residuals)))
}

/// Turns the world about its origin so that z points up; by how many degrees.
fn upright(poses: &mut [Option<Pose>], gravity: Gravity) -> Result<f64, JoinError> {
    let fail = |problem: String| JoinError::Option { option: "--gravity", problem };
    let down: Vector3<f64> = match gravity {
        Gravity::Down(down) => down,
        Gravity::Camera => {
            let known: Vec<&Pose> = poses.iter().flatten().collect();
            let mean: Vector3<f64> = known.iter().map(|pose| pose.rotation * Vector3::y()).sum();
            mean / known.len() as f64
        }
    };
    // The mean of unit vectors that point everywhere is short.
    if down.norm() <= 0.1 || down.norm().is_nan() {
        return Err(fail(format!(
            "found no clear direction down (length {:.3}): give it as x,y,z in the trajectory's world",
            down.norm()
        )));
    }
    let up = -down.normalize();
    // Half a turn is about any level axis.
    let half_turn = UnitQuaternion::from_axis_angle(&Vector3::x_axis(), std::f64::consts::PI);
    let rotation = UnitQuaternion::rotation_between(&up, &Vector3::z()).unwrap_or(half_turn);
    for pose in poses.iter_mut().flatten() {
        *pose = rotation * *pose;
    }
    Ok(rotation.angle().to_degrees())
}

#[cfg(test)]
mod tests {
    use grnet_geometry::StampedPose;
    use grnet_geometry::trajectory::Trajectory;

    use super::*;

    /// A drive around a corner, seen from above, and its frames at 10 Hz.
    fn drive() -> (Vec<RecordedFrame>, Matched) {
        let pose = |i: usize| {
            let t = i as f64 / 10.0;
            Pose::new(Vector3::new(t, t * t, 0.1 * t), Vector3::new(0.0, 0.0, t))
        };
        let frame = |i: usize| RecordedFrame {
            path: format!("{i}.png").into(),
            time_ns: i as u64 * 100_000_000,
            sequence: i as u64,
            world_from_camera: None,
            camera: None,
        };
        let poses = (0..10).map(|i| (i != 4).then(|| pose(i))).collect();
        ((0..10).map(frame).collect(), Matched { poses, in_gaps: 1, ..Matched::default() })
    }

    fn positions(poses: &[Option<Pose>]) -> Vec<Vector3<f64>> {
        poses.iter().flatten().map(|pose| pose.translation.vector).collect()
    }

    #[test]
    fn a_factor_scales_places_and_the_lever_arm_stays_metric() {
        let (frames, matched) = drive();
        let body_from_camera = Pose::translation(0.5, 0.0, 0.0);
        let transform = Transform { scale: Scale::Factor(3.0), body_from_camera, gravity: None };
        let (poses, report) = apply(&frames, &matched, &transform).unwrap();
        let (first, last) = (poses[0].unwrap(), poses[9].unwrap());
        assert!((first.translation.vector - Vector3::new(0.5, 0.0, 0.0)).norm() < 1e-12);
        let body = matched.poses[9].unwrap();
        let wanted = body.translation.vector * 3.0 + body.rotation * Vector3::new(0.5, 0.0, 0.0);
        assert!((last.translation.vector - wanted).norm() < 1e-12);
        assert_eq!((report.with_pose, report.in_gaps, report.scale), (9, 1, 3.0));
        assert_eq!(report.without_pose, [(4, 4)]);
    }

    #[test]
    fn a_measured_distance_gives_the_scale() {
        let (frames, matched) = drive();
        let between = |first, second| Transform {
            scale: Scale::Between { first, second, distance_m: 8.0 },
            ..Transform::default()
        };
        let (poses, report) = apply(&frames, &matched, &between(0, 9)).unwrap();
        let ends = poses[9].unwrap().translation.vector - poses[0].unwrap().translation.vector;
        assert!((ends.norm() - 8.0).abs() < 1e-12 && report.scale > 1.0);
        for (first, second, word) in [(0, 4, "frame 4"), (0, 77, "frame 77"), (3, 3, "one place")] {
            let error = apply(&frames, &matched, &between(first, second)).unwrap_err().to_string();
            assert!(error.contains(word), "{error}");
        }
        let lever = Transform { body_from_camera: Pose::translation(0.1, 0.0, 0.0), ..between(0, 9) };
        assert!(apply(&frames, &matched, &lever).unwrap_err().to_string().contains("give --scale"));
    }

    #[test]
    fn a_reference_gives_scale_and_world_and_its_residuals() {
        let (frames, matched) = drive();
        let moved = Pose::new(Vector3::new(5.0, -2.0, 1.0), Vector3::new(0.3, 0.2, -0.9));
        let reference = |noise: f64| {
            let stamped = |i: i64| {
                let t = i as f64 / 10.0;
                let place = Vector3::new(t, t * t, 0.1 * t) * 2.5 + Vector3::z() * (noise * (i % 2) as f64);
                let place = moved * nalgebra::Point3::from(place);
                StampedPose {
                    time_ns: i * 100_000_000 - 40,
                    world_from_camera: Pose::translation(place.x, place.y, place.z),
                }
            };
            let trajectory = Trajectory::new((0..10).map(stamped).collect()).unwrap();
            let scale = Scale::Reference { trajectory, time_offset_ns: 40, max_gap_ns: 200_000_000 };
            Transform { scale, ..Transform::default() }
        };
        let (poses, report) = apply(&frames, &matched, &reference(0.0)).unwrap();
        assert!((report.scale - 2.5).abs() < 1e-9);
        let residuals = report.reference.unwrap();
        assert!(residuals.pairs == 9 && residuals.max_m < 1e-9, "{residuals:?}");
        let start = poses[0].unwrap().translation.vector - moved.translation.vector;
        assert!(start.norm() < 1e-9);
        let (_, report) = apply(&frames, &matched, &reference(0.2)).unwrap();
        let residuals = report.reference.unwrap();
        assert!(residuals.rms_m > 0.05 && residuals.max_m >= residuals.rms_m, "{residuals:?}");
    }

    #[test]
    fn gravity_puts_z_up_by_a_vector_or_by_the_cameras() {
        let (frames, mut matched) = drive();
        // Cameras that stand upright in a world whose down is x.
        let upright = UnitQuaternion::rotation_between(&Vector3::y(), &Vector3::x()).unwrap();
        for (i, pose) in matched.poses.iter_mut().enumerate() {
            let yaw = UnitQuaternion::from_axis_angle(&Vector3::x_axis(), i as f64 * 0.3);
            *pose = pose.map(|pose| Pose::from_parts(pose.translation, yaw * upright));
        }
        for gravity in [Gravity::Camera, Gravity::Down(Vector3::new(9.81, 0.0, 0.0))] {
            let transform = Transform { gravity: Some(gravity), ..Transform::default() };
            let (poses, report) = apply(&frames, &matched, &transform).unwrap();
            for pose in poses.iter().flatten() {
                assert!((pose.rotation * Vector3::y() + Vector3::z()).norm() < 1e-9, "{gravity:?}");
            }
            assert!((report.turned_deg.unwrap() - 90.0).abs() < 1e-9);
            let length = |p: &[Vector3<f64>]| (p[8] - p[0]).norm();
            let before = length(&positions(&matched.poses));
            assert!((length(&positions(&poses)) - before).abs() < 1e-12);
        }
        let none = Transform { gravity: Some(Gravity::Down(Vector3::zeros())), ..Transform::default() };
        assert!(apply(&frames, &matched, &none).unwrap_err().to_string().contains("no clear direction"));
        let over = Transform { gravity: Some(Gravity::Down(Vector3::z())), ..Transform::default() };
        assert!((apply(&frames, &matched, &over).unwrap().1.turned_deg.unwrap() - 180.0).abs() < 1e-9);
    }
}
