//! Whole losses: by hand, perfect predictions, gradients by central differences, half turns, signs, window lengths.

use candle_core::{Device, Tensor, Var};
use grnet_geometry::{Pose, quaternion, se3};
use nalgebra::{UnitQuaternion, Vector3};
use rand::{Rng, SeedableRng};

use super::*;

/// A head's output whose numbers are variables.
struct Output {
    translation: Var,
    rotation: Var,
}

impl Output {
    fn new(rows: &[Vec<(Vector3<f64>, Vec<f64>)>]) -> Self {
        let (b, k, n) = (rows.len(), rows[0].len(), rows[0][0].1.len());
        let t: Vec<f32> = rows
            .iter()
            .flatten()
            .flat_map(|(t, _)| t.iter().map(|v| *v as f32).collect::<Vec<_>>())
            .collect();
        let r: Vec<f32> = rows.iter().flatten().flat_map(|(_, r)| r.iter().map(|v| *v as f32)).collect();
        let var = |values, shape| Var::from_vec::<_, f32>(values, shape, &Device::Cpu).unwrap();
        Self { translation: var(t, (b, k, 3)), rotation: var(r, (b, k, n)) }
    }

    /// `size` scales the raw rotation; a negative one flips the sign of a quaternion.
    fn of(windows: &[Vec<Pose>], six: bool, size: f64) -> Self {
        let raw = |pose: &Pose| match six {
            true => quaternion::to_6d(&pose.rotation).map(|v| size * v).to_vec(),
            false => quaternion::xyzw(&pose.rotation).map(|v| size * v).to_vec(),
        };
        let row = |pose: &Pose| (pose.translation.vector, raw(pose));
        Self::new(&windows.iter().map(|w| w.iter().map(row).collect()).collect::<Vec<_>>())
    }

    fn head(&self) -> HeadTensors {
        HeadTensors {
            translation: self.translation.as_tensor().clone(),
            rotation: self.rotation.as_tensor().clone(),
            log_variance: None,
        }
    }

    fn gradients(&self, total: &Tensor) -> Vec<f32> {
        let gradients = total.backward().unwrap();
        let of = |var: &Var| match gradients.get(var) {
            Some(g) => g.flatten_all().unwrap().to_vec1::<f32>().unwrap(),
            None => panic!("no gradient"),
        };
        [of(&self.translation), of(&self.rotation)].concat()
    }
}

fn value(tensor: &Tensor) -> f64 {
    f64::from(tensor.to_scalar::<f32>().unwrap())
}

fn part(terms: &Terms, name: &str) -> f64 {
    value(&terms.parts.iter().find(|(n, _)| *n == name).unwrap_or_else(|| panic!("{name}")).1)
}

fn walks(batch: usize, frames: usize, seed: u64) -> Vec<Vec<Pose>> {
    let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(seed);
    let mut random = |size: f64| Vector3::from_fn(|_, _| rng.random_range(-size..size));
    let mut walk = || {
        let mut pose = Pose::new(random(2.0), random(1.5));
        (0..frames)
            .map(|_| {
                pose *= Pose::new(random(0.3), random(0.2));
                pose
            })
            .collect()
    };
    (0..batch).map(|_| walk()).collect()
}

/// What RCNN1 should give: the motion of each step; for frame 0, whose output is in no term, nonsense.
fn steps(windows: &[Vec<Pose>]) -> Vec<Vec<Pose>> {
    let nonsense = Pose::new(Vector3::new(7.0, 8.0, 9.0), Vector3::new(1.0, 0.0, 0.0));
    let step = |w: &[Pose], t: usize| if t == 0 { nonsense } else { se3::relative(&w[t - 1], &w[t]) };
    windows.iter().map(|w| (0..w.len()).map(|t| step(w, t)).collect()).collect()
}

fn disturbed(windows: &[Vec<Pose>], metres: f64, radians: f64) -> Vec<Vec<Pose>> {
    let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(99);
    let mut random = |size: f64| Vector3::from_fn(|_, _| rng.random_range(-size..size));
    let mut disturb = |pose: &Pose| {
        let rotation = pose.rotation * se3::so3_exp(&random(radians));
        Pose::from_parts((pose.translation.vector + random(metres)).into(), rotation)
    };
    windows.iter().map(|w| w.iter().map(&mut disturb).collect()).collect()
}

