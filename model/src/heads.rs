//! The pose heads: fc4 ("inner-product layer" of dimension 3, translation) and fc5 (rotation), which stand on fc3 in the
//! paper (section "Fully-connected fusion layers"), and on fc1 and fc2 while RCNN1 and RCNN2 are trained (section
//! "Training Strategy").
//!
//! Departures: RCNN1 and RCNN2 keep their heads at run time; fc5 may write a 6-D rotation; a `log_variance` layer may
//! stand beside them.

use candle_core::{Module, Result, Tensor};
use candle_nn::{Linear, VarBuilder, linear};

use crate::config::NetworkConfig;

/// Outputs of one head as tensors; the leading dimensions are those of the input.
#[derive(Debug, Clone)]
pub struct HeadTensors {
    /// (..., 3), metres.
    pub translation: Tensor,
    /// (..., 4) as x, y, z, w, or (..., 6); raw, not normalised.
    pub rotation: Tensor,
    /// (..., 6), natural logarithm of the variance: translation (m^2), then rotation (rad^2).
    pub log_variance: Option<Tensor>,
}

impl HeadTensors {
    /// Reshapes every tensor from (B * T, n) to (B, T, n).
    pub(crate) fn unflatten(self, batch: usize, frames: usize) -> Result<Self> {
        let unflatten = |t: &Tensor| t.reshape((batch, frames, ())); // (B * T, n) -> (B, T, n)
        Ok(Self {
            translation: unflatten(&self.translation)?,
            rotation: unflatten(&self.rotation)?,
            log_variance: self.log_variance.as_ref().map(unflatten).transpose()?,
        })
    }

    /// The numbers of a single frame, (1, n).
    pub(crate) fn to_output(&self) -> Result<HeadOutput> {
        let log_variance = self.log_variance.as_ref().map(numbers::<6>).transpose()?;
        let rotation = self.rotation.flatten_all()?.to_vec1::<f32>()?;
        Ok(HeadOutput {
            translation_m: numbers(&self.translation)?,
            rotation_raw: rotation.into_iter().map(f64::from).collect(),
            log_variance,
        })
    }
}

/// Outputs of one head for one frame as plain numbers, raw: the rotation is not normalised.
#[derive(Debug, Clone, PartialEq)]
pub struct HeadOutput {
    /// Translation in metres: of the current camera in the previous camera (relative) or in the world (global, fused).
    pub translation_m: [f64; 3],
    /// Quaternion (x, y, z, w), or the first two columns of the rotation matrix (6 numbers).
    pub rotation_raw: Vec<f64>,
    /// Natural logarithm of the variance of translation (m^2) and rotation (rad^2); none where no such head is live.
    pub log_variance: Option<[f64; 6]>,
}

/// fc4, fc5 and, where configured, `log_variance`.
#[derive(Debug, Clone)]
pub struct PoseHead {
    fc4: Linear,
    fc5: Linear,
    log_variance: Option<Linear>,
}

impl PoseHead {
    /// Keys: `fc4`, `fc5`, `log_variance`, each with `weight` and `bias`.
    ///
    /// # Errors
    /// When a tensor is missing or of another shape.
    pub fn new(config: &NetworkConfig, inputs: usize, vb: VarBuilder<'_>) -> Result<Self> {
        let log_variance =
            config.log_variance.then(|| linear(inputs, 6, vb.pp("log_variance"))).transpose()?;
        Ok(Self {
            fc4: linear(inputs, 3, vb.pp("fc4"))?,
            fc5: linear(inputs, config.rotation.outputs(), vb.pp("fc5"))?,
            log_variance,
        })
    }

    /// Adds to the log-variances [translation, rotation], where there are any.
    ///
    /// # Errors
    /// When the device has no memory.
    pub fn shift_log_variance(&mut self, shift: [f64; 6]) -> Result<()> {
        let Some(layer) = &self.log_variance else { return Ok(()) };
        let weight = layer.weight();
        let shift = Tensor::new(&shift, weight.device())?.to_dtype(weight.dtype())?;
        let bias = layer.bias().map_or_else(|| Ok(shift.clone()), |bias| bias + &shift)?;
        self.log_variance = Some(Linear::new(weight.clone(), Some(bias)));
        Ok(())
    }

    /// (N, inputs) -> (N, 3), (N, 4 or 6) and (N, 6).
    ///
    /// # Errors
    /// When shapes do not fit.
    pub fn forward(&self, x: &Tensor) -> Result<HeadTensors> {
        Ok(HeadTensors {
            translation: self.fc4.forward(x)?,
            rotation: self.fc5.forward(x)?,
            // What says how uncertain a pose is must not change the pose: its gradient ends here.
            log_variance: self.log_variance.as_ref().map(|layer| layer.forward(&x.detach())).transpose()?,
        })
    }
}

fn numbers<const N: usize>(tensor: &Tensor) -> Result<[f64; N]> {
    let values = tensor.flatten_all()?.to_vec1::<f32>()?; // (1, N) -> N numbers
    let values: [f32; N] = values.try_into().map_err(|v: Vec<f32>| {
        candle_core::Error::Msg(format!("{} numbers where {N} were expected", v.len()))
    })?;
    Ok(values.map(f64::from))
}
