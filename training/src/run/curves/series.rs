//! Lines of a plot from the numbers of a log: gaps, smoothing, thinning, and the range of an axis.

use std::ops::Range;

/// Columns of the picture that are worth a point of their own.
const COLUMNS: usize = 800;
/// Magnitudes beyond this are as little of a number as infinity, for a plot.
const LARGEST: f64 = 1e30;
/// A logarithmic axis spans no more than this, a linear one turns into one beyond [`CURVED`].
const SPAN: f64 = 1e8;
/// From this ratio of the largest to the smallest value on, an axis is logarithmic.
const CURVED: f64 = 8.0;

/// A point: step and value.
pub(super) type Point = (f64, f64);

/// Whether a value can be drawn.
pub(super) fn is_drawable(value: f64) -> bool {
    value.abs() <= LARGEST
}

/// The points as lines that end where a value cannot be drawn.
pub(super) fn pieces(points: &[Point]) -> Vec<Vec<Point>> {
    points.split(|(_, value)| !is_drawable(*value)).filter(|piece| !piece.is_empty()).map(thinned).collect()
}

/// An exponential mean over a fortieth of the points; what cannot be drawn is passed over. Nothing of few points.
pub(super) fn smoothed(points: &[Point]) -> Vec<Point> {
    let span = points.len() / 40;
    if span < 2 {
        return Vec::new();
    }
    let share = 2.0 / (span as f64 + 1.0);
    let (mut mean, mut weight) = (0.0, 0.0);
    let mut line = Vec::new();
    for (step, value) in points.iter().filter(|(_, value)| is_drawable(*value)) {
        mean += share * (value - mean);
        weight += share * (1.0 - weight);
        // The mean began at zero: what that took away is given back.
        line.push((*step, mean / weight));
    }
    thinned(&line)
}

/// At most two points per column: the lowest and the highest of those that fall into it.
fn thinned(points: &[Point]) -> Vec<Point> {
    if points.len() <= 2 * COLUMNS {
        return points.to_vec();
    }
    let mut line = Vec::with_capacity(2 * COLUMNS);
    for column in points.chunks(points.len().div_ceil(COLUMNS)) {
        let by_value = |n: &usize, m: &usize| column[*n].1.total_cmp(&column[*m].1);
        let lowest = (0..column.len()).min_by(by_value).unwrap_or_default();
        let highest = (0..column.len()).max_by(by_value).unwrap_or_default();
        line.push(column[lowest.min(highest)]);
        if lowest != highest {
            line.push(column[lowest.max(highest)]);
        }
    }
    line
}

/// The vertical axis of a panel.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Axis {
    pub(super) range: Range<f64>,
    pub(super) is_log: bool,
}

impl Axis {
    /// An axis for these values; logarithmic when they are positive and spread over more than [`CURVED`]. `zero_is_small`:
    /// zeros are lengths too small to measure and do not speak against it.
    pub(super) fn of(values: impl Iterator<Item = f64>, zero_is_small: bool) -> Self {
        let mut values: Vec<f64> = values.filter(|value| is_drawable(*value)).collect();
        values.sort_by(f64::total_cmp);
        let positive = values.partition_point(|value| *value <= 0.0);
        let all_positive = positive == 0 || (zero_is_small && values.first().is_some_and(|v| *v >= 0.0));
        let usable = if all_positive { &values[positive..] } else { &values[..] };
        let (Some(low), Some(high)) = (quantile(usable, 0.002), quantile(usable, 0.998)) else {
            return Self { range: 0.0..1.0, is_log: false };
        };
        let is_log = all_positive && low > 0.0 && high / low > CURVED;
        let range = match is_log {
            true => round_down(low.max(high / SPAN))..round_up(high),
            false => {
                let margin = match high - low {
                    0.0 => (0.1 * high.abs()).max(1e-12),
                    spread => 0.05 * spread,
                };
                low - margin..high + margin
            }
        };
        Self { range, is_log }
    }