/// Of either norm.
fn weights(windows: &[Vec<Pose>]) -> [Homoscedastic; 2] {
    let heads = [Head::Relative, Head::Global, Head::Fused];
    [Norm::Squares, Norm::Length].map(|norm| {
        Homoscedastic::initial(norm, &TargetStatistics::of(windows), &heads, &Device::Cpu).unwrap()
    })
}

/// All losses of a head, with the learned weights where `weights` are given.
fn losses(output: &Output, targets: &Targets, weights: Option<&[Homoscedastic; 2]>) -> Vec<(String, Terms)> {
    let mut losses = Vec::new();
    for (kind, at) in [(Loss::Paper, 0), (Loss::Learned, 0), (Loss::Robust, 1)] {
        let weights = weights.map(|weights| &weights[at]);
        for head in [Head::Global, Head::Fused] {
            let terms = joint_loss(kind, &output.head(), targets, head, weights).unwrap();
            losses.push((format!("{kind:?} {head:?}"), terms));
        }
        if targets.frames() > 1 {
            let terms = relative_loss(kind, &output.head(), targets, weights).unwrap();
            losses.push((format!("{kind:?} Relative"), terms));
        }
    }
    losses
}

#[test]
fn paper_by_hand() {
    // K = 2, true poses: the origin, then 1 m along x. Predicted: both 0.3 m too far along y, the second's quaternion
    // (0, 0, 0.1, 1), not normalised.
    let truth = vec![Pose::identity(), Pose::translation(1.0, 0.0, 0.0)];
    let targets = Targets::new(std::slice::from_ref(&truth), &Device::Cpu).unwrap();
    let output = Output::new(&[vec![
        (Vector3::new(0.0, 0.3, 0.0), vec![0.0, 0.0, 0.0, 1.0]),
        (Vector3::new(1.0, 0.3, 0.0), vec![0.0, 0.0, 0.1, 1.0]),
    ]]);
    // Absolute: 2 x 0.09 / 3 and 0.01 / 4. Pair: no translation error; the unit quaternion of (0, 0, 0.1, 1) against none:
    // |q - q*|^2 = 2 - 2 w.
    let w = 1.0 / 1.01_f64.sqrt();
    let expected = 0.06 + 0.01 / 4.0 + (2.0 - 2.0 * w) / 4.0;
    let terms = joint_loss(Loss::Paper, &output.head(), &targets, Head::Global, None).unwrap();
    assert!((value(&terms.total) - expected).abs() < 1e-6, "{} {expected}", value(&terms.total));
    assert!((part(&terms, "absolute_translation_m") - 0.3).abs() < 1e-6);
    let angle = 2.0 * 0.1_f64.atan().to_degrees();
    assert!((part(&terms, "absolute_rotation_deg") - angle / 2.0).abs() < 1e-4);
    assert!(part(&terms, "pairs_translation_m").abs() < 1e-6);
    assert!((part(&terms, "pairs_rotation_deg") - angle).abs() < 1e-4);

    // As motions of steps: only the second counts, its numbers as they stand.
    let terms = relative_loss(Loss::Paper, &output.head(), &targets, None).unwrap();
    assert!((value(&terms.total) - (0.09 / 3.0 + 0.01 / 4.0)).abs() < 1e-6);
    assert_eq!(terms.parts.len(), 2);
}

#[test]
fn learned_by_hand() {
    // One frame, off by 0.6 m and by 0.3 rad about y, whatever the raw rotation's length.
    let truth = Pose::new(Vector3::new(1.0, 2.0, 3.0), Vector3::new(0.4, 0.5, 0.6));
    let turn = UnitQuaternion::from_axis_angle(&Vector3::y_axis(), 0.3);
    let off = Pose::from_parts(
        (truth.translation.vector + Vector3::new(0.0, 0.0, 0.6)).into(),
        truth.rotation * turn,
    );
    let targets = Targets::new(&[vec![truth]], &Device::Cpu).unwrap();
    for (six, size) in [(false, 1.0), (false, -3.0), (true, 0.5)] {
        let output = Output::of(&[vec![off]], six, size);
        let terms = joint_loss(Loss::Learned, &output.head(), &targets, Head::Fused, None).unwrap();
        assert!((value(&terms.total) - (0.36 + 0.09) / 3.0).abs() < 1e-6);
        let weights = Homoscedastic::initial(
            Norm::Squares,
            &TargetStatistics {
                absolute_translation_m2: 0.25,
                absolute_rotation_rad2: 0.01,
                pairs_translation_m2: 1.0,
                pairs_rotation_rad2: 1.0,
            },
            &[Head::Fused],
            &Device::Cpu,
        )
        .unwrap();
        let terms = joint_loss(Loss::Learned, &output.head(), &targets, Head::Fused, Some(&weights)).unwrap();
        let expected = 0.12 / 0.25 + 0.25_f64.ln() + 0.03 / 0.01 + 0.01_f64.ln();
        assert!((value(&terms.total) - expected).abs() < 1e-5, "{} {expected}", value(&terms.total));
    }
}

