//! The differences between predicted and true motions as one differentiable operation.
//!
//! Composition, logarithm and projection are computed in f64 with an analytic gradient: candle's own gradients are NaN
//! where a square root meets 0, which a perfect prediction is, and a window is a few dozen numbers, so the copy to the CPU
//! costs less than the many small operations it replaces.

use candle_core::{CpuStorage, CustomOp1, DType, Device, Layout, Result, Shape, Tensor, bail};
use grnet_geometry::{Pose, quaternion, se3};
use grnet_model::HeadTensors;
use nalgebra::{Matrix3x6, Quaternion, Vector3, Vector4};

use super::chart;
use super::motion::{Gradient, Motion};

/// How a difference of two poses is written; the translation is `t - t_true` in both.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Space {
    /// 7 numbers, `q - q_true`: the components of the paper's `P - P_true`.
    ///
    /// `q_true` has w >= 0. Where a quaternion is what the head wrote, `q` is that, not normalised; where it had to be
    /// computed (composition, 6-D rotation), `q` is the unit quaternion, of the two signs the nearer one.
    Quaternion,
    /// 6 numbers, `Log(R_true^T R)` in radians, of length at most pi.
    Log,
}

impl Space {
    const fn size(self) -> usize {
        match self {
            Self::Quaternion => 7,
            Self::Log => 6,
        }
    }
}

/// The operation: (B, K, 3 + 4 or 6) outputs of a head -> (B, M, 7 or 6) differences of its M motions.
#[derive(Debug, Clone)]
pub(super) struct Residuals {
    pub(super) space: Space,
    /// Frames per window, K.
    pub(super) frames: usize,
    /// The M motions, the same in every window.
    pub(super) motions: Vec<Motion>,
    /// Their true values, B * M.
    pub(super) truths: Vec<Pose>,
}

impl Residuals {
    /// The differences of a head's motions, on `device`.
    ///
    /// # Errors
    /// When the head's tensors are not of B windows of K frames in f32, or a copy fails.
    pub(super) fn of(self, head: &HeadTensors, device: &Device) -> Result<Tensor> {
        let batch = self.truths.len() / self.motions.len().max(1);
        let rows = chart::rows(head, batch, self.frames)?;
        rows.apply_op1(self)?.to_device(device)
    }

    fn values(&self, rows: &[f64], row_length: usize) -> Vec<f64> {
        let windows = rows.chunks_exact(self.frames * row_length);
        let truths = self.truths.chunks_exact(self.motions.len());
        let mut values = Vec::with_capacity(self.truths.len() * self.space.size());
        for (window, truths) in windows.zip(truths) {
            let frames: Vec<Pose> = window.chunks_exact(row_length).map(chart::pose).collect();
            for (motion, truth) in self.motions.iter().zip(truths) {
                let predicted = motion.of(&frames);
                values.extend((predicted.translation.vector - truth.translation.vector).iter());
                match self.space {
                    Space::Log => {
                        values.extend(se3::so3_log(&(truth.rotation.inverse() * predicted.rotation)).iter());
                    }
                    Space::Quaternion => {
                        let q = match self.raw_quaternion(*motion, row_length) {
                            Some(at) => Vector4::from_column_slice(&window[at..at + 4]),
                            None => nearer(&predicted, truth),
                        };
                        values.extend((q - canonical(truth)).iter());
                    }
                }
            }
        }
        values
    }

