//! The loss of the log-variance heads, which say how far a pose may be off.

use candle_core::{Device, Result, Tensor, bail};
use grnet_geometry::covariance;
use grnet_model::HeadTensors;

use super::motion::Motion;
use super::{Head, Targets, chart};

/// Log-variances beyond +-20 (standard deviations of 45 micrometres and 22 km) stop following the likelihood and are
/// pulled back at a constant rate: exp(20) is still a small f32, and the pipeline takes what is beyond 30 for unknown.
const MAX_LOG_VARIANCE: f64 = 20.0;

/// Gaussian negative log likelihood of a head's pose errors under its log-variances `v`, averaged over windows, frames and
/// the six components: `mean(exp(-v) e^2 + v) / 2`, up to a constant. None where the head writes no log-variances, and for
/// the relative head of windows of a single frame.
///
/// `e` is the error of [`grnet_geometry::covariance`], the convention of the published covariances:
/// `[t_true - t, Log(R_true R^T)]` about the fixed axes of the parent frame, of world_from_camera, or for [`Head::Relative`]
/// of the motion camera_{t-1}_from_camera_t, t = 1..K. It carries no gradient: this loss trains the log-variances and
/// never moves a pose output. The layers below the log-variance layer get its gradient unless the caller detaches that
/// layer's input.
///
/// # Errors
/// When the head's tensors are not of the targets' windows, or a tensor operation fails.
pub fn uncertainty_loss(output: &HeadTensors, targets: &Targets, head: Head) -> Result<Option<Tensor>> {
    let (batch, frames) = (targets.batch(), targets.frames());
    let Some(log_variance) = &output.log_variance else { return Ok(None) };
    let first = match head {
        // Frame 0 is paired with itself and its motion is known to be none.
        Head::Relative => 1,
        Head::Global | Head::Fused => 0,
    };
    if first >= frames {
        return Ok(None);
    }
    if log_variance.dims() != [batch, frames, 6] {
        bail!(
            "the {} head gave log-variances {:?}; the targets need ({batch}, {frames}, 6)",
            head.name(),
            log_variance.dims()
        );
    }
    let motions: Vec<Motion> = match head {
        Head::Relative => (1..frames).map(|t| Motion::Chain(t - 1, t)).collect(),
        Head::Global | Head::Fused => (0..frames).map(Motion::Absolute).collect(),
    };
    let truths = targets.truths(&motions);
    let poses = chart::poses(output, batch, frames)?;
    let mut squares = Vec::with_capacity(6 * truths.len());
    for (window, truths) in poses.chunks_exact(frames).zip(truths.chunks_exact(motions.len())) {
        for (motion, truth) in motions.iter().zip(truths) {
            let error = covariance::error(&motion.of(window), truth);
            squares.extend(error.vector().iter().map(|e| (e * e) as f32));
        }
    }
    let squares =
        Tensor::from_vec(squares, (batch, motions.len(), 6), &Device::Cpu)?.to_device(targets.device())?;
    let v = log_variance.narrow(1, first, motions.len())?.to_device(targets.device())?; // (B, K, 6) -> (B, M, 6)
    let inside = v.clamp(-MAX_LOG_VARIANCE, MAX_LOG_VARIANCE)?;
    let beyond = (&v - &inside)?.abs()?;
    let likelihood = ((squares * inside.neg()?.exp()?)? + &inside)?;
    Ok(Some((likelihood + beyond)?.mean_all()?.affine(0.5, 0.0)?))
}

#[cfg(test)]
mod tests {
    use super::*;
    use candle_core::Var;
    use grnet_geometry::Pose;
    use nalgebra::Vector3;

    fn head(rows: &[[f32; 7]], log_variance: &Var) -> HeadTensors {
        let columns = |range: std::ops::Range<usize>| {
            let (n, k) = (range.len(), rows.len());
            let values: Vec<f32> = rows.iter().flat_map(|row| row[range.clone()].to_vec()).collect();
            Tensor::from_vec(values, (1, k, n), &Device::Cpu).unwrap()
        };
        HeadTensors {
            translation: columns(0..3),
            rotation: columns(3..7),
            log_variance: Some(log_variance.as_tensor().clone()),
        }
    }

    fn log_variance(k: usize, value: f32) -> Var {
        Var::from_tensor(&Tensor::full(value, (1, k, 6), &Device::Cpu).unwrap()).unwrap()
    }

