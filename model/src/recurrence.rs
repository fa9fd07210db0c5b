//! The LSTM over time, in both forms of [`Recurrence`]: the state carried from frame to frame, or a re-run over the
//! pooled features of the last K frames. Windows and streams give the same numbers in either form.

use std::collections::VecDeque;

use candle_core::{Result, Tensor};
use candle_nn::VarBuilder;

use crate::config::{NetworkConfig, Recurrence};
use crate::lstm::{Lstm, LstmState};

/// What one recurrent branch remembers between frames.
#[derive(Debug, Clone, Default)]
pub struct Memory {
    carried: Option<LstmState>,
    pooled: VecDeque<Tensor>,
}

impl Memory {
    /// The carried LSTM state; none before the first frame, after a reset, and with [`Recurrence::RerunLastK`].
    pub fn lstm_state(&self) -> Option<&LstmState> {
        self.carried.as_ref()
    }

    /// How many pooled feature vectors are cached for a re-run; at most K, none with [`Recurrence::Carry`].
    pub fn cached_frames(&self) -> usize {
        self.pooled.len()
    }
}

/// The stacked LSTM of one branch and the rule for its state.
#[derive(Debug, Clone)]
pub struct Recurrent {
    lstm: Lstm,
    recurrence: Recurrence,
    k: usize,
}

impl Recurrent {
    /// Keys as in [`Lstm::new`].
    ///
    /// # Errors
    /// When a tensor is missing or of another shape.
    pub fn new(config: &NetworkConfig, vb: VarBuilder<'_>) -> Result<Self> {
        let lstm = Lstm::new(config.pooled_features(), config.lstm_hidden, config.lstm_layers, vb)?;
        Ok(Self { lstm, recurrence: config.recurrence, k: config.k })
    }

    /// One frame: pooled features (1, F) -> (1, hidden). `memory` moves on if the frame is to be remembered, and stays as it
    /// is if it is not.
    ///
    /// # Errors
    /// When shapes do not fit.
    pub fn step(&self, pooled: &Tensor, memory: &mut Memory, remember: bool) -> Result<Tensor> {
        match self.recurrence {
            Recurrence::Carry => {
                let before = match &memory.carried {
                    Some(state) => state.clone(),
                    None => self.lstm.zero_state(1, pooled.device())?,
                };
                let (y, state) = self.lstm.forward(&pooled.unsqueeze(1)?, &before)?; // (1, F) -> (1, 1, F)
                if remember {
                    // A state that kept its history would keep every earlier frame in memory.
                    memory.carried = Some(state.detach());
                }
                y.squeeze(1) // (1, 1, hidden) -> (1, hidden)
            }
            Recurrence::RerunLastK => {
                let pooled = pooled.detach();
                let earlier = memory.pooled.len().saturating_sub(self.k - 1);
                let frames: Vec<&Tensor> = memory.pooled.iter().skip(earlier).chain([&pooled]).collect();
                let y = self.last_of(&Tensor::stack(&frames, 1)?)?; // up to K x (1, F) -> (1, K, F)
                if remember {
                    memory.pooled.push_back(pooled);
                    if memory.pooled.len() > self.k {
                        memory.pooled.pop_front();
                    }
                }
                Ok(y)
            }
        }
    }

    /// A window from its first frame on: (B, T, F) -> (B, T, hidden).
    ///
    /// # Errors
    /// When shapes do not fit.
    pub fn window(&self, pooled: &Tensor) -> Result<Tensor> {
        let (batch, frames, _) = pooled.dims3()?;
        let zero = self.lstm.zero_state(batch, pooled.device())?;
        // Up to K frames, a re-run from the first frame is the carried state.
        let whole = match self.recurrence {
            Recurrence::Carry => frames,
            Recurrence::RerunLastK => frames.min(self.k),
        };
        let mut outputs = vec![self.lstm.forward(&pooled.narrow(1, 0, whole)?, &zero)?.0]; // (B, whole, hidden)
        for last in whole..frames {
            let y = self.last_of(&pooled.narrow(1, last + 1 - self.k, self.k)?)?; // (B, hidden)
            outputs.push(y.unsqueeze(1)?); // (B, 1, hidden)
        }
        Tensor::cat(&outputs, 1) // (B, T, hidden)
    }

    /// The output after the last of some frames from the zero state: (B, T, F) -> (B, hidden).
    fn last_of(&self, pooled: &Tensor) -> Result<Tensor> {
        let (batch, frames, _) = pooled.dims3()?;
        let zero = self.lstm.zero_state(batch, pooled.device())?;
        let (y, _) = self.lstm.forward(pooled, &zero)?;
        y.narrow(1, frames - 1, 1)?.squeeze(1) // (B, T, hidden) -> (B, hidden)
    }
}
