//! How long the stages take: percentiles over the last seconds and over the whole run.

use std::time::Duration;

use grnet_proto::{LatencyPercentiles, StageLatency, StagePercentiles};
use hdrhistogram::Histogram;

/// Half of the time that the recent percentiles look back.
const HALF_WINDOW: Duration = Duration::from_secs(5);

/// Longest latency that is told apart from longer ones.
const MOST_US: u64 = 600_000_000;

/// The stages in the order a frame passes them, the total last: names as in [`LatencyPercentiles::stages`].
const STAGES: usize = 6;

/// Latencies of all stages.
#[derive(Debug)]
pub struct Latencies {
    stages: [Stage; STAGES],
    rotated_ns: u64,
}

#[derive(Debug)]
struct Stage {
    current: Histogram<u64>,
    previous: Histogram<u64>,
    whole: Histogram<u64>,
}

impl Default for Latencies {
    fn default() -> Self {
        Self { stages: std::array::from_fn(|_| Stage::new()), rotated_ns: 0 }
    }
}

impl Latencies {
    /// Adds what one sample measured; NaN is not counted.
    pub fn record(&mut self, latency: &StageLatency) {
        let StageLatency { wait_us, preprocess_us, infer_us, fuse_us, publish_us, total_us } = *latency;
        let values = [wait_us, preprocess_us, infer_us, fuse_us, publish_us, total_us];
        for (stage, value_us) in self.stages.iter_mut().zip(values) {
            stage.record(value_us);
        }
    }

    /// Percentiles over the last 5 to 10 seconds before `now_ns`.
    pub fn recent(&mut self, now_ns: u64) -> LatencyPercentiles {
        if now_ns.saturating_sub(self.rotated_ns) >= HALF_WINDOW.as_nanos() as u64 {
            self.rotated_ns = now_ns;
            self.stages.iter_mut().for_each(Stage::rotate);
        }
        let [wait, preprocess, infer, fuse, publish, total] = self.stages.each_ref().map(Stage::recent);
        LatencyPercentiles { wait, preprocess, infer, fuse, publish, total }
    }

    /// Percentiles over the whole run.
    pub fn whole(&self) -> LatencyPercentiles {
        let [wait, preprocess, infer, fuse, publish, total] =
            self.stages.each_ref().map(|stage| percentiles(&stage.whole));
        LatencyPercentiles { wait, preprocess, infer, fuse, publish, total }
    }
}

impl Stage {
    fn new() -> Self {
        let empty = || Histogram::new_with_bounds(1, MOST_US, 3).expect("the bounds are valid");
        Self { current: empty(), previous: empty(), whole: empty() }
    }

    fn record(&mut self, value_us: f32) {
        // A time of capture may lie a little in the future: negative becomes zero.
        if value_us.is_finite() {
            let value_us = value_us.max(0.0).round() as u64;
            self.current.saturating_record(value_us);
            self.whole.saturating_record(value_us);
        }
    }

    fn rotate(&mut self) {
        std::mem::swap(&mut self.current, &mut self.previous);
        self.current.reset();
    }

    fn recent(&self) -> StagePercentiles {
        let mut both = self.previous.clone();
        both.add(&self.current).expect("the bounds are the same");
        percentiles(&both)
    }
}

fn percentiles(histogram: &Histogram<u64>) -> StagePercentiles {
    if histogram.is_empty() {
        return StagePercentiles::UNKNOWN;
    }
    let at = |quantile| histogram.value_at_quantile(quantile) as f32;
    StagePercentiles { p50_us: at(0.5), p90_us: at(0.9), p99_us: at(0.99), max_us: histogram.max() as f32 }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sample(infer_us: f32) -> StageLatency {
        StageLatency { infer_us, ..StageLatency::UNKNOWN }
    }

    #[test]
    fn percentiles_are_those_of_what_was_measured() {
        let mut latencies = Latencies::default();
        assert!(latencies.whole().infer.p50_us.is_nan());
        for value in 1..=1000 {
            latencies.record(&sample(value as f32));
        }
        let infer = latencies.recent(1).infer;
        assert!((infer.p50_us - 500.0).abs() <= 1.0 && (infer.p99_us - 990.0).abs() <= 1.0, "{infer:?}");
        assert!(latencies.recent(1).wait.p50_us.is_nan());
    }

    #[test]
    fn recent_percentiles_forget_and_whole_ones_do_not() {
        let mut latencies = Latencies::default();
        latencies.record(&sample(7.0));
        for second in 1..=3 {
            latencies.recent(second * 6_000_000_000);
        }
        assert!(latencies.recent(18_000_000_001).infer.max_us.is_nan());
        assert_eq!(latencies.whole().infer.max_us, 7.0);
    }

    #[test]
    fn a_time_of_capture_in_the_future_is_zero_latency() {
        let mut latencies = Latencies::default();
        latencies.record(&sample(-3.0));
        assert_eq!(latencies.whole().infer.max_us, 0.0);
    }
}