#[test]
fn learned_weights_meet_their_own_terms() {
    // Both frames 0.3 m off along y and the second turned by 0.2 rad about z on top: the pair is off by the turn only.
    let truth = vec![Pose::identity(), Pose::translation(1.0, 0.0, 0.0)];
    let off =
        vec![Pose::translation(0.0, 0.3, 0.0), Pose::new(Vector3::new(1.0, 0.3, 0.0), Vector3::z() * 0.2)];
    let targets = Targets::new(&[truth.clone(), truth], &Device::Cpu).unwrap();
    let statistics = TargetStatistics {
        absolute_translation_m2: 0.5,
        absolute_rotation_rad2: 0.1,
        pairs_translation_m2: 0.02,
        pairs_rotation_rad2: 0.004,
    };
    let weights = Homoscedastic::initial(Norm::Squares, &statistics, &[Head::Global], &Device::Cpu).unwrap();
    let output = Output::of(&[off.clone(), off], true, 1.0);
    let terms = joint_loss(Loss::Learned, &output.head(), &targets, Head::Global, Some(&weights)).unwrap();
    let term = |mean_square: f64, variance: f64| mean_square / variance + variance.ln();
    let expected = term(0.03, 0.5) + term(0.04 / 6.0, 0.1) + term(0.0, 0.02) + term(0.04 / 3.0, 0.004);
    assert!((value(&terms.total) - expected).abs() < 1e-5, "{} {expected}", value(&terms.total));
    // As motions of steps: the second frame's output is the pair.
    let weights =
        Homoscedastic::initial(Norm::Squares, &statistics, &[Head::Relative], &Device::Cpu).unwrap();
    let terms = relative_loss(Loss::Learned, &output.head(), &targets, Some(&weights)).unwrap();
    let expected = term(0.03, 0.02) + term(0.04 / 3.0, 0.004);
    assert!((value(&terms.total) - expected).abs() < 1e-5, "{} {expected}", value(&terms.total));
}

#[test]
fn robust_by_hand() {
    // Two windows of one frame: off by 0.3 m and by 3 m, and by 0.2 rad in the second.
    let truth = vec![Pose::identity()];
    let off = |metres: f64, turn: f64| {
        vec![Pose::new(Vector3::new(0.0, metres, 0.0), Vector3::new(turn, 0.0, 0.0))]
    };
    let targets = Targets::new(&[truth.clone(), truth], &Device::Cpu).unwrap();
    let output = Output::of(&[off(0.3, 0.0), off(3.0, 0.2)], true, 1.0);
    let terms = joint_loss(Loss::Robust, &output.head(), &targets, Head::Fused, None).unwrap();
    // Root mean squares of three components, rounded off below a millimetre.
    let length = |error: f64| (error * error / 3.0 + 1e-6).sqrt() - 1e-3;
    let (metres, radians) = ((length(0.3) + length(3.0)) / 2.0, length(0.2) / 2.0);
    assert!((value(&terms.total) - 2.0 * (metres + radians)).abs() < 1e-5, "{}", value(&terms.total));
    // Ten times as far off pulls as hard and no harder.
    let gradient = output.gradients(&terms.total);
    assert!((gradient[1] / gradient[4] - 1.0).abs() < 1e-4, "{gradient:?}");

    let statistics = TargetStatistics {
        absolute_translation_m2: 0.25,
        absolute_rotation_rad2: 0.01,
        pairs_translation_m2: 1.0,
        pairs_rotation_rad2: 1.0,
    };
    let weights = Homoscedastic::initial(Norm::Length, &statistics, &[Head::Fused], &Device::Cpu).unwrap();
    let terms = joint_loss(Loss::Robust, &output.head(), &targets, Head::Fused, Some(&weights)).unwrap();
    let expected = 2.0 * metres / 0.5 + 0.25_f64.ln() + 2.0 * radians / 0.1 + 0.01_f64.ln();
    assert!((value(&terms.total) - expected).abs() < 1e-4, "{} {expected}", value(&terms.total));
}

