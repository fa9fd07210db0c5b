//! The pose in the map: the network's global pose, checked against the motion since the last accepted one.

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

/// Follows `map_from_base` from frame to frame.
#[derive(Debug, Clone)]
pub(crate) struct MapTracker {
    gate: Option<InnovationGate>,
    anchor: Anchor,
    /// The last frame's global pose, accepted or not.
    last_measured: Option<Uncertain>,
    rejections: u32,
    agreements: u32,
    is_lost: bool,
}

impl MapTracker {
    pub(crate) fn new(gate: Option<InnovationGate>) -> Self {
        let anchor = Anchor::Unknown;
        Self { gate, anchor, last_measured: None, rejections: 0, agreements: 0, is_lost: false }
    }

    /// Another gate from the next frame on.
    pub(crate) fn set_gate(&mut self, gate: Option<InnovationGate>) {
        self.gate = gate;
    }

    /// Takes one frame: `previous_from_current` where the motion is known, `measured` where there is a scene.
    pub(crate) fn update(
        &mut self,
        previous_from_current: Option<&Uncertain>,
        measured: Option<&Uncertain>,
    ) -> MapUpdate {
        let moved = |at: Uncertain| previous_from_current.map(|motion| at.then(motion));
        let predicted = match self.anchor {
            Anchor::Unknown => None,
            Anchor::LastFrame(pose) => moved(pose),
            Anchor::NextFrame(pose) => Some(pose),
        }
        .filter(Uncertain::is_presentable);
        let expected = self.last_measured.and_then(moved);
        self.last_measured = measured.copied();
        let Some(measured) = measured else {
            self.set_anchor(predicted);
            return MapUpdate {
                map_from_base: predicted,
                innovation_ratio: f64::NAN,
                verdict: Verdict::Following,
            };
        };
        let ratio = predicted.map_or(f64::NAN, |predicted| innovation_ratio(&predicted, measured));
        let verdict = match self.gate {
            Some(gate) if ratio > 1.0 => self.contradiction(gate, expected.as_ref(), measured),
            _ => Verdict::Accepted,
        };
        let map_from_base = match verdict {
            Verdict::Accepted | Verdict::Reinitialised => {
                (self.rejections, self.agreements, self.is_lost) = (0, 0, false);
                self.set_anchor(Some(*measured));
                Some(*measured)
            }
            Verdict::Rejected | Verdict::Following => {
                self.set_anchor(predicted);
                predicted
            }
            Verdict::Lost => {
                self.set_anchor(predicted);
                None
            }
        };
        MapUpdate { map_from_base, innovation_ratio: ratio, verdict }
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
        (self.anchor, self.last_measured) = (Anchor::Unknown, None);
        (self.rejections, self.agreements, self.is_lost) = (0, 0, false);
    }

    /// The motion from the last frame to the next will not be measured, but the body is taken to stand still.
    pub(crate) fn hold(&mut self) {
        self.last_measured = None;
        if let Anchor::LastFrame(pose) = self.anchor {
            self.anchor = Anchor::NextFrame(pose);
        }
    }

    /// The body is known to be there: now, which is the last frame, or the next one where there was none.
    pub(crate) fn place(&mut self, map_from_base: Uncertain, has_last_frame: bool) {
        self.forget();
        self.anchor =
            if has_last_frame { Anchor::LastFrame(map_from_base) } else { Anchor::NextFrame(map_from_base) };
    }

    fn set_anchor(&mut self, at: Option<Uncertain>) {
        self.anchor = at.map_or(Anchor::Unknown, Anchor::LastFrame);
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
