//! Alignment recovers known transforms, and says when it cannot.

use grnet_geometry::{
    Pose,
    align::{Alignment, AlignmentError, Similarity, scale_about_origin, umeyama},
    nalgebra::{Vector3, Vector6},
    se3::{self, Tangent},
};
use proptest::prelude::*;

fn pose() -> impl Strategy<Value = Pose> {
    prop::array::uniform6(-3.0..3.0f64).prop_map(|v| se3::exp(&Tangent(Vector6::from(v))))
}

proptest! {
    #[test]
    fn a_known_similarity_is_recovered(
        poses in prop::collection::vec(pose(), 5..40), motion in pose(), scale in 0.05..20.0f64,
    ) {
        let truth = Similarity { scale, rotation: motion.rotation, translation: motion.translation.vector };
        let moved: Vec<Pose> = poses.iter().map(|p| truth.apply(p)).collect();
        let found = Alignment::Sim3.solve(&poses, &moved).unwrap();
        prop_assert!((found.scale / scale - 1.0).abs() < 1e-9);
        prop_assert!(found.rotation.angle_to(&truth.rotation) < 1e-7);
        prop_assert!((found.translation - truth.translation).norm() < 1e-7 * scale.max(1.0));

        let rigid = Similarity { scale: 1.0, ..truth };
        let moved: Vec<Pose> = poses.iter().map(|p| rigid.apply(p)).collect();
        let found = Alignment::Se3.solve(&poses, &moved).unwrap();
        prop_assert_eq!(found.scale, 1.0);
        prop_assert!(found.rotation.angle_to(&truth.rotation) < 1e-7);

        let stretched: Vec<Pose> = poses.iter().map(|p| Similarity { scale, ..Similarity::identity() }.apply(p)).collect();
        let found = Alignment::Scale.solve(&poses, &stretched).unwrap();
        prop_assert!((found.scale / scale - 1.0).abs() < 1e-9);
        prop_assert_eq!(found, Similarity { scale: found.scale, ..Similarity::identity() });
    }

    #[test]
    fn no_small_change_fits_better(
        from in prop::collection::vec(prop::array::uniform3(-2.0..2.0f64), 4..20),
        to in prop::collection::vec(prop::array::uniform3(-2.0..2.0f64), 20),
        change in prop::array::uniform6(-0.01..0.01f64), stretch in 0.99..1.01f64,
    ) {
        let from: Vec<Vector3<f64>> = from.into_iter().map(Vector3::from).collect();
        let to: Vec<Vector3<f64>> = to.into_iter().take(from.len()).map(Vector3::from).collect();
        let cost = |s: &Similarity| from.iter().zip(&to).map(|(x, y)| (s.apply_point(x) - y).norm_squared()).sum::<f64>();
        let best = umeyama(&from, &to, true).unwrap();
        let step = se3::exp(&Tangent(Vector6::from(change)));
        let other = Similarity {
            scale: best.scale * stretch,
            rotation: step.rotation * best.rotation,
            translation: best.translation + step.translation.vector,
        };
        prop_assert!(cost(&best) <= cost(&other) + 1e-9);
    }
}

#[test]
fn a_plane_is_enough_and_never_mirrored() {
    let from: Vec<Vector3<f64>> =
        (0..20).map(|i| Vector3::new(f64::from(i % 5), f64::from(i / 5), 0.0)).collect();
    let mirrored: Vec<Vector3<f64>> = from.iter().map(|p| Vector3::new(-p.x, p.y, 0.0)).collect();
    let found = umeyama(&from, &mirrored, false).unwrap();
    // Half a turn about y maps the plane to its mirror image without a reflection.
    for (x, y) in from.iter().zip(&mirrored) {
        assert!((found.apply_point(x) - y).norm() < 1e-12);
    }
    assert!((found.rotation.to_rotation_matrix().matrix().determinant() - 1.0).abs() < 1e-12);
}

#[test]
fn what_determines_no_alignment_is_refused() {
    let degenerate = |from: &[Vector3<f64>]| umeyama(from, from, true).unwrap_err();
    assert_eq!(degenerate(&[]), AlignmentError::Degenerate { points: 0, dimensions: 0 });
    assert_eq!(
        degenerate(&[Vector3::new(1.0, 2.0, 3.0)]),
        AlignmentError::Degenerate { points: 1, dimensions: 0 }
    );
    let still = [Vector3::new(1e3, 2.0, -3.0); 50];
    assert_eq!(degenerate(&still), AlignmentError::Degenerate { points: 50, dimensions: 0 });
    // Far from the origin rounding spreads a line sideways; it is still a line.
    let line: Vec<Vector3<f64>> =
        (0..50).map(|i| Vector3::new(1e5, 2e5, -3e5) + Vector3::new(0.3, 0.7, 0.1) * f64::from(i)).collect();
    assert_eq!(degenerate(&line), AlignmentError::Degenerate { points: 50, dimensions: 1 });

    let two = [Vector3::zeros(), Vector3::new(1.0, 0.0, 0.0)];
    assert_eq!(umeyama(&two, &two[..1], true), Err(AlignmentError::LengthMismatch { from: 2, to: 1 }));
    let nan = [Vector3::zeros(), Vector3::new(f64::NAN, 0.0, 0.0)];
    assert_eq!(umeyama(&two, &nan, true), Err(AlignmentError::NotFinite { index: 1 }));
    assert_eq!(Alignment::None.solve(&[], &[]), Ok(Similarity::identity()));

    assert_eq!(scale_about_origin(&two, &[Vector3::zeros(), Vector3::new(2.0, 5.0, 0.0)]), Ok(2.0));
    assert!(scale_about_origin(&[Vector3::zeros()], &[Vector3::zeros()]).is_err());
    assert_eq!(scale_about_origin(&two, &nan), Err(AlignmentError::NotFinite { index: 1 }));
}
