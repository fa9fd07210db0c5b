//! Learned weights of the terms of a loss (Kendall & Cipolla, *Geometric Loss Functions for Camera Pose Regression with
//! Deep Learning*, CVPR 2017, Eq. 6).

use candle_core::{DType, Device, Result, Tensor, Var, bail};

use super::targets::TargetStatistics;
use super::{Component, Head, Norm, Term};

/// Smallest variance that a weight starts from: 1 mm^2 and (0.06 deg)^2.
const MIN_VARIANCE: f64 = 1e-6;

/// Log-variances `s` of each term of each head: a term `L` counts as `exp(-s) L + s`.
///
/// With `L` a mean of squared components this is, up to the constant factor 1/2 that all terms share and that is left
/// out, the negative log likelihood of Gaussian errors of variance `exp(s)`; its minimum over `s` is at `s = ln L`, so
/// the weights follow what is left of each error. A length `L` counts as `2 exp(-s / 2) L + s`, with its minimum at `s = 2 ln L`: the
/// same for errors with Laplace's tails, so that `exp(s / 2)` is a deviation in both.
#[derive(Debug, Clone)]
pub struct Homoscedastic {
    norm: Norm,
    weights: Vec<(Head, Term, Component, Var)>,
}

impl Homoscedastic {
    /// Weights for the given heads with `s` the logarithm of the mean squared deviation of the targets: every term
    /// starts near 1, as long as nothing is learnt. Started at 0 they starve translation, whose squares are small where a
    /// scene is. [`Homoscedastic::start_at`] puts them where a batch of a network that has learnt something needs them.
    ///
    /// # Errors
    /// When a statistic is not finite or the variables cannot be made.
    pub fn initial(
        norm: Norm,
        statistics: &TargetStatistics,
        heads: &[Head],
        device: &Device,
    ) -> Result<Self> {
        let mut weights = Vec::new();
        for head in heads {
            for (term, component, variance) in [
                (Term::Absolute, Component::Translation, statistics.absolute_translation_m2),
                (Term::Absolute, Component::Rotation, statistics.absolute_rotation_rad2),
                (Term::Pairs, Component::Translation, statistics.pairs_translation_m2),
                (Term::Pairs, Component::Rotation, statistics.pairs_rotation_rad2),
            ] {
                if *head == Head::Relative && term == Term::Absolute {
                    continue;
                }
                if !variance.is_finite() {
                    bail!(
                        "{} cannot start: the targets' variance is {variance}",
                        name(*head, term, component)
                    );
                }
                let s = variance.max(MIN_VARIANCE).ln() as f32;
                weights.push((*head, term, component, Var::from_tensor(&Tensor::new(s, device)?)?));
            }
        }
        Ok(Self { norm, weights })
    }

    /// Puts the weights of a head where their minimum for a batch is: a network that is trained on has small
    /// errors, which weights from the targets' deviations would take a thousand steps to follow.
    ///
    /// `gradient` gives the derivative by each variable of the loss in which the head counts `weight` times. With
    /// `d/ds w (exp(-s) L + s) = w (1 - exp(-s) L)` it tells `L`, and for a length, with `w (1 - exp(-s / 2) L)`, likewise.
    ///
    /// # Errors
    /// When a variable cannot be read or set.
    pub fn start_at(
        &self,
        head: Head,
        weight: f64,
        gradient: impl Fn(&Var) -> Result<Option<f64>>,
    ) -> Result<()> {
        for (_, _, _, var) in self.weights.iter().filter(|(of, ..)| *of == head) {
            let Some(gradient) = gradient(var)? else { continue };
            let s = f64::from(var.to_scalar::<f32>()?);
            let share = 1.0 - gradient / weight;
            let variance = match self.norm {
                Norm::Squares => s.exp() * share,
                Norm::Length => s.exp() * share * share,
            };
            var.set(&Tensor::new(variance.max(MIN_VARIANCE).ln() as f32, var.device())?)?;
        }
        Ok(())
    }

    /// The variables by name, such as `loss.fused.absolute.translation`.
    pub fn vars(&self) -> Vec<(String, Var)> {
        self.weights
            .iter()
            .map(|(head, term, component, s)| (name(*head, *term, *component), s.clone()))
            .collect()
    }

    /// The standard deviations `exp(s / 2)` that the weights stand for (m or rad), by the same names.
    ///
    /// # Errors
    /// When a variable cannot be read.
    pub fn deviations(&self) -> Result<Vec<(String, f64)>> {
        let read = |(name, s): (String, Var)| -> Result<_> {
            let s = s.to_dtype(DType::F64)?.to_scalar::<f64>()?;
            Ok((name, (s / 2.0).exp()))
        };
        self.vars().into_iter().map(read).collect()
    }

    /// The loss with its weight.
    pub(super) fn weigh(
        &self,
        head: Head,
        term: Term,
        component: Component,
        loss: &Tensor,
    ) -> Result<Tensor> {
        let wanted = |w: &&(Head, Term, Component, Var)| (w.0, w.1, w.2) == (head, term, component);
        let Some((.., s)) = self.weights.iter().find(wanted) else {
            bail!(
                "there is no learned weight {}: the weights were made for other heads",
                name(head, term, component)
            );
        };
        self.norm.weigh(loss, s)
    }
}

