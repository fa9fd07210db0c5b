//! ELU, and the exponential below it in a form that compilers turn into vector instructions.

/// x above 0, exp(x) - 1 below.
#[inline(always)]
pub(super) fn elu(x: f32) -> f32 {
    if x > 0.0 { x } else { exp_minus_1(x) }
}

/// exp(x) - 1 for x <= 0, to 2e-7 of its value: exp(x) = 2^n exp(r), |r| <= ln(2) / 2, exp(r) - 1 by its Taylor series.
#[inline(always)]
fn exp_minus_1(x: f32) -> f32 {
    // Adding 1.5 * 2^23 rounds to an integer, which then stands in the low bits.
    const ROUND: f32 = 12_582_912.0;
    // ln(2) in two parts, the first with few enough bits for an exact product.
    const LN2: (f32, f32) = (0.693_359_4, -2.121_944_4e-4);
    let x = if x < -80.0 { -80.0 } else { x }; // f32::max would turn NaN into -80
    let shifted = x * std::f32::consts::LOG2_E + ROUND;
    let n = shifted - ROUND;
    let r = x - n * LN2.0 - n * LN2.1;
    let series = 1.0 / 120.0 + r * (1.0 / 720.0 + r * (1.0 / 5040.0));
    let series = r + r * r * (0.5 + r * (1.0 / 6.0 + r * (1.0 / 24.0 + r * series)));
    let power = f32::from_bits(shifted.to_bits().wrapping_add(127) << 23); // 2^n
    power * series + (power - 1.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn elu_is_the_exponential_below_zero_and_the_identity_above() {
        let points = (0..200_000).map(|i| -(i as f64) * 5e-4).chain((0..60).map(|i| -(2.0_f64.powi(-i))));
        for x in points.map(|x| x as f32) {
            let (found, expected) = (f64::from(elu(x)), f64::from(x).exp_m1());
            assert!((found - expected).abs() <= 2e-7 * expected.abs(), "elu({x}) = {found}, not {expected}");
        }
        assert_eq!([elu(0.0), elu(1e-30), elu(3.5), elu(f32::NEG_INFINITY)], [0.0, 1e-30, 3.5, -1.0]);
        assert!(elu(f32::NAN).is_nan(), "a defect upstream must stay visible");
    }
}
