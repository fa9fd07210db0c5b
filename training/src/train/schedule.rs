//! Learning rates over the steps of a stage.

use serde::{Deserialize, Serialize};

/// How the learning rate falls.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Decay {
    /// Halved at every fifth of the steps, as in the paper (section "Network Training").
    #[default]
    HalveEveryFifth,
    /// Half a cosine from the full rate to a fiftieth of it.
    Cosine,
    /// No decay.
    Constant,
}

/// The learning rate of every step of a stage.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Schedule {
    /// Rate at the start, after the warm-up.
    pub learning_rate: f64,
    /// Steps of a linear rise from almost nothing to the full rate.
    pub warmup_steps: u64,
    /// How it falls.
    pub decay: Decay,
    /// All steps of the stage.
    pub steps: u64,
}

impl Schedule {
    /// The rate of step `step`, counted from 0.
    pub fn at(&self, step: u64) -> f64 {
        let done = step as f64 / self.steps.max(1) as f64;
        let factor = match self.decay {
            Decay::HalveEveryFifth => 0.5f64.powi((done * 5.0).floor().clamp(0.0, 4.0) as i32),
            Decay::Cosine => 0.02 + 0.98 * 0.5 * (1.0 + (std::f64::consts::PI * done.min(1.0)).cos()),
            Decay::Constant => 1.0,
        };
        let warmup = (step + 1) as f64 / (self.warmup_steps + 1) as f64;
        self.learning_rate * factor * warmup.min(1.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_papers_schedule_halves_four_times() {
        let schedule =
            Schedule { learning_rate: 1e-3, warmup_steps: 0, decay: Decay::HalveEveryFifth, steps: 100 };
        let rates = [0, 19, 20, 40, 60, 80, 99].map(|step| schedule.at(step));
        assert_eq!(rates, [1e-3, 1e-3, 5e-4, 2.5e-4, 1.25e-4, 6.25e-5, 6.25e-5]);
    }

    #[test]
    fn a_warm_up_rises_and_a_cosine_ends_low() {
        let schedule = Schedule { learning_rate: 1.0, warmup_steps: 9, decay: Decay::Cosine, steps: 1000 };
        assert!((schedule.at(0) - 0.1).abs() < 1e-6);
        assert!(schedule.at(8) < schedule.at(10));
        assert!((schedule.at(1000) - 0.02).abs() < 1e-9);
        let flat = Schedule { decay: Decay::Constant, ..schedule };
        assert_eq!(flat.at(500), 1.0);
    }
}