#[test]
fn a_perfect_prediction_costs_nothing_and_has_finite_gradients() {
    for frames in 1..=11 {
        let windows = walks(2, frames, frames as u64);
        let targets = Targets::new(&windows, &Device::Cpu).unwrap();
        for six in [false, true] {
            let absolute = Output::of(&windows, six, 1.0);
            let relative = Output::of(&steps(&windows), six, 1.0);
            for kind in [Loss::Paper, Loss::Learned, Loss::Robust] {
                let mut checked = vec![(
                    &absolute,
                    joint_loss(kind, &absolute.head(), &targets, Head::Fused, None).unwrap(),
                )];
                if frames > 1 {
                    checked.push((&relative, relative_loss(kind, &relative.head(), &targets, None).unwrap()));
                } else {
                    let error = relative_loss(kind, &relative.head(), &targets, None).unwrap_err();
                    assert!(error.to_string().contains("at least 2 frames"), "{error}");
                }
                for (output, terms) in checked {
                    assert!(value(&terms.total).abs() < 1e-8, "K = {frames}: {}", value(&terms.total));
                    let gradients = output.gradients(&terms.total);
                    assert!(gradients.iter().all(|g| g.abs() < 1e-4), "K = {frames}: {gradients:?}");
                }
            }
        }
    }
}

#[test]
fn exactly_no_motion_is_smooth() {
    let windows = vec![vec![Pose::identity(); 5]];
    let targets = Targets::new(&windows, &Device::Cpu).unwrap();
    for six in [false, true] {
        let output = Output::of(&windows, six, 1.0);
        for (name, terms) in losses(&output, &targets, None) {
            // A rounded length may leave less than a nanometre.
            assert!(value(&terms.total).abs() < 1e-8, "{name}");
            assert!(output.gradients(&terms.total).iter().all(|g| *g == 0.0), "{name}");
        }
    }
}

#[test]
fn gradients_are_central_differences() {
    for frames in [1, 2, 3, 5] {
        let windows = walks(2, frames, 7);
        let weights = weights(&windows);
        let targets = Targets::new(&windows, &Device::Cpu).unwrap();
        for six in [false, true] {
            // Outputs of the right size for absolute poses and for steps alike.
            let output = Output::of(&disturbed(&windows, 0.3, 0.4), six, 1.3);
            let ours: Vec<_> = losses(&output, &targets, Some(&weights))
                .into_iter()
                .map(|(name, terms)| (name, output.gradients(&terms.total)))
                .collect();
            let vars = [&output.translation, &output.rotation];
            let mut at = 0;
            for var in vars {
                let (shape, start) =
                    (var.shape().clone(), var.flatten_all().unwrap().to_vec1::<f32>().unwrap());
                for i in 0..start.len() {
                    let moved = |step: f32| {
                        let mut values = start.clone();
                        values[i] += step;
                        var.set(&Tensor::from_vec(values, &shape, &Device::Cpu).unwrap()).unwrap();
                        losses(&output, &targets, Some(&weights))
                    };
                    let (up, down) = (moved(1e-2), moved(-1e-2));
                    let numeric =
                        up.iter().zip(&down).map(|(u, d)| (value(&u.1.total) - value(&d.1.total)) / 2e-2);
                    for ((name, gradients), numeric) in ours.iter().zip(numeric) {
                        let (g, scale) =
                            (f64::from(gradients[at]), gradients.iter().fold(1.0_f32, |a, g| a.max(g.abs())));
                        let off = (g - numeric).abs() / f64::from(scale);
                        assert!(off < 5e-3, "K = {frames}, {name}, number {at}: {g} {numeric}");
                    }
                    at += 1;
                }
                var.set(&Tensor::from_vec(start, &shape, &Device::Cpu).unwrap()).unwrap();
            }
        }
    }
}

