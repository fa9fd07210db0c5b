//! The stacked LSTMs of RCNN1 and RCNN2 ("two Long Short-Term Memory (LSTMs) ... each of the LSTM layers has 1000 hidden
//! states"), with PyTorch's parameter names and gate order i, f, g, o:
//!
//! ```text
//! i = sigmoid(W_ii x + b_ii + W_hi h + b_hi)      c' = f c + i g
//! f = sigmoid(W_if x + b_if + W_hf h + b_hf)      h' = o tanh(c')
//! g = tanh   (W_ig x + b_ig + W_hg h + b_hg)
//! o = sigmoid(W_io x + b_io + W_ho h + b_ho)
//! ```

use candle_core::{DType, Device, Result, Tensor};
use candle_nn::{VarBuilder, ops::sigmoid};

/// Hidden and cell state of every layer, each (B, hidden).
#[derive(Debug, Clone)]
pub struct LstmState {
    layers: Vec<(Tensor, Tensor)>,
}

impl LstmState {
    /// (h, c) of every layer, the lowest first; each (B, hidden).
    pub fn layers(&self) -> &[(Tensor, Tensor)] {
        &self.layers
    }

    /// The same numbers, cut off from whatever computed them.
    pub(crate) fn detach(&self) -> Self {
        Self { layers: self.layers.iter().map(|(h, c)| (h.detach(), c.detach())).collect() }
    }
}

#[derive(Debug, Clone)]
struct Cell {
    weight_ih: Tensor,
    weight_hh: Tensor,
    bias_ih: Tensor,
    bias_hh: Tensor,
}

/// Stacked LSTM layers.
#[derive(Debug, Clone)]
pub struct Lstm {
    cells: Vec<Cell>,
    hidden: usize,
}

impl Lstm {
    /// Keys for layer k: `weight_ih_l{k}` (4 hidden, inputs), `weight_hh_l{k}` (4 hidden, hidden), `bias_ih_l{k}` and
    /// `bias_hh_l{k}` (4 hidden).
    ///
    /// # Errors
    /// When a tensor is missing or of another shape.
    pub fn new(inputs: usize, hidden: usize, layers: usize, vb: VarBuilder<'_>) -> Result<Self> {
        let cell = |k: usize| {
            let inputs = if k == 0 { inputs } else { hidden };
            Ok(Cell {
                weight_ih: vb.get((4 * hidden, inputs), &format!("weight_ih_l{k}"))?,
                weight_hh: vb.get((4 * hidden, hidden), &format!("weight_hh_l{k}"))?,
                bias_ih: vb.get(4 * hidden, &format!("bias_ih_l{k}"))?,
                bias_hh: vb.get(4 * hidden, &format!("bias_hh_l{k}"))?,
            })
        };
        Ok(Self { cells: (0..layers).map(cell).collect::<Result<_>>()?, hidden })
    }

    /// The state before the first frame: zeros.
    ///
    /// # Errors
    /// When the device has no memory left.
    pub fn zero_state(&self, batch: usize, device: &Device) -> Result<LstmState> {
        let zeros = Tensor::zeros((batch, self.hidden), DType::F32, device)?;
        Ok(LstmState { layers: vec![(zeros.clone(), zeros); self.cells.len()] })
    }

    /// Runs T steps: (B, T, inputs) -> (B, T, hidden) of the top layer, and the state after the last step.
    ///
    /// # Errors
    /// When shapes do not fit.
    pub fn forward(&self, x: &Tensor, state: &LstmState) -> Result<(Tensor, LstmState)> {
        let mut x = x.clone();
        let mut layers = Vec::with_capacity(self.cells.len());
        for (cell, state) in self.cells.iter().zip(&state.layers) {
            let (outputs, state) = cell.forward(&x, state)?;
            x = outputs;
            layers.push(state);
        }
        Ok((x, LstmState { layers }))
    }
}

impl Cell {
    fn forward(&self, x: &Tensor, state: &(Tensor, Tensor)) -> Result<(Tensor, (Tensor, Tensor))> {
        let (batch, steps, inputs) = x.dims3()?;
        // The inputs of all steps in one product: (B, T, inputs) -> (B * T, inputs) -> (B, T, 4 hidden).
        let projected = x.reshape((batch * steps, inputs))?.matmul(&self.weight_ih.t()?)?;
        let projected = projected.broadcast_add(&(&self.bias_ih + &self.bias_hh)?)?;
        let projected = projected.reshape((batch, steps, ()))?;
        let recurrent = self.weight_hh.t()?; // (hidden, 4 hidden)
        let (mut h, mut c) = state.clone();
        let mut outputs = Vec::with_capacity(steps);
        for step in 0..steps {
            let gates = (projected.narrow(1, step, 1)?.squeeze(1)? + h.matmul(&recurrent)?)?; // (B, 4 hidden)
            let gates = gates.chunk(4, 1)?; // i, f, g, o: each (B, hidden)
            let kept = (sigmoid(&gates[1])? * &c)?;
            let added = (sigmoid(&gates[0])? * gates[2].tanh()?)?;
            c = (kept + added)?;
            h = (sigmoid(&gates[3])? * c.tanh()?)?;
            outputs.push(h.clone());
        }
        Ok((Tensor::stack(&outputs, 1)?, (h, c))) // T x (B, hidden) -> (B, T, hidden)
    }
}
