//! The pose in the map: the network's global pose, checked against the motion since the last accepted one, and on request
//! averaged along the odometry.

use grnet_geometry::covariance;

use super::heads::Uncertain;
use crate::options::{AfterRejections, InnovationGate};

/// The 99 % point of chi-square with 6 degrees of freedom.
const CHI_SQUARE_6_99: f64 = 16.81;

/// What a frame did to the map pose.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Verdict {
    /// No global pose to judge: the map pose follows odometry, where there is one.
    Following,
    /// The global pose was taken.
    Accepted,
    /// The global pose contradicts the motion; the map pose follows odometry.
    Rejected,
    /// The global pose was taken in spite of contradicting the motion.
    Reinitialised,
    /// Too many contradictions: the map pose is not known.
    Lost,
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct MapUpdate {
    pub(crate) map_from_base: Option<Uncertain>,
    pub(crate) innovation_ratio: f64,
    pub(crate) verdict: Verdict,
}

/// Where the body was last known to be.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Anchor {
    Unknown,
    /// Of the last frame: the motion since then comes on top.
    LastFrame(Uncertain),
    /// Of the next frame, as it is.
    NextFrame(Uncertain),
}

impl Anchor {
    fn last(at: Option<Uncertain>) -> Self {
        at.map_or(Self::Unknown, Self::LastFrame)
    }

    /// Where the body is at the next frame, after a motion that is perhaps not known.
    fn moved(self, motion: Option<&Uncertain>) -> Option<Uncertain> {
        match self {
            Self::Unknown => None,
            Self::LastFrame(pose) => motion.map(|motion| pose.then(motion)),
            Self::NextFrame(pose) => Some(pose),
        }
        .filter(Uncertain::is_presentable)
    }

    /// The body is taken to stand still until the next frame.
    fn held(self) -> Self {
        match self {
            Self::LastFrame(pose) => Self::NextFrame(pose),
            other => other,
        }
    }
}

/// Follows `map_from_base` from frame to frame.
#[derive(Debug, Clone)]
pub(crate) struct MapTracker {
    gate: Option<InnovationGate>,
    smoothing_s: f64,
    /// The last accepted global pose, moved since: what the gate compares with.
    anchor: Anchor,
    /// What was published, moved since.
    published: Anchor,
    /// How many global poses the published one is a mean of.
    averaged: u32,
    /// The last frame's global pose, accepted or not.
    last_measured: Option<Uncertain>,
    rejections: u32,
    agreements: u32,
    is_lost: bool,
}

impl MapTracker {
    pub(crate) fn new(gate: Option<InnovationGate>, smoothing_s: f64) -> Self {
        Self {
            gate,
            smoothing_s,
            anchor: Anchor::Unknown,
            published: Anchor::Unknown,
            averaged: 0,
            last_measured: None,
            rejections: 0,
            agreements: 0,
            is_lost: false,
        }
    }

    /// Other rules from the next frame on.
    pub(crate) fn set_rules(&mut self, gate: Option<InnovationGate>, smoothing_s: f64) {
        (self.gate, self.smoothing_s) = (gate, smoothing_s);
    }

    /// Takes one frame: `previous_from_current` where the motion is known, `measured` where there is a scene; `dt_s` after
    /// the last one.
    pub(crate) fn update(
        &mut self,
        previous_from_current: Option<&Uncertain>,
        measured: Option<&Uncertain>,
        dt_s: Option<f64>,
    ) -> MapUpdate {
        let predicted = self.anchor.moved(previous_from_current);
        let continued = self.published.moved(previous_from_current);
        let expected = self.last_measured.and_then(|at| previous_from_current.map(|motion| at.then(motion)));
        self.last_measured = measured.copied();
        let Some(measured) = measured else {
            (self.anchor, self.published) = (Anchor::last(predicted), Anchor::last(continued));
            return MapUpdate {
                map_from_base: continued,
                innovation_ratio: f64::NAN,
                verdict: Verdict::Following,
            };
        };
        let ratio = predicted.map_or(f64::NAN, |predicted| innovation_ratio(&predicted, measured));
        let verdict = match self.gate {
            Some(gate) if ratio > 1.0 => self.contradiction(gate, expected.as_ref(), measured),
            _ => Verdict::Accepted,
        };
        let (at, published) = match verdict {
            Verdict::Accepted | Verdict::Reinitialised => {
                (self.rejections, self.agreements, self.is_lost) = (0, 0, false);
                // A jump that is announced is made at once.
                let continued = continued.filter(|_| verdict == Verdict::Accepted);
                (Some(*measured), Some(self.smoothed(continued, measured, dt_s)))
            }
            Verdict::Rejected | Verdict::Following | Verdict::Lost => (predicted, continued),
        };
        (self.anchor, self.published) = (Anchor::last(at), Anchor::last(published));
        let map_from_base = published.filter(|_| verdict != Verdict::Lost);
        MapUpdate { map_from_base, innovation_ratio: ratio, verdict }
    }