#[test]
fn the_sign_of_a_quaternion_means_nothing_once_it_is_a_rotation() {
    let windows = walks(2, 5, 3);
    let targets = Targets::new(&windows, &Device::Cpu).unwrap();
    let outputs = [1.0, -1.0].map(|sign| Output::of(&disturbed(&windows, 0.2, 0.3), false, sign));
    let [plus, minus] = outputs.map(|o| {
        let terms = joint_loss(Loss::Learned, &o.head(), &targets, Head::Global, None).unwrap();
        value(&terms.total)
    });
    assert!((plus - minus).abs() < 1e-6, "{plus} {minus}");
    // A flipped step changes no longer pair, but it is itself far from the canonical truth.
    let steps = steps(&windows);
    let [plus, minus] = [1.0, -1.0].map(|sign| {
        let output = Output::of(&steps, false, sign);
        value(&relative_loss(Loss::Paper, &output.head(), &targets, None).unwrap().total)
    });
    // Four steps a window, each with |-2 q|^2 / 4 = 1.
    assert!(plus.abs() < 1e-9 && (minus - 4.0).abs() < 1e-4, "{plus} {minus}");
}

#[test]
fn half_turns_are_finite_and_near_ones_point_home() {
    for degrees in [179.0_f64, 179.9, 180.0, 180.1] {
        let turn = UnitQuaternion::from_axis_angle(&Vector3::y_axis(), degrees.to_radians());
        let wrong = Pose::from_parts(Vector3::zeros().into(), turn);
        let targets = Targets::new(&[vec![Pose::identity(); 2]], &Device::Cpu).unwrap();
        for six in [false, true] {
            let output = Output::of(&[vec![Pose::identity(), wrong]], six, 1.0);
            for (name, terms) in losses(&output, &targets, None) {
                let gradients = output.gradients(&terms.total);
                assert!(value(&terms.total).is_finite() && gradients.iter().all(|g| g.is_finite()), "{name}");
            }
            let terms = joint_loss(Loss::Learned, &output.head(), &targets, Head::Fused, None).unwrap();
            let angle = 180.0 - (degrees - 180.0).abs();
            assert!((part(&terms, "pairs_rotation_deg") - angle).abs() < 1e-3);
            // Mean over the only pair, and over two frames of which one is right.
            let expected = 1.5 * angle.to_radians().powi(2) / 3.0;
            assert!((value(&terms.total) - expected).abs() < 1e-4 * expected, "{degrees} {six}");
            let gradients = output.gradients(&terms.total);
            let length: f32 = gradients.iter().map(|g| g * g).sum::<f32>().sqrt();
            assert!(length > 0.1, "{degrees} {six}: {gradients:?}");
        }
    }
}

#[test]
fn numbers_that_are_no_rotation_are_finite_and_nan_is_not_hidden() {
    let windows = walks(1, 3, 5);
    let targets = Targets::new(&windows, &Device::Cpu).unwrap();
    for six in [false, true] {
        let zero = Output::of(&windows, six, 0.0);
        for (name, terms) in losses(&zero, &targets, None) {
            assert!(value(&terms.total).is_finite(), "{name}");
            assert!(zero.gradients(&terms.total).iter().all(|g| g.is_finite()), "{name}");
        }
        let nan = Output::of(&windows, six, f64::NAN);
        for (name, terms) in losses(&nan, &targets, None) {
            assert!(value(&terms.total).is_nan(), "{name}");
        }
    }
}

#[test]
fn what_does_not_fit_is_refused() {
    let windows = walks(2, 3, 1);
    let targets = Targets::new(&windows, &Device::Cpu).unwrap();
    let other = Output::of(&walks(2, 4, 1), false, 1.0);
    let error = joint_loss(Loss::Paper, &other.head(), &targets, Head::Fused, None).unwrap_err().to_string();
    assert!(error.contains("[2, 4, 3]") && error.contains("(2, 3, 3)"), "{error}");
    let output = Output::of(&windows, false, 1.0);
    let error =
        joint_loss(Loss::Paper, &output.head(), &targets, Head::Relative, None).unwrap_err().to_string();
    assert!(error.contains("relative_loss"), "{error}");
}

#[test]
fn a_loss_has_its_name_in_files() {
    assert_eq!(
        serde_json::to_string(&[Loss::Paper, Loss::Learned, Loss::Robust]).unwrap(),
        r#"["paper","learned","robust"]"#
    );
    assert_eq!(serde_json::from_str::<Loss>("\"learned\"").unwrap(), Loss::Learned);
    assert!(serde_json::from_str::<Loss>("\"l2\"").is_err());
}
