//! When each step of a played recording is due.

use std::sync::Arc;

use grnet_frame::Camera;

use crate::dataset::RecordedFrame;

/// The part of a recording that is played, maybe over and over. Steps count the frames from its start, over
/// all rounds.
#[derive(Debug, Clone)]
pub(crate) struct Schedule {
    pub name: String,
    pub frames: Arc<[RecordedFrame]>,
    pub camera: Option<Camera>,
    /// Index in the recording of the first frame.
    pub start_at: u64,
    pub looped: bool,
    /// From the start of a round to the start of the next, on the recording's clock.
    pub period_ns: u64,
}

/// One frame to be played.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Step<'a> {
    pub frame: &'a RecordedFrame,
    pub sequence: u64,
    /// Since the first frame of the first round, on the recording's clock.
    pub offset_ns: u64,
}

impl Schedule {
    /// Steps in all; `None` for ever.
    pub fn length(&self) -> Option<u64> {
        (!self.looped).then_some(self.frames.len() as u64)
    }

    /// The step's frame; `None` after the last.
    pub fn step(&self, step: u64) -> Option<Step<'_>> {
        let length = self.frames.len() as u64;
        if !self.looped && step >= length {
            return None;
        }
        let frame = &self.frames[(step % length) as usize];
        // Names can claim times near the end of the range; they stay there rather than wrap.
        let within_ns = frame.time_ns - self.frames[0].time_ns;
        let offset_ns = (step / length).saturating_mul(self.period_ns).saturating_add(within_ns);
        Some(Step { frame, sequence: self.start_at + step, offset_ns })
    }

    /// Time of capture on the recording's clock, which runs on from round to round.
    pub fn recorded_ns(&self, step: &Step<'_>) -> u64 {
        self.frames[0].time_ns.saturating_add(step.offset_ns)
    }

    /// The last step that is due `elapsed_ns` (on the recording's clock) after the start, at least `from`.
    pub fn newest_due(&self, from: u64, elapsed_ns: u64) -> u64 {
        let length = self.frames.len() as u64;
        let (round, within_ns) = if self.looped {
            (elapsed_ns / self.period_ns, elapsed_ns % self.period_ns)
        } else {
            (0, elapsed_ns)
        };
        let due = self.frames.partition_point(|frame| frame.time_ns - self.frames[0].time_ns <= within_ns);
        // The first frame of a round is always due in it, so `due` is at least 1.
        from.max(round * length + due as u64 - 1)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn schedule(times_ns: &[u64], looped: bool) -> Schedule {
        let frame = |(index, time_ns): (usize, &u64)| RecordedFrame {
            path: format!("{index}.png").into(),
            time_ns: *time_ns,
            sequence: index as u64,
            world_from_camera: None,
            camera: None,
        };
        Schedule {
            name: "test".into(),
            frames: times_ns.iter().enumerate().map(frame).collect(),
            camera: None,
            start_at: 7,
            looped,
            period_ns: times_ns[times_ns.len() - 1] - times_ns[0] + 10,
        }
    }

    #[test]
    fn the_newest_due_frame_is_found() {
        let once = schedule(&[100, 110, 130, 130, 140], false);
        let due: Vec<u64> = [0, 9, 10, 29, 30, 40, 1000].map(|ns| once.newest_due(0, ns)).into();
        assert_eq!(due, [0, 0, 1, 1, 3, 4, 4]);
        assert_eq!((once.newest_due(3, 0), once.length()), (3, Some(5)));
        assert!(once.step(4).is_some() && once.step(5).is_none());
    }

    #[test]
    fn rounds_go_on_in_number_and_time() {
        let looped = schedule(&[100, 110, 130], true);
        let step = looped.step(4).unwrap();
        assert_eq!((step.sequence, step.offset_ns, looped.recorded_ns(&step)), (11, 50, 150));
        assert_eq!(step.frame.sequence, 1);
        assert_eq!((looped.newest_due(0, 39), looped.newest_due(0, 40), looped.length()), (2, 3, None));
    }

    proptest! {
        #[test]
        fn steps_never_go_back_and_the_newest_due_is_the_newest(
            gaps in prop::collection::vec(0u64..50, 0..20), looped: bool, elapsed in 0u64..3000,
        ) {
            let times: Vec<u64> =
                std::iter::once(1000).chain(gaps.iter().scan(1000, |t, gap| { *t += gap; Some(*t) })).collect();
            let schedule = schedule(&times, looped);
            let steps: Vec<Step<'_>> = (0..400).map_while(|step| schedule.step(step)).collect();
            for pair in steps.windows(2) {
                prop_assert!(pair[0].offset_ns <= pair[1].offset_ns && pair[0].sequence < pair[1].sequence);
            }
            let slow = steps.iter().rposition(|step| step.offset_ns <= elapsed).unwrap() as u64;
            if slow < 399 {
                prop_assert_eq!(schedule.newest_due(0, elapsed), slow);
            }
        }
    }
}