    const IDENTITY: [f32; 7] = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0];

    #[test]
    fn absolute_by_hand_and_its_minimum() {
        // Off by 0.5 m in y and 0.2 rad about the world's x.
        let truth = Pose::new(Vector3::new(0.0, 0.5, 0.0), Vector3::new(0.2, 0.0, 0.0));
        let targets = Targets::new(&[vec![truth]], &Device::Cpu).unwrap();
        let v = log_variance(1, 0.0);
        let loss = uncertainty_loss(&head(&[IDENTITY], &v), &targets, Head::Global).unwrap().unwrap();
        assert!((loss.to_scalar::<f32>().unwrap() - (0.25 + 0.04) / 12.0).abs() < 1e-6);
        // d/dv (exp(-v) e^2 + v) / 12 = (1 - e^2) / 12 at v = 0, by component [translation, rotation].
        let gradient =
            loss.backward().unwrap().get(&v).unwrap().flatten_all().unwrap().to_vec1::<f32>().unwrap();
        for (g, e) in gradient.iter().zip([0.0, 0.5, 0.0, 0.2, 0.0, 0.0]) {
            assert!((g - (1.0 - e * e) / 12.0).abs() < 1e-6, "{gradient:?}");
        }
        let fitted = [1e-4_f32, 0.25, 1e-4, 0.04, 1e-4, 1e-4].map(f32::ln);
        v.set(&Tensor::from_slice(&fitted, (1, 1, 6), &Device::Cpu).unwrap()).unwrap();
        let loss = uncertainty_loss(&head(&[IDENTITY], &v), &targets, Head::Fused).unwrap().unwrap();
        let gradient =
            loss.backward().unwrap().get(&v).unwrap().flatten_all().unwrap().to_vec1::<f32>().unwrap();
        assert!(gradient[1].abs() < 1e-6 && gradient[3].abs() < 1e-6, "{gradient:?}");
    }

    #[test]
    fn the_relative_head_ignores_frame_0_and_speaks_of_the_parents_axes() {
        // The world is turned a quarter about z against the first camera; both cameras move 0.5 m along their own x.
        let turn = Pose::new(Vector3::zeros(), Vector3::new(0.0, 0.0, std::f64::consts::FRAC_PI_2));
        let step = Pose::translation(0.5, 0.0, 0.0);
        let targets = Targets::new(&[vec![turn, turn * step]], &Device::Cpu).unwrap();
        let v = log_variance(2, 0.0);
        let wild = [9.0, 9.0, 9.0, 1.0, 0.0, 0.0, 0.0];
        let loss = uncertainty_loss(&head(&[wild, IDENTITY], &v), &targets, Head::Relative).unwrap().unwrap();
        assert!((loss.to_scalar::<f32>().unwrap() - 0.25 / 12.0).abs() < 1e-6);
        let gradient =
            loss.backward().unwrap().get(&v).unwrap().flatten_all().unwrap().to_vec1::<f32>().unwrap();
        assert_eq!(gradient[..6], [0.0; 6]);
        assert!(
            (gradient[6] - 0.75 / 12.0).abs() < 1e-6 && (gradient[7] - 1.0 / 12.0).abs() < 1e-6,
            "{gradient:?}"
        );
        let one = Targets::new(&[vec![turn]], &Device::Cpu).unwrap();
        assert!(
            uncertainty_loss(&head(&[IDENTITY], &log_variance(1, 0.0)), &one, Head::Relative)
                .unwrap()
                .is_none()
        );
    }

    #[test]
    fn the_pose_gets_no_gradient_and_a_wild_variance_comes_back() {
        let targets = Targets::new(&[vec![Pose::translation(1.0, 0.0, 0.0)]], &Device::Cpu).unwrap();
        for (value, sign) in [(-200.0, -1.0), (200.0, 1.0)] {
            let v = log_variance(1, value);
            let mut output = head(&[IDENTITY], &v);
            let translation = Var::from_tensor(&output.translation).unwrap();
            let rotation = Var::from_tensor(&output.rotation).unwrap();
            (output.translation, output.rotation) =
                (translation.as_tensor().clone(), rotation.as_tensor().clone());
            let loss = uncertainty_loss(&output, &targets, Head::Global).unwrap().unwrap();
            assert!(loss.to_scalar::<f32>().unwrap().is_finite());
            let gradients = loss.backward().unwrap();
            assert!(gradients.get(&translation).is_none() && gradients.get(&rotation).is_none());
            let gradient = gradients.get(&v).unwrap().flatten_all().unwrap().to_vec1::<f32>().unwrap();
            assert!(gradient.iter().all(|g| (g - sign / 12.0).abs() < 1e-6), "{gradient:?}");
        }
    }

    #[test]
    fn another_shape_is_refused() {
        let targets = Targets::new(&[vec![Pose::identity(); 2]], &Device::Cpu).unwrap();
        let output = head(&[IDENTITY; 2], &log_variance(3, 0.0));
        let error = uncertainty_loss(&output, &targets, Head::Fused).unwrap_err().to_string();
        assert!(error.contains("fused") && error.contains("(1, 2, 6)"), "{error}");
    }
}
