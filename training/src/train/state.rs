//! The trainer's part of a saved state: weights, running statistics, loss weights, moments.

use std::collections::BTreeMap;

use candle_core::{Device, Tensor};
use grnet_model::ops::{Adam, AdamMoments, AdamState};

use super::TrainError;
use super::parameters::Parameters;
use crate::loss::Homoscedastic;
use crate::run::{State, StateTensor};

const FIRST: &str = "adam.m.";
const SECOND: &str = "adam.v.";
const UPDATES: &str = "adam.steps.";
const LOSS: &str = "loss.";
const OPTIMIZER_STEPS: &str = "optimizer_steps";
const STAGE_STEP: &str = "stage_step";

/// Where a run is.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Position {
    /// Steps over all stages.
    pub step: u64,
    /// Index of the stage.
    pub stage: usize,
    /// Steps of that stage.
    pub stage_step: u64,
}

/// Everything that goes into a file; no moments where the next step is the first of a stage.
///
/// # Errors
/// When memory runs out.
pub fn pack(
    at: Position,
    parameters: &Parameters,
    homoscedastic: Option<&Homoscedastic>,
    adam: Option<&Adam>,
) -> Result<State, TrainError> {
    let mut tensors = BTreeMap::new();
    for (name, tensor) in parameters.snapshot()? {
        tensors.insert(name, values(&tensor)?);
    }
    for (name, var) in homoscedastic.into_iter().flat_map(Homoscedastic::vars) {
        tensors.insert(name, values(var.as_tensor())?);
    }
    let mut numbers = BTreeMap::from([(STAGE_STEP.to_owned(), at.stage_step.into())]);
    let AdamState { moments, steps } = adam.map(Adam::state).transpose()?.unwrap_or_default();
    numbers.insert(OPTIMIZER_STEPS.to_owned(), steps.into());
    for (name, AdamMoments { first, second, steps }) in moments {
        let shape = vec![first.len()];
        tensors.insert(format!("{FIRST}{name}"), StateTensor { shape: shape.clone(), values: first });
        tensors.insert(format!("{SECOND}{name}"), StateTensor { shape, values: second });
        numbers.insert(format!("{UPDATES}{name}"), steps.into());
    }
    Ok(State { step: at.step, stage: at.stage, tensors, numbers })
}

/// Where the state was taken.
///
/// # Errors
/// When it lacks a number.
pub fn position(state: &State) -> Result<Position, TrainError> {
    Ok(Position { step: state.step, stage: state.stage, stage_step: number(state, STAGE_STEP)? })
}

/// Puts weights and loss weights back; the optimizer of the stage follows with [`restore_adam`].
///
/// # Errors
/// When the state is of another network.
pub fn restore_weights(
    state: &State,
    parameters: &mut Parameters,
    homoscedastic: Option<&Homoscedastic>,
    device: &Device,
) -> Result<(), TrainError> {
    let tensor = |stored: &StateTensor| Tensor::from_slice(&stored.values, stored.shape.as_slice(), device);
    let weights =
        state.tensors.iter().filter(|(name, _)| !name.starts_with("adam.") && !name.starts_with(LOSS));
    let weights: Vec<_> = weights
        .map(|(name, stored)| Ok((name.clone(), tensor(stored)?)))
        .collect::<Result<_, TrainError>>()?;
    parameters.restore(weights)?;
    for (name, var) in homoscedastic.into_iter().flat_map(Homoscedastic::vars) {
        let stored = state.tensors.get(&name).ok_or(TrainError::State { what: name })?;
        var.set(&tensor(stored)?)?;
    }
    Ok(())
}

/// Puts the moments back.
///
/// # Errors
/// When the state has no moments of a parameter.
pub fn restore_adam(state: &State, adam: &mut Adam) -> Result<(), TrainError> {
    let mut moments = BTreeMap::new();
    for name in adam.lengths().into_keys() {
        let find = |kind: &str| {
            let key = format!("{kind}{name}");
            state.tensors.get(&key).map(|stored| stored.values.clone()).ok_or(TrainError::State { what: key })
        };
        let (first, second) = (find(FIRST)?, find(SECOND)?);
        let steps = number(state, &format!("{UPDATES}{name}"))?;
        moments.insert(name, AdamMoments { first, second, steps });
    }
    Ok(adam.restore(AdamState { moments, steps: number(state, OPTIMIZER_STEPS)? })?)
}

fn values(tensor: &Tensor) -> Result<StateTensor, TrainError> {
    Ok(StateTensor { shape: tensor.dims().to_vec(), values: tensor.flatten_all()?.to_vec1()? })
}

fn number(state: &State, name: &str) -> Result<u64, TrainError> {
    let found = state.numbers.get(name).and_then(serde_json::Value::as_u64);
    found.ok_or_else(|| TrainError::State { what: format!("the number \"{name}\"") })
}