impl Norm {
    /// `exp(-s) loss + s` for squares, `2 exp(-s / 2) loss + s` for lengths.
    pub(super) fn weigh(self, loss: &Tensor, s: &Tensor) -> Result<Tensor> {
        let weight = match self {
            Self::Squares => s.neg()?.exp()?,
            Self::Length => s.affine(-0.5, 0.0)?.exp()?.affine(2.0, 0.0)?,
        };
        (loss * weight)? + s
    }
}

fn name(head: Head, term: Term, component: Component) -> String {
    format!("loss.{}.{}.{}", head.name(), term.name(), component.name())
}

#[cfg(test)]
mod tests {
    use super::*;

    const STATISTICS: TargetStatistics = TargetStatistics {
        absolute_translation_m2: 0.25,
        absolute_rotation_rad2: 0.04,
        pairs_translation_m2: 1e-4,
        pairs_rotation_rad2: 0.0,
    };

    fn weights(heads: &[Head]) -> Homoscedastic {
        Homoscedastic::initial(Norm::Squares, &STATISTICS, heads, &Device::Cpu).unwrap()
    }

    #[test]
    fn names_and_starting_deviations() {
        let deviations = weights(&[Head::Relative, Head::Fused]).deviations().unwrap();
        let expected = [
            ("loss.relative.pairs.translation", 0.01),
            ("loss.relative.pairs.rotation", 0.001),
            ("loss.fused.absolute.translation", 0.5),
            ("loss.fused.absolute.rotation", 0.2),
            ("loss.fused.pairs.translation", 0.01),
            ("loss.fused.pairs.rotation", 0.001),
        ];
        assert_eq!(deviations.len(), expected.len());
        for ((name, deviation), (expected_name, expected)) in deviations.iter().zip(expected) {
            assert_eq!(name, expected_name);
            assert!((deviation - expected).abs() < 1e-6, "{name}: {deviation}");
        }
    }

    #[test]
    fn a_weight_has_its_minimum_at_the_terms_logarithm() {
        let weights = weights(&[Head::Global]);
        let loss = Var::new(0.25_f32, &Device::Cpu).unwrap();
        let value =
            weights.weigh(Head::Global, Term::Absolute, Component::Translation, loss.as_tensor()).unwrap();
        assert!((value.to_scalar::<f32>().unwrap() - (1.0 + 0.25_f32.ln())).abs() < 1e-6);
        let gradients = value.backward().unwrap();
        let of = |var: &Var| gradients.get(var).unwrap().to_scalar::<f32>().unwrap();
        assert!(of(&weights.vars()[0].1).abs() < 1e-6);
        assert!((of(&loss) - 4.0).abs() < 1e-5);
    }

    #[test]
    fn a_start_from_a_batch_is_at_its_minimum() {
        starts_at_its_minimum(Norm::Squares, 0.0016);
        starts_at_its_minimum(Norm::Length, 0.04);
    }

    fn starts_at_its_minimum(norm: Norm, loss: f32) {
        let heads = [Head::Global, Head::Fused];
        let weights = Homoscedastic::initial(norm, &STATISTICS, &heads, &Device::Cpu).unwrap();
        let loss = Tensor::new(loss, &Device::Cpu).unwrap();
        let weighed =
            weights.weigh(Head::Fused, Term::Absolute, Component::Rotation, &loss).unwrap().affine(1.5, 0.0);
        let gradients = weighed.unwrap().backward().unwrap();
        let before: Vec<(String, f64)> = weights.deviations().unwrap();
        let gradient =
            |var: &Var| gradients.get(var).map(|g| g.to_scalar::<f32>().map(f64::from)).transpose();
        weights.start_at(Head::Fused, 1.5, gradient).unwrap();
        for ((name, after), (_, before)) in weights.deviations().unwrap().into_iter().zip(before) {
            let expected = if name == "loss.fused.absolute.rotation" { 0.04 } else { before };
            assert!((after - expected).abs() < 1e-5, "{name}: {after}");
        }
        // A perfect batch stops at the smallest variance and not at the logarithm of 0.
        weights.start_at(Head::Fused, 1.5, |_| Ok(Some(1.5))).unwrap();
        assert!(
            weights.deviations().unwrap()[4..].iter().all(|(_, deviation)| (deviation - 1e-3).abs() < 1e-6)
        );
    }

    #[test]
    fn a_head_without_weights_and_targets_without_numbers_are_refused() {
        let loss = Tensor::new(1.0_f32, &Device::Cpu).unwrap();
        let error = weights(&[Head::Global]).weigh(Head::Fused, Term::Pairs, Component::Rotation, &loss);
        assert!(error.unwrap_err().to_string().contains("loss.fused.pairs.rotation"));
        let bad = TargetStatistics { pairs_rotation_rad2: f64::NAN, ..STATISTICS };
        let error = Homoscedastic::initial(Norm::Squares, &bad, &[Head::Relative], &Device::Cpu)
            .unwrap_err()
            .to_string();
        assert!(error.contains("loss.relative.pairs.rotation") && error.contains("NaN"), "{error}");
    }
}