    /// The mean of what was published, moved to this frame, and this frame's global pose. The past fades with the time
    /// constant `smoothing_s`; until there is that much of it, all global poses weigh the same.
    ///
    /// Where only one of the two covariances is known, that pose alone counts.
    fn smoothed(
        &mut self,
        continued: Option<Uncertain>,
        measured: &Uncertain,
        dt_s: Option<f64>,
    ) -> Uncertain {
        let (Some(continued), Some(dt_s)) = (continued.filter(|_| self.smoothing_s > 0.0), dt_s) else {
            self.averaged = 1;
            return *measured;
        };
        match (continued.covariance.is_finite(), measured.covariance.is_finite()) {
            (true, false) => continued,
            (false, true) => {
                self.averaged = 1;
                *measured
            }
            _ => {
                self.averaged = self.averaged.saturating_add(1);
                let new_share = -(-dt_s / self.smoothing_s).exp_m1();
                continued.towards(measured, new_share.max(1.0 / f64::from(self.averaged)))
            }
        }
    }

    fn contradiction(
        &mut self,
        gate: InnovationGate,
        expected: Option<&Uncertain>,
        measured: &Uncertain,
    ) -> Verdict {
        self.rejections = self.rejections.saturating_add(1);
        let agrees = expected.is_some_and(|expected| innovation_ratio(expected, measured) <= 1.0);
        self.agreements = if agrees { self.agreements.saturating_add(1) } else { 0 };
        let run_is_over = self.rejections > gate.rejections_allowed;
        match gate.then {
            AfterRejections::Reinitialise if run_is_over => Verdict::Reinitialised,
            AfterRejections::Lost if self.is_lost && self.agreements >= gate.agreements_to_recover => {
                Verdict::Reinitialised
            }
            AfterRejections::Lost if run_is_over => {
                if !self.is_lost {
                    (self.is_lost, self.agreements) = (true, 0);
                }
                Verdict::Lost
            }
            _ => Verdict::Rejected,
        }
    }

    /// The motion from the last frame to the next will not be known: nothing can be predicted.
    pub(crate) fn forget(&mut self) {
        (self.anchor, self.published, self.averaged) = (Anchor::Unknown, Anchor::Unknown, 0);
        self.last_measured = None;
        (self.rejections, self.agreements, self.is_lost) = (0, 0, false);
    }

    /// The motion from the last frame to the next will not be measured, but the body is taken to stand still.
    pub(crate) fn hold(&mut self) {
        self.last_measured = None;
        (self.anchor, self.published) = (self.anchor.held(), self.published.held());
    }

    /// The body is known to be there: now, which is the last frame, or the next one where there was none.
    pub(crate) fn place(&mut self, map_from_base: Uncertain, has_last_frame: bool) {
        self.forget();
        let at = Anchor::LastFrame(map_from_base);
        let at = if has_last_frame { at } else { at.held() };
        (self.anchor, self.published, self.averaged) = (at, at, 1);
    }
}

/// `v^T S^-1 v / 16.81`, v the difference of the poses in the covariances' own convention, S the sum of the
/// covariances. NaN when one of them is unknown; the largest number when the difference overflows.
pub(crate) fn innovation_ratio(predicted: &Uncertain, measured: &Uncertain) -> f64 {
    if !(predicted.covariance.is_finite() && measured.covariance.is_finite()) {
        return f64::NAN;
    }
    let difference = covariance::error(&predicted.pose, &measured.pose);
    let sum = predicted.covariance + measured.covariance;
    sum.nees(&difference).map_or(f64::MAX, |squared| squared / CHI_SQUARE_6_99)
}