    /// The value, or the end of the axis that it lies beyond.
    pub(super) fn bound(&self, value: f64) -> f64 {
        value.clamp(self.range.start, self.range.end)
    }
}

/// Of sorted values: few are all kept, of many a few wild ones may lie outside.
fn quantile(sorted: &[f64], share: f64) -> Option<f64> {
    let last = sorted.len().checked_sub(1)?;
    let at = (share * last as f64).round() as usize;
    Some(sorted[at])
}

/// The next of 1, 2, 5, 10, 20, ... at or below.
fn round_down(value: f64) -> f64 {
    let decade = 10f64.powf(value.log10().floor());
    let found =
        [10.0, 5.0, 2.0, 1.0].into_iter().map(|n| n * decade).find(|round| *round <= value * 1.000_001);
    found.unwrap_or(value)
}

/// The next of 1, 2, 5, 10, 20, ... at or above.
fn round_up(value: f64) -> f64 {
    let decade = 10f64.powf(value.log10().floor());
    let found =
        [1.0, 2.0, 5.0, 10.0].into_iter().map(|n| n * decade).find(|round| *round >= value * 0.999_999);
    found.unwrap_or(value)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_end_at_what_cannot_be_drawn() {
        let points =
            [(0.0, 1.0), (1.0, f64::NAN), (2.0, 2.0), (3.0, 3.0), (4.0, f64::INFINITY), (5.0, 1e300)];
        assert_eq!(pieces(&points), [vec![(0.0, 1.0)], vec![(2.0, 2.0), (3.0, 3.0)]]);
    }

    #[test]
    fn thinning_keeps_the_peaks() {
        let mut points: Vec<Point> = (0..100_000).map(|n| (n as f64, 1.0)).collect();
        (points[777].1, points[55_555].1) = (9.0, -9.0);
        let thin = &pieces(&points)[0];
        assert!(thin.len() <= 2 * COLUMNS, "{}", thin.len());
        assert!(thin.contains(&(777.0, 9.0)) && thin.contains(&(55_555.0, -9.0)));
        assert!(thin.is_sorted_by(|a, b| a.0 < b.0));
    }

    #[test]
    fn smoothing_keeps_a_constant_and_calms_noise() {
        let noisy: Vec<Point> = (0..1000).map(|n| (n as f64, 5.0 + f64::from(n % 2) - 0.5)).collect();
        assert!(smoothed(&noisy)[100..].iter().all(|(_, value)| (value - 5.0).abs() < 0.05));
        let constant: Vec<Point> = (0..1000).map(|n| (n as f64, 3.0)).collect();
        assert!(smoothed(&constant).iter().all(|(_, value)| (value - 3.0).abs() < 1e-9));
        assert_eq!(smoothed(&noisy[..50]), []);
    }

    #[test]
    fn axes_suit_their_values() {
        let axis = |values: &[f64], zero_is_small| Axis::of(values.iter().copied(), zero_is_small);
        assert_eq!(axis(&[0.03, 4.0], false), Axis { range: 0.02..5.0, is_log: true });
        assert_eq!(axis(&[0.0, 0.01, 1.0], true), Axis { range: 0.01..1.0, is_log: true });
        assert!(!axis(&[0.0, 0.01, 1.0], false).is_log);
        assert_eq!(axis(&[-1.0, 1.0], false), Axis { range: -1.1..1.1, is_log: false });
        assert_eq!(axis(&[f64::NAN], false), Axis { range: 0.0..1.0, is_log: false });
        for same in [0.0, 5.0, -5.0, 1e30, 1e-300] {
            let range = axis(&[same], false).range;
            assert!(range.start < same && same < range.end, "{range:?} around {same}");
        }
        let wide = axis(&[1e-200, 1e20], false);
        assert!(wide.is_log && wide.range == (1e12..1e20), "{wide:?}");
    }
}