    /// The derivative with respect to the rows, from that with respect to [`Residuals::values`].
    fn pull_back(&self, rows: &[f64], row_length: usize, gradient: &[f64]) -> Vec<f64> {
        let size = self.space.size();
        let mut result = vec![0.0; rows.len()];
        let windows = rows.chunks_exact(self.frames * row_length);
        let windows = windows.zip(result.chunks_exact_mut(self.frames * row_length));
        let truths = self.truths.chunks_exact(self.motions.len());
        let gradients = gradient.chunks_exact(self.motions.len() * size);
        for (((window, result), truths), gradients) in windows.zip(truths).zip(gradients) {
            let frames: Vec<Pose> = window.chunks_exact(row_length).map(chart::pose).collect();
            let mut on_frames = vec![Gradient::ZERO; self.frames];
            for ((motion, truth), g) in self.motions.iter().zip(truths).zip(gradients.chunks_exact(size)) {
                let translation = Vector3::new(g[0], g[1], g[2]);
                let predicted = motion.of(&frames);
                let rotation = match (self.space, self.raw_quaternion(*motion, row_length)) {
                    // Log(E Exp(d)) with E = R_true^T R and d about R_true's axes: J^-1(log E) R_true^T d_theta.
                    (Space::Log, _) => {
                        let log = se3::so3_log(&(truth.rotation.inverse() * predicted.rotation));
                        let inner =
                            se3::so3_left_jacobian_inverse(&log).transpose() * Vector3::new(g[3], g[4], g[5]);
                        truth.rotation * inner
                    }
                    // The numbers themselves, not the rotation that they stand for.
                    (Space::Quaternion, Some(at)) => {
                        (0..4).for_each(|i| result[at + i] += g[3 + i]);
                        Vector3::zeros()
                    }
                    // d_q = (d_theta, 0) q / 2
                    (Space::Quaternion, None) => {
                        let q = nearer(&predicted, truth);
                        let (v, g_v) = (q.xyz(), Vector3::new(g[3], g[4], g[5]));
                        (g_v * q.w + v.cross(&g_v) - v * g[6]) * 0.5
                    }
                };
                motion.pull_back(&frames, &Gradient { translation, rotation }, &mut on_frames);
            }
            for (i, g) in on_frames.iter().enumerate() {
                let row = i * row_length..(i + 1) * row_length;
                let on_raw = on_raw_rotation(&window[row.clone()][3..], &g.rotation);
                let into = &mut result[row];
                (0..3).for_each(|axis| into[axis] += g.translation[axis]);
                into[3..].iter_mut().zip(on_raw).for_each(|(into, g)| *into += g);
            }
        }
        result
    }

    /// Where in a window's numbers the quaternion stands that the head wrote for this motion.
    fn raw_quaternion(&self, motion: Motion, row_length: usize) -> Option<usize> {
        motion.direct().filter(|_| row_length == 7).map(|frame| frame * row_length + 3)
    }
}

impl CustomOp1 for Residuals {
    fn name(&self) -> &'static str {
        "pose-residuals"
    }

    fn cpu_fwd(&self, storage: &CpuStorage, layout: &Layout) -> Result<(CpuStorage, Shape)> {
        let (CpuStorage::F32(values), Some((start, end))) = (storage, layout.contiguous_offsets()) else {
            bail!("pose residuals need contiguous f32 numbers");
        };
        let (batch, _, row_length) = layout.shape().dims3()?;
        let rows: Vec<f64> = values[start..end].iter().copied().map(f64::from).collect();
        let residuals = self.values(&rows, row_length).into_iter().map(|v| v as f32).collect();
        Ok((CpuStorage::F32(residuals), Shape::from((batch, self.motions.len(), self.space.size()))))
    }

    fn bwd(&self, arg: &Tensor, _res: &Tensor, grad_res: &Tensor) -> Result<Option<Tensor>> {
        let row_length = arg.dim(2)?;
        let gradient = self.pull_back(&numbers(arg)?, row_length, &numbers(grad_res)?);
        let gradient = gradient.into_iter().map(|v| v as f32).collect();
        Ok(Some(Tensor::from_vec(gradient, arg.shape(), arg.device())?))
    }
}

fn numbers(tensor: &Tensor) -> Result<Vec<f64>> {
    tensor.flatten_all()?.to_dtype(DType::F64)?.to_vec1() // (B, n, m) -> B * n * m
}

fn canonical(pose: &Pose) -> Vector4<f64> {
    Vector4::from(quaternion::xyzw(&pose.rotation))
}

/// The sign of the predicted quaternion that is nearer to the canonical true one.
fn nearer(predicted: &Pose, truth: &Pose) -> Vector4<f64> {
    let q: &Quaternion<f64> = predicted.rotation.quaternion();
    if q.coords.dot(&canonical(truth)) < 0.0 { -q.coords } else { q.coords }
}

fn on_raw_rotation(raw: &[f64], on_rotation: &Vector3<f64>) -> impl Iterator<Item = f64> + use<> {
    let jacobian: Matrix3x6<f64> = chart::jacobian(raw);
    let on_raw = jacobian.transpose() * on_rotation;
    (0..raw.len()).map(move |i| on_raw[i])
}

#[cfg(test)]
mod tests;
